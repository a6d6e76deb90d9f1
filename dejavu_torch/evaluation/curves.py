"""Exact precision and recall, with every distinct score as a threshold (section IV-C)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.ground_truth import (
    GroundTruth,
    Truth,
    as_ground_truth,
    counted,
    is_right,
    scored_and_right,
)
from dejavu_torch.types import InputError, Match

RECALL_DEFINITION = (
    "TP / all queries with a right answer; *_reported: TP / (TP + FN), a wrong report is no FN"
)


class PRCurve(NamedTuple):
    """Precision and recall when every query with score <= threshold reports; each (T,) float64."""

    precision: Tensor
    recall: Tensor
    threshold: Tensor


class Scores(NamedTuple):
    """The scores of matches against a truth; the fields are keys of report.json.

    recall = TP / all queries with a right answer; in the *_reported fields TP / (TP + FN), in which only
    a query that reports nothing is a false negative.

    The areas begin at the curve's first point: n right answers of different scores have 1 - 1/n, and of equal
    scores 0. `average_precision` does not depend on n: it is that of scikit-learn for whether the answers are
    right, 1 if all right answers have better scores than all wrong ones; it does not say how many are right.
    `recall_at_99_precision` orders the answers by `Match.confidence`, where it is known, all others by score.
    """

    auc: float
    auc_reported: float
    recall_at_100_precision: float
    recall_at_100_precision_reported: float
    precision_at_100_recall: float
    recall_at_1: float
    average_precision: float
    recall_at_99_precision: float


def pr_curve(
    score: Tensor, right: Tensor, answerable: Tensor, recall: Literal["all", "reported"] = "all"
) -> PRCurve:
    """Precision and recall if the queries up to each distinct score report (section IV-C).

    Args:
        score: best score of each query, lower is better; +inf reports nothing.
        right: whether the reported place is right.
        answerable: whether the query has a right answer.
        recall: "all" is TP / all answerable queries; "reported" is TP / (TP + FN), in which a query that
            reports a wrong place is a false positive only.

    Shape: (Q,), (Q,) bool, (Q,) bool -> PRCurve of (T,), T distinct finite scores, increasing.

    Raises:
        InputError: different lengths, or a NaN score.

    Example:
        >>> right = torch.tensor([True, False, True])
        >>> curve = pr_curve(torch.tensor([1.0, 2.0, 3.0]), right, torch.ones(3, dtype=torch.bool))
        >>> curve.precision.tolist(), curve.recall[-1].item()
        ([1.0, 0.5, 0.6666666666666666], 0.6666666666666666)
    """
    if not score.shape == right.shape == answerable.shape or score.ndim != 1:
        shapes = tuple(score.shape), tuple(right.shape), tuple(answerable.shape)
        raise InputError(f"score, right and answerable are {shapes}; expected three of (Q,)")
    if score.isnan().any():
        raise InputError("a score is NaN; expected numbers or +inf")
    reported = score.isfinite()
    order = score[reported].argsort(stable=True)
    ordered = score[reported][order].double()
    true_positives = (right & answerable)[reported][order].cumsum(0).double()
    answered = answerable[reported][order].cumsum(0).double()
    last = torch.ones_like(ordered, dtype=torch.bool)
    last[:-1] = ordered[1:] != ordered[:-1]
    tp = true_positives[last]
    accepted = torch.arange(1, len(ordered) + 1, device=score.device)[last].double()
    total = answerable.sum().double()
    # each answerable query that has not reported yet is a false negative
    relevant = total if recall == "all" else tp + (total - answered[last])
    fraction = torch.where(tp > 0, tp / torch.as_tensor(relevant).clamp(min=1), 0.0)
    return PRCurve(tp / accepted, fraction, ordered[last])


def area(curve: PRCurve) -> float:
    """Area under the curve, by trapezoids over its own points without an added starting point."""
    return float(torch.trapezoid(curve.precision, curve.recall)) if len(curve.recall) else 0.0


def average_precision(curve: PRCurve) -> float:
    """The mean, over right answers, of the precision at which they are reported."""
    gains = curve.recall.diff(prepend=curve.recall.new_zeros(1))
    return float((curve.precision * gains).sum() / gains.sum()) if bool(gains.any()) else 0.0


def recall_at_precision(curve: PRCurve, precision: float = 1.0) -> float:
    """The largest recall at which this share of the reports is right."""
    reached = curve.recall[curve.precision >= precision]
    return float(reached.max()) if len(reached) else 0.0


def by_confidence(match: Match) -> Match:
    """The same answers, the most confident first: with scores that fall with their confidence; unchanged if
    that is unknown."""
    if match.confidence is None:
        return match
    return replace(match, score=(-match.confidence).masked_fill(~match.score.isfinite(), torch.inf))


def threshold_of_full_precision(curve: PRCurve) -> float | None:
    """The threshold that accepts the most queries while all of them are right; None if there is none.

    It is between the last accepted score and the next one, with as few digits as that allows.

    Example:
        >>> scores, right = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([True, True, False])
        >>> threshold_of_full_precision(pr_curve(scores, right, torch.ones(3, dtype=torch.bool)))
        2.5
    """
    perfect = (curve.precision == 1).nonzero().flatten()
    if len(perfect) == 0:
        return None
    last = float(curve.threshold[perfect[-1]])
    beyond = curve.threshold[perfect[-1] + 1 :]
    middle = (last + float(beyond[0])) / 2 if len(beyond) else last + abs(last) / 1000 + 1e-12
    short = (float(f"{middle:.{digits}g}") for digits in range(1, 17))
    return next((one for one in short if last < one < 2 * middle - last), middle)


def curve_of(
    match: Match, truth: Truth, tolerance: int, recall: Literal["all", "reported"] = "all"
) -> PRCurve:
    """`pr_curve` of matches against a truth; see `evaluate`."""
    match, right, answerable = _judged(match, truth, tolerance)
    return pr_curve(match.score, right, answerable, recall)


def auc_error(match: Match, truth: Truth, tolerance: int, block: int, draws: int = 100) -> float:
    """Standard error of the area, by drawing blocks of consecutive queries with replacement (bootstrap).

    Args:
        block: queries that depend on each other, so that n of them say as much as n / block.

    Returns:
        A number of at least 0; 0 for fewer than two blocks.
    """
    match, right, answerable = _judged(match, truth, tolerance)
    blocks = torch.arange(len(right)).split(block)
    generator, areas = torch.Generator().manual_seed(0), []
    for _ in range(draws if len(blocks) > 1 else 0):
        drawn = torch.randint(len(blocks), (len(blocks),), generator=generator).tolist()
        chosen = torch.cat([blocks[i] for i in drawn])
        if answerable[chosen].any():
            areas.append(area(pr_curve(match.score[chosen], right[chosen], answerable[chosen])))
    return float(torch.tensor(areas).std()) if len(areas) > 1 else 0.0


def evaluate(match: Match, truth: Truth, tolerance: int = 5) -> Scores:
    """All scores of matches against a truth.

    Args:
        match: (Q,), or candidates (Q,k), of which the first is the answer. One of several sequences at once,
            (R,Q), has to be flattened.
        truth: in any form of `as_ground_truth`. Queries that are not judged, or that report an ignored place,
            are excluded from precision, recall and the number of queries.
        tolerance: places, inclusive; by default that of the commands.

    Raises:
        InputError: a truth of another length than the matches, a negative tolerance, or no query to judge.

    Example:
        >>> match = Match(torch.tensor([0, 7]), torch.tensor([0.1, 0.2]), torch.tensor([True, True]))
        >>> evaluate(match, [0, 1], tolerance=0).recall_at_1
        0.5
        >>> both = torch.tensor([True, True])
        >>> truth = GroundTruth(torch.tensor([[0], [1]]), both, torch.tensor([[-1], [7]]))
        >>> evaluate(match, truth, tolerance=0).recall_at_1
        1.0
    """
    match, right, answerable = _judged(match, truth, tolerance)
    every = pr_curve(match.score, right, answerable, "all")
    reported = pr_curve(match.score, right, answerable, "reported")
    surest = pr_curve(by_confidence(match).score, right, answerable, "all")
    return Scores(
        area(every),
        area(reported),
        recall_at_precision(every),
        recall_at_precision(reported),
        int(right.sum()) / max(1, int((match.index >= 0).sum())),
        int(right.sum()) / max(1, int(answerable.sum())),
        average_precision(every),
        recall_at_precision(surest, 0.99),
    )


class Judgement(NamedTuple):
    """What `judge` finds.

    scores: of the first candidates.
    recalls: by K, the share of the queries with a right answer that have it among their first K candidates.
    right: (Q,) bool, whether the first candidate is right; False for a query that is not judged.
    judged: (Q,) bool, whether the truth judges the query.
    """

    scores: Scores
    recalls: dict[int, float]
    right: Tensor
    judged: Tensor


def judge(match: Match, truth: Truth, tolerance: int = 5, recalls: Sequence[int] = (1, 5, 10)) -> Judgement:
    """Which queries are right, the recall among their first candidates, and all scores of `evaluate`.

    Args:
        match, truth, tolerance: see `evaluate`.
        recalls: numbers K of candidates; those above the k of the match are left out.

    Example:
        >>> wave = torch.arange(64)[:, None] % torch.tensor([8.0, 9.0])
        >>> from dejavu_torch import DejaVu
        >>> candidates = DejaVu().learn(wave).candidates(wave[20:22], k=5)
        >>> found = judge(candidates, [20, 21], tolerance=0)
        >>> found.recalls, found.right.tolist()
        ({1: 1.0, 5: 1.0}, [True, True])
    """
    if min(recalls, default=1) < 1:
        raise InputError(f"recalls are {[*recalls]}; expected numbers of candidates, at least 1")
    scores = evaluate(match, truth, tolerance)
    known = _on_cpu(truth, len(match.index))
    index = match.index.cpu() if match.index.ndim == 2 else match.index.cpu()[:, None]
    judged, right = scored_and_right(index[:, 0], known, tolerance)
    found = {first: recall_at(index, known, tolerance, first) for first in recalls}
    return Judgement(scores, {k: share for k, share in found.items() if share is not None}, right, judged)


def recall_at(candidates: Tensor, truth: Truth, tolerance: int, first: int) -> float | None:
    """Share of the queries with a right answer that have it among their `first` candidates (Q,K).

    Example:
        >>> places, right = torch.tensor([[7, 0], [9, 4]]), torch.tensor([[0], [1]])
        >>> [recall_at(places, right, 0, first) for first in (1, 2, 3)]
        [0.0, 0.5, None]
    """
    truth = as_ground_truth(truth, len(candidates))
    kept = counted(candidates[:, 0], truth, tolerance)
    if candidates.shape[1] < first or not kept.any():
        return None
    positives = truth.positives[kept]
    right = torch.stack([is_right(place, positives, tolerance) for place in candidates[kept, :first].T])
    return int(right.any(0).sum()) / max(1, int((positives >= 0).any(1).sum()))


def recall_over_all(
    candidates: Tensor, truth: Truth, tolerance: int, firsts: Sequence[int]
) -> dict[str, float]:
    """Share of all judged queries that have a right answer among their first N candidates (Q,K), for each N.

    As in image retrieval, and unlike in `recall_at`, a query without a right answer is a miss.

    Raises:
        InputError: an N that is not from 1 to K.

    Example:
        >>> places, right = torch.tensor([[7, 0], [9, 4]]), torch.tensor([[0], [-1]])
        >>> recall_over_all(places, right, 0, [1, 2]), recall_at(places, right, 0, 2)
        ({'1': 0.0, '2': 0.5}, 1.0)
    """
    truth, ranks = as_ground_truth(truth, len(candidates)), candidates.shape[1]
    for first in firsts:
        if not 1 <= first <= ranks:
            more = f", or matches written with --top {first}" * (first > ranks)
            raise InputError(f"recall among the first {first} of {ranks} ranks; expected 1 to {ranks}{more}")
    right = torch.stack([is_right(place, truth.positives, tolerance) for place in candidates.T], 1)
    found = right[truth.judged].cumsum(1) > 0
    return {str(first): int(found[:, first - 1].sum()) / max(1, len(found)) for first in firsts}


def count_queries(match: Match, truth: Truth, tolerance: int) -> dict[str, int]:
    """The numbers of queries, by their keys in report.json.

    queries = judged + unknown (to the truth) + ignored (an ignored place is reported). Of the judged ones,
    with_answer have a right answer, accepted are accepted, and accepted_right are accepted at a right place.

    Raises:
        InputError: as `evaluate`.
    """
    kept, right, answerable = _judged(match, truth, tolerance)
    queries, judged = len(match.index), len(kept.index)
    unknown = int((~as_ground_truth(truth, queries).judged).sum())
    counts = {"queries": queries, "judged": judged, "unknown": unknown, "ignored": queries - judged - unknown}
    return counts | {
        "with_answer": int(answerable.sum()),
        "accepted": int(kept.accepted.sum()),
        "accepted_right": int((kept.accepted & right).sum()),
    }


def check_truth(match: Match, truth: Truth, tolerance: int) -> GroundTruth:
    """The truth as a GroundTruth; an InputError if it does not fit the matches."""
    if not isinstance(match, Match):
        seen = f"evaluate got a {type(match).__name__} and a {type(truth).__name__}"
        raise InputError(f"{seen}; expected a Match of `localize`, and places")
    if tolerance < 0:
        raise InputError(f"the tolerance is {tolerance}; expected at least 0")
    shape = tuple(match.index.shape)
    if len(shape) not in (1, 2) or shape[1:] == (0,):
        raise InputError(f"the match is {shape}; expected (Q,), or candidates (Q,k) with k of at least 1")
    return as_ground_truth(truth, len(match.index))


def _on_cpu(truth: Truth, queries: int) -> GroundTruth:
    return GroundTruth(*(part.cpu() for part in as_ground_truth(truth, queries)))


def _judged(match: Match, truth: Truth, tolerance: int) -> tuple[Match, Tensor, Tensor]:
    """First candidates of the queries that are scored, whether they are right, and can be, on the CPU."""
    known = _on_cpu(check_truth(match, truth, tolerance), len(match.index))
    match = match.map(lambda column: column.cpu() if column.ndim == 1 else column.cpu()[:, 0])
    kept, right = scored_and_right(match.index, known, tolerance)
    if not kept.any():
        seen = f"of {len(kept)} queries {int(known.judged.sum())} are in the truth and none can be judged"
        raise InputError(f"{seen}; expected one in the truth that does not report an ignored place")
    return match[kept], right[kept], (known.positives >= 0).any(1)[kept]
