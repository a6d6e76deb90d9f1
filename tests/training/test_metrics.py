"""The metric is `evaluate` over everything it saw, in whatever batches."""

from __future__ import annotations

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.evaluation.curves import Scores, evaluate
from dejavu_torch.training.metrics import PlaceRecognition
from dejavu_torch.types import Match

INF = float("inf")
# score, reported place, right places, judged, ignored places; few values, so that scores tie
QUERY = st.tuples(
    st.sampled_from([-1.5, 0.0, 0.5, 1.0, 1.0 + 1e-12, INF]),
    st.integers(-1, 6),
    st.lists(st.integers(-1, 6), max_size=3),
    st.booleans(),
    st.lists(st.integers(0, 6), max_size=2),
)
BATCHES = st.lists(st.lists(QUERY, max_size=6), min_size=1, max_size=5)


def table(rows):
    """As wide as the widest row: batches differ."""
    width = max((len(row) for row in rows), default=0)
    padded = [row + [-1] * (width - len(row)) for row in rows]
    return torch.tensor(padded, dtype=torch.int64).reshape(len(rows), width)


def batch_of(queries):
    score, index, right, judged, ignored = zip(*queries, strict=True) if queries else ((),) * 5
    scores = torch.tensor(score, dtype=torch.float64)
    match = Match(torch.tensor(index, dtype=torch.int64), scores, scores < 1)
    return match, GroundTruth(table(right), torch.tensor(judged, dtype=torch.bool), table(ignored))


def assert_evaluated(metric, batches):
    """The figures are those of `evaluate` on all batches, NaN if no query counts."""
    match, truth = batch_of([query for queries in batches for query in queries])
    near = (match.index[:, None] - truth.positives).abs() <= metric.tolerance
    right = (near & (truth.positives >= 0) & (match.index >= 0)[:, None]).any(1)
    ignored = ((match.index[:, None] == truth.ignored) & (truth.ignored >= 0)).any(1)
    figures = {name: value.item() for name, value in metric.compute().items()}
    if (truth.judged & (right | ~ignored)).any():
        assert figures == evaluate(match, truth, metric.tolerance)._asdict()
    else:
        assert figures == pytest.approx(dict.fromkeys(Scores._fields, float("nan")), nan_ok=True)


@given(BATCHES, st.integers(0, 2))
def test_it_is_evaluate_on_all_data_whatever_the_batches(batches, tolerance):
    metric = PlaceRecognition(tolerance)
    for queries in batches:
        metric.update(*batch_of(queries))
    assert_evaluated(metric, batches)


@given(BATCHES, st.one_of(BATCHES, st.just([])))
def test_processes_are_joined(here, elsewhere):
    """As torchmetrics syncs: one tensor from each process, of the same type and number of dimensions."""
    other = PlaceRecognition(1)
    for queries in elsewhere:
        other.update(*batch_of(queries))

    def gather(mine, group):
        theirs = torch.cat(other.rows) if other.rows else torch.zeros(0, dtype=torch.float64)
        assert (mine.ndim, mine.dtype) == (theirs.ndim, theirs.dtype) == (1, torch.float64)
        return [mine, theirs]

    metric = PlaceRecognition(1, dist_sync_fn=gather, distributed_available_fn=lambda: True)
    for queries in here:
        metric.update(*batch_of(queries))
    assert_evaluated(metric, [*here, *elsewhere])


MATCH = Match(torch.tensor([0, 1, -1]), torch.tensor([0.1, 0.2, INF]), torch.tensor([True, True, False]))
NAN = Match(MATCH.index, MATCH.score * float("nan"), MATCH.accepted)


@pytest.mark.parametrize(
    ("match", "truth", "facts"),
    [
        (NAN, torch.zeros(3, 2).long(), ["a score is NaN"]),
        (MATCH, torch.zeros(2, 2).long(), ["the truth is (2, 2)", "(3, R)"]),
    ],
    ids=["NaN", "truth"],
)
def test_what_does_not_fit_is_refused(match, truth, facts):
    metric = PlaceRecognition(tolerance=1)
    with refused(*facts):
        metric.update(match, truth)
    assert not metric.rows  # nothing of a refused batch is kept
