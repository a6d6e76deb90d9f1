"""What the docs tell of training with a network of one's own, which has no standardised features."""

from __future__ import annotations

import pytorch_lightning as pl
import torch
from small_training import FRAMES, footage
from torch import nn

from dejavu_torch import DejaVu, DescriptorTask, RouteData, SpectralMapper, evaluate
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.training.export import MapExport


def ordinary():
    """Convolutions, batch norm and ReLU, then a linear layer."""
    layers = []
    for before, after, stride in ((1, 8, 2), (8, 16, 2), (16, 16, 2), (16, 16, 1)):
        layers += [nn.Conv2d(before, after, 3, stride, 1), nn.BatchNorm2d(after), nn.ReLU()]
    return nn.Sequential(*layers, nn.Flatten(), nn.Linear(64, 32))


def trained(task, folder, steps, **given):
    export = MapExport()
    silent = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    settings = silent | {"enable_checkpointing": False, "accelerator": "cpu", "limit_val_batches": 0}
    running = pl.Trainer(max_steps=steps, callbacks=[export], default_root_dir=folder, **settings)
    running.fit(task, datamodule=RouteData(footage().numpy(), held_out=0.0, batch_size=16, **given))
    return export


def test_the_recipe_learns_with_an_ordinary_backbone(tmp_path):
    torch.manual_seed(0)
    task = DescriptorTask(ordinary(), mapper=SpectralMapper(8.0), rate=0.3)  # as on the page
    export = trained(task, tmp_path, 200)
    assert export.written is not None
    torch.manual_seed(0)
    untrained = DejaVu(ordinary(), "none", mapper=SpectralMapper(8.0)).learn(ArrayTraverse(footage()))
    found, before = (
        evaluate(model.localize(ArrayTraverse(footage(0.3))), range(FRAMES), tolerance=2).recall_at_1
        for model in (export.written[1], untrained)
    )
    assert found > before + 0.05
