"""Steps that show no common ground: their velocity is interpolated, and they are told."""

from __future__ import annotations

import logging

import torch
from torch import Tensor

from dejavu_torch.types import InputError

log = logging.getLogger("dejavu_torch")

NAMED = 6  # cuts, and as many stretches without ground, that the line names


def mended(shift: Tensor, believed: Tensor, name: str) -> Tensor:
    """Steps that are not believed, interpolated between those that are, and told. (n,), (n,) -> (n,)"""
    bad = (~believed).nonzero()[:, 0]
    if not len(bad):
        return shift
    good = believed.nonzero()[:, 0]
    if not len(good):
        raise InputError(
            f"{name}: none of {len(shift)} steps shows the same ground twice; "
            "expected corners on the ground in front of the camera"
        )
    log.warning("%s: %s: the velocity there is interpolated", name, _interruptions(bad.tolist(), len(shift)))
    after = torch.searchsorted(good, bad)
    left, right = good[(after - 1).clamp(min=0)], good[after.clamp(max=len(good) - 1)]
    share = (bad - left).double() / (right - left).clamp(min=1)
    share = share.clamp(0, 1)  # ahead of the first and behind the last: that one's
    return shift.index_copy(0, bad, shift[left].lerp(shift[right], share))


def _interruptions(bad: list[int], steps: int) -> str:
    """Steps without common ground in words: alone they are cuts, else stretches of frames."""
    runs = [[bad[0], bad[0]]]
    for step in bad[1:]:
        if step == runs[-1][1] + 1:
            runs[-1][1] = step
        else:
            runs.append([step, step])
    cuts = [f"{first}" for first, last in runs if first == last]
    lost = [f"{first} to {last + 1}" for first, last in runs if first < last]
    told = []
    if cuts:
        told.append(
            f"{len(cuts)} cuts or bad views, after frames "
            if len(cuts) > 1
            else "a cut or bad view after frame "
        )
        told[-1] += _first_few(cuts)
    if lost:
        share = f"({len(bad) - len(cuts)} of {steps} steps)"
        told.append(f"no common ground in frames {_first_few(lost)} {share}")
    return "; ".join(told)


def _first_few(items: list[str]) -> str:
    more = len(items) - NAMED
    return ", ".join(items[:NAMED]) + (f" and {more} more" if more > 0 else "")
