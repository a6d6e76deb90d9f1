"""Trainings that end in a map which is made of the descriptor, in closed form, and not trained."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from helpers import refused
from pytorch_lightning.callbacks import ModelCheckpoint
from small_training import (
    FRAMES,
    assert_same_scores,
    backbone,
    coded,
    data_of,
    fit,
    footage,
    mapper,
    new_descriptor,
    new_task,
    recall,
    still,
    trainer,
    warned,
)
from torch import nn

from dejavu_torch import HOG, DejaVu, SpectralMapper, TemplateMap, Whitening
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.training.task import start_from

spectral = new_descriptor


class Plain(SpectralMapper):
    """A mapper that takes descriptors as they are."""

    whitens = False


def levels(model):
    assert isinstance(model.map, SpectralMap)
    return model.map.level


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"backbone": nn.Sequential(nn.Flatten(), nn.Linear(256, 8))},
        {"mapper": Plain(20.0)},
        {"mapper": SpectralMapper(10.0, transform="dct", metric="l2"), "whitening": Whitening(numbers=4)},
        {"batch_norm": "frozen", "freeze": ["network.convolutions"]},
    ],
    ids=["code", "foreign", "no whitening", "l2", "frozen"],
)
def test_a_training_ends_in_a_map_that_finds_its_own_places(tmp_path, settings):
    task = spectral(**settings)
    trainer(tmp_path).fit(task, data_of())
    named = type(task.dejavu.mapper) is SpectralMapper  # a map file names no other
    features = task.features if isinstance(task.features, nn.Sequential) else None
    model = DejaVu.load(tmp_path / "map.safetensors", features) if named else task.deployed()
    assert isinstance(model.map, SpectralMap)
    assert_same_scores(task, model)
    assert recall(model, footage()) > 0.9
    assert model.trained is not None
    assert model.trained.steps == 4


def ordinary():
    """Convolutions, batch norm and ReLU, then a linear layer: features of any scale."""
    layers = []
    for before, after, stride in ((1, 8, 2), (8, 16, 2), (16, 16, 2), (16, 16, 1)):
        layers += [nn.Conv2d(before, after, 3, stride, 1), nn.BatchNorm2d(after), nn.ReLU()]
    return nn.Sequential(*layers, nn.Flatten(), nn.Linear(64, 32))


def test_an_ordinary_network_learns(tmp_path):
    torch.manual_seed(0)
    task = spectral(backbone=ordinary(), mapper=SpectralMapper(8.0), rate=0.3)
    trainer(tmp_path, max_steps=200, limit_val_batches=0).fit(task, data_of(tolerance=5))
    torch.manual_seed(0)
    untrained = DejaVu(ordinary(), "none", mapper=SpectralMapper(8.0)).learn(ArrayTraverse(footage()))
    assert recall(task.deployed(), footage(0.3)) > recall(untrained, footage(0.3)) + 0.05


def test_the_file_holds_the_network_alone(tmp_path):
    model = fit(tmp_path, spectral(weight_bits=32), data_of())
    assert isinstance(model.features, Embedding)
    network = model.features.network.state_dict()
    assert model.summary().fixed["backbone"] == sum(tensor.nbytes for tensor in network.values())
    assert all(name.startswith("network.") for name in model.features.state_dict())
    assert model.map.dimension == 8  # of the network, not the 12 of the code
    assert model.whitening is not None
    assert model.whitening.learned


def test_the_map_is_of_the_last_features_not_of_those_validated_before(tmp_path):
    every = {"val_check_interval": 2, "check_val_every_n_epoch": None}
    model = fit(tmp_path, spectral(), data_of(), max_steps=3, **every)
    features = model.descriptor.all_of(ArrayTraverse(footage()))
    assert torch.equal(levels(model), SpectralMapper(20.0)(features).level)


@pytest.mark.parametrize("alone", [False, True], ids=["augmented", "second alone"])
def test_a_second_traverse_tells_what_a_visit_changes(tmp_path, caplog, alone):
    """Of a checkpoint as in the training: what is tested is the map of the file."""
    winter = ArrayTraverse((footage().float() * torch.linspace(0.2, 1, 16)).byte())
    given = {"augmentation": still() if alone else None, "second": winter, "second_truth": "0"}
    last, noisy = tmp_path / "checkpoints" / "last.ckpt", ArrayTraverse(footage(0.2))
    kept = ModelCheckpoint(tmp_path / "checkpoints", save_last=True, save_top_k=0)
    trainer(tmp_path, kept).fit(spectral(), data_of(**given))
    assert warned(caplog) == []
    model = DejaVu.load(tmp_path / "map.safetensors")
    found = replace(model.localize(noisy), confidence=None)  # a training orders answers by their scores
    expected = evaluate(found, torch.arange(FRAMES)[:, None], tolerance=2)._asdict()
    task, data = spectral(), data_of(**given, query=noisy, truth="0")
    (figures,) = trainer(tmp_path).test(task, data, ckpt_path=last, verbose=False)
    assert torch.equal(levels(task.dejavu), levels(model))
    assert figures == pytest.approx({f"test/{name}": one for name, one in expected.items()}, abs=1e-6)


def test_without_anything_that_changes_nothing_is_whitened(tmp_path):
    running = trainer(tmp_path / "whitened")
    with refused("data.augmentation", "data.second", "model.whitening none"):
        running.fit(spectral(), data_of(augmentation=still()))
    assert running.global_step == 0
    model = fit(tmp_path / "plain", spectral(whitening="none"), data_of(augmentation=still()))
    assert model.whitening is None
    assert recall(model, footage()) > 0.9


def test_a_map_gives_its_network_to_start_from(tmp_path):
    task = spectral(weight_bits=32)
    fit(tmp_path, task, data_of(), max_steps=4)
    kept = task.features.network.state_dict()  # type: ignore[union-attr,operator]
    path = tmp_path / "map.safetensors"
    for start in (coded(), coded().without_code()):
        fresh = {n: t.clone() for n, t in start.state_dict().items()}
        start_from(start, path)
        assert all(torch.equal(kept[n], t) for n, t in start.network.state_dict().items())
        assert all(torch.equal(fresh[n], t) for n, t in start.state_dict().items() if "network." not in n)
    again = new_task(backbone=coded(), start=str(path))
    model = fit(tmp_path / "again", again, data_of())
    assert isinstance(model.map, TemplateMap)
    after = model.features.network.state_dict()  # type: ignore[union-attr,operator]
    assert all(
        torch.allclose(kept[n], t, atol=0.02) for n, t in after.items()
    )  # rounded to 8 bits, not trained
    for other in (coded(network=backbone(9)), backbone()):
        with refused("holds weights of", f"expected those of the same {type(other).__name__}"):
            spectral(backbone=other, start=str(path))


# refusals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "facts"),
    [
        ({"lr": 0.0}, ("lr is 0.0", "above 0")),
        ({"rate": math.nan}, ("rate is nan", "0 or more")),
        ({"weight_bits": 4}, ("weight_bits is 4", "8, 32")),
        ({"mapper": nn.Identity()}, ("mapper is a Identity", "expected a Mapper")),
        ({"mapper": mapper()}, ("mapper is a TemplateMapper", "TemplateTask")),
        ({"whitening": Whitening(strengths={"noise": 0.1})}, ("whitening.strengths", "data.augmentation")),
        ({"freeze": ["linear"]}, ("'linear'", "expected one of network")),  # the code is gone
    ],
    ids=str,
)
def test_settings_that_do_not_fit_are_refused(settings, facts):
    with refused(*facts):
        spectral(**settings)


@pytest.mark.parametrize(
    ("settings", "frames", "facts"),
    [
        ({"backbone": coded(network=HOG())}, None, ("nothing to train", "dejavu learn")),
        ({"freeze": [""]}, None, ("nothing to train", "dejavu learn")),
        ({}, torch.eye(FRAMES), ("ready features", "dejavu learn")),
        ({"mapper": SpectralMapper(0.1)}, None, ("route_bytes_per_place is 0.1",)),
    ],
    ids=["HOG", "frozen", "features", "budget"],
)
def test_what_cannot_be_trained_is_told_before(tmp_path, settings, frames, facts):
    running = trainer(tmp_path, num_sanity_val_steps=0)
    with refused(*facts):
        running.fit(spectral(**settings), data_of(frames))
    assert running.global_step == 0
