"""A training that learns nothing is given up; one that learns goes on."""

from __future__ import annotations

from fractions import Fraction

import pytest
import torch
from helpers import refused
from small_training import FRAMES, backbone, data_of, new_descriptor, new_task, trainer

from dejavu_torch.training.losses import (
    LAST,
    LastLosses,
    phase_chance,
    phase_cross_entropy,
    place_chance,
    place_cross_entropy,
)
from dejavu_torch.types import FrequencyLayer

FEW, STEPS = 20, 30  # steps that tell, and of a training
ALIKE = torch.full((FRAMES, 16, 16), 128, dtype=torch.uint8)


@pytest.fixture
def few(monkeypatch):
    """Losses of fewer steps tell."""
    monkeypatch.setattr("dejavu_torch.training.losses.LAST", FEW)


def task_of(kind):
    return new_descriptor(backbone=backbone(32)) if kind == "spectral" else new_task()


@pytest.mark.parametrize("tolerance", [0, 3])
def test_no_blind_guess_of_the_place_is_better(tolerance):
    """Whatever places it prefers."""
    torch.manual_seed(0)
    places, guesses = torch.arange(60)[:, None], [torch.zeros(60), *(5 * torch.randn(20, 60))]
    losses = [float(place_cross_entropy(g.expand(60, -1), places, tolerance, 1.0).loss) for g in guesses]
    assert place_chance(60, tolerance) <= min(losses) + 1e-6
    assert losses[0] == pytest.approx(place_chance(60, tolerance), abs=0.05)  # but for the ends of the route
    assert place_chance(2 * tolerance + 1, tolerance) == 0


def test_no_blind_guess_of_the_phase_is_better():
    torch.manual_seed(0)
    plan = (FrequencyLayer(Fraction(7), 7, 0, 10, (0,)), FrequencyLayer(Fraction(20), 4, 0, 10, (0,)))
    places = torch.arange(10)[:, None]
    blind = [[3 * torch.randn(1, layer.phases).expand(10, -1) for layer in plan] for _ in range(20)]
    assert all(float(phase_cross_entropy(one, plan, places, 1.0)) >= phase_chance(plan) for one in blind)
    share = torch.tensor([0.2] * 3 + [0.1] * 4), torch.tensor([0.5, 0.5, 1e-9, 1e-9])
    best = [-part.log().expand(10, -1) for part in share]
    assert float(phase_cross_entropy(best, plan, places, 1.0)) == pytest.approx(phase_chance(plan), abs=1e-5)


@pytest.mark.parametrize(
    ("place", "phase", "steps", "refused_"),
    [
        ((3.0, 3.0), 9.0, LAST, True),
        ((3.0, 3.0), 9.0, LAST - 1, False),  # too few to tell
        ((2.93, 2.93), 9.0, LAST, False),  # below 2.94
        ((3.0, 3.0), 1.9, LAST, False),  # one below chance is enough
        ((3.3, 3.1), 9.0, LAST, False),  # still falling
        ((3.3, 3.27), 9.0, LAST, True),  # hardly
    ],
)
def test_chance_is_told_by_the_losses_of_the_last_steps(place, phase, steps, refused_):
    last = LastLosses()
    for i in range(steps):
        last.append({"place": torch.tensor(place[2 * i // LAST]), "phase": torch.tensor(phase)})
    if refused_:
        with refused("nothing is learned", "chance 3", f"phase loss is {phase:g}", "chance 2"):
            last.check({"place": 3.0, "phase": 2.0})
    else:
        last.check({"place": 3.0, "phase": 2.0})


@pytest.mark.parametrize("kind", ["templates", "spectral"])
@pytest.mark.usefixtures("few")
def test_frames_that_are_all_alike_end_a_training_ahead_of_its_last_step(tmp_path, kind):
    running = trainer(tmp_path, max_steps=9 * FEW, limit_val_batches=0)
    with refused("nothing is learned", "chance 2.08"):  # log(40 places / 5 right ones)
        running.fit(task_of(kind), data_of(ALIKE))
    assert FEW < running.global_step < 9 * FEW
    assert not list(tmp_path.iterdir())
