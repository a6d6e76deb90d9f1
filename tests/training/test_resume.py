"""A run that is interrupted and resumed ends in the map of one that was not."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import refused
from small_training import Stop, backbone, data_of, mapper, new_task, trainer
from test_stages import coded
from torch import Tensor

from dejavu_torch import DejaVu, RouteData, SpectralMapper
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.training.task import PlaceRecognitionTask

STEPS, BROKEN = 9, 6
INTERRUPTED = {"in the first epoch": 3, "between": 5, "in the second": 7}  # steps


def spectral(rate: float) -> PlaceRecognitionTask:
    return new_task(backbone=coded(), mapper=SpectralMapper(20.0), rate=rate)


def code() -> PlaceRecognitionTask:
    return new_task(backbone=coded(), mapper=mapper(), descriptor=0.25)


def templates() -> PlaceRecognitionTask:
    return new_task(backbone=backbone(), mapper=mapper())


def data() -> RouteData:
    return data_of(augmentation=Augmentation(noise=0.1), batch_size=8)  # 5 batches an epoch


def run(folder: Path, make: Callable[[], PlaceRecognitionTask], start: Path | None, *callbacks: Any) -> Path:
    torch.manual_seed(3 if start is None else 4)
    task, every = make(), {"val_check_interval": 4, "check_val_every_n_epoch": None}
    settings = {"max_steps": STEPS, "enable_checkpointing": True} | every
    trainer(folder, *callbacks, **settings).fit(task, data(), ckpt_path=start, weights_only=True)
    return folder / "map.safetensors"


def tensors(path: Path) -> dict[str, Tensor]:
    return {n: t for n, t in DejaVu.load(path).state_dict().items() if isinstance(t, Tensor)}


class Break(Stop):
    """Ends the training in the midst of a step, whose random numbers are drawn."""

    def on_before_optimizer_step(self, trainer: Any, *_: Any) -> None:
        if trainer.global_step == self.steps:
            assert self.path is not None
            trainer.save_checkpoint(self.path)
            raise RuntimeError("power cut")

    def on_train_batch_end(self, trainer: Any, *_: Any) -> None:
        pass


class Keep(Stop):
    """Saves a checkpoint wherever a training is interrupted, and ends it at the last."""

    def __init__(self, folder: Path) -> None:
        super().__init__(max(INTERRUPTED.values()))
        self.folder = folder

    def on_train_batch_end(self, trainer: Any, *rest: Any) -> None:
        if trainer.global_step in INTERRUPTED.values():
            trainer.save_checkpoint(self.folder / f"{trainer.global_step}.ckpt")
        super().on_train_batch_end(trainer, *rest)


MAKE: dict[str, Callable[[], PlaceRecognitionTask]] = {
    "spectral": lambda: spectral(0.0),
    "rate": lambda: spectral(1.0),
    "code": code,
    "plain": templates,
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A folder for each kind of training."""
    return {name: tmp_path_factory.mktemp(name) for name in MAKE}


@pytest.fixture(scope="module")
def maps(folders: dict[str, Path]) -> Callable[[str], dict[str, Tensor]]:
    """The map of a training that was not interrupted."""
    return cache(lambda name: tensors(run(folders[name] / "whole", MAKE[name], None)))


@pytest.fixture(scope="module")
def parts(folders: dict[str, Path]) -> Callable[[str], Path]:
    """Where the checkpoints of one that was lie."""

    @cache
    def interrupted(name: str) -> Path:
        run(folders[name] / "first", MAKE[name], None, Keep(folders[name]))
        return folders[name]

    return interrupted


def assert_same(again: dict[str, Tensor], whole: dict[str, Tensor]) -> None:
    assert whole.keys() == again.keys()
    for name, value in whole.items():
        assert torch.allclose(again[name].double(), value.double(), rtol=1e-4, atol=1e-5), name


@pytest.mark.parametrize("name", MAKE)
@pytest.mark.parametrize("step", INTERRUPTED.values(), ids=INTERRUPTED)
def test_it_ends_in_the_same_map(tmp_path: Path, maps: Any, parts: Any, name: str, step: int) -> None:
    again = run(tmp_path / "again", MAKE[name], parts(name) / f"{step}.ckpt")
    assert_same(tensors(again), maps(name))


def test_a_step_that_was_broken_off_is_taken_again(tmp_path: Path, maps: Any) -> None:
    part = tmp_path / "part.ckpt"
    with pytest.raises(RuntimeError, match="power cut"):
        run(tmp_path / "first", MAKE["rate"], None, Break(BROKEN, part))
    assert_same(tensors(run(tmp_path / "again", MAKE["rate"], part)), maps("rate"))


@pytest.mark.parametrize(
    "change",
    [
        lambda random: random.pop("now"),
        lambda random: random.update(done=-1),
        lambda random: random.update(done=True),
        lambda random: random.update(order=torch.zeros(3)),
        lambda random: random.update(order=None),
        lambda random: random.update(views=torch.zeros(7, dtype=torch.uint8)),
    ],
)
def test_damaged_random_numbers_are_refused(tmp_path: Path, parts: Any, change: Callable[[Any], Any]) -> None:
    part = tmp_path / "part.ckpt"
    checkpoint = torch.load(parts("spectral") / "3.ckpt", weights_only=True)
    change(checkpoint["random"])
    torch.save(checkpoint, part)
    with refused("its random numbers are no state of torch's"):
        run(tmp_path / "again", MAKE["spectral"], part)


@pytest.mark.parametrize(
    ("key", "value"),
    [*(("routes", one) for one in (7, None, ["a"], "one")), *(("held", one) for one in (7, None, ["a"]))],
)
def test_damaged_routes_and_stretches_are_refused(tmp_path: Path, parts: Any, key: str, value: Any) -> None:
    part = tmp_path / "part.ckpt"
    checkpoint = torch.load(parts("spectral") / "3.ckpt", weights_only=True)
    torch.save(checkpoint | {key: value}, part)
    with refused(f"{key} of the checkpoint", str(value)):
        run(tmp_path / "again", MAKE["spectral"], part)
