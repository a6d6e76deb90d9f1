"""A training by two processes is that of one with the doubled batch.

As a script, `python test_several_processes.py FOLDER`, this file trains by two: first `dejavu train` with the
config in FOLDER, which starts a second process that runs this file as well; then both go on with the cases.
What each step logs and the weights after it are kept in FOLDER, in a file for each case and process.
"""

from __future__ import annotations

import copy
import logging
import math
import os
import subprocess
import sys
import warnings
from collections import OrderedDict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import pytorch_lightning as pl
import torch
from small_training import CONFIG, backbone, data_of, footage, mapper, still, trainer
from torch import Tensor, nn

from dejavu_torch import DejaVu, Embedding, SpectralMapper
from dejavu_torch.cli import main
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.training.export import LastCheckpoint
from dejavu_torch.training.task import PlaceRecognitionTask

BATCH = 16  # of all processes


def residues(noise: float = 0.0) -> Embedding:
    """With batch normalisation, which is by each process's part of a batch; each draws its own noise."""
    first = nn.Conv2d(1, 4, 3, stride=2, bias=False)
    network = nn.Sequential(first, nn.BatchNorm2d(4), nn.ReLU(), nn.Conv2d(4, 8, 3))
    made = Embedding(network, dimension=8, hidden=12, channels=1, resize=(16, 16))
    assert made.coder is not None
    made.coder.noise = noise
    return made


# a standardisation takes away any bias ahead of it: its gradient is rounding, of which Adam makes steps
CASES: dict[str, dict[str, Any]] = {
    "templates": {"mapper": mapper(), "refresh": 1, "feature_weights": True, "freeze": ["linear.bias"]},
    "rate": {"mapper": SpectralMapper(route_bytes_per_place=8.0), "rate": 0.3, "freeze": ["linear.bias"]},
    "stages": {"mapper": mapper(), "descriptor": 0.4, "freeze": ["linear.layers.3.bias"]},
    "augmented": {"mapper": mapper()},
}


class Steps(pl.Callback):
    """What each step logs."""

    def __init__(self) -> None:
        self.figures: list[dict[str, float]] = []

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        self.figures.append({name: float(value) for name, value in trainer.callback_metrics.items()})


def run(case: str, processes: int, folder: Path) -> None:
    """Train, and keep what came of it."""
    torch.manual_seed(0)
    # without batch normalisation
    plain = nn.Sequential(OrderedDict(flatten=nn.Flatten(), linear=nn.Linear(256, 8)))
    network = residues() if case == "stages" else backbone() if case == "augmented" else plain
    task = PlaceRecognitionTask(network, **CASES[case], lr=1e-2)
    data = data_of(
        batch_size=BATCH // processes,
        second=footage(0.1)[:35],
        second_truth=4,  # some of its frames show no place
        augmentation=Augmentation() if case == "augmented" else still(),
        validation=footage(0.05)[:37],
        validation_truth=0,
    )
    steps, beginning = Steps(), copy.deepcopy(network.state_dict())
    shared = {"devices": processes, "strategy": "ddp" if processes > 1 else "auto", "num_sanity_val_steps": 0}
    limits = {"max_steps": 2 if case == "augmented" else 7, "gradient_clip_val": 1.0}
    running = trainer(folder / f"{case}{processes}", steps, LastCheckpoint(4), **shared, **limits)
    # a training makes its processes begin alike
    torch.manual_seed(1 + running.global_rank)
    for parameter in network.parameters():
        parameter.data += running.global_rank
    running.fit(task, data)
    kept = (steps.figures, beginning, task.dejavu.features.state_dict())
    torch.save(kept, folder / f"{case}{processes}-{running.global_rank}.pt")


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
        [sys.executable, __file__, folder],
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


if __name__ == "__main__":
    logging.getLogger("pytorch_lightning").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore")
    folder = Path(sys.argv[1])
    os.chdir(folder)
    words = ["fit", "--config", "train.yaml", "--data.batch_size", "10", "--trainer.devices", "2"]
    main(["train", *words, "--trainer.strategy", "ddp"])
    del os.environ["PL_GLOBAL_SEED"]  # with which Lightning would begin the cases
    for case in CASES:
        run(case, 2, folder)
