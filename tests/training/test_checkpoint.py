"""Checkpoints: what a run goes on from, what it takes over, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import refused
from pytorch_lightning.callbacks import ModelCheckpoint
from small_training import FRAMES, Later, data_of, fit, footage, mapper, new_task, trainer
from test_stages import coded

from dejavu_torch import DejaVu, ImposedPeriods
from dejavu_torch.data.arrays import ArrayTraverse


def train(folder: Path, **settings: Any) -> Path:
    """The last checkpoint of a training of two epochs."""
    kept = ModelCheckpoint(folder, save_last=True)
    trainer(folder, kept, max_epochs=2, max_steps=-1).fit(new_task(**settings), data_of())
    return folder / "last.ckpt"


@pytest.fixture(scope="module")
def last(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tmp_path_factory.mktemp("checkpoint"))


@pytest.mark.parametrize("settings", [{}, {"feature_weights": True}], ids=str)
def test_layers_that_were_found_are_taken_over(tmp_path: Path, settings: dict[str, Any]) -> None:
    """Whatever this run would find: it is not asked for them."""
    first = train(tmp_path, mapper=mapper(Later()), refresh=1, **settings)
    state = torch.load(first, weights_only=True)["state_dict"]
    again = new_task(mapper=mapper(Later()), **settings)
    with torch.no_grad():
        again.dejavu.features.linear.weight.fill_(7)
    resumed = trainer(tmp_path, max_epochs=3, max_steps=-1)
    resumed.fit(again, data_of(), ckpt_path=first)
    assert resumed.global_step == 3 * (FRAMES // 16)
    assert again.dejavu.mapper.periods.asked == 0  # type: ignore[union-attr]
    written = DejaVu.load(tmp_path / "map.safetensors").map
    assert again.route.plan == written.plan
    assert [layer.phases for layer in again.route.plan] == [5, 7, 9]
    assert not torch.equal(again.dejavu.features.linear.weight, state["dejavu.features.linear.weight"])
    evaluated = new_task(mapper=mapper(Later()), **settings)
    trainer(tmp_path).validate(evaluated, data_of(), ckpt_path=first, verbose=False)
    assert evaluated.dejavu.mapper.periods.asked == 0  # type: ignore[union-attr]
    for name in ("dejavu.features.linear.weight", "dejavu.map.templates", "log_temperature"):
        assert torch.equal(evaluated.state_dict()[name], state[name])


def test_a_resumed_run_finds_layers_anew_when_it_is_time_to(tmp_path: Path) -> None:
    first = train(tmp_path, mapper=mapper(Later()))
    again = new_task(mapper=mapper(Later()), refresh=1)
    again.dejavu.mapper.periods.asked = 1  # type: ignore[union-attr]
    running = trainer(tmp_path, max_epochs=3, max_steps=-1)
    running.fit(again, data_of(), ckpt_path=first)
    assert [layer.phases for layer in again.route.plan] == [5, 7, 9]
    optimised = {id(p) for group in running.optimizers[0].param_groups for p in group["params"]}
    assert optimised == {id(p) for p in again.parameters()}


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            {"mapper": mapper(ImposedPeriods([3, 4, 7], bin=2))},
            ("3 in 6, 4 in 8, 5 in 10 frames", "imposes 3 in 6, 4 in 8, 7 in 14", "the same periods"),
        ),
        ({"mapper": mapper(metric="l2")}, ("metric is 'l1'", "expected 'l2'")),
        ({"feature_weights": True}, ("dejavu.map.weights", "not in both", "the same settings")),
        ({"freeze": ["linear"]}, ("dejavu.features.linear.bias, dejavu.features.linear.weight:",)),
        ({"backbone": coded()}, ("of ['CodeStage']", "['DescriptorStage', 'CodeStage']")),
    ],
    ids=["periods", "metric", "weights", "freeze", "stages"],
)
@pytest.mark.parametrize("stage", ["fit", "validate"])
def test_a_checkpoint_of_other_settings_is_refused(
    tmp_path: Path, last: Path, settings: dict[str, Any], words: tuple[str, ...], stage: str
) -> None:
    with refused(*words):
        getattr(trainer(tmp_path), stage)(new_task(**settings), data_of(), ckpt_path=last)


def test_a_task_is_not_fitted_to_a_second_route(tmp_path: Path) -> None:
    task = new_task()
    model = fit(tmp_path, task, data_of())
    with refused("the map is of 40 places", "the array has 30", "expected the route that it was made of"):
        trainer(tmp_path).fit(task, data_of(footage()[:30]))
    with refused("the map is of 40 places", "the array has 30"):
        trainer(tmp_path).validate(task, data_of(footage()[:30]), verbose=False)
    # the same route once more goes on from its map
    templates = task.route.templates.detach().clone()
    assert torch.equal(templates, model.map.templates)
    trainer(tmp_path, max_steps=1).fit(task, data_of(second=ArrayTraverse(footage(0.1))))
    assert 0 < (task.route.templates - templates).abs().max() < 0.02
