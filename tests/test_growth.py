"""Maps that grow, from descriptors."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from command_line import rows_of, run
from footage import REFERENCE, SIDE, camera, footage
from helpers import long_from, refused, streamed, template_model
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import (
    HOG,
    DejaVu,
    PlaceFilter,
    Preprocess,
    SequenceMatcher,
    SpectralMapper,
    growth,
    learning,
    open_source,
)
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.growth import append, associate, average, learn_mean, merge, only_route
from dejavu_torch.maps.file import read_map
from dejavu_torch.maps.spectral import encode_chunk
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.places.frame_table import FrameTable
from dejavu_torch.places.layout import Layout
from dejavu_torch.places.positions import count_places, positions_behind, shown_frames
from dejavu_torch.places.rectangles import Rectangle
from dejavu_torch.recognition.calibration import Calibration, Platt
from dejavu_torch.recognition.localizer import Matching
from dejavu_torch.recognition.smoother import PlaceSmoother

NUMBERS = 6


def walk(places, seed=0):
    """Descriptors (N,6) that change slowly."""
    steps = torch.randn(places, NUMBERS, generator=torch.Generator().manual_seed(seed))
    return 0.1 * steps.cumsum(0) + torch.arange(6.0)


def learned(route, chunk=64, **settings):
    mapper = SpectralMapper(4.0, chunk=chunk, **settings)  # type: ignore[arg-type]
    return DejaVu(whitening="none", mapper=mapper).learn(route)


class Named(ArrayTraverse):
    """Frames or features with names."""

    @property
    def names(self):  # type: ignore[override]
        return [f"{self.name}_{i:04}.png" for i in range(len(self))]


def spectral(model):
    assert isinstance(model.map, SpectralMap)
    return model.map


def coding_of(route):
    """What `encode_chunk` takes beside descriptors."""
    return route.means[0], route.step, route.transform, route.resolution


def on_ground(route):
    """A model whose places are even steps along the ground."""
    model = DejaVu(HOG(), "none", SpectralMapper(200.0, chunk=20), velocity=camera())
    return model.learn(ArrayTraverse(route, "route"))


# places behind those of a map


@pytest.mark.parametrize(
    ("chunk", "parts", "settings"),
    [
        (64, (64, 128, 7), {"metric": "l2", "transform": "dct"}),
        (50, (100, 50, 200), {"resolution": 8.0}),
        (32, (192, 1), {}),
    ],
)
def test_the_file_is_that_of_all_places_learned_at_once(chunk, parts, settings, tmp_path):
    route = walk(sum(parts))
    first, *others = route.split(parts)
    model, whole = (learned(first, chunk, **settings) for _ in range(2))
    for i, part in enumerate(others):
        append(model, ArrayTraverse(part, "rest") if i else part)
    known = spectral(whole)
    whole.map = known.of_chunks(encode_chunk(part, *coding_of(known)) for part in route.split(chunk))
    for name, one in (("appended", model), ("whole", whole)):
        one.save(tmp_path / name)
    assert (tmp_path / "appended").read_bytes() == (tmp_path / "whole").read_bytes()
    assert DejaVu.load(tmp_path / "appended").map.places == len(route)


def test_a_calibration_goes_and_comes_again_from_the_new_places():
    coarse = torch.rand(120, 1, 8, 8, generator=torch.Generator().manual_seed(0))
    frames = torch.nn.functional.interpolate(coarse, (32, 32), mode="bilinear")
    mapper = SpectralMapper(40.0, chunk=20)
    model = DejaVu(HOG(resize=(32, 32)), "none", mapper, precision=0.9).learn(frames[:80])
    model.calibrate(frames[:80])
    append(model, frames[80:])
    assert model.calibration is None
    model.calibrate(frames[80:], places=torch.arange(80, 120))
    assert model.calibration is not None
    assert model.calibration.single is not None
    matched = model.localize(frames)
    assert matched.probability is not None
    assert torch.equal(matched.accepted, matched.probability >= 0.9)
    assert matched.accepted.float().mean() > 0.5
    model.calibrate(frames[80:], places=torch.arange(40))  # as if those frames were the first places
    lower = model.localize(frames).probability
    assert lower is not None
    assert lower.mean() < matched.probability.mean() - 0.3


def test_places_at_even_steps_go_on_behind_the_last():
    model, rest = on_ground(footage(REFERENCE)), ArrayTraverse(footage(REFERENCE + 31), "next")
    alone = model.map.frame_of(torch.arange(101))
    assert append(model, rest).map.places == 202
    frames = len(REFERENCE)
    assert torch.equal(model.map.frame_of(torch.arange(101)), alone)
    assert ((model.map.frame_of(torch.arange(101, 202)) - frames - alone).abs() <= 1).all()
    assert len(model.map.positions) == 2 * frames
    assert model.map.place_of(torch.tensor([0, frames])).tolist() == [0, 101]
    matched = model.localize(rest).index
    assert ((matched - torch.arange(101, 202)).abs() <= 2).float().mean() > 0.9
    with refused("ready features", "even steps"):
        append(model, walk(30))


@given(
    st.lists(st.floats(-3.0, 3.0, width=32), min_size=2, max_size=40),
    st.sampled_from([1, 7, 1000, 99_999, 2**23]),
)
def test_positions_behind_others_reach_as_many_places(moves, places):
    own = torch.tensor([0.0, *moves]).cumsum(0)
    behind = positions_behind(own, places)
    assert count_places(behind) == places + count_places(own)
    assert behind.min() >= places
    if places < 10_000:  # beyond, float32 holds them to a thousandth of a step only
        joined = torch.cat([torch.tensor([0.0, places - 0.75]), behind])
        shown = shown_frames(joined)[places:]
        assert shown[0] == 2
        assert (shown - 2 - shown_frames(own.clamp(min=0))).abs().max() <= 1


def test_no_place_is_lost_behind_more_than_float32_can_count():
    own = torch.arange(50.0)
    assert count_places(positions_behind(own, 2**24 - 50)) == 2**24
    with refused("16777217 places", "merge"):
        positions_behind(own, 2**24 - 49)
    long = Rectangle(2**24 + 1, frames=50), Rectangle(50, route=1)
    table = FrameTable(Layout.of(long, routes=["one", "two"]), torch.cat([own, own]))
    assert table.routes == (("one", 2**24 + 1, 50), ("two", 50, 50))
    assert torch.equal(table.steps[50:] - 2**24, own.double() + 1)


def test_frames_that_are_appended_are_coded_as_those_of_a_long_route(monkeypatch, tmp_path):
    long_from(monkeypatch, 60)
    route = open_source("sim:aerial?frames=130")
    mapper = SpectralMapper(5.0, chunk=40)
    whole = DejaVu(whitening=Whitening(views=1), mapper=mapper, batch_size=16).learn(route)
    whole.save(tmp_path / "whole")
    part = DejaVu.load(tmp_path / "whole")
    one = spectral(part)
    part.map = one.of_chunks(one.coded()[:2])
    sizes = []
    code = learning.encode_chunk
    monkeypatch.setattr(
        learning, "encode_chunk", lambda rows, *rest: sizes.append(len(rows)) or code(rows, *rest)
    )
    append(part, open_source("sim:aerial?frames=130&start=80"))
    assert sizes == [40, 10]  # a chunk of descriptors at a time
    part.save(tmp_path / "part")
    assert (tmp_path / "part").read_bytes() == (tmp_path / "whole").read_bytes()


# what is refused leaves the map as it was


def image_model(chunk=20, **settings):
    frames = torch.rand(40, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    mapper = SpectralMapper(40.0, chunk=chunk)
    return DejaVu(whitening="none", mapper=mapper, **settings).learn(frames)  # type: ignore[arg-type]


def test_what_cannot_be_appended():
    features, images = learned(walk(64)), image_model()
    for model, added, words in (
        (template_model().learn(walk(64)), walk(40), ("'templates'", "'spectral'")),
        (DejaVu(), walk(40), ("no map yet to append to",)),
        (merge(routes("a", "b"), ["a", "b"]), walk(64), ("routes a, b", "by its name", "--route")),
        (features, torch.rand(40, 7), ("7 features", "expected 6")),
        (features, torch.rand(40, 1, 9, 9), ("has frames", "ready features")),
        (features, torch.full((40, NUMBERS), math.nan), ("NaN",)),
        (images, walk(40), ("has ready features", "from frames")),
        (images, torch.rand(40, 3, 48, 32), ("3 x 48 x 32", "3 x 32 x 32")),
        (images, torch.rand(40, 1, 32, 32), ("1 x 32 x 32", "3 x 32 x 32")),
    ):
        before, state = model.map, model.get_extra_state()
        with refused(*words):
            append(model, added)
        assert model.map is before
        assert model.get_extra_state() == state


def test_more_places_than_lines_can_be_numbered(monkeypatch):
    model = learned(walk(64))
    monkeypatch.setattr(growth, "LARGEST", 100)
    with refused("128 places", "at most 100"):
        append(model, walk(64))
    with refused("230 places", "at most 100"):
        merge(routes("a", "b"), ["a", "b"])
    assert append(model, walk(36)).map.places == 100
    monkeypatch.setattr(growth, "EXACT", 150)
    ground = footage(REFERENCE)[:, :, :SIDE]
    with refused("202 places at even steps", "at most 150"):
        append(on_ground(ground), ground)


# maps of several routes


def routes(*names, chunks=(64, 50, 10_000), **settings):
    """Models of other routes that describe them alike, each at its own mean and step."""
    whitening = Whitening(numbers=4)
    models = []
    for i, (name, chunk) in enumerate(zip(names, chunks, strict=False)):
        mapper = SpectralMapper(3.0 + i, chunk=chunk, **settings)  # type: ignore[arg-type]
        models.append(DejaVu(whitening=whitening, mapper=mapper))
        models[-1].learn(Named(walk(100 + 30 * i, seed=i) + i, name))
        whitening.fixed = True
    return models


@pytest.mark.parametrize("metric", ["cosine", "l2"])
def test_a_merged_map_scores_as_its_parts_do(metric, tmp_path):
    models = routes("a", "b", "c", metric=metric)
    merged = merge(models, ["a", "b", "c"])
    merged.save(tmp_path / "m.safetensors")
    loaded = DejaVu.load(tmp_path / "m.safetensors")
    fresh = DejaVu(whitening=merged.whitening, mapper=merged.mapper)
    fresh.load_state_dict(merged.state_dict())
    queries = walk(40, seed=9)
    descriptors = merged.descriptor.whitened(queries)
    expected = torch.cat([model.map.scores(descriptors) for model in models], 1)
    for one in (merged, loaded, fresh):
        assert torch.allclose(one(queries), expected, atol=1e-6)
    assert loaded.summary().map_bytes == (tmp_path / "m.safetensors").stat().st_size
    assert loaded.summary().route_bytes == sum(model.summary().route_bytes for model in models)
    assert loaded.map.routes == merged.map.routes
    loaded.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "m.safetensors").read_bytes()


def assert_same(part, whole):
    """Maps of the same places; of a part of another map, fewer have a digest."""
    own, others = (one.packed() for one in (part, whole))
    assert own.keys() == others.keys()
    assert all(torch.equal(own[name], others[name]) for name in own.keys() - {"digest"})
    known = (own["digest"] > 0).any(1)
    assert torch.equal(own["digest"][known], others["digest"][known])


def test_a_place_of_a_merged_map_has_a_route_and_a_frame():
    models = routes("a", "b", "c")
    merged = merge(models, ["a", "b", "c"])
    assert merged.map.routes == (("a", 100, 100), ("b", 130, 130), ("c", 160, 160))
    places = torch.tensor([[0, 99, 100], [229, 230, 389], [-1, 5, -1]])
    assert merged.map.table.route_of(places).tolist() == [[0, 0, 1], [1, 2, 2], [-1, 0, -1]]
    assert merged.map.table.own_frame_of(places).tolist() == [[0, 99, 0], [129, 0, 159], [-1, 5, -1]]
    assert torch.equal(merged.map.frame_of(places), places)
    assert [merged.frame_names[i] for i in (99, 100, 389)] == ["a_0099.png", "b_0000.png", "c_0159.png"]
    for i in range(3):
        found = merged.localize(walk(100 + 30 * i, seed=i) + i).index
        assert (merged.map.table.route_of(found) == i).float().mean() > 0.95
        near = (merged.map.table.own_frame_of(found) - torch.arange(100 + 30 * i)).abs() <= 5
        assert near.float().mean() > 0.8
    part, own = merged.map.part("b"), models[1].map  # type: ignore[operator]
    assert_same(part, own)
    with refused("no route 'd'", "a, b, c"):
        merged.map.part("d")  # type: ignore[operator]


def test_one_route_of_a_merged_map_goes_on_and_no_place_gets_another_number(tmp_path):
    """As if it had gone on before it was merged; only its new places are the last ones."""
    long = [walk(100 + 30 * i + 60, seed=i) + i for i in range(3)]
    models = routes("a", "b", "c")
    merged, rest = merge(models, ["a", "b", "c"]), Named(long[0][100:160], "more")
    linked = merged.map.linked([(99, 100, 0.5)])  # type: ignore[operator]
    merged.replace_map(linked)
    queries = merged.descriptor.whitened(torch.cat(long))
    before, alone = merged.map.scores(queries), append(models[0], rest).map
    grown = append(merged, rest, route="a")
    grown.save(tmp_path / "grown.safetensors")
    for model in (grown, DejaVu.load(tmp_path / "grown.safetensors")):
        place_map, table = spectral(model), model.map.table
        torch.testing.assert_close(place_map.scores(queries)[:, :390], before, atol=1e-6, rtol=1e-4)
        own = torch.cat([torch.arange(100), torch.arange(390, 450)])
        expected = alone.scores(queries)
        torch.testing.assert_close(place_map.scores(queries)[:, own], expected, atol=1e-6, rtol=1e-4)
        assert place_map.routes == (("a", 160, 160), ("b", 130, 130), ("c", 160, 160))
        assert table.route_of(own).tolist() == [0] * 160
        assert table.own_frame_of(own).tolist() == [*range(160)]
        assert model.frame_names[390] == "more_0000.png"
        assert place_map.connections == ((99, 100, 0.5), (99, 390, 1.0))
        part = place_map.part("a")
        assert_same(part, alone)
        assert part.layout == alone.layout
        # a drive crosses the border, and an answer on one side of it suppresses those on the other
        drive = model.localize_descriptors(model.descriptor.whitened(long[0][70:130]), PlaceSmoother())
        assert float((drive.index == own[70:130]).double().mean()) > 0.9
        two = model.localize_descriptors(queries[95:105], Matching(k=2, radius=5)).index
        assert int(place_map.layout.distance(*two.T).min()) > 5
    more = append(append(grown, walk(20, seed=7), route="a"), walk(20, seed=8), route="c")
    assert [len(part) for part in more.map.layout.ranges(0)] == [100, 80]
    assert [len(part) for part in more.map.layout.ranges(2)] == [160, 20]
    both = merge([more, models[1]], ["all", "b"])
    assert both.map.layout.routes == ("a", "b", "c", "b-2")
    assert both.map.layout.starts == (0, 100, 230, 390, 470, 490)
    assert both.map.connections[0] == (99, 100, 0.5)
    with refused("no route 'd'", "a, b, c"):
        append(grown, rest, route="d")
    assert only_route(grown, "a").frame_names[99:101] == ["a_0099.png", "more_0000.png"]


def test_a_merged_route_of_even_steps_goes_on():
    parts = footage(REFERENCE), footage(REFERENCE[:70]).flip(3)
    models = [on_ground(ground) for ground in parts]
    merged, rest = merge(models, ["out", "back"]), ArrayTraverse(footage(REFERENCE + 31), "next")
    before = merged.map.frame_of(torch.arange(merged.map.places))
    grown, alone = append(merged, rest, route="out"), append(models[0], rest)
    assert torch.equal(grown.map.frame_of(torch.arange(len(before))), before)
    own = grown.map.layout.places_in(0)
    shown = grown.map.table.own_frame_of(own)
    assert int((shown - alone.map.frame_of(torch.arange(202))).abs().max()) <= 1
    assert torch.allclose(grown.map.part("out").positions, alone.map.positions, atol=1e-3)
    longer = append(append(grown, rest, route="out"), rest, route="back").map
    frames = len(REFERENCE)
    sizes = [(303, 3 * frames), (models[1].map.places + 101, 70 + frames)]
    assert [route[1:] for route in longer.routes] == sizes
    assert torch.equal(longer.place_of(longer.frame_of(own)), grown.map.place_of(grown.map.frame_of(own)))


def test_even_steps_of_merged_routes():
    grounds = footage(REFERENCE), footage(REFERENCE[:70]).flip(3)
    models = [on_ground(ground) for ground in grounds]
    merged = merge(models, ["out", "back"])
    first, second = (model.map for model in models)
    assert merged.map.routes == (("out", 101, len(REFERENCE)), ("back", second.places, 70))
    places = torch.arange(merged.map.places)
    assert torch.equal(merged.map.table.own_frame_of(places[:101]), first.frame_of(places[:101]))
    own = merged.map.table.own_frame_of(places[101:]) - second.frame_of(places[: second.places])
    assert own.abs().max() <= 1
    matched = merged.localize(ArrayTraverse(grounds[1], "query")).index
    assert (merged.map.table.route_of(matched) == 1).float().mean() > 0.9
    models[1].step = 7.0
    with refused("steps", "6", "7", "--velocity.step"):
        merge(models, ["out", "back"])


def test_a_sequence_does_not_run_from_one_route_into_the_next():
    models = routes("a", "b", "c")
    merged = merge(models, ["a", "b", "c"])
    queries = walk(30, seed=4)
    for speeds in ((1.0,), (0.8, 1.0, -1.2)):
        matcher = SequenceMatcher(7, speeds)
        scores = [[model.map.scores(one) for one in queries_of(model, queries)] for model in models]
        expected = torch.cat([torch.cat([*streamed(matcher, part)]) for part in scores], 1)
        whole = torch.cat(list(streamed(matcher, map(merged.map.scores, queries_of(merged, queries)))))
        assert not torch.equal(whole, expected)  # as one route's places they would count
        assert torch.equal(merged.localize(queries, sequence=matcher).index, expected.argmin(1))
        seen = []
        merged.localizer(merged.matching(matcher)._replace(callback=seen.append))(
            merged.descriptor.whitened(queries)
        )
        torch.testing.assert_close(torch.cat(seen), expected, atol=1e-5, rtol=0)
    assert merged.localize(queries, sequence=PlaceFilter()).index.shape == (30,)


def queries_of(model, queries):
    return (model.descriptor.whitened(part) for part in queries.split(8))


def test_merging_merged_maps_and_names_that_are_there(caplog):
    models = routes("a", "b", "c")
    for model in models:
        model.threshold = 0.25
    pair = merge(models[:2], ["route", "route"])
    assert [one.name for one in pair.map.routes] == ["route", "route-2"]
    both = merge([pair, models[2], pair], ["x", "route", "y"])
    names = [one.name for one in both.map.routes]
    assert names == ["route", "route-2", "route-3", "route-4", "route-2-2"]
    assert (both.map.places, both.threshold, len(both.frame_names)) == (2 * 230 + 160, 0.25, 620)
    assert both.frame_names[390] == "a_0000.png"
    assert caplog.text == ""


def test_what_is_of_single_routes_is_not_kept_and_told(caplog):
    models = routes("a", "b")
    models[0].calibration = Calibration(Platt(1.0, 0.0), None)
    models[1].precision, models[1].threshold = 0.9, 0.5
    merged = merge(models, ["a", "b"])
    assert (merged.calibration, merged.precision, merged.threshold) == (None, None, None)
    assert "no thresholds, calibration, precision" in caplog.text
    assert models[1].precision == 0.9


def test_a_merged_map_is_as_strict_as_its_strictest_part():
    models = routes("a", "b", "c")
    for model, offset in zip(models, (6.0, 2.0, 4.0), strict=True):
        model.calibration = Calibration(Platt(8.0, offset), Platt(0.5, -offset))
        model.precision = 0.9
    merged = merge(models, ["a", "b", "c"])
    assert merged.calibration == Calibration(Platt(8.0, 2.0), Platt(0.5, -6.0))
    assert merged.precision == 0.9
    models[1].calibration = Calibration(Platt(8.0, 2.0), None)
    assert merge(models, ["a", "b", "c"]).calibration == Calibration(Platt(8.0, 2.0), None)


def test_one_route_of_a_merged_map_answers_alone(tmp_path):
    models = routes("a", "b")
    for model in models:
        model.calibration = Calibration(Platt(8.0, 6.0), None)
    merge(models, ["a", "b"]).save(tmp_path / "both.safetensors")
    alone = only_route(DejaVu.load(tmp_path / "both.safetensors"), "b")
    queries = walk(130, seed=1) + 1
    assert torch.equal(alone.localize(queries, sequence=None).index, models[1].localize(queries, None).index)
    assert (alone.frame_names[0], len(alone.frame_names), alone.map.routes) == ("b_0000.png", 130, ())
    assert alone.calibration == models[0].calibration
    np.save(tmp_path / "q.npy", queries.numpy())
    words = "localize", tmp_path / "both.safetensors", tmp_path / "q.npy", "--out", tmp_path / "m.csv"
    run(*words, "--match", "single", "--route", "b")
    rows = rows_of(tmp_path / "m.csv")
    assert "route" not in rows[0]
    assert [int(row["place"]) for row in rows] == alone.localize(queries, sequence=None).index.tolist()
    with refused("no route 'd'", "a, b"):
        only_route(DejaVu.load(tmp_path / "both.safetensors"), "d")
    with refused("route 'b' of a map of one route", "dejavu merge"):
        only_route(models[0], "b")


def test_maps_that_cannot_be_merged():
    (one,) = routes("a")
    other = DejaVu(whitening=Whitening(numbers=4), mapper=SpectralMapper()).learn(walk(90, seed=8))
    plain = learned(walk(90))
    wide = learned(torch.randn(90, 7).cumsum(0))
    l2 = learned(walk(90), metric="l2")
    hog = DejaVu(HOG()).learn(walk(90))
    cells = DejaVu(HOG(cell=4), "none", SpectralMapper()).learn(walk(90))
    grey = DejaVu(None, "none", SpectralMapper(), preprocess=Preprocess(channel="grey")).learn(walk(90))
    images, wider = image_model(), image_model()
    wider.frame_shape = (3, 40, 40)
    templates = template_model(whitening="none").learn(walk(90))
    for pair, words in (
        ((one, other), ("a and b", "whitening", "learned separately", "--whitening MAP")),
        ((one, plain), ("features differ", "Joined; got HOG")),  # the defaults with a whitening and without
        ((hog, plain), ("whitening", "Whitening; got no whitening")),
        ((plain, wide), ("6 and 7",)),
        ((plain, l2), ("metric", "cosine", "l2")),
        ((plain, cells), ("features", "cell=8", "cell=4")),
        ((plain, grey), ("preprocess", "grey")),
        ((images, wider), ("3 x 32 x 32", "3 x 40 x 40")),
        ((plain, templates), ("b is", "'templates'", "'spectral'")),
        ((plain, DejaVu()), ("b is no map",)),
        ((plain,), ("1 maps", "at least two")),
    ):
        with refused(*words):
            merge(pair, ["a", "b"][: len(pair)])
    assert merge([plain, learned(walk(90, seed=1))], ["a", "b"]).map.places == 180


def test_a_state_that_does_not_fit_leaves_a_merged_map_as_it_was():
    merged = merge(routes("a", "b"), ["a", "b"])
    query = walk(1)
    before = merged(query)
    good = merged.map.state_dict()
    extra = good["_extra_state"]
    for change, words in (
        ({"places": 231}, ("expected 231",)),
        ({"routes": [extra["routes"][0], extra["routes"][1] | {"name": "a"}]}, ("means (2, ", "(1, ")),
        ({"routes": extra["routes"][:1]}, ("means (2, ", "(1, ")),
    ):
        with refused(*words):
            merged.map.load_state_dict(good | {"_extra_state": extra | change})
        assert torch.equal(merged(query), before)
    for other in ({"steps": good["steps"][:-1]}, {"steps": good["steps"][:0]}, {"_extra_state": None}):
        with refused("the map does not fit together"):
            merged.map.load_state_dict(good | other)
        assert torch.equal(merged(query), before)


# further visits averaged in


def noisy(route, seed, noise=0.3):
    return route + noise * torch.randn(route.shape, generator=torch.Generator().manual_seed(seed))


def by_hand(route, counts, rows, places):
    """The mean of each place's descriptor, so many times, and of each further one, in a loop."""
    sums, numbers = [row * n for row, n in zip(route, counts, strict=True)], list(counts)
    for row, place in zip(rows, places, strict=True):
        if place >= 0:
            sums[place], numbers[place] = sums[place] + row, numbers[place] + 1
    return torch.stack([total / n for total, n in zip(sums, numbers, strict=True)])


def test_a_map_of_means_is_that_of_the_means_by_hand(tmp_path):
    route, more = walk(120), noisy(walk(150), 1)
    places = [*range(-10, 0), *range(20, 120), *[60] * 40]
    model = DejaVu(whitening="none", mapper=SpectralMapper(6.0, chunk=50))
    learn_mean(model, route, LabelledFrames(ArrayTraverse(more, "more"), torch.tensor(places).clamp(min=-1)))
    means = by_hand(route, [1] * 120, more, places)
    whole = SpectralMapper(6.0, chunk=50)(means)
    assert spectral(model).steps.tolist() == pytest.approx(whole.steps.tolist(), rel=1e-3)
    rebuilt = torch.cat([spectral(model).decode(g) for g in range(3)])
    assert (rebuilt - means).abs().mean() < 2 * float(whole.steps[0])
    counts = [1] * 20 + [2] * 40 + [42] + [2] * 59
    assert model.map.visit_counts.tolist() == counts
    assert model.map.visits.tolist() == [[20, 1], [40, 2], [1, 42], [59, 2]]
    model.save(tmp_path / "m")
    loaded = DejaVu.load(tmp_path / "m")
    assert torch.equal(loaded.map.visits, model.map.visits)
    learned(route).save(tmp_path / "once")
    assert "map.visits" not in read_map(tmp_path / "once")[0]
    assert loaded.summary().route["visits"] == 4 * 8
    assert loaded.summary().map_bytes == (tmp_path / "m").stat().st_size
    fresh = DejaVu(whitening="none", mapper=SpectralMapper(6.0, chunk=50))
    fresh.load_state_dict(loaded.state_dict())
    assert fresh.map.visit_counts.tolist() == counts
    both = merge([loaded, learned(route)], ["a", "b"])
    assert both.map.visits.tolist() == [*model.map.visits.tolist(), [120, 1]]
    fresh.load_state_dict(learned(route, 50).state_dict())  # of one visit
    assert fresh.map.visit_counts.tolist() == [1] * 120


def test_a_visit_is_averaged_into_a_map():
    route, more = walk(150), noisy(walk(60), 1)
    model = learned(route, 50, resolution=4.0)
    one = spectral(model)
    before, coded = torch.cat([one.decode(g) for g in range(len(one.chunks))]), one.coded()
    shown = [*range(5, 45), *[-1] * 10, *range(5, 15)]
    visits = LabelledFrames(ArrayTraverse(more, "more"), torch.tensor(shown))
    assert average(model, visits) == 40
    means = by_hand(before, [1] * 150, more, shown)
    # nothing was seen in the other chunks: they are not coded again
    same = one.of_chunks([encode_chunk(means[:50], *coding_of(one)), *coded[1:]])
    query = walk(4, seed=5)
    assert torch.allclose(model.map.scores(query), same.scores(query), atol=1e-5)
    assert model.map.visits.tolist() == [[5, 1], [10, 3], [30, 2], [105, 1]]
    average(model, visits)  # weighed by the visits before
    assert model.map.visits.tolist() == [[5, 1], [10, 5], [30, 3], [105, 1]]
    means = by_hand(means, [1] * 5 + [3] * 10 + [2] * 30 + [1] * 105, more, shown)
    assert (spectral(model).decode(0)[:45] - means[:45]).abs().mean() < 2 * coded[0].step


def test_which_places_a_visit_shows(tmp_path):
    model, again = learned(walk(100)), ArrayTraverse(walk(100, seed=1), "again")
    few = ArrayTraverse(walk(29), "few")
    assert associate(model, None, again, "0").places.tolist() == list(range(100))
    with refused("of again, fewer than 60 frames", "--average_truth, such as 0"):  # not by length
        associate(model, None, again)
    again.names = model.frame_names = [f"@{i * i}.png" for i in range(100)]
    assert associate(model, None, again).places.tolist() == list(range(100))
    assert associate(model, None, few, "80").places.tolist() == [*range(80, 100), *[-1] * 9]
    (tmp_path / "t.csv").write_text("query,place\n0,7\n3,9\n")
    assert associate(model, None, few, str(tmp_path / "t.csv")).places[:5].tolist() == [7, -1, -1, 9, -1]
    with refused("29 frames of few", "the map", "--average_truth"):
        associate(model, None, few)
    route = ArrayTraverse(footage(REFERENCE), "route")
    moved = on_ground(route.values)
    placed = associate(moved, None, route).places
    assert (placed - torch.arange(101))[placed >= 0].abs().max() <= 1
    views = associate(moved, None, route, "0")
    assert (views.places - torch.arange(101)).abs().max() <= 1
    assert average(moved, views) == len(views.places.unique())
    assert (int(moved.map.visit_counts.sum()), len(moved.map.positions)) == (202, len(REFERENCE))


def test_visits_that_cannot_be_averaged():
    model = learned(walk(90), 10_000)
    before, templates = model.map, template_model(whitening="none")
    at = torch.arange(90)
    for rows, places, words in (
        (walk(90), at + 1, ("shows place 90", "one of 90")),
        (walk(80), at, ("80 frames and 90 places",)),
        (torch.rand(90, 7), at, ("7",)),
        (torch.full((90, 6), math.nan), at, ("NaN",)),
        (torch.rand(90, 1, 9, 9), at, ("frames",)),
    ):
        visits = LabelledFrames(ArrayTraverse(rows, "more"), places)
        for use in (lambda: average(model, visits), lambda: learn_mean(model, walk(90), visits)):  # noqa: B023
            with refused(*words):
                use()
            assert model.map is before
    good = LabelledFrames(ArrayTraverse(walk(90), "more"), at)
    with refused("TemplateMapper", "SpectralMapper"):
        learn_mean(templates, walk(90), good)
    with refused("'templates'", "'spectral'"):
        average(templates.learn(walk(90)), good)
    with refused("no map yet to average visits into"):
        average(DejaVu(), good)
    route = learned(walk(90)).map
    route.visits = torch.tensor([[89, 2]], dtype=torch.int32)
    with refused("visits of 89 places", "90"):
        route.check()
