"""Images of any heading on the map of an area: turned by known ones, or as copies of which one is found."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from command_line import fails, rows_of, run, write_images
from helpers import refused
from PIL import Image

from dejavu_torch import DejaVu, PlaceFilter, PlaceSmoother, SpectralMapper, Whitening, compare, open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.coordinates import read_coordinates
from dejavu_torch.data.flight import Flight
from dejavu_torch.data.grid import Grid
from dejavu_torch.data.traverse import Chain, Part
from dejavu_torch.data.turning import Turned, facing_north, turned_north
from dejavu_torch.evaluation.options import Reporting
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition.centring import learn_turned, set_apart
from dejavu_torch.recognition.localizer import Matching, answer
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.recognition.scorer import OfRows
from dejavu_torch.recognition.select import best_candidates


@pytest.fixture(scope="module")
def ground():
    """Windows of a smooth picture of 192 x 224 pixels, in 9 rows and 11 columns."""
    noise = torch.rand(3, 1, 208, 240, generator=torch.Generator().manual_seed(0))
    picture = torch.nn.functional.avg_pool2d(noise, 9, 1)[:, 0, :192, :224]
    picture = (picture - picture.amin()) / (picture.amax() - picture.amin())
    return Grid((255 * picture).byte(), window=64, stride=16, name="ground")


@pytest.fixture(scope="module")
def model(ground):
    return DejaVu(mapper=SpectralMapper(8), whitening=Whitening(views=2)).learn(ground)


PLACES = torch.arange(2, 99, 4)
QUARTERS = torch.arange(len(PLACES)) % 4  # of a turn, clockwise


@pytest.fixture(scope="module")
def images(ground):
    """Windows as a camera with these headings sees them, turned the other way."""
    each = zip(ground[PLACES], QUARTERS.tolist(), strict=True)
    return torch.stack([frame.rot90(quarter, (1, 2)) for frame, quarter in each])


def test_quarter_turns_are_exact_and_clockwise(images, ground):
    assert torch.allclose(turned_north(images, 90 * QUARTERS), ground[PLACES], atol=1e-5)
    wide = torch.rand(1, 3, 20, 40)
    assert torch.allclose(turned_north(wide, torch.tensor([180.0])), wide.rot90(2, (2, 3)), atol=1e-5)
    # what is 5 pixels above the middle is 5 pixels right of it, once a camera that looks east is north up
    dot = torch.zeros(1, 1, 41, 41)
    dot[0, 0, 15, 20] = 1
    assert turned_north(dot, torch.tensor([90.0]))[0, 0, 20, 25] > 0.99


@pytest.mark.parametrize("search", ["auto", "scan"])
def test_quarter_turns_are_found_and_their_headings_told(model, images, search):
    match = model.localize(images, search=search, headings=4)
    assert match.index.tolist() == PLACES.tolist()
    assert match.heading.tolist() == (90 * QUARTERS).tolist()
    several = model.candidates(images, 3, headings=4, search=search)
    assert torch.equal(several.index[:, 0], match.index)
    assert torch.equal(several.heading[:, 0], match.heading)
    assert several.heading.shape == (len(images), 3)


def test_the_best_of_all_copies_is_the_minimum_of_their_scores(model, images):
    rows = model.descriptor(images)[:24]
    with torch.no_grad():
        scores = model.map.scores(rows).view(6, 4, -1)
    expected = best_candidates(scores.amin(1), 4, 2, layout=model.map.layout)
    for search in ("auto", "scan"):
        matching = Matching(k=4, radius=2, wrappers=Querying(headings=4).wrappers, search=search)
        match = model.localize_descriptors(rows, matching)
        assert torch.equal(match.index, expected.index)
        assert torch.allclose(match.score, expected.score, atol=1e-4)
        at = expected.index[:, None].expand(-1, 4, -1)
        assert torch.equal(match.heading, 90.0 * scores.gather(2, at).argmin(1))
    none = answer(
        OfRows(lambda numbers: torch.full((2, 5), math.inf), rows[:2], Layout(5)),
        Matching(wrappers=Querying(headings=2).wrappers),
    )
    assert none.index.tolist() == [-1]
    assert none.heading.isnan().all()


def test_one_heading_is_none_bit_by_bit(model, ground):
    plain, one = model.localize(ground[PLACES]), model.localize(ground[PLACES], headings=1)
    assert plain.columns.keys() == one.columns.keys()
    assert "heading" not in one.columns
    assert all(torch.equal(one.columns[name], column) for name, column in plain.columns.items())


def test_known_headings_turn_as_by_hand(model, images, ground):
    query = ArrayTraverse(images)
    query.headings = (90 * QUARTERS).double()
    north = facing_north(query, ground.layout)
    assert isinstance(north, Turned)
    assert torch.allclose(north[:], ground[PLACES], atol=1e-5)
    assert facing_north(north, ground.layout) is north
    assert facing_north(query, Layout(99)) is query  # a car has headings too, and its images look ahead
    match = model.localize(query)
    assert match.index.tolist() == PLACES.tolist()
    rows = model.descriptor(turned_north(images, 90 * QUARTERS))
    by_hand = model.localize_descriptors(set_apart(model.map, rows))
    assert torch.equal(match.index, by_hand.index)
    assert torch.allclose(match.score, by_hand.score, atol=1e-5)
    query.headings[3] = math.nan
    assert torch.allclose(facing_north(query, ground.layout)[3], images[3], atol=1e-5)


def as_pixels(images):
    return (255 * images).round().byte().permute(0, 2, 3, 1).numpy()


@pytest.mark.parametrize("times", [False, True])
def test_headings_are_read_with_coordinates(tmp_path, times):
    write_images(tmp_path / "photos", as_pixels(torch.zeros(3, 3, 8, 8)))
    if times:  # between two rows the shorter way around
        rows = "time,x,y,heading\n-.5,0,0,330\n.5,1,0,30\n1.5,2,0,50\n2.5,2,0,\n"
        expected = [0, 40, math.nan]
    else:
        rows = "heading,x,y\n350,0,0\n-10,1,0\n361,2,0\n"
        expected = [350, 350, 1]
    (tmp_path / "track.csv").write_text(rows)
    photos = open_source(f"{tmp_path}/photos?coordinates={tmp_path}/track.csv")
    assert photos.headings.numpy() == pytest.approx(expected, abs=1e-6, nan_ok=True)
    assert photos.coordinates.values.shape == (3, 2)
    part = open_source(f"{tmp_path}/photos?coordinates={tmp_path}/track.csv&start=1")
    assert part.headings[0] == pytest.approx(expected[1])


def test_a_flight_is_found_and_its_headings_told(model, ground):
    path = torch.cat([44 + torch.arange(11), 65 - torch.arange(11)])  # there and back
    turns = torch.arange(22) // 3 % 4
    flight = torch.stack([ground[int(p)].rot90(int(t), (1, 2)) for p, t in zip(path, turns, strict=True)])
    match = model.localize(flight, sequence=PlaceSmoother(), headings=4)
    assert model.map.area.distance(match.index, path).amax() <= 1
    exact = match.index == path
    assert exact.sum() >= 18
    assert torch.equal(match.heading[exact], 90.0 * turns[exact])


def test_what_is_set_apart_has_length_one():
    rows = torch.randn(300, 8) @ torch.diag(torch.tensor([30.0, 5, 1, 1, 1, 1, 1, 1])) + 4
    rows[7] = 0
    place_map = SpectralMap(torch.zeros(1, 8))
    assert set_apart(place_map, rows) is rows  # nothing is known of turned images
    learn_turned(place_map, rows)
    apart = set_apart(place_map, rows)
    assert apart.norm(dim=1).sort().values.tolist() == pytest.approx([0] + 299 * [1], abs=1e-5)
    assert (apart[7] == 0).all()
    assert apart.std(0)[0] < 2 * apart.std(0)[2:].mean()  # 30 times before
    assert set_apart(place_map, rows[:0]).shape == (0, 8)
    learn_turned(place_map, torch.zeros(2, 8))  # a black picture
    place_map.check()
    place_map.turned = torch.ones(7, 8).to(torch.int8)
    with refused("turned images (7, 8); expected (8, 8)"):
        place_map.check()


def hovering(ground, place=60, count=20):
    """Images of a camera over one place, which turns and moves a little, and their headings."""
    middle = ground.layout.coordinates(torch.tensor([place])) + torch.randn(count, 2).double()
    headings = 120 + torch.arange(count).double()
    return Flight(ground.picture, middle.expand(count, 2), headings, ground.window)


def test_what_an_image_is_compared_with_does_not_depend_on_other_images(model, ground):
    torch.manual_seed(0)
    hover = hovering(ground)
    match = model.localize(hover, sequence=None)
    assert (match.index == 60).float().mean() >= 0.9
    alone = model.localize(Part(hover, range(3, 4)))
    assert alone.index[0] == match.index[3]
    assert alone.score[0] == pytest.approx(float(match.score[3]), abs=1e-5)
    several = model.localize(ArrayTraverse(hover[:6]), headings=24)
    assert (several.index == 60).float().mean() >= 0.5
    one = model.localize(ArrayTraverse(hover[:1]), headings=24)
    assert (one.index, one.heading) == (several.index[0], several.heading[0])


def test_what_turned_images_have_in_common_is_in_the_file(tmp_path, model, ground):
    hover = hovering(ground)
    model.save(tmp_path / "map.safetensors")
    loaded = DejaVu.load(tmp_path / "map.safetensors")
    assert torch.equal(loaded.map.turned, model.map.turned)
    assert torch.equal(loaded.localize(hover).score, model.localize(hover).score)
    assert model.summary().fixed["turned"] == model.map.dimension**2
    tensors, extra = model.map.packed(), model.map.get_extra_state()
    older = DejaVu.load(tmp_path / "map.safetensors")
    older.map.load_packed({n: t for n, t in tensors.items() if n != "turned"}, extra)
    assert not len(older.map.turned)
    rows = model.descriptor(turned_north(hover[:], hover.headings))
    assert torch.allclose(older.localize(hover).score, older.localize_descriptors(rows).score, atol=1e-5)
    assert not len(DejaVu().learn_features(rows, layout=Layout(4, 5)).map.turned)


def test_what_cannot_be_turned_is_refused(model, ground, images):
    with refused("headings is 0; expected a whole number from 1 to 360"):
        model.localize(images, headings=0)
    with refused("headings 4 on a route; expected the map of an area, as of grid:PICTURE"):
        DejaVu().learn(ground[:12]).localize(images, headings=4)
    rows = model.descriptor.describe(images)
    with refused("headings 4, and the array has ready features; expected images, which can be turned"):
        model.localize(rows, headings=4)
    with refused("--loops 3 and --headings 4; expected one of them"):
        compare(ground, None, querying=Querying(loops=3, headings=4))
    with refused("loops on the map of an area; expected a route"):
        model.loops(ground)
    with refused("loops on the map of an area; expected a route"):
        compare(ground, None, querying=Querying(loops=3))
    reporting = Reporting(storage_curve=True, drives="all")
    with refused("there is none to judge a storage curve by"):
        compare(ground, images, querying=Querying(headings=4), reporting=reporting)


def test_commands_try_headings(tmp_path, model, ground, images, capsys):
    pixels = np.zeros((192, 224, 3), dtype=np.uint8)
    frames = as_pixels(ground[:])
    for frame, (row, column) in zip(
        frames, (16 * ground.layout.cells(torch.arange(99))).tolist(), strict=True
    ):
        pixels[row : row + 64, column : column + 64] = frame
    Image.fromarray(pixels).save(tmp_path / "ground.png")
    write_images(tmp_path / "photos", as_pixels(images))
    lines = (f"{x},{y}" for x, y in ground.layout.coordinates(PLACES).tolist())
    (tmp_path / "track.csv").write_text("\n".join(["x,y", *lines]))
    area, out = f"grid:{tmp_path}/ground.png?window=64&stride=16", tmp_path / "report"
    photos, known = f"{tmp_path}/photos?coordinates={tmp_path}/track.csv", tmp_path / "ground.safetensors"
    model.save(known)
    words = "--map", known, "--truth", "pixels:4", "--tolerance", "4", "--unordered", "--out", out
    run("compare", area, photos, *words, "--headings", "4")
    report = json.loads((out / "report.json").read_text())
    assert (report["headings"], report["recall_at_1"], report["uncompressed"]["recall_at_1"]) == (4, 1, 1)
    expected = (90.0 * QUARTERS).tolist()
    assert [float(row["heading"]) for row in rows_of(out / "matches.csv")] == expected
    run("localize", known, photos, "--unordered", "--headings", "4", "--out", tmp_path / "matches.csv")
    assert [float(row["heading"]) for row in rows_of(tmp_path / "matches.csv")] == expected
    words = known, photos, "--headings", "0", "--out", tmp_path / "matches.csv"
    assert "headings is 0; expected a whole number" in fails(capsys, "localize", *words)


ROTATED = Layout(
    9, 11, right=(0.5, 0.3), down=(0.3, -0.5), unit="m"
)  # a picture that is turned by 30.96 degrees


def test_headings_count_from_north_not_from_the_picture(model, images, ground):
    assert Layout(2, 2).north == 0
    assert Layout(2, 2, right=(0.5, 0.0), down=(0.0, -0.5), unit="m").north == 0
    assert Layout(2, 2, right=(0.0, 1.0), down=(-1.0, 0.0)).north == pytest.approx(-90)  # its right is south
    # where rows rise to the right, north is to the right of up by as much
    north = math.degrees(math.atan2(0.3, 0.5))
    x, y = math.sin(math.radians(north)), -math.cos(math.radians(north))
    assert x * 0.5 + y * 0.3 == pytest.approx(0)
    assert x * 0.3 - y * 0.5 > 0
    assert ROTATED.north == pytest.approx(north)
    turned = DejaVu(mapper=SpectralMapper(8), whitening=model.whitening)
    turned.replace_map(model.map._sharing(), model.state)
    turned.map.layout = ROTATED
    match = turned.localize(images, headings=4)
    assert match.index.tolist() == PLACES.tolist()
    assert torch.allclose(match.heading, ((90 * QUARTERS - north) % 360).float())
    query = ArrayTraverse(images)
    query.headings = (90 * QUARTERS - north).double()
    assert torch.allclose(facing_north(query, ROTATED)[:], ground[PLACES], atol=1e-5)


def test_a_filter_tells_headings(model, ground):
    path, turns = torch.arange(44, 55), torch.arange(11) % 4
    flight = torch.stack([ground[int(p)].rot90(int(t), (1, 2)) for p, t in zip(path, turns, strict=True)])
    match = model.localize(flight, sequence=PlaceFilter(), headings=4)
    exact = match.index == path
    assert exact.sum() >= 8
    assert torch.equal(match.heading[exact], 90.0 * turns[exact])


def test_frames_are_turned_as_they_come(tmp_path, model, ground, images, capsys):
    write_images(tmp_path / "photos", as_pixels(images))
    rows = zip(ground.layout.coordinates(PLACES).tolist(), (90 * QUARTERS).tolist(), strict=True)
    (tmp_path / "track.csv").write_text("\n".join(["x,y,heading", *(f"{x},{y},{h}" for (x, y), h in rows)]))
    photos = f"{tmp_path}/photos?coordinates={tmp_path}/track.csv"
    model.save(tmp_path / "map.safetensors")
    run("live", tmp_path / "map.safetensors", photos, "--match", "single")
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    expected = model.localize(photos, sequence=None)
    assert [line["place"] for line in lines] == expected.index.tolist() == PLACES.tolist()
    assert [line["score"] for line in lines] == pytest.approx(expected.score.tolist(), abs=1e-3)


def test_headings_that_are_not_known_are_none(tmp_path, ground):
    Image.fromarray(ground.picture.permute(1, 2, 0).numpy()).save(tmp_path / "ground.png")
    (tmp_path / "points.csv").write_text("x,y,heading\n90,90,30\n100,90,60\n")
    (tmp_path / "plain.csv").write_text("x,y\n1,2\n3,4\n")
    (tmp_path / "none.csv").write_text("x,y,heading\n1,2,\n3,4,\n")
    flight = f"path:{tmp_path}/ground.png?points={tmp_path}/points.csv"
    for name in ("plain", "none"):
        source = open_source(f"{flight}&coordinates={tmp_path}/{name}.csv")
        assert source.headings.tolist() == [30, 60]
        assert source.coordinates.values.tolist() == [[1, 2], [3, 4]]
    plain = ArrayTraverse(torch.zeros(2, 3, 64, 64))
    assert read_coordinates(tmp_path / "none.csv", plain)[1] is None
    chain = Chain([open_source(flight), plain])
    assert chain.headings.numpy() == pytest.approx([30, 60, math.nan, math.nan], nan_ok=True)
    assert Chain([plain, plain]).headings is None
