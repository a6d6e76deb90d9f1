"""How far a training is, on a terminal and elsewhere."""

from __future__ import annotations

import io
import re
import sys
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from dejavu_torch.training import export
from dejavu_torch.training.export import StepBar


def shown(monkeypatch: pytest.MonkeyPatch, terminal: bool, total: int, began: int, batch: float = 0.5) -> str:
    """What a training writes whose every second batch ends a step, and takes so many seconds."""
    clock, stream = iter(range(10**6)), io.StringIO()
    stream.isatty = lambda: terminal  # type: ignore[method-assign]
    monkeypatch.setattr(export, "time", SimpleNamespace(monotonic=lambda: batch * next(clock)))
    monkeypatch.setattr(sys, "stderr", stream)
    loss = {"train/loss": torch.tensor(2.5)}
    trainer: Any = SimpleNamespace(estimated_stepping_batches=total, global_step=began, callback_metrics=loss)
    bar, module = StepBar(), torch.nn.Identity()
    bar.on_train_start(trainer, module)  # type: ignore[arg-type]
    for done in range(2 * (total - began)):
        trainer.global_step = began + (done + 1) // 2
        bar.on_train_batch_end(trainer)
    bar.teardown(trainer, module, "fit")  # type: ignore[arg-type]
    return stream.getvalue()


def test_elsewhere_a_line_tells_each_tenth_or_each_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = shown(monkeypatch, False, 40, 20).splitlines()
    figures = [re.findall(r"[\d.]+[\d:]*", line) for line in lines]
    assert figures[0] == ["24", "40", "2.5", "00:16"]
    assert figures[-1] == ["40", "40", "2.5", "00:00"]
    assert len(lines) == 5
    slow = shown(monkeypatch, False, 1000, 990, batch=31.0)
    assert re.findall(r"step (\d+)", slow) == [str(step) for step in range(991, 1001)]


def test_on_a_terminal_one_bar_counts_the_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    said = shown(monkeypatch, True, 40, 20)
    assert said.count("\n") == 1
    last = said.split("\r")[-1]
    assert "40/40" in last
    assert "loss 2.5" in last
