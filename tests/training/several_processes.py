"""Trainings of a few steps by one process, or by two: `python several_processes.py FOLDER`.

First `dejavu train` trains by two processes with the config in FOLDER. It starts the second, which runs this
file as well, and both go on with the cases. What each step logs and the weights behind it are kept in FOLDER,
in a file for each case and process.
"""

from __future__ import annotations

import copy
import logging
import os
import sys
import warnings
from collections import OrderedDict
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
import torch
from small_training import backbone, data_of, footage, mapper, still, trainer
from torch import nn

from dejavu_torch import Embedding, SpectralMapper
from dejavu_torch.cli import main
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.training.export import LastCheckpoint
from dejavu_torch.training.task import PlaceRecognitionTask

BATCH = 16  # of all processes


def residues() -> Embedding:
    """With batch normalisation, which is by each process's part of a batch."""
    first = nn.Conv2d(1, 4, 3, stride=2, bias=False)
    network = nn.Sequential(first, nn.BatchNorm2d(4), nn.ReLU(), nn.Conv2d(4, 8, 3))
    made = Embedding(network, dimension=8, hidden=12, channels=1, resize=(16, 16))
    assert made.coder is not None
    made.coder.noise = 0.0  # each process draws its own
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
