"""Stretches that training never sees, by which a map is calibrated and judged; short routes and channels."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import fails
from helpers import refused
from small_training import backbone, data_of, footage, new_task, train, trainer, warned

from dejavu_torch import DejaVu, Preprocess, RouteData, SpectralMapper
from dejavu_torch.cli import main
from dejavu_torch.cli.train import MapTrainer
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import as_ground_truth
from dejavu_torch.features.views import STRETCH, Views
from dejavu_torch.training.export import UNTRAINED, LastCheckpoint, beside_untrained

FRAMES = 320
MADE = {"mapper": SpectralMapper(6.0), "whitening": "none"}  # a descriptor and its map
CALIBRATE = DejaVu.calibrate  # which conftest.py patches away


def long(**settings: Any) -> RouteData:
    data = data_of(footage(frames=FRAMES), **settings)
    data.setup("fit")
    return data


def places_of(data: RouteData) -> set[int]:
    """Those that an epoch shows."""
    return {place for batch in data.training_batches() for place in batch.truth.positives[:, 0].tolist()}


@pytest.mark.parametrize(
    ("frames", "share", "expected"),
    [(320, 0.05, 2), (320, 0.25, 4), (2697, 0.05, 7), (299, 0.05, 0), (320, 0.0, 0)],
)
def test_stretches_are_evenly_spaced(frames: int, share: float, expected: int) -> None:
    data = data_of(torch.zeros(frames, 4, 4, dtype=torch.uint8), held_out=share)
    data.setup("fit")
    starts = torch.tensor([*data.held, frames + data.held[0]] if data.held else [])
    assert len(data.held) == expected
    if expected:
        assert (starts.diff() - frames / expected).abs().max() <= 1
        assert min(data.held) >= 0
        assert max(data.held) + STRETCH <= frames


@pytest.mark.parametrize("clip", [1, 4])
def test_training_never_sees_them_in_any_traverse(clip: int) -> None:
    data = long(clip=clip, second=ArrayTraverse(footage(0.1, FRAMES)), batch_size=8)
    held = {start + i for start in data.held for i in range(STRETCH)}
    assert len(held) == 2 * STRETCH
    seen = set().union(*(places_of(data) for _ in range(8)))
    assert seen == set(range(FRAMES)) - held


@pytest.mark.parametrize(
    "source",
    [torch.rand(FRAMES, 6), [footage(frames=FRAMES), footage(frames=FRAMES)]],
    ids=["features", "routes"],
)
def test_nothing_is_held_out_where_it_would_serve_for_nothing(source: Any) -> None:
    data = RouteData(source, tolerance=2)
    data.setup("fit")
    assert data.held == []
    validated = long(validation=ArrayTraverse(footage(0.1, FRAMES)), validation_truth="0")
    assert places_of(validated) == set(range(FRAMES))


def test_templates_are_trained_on_all_places(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    data = long()
    trainer(tmp_path, max_steps=2, limit_val_batches=0).fit(new_task(), data)
    assert data.held == []
    assert len([line for line in warned(caplog) if "not calibrated" in line]) == 1


@pytest.mark.parametrize("validated", [False, True])
def test_what_training_has_not_seen_calibrates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, validated: bool
) -> None:
    seen: list[Views] = []

    def taken(model: DejaVu, reference: object, views: Views) -> None:
        seen.append(views)

    monkeypatch.setattr(DejaVu, "calibrate", taken)
    monkeypatch.setattr("dejavu_torch.training.export.beside_untrained", lambda *_: {})
    data = long(validation=ArrayTraverse(footage(0.1, FRAMES)), validation_truth="0") if validated else long()
    trainer(tmp_path, max_steps=2, limit_val_batches=0).fit(new_task(**MADE), data)
    (views,) = seen
    held = {start + i for start in data.held for i in range(STRETCH)}
    assert set(views.places.tolist()) == (set(range(FRAMES)) if validated else held)


@pytest.mark.parametrize("first", [{"held_out": 0}, {}], ids=["all seen", "held out"])
def test_what_the_checkpoint_s_training_saw_does_not_calibrate(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, first: dict[str, Any]
) -> None:
    seen: list[Views] = []
    monkeypatch.setattr(DejaVu, "calibrate", lambda _, reference, views: seen.append(views))
    monkeypatch.setattr("dejavu_torch.training.export.beside_untrained", lambda *_: {})
    quiet = {"max_steps": 2, "limit_val_batches": 0}
    trainer(tmp_path / "one", LastCheckpoint(), **quiet).fit(new_task(**MADE), long(**first))
    seen.clear()
    running = MapTrainer(accelerator="cpu", logger=False, default_root_dir=tmp_path / "two")
    running.export(new_task(**MADE), long(), str(tmp_path / "one" / "checkpoints" / "last.ckpt"))
    assert (tmp_path / "two" / "map.safetensors").is_file()
    assert len(seen) == ("held_out" not in first)
    assert len([line for line in warned(caplog) if "not calibrated" in line]) == len(first)


@pytest.mark.slow
def test_at_the_end_the_map_is_calibrated_and_set_beside_the_untrained_one(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At another size than the reference's, with a backbone that takes no other."""
    monkeypatch.setattr(DejaVu, "calibrate", CALIBRATE)
    monkeypatch.setattr("dejavu_torch.features.views.FEWEST", 40)
    np.save(tmp_path / "long.npy", footage(frames=FRAMES, side=32).numpy())
    words = ["--data.source", tmp_path / "long.npy", "--trainer.max_steps=2", "--trainer.limit_val_batches=0"]
    words += ["--data.resize", "[16,16]", "--model.backbone", "mine.Plain", "--model.whitening", "none"]
    words += ["--model.mapper", "SpectralMapper", "--model.mapper.route_bytes_per_place", 8]
    train("fit", *words, "--trainer.default_root_dir", tmp_path / "run")
    said = capsys.readouterr().out
    assert "stretches that training never saw" in said
    rows = [line.split("AUC")[0].strip() for line in said.splitlines() if "recall@1" in line]
    assert rows == ["the trained map", "HOG of all frames", "the untrained map"]
    model = DejaVu.load(tmp_path / "run" / "map.safetensors", import_module("mine").Plain())
    assert model.frame_shape == (1, 16, 16)
    assert model.calibration is not None


def test_a_calibration_that_fails_loses_no_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: object) -> None:
        raise RuntimeError("shapes cannot be multiplied")

    monkeypatch.setattr(DejaVu, "calibrate", failing)
    with pytest.raises(RuntimeError, match="shapes"):
        trainer(tmp_path, max_steps=2, limit_val_batches=0).fit(new_task(**MADE), long())
    assert DejaVu.load(tmp_path / "map.safetensors").map.places == FRAMES


@pytest.mark.parametrize("size", [None, 160])
def test_the_untrained_map_is_of_frames_of_the_queries_size(
    caplog: pytest.LogCaptureFixture, size: int | None
) -> None:
    """Of raw frames as `data.resize` leaves them, above what a map reduces them to by default."""
    reference, query = (ArrayTraverse(footage(noise, 24, 176)) for noise in (0.0, 0.1))
    model = DejaVu(backbone(), mapper=SpectralMapper(6.0), preprocess=Preprocess(size=size))
    model.learn(ArrayTraverse(footage(0.0, 24, 32)))
    scores = beside_untrained(model, reference, query, as_ground_truth(torch.arange(24)[:, None]), 2)
    assert UNTRAINED in scores
    assert len([line for line in warned(caplog) if "brought to" in line]) == (size is not None)


# short routes --------------------------------------------------------------------------------------------


def test_a_short_route_is_told_ahead_of_the_training(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    trainer(tmp_path, max_steps=1, limit_val_batches=0).fit(new_task(), data_of())
    (line,) = warned(caplog)
    assert "40 frames, below 300" in line
    assert "dejavu learn" in line
    assert "data.validation" in line
    assert DejaVu.load(tmp_path / "map.safetensors").calibration is None


def test_bytes_that_nobody_asked_for_give_way(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    given = {"mapper": SpectralMapper(0.3), "whitening": "none"}
    with refused("route_bytes_per_place is 0.3"):
        trainer(tmp_path, max_steps=1, limit_val_batches=0).fit(new_task(**given), data_of())
    caplog.clear()
    task = new_task(**given)
    task.gives_way = True
    trainer(tmp_path, max_steps=1, limit_val_batches=0).fit(task, data_of())
    assert [line for line in warned(caplog) if "route_bytes_per_place 0.3" in line and "1.43" in line]
    summary = DejaVu.load(tmp_path / "map.safetensors").summary()
    assert summary.lines > 0
    assert summary.route_bytes / 40 <= 1.43


def test_the_command_tells_what_was_asked_for(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    config = (folder / "train.yaml").read_text()
    head, tail = config.split("  mapper:")[0], config[config.index("data:") :]
    mapper = "  mapper: {class_path: SpectralMapper, init_args: {route_bytes_per_place: 0.3}}\n"
    (tmp_path / "tight.yaml").write_text(f"{head}{mapper}{tail}")
    words = ["--config", str(tmp_path / "tight.yaml"), "--trainer.default_root_dir", str(tmp_path / "run")]
    words += ["--trainer.max_steps=1", "--trainer.limit_val_batches=0"]
    error = fails(capfd, "train", "fit", *words, "--model.mapper.route_bytes_per_place", "0.3")
    assert "route_bytes_per_place is 0.3; expected more than" in error
    for command in ("fit", "export"):
        main(["train", command, *words])
    assert (tmp_path / "run" / "map.safetensors").is_file()


# channels ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [1, 3])
def test_a_network_takes_as_many_channels_as_the_frames_have(tmp_path: Path, channels: int) -> None:
    frames = footage()[..., None].expand(-1, -1, -1, channels)
    network = type(backbone())(8, resize=(16, 16), widths=(4, 8), squeeze=4)
    task = new_task(backbone=network)
    trainer(tmp_path, max_steps=1, limit_val_batches=0).fit(task, data_of(frames))
    model = DejaVu.load(tmp_path / "map.safetensors")
    assert model.features.channels == channels
    assert model(torch.rand(2, channels, 16, 16)).shape == (2, 40)
    start = str(tmp_path / "map.safetensors")
    again = type(network)(8, resize=(16, 16), widths=(4, 8), squeeze=4)
    new_task(backbone=again, start=start)  # takes its channels too
    assert again.channels == channels


def test_a_checkpoint_brings_its_channels(folder: Path, tmp_path: Path) -> None:
    config = (folder / "train.yaml").read_text().replace("channels: 1, ", "")
    (tmp_path / "free.yaml").write_text(config)
    words = ["--trainer.default_root_dir", tmp_path / "run"]
    train("fit", *words, "--trainer.max_steps", 1, config=str(tmp_path / "free.yaml"))
    train("export", *words, config=str(tmp_path / "free.yaml"))
    assert DejaVu.load(tmp_path / "run" / "map.safetensors").features.channels == 1
