"""The best place (eq. 5), whether to believe it (eq. 6), and the best ones away from each other."""

from __future__ import annotations

import math

import pytest
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


@given(ROWS, st.sampled_from([0.0, 1.0, 1.5, INF]))
def test_equals_reference(rows, threshold):
    index, score, accepted = best_match(torch.tensor(rows), threshold)
    assert index.tolist() == [reference.best(row) for row in rows]
    assert score.tolist() == [min(row) for row in rows]
    assert accepted.tolist() == [reference.accepted(row, threshold) for row in rows]


@given(ROWS, st.integers(1, 12), st.integers(0, 13))
def test_candidates_equal_reference(rows, k, apart):
    k = min(k, len(rows[0]))
    index, score, accepted = best_candidates(torch.tensor(rows), k, apart)
    assert torch.equal(accepted, score.isfinite())
    assert index.tolist() == [reference.candidates(row, k, apart) for row in rows]
    at = [
        [row[i] if i >= 0 else INF for i in places] for row, places in zip(rows, index.tolist(), strict=True)
    ]
    assert score.tolist() == at


@pytest.mark.parametrize("places", [1, 2, 15, 16, 17, 1000, 4099])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_convention_2_ties_go_to_the_lowest_place(places, dtype):
    scores = torch.ones(8, places, dtype=dtype)
    first = torch.randint(places, (8,))
    for row, start in zip(scores, first.tolist(), strict=True):
        row[start:] = 0.5
    assert best_match(scores).index.tolist() == first.tolist()
    assert best_match(torch.ones(3, places, dtype=dtype)).index.tolist() == [0, 0, 0]


@pytest.mark.parametrize("threshold", [None, 1.0, INF])
def test_convention_2_a_query_that_nothing_covers_reports_nothing(threshold):
    match = best_match(torch.tensor([[INF, INF, INF], [INF, 0.5, INF], [1.0, torch.nan, 0.1]]), threshold)
    assert match.index.tolist() == [-1, 1, -1]
    assert match.score[:2].tolist() == [INF, 0.5]
    assert match.accepted.tolist() == [False, True, False]
    assert best_candidates(torch.tensor([[1.0, torch.nan, 2.0, 3.0]]), 2, 0).index.tolist() == [[-1, -1]]


def test_convention_4_accept_when_the_score_is_below_the_threshold():
    match = best_match(torch.tensor([[0.9], [1.0], [1.1]]), threshold=1.0)
    assert match.accepted.tolist() == [True, False, False]
    assert match.index.tolist() == [0, 0, 0]  # the place is reported either way


def test_convention_4_without_a_threshold_every_finite_score_is_accepted():
    match = best_match(torch.tensor([[3.0], [1e30], [INF]]))
    assert match.accepted.tolist() == [True, True, False]


def test_the_scores_carry_gradients_and_are_left_as_they_are():
    scores = torch.tensor([[3.0, 1.0, 2.0, 4.0]], dtype=torch.float64, requires_grad=True)
    (best_match(scores).score.sum() + best_candidates(scores, 2, 1).score.sum()).backward()
    assert scores.tolist() == [[3, 1, 2, 4]]
    assert scores.grad is not None
    assert scores.grad.tolist() == [[0, 2, 0, 1]]


def test_what_cannot_be_is_refused():
    scores = torch.rand(2, 4)
    for arguments, words in (
        ((scores, 0, 5), ["0 candidates", "at least 1"]),
        ((scores, 5, 5), ["5 candidates", "on 4 places", "at most 4"]),
        ((scores, 2, -1), ["radius is -1 places", "at least 0"]),
        ((scores[0], 2, 5), ["(4,)", "(Q, N>=1)"]),
        ((scores[:, :0], 1, 5), ["(2, 0)", "(Q, N>=1)"]),
        ((scores[None], 1, 5), ["(1, 2, 4)", "(Q, N>=1)"]),
    ):
        with refused(*words):
            best_candidates(*arguments)
    check_candidates(10**6, 0)  # of an unknown number of places
