"""A descriptor first, then its code: what is trained when, and what stays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import refused
from pytorch_lightning import Callback
from pytorch_lightning.callbacks import EarlyStopping, ModelCheckpoint
from test_task import (
    FRAMES,
    assert_same_scores,
    backbone,
    data_of,
    fit,
    footage,
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
from dejavu_torch.training.task import PlaceRecognitionTask

STILL = {name: 0.0 for name in ("rotation", "scale", "gamma", "illumination", "blur", "occlusion", "noise")}
STILL |= {name: (0.0, 0.0) for name in ("colour", "shift", "exposure")}  # type: ignore[dict-item]


def coded(**settings: Any) -> Embedding:
    given = {"dimension": 12, "channels": 1, "resize": (16, 16), "hidden": 16} | settings
    return Embedding(**{"network": backbone()} | given)


class Stop(Callback):
    """Saves a checkpoint after some steps, and ends the training."""

    def __init__(self, steps: int, path: Path) -> None:
        self.steps, self.path = steps, path

    def on_train_batch_end(self, trainer: Any, *_: Any) -> None:
        if trainer.global_step == self.steps:
            trainer.save_checkpoint(self.path)
            trainer.should_stop = True


class Watch(Callback):
    """The state of the backbone ahead of every step, and the rate of learning."""

    def __init__(self) -> None:
        self.states: list[dict[str, Tensor]] = []
        self.rates: list[float] = []

    def on_train_batch_start(self, trainer: Any, pl_module: Any, *_: Any) -> None:
        features = pl_module.dejavu.features
        self.states.append({name: value.clone() for name, value in features.state_dict().items()})
        self.rates.append(trainer.optimizers[0].param_groups[0]["lr"])


def changed(states: list[dict[str, Tensor]]) -> set[str]:
    """Names of what differs between the first and the last state, without counters."""
    first, last = states[0], states[-1]
    return {name for name in first if not torch.equal(first[name], last[name]) and "num_" not in name}


def watched(folder: Path, steps: int = 10, **settings: Any) -> tuple[PlaceRecognitionTask, Watch]:
    task, watch = new_task(**{"backbone": coded(), "descriptor": 0.5} | settings), Watch()
    trainer(folder, watch, max_steps=steps, enable_checkpointing=True).fit(task, data_of())
    return task, watch


def test_the_network_learns_first_and_its_code_behind_it(tmp_path: Path) -> None:
    task, watch = watched(tmp_path)
    first, code = changed(watch.states[:6]), changed(watch.states[6:])
    assert {name.partition(".")[0] for name in first} == {"network"}
    assert "network.convolutions.0.weight" in first
    assert "network.convolutions.1.running_mean" in first
    assert {name.partition(".")[0] for name in code} == {"linear", "standardise"}
    assert not code & {"linear.mean", "linear.projection", "linear.whitened"}
    assert not watch.states[5]["linear.whitened"]
    assert watch.states[6]["linear.whitened"]
    # in either part the rate rises and falls
    assert watch.rates.index(max(watch.rates)) == 0
    assert watch.rates[4] < 0.3 * watch.rates[0]
    assert watch.rates[5] == watch.rates[0]
    assert DejaVu.load(tmp_path / "map.safetensors").features.linear.whitened  # type: ignore[union-attr]
    assert task.descriptor.settled == 5


def test_what_is_learned_finds_places_on_another_day(tmp_path: Path) -> None:
    settings = {"backbone": coded(hidden=64, noise=0.5), "descriptor": 0.2}
    mild = Augmentation(**STILL | {"noise": 0.1, "exposure": (0.1, 0.1)})  # type: ignore[arg-type]
    model = fit(tmp_path, new_task(**settings), data_of(augmentation=mild), max_steps=500)
    assert recall(model, footage(0.05)) > 0.7


def test_task_map_and_exported_program_give_the_same_scores(tmp_path: Path) -> None:
    task = new_task(backbone=coded())
    assert_same_scores(task, fit(tmp_path, task, data_of(), max_steps=6))


def test_without_a_network_to_train_every_step_is_the_codes(tmp_path: Path) -> None:
    """HOG has no parameters, a frozen network none that may change; both are whitened by what there is."""
    for name, network, freeze in (("hog", HOG(), []), ("frozen", backbone(), ["network"])):
        task, watch = watched(tmp_path / name, backbone=coded(network=network), freeze=freeze)
        assert task.descriptor.settled == 0
        assert watch.states[0]["linear.whitened"]
        assert {part.partition(".")[0] for part in changed(watch.states)} == {"linear", "standardise"}


def test_a_second_traverse_tells_what_a_season_changes(tmp_path: Path) -> None:
    """Winter is darker at the left: without augmentation that is all the change that there is."""
    summer = footage()
    winter = (summer.float() * torch.linspace(0.2, 1, 16)).byte()
    still = Augmentation(**STILL)  # type: ignore[arg-type]
    task = new_task(backbone=coded(network=HOG()))
    given = {"second": ArrayTraverse(winter), "second_truth": "0", "augmentation": still}
    trainer(tmp_path / "both").fit(task, data_of(summer, **given))
    views = task.descriptor.views
    assert views is not None
    assert len({tuple(view) for view in views.tolist()}) == 2 * FRAMES
    with refused("differ from those of their places by 0 in", "a second traverse"):
        trainer(tmp_path / "one").fit(new_task(backbone=coded(network=HOG())), data_of(augmentation=still))


def test_frames_of_no_known_place_are_not_learned_from(tmp_path: Path) -> None:
    truth = tmp_path / "truth.csv"
    truth.write_text("query,place\n" + "".join(f"{i},{i}\n" for i in range(10)))
    task = new_task(backbone=coded(network=HOG()))
    given = {"second": ArrayTraverse(footage(0.1)), "second_truth": str(truth), "batch_size": 2}
    trainer(tmp_path).fit(task, data_of(**given))
    assert task.descriptor.right.min() == 0
    assert task.descriptor.views is not None
    assert len(task.descriptor.views) == len(task.descriptor.right) == 10 * (FRAMES + 10)


def test_another_route_keeps_the_descriptor(tmp_path: Path) -> None:
    first, _ = watched(tmp_path / "first")
    again = coded(dimension=7)
    fresh = again.linear.layers[0].weight.clone()  # type: ignore[union-attr,operator,index]
    task = new_task(backbone=again, start=str(tmp_path / "first" / "map.safetensors"))
    assert torch.equal(again.linear.layers[0].weight, fresh)  # type: ignore[union-attr,operator,index]
    trainer(tmp_path / "second").fit(task, data_of(footage(frames=30)))
    assert task.descriptor.settled == 0
    before, after = first.dejavu.features.state_dict(), again.state_dict()
    same = {name.partition(".")[0] for name in after if torch.equal(before[name], after[name])}
    assert {"network", "linear"} <= same  # linear: the whitening
    assert torch.equal(before["linear.projection"], after["linear.projection"])
    assert not torch.equal(before["linear.layers.0.weight"], after["linear.layers.0.weight"])


@pytest.mark.parametrize("steps", [3, 8], ids=["the descriptor", "the code"])
def test_a_resumed_run_goes_on_where_it_was(tmp_path: Path, steps: int) -> None:
    whole, watch = watched(tmp_path / "whole")
    stop = Stop(steps, tmp_path / "part.ckpt")
    trainer(tmp_path / "part", stop, max_steps=10).fit(new_task(backbone=coded(), descriptor=0.5), data_of())
    again, resumed = new_task(backbone=coded(), descriptor=0.5), Watch()
    on = trainer(tmp_path / "again", resumed, max_steps=10, enable_checkpointing=True)
    on.fit(again, data_of(), ckpt_path=tmp_path / "part.ckpt", weights_only=True)
    assert on.global_step == 10
    assert again.descriptor.settled == whole.descriptor.settled == 5
    assert resumed.rates == pytest.approx(watch.rates[steps:])
    assert resumed.states[0]["linear.whitened"] == (steps > 5)
    assert {n.partition(".")[0] for n in changed(resumed.states[-2:])} == {"linear", "standardise"}


def test_a_training_that_ends_too_early_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    task = new_task(backbone=coded(), descriptor=0.5)
    trainer(tmp_path, Stop(3, tmp_path / "part.ckpt"), max_steps=10).fit(task, data_of())
    assert task.descriptor.settled is None
    assert any("ahead of the code" in line for line in warned(caplog))


def test_a_share_of_the_steps_is_a_share() -> None:
    for share in (-0.1, 1.0):
        with refused(f"descriptor is {share}", "from 0 to below 1"):
            new_task(descriptor=share)


def test_ready_features_have_no_descriptor_to_learn(tmp_path: Path) -> None:
    task = new_task(backbone=coded())
    model = fit(tmp_path, task, data_of(torch.rand(FRAMES, 6)))
    assert model.map.dimension == 6
    assert task.descriptor.settled is None


def test_what_watches_the_training_waits_for_the_code(tmp_path: Path) -> None:
    """Up to step 10 the code is random: no patience is lost there, and no best checkpoint found."""
    patient = EarlyStopping("val/auc", mode="max", patience=2)
    best = ModelCheckpoint(tmp_path, monitor="train/loss", filename="{step}", every_n_train_steps=1)
    task = new_task(backbone=coded(), descriptor=0.5)
    running = trainer(tmp_path, patient, best, max_steps=20, val_check_interval=1, log_every_n_steps=1)
    running.fit(task, data_of())
    assert running.global_step > 11
    assert int(best.best_model_path.partition("step=")[2].removesuffix(".ckpt")) > 10
    assert DejaVu.load(tmp_path / "map.safetensors").features.linear.whitened  # type: ignore[union-attr]


@pytest.mark.parametrize("steps", [3, 8], ids=["the descriptor", "the code"])
def test_a_checkpoint_is_judged_with_another_tolerance(tmp_path: Path, steps: int) -> None:
    path = tmp_path / "part.ckpt"
    trainer(tmp_path, Stop(steps, path), max_steps=10).fit(
        new_task(backbone=coded(), descriptor=0.5), data_of()
    )
    judged = new_task(backbone=coded(), descriptor=0.5)
    trainer(tmp_path).validate(judged, data_of(tolerance=4), ckpt_path=path, verbose=False, weights_only=True)
    state = torch.load(path, weights_only=True)["state_dict"]
    own = judged.state_dict()
    assert all(torch.equal(own[name], value) for name, value in state.items() if isinstance(value, Tensor))
    given = {"backbone": coded(), "descriptor": 0.5, "periods": new_task().dejavu.periods}
    again = PlaceRecognitionTask.load_from_checkpoint(path, weights_only=True, **given)
    assert torch.equal(again.descriptor.proxies, judged.descriptor.proxies)  # type: ignore[arg-type]


def test_a_further_training_looks_at_its_own_frames(tmp_path: Path) -> None:
    task = new_task(backbone=coded(network=HOG()))
    trainer(tmp_path).fit(task, data_of())
    assert task.descriptor.views is not None
    before = len(task.descriptor.views)
    trainer(tmp_path).fit(task, data_of(second=ArrayTraverse(footage(0.1)), second_truth="0"))
    assert len(task.descriptor.views) > 2 * before


def test_a_judged_task_is_trained_like_any_other(tmp_path: Path) -> None:
    task = new_task(backbone=coded(network=HOG()))
    trainer(tmp_path, inference_mode=False).validate(task, data_of(), verbose=False)
    trainer(tmp_path).fit(task, data_of())
    assert task.descriptor.settled == 0
    assert task.dejavu.features.linear.whitened  # type: ignore[union-attr]
