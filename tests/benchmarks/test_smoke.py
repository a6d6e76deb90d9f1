"""Benchmarks of `python -m benchmarks`, end to end on tiny input: the rows and tables that they write."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from command_line import benchmark, benchmark_fails
from torch.nn.functional import normalize

from benchmarks import (
    alike,
    chunks,
    files,
    front,
    live,
    order,
    provenance,
    spread,
    tables,
    teaching,
    train,
    visits,
)
from benchmarks.alike import CAPPED, CHECKED, SINGLE, UNCAPPED
from benchmarks.teaching import COPIES, PLACED, REFINED, TASKS, TOLD, Task, right_of, run_teaching
from benchmarks.train import Rung
from benchmarks.trainings import Route
from benchmarks.visits import ANEW, UPDATED, Visits, curves, run_visits
from dejavu_torch import DejaVu, Whitening, open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import as_ground_truth
from dejavu_torch.evaluation.paper_tables import PUBLISHED
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.recognition.calibration import POWER


def rows_of(out):
    return json.loads((out / "bench.json").read_text())["rows"]


@pytest.fixture
def films(tmp_path, monkeypatch):
    """A folder of two drives along a road, and of the truth of a second; models learn from few copies."""
    for bench in (alike, teaching, visits):
        monkeypatch.setattr(bench, "DejaVu", lambda: DejaVu(whitening=Whitening(views=2)))
    for name, traverse in (("road", 0), ("drive", 1)):
        frames = torch.cat(list(open_source(f"sim:aerial?frames=120&traverse={traverse}").batches(120)))
        np.save(tmp_path / f"{name}.npy", frames[..., ::2, ::2].mul(255).byte().permute(0, 2, 3, 1).numpy())
    (tmp_path / "truth.csv").write_text("query,place\n" + "".join(f"{i},{i}\n" for i in range(120)))
    return tmp_path


def test_front(tmp_path, monkeypatch):
    """Of a short road: a row for each way and size, and a picture with three pairs."""
    monkeypatch.setattr(front, "ROAD", tuple(f"demo:road?traverse={i}&stop=90" for i in (0, 1)))
    other = f"{front.OTHER}&frames=90"
    for name, value in (("SEEDS", (1,)), ("BYTES", (2.0, 120.0)), ("OTHER", other), ("SHOWN", (20, 60))):
        monkeypatch.setattr(front, name, value)
    benchmark("front", "--out", tmp_path)
    rows = rows_of(tmp_path)
    assert {row["contender"] for row in rows} == {*front.WAYS, *front.ACCOUNTS, *front.POINTS}
    assert min(row["one_image"] for row in rows if row["contender"] == "uncompressed") > 0.9
    for row in rows:
        ways = front.COLUMNS[1:-1] if row["contender"] in front.ACCOUNTS else front.COLUMNS[1:]
        assert all(0 <= row[f"{way}_span"][0] <= row[way] for way in ways)
    assert (tmp_path / "bench.png").stat().st_size > 10_000


def test_order(films, monkeypatch, capsys):
    """A row for each route and order; by score is what the others gain over."""
    road = Route("{data}/road.npy", "{data}/drive.npy", 5, "{data}/truth.csv")
    for name in ("CHOSEN", "REPORTED"):
        monkeypatch.setattr(order, name, {f"{name} road": road})
    monkeypatch.setattr(order, "HALVES", {"chosen on": order.CHOSEN, "reported": order.REPORTED})
    benchmark("order", films, "--out", films / "out")
    rows = rows_of(films / "out")
    assert len(rows) == 2 * 9
    assert min(row["auc"] for row in rows) > 0.5
    assert all(row["auc"] == 0 for row in order.gains(rows) if row["contender"] == "score")
    assert "reported: score / elsewhere^0.75" in capsys.readouterr().out
    assert POWER in order.POWERS


def test_files(tmp_path, monkeypatch):
    """Each of the routes with everything that its file needs."""
    monkeypatch.setattr(files, "ROUTES", {60: files.ROAD, 80: files.SIMULATED, 400: files.MADE})
    for name, value in (("QUERIES", 20), ("LIKE", 80)):
        monkeypatch.setattr(files, name, value)
    benchmark("files", "--out", tmp_path)
    rows = rows_of(tmp_path)
    assert [row["contender"] for row in rows] == 3 * [*files.NAMES]
    for row in rows:
        assert row["recall_at_1"] > 0.5
    assert rows[1]["codebook_bytes"] > 0 == rows[0]["codebook_bytes"]
    model = DejaVu().learn(files.SOURCES[files.ROAD].format(places=60, traverse=0))
    model.save(tmp_path / "map.safetensors")
    assert rows[0]["bytes"] == pytest.approx((tmp_path / "map.safetensors").stat().st_size, rel=0.01)


def test_alike(films, monkeypatch):
    places = normalize(torch.randn(60, 16), dim=1).repeat(2, 1)
    np.save(films / "laps.npy", (places + 0.01 * torch.randn(120, 16)).numpy())
    np.save(films / "lap.npy", places[:60].numpy())
    (films / "lap.csv").write_text("query,place\n" + "".join(f"{i},{i % 60}\n" for i in range(120)))
    road = Route("{data}/road.npy", "{data}/drive.npy", 5, "{data}/truth.csv")
    laps = Route("{data}/lap.npy", "{data}/laps.npy", 0, "{data}/lap.csv")
    monkeypatch.setattr(alike, "ROUTES", {"road": (road, None)})
    monkeypatch.setattr(alike, "LAPS", {"laps": laps})
    monkeypatch.setattr(alike, "ONCE", {"road": "{data}/road.npy?stop=90"})
    benchmark("alike", films, "--out", films / "out")
    rows = rows_of(films / "out")
    found = {(row["case"], row["contender"], row["precision"]): row for row in rows}
    for way in (CAPPED, UNCAPPED):
        assert found["road", way, 0.5]["right"] > 100
    lap = found["loops: laps", CHECKED, 0.5]
    assert lap["right"] == lap["judged"] > 50
    assert found["loops: laps", SINGLE, None]["right"] == 60
    assert found["loops: road, once", CHECKED, 0.5]["right"] == 0
    monkeypatch.setattr(tables, "read", lambda name: {"rows": rows})
    assert [len(part.splitlines()) for part in tables.TABLES["alike"]().split("\n\n")] == [3, 4]


def test_provenance(films, monkeypatch):
    road = Route("{data}/road.npy", "{data}/drive.npy", 5, "{data}/truth.csv")
    ready = Route("{data}/rows.npy", "{data}/again.npy")
    rows = normalize(torch.nn.functional.avg_pool1d(torch.randn(1, 32, 190), 11, 1)[0].T, dim=1)
    np.save(films / "rows.npy", rows.numpy())
    np.save(films / "again.npy", (rows + 0.3 * normalize(torch.randn(1, 32))).numpy())
    monkeypatch.setattr(provenance, "PAIRS", {"road": road, "rows": ready})
    benchmark("provenance", films, "--out", films / "out")
    rows = rows_of(films / "out")
    found = {(row["case"], row["contender"]): row for row in rows if row["places"] is not None}
    assert [found[case, provenance.VISIT]["told"] for case in ("road", "rows")] == ["", ""]
    assert found["rows", provenance.OWN]["told"] == "frames"
    assert found["rows", provenance.BETWEEN]["told"] == "between"
    monkeypatch.setattr(tables, "read", lambda name: {"rows": rows})
    assert [len(part.splitlines()) for part in tables.TABLES["provenance"]().split("\n\n")] == [4, 1]


def test_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr(chunks, "LENGTHS", (64, 128, 256))
    monkeypatch.setattr(chunks, "PUBLISHED", {"aerial": PUBLISHED["aerial"]})
    benchmark("chunks", "--frames", "140", "--out", tmp_path / "out")
    rows = rows_of(tmp_path / "out")
    assert [row["contender"] for row in rows] == ["chunks of 64", "chunks of 128"]  # 256 is longer
    assert rows[0]["bytes_per_place"] != rows[1]["bytes_per_place"]
    assert all(0 < row["recall_at_1"] <= 1 and 0 < row["auc"] <= 1 for row in rows)


def test_live(tmp_path, monkeypatch, capsys):
    short = live.bench_live(400, 40, ((32, 48),), (96, 128), numbers=12)
    monkeypatch.setattr(live, "bench_live", lambda: short)
    benchmark("live", "--out", tmp_path)
    assert "filter" in capsys.readouterr().out
    rows = rows_of(tmp_path)
    case = "96 x 128 on a map of 32 x 48"
    assert [(row["case"], row["contender"]) for row in rows] == [(case, "dejavu")]
    for row in rows:
        assert 0 < row["seconds"] <= row["seconds_p99"]
        assert row["recall_at_1"] > 0.8
        assert 0 <= row["dropped"] < row["frames"] == 40
        assert set(row["parts"]) == {"decoding", "features", "whitening", "search", "scores", "filter"}
        assert sum(row["parts"].values()) > row["seconds"] / 10
    assert (tmp_path / "bench.png").is_file()


def test_train(tmp_path, monkeypatch, capsys):
    def small():
        return SmallCNN(dimension=12, resize=(16, 16), widths=(4, 8), squeeze=4, cell=0)

    rungs = [Rung("plain", small, Augmentation), Rung("other", small, lambda: Augmentation(noise=0.0))]
    monkeypatch.setattr(train, "ladder", lambda: rungs)
    pair = (f"sim:aerial?frames=64&traverse={i}" for i in range(2))
    benchmark("train", *pair, "--out", tmp_path, "--steps", "3", "--seeds", "0", "1")
    rows = rows_of(tmp_path)
    assert [(row["contender"], row["seed"]) for row in rows] == [
        (name, seed) for name in ("plain", "other") for seed in (0, 1)
    ]
    for row in rows:
        assert row["seconds"] > 0
        assert row["auc"].keys() == row["recall_at_1"].keys() == {"2.4", "1"}
        assert all(0 <= value <= 1 for value in row["auc"].values())
    assert rows[0]["auc"] != rows[1]["auc"]
    lines = capsys.readouterr().out.splitlines()
    shown = [line for line in lines if line.startswith(("plain", "other"))]
    assert len(shown) == 2
    assert all(line.endswith("-") for line in shown)  # too few bytes for so short a route
    assert (tmp_path / "bench.png").is_file()


def test_spread(tmp_path, monkeypatch, capsys):
    seen = []

    def made(words, folder, report, environment):
        seed = words[words.index("--seed") + 1]
        seen.append((seed, environment["OMP_NUM_THREADS"]))
        folder.mkdir(parents=True, exist_ok=True)
        report.write_text(json.dumps({"auc": int(seed) / 10, "recall_at_1": 0.5, "fixed_bytes": 7}))
        (folder / "matches.csv").write_text(f"place\n4\n{seed}\n")

    monkeypatch.setattr(spread, "done_once", made)
    monkeypatch.setattr(spread, "imitable", lambda: ["this", "oldest"])
    given = ("spread", "a", "b", "--tolerance", "0", "--out", tmp_path / "out")
    benchmark(*given, "--seeds", "3")
    assert seen == [("0", "1"), ("0", "2")] * 2 + [("1", "1"), ("2", "1"), ("3", "1")]
    rows = rows_of(tmp_path / "out")
    assert [row["differ"] for row in rows] == [0, 0, 0, 0, 0.5, 0.5, 0.5]
    said = capsys.readouterr().out
    assert "by processor: auc 0.000, standard deviation 0.000" in said
    assert "by seed: auc 0.200, standard deviation 0.100" in said
    assert "1 seeds" in benchmark_fails(capsys, *given, "--seeds", "1")
    monkeypatch.setattr(spread, "done_once", lambda *_: "a is not there")
    assert "a is not there" in benchmark_fails(capsys, *given)


def test_frames_without_a_place_are_not_counted_as_wrong():
    truth = as_ground_truth(torch.tensor([[0], [1], [-1], [3], [40]]))
    views = LabelledFrames(ArrayTraverse(torch.rand(4, 3)), torch.tensor([1, 9, -1, 30]))
    task = Task(TASKS["laps, first, then last"].learned, (1, None))
    assert right_of(views, truth, task, tolerance=5) == 0.5  # of those at 1 and 40


def test_teaching(films, monkeypatch):
    route = Route("{data}/road.npy", "{data}/drive.npy", 5, "0")
    wrong = Route("{data}/road.npy", "{data}/drive.npy?start=30", 5, None)
    tasks = {"own": Task(route, (0, 90), None, (60, None)), "wrong": Task(wrong, asked=route)}
    monkeypatch.setattr(teaching, "TASKS", tasks)
    run_teaching(films, out=films)
    rows = rows_of(films)
    assert [row["contender"] for row in rows] == [COPIES, PLACED, REFINED, TOLD, COPIES, PLACED, REFINED]
    own = {row["contender"]: row for row in rows[:4]}
    assert own[PLACED]["of"] == 90
    assert own[PLACED]["placed"] >= 60
    assert own[PLACED]["right"] > 0.98
    assert all(0 <= row["auc"] <= 1 for row in rows)
    assert own[COPIES]["asked"] == 60
    monkeypatch.setattr(tables, "read", lambda name: {"rows": rows})
    table = tables.taught().splitlines()
    assert len(table) == 4
    assert f"{own[PLACED]['placed']} of 90" in table[2]


def test_visits(films, monkeypatch):
    route = Route("{data}/road.npy?stop=90", "{data}/drive.npy?stop=90", 5, "0")
    monkeypatch.setattr(visits, "VISITS", {"road": Visits(route, (0, 60), ((route.query, 20, None),))})
    lines = run_visits(films, out=films / "out")
    assert "AUC of another drive" in lines[-1]
    assert (films / "out" / "bench.png").stat().st_size > 5000
    rows = rows_of(films / "out")
    ways = [(ANEW, 0), (ANEW, 1), (UPDATED, 0), (UPDATED, 1)]
    assert [(row["contender"], row["drives"]) for row in rows] == ways
    assert rows[0]["auc"] == rows[2]["auc"]
    assert "frames placed" in rows[3]["told"]
    assert [*curves(rows)["road"]] == [ANEW, UPDATED]
    monkeypatch.setattr(tables, "read", lambda name: {"rows": rows})
    assert len(tables.visits().splitlines()) == 4
