"""A training of seconds: footage, backbone, task and trainer; and the config and classes of a user."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from pytorch_lightning import Callback, Trainer
from pytorch_lightning.callbacks import ModelCheckpoint
from torch import nn

from dejavu_torch import DejaVu, ImposedPeriods, SpectralMapper, TemplateMapper
from dejavu_torch.cli import main
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.training.datamodule import RouteData
from dejavu_torch.training.descriptors import DescriptorTask
from dejavu_torch.training.export import MapExport
from dejavu_torch.training.templates import TemplateTask

FRAMES = 40


def footage(noise=0.0, frames=FRAMES, side=16):
    """(N,side,side) uint8, a window slid along a smooth strip by 2 pixels a frame."""
    random = torch.Generator().manual_seed(0)
    strip = torch.rand(1, 1, 4, frames, generator=random)
    strip = nn.functional.interpolate(strip, (side, 2 * frames + side), mode="bicubic")[0, 0]
    windows = torch.stack([strip[:, 2 * i : 2 * i + side] for i in range(frames)])
    noisy = windows + noise * torch.randn(windows.shape, generator=random)
    return (255 * noisy.clamp(0, 1)).byte()


def backbone(dimension=8):
    return SmallCNN(dimension, channels=1, resize=(16, 16), widths=(4, 8), squeeze=4)


def coded(**settings):
    """With a hidden layer: a descriptor, and a code of it."""
    given = {"dimension": 12, "channels": 1, "resize": (16, 16), "hidden": 16} | settings
    return Embedding(**{"network": backbone()} | given)


def mapper(periods=None, **settings):
    return TemplateMapper(ImposedPeriods([3, 4, 5], bin=2) if periods is None else periods, **settings)


def new_task(**settings):
    return TemplateTask(**{"backbone": backbone(), "mapper": mapper()} | settings)


def new_descriptor(**settings):
    return DescriptorTask(**{"backbone": coded(), "mapper": SpectralMapper(20.0)} | settings)


def still(**strengths):
    """Which changes nothing but what is given."""
    none = dict.fromkeys(("rotation", "scale", "gamma", "illumination", "blur", "occlusion", "noise"), 0.0)
    pairs = dict.fromkeys(("colour", "shift", "exposure"), (0.0, 0.0))
    return Augmentation(**none | pairs | strengths)  # type: ignore[arg-type]


def data_of(source=None, **settings):
    given = {"tolerance": 2, "batch_size": 16} | settings
    return RouteData(ArrayTraverse(footage() if source is None else source), **given)


def trainer(folder, *callbacks, **settings):
    given = {"max_steps": 4, "accelerator": "cpu", "enable_checkpointing": bool(callbacks)} | settings
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    return Trainer(default_root_dir=folder, callbacks=[*callbacks, MapExport()], **quiet, **given)


def last(folder, **settings):
    """Keeps `checkpoints/last.ckpt`, as the command does."""
    return ModelCheckpoint(folder / "checkpoints", save_last=True, save_top_k=0, **settings)


def heights(steps):
    """The learning rates of so many steps, beside the highest."""
    rise = max(1, steps // 10)
    falls = [0.5 + 0.5 * math.cos(math.pi * k / (steps - rise)) for k in range(steps - rise)]
    return [(k + 1) / rise for k in range(rise)] + falls


def fit(folder, task, data, **settings):
    """The map that a training writes."""
    trainer(folder, **settings).fit(task, data)
    return DejaVu.load(folder / "map.safetensors")


def warned(caplog):
    """The package's warnings, but for those that tell of this machine."""
    told = [record.getMessage() for record in caplog.records if record.name == "dejavu_torch"]
    return [line for line in told if "bfloat16" not in line and "GPU available but not used" not in line]


def recall(model, query):
    truth = torch.arange(len(query))[:, None]
    return evaluate(model.localize(ArrayTraverse(query)), truth, tolerance=2).recall_at_1


def assert_same_scores(task, model):
    """Of the task, of its map, and of the exported program."""
    frames = footage(0.1)[:7, None] / 255
    with torch.no_grad():
        scores = task.eval()(frames)
        torch.testing.assert_close(model(frames), scores, rtol=1e-5, atol=1e-5)
        program = torch.export.export(
            model, (frames[:2],), dynamic_shapes={"queries": {0: torch.export.Dim("batch")}}
        )
        torch.testing.assert_close(program.module()(frames), scores, rtol=1e-5, atol=1e-5)
    assert scores.shape == (7, FRAMES)
    assert not list(model.map.parameters())


class Stop(Callback):
    """Saves a checkpoint after some steps, and ends the training."""

    def __init__(self, steps: int, path: Path | None = None) -> None:
        self.steps, self.path = steps, path

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == self.steps:
            if self.path is not None:
                trainer.save_checkpoint(self.path)
            trainer.should_stop = True


CONFIG = """
model:
  class_path: dejavu_torch.TemplateTask
  init_args:
    backbone:
      class_path: dejavu_torch.features.cnn.SmallCNN
      init_args: {dimension: 8, channels: 1, resize: [16, 16], widths: [4, 8], squeeze: 4}
    mapper:
      class_path: dejavu_torch.TemplateMapper
      init_args:
        periods:
          class_path: dejavu_torch.ImposedPeriods
          init_args: {periods: [3, 4, 5], bin: 2}
data: {source: one.npy, batch_size: 20, tolerance: 2}
trainer: {max_steps: 4, accelerator: cpu, enable_progress_bar: false, default_root_dir: run}
"""
MINE = """
from torch import nn

class Plain(nn.Module):
    def __init__(self, dimension: int = 8) -> None:
        super().__init__()
        self.linear = nn.Linear(256, dimension)
        self.calls = 0
    def forward(self, frames):
        self.calls += self.training
        return self.linear(frames.flatten(1))

class Broken(nn.Module):
    def __init__(self) -> None:
        raise RuntimeError("no weights\\nto be had")

class Hungry(Plain):
    def forward(self, frames):
        if self.calls > 2:
            raise MemoryError
        return super().forward(frames)

class Interrupted(Plain):
    def forward(self, frames):
        if self.calls > 3:
            raise KeyboardInterrupt
        return super().forward(frames)
"""


DESCRIPTOR = ["--model", "DescriptorTask", "--model.mapper", "SpectralMapper"]


def train(command, *options, config="train.yaml"):
    main(["train", command, "--config", config, *map(str, options)])
