"""`benchmarks visits`: maps after more and more drives."""

from __future__ import annotations

import json

import numpy as np
import torch

from benchmarks import tables, visits
from benchmarks.trainings import Route
from benchmarks.visits import ANEW, UPDATED, Visits, curves, run_visits
from dejavu_torch import open_source


def test_a_row_for_each_number_of_drives(tmp_path, monkeypatch):
    for name, traverse in (("road", 0), ("drive", 1)):
        frames = torch.cat(list(open_source(f"sim:aerial?frames=120&traverse={traverse}").batches(120)))
        pixels = frames[..., ::2, ::2].mul(255).byte().permute(0, 2, 3, 1).numpy()
        np.save(tmp_path / f"{name}.npy", pixels)
    route = Route("{data}/road.npy?stop=90", "{data}/drive.npy", 5, None)
    (tmp_path / "truth.csv").write_text("query,place\n" + "".join(f"{i},{i}\n" for i in range(90)))
    route = route._replace(truth="{data}/truth.csv")
    monkeypatch.setattr(visits, "VISITS", {"road": Visits(route, (0, 60), ((route.query, 20, None),))})
    lines = run_visits(tmp_path, out=tmp_path / "out")
    assert "AUC of another drive" in lines[-1]
    assert (tmp_path / "out" / "bench.png").stat().st_size > 5000
    rows = json.loads((tmp_path / "out" / "bench.json").read_text())["rows"]
    ways = [(ANEW, 0), (ANEW, 1), (UPDATED, 0), (UPDATED, 1)]
    assert [(row["contender"], row["drives"]) for row in rows] == ways
    assert rows[0]["auc"] == rows[2]["auc"]
    assert "frames placed" in rows[3]["told"]
    assert [*curves(rows)["road"]] == [ANEW, UPDATED]
    monkeypatch.setattr(tables, "read", lambda name: {"rows": rows})
    assert len(tables.visits().splitlines()) == 4
