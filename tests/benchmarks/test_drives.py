"""`benchmarks drives` and `benchmarks storage --drives`: which drives are made, and what is told of them."""

from __future__ import annotations

import json
import math

import numpy as np
import torch
from command_line import benchmark
from torch.nn.functional import normalize

from benchmarks import (
    chosen,
    cross,
    drives,
    ends,
    large_drives,
    odometry,
    own_copies,
    storage_drives,
    tables,
)
from benchmarks.drives import AS_IT_WAS, ELSEWHERE, HALF, NO_OTHER, bench_drives, drives_of
from benchmarks.storage_drives import ANSWERS, Asked, bench_storage_drives, both_sides, drive_table
from benchmarks.trainings import Route
from dejavu_torch.data.ground_truth import as_ground_truth
from dejavu_torch.recognition import chosen as constants
from dejavu_torch.recognition.evidence import place_means, standardised

PLACES, NUMBERS = 120, 24


def walk(seed, noise=0.0, route=7):
    """Features along a route, with noise of this seed."""
    profile, own = (torch.Generator().manual_seed(one) for one in (route, seed))
    smooth = torch.randn(PLACES, NUMBERS, generator=profile).cumsum(0)
    return smooth + noise * torch.randn(PLACES, NUMBERS, generator=own)


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
    assert table[-1][0] == "walk: dejavu, recall@1 of the drive"
    assert table[-1][3] == f"{found['dejavu 1', 'drive']['recall_at_1']:.3f}".removeprefix("0")


def test_drives_over_other_ground_are_told_by_map():
    """The worst of others, what is taken, and the threshold between."""

    def row(contender, relation, taken, above, shown):
        facts = {"shown": shown, "null": -1.0, "log_likelihood": 50.0, "nats_per_query": 2.0}
        return facts | {
            "case": "city 1",
            "contender": contender,
            "relation": relation,
            "taken": taken,
            "drive_above": above,
        }

    rows = [
        row("city 1", cross.OWN, True, [1, 1, 1], -0.5),
        row("city 1", cross.OWN, False, [0, 0, 0], -0.6),
        row("railway, first half", cross.OTHER, False, [0.1, 0.02, 0], -0.9),
        row("city 9", cross.KIND, True, [0.05, 0.03, 0], -0.8),
    ]
    head, line = cross.summary(rows)
    assert dict(zip(head, line, strict=True)) == {
        "map": "city 1",
        "own taken": "1 of 2",
        f"{cross.REPEATED}: taken": "",
        f"{cross.KIND}: taken": "1 of 1",
        f"{cross.OTHER}: taken": "0 of 1",
        "worst drive, p > .5 .9 .99": "0.10 0.03 0.00",
        "worst filter, p > .5 .9 .99": "",
        "worst one, p > .5 .9 .99": "",
    }
    assert cross.chosen(rows).startswith(
        "surer by, chosen on: others up to 0.200, 2 of 2 own ones above, from 0.400, between 0.300"
    )


def test_what_shares_ground_is_no_other_route():
    board = cross.Board(None, ("city 1",), torch.empty(0), None, 2)
    assert cross.related(board, "city 2") == cross.SHARED
    assert cross.related(board, "laps") == cross.OTHER
    assert cross.related(board._replace(shows=("road, first half",)), "road, second half") == cross.REPEATED
    assert cross.related(board._replace(shows=("railway, first half",)), "railway, second half") == cross.KIND


def test_other_constants_are_tried_and_put_back(tmp_path, monkeypatch, capsys):
    for name, features in {"a": walk(0), "b": walk(1, 1.0), "c": walk(2, 1.0, route=5)}.items():
        np.save(tmp_path / f"{name}.npy", features.numpy())
    route = Route("{data}/a.npy", "{data}/b.npy", 2, "0")
    monkeypatch.setattr(chosen, "ROUTES", {"walk": (route, "{data}/c.npy")})
    monkeypatch.setattr(chosen, "HALVED", ("SHARPENED", "ROUNDS"))
    before = vars(constants).copy()
    benchmark("chosen", tmp_path, "--constants", "SHARPENED", "FAST", "--out", tmp_path / "out")
    rows = json.loads((tmp_path / "out" / "bench.json").read_text())["rows"]
    assert [row["contender"] for row in rows] == [
        "as it is",
        "SHARPENED 0.6: 0.3",
        "SHARPENED 0.6: 1.2",
        "FAST: none",
    ]
    assert rows[0]["lost"] == rows[0]["gained"] == 0
    assert len({row["calibration_error"] for row in rows}) > 1
    assert vars(constants) == before
    assert "SHARPENED 0.6: 1.2" in capsys.readouterr().out


def test_copies_choose_for_the_drives_of_another_visit(tmp_path, monkeypatch):
    for name, seed in {"a": 0, "b": 1}.items():
        np.save(tmp_path / f"{name}.npy", pictures(seed))
    route = Route("{data}/a.npy", "{data}/b.npy", 2, "0")
    monkeypatch.setattr(own_copies, "ROUTES", {"walk": (route, None)})
    settings = {name: own_copies.SETTINGS[name] for name in ("free, 0.6", own_copies.USUAL)}
    monkeypatch.setattr(own_copies, "SETTINGS", settings)
    benchmark("own_copies", tmp_path, "--out", tmp_path / "out")
    usual, alone, alike, best = json.loads((tmp_path / "out" / "bench.json").read_text())["rows"]
    assert usual["setting"] == own_copies.USUAL
    assert best["auc"] >= max(usual["auc"], alone["auc"], alike["auc"])
    assert alike["tau"] > alone["tau"]
    monkeypatch.setattr(tables, "read", lambda _: {"rows": [usual, alone, alike, best]})
    assert f"| walk | {usual['auc']:.3f} (both, 0.6) |" in tables.own_copies()


def test_odometry_is_made_from_the_truth_and_helps(tmp_path, monkeypatch):
    order = torch.arange(PLACES).roll(-30)[::3]  # over the end of a lap, at three times the speed
    truth = as_ground_truth(order.tolist())
    assert odometry.moves_of(truth, PLACES).tolist() == [0.0] + [3.0] * (len(order) - 1)
    np.save(tmp_path / "a.npy", walk(0).numpy())
    np.save(tmp_path / "b.npy", walk(1, 3.0)[::2].numpy())
    (tmp_path / "truth.csv").write_text("".join(f"{i},{2 * i}\n" for i in range(60)))
    route = Route("{data}/a.npy", "{data}/b.npy", 2, "{data}/truth.csv")
    for module in (drives, odometry):
        monkeypatch.setattr(module, "ROUTES", {"walk": (route, None)})
    monkeypatch.setattr(odometry, "RATES", {"": None, ", a thousandth": 0.001})
    monkeypatch.setattr(odometry, "DRIVEN", ("walk",))
    benchmark("odometry", tmp_path, "--out", tmp_path / "out")
    *rows, few = json.loads((tmp_path / "out" / "bench.json").read_text())["rows"]
    without, noisy, longer, _ = rows
    assert "expected more than" in few["skipped"]
    assert noisy["filter"] > without["filter"]
    assert min(noisy["drive"], longer["drive"]) > without["drive"] - 0.05
    monkeypatch.setattr(tables, "read", lambda _: {"rows": [*rows, few]})
    assert tables.odometry().count("\n") >= 3


def test_drives_leave_the_map_stand_still_and_see_it_otherwise(tmp_path, monkeypatch, capsys):
    for name, seed in {"a": 0, "b": 1}.items():
        images = pictures(seed)
        np.save(tmp_path / f"{name}.npy", images)
    footage = cross.Footage("{data}/a.npy", "{data}/b.npy", 2, "0", "walk", "walk")
    monkeypatch.setattr(ends, "FOOTAGE", {"walk": footage})
    monkeypatch.setattr(ends, "SEES", {"walk": 3})
    monkeypatch.setattr(ends, "HOLE", 20)
    benchmark("ends", tmp_path, "--out", tmp_path / "out")
    rows = {
        row["contender"]: row for row in json.loads((tmp_path / "out" / "bench.json").read_text())["rows"]
    }
    whole, cut, hole = (rows[name] for name in ("as it is", "end cut, 33%", "a hole of 40"))
    assert (whole["on"], whole["off"], whole["taken"]) == (PLACES, 0, True)
    assert whole["drive_on_0.5"] > 0.9
    assert (cut["on"], cut["shared"], cut["off"]) == (80, 3, 37)
    assert cut["drive_off_0.5"] < 0.1
    assert cut["drive_on_0.5"] > 0.8
    assert hole["on"] == PLACES - 20
    assert rows["stalls of 20"]["drive_on_wrong"] < 0.1
    assert {"a lens of 1.2", "a wait", "a wait with noise"} <= rows.keys()
    assert rows["a wait"]["loops_in_wait"] == rows["a wait with noise"]["loops_in_wait"] == 0
    assert "loops within a wait, at most: 0" in capsys.readouterr().out
    monkeypatch.setattr(tables, "read", lambda _: {"rows": [*rows.values()]})
    assert "| end cut, 33% | 1 |" in tables.left()


def pictures(seed):
    """A walk past random ground, 120 pictures of 24 x 24, with noise of this seed."""
    ground = torch.rand(1, 1, 24, 6 * PLACES, generator=torch.Generator().manual_seed(7))
    ground = torch.nn.functional.avg_pool2d(ground, 3, 1, 1)[0, 0]
    frames = torch.stack([ground[:, 6 * i : 6 * i + 24] for i in range(PLACES - 3)])
    frames = torch.cat([frames, frames[-3:].flip(2)])
    noise = torch.rand(frames.shape, generator=torch.Generator().manual_seed(seed))
    return (220 * frames + 30 * noise).byte().numpy()
