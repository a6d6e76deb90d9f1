"""A training by two processes is that of one with the doubled batch."""

from __future__ import annotations

import math
import os
import socket
import subprocess
import sys
from pathlib import Path

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


def surroundings(**more: str) -> dict[str, str]:
    """Variables of a process of its own, which finds this package and these tests."""
    paths = [str(HERE.parents[1]), str(HERE.parent), str(HERE), os.environ.get("PYTHONPATH", "")]
    alone = {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(paths), "MASTER_ADDR": "127.0.0.1"}
    seeded = "PL_GLOBAL_SEED"  # of another test: Lightning would start processes with it, but no single one
    return {name: value for name, value in os.environ.items() if name != seeded} | alone | more


def free_port() -> str:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return str(one.getsockname()[1])


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All cases, by one process and by two, side by side."""
    folder, port = tmp_path_factory.mktemp("trained"), free_port()
    started = [
        subprocess.Popen(
            [sys.executable, HERE / "several_processes.py", "2", folder],
            env=surroundings(LOCAL_RANK=str(process), MASTER_PORT=port),
            stderr=subprocess.PIPE,
            text=True,
        )
        for process in range(2)
    ]
    try:
        for case in CASES:
            run(case, 1, folder)
        told = [one.communicate(timeout=240)[1] for one in started]
    finally:
        for one in started:
            one.kill()
    assert [one.returncode for one in started] == [0, 0], told
    return folder


def kept(folder: Path, case: str, count: int, process: int = 0) -> Kept:
    both: Kept = torch.load(folder / f"{case}{count}-{process}.pt")
    return both


def apart(a: Weights, b: Weights) -> float:
    """How far two states lie apart."""
    return math.sqrt(
        sum(float((value.double() - b[name].double()).square().sum()) for name, value in a.items())
    )


@pytest.mark.parametrize("case", [case for case in CASES if case != "augmented"])
def test_losses_figures_and_weights_are_those_of_the_doubled_batch(trained: Path, case: str) -> None:
    steps, beginning, weights = kept(trained, case, 1)
    found, _, others = kept(trained, case, 2)
    assert len(steps) == len(found)
    for step, other in zip(steps, found, strict=True):
        assert step.keys() == other.keys()
        for name, value in step.items():
            assert other[name] == pytest.approx(value, rel=1e-4, abs=1e-4, nan_ok=True), name
    assert steps[0]["train/loss"] != steps[-1]["train/loss"]
    assert {"val/auc", "train/left_out"} <= steps[-1].keys()
    # Adam makes steps of the rounding of gradients near 0
    moved = apart(weights, beginning)
    assert apart(weights, others) < 1e-2 * moved


@pytest.mark.parametrize("case", CASES)
def test_all_processes_end_alike_and_one_writes(trained: Path, case: str) -> None:
    first, second = (kept(trained, case, 2, process) for process in range(2))
    assert str(first[0]) == str(second[0])  # NaN where nothing is measured
    assert all(torch.equal(value, second[2][name]) for name, value in first[2].items())
    written = [str(path.relative_to(trained / f"{case}2")) for path in (trained / f"{case}2").rglob("*.*")]
    assert written == ["checkpoints/last.ckpt"]


def test_each_process_draws_its_own_augmentation(trained: Path) -> None:
    steps, others = (kept(trained, "augmented", count)[0] for count in (1, 2))
    losses = [[step["train/loss"] for step in one] for one in (steps, others)]
    assert all(math.isfinite(loss) for one in losses for loss in one)
    assert losses[0] != pytest.approx(losses[1], rel=1e-3)
    # as of one process, whose batches get other changes: no bias
    assert sum(losses[0]) == pytest.approx(sum(losses[1]), rel=0.3)


def test_the_command_trains_by_two_processes(tmp_path: Path) -> None:
    np.save(tmp_path / "one.npy", footage().numpy())
    (tmp_path / "train.yaml").write_text(CONFIG)
    words = ["fit", "--config", "train.yaml", "--data.batch_size", "10", "--trainer.devices", "2"]
    words += ["--trainer.strategy", "ddp"]
    done = subprocess.run(
        [sys.executable, "-m", "dejavu_torch.cli", "train", *words],
        cwd=tmp_path,
        env=surroundings(),
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("written to run/map.safetensors") == 1
    assert "Traceback" not in done.stderr
    assert (tmp_path / "run/checkpoints/last.ckpt").is_file()
    model = DejaVu.load(tmp_path / "run/map.safetensors")
    assert model.trained is not None
    assert (model.trained.steps, model.map.places) == (4, 40)
