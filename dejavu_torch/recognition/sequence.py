"""Scores from several consecutive queries."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Iterable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.memory import is_readable
from dejavu_torch.types import InputError, SequenceModel, Together, expect

MAX_LENGTH = 2**16  # queries of a sequence

log = logging.getLogger("dejavu_torch")


class SequenceMatcher(SequenceModel):
    """Scores of places from the latest T queries instead of one, for any map.

    The score of place i is the mean along the trajectory that ends there: for the query k steps before the
    latest, the score of place i - v k, rounded. The best of several speeds v counts.

    Args:
        length: T, queries of a sequence.
        speeds: each v in places per query: 1 for equally fast traverses, negative for the opposite direction.

    Shape: scores (..., Q, N), state (..., R, N) or None -> (..., Q, N), lower is better.

    Convention: causal. The state holds the scores of the last R < T queries; rows of NaN are placeholders. A
        trajectory ends at the ends of its route, and the mean ignores places that nothing covers. The score
        is +inf if less than half of the trajectory is on the map, or if nothing covers the place for the
        latest query. Half a place is rounded up.

    Source: the constant-speed search of SeqSLAM (Milford and Wyeth, ICRA 2012), causal and without its
        normalisation.

    Raises:
        InputError: a length outside 1..65536, no speeds, or speeds that are not finite; forward: scores or a
            state of another shape.

    Example:
        >>> scores = torch.tensor([[0.0, 5, 5, 0], [5, 0.0, 0, 5], [0, 5, 0.0, 5]])
        >>> scores.argmin(1), SequenceMatcher(length=3)(scores).argmin(1)
        (tensor([0, 1, 0]), tensor([0, 1, 2]))
    """

    def __init__(self, length: int = 11, speeds: Sequence[float] = (1.0,)) -> None:
        super().__init__()
        if not isinstance(length, int) or not 1 <= length <= MAX_LENGTH:
            raise InputError(f"a sequence of {length} queries; expected a whole number, 1 to {MAX_LENGTH}")
        self.length = length
        self.speeds = tuple(float(speed) for speed in speeds) if isinstance(speeds, Iterable) else ()
        fits = self.speeds and all(map(math.isfinite, self.speeds))
        expect(fits, "at least one finite number of places per query", f"the speeds are {speeds}")

    @property
    def key(self) -> Together:
        return self.length

    def _shifts(self, speed: float) -> list[int]:
        """Places from a trajectory's end back to it, 0, 1, .., T - 1 queries before the latest."""
        return [math.floor(speed * k + 0.5) for k in range(self.length)]

    def start(self, places: int, fixed: bool = False) -> Tensor:
        return torch.full((self.length - 1 if fixed else 0, places), math.nan, dtype=torch.float32)

    def forward(self, scores: Tensor, state: Tensor | None = None) -> Tensor:
        if scores.ndim > 2:
            return each(self, scores, state)
        return self.step(scores, self.start(scores.shape[-1]).to(scores) if state is None else state)[0]

    def step(
        self, scores: Tensor, state: Tensor, route_starts: Sequence[int] = (0,)
    ) -> tuple[Tensor, Tensor]:
        fits = state.shape[1:] == scores.shape[1:] and len(state) < self.length
        if scores.ndim != 2 or not fits or not scores.is_floating_point():
            raise InputError(
                f"scores are {tuple(scores.shape)} {scores.dtype} after {tuple(state.shape)}; expected "
                f"floats (Q,N) after at most ({self.length - 1},N)"
            )
        if self.length == 1 or not len(scores):
            return scores, state
        rows = torch.cat([state.to(scores), scores])
        before = (~state[:, :1].isnan()).sum()
        used = (torch.arange(1, len(scores) + 1, device=rows.device) + before).clamp(max=self.length)
        parts = [self._best(part, used) for part in rows.tensor_split([*route_starts[1:]], 1)]
        best = parts[0] if len(parts) == 1 else torch.cat(parts, 1)
        return best, rows[max(0, len(rows) - self.length + 1) :]

    def _best(self, rows: Tensor, used: Tensor) -> Tensor:
        """Scores on one route, (R,N) -> (Q,N); `used`: (Q,) rows that each query uses."""
        valid = rows.isfinite()
        gaps = not is_readable(rows) or not bool(valid.all())
        known, counted = (torch.where(valid, rows, 0), valid.to(rows)) if gaps else (rows, None)
        means = (self._means(known, counted, used, speed) for speed in self.speeds)
        best = functools.reduce(torch.minimum, means)
        return best.masked_fill(~valid[-len(used) :], math.inf) if gaps else best

    def _means(self, rows: Tensor, counted: Tensor | None, used: Tensor, speed: float) -> Tensor:
        """Mean scores along trajectories; `counted`: 1 for a finite score, else 0; None if all are finite."""
        shifts = self._shifts(speed)[: len(rows)]
        total = _along(rows, shifts, len(used))
        if counted is not None:
            count = _along(counted, shifts, len(used))
        else:  # it depends on `used` alone
            lowest = min(len(rows) - len(used) + 1, len(shifts))
            count = _along(torch.ones_like(rows[: len(shifts)]), shifts, len(shifts) - lowest + 1)
            count = count if len(count) == 1 else count[used - lowest]
        return torch.where(2 * count >= used[:, None], total / count.clamp(min=1), math.inf)

    def trajectory(self, scores: Tensor, place: int) -> Tensor:
        """The cells whose mean is the last query's score of a place, which has to be finite.

        Shape: (Q,N) -> (C,2), query and place of each of at most T cells, the latest query first.
        """
        means = [float(SequenceMatcher(self.length, (v,))(scores)[-1, place]) for v in self.speeds]
        back = torch.tensor(self._shifts(self.speeds[means.index(min(means))])[: len(scores)])
        cells = torch.stack([len(scores) - 1 - torch.arange(len(back)), place - back], 1)
        cells = cells[(cells[:, 1] >= 0) & (cells[:, 1] < scores.shape[1])]
        return cells[scores.cpu()[cells[:, 0], cells[:, 1]].isfinite()]

    def check(self, queries: int | None, places: int) -> None:
        for speed in self.speeds:
            seen = f"a sequence of {self.length} queries at {speed:g} places per query on {places} places"
            expect(abs(self._shifts(speed)[-1]) < places, "a shorter one, or other speeds", seen)
        if queries is not None and self.length > queries:
            log.warning("a sequence of %d queries, but there are %d: all are used", self.length, queries)

    def extra_repr(self) -> str:
        return f"length={self.length}, speeds={list(self.speeds)}"


def each(model: SequenceModel, scores: Tensor, state: Tensor | None) -> Tensor:
    """A sequence model for each of several sequences: (..., Q, N) and their states -> (..., Q, N)."""
    lead = scores.shape[:-2]
    if state is not None and state.shape[: len(lead)] != lead:
        seen = f"the scores are {tuple(scores.shape)}, the states {tuple(state.shape)}"
        raise InputError(f"{seen}; expected a state for each sequence, {tuple(lead)}")
    if not lead.numel():
        return scores.clone()
    given = [one.flatten(0, len(lead) - 1) for one in (scores, state) if one is not None]
    together: Tensor = torch.func.vmap(model)(*given)
    return together.view(*lead, *together.shape[1:])


def _along(rows: Tensor, shifts: list[int], queries: int) -> Tensor:
    """Sums along the trajectories that end at each place, for each of the last queries, (R,N) -> (Q,N)."""
    places, before = rows.shape[1], len(rows) - queries
    far = min(places, max(map(abs, shifts)))
    padded = F.pad(rows, (far, far))
    total = rows.new_zeros(queries, places)
    for k, shift in enumerate(shifts):
        first = max(0, k - before)  # the first query with a predecessor k steps before
        left = far - max(-far, min(shift, far))
        total[first:] += padded[before + first - k : len(rows) - k, left : left + places]
    return total
