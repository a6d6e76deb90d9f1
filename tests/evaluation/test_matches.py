"""Matches in a csv: what is written is read, and what others write too."""

from __future__ import annotations

import csv
from unicodedata import category

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.evaluation.matches import ELSEWHERE, read_matches, write_matches
from dejavu_torch.places.frame_table import FrameTable
from dejavu_torch.places.layout import Layout
from dejavu_torch.places.rectangles import Rectangle
from dejavu_torch.types import InputError, Match

INF = float("inf")
ROWS = st.lists(
    st.tuples(
        st.integers(0, 2**40), st.floats(width=32, allow_nan=False, allow_infinity=False), st.booleans()
    ),
    min_size=1,
    max_size=12,
)
PLAIN = "query,place,score,accepted\n0,7,0.5,1\n1,-1,inf,0\n2,3,-2,0\n"
RANKED = "query,place,score,accepted,rank\n4,7,0.5,1,1\n4,20,0.6,0,2\n9,3,0.1,1,1\n9,-1,inf,0,2\n"


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    return tmp_path_factory.mktemp("matches")


def written(folder, text):
    path = folder / "matches.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def told(path):
    """The rows that were read, by query."""
    queries, match, _ = read_matches(path)
    assert [queries.dtype, match.index.dtype, match.score.dtype] == [torch.int64, torch.int64, torch.float64]
    assert match.accepted.dtype == torch.bool
    columns = (queries, *match)
    return sorted(zip(*(column.tolist() for column in columns), strict=True))


@given(ROWS, st.none() | st.integers(1, 4), st.integers(1, 5))
def test_what_is_written_in_parts_is_read(scratch, rows, ranks, size):
    count, rows = len(rows), rows * (ranks or 1)
    index, score, accepted = (torch.tensor(column) for column in zip(*rows, strict=True))
    silent = index % 5 == 0
    index, score = torch.where(silent, -1, index), torch.where(silent, torch.inf, score.float())
    match = Match(index, score, accepted & ~silent)
    path, step = scratch / "m.csv", size * (ranks or 1)
    frames = torch.arange(count) // (1 if ranks is None else 2)  # a frame, two queries
    first, parts = match[:: ranks or 1], (match[i : i + step] for i in range(0, len(match), step))
    written = write_matches(path, parts, frames, ranks=ranks)
    assert written == (count, int(first.accepted.sum()))
    queries, read, candidates = read_matches(path)
    assert queries.tolist() == frames.tolist()
    assert torch.equal(read.index, first.index)
    assert torch.equal(read.accepted, first.accepted)
    assert torch.equal(read.score.float(), first.score)  # nine digits hold every float32
    assert torch.equal(candidates, index.view(count, ranks or 1))
    rank = "" if ranks is None else "rank,"
    assert lines(path)[0] == f"query,place,score,accepted,{rank}query_name,place_name"


@pytest.mark.parametrize(
    ("text", "expected", "candidates"),
    [
        (PLAIN, [(0, 7, 0.5, True), (1, -1, INF, False), (2, 3, -2.0, False)], [[7], [-1], [3]]),
        (
            "query,place,score\n5,1,0.25\n3,2,inf\n4,-1,0.5\n",  # every finite score is accepted
            [(3, -1, INF, False), (4, -1, INF, False), (5, 1, 0.25, True)],
            [[1], [-1], [-1]],
        ),
        (RANKED, [(4, 7, 0.5, True), (9, 3, 0.1, True)], [[7, 20], [3, -1]]),
    ],
    ids=["plain", "not accepted", "ranked"],
)
def test_by_hand(tmp_path, text, expected, candidates):
    path = written(tmp_path, text)
    assert told(path) == expected
    assert read_matches(path).candidates.tolist() == candidates


@pytest.mark.parametrize(
    "text",
    [
        PLAIN.replace("\n", "\r\n"),
        "\ufeff" + PLAIN,
        PLAIN.replace("\n", "\n\n"),
        PLAIN.replace(",", " , "),
        PLAIN.replace("0,7,", "0.0,7.0,").replace("query", "Query"),
        PLAIN.replace(",1\n", ",True\n").replace(",0\n", ",false\n"),
        "name,accepted,score,place,query\nc,0,-2,3,2\na,1,0.5,7,0\nb,0,inf,-1,1\n",
        'query,place,score,accepted,note\n0,7,0.5,1,"a, b"\n1,-1,Infinity,0,\n2,3,-2,0,x,,\n',
    ],
)
def test_other_ways_to_write_the_same(tmp_path, text):
    assert told(written(tmp_path, text)) == told(written(tmp_path, PLAIN))


def test_convention_2_no_place_or_no_score_reports_nothing(tmp_path):
    path = written(tmp_path, "query,place,score,accepted\n0,-1,0.5,1\n1,4,inf,1\n")
    assert told(path) == [(0, -1, INF, False), (1, -1, INF, False)]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("query,score\n0,1\n", ("line 1", "no column place", "query,place,score")),
        ("0,7,0.5,1\n", ("line 1", "no column query")),
        ("\nplace,query,x\n", ("line 2", "no column score")),
        (PLAIN + "3,x,1,1\n", ("line 5", "place is 'x'", "at least -1")),
        (PLAIN + "3,-2,1,1\n", ("line 5", "place is '-2'")),
        (PLAIN + "\n-1,1,1,1\n", ("line 6", "query is '-1'", "at least 0")),
        (PLAIN + "3,1,nan,1\n", ("line 5", "score is 'nan'")),
        (PLAIN + "3,1,,1\n", ("line 5", "score is ''")),
        (PLAIN + "3,1,0.5,2\n", ("line 5", "accepted is '2'", "1 or 0")),
        (PLAIN + "3,1,0.5\n", ("line 5", "3 cells", "expected 4")),
        (PLAIN + "0,1,0.5,1\n", ("line 5", "query 0", "twice")),
        (PLAIN + "3," + "1" * 200_000 + ",1,1\n", ("line 5", "field larger")),
        ("query,place,score,probability\n3,1,0.5,1.5\n", ("line 2", "probability is '1.5'", "0 to 1")),
        ("query,place,score\n", ("no matches",)),
        ("", ("no matches",)),
        (b"\x89PNG\r\n\x1a\n", ("UTF-8",)),
        (b"query,place,score\n\x00", ("null character",)),
        (RANKED[:32] + "4,7,1,1,0\n", ("line 2", "rank is '0'", "at least 1")),
        (RANKED[:32] + "4,7,1,1,2\n", ("line 2", "rank 2 of query 4", "expected rank 1")),
        (RANKED + "9,8,1,1,4\n", ("line 6", "rank 4 of query 9", "rank 3 of query 9")),
        (RANKED + "5,8,1,1,2\n", ("line 6", "rank 2 of query 5", "rank 3 of query 9")),
        (RANKED + "5,8,1,1,1\n4,9,1,1,2\n", ("line 7", "rank 2 of query 4", "rank 2 of query 5")),
        (RANKED + "5,8,1,1,1\n", ("query 5 has 1 ranks", "expected 2, as query 4 has")),
    ],
)
def test_what_cannot_be_read_is_refused(tmp_path, text, words):
    with refused("matches.csv", *words):
        read_matches(written(tmp_path, text))


def test_what_reports_nothing_needs_no_probability(tmp_path):
    text = "query,place,score,probability\n0,-1,inf,\n1,4,0.5,0.75\n"
    assert read_matches(written(tmp_path, text)).match.probability.tolist() == [0, 0.75]


# frames of the sources, and their names

MATCH = Match(torch.tensor([2, -1, 0]), torch.tensor([0.5, INF, 0.25]), torch.tensor([True, False, True]))


class Named:
    """The names of as many frames as one likes."""

    def __init__(self, form: str) -> None:
        self.form = form

    def __getitem__(self, frame):
        return self.form.format(frame)


def lines(path):
    text = path.read_bytes().decode()
    assert text.count("\n") == text.count("\r\n")
    return text.splitlines()


def test_convention_11_the_file_counts_frames_of_the_sources(tmp_path):
    path, parts = tmp_path / "m.csv", [MATCH[:2], MATCH[2:]]
    steps = torch.tensor([-1.0] * 10 + [0.0] * 4 + [1.0] * 5 + [2.0])  # first at frames 10, 14 and 19
    table = FrameTable(Layout(3), steps)
    write_matches(path, parts, torch.tensor([4, 4, 7]), table, Named("q{}.png"), Named("0:00:{:02}.000"))
    assert lines(path)[1:] == [
        "4,19,0.5,1,q4.png,0:00:19.000",
        "4,-1,inf,0,q4.png,",
        "7,10,0.25,1,q7.png,0:00:10.000",
    ]
    queries, match, _ = read_matches(path, repeats=True)
    assert (queries.tolist(), match.index.tolist()) == ([4, 4, 7], [19, -1, 10])
    with refused("query 4 is there twice", "a column rank", "--map MAP"):
        read_matches(path)


@given(st.lists(st.text(st.characters(blacklist_characters="\0"), max_size=9), min_size=3, max_size=3))
def test_any_name_leaves_the_file_readable(scratch, names):
    path = scratch / "names.csv"
    write_matches(path, [MATCH], query_names=names, place_names=names)
    queries, match, _ = read_matches(path)
    assert queries.tolist() == [0, 1, 2]
    for one, other in zip(match, MATCH, strict=True):
        assert torch.equal(one, other.to(one.dtype))
    rows = list(csv.DictReader(path.open(newline="")))
    for row, name in zip(rows, names, strict=True):
        # spaces of any width stay as they are
        assert all(one.isprintable() or category(one) == "Zs" for one in row["query_name"])
        if name.isprintable():
            assert row["query_name"] == name


# pairs of images


@given(ROWS, st.none() | st.integers(1, 4))
def test_pairs_are_the_names_of_the_rows_that_report_a_place(scratch, rows, ranks):
    index, score, accepted = (torch.tensor(column) for column in zip(*rows * (ranks or 1), strict=True))
    index = torch.where(index % 5 == 0, -1, index)
    path, pairs, names = scratch / "m.csv", scratch / "pairs.txt", (Named("q/{}.jpg"), Named("r\n{}.jpg"))
    write_matches(path, [Match(index, score, accepted)], None, None, *names, ranks, pairs)
    with path.open(newline="") as file:
        kept = [row for row in csv.DictReader(file) if row["place"] != "-1"]
    expected = [[row["query_name"], row["place_name"]] for row in kept]
    assert [line.split() for line in pairs.read_bytes().decode().splitlines()] == expected
    assert expected == [
        [f"q/{i // (ranks or 1)}.jpg", f"r\\n{place}.jpg"]
        for i, place in enumerate(index.tolist())
        if place >= 0
    ]


def test_neither_matches_nor_pairs_are_half_written(tmp_path):
    def breaks_off():
        yield MATCH
        raise InputError("a frame is damaged")

    path, pairs = written(tmp_path, PLAIN), tmp_path / "pairs.txt"
    names = Named("q{}"), Named("r{}")
    with refused("damaged"):
        write_matches(path, breaks_off(), None, None, *names, pairs=pairs)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    assert path.read_text() == PLAIN
    pairs.mkdir()
    with refused("pairs.txt is a folder"):
        write_matches(path, [MATCH], None, None, *names, pairs=pairs)
    assert path.read_text() == PLAIN


def test_places_of_several_routes_are_told_by_route_and_frame(tmp_path):
    routes = Layout.of([Rectangle(4, frames=8), Rectangle(3, route=1, frames=5)], routes=["out", "b,ack"])
    steps = torch.tensor([0.0, 0, 1, 1, 2, 2, 2, 3, 0, 0, 1, 1, 2])
    score, route = torch.tensor([0.1, 0.2, 0.3, INF, 0.5]), torch.tensor([0, 0, 1, -1, 1])
    match = Match(torch.tensor([0, 3, 4, -1, 6]), score, torch.ones(5) > 0, route=route)
    path = tmp_path / "m.csv"
    write_matches(path, [match], None, FrameTable(routes, steps), (), Named("{}.png"))
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    assert [(row["place"], row["route"], row["place_name"]) for row in rows] == [
        ("0", "out", "0.png"),
        ("7", "out", "7.png"),
        ("0", "b,ack", "8.png"),
        ("-1", "", ""),
        ("4", "b,ack", "12.png"),
    ]
    assert read_matches(path, "out").match.index.tolist() == [0, 7, ELSEWHERE, -1, ELSEWHERE]
    _, back, candidates = read_matches(path, "b,ack")
    assert back.index.tolist() == candidates[:, 0].tolist() == [ELSEWHERE, ELSEWHERE, 0, -1, 4]
    assert back.accepted.tolist() == [True, True, True, False, True]
    with refused("column route", "out, b,ack", "--route"):
        read_matches(path)
