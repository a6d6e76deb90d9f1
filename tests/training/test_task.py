"""The task under Lightning's trainer: what it learns, keeps, leaves alone and hands over."""

from __future__ import annotations

import pytest
import torch
from footage import QUERY, REFERENCE, STEP, camera
from footage import footage as ground
from helpers import Fixed, refused
from small_training import (
    FRAMES,
    assert_same_scores,
    data_of,
    fit,
    footage,
    heights,
    mapper,
    new_task,
    recall,
    trainer,
)
from torch import Tensor, nn

from dejavu_torch import DejaVu, Preprocess, TemplateMap
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import find_ground_truth
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.training.datamodule import RouteData
from dejavu_torch.types import FrequencyLayer, Training

EPOCHS = {"max_steps": -1, "enable_checkpointing": False}


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"mapper": mapper(metric="l2", reduction="sum", temperature=0.5)},
        {"mapper": mapper(metric="cosine", trainable=True), "batch_size": 1},
    ],
    ids=str,
)
def test_task_map_and_exported_program_give_the_same_scores(tmp_path, settings):
    task = new_task(**settings)
    model = fit(tmp_path, task, data_of(batch_size=20))
    assert_same_scores(task, model)
    assert isinstance(model.map, TemplateMap)
    temperature = task.log_temperature.exp().item()
    assert model.map.temperature == model.mapper.temperature == pytest.approx(temperature)


def test_the_map_holds_how_it_was_trained_and_counts_the_backbone(tmp_path, monkeypatch):
    monkeypatch.delenv("PL_GLOBAL_SEED", raising=False)
    task = new_task(weight_bits=32)
    model = fit(tmp_path, task, data_of())
    assert model.trained == Training(4, None)
    assert not any(part.training for part in model.modules())
    weights = sum(tensor.nbytes for tensor in task.dejavu.features.state_dict().values())
    assert model.summary().fixed["backbone"] == weights > 0
    assert model.summary().map_bytes == (tmp_path / "map.safetensors").stat().st_size
    monkeypatch.setenv("PL_GLOBAL_SEED", "7")
    assert fit(tmp_path, new_task(), data_of()).trained == Training(4, 7)


def test_training_finds_places_that_the_untrained_start_does_not(tmp_path):
    torch.manual_seed(0)
    noisy = footage(0.15)
    given = {"limit_val_batches": 0}
    start = recall(fit(tmp_path, new_task(lr=1e-9), data_of(), max_steps=1, **given), noisy)
    trained = recall(fit(tmp_path, new_task(lr=1e-2), data_of(), max_steps=150, **given), noisy)
    assert trained > start + 0.2, (start, trained)


def test_a_seed_repeats_a_training_and_a_validation_changes_nothing_in_it(tmp_path):
    states = []
    for seed, batches in ((1, 1.0), (1, 0), (2, 0)):
        torch.manual_seed(seed)
        given = EPOCHS | {"max_epochs": 2, "limit_val_batches": batches, "num_sanity_val_steps": 0}
        states.append(fit(tmp_path, new_task(), data_of(), **given).state_dict())
    one, same, other = ({n: t for n, t in s.items() if isinstance(t, Tensor)} for s in states)
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not torch.equal(one["map.templates"], other["map.templates"])


# layers --------------------------------------------------------------------------------------------------


def test_places_without_a_layer_are_left_out(tmp_path):
    gap = [FrequencyLayer(4, 4, start, start + 16, (0, 1, 2)) for start in (0, 24)]
    running, task = trainer(tmp_path, max_epochs=1, max_steps=-1), new_task(mapper=mapper(Fixed(*gap)))
    running.fit(task, data_of(batch_size=20))
    assert running.callback_metrics["train/left_out"] == 4  # 16 to 23, less 2 on each side within tolerance
    assert all(parameter.isfinite().all() for parameter in task.parameters())
    assert DejaVu.load(tmp_path / "map.safetensors").eval()(torch.rand(2, 1, 16, 16))[:, 16:24].isinf().all()


@pytest.mark.parametrize(
    ("settings", "steps", "facts"),
    [
        ({"mapper": mapper(Fixed())}, {}, ["nothing repeats in the features of the array", "imposed"]),
        ({}, {"max_steps": -1, "max_epochs": -1}, ["no end", "trainer.max_steps"]),
    ],
    ids=["no layer", "no end"],
)
def test_what_cannot_be_trained_is_refused(tmp_path, settings, steps, facts):
    with refused(*facts):
        fit(tmp_path, new_task(**settings), data_of(), **steps)


# frames --------------------------------------------------------------------------------------------------


def test_even_steps_are_places(tmp_path):
    small = SmallCNN(8, channels=1, resize=(16, 16), widths=(4,), squeeze=4)
    data = RouteData(ArrayTraverse(ground(REFERENCE)), velocity=camera(), batch_size=32)
    model = fit(tmp_path, new_task(backbone=small), data)
    assert model.step == STEP
    assert model.map.places == 101
    assert len(model.map.positions) == len(REFERENCE)
    assert len(model.localize(ArrayTraverse(ground(QUERY))).index) == 101


@pytest.mark.parametrize(
    ("settings", "resize", "stored", "shape"),
    [
        ({}, None, (1, 16, 16), (1, 24, 24)),  # once, to what the backbone would resize them to
        ({}, (20, 20), (1, 20, 20), (1, 20, 20)),
        ({"backbone": SmallCNN(8, 1, (32, 32), (4,))}, None, (1, 24, 24), (1, 24, 24)),  # never larger
        ({"preprocess": Preprocess(contrast="patch")}, None, (1, 24, 24), (1, 24, 24)),  # of the whole frame
        ({"backbone": nn.Sequential(nn.Flatten(), nn.Linear(576, 8))}, None, (1, 24, 24), (1, 24, 24)),
    ],
)
def test_frames_are_resized_when_they_are_stored(tmp_path, settings, resize, stored, shape):
    data, task = data_of(footage(side=24), resize=resize), new_task(**settings)
    trainer(tmp_path, max_steps=1).fit(task, data)
    assert data.sets["reference"].values.shape == (FRAMES, *stored)
    assert task.deployed().frame_shape == shape


# figures -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_the_figures_are_those_of_evaluate_on_the_map(tmp_path, precision):
    """Also of queries without a right place, or of which nothing is known."""
    rows = [f"{i},{i},{i // 2}" if i % 3 else f"{i}" for i in range(30)]
    truth = tmp_path / "truth.csv"
    truth.write_text("\n".join(rows) + "\n")
    running, task, noisy = trainer(tmp_path, precision=precision), new_task(), ArrayTraverse(footage(0.2))
    running.fit(task, data_of())
    (figures,) = running.test(task, data_of(query=noisy, truth=str(truth)), verbose=False)
    match = DejaVu.load(tmp_path / "map.safetensors").localize(noisy)
    known = find_ground_truth(str(truth), None, None, FRAMES, FRAMES)
    assert known is not None
    expected = evaluate(match, known, tolerance=2)._asdict()
    assert figures == pytest.approx({f"test/{name}": value for name, value in expected.items()}, abs=1e-6)


def test_the_rate_rises_over_a_tenth_and_falls_to_0(tmp_path):
    """And only what is multiplied decays."""
    task, seen = new_task(weight_decay=0.3), []

    def noted(optimizer):
        seen.append(optimizer.param_groups[0]["lr"] / task.lr)
        decays = {id(p): group["weight_decay"] for group in optimizer.param_groups for p in group["params"]}
        assert decays == {id(p): 0.3 if p.ndim > 1 else 0 for p in task.parameters()}

    task.on_before_optimizer_step = noted  # type: ignore[method-assign]
    trainer(tmp_path, max_steps=20, limit_val_batches=0).fit(task, data_of())
    assert seen == pytest.approx(heights(20))
