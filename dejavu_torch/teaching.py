"""Drives that teach a map without ground truth: a smoother places their frames."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from torch import Tensor

from dejavu_torch.data.traverse import chained
from dejavu_torch.features.views import LabelledFrames, Placed
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.centring import PRIOR, centred
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.types import Traverse

SURE = 0.9  # probability of a frame that teaches
FEWEST, SHARE = 60, 0.1  # frames of a drive that teaches, and their share of it, at least
ROUNDS = 2  # of placing: the second time on a map that the first one taught


@torch.no_grad()
def place_drive(model: DejaVu, descriptors: Tensor) -> Tensor:
    """The place of each frame of a drive, as sure as `SURE`, by the drive as a whole: (Q,K) -> (Q,) int64, -1
    for the others. All are -1 if it is no drive of the map, or too few of its frames are sure."""
    smoother, queries = PlaceSmoother(), descriptors
    if len(queries) >= PRIOR:
        queries = centred(model.map, queries)
    match = model.localize_descriptors(queries, model.matching(smoother)._replace(plain=descriptors))
    assert match.probability is not None
    places = torch.where(match.probability >= SURE, match.index, -1)
    few = int((places >= 0).sum()) < max(FEWEST, SHARE * len(places))
    return torch.full_like(places, -1) if few or not smoother.is_drive else places


def place_drives(
    model: DejaVu,
    reference: Traverse,
    drives: Sequence[tuple[Traverse, Tensor | None]],
    progress: bool = False,
) -> LabelledFrames:
    """Place drives on a map of the reference, learned from augmented copies, and once more on one that the
    drives have taught.

    Args:
        model: its settings. drives: in order, each with the place of each frame if it is known.
    """
    frames, lengths = chained([drive for drive, _ in drives]), [len(drive) for drive, _ in drives]
    which = torch.arange(len(drives)).repeat_interleave(torch.tensor(lengths))
    names = {i: drive.name for i, (drive, known) in enumerate(drives) if known is None}
    scratch, views = copy.deepcopy(model), None
    with scratch.descriptor.remembering():
        for rounds in range(1, ROUNDS + 1):
            scratch.learn(reference, progress, views)
            parts = scratch.descriptor.all_of(frames, progress).split(lengths)
            pairs = zip(parts, drives, strict=True)
            found = [place_drive(scratch, part) if known is None else known for part, (_, known) in pairs]
            before, places = views, torch.cat(found)
            views = LabelledFrames(frames, places, Placed(which, names, SURE, rounds))
            if not (places >= 0).any() or (before is not None and torch.equal(before.places, places)):
                break
    assert views is not None
    return views
