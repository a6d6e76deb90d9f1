"""Stretches that training never sees, by which a map is calibrated and judged; short routes and channels."""

from __future__ import annotations

import pytest
import torch
from small_training import (
    backbone,
    data_of,
    footage,
    last,
    new_descriptor,
    new_task,
    trainer,
    warned,
)

from dejavu_torch import DejaVu, RouteData, SpectralMapper
from dejavu_torch.cli.train import MapTrainer
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import as_ground_truth
from dejavu_torch.features.views import SEGMENT
from dejavu_torch.training import export
from dejavu_torch.training.export import compare_with_untrained

FRAMES = 320
MADE = {"mapper": SpectralMapper(6.0), "whitening": "none"}  # a descriptor and its map
SHORT = {"max_steps": 2, "limit_val_batches": 0}


def long(**settings):
    data = data_of(footage(frames=FRAMES), **settings)
    data.setup("fit")
    return data


def places_of(data):
    """Those that an epoch shows."""
    return {place for batch in data.training_batches() for place in batch.truth.positives[:, 0].tolist()}


def held(data):
    return {start + i for start in data.held for i in range(SEGMENT)}


@pytest.fixture
def calibrations(monkeypatch):
    """The places of the views that maps are calibrated by."""
    seen = []

    def taken(model, reference, views):
        seen.append(set(views.places.tolist()))

    monkeypatch.setattr(DejaVu, "calibrate", taken)
    monkeypatch.setattr("dejavu_torch.training.export.compare_with_untrained", lambda *_: {})
    return seen


@pytest.mark.parametrize(
    ("frames", "share", "expected"),
    [(320, 0.05, 2), (320, 0.25, 4), (2697, 0.05, 7), (299, 0.05, 0), (320, 0.0, 0)],
)
def test_stretches_are_evenly_spaced(frames, share, expected):
    data = data_of(torch.zeros(frames, 4, 4, dtype=torch.uint8), held_out=share)
    data.setup("fit")
    assert len(data.held) == expected
    if expected:
        starts = torch.tensor([*data.held, frames + data.held[0]])
        assert (starts.diff() - frames / expected).abs().max() <= 1
        assert min(data.held) >= 0
        assert max(data.held) + SEGMENT <= frames


@pytest.mark.parametrize("clip", [1, 4])
def test_training_never_sees_them_in_any_traverse(clip):
    data = long(clip=clip, second=ArrayTraverse(footage(0.1, FRAMES)), batch_size=8)
    assert len(held(data)) == 2 * SEGMENT
    assert set().union(*(places_of(data) for _ in range(8))) == set(range(FRAMES)) - held(data)


def test_nothing_is_held_out_if_it_would_serve_for_nothing(tmp_path, caplog):
    """Of features, of several routes, with a validation, or of templates."""
    for source in (torch.rand(FRAMES, 6), [footage(frames=FRAMES), footage(frames=FRAMES)]):
        data = RouteData(source, tolerance=2)
        data.setup("fit")
        assert data.held == []
    validated = long(validation=ArrayTraverse(footage(0.1, FRAMES)), validation_truth="0")
    assert places_of(validated) == set(range(FRAMES))
    data = long()
    trainer(tmp_path, **SHORT).fit(new_task(), data)
    assert data.held == []
    assert len([line for line in warned(caplog) if "not calibrated" in line]) == 1


@pytest.mark.parametrize("validated", [False, True])
def test_what_training_has_not_seen_calibrates(tmp_path, calibrations, validated):
    data = long(validation=ArrayTraverse(footage(0.1, FRAMES)), validation_truth="0") if validated else long()
    trainer(tmp_path, **SHORT).fit(new_descriptor(backbone=backbone(), **MADE), data)
    assert calibrations == [set(range(FRAMES)) if validated else held(data)]


@pytest.mark.parametrize("first", [{"held_out": 0}, {}], ids=["all seen", "held out"])
def test_what_the_checkpoint_s_training_saw_does_not_calibrate(tmp_path, caplog, calibrations, first):
    trainer(tmp_path / "one", last(tmp_path / "one"), **SHORT).fit(
        new_descriptor(backbone=backbone(), **MADE), long(**first)
    )
    calibrations.clear()
    running = MapTrainer(accelerator="cpu", logger=False, default_root_dir=tmp_path / "two")
    running.export(
        new_descriptor(backbone=backbone(), **MADE),
        long(),
        str(tmp_path / "one" / "checkpoints" / "last.ckpt"),
    )
    assert (tmp_path / "two" / "map.safetensors").is_file()
    assert len(calibrations) == ("held_out" not in first)
    assert len([line for line in warned(caplog) if "not calibrated" in line]) == len(first)


def test_a_calibration_that_fails_loses_no_training(tmp_path, monkeypatch):
    def failing(*_):
        raise RuntimeError("shapes cannot be multiplied")

    monkeypatch.setattr(DejaVu, "calibrate", failing)
    with pytest.raises(RuntimeError, match="shapes"):
        trainer(tmp_path, **SHORT).fit(new_descriptor(backbone=backbone(), **MADE), long())
    assert DejaVu.load(tmp_path / "map.safetensors").map.places == FRAMES


@pytest.mark.parametrize("settings", [{"hold": 0.9}, {"step": 1.0}])
def test_the_untrained_map_takes_as_many_bytes(settings, monkeypatch):
    """Its own descriptor would take others to hold as much, and a step is in units of the trained one."""
    reference, query = (ArrayTraverse(footage(noise, 24, 64)) for noise in (0.0, 0.1))
    model = DejaVu(backbone(), mapper=SpectralMapper(**settings)).learn(reference)  # type: ignore[arg-type]
    sizes, match = [], export._match

    def noted(model, query):
        sizes.append(model.summary().route_bytes)
        return match(model, query)

    monkeypatch.setattr(export, "_match", noted)
    compare_with_untrained(model, reference, query, as_ground_truth(torch.arange(24)[:, None]), 2)
    assert sizes[1] == pytest.approx(sizes[0], rel=0.02)


# short routes, and channels ------------------------------------------------------------------------------


def test_a_short_route_is_told_before_the_training(tmp_path, caplog):
    trainer(tmp_path, **SHORT).fit(new_task(), data_of())
    (line,) = warned(caplog)
    assert all(fact in line for fact in ("40 frames, fewer than 300", "dejavu learn", "data.validation"))
    assert DejaVu.load(tmp_path / "map.safetensors").calibration is None


@pytest.mark.parametrize("channels", [1, 3])
def test_a_network_takes_as_many_channels_as_the_frames_have(tmp_path, channels):
    frames = footage()[..., None].expand(-1, -1, -1, channels)
    network, again = (type(backbone())(8, resize=(16, 16), widths=(4, 8), squeeze=4) for _ in range(2))
    trainer(tmp_path, last(tmp_path), **SHORT).fit(new_task(backbone=network), data_of(frames))
    model = DejaVu.load(tmp_path / "map.safetensors")
    assert model.features.channels == channels
    assert model(torch.rand(2, channels, 16, 16)).shape == (2, 40)
    new_task(backbone=again, start=str(tmp_path / "map.safetensors"))  # takes its channels too
    assert again.channels == channels
    free = type(network)(8, resize=(16, 16), widths=(4, 8), squeeze=4)
    running = MapTrainer(accelerator="cpu", logger=False, default_root_dir=tmp_path / "again")
    running.export(new_task(backbone=free), data_of(frames), str(tmp_path / "checkpoints" / "last.ckpt"))
    assert DejaVu.load(tmp_path / "again" / "map.safetensors").features.channels == channels
