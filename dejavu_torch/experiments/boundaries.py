"""What it costs that chunks do not end where what repeats starts and stops (section V, underground)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.ground_truth import counted, is_right
from dejavu_torch.database.scores import Matcher
from dejavu_torch.evaluation.contenders import Contender, contend
from dejavu_torch.evaluation.controls import same_settings
from dejavu_torch.experiments.compare import Comparison
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.types import GroundTruth, InputError, Match


class GivenChunks(SpectrogramAnalysis):
    """The spectrogram analysis on chunks that are known beforehand.

    Args:
        cuts: the frames at which a chunk ends and the next begins, increasing.
        settings: as SpectrogramAnalysis has them; window and hop mean nothing here.

    Convention: a piece of fewer than two of the shortest periods joins the piece before it.
    """

    def __init__(self, cuts: Sequence[int], settings: Mapping[str, Any] | None = None) -> None:
        super().__init__(**(settings or {}))
        self.cuts = list(cuts)
        self.settings = dict(settings or {})

    def chunks(self, frames: int) -> list[tuple[int, int]]:
        """The chunks [start, stop) of a traverse of `frames` frames."""
        edges = [0]
        for cut in [*self.cuts, frames]:
            if edges[-1] + 2 * self.min_period <= cut <= frames - 2 * self.min_period or cut == frames:
                edges.append(cut)
        if frames < 2 * self.min_period:
            raise InputError(
                f"the traverse has {frames} frames; expected at least {2 * self.min_period}, two periods"
            )
        return list(pairwise(edges))


class BoundaryEffect(NamedTuple):
    """Recall@1 of queries near to where something starts or stops, and of the others.

    near: frames within which a place counts as near. queries_near, queries_far: how many there are.
    None where there are none.
    """

    near: int
    queries_near: int
    queries_far: int
    recall_at_1_near: float | None
    recall_at_1_far: float | None


def boundary_effect(
    match: Match, truth: GroundTruth, cuts: Sequence[int], tolerance: int, near: int = 32
) -> BoundaryEffect:
    """Recall@1 near to the cuts and far from them.

    Args:
        cuts: reference frames at which something starts or stops, at least one.
        near: frames.

    Shape: match and truth of Q queries.
    """
    if not cuts:
        raise InputError("there are no cuts; expected at least one frame at which something starts or stops")
    answered = counted(match.index, truth, tolerance) & (truth.positives >= 0).any(1)
    right = is_right(match.index, truth.positives, tolerance)
    apart = (truth.positives[:, :, None] - torch.tensor(list(cuts))).abs().amin(2)
    close = torch.where(truth.positives >= 0, apart, torch.iinfo(torch.int64).max).amin(1) <= near

    def recall(which: Tensor) -> float | None:
        return float(right[which].double().mean()) if which.any() else None

    inside, outside = answered & close, answered & ~close
    return BoundaryEffect(near, int(inside.sum()), int(outside.sum()), recall(inside), recall(outside))


class Boundaries(NamedTuple):
    """What the chunks' ends cost, told by two maps of comparable scores (`reduction="mean"`).

    fixed: chunks as they were. known: chunks that end at the cuts. Each with its recall near to the cuts
    and far from them. The printed sum of eq. 4 would hide it: of chunks of different size the one of the
    fewest features gets nearly all queries.
    """

    fixed: Contender
    known: Contender
    fixed_effect: BoundaryEffect
    known_effect: BoundaryEffect


def known_boundaries(result: Comparison, cuts: Sequence[int], tolerance: int) -> Boundaries:
    """The settings of a comparison, with comparable scores, on its own chunks and on those the cuts make.

    Raises:
        InputError: a comparison without truth, or whose periods another finder found.
    """
    model, truth = result.model, result.truth
    if truth is None or not isinstance(model.periods, SpectrogramAnalysis):
        raise InputError(
            "known boundaries need a truth and SpectrogramAnalysis; this comparison has not both"
        )
    names = ("min_period", "strongest", "peaks", "false_alarm", "similar")
    given = GivenChunks(cuts, {name: getattr(model.periods, name) for name in names})
    contenders, effects = [], []
    for name, periods in (
        ("the same chunks, comparable scores", model.periods),
        ("chunks cut where structures start and stop, comparable scores", given),
    ):
        other = same_settings(model)
        other.periods, other.matcher = periods, Matcher(model.matcher.metric, "mean")
        match = other.learn_features(result.stored, result.reference).localize(result.seen)
        contenders.append(contend(name, match, truth, tolerance, other.map_bytes))
        effects.append(boundary_effect(match, truth, cuts, tolerance))
    return Boundaries(contenders[0], contenders[1], effects[0], effects[1])
