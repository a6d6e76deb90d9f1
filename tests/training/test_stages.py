"""The stages of a training, the descriptor and its code: what is trained when, what stays."""

from __future__ import annotations

import math
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
    coded,
    data_of,
    fit,
    footage,
    heights,
    new_task,
    recall,
    still,
    trainer,
    warned,
)
from torch import Tensor, nn

from dejavu_torch import HOG, DejaVu, SpectralMapper
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import as_ground_truth
from dejavu_torch.training.datamodule import StoredFrames
from dejavu_torch.training.stages import CodeStage, DescriptorStage, similar_span
from dejavu_torch.training.task import PlaceRecognitionTask

ALL = [DescriptorStage, CodeStage]


def staged(**settings: Any) -> PlaceRecognitionTask:
    return new_task(**{"backbone": coded(), "descriptor": 0.5} | settings)


class Watch(Callback):
    """The state of the backbone before every step and after the last, and the rate of every step."""

    def __init__(self) -> None:
        self.states: list[dict[str, Tensor]] = []
        self.rates: list[float] = []

    def keep(self, task: Any) -> None:
        self.states.append({name: value.clone() for name, value in task.dejavu.features.state_dict().items()})

    def on_before_optimizer_step(self, trainer: Any, pl_module: Any, optimizer: Any) -> None:
        self.keep(pl_module)
        self.rates.append(optimizer.param_groups[0]["lr"] / pl_module.lr)

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        self.keep(pl_module)


def changed(states: list[dict[str, Tensor]]) -> set[str]:
    """Names of what differs between the first and the last state, without counters."""
    first, last = states[0], states[-1]
    return {name for name in first if not torch.equal(first[name], last[name]) and "num_" not in name}


def parts_of(names: set[str]) -> set[str]:
    return {name.partition(".")[0] for name in names}


def watched(folder: Path, **settings: Any) -> tuple[PlaceRecognitionTask, Watch]:
    task, watch = staged(**settings), Watch()
    trainer(folder, watch, max_steps=10).fit(task, data_of())
    return task, watch


def test_the_network_is_learned_first_and_its_code_after_it(tmp_path: Path) -> None:
    task, watch = watched(tmp_path)
    assert [type(stage) for stage in task.stages] == ALL
    first, code = changed(watch.states[:5]), changed(watch.states[5:])
    assert parts_of(first) == {"network"}
    assert first >= {"network.convolutions.0.weight", "network.convolutions.1.running_mean"}
    assert parts_of(code) == {"linear", "standardise"}
    assert not code & {"linear.mean", "linear.projection", "linear.whitened"}
    assert not watch.states[4]["linear.whitened"]
    assert watch.states[5]["linear.whitened"]
    assert watch.rates == pytest.approx(2 * heights(5))
    assert DejaVu.load(tmp_path / "map.safetensors").features.linear.whitened  # type: ignore[union-attr]


def test_what_is_learned_finds_places_on_another_day(tmp_path: Path) -> None:
    mild = still(noise=0.1, exposure=(0.1, 0.1))
    task = new_task(backbone=coded(hidden=64, noise=0.5), descriptor=0.2)
    model = fit(tmp_path, task, data_of(augmentation=mild), max_steps=500, limit_val_batches=0)
    assert recall(model, footage(0.05)) > 0.7


@pytest.mark.parametrize("name", ["hog", "frozen"])
def test_without_a_network_to_train_every_step_is_the_codes(tmp_path: Path, name: str) -> None:
    """HOG has no parameters, a frozen network none that may change; both are whitened first."""
    network, freeze = (HOG(), []) if name == "hog" else (backbone(), ["network"])
    task, watch = watched(tmp_path, backbone=coded(network=network), freeze=freeze)
    assert [type(stage) for stage in task.stages] == ALL[1:]
    assert watch.states[0]["linear.whitened"]
    assert parts_of(changed(watch.states)) == {"linear", "standardise"}


def test_a_second_traverse_tells_what_a_season_changes(tmp_path: Path) -> None:
    """Winter is darker at the left: without augmentation that is all the change that there is."""
    winter = (footage().float() * torch.linspace(0.2, 1, 16)).byte()
    task = new_task(backbone=coded(network=HOG()))
    given = {"second": ArrayTraverse(winter), "second_truth": "0", "augmentation": still()}
    trainer(tmp_path / "both").fit(task, data_of(**given))
    assert task.views is not None
    assert len({tuple(view) for view in task.views[0].tolist()}) == 2 * FRAMES
    with refused("data.augmentation changes nothing", "data.second"):
        trainer(tmp_path / "one").fit(new_task(backbone=coded(network=HOG())), data_of(augmentation=still()))


def test_frames_of_no_known_place_are_not_learned_from(tmp_path: Path) -> None:
    truth = tmp_path / "truth.csv"
    truth.write_text("query,place\n" + "".join(f"{i},{i}\n" for i in range(10)))
    task = new_task(backbone=coded(network=HOG()))
    given = {"second": ArrayTraverse(footage(0.1)), "second_truth": str(truth), "batch_size": 2}
    trainer(tmp_path).fit(task, data_of(**given))
    assert task.views is not None
    assert task.views[1].min() == 0
    assert len(task.views[0]) == len(task.views[1]) == 10 * (FRAMES + 10)
    trainer(tmp_path).fit(task, data_of())  # a further training describes its own frames
    assert len(task.views[0]) == 10 * (FRAMES - FRAMES % 16)


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


def test_a_training_that_ends_in_an_earlier_stage_leaves_no_map(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    trainer(tmp_path, Stop(3), max_steps=10).fit(staged(), data_of())
    assert not (tmp_path / "map.safetensors").exists()
    (line,) = warned(caplog)
    assert "no map is written" in line
    assert "DescriptorStage" in line


def test_what_watches_a_figure_begins_with_the_last_stage(tmp_path: Path) -> None:
    """Up to step 10 there is no map: no patience is lost there, and no best checkpoint found."""
    figures: list[tuple[int, bool]] = []

    class Seen(Callback):
        def on_validation_end(self, trainer: Any, pl_module: Any) -> None:
            figures.append((trainer.global_step, "val/auc_augmented" in trainer.callback_metrics))

    patient = EarlyStopping("val/auc_augmented", mode="max", patience=2)
    best = ModelCheckpoint(tmp_path, monitor="train/loss", filename="{step}", every_n_train_steps=1)
    given = {"max_steps": 20, "log_every_n_steps": 1, "val_check_interval": 1}
    running = trainer(tmp_path, Seen(), patient, best, **given)
    callbacks = list(running.callbacks)  # type: ignore[attr-defined]
    running.fit(staged(), data_of())
    assert running.global_step > 11
    assert all(there == (step > 10) for step, there in figures)
    assert int(best.best_model_path.partition("step=")[2].removesuffix(".ckpt")) > 10
    assert (tmp_path / "map.safetensors").is_file()
    assert running.callbacks == callbacks  # type: ignore[attr-defined]


def stored(*routes: Tensor) -> StoredFrames:
    count = sum(map(len, routes))
    return StoredFrames([(255 * one).byte() for one in routes], as_ground_truth(torch.arange(count)[:, None]))


def slid(step: int, count: int = 200, noise: float = 0.0, seed: int = 0) -> Tensor:
    """A window of 64 x 64 pixels, slid so many pixels a frame along a picture in which nothing repeats."""
    random = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 1, 4, (64 + step * count) // 16 + 1, generator=random)
    picture = nn.functional.interpolate(coarse, scale_factor=16, mode="bicubic")[0]
    frames = torch.stack([picture[:, :, step * i : step * i + 64] for i in range(count)])
    return (frames + noise * torch.randn(frames.shape, generator=random)).clamp(0, 1)


@pytest.mark.parametrize(("step", "noise", "expected"), [(1, 0.0, 5), (1, 0.1, 5), (80, 0.0, 1)])
def test_a_stretch_is_as_long_as_frames_stay_alike(step: int, noise: float, expected: int) -> None:
    frames = slid(step, noise=noise)
    assert similar_span(stored(frames), [200], 5) == expected
    assert [similar_span(stored(frames), [200], most) for most in (1, 0)] == [1, 1]  # the tolerance at most
    stop = torch.cat([frames[:100], frames[100:101].expand(60, -1, -1, -1), frames[100:]])
    assert similar_span(stored(stop), [260], 5) == expected


def test_what_a_route_always_shows_is_no_likeness() -> None:
    below, other = torch.rand(2, 1, 32, 64, generator=torch.Generator().manual_seed(1))
    routes = [slid(80, 60, seed=seed) for seed in (2, 3)]
    routes[0][:, :, 32:], routes[1][:, :, 32:] = below, other
    assert similar_span(stored(*routes), [60, 60], 5) == 1
    assert similar_span(stored(slid(1)[:60], *routes), [60, 60, 60], 5) == 1  # not the first route alone


def test_frames_too_small_for_hog_have_stretches_of_the_tolerance() -> None:
    small = StoredFrames(
        [torch.zeros(9, 1, 4, 4, dtype=torch.uint8)], as_ground_truth(torch.arange(9)[:, None])
    )
    assert similar_span(small, [9], 5) == 5


def test_places_are_right_within_a_stretch(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = new_task(mapper=SpectralMapper(6.0))
    fit(tmp_path, task, data_of(slid(80), tolerance=5), max_steps=1)
    assert isinstance(task.stage, DescriptorStage)
    assert (int(task.stage.every), len(task.stage.proxies)) == (1, 200)
    assert (task.stage.tolerance(task), task.metric.tolerance) == (1, 5)
    assert task.stage.chance(task) == {"descriptor": pytest.approx(math.log(200 / 3))}
    # one that is resumed keeps its stretches
    monkeypatch.setattr("dejavu_torch.training.stages.similar_span", lambda *_: pytest.fail("looked again"))
    task.stage.begin(task)
    assert int(task.stage.every) == 1
    (line,) = [line for line in warned(caplog) if "stay similar" in line]
    assert all(fact in line for fact in ("for 1, fewer than data.tolerance 5", "dejavu learn"))
