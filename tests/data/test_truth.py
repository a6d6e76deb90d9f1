"""The right places of each query."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.truth import find_truth, is_right, offset_truth, position_truth
from dejavu_torch.types import InputError, Traverse

POSITIONS = st.lists(st.integers(-20, 20), min_size=1, max_size=12)


def route(length: int, place: list[float] | None = None) -> Traverse:
    traverse = ArrayTraverse(torch.rand(length, 2))
    traverse.place = None if place is None else torch.tensor(place, dtype=torch.float64)
    return traverse


def column(truth: Tensor | None) -> list[int]:
    assert truth is not None
    assert (truth.ndim, truth.shape[1], truth.dtype) == (2, 1, torch.int64)
    return truth[:, 0].tolist()


@given(st.integers(1, 9), st.integers(1, 9), st.integers(-12, 12))
def test_offset(queries: int, places: int, offset: int) -> None:
    expected = [i + offset if 0 <= i + offset < places else -1 for i in range(queries)]
    assert column(offset_truth(queries, places, offset)) == expected


@given(POSITIONS, POSITIONS)
def test_position_is_the_nearest_reference_frame(reference: list[int], query: list[int]) -> None:
    found = column(position_truth(torch.tensor(reference).double(), torch.tensor(query).double()))
    ordered = sorted(reference)
    widest = max((b - a for a, b in pairwise(ordered)), default=0)
    for place, position in zip(found, query, strict=True):
        nearest = min(abs(position - r) for r in reference)
        if nearest > widest:
            assert place == -1
        else:
            assert abs(reference[place] - position) == nearest


def test_position_beyond_the_route_has_no_right_place() -> None:
    reference, query = torch.arange(5.0), torch.tensor([-3.0, -0.4, 2.4, 4.9, 9.0])
    assert column(position_truth(reference, query)) == [-1, 0, 2, 4, -1]


@pytest.mark.parametrize(
    ("truth", "reference", "query", "expected"),
    [
        ("0", route(3), route(3), [0, 1, 2]),
        ("-1", route(3), route(3), [-1, 0, 1]),
        ("+1", route(3), route(2), [1, 2]),
        (None, route(3), route(3), [0, 1, 2]),
        (None, route(3, [0, 1, 2]), route(2, [2, 1]), [2, 1]),
        (None, route(3, [0, 1, 2]), route(3), [0, 1, 2]),
        ("1", route(3, [0, 1, 2]), route(3, [2, 1, 0]), [1, 2, -1]),
    ],
)
def test_what_a_command_was_given_or_can_know(
    truth: str | None, reference: Traverse, query: Traverse, expected: list[int]
) -> None:
    assert column(find_truth(truth, reference, query, reference.length or 0, query.length or 0)) == expected


def test_without_a_truth_other_lengths_give_none() -> None:
    assert find_truth(None, route(3), route(4), 3, 4) is None


@pytest.mark.parametrize("truth", ["x", "", "1.5", "truth.csv"])
def test_text_that_is_no_truth_is_refused(truth: str) -> None:
    with pytest.raises(InputError, match=r"\Atruth '[^\n]*expected an integer offset[^\n]*\Z"):
        find_truth(truth, route(3), route(3), 3, 3)


def test_convention_5_tolerance_is_inclusive() -> None:
    index = torch.tensor([4, 5, 10, 15, 16])
    assert is_right(index, torch.full((5, 1), 10), 5).tolist() == [False, True, True, True, False]
    assert is_right(index, torch.full((5, 1), 10), 0).tolist() == [False, False, True, False, False]


ANSWERS = st.lists(
    st.tuples(st.integers(-1, 9), st.lists(st.integers(-1, 9), min_size=3, max_size=3)), min_size=1
)


@given(ANSWERS, st.integers(0, 4))
def test_any_right_place_will_do_and_minus_one_is_none(
    rows: list[tuple[int, list[int]]], tolerance: int
) -> None:
    expected = [i >= 0 and any(t >= 0 and abs(i - t) <= tolerance for t in truth) for i, truth in rows]
    index, truth = torch.tensor([i for i, _ in rows]), torch.tensor([t for _, t in rows])
    assert is_right(index, truth, tolerance).tolist() == expected
