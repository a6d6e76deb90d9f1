"""The right places of each query."""

from __future__ import annotations

from itertools import pairwise

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch.data.truth import (
    as_truth,
    counted,
    is_right,
    near_truth,
    offset_truth,
    padded,
    position_truth,
)
from dejavu_torch.types import GroundTruth

POSITIONS = st.lists(st.integers(-20, 20), min_size=1, max_size=12)


def column(truth: Tensor) -> list[int]:
    assert (truth.ndim, truth.shape[1], truth.dtype) == (2, 1, torch.int64)
    return truth[:, 0].tolist()


@given(st.integers(1, 9), st.integers(1, 9), st.integers(-12, 12))
def test_offset(queries: int, places: int, offset: int) -> None:
    expected = [i + offset if 0 <= i + offset < places else -1 for i in range(queries)]
    assert column(offset_truth(queries, places, offset)) == expected


@given(st.lists(st.integers(0, 30), min_size=1, max_size=9), st.integers(-40, 40))
def test_offset_of_numbered_queries_on_a_map_of_unknown_length(numbers: list[int], offset: int) -> None:
    expected = [i + offset if i + offset >= 0 else -1 for i in numbers]
    assert column(offset_truth(torch.tensor(numbers), None, offset)) == expected


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


@given(st.lists(st.lists(st.integers(0, 9), max_size=4), min_size=1, max_size=8))
def test_padded_holds_each_row_in_order(rows: list[list[int]]) -> None:
    row = torch.tensor([i for i, places in enumerate(rows) for _ in places], dtype=torch.int64)
    place = torch.tensor([p for places in rows for p in places], dtype=torch.int64)
    table = padded(row, place, len(rows))
    assert table.dtype == torch.int64
    assert table.shape == (len(rows), max(map(len, rows)))
    assert [[p for p in line if p >= 0] for line in table.tolist()] == rows
    # the padding stands behind the places
    assert [line[: len(places)] for line, places in zip(table.tolist(), rows, strict=True)] == rows


POINTS = st.lists(st.tuples(st.integers(-6, 6), st.integers(-6, 6)), min_size=1, max_size=12)


@given(POINTS, POINTS, st.integers(0, 6))
def test_near_is_every_frame_within_the_radius_inclusive(
    reference: list[tuple[int, int]], query: list[tuple[int, int]], radius: int
) -> None:
    # UTM coordinates are large: float32 would not hold their metres
    far = torch.tensor([500_000, 5_000_000], dtype=torch.float64)
    found = near_truth(torch.tensor(reference) + far, torch.tensor(query) + far, radius)
    expected = [
        [i for i, (a, b) in enumerate(reference) if (a - x) ** 2 + (b - y) ** 2 <= radius**2]
        for x, y in query
    ]
    assert [[place for place in row if place >= 0] for row in found.tolist()] == expected


def test_near_needs_no_table_of_all_pairs(largest_tensor: type) -> None:
    line = torch.stack([torch.arange(2500.0), torch.zeros(2500)], 1)
    with largest_tensor() as seen:
        found = near_truth(line, line, 0.0)
    assert found.flatten().tolist() == list(range(2500))
    assert seen.numel < 2500 * 2500 / 3


def test_a_tensor_of_places_is_a_truth_in_which_all_is_known() -> None:
    right = torch.tensor([[0, 1], [-1, -1]])
    truth = as_truth(right)
    assert torch.equal(truth.positives, right)
    assert truth.judged.tolist() == [True, True]
    assert truth.ignored.shape == (2, 0)
    assert as_truth(truth) is truth


def test_a_soft_place_counts_neither_way_and_an_unknown_query_never() -> None:
    """Right, wrong, soft, silent, soft but right by the tolerance, not known, not known though right."""
    index = torch.tensor([10, 30, 20, -1, 11, 30, 10])
    known = torch.tensor([True] * 5 + [False] * 2)
    truth = GroundTruth(torch.full((7, 1), 10), known, torch.tensor([[20, 11]] * 7))
    assert counted(index, truth, 1).tolist() == [True, True, False, True, True, False, False]
    assert counted(index, truth, 0).tolist() == [True, True, False, True, False, False, False]
