"""Precision and recall, exactly: every distinct score is a threshold (section IV-C)."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.truth import is_right
from dejavu_torch.types import InputError, Match, PRCurve

RECALL_DEFINITION = (
    "TP / all queries with a right answer; *_reported: TP / (TP + FN), a wrong report is no FN"
)


class Scores(NamedTuple):
    """How well matches agree with the truth; the fields are keys of report.json.

    recall = TP / all queries with a right answer; in the *_reported fields TP / (TP + FN), where
    only a query that reports nothing is a false negative.
    """

    auc: float
    auc_reported: float
    recall_at_100_precision: float
    recall_at_100_precision_reported: float
    precision_at_100_recall: float
    recall_at_1: float


def pr_curve(
    score: Tensor, right: Tensor, answerable: Tensor, recall: Literal["all", "reported"] = "all"
) -> PRCurve:
    """Precision and recall when the queries up to each distinct score report (section IV-C).

    Args:
        score: best score of each query, lower is better; +inf reports nothing.
        right: whether the reported place is right.
        answerable: whether the query has a right answer at all.
        recall: "all" is TP / all answerable queries; "reported" is TP / (TP + FN), where a query that
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
    accepted = torch.arange(1, len(ordered) + 1, dtype=torch.float64)[last]
    total = answerable.sum().double()
    # every answerable query that has not reported yet is a false negative
    relevant = total if recall == "all" else tp + (total - answered[last])
    fraction = torch.where(tp > 0, tp / torch.as_tensor(relevant).clamp(min=1), 0.0)
    return PRCurve(tp / accepted, fraction, ordered[last])


def area(curve: PRCurve) -> float:
    """Area under the curve: trapezoid over its own points, no starting point added."""
    return float(torch.trapezoid(curve.precision, curve.recall)) if len(curve.recall) else 0.0


def recall_at_full_precision(curve: PRCurve) -> float:
    """Largest recall at which every report is right."""
    perfect = curve.recall[curve.precision == 1]
    return float(perfect.max()) if len(perfect) else 0.0


def curve_of(
    match: Match, truth: Tensor, tolerance: int, recall: Literal["all", "reported"] = "all"
) -> PRCurve:
    """`pr_curve` of matches against a truth (Q,R)."""
    check_truth(match, truth, tolerance)
    return pr_curve(match.score, is_right(match.index, truth, tolerance), (truth >= 0).any(1), recall)


def judge(match: Match, truth: Tensor, tolerance: int) -> Scores:
    """All scores of matches against a truth.

    Args:
        truth: (Q,R) int64, every right place of each query, -1 as padding.
        tolerance: frames, inclusive.

    Raises:
        InputError: a truth of another length than the matches, or a negative tolerance.
    """
    every = curve_of(match, truth, tolerance, "all")
    reported = curve_of(match, truth, tolerance, "reported")
    right = is_right(match.index, truth, tolerance).sum().item()
    return Scores(
        area(every),
        area(reported),
        recall_at_full_precision(every),
        recall_at_full_precision(reported),
        right / max(1, int((match.index >= 0).sum())),
        right / max(1, int((truth >= 0).any(1).sum())),
    )


def check_truth(match: Match, truth: Tensor, tolerance: int) -> None:
    """Refuse a truth that does not fit the matches."""
    if truth.ndim != 2 or len(truth) != len(match.index):
        raise InputError(
            f"the truth is {tuple(truth.shape)}; expected ({len(match.index)}, R), a row a query"
        )
    if tolerance < 0:
        raise InputError(f"the tolerance is {tolerance}; expected at least 0")
