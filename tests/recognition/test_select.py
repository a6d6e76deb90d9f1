"""The best place (eq. 5) and whether to believe it (eq. 6)."""

from __future__ import annotations

import math

import pytest
import reference
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import InputError, best_match

INF = math.inf
SCORE = st.one_of(st.integers(0, 3).map(float), st.just(INF))  # few values: many ties


@given(
    st.integers(1, 8).flatmap(lambda n: st.lists(st.lists(SCORE, min_size=n, max_size=n), min_size=1)),
    st.sampled_from([0.0, 1.0, 1.5, INF]),
)
def test_equals_reference(rows: list[list[float]], threshold: float) -> None:
    index, score, accepted = best_match(torch.tensor(rows), threshold)
    assert index.tolist() == [reference.best(row) for row in rows]
    assert score.tolist() == [min(row) for row in rows]
    assert accepted.tolist() == [reference.accepted(row, threshold) for row in rows]


@pytest.mark.parametrize("places", [1, 2, 15, 16, 17, 1000, 4099])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_convention_2_ties_go_to_the_lowest_place(places: int, dtype: torch.dtype) -> None:
    scores = torch.ones(8, places, dtype=dtype)
    first = torch.randint(places, (8,))
    for row, start in zip(scores, first.tolist(), strict=True):
        row[start:] = 0.5
    assert best_match(scores).index.tolist() == first.tolist()
    assert best_match(torch.ones(3, places, dtype=dtype)).index.tolist() == [0, 0, 0]


@pytest.mark.parametrize("threshold", [None, 1.0, INF])
def test_convention_2_a_query_that_nothing_covers_reports_nothing(threshold: float | None) -> None:
    match = best_match(torch.tensor([[INF, INF, INF], [INF, 0.5, INF]]), threshold)
    assert match.index.tolist() == [-1, 1]
    assert match.score.tolist() == [INF, 0.5]
    assert match.accepted.tolist() == [False, True]


def test_convention_4_accept_when_the_score_is_below_the_threshold() -> None:
    match = best_match(torch.tensor([[0.9], [1.0], [1.1]]), threshold=1.0)
    assert match.accepted.tolist() == [True, False, False]
    assert match.index.tolist() == [0, 0, 0]  # the place is reported either way


def test_convention_4_without_a_threshold_every_finite_score_is_accepted() -> None:
    match = best_match(torch.tensor([[3.0], [1e30], [INF]]))
    assert match.accepted.tolist() == [True, True, False]


@pytest.mark.parametrize("threshold", [None, 5.0])
def test_nan_reports_nothing(threshold: float | None) -> None:
    match = best_match(torch.tensor([[1.0, torch.nan]]), threshold)
    assert match.index.tolist() == [-1]
    assert match.accepted.tolist() == [False]


def test_the_score_carries_gradients() -> None:
    scores = torch.tensor([[3.0, 1.0, 2.0]], requires_grad=True)
    best_match(scores).score.sum().backward()
    assert scores.grad is not None
    assert scores.grad.tolist() == [[0, 1, 0]]


@pytest.mark.parametrize("shape", [(3,), (3, 0), (1, 2, 3)])
def test_scores_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"scores are .*; expected \(Q,N\) with N >= 1"):
        best_match(torch.rand(shape))
