"""`benchmarks drives` and `benchmarks storage --drives`: which drives are made, and what is told of them."""

from __future__ import annotations

import json
import math

import numpy as np
import torch
from command_line import benchmark
from torch.nn.functional import normalize

from benchmarks import drives, large_drives, storage_drives, tables
from benchmarks.drives import AS_IT_WAS, ELSEWHERE, HALF, NO_OTHER, Known, asked, bench_drives, drives_of
from benchmarks.storage_drives import ANSWERS, Asked, bench_storage_drives, both_sides, drive_table
from benchmarks.trainings import Route
from dejavu_torch import DejaVu
from dejavu_torch.data.ground_truth import GroundTruth, as_ground_truth
from dejavu_torch.recognition.evidence import place_means, standardised

PLACES, NUMBERS = 120, 24


def walk(seed, noise=0.0, route=7):
    """Features along a route, with noise of this seed."""
    profile, own = (torch.Generator().manual_seed(one) for one in (route, seed))
    smooth = torch.randn(PLACES, NUMBERS, generator=profile).cumsum(0)
    return smooth + noise * torch.randn(PLACES, NUMBERS, generator=own)


def test_drives_are_cut_from_the_one_that_was():
    made = drives_of(10, torch.zeros(4, 1))
    listed = {name: numbers.tolist() for name, numbers in made.items() if numbers is not None}
    assert listed["there and back"] == [0, 1, 2, 3, 4, 4, 3, 2, 1, 0]
    assert listed["a third of the speed"][:7] == [0, 0, 0, 1, 1, 1, 2]
    assert listed["five times the speed"] == [0, 5]
    assert listed["a stop"] == [*range(5), *[5] * 200, *range(5, 10)]
    assert listed["half of it off the map"] == [0, 1, 2, 3, 4, -1, -2, -3, -4]
    assert listed[ELSEWHERE] == [-1, -2, -3, -4]
    long = drives_of(300, None, seed=3)
    assert [name for name, numbers in long.items() if numbers is None] == [*made][-3:]
    cut = long["stretches of 20 to 40"]
    assert cut is not None
    borders = ((cut[1:] - cut[:-1]).abs() != 1).nonzero()[:, 0] + 1
    lengths = {len(part) for part in cut.tensor_split(borders)}
    assert min(lengths) >= 20
    assert {*(cut[1:] - cut[:-1]).tolist()} >= {1, -1}  # both ways
    again = drives_of(300, None, seed=3)["stretches of 20 to 40"]
    assert again is not None
    assert torch.equal(again, cut)


def test_large_maps_are_measured_beside_all_places(tmp_path, monkeypatch, capsys):
    task = large_drives.Task(120, 600, 5.0)
    monkeypatch.setattr(large_drives, "TASKS", (task,))
    monkeypatch.setattr(drives, "TASKS", (task,))
    benchmark("drives", tmp_path, "--large", "--out", tmp_path / "out")
    (row,) = json.loads((tmp_path / "out" / "bench.json").read_text())["rows"]
    assert row["skipped"] is None
    assert row["recall"] == row["recall_all"] == 1
    assert row["recall_one"] < 1
    assert row["drive_seconds"] > 0
    assert "120 on 600, 5 B" in capsys.readouterr().out
    place_map, queries, truth = large_drives.made(task)
    assert place_map.places == 600
    assert len(queries) == len(truth) == 120
    monkeypatch.setattr(tables, "read", lambda _: {"rows": [row]})
    assert "| 120, 600, 5 |" in tables.large_drives()


def test_queries_of_another_route_have_no_place_but_are_judged():
    truth = GroundTruth(torch.tensor([[4], [5]]), torch.tensor([True, False]), torch.tensor([[7], [8]]))
    known = Known(DejaVu(), torch.tensor([[1.0], [2]]), truth, 1, torch.tensor([[30.0], [40]]))
    queries, found = asked(known, torch.tensor([1, -2, 0]))
    assert queries.tolist() == [[2], [40], [1]]
    assert found.positives.tolist() == [[5], [-1], [4]]
    assert found.judged.tolist() == [False, True, True]
    assert found.ignored.tolist() == [[8], [-1], [7]]


def test_a_row_for_each_drive_of_a_route(tmp_path, monkeypatch, capsys):
    for name, features in {"a": walk(0), "b": walk(1, 1.0), "c": walk(2, 1.0, route=5)}.items():
        np.save(tmp_path / f"{name}.npy", features.numpy())
    route = Route("{data}/a.npy", "{data}/b.npy", 2, "0")
    monkeypatch.setattr(drives, "ROUTES", {"walk": (route, "{data}/c.npy")})
    kept = (AS_IT_WAS, HALF, ELSEWHERE)
    some = lambda *given: {name: drives_of(*given)[name] for name in kept}  # noqa: E731
    monkeypatch.setattr(drives, "drives_of", some)
    benchmark("drives", tmp_path, "--out", tmp_path / "out")
    rows = {
        row["contender"]: row for row in json.loads((tmp_path / "out" / "bench.json").read_text())["rows"]
    }
    whole, other = rows[AS_IT_WAS], rows[ELSEWHERE]
    assert whole["is_drive"]
    assert whole["auc"] >= whole["auc_one"] - 0.01
    assert whole["accepted_right"] > 0.9
    assert rows[HALF]["above_half"] < 0.7 < whole["above_half"]
    assert (other["auc"], other["accepted_right"], other["above_nine_tenths"]) == (None, None, 0)
    assert "walk: another route" in capsys.readouterr().out
    known = drives.learned(route.below(tmp_path), None)
    monkeypatch.setattr(drives, "facts_of", lambda *_: {})
    skipped = [row["contender"] for row in bench_drives("walk", known) if row["skipped"] == NO_OTHER]
    assert skipped == [HALF, ELSEWHERE]


def test_sums_on_both_sides_are_those_of_a_literal_loop():
    scores = torch.rand(9, 12, generator=torch.Generator().manual_seed(0))
    z = standardised(scores, place_means(scores, torch.ones(9))).z
    expected = torch.full((9, 12), math.inf)
    for t in range(9):
        for i in range(12):
            for speed in (1.0, 1.6):
                near = [(t + d, i + math.floor(speed * d + 0.5)) for d in range(-3, 4) if 0 <= t + d < 9]
                cells = [z[row, place] for row, place in near if 0 <= place < 12]
                if 2 * len(cells) >= len(near):
                    expected[t, i] = min(expected[t, i], -sum(cells) / len(cells))
    torch.testing.assert_close(both_sides(scores, 3, (1.0, 1.6)), expected)


def test_stores_are_asked_three_ways_from_the_same_scores(monkeypatch):
    monkeypatch.setattr(storage_drives, "BUDGETS", (1.0,))
    monkeypatch.setattr(storage_drives, "BETWEEN", (8,))
    monkeypatch.setattr(storage_drives, "HOG_SPACED", (1,))
    places, queries = (normalize(one, dim=1) for one in (walk(0), walk(1, 6.0)))
    hog = walk(0), walk(1, 6.0)
    route = Asked("walk", places, queries, as_ground_truth(torch.arange(PLACES)), 2, hog)
    rows = list(bench_storage_drives(route))
    found = {(row["contender"], row["answer"]): row for row in rows}
    assert len(found) == len(rows) == 3 * len({row["contender"] for row in rows})
    for name in ("dejavu 1", "HOG of every frame, int8"):
        one, window, drive = (found[name, answer] for answer in ANSWERS)
        assert one["auc"] < min(window["auc"], drive["auc"])
        assert one["route_bytes"] == window["route_bytes"] == drive["route_bytes"] > 0
        assert (one["is_drive"], window["is_drive"], drive["is_drive"]) == (None, None, True)
    assert found["every 8th frame, int8", "one"]["route_bytes"] == 16 * NUMBERS  # with the last one
    (reason,) = {row["skipped"] for row in rows if row["family"] in ("PQ", "RQ", "LSQ")}
    assert "no other route" in reason
    table = drive_table(rows)
    ours = next(row for row in table if row[0] == "walk: **dejavu**")
    areas = [found["dejavu 1", answer]["auc"] for answer in ANSWERS]
    assert ours[3] == " ".join(f"{area:.3f}".removeprefix("0") for area in areas)
    assert storage_drives.pictured(rows)[0].axes[1].get_title("left") == "whole drive\nwalk"


def test_the_table_of_made_drives(monkeypatch):
    def row(case, one, auc, taken):
        facts = {"is_drive": taken, "above_half": 0.5, "above_nine_tenths": 0.25, "calibration_error": 0.125}
        facts |= {"auc_one": one, "auc_uncentred": one - 0.25}
        return {"case": case, "contender": "reversed", "auc": auc, **facts}

    rows = [row("city", 0.5, 1.0, True), row("laps", 0.75, 0.5, False)]
    monkeypatch.setattr(tables, "read", lambda _: {"rows": rows})
    means, areas = tables.made_drives().split("\n\n")
    assert means.splitlines()[2].startswith(
        "| reversed | 2 | 1 | 0.625 | 0.375 | 0.750 | 0.250, laps | 0.500 | 0.250 |  | 0.125 |"
    )
    assert areas.splitlines()[2] == "| reversed | .500 1.000 | .750 .500* |"
