"""Whether a training learns anything: its losses beside those of a guess that is blind to the frames."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import torch
from torch import Tensor

from dejavu_torch.types import InputError, Plan

LAST, BELOW = 100, 0.98  # steps, and the share of chance, or of what was before, that is less than it


class NothingLearned(InputError):
    """The losses of a training have stayed at chance."""


def place_chance(places: int, tolerance: int) -> float:
    """The least `place_cross_entropy` of one answer to all queries of a route, log(N / (2 tolerance + 1)).

    Example:
        >>> round(place_chance(2697, 5), 2)
        5.5
    """
    return max(0.0, math.log(places / (2 * tolerance + 1)))


def phase_chance(plan: Plan) -> float:
    """The least `phase_cross_entropy` likewise: the mean entropy of a layer's phases along the route."""
    entropies = []
    for layer in plan:
        share = torch.bincount(layer.phase(torch.arange(layer.start, layer.stop))).double()
        share = share[share > 0] / share.sum()
        entropies.append(float(-(share * share.log()).sum()))
    return sum(entropies) / len(entropies)


class LastLosses:
    """The losses of the last `LAST` steps of a stage, behind its warm-up."""

    def __init__(self) -> None:
        self.last: deque[dict[str, Tensor]] = deque(maxlen=LAST)
        self.learned = False

    def add(self, parts: Mapping[str, Tensor]) -> None:
        """Those of a step, by name."""
        self.last.append(dict(parts))

    def check(self, chance: Mapping[str, float]) -> None:
        """Refuse losses none of which is below chance or still falling. Nothing is known before `LAST` steps.

        Args:
            chance: of each loss that tells places apart, by name.

        Raises:
            NothingLearned: naming both.
        """
        if len(self.last) < LAST or not chance:
            return
        losses = {name: torch.stack([parts[name] for parts in self.last]) for name in chance}
        halves = {name: one.view(2, -1).mean(1).tolist() for name, one in losses.items()}
        self.learned = any(sum(halves[name]) / 2 <= BELOW * guess for name, guess in chance.items())
        falling = any(late < BELOW * early for early, late in halves.values())
        if self.learned or falling or min(chance.values()) == 0:
            return
        means = {name: sum(one) / 2 for name, one in halves.items()}
        seen = ", ".join(
            f"the {name} loss is {mean:.3g} (chance {chance[name]:.3g})" for name, mean in means.items()
        )
        raise NothingLearned(f"nothing is learned: over the last {LAST} steps {seen}")
