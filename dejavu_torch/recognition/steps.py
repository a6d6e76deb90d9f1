"""One query of a sequence or of a filter: a fixed run of tensor operations, its state handed in and out."""

from __future__ import annotations

import functools
import math
from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import InputError, SequenceModel


class Step(Protocol):
    """What scores a query behind others: a module (scores, state) -> (scores, state)."""

    def __call__(self, scores: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Scores of the query alone and the state behind the one before -> scores, and the next state."""

    def start(self, places: int) -> Tensor:
        """The state ahead of the first query."""


class SequenceStep(nn.Module):
    """`SequenceMatcher`, a query at a time.

    Args:
        sequence: whose length and speeds it takes.

    Shape: scores of one query (N,) or (1,N), state (T-1,N) -> scores as `SequenceMatcher.stream` gives them,
        of the same shape, and the next state (T-1,N).

    Convention: the state holds the scores of the queries before, the latest last, and NaN in the rows of
        those that there were not; `start` is all NaN. Gradients reach scores and state.

    Raises:
        InputError: scores that are not of one query, or a state of another length or map; trajectories
            longer than the map.

    Example:
        >>> step = SequenceStep(SequenceMatcher(length=3))
        >>> state = step.start(places=4)
        >>> for scores in torch.tensor([[0.0, 5, 5, 0], [5, 0.0, 0, 5], [0, 5, 0.0, 5]]):
        ...     together, state = step(scores, state)
        ...     print(int(together.argmin()))
        0
        1
        2
    """

    def __init__(self, sequence: SequenceMatcher) -> None:
        super().__init__()
        self.length, self.shifts = sequence.length, sequence.shifts

    def start(self, places: int) -> Tensor:
        """The state ahead of the first query of a map of so many places: (T-1,N)."""
        return torch.full((self.length - 1, places), math.nan)

    def forward(self, scores: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        places = _places(scores)
        if state.shape != (self.length - 1, places):
            raise InputError(
                f"a state {tuple(state.shape)}; expected ({self.length - 1}, {places}), as `start` gives it"
            )
        far = max(abs(shifts[-1]) for shifts in self.shifts)
        if far >= places:
            raise InputError(f"trajectories over {far} places on a map of {places}; expected shorter ones")
        rows = torch.cat([state.to(scores), scores.reshape(1, places)])
        known = rows.isfinite()
        summed = torch.stack(
            [torch.where(known, rows, 0), known.to(rows)], 1
        )  # (T,2,N): scores, their number
        used = (~rows.isnan().all(1)).sum()  # queries so far, at most T
        ways = [self._mean(summed, shifts, used) for shifts in self.shifts]
        best = functools.reduce(torch.minimum, ways).masked_fill(~known[-1], math.inf)
        return best.reshape(scores.shape), rows[1:]

    def _mean(self, summed: Tensor, shifts: tuple[int, ...], used: Tensor) -> Tensor:
        """Means along the trajectories of one speed: (T,2,N) -> (N,), +inf on too little of the map."""
        # a pad below 0 crops: what is on the map k queries back comes to lie at the trajectory's end
        moved = (F.pad(row, (shift, -shift)) for row, shift in zip(summed.flip(0), shifts, strict=True))
        total, count = functools.reduce(torch.add, moved)
        return torch.where(2 * count >= used, total / count.clamp(min=1), math.inf)

    def extra_repr(self) -> str:
        return f"length={self.length}"


class FilterStep(nn.Module):
    """`PlaceFilter`, a query at a time.

    Args:
        filter: whose settings, its parameters, it shares.

    Shape: scores of one query (N,) or (1,N), posterior (N+1,) -> -log of a probability, of the shape of the
        scores, as `PlaceFilter.stream` gives it, and the next posterior (N+1,).

    Convention: the last number of a posterior is the probability of being off the map. `start`, ahead of the
        first query, is all 0. Each query searches all places, whatever `search_every`. Gradients reach
        scores, posterior and parameters.

    Raises:
        InputError: scores that are not of one query, or a posterior of another map.

    Example:
        >>> step = FilterStep(PlaceFilter(within=0))
        >>> posterior = step.start(places=6)
        >>> for scores in torch.tensor([[0.0, 5, 5, 5, 5, 5], [5, 0, 5, 5, 0, 5], [5, 5, 0, 5, 5, 5]]):
        ...     unlikely, posterior = step(scores, posterior)
        ...     print(int(unlikely.argmin()))
        0
        1
        2
    """

    def __init__(self, filter: PlaceFilter) -> None:
        super().__init__()
        self.filter = filter

    def start(self, places: int) -> Tensor:
        """The state ahead of the first query of a map of so many places: (N+1,)."""
        return torch.zeros(places + 1)

    def forward(self, scores: Tensor, posterior: Tensor) -> tuple[Tensor, Tensor]:
        places = _places(scores)
        if posterior.shape != (places + 1,):
            raise InputError(f"a posterior {tuple(posterior.shape)}; expected ({places + 1},)")
        row = scores.reshape(1, places)
        found = self.filter.step(row, posterior.to(scores))
        return self.filter.unlikely(found[None, :-1], row).reshape(scores.shape), found


def step_of(sequence: SequenceModel) -> SequenceStep | FilterStep:
    """The step of a sequence or a filter.

    Raises:
        InputError: a model of another kind.
    """
    if isinstance(sequence, SequenceMatcher):
        return SequenceStep(sequence)
    if isinstance(sequence, PlaceFilter):
        return FilterStep(sequence)
    raise InputError(f"{type(sequence).__name__} has no step; expected a SequenceMatcher or a PlaceFilter")


def _places(scores: Tensor) -> int:
    if scores.ndim not in (1, 2) or scores.shape[:-1].numel() != 1 or not scores.is_floating_point():
        raise InputError(f"scores are {tuple(scores.shape)} {scores.dtype}; expected floats (N,) or (1,N)")
    return scores.shape[-1]
