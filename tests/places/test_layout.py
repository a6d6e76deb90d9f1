"""Where places lie: a route is a layout of one column."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.places import layout as layouts
from dejavu_torch.places.layout import Layout, Rectangle

sides = st.integers(1, 12)


@pytest.fixture(autouse=True, scope="module")
def small_tiles():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(layouts, "SIDE", 4)
        yield


@given(places=st.integers(1, 60), radius=st.integers(0, 70), k=st.integers(1, 70), seed=st.integers(0, 99))
def test_a_route_is_one_column(places, radius, k, seed):
    draw = torch.Generator().manual_seed(seed)
    route, (one, other) = Layout(places), torch.randint(0, places, (2, 9), generator=draw)
    assert (route.dimensions, route.places, route.near(radius)) == (1, places, 2 * radius + 1)
    assert route.cells(one).tolist() == [[place, 0] for place in one.tolist()]
    assert torch.equal(route.place_at(route.cells(one)), one)
    assert torch.equal(route.distance(one, other), (one - other).abs())
    for place, near in zip(one.tolist(), route.around(one, radius).tolist(), strict=True):
        assert {*near} == {*range(max(0, place - radius), min(places, place + radius + 1))}
    assert route.strided(k)[0].tolist() == [*range(0, places, k)]
    assert [len(table) for table in Layout(0).strided(k)] == [0, 0]


@given(rows=sides, columns=sides, radius=st.integers(0, 14), k=st.integers(1, 14))
def test_near_is_the_same_for_all(rows, columns, radius, k):
    """Distance, surroundings, and what every k-th place is nearest to agree, also on a grown layout."""
    grown = Layout.of([Rectangle(rows, columns), Rectangle(2, 3, corner=(rows, -1))])
    for layout in (Layout(rows, columns), grown):
        every = torch.arange(layout.places)
        far = layout.distance(every[:, None], every)
        assert torch.equal(far, far.T)
        for place, near in zip(every.tolist(), layout.around(every, radius).tolist(), strict=True):
            assert {*near} == {*(far[place] <= radius).nonzero()[:, 0].tolist()}
            assert len({*near}) <= layout.near(radius)
    stored, nearest = Layout(rows, columns).strided(k)
    far = Layout(rows, columns).distance(torch.arange(rows * columns)[:, None], stored)
    last = far.amin(1) > k // 2  # beyond the last that is stored
    assert torch.equal(far.gather(1, nearest[:, None])[~last, 0], far.amin(1)[~last])


@given(rows=sides, columns=sides, one=st.integers(1, 4), other=st.integers(1, 4))
def test_a_stride_of_a_stride(rows, columns, one, other):
    whole = Layout(rows, columns)
    kept = Layout(-(-rows // one), -(-columns // one))
    cells = kept.cells(kept.strided(other)[0])
    assert torch.equal(whole.place_at(cells * one), whole.strided(one * other)[0])


@given(sizes=st.lists(st.tuples(sides, sides), min_size=2, max_size=3))
def test_places_that_are_not_of_one_ground_are_never_near(sizes):
    each = [Layout(*size) for size in sizes]
    joined, start = Layout.merged(each, [[str(route)] for route in range(len(each))]), 0
    assert joined.places == sum(one.places for one in each)
    for one in each:
        own = torch.arange(start, start + one.places)
        others = torch.cat([torch.arange(start), torch.arange(start + one.places, joined.places)])
        assert int(joined.distance(own[:, None], others).min()) >= layouts.FAR
        assert torch.equal(
            joined.distance(own[:, None], own), one.distance(own[:, None] - start, own - start)
        )
        start += one.places
