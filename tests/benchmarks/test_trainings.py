"""`benchmarks trainings`: trainings beside the untrained map, taken up where an earlier run was stopped."""

from __future__ import annotations

import json
import subprocess

from command_line import benchmark, run_here

from benchmarks import trainings
from benchmarks.trainings import Route


def test_a_training_is_set_beside_the_untrained_map_and_made_once(tmp_path, monkeypatch, capsys):
    flight = Route(
        "sim:aerial?frames=120", "sim:aerial?frames=120&traverse=1", options="--trainer.max_steps 1"
    )
    broken = flight._replace(options="--model.lr 0")
    monkeypatch.setattr(trainings, "ROUTES", {"flight, short": flight, "broken": broken})
    given = ("trainings", tmp_path, "--out", tmp_path / "out", "--seeds", "3", "--jobs", "2")

    def refusing(command, **settings):
        refused = ["sh", "-c", "echo 'dejavu: lr is 0'; exit 2"]  # sooner than a training
        return run_here(refused if "--model.lr" in command else command, **settings)

    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "run", refusing)
        benchmark(*given)
    rows = json.loads((tmp_path / "out" / "bench.json").read_text())["rows"]
    found = {(row["case"], row["contender"]): row for row in rows}
    for kind in (
        "HOG of all frames",
        "untrained 5 B",
        "untrained, null 5 B",
        "trained 5 B",
        "trained default",
    ):
        assert 0 <= found["flight, short", kind]["auc"] <= 1
    assert found["flight, short", "trained 5 B"]["seed"] == 3
    assert found["flight, short", "trained 5 B"]["route_bytes_per_place"] <= 5
    assert found["broken", "trained"]["skipped"].startswith("lr is 0")  # told, not lost
    assert "broken, seed 3: " in capsys.readouterr().out
    assert (tmp_path / "out" / "bench.png").is_file()
