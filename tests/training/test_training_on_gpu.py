"""A training on a GPU is that on the CPU but for rounding."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
import torch
from devices import DEVICE, pretend
from pytorch_lightning import Callback
from pytorch_lightning.accelerators import CPUAccelerator
from pytorch_lightning.strategies import SingleDeviceStrategy
from small_training import backbone, coded, data_of, footage, mapper, still, trainer

from dejavu_torch import DejaVu, SpectralMapper
from dejavu_torch.training.descriptors import DescriptorTask
from dejavu_torch.training.templates import TemplateTask

CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
GPU = pytest.param("cuda", marks=[pytest.mark.gpu, CUDA])


CASES = {
    "templates": lambda: TemplateTask(backbone(), mapper(), lr=1e-2, freeze=["linear.bias"]),
    "rate": lambda: DescriptorTask(backbone(), SpectralMapper(8.0), rate=0.3, lr=1e-2),
    "code": lambda: TemplateTask(coded(noise=0.3), mapper(), lr=1e-2),
}


class Steps(Callback):
    """What each step logs."""

    def __init__(self) -> None:
        self.figures = []

    def on_train_batch_end(self, trainer, *_):
        self.figures.append({name: float(value) for name, value in trainer.callback_metrics.items()})


class Accelerator(CPUAccelerator):
    """Of the pretended device."""

    def setup_device(self, device):
        pass


def trained(case, device, folder):
    """What the steps log, and the map that is written."""
    torch.manual_seed(0)
    task = CASES[case]()
    steps, where = Steps(), {"accelerator": device}
    if device == DEVICE.type:
        where = {"accelerator": "auto", "strategy": SingleDeviceStrategy(DEVICE, Accelerator())}
    running = trainer(folder, steps, max_steps=6, devices=1, **where)
    torch.manual_seed(1)
    with pretend() if device == DEVICE.type else nullcontext():
        running.fit(task, data_of(second=footage(0.1), second_truth="0", augmentation=still()))
    return steps.figures, DejaVu.load(folder / "map.safetensors", task.dejavu.features)


@pytest.mark.parametrize("device", [DEVICE.type, GPU])
@pytest.mark.parametrize("case", CASES)
def test_losses_are_those_of_the_cpu(case, device, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    steps, _ = trained(case, "cpu", tmp_path / "here")
    found, model = trained(case, device, tmp_path / "there")
    assert len(steps) == len(found)
    near = 1e-4 if case == "rate" else 1e-3  # means of phases and whitening amplify what rounds features
    for step, other in zip(steps, found, strict=True):
        losses = {name: value for name, value in step.items() if name.startswith("train/")}
        assert {name: other[name] for name in losses} == pytest.approx(losses, rel=near, abs=near)
    assert model.map.places == 40
