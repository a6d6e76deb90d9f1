"""`benchmarks alike`: what counts as accepted and right, and its tables."""

from __future__ import annotations

import json

import numpy as np
import torch
from command_line import benchmark
from torch.nn.functional import normalize

from benchmarks import alike, tables
from benchmarks.alike import CAPPED, CHECKED, SINGLE, UNCAPPED
from benchmarks.trainings import Route
from dejavu_torch import open_source


def test_routes_laps_and_drives_become_two_tables(tmp_path, monkeypatch):
    for name, traverse in (("road", 0), ("drive", 1)):
        frames = torch.cat(list(open_source(f"sim:aerial?frames=120&traverse={traverse}").batches(120)))
        np.save(tmp_path / f"{name}.npy", frames[..., ::2, ::2].mul(255).byte().permute(0, 2, 3, 1).numpy())
    places = normalize(torch.randn(60, 16), dim=1).repeat(2, 1)
    np.save(tmp_path / "laps.npy", (places + 0.01 * torch.randn(120, 16)).numpy())
    np.save(tmp_path / "lap.npy", places[:60].numpy())
    (tmp_path / "truth.csv").write_text("query,place\n" + "".join(f"{i},{i}\n" for i in range(120)))
    (tmp_path / "lap.csv").write_text("query,place\n" + "".join(f"{i},{i % 60}\n" for i in range(120)))
    road = Route("{data}/road.npy", "{data}/drive.npy", 5, "{data}/truth.csv")
    monkeypatch.setattr(alike, "ROUTES", {"road": (road, None)})
    monkeypatch.setattr(
        alike, "LAPS", {"laps": Route("{data}/lap.npy", "{data}/laps.npy", 0, "{data}/lap.csv")}
    )
    monkeypatch.setattr(alike, "ONCE", {"road": "{data}/road.npy?stop=90"})
    benchmark("alike", tmp_path, "--out", tmp_path / "out")
    bench = json.loads((tmp_path / "out" / "bench.json").read_text())
    found = {(row["case"], row["contender"], row["precision"]): row for row in bench["rows"]}
    for way in (CAPPED, UNCAPPED):
        assert found["road", way, 0.5]["right"] > 100
    lap = found["loops: laps", CHECKED, 0.5]
    assert lap["right"] == lap["judged"] > 50
    assert found["loops: laps", SINGLE, None]["right"] == 60
    assert found["loops: road, once", CHECKED, 0.5]["right"] == 0
    monkeypatch.setattr(tables, "read", lambda name: bench)
    assert [len(part.splitlines()) for part in tables.TABLES["alike"]().split("\n\n")] == [3, 4]
