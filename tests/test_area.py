"""Maps of areas: windows in rows and columns, lines of two frequencies, and places in a plane."""

from __future__ import annotations

import csv
import itertools
import json
import math
import warnings

import numpy as np
import pytest
import torch
from command_line import fails, run
from helpers import long_from, refused
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import dejavu_torch.places.rectangles as areas
from dejavu_torch import (
    DejaVu,
    PlaceFilter,
    PlaceSmoother,
    SequenceMatcher,
    SpectralMapper,
    TemplateMapper,
    Whitening,
    compare,
    open_source,
)
from dejavu_torch.data.grid import Grid
from dejavu_torch.evaluation.baselines import stored_frames
from dejavu_torch.features.views import Sample
from dejavu_torch.learning import Checkpoint
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.spectrum import by_frequency, frequencies, from_lines, lines_of
from dejavu_torch.places.layout import Layout
from dejavu_torch.places.rectangles import Rectangle
from dejavu_torch.recognition.coarse import CoarseSearch, SamplingPlan
from dejavu_torch.recognition.engine import Evidence, FittedPart, Rates, explained, normalised
from dejavu_torch.recognition.evidence import RankTable, standardised
from dejavu_torch.recognition.localizer import Matching
from dejavu_torch.recognition.plane import Followed, PlaneMotion
from dejavu_torch.recognition.samples import RowSearch
from dejavu_torch.recognition.scorer import OfRows
from dejavu_torch.recognition.search import Scan
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.types import Match

SIDES = st.integers(1, 40)


def smooth(rows, columns, dimension=12, seed=0):
    """Descriptors (rows x columns, K) that change slowly in both directions, row by row."""
    draw = torch.Generator().manual_seed(seed)
    noise = torch.randn(dimension, 1, rows + 8, columns + 8, generator=draw)
    plane = torch.nn.functional.avg_pool2d(noise, 9, 1, 4)[:, 0, 4:-4, 4:-4]
    return torch.nn.functional.normalize(plane.flatten(1).T)


def learned(area, transform="dft", step=0.02, seed=0):
    """A map of smooth descriptors, and these in the order of its places."""
    rows = smooth(area.rows, area.columns, seed=seed)
    cells = area.cells(torch.arange(area.places))
    own = rows[cells[:, 0] * area.columns + cells[:, 1]]
    return SpectralMapper(step=step, transform=transform)(own, area), own


@given(rows=SIDES, columns=SIDES, side=st.integers(1, 9))
def test_every_window_is_one_place_and_a_tile_is_a_run_of_places(rows, columns, side):
    before, areas.SIDE = areas.SIDE, side
    try:
        area = Layout(rows, columns)
        places = torch.arange(area.places)
        cells = area.cells(places)
        assert {(r, c) for r in range(rows) for c in range(columns)} == {*map(tuple, cells.tolist())}
        assert torch.equal(area.place_at(cells), places)
        assert area.tiles[0] == (area.tiles[0][0], area.columns_from(0))
        for (tall, wide), run_of in zip(area.tiles, cells.split([r * c for r, c in area.tiles]), strict=True):
            inside = run_of - run_of[0]
            assert torch.equal(
                inside, torch.cartesian_prod(torch.arange(tall), torch.arange(wide)).view(-1, 2)
            )
    finally:
        areas.SIDE = before


@given(rows=SIDES, columns=SIDES, side=st.integers(1, 9))
def test_values_by_place_are_a_plane_row_by_row(rows, columns, side):
    before, areas.SIDE = areas.SIDE, side
    try:
        area, values = Layout(rows, columns), torch.randn(2, rows * columns)
        plane = area.as_plane(values)
        cells = area.cells(torch.arange(area.places))
        assert torch.equal(plane[:, cells[:, 0], cells[:, 1]], values)
        assert torch.equal(area.by_place(plane), values)
    finally:
        areas.SIDE = before


def test_orders_from_inference_serve_training():
    area, values = Layout(7, 5, first=(0.5, 0.5)), torch.randn(1, 35, requires_grad=True)
    with torch.inference_mode():
        area.as_plane(values.detach())
    area.by_place(area.as_plane(values).square()).sum().backward()
    torch.testing.assert_close(values.grad, 2 * values.detach())


def test_columns_of_candidates_have_coordinates_without_a_warning():
    index, area = torch.arange(20).view(10, 2), Layout(3, 8)
    torch.set_warn_always(True)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = area.coordinates(index[:, 0])
    finally:
        torch.set_warn_always(False)
    assert torch.equal(found, area.coordinates(index)[:, 0])


def test_neighbours_are_those_in_the_plane(small_tiles):
    area = Layout(13, 17)
    place = area.place_at(torch.tensor([[5, 5], [0, 16]]))
    near = area.around(place, 2)
    for one, found in zip(place, near, strict=True):
        every = torch.arange(area.places)
        assert {*found.tolist()} == {*every[area.distance(every, one) <= 2].tolist()}


@given(rows=SIDES, columns=SIDES, transform=st.sampled_from(["dft", "dct"]), seed=st.integers(0, 99))
def test_lines_of_a_plane_are_orthonormal_and_in_the_order_of_their_frequency(rows, columns, transform, seed):
    plane = torch.randn(3, rows * columns, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    lines = lines_of(plane, columns, transform)
    torch.testing.assert_close(lines.square().sum(1), plane.square().sum(1))
    torch.testing.assert_close(from_lines(lines, columns, transform), plane)
    torch.testing.assert_close(lines[:, 0], plane.sum(1) / (rows * columns) ** 0.5)
    squares = frequencies(rows, columns, transform).square().sum(1)
    assert (squares.diff() >= -1e-12).all()
    assert by_frequency(rows, 1, transform, torch.device("cpu")).tolist() == [*range(rows)]


def test_a_wave_over_the_plane_is_one_line():
    """cos(2 pi (2 r / 8 + 3 c / 12)) is half the product of two cosines less that of two sines."""
    row, column = torch.meshgrid(torch.arange(8.0), torch.arange(12.0), indexing="ij")
    wave = torch.cos(2 * torch.pi * (2 * row / 8 + 3 * column / 12)).flatten()
    lines = lines_of(wave, 12)
    strong = (lines.abs() > 1e-4).nonzero()[:, 0]
    assert len(strong) == 2
    found = frequencies(8, 12, "dft")[strong]
    torch.testing.assert_close(found, torch.tensor([[2 / 8, 3 / 12]] * 2, dtype=torch.float64))


@pytest.mark.parametrize("transform", ["dft", "dct"])
def test_the_map_of_an_area_scores_as_its_descriptors(small_tiles, transform):
    area = Layout(13, 17)
    place_map, own = learned(area, transform)
    assert [place_map.size_of(g) for g in range(len(place_map.chunks))] == area.tiles
    decoded = torch.cat([place_map.decode(g) for g in range(len(place_map.chunks))])
    assert float((decoded - own).norm() / own.norm()) < 0.1
    queries = torch.randn(5, own.shape[1])
    exact = 1 - torch.cosine_similarity(queries[:, None], decoded, dim=2)
    torch.testing.assert_close(place_map.scores(queries), exact, rtol=1e-4, atol=1e-4)
    again = place_map._without_places(place_map.means)
    again.load_packed(place_map.packed(), place_map.get_extra_state())
    assert again.area == area
    assert torch.equal(again.scores(queries), place_map.scores(queries))
    assert place_map.summary().covered == area.places


def test_two_directions_take_fewer_bytes_than_one():
    area = Layout(40, 40)
    place_map, own = learned(area, step=0.3)
    rows = SpectralMapper(step=0.3, chunk=40)(own)  # one tile, row by row
    shuffled = SpectralMapper(step=0.3)(own[torch.randperm(len(own))], area)
    sizes = [one.summary().route["lines"] for one in (place_map, rows, shuffled)]
    assert sizes[0] < 0.8 * sizes[1] < 0.8 * sizes[2]


def test_a_route_of_one_column_is_the_map_of_a_route():
    rows = smooth(50, 1)
    place_map, route = SpectralMapper(step=0.1)(rows, Layout(50, 1)), SpectralMapper(step=0.1)(rows)
    assert torch.equal(place_map.streams, route.streams)
    assert not len(place_map.columns)


@pytest.mark.parametrize("transform", ["dft", "dct"])
def test_samples_are_low_passed_in_both_directions(small_tiles, transform, monkeypatch):
    monkeypatch.setattr(areas, "SIDE", 20)
    place_map, _ = learned(Layout(40, 37), transform, step=0.01)
    for chunk in range(len(place_map.chunks)):
        decoded = place_map.decode(chunk)
        torch.testing.assert_close(place_map.samples(chunk, 1), decoded, rtol=0, atol=1e-4)
        near = decoded[place_map.sampled(chunk, 2)]
        assert float(torch.cosine_similarity(place_map.samples(chunk, 2), near).median()) > 0.9


def test_searches_find_what_a_scan_finds(small_tiles, monkeypatch):
    monkeypatch.setattr(areas, "SIDE", 16)
    place_map, own = learned(Layout(48, 50), step=0.05)
    queries = own[::37] + 0.02 * torch.randn(len(own[::37]), own.shape[1])
    wanted = [(3, 2), (2, 5)]
    scan = Scan(place_map)
    for search in (RowSearch(place_map), CoarseSearch(place_map, SamplingPlan(2, 1, 64, 1.0, 0))):
        for spec in wanted:
            score, place = search(queries, wanted)
            found = best_candidates(score, *spec, place, place_map.layout)
            best = best_candidates(place_map.scores(queries), *spec, layout=place_map.layout)
            exact = best_candidates(
                *(scan(queries, wanted)[0], *spec, scan(queries, wanted)[1]), place_map.layout
            )
            assert torch.equal(exact.index, best.index)
            assert float((found.index[:, 0] == best.index[:, 0]).float().mean()) > 0.95
            torch.testing.assert_close(found.score[:, 0], best.score[:, 0], rtol=0, atol=1e-2)


def test_candidates_are_apart_in_the_plane(small_tiles):
    area = Layout(13, 17)
    scores = torch.rand(4, area.places)
    found = best_candidates(scores, 4, 3, layout=area)
    for row in found.index:
        apart = area.distance(row[:, None], row) + 99 * torch.eye(4, dtype=torch.long)
        assert int(apart.min()) > 3


def test_every_kth_window_is_stored_in_both_directions(small_tiles):
    area = Layout(13, 17)
    stored, nearest = stored_frames(area.places, 4, area)
    assert len(stored) == 4 * 5
    every = torch.arange(area.places)
    assert int(area.distance(stored[nearest], every).max()) <= 2
    assert [table.tolist() for table in stored_frames(5, 2)] == [[0, 2, 4], [0, 1, 1, 2, 2]]


def transitions(cells, kernel, jump, leave, enter):
    """Probabilities from each window, or off the area, to each, (N+1,N+1) float64."""
    n, reach = len(cells), len(kernel) // 2
    step = torch.zeros(n + 1, n + 1, dtype=torch.float64)
    moves = (cells[None] - cells[:, None]) + reach
    inside = ((moves >= 0) & (moves <= 2 * reach)).all(2)
    at = moves.clamp(0, 2 * reach)
    step[:n, :n] = (1 - jump - leave) * torch.where(inside, kernel[at[..., 0], at[..., 1]], 0).double()
    lost = 1 - jump - leave - step[:n, :n].sum(1)  # over the border
    step[:n, :n] += jump / n
    step[:n, n] = leave + lost
    step[n, :n], step[n, n] = enter / n, 1 - enter
    return step


@pytest.mark.parametrize(
    "area", [Layout(7, 11), Layout.of([Rectangle(6, 11), Rectangle(1, 7, corner=(6, 2))])]
)
def test_a_filter_moves_over_an_area(small_tiles, area):
    """Against matrices of all transitions."""
    assert len(area.tiles) > 1
    places = area.places
    kernel = torch.rand(5, 5, generator=torch.Generator().manual_seed(2))
    kernel /= kernel.sum()
    rates = Rates(kernel.flatten(), *torch.tensor([0.05, 0.1, 0.2]))
    motion = PlaneMotion(area, rates)
    step = transitions(area.cells(torch.arange(places)), kernel, *rates[1:])
    belief, message = torch.rand(2, places + 1, generator=torch.Generator().manual_seed(0))
    belief /= belief.sum()
    moved, before = motion.moved(motion.unfolded(belief)), motion.expected(motion.unfolded(message))
    torch.testing.assert_close(motion.folded(moved), (belief.double() @ step).float())
    torch.testing.assert_close(motion.folded(before), (step @ message.double()).float())
    assert float(motion.anywhere().sum()) == pytest.approx(1)
    counts = motion.counts(motion.unfolded(belief)[None], motion.unfolded(message)[None])
    assert float(counts.moves.sum() + sum(counts[1:])) == pytest.approx(1)
    # of one move between two windows
    one, two = torch.zeros(2, places + 1)
    one[area.place_at(torch.tensor([3, 4]))] = two[area.place_at(torch.tensor([2, 6]))] = 1
    one, two = (motion.unfolded(belief)[None] for belief in (one, two))
    counts = PlaneMotion(area, rates._replace(jump=torch.tensor(0.0))).counts(one, two)
    assert counts.moves.nonzero().tolist() == [[5 * 1 + 4]]
    kernel = Followed(torch.zeros(25)).moves_after(torch.tensor([0.2, 0.3, 0.5])).view(5, 5)
    torch.testing.assert_close(kernel, kernel.T)
    assert float(kernel[0, 1] / kernel[2, 2]) == pytest.approx(0.5 / 0.2)


def by_heading(kernel, headings):
    """Kernels of the moves that go each way, and the share of each heading that goes on as each."""
    if headings == 1:
        return [kernel], torch.ones(1, 1)
    reach, kernels = len(kernel) // 2, []
    change = torch.zeros(headings, headings)
    for h in range(headings):
        change[h, h], change[h, (h + 1) % headings], change[h, h - 1] = 0.92, 0.04, 0.04
        share = torch.zeros_like(kernel)
        for i, j in itertools.product(range(-reach, reach + 1), repeat=2):
            away = math.atan2(i, j) - 2 * math.pi * h / headings
            share[reach + i, reach + j] = math.exp(8 * (math.cos(away) - 1))
        share[reach, reach] = 0
        stands, goes = kernel[reach, reach], kernel * share
        kernels.append(goes / goes.sum() * (kernel.sum() - stands))
        kernels[-1][reach, reach] = stands
    return kernels, change


def test_a_filter_finds_a_flight_on_the_way(small_tiles):
    model, own, truth = flown(step=0.05)
    draw = torch.Generator().manual_seed(1)
    queries = own[truth] + 0.25 * torch.randn(90, own.shape[1], generator=draw)
    filter = PlaceFilter()

    def near(match):
        return float((model.map.area.distance(match.index.clamp(min=0), truth) <= 2).double().mean())

    found = model.localize_descriptors(queries, filter)
    assert not filter.layout.places  # of a filter that may belong to several maps
    beside = model.localize_descriptors(queries, Matching(also={"filter": filter}))
    assert torch.equal(beside.sequences["filter"].index, found.index)
    assert near(found) > near(model.localize_descriptors(queries)) + 0.05
    localizer = model.localizer(model.matching(PlaceFilter(lag=5, learns=True)))
    answers = [localizer(queries[t : t + 1]) for t in range(90)]
    later = Match.joined([*answers, localizer.finish()])
    assert len(later) == 90
    assert near(later) >= near(found)


def test_a_filter_learns_the_course_of_a_flight():
    model, own, _ = flown(step=0.01)
    course = model.map.area.place_at(torch.stack([torch.arange(5, 25), torch.arange(0, 40, 2)], 1))
    localizer = model.localizer(model.matching(PlaceFilter()))
    localizer(own[course])
    learned = localizer.states["filter"].learned.moves.view(11, 11)
    assert divmod(int(learned.argmax()), 11) == (5 + 1, 5 + 2)  # a row and two columns
    assert 5 < float(learned.sum()) < 20  # early moves are forgotten


@pytest.mark.parametrize("headings", [1, 8])
@pytest.mark.parametrize(
    "area", [Layout(4, 5), Layout.of([Rectangle(3, 5), Rectangle(2, 2, corner=(-2, 3))])]
)
def test_a_sweep_gives_the_masses_of_the_model(small_tiles, area, headings):
    """Against matrices of all transitions between the windows, and the state off the area."""
    queries = 5
    smoother, draw = PlaceSmoother((0.5, 0.5)), torch.Generator().manual_seed(0)
    std = standardised(torch.rand(queries, area.places, generator=draw), torch.zeros(area.places))
    values = RankTable()
    values.add(std.z, torch.ones_like(std.z))
    kernel = torch.rand(3, 3, generator=draw)
    kernel /= kernel.sum()
    still = torch.tensor([False, False, True, False, False])
    weight = torch.tensor([1.0, 1.0, 0.5, 0.5, 1.0])
    _, jump, leave = smoother.rate_logits.detach().softmax(0)
    rates = Rates(kernel.flatten(), jump, leave, smoother.enter_logit.detach().sigmoid())
    motion = PlaneMotion(area, rates, headings)
    told = Evidence(values.values, 2.0, smoother.tempering)
    blocks = [*explained(FittedPart(std, weight, still, motion), told, motion, 2)][::-1]
    found = [motion.folded(torch.cat([one.posterior for one in blocks]))]
    found.append(motion.folded(torch.cat([normalised(one.before * one.after) for one in blocks])))

    n, cells = area.places, area.cells(torch.arange(area.places))
    kernels, change = by_heading(kernel, headings)
    each = [transitions(cells, one, *motion.rates[1:]) for one in kernels]
    step = torch.zeros(headings * n + 1, headings * n + 1, dtype=torch.float64)
    for h, g in itertools.product(range(headings), repeat=2):
        goes = change[h, g] * each[g][:n, :n]  # turns, then moves
        goes += (1 / headings - change[h, g]) * rates.jump / n  # and jumps to any heading
        step[h * n : h * n + n, g * n : g * n + n] = goes
        step[h * n : h * n + n, -1] += change[h, g] * each[g][:n, n]
    step[-1, :-1], step[-1, -1] = rates.enter / (headings * n), 1 - rates.enter
    seen = torch.cat([told(std, weight).exp()] * headings + [torch.ones(queries, 1)], 1).double()
    on, off = motion.folded(motion.anywhere()).double().split([n, 1])
    belief = torch.cat([on / headings] * headings + [off])
    forward, before, total = [], [], 0.0
    for t in range(queries):
        if t and not still[t]:
            belief = belief @ step
        before.append(belief)
        belief = belief * seen[t]
        total += float(belief.sum().log())
        belief = belief / belief.sum()
        forward.append(belief)
    message = torch.ones(len(belief), dtype=torch.float64)
    for t in reversed(range(queries)):
        for own, masses in ((forward[t], found[0]), (before[t], found[1])):
            mass = own * message / (own * message).sum()
            mass = torch.cat([mass[:-1].view(headings, n).sum(0), mass[-1:]])
            torch.testing.assert_close(mass.float(), masses[t], rtol=1e-3, atol=1e-5)
        message = message * seen[t]
        message = message if still[t] else step @ message
    assert float(sum(one.log.sum() for one in blocks)) == pytest.approx(total, abs=1e-3)


def flight(area, images, seed=0):
    """Places of a flight over an area that keeps to its course for a while, (n,)."""
    draw = torch.Generator().manual_seed(seed)
    at, course, found = torch.tensor([5.0, 5.0]), torch.tensor([0.7, 1.2]), []
    most = torch.tensor([area.rows - 1.0, area.columns - 1.0])
    for _ in range(images):
        course = course + 0.2 * torch.randn(2, generator=draw)
        course = torch.where(((at + course) < 0) | ((at + course) > most), -course, course).clamp(-2, 2)
        at = (at + course).clamp(torch.zeros(2), most)
        found.append(at.round().long())
    return area.place_at(torch.stack(found))


def flown(step):
    """A model of an area, its descriptors, and the places of a flight over it."""
    area = Layout(30, 40)
    _, own = learned(area)
    model = DejaVu(whitening="none", mapper=SpectralMapper(step=step)).learn_features(own, layout=area)
    return model, own, flight(area, 90)


def test_a_flight_is_found_where_single_images_are_not():
    model, own, truth = flown(step=0.05)
    area, draw = model.map.area, torch.Generator().manual_seed(1)
    queries = own[truth] + 0.22 * torch.randn(90, own.shape[1], generator=draw)

    def near(match):
        return float((area.distance(match.index.clamp(min=0), truth) <= 2).double().mean())

    one, whole = (model.localize_descriptors(queries, way) for way in (None, PlaceSmoother()))
    assert whole.is_drive
    assert near(whole) > near(one) + 0.1
    assert near(whole) > 0.85
    right = area.distance(whole.index.clamp(min=0), truth) <= 5
    assert float(whole.probability.mean()) == pytest.approx(float(right.double().mean()), abs=0.1)
    mixed = model.localize_descriptors(queries[torch.randperm(90, generator=draw)], PlaceSmoother())
    assert not mixed.is_drive  # in no order
    away = model.localize_descriptors(smooth(30, 40, seed=9)[truth], PlaceSmoother())
    assert not away.is_drive  # over other ground
    noise = torch.randn(90, own.shape[1], generator=draw)
    bare = lambda scorer: OfRows(scorer.rows, scorer.descriptors, area)  # noqa: E731 whose images are not asked
    unsure = model.localize_descriptors(own[truth] + 0.8 * noise, PlaceSmoother(), bare)
    assert 0.05 < unsure.smoother.nats_per_query < 0.2
    assert not unsure.is_drive  # by too little for each image


def ground(side, seed=0, light=0.0):
    """A picture of coarse and fine texture, (side,side,3) uint8."""
    draw = torch.Generator().manual_seed(seed)
    layers = [torch.rand(1, 3, side // n, side // n, generator=draw) for n in (16, 8, 4)]
    resized = [torch.nn.functional.interpolate(one, (side, side), mode="bicubic") for one in layers]
    picture = (sum(resized) / 3 + light).clamp(0, 1)[0]  # type: ignore[operator]
    return (255 * picture).byte().permute(1, 2, 0).numpy()


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Two pictures of the same ground, in another light."""
    folder = tmp_path_factory.mktemp("ground")
    for name, light in (("one", 0.0), ("two", 0.08)):
        Image.fromarray(ground(192, light=light)).save(folder / f"{name}.png")
    return folder


def test_windows_are_parts_of_the_picture(pictures, small_tiles):
    grid = open_source(f"grid:{pictures}/one.png?window=32&stride=16&rows=10:190&columns=4:180")
    assert isinstance(grid, Grid)
    picture = np.asarray(Image.open(pictures / "one.png"))
    assert (grid.area.rows, grid.area.columns) == (10, 10)
    for place in (0, 7, 58, 99):
        row, column = grid.area.cells(torch.tensor(place)).tolist()
        top, left = 10 + 16 * row, 4 + 16 * column
        own = torch.from_numpy(picture[top : top + 32, left : left + 32].copy()).permute(2, 0, 1) / 255
        torch.testing.assert_close(grid[place], own)
        assert grid.coordinates.values[place].tolist() == [left + 16, top + 16]
    halved = open_source(f"grid:{pictures}/one.png?window=32&stride=16&scale=.5")
    assert (halved.area.rows, halved.frame_shape) == (5, (3, 32, 32))
    with refused("start=0, stop=5", "rows=first:stop", "stride="):
        open_source(f"grid:{pictures}/one.png?stop=5")


def test_an_area_is_compared_by_distance(pictures, small_tiles, tmp_path, monkeypatch, capsys):
    long_from(monkeypatch, 200)  # learned tile by tile
    one = f"grid:{pictures}/one.png?window=48&stride=8"
    two = f"grid:{pictures}/two.png?window=48&stride=11&rows=3:180"
    few = ("--bytes", "2.5", "--whitening.views", "4")
    run("compare", one, two, "--tolerance", "6", *few, "--out", tmp_path / "report")
    said = capsys.readouterr().out
    assert "within 6 pixels" in said
    assert "every 2nd window" not in said  # twice 6 pixels are one window
    rows = [*csv.DictReader((tmp_path / "report" / "matches.csv").open())]
    own = open_source(two).coordinates.values
    found = torch.tensor([[float(row["x"]), float(row["y"])] for row in rows], dtype=torch.float64)
    right = (found - own).norm(dim=1) <= 6
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert report["recall_at_1"] == pytest.approx(float(right.double().mean()))
    assert report["recall_at_1"] > 0.4
    assert report["null"]["recall_at_1"] < 0.95 * report["recall_at_1"]
    assert report["area"] == {"rows": 19, "columns": 19}
    assert report["error_pixels"]["all"]["0.5"] < 8
    within = [float(((found - own).norm(dim=1) <= 8 * n).double().mean()) for n in (1, 2, 5)]
    assert report["recall_within"] == pytest.approx(dict(zip(("8", "16", "40"), within, strict=True)))
    run("localize", tmp_path / "report" / "map.safetensors", two, "--out", tmp_path / "m.csv")
    assert f"{len(own)} queries" in capsys.readouterr().out
    again = [*csv.DictReader((tmp_path / "m.csv").open())]
    assert [row["place"] for row in again] == [row["place"] for row in rows]


@pytest.mark.parametrize("area", [Layout(5, 6), Layout.of([Rectangle(3, 5), Rectangle(2, 2, corner=(3, 3))])])
def test_a_window_at_a_border_is_chosen_by_its_own_mass(area):
    every = torch.eye(area.places)
    near = area.blurred(every, 2)
    assert torch.equal(near.argmax(1), torch.arange(area.places))
    away = area.cells(torch.arange(area.places))
    pyramid = (1 - (away[:, None] - away).abs() / 3).clamp(min=0).prod(2)
    torch.testing.assert_close(near, pyramid)


def test_a_flight_is_placed_near_its_images():
    """On a map that tells every window: neighbours look alike, and rank nearly as high."""
    model, own, truth = flown(step=0.01)
    found = model.localize_descriptors(own[truth], PlaceSmoother())
    off = model.map.area.distance(found.index.clamp(min=0), truth)
    assert float(off.double().quantile(0.5)) <= 1
    assert float((off <= 2).double().mean()) > 0.8


def test_other_truths_count_windows_around_the_right_one(pictures, small_tiles, tmp_path, capsys):
    windows = "window=48&stride=8&rows=0:144&columns=0:144"
    one, two = (f"grid:{pictures}/{name}.png?{windows}" for name in ("one", "two"))
    model = DejaVu(mapper=SpectralMapper(2.0)).learn(one)  # so few bytes that a tenth is found beside
    same = torch.arange(model.map.places)
    exact, near = (compare(one, two, truth=same, model=model, tolerance=n).report.as_json() for n in (0, 8))
    assert exact["recall_at_1"] < near["recall_at_1"]
    assert (near["tolerance"], near["unit"]) == (8, "pixels")
    by_distance = compare(one, two, truth="pixels:11.4", model=model, tolerance=3).report.as_json()
    assert by_distance["tolerance"] == 11.4
    assert by_distance["recall_at_1"] == near["recall_at_1"]  # the eight windows around
    model.save(tmp_path / "map.safetensors")
    run("localize", tmp_path / "map.safetensors", two, "--out", tmp_path / "m.csv")
    judged = (tmp_path / "m.csv", "--reference", one, "--query", two, "--out", tmp_path / "scores")
    run("evaluate", *judged, "--truth", "pixels:11.4")
    found = json.loads((tmp_path / "scores" / "report.json").read_text())
    assert found["recall_at_1"] == near["recall_at_1"]
    told = fails(capsys, "evaluate", *judged[:-1], tmp_path / "again", "--truth", "0")
    assert "--tolerance 0" in told


def test_the_map_of_an_area_is_exported(small_tiles):
    place_map, own = learned(Layout(13, 17))

    class Scores(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.place_map = place_map

        def forward(self, queries):
            return self.place_map.scores(queries)

    program = torch.export.export(Scores(), (own[:3],))
    torch.testing.assert_close(program.module()(own[:3]), place_map.scores(own[:3]), rtol=1e-4, atol=1e-4)


def test_gradients_pass_a_map_that_was_first_used_without(small_tiles):
    place_map, own = learned(Layout(13, 17))
    with torch.inference_mode():
        place_map.scores(own[:2])
    query = own[:2].clone().requires_grad_()
    place_map.scores(query).sum().backward()
    assert query.grad is not None
    assert float(query.grad.abs().sum()) > 0


@given(rows=st.integers(1, 3000), columns=st.integers(1, 3000))
def test_a_sample_of_an_area_reaches_its_borders(rows, columns):
    sample = Sample.of_area(area := Layout(rows, columns))
    cells = area.cells(sample.frame)
    assert len(sample.frame) == sum(tall * wide for tall, wide in sample.sizes)
    assert len(sample.frame) >= min(area.places, 2000)
    assert cells.amin(0).tolist() == [0, 0]
    tall, wide = sample.sizes[0]
    if len(sample.sizes) > 1 and min(rows // tall, columns // wide) > 1:  # from border to border
        assert cells.amax(0).tolist() == [rows - 1, columns - 1]


def test_narrow_areas_have_long_tiles():
    assert len(Layout(10_000, 1).tiles) == len(Layout(1, 10_000).tiles) == 1
    assert len(Layout(10_000, 3).tiles) == len(Layout(3, 10_000).tiles) == 2


def test_a_large_area_is_learned_tile_by_tile(pictures, small_tiles, monkeypatch, tmp_path):
    source, few = f"grid:{pictures}/one.png?window=48&stride=8", Whitening(views=2)
    whole = DejaVu(whitening=few, mapper=SpectralMapper(8.0)).learn(source)
    long_from(monkeypatch, 200)
    parts = DejaVu(whitening=few, mapper=SpectralMapper(8.0)).learn(source)
    assert isinstance(parts.map, SpectralMap)
    assert parts.map.area == whole.map.area
    assert parts.map.columns.tolist() == [columns for _, columns in parts.map.area.tiles]  # type: ignore[union-attr]
    found = parts.localize(source)
    assert float((found.index == torch.arange(parts.map.places)).double().mean()) > 0.9

    def stopped(encode, tasks):
        yield from map(encode, tasks[:3])
        raise KeyboardInterrupt

    again = DejaVu(whitening=Whitening(views=2), mapper=SpectralMapper(8.0))
    with pytest.raises(KeyboardInterrupt):
        again.learn(source, checkpoint=Checkpoint(tmp_path / "m"), map_tasks=stopped)
    again.learn(source, checkpoint=Checkpoint(tmp_path / "m"))
    assert all(map(torch.equal, again.map.packed().values(), parts.map.packed().values()))
    assert again.map.layout == parts.map.layout


def test_what_a_map_of_an_area_does_not_do_is_refused(pictures, small_tiles):
    source = f"grid:{pictures}/one.png?window=48&stride=16"
    model = DejaVu().learn(source)
    assert isinstance(model.map, SpectralMap)
    with refused("SequenceMatcher", "area", "PlaceFilter"):
        model.localize(source, sequence=SequenceMatcher(3))
    with refused("TemplateMapper", "area", "SpectralMapper"):
        DejaVu(mapper=TemplateMapper()).learn(source)
    with refused("100 descriptors", "10 x 11", "one for each"):
        SpectralMapper()(smooth(10, 10), Layout(10, 11))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("window=300", ("192 x 192", "windows 300", "1 to 192")),
        ("window=32&stride=40", ("stride 40", "leave gaps")),
        ("window=32&stride=0", ("stride 0",)),
        ("scale=2", ("scale is 2", "at most 1")),
        ("scale=.1&window=32", ("19 x 19",)),
        ("rows=50:300", ("rows 50:300", "0:192")),
        ("columns=7", ("columns 7", "first:stop")),
        ("windows=7", ("unknown 'windows'", "window")),
    ],
)
def test_bad_options_are_told_in_one_line(pictures, options, words):
    with refused(*words):
        open_source(f"grid:{pictures}/one.png?{options}")


def test_other_pictures(tmp_path, capsys):
    Image.fromarray(ground(64)).convert("RGBA").save(tmp_path / "alpha.png")
    assert open_source(f"grid:{tmp_path}/alpha.png?window=32").frame_shape == (3, 32, 32)
    deep = (np.arange(64 * 64).reshape(64, 64) * 16).astype(np.uint16)
    Image.fromarray(deep).save(tmp_path / "deep.png")
    assert open_source(f"grid:{tmp_path}/deep.png?window=32").frame_shape == (1, 32, 32)
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n")
    assert "cannot be read" in fails(
        capsys, "learn", f"grid:{tmp_path}/broken.png", "--map", tmp_path / "map.safetensors"
    )
    assert "missing.png" in fails(
        capsys, "learn", f"grid:{tmp_path}/missing.png", "--map", tmp_path / "map.safetensors"
    )
