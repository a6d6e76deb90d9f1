"""The stages of a training, the descriptor and its code: what is trained when, what stays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import refused
from pytorch_lightning import Callback
from pytorch_lightning.callbacks import EarlyStopping, ModelCheckpoint
from small_training import (
    FRAMES,
    Stop,
    backbone,
    data_of,
    fit,
    footage,
    mapper,
    new_task,
    recall,
    trainer,
    warned,
)
from torch import Tensor

from dejavu_torch import HOG, DejaVu
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.training.stages import CodeStage, DescriptorStage
from dejavu_torch.training.task import PlaceRecognitionTask

STILL = {name: 0.0 for name in ("rotation", "scale", "gamma", "illumination", "blur", "occlusion", "noise")}
STILL |= {name: (0.0, 0.0) for name in ("colour", "shift", "exposure")}  # type: ignore[dict-item]
ALL = [DescriptorStage, CodeStage]


def coded(**settings: Any) -> Embedding:
    given = {"dimension": 12, "channels": 1, "resize": (16, 16), "hidden": 16} | settings
    return Embedding(**{"network": backbone()} | given)


def staged(**settings: Any) -> PlaceRecognitionTask:
    return new_task(**{"backbone": coded(), "descriptor": 0.5} | settings)


def part(folder: Path, steps: int) -> Path:
    """A checkpoint after some steps of 10, of which 5 are the descriptor's."""
    trainer(folder, Stop(steps, folder / "part.ckpt"), max_steps=10).fit(staged(), data_of())
    return folder / "part.ckpt"


class Watch(Callback):
    """The state of the backbone ahead of every step and behind the last, and the rate of every step."""

    def __init__(self) -> None:
        self.states: list[dict[str, Tensor]] = []
        self.rates: list[float] = []

    def keep(self, task: Any) -> None:
        self.states.append({name: value.clone() for name, value in task.dejavu.features.state_dict().items()})

    def on_before_optimizer_step(self, trainer: Any, pl_module: Any, optimizer: Any) -> None:
        self.keep(pl_module)
        self.rates.append(optimizer.param_groups[0]["lr"])

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        self.keep(pl_module)


def changed(states: list[dict[str, Tensor]]) -> set[str]:
    """Names of what differs between the first and the last state, without counters."""
    first, last = states[0], states[-1]
    return {name for name in first if not torch.equal(first[name], last[name]) and "num_" not in name}


def watched(folder: Path, **settings: Any) -> tuple[PlaceRecognitionTask, Watch]:
    task, watch = staged(**settings), Watch()
    trainer(folder, watch, max_steps=10, enable_checkpointing=True).fit(task, data_of())
    return task, watch


def test_the_network_is_learned_first_and_its_code_behind_it(tmp_path: Path) -> None:
    task, watch = watched(tmp_path)
    assert [type(stage) for stage in task.stages] == ALL
    first, code = changed(watch.states[:5]), changed(watch.states[5:])
    assert {name.partition(".")[0] for name in first} == {"network"}
    assert "network.convolutions.0.weight" in first
    assert "network.convolutions.1.running_mean" in first
    assert {name.partition(".")[0] for name in code} == {"linear", "standardise"}
    assert not code & {"linear.mean", "linear.projection", "linear.whitened"}
    assert not watch.states[4]["linear.whitened"]
    assert watch.states[5]["linear.whitened"]
    # in either stage the rate rises and falls
    assert watch.rates[4] < 0.3 * watch.rates[0]
    assert watch.rates[5:] == watch.rates[:5]
    assert DejaVu.load(tmp_path / "map.safetensors").features.linear.whitened  # type: ignore[union-attr]


def test_what_is_learned_finds_places_on_another_day(tmp_path: Path) -> None:
    settings = {"backbone": coded(hidden=64, noise=0.5), "descriptor": 0.2}
    mild = Augmentation(**STILL | {"noise": 0.1, "exposure": (0.1, 0.1)})  # type: ignore[arg-type]
    model = fit(
        tmp_path, new_task(**settings), data_of(augmentation=mild), max_steps=500, limit_val_batches=0
    )
    assert recall(model, footage(0.05)) > 0.7


@pytest.mark.parametrize("name", ["hog", "frozen"])
def test_without_a_network_to_train_every_step_is_the_codes(tmp_path: Path, name: str) -> None:
    """HOG has no parameters, a frozen network none that may change; both are whitened first."""
    network, freeze = (HOG(), []) if name == "hog" else (backbone(), ["network"])
    task, watch = watched(tmp_path, backbone=coded(network=network), freeze=freeze)
    assert [type(stage) for stage in task.stages] == ALL[1:]
    assert watch.states[0]["linear.whitened"]
    assert {name.partition(".")[0] for name in changed(watch.states)} == {"linear", "standardise"}


def test_a_second_traverse_tells_what_a_season_changes(tmp_path: Path) -> None:
    """Winter is darker at the left: without augmentation that is all the change that there is."""
    summer = footage()
    winter = (summer.float() * torch.linspace(0.2, 1, 16)).byte()
    still = Augmentation(**STILL)  # type: ignore[arg-type]
    task = new_task(backbone=coded(network=HOG()))
    given = {"second": ArrayTraverse(winter), "second_truth": "0", "augmentation": still}
    trainer(tmp_path / "both").fit(task, data_of(summer, **given))
    assert task.views is not None
    assert len({tuple(view) for view in task.views[0].tolist()}) == 2 * FRAMES
    with refused("data.augmentation changes nothing", "data.second"):
        trainer(tmp_path / "one").fit(new_task(backbone=coded(network=HOG())), data_of(augmentation=still))


def test_frames_of_no_known_place_are_not_learned_from(tmp_path: Path) -> None:
    truth = tmp_path / "truth.csv"
    truth.write_text("query,place\n" + "".join(f"{i},{i}\n" for i in range(10)))
    task = new_task(backbone=coded(network=HOG()))
    given = {"second": ArrayTraverse(footage(0.1)), "second_truth": str(truth), "batch_size": 2}
    trainer(tmp_path).fit(task, data_of(**given))
    assert task.views is not None
    assert task.views[1].min() == 0
    assert len(task.views[0]) == len(task.views[1]) == 10 * (FRAMES + 10)
    before = len(task.views[0])
    trainer(tmp_path).fit(task, data_of())  # a further training describes its own frames
    assert len(task.views[0]) == 10 * (FRAMES - FRAMES % 16) < before


def test_another_route_keeps_the_descriptor(tmp_path: Path) -> None:
    first, _ = watched(tmp_path / "first", weight_bits=32)
    again = coded(dimension=7)
    fresh = again.linear.layers[0].weight.clone()  # type: ignore[union-attr,operator,index]
    task = new_task(backbone=again, start=str(tmp_path / "first" / "map.safetensors"))
    assert torch.equal(again.linear.layers[0].weight, fresh)  # type: ignore[union-attr,operator,index]
    assert [type(stage) for stage in task.stages] == [CodeStage]
    trainer(tmp_path / "second").fit(task, data_of(footage(frames=30)))
    before, after = first.dejavu.features.state_dict(), again.state_dict()
    same = {name for name in after if torch.equal(before[name], after[name]) and "num_" not in name}
    kept = {name for name in after if name.startswith("network.") and "num_" not in name}
    assert same >= kept | {"linear.mean", "linear.projection", "linear.whitened"}
    assert "linear.layers.0.weight" not in same


@pytest.mark.parametrize("steps", [3, 5, 8], ids=["the descriptor", "between", "the code"])
def test_a_resumed_run_goes_on_where_it_was(tmp_path: Path, steps: int) -> None:
    _, whole = watched(tmp_path / "whole")
    again, resumed = staged(), Watch()
    on = trainer(tmp_path / "again", resumed, max_steps=10, enable_checkpointing=True)
    on.fit(again, data_of(), ckpt_path=part(tmp_path, steps), weights_only=True)
    assert on.global_step == 10
    assert (again.index, again.began) == (1, 5)
    assert resumed.rates == pytest.approx(whole.rates[steps:])
    assert resumed.states[0]["linear.whitened"] == (steps >= 5)
    assert {n.partition(".")[0] for n in changed(resumed.states[-3:])} == {"linear", "standardise"}


@pytest.mark.parametrize("steps", [3, 8], ids=["the descriptor", "the code"])
def test_a_checkpoint_is_loaded_whatever_the_tolerance(tmp_path: Path, steps: int) -> None:
    path = part(tmp_path, steps)
    given = {"backbone": coded(), "descriptor": 0.5, "mapper": mapper()}
    task = PlaceRecognitionTask.load_from_checkpoint(path, weights_only=True, **given)
    state, own = torch.load(path, weights_only=True)["state_dict"], task.state_dict()
    assert all(torch.equal(own[name], value) for name, value in state.items() if isinstance(value, Tensor))
    evaluated, running = staged(), trainer(tmp_path)
    if steps == 8:
        running.validate(evaluated, data_of(tolerance=4), ckpt_path=path, verbose=False, weights_only=True)
        assert evaluated.in_last_stage
        return
    with refused("stage 1 of 2, DescriptorStage", "no map yet"):
        running.validate(evaluated, data_of(tolerance=4), ckpt_path=path, verbose=False, weights_only=True)
    with refused("stage 1 of 2, DescriptorStage"):
        task.deployed()


def test_a_training_that_ends_in_an_earlier_stage_leaves_no_map(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    task = staged()
    trainer(tmp_path, Stop(3), max_steps=10).fit(task, data_of())
    assert not (tmp_path / "map.safetensors").exists()
    (line,) = warned(caplog)
    assert "no map is written" in line
    assert "DescriptorStage" in line


@pytest.mark.parametrize("every", [{"val_check_interval": 1}, {"check_val_every_n_epoch": 1}], ids=str)
def test_what_watches_a_figure_begins_with_the_last_stage(tmp_path: Path, every: dict[str, int]) -> None:
    """Up to step 10 there is no map: no patience is lost there, and no best checkpoint found."""
    figures: list[tuple[int, bool]] = []

    class Seen(Callback):
        def on_validation_end(self, trainer: Any, pl_module: Any) -> None:
            figures.append((trainer.global_step, "val/auc_augmented" in trainer.callback_metrics))

    patient = EarlyStopping("val/auc_augmented", mode="max", patience=2)
    best = ModelCheckpoint(tmp_path, monitor="train/loss", filename="{step}", every_n_train_steps=1)
    task = staged()
    running = trainer(tmp_path, Seen(), patient, best, max_steps=20, log_every_n_steps=1, **every)
    callbacks = list(running.callbacks)  # type: ignore[attr-defined]
    running.fit(task, data_of())
    assert running.global_step > 11
    assert all(there == (step > 10) for step, there in figures)
    assert int(best.best_model_path.partition("step=")[2].removesuffix(".ckpt")) > 10
    assert DejaVu.load(tmp_path / "map.safetensors").features.linear.whitened  # type: ignore[union-attr]
    assert running.callbacks == callbacks  # type: ignore[attr-defined]
