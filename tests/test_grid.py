"""Pictures in parts, coordinates of GeoTIFF files, and windows along a path."""

from __future__ import annotations

import logging
import math
import pickle
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import fails
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import dejavu_torch.data.folder as folder
import dejavu_torch.data.picture as pictures
import dejavu_torch.memory as memory
from dejavu_torch import DejaVu, SpectralMapper, compare, open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.coordinates import coordinates_of, read_coordinates
from dejavu_torch.data.flight import Flight
from dejavu_torch.data.geotiff import from_degrees
from dejavu_torch.data.grid import Grid
from dejavu_torch.data.ground_truth import find_ground_truth
from dejavu_torch.data.picture import PictureFile, read_picture
from dejavu_torch.data.source import check_not_read
from dejavu_torch.evaluation.options import Reporting
from dejavu_torch.places.rectangles import Ground
from dejavu_torch.resize import resize_frames
from dejavu_torch.types import Coordinates

UTM = "EPSG:32632"
ROAD = Path(folder.__file__).parent / "road"


def ground(height, width, channels=3, seed=0):
    """(C,H,W) uint8 of coarse and fine texture."""
    draw = torch.Generator().manual_seed(seed)
    layers = [torch.rand(1, channels, height // n + 1, width // n + 1, generator=draw) for n in (16, 8, 4)]
    layers = [torch.nn.functional.interpolate(one, (height, width), mode="bicubic")[0] for one in layers]
    return (85 * sum(layers)).clamp(0, 255).byte()


@pytest.fixture
def geotiff(tmp_path):
    """Writes pixels (C,H,W) as a GeoTIFF."""
    rasterio = pytest.importorskip("rasterio")

    def write(pixels, name="a.tif", crs=UTM, at=(500_000, 5_300_000), size=0.5, turned=0.0, **options):
        pixels = np.asarray(pixels)
        place = rasterio.Affine.translation(*at) @ rasterio.Affine.rotation(turned)
        options = {"crs": crs, "transform": place @ rasterio.Affine.scale(size, -size)} | options
        count, height, width = pixels.shape
        options |= {"width": width, "height": height, "count": count, "dtype": pixels.dtype}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of files without coordinates
            with rasterio.open(tmp_path / name, "w", driver="GTiff", **options) as file:
                file.write(pixels)
        return tmp_path / name

    return write


@given(scale=st.sampled_from([1.0, 0.7, 0.5, 0.23]), seed=st.integers(0, 99), data=st.data())
def test_a_part_is_that_of_the_whole_picture(scale, seed, data):
    pixels = ground(300, 410, seed=seed)
    picture = PictureFile((3, 300, 410), lambda a, b, c, d: pixels[:, a:b, c:d], scale)
    small = resize_frames(pixels[None].float(), tuple(picture.full))[0].round().clamp(0, 255)
    height, width = picture.full
    whole = picture[:, 0:height, 0:width]
    assert whole.shape == picture.shape
    assert float((whole - small).abs().max()) <= 1
    assert float((whole != small).float().mean()) < 0.03  # halves are rounded to either side
    top, left = data.draw(st.integers(0, height - 1)), data.draw(st.integers(0, width - 1))
    bottom, right = data.draw(st.integers(top + 1, height)), data.draw(st.integers(left + 1, width))
    fresh = PictureFile((3, 300, 410), lambda a, b, c, d: pixels[:, a:b, c:d], scale).part(
        top, bottom, left, right
    )
    assert torch.equal(fresh[:, 0 : bottom - top, 0 : right - left], whole[:, top:bottom, left:right])


def test_a_tiff_is_read_in_parts(geotiff, monkeypatch):
    monkeypatch.setattr(pictures, "SIDE_READ", 64)
    monkeypatch.setattr(pictures, "HELD", 3 * 64 * 64 * 4)
    pixels = ground(200, 260)
    path = geotiff(pixels)
    grid = open_source(f"grid:{path}?window=48&stride=12&scale=.5&rows=10:90&columns=6:130")
    assert isinstance(grid.picture, PictureFile)
    Image.fromarray(pixels.permute(1, 2, 0).numpy()).save(path.with_suffix(".png"))
    whole = open_source(
        f"grid:{path.with_suffix('.png')}?window=48&stride=12&scale=.5&rows=10:90&columns=6:130"
    )
    assert isinstance(whole.picture, torch.Tensor)
    assert torch.equal(grid[:], whole[:])
    assert len(grid.picture._blocks) <= 4 * 4
    assert torch.equal(pickle.loads(pickle.dumps(grid))[5], whole[5])


def test_a_picture_beyond_the_limit_of_pillow_is_read_if_it_fits(tmp_path, monkeypatch, recwarn):
    Image.fromarray(ground(80, 100).permute(1, 2, 0).numpy()).save(tmp_path / "a.jpg")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    assert len(open_source(f"grid:{tmp_path}/a.jpg?window=32")) == 7 * 9
    assert Image.MAX_IMAGE_PIXELS == 100
    assert not recwarn.list
    monkeypatch.setattr(memory, "free_memory", lambda: 1000.0)
    with refused("a.jpg of 100 x 80 pixels takes", "at most"):
        open_source(f"grid:{tmp_path}/a.jpg?window=32")


@pytest.mark.parametrize("turned", [0.0, 30.0])
def test_coordinates_are_those_of_the_map(geotiff, turned):
    grid = open_source(
        f"grid:{geotiff(ground(100, 140), turned=turned)}?window=16&stride=16&scale=.5&rows=10:50"
    )
    assert (grid.area.unit, grid.coordinates.frame) == ("m", UTM)
    row, column = 1, 2
    across, down = 16 * column + 8, -(10 + 16 * row + 8)  # metres, as a pixel is one after scaling
    angle = math.radians(turned)
    x = 500_000 + across * math.cos(angle) - down * math.sin(angle)
    y = 5_300_000 + across * math.sin(angle) + down * math.cos(angle)
    place = int(grid.area.place_at(torch.tensor([row, column])))
    assert grid.coordinates.values[place].tolist() == pytest.approx([x, y], abs=1e-3)


@pytest.mark.parametrize(
    ("crs", "steps"),
    [
        ("EPSG:4326", (1e-5, 0, 0, -1e-5)),
        ("EPSG:4326", (7e-6, 5e-6, 7e-6, -5e-6)),
        ("EPSG:3857", (1.5, 0, 0, -1.5)),
        ("EPSG:3395", (1.5, 0, 0, 1.5)),
        ("EPSG:25833", (1, 0, 0, -0.5)),
        ("EPSG:25833", (1, 0.3, 0.3, -1.0)),
        ("EPSG:25833", (0.8, 0.6, 0.6, -0.8)),
    ],
)
@pytest.mark.parametrize("bands", [1, 3])
def test_windows_are_squares_of_metres_on_the_ground(geotiff, crs, steps, bands):
    from rasterio import Affine
    from rasterio.warp import transform

    def shade(x, y):  # of the ground, by metres of UTM
        return 128 + 60 * np.sin((x - 400_000) / 7) + 60 * np.cos((y - 5_300_000) / 11)

    (x,), (y,) = transform("EPSG:32633", crs, [400_000], [5_300_000])
    across, down, height, width = *steps[::2], 100, 140
    place = Affine(across, down, x, *steps[1::2], y)
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    seen = transform(crs, "EPSG:32633", *(one.ravel() for one in place @ (columns, rows)))
    pixels = shade(*map(np.array, seen)).reshape(1, height, width).round().astype(np.uint8)
    grid = open_source(
        f"grid:{geotiff(pixels.repeat(bands, 0), crs=crs, transform=place)}?window=20&stride=10"
    )
    right, first = np.array(grid.area.right), torch.tensor(grid.area.first)
    assert np.hypot(*right) == pytest.approx(np.hypot(*grid.area.down), rel=0.01)
    assert abs(right @ grid.area.down) < 0.01 * (right @ right)
    assert grid.area.frame == (crs if crs == "EPSG:25833" else "EPSG:32633")
    whole = grid.picture[:, 0 : grid.picture.shape[1], 0 : grid.picture.shape[2]]
    line = torch.tensor(np.mgrid[: whole.shape[1], : whole.shape[2]][::-1].copy(), dtype=torch.float64) - 9.5
    along = torch.tensor([grid.area.right, grid.area.down], dtype=torch.float64) / 10
    at = line.permute(1, 2, 0) @ along + first
    inside = whole[0] > 0
    inside[[0, -1]] = inside[:, [0, -1]] = False  # where the file ends
    off = (whole[0].double() - torch.from_numpy(shade(*at.numpy().transpose(2, 0, 1)))).abs()[inside]
    assert len(off) > 3000
    assert len(whole) == bands
    assert float(off.quantile(0.99)) < 4


def test_two_geotiffs_are_compared_in_metres(geotiff):
    pixels = ground(120, 130)
    one = geotiff(pixels, "one.tif", turned=20.0)
    x, y = 20 * math.cos(math.radians(20)), 20 * math.sin(math.radians(20))  # 40 pixels to the right
    light = (pixels[:, 20:112, 40:122].float() * 0.9 + 10).byte()
    two = geotiff(light, "two.tif", at=(500_000 + x + y / 2, 5_300_000 + y - x / 2), turned=20.0)
    reference, query = (open_source(f"grid:{path}?window=48&stride=8") for path in (one, two))
    found = compare(reference, query, tolerance=3, model=DejaVu(mapper=SpectralMapper(8.0)))
    report = found.report.as_json()
    assert report["recall_at_1"] > 0.8
    assert report["unit"] == "metres"
    assert "shift" not in report
    values = query.coordinates.values
    for x, y in ((-12.0, 12.0), (14.0, 0.0)):  # corners, and others' coordinates
        query.coordinates = Coordinates(values + torch.tensor([x, y]), frame=UTM)
        told = compare(reference, query, tolerance=3, model=found.run.model).report
        assert (told.facts["shift"]["x"], told.facts["shift"]["y"]) == pytest.approx((-x, -y), abs=3)
        assert "the answers contradict the truth" in repr(told)
    query.coordinates = Coordinates(values, frame=UTM)
    told = repr(found.run.model.summary())
    assert "an area of 10 x 11 windows" in told
    periods = told.split("strongest periods ")[1].split("\n")[0].split(", ")
    assert len(periods) == len({*periods})
    other = open_source(f"grid:{geotiff(light, 'other.tif', crs='EPSG:32633')}?window=48")
    with refused("one.tif", UTM, "other.tif", "EPSG:32633", "gdalwarp"):
        coordinates_of([reference, other], "metres")
    plain = open_source(f"grid:{geotiff(light, 'plain.tif', crs=None, transform=None)}?window=48")
    with refused("plain.tif", "in pixels", UTM):
        coordinates_of([reference, plain], "metres")


@pytest.mark.parametrize("palette", [False, True])
def test_a_picture_that_is_stored_from_below_is_read_from_above(geotiff, tmp_path, palette):
    rasterio = pytest.importorskip("rasterio")
    pixels = ground(120, 150, 1 if palette else 3)
    above = geotiff(pixels, "above.tif", size=1.0)
    from_below = rasterio.Affine(1, 0, 500_000, 0, 1, 5_300_000 - 120)
    below = geotiff(pixels.flip(1), "below.tif", transform=from_below)
    if palette:
        with rasterio.open(below, "r+") as file:
            file.write_colormap(1, {i: (i, i, i, 255) for i in range(256)})
    options = "window=32&stride=16&rows=10:110"
    one, other = (open_source(f"grid:{path}?{options}") for path in (above, below))
    assert torch.equal(one[:].expand_as(other[:]), other[:])
    assert one.area == other.area
    (tmp_path / "track.csv").write_text("x,y,heading\n500080,5299940,0\n")
    flight = open_source(f"path:{below}?points={tmp_path}/track.csv&window=40")
    upright = pixels[:, 40:80, 60:100].float() / 255
    torch.testing.assert_close(flight[0], upright.expand_as(flight[0]), rtol=0, atol=1e-5)


def test_turned_and_misnamed_files_are_read_alike_without_rasterio(geotiff, monkeypatch):
    path = geotiff(ground(70, 80))
    image = Image.fromarray(ground(70, 80).permute(1, 2, 0).numpy())
    exif = Image.Exif()
    exif[274] = 6
    image.save(path.with_name("turned.tif"), exif=exif)
    image.save(path.with_name("png.tif"), format="PNG")
    files = [path.with_name(name) for name in ("turned.tif", "png.tif")]
    seen = [read_picture(file)[0] for file in files]
    assert torch.equal(seen[0], torch.rot90(seen[1], -1, (1, 2)))
    monkeypatch.setitem(sys.modules, "rasterio", None)
    assert all(torch.equal(read_picture(file)[0], one) for file, one in zip(files, seen, strict=True))


def test_blocks_at_a_border_count_as_whole_ones(monkeypatch):
    monkeypatch.setattr(pictures, "SIDE_READ", 64)
    monkeypatch.setattr(pictures, "HELD", 3 * 64 * 64 * 4)
    pixels = ground(65, 640)
    picture = PictureFile((3, 65, 640), lambda a, b, c, d: pixels[:, a:b, c:d])
    assert torch.equal(picture[:, 0:65, 0:640], pixels)
    assert len(picture._blocks) <= 4 + 1


def test_pixels_of_every_kind(geotiff):
    colours = ground(70, 80)

    def read(pixels, **options):
        return read_picture(geotiff(pixels, **options))[0][:, 0:70, 0:80]

    assert torch.equal(read(colours[:1]), colours[:1])
    assert torch.equal(read(torch.cat([colours, colours])), colours)
    assert torch.equal(read(colours.int().numpy().astype(np.uint16) * 257), colours)
    floats = colours.numpy()[:1] / np.float32(255)
    floats[0, :9] = -9999
    assert torch.equal(read(floats, nodata=-9999)[:, 9:], colours[:1, 9:])
    assert not read(floats, nodata=-9999)[:, :9].any()
    with refused("values from -9999"):
        read(floats)
    alpha = torch.full((1, 70, 80), 255, dtype=torch.uint8)
    alpha[:, :9] = 0
    seen = read(torch.cat([colours, alpha]), photometric="RGB", alpha="YES")
    assert torch.equal(seen[:, 9:], colours[:, 9:])
    assert not seen[:, :9].any()
    path = geotiff(colours[:1])
    image = Image.fromarray(torch.cat([colours, alpha]).permute(1, 2, 0).numpy())
    image.save(path.with_suffix(".png"))
    assert torch.equal(read_picture(path.with_suffix(".png"))[0], seen)
    for mode in ("P", "1", "CMYK"):  # of a palette and of single bits by Pillow
        image.convert("RGB").convert(mode).save(path)
        kept, _, where = read_picture(path)
        expected = folder.read_image(path)
        assert torch.equal(kept[:, 0:70, 0:80], (expected * 255).round().byte())
        assert where == Ground()
    with refused("complex64"):
        read(colours[:1].numpy().astype(np.complex64))
    with refused("pixels of int8", "expected uint8"):
        read((colours[:1] // 2).numpy().astype(np.int8))
    path.write_bytes(b"II*\0")
    with refused("a.tif cannot be read as a TIFF"):
        read_picture(path)


def test_without_rasterio_coordinates_are_pixels(geotiff, monkeypatch, caplog):
    path = geotiff(ground(70, 80))
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with caplog.at_level(logging.WARNING, "dejavu_torch"):
        grid = open_source(f"grid:{path}?window=32")
        open_source(f"grid:{path}?window=32")
    assert grid.coordinates.frame == "pixels"
    (record,) = caplog.records
    assert "pip install 'dejavu_torch[geo]'" in record.getMessage()


def test_what_cannot_be_reprojected_is_refused(geotiff):
    from rasterio import open as opened

    path = geotiff(ground(70, 80)[:1], crs="EPSG:4326", at=(5, 52), size=1e-5, photometric="PALETTE")
    with opened(path, "r+") as file:
        file.write_colormap(1, {value: (value, 0, 0, 255) for value in range(256)})
    with refused("a.tif", "palette", "gdalwarp -t_srs EPSG:32631"):
        open_source(f"grid:{path}?window=32")


def test_what_no_zone_covers_is_refused(geotiff):
    for crs, size in (("EPSG:4326", 2.0), ("EPSG:3857", 150_000.0), ("EPSG:25832", 60_000.0)):
        with refused("a.tif", "UTM zone", "gdal_translate -projwin"):
            at = (4e5, 5.3e6) if crs == "EPSG:25832" else (-20, 40) if crs == "EPSG:4326" else (0, 5e6)
            open_source(f"grid:{geotiff(ground(30, 40), crs=crs, at=at, size=size)}?window=16")


def test_latitudes_are_those_of_the_map(geotiff, tmp_path):
    grid = open_source(f"grid:{geotiff(ground(100, 140), at=(500_000, 5_300_000))}?window=20&stride=20")
    (tmp_path / "photos.csv").write_text("lat,lon\n47.85,9.0005\nnan,nan\n")
    own = ArrayTraverse(torch.zeros(2, 20, 20, dtype=torch.uint8))
    own.coordinates, *_ = read_coordinates(tmp_path / "photos.csv", own)
    stored, asked = coordinates_of([grid, own], "metres")
    assert asked[0].tolist() == pytest.approx([500_037.4, 5_299_628.6], abs=0.1)  # 9 degrees east are 500 km
    assert asked[1].isnan().all()
    assert torch.equal(stored, grid.coordinates.values)
    with refused("EPSG:32632", "expected ones that it covers"):
        from_degrees(torch.tensor([[0.0, 100.0]]), UTM)
    swapped = own.coordinates._replace(values=asked.flip(1), degrees=False)
    own.coordinates = swapped
    with refused("6787894 m from that of", "a.tif", UTM, "or lat,lon"):
        find_ground_truth("metres:5", grid, own, len(grid), 2)


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("demo:area?start=5", ("start=5", "rows=first:stop", "stride=")),
        ("demo:area?step=2", ("step=2", "rows=first:stop")),
        ("demo:area?crop=1,0,0,0", ("crop=1,0,0,0", "columns=first:stop")),
    ],
)
def test_parts_of_an_area_are_rows_and_columns(source, words):
    with refused(*words):
        open_source(source)
    area = open_source("demo:area?rows=10:100&columns=20:300&stride=16").area
    assert (area.rows, area.columns, area.first) == (2, 14, (52.0, 42.0))


def test_an_area_has_no_velocity(tmp_path, capsys):
    source = "demo:area?stride=32"
    told = fails(capsys, "learn", source, "--velocity", "--map", tmp_path / "map.safetensors")
    assert "is an area; expected a route" in told


# along a path


def test_windows_of_a_path_are_those_of_the_picture():
    picture = ground(120, 150)
    grid = Grid(picture, 40, 10)
    at = [3, 17, 60]
    points = grid.coordinates.values[at]
    torch.testing.assert_close(Flight(picture, points, window=40)[:], grid[at])
    for k in range(4):
        turned = Flight(picture, points, torch.full((3,), 90.0 * k), window=40)
        torch.testing.assert_close(turned[:], torch.rot90(grid[at], k, (2, 3)), rtol=0, atol=1e-5)
    between = Flight(picture, points + torch.tensor([0.5, 0.0]), window=40)[0]
    x, y = (int(one) for one in points[0] - 20)
    near = picture[:, y : y + 40, x : x + 41].float() / 255
    torch.testing.assert_close(between, (near[..., 1:] + near[..., :-1]) / 2, rtol=0, atol=1e-5)


def test_headings_are_those_of_the_map(geotiff, tmp_path):
    """In a picture that is turned by 90 degrees to the left of the map, north is to the right."""
    pixels = ground(120, 150)
    path = geotiff(pixels, turned=90.0)
    (tmp_path / "track.csv").write_text("x,y,heading\n500030,5300040,0\n")  # row 60, column 80
    flight = open_source(f"path:{path}?points={tmp_path}/track.csv&window=40")
    upright = pixels[:, 40:80, 60:100].float() / 255
    torch.testing.assert_close(flight[0], torch.rot90(upright, 1, (1, 2)), rtol=0, atol=1e-5)
    assert flight.coordinates.frame == UTM


def test_a_flight_over_a_later_picture_needs_no_truth(tmp_path):
    rows = [f"{x},{80 + 8 * math.sin(x / 60):.2f}" for x in range(40, 180, 5)]
    (tmp_path / "track.csv").write_text("\n".join(["x,y", *rows]))
    reference = f"grid:{ROAD}/flight_0.jpg?stride=5&columns=0:220&rows=40:120"
    query = f"path:{ROAD}/flight_1.jpg?points={tmp_path}/track.csv"
    model, flight = DejaVu(mapper=SpectralMapper(8.0)).learn(reference), open_source(query)
    assert flight.ordered
    found = model.map.area.coordinates(model.localize(flight).index)
    right = (found - flight.coordinates.values).norm(dim=1) <= 10
    assert float(right.double().mean()) > 0.8
    here, there = coordinates_of([open_source(reference), flight], "pixels")
    assert here.shape[1] == there.shape[1] == 2
    # rivals and controls fly over the area, too
    report = compare(
        reference, flight, model=model, tolerance=10, reporting=Reporting(drives="all")
    ).report.as_json()
    for rival in (report, report["uncompressed"], report["hog"]):
        for way in ("filter", "smoother"):
            assert rival["sequences"][way]["recall_at_1"] > 0.9
    with refused("is an input"):
        check_not_read(tmp_path / "track.csv", query)
    with refused("flight_1.jpg"):
        check_not_read(ROAD / "flight_1.jpg", query)


@pytest.mark.parametrize(
    ("options", "text", "words"),
    [
        ("", "", ("points is missing", "points=FILE")),
        (
            "?points={}",
            "x,y\n80,80\n80,20\n",
            ("track.csv, line 3", "x=80, y=20 leaves the picture", "2792 x 160"),
        ),
        ("?points={}&scale=.5", "x,y\n40,40\n1380,40\n", ("line 3", "1396 x 80")),
        ("?points={}&window=0", "x,y\n80,80\n", ("window=0",)),
        ("?points={}", "x,y,heading\n80,80,north\n", ("line 2: 80, 80, north", "expected numbers")),
        ("?points={}", "lat,lon\n80,80\n", ("columns lat, lon", "x,y")),
        ("?points={}", "x,y\n", ("the columns x, y",)),
        ("?points={}", "", ("track.csv has no rows",)),
        ("?points=nowhere.csv", "", ("nowhere.csv is not there",)),
        ("?points={}&stride=4", "x,y\n80,80\n", ("unknown 'stride'", "points, window, scale")),
    ],
)
def test_bad_paths_are_told_in_one_line(tmp_path, options, text, words):
    (tmp_path / "track.csv").write_text(text)
    with refused(*words):
        open_source(f"path:{ROAD}/flight_1.jpg{options.replace('{}', str(tmp_path / 'track.csv'))}")
