"""Checkpoints: what a run goes on from and takes over, and which other settings and routes are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import refused
from pytorch_lightning.callbacks import ModelCheckpoint
from small_training import (
    FRAMES,
    Later,
    Stop,
    coded,
    data_of,
    fit,
    footage,
    heights,
    mapper,
    new_task,
    trainer,
)
from torch import Tensor

from dejavu_torch import DejaVu, ImposedPeriods, SpectralMapper
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.training.task import PlaceRecognitionTask

STEPS = 10  # of a staged training 5 are the descriptor's
KINDS: dict[str, dict[str, Any]] = {
    "templates": {},
    "staged": {"descriptor": 0.5},
    "spectral": {"mapper": SpectralMapper(20.0)},
    "rate": {"mapper": SpectralMapper(20.0), "rate": 1.0},
}
PARTS = ["templates 3", "staged 3", "staged 5", "staged 8", "spectral 4", "rate 7"]  # and the steps made


def task_of(kind: str, **settings: Any) -> PlaceRecognitionTask:
    kind = kind.split()[0]
    code = {} if kind == "templates" else {"backbone": coded()}
    return new_task(**code | KINDS[kind] | settings)


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Checkpoints of trainings that ended early."""
    folder = tmp_path_factory.mktemp("parts")
    for part in PARTS:
        stop = Stop(int(part.split()[1]), folder / f"{part}.ckpt")
        trainer(folder, stop, max_steps=STEPS).fit(task_of(part), data_of())
    return {part: folder / f"{part}.ckpt" for part in PARTS}


@pytest.mark.parametrize("part", PARTS)
def test_a_resumed_run_takes_the_steps_that_are_left(
    tmp_path: Path, parts: dict[str, Path], part: str
) -> None:
    again, running, rates = task_of(part), trainer(tmp_path, max_steps=STEPS), []
    take = again.training_step

    def taken(*given: Any) -> Any:
        loss = take(*given)
        rates.append(running.optimizers[0].param_groups[0]["lr"] / again.lr)
        return loss

    again.training_step = taken  # type: ignore[method-assign]
    running.fit(again, data_of(), ckpt_path=parts[part])
    kind, step = part.split()
    whole = heights(5) * 2 if kind == "staged" else heights(STEPS)
    assert rates == pytest.approx(whole[int(step) :])
    assert (again.index, again.began) == ((1, 5) if kind == "staged" else (0, 0))
    model = DejaVu.load(tmp_path / "map.safetensors")
    assert model.trained is not None
    assert (model.trained.steps, model.map.places) == (STEPS, FRAMES)


@pytest.mark.parametrize("part", ["staged 3", "staged 8"])
def test_a_checkpoint_is_loaded_whatever_the_tolerance(
    tmp_path: Path, parts: dict[str, Path], part: str
) -> None:
    given = {"backbone": coded(), "descriptor": 0.5, "mapper": mapper()}
    task = PlaceRecognitionTask.load_from_checkpoint(parts[part], weights_only=True, **given)
    state, own = torch.load(parts[part], weights_only=True)["state_dict"], task.state_dict()
    assert all(torch.equal(own[name], value) for name, value in state.items() if isinstance(value, Tensor))
    running, data = trainer(tmp_path), data_of(tolerance=4)
    if part == "staged 8":
        running.validate(task_of(part), data, ckpt_path=parts[part], verbose=False)
        return
    with refused("stage 1 of 2, DescriptorStage", "no map yet"):
        running.validate(task_of(part), data, ckpt_path=parts[part], verbose=False)
    with refused("stage 1 of 2, DescriptorStage"):
        task.deployed()


def test_a_spectral_checkpoint_has_no_map_and_validating_it_makes_one(
    tmp_path: Path, parts: dict[str, Path]
) -> None:
    state = torch.load(parts["spectral 4"], weights_only=True)["state_dict"]
    maps = [value for name, value in state.items() if "dejavu.map" in name and isinstance(value, Tensor)]
    assert not any(value.numel() for value in maps)
    task = task_of("spectral", mapper=SpectralMapper(6.0))  # this run's budget
    noisy = data_of(validation=ArrayTraverse(footage(0.05)), validation_truth="0")
    (figures,) = trainer(tmp_path).validate(task, noisy, ckpt_path=parts["spectral 4"], verbose=False)
    assert figures["val/recall_at_1"] > 0.5
    route = task.deployed()
    assert route.trained is not None
    assert route.trained.steps == 4
    assert 5.8 < route.summary().route_bytes / FRAMES <= 6


# layers that were found ----------------------------------------------------------------------------------


def found_later(folder: Path, **settings: Any) -> Path:
    """The last checkpoint of a training of two epochs."""
    task, kept = new_task(mapper=mapper(Later()), **settings), ModelCheckpoint(folder, save_last=True)
    trainer(folder, kept, max_epochs=2, max_steps=-1).fit(task, data_of())
    return folder / "last.ckpt"


@pytest.mark.parametrize("settings", [{}, {"feature_weights": True}], ids=str)
def test_layers_that_were_found_are_taken_over(tmp_path: Path, settings: dict[str, Any]) -> None:
    """Whatever this run would find: it is not asked for them."""
    first = found_later(tmp_path, refresh=1, **settings)
    state = torch.load(first, weights_only=True)["state_dict"]
    again, evaluated = (new_task(mapper=mapper(Later()), **settings) for _ in range(2))
    trainer(tmp_path, max_epochs=3, max_steps=-1).fit(again, data_of(), ckpt_path=first)
    written = DejaVu.load(tmp_path / "map.safetensors").map
    assert again.route.plan == written.plan
    assert [layer.phases for layer in again.route.plan] == [5, 7, 9]
    trainer(tmp_path).validate(evaluated, data_of(), ckpt_path=first, verbose=False)
    for name in ("dejavu.descriptor.features.linear.weight", "dejavu.map.templates", "log_temperature"):
        assert torch.equal(evaluated.state_dict()[name], state[name])
    assert [one.dejavu.mapper.periods.asked for one in (again, evaluated)] == [0, 0]  # type: ignore[union-attr]


def test_a_resumed_run_finds_layers_anew_when_it_is_time_to(tmp_path: Path) -> None:
    first, again = found_later(tmp_path), new_task(mapper=mapper(Later()), refresh=1)
    again.dejavu.mapper.periods.asked = 1  # type: ignore[union-attr]
    running = trainer(tmp_path, max_epochs=3, max_steps=-1)
    running.fit(again, data_of(), ckpt_path=first)
    assert [layer.phases for layer in again.route.plan] == [5, 7, 9]
    optimised = {id(p) for group in running.optimizers[0].param_groups for p in group["params"]}
    assert optimised == {id(p) for p in again.parameters()}


# refusals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("part", "settings", "frames", "facts"),
    [
        ("templates 3", {"mapper": mapper(ImposedPeriods([3, 4, 7], bin=2))}, FRAMES, ["5 in 10", "7 in 14"]),
        ("templates 3", {"mapper": mapper(metric="l2")}, FRAMES, ["metric is 'l1'", "expected 'l2'"]),
        ("templates 3", {"feature_weights": True}, FRAMES, ["dejavu.map.weights", "not in both"]),
        ("templates 3", {"freeze": ["linear"]}, FRAMES, ["dejavu.descriptor.features.linear.bias, dejavu"]),
        ("templates 3", {"backbone": coded()}, FRAMES, ["['CodeStage']", "['DescriptorStage', 'CodeStage']"]),
        ("templates 3", {}, 30, ["the map has 40 places", "the array has 30"]),
        ("spectral 4", {"mapper": mapper()}, FRAMES, ["['DescriptorStage']", "'CodeStage'"]),
        ("spectral 4", {}, 30, ["40 segments of 1 frames", "the array has 30", "the route"]),
        ("spectral 4", {"freeze": ["network.linear"]}, FRAMES, ["network.linear.bias", "not in both"]),
    ],
    ids=str,
)
def test_a_checkpoint_of_another_training_is_refused(
    tmp_path: Path,
    parts: dict[str, Path],
    part: str,
    settings: dict[str, Any],
    frames: int,
    facts: list[str],
) -> None:
    running, data = trainer(tmp_path, max_steps=STEPS), data_of(footage(frames=frames))
    with refused(*facts):
        running.fit(task_of(part, **settings), data, ckpt_path=parts[part])


@pytest.mark.parametrize(("key", "value"), [("routes", ["a"]), ("held", None)])
def test_damaged_routes_and_stretches_are_refused(
    tmp_path: Path, parts: dict[str, Path], key: str, value: Any
) -> None:
    torch.save(torch.load(parts["spectral 4"], weights_only=True) | {key: value}, tmp_path / "bad.ckpt")
    with refused("checkpoint", str(value)):
        trainer(tmp_path).fit(task_of("spectral"), data_of(), ckpt_path=tmp_path / "bad.ckpt")


def test_a_task_is_not_fitted_to_a_second_route(tmp_path: Path) -> None:
    task = new_task()
    model = fit(tmp_path, task, data_of())
    for stage in ("fit", "validate"):
        with refused("the map has 40 places", "the array has 30", "expected the route"):
            getattr(trainer(tmp_path), stage)(task, data_of(footage()[:30]))
    # the same route once more goes on from its map
    templates = task.route.templates.detach().clone()
    assert torch.equal(templates, model.map.templates)
    trainer(tmp_path, max_steps=1).fit(task, data_of(second=ArrayTraverse(footage(0.1))))
    assert 0 < (task.route.templates - templates).abs().max() < 0.02
