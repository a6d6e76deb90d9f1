"""Which parameters AdamW decays, how its learning rate runs, and how its parameters are exchanged."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from helpers import refused
from test_task import data_of, new_task, trainer
from torch import nn
from torch.optim import AdamW

from dejavu_torch.training.optimizer import adamw_of, replace


def rates(steps: float, taken: int) -> list[float]:
    """The learning rate of each step, of at most 1, and of the one behind the last."""
    made = adamw_of([nn.Parameter(torch.zeros(2))], 1.0, 0.0, steps)
    optimizer, schedule = made["optimizer"], made["lr_scheduler"]
    assert schedule["interval"] == "step"
    seen = [optimizer.param_groups[0]["lr"]]
    for _ in range(taken):
        optimizer.step()
        schedule["scheduler"].step()
        seen.append(optimizer.param_groups[0]["lr"])
    return seen


def test_the_rate_rises_over_a_tenth_and_falls_to_0() -> None:
    seen = rates(100, 103)
    rise = [(k + 1) / 10 for k in range(10)]
    fall = [0.5 + 0.5 * math.cos(math.pi * k / 90) for k in range(91)]
    assert seen == pytest.approx([*rise, *fall, 0, 0, 0])


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_a_short_run_begins_at_the_highest_rate(steps: int) -> None:
    seen = rates(steps, steps)
    assert seen[0] == 1
    assert all(0 < rate <= 1 for rate in seen[:-1])


def test_a_training_ends_at_rate_0(tmp_path: Path) -> None:
    running = trainer(tmp_path, max_steps=7)
    running.fit(new_task(), data_of())
    assert [group["lr"] for group in running.optimizers[0].param_groups] == pytest.approx([0, 0], abs=1e-12)


def test_only_what_is_multiplied_decays() -> None:
    net = nn.Sequential(nn.Conv2d(1, 2, 3), nn.BatchNorm2d(2), nn.Linear(2, 2))
    net[2].weight.requires_grad_(False)
    optimizer = adamw_of(net.parameters(), 0.1, 0.3, 10)["optimizer"]
    assert isinstance(optimizer, AdamW)
    decays = {id(p): group["weight_decay"] for group in optimizer.param_groups for p in group["params"]}
    expected = {net[0].weight: 0.3, net[0].bias: 0, net[1].weight: 0, net[1].bias: 0, net[2].bias: 0}
    assert decays == {id(parameter): decay for parameter, decay in expected.items()}
    assert len(adamw_of([net[0].bias], 0.1, 0.3, 10)["optimizer"].param_groups) == 1


def test_a_schedule_needs_an_end() -> None:
    with refused("no end", "trainer.max_steps"):
        adamw_of([nn.Parameter(torch.zeros(2))], 1.0, 0.0, math.inf)


def test_parameters_are_replaced_with_nothing_remembered() -> None:
    before, after, other = nn.Linear(3, 2), nn.Linear(3, 2), nn.Linear(2, 1)
    optimizer = adamw_of([*before.parameters(), *other.parameters()], 0.1, 0.1, 10)["optimizer"]

    def step(first: nn.Module) -> None:
        optimizer.zero_grad()
        other(first(torch.ones(4, 3))).sum().backward()
        optimizer.step()

    step(before)
    kept = optimizer.state[other.weight]
    replace(optimizer, before, after)
    assert [[p.shape for p in group["params"]] for group in optimizer.param_groups] == [
        [(2, 3), (1, 2)],
        [(2,), (1,)],
    ]
    assert set(optimizer.state) == set(other.parameters())
    assert optimizer.state[other.weight] is kept
    old, new = before.weight.clone(), after.weight.clone()
    step(after)
    assert torch.equal(before.weight, old)
    assert not torch.equal(after.weight, new)
    assert float(optimizer.state[after.weight]["step"]) == 1
    assert float(kept["step"]) == 2
