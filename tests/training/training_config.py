"""A config of `dejavu train`, and backbones that a user might bring."""

from __future__ import annotations

from dejavu_torch.cli import main

CONFIG = """
model:
  backbone:
    class_path: dejavu_torch.features.cnn.SmallCNN
    init_args: {dimension: 8, channels: 1, resize: [16, 16], widths: [4, 8], squeeze: 4}
  periods:
    class_path: dejavu_torch.periods.imposed.ImposedPeriods
    init_args: {periods: [3, 4, 5], bin: 2}
data: {source: one.npy, batch_size: 20, tolerance: 2}
trainer: {max_steps: 4, accelerator: cpu, enable_progress_bar: false, default_root_dir: run}
"""
MINE = """
import torch
from torch import nn

class Plain(nn.Module):
    def __init__(self, dimension: int = 8) -> None:
        super().__init__()
        self.linear = nn.Linear(256, dimension)
        self.calls = 0
    def forward(self, frames):
        self.calls += self.training
        return self.linear(frames.flatten(1))

class Deep(Plain):
    def forward(self, frames):
        return super().forward(frames)[..., None]

class Broken(nn.Module):
    def __init__(self) -> None:
        raise RuntimeError("no weights\\nto be had")

class Late(Plain):
    def forward(self, frames):
        return super().forward(frames) * (float("nan") if self.calls > 2 else 1.0)

class Interrupted(Plain):
    def forward(self, frames):
        if self.calls > 2:
            raise KeyboardInterrupt
        return super().forward(frames)
"""


def train(command: str, *options: object, config: str = "train.yaml") -> None:
    main(["train", command, "--config", config, *map(str, options)])
