"""The ground truth: offset, positions, csv, npz, coordinates in image names; and what counts as right."""

from __future__ import annotations

import io
import json
import zipfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import memory
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import (
    GroundTruth,
    are_aligned,
    check_ground_truth,
    counted,
    find_ground_truth,
    ground_truth_in_places,
    is_right,
    merely_count,
    near_truth,
    offset_truth,
    padded,
    position_truth,
)
from dejavu_torch.data.strip import SlidingWindow
from dejavu_torch.data.traverse import frame_range
from dejavu_torch.places.positions import look_up
from dejavu_torch.types import Coordinates

POSITIONS = st.lists(st.integers(-20, 20), min_size=1, max_size=12)


def column(truth):
    assert (truth.ndim, truth.shape[1], truth.dtype) == (2, 1, torch.int64)
    return truth[:, 0].tolist()


@given(
    st.lists(st.integers(0, 30), min_size=1, max_size=9), st.none() | st.integers(1, 30), st.integers(-40, 40)
)
def test_offset(numbers, frames, offset):
    end = 100 if frames is None else frames  # of a map of unknown length
    expected = [i + offset if 0 <= i + offset < end else -1 for i in numbers]
    assert column(offset_truth(torch.tensor(numbers), frames, offset)) == expected


@given(POSITIONS, POSITIONS)
def test_position_is_the_nearest_reference_frame(reference, query):
    found = column(position_truth(torch.tensor(reference).double(), torch.tensor(query).double()))
    ordered = sorted(reference)
    widest = max((b - a for a, b in pairwise(ordered)), default=0)
    for place, position in zip(found, query, strict=True):
        nearest = min(abs(position - r) for r in reference)
        if nearest > widest:
            assert place == -1
        else:
            assert abs(reference[place] - position) == nearest


def test_convention_5_tolerance_is_inclusive():
    index = torch.tensor([4, 5, 10, 15, 16])
    assert is_right(index, torch.full((5, 1), 10), 5).tolist() == [False, True, True, True, False]
    assert is_right(index, torch.full((5, 1), 10), 0).tolist() == [False, False, True, False, False]
    for largest in (2**53, 2**63, 10**30):
        assert is_right(index[:2], torch.tensor([[10**6], [-1]]), largest).tolist() == [True, False]


ANSWERS = st.lists(
    st.tuples(st.integers(-1, 9), st.lists(st.integers(-1, 9), min_size=3, max_size=3)), min_size=1
)


@given(ANSWERS, st.integers(0, 4))
def test_any_right_place_will_do_and_minus_one_is_none(rows, tolerance):
    expected = [i >= 0 and any(t >= 0 and abs(i - t) <= tolerance for t in truth) for i, truth in rows]
    index, truth = torch.tensor([i for i, _ in rows]), torch.tensor([t for _, t in rows])
    assert is_right(index, truth, tolerance).tolist() == expected


@given(st.lists(st.lists(st.integers(0, 9), max_size=4), min_size=1, max_size=8))
def test_padded_holds_each_row_in_order(rows):
    table = padded(torch.tensor(places, dtype=torch.int64) for places in rows)
    assert table.dtype == torch.int64
    assert table.shape == (len(rows), max(map(len, rows)))
    assert [[p for p in line if p >= 0] for line in table.tolist()] == rows
    # the padding stands behind the places
    assert [line[: len(places)] for line, places in zip(table.tolist(), rows, strict=True)] == rows


POINTS = st.lists(st.tuples(st.integers(-6, 6), st.integers(-6, 6)), min_size=1, max_size=12)


@given(POINTS, POINTS, st.integers(0, 6))
def test_near_is_every_frame_within_the_radius_inclusive(reference, query, radius):
    # UTM coordinates are large: float32 would not hold their metres
    far = torch.tensor([500_000, 5_000_000], dtype=torch.float64)
    found = near_truth(torch.tensor(reference) + far, torch.tensor(query) + far, radius)
    expected = [
        [i for i, (a, b) in enumerate(reference) if (a - x) ** 2 + (b - y) ** 2 <= radius**2]
        for x, y in query
    ]
    assert [[place for place in row if place >= 0] for row in found.tolist()] == expected


def test_a_soft_place_counts_neither_way_and_an_unknown_query_never():
    """Right, wrong, soft, silent, soft but right by the tolerance, not known, not known though right."""
    index = torch.tensor([10, 30, 20, -1, 11, 30, 10])
    known = torch.tensor([True] * 5 + [False] * 2)
    truth = GroundTruth(torch.full((7, 1), 10), known, torch.tensor([[20, 11]] * 7))
    assert counted(index, truth, 1).tolist() == [True, True, False, True, True, False, False]
    assert counted(index, truth, 0).tolist() == [True, True, False, True, False, False, False]


def route(length, place=None):
    traverse = ArrayTraverse(torch.rand(length, 2))
    traverse.places = None if place is None else torch.tensor(place, dtype=torch.float64)
    return traverse


def known(*arguments, **options):
    found = find_ground_truth(*arguments, **options)
    assert found is not None
    return found


def read(truth, frames, queries, **options):
    return known(truth, None, None, frames, queries, **options)


def sets(table):
    assert table.dtype == torch.int64
    return [{place for place in row if place >= 0} for row in table.tolist()]


def written(folder, text):
    path = folder / "truth.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return str(path)


# offsets and what traverses carry


@pytest.mark.parametrize(
    ("truth", "reference", "query", "expected"),
    [
        ("+1", route(3), route(2), [1, 2]),
        (None, route(3, [0, 1, 2]), route(2, [2, 1]), [2, 1]),
        ("1", route(3, [0, 1, 2]), route(3, [2, 1, 0]), [1, 2, -1]),
        ("-8", None, route(9), [-1] * 8 + [0]),
        (None, route(3), route(4), None),
        (None, None, route(3), None),
        (None, route(3), None, None),
    ],
)
def test_what_a_command_was_given_or_can_know(truth, reference, query, expected):
    queries = len(query) if query is not None else None
    found = find_ground_truth(truth, reference, query, reference and len(reference), queries or 3)
    assert (found is None) == (expected is None)
    if found is not None:
        assert found.positives[:, 0].tolist() == expected
        assert found.judged.all()


def test_an_offset_beyond_every_frame_is_refused():
    with refused("truth 9", "from -3 to 4"):
        find_ground_truth("9", route(5), route(4), 5, 4)
    with refused("truth -9", "from -8"):
        find_ground_truth("-9", None, route(9), None, 9)


class Named(ArrayTraverse):
    """Frames with names, and with times where `timed`."""

    def __init__(self, names: list[str], timed: bool = False) -> None:
        super().__init__(torch.rand(len(names), 2))
        self.names, self.times = names, torch.arange(len(names)).double() if timed else None


def strip(pixels, width=8, **part):
    window = SlidingWindow(torch.rand(1, 8, pixels), width)
    return frame_range(window, **part) if part else window


ABC, TIMES = list("abc"), ["0:00.0", "0:00.5", "0:01.0"]


@pytest.mark.parametrize(
    ("reference", "query", "says"),
    [
        (Named(ABC), Named(ABC), True),
        (frame_range(Named([*"xabc"]), 1), Named(ABC), True),
        (route(3), route(3), False),
        (Named(ABC), Named(["b", "a", "c"]), False),
        (Named(["a", "b", ""]), Named(["a", "b", ""]), False),
        (Named(["a"] * 3), Named(["a"] * 3), False),
        (Named(TIMES, timed=True), Named(TIMES, timed=True), False),
        (strip(20), strip(20), True),
        (strip(20), strip(22, 10), False),  # as many frames, of other windows
        (strip(20, start=3), strip(20, start=3), True),
        (strip(20, start=3, stop=6), strip(20, start=4, stop=7), False),
        (strip(20, step=2), strip(20, stop=7), False),
        (strip(10), route(3), False),
        (route(3), strip(10), False),
    ],
)
def test_as_many_frames_are_the_same_places_where_they_say_so(reference, query, says):
    frames, queries = len(reference), len(query)
    assert queries == frames
    found = find_ground_truth(None, reference, query, frames, queries)
    assert found is None if not says else found.positives[:, 0].tolist() == list(range(frames))


def at(points, frame=""):
    traverse = route(3)
    traverse.coordinates = Coordinates(torch.tensor(points, dtype=torch.float64), frame=frame)
    return traverse


COUNTERS = (
    *(["00001.png", "00002.png", "00003.png"], ["1.jpg", "10.jpg", "19.jpg"], ["a-9", "a-8", "a-7"]),
    *(["day3_0-of-9", "day3_3-of-9", "day3_6-of-9"], ["0.0", "0.5", "1.0"], ["1", "3", "2"]),
)
STAMPS = (["17.03.png", "17.10.png", "17.14.png"], ["1.png", "2.png", "4.png"], ["gate", "hall", "yard"])
STAMPS += (["a1.png", "b2.png", "c3.png"], ["1_5", "2_6", "3_9"])


@pytest.mark.parametrize(("names", "count"), [*((c, True) for c in COUNTERS), *((s, False) for s in STAMPS)])
def test_names_that_merely_count_align_no_visit_that_teaches(names, count, caplog):
    pair = Named(names), Named(names)
    assert merely_count(names) == count
    assert are_aligned(*pair)
    assert are_aligned(*pair, counters=False) == (not count)
    found = find_ground_truth(None, *pair, 3, 3, counters=False)
    assert (found is None) == count
    assert not caplog.records
    assert known(None, *pair, 3, 3).positives[:, 0].tolist() == [0, 1, 2]
    assert ("count their frames alike" in caplog.text) == count


def test_counters_with_a_carry_or_a_gap_are_no_proof():
    """Of minutes and seconds, of two folders, and with one frame left out; times of a camera are one."""
    carried = [f"{i // 60:02}-{i % 60:02}.png" for i in range(20, 120)]
    folders = [f"{part}/{i:04}.png" for part in "ab" for i in range(50)]
    assert merely_count(carried)
    assert merely_count(folders)
    assert merely_count([f"{i}.png" for i in range(60) if i != 20])
    stamps = torch.rand(100, generator=torch.Generator().manual_seed(0)).cumsum(0)
    assert not merely_count([f"{stamp:.3f}.png" for stamp in stamps.tolist()])
    assert not merely_count([f"room {name}" for name in "abcdefghijklm"])


def test_equal_coordinates_align_two_visits():
    points = [[0.0, 1], [2, 3], [4, 5]]
    assert are_aligned(at(points), at(points), counters=False)
    assert not are_aligned(at(points), at([*points[:2], [4, 6]]))
    assert not are_aligned(at(points, "EPSG:32632"), at(points, "pixels"))
    assert not are_aligned(at(points), route(3))


def test_numbered_queries_get_their_own_rows():
    numbers = torch.tensor([3, 0])
    by_offset = known("2", None, None, None, numbers)
    by_position = known(None, route(3, [0, 1, 2]), route(4, [2, 9, 9, 1]), 3, numbers)
    by_name = known(None, Named([*"abcd"]), Named([*"abcd"]), 4, numbers)
    for found, expected in ((by_offset, [5, 2]), (by_position, [1, 2]), (by_name, [3, 0])):
        assert found.positives[:, 0].tolist() == expected
    with refused("query 3", "below 3"):
        find_ground_truth(None, route(3, [0, 1, 2]), route(3, [0, 1, 2]), 3, numbers)


# any text

NO_TRUTH = ["x", "", "1.5", "utm:", "utm:far", "utm:-1", "utm:nan", "utm2", "9" * 30, "truth.txt", "nan"]


@pytest.mark.parametrize(
    ("truth", "options", "words"),
    [
        *((text, {}, (f"truth {text!r}", "an integer offset", "utm:25")) for text in NO_TRUTH),
        *((name, {}, (name, "is not there")) for name in ("none.csv", "none.npz", "none.CSV", "none.json")),
        *(
            (text, {"interpolate": True}, (text, "interpolated", ".csv"))
            for text in ("3", "utm:7.5", "a.json")
        ),
        ("folder.csv", {}, ("folder.csv", "is a folder")),
    ],
)
def test_what_is_no_truth_is_refused_early(truth, options, words, scratch, monkeypatch):
    (scratch / "folder.csv").mkdir(exist_ok=True)
    monkeypatch.chdir(scratch)
    with refused(*words):
        check_ground_truth(truth, **options)


# csv

LISTED = st.dictionaries(st.integers(0, 12), st.lists(st.integers(0, 9), max_size=3), min_size=1, max_size=9)
TABLE = "query,place...\n0,4\n2,1,7\n3\n5,-1\n"


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    return tmp_path_factory.mktemp("truth")


@given(LISTED, st.booleans(), st.lists(st.integers(0, 20), min_size=1, max_size=9, unique=True))
def test_csv_holds_what_was_written(scratch, listed, header, numbers):
    lines = [",".join(map(str, [query, *places])) for query, places in listed.items()]
    path = written(scratch, "\n".join(["query,place", *lines] if header else lines))
    wanted = [set(listed.get(query, [])) for query in numbers]
    if not any(query in listed for query in numbers) or not any(wanted):
        with refused("expected some" if not any(query in listed for query in numbers) else "no query"):
            read(path, 10, torch.tensor(numbers))
        return
    truth = read(path, 10, torch.tensor(numbers))
    assert sets(truth.positives) == wanted
    assert truth.judged.tolist() == [query in listed for query in numbers]
    assert truth.positives.shape[1] == max(len(listed.get(query, [])) for query in numbers)


@pytest.mark.parametrize(
    "text",
    [
        TABLE,
        TABLE.replace("\n", "\r\n"),
        "\ufeff" + TABLE,
        TABLE.replace("\n", "\n\n") + "\n , ,\n",
        TABLE.replace(",", ";"),
        TABLE.replace(",", "\t"),
        TABLE.replace(",", " "),
        TABLE.replace("4", "4.0").replace("\n5", "\n5.0"),
        TABLE.replace("0,4", "0,4,,,").replace("\n3", "\n3,,,"),
        TABLE.split("\n", 1)[1],
        '"query","place"\n"0","4"\n"2","1","7"\n"3"\n"5","-1"\n',
        "3\n5\n2,1,7\n0,4",
    ],
)
def test_csv_is_read_leniently(tmp_path, text):
    truth = read(written(tmp_path, text), 8, 7)
    assert sets(truth.positives) == [{4}, set(), {1, 7}, set(), set(), set(), set()]
    assert truth.judged.tolist() == [True, False, True, True, False, True, False]
    assert truth.ignored.shape == (7, 0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("query,place\n0,1\n1,x\n", ("line 3", "'x'", "expected")),
        ("0,1\n\n1,nan\n", ("line 3", "'nan'")),
        ("query;place\n0;1,5\n", ("line 2", "'1,5'")),
        ("0,1\n2,1\n0,3\n", ("line 3", "query 0", "twice")),
        ("0,1\n-1,1\n", ("line 2", "query is '-1'")),
        ("0,1\n1,8\n", ("line 2", "place 8", "0 to 7")),
        ("0,1\n1,-2\n", ("line 2", "place -2", "-1 for none")),
        ("0,1\n1,2.5\n", ("line 2", "place 2.5", "whole", "interpolation")),
        (",query,place\n0,0,1\n", ("line 1", ",query,place", "expected query,place")),
        ("place,query\n0,1\n", ("line 1", "place,query")),
        ("query,place,distance_m\n0,1,2\n", ("line 1", "distance_m", "expected query,place[,place...]")),
        ("0,,5\n", ("line 1", "''")),
        ("", ("lists no query",)),
        ("7,1\n9,1\n", ("7 to 9", "0 to 6")),
        ("0,-1\n1\n", ("no query has a right answer",)),
        (b"\x89PNG\r\n\x1a\n", ("UTF-8", "query,place")),
        # with interpolation
        ("0,1\n1,2,3\n", ("line 2", "2 places", "one")),
        ("0,1\n1,-1\n", ("line 2", "0 places")),
        ("0,1\n1,7.5\n", ("line 2", "place 7.5", "0 to 7")),
    ],
)
def test_a_csv_that_is_none_is_refused(tmp_path, text, words):
    interpolate = any(word in words for word in ("2 places", "0 places", "place 7.5"))
    with refused("truth.csv", *words):
        read(written(tmp_path, text), 8, 7, interpolate=interpolate)


@given(st.dictionaries(st.integers(0, 30), st.integers(0, 60), min_size=1, max_size=6))
def test_interpolation_is_a_straight_line_between_neighbours_and_nothing_beyond(scratch, listed):
    path = written(scratch, "".join(f"{query},{place}\n" for query, place in listed.items()))
    truth = read(path, 61, 34, interpolate=True)
    expected = dict(listed)
    for a, b in pairwise(sorted(listed)):
        expected |= {q: listed[a] + (listed[b] - listed[a]) * (q - a) / (b - a) for q in range(a, b)}
    assert truth.judged.tolist() == [query in expected for query in range(34)]
    for query, found in enumerate(sets(truth.positives)):
        assert len(found) == (query in expected)
        assert all(abs(place - expected[query]) <= 0.5 + 1e-9 for place in found)
    assert all(sets(truth.positives)[query] == {place} for query, place in listed.items())


# npz

MATRIX = st.integers(1, 6).flatmap(
    lambda places: st.integers(1, 6).flatmap(
        lambda queries: st.lists(
            st.lists(st.sampled_from(["hard", "soft", "both", ""]), min_size=queries, max_size=queries),
            min_size=places,
            max_size=places,
        )
    )
)


def saved(folder, **arrays):
    path = folder / "truth.npz"
    np.savez(path, **arrays)
    return str(path)


@given(MATRIX, st.sampled_from([bool, np.uint8, np.float64]))
def test_npz_rows_are_places_and_columns_queries(scratch, cells, dtype):
    hard = np.array([[cell in ("hard", "both") for cell in row] for row in cells])
    soft = np.array([[cell in ("soft", "both") for cell in row] for row in cells])
    places, queries = hard.shape
    path = saved(scratch, GThard=hard.astype(dtype), GTsoft=soft.astype(dtype), other=np.zeros(3))
    if not hard.any():
        with refused("no query has a right answer"):
            read(path, places, queries)
        return
    truth = read(path, places, queries)
    assert sets(truth.positives) == [{i for i in range(places) if hard[i, q]} for q in range(queries)]
    # what is right is not soft
    assert sets(truth.ignored) == [
        {i for i in range(places) if cells[i][q] == "soft"} for q in range(queries)
    ]
    assert truth.judged.all()
    turned = read(path, places, torch.arange(queries).flip(0))
    assert sets(turned.positives) == sets(truth.positives)[::-1]
    assert sets(turned.ignored) == sets(truth.ignored)[::-1]


def test_npz_with_one_matrix_only(tmp_path):
    matrix = np.array([[True, False], [True, False], [False, True]])
    for name in ("GThard", "GTsoft"):
        truth = read(saved(tmp_path, **{name: matrix}), 3, 2)
        assert sets(truth.positives) == [{0, 1}, {2}]
        assert truth.ignored.shape == (2, 0)


SQUARE, SOME = np.eye(3, dtype=bool), torch.tensor([0, 2])


@pytest.mark.parametrize(
    ("hard", "places", "queries", "words"),
    [
        (np.ones((3, 2)), 2, 3, ("(3, 2)", "(2, 3)", "its transpose fits")),
        (np.ones((3, 5)), None, SOME, ("(3, 5)", "(reference frames, 3)")),
        (np.ones((3, 2)), None, SOME, ("its transpose fits",)),
        (np.ones((4, 4)), 3, 4, ("(4, 4)", "(3, 4)")),
        (np.ones((3, 6)), 3, 5, ("(3, 6)", "(3, 5)")),
        (np.ones(3), 3, 1, ("(3,)", "one column per query")),
        (np.array([["1"]]), 1, 1, ("<U1",)),
        (np.array([[{}]], dtype=object), 1, 1, ("object",)),
        (np.full((3, 3), np.nan), 3, 3, ("not finite",)),
    ],
)
def test_a_matrix_that_does_not_fit_is_refused(tmp_path, hard, places, queries, words):
    with refused("truth.npz", "GThard", *words):
        read(saved(tmp_path, GThard=hard), places, queries)


def test_other_npz_files_are_refused(tmp_path):
    with refused("truth.npz", "contains gt, S", "GThard"):
        read(saved(tmp_path, gt=SQUARE, S=SQUARE), 3, 3)
    with refused("differ in shape"):
        read(saved(tmp_path, GThard=SQUARE, GTsoft=np.ones((2, 3))), None, 3)
    path = Path(saved(tmp_path, GThard=SQUARE))
    whole, single = path.read_bytes(), io.BytesIO()
    np.save(single, SQUARE)
    for data in (whole[: len(whole) // 2], b"", b"query,place\n", single.getvalue()):
        path.write_bytes(data)
        with refused("truth.npz", "not a complete .npz", "GThard"):
            read(str(path), 3, 3)


# coordinates in image names


def images(*points):
    return Named([f"{i:03}@{east:.2f}@{north:.2f}@33@T@@@.png" for i, (east, north) in enumerate(points)])


# a list for each query


def listed(folder, rows):
    path = folder / "truth.json"
    path.write_text(rows if isinstance(rows, str) else json.dumps(rows))
    return str(path)


@given(st.lists(st.lists(st.integers(0, 9), max_size=4), min_size=1, max_size=9).filter(any))
def test_json_lists_all_right_places_of_each_query(scratch, rows):
    path = listed(scratch, rows)
    for frames in (10, None):
        truth = read(path, frames, len(rows))
        assert sets(truth.positives) == [set(row) for row in rows]
        assert truth.judged.all()
        assert truth.ignored.numel() == 0
    last = max(query for query, row in enumerate(rows) if row)
    some = torch.tensor([last, 0])  # in any order
    assert sets(read(path, 10, some).positives) == [set(rows[last]), set(rows[0])]


@pytest.mark.parametrize(
    ("rows", "queries", "words"),
    [
        ("[[1], [2]", 2, ("is not JSON",)),
        ({"0": [1]}, 1, ("contains a dict", "expected a list")),
        (3, 1, ("contains a int", "expected a list")),
        ([[1], [2]], 3, ("contains a list of 2", "3 queries")),
        ([[1], [2]], 1, ("contains a list of 2", "1 queries")),
        ([[1], [2]], torch.tensor([0, 2]), ("contains a list of 2", "3 queries or more")),
        ([1, 2], 2, ("query 0: 1;", "expected a list")),
        ([[1], [2, "3"]], 2, ('query 1: "3"', "from 0 to 9")),
        ([[1], [2.0]], 2, ("query 1: 2.0", "from 0 to 9")),
        ([[1], [True]], 2, ("query 1: true", "from 0 to 9")),
        ([[1], [[2]]], 2, ("query 1: [2]", "from 0 to 9")),
        ([[1], [10]], 2, ("query 1: 10", "from 0 to 9")),
        ([[-1], [1]], 2, ("query 0: -1", "from 0 to 9")),
        ([[], []], 2, ("no query has a right answer", "truth.json")),
    ],
)
def test_a_json_of_another_shape_is_refused(tmp_path, rows, queries, words):
    with refused("truth.json", *words):
        read(listed(tmp_path, rows), 10, queries)


def test_utm_makes_every_reference_frame_near_by_right():
    reference = images(*((500_000 + 10 * i, 4_000_000) for i in range(8)))
    query = images((500_030, 4_000_000), (500_000, 4_000_025), (500_000, 4_000_026))
    expected = [{1, 2, 3, 4, 5}, {0}, set()]
    for text in ("utm", "utm:25"):
        truth = known(text, reference, query, 8, 3)
        assert sets(truth.positives) == expected
        assert truth.judged.all()
    near = known("utm:10", reference, query, 8, torch.tensor([2, 0]))
    assert sets(near.positives) == [set(), {2, 3, 4}]
    with refused("no query has a right answer", "within 1 m"):
        find_ground_truth("utm:1", reference, query, 8, torch.tensor([2, 1]))


def test_utm_needs_two_folders_of_images_with_coordinates():
    good = images((500_001, 2))
    for name in ("1.png", "@1@.png", "@x@3@.png"):
        with refused(name, "no coordinates", "@easting@northing@"):
            find_ground_truth("utm", good, Named([name]), 1, 1)
    with refused("no image names", "a folder of images"):
        find_ground_truth("utm", route(1), good, 1, 1)
    for query in (good, None):
        with refused("truth utm", "reference and query"):
            find_ground_truth("utm", None, query, 1, 1)
    with refused("query 1", "below 1"):
        find_ground_truth("utm", good, good, 1, torch.tensor([1]))


def test_degrees_are_no_metres_of_utm():
    degrees = named((48.137, 11.575), (48.1371, 11.575), (48.2, 11.6))
    for text in ("utm", "utm:25"):
        with refused("48.137, 11.575 look like degrees", "degrees:25 (lat, lon) or metres:25"):
            find_ground_truth(text, degrees, degrees, 3, 3)
    assert sets(known("degrees:25", degrees, degrees, 3, 3).positives) == [{0, 1}, {0, 1}, {2}]
    assert sets(known("degrees:11", degrees, degrees, 3, 3).positives) == [{0}, {1}, {2}]  # 11.1 m apart
    assert sets(known("metres:1", degrees, degrees, 3, 3).positives) == [{0, 1, 2}] * 3
    east = named((0, 179.9999), (0, -179.9999))
    assert sets(known("degrees:25", east, east, 2, 2).positives) == [{0, 1}] * 2  # 22.3 m
    with refused("500000, 4e+06 are no degrees", "utm:25"):
        find_ground_truth("degrees", images((500_000, 4_000_000)), degrees, 1, 3)


def named(*fixes):
    return Named(["@" + "@".join(map(str, fix)) + "@.jpg" for fix in fixes])


def test_equal_numbers_in_other_zones_are_other_places():
    one = (500_000, 5_300_000, 32, "U", 47.85, 9.0)
    other = (500_000, 5_300_000, 33, "U", 47.85, 15.0)  # 450 km east
    assert sets(known("utm", named(one), named(one, other), 1, 2).positives) == [{0}, set()]
    near = (730_000, 5_330_000, 32, "U", 48.0, 12.0001), (269_000, 5_330_000, 33, "U", 48.0, 11.9999)
    assert sets(known("utm", named(*near), named(*near), 2, 2).positives) == [{0, 1}] * 2  # 14.9 m
    with refused("UTM zones 32 and 33", "@lat@lon"):
        find_ground_truth("utm", Named(["@5e5@53e5@32@U@.jpg"]), Named(["@5e5@53e5@33@U@.jpg"]), 1, 1)
    south = (500_000, 9_990_000, 32, "M", -0.09, 9.0), (500_000, 10_000, 32, "N", 0.09, 9.0)
    assert sets(known("utm:20000", named(*south), named(*south), 2, 2).positives) == [{0, 1}] * 2


def test_frames_without_a_fix_are_not_scored(caplog):
    reference = Named(["@500000@4000000@.jpg", "@@@.jpg", "@500010@4000000@.jpg"])
    query = Named(["none.jpg", "@500000@4000000@.jpg"])
    truth = known("utm", reference, query, 3, 2)
    assert truth.judged.tolist() == [False, True]
    assert sets(truth.positives) == [set(), {0, 2}]
    assert "1 of 3 frames have no coordinates, such as @@@.jpg" in caplog.text
    assert "1 of 2 frames have no coordinates, such as none.jpg" in caplog.text


def test_a_truth_that_calls_nearly_all_right_is_told(caplog):
    road = images(*((500_000 + 10 * i, 4_000_000) for i in range(40)))
    known("utm:25", road, road, 40, 40)
    assert "count as right" not in caplog.text
    known("utm:100", road, road, 40, 40)
    assert "46 % of all pairs of a query and a place count as right" in caplog.text


# resampled by distance: two queries show frames 3 and 9 of 11; three places show frames 0, 4 and 9 of 12

SHOWN = torch.tensor([3, 9])
PLACE_OF = torch.tensor([0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, -1])


def resampled(truth, **options):
    return known(truth, route(12), route(11), 12, SHOWN, resampled=True, **options)


def test_convention_11_a_ground_truth_counts_frames(tmp_path):
    found = resampled(written(tmp_path, "query,place\n3,4\n4,0\n9,11,2\n"))
    assert sets(found.positives) == [{4}, {2, 11}]
    places = ground_truth_in_places(found, lambda frames: look_up(PLACE_OF, frames))
    assert sets(places.positives) == [{1}, {0}]
    assert torch.equal(places.judged, found.judged)
    assert sets(resampled("-1").positives) == [{2}, {8}]


def test_a_frame_that_no_query_shows_speaks_for_the_nearest_one_that_is_shown(tmp_path):
    found = resampled(written(tmp_path, "1,0\n2,1\n10,4\n"))
    assert sets(found.positives) == [{0, 1}, {4}]
    assert found.judged.all()
    kept = resampled(written(tmp_path, "1,0\n3,1\n"))
    assert sets(kept.positives) == [{1}, set()]
    assert kept.judged.tolist() == [True, False]
    between = resampled(written(tmp_path, "0,0\n10,11\n"), interpolate=True)
    assert sets(between.positives) == [{3}, {10}]
    with refused("query 11", "0 to 10"):
        resampled(written(tmp_path, "11,1\n"))
    # frames are not moved where queries are only some of the frames
    with refused("lists queries from 1 to 10"):
        read(written(tmp_path, "1,0\n10,4\n"), 12, SHOWN)


# sizes, which are checked before anything is read


def packed(folder, kind, shape, body):
    """An .npz whose GThard says that it is of this type and shape."""
    header = f"{{'descr': {kind}, 'fortran_order': False, 'shape': {shape}}}\n".encode()
    array = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + body
    with zipfile.ZipFile(folder / "truth.npz", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("GThard.npy", array)
    return str(folder / "truth.npz")


@pytest.mark.parametrize(
    ("kind", "shape", "words"),
    [
        ("'|b1'", f"({10**6}, {10**6})", "GB free"),
        ("'|b1'", "(1000, 1000)", "GThard has 9 bytes or more instead of 1000000"),
        ("'|b1'", "(2, 3)", "GThard has 7 bytes or more instead of 6"),
        ("('|b1', (1000000000000,))", "(3, 3)", "GThard"),
    ],
)
def test_a_size_that_a_matrix_claims_is_not_believed(tmp_path, kind, shape, words):
    with refused("truth.npz", words):
        read(packed(tmp_path, kind, shape, bytes(9)), None, torch.tensor([0]))


def test_a_table_wider_than_the_memory_is_refused(tmp_path, monkeypatch):
    wide = "0," + ",".join(map(str, range(20_000)))
    path = written(tmp_path, "\n".join([wide, *(f"{i},1" for i in range(1, 2000))]))
    monkeypatch.setattr(memory, "free_memory", lambda: 1e9)
    with refused("20000 places for each of 2000 queries", "1 GB free"):
        read(path, None, 2000)
    with refused("1500 places for each of 30000 queries", "GB free"):
        near_truth(torch.zeros(1500, 2), torch.zeros(30_000, 2), radius=1.0)


def frames_of(count):
    return ArrayTraverse(torch.rand(count, 4), f"{count} frames")


def test_rows_beyond_the_last_frame_are_refused_but_for_a_stop(tmp_path, caplog):
    def ask(text, query, reference=None):
        (tmp_path / "truth.csv").write_text(text)
        return find_ground_truth(tmp_path / "truth.csv", reference, query, 8, len(query))

    long = "\n".join(f"{i},{min(i, 7)}" for i in range(10))
    with refused("2 beyond the last frame: query 8 to 9", "0 to 7"):
        ask(long, frames_of(8))
    with refused("query 8", "count from 1?"):
        ask("\n".join(f"{i},{min(i, 7)}" for i in range(1, 9)), frames_of(8))
    truth = ask(long, frame_range(frames_of(10), stop=8))
    assert truth.positives.tolist() == [[i] for i in range(8)]
    assert "2 of its right places lie beyond a stop" in caplog.text
    ask("\n".join(f"{i},{i}" for i in range(4)), frame_range(frames_of(10), stop=9, step=3))
    assert "1 of its right places lie beyond a stop" in caplog.text
    truth = ask("0,3\n1,9\n2,5\n", frames_of(3), frame_range(frames_of(10), stop=8))
    assert truth.positives.tolist() == [[3], [-1], [5]]


def test_numbers_that_look_like_seconds_are_told(tmp_path, caplog):
    (tmp_path / "truth.csv").write_text("\n".join(f"{i},{i}" for i in range(20)))
    find_ground_truth(tmp_path / "truth.csv", None, frames_of(600), 500, 600)
    assert "ends at query 19 of 600 and place 19 of 500: does it count seconds" in caplog.text
    caplog.clear()
    find_ground_truth(tmp_path / "truth.csv", None, frames_of(20), 500, 20)
    assert not caplog.text
