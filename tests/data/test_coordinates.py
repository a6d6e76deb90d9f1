"""Where frames were taken, from files: formats, names, times, and what does not fit."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import refused
from PIL import Image

from dejavu_torch import compare, open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.coordinates import coordinates_of, odometer_of, read_coordinates, read_odometer
from dejavu_torch.data.ground_truth import find_ground_truth
from dejavu_torch.data.source import check_not_read
from dejavu_torch.data.tables import read_table
from dejavu_torch.data.traverse import Chain, Part
from dejavu_torch.types import Coordinates

NAN = math.nan


def images(folder, *names):
    folder.mkdir()
    for name in names:
        Image.new("L", (12, 12)).save(folder / name)
    return folder


def values(text, traverse, tmp_path):
    (tmp_path / "where.csv").write_text(text)
    return read_coordinates(tmp_path / "where.csv", traverse)[0].values.tolist()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x,y\n1,2\n3,4\n", [[1, 2], [3, 4]]),
        ("x;y;z\n1,5;2;9\n3;4;8\n".replace("1,5", "1.5"), [[1.5, 2, 9], [3, 4, 8]]),
        ("id,Y,X\n0,1,2\n1,,4\n", [[2, 1], [4, NAN]]),
        ("1 0 0 10 0 1 0 20 0 0 1 30\n1 0 0 11 0 1 0 21 0 0 1 31\n", [[10, 20, 30], [11, 21, 31]]),  # KITTI
        ("lat,lon,alt\n48,11,500\n49,-12,501\n", [[48, 11], [49, -12]]),
    ],
)
def test_a_row_for_each_frame(text, expected, tmp_path):
    two = ArrayTraverse(torch.rand(2, 4), "two")
    np.testing.assert_array_equal(values(text, two, tmp_path), expected)


def test_rows_by_the_names_of_images(tmp_path, caplog):
    folder = images(tmp_path / "a", "1.png", "2.png", "3.png")
    found = values("name,x,y\n3.png,30,0\n1.png,10,0\nother.png,0,0\n", open_source(folder), tmp_path)
    np.testing.assert_array_equal(found, [[10, 0], [NAN, NAN], [30, 0]])
    assert "1 of 3 frames have no coordinates" in caplog.text
    with refused("no frame of", "names or times"):
        values("name,x,y\nother.png,0,0\n", open_source(folder), tmp_path)


@pytest.mark.parametrize(("unit", "sign"), [(1, " "), (10**9, ",")])  # TUM, EuRoC
def test_poses_with_times(unit, sign, tmp_path):
    """Poses every half second at 1 m/s, images a quarter of a second later, and one after the end."""
    first = 1403636579
    names = [
        f"{first + i + 0.25}" if unit == 1 else f"{first * unit + i * unit + unit // 4}" for i in (0, 1, 9)
    ]
    folder = images(tmp_path / "a", *(f"{name}.png" for name in names))
    rows = [
        sign.join(
            map(str, (first + i / 2 if unit == 1 else first * unit + i * unit // 2, i / 2, 2, 3, 0, 0, 0, 1))
        )
        for i in range(5)
    ]
    found = values("#timestamp, p_x, p_y\n" + "\n".join(rows), open_source(folder), tmp_path)
    np.testing.assert_allclose(found, [[0.25, 2, 3], [1.25, 2, 3], [NAN] * 3], atol=1e-6)


def test_rows_by_time(tmp_path):
    folder = images(tmp_path / "a", "100.25.png", "101.0.png", "102.0.png", "103.0.png", "105.png")
    found = values(
        "time,x,y\n100,7,2\n100.5,8,4\n101,9,6\n103,1,1\n104.5,2,2\n", open_source(folder), tmp_path
    )
    np.testing.assert_allclose(found, [[7.5, 3], [9, 6], [NAN, NAN], [1, 1], [NAN, NAN]])
    for text, words in (
        ("time,x,y\n2,0,0\n1,0,0\n", ("do not rise",)),
        ("time,x,y\nnoon,0,0\n", ("a row without a time",)),
    ):
        with refused(*words):
            values(text, open_source(folder), tmp_path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x,y\n1,2\n", ("1 rows", "2 frames", "name or time")),
        ("a,b\n1,2\n3,4\n", ("columns a, b", "lat,lon")),
        ("x,y\n", ("columns x, y",)),
        ("", ("no rows",)),
        ("1,2\n3,4\n", ("2 columns without a header",)),
        ("x,y\n1,2\n3\n", ("line 3", "1 columns")),
        ("lat,lon\n480000,11\n490000,12\n", ("latitudes beyond 90",)),
        ("x,y\n,\n,\n", ("columns x, y",)),
    ],
)
def test_what_is_refused(text, words, tmp_path):
    with refused(*words):
        values(text, ArrayTraverse(torch.rand(2, 4), "two"), tmp_path)


FIRST = 1305031102


@pytest.fixture(scope="module")
def counted(tmp_path_factory):
    return images(tmp_path_factory.mktemp("n") / "counted", *(f"{i:06}.png" for i in range(12)))


@pytest.fixture(scope="module")
def stamped(tmp_path_factory):
    return images(tmp_path_factory.mktemp("n") / "stamped", *(f"{FIRST + i / 4:.2f}.png" for i in range(12)))


def lines(form, count=12):
    return "\n".join(form(i) for i in range(count))


@pytest.mark.parametrize(
    "text",
    [
        "stamp,x,y\n" + lines(lambda i: f"{FIRST + i / 4},{i},0"),
        "timestamp_ns,x,y\n" + lines(lambda i: f"{FIRST * 10**9 + i * 250_000_000},{i},0"),
        "sec,nsec,x,y\n" + lines(lambda i: f"{FIRST + i // 4},{i % 4 * 250_000_000},{i},0"),
        "field.header.stamp,field.pose.position.x,field.pose.position.y\n"
        + lines(lambda i: f"{FIRST * 10**9 + i * 250_000_000},{i},0"),
        "time,x,y\n" + lines(lambda i: f"{FIRST + i / 4},{i},0\n{FIRST + i / 4},{i},0"),  # written twice
        "Time,header.stamp.secs,header.stamp.nsecs,x,y\n"
        + lines(lambda i: f"{FIRST + i / 4},{FIRST + i // 4},{i % 4 * 250_000_000},{i},0"),
        "name,x,y\n" + lines(lambda i: f"{FIRST + i / 4:.2f},{i},0"),  # no suffix
    ],
)
def test_times_by_any_name_and_unit(text, stamped, tmp_path):
    np.testing.assert_allclose(
        values(text, open_source(stamped), tmp_path), [[i, 0] for i in range(12)], atol=1e-5
    )


@pytest.mark.parametrize(
    "text",
    [
        "filename,x,y\n" + "\n".join(f"left/{i:06}.jpg,{i},0" for i in reversed(range(12))),
        "frame,x,y\n" + "\n".join(f"{i},{i},0" for i in reversed(range(12))),
        "t,x,y\n" + lines(lambda i: f"{i / 10},{i},0"),  # times of frames that have none: a row a frame
        "x [cm],y [cm]\n" + lines(lambda i: f"{100 * i},0"),
        "stamp,x,y\n" + lines(lambda i: f"2011-05-10T12:38:{i:02},{i},0"),
        "frame_id,x,y\n" + lines(lambda i: f"map,{i},0"),
        "easting,northing,altitude\n" + lines(lambda i: f"{i},0,{500 + i % 3}"),
    ],
)
def test_frames_by_name_or_number(text, counted, tmp_path):
    np.testing.assert_allclose(values(text, open_source(counted), tmp_path), [[i, 0] for i in range(12)])


@pytest.mark.parametrize(
    "text",
    [
        "image,x,y\n" + lines(lambda i: f"{i}.jpg,{i // 4},0"),
        "file,x,y\n" + lines(lambda i: f"drive.bag,{i // 4},0"),
        "t,x,y\n" + lines(lambda i: f"{i // 4},{i // 4},0"),  # a camera that stands, by a clock of seconds
    ],
)
def test_a_row_for_each_frame_that_has_no_name(text, tmp_path):
    found = values(text, ArrayTraverse(torch.rand(12, 4), "ready"), tmp_path)
    assert found == [[i // 4, 0] for i in range(12)]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "frame,x,y\n" + "\n".join(f"{i},{i},0" for i in range(1, 13)),
            ("1 beyond", "frame 12", "count from 1?"),
        ),
        ("frame,x,y\n" + lines(lambda i: f"{i},{i},0", 15), ("3 beyond", "frame 12 to 14", "0 to 11")),
        ("frame,x,y\n" + lines(lambda i: f"{min(i, 4)},{i},0"), ("frame 4 twice",)),
        ("frame,x,y\n" + lines(lambda i: f"{i / 2},{i},0"), ("line 3", "0.5", "whole number")),
        ("name,x,y\n" + lines(lambda i: f"{min(i, 4):06}.png,{i},0"), ("line 7", "000004.png", "line 6")),
        (
            "t,x,y\n" + lines(lambda i: f"{i / 10},{i},0", 30),
            ("no times within", "0 to 2.9 s", "a row a frame"),
        ),
        ("x,y\n" + lines(lambda i: f"{i},0", 15), ("15 rows", "12 frames")),
    ],
)
def test_rows_that_fit_no_frames_are_refused(text, words, counted, tmp_path):
    with refused(*words):
        values(text, open_source(counted), tmp_path)


def test_times_of_another_clock_or_of_few_digits_are_refused(stamped, tmp_path):
    with refused("0 to 2.75 s", "1305031102 to 1305031104.75 s", "one clock"):
        values("time,x,y\n" + lines(lambda i: f"{i / 4},{i},0"), open_source(stamped), tmp_path)
    with refused("10 times twice", "lines 2 and 3 both have 1305031040 s", "more digits"):
        rounded = [float(np.float32(FIRST + i / 4)) for i in range(12)]
        values("time,x,y\n" + lines(lambda i: f"{rounded[i]:.1f},{i},0"), open_source(stamped), tmp_path)


def test_what_is_not_used_and_what_is_no_fix_are_told(counted, tmp_path, caplog):
    text = "lat,lon,alt,sats\n" + lines(lambda i: f"{48 + 1e-5 * i},11,500,7" if i > 3 else "0,0,0,0")
    found = values(text, open_source(counted), tmp_path)
    assert [row[0] for row in found][4:] == [48 + 1e-5 * i for i in range(4, 12)]
    assert np.isnan(found[:4]).all()
    assert "the columns alt, sats are not used" in caplog.text
    assert "4 fixes at 0, 0" in caplog.text
    assert "4 of 12 frames have no coordinates" in caplog.text


def test_longitudes_between_rows_across_180_degrees(stamped, tmp_path):
    text = "time,lat,lon\n" + "\n".join(
        f"{FIRST + i},-17,{(179.9995 + i * 1e-3 + 180) % 360 - 180}" for i in range(4)
    )
    found = np.array(values(text, open_source(stamped), tmp_path))[:, 1] % 360
    np.testing.assert_allclose(found, 179.9995 + 2.5e-4 * np.arange(12), atol=1e-7)


def test_heights_are_compared_only_if_both_visits_have_them(tmp_path, caplog):
    """Poses of KITTI have the height in the second of three numbers, and down."""
    three = ArrayTraverse(torch.rand(3, 4), "poses")
    two = ArrayTraverse(torch.rand(3, 4), "gps")
    (tmp_path / "p.txt").write_text("\n".join(f"1 0 0 {i} 0 1 0 -7 0 0 1 {10 * i} " for i in range(3)))
    (tmp_path / "g.csv").write_text("x,y\n" + "\n".join(f"{i},{10 * i}" for i in range(3)))
    three.coordinates, *_ = read_coordinates(tmp_path / "p.txt", three)
    two.coordinates, *_ = read_coordinates(tmp_path / "g.csv", two)
    one, other = coordinates_of([three, two], "metres")
    assert one.tolist() == other.tolist() == [[0, 0], [1, 10], [2, 20]]
    assert "gps has coordinates of two numbers" in caplog.text
    one, other = coordinates_of([three, three], "metres")
    assert one[1].tolist() == [1, 10, -7]  # the height last
    (tmp_path / "g.csv").write_text("x,y,z\n" + "\n".join(f"{i},{10 * i},7" for i in range(3)))
    two.coordinates, *_ = read_coordinates(tmp_path / "g.csv", two)
    one, other = coordinates_of([three, two], "metres")
    assert one.tolist() == other.tolist() == [[0, 0], [1, 10], [2, 20]]
    assert "poses has coordinates of another axis for heights" in caplog.text


def test_parts_and_chains_keep_coordinates(tmp_path):
    (tmp_path / "w.csv").write_text("x,y\n" + "\n".join(f"{i},0" for i in range(9)))
    np.save(tmp_path / "f.npy", np.random.default_rng(0).random((9, 5), np.float32))
    whole = open_source(f"{tmp_path}/f.npy?coordinates={tmp_path}/w.csv")
    part = open_source(f"{tmp_path}/f.npy?coordinates={tmp_path}/w.csv&start=3&step=2")
    assert part.coordinates is not None
    assert part.coordinates.values[:, 0].tolist() == [3, 5, 7]
    both = Chain([whole, Part(whole, range(2))]).coordinates
    assert both is not None
    assert both.values[:, 0].tolist() == [*range(9), 0, 1]
    plain = open_source(f"{tmp_path}/f.npy")
    assert Chain([whole, plain]).coordinates is None
    with refused("has coordinates and", "none", "coordinates=FILE"):
        coordinates_of([whole, plain], "metres")
    truth = find_ground_truth("metres:1", whole, part, 9, 3)
    assert truth is not None
    assert truth.positives.tolist() == [[2, 3, 4], [4, 5, 6], [6, 7, 8]]


def test_a_file_of_coordinates_is_never_an_output(tmp_path):
    for name in ("coordinates", "mask"):
        with refused("w.csv is an input"):
            check_not_read(tmp_path / "w.csv", f"{tmp_path}/a?start=3&{name}={tmp_path}/w.csv")


def test_a_report_tells_errors_in_metres(tmp_path):
    """Each query shows the place 1 m beside it: all errors are 1 m."""
    rows = torch.nn.functional.normalize(torch.randn(60, 8), dim=1)
    reference, query = ArrayTraverse(rows, "one"), ArrayTraverse(rows.clone(), "two")
    for traverse, y in ((reference, 0), (query, 1)):
        (tmp_path / "w.csv").write_text("x,y\n" + "\n".join(f"{10 * i},{y}" for i in range(60)))
        traverse.coordinates, *_ = read_coordinates(tmp_path / "w.csv", traverse)
    facts = compare(reference, query, "metres:2", tolerance=0).report.facts
    assert facts["error_metres"]["all"] == {"0.5": 1.0, "0.9": 1.0, "0.99": 1.0}


def odometer(text, traverse, tmp_path):
    (tmp_path / "moved.csv").write_text(text)
    return read_odometer(read_table(tmp_path / "moved.csv", "moves"), traverse)


@pytest.mark.parametrize(
    ("text", "moves", "metres"),
    [
        ("moved\nfirst\n1.5\n0\n", [[0, NAN], [1.5, NAN], [0, NAN]], False),
        ("moved [m]\n0\n1.5\n0\n", [[0, NAN], [1.5, NAN], [0, NAN]], True),
        ("frame,moved\n0,7\n1,1\n2,2\n", [[0, NAN], [1, NAN], [2, NAN]], False),
        ("moved_m,moved_spread\n9,9\n1,.5\n2,0\n", [[0, 0], [1, 0.5], [2, 0]], True),
        ("moved_spread [cm],moved [cm]\n1,1\n50,100\n30,200\n", [[0, 0], [1, 0.5], [2, 0.3]], True),
    ],
)
def test_what_an_odometer_tells_of_each_frame(text, moves, metres, tmp_path):
    read = odometer(text, ArrayTraverse(torch.rand(3, 4), "three"), tmp_path)
    np.testing.assert_allclose(read.moves, moves)
    assert read.metres == metres


def test_an_odometer_with_a_clock_or_names_of_its_own(tmp_path):
    """Its rows add up, between two of them evenly: the images are at 1, 1.5 and 2.75 s."""
    folder = images(tmp_path / "a", "1.0.png", "1.5.png", "2.75.png")
    text = "time,moved,moved_spread\n.5,8,8\n1.0,1,1\n1.5,2,3\n2,4,4\n2.5,8,0\n3,2,0\n"
    read = odometer(text, open_source(folder), tmp_path)
    np.testing.assert_allclose(read.moves, [[0, 0], [2, 3], [13, 4]])
    named = odometer(
        "name,moved\n1.0.png,1\nlost.png,2\n1.5.png,3\n2.75.png,4\n", open_source(folder), tmp_path
    )
    assert named.moves[:, 0].tolist() == [0, 5, 4]


def test_a_column_of_coordinates_is_cut_with_the_frames(tmp_path, caplog):
    np.save(tmp_path / "six.npy", np.random.default_rng(0).random((6, 4), np.float32))
    rows = [f"{i},0,{i},{i}" for i in range(6)]
    (tmp_path / "where.csv").write_text("\n".join(["x,y,moved_m,moved_spread", *rows]))
    source = f"{tmp_path / 'six.npy'}?coordinates={tmp_path / 'where.csv'}"
    assert open_source(source).odometer.moves[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
    some = open_source(f"{source}&start=1&step=2").odometer
    np.testing.assert_allclose(some.moves, [[0, 0], [5, 13**0.5], [9, 41**0.5]])
    assert some.metres
    assert "not used" not in caplog.text
    assert caplog.text.count("the column moved is read as odometry") == 2
    (tmp_path / "where.csv").write_text("x,y,moved\n" + "0,0,1\n" * 5 + "0,0,yes\n")
    assert open_source(source).odometer is None
    assert "the column moved is not used" in caplog.text
    assert caplog.text.count("the column moved is read") == 2
    assert "line 7: moved is 'yes'" in caplog.text


def test_coordinates_tell_what_an_odometer_would_read():
    traverse = ArrayTraverse(torch.rand(7, 4), "seven")
    places = [[NAN, NAN], [0, 0], [3, 4], [NAN, NAN], [3, 10], [3, 10], [NAN, NAN]]
    traverse.coordinates = Coordinates(torch.tensor(places).double())
    read = odometer_of(traverse)
    np.testing.assert_allclose(read.values[:, 0], [-2.75, 0, 5, 8, 11, 11, 13.75])
    with refused("has no coordinates of its frames"):
        odometer_of(traverse.changed(coordinates=Coordinates(torch.full((7, 2), NAN).double())))
    assert read.metres
    degrees = torch.tensor([[48.0, 11.0], [48.001, 11.0]]).double()
    two = ArrayTraverse(torch.rand(2, 4), "two")
    two.coordinates = Coordinates(degrees, degrees=True)
    assert float(odometer_of(two).moves[1, 0]) == pytest.approx(111.2, abs=0.1)
    for other in (None, Coordinates(degrees, frame="pixels")):
        two.coordinates = other
        with refused("two without coordinates", "metres or degrees"):
            odometer_of(two)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", ["columns", "a column moved"]),
        ("x,y\n1,2\n", ["columns x, y", "a column moved"]),
        ("moved [px]\n1\n", ["columns moved[px]", "a column moved"]),
        ("moved\n", ["0 rows", "a column moved"]),
        ("moved\n1\nfar\n", ["line 3", "'far'", "a number"]),
        ("moved\n1\n-2\n", ["line 3", "'-2'", "at least 0"]),
        ("frame,moved\n1,\n2\n", ["line 3", "''", "a number"]),
        ("moved,moved_spread\n1,1\n2,\n", ["line 3", "moved_spread is ''", "a number"]),
        ("moved,moved_spread_m\n1,1\n2,1\n", ["moved and moved_spread_m", "one unit"]),
        ("moved\n1\n2\n3\n", ["3 rows, two 2 frames", "as many"]),
    ],
)
def test_what_is_no_odometer_is_refused(text, told, tmp_path):
    with refused(*told):
        odometer(text, ArrayTraverse(torch.rand(2, 4), "two"), tmp_path)
