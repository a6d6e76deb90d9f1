"""A training by two processes is that of one with the doubled batch."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from several_processes import CASES, run
from small_training import CONFIG, footage
from torch import Tensor

from dejavu_torch import DejaVu

HERE = Path(__file__).parent
Weights = dict[str, Tensor]
Kept = tuple[
    list[dict[str, float]], Weights, Weights
]  # figures of the steps, weights ahead of and behind them


def surroundings() -> dict[str, str]:
    """Variables of a process of its own, which finds this package and these tests."""
    paths = [str(HERE.parents[1]), str(HERE.parent), str(HERE), os.environ.get("PYTHONPATH", "")]
    alone = {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(paths)}
    seeded = "PL_GLOBAL_SEED"  # of another test: Lightning would start processes with it, but no single one
    return {name: value for name, value in os.environ.items() if name != seeded} | alone


class Trained(NamedTuple):
    """Where all cases were trained by one process and by two, and what the two printed."""

    folder: Path
    stdout: str
    stderr: str


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """All cases by one process, and beside it the command and all cases by two."""
    folder = tmp_path_factory.mktemp("trained")
    np.save(folder / "one.npy", footage().numpy())
    (folder / "train.yaml").write_text(CONFIG)
    with subprocess.Popen(
        [sys.executable, HERE / "several_processes.py", folder],
        env=surroundings(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as started:
        try:
            for case in CASES:
                run(case, 1, folder)
            told = started.communicate(timeout=240)
        finally:
            started.kill()
    assert started.returncode == 0, told
    return Trained(folder, *told)


def kept(folder: Path, case: str, count: int, process: int = 0) -> Kept:
    both: Kept = torch.load(folder / f"{case}{count}-{process}.pt")
    return both


def apart(a: Weights, b: Weights) -> float:
    """How far two states lie apart."""
    return math.sqrt(
        sum(float((value.double() - b[name].double()).square().sum()) for name, value in a.items())
    )


def test_the_first_losses_of_templates_are_those_of_the_doubled_batch(trained: Trained) -> None:
    """Later ones part: the gradient of an L1 distance jumps, and Adam makes steps of its rounding."""
    steps, found = (kept(trained.folder, "templates", count)[0][:2] for count in (1, 2))
    losses = [[step["train/loss"] for step in one] for one in (steps, found)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)


def test_losses_figures_and_weights_are_those_of_the_doubled_batch(trained: Trained) -> None:
    steps, beginning, weights = kept(trained.folder, "rate", 1)
    found, _, others = kept(trained.folder, "rate", 2)
    assert len(steps) == len(found)
    for step, other in zip(steps, found, strict=True):
        assert step.keys() == other.keys()
        for name, value in step.items():
            near = 0.05 if name.startswith("val/") else 1e-4  # scores of similar places change their order
            assert other[name] == pytest.approx(value, rel=1e-4, abs=near, nan_ok=True), name
    assert steps[0]["train/loss"] != steps[-1]["train/loss"]
    assert {"val/auc", "train/left_out"} <= steps[-1].keys()
    # Adam makes steps of the rounding of gradients near 0
    moved = apart(weights, beginning)
    assert apart(weights, others) < 1e-2 * moved


@pytest.mark.parametrize("case", CASES)
def test_all_processes_end_alike_and_one_writes(trained: Trained, case: str) -> None:
    first, second = (kept(trained.folder, case, 2, process) for process in range(2))
    assert str(first[0]) == str(second[0])  # NaN where nothing is measured
    assert all(torch.equal(value, second[2][name]) for name, value in first[2].items())
    root = trained.folder / f"{case}2"
    assert {path.name for path in root.rglob("*.*")} == {"last.ckpt", "map.safetensors"}


def test_each_process_draws_its_own_augmentation(trained: Trained) -> None:
    steps, others = (kept(trained.folder, "augmented", count)[0] for count in (1, 2))
    losses = [[step["train/loss"] for step in one] for one in (steps, others)]
    assert all(math.isfinite(loss) for one in losses for loss in one)
    assert losses[0] != pytest.approx(losses[1], rel=1e-3)
    # as of one process, whose batches get other changes: no bias
    assert sum(losses[0]) == pytest.approx(sum(losses[1]), rel=0.3)


def test_the_command_trains_by_two_processes(trained: Trained) -> None:
    """Of which it starts the second itself."""
    assert trained.stdout.count("written to run/map.safetensors") == 1
    assert "Traceback" not in trained.stderr
    assert (trained.folder / "run/checkpoints/last.ckpt").is_file()
    model = DejaVu.load(trained.folder / "run/map.safetensors")
    assert model.trained is not None
    assert (model.trained.steps, model.map.places) == (4, 40)
