"""Where places lie: a route is a layout of one column."""

from __future__ import annotations

import json
from itertools import pairwise

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import PlaceFilter
from dejavu_torch.places import rectangles
from dejavu_torch.places.layout import FAR, Layout
from dejavu_torch.places.rectangles import Rectangle

sides = st.integers(1, 12)


@pytest.fixture(autouse=True, scope="module")
def small_tiles():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rectangles, "SIDE", 4)
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


@st.composite
def layouts_of_all_kinds(draw):
    """Routes, areas, and several of them that have grown in any order."""
    columns = st.just(1) if draw(st.booleans()) else sides
    unit = draw(st.sampled_from(["px", "m"])) if columns is sides else ""
    parts, down = [], {"right": (2.0, 0.0), "down": (0.0, 3.0)} if unit else {}
    for _ in range(draw(st.integers(1, 3))):
        parts.append(Layout(draw(sides), draw(columns), **down, unit=unit))
    layout = parts[0] if len(parts) == 1 else Layout.merged(parts, [[str(i)] for i in range(len(parts))])
    for route in draw(st.lists(st.integers(0, len(parts) - 1), max_size=3)):
        own = [one for one in layout.rectangles if one.route == route]
        below = max(one.corner[0] + one.rows for one in own) * 3.0
        more = Layout(draw(sides), own[0].columns, (0.0, below), **down, unit=unit)
        layout = layout.grown(more, "more", route=route)
    return layout


@given(layout=layouts_of_all_kinds(), radius=st.integers(0, 40), k=st.integers(1, 9))
def test_places_of_one_route_are_near_by_rows_and_columns_and_no_others(layout, radius, k):
    every = torch.arange(layout.places)
    route, far = layout.route_of(every), layout.distance(every[:, None], every)
    alike = route[:, None] == route
    assert bool((far[~alike] >= FAR).all())
    cells = layout.cells(every)
    assert torch.equal(far[alike], (cells[:, None] - cells).abs().amax(2)[alike])
    assert torch.equal(layout.place_at(cells), every)
    for place, near in zip(every, layout.around(every, radius).tolist(), strict=True):
        assert {*near} == {*(far[place] <= radius).nonzero()[:, 0].tolist()}
    mass = torch.rand(3, layout.places, dtype=torch.float64, generator=torch.Generator().manual_seed(radius))
    mass /= mass.sum(1, keepdim=True)
    at = every[torch.arange(3) * len(every) // 3]
    torch.testing.assert_close(layout.mass_near(mass, at, radius), (mass * (far[at] <= radius)).sum(1))
    shortest = min(layout.places_of(r) for r in range(layout.count))
    even = 2 * (min(radius, shortest, rectangles.GAP) // 2)  # a triangle, or pyramid
    away = (cells[:, None] - cells).abs() / (even + 1)
    weight = ((1 - away).clamp(min=0).prod(2) * alike).double()
    torch.testing.assert_close(layout.blurred(mass, even), mass @ weight)
    # places of each route by itself are as far from each other as before
    for r in range(layout.count):
        own, alone = layout.places_in(r), layout.only(r)
        inside = torch.arange(alone.places)
        assert torch.equal(alone.distance(inside[:, None], inside), far[own][:, own])
        torch.testing.assert_close(alone.coordinates(inside), layout.coordinates(own), equal_nan=True)
    stored, nearest = layout.strided(k)
    assert torch.equal(route[stored][nearest], route)
    assert int(far[every, stored[nearest]].max()) < k
    assert (
        Layout.restored(json.loads(json.dumps(layout.stored())), layout.places).reaching(len(every)) == layout
    )


@given(layout=layouts_of_all_kinds(), start=st.integers(0, 30), length=st.integers(1, 30))
def test_numbers_never_change_and_a_camera_goes_on_from_part_to_part(layout, start, length):
    if layout.dimensions == 2:
        assert layout.joins == ()
        return
    states, every = layout.states(2, [(0, 0, 0.5)]), torch.arange(layout.places)
    assert (states.places, states.directions, states.links[0]) == (layout.places, 2, (0, 0, 0.5))
    follows = {(int(a), int(b)) for r in range(layout.count) for a, b in pairwise(layout.places_in(r))}
    plain = {(a, a + 1) for a in every[:-1].tolist() if a + 1 not in states.route_starts}
    assert follows == plain | {(a, b) for a, b, share in layout.joins if share == 1.0}
    grown = layout.grown(Layout(5), "more", route=layout.count - 1)
    before = layout.distance(every[:, None], every)
    assert torch.equal(grown.distance(every[:, None], every), before)
    stop = min(layout.places, start + length)
    if start < stop:  # some chunks of a map, as a worker holds them
        part, some = layout.cut(start, stop), every[: stop - start]
        same = layout.route_of(some + start)
        named = [layout.names("")[r] for r in same.tolist()]
        assert [part.names("")[r] for r in part.route_of(some).tolist()] == named


@given(layout=layouts_of_all_kinds(), distance=st.floats(0.5, 30), seed=st.integers(0, 99))
def test_places_within_a_distance_are_those_by_their_coordinates(layout, distance, seed):
    draw = torch.Generator().manual_seed(seed)
    points = 60 * torch.rand(5, 2, dtype=torch.float64, generator=draw) - 10
    points[0] = torch.nan
    found = layout.within(points, distance)
    away = (layout.coordinates(torch.arange(layout.places)) - points[:, None]).norm(dim=2)
    for near, row in zip(found.tolist(), away, strict=True):
        assert {*near} - {-1} == {*(row <= distance).nonzero()[:, 0].tolist()}


@given(sizes=st.lists(st.tuples(sides, sides), min_size=2, max_size=3))
def test_places_that_are_not_of_one_ground_are_never_near(sizes):
    each = [Layout(*size) for size in sizes]
    joined, start = Layout.merged(each, [[str(route)] for route in range(len(each))]), 0
    assert joined.places == sum(one.places for one in each)
    for one in each:
        own = torch.arange(start, start + one.places)
        others = torch.cat([torch.arange(start), torch.arange(start + one.places, joined.places)])
        assert int(joined.distance(own[:, None], others).min()) >= FAR
        assert torch.equal(
            joined.distance(own[:, None], own), one.distance(own[:, None] - start, own - start)
        )
        start += one.places


def test_words_of_users_are_no_formats_and_what_does_not_fit_is_told():
    two = Layout.merged([Layout(3), Layout(4)], [["a"], ["b"]])
    Layout(3).expect_one("one", "map {0}")
    with refused("map {0} has the routes a, b", "expected one"):
        two.expect_one("one", "map {0}")
    with refused("no route 'c'", "one of a, b"):
        two.number("c")
    with refused("no route 'c'", "none"):
        Layout(3).number("c")
    with refused("layout 'Foo'", "Layout"):
        Layout.restored({"layout": "Foo"}, 3)
    with refused("1099511627776 windows"):
        stored = Layout(3, 4).stored()
        Layout.restored({"area": stored["area"] | {"rows": 2**38}}, 12)
    column = Layout(22, 1, unit="px", frame="pixels")
    assert not Layout(22).same(column)
    assert not column.same(Layout(22))
    assert column.same(column)
    assert Layout(22).same(Layout(5))


@pytest.mark.parametrize("parts", [(0,), (0, 1), (0, 1, 0)])
def test_a_filter_compiles_on_routes_of_all_kinds(parts):
    rectangles = [Rectangle(20, corner=(20 * i, 0), route=route) for i, route in enumerate(parts)]
    layout = Layout.of(rectangles, routes=["a", "b"][: len({*parts})])
    moved, scores = PlaceFilter().over(layout), torch.rand(3, layout.places)
    step = torch.compile(
        lambda rows: moved.step(rows, moved.start(layout.places))[0], backend="eager", fullgraph=True
    )
    torch.testing.assert_close(step(scores), moved.step(scores, moved.start(layout.places))[0])


def test_a_filter_on_a_route_keeps_what_was_set():
    given = PlaceFilter().double().requires_grad_(False)
    there = given.over(Layout(10))
    assert (there.move_logits.dtype, there.move_logits.requires_grad) == (torch.float64, False)
    assert given.over(Layout(3, 4)).move_logits.dtype == torch.float64
    back = given.over(Layout(3, 4)).over(Layout(10))
    torch.testing.assert_close(back.move_logits, given.move_logits)
