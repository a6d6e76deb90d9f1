"""Trainings that end in a map which is made of the descriptor, in closed form, and not trained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import refused
from small_training import (
    FRAMES,
    Stop,
    assert_same_scores,
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
from test_stages import STILL, coded
from torch import nn

from dejavu_torch import HOG, DejaVu, SpectralMapper, TemplateMap, Whitening
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.training.export import LastCheckpoint
from dejavu_torch.training.losses import Objective
from dejavu_torch.training.stages import CodeStage, DescriptorStage
from dejavu_torch.training.task import PlaceRecognitionTask, start_from

EVERY = {"val_check_interval": 2, "check_val_every_n_epoch": None}


def spectral(**settings: Any) -> PlaceRecognitionTask:
    return new_task(**{"backbone": coded(), "mapper": SpectralMapper(20.0)} | settings)


class Plain(SpectralMapper):
    """A mapper that takes descriptors as they are."""

    whitens = False


def levels(model: DejaVu) -> torch.Tensor:
    assert isinstance(model.map, SpectralMap)
    return model.map.level


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"backbone": backbone()},
        {"backbone": coded(hidden=0)},
        {"backbone": nn.Sequential(nn.Flatten(), nn.Linear(256, 8))},
        {"mapper": Plain(20.0)},
        {"mapper": SpectralMapper(10.0, transform="dct", metric="l2"), "whitening": Whitening(numbers=4)},
        {"batch_norm": "frozen", "freeze": ["network.convolutions"]},
    ],
    ids=["code", "CNN", "linear", "foreign", "no whitening", "l2", "frozen"],
)
def test_a_training_ends_in_a_map_that_finds_its_own_places(tmp_path: Path, settings: dict[str, Any]) -> None:
    task = spectral(**settings)
    trainer(tmp_path).fit(task, data_of())
    given = DejaVu.load if type(task.dejavu.mapper) is SpectralMapper else None
    features = task.dejavu.features if isinstance(task.dejavu.features, nn.Sequential) else None
    model = task.deployed() if given is None else given(tmp_path / "map.safetensors", features)
    assert isinstance(model.map, SpectralMap)
    assert_same_scores(task, model)
    assert recall(model, footage()) > 0.9
    assert model.trained is not None
    assert model.trained.steps == 4


def test_the_file_holds_the_network_alone(tmp_path: Path) -> None:
    task = spectral(weight_bits=32)
    model = fit(tmp_path, task, data_of())
    assert isinstance(model.features, Embedding)
    network = model.features.network.state_dict()
    assert model.summary().fixed["backbone"] == sum(tensor.nbytes for tensor in network.values())
    assert all(name.startswith("network.") for name in model.features.state_dict())
    assert model.map.dimension == 8  # of the network, not the 12 of the code
    assert model.whitening is not None
    assert model.whitening.learned


def test_the_map_is_of_the_last_features_not_of_those_validated_before(tmp_path: Path) -> None:
    model = fit(tmp_path, spectral(), data_of(), max_steps=3, **EVERY)
    features = model.extract_all(ArrayTraverse(footage()))
    assert torch.equal(levels(model), SpectralMapper(20.0)(features).level)


def test_making_a_map_changes_nothing_and_gives_the_same_again(tmp_path: Path) -> None:
    task = spectral()
    trainer(tmp_path).fit(task, data_of())
    task.train()
    first, state = levels(task.deployed()), torch.get_rng_state()
    weights = {name: value.clone() for name, value in task.dejavu.features.state_dict().items()}
    task.relearn()
    assert torch.equal(levels(task.deployed()), first)
    assert torch.equal(torch.get_rng_state(), state)
    assert task.dejavu.features.training
    assert all(torch.equal(weights[n], value) for n, value in task.dejavu.features.state_dict().items())


# checkpoints ---------------------------------------------------------------------------------------------


def part(folder: Path, steps: int = 4, of: int = 8) -> Path:
    """A checkpoint after some steps, behind a validation."""
    keep = Stop(steps, folder / "part.ckpt")
    trainer(folder, keep, max_steps=of, **EVERY).fit(spectral(), data_of())
    return folder / "part.ckpt"


def test_a_checkpoint_holds_no_map_and_validating_it_makes_one(tmp_path: Path) -> None:
    path = part(tmp_path)
    state = torch.load(path, weights_only=True)["state_dict"]
    assert not [
        n for n, t in state.items() if "dejavu.map" in n and isinstance(t, torch.Tensor) and t.numel()
    ]
    task, running = spectral(mapper=SpectralMapper(6.0)), trainer(tmp_path)  # this run's budget
    noisy = data_of(validation=ArrayTraverse(footage(0.05)), validation_truth="0")
    (figures,) = running.validate(task, noisy, ckpt_path=path, verbose=False, weights_only=True)
    assert figures["val/recall_at_1"] > 0.5
    route = task.deployed()
    assert route.trained is not None
    assert route.trained.steps == 4
    assert 5.8 < route.summary().route_bytes / FRAMES <= 6


@pytest.mark.parametrize(
    ("settings", "frames", "words"),
    [
        ({"mapper": mapper()}, FRAMES, ("of ['DescriptorStage']", "'CodeStage'")),
        ({}, 30, ("20 stretches of 2 frames", "the array has 15", "the route that it was learned on")),
        ({"freeze": ["network.linear"]}, FRAMES, ("network.linear.bias", "not in both")),
    ],
    ids=str,
)
def test_a_checkpoint_of_another_training_is_refused(
    tmp_path: Path, settings: dict[str, Any], frames: int, words: tuple[str, ...]
) -> None:
    path, data = part(tmp_path), data_of(footage(frames=frames))
    with refused(*words):
        trainer(tmp_path / "on", max_steps=8).fit(
            spectral(**settings), data, ckpt_path=path, weights_only=True
        )


# views, and where to start -------------------------------------------------------------------------------


def still() -> Augmentation:
    return Augmentation(**STILL)  # type: ignore[arg-type]


@pytest.mark.parametrize("augmentation", [None, still()], ids=["augmented", "second alone"])
def test_a_second_traverse_tells_what_a_visit_changes(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, augmentation: Augmentation | None
) -> None:
    """Of a checkpoint as in the training: what is tested is the map of the file."""
    winter = ArrayTraverse((footage().float() * torch.linspace(0.2, 1, 16)).byte())
    given = {"augmentation": augmentation, "second": winter, "second_truth": "0"}
    last, noisy = tmp_path / "checkpoints" / "last.ckpt", ArrayTraverse(footage(0.2))
    trainer(tmp_path, LastCheckpoint()).fit(spectral(), data_of(**given))
    assert warned(caplog) == []
    model = DejaVu.load(tmp_path / "map.safetensors")
    expected = evaluate(model.localize(noisy), torch.arange(FRAMES)[:, None], tolerance=2)._asdict()
    for stage, name, truth, prefix in (
        ("test", "query", "truth", "test/"),
        ("validate", "validation", "validation_truth", "val/"),
    ):
        data = data_of(**given, **{name: noisy, truth: "0"})
        task, running = spectral(), trainer(tmp_path)
        (figures,) = getattr(running, stage)(task, data, ckpt_path=last, verbose=False, weights_only=True)
        assert torch.equal(levels(task.dejavu), levels(model))
        named = {f"{prefix}{name}": value for name, value in expected.items()}
        assert figures == pytest.approx(named, abs=1e-6)


def test_whitening_needs_something_that_changes_or_none_of_it(tmp_path: Path) -> None:
    running = trainer(tmp_path / "whitened")
    with refused("data.augmentation", "data.second", "model.whitening none"):
        running.fit(spectral(), data_of(augmentation=still()))
    assert running.global_step == 0
    model = fit(tmp_path / "plain", spectral(whitening="none"), data_of(augmentation=still()))
    assert model.whitening is None
    assert recall(model, footage()) > 0.9


def test_a_map_of_either_kind_gives_its_network_to_start_from(tmp_path: Path) -> None:
    given: dict[str, Any] = {"weight_bits": 32}
    maps = {"code": new_task(backbone=coded(), descriptor=0.5, **given), "own": spectral(**given)}
    for name, task in maps.items():
        fit(tmp_path / name, task, data_of(), max_steps=4)
        kept = task.dejavu.features.network.state_dict()  # type: ignore[union-attr,operator]
        for start in (coded(), coded().without_code()):
            fresh = {n: t.clone() for n, t in start.state_dict().items()}
            start_from(start, tmp_path / name / "map.safetensors")
            assert all(torch.equal(kept[n], t) for n, t in start.network.state_dict().items())
            if name == "own":  # no code comes with it
                assert all(
                    torch.equal(fresh[n], t) for n, t in start.state_dict().items() if "network." not in n
                )
    path = str(tmp_path / "own" / "map.safetensors")
    again = new_task(backbone=coded(), start=path)
    assert [type(stage) for stage in again.stages] == [DescriptorStage, CodeStage]
    assert isinstance(fit(tmp_path / "again", again, data_of()).map, TemplateMap)
    with refused("holds weights of", "expected those of the same Embedding"):
        spectral(backbone=coded(network=backbone(9)), start=path)
    fit(tmp_path / "small", spectral(backbone=backbone()), data_of())
    with refused("holds weights of", "expected those of the same Embedding"):
        spectral(start=str(tmp_path / "small" / "map.safetensors"))


# refusals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"feature_weights": True}, ("feature_weights", "SpectralMapper")),
        ({"descriptor": 0.5}, ("descriptor", "SpectralMapper")),
        ({"refresh": 2}, ("refresh", "SpectralMapper")),
        ({"losses": Objective()}, ("losses", "SpectralMapper")),
        ({"mapper": mapper(), "whitening": Whitening()}, ("whitening", "TemplateMapper")),
        ({"whitening": Whitening(strengths={"noise": 0.1})}, ("whitening.strengths", "data.augmentation")),
        ({"freeze": ["linear"]}, ("'linear'", "expected one of network")),  # the code is gone
    ],
    ids=str,
)
def test_settings_that_do_nothing_are_refused(settings: dict[str, Any], words: tuple[str, ...]) -> None:
    with refused(*words):
        spectral(**settings)


@pytest.mark.parametrize(
    ("settings", "frames", "words"),
    [
        ({"backbone": HOG()}, None, ("can be trained", "dejavu learn")),
        ({"backbone": coded(network=HOG())}, None, ("can be trained", "dejavu learn")),
        ({"freeze": [""]}, None, ("can be trained", "dejavu learn")),
        ({}, torch.eye(FRAMES), ("ready features", "SpectralMapper is not trained", "dejavu learn")),
        ({"mapper": SpectralMapper(0.1)}, None, ("route_bytes_per_place is 0.1",)),
    ],
    ids=["HOG", "code of HOG", "frozen", "features", "budget"],
)
def test_what_cannot_be_trained_is_told_ahead(
    tmp_path: Path, settings: dict[str, Any], frames: torch.Tensor | None, words: tuple[str, ...]
) -> None:
    running = trainer(tmp_path, num_sanity_val_steps=0)
    with refused(*words):
        running.fit(spectral(**settings), data_of(frames))
    assert running.global_step == 0
