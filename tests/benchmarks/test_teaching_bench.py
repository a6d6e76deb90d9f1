"""`benchmarks teaching`: what is told of maps that learned from a drive."""

from __future__ import annotations

import json

import numpy as np
import torch

from benchmarks import tables, teaching
from benchmarks.teaching import COPIES, PLACED, REFINED, TASKS, TOLD, Task, right_of, run_teaching
from benchmarks.trainings import Route
from dejavu_torch import open_source
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import as_ground_truth
from dejavu_torch.features.views import LabelledFrames


def test_frames_without_a_place_are_not_counted_as_wrong():
    truth = as_ground_truth(torch.tensor([[0], [1], [-1], [3], [40]]))
    views = LabelledFrames(ArrayTraverse(torch.rand(4, 3)), torch.tensor([1, 9, -1, 30]))
    task = Task(TASKS["laps, first, then last"].learned, (1, None))
    assert right_of(views, truth, task, tolerance=5) == 0.5  # of those at 1 and 40


def test_a_row_for_each_way_to_learn(tmp_path, monkeypatch, capsys):
    for name, traverse, part in (("road", 0, slice(0, 120)), ("drive", 1, slice(0, 110))):
        frames = torch.cat(list(open_source(f"sim:aerial?frames=120&traverse={traverse}").batches(120)))
        pixels = frames[part, ..., ::2, ::2].mul(255).byte().permute(0, 2, 3, 1).numpy()
        np.save(tmp_path / f"{name}.npy", pixels)
    route = Route("{data}/road.npy", "{data}/drive.npy", 5, "0")
    wrong = Route("{data}/road.npy", "{data}/drive.npy?start=30", 5, None)
    tasks = {"own": Task(route, (0, 90), None, (60, None)), "wrong": Task(wrong, asked=route)}
    monkeypatch.setattr(teaching, "TASKS", tasks)
    run_teaching(tmp_path, out=tmp_path)
    rows = json.loads((tmp_path / "bench.json").read_text())["rows"]
    assert [row["contender"] for row in rows] == [COPIES, PLACED, REFINED, TOLD, COPIES, PLACED, REFINED]
    own = {row["contender"]: row for row in rows[:4]}
    assert own[PLACED]["of"] == 90
    assert own[PLACED]["placed"] >= 60
    assert own[PLACED]["right"] > 0.98
    assert all(0 <= row["auc"] <= 1 for row in rows)
    assert own[COPIES]["asked"] == 50
    monkeypatch.setattr(tables, "read", lambda name: {"rows": rows})
    table = tables.taught().splitlines()
    assert len(table) == 4
    assert f"{own[PLACED]['placed']} of 90" in table[2]
