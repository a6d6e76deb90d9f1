"""Backbones that are frozen, foreign, without parameters, or wrong."""

from __future__ import annotations

import pytest
import torch
from helpers import refused
from small_training import (
    FRAMES,
    backbone,
    data_of,
    fit,
    footage,
    new_task,
    recall,
    trainer,
    warned,
)
from torch import nn

from dejavu_torch import HOG, DejaVu
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.training.task import freeze_parts

RUNNING = ("running_mean", "running_var", "num_batches_tracked")


def changed(tmp_path, module, **settings):
    """The names in the backbone's state that a training changes."""
    before = {name: value.clone() for name, value in module.state_dict().items()}
    task = new_task(backbone=module, **settings)
    trainer(tmp_path).fit(task, data_of())
    after = module.state_dict()
    return {name for name, value in before.items() if not torch.equal(value, after[name])}, task


def trained(task):
    return {name for name, parameter in task.named_parameters() if parameter.requires_grad}


def normed():
    norm = nn.InstanceNorm2d(2, affine=True, track_running_stats=True)
    return nn.Sequential(nn.Conv2d(1, 2, 5, stride=4), norm, nn.Flatten(), nn.Linear(18, 4))


def test_frozen_in_part_only_that_part_stays(tmp_path):
    """With its running statistics, also those of instances."""
    names, _ = changed(tmp_path, module := backbone(), freeze=["convolutions.1"])
    # the bias before a standardisation is taken out again
    kept = {name for name in module.state_dict() if name.startswith("convolutions.1.")} | {"linear.bias"}
    assert names | {"linear.bias"} == set(module.state_dict()) - kept | {"linear.bias"}
    names, _ = changed(tmp_path, normed(), freeze=["1"])
    assert names == {"0.weight", "0.bias", "3.weight", "3.bias"}
    names, _ = changed(tmp_path, normed())
    assert {"1.running_mean", "1.running_var"} < names


def test_frozen_batch_norm_keeps_its_statistics_and_learns_its_weights(tmp_path):
    names, task = changed(tmp_path, module := backbone(), batch_norm="frozen")
    statistics = {name for name in module.state_dict() if name.endswith(RUNNING)}
    assert statistics
    assert names == set(module.state_dict()) - statistics
    task.train()
    assert {type(part) for part in module.modules() if not part.training} == {nn.BatchNorm1d, nn.BatchNorm2d}
    assert module.training


def test_a_prefix_of_nothing_is_refused():
    with refused("'nix'", "SmallCNN", "convolutions, linear"):
        new_task(freeze=["linear", "nix"])
    with refused("''", "HOG", "it has none"):
        freeze_parts(HOG(), [""], "train")


def test_hog_has_nothing_to_train_but_the_map_is(tmp_path):
    task = new_task(backbone=HOG(cell=4, block=1))
    model = fit(tmp_path, task, data_of())
    assert trained(task) == {"log_temperature", "dejavu.map.templates"}
    assert recall(model, footage(0.02)) > 0.5


def test_ready_features_leave_a_backbone_out(tmp_path, caplog):
    features, task = torch.randn(FRAMES, 6), new_task()
    running = trainer(tmp_path)
    running.fit(task, data_of(features))
    model = DejaVu.load(tmp_path / "map.safetensors")  # by itself
    running.validate(task, data_of(features), verbose=False)
    assert warned(caplog) == ["the source holds ready features: the backbone is not used"]
    assert "backbone" not in model.summary().fixed
    assert model.summary().map_bytes < sum(p.nbytes for p in backbone().parameters())
    torch.testing.assert_close(model(features[:3]), task(features[:3]))


class Wrong(nn.Module):
    """Features that are not what they should be."""

    def __init__(self, what: str) -> None:
        super().__init__()
        self.linear = nn.Linear(256, 8)
        self.what, self.calls = what, 0

    def forward(self, frames):
        features = self.linear(frames.flatten(1))
        self.calls += self.training
        late = {1: float("nan")}.get(self.calls // 4, 1.0)
        return {"3d": features[..., None], "half": features[::2], "nan": features / 0 * 0}.get(
            self.what, features * late
        )


@pytest.mark.parametrize(
    ("module", "facts"),
    [
        (Wrong("3d"), ("Wrong made (40, 8, 1)", "expected features (40, D)")),
        (Wrong("half"), ("Wrong made (20, 8)", "expected features (40, D)")),
        (Wrong("nan"), ("Wrong gives NaN", "the array")),
        (Wrong("late"), ("the loss is nan at step 2", "place nan", "expected a finite number")),
        (SmallCNN(8, 3, (16, 16), (4,)), ("got (40, 1, 16, 16)",)),
        (
            nn.Sequential(nn.Conv2d(3, 2, 3), nn.Flatten()),
            ("Sequential does not accept frames (1, 16, 16)", "3 channels"),
        ),
    ],
    ids=["3d", "half", "nan", "late", "CNN's channels", "channels"],
)
def test_wrong_features_and_channels_are_told_at_once(tmp_path, module, facts):
    with refused(*facts):
        fit(tmp_path, new_task(backbone=module), data_of(), max_steps=9)
