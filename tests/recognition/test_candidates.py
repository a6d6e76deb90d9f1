"""The best places of a query, no two of them near each other."""

from __future__ import annotations

import math

import reference
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import best_match
from dejavu_torch.recognition.select import best_candidates, check_candidates

INF = math.inf
SCORE = st.one_of(st.integers(-3, 3).map(float), st.just(INF))  # few values: many ties
ROWS = st.integers(1, 12).flatmap(lambda n: st.lists(st.lists(SCORE, min_size=n, max_size=n), min_size=1))


@given(ROWS, st.integers(1, 12), st.integers(0, 13))
def test_equals_reference(rows: list[list[float]], k: int, apart: int) -> None:
    k = min(k, len(rows[0]))
    index, score, accepted = best_candidates(torch.tensor(rows), k, apart)
    assert torch.equal(accepted, score.isfinite())
    assert index.tolist() == [reference.candidates(row, k, apart) for row in rows]
    at = [
        [row[i] if i >= 0 else INF for i in places] for row, places in zip(rows, index.tolist(), strict=True)
    ]
    assert score.tolist() == at


def test_a_query_of_nan_has_no_candidates() -> None:
    candidates = best_candidates(torch.tensor([[1.0, torch.nan, 2.0, 3.0]]), 2, 0)
    assert candidates.index.tolist() == [[-1, -1]]


def test_the_scores_carry_gradients_and_are_left_as_they_are() -> None:
    scores = torch.tensor([[3.0, 1.0, 2.0, 4.0]], dtype=torch.float64, requires_grad=True)
    best_candidates(scores, 2, 1).score.sum().backward()
    assert scores.tolist() == [[3, 1, 2, 4]]
    assert scores.grad is not None
    assert scores.grad.tolist() == [[0, 1, 0, 1]]


def test_what_cannot_be_is_refused() -> None:
    scores = torch.rand(2, 4)
    for arguments, words in (
        ((scores, 0, 5), ["0 candidates", "at least 1"]),
        ((scores, 5, 5), ["5 candidates", "on 4 places", "at most 4"]),
        ((scores, 2, -1), ["more than -1 places apart", "at least 0"]),
        ((scores[0], 2, 5), ["(4,)", "(Q,N)"]),
    ):
        with refused(*words):
            best_candidates(*arguments)
    check_candidates(10**6, 0)  # of an unknown number of places


@given(ROWS, st.integers(0, 3))
def test_the_first_is_the_best_match(rows: list[list[float]], apart: int) -> None:
    scores = torch.tensor(rows)
    match = best_match(scores, threshold=1.0)
    first = best_candidates(scores, 1, apart).map(lambda column: column[:, 0])
    for one, other in zip(first[:2], match[:2], strict=True):
        assert torch.equal(one, other)
