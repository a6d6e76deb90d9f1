"""Loops within one drive: what may answer, which truth counts, and real drives with and without."""

from __future__ import annotations

import csv
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from command_line import fails, report_of, run
from helpers import refused

from dejavu_torch import DejaVu, PlaceFilter, open_source
from dejavu_torch.data.ground_truth import as_ground_truth, of_loops
from dejavu_torch.evaluation.compare import compare
from dejavu_torch.recognition.evidence import passed_of, standing
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.types import Coordinates


def twice(length=120):
    """A drive over `length` places, and over the same again, with other noise."""
    places = F.normalize(torch.randn(length, 16), dim=1)
    return F.normalize(torch.cat([places, places]) + 0.05 * torch.randn(2 * length, 16), dim=1)


@pytest.mark.parametrize("drive", [False, True])
def test_a_second_lap_finds_the_first(drive):
    rows = twice()
    match = DejaVu(whitening="none").learn(rows).loops(rows, 30, drive)
    assert len(match) == 240
    assert (match.index[:31] == -1).all()
    assert not match.accepted[:31].any()
    assert ((match.index < torch.arange(240) - 30) | (match.index < 0)).all()
    assert torch.equal(match.index[120:], torch.arange(120))
    if drive:
        assert match.accepted[130:230].all()
        assert not match.accepted[:120].any()


def test_what_is_refused(tmp_path, capsys):
    rows = twice()
    model = DejaVu(whitening="none").learn(rows)
    with refused("100 places, the map 240", "learned from"):
        model.loops(rows[:100])
    for apart in (0, 240):
        with refused(f"loops: {apart}", "from 1 to 239"):
            model.loops(rows, apart)
    model.save(tmp_path / "m.safetensors")
    np.save(tmp_path / "d.npy", rows.numpy())
    files = tmp_path / "m.safetensors", tmp_path / "d.npy"
    words = "localize", *files, "--loops", 30, "--out", tmp_path / "m.csv"
    for option in ("--top 3", "--match filter", "--centre mean"):
        assert f"--loops 30 and {option}" in fails(capsys, *words, *option.split())


def test_only_earlier_places_are_right():
    truth = as_ground_truth([[0, 1, 90], [5], [], [88]])
    queries = torch.tensor([60, 6, 2, 100])
    assert of_loops(truth, queries, 20).positives.tolist() == [[0, 1, -1], [-1] * 3, [-1] * 3, [-1] * 3]
    with refused("over 70 frames before"):
        of_loops(truth, queries, 70)


@pytest.mark.parametrize("noise", [0.0, 0.2])
@pytest.mark.parametrize("drive", [False, True])
def test_a_wait_is_no_loop(noise, drive):
    """120 frames of a place, by the same picture or with noise, on the second lap."""
    rows = twice()
    at = torch.tensor([*range(180), *[180] * 120, *range(180, 240)])
    waits = torch.arange(360).sub(180).clamp(0, 120)
    waits = F.normalize(rows[at] + (waits % 120 > 0)[:, None] * noise / 4 * torch.randn(360, 16), dim=1)
    match = DejaVu(whitening="none").learn(waits).loops(waits, 50, drive)
    accepted = match.accepted[200:300]
    assert ((match.index[200:300] < 120) | ~accepted).all()  # but the first lap is found
    if drive:
        assert match.accepted[[*range(150, 180), *range(310, 340)]].all()
    truth = of_loops(as_ground_truth([[0, 178, 190]] * 2), torch.tensor([200, 299]), 50)
    assert truth.positives.tolist() == [[0, -1, -1], [0, 178, 190]]  # by frames
    where = torch.stack([at.double(), 0 * at], 1)
    assert int(standing(where).sum()) == 120
    truth = of_loops(
        as_ground_truth([[0, 178, 190]] * 2), torch.tensor([200, 299]), 50, (~standing(where)).cumsum(0)
    )
    assert truth.positives.tolist() == [[0, -1, -1]] * 2


def test_a_wait_is_seen_in_laps_and_where_some_coordinates_are_unknown():
    path = 3 * torch.randn(200, 2, generator=torch.Generator().manual_seed(0)).cumsum(0)
    wait = torch.cat([path[:100], path[100:101].repeat(60, 1), path[100:]])
    assert int(standing(wait).sum()) == 60
    assert int(standing(torch.cat([wait, wait])).sum()) == 120
    drive = SimpleNamespace(coordinates=Coordinates(wait.double()))
    assert int(passed_of(drive)[-1]) == 260 - 60
    wait[3, 1] = torch.nan
    assert int(standing(wait).sum()) == 60
    drive = SimpleNamespace(coordinates=Coordinates(path[:60].double().repeat_interleave(30, 0)))
    assert int(passed_of(drive)[-1]) == 60 * 30  # by a receiver slower than the camera
    assert passed_of(None) is None


def test_a_place_that_only_some_queries_see_is_no_hole():
    """As in loops, where later places are seen by later queries alone, some of which repeat."""
    rows = twice(200)
    stalled = torch.cat([rows, rows[-1:].expand(60, -1)])
    match = DejaVu(whitening="none").learn(stalled).loops(stalled, 30)
    assert match.accepted[210:390].double().mean() > 0.9


MOVES = torch.randn(300, 8, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("queries", [torch.zeros(0, 3), torch.ones(1, 3), MOVES, torch.ones(30, 2)])
def test_what_moves_or_is_short_is_no_wait(queries):
    assert not standing(queries).any()
    assert not standing(torch.randn(200, 64).cumsum(0)).any()
    assert not standing(torch.full((200, 2), torch.nan)).any()


def test_the_commands_find_and_score_loops(tmp_path):
    drive, where = tmp_path / "d.npy", tmp_path / "d.csv"
    np.save(drive, twice().numpy())
    where.write_text("x,y\n" + "\n".join(f"{i % 120},0" for i in range(240)))
    run("learn", drive, "--map", tmp_path / "m.safetensors", "--calibration", "none")
    run(
        "localize", tmp_path / "m.safetensors", drive, "--loops", 30, "--ordered", "--out", tmp_path / "m.csv"
    )
    pairs = [row for row in csv.DictReader((tmp_path / "m.csv").open()) if row["accepted"] == "1"]
    assert {int(row["query"]) - int(row["place"]) for row in pairs} == {120}
    source = f"{drive}?coordinates={where}"
    words = ("--truth", "metres:.5", "--tolerance", 0, "--reference", source, "--query", source)
    run("evaluate", tmp_path / "m.csv", *words, "--loops", 30, "--out", tmp_path / "scores")
    report = report_of(tmp_path / "scores")
    assert report["with_answer"] == 120
    assert report["recall_at_1"] == 1
    assert report["accepted_right"] == report["accepted"] == len(pairs)


def test_a_comparison_of_loops_asks_all_contenders_for_them(tmp_path, capsys):
    drive, where = tmp_path / "d.npy", tmp_path / "d.csv"
    np.save(drive, twice().numpy())
    where.write_text("x,y\n" + "\n".join(f"{i % 120},0" for i in range(240)))
    words = ["--loops", "30", "--ordered", "--truth", "metres:.5", "--tolerance", "0", "--out"]
    run("compare", f"{drive}?coordinates={where}", *words, tmp_path / "r")
    assert "give --truth" not in capsys.readouterr().out
    report = report_of(tmp_path / "r")
    assert (report["answers"], report["loops"], report["with_answer"]) == ("loops", 30, 120)
    assert report["accepted"] == report["accepted_right"] == 120
    # without the mask each place would be its own answer, and none a loop
    for one in (report, report["uncompressed"], report["null"]):
        assert one["recall_at_1"] > 0.9
    rows = [*csv.DictReader((tmp_path / "r" / "matches.csv").open())]
    assert all(int(row["place"]) < int(row["query"]) - 30 for row in rows if row["accepted"] == "1")
    assert report["error_metres"]["all"]["0.99"] < 1

    assert "compare without QUERY" in fails(capsys, "compare", drive, "--out", tmp_path / "x")
    assert "expected the reference alone" in fails(capsys, "compare", drive, drive, *words, tmp_path / "x")
    for option in ("--top 3", "--match filter", "--centre mean", "--leave_out 2"):
        failed = fails(capsys, "compare", drive, *words, tmp_path / "x", *option.split())
        assert f"--loops 30 and {option}" in failed
    with refused("expected a second visit, or loops"):
        compare(twice(), None)
    with refused("--loops 5 and a query; expected the reference alone"):
        compare(twice(), twice(), querying=Querying(loops=5))
    with refused("--loops 5 and --match filter; expected one of them"):
        compare(twice(), None, querying=Querying(loops=5, match=PlaceFilter()))


def test_real_drives_with_and_without_loops(data_dir):
    """Two laps of a small car on a track of 390 frames; a road in a city, driven once."""
    laps = open_source(f"{data_dir}/rc_car_laps/frames?stop=1000&width=64")
    match = DejaVu().learn(laps).calibrate(laps).loops(laps, 50)
    found = match.accepted.nonzero()[:, 0]
    starts = torch.tensor([194, 590, 982, 1356.0])
    judged = found[(found >= 590) & (match.index[found] >= 194)]

    def around(frames):
        lap = torch.searchsorted(starts, frames.float(), right=True) - 1
        return (frames - starts[lap]) / (starts[lap + 1] - starts[lap])

    off = ((around(judged) - around(match.index[judged]) + 0.5) % 1 - 0.5).abs()
    assert len(judged) > 100
    assert float((off < 0.1).double().mean()) > 0.98
    once = open_source(data_dir / "robotcar" / "t1" / "reference.npy")
    match = DejaVu().learn(once).calibrate(once).loops(once, 50)
    assert int(match.accepted.sum()) == 0
