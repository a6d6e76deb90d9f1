"""What the docs tell of training with a network of one's own, which has no standardised features."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import pytorch_lightning as pl
import torch
from small_training import FRAMES, footage, mapper, warned
from torch import nn

from dejavu_torch import DejaVu, DescriptorTask, RouteData, SpectralMapper, TemplateTask, evaluate
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation import Scores
from dejavu_torch.training.export import MapExport
from dejavu_torch.training.losses import NothingLearned

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "own_loop.md"
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.figures) for seed in (1, 2))]


@pytest.mark.figures
@pytest.mark.parametrize(
    "route", ["sim:aerial?frames=300&size=32", "sim:outdoor?frames=300&height=32&width=32"]
)
@pytest.mark.parametrize("seed", range(3))
def test_the_loop_of_the_page_beats_its_untrained_network(seed, route, tmp_path, monkeypatch):
    """The page itself, of one seed and route, is run by test_readme."""
    monkeypatch.chdir(tmp_path)
    found = re.search(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert found is not None
    code = found[1].replace("manual_seed(0)", f"manual_seed({seed})")
    code = code.replace("sim:aerial?frames=300&size=32", route)
    space = {}
    exec(code, space)
    assert space["trained"].auc > space["untrained"].auc + 0.15


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


@pytest.mark.parametrize("seed", SEEDS)
def test_the_recipe_learns_with_an_ordinary_backbone(seed, tmp_path):
    torch.manual_seed(seed)
    task = DescriptorTask(ordinary(), mapper=SpectralMapper(8.0), rate=0.3)  # as on the page
    export = trained(task, tmp_path, 200)
    assert export.written is not None
    torch.manual_seed(seed)
    untrained = DejaVu(ordinary(), "none", mapper=SpectralMapper(8.0)).learn(ArrayTraverse(footage()))
    found, before = (
        evaluate(model.localize(ArrayTraverse(footage(0.3))), range(FRAMES), tolerance=2).recall_at_1
        for model in (export.written[1], untrained)
    )
    assert found > before + 0.05


def test_templates_of_features_without_scale_name_the_cure(tmp_path, monkeypatch):
    monkeypatch.setattr("dejavu_torch.training.losses.BELOW", 0.0)  # nothing counts as learned
    task = TemplateTask(ordinary(), mapper=mapper())
    with pytest.raises(NothingLearned, match=r"BatchNorm1d\(D, affine=False\).*DescriptorTask"):
        trained(task, tmp_path, 120)


def test_python_is_warned_of_a_map_that_lost_to_the_untrained_one(tmp_path, monkeypatch, caplog):
    lost, won = (Scores(area, area, 1, 1, 1, 1, 1) for area in (0.5, 0.75))
    scores = {"the trained map": lost, "the untrained map": won}
    monkeypatch.setattr("dejavu_torch.training.export.compare_with_untrained", lambda *_: scores)
    given = {"validation": ArrayTraverse(footage(0.1)), "validation_truth": "0"}
    trained(DescriptorTask(ordinary(), mapper=SpectralMapper(8.0), rate=0.3), tmp_path, 2, **given)
    (line,) = [one for one in warned(caplog) if "worse" in one]
    assert "the trained map is worse than the untrained map" in line
