"""Trained maps whose backbone lies in 8 bits: the map is of the rounded network, the training is not."""

from __future__ import annotations

import pytest
import torch
from helpers import refused
from pytorch_lightning import Callback
from small_training import assert_same_scores, backbone, data_of, footage, mapper, trainer

from dejavu_torch import DejaVu, SpectralMapper
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.maps.file import read_map, write_map
from dejavu_torch.maps.weights import is_rounded
from dejavu_torch.training.descriptors import DescriptorTask
from dejavu_torch.training.task import start_from
from dejavu_torch.training.templates import TemplateTask


class Watch(Callback):
    """The backbone's weights after every step."""

    def __init__(self) -> None:
        self.weights = []

    def on_train_batch_end(self, trainer, pl_module, *_):
        assert not is_rounded(pl_module.dejavu.features)
        self.weights.append(pl_module.dejavu.features.linear.weight.detach().clone())


def trained(folder, **settings):
    torch.manual_seed(0)
    kind = DescriptorTask if settings.get("mapper") else TemplateTask
    task, watch = kind(**{"backbone": backbone(), "mapper": mapper()} | settings), Watch()
    task.dejavu.features.load_state_dict(backbone().state_dict())
    trainer(folder, watch, max_steps=6, val_check_interval=1).fit(task, data_of())
    return task, watch.weights, DejaVu.load(folder / "map.safetensors")


@pytest.mark.parametrize("settings", [{}, {"mapper": SpectralMapper(20.0)}], ids=["templates", "spectral"])
def test_the_map_is_of_the_rounded_network_and_the_training_is_not(tmp_path, settings):
    task, narrow, model = trained(tmp_path / "8", **settings)
    assert model.weight_bits == 8
    assert is_rounded(model.features)
    assert_same_scores(task, model)
    frames = footage(0.1)[:, None] / 255
    with torch.no_grad():
        assert torch.equal(task.deployed()(frames), model(frames))
    assert not is_rounded(task.dejavu.features)
    if settings:
        made = SpectralMapper(20.0)(model.descriptor.all_of(ArrayTraverse(footage())))
        assert torch.equal(made.streams, model.map.streams)  # type: ignore[arg-type]
    _, wide, large = trained(tmp_path / "32", weight_bits=32, **settings)
    assert torch.equal(torch.stack(narrow), torch.stack(wide))
    assert torch.equal(large.features.linear.weight, wide[-1])  # type: ignore[union-attr,arg-type]
    assert model.summary().fixed["backbone"] < 0.4 * large.summary().fixed["backbone"]


def test_a_training_starts_from_8_bits_and_refuses_damaged_ones(tmp_path):
    _, _, model = trained(tmp_path)
    start_from(again := backbone(), path := tmp_path / "map.safetensors")
    own = model.features.state_dict()
    assert all(torch.equal(tensor, own[name]) for name, tensor in again.state_dict().items())
    tensors, header = read_map(path)
    without = {name: tensor for name, tensor in tensors.items() if not name.endswith(".scale")}
    write_map(path, without, header)
    with refused(str(path), "is int8", "expected a float type"):
        start_from(again, path)
