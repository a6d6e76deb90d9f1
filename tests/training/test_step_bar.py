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


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown(
    monkeypatch: pytest.MonkeyPatch, stream: io.StringIO, total: int, began: int, **seconds: float
) -> str:
    """What a training writes whose every second batch ends a step, each a second long."""
    clock = iter(range(10**6))
    monkeypatch.setattr(
        export, "time", SimpleNamespace(monotonic=lambda: seconds.get("batch", 0.5) * next(clock))
    )
    monkeypatch.setattr(sys, "stderr", stream)
    trainer: Any = SimpleNamespace(
        estimated_stepping_batches=total,
        global_step=began,
        callback_metrics={"train/loss": torch.tensor(2.5)},
    )
    bar = StepBar()
    bar.on_train_start(trainer, None)  # type: ignore[arg-type]
    for batch in range(2 * (total - began)):
        trainer.global_step = began + (batch + 1) // 2
        bar.on_train_batch_end(trainer)
    bar.teardown(trainer, None, "fit")  # type: ignore[arg-type]
    return stream.getvalue()


def test_elsewhere_a_line_tells_each_tenth_with_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = shown(monkeypatch, io.StringIO(), 40, 20).splitlines()
    figures = [re.findall(r"[\d.]+[\d:]*", line) for line in lines]
    assert figures[0] == ["24", "40", "2.5", "00:16"]
    assert figures[-1] == ["40", "40", "2.5", "00:00"]
    assert len(lines) == 5


def test_or_each_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = shown(monkeypatch, io.StringIO(), 1000, 990, batch=31.0).splitlines()
    assert [re.findall(r"step (\d+)", line)[0] for line in lines] == [str(step) for step in range(991, 1001)]


def test_on_a_terminal_one_bar_counts_the_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    said = shown(monkeypatch, Terminal(), 40, 20)
    assert said.count("\n") == 1
    last = said.split("\r")[-1]
    assert "40/40" in last
    assert "loss 2.5" in last
