"""Templates that are not trained: the phase means of the present features (eq. 1), whenever they are used."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from pytorch_lightning import Callback, Trainer
from pytorch_lightning.callbacks import ModelCheckpoint
from test_task import Later, assert_figures, data_of, fit, footage, new_task, phases, trainer
from torch import Tensor, nn

from dejavu_torch import DejaVu, PhaseTemplates
from dejavu_torch.data.arrays import ArrayTraverse


def assert_means(model: DejaVu) -> None:
    """The templates are the phase means of what the features are now."""
    features = model.map.weighted(model.extract_all(ArrayTraverse(footage())))
    means = PhaseTemplates()(features, model.map.plan)
    for block, mean in zip(model.map.blocks(), means, strict=True):
        torch.testing.assert_close(block, mean, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("weights", [False, True])
def test_the_map_has_the_means_of_the_final_features(tmp_path: Path, weights: bool) -> None:
    settings = {"train_templates": False, "feature_weights": weights, "lr": 0.02}
    model = fit(tmp_path, new_task(**settings), data_of(), limit_val_batches=0)
    assert (len(model.map.weights) > 0) == weights
    assert_means(model)
    trained = fit(tmp_path, new_task(lr=0.02), data_of())
    with pytest.raises(AssertionError):
        assert_means(trained)


class Means(Callback):
    """Looks at the templates when an epoch begins, and when its validation does."""

    def __init__(self) -> None:
        self.seen: list[Tensor] = []

    def on_train_batch_start(self, trainer: Trainer, pl_module: Any, batch: Any, batch_idx: int) -> None:
        if batch_idx == 0 and trainer.current_epoch:  # the first means are those of untrained features
            self.look(pl_module)

    def on_validation_batch_start(self, trainer: Trainer, pl_module: Any, *args: Any) -> None:
        self.look(pl_module)

    def look(self, task: Any) -> None:
        self.seen.append(task.dejavu.map.templates.clone())
        modes = [(part, part.training) for part in task.modules()]
        task.eval()
        assert_means(task.dejavu)
        for part, mode in modes:
            part.training = mode


@pytest.mark.parametrize(("batches", "looks"), [(0, 2), (1, 5)])
def test_they_are_retaken_every_epoch_and_ahead_of_every_validation(
    tmp_path: Path, batches: int, looks: int
) -> None:
    means, task = Means(), new_task(train_templates=False, periods=Later(), lr=0.02)
    given = {"limit_val_batches": batches, "num_sanity_val_steps": 0, "enable_checkpointing": False}
    running = trainer(tmp_path, means, max_epochs=3, max_steps=-1, **given)
    running.fit(task, data_of())
    assert len(means.seen) == looks
    assert not torch.equal(means.seen[0], means.seen[-1])
    assert task.dejavu.periods.asked == 1  # type: ignore[union-attr]
    model = DejaVu.load(tmp_path / "map.safetensors")
    assert phases(model) == phases(task) == [3, 4]
    assert_means(model)


def test_a_checkpoint_is_judged_as_the_map_is(tmp_path: Path) -> None:
    """Its templates are those of the last epoch's start."""
    kept = ModelCheckpoint(tmp_path, save_last=True)
    settings = {"train_templates": False, "lr": 0.02}
    trainer(tmp_path, kept, max_steps=6, limit_val_batches=0).fit(new_task(**settings), data_of())
    state = torch.load(tmp_path / "last.ckpt", weights_only=True)
    model = DejaVu.load(tmp_path / "map.safetensors")
    assert not torch.allclose(state["state_dict"]["dejavu.map.templates"], model.map.templates, atol=1e-3)
    task, running = new_task(**settings), trainer(tmp_path)
    running.validate(task, data_of(), ckpt_path=tmp_path / "last.ckpt", verbose=False)
    torch.testing.assert_close(task.dejavu.map.templates, model.map.templates)
    assert_figures(running, task, footage(0.2))


def test_deploying_changes_nothing_that_is_trained(tmp_path: Path) -> None:
    task = new_task(train_templates=False, feature_weights=True)
    running = trainer(tmp_path)
    running.fit(task, data_of())
    before = dict(task.named_parameters())
    values = {name: parameter.detach().clone() for name, parameter in before.items()}
    model = task.deployed()
    assert isinstance(task.dejavu.map.weights, nn.Parameter)
    after = dict(task.named_parameters())
    assert after.keys() == before.keys()
    assert all(after[name] is before[name] for name in before)
    assert all(torch.equal(after[name], values[name]) for name in values)
    optimised = {id(p) for group in running.optimizers[0].param_groups for p in group["params"]}
    assert id(task.dejavu.map.weights) in optimised
    assert not list(model.map.parameters())
