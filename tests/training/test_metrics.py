"""The metric is `evaluate` over everything it saw, in whatever batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.evaluation.curves import Scores, evaluate
from dejavu_torch.training.metrics import PlaceRecognition
from dejavu_torch.types import Match

INF = float("inf")
# score, reported place, right places, judged, ignored places; few values, so that scores tie
QUERY = st.tuples(
    st.sampled_from([-1.5, 0.0, 0.5, 1.0, INF]),
    st.integers(-1, 6),
    st.lists(st.integers(-1, 6), max_size=3),
    st.booleans(),
    st.lists(st.integers(0, 6), max_size=2),
)
BATCHES = st.lists(st.lists(QUERY, max_size=6), min_size=1, max_size=5)


def table(rows: Sequence[list[int]]) -> Tensor:
    """As wide as the widest row: batches differ."""
    width = max((len(row) for row in rows), default=0)
    padded = [row + [-1] * (width - len(row)) for row in rows]
    return torch.tensor(padded, dtype=torch.int64).reshape(len(rows), width)


def batch_of(queries: list[Any]) -> tuple[Match, GroundTruth]:
    score, index, right, judged, ignored = zip(*queries, strict=True) if queries else ((),) * 5
    scores = torch.tensor(score, dtype=torch.float32)
    match = Match(torch.tensor(index, dtype=torch.int64), scores, scores < 1)
    return match, GroundTruth(table(right), torch.tensor(judged, dtype=torch.bool), table(ignored))


def same(figures: dict[str, Tensor], scores: Scores) -> bool:
    return {name: value.item() for name, value in figures.items()} == scores._asdict()


def some(queries: int = 40, rights: int = 2) -> tuple[Match, Tensor]:
    index = torch.randint(-1, 9, (queries,))
    score = torch.where(index < 0, INF, torch.rand(queries))
    return Match(index, score, score < 0.5), torch.randint(-1, 9, (queries, rights))


def fed(*batches: tuple[Match, Tensor], **arguments: Any) -> PlaceRecognition:
    metric = PlaceRecognition(tolerance=1, **arguments)
    for match, truth in batches:
        metric.update(match, truth)
    return metric


@given(BATCHES, st.integers(0, 2))
def test_it_is_evaluate_on_all_data_whatever_the_batches(batches: list[Any], tolerance: int) -> None:
    metric = PlaceRecognition(tolerance)
    for queries in batches:
        metric.update(*batch_of(queries))
    match, truth = batch_of([query for queries in batches for query in queries])
    near = (match.index[:, None] - truth.positives).abs() <= tolerance
    right = (near & (truth.positives >= 0) & (match.index >= 0)[:, None]).any(1)
    ignored = ((match.index[:, None] == truth.ignored) & (truth.ignored >= 0)).any(1)
    figures = metric.compute()
    assert isinstance(figures, dict)
    if (truth.judged & (right | ~ignored)).any():
        assert same(figures, evaluate(match, truth, tolerance))
    else:
        assert set(figures) == set(Scores._fields)
        assert all(value.isnan() for value in figures.values())


def test_close_scores_in_double_precision_stay_apart() -> None:
    index, score = torch.tensor([0, 1]), torch.tensor([1.0, 1.0 + 1e-12], dtype=torch.float64)
    match = Match(index, score, score.isfinite())
    truth = torch.tensor([[0], [5]])
    metric = PlaceRecognition(tolerance=0)
    metric.update(match, truth)
    assert same(metric.compute(), evaluate(match, truth, 0))
    assert metric.compute()["recall_at_100_precision"] == 0.5


def fed_scores(*batches: tuple[Match, Tensor]) -> Scores:
    """`evaluate` of the batches joined by hand."""
    matches, truths = zip(*batches, strict=True)
    width = max(truth.shape[1] for truth in truths)
    rows = [torch.nn.functional.pad(truth, (0, width - truth.shape[1]), value=-1) for truth in truths]
    joined = Match(*(torch.cat(column) for column in zip(*matches, strict=True)))
    return evaluate(joined, torch.cat(rows), tolerance=1)


@pytest.mark.parametrize("elsewhere", [(), (some(30, 3),), (some(30, 3), some(5, 1))], ids=len)
def test_processes_are_joined(elsewhere: tuple[tuple[Match, Tensor], ...]) -> None:
    """As torchmetrics syncs: a tensor a state from each process, in the order of the states."""
    here, other = (some(), some(rights=1)), fed(*elsewhere)
    states = [torch.cat(state) if state else torch.zeros(0) for state in other.metric_state.values()]
    theirs = iter(states)

    def concatenate(mine: Tensor, group: object) -> list[Tensor]:
        assert mine.ndim == 1  # processes exchange only tensors of the same type and number of dimensions
        assert mine.dtype == torch.float64
        return [mine, next(theirs).to(mine.dtype)]

    metric = fed(*here, dist_sync_fn=concatenate, distributed_available_fn=lambda: True)
    assert same(metric.compute(), fed_scores(*here, *elsewhere))
    assert same(fed(*here).compute(), fed_scores(*here))


def test_a_process_that_saw_nothing_sends_what_the_others_send() -> None:
    sent = []

    def concatenate(mine: Tensor, group: object) -> list[Tensor]:
        sent.append((mine.ndim, mine.dtype))
        return [mine, torch.zeros(1, dtype=torch.float64)]

    fed(dist_sync_fn=concatenate, distributed_available_fn=lambda: True).compute()
    assert sent == [(1, torch.float64)] * 3


MATCH, TRUTH = some(queries=3)


@pytest.mark.parametrize(
    ("match", "truth", "words"),
    [
        (MATCH._replace(index=MATCH.index[:, None]), TRUTH, ("(3, 1) torch.int64", "expected (Q,) int64")),
        (MATCH._replace(score=MATCH.score[:2]), TRUTH, ("(3,) torch.int64 and (2,)",)),
        (MATCH._replace(score=MATCH.score * float("nan")), TRUTH, ("a score is NaN",)),
        (MATCH, TRUTH[:2], ("the truth is (2, 2)", "(3, R)")),
    ],
)
def test_what_does_not_fit_is_refused(match: Match, truth: Tensor, words: tuple[str, ...]) -> None:
    metric = PlaceRecognition(tolerance=1)
    with refused(*words):
        metric.update(match, truth)
    assert not metric.score  # nothing of a refused batch is kept
