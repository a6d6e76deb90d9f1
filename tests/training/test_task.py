"""The task under Lightning's trainer: what it learns, keeps, leaves alone and hands over."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
import torch
from dejavu_torch.data.truthfile import read_truth
from dejavu_torch.recognition.deploy import Localizer
from helpers import Fixed
from pytorch_lightning import Callback, Trainer
from test_evenly import QUERY, REFERENCE, STEP, camera
from test_evenly import footage as ground
from torch import Tensor, nn

from dejavu_torch import DejaVu
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.training.datamodule import RouteData
from dejavu_torch.training.export import MapExport
from dejavu_torch.training.objective import Objective
from dejavu_torch.training.task import PlaceRecognitionTask
from dejavu_torch.types import FrequencyLayer, Plan, Training

FRAMES = 40


def footage(noise: float = 0.0, frames: int = FRAMES, side: int = 16) -> Tensor:
    """(N,side,side) uint8, a window slid along a smooth strip by 2 pixels a frame."""
    random = torch.Generator().manual_seed(0)
    strip = torch.rand(1, 1, 4, frames, generator=random)
    strip = nn.functional.interpolate(strip, (side, 2 * frames + side), mode="bicubic")[0, 0]
    windows = torch.stack([strip[:, 2 * i : 2 * i + side] for i in range(frames)])
    noisy = windows + noise * torch.randn(windows.shape, generator=random)
    return (255 * noisy.clamp(0, 1)).byte()


def backbone(dimension: int = 8) -> SmallCNN:
    return SmallCNN(dimension, channels=1, resize=(16, 16), widths=(4, 8), squeeze=4)


def new_task(**settings: Any) -> PlaceRecognitionTask:
    given = {"backbone": backbone(), "periods": ImposedPeriods([3, 4, 5], bin=2)} | settings
    return PlaceRecognitionTask(**given)


def data_of(source: Tensor | None = None, **settings: Any) -> RouteData:
    given = {"tolerance": 2, "batch_size": 16} | settings
    return RouteData(ArrayTraverse(footage() if source is None else source), **given)


def trainer(folder: Path, *callbacks: Callback, **settings: Any) -> Trainer:
    given = {"max_steps": 4, "enable_checkpointing": bool(callbacks)} | settings
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    return Trainer(
        accelerator="cpu", default_root_dir=folder, callbacks=[*callbacks, MapExport()], **quiet, **given
    )


def fit(folder: Path, task: PlaceRecognitionTask, data: RouteData, **settings: Any) -> DejaVu:
    """The map that a training writes."""
    trainer(folder, **settings).fit(task, data)
    return DejaVu.load(folder / "map.safetensors")


def warned(caplog: pytest.LogCaptureFixture) -> list[str]:
    """What the package told."""
    return [record.getMessage() for record in caplog.records if record.name == "dejavu_torch"]


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"feature_weights": True},
        {"train_templates": False},
        {"metric": "l2"},
        {"batch_size": 1},
        {"losses": Objective(periodicity=0.1, decorrelation=0.1, support=0.1)},
    ],
    ids=str,
)
def test_task_map_and_exported_program_give_the_same_scores(tmp_path: Path, settings: dict[str, Any]) -> None:
    task = new_task(**settings)
    assert_same_scores(task, fit(tmp_path, task, data_of(batch_size=20)))


def assert_same_scores(task: PlaceRecognitionTask, model: DejaVu) -> None:
    """Of the task, of its map, and of what is exported."""
    frames = footage(0.1)[:7, None] / 255
    with torch.no_grad():
        scores = task.eval()(frames)
        torch.testing.assert_close(model(frames), scores, rtol=1e-5, atol=1e-5)
        localizer = Localizer(model.pipeline, model.map, model.matcher).eval()
        free = {"frames": {0: torch.export.Dim("batch")}}
        program = torch.export.export(localizer, (frames[:2],), dynamic_shapes=free)
        torch.testing.assert_close(program.module()(frames), scores, rtol=1e-5, atol=1e-5)
    assert scores.shape == (7, FRAMES)
    assert not list(model.map.parameters())


def test_the_map_tells_its_training_and_counts_the_backbone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PL_GLOBAL_SEED", raising=False)
    task = new_task()
    model = fit(tmp_path, task, data_of())
    assert model.trained == Training(4, task.seconds, None)
    assert not any(part.training for part in model.modules())
    assert task.seconds > 0
    weights = sum(tensor.nbytes for tensor in task.dejavu.features.state_dict().values())
    assert model.backbone_bytes == weights > 0
    assert model.map_bytes == (tmp_path / "map.safetensors").stat().st_size
    monkeypatch.setenv("PL_GLOBAL_SEED", "7")
    again = fit(tmp_path, new_task(), data_of())
    assert again.trained is not None
    assert again.trained.seed == 7


def recall(model: DejaVu, query: Tensor) -> float:
    truth = torch.arange(len(query))[:, None]
    return evaluate(model.localize(ArrayTraverse(query)), truth, tolerance=2).recall_at_1


def test_training_finds_places_that_the_untrained_start_does_not(tmp_path: Path) -> None:
    noisy = footage(0.15)
    start = recall(fit(tmp_path, new_task(lr=1e-9), data_of(), max_steps=1), noisy)
    trained = recall(fit(tmp_path, new_task(lr=1e-2), data_of(), max_steps=150), noisy)
    assert trained > max(0.6, start + 0.2), (start, trained)


def test_a_seed_repeats_a_training(tmp_path: Path) -> None:
    states = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        states.append(fit(tmp_path, new_task(refresh=1), data_of(), max_epochs=2, max_steps=-1).state_dict())
    one, same, other = ({n: t for n, t in s.items() if isinstance(t, Tensor)} for s in states)
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not torch.equal(one["map.templates"], other["map.templates"])


def test_a_validation_changes_nothing_in_training(tmp_path: Path) -> None:
    maps = []
    for batches in (0, 1.0):
        torch.manual_seed(0)
        settings = {"limit_val_batches": batches, "num_sanity_val_steps": 0, "max_epochs": 3, "max_steps": -1}
        maps.append(fit(tmp_path, new_task(), data_of(), **settings).map.templates)
    assert torch.equal(*maps)


def test_bf16_trains_and_exports_float32(tmp_path: Path) -> None:
    model = fit(tmp_path, new_task(feature_weights=True), data_of(), precision="bf16-mixed")
    kinds = {t.dtype for t in model.state_dict().values() if isinstance(t, Tensor) and t.is_floating_point()}
    assert kinds == {torch.float32}


# templates, weights, layers ------------------------------------------------------------------------------


def test_weights_are_learnt_and_written_with_their_signs_turned(tmp_path: Path) -> None:
    task = new_task(feature_weights=True, lr=2.0)
    model = fit(tmp_path, task, data_of())
    weights, frames = task.dejavu.map.weights.detach(), footage(0.1)[:7, None] / 255
    assert weights.min() < 0  # so large a step, and nothing holds it back
    assert torch.equal(model.map.weights, weights.abs())
    with torch.no_grad():
        torch.testing.assert_close(model(frames), task.eval()(frames), rtol=1e-5, atol=1e-5)


class Later(Fixed):
    """Other layers whenever it is asked again."""

    asked = 0

    def plan(self, features: Tensor) -> Plan:
        self.asked += 1
        periods = (3, 4) if self.asked == 1 else (5, 7, 9)
        return tuple(FrequencyLayer(Fraction(p), p, 0, len(features), tuple(range(8))) for p in periods)


def phases(task: PlaceRecognitionTask | DejaVu) -> list[int]:
    model = task if isinstance(task, DejaVu) else task.dejavu
    return [layer.phases for layer in model.map.plan]


class Starts(Callback):
    """Remembers the templates at the start of the last epoch."""

    def on_train_batch_start(self, trainer: Trainer, pl_module: Any, batch: Any, batch_idx: int) -> None:
        if batch_idx == 0:
            self.templates = pl_module.dejavu.map.templates.detach().clone()


@pytest.mark.parametrize("weights", [False, True])
def test_layers_found_later_are_trained(tmp_path: Path, weights: bool) -> None:
    task, seen = new_task(periods=Later(), refresh=1, feature_weights=weights), Starts()
    running = trainer(tmp_path, seen, max_epochs=2, max_steps=-1, enable_checkpointing=False)
    running.fit(task, data_of())
    assert phases(task) == [5, 7, 9]
    assert not torch.equal(seen.templates, task.dejavu.map.templates)
    optimised = {id(p) for group in running.optimizers[0].param_groups for p in group["params"]}
    assert optimised == {id(p) for p in task.parameters()}
    assert {id(p) for p in running.optimizers[0].state} <= optimised


class Asked(Callback):
    """Remembers how often the layers were asked for by the first step of each epoch."""

    def __init__(self) -> None:
        self.times: list[int] = []

    def on_train_batch_start(self, trainer: Trainer, pl_module: Any, batch: Any, batch_idx: int) -> None:
        if batch_idx == 0:
            self.times.append(pl_module.dejavu.periods.asked)


@pytest.mark.parametrize(
    ("refresh", "times"), [(0, [1] * 5), (1, [1, 2, 3, 4, 5]), (2, [1, 1, 2, 2, 3]), (3, [1, 1, 1, 2, 2])]
)
def test_layers_are_asked_for_every_few_epochs(tmp_path: Path, refresh: int, times: list[int]) -> None:
    asked, task = Asked(), new_task(periods=Later(), refresh=refresh)
    trainer(tmp_path, asked, max_epochs=5, max_steps=-1, enable_checkpointing=False).fit(task, data_of())
    assert asked.times == times


def test_places_without_a_layer_are_left_out(tmp_path: Path) -> None:
    gap = [FrequencyLayer(4, 4, start, start + 16, (0, 1, 2)) for start in (0, 24)]
    running, task = trainer(tmp_path, max_epochs=1, max_steps=-1), new_task(periods=Fixed(*gap))
    running.fit(task, data_of(batch_size=20))
    assert running.callback_metrics["train/left_out"] == 4  # 16 to 23, less 2 on each side within tolerance
    assert all(parameter.isfinite().all() for parameter in task.parameters())
    assert DejaVu.load(tmp_path / "map.safetensors").eval()(torch.rand(2, 1, 16, 16))[:, 16:24].isinf().all()


def test_even_steps_are_places(tmp_path: Path) -> None:
    small = SmallCNN(8, channels=1, resize=(16, 16), widths=(4,), squeeze=4)
    data = RouteData(ArrayTraverse(ground(REFERENCE)), velocity=camera(), batch_size=32)
    model = fit(tmp_path, new_task(backbone=small), data)
    assert model.step == STEP
    assert model.map.places == 101
    assert len(model.map.way) == len(REFERENCE)
    assert len(model.localize(ArrayTraverse(ground(QUERY))).index) == 101


def test_frames_that_were_resized_are_what_the_map_expects(tmp_path: Path) -> None:
    model = fit(tmp_path, new_task(), data_of(footage(side=24), resize=(16, 16)))
    assert model.learnt_from == (1, 16, 16)


# figures ---------------------------------------------------------------------------------------------------


def assert_figures(running: Trainer, task: PlaceRecognitionTask, noisy: Tensor, truth: str = "0") -> None:
    """What a test tells is what `evaluate` says of the map in the trainer's folder."""
    data = data_of(query=ArrayTraverse(noisy), truth=truth)
    (figures,) = running.test(task, data, verbose=False)
    match = DejaVu.load(Path(running.default_root_dir) / "map.safetensors").localize(ArrayTraverse(noisy))
    expected = evaluate(match, read_truth(truth, FRAMES, FRAMES), tolerance=2)._asdict()
    assert figures == pytest.approx({f"test/{name}": value for name, value in expected.items()}, abs=1e-6)


@pytest.mark.parametrize("truth", ["0", "5", "csv"])
def test_the_figures_are_those_of_judge_on_the_map(tmp_path: Path, truth: str) -> None:
    """5 leaves the last queries without a right place; the csv also leaves some unknown."""
    if truth == "csv":
        truth = str(tmp_path / "truth.csv")
        rows = [f"{i},{i},{i // 2}" if i % 3 else f"{i}" for i in range(30)]
        Path(truth).write_text("\n".join(rows) + "\n")
    running, task = trainer(tmp_path), new_task()
    running.fit(task, data_of())
    assert_figures(running, task, footage(0.2), truth)


@pytest.mark.parametrize("precision", ["bf16-mixed", "32-true"])
@pytest.mark.parametrize("settings", [{}, {"train_templates": False, "feature_weights": True}], ids=str)
def test_figures_are_made_in_32_bits(tmp_path: Path, precision: Any, settings: dict[str, Any]) -> None:
    running, task = trainer(tmp_path, precision=precision, max_steps=30), new_task(**settings)
    running.fit(task, data_of())
    assert_figures(running, task, footage(0.2))


def test_without_training_the_phase_means_are_judged(tmp_path: Path) -> None:
    running, task = trainer(tmp_path), new_task()
    running.validate(task, data_of(validation=ArrayTraverse(footage(0.2))), verbose=False)
    task.deployed().save(tmp_path / "map.safetensors")
    assert_figures(running, task, footage(0.2))
