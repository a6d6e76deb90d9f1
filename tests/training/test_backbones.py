"""Backbones that are frozen, foreign, without parameters, or wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import refused
from kornia.feature import TFeat
from small_training import FRAMES, backbone, data_of, fit, footage, new_task, recall, trainer, warned
from torch import Tensor, nn

from dejavu_torch import HOG, DejaVu
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.training.task import PlaceRecognitionTask, freeze_parts, start_from

RUNNING = ("running_mean", "running_var", "num_batches_tracked")


def changed(tmp_path: Path, module: nn.Module, **settings: Any) -> tuple[set[str], PlaceRecognitionTask]:
    """The names in the backbone's state that a training changes."""
    before = {name: value.clone() for name, value in module.state_dict().items()}
    task = new_task(backbone=module, **settings)
    trainer(tmp_path).fit(task, data_of())
    after = module.state_dict()
    return {name for name, value in before.items() if not torch.equal(value, after[name])}, task


def test_frozen_wholly_it_stays_as_it_was(tmp_path: Path) -> None:
    start = fit(tmp_path, new_task(backbone=(module := backbone()), freeze=[""], lr=1e-12), data_of())
    names, task = changed(tmp_path, module, freeze=[""])
    assert names == set()
    assert not torch.allclose(task.dejavu.map.templates, start.map.templates, atol=1e-3)
    trained = {name for name, parameter in task.named_parameters() if parameter.requires_grad}
    assert trained == {"log_temperature", "dejavu.map.templates"}


@pytest.mark.parametrize("prefix", ["convolutions.1", "convolutions.1."])
def test_frozen_in_part_only_that_part_stays(tmp_path: Path, prefix: str) -> None:
    module = backbone()
    names, _ = changed(tmp_path, module, freeze=[prefix])
    # the bias ahead of a standardisation is taken out again
    kept = {name for name in module.state_dict() if name.startswith("convolutions.1.")} | {"linear.bias"}
    assert names | {"linear.bias"} == set(module.state_dict()) - kept | {"linear.bias"}


def test_frozen_batch_norm_keeps_its_statistics_and_learns_its_weights(tmp_path: Path) -> None:
    module = backbone()
    names, task = changed(tmp_path, module, batch_norm="frozen")
    statistics = {name for name in module.state_dict() if name.endswith(RUNNING)}
    assert statistics
    assert names == set(module.state_dict()) - statistics
    task.train()
    assert {type(part) for part in module.modules() if not part.training} == {nn.BatchNorm1d, nn.BatchNorm2d}
    assert module.training


def test_statistics_of_instances_stay_in_a_frozen_part(tmp_path: Path) -> None:
    def module() -> nn.Module:
        norm = nn.InstanceNorm2d(2, affine=True, track_running_stats=True)
        return nn.Sequential(nn.Conv2d(1, 2, 5, stride=4), norm, nn.Flatten(), nn.Linear(18, 4))

    names, _ = changed(tmp_path, module(), freeze=["1"])
    assert names == {"0.weight", "0.bias", "3.weight", "3.bias"}
    names, _ = changed(tmp_path, module())
    assert {"1.running_mean", "1.running_var"} < names


def test_a_prefix_of_nothing_is_refused() -> None:
    with refused("'nix'", "SmallCNN", "convolutions, linear"):
        new_task(freeze=["linear", "nix"])
    with refused("''", "HOG", "it has none"):
        freeze_parts(HOG(), [""], "train")


def test_a_map_gives_a_backbone_to_start_from(tmp_path: Path) -> None:
    first, path = new_task(weight_bits=32), tmp_path / "map.safetensors"
    fit(tmp_path, first, data_of())
    start_from(module := backbone(), path)
    trained = first.dejavu.features.state_dict()
    assert all(torch.equal(value, trained[name]) for name, value in module.state_dict().items())
    with refused("map.safetensors holds weights of", "SmallCNN", "expected those of the same"):
        start_from(backbone(9), path)
    with refused("gone is not there"):
        start_from(module, tmp_path / "gone")


class Foreign(nn.Module):
    """What a user brings."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(256, 8)
        self.norm = nn.BatchNorm1d(8, affine=False)

    def forward(self, frames: Tensor) -> Tensor:
        features: Tensor = self.norm(self.linear(frames.flatten(1)))
        return features


@pytest.mark.parametrize("kind", ["foreign", "kornia"])
def test_a_foreign_network_learns(tmp_path: Path, kind: str) -> None:
    def module() -> nn.Module:
        torch.manual_seed(0)
        return (
            Foreign()
            if kind == "foreign"
            else Embedding(TFeat(pretrained=False), 8, channels=1, resize=(32, 32))
        )

    noisy = footage(0.1)
    light = Augmentation(rotation=0, shift=(0, 0), scale=0, blur=0, occlusion=0, noise=0.2)
    found = []
    for lr, steps in ((1e-9, 1), (3e-3, 60)):
        task = new_task(backbone=module(), lr=lr)
        trainer(tmp_path, max_steps=steps).fit(task, data_of(augmentation=light))
        model = DejaVu.load(tmp_path / "map.safetensors", module())  # its weights are the map's
        torch.testing.assert_close(model.eval()(noisy[:4, None] / 255), task.eval()(noisy[:4, None] / 255))
        found.append(recall(model, noisy))
    assert found[1] > max(0.4, found[0] + 0.15), found
    with refused("only the caller can load", "`features`"):
        DejaVu.load(tmp_path / "map.safetensors")


def test_hog_has_nothing_to_train_but_the_map_is(tmp_path: Path) -> None:
    task = new_task(backbone=HOG(cell=4, block=1), feature_weights=True)
    model = fit(tmp_path, task, data_of())
    trained = {name for name, parameter in task.named_parameters() if parameter.requires_grad}
    assert trained == {"log_temperature", "dejavu.map.templates", "dejavu.map.weights"}
    assert len(model.map.weights) == model.map.dimension
    assert not (model.map.weights == 1).all()
    assert recall(model, footage(0.02)) > 0.5


def test_ready_features_leave_a_backbone_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    features, task = torch.randn(FRAMES, 6), new_task()
    running = trainer(tmp_path)
    running.fit(task, data_of(features))
    model = DejaVu.load(tmp_path / "map.safetensors")  # by itself
    assert warned(caplog) == ["these are ready features: the backbone is left out"]
    assert "backbone" not in model.summary().fixed
    assert model.summary().map_bytes < sum(p.nbytes for p in backbone().parameters())
    torch.testing.assert_close(model(features[:3]), task(features[:3]))
    running.validate(task, data_of(features), verbose=False)
    assert len(warned(caplog)) == 1


@pytest.mark.parametrize("channels", [1, 3])
def test_a_backbone_for_other_channels_is_told_at_once(tmp_path: Path, channels: int) -> None:
    frames = footage()[:, None].expand(-1, channels, -1, -1)
    for module, words in (
        (SmallCNN(8, 4 - channels, (16, 16), (4,)), (f"got frames (40, {channels}, 16, 16)",)),
        (
            nn.Sequential(nn.Conv2d(4 - channels, 2, 3), nn.Flatten()),
            (f"Sequential does not take frames ({channels}, 16, 16)", f"{4 - channels} channels"),
        ),
    ):
        with refused(*words):
            fit(tmp_path, new_task(backbone=module), data_of(frames.float() / 255))


class Wrong(nn.Module):
    """Features that are not what they should be."""

    def __init__(self, what: str) -> None:
        super().__init__()
        self.linear = nn.Linear(256, 8)
        self.what, self.calls = what, 0

    def forward(self, frames: Tensor) -> Tensor:
        features: Tensor = self.linear(frames.flatten(1))
        self.calls += self.training
        late = {1: float("nan")}.get(self.calls // 4, 1.0)
        return {"3d": features[..., None], "half": features[::2], "nan": features / 0 * 0}.get(
            self.what, features * late
        )


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("3d", ("Wrong made (40, 8, 1)", "expected features (40, D)")),
        ("half", ("Wrong made (20, 8)", "expected features (40, D)")),
        ("nan", ("Wrong makes NaN", "the array")),
        ("late", ("the loss is nan at step 2", "place nan", "expected a finite number")),
    ],
)
def test_wrong_features_are_told_at_once(tmp_path: Path, what: str, words: tuple[str, ...]) -> None:
    with refused(*words):
        fit(tmp_path, new_task(backbone=Wrong(what)), data_of(), max_steps=9)
