"""Evaluate the probabilities of a calibrated map, and acceptance by them."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.ground_truth import GroundTruth, scored_and_right
from dejavu_torch.evaluation.activation import share
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.plots import DARK, GREY, RIGHT, Pictures, canvas, picture
from dejavu_torch.memory import in_float32
from dejavu_torch.recognition.calibration import TOLERANCE
from dejavu_torch.types import Facts, Match, SequenceModel, Traverse

if TYPE_CHECKING:
    from dejavu_torch.evaluation.localization import Localization

log = logging.getLogger("dejavu_torch")

ASKED = (0.5, 0.8, 0.9, 0.95, 0.99)  # precisions in a report
BINS = 10


def reach_of(tolerance: int, truth: GroundTruth | None, near: bool = False) -> int:
    """The places around an answer within which a probability is that of a right place.

    Args:
        tolerance: in places; above 0 it is the reach.
        truth: in places, None if unknown. At tolerance 0 the reach is half the longest stretch of consecutive
            right places, in the median over queries, rounded up; without stretches `TOLERANCE`.
        near: the truth is by distance, which reaches a place at least.

    Example:
        >>> from dejavu_torch.data.ground_truth import all_judged
        >>> reach_of(0, all_judged(torch.tensor([[3, 4, 5, 90], [6, 7, 8, 9], [-1, -1, -1, -1]])))
        1
    """
    if tolerance or truth is None or not bool((truth.positives >= 0).any()):
        return tolerance or TOLERANCE
    places = truth.positives[(truth.positives >= 0).any(1)].sort(1).values
    begins = F.pad((places.diff(dim=1) > 1) | (places[:, :-1] < 0), (1, 0), value=True)
    stretch = (places - places.where(begins, -1).cummax(1).values).amax(1)
    return math.ceil(stretch.median() / 2) or (1 if near else TOLERANCE)


def found_elsewhere(
    run: Localization,
    off: Sequence[Traverse],
    way: SequenceModel | None,
    ordered: bool,
    centring: bool,
    progress: bool,
) -> dict[str, Tensor]:
    """The probability of the match of each frame of routes off the map, (n,) by name; none without a
    calibration."""
    model, probabilities = run.model, {}
    if off and not ((way and way.whole) or model.matching(way).platt):
        log.warning("the map is not calibrated, so no frame of other routes has a probability")
        return {}
    for other in off:
        centres = centring and (way is None or way.whole)
        querying = model.looking(other, run.querying, ordered, centres)
        queries = model.described(other, querying, centres, progress)
        matching = model.matching(way)._replace(wrappers=querying.wrappers)
        match = model.localize_descriptors(queries, matching)
        assert match.probability is not None
        probabilities[other.name] = match.probability
    return probabilities


def rejection_facts(
    match: Match, truth: GroundTruth | None, tolerance: int, off_map: Mapping[str, Tensor]
) -> Facts:
    """The entry `rejection` of report.json; empty if matches have no probabilities."""
    if match.probability is None:
        return {}
    facts: Facts = {"off_map": {}}
    for name, probability in off_map.items():
        accepted = {f"{asked:g}": float((probability >= asked).double().mean()) for asked in ASKED}
        facts["off_map"][name] = {"frames": len(probability), "accepted": accepted}
    if truth is not None:
        probability, right = judged(match, truth, tolerance)
        scores = evaluate(replace(match, score=1 - match.probability), truth, tolerance)
        each = [(asked, probability >= asked) for asked in ASKED]
        facts |= {
            "auc": scores.auc,
            "recall_at_100_precision": scores.recall_at_100_precision,
            "precision": [
                {"asked": asked, "precision": share(right, kept), "kept": share(kept, right) or 0.0}
                for asked, kept in each
            ],
            "expected_calibration_error": calibration_error(probability, right, BINS),
        }
    return {"rejection": facts}


def judged(match: Match, truth: GroundTruth, tolerance: int) -> tuple[Tensor, Tensor]:
    """Probability (n,) of the queries that are scored, and whether they are right (n,) bool."""
    assert match.probability is not None
    kept, right = scored_and_right(match.index, truth, tolerance)
    return match.probability[kept], right[kept]


def rejection_table(facts: Mapping[str, Any]) -> list[list[str]]:
    """What is accepted at each requested precision, as rows of text, the header first."""
    own, off_map = facts.get("precision"), facts.get("off_map", {})
    if own is None and not off_map:
        return []
    rows = [["--precision", *(f"{asked:g}" for asked in ASKED)]]
    if own is not None:
        reached = ("" if one["precision"] is None else f"{one['precision']:.4f}" for one in own)
        rows.append(["precision reached", *reached])
        rows.append(["right answers accepted", *(f"{one['kept']:.3f}" for one in own)])
    for name, one in off_map.items():
        shares = (f"{one['accepted'][f'{asked:g}']:.4f}" for asked in ASKED)
        rows.append([f"accepted of {one['frames']} frames of {name}", *shares])
    return rows


@in_float32()
def draw_reliability(match: Match, truth: GroundTruth | None, tolerance: int) -> Pictures:
    """The share of right answers over their probability; empty without probabilities or truth."""
    if match.probability is None or truth is None:
        return {}
    probability, right = judged(match, truth, tolerance)
    if not len(right):
        return {}
    counts, sums, good = binned(probability, right, BINS)
    figure, (above, below) = canvas(4.2, 2, sharex=True, height_ratios=[3, 1])
    above.plot([0, 1], [0, 1], color=GREY, linewidth=0.8, linestyle=":")
    filled = counts > 0
    means, shares = sums[filled] / counts[filled], good[filled] / counts[filled]
    above.plot(means, shares, color=DARK, linewidth=1)
    sizes = 14 + 120 * (counts[filled] / counts.max()).sqrt()
    above.scatter(means, shares, s=sizes, color=RIGHT, zorder=3)
    above.set(ylabel="share that is right", xlim=(-0.03, 1.03), ylim=(-0.06, 1.06))
    below.bar((torch.arange(BINS) + 0.5) / BINS, counts, width=0.9 / BINS, color=GREY)
    below.set(xlabel="probability of being right", ylabel="queries", yscale="symlog", ylim=(0, None))
    return picture("reliability", (figure, (above, below)), error=calibration_error(probability, right, BINS))


def calibration_error(probability: Tensor, right: Tensor, bins: int = 10) -> float:
    """Expected calibration error: the mean distance of probabilities from the shares of right answers.

    Shape: probability (n,) and right (n,) bool -> a number from 0 to 1; NaN without answers.

    Source: Naeini, Cooper and Hauskrecht, AAAI 2015.

    Example:
        >>> calibration_error(torch.full((4,), 0.875), torch.tensor([True, True, True, False]))
        0.125
    """
    if not len(right):
        return math.nan
    _, sums, good = binned(probability, right, bins)
    return float((sums - good).abs().sum()) / len(right)


def binned(probability: Tensor, right: Tensor, bins: int) -> Tensor:
    """For each bin of probability: answers, the sum of their probabilities, right answers; (3,bins)."""
    probability = probability.double()
    columns = torch.stack([torch.ones_like(probability), probability, right.double()])
    bin_of = (probability * bins).long().clamp(0, bins - 1)
    return torch.zeros(3, bins, dtype=torch.float64).index_add_(1, bin_of, columns)
