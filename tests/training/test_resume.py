"""A run that is interrupted and resumed takes the steps that are left; test_stages.py: in whichever stage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import refused
from small_training import Stop, data_of, new_task, trainer
from test_stages import coded

from dejavu_torch import DejaVu, RouteData, SpectralMapper
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.training.task import PlaceRecognitionTask

STEPS = 9
MAKE: dict[str, dict[str, Any]] = {
    "spectral": {"mapper": SpectralMapper(20.0)},
    "rate": {"mapper": SpectralMapper(20.0), "rate": 1.0},
}


def task_of(name: str) -> PlaceRecognitionTask:
    return new_task(backbone=coded(), **MAKE[name])


def data() -> RouteData:
    return data_of(augmentation=Augmentation(noise=0.1), batch_size=8)  # 5 batches an epoch


def interrupted(folder: Path, name: str, step: int) -> Path:
    """The checkpoint of a run that ended at a step."""
    path = folder / "part.ckpt"
    trainer(folder / "first", Stop(step, path), max_steps=STEPS).fit(task_of(name), data())
    return path


@pytest.mark.parametrize(("name", "step"), [("spectral", 3), ("rate", 5)])
def test_a_resumed_run_takes_the_steps_that_are_left(tmp_path: Path, name: str, step: int) -> None:
    part, again = interrupted(tmp_path, name, step), task_of(name)
    running = trainer(tmp_path / "again", max_steps=STEPS)
    seen: list[tuple[int, float]] = []
    take = again.training_step

    def taken(*given: Any) -> Any:
        loss = take(*given)
        seen.append((running.global_step, running.optimizers[0].param_groups[0]["lr"]))
        return loss

    again.training_step = taken  # type: ignore[method-assign]
    running.fit(again, data(), ckpt_path=part, weights_only=True)
    assert [at for at, _ in seen] == [*range(step, STEPS)]
    assert seen[-1][1] < 1e-3  # the end of the schedule
    model = DejaVu.load(tmp_path / "again" / "map.safetensors")
    assert model.trained is not None
    assert (model.trained.steps, model.map.places) == (STEPS, 40)


@pytest.mark.parametrize(("key", "value"), [("routes", ["a"]), ("held", None), ("held", ["a"])])
def test_damaged_routes_and_stretches_are_refused(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, key: str, value: Any
) -> None:
    part = tmp_path / "part.ckpt"
    if not PARTS:
        PARTS.append(interrupted(tmp_path_factory.mktemp("parts"), "spectral", 3))
    torch.save(torch.load(PARTS[0], weights_only=True) | {key: value}, part)
    with refused(f"{key} of the checkpoint", str(value)):
        trainer(tmp_path / "again", max_steps=STEPS).fit(task_of("spectral"), data(), ckpt_path=part)


PARTS: list[Path] = []
