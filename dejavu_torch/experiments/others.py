"""What else could be stored of a route, matched with the same queries."""

from __future__ import annotations

import logging
from typing import NamedTuple

from torch import Tensor

from dejavu_torch.evaluation.baselines import fair_stride, nearest_frames, stride_bytes
from dejavu_torch.evaluation.controls import null_control
from dejavu_torch.features.hog import HOG
from dejavu_torch.model import DejaVu
from dejavu_torch.types import InputError, Match, Traverse

log = logging.getLogger("dejavu_torch")


class Other(NamedTuple):
    """Matches of another way to store the route; bytes and k as of a Contender."""

    name: str
    match: Match
    bytes: int | None = None
    k: int | None = None


def others_of(
    model: DejaVu, stored: Tensor, seen: Tensor, tolerance: int, seed: int, progress: bool
) -> dict[str, Other]:
    """The baselines and null controls that every report sets beside the map.

    Args:
        model: with the map. stored: (N,D) features of the reference. seen: (Q,D) those of the queries.
        tolerance: the coarsest stride is twice as much. seed: of the shuffle of the null controls.
        progress: show progress bars on a terminal.
    """
    frames, dimension = stored.shape
    itemsize, backbone = model.map.templates.element_size(), model.backbone_bytes  # frames need it as well
    strides = {
        "uncompressed": 1,
        "stride": fair_stride(frames, dimension, itemsize, model.map_bytes - backbone, tolerance),
        "stride_coarsest": max(1, 2 * tolerance),
    }
    of = "" if isinstance(model.features, HOG) else "same features, "
    names = {
        "uncompressed": f"{of}all {frames} frames",
        "stride": f"{of}{_every(strides['stride'])} (at least the map's bytes)",
        "stride_coarsest": f"{of}{_every(strides['stride_coarsest'])} (2 x tolerance)",
    }
    nearest = nearest_frames(stored, seen, tuple(strides.values()), model.matcher.metric, progress)
    others = {
        key: Other(names[key], match, stride_bytes(frames, dimension, itemsize, k) + backbone, k)
        for (key, k), match in zip(strides.items(), nearest, strict=True)
    }
    if model.trained is None:
        null = null_control(model, stored, seen, seed, progress=progress)
        others["null"] = Other("null: all learnt shuffled", null)
    null = null_control(model, stored, seen, seed, same_plan=True, progress=progress)
    if model.trained is None:
        others["null_same_plan"] = Other("null: this map's layers, shuffled", null)
    else:  # training anew is a run of its own
        others["null"] = Other("null: templates of shuffled frames", null)
    return others


def hog_others(
    reference: Traverse, query: Traverse, batch_size: int, tolerance: int, progress: bool
) -> dict[str, Other]:
    """What a map of other features is set beside: HOG of all frames, and of every k-th, k = 2 x tolerance.

    Nothing where frames are too small for HOG.
    """
    plain = DejaVu(batch_size=batch_size)
    try:
        stored = plain.extract_all(reference, "HOG of the reference" if progress else None)
        seen = plain.extract_all(query, "HOG of the queries" if progress else None)
    except InputError as error:
        log.info("no HOG to compare with: %s", error)
        return {}
    steps = {"hog": 1, "hog_stride_coarsest": max(1, 2 * tolerance)}
    nearest = nearest_frames(stored, seen, tuple(steps.values()), progress=progress)
    frames, dimension = stored.shape
    return {
        key: Other(f"HOG, {_every(k)}", match, stride_bytes(frames, dimension, stored.element_size(), k), k)
        for (key, k), match in zip(steps.items(), nearest, strict=True)
    }


def _every(k: int) -> str:
    return "every frame" if k == 1 else f"every { ({2: '2nd', 3: '3rd'}.get(k, f'{k}th')) } frame"
