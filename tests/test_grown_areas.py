"""Maps of areas that grow: more windows of the same ground, further visits, and several areas in one map."""

from __future__ import annotations

import json

import pytest
import torch
from command_line import fails, run
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from test_area import ground

import dejavu_torch.places.rectangles as areas
from dejavu_torch import DejaVu, PlaceFilter, PlaceSmoother, SpectralMapper, open_source
from dejavu_torch.growth import append, associate, average, merge
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.places.layout import FAR, Layout
from dejavu_torch.places.rectangles import Rectangle

WINDOWS = "window=48&stride=16"


def changed(layout, **changes):
    """A layout with other steps, unit or frame."""
    known = {"unit": layout.unit, "frame": layout.frame} | changes
    own = {name: known.pop(name) for name in changes if name in Rectangle._fields}
    return Layout.of([one._replace(**own) for one in layout.rectangles], **known)


@pytest.fixture
def picture(tmp_path):
    """A picture of the ground, and a part of it as a source."""
    Image.fromarray(ground(240)).save(tmp_path / "ground.png")

    def source(rows="", columns="", name="ground.png", options=WINDOWS):
        return f"grid:{tmp_path / name}?{options}" + "".join(
            f"&{key}={part}" for key, part in (("rows", rows), ("columns", columns)) if part
        )

    return source


def learn(source, whitening=None):
    """A map with fine steps; a given whitening makes the same descriptors."""
    model = DejaVu(mapper=SpectralMapper(step=0.02), whitening=whitening or "none")
    return model.learn(source)


@st.composite
def several(draw):
    """An area of several rectangles of one ground that do not overlap."""
    found, row = [], 0
    for _ in range(draw(st.integers(1, 4))):
        sides, corner = (draw(st.integers(1, 9)), draw(st.integers(1, 9))), (row, draw(st.integers(-5, 5)))
        found.append(Rectangle(*sides, first=(float(row), 3.0), corner=corner))
        row += sides[0] + draw(st.integers(0, 3))
    return Layout.of(found[::-1], "px")


@given(area=several())
def test_every_window_has_one_place(area):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(areas, "SIDE", 3)
        places = torch.arange(area.places)
        cells = area.cells(places)
        assert torch.equal(area.place_at(cells), places)
        assert len({*map(tuple, cells.tolist())}) == area.places
        assert cells.amin(0).tolist() == [0, 0]
        assert cells.amax(0).tolist() == [area.rows - 1, area.columns - 1]
        lattice = torch.cartesian_prod(torch.arange(-1, area.rows + 1), torch.arange(-1, area.columns + 1))
        known = area.place_at(lattice) >= 0
        assert int(known.sum()) == area.places
        values = torch.randn(2, area.places)
        assert torch.equal(area.by_place(area.as_plane(values)), values)
        for one, near in zip(places, area.around(places, 2), strict=True):
            assert {*near.tolist()} == {*places[area.distance(places, one) <= 2].tolist()}
        sizes = [part.places for part in area.rectangles]
        for part, own in zip(area.rectangles, places.split(sizes), strict=True):
            alone = Layout.of([part], "px")
            assert torch.equal(area.coordinates(own), alone.coordinates(torch.arange(len(own))))
        assert Layout.restored(json.loads(json.dumps(area.stored())), area.places) == area


def test_areas_that_are_apart_are_not_near():
    one, two = Layout(4, 5, first=(7.0, 8.0)), Layout.of([Rectangle(2, 3), Rectangle(2, 2, corner=(2, 0))])
    both = Layout.merged([one, two, one], [["a"], ["b"], ["c"]])
    assert both.places == 2 * one.places + two.places
    assert int(both.distance(torch.tensor(19), torch.tensor(20))) >= FAR
    assert [both.only(route) for route in range(3)] == [one, two, one]
    assert torch.equal(both.coordinates(torch.arange(30, 50)), one.coordinates(torch.arange(20)))


def test_an_area_grows_by_windows_of_the_same_ground(picture, small_tiles, tmp_path):
    whole, left = open_source(picture()), learn(picture(columns="0:128"))
    separate = learn(picture(columns="96:240"))
    grown = append(learn(picture(columns="0:128")), open_source(picture(columns="96:240")))
    area = grown.map.area
    assert area is not None
    assert (area.rows, area.columns, area.places) == (whole.area.rows, whole.area.columns, whole.area.places)
    cells = area.cells(torch.arange(area.places))
    at = whole.area.place_at(cells)
    assert torch.equal(area.coordinates(torch.arange(area.places)), whole.coordinates.values[at])
    queries = grown.descriptor.all_of(whole)[at]
    scores = grown.map.scores(queries)
    torch.testing.assert_close(scores[:, : left.map.places], left.map.scores(queries))
    found = grown.localize_descriptors(queries)
    assert float((found.index == torch.arange(area.places)).double().mean()) > 0.95
    grown.save(tmp_path / "grown.safetensors")
    again = DejaVu.load(tmp_path / "grown.safetensors")
    assert again.map.area == area
    assert torch.equal(again.map.scores(queries), scores)
    assert "and 13 x" in repr(again.summary())
    # a flight crosses the seam
    course = area.place_at(torch.stack([torch.arange(30) % 3 + 4, torch.arange(30) * 12 // 29], 1))
    for sequence in (PlaceSmoother(), PlaceFilter()):
        match = grown.localize_descriptors(queries[course], sequence)
        off = area.distance(match.index.clamp(min=0), course)
        assert float((off <= 1).double().mean()) > 0.9
    assert separate.map.places + left.map.places == area.places


def test_coordinates_of_metres_are_exact():
    """Northings of millions, and windows closer than the steps of float32 there."""
    steps = {"right": (0.16, 1e-5), "down": (1e-5, -0.16), "unit": "m", "frame": "EPSG:32632"}
    area = Layout(40, 50, first=(691_000.1, 5_334_000.3), **steps)
    places = torch.arange(area.places)
    assert torch.equal(area.place_near(area.coordinates(places)), places)
    for row, column in ((40, 3), (-7, 50), (0, -40)):
        first = torch.tensor(area.first, dtype=torch.float64)
        first += torch.tensor([[row, column]]).double()[0] @ torch.tensor([area.down, area.right]).double()
        other = Layout(7, 40, first=tuple(first.tolist()), **{**steps, "right": (0.16, 2e-5)})
        own, added = area.grown(other, "more").rectangles
        assert (added.corner[0] - own.corner[0], added.corner[1] - own.corner[1]) == (row, column)
    for other, words in (
        (changed(area, frame="EPSG:32633"), ("EPSG:32632 and EPSG:32633",)),
        (changed(area, right=(0.32, 0.0)), ("0.16 and 0.32 m apart",)),
        (changed(area, right=(0.0, 0.16), down=(0.16, 0.0)), ("north is 0",)),
    ):
        with refused(*words):
            area.grown(other, "more")
    beyond = changed(other, **{**steps, "first": (691_000.1, 5_334_010.3)})
    assert changed(area, frame="").grown(beyond, "").frame == "EPSG:32632"


@pytest.mark.parametrize("strip", [Layout(3, 36), Layout(36, 3)])
def test_long_areas_follow_each_other(strip):
    both = Layout.merged([strip] * 14, [[str(route)] for route in range(14)])
    assert both.rows * both.columns < 2 * both.places == 2 * 14 * strip.places


def test_areas_are_merged_like_routes(picture, small_tiles, tmp_path):
    left, right = learn(picture(columns="0:128")), learn(picture(columns="128:240"))
    merged = merge([left, right, left], ["left", "right", "left"])
    assert isinstance(merged.map, SpectralMap)
    assert [route.name for route in merged.map.routes] == ["left", "right", "left-2"]
    queries = left.descriptor.all_of(open_source(picture()))
    scores = torch.cat([model.map.scores(queries) for model in (left, right, left)], 1)
    torch.testing.assert_close(merged.map.scores(queries), scores, rtol=1e-4, atol=1e-5)
    merged.save(tmp_path / "merged.safetensors")
    part = DejaVu.load(tmp_path / "merged.safetensors").map.part("right")
    assert part.area == right.map.area
    torch.testing.assert_close(part.scores(queries), right.map.scores(queries))
    turned = torch.stack([model.map.turned.double() for model in (left, right, left)]).mean(0)
    torch.testing.assert_close(merged.map.turned.double(), turned, atol=0.5, rtol=0)
    grown = append(learn(picture(columns="0:128")), open_source(picture(columns="128:240")))
    assert merge([grown, right], ["grown", "right"]).map.part("grown").area == grown.map.area


def test_one_of_merged_areas_grows_and_keeps_its_metres(picture, small_tiles, tmp_path):
    left, right = learn(picture(columns="0:128")), learn(picture(columns="128:240"))
    more = open_source(picture(columns="96:240"))
    alone, merged = append(learn(picture(columns="0:128")), more), merge([left, right], ["left", "right"])
    before = merged.map.layout.coordinates(torch.arange(merged.map.places))
    append(merged, more, route="left").save(tmp_path / "grown.safetensors")
    grown = DejaVu.load(tmp_path / "grown.safetensors")
    layout = grown.map.layout
    assert torch.equal(layout.coordinates(torch.arange(len(before))), before)
    assert layout.only(0) == alone.map.layout
    own = layout.places_in(0)
    assert torch.equal(layout.coordinates(own), alone.map.layout.coordinates(torch.arange(len(own))))
    queries = grown.descriptor.all_of(open_source(picture()))
    expected = alone.map.scores(queries)
    torch.testing.assert_close(grown.map.scores(queries)[:, own], expected, rtol=1e-4, atol=1e-5)
    assert grown.map.part("left").layout == alone.map.layout
    with refused("share 13 x 6 windows"):
        append(merged, open_source(picture(columns="0:128")), route="left")
    assert append(merged, open_source(picture(columns="0:128")), route="right").map.layout.count == 2


def test_each_of_merged_areas_has_its_own_mean(small_tiles):
    rows = torch.rand(2, 36, 8, generator=torch.Generator().manual_seed(0)) + torch.tensor([0.0, 2.0]).view(
        2, 1, 1
    )
    models = [
        DejaVu(mapper=SpectralMapper(step=0.01), whitening="none").learn_features(own, layout=Layout(6, 6))
        for own in rows
    ]
    merged = merge(models, ["low", "high"])
    assert float(merged.map.means.diff(dim=0).abs().mean()) > 1
    alone = torch.cat([model.map.scores(rows[0]) for model in models], 1)
    torch.testing.assert_close(merged.map.scores(rows[0]), alone)


def test_a_further_visit_is_averaged_into_an_area(picture, small_tiles, tmp_path):
    noise = torch.randint(-60, 60, (240, 240, 3), generator=torch.Generator().manual_seed(0)).numpy()
    changed = (ground(240).astype(int) + noise).clip(0, 255).astype("uint8")
    Image.fromarray(changed).save(tmp_path / "later.png")
    later, model = open_source(picture(name="later.png")), learn(picture())
    assert average(model, associate(model, None, later)) == model.map.places
    rows = (model.descriptor.all_of(one) for one in (open_source(picture()), later))
    mean = torch.nn.functional.normalize(sum(rows) / 2, dim=1)
    own = torch.nn.functional.normalize(torch.cat([*map(model.map.decode, range(len(model.map.chunks)))]))
    assert float((mean * own).sum(1).mean()) > 0.99
    assert model.map.visit_counts.tolist() == [2] * model.map.places
    assert model.map.area == open_source(picture()).area
    # on a grown map, the places of a visit are those of its coordinates
    grown = append(learn(picture(columns="96:240")), open_source(picture(columns="0:128")))
    seen = associate(grown, None, open_source(picture(columns="16:160"))).places
    assert torch.equal(
        grown.map.area.coordinates(seen), open_source(picture(columns="16:160")).coordinates.values
    )
    off = associate(grown, None, open_source(picture(rows="7:240"))).places
    area = open_source(picture()).area
    assert area.place_near(
        torch.tensor([[31.0, 33.0], [33.0, 33.0], [15.0, 24.0], [torch.nan, 24.0]])
    ).tolist() == [*area.place_at(torch.tensor([[1, 0], [1, 1]])).tolist(), -1, -1]
    assert int((off >= 0).sum()) == len(off)
    far = open_source(picture())
    far.coordinates = far.coordinates._replace(frame="EPSG:32632")
    with refused("EPSG:32632", "pixels", "one system"):
        associate(grown, None, far)


def test_csv_of_a_grown_area_are_judged_by_its_map(picture, tmp_path, capsys):
    (tmp_path / "track.csv").write_text(
        "x,y\n" + "".join(f"{24 + 16 * (i % 13)},{24 + 16 * (i // 13)}\n" for i in range(40))
    )
    flight = f"path:{tmp_path}/ground.png?window=48&points={tmp_path}/track.csv"
    left, both = tmp_path / "left.safetensors", tmp_path / "both.safetensors"
    run("learn", picture(columns="0:128"), "--map", left)
    run("learn", picture(columns="96:240"), "--append", left, "--map", both)
    assert "an area of 13 x 6 and 13 x 7 windows" in capsys.readouterr().out
    run("localize", both, flight, "--out", tmp_path / "m.csv")
    judged = ("--map", both, "--query", flight, "--truth", "pixels:12", "--tolerance", "0")
    run("evaluate", tmp_path / "m.csv", *judged, "--out", tmp_path / "scores")
    report = json.loads((tmp_path / "scores" / "report.json").read_text())
    assert report["recall_at_1"] > 0.95
    assert (report["tolerance"], report["unit"]) == (12, "pixels")
    told = fails(capsys, "compare", picture(), flight, "--map", both, "--out", tmp_path / "report")
    assert "is another area" in told
    told = fails(
        capsys, "evaluate", tmp_path / "m.csv", *judged, "--reference", picture(), "--out", tmp_path / "no"
    )
    assert "is not the area of" in told
    unit = (*judged[:5], "metres:12")
    assert "the same unit" in fails(capsys, "evaluate", tmp_path / "m.csv", *unit, "--out", tmp_path / "no")
    told = fails(capsys, "export", both, "--match", "filter", "--onnx", tmp_path / "m.onnx")
    assert "single queries to export" in told


def test_what_does_not_fit_an_area_is_refused(picture, small_tiles, tmp_path, capsys):
    def model():
        return learn(picture(columns="0:128"))

    with refused("share 13 x 3 windows", "ground that the map lacks"):
        append(model(), open_source(picture(columns="48:160")))
    with refused("16 and 24 px apart", "does not continue the map"):
        append(model(), open_source(picture(columns="128:240", options="window=48&stride=24")))
    far = open_source(picture(columns="128:240"))
    far.layout = changed(far.layout, first=(9e5, 24.0))
    with refused("13 x 5", "areas nearby", "merge"):
        append(model(), far)
    frames = torch.rand(20, 3, 48, 48)
    with refused("is a route", "of an area", "an area for an area"):
        append(model(), frames)
    with refused("is an area", "of a route", "a route for a route"):
        append(learn(frames), open_source(picture()))
    with refused("b is the map of a route", "a of an area"):
        merge([model(), learn(frames)], ["a", "b"])
    metres, turned = model(), model()
    metres.map.layout = changed(metres.map.layout, unit="m", frame="EPSG:32632")
    with refused("in pixels and EPSG:32632", "expected the same"):
        merge([model(), metres], ["a", "b"])
    turned.map.layout = changed(turned.map.layout, right=(0.0, 16.0), down=(-16.0, 0.0))
    with refused("north", "90 degrees"):
        merge([model(), turned], ["a", "b"])
    told = fails(
        capsys,
        "learn",
        picture(columns="0:128"),
        picture(columns="128:240"),
        "--map",
        tmp_path / "m.safetensors",
    )
    assert "--append" in told
