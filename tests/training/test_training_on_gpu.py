"""A training on a GPU is that on the CPU but for rounding; what the augmentation draws is the GPU's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from small_training import backbone, data_of, footage, still, trainer
from test_several_processes import CASES, Steps, residues

from dejavu_torch import DejaVu
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.training.task import PlaceRecognitionTask

CUDA = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
GPU = pytest.param("cuda", marks=[pytest.mark.gpu, CUDA])


def trained(case: str, device: str, folder: Path, **settings: Any) -> tuple[list[dict[str, float]], DejaVu]:
    """What the steps log, and the map that is written."""
    torch.manual_seed(0)
    task = PlaceRecognitionTask(residues() if case == "stages" else backbone(), **CASES[case], lr=1e-2)
    steps = Steps()
    running = trainer(folder, steps, max_steps=6, accelerator=device, devices=1)
    torch.manual_seed(1)
    running.fit(task, data_of(**{"second": footage(0.1), "augmentation": still()} | settings))
    return steps.figures, DejaVu.load(folder / "map.safetensors", task.dejavu.features)


@pytest.mark.parametrize("device", ["cpu", GPU])
@pytest.mark.parametrize("case", ["templates", "rate", "stages"])
def test_losses_are_those_of_the_cpu(
    case: str, device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    steps, _ = trained(case, "cpu", tmp_path / "here")
    found, model = trained(case, device, tmp_path / "there")
    assert len(steps) == len(found)
    for step, other in zip(steps, found, strict=True):
        losses = {name: value for name, value in step.items() if name.startswith("train/")}
        assert {name: other[name] for name in losses} == pytest.approx(losses, rel=1e-4, abs=1e-4)
    assert model.map.places == 40


@pytest.mark.gpu
@CUDA
def test_a_map_trained_on_a_gpu_scores_alike_on_both(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    given = {"validation": footage(0.05), "validation_truth": "0"}
    _, model = trained("augmented", "cuda", tmp_path, augmentation=Augmentation(), **given)
    query = ArrayTraverse(footage(0.1))
    here = model.localize(query)
    there = model.to("cuda").localize(query)
    torch.testing.assert_close(there.score, here.score, rtol=1e-4, atol=1e-4)
