"""Precision and recall against literal loops, and by hand."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Literal

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from processes import python
from torch import Tensor

from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.evaluation.curves import (
    Scores,
    area,
    count_queries,
    curve_of,
    evaluate,
    judge,
    pr_curve,
    recall_at,
    recall_at_precision,
    threshold_of_full_precision,
)
from dejavu_torch.types import Match

INF = float("inf")
Recall = Literal["all", "reported"]
BOTH = pytest.mark.parametrize("recall", ["all", "reported"])
# few values, so that scores tie
SCORE = st.sampled_from([-1.5, 0.0, 0.5, 1.0, 2.0, INF])
QUERIES = st.lists(st.tuples(SCORE, st.booleans(), st.booleans()), max_size=14)
PLACED = st.lists(
    st.tuples(SCORE, st.integers(0, 9), st.lists(st.integers(-1, 9), min_size=2, max_size=2)),
    min_size=1,
    max_size=14,
)


def columns(queries):
    score, right, answerable = zip(*queries, strict=True) if queries else ((), (), ())
    return (
        torch.tensor(score, dtype=torch.float64),
        torch.tensor(right, dtype=torch.bool),
        torch.tensor(answerable, dtype=torch.bool),
    )


def literal_curve(queries, recall):
    """(precision, recall, threshold), one query and one threshold at a time."""
    points = []
    for threshold in sorted({score for score, _, _ in queries if score < INF}):
        reports = [(right, answerable) for score, right, answerable in queries if score <= threshold]
        tp = sum(right and answerable for right, answerable in reports)
        answerables = sum(answerable for _, _, answerable in queries)
        silent = sum(answerable for score, _, answerable in queries if score > threshold)
        relevant = answerables if recall == "all" else tp + silent
        points.append((tp / len(reports), tp / relevant if tp else 0.0, threshold))
    return points


def literal_area(points):
    return sum((b[1] - a[1]) * (a[0] + b[0]) / 2 for a, b in pairwise(points))


def flat(points):
    return [number for point in points for number in point]


def points_of(curve):
    return list(zip(*(column.tolist() for column in curve), strict=True))


@BOTH
@given(queries=QUERIES)
def test_every_distinct_score_is_a_threshold(queries, recall):
    curve, expected = pr_curve(*columns(queries), recall), literal_curve(queries, recall)
    assert flat(points_of(curve)) == pytest.approx(flat(expected))
    assert area(curve) == pytest.approx(literal_area(expected))
    for precision in (1, 0.75):
        reached = [r for p, r, _ in expected if p >= precision]
        assert recall_at_precision(curve, precision) == max(reached, default=0.0)


@BOTH
@given(queries=QUERIES, order=st.randoms())
def test_the_order_of_queries_changes_nothing(queries, order, recall):
    mixed = list(queries)
    order.shuffle(mixed)  # type: ignore[attr-defined]
    assert points_of(pr_curve(*columns(mixed), recall)) == points_of(pr_curve(*columns(queries), recall))


@BOTH
@given(queries=QUERIES)
def test_only_the_order_of_scores_counts(queries, recall):
    score, right, answerable = columns(queries)
    before, after = (pr_curve(s, right, answerable, recall) for s in (score, score.exp()))
    assert torch.equal(before.precision, after.precision)
    assert torch.equal(before.recall, after.recall)


@given(queries=QUERIES)
def test_the_reported_recall_is_never_the_smaller(queries):
    every, reported = (pr_curve(*columns(queries), recall) for recall in ("all", "reported"))
    assert (reported.recall >= every.recall).all()
    assert (every.recall.diff() >= 0).all()
    assert (reported.recall.diff() >= 0).all()


def test_queries_with_equal_scores_report_together():
    curve = pr_curve(torch.ones(4), torch.tensor([True, False, True, True]), torch.ones(4, dtype=torch.bool))
    assert points_of(curve) == [(0.75, 0.75, 1.0)]


# matches and truth


def literal_average_precision(points):
    """Precision times the gain of recall at each point, relative to all the recall that is reached."""
    total, before = 0.0, 0.0
    for precision, recall, _ in points:
        total, before = total + precision * (recall - before), recall
    return total / before if before else 0.0


def match_of(index, score=None):
    scores = torch.arange(len(index)).float() if score is None else torch.tensor(score)
    places = torch.where(scores.isfinite(), torch.tensor(index), -1)
    return Match(places, scores, scores.isfinite())


@given(PLACED, st.integers(0, 3))
def test_judge_equals_literal_loops(rows, tolerance):
    match = match_of([index for _, index, _ in rows], [score for score, _, _ in rows])
    queries = []
    for score, index, truth in rows:
        places = [t for t in truth if t >= 0]
        queries.append((score, any(abs(index - t) <= tolerance for t in places), bool(places)))
    every, reported = literal_curve(queries, "all"), literal_curve(queries, "reported")
    right = sum(r for score, r, _ in queries if score < INF)
    expected = Scores(
        auc=literal_area(every),
        auc_reported=literal_area(reported),
        recall_at_100_precision=max((r for p, r, _ in every if p == 1), default=0.0),
        recall_at_100_precision_reported=max((r for p, r, _ in reported if p == 1), default=0.0),
        precision_at_100_recall=right / max(1, sum(score < INF for score, _, _ in queries)),
        recall_at_1=right / max(1, sum(a for _, _, a in queries)),
        average_precision=literal_average_precision(every),
        recall_at_99_precision=max((r for p, r, _ in every if p >= 0.99), default=0.0),
    )
    assert evaluate(match, torch.tensor([truth for _, _, truth in rows]), tolerance) == pytest.approx(
        expected
    )


@given(PLACED, st.integers(0, 3), st.data())
def test_recall_at_99_precision_is_in_the_order_of_confidence(rows, tolerance, data):
    scores = [score for score, _, _ in rows]
    sure = data.draw(st.lists(st.sampled_from([0.0, 1.0, 2.0, 3.0]), min_size=len(rows), max_size=len(rows)))
    places, truth = [index for _, index, _ in rows], torch.tensor([truth for _, _, truth in rows])
    match = replace(match_of(places, scores), confidence=torch.tensor(sure))
    by_score = [INF if score == INF else -one for one, score in zip(sure, scores, strict=True)]
    found = evaluate(match, truth, tolerance)
    expected = evaluate(match_of(places, by_score), truth, tolerance)
    assert found.recall_at_99_precision == expected.recall_at_99_precision
    assert found.auc == evaluate(match_of(places, scores), truth, tolerance).auc


def test_convention_5_tolerance_is_inclusive_in_every_score():
    match, truth = match_of([5, 6]), torch.zeros(2, 1, dtype=torch.int64)
    assert evaluate(match, truth, 4).recall_at_1 == 0.0
    assert evaluate(match, truth, 5).recall_at_1 == 0.5
    assert evaluate(match, truth, 6).recall_at_1 == 1.0
    assert evaluate(match, truth) == judge(match, truth).scores == evaluate(match, truth, 5)
    assert curve_of(match, truth, 5).precision.tolist() == [1.0, 0.5]


def test_convention_6_recall_is_of_all_answerable_queries_and_reported_forgives_wrong_reports():
    """Two right reports, one wrong one, one silent query, one query without an answer."""
    match = match_of([0, 1, 9, 0, 4], [1.0, 2.0, 3.0, INF, 4.0])
    truth = torch.tensor([[0], [1], [2], [3], [-1]])
    assert curve_of(match, truth, 0).recall[-1] == 2 / 4
    assert curve_of(match, truth, 0, "reported").recall[-1] == pytest.approx(2 / 3)
    scores = evaluate(match, truth, 0)
    assert scores.recall_at_1 == scores.recall_at_100_precision == 2 / 4
    assert scores.recall_at_100_precision_reported == 2 / 4  # at score 2 two answerable queries are silent
    assert scores.precision_at_100_recall == 2 / 4


def test_convention_6_the_paper_s_figures_fit_the_reported_recall():
    """Every query reports, 95 of 100 rightly: 95 % precision at 100 % recall."""
    match, truth = match_of([0] * 95 + [9] * 5), torch.zeros(100, 1, dtype=torch.int64)
    assert curve_of(match, truth, 5, "reported").recall[-1] == 1.0
    assert curve_of(match, truth, 5, "all").recall[-1] == pytest.approx(0.95)
    assert evaluate(match, truth, 5).precision_at_100_recall == pytest.approx(0.95)


def test_convention_7_curves_are_plain_tensors_without_torchmetrics():
    for column in curve_of(match_of([0, 1, 2]), torch.arange(3)[:, None], 0):
        assert type(column) is Tensor
        assert (column.dtype, column.ndim) == (torch.float64, 1)
    code = "import sys, dejavu_torch.evaluation.curves; sys.exit('torchmetrics' in sys.modules)"
    assert python(code).returncode == 0


def test_convention_7_thresholds_are_the_scores_themselves():
    """No sigmoid: distances that differ by little at a large value stay apart."""
    score = torch.tensor([1000.0, 1000.001, 1000.002], dtype=torch.float64)
    curve = pr_curve(score, torch.tensor([True, False, True]), torch.ones(3, dtype=torch.bool))
    assert torch.equal(curve.threshold, score)


# what is not judged

PLACE = st.integers(-1, 6)
ASKED = st.lists(
    st.tuples(
        SCORE, PLACE, st.lists(PLACE, min_size=2, max_size=2), st.booleans(), st.lists(PLACE, min_size=1)
    ),
    min_size=1,
    max_size=12,
)


@given(ASKED, st.integers(0, 2))
def test_queries_that_are_not_counted_are_as_if_never_asked(rows, tolerance):
    soft = [(row[4] * 12)[:3] for row in rows]
    match = match_of([row[1] for row in rows], [row[0] for row in rows])
    truth = GroundTruth(
        torch.tensor([row[2] for row in rows]), torch.tensor([row[3] for row in rows]), torch.tensor(soft)
    )
    kept = []
    for i, (place, (_, _, right, known, _)) in enumerate(zip(match.index.tolist(), rows, strict=True)):
        good = any(t >= 0 and abs(place - t) <= tolerance for t in right if place >= 0)
        if known and (good or place < 0 or place not in soft[i]):
            kept.append(i)
    if not kept:
        for judging in (evaluate, curve_of, count_queries):
            with refused(f"of {len(rows)} queries", "none can be judged", "expected"):
                judging(match, truth, tolerance)
        return
    rest, right = match[kept], truth.positives[kept]
    assert evaluate(match, truth, tolerance) == evaluate(rest, right, tolerance)
    for recall in ("all", "reported"):
        left, expected = curve_of(match, truth, tolerance, recall), curve_of(rest, right, tolerance, recall)
        assert points_of(left) == points_of(expected)
    counts, rest_counts = count_queries(match, truth, tolerance), count_queries(rest, right, tolerance)
    assert counts["queries"] == len(rows) == counts["judged"] + counts["unknown"] + counts["ignored"]
    assert counts["unknown"] == sum(not row[3] for row in rows)
    assert rest_counts["unknown"] == rest_counts["ignored"] == 0
    for name in ("judged", "with_answer", "accepted", "accepted_right"):
        assert counts[name] == rest_counts[name]


def test_a_soft_place_within_the_tolerance_of_a_right_one_is_right():
    truth = GroundTruth(torch.tensor([[10]]), torch.tensor([True]), torch.tensor([[12]]))
    assert evaluate(match_of([12]), truth, 2).recall_at_1 == 1.0
    with refused("none can be judged"):
        evaluate(match_of([12]), truth, 1)


def test_the_threshold_of_full_precision_accepts_what_is_right_and_no_more():
    score, every = torch.tensor([3.0, 1.0, 2.0, 4.0]), torch.ones(4, dtype=torch.bool)
    for right, count in (([1, 1, 1, 1], 4), ([0, 1, 1, 1], 2), ([0, 1, 0, 0], 1)):
        curve = pr_curve(score, torch.tensor(right, dtype=torch.bool), every)
        threshold = threshold_of_full_precision(curve)
        assert threshold is not None
        assert int((score < threshold).sum()) == count
    assert threshold_of_full_precision(pr_curve(score, ~every, every)) is None
    for scores, short in (([0.26, 0.28], 0.27), ([0.2611, 0.29], 0.28), ([-3.0, -2.0], -2.5)):
        curve = pr_curve(torch.tensor(scores).double(), torch.tensor([True, False]), torch.ones(2).bool())
        assert threshold_of_full_precision(curve) == short
    alone = pr_curve(torch.tensor([-3.0]), torch.tensor([True]), torch.tensor([True]))
    assert -3 < float(threshold_of_full_precision(alone) or 0) < -2.99


THREE, TWO = torch.zeros(3), torch.zeros(2, 1, dtype=torch.int64)


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: pr_curve(THREE, THREE[:2] < 1, THREE < 1), ["(3,), (2,), (3,)", "three of (Q,)"]),
        (lambda: pr_curve(THREE * torch.nan, THREE < 1, THREE < 1), ["a score is NaN"]),
        (lambda: evaluate(match_of([0, 1]), TWO[0], 5), ["the truth is (1, 1)", "(2, R)"]),
        (lambda: evaluate(match_of([0]), TWO, 5), ["the truth is (2, 1)", "(1, R)"]),
        (lambda: evaluate(match_of([0, 1]), TWO, -1), ["the tolerance is -1", "at least 0"]),
        (
            lambda: evaluate(match_of([0, 1]), GroundTruth(TWO, THREE > 0, TWO), 5),
            ["judged (3,)", "(2,) and (2, S)"],
        ),
    ],
)
def test_what_does_not_fit_is_refused(call, facts):
    with refused(*facts):
        call()


# candidates


def test_a_right_place_among_the_first_candidates():
    """By hand: right at rank 1, 2, 3, never; no answer; not known."""
    candidates = torch.tensor(
        [[10, 50, 90], [50, 12, 90], [50, 90, 8], [50, 90, -1], [10, 20, 30], [1, 2, 3]]
    )
    positives = torch.tensor([[10, -1], [10, -1], [70, 10], [10, -1], [-1, -1], [-1, -1]])
    judged = torch.tensor([True] * 5 + [False])
    truth = GroundTruth(positives, judged, torch.zeros(6, 0, dtype=torch.int64))
    assert [recall_at(candidates, truth, 2, first) for first in (1, 2, 3, 4)] == [1 / 4, 2 / 4, 3 / 4, None]
    assert recall_at(candidates, truth, 1, 3) == 1 / 4
    # an ignored place at rank 1 takes the query out of every score; behind it, it does not
    ignored = truth._replace(ignored=torch.tensor([[-1], [50], [90], [-1], [-1], [-1]]))
    assert [recall_at(candidates, ignored, 2, first) for first in (1, 2, 3)] == [1 / 3, 1 / 3, 2 / 3]
    nothing = truth._replace(judged=torch.zeros(6, dtype=torch.bool))
    assert recall_at(candidates, nothing, 2, 1) is None
