"""How a camera moves over an area from one query to the next, and masses of windows near each other."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition.motion import MIN_PROBABILITY, Counts, Rates

# places around one whose mass an answer is chosen by, at most, and that of a drive at least, by the
# dimensions of a layout
SHARP, FLOWN = {1: 2**31, 2: 2}, {1: 0, 2: 2}
PERSISTENCE = 0.95  # of learned moves from one query to the next
MOVES_GIVEN = 5.0  # queries that the given moves count as


class Steps(NamedTuple):
    """A step over an area, and its transpose, of the mass of windows (R,C) and that of being off it ().

    kernel: (2 V + 1, 2 V + 1), probabilities of a move by rows and columns, `jump` and `leave` taken off.
    jump, leave, enter: see `Motion`; a move over the border leaves the area. inside: (R,C), see `Layout`.
    """

    kernel: Tensor
    jump: Tensor
    leave: Tensor
    enter: Tensor
    inside: Tensor | None = None

    def moved(self, on: Tensor, off: Tensor) -> tuple[Tensor, Tensor]:
        """The belief before the next query."""
        total = on.sum()
        goes = F.conv2d(on[None, None], self.kernel.flip(0, 1)[None, None], padding=self.reach)[0, 0]
        goes = goes if self.inside is None else goes * self.inside
        lost = self.kernel.sum() * total - goes.sum()
        anywhere = (self.jump * total + self.enter * off) * self.even(on)
        return goes + anywhere, (1 - self.enter) * off + self.leave * total + lost

    def expected(self, on: Tensor, off: Tensor) -> tuple[Tensor, Tensor]:
        """What a message of the next query says of the state before."""
        goes = F.conv2d(self._bordered(on, off), self.kernel[None, None])[0, 0]
        anywhere = (on * self.even(on)).sum()
        back = goes + self.jump * anywhere + self.leave * off
        return back, self.enter * anywhere + (1 - self.enter) * off

    def pairs(self, before: Tensor, on: Tensor, off: Tensor) -> Tensor:
        """Of each move (2 V + 1, 2 V + 1), the weight of belief before (R,C) and message after it."""
        weight: Tensor = self.kernel * F.conv2d(self._bordered(on, off), before[None, None])[0, 0]
        return weight

    @property
    def reach(self) -> int:
        """V."""
        return len(self.kernel) // 2

    def even(self, on: Tensor) -> Tensor:
        """The mass of each window if all have the same, (R,C), or () if all rows and columns are windows."""
        return on.new_tensor(1 / on.numel()) if self.inside is None else self.inside / self.inside.sum()

    def _bordered(self, on: Tensor, off: Tensor) -> Tensor:
        """A message, with that of being off the area around it, (1, 1, R + 2 V, C + 2 V)."""
        on = on if self.inside is None else torch.where(self.inside > 0, on, off)
        around = off.expand(tuple(side + 2 * self.reach for side in on.shape)).clone()
        around[self.reach : self.reach + len(on), self.reach : self.reach + on.shape[1]] = on
        return around[None, None]


class Followed(NamedTuple):
    """What a filter over an area learns on the way: the moves by rows and columns, of which the latest count
    most, since a camera keeps its course. moves: (M,), M = (2 V + 1)^2, expected numbers of each."""

    moves: Tensor

    @classmethod
    def size(cls, places: int, moves: int) -> int:
        """M, if windows up to V = `moves` - 1 rows or columns away are reached."""
        return (2 * moves - 1) ** 2

    @classmethod
    def unpacked(cls, numbers: Tensor, places: int, moves: int) -> Followed:
        return cls(numbers[: cls.size(places, moves)])

    def after(self, z: Tensor, speaks: Tensor, expected: Tensor, moves: Tensor) -> Followed:
        """The numbers after another query, see `Learned`."""
        return Followed(PERSISTENCE * self.moves + moves)

    def likelihood(self, sharpness: Tensor, off_map: Tensor) -> tuple[Tensor, Tensor]:
        """Both as given."""
        return sharpness, off_map

    def moves_after(self, given: Tensor) -> Tensor:
        """Probabilities of the moves (M,), from weights (V+1,) of windows 0 to V rows or columns away,
        whichever are more."""
        kernel = given[rings(len(given) - 1).to(given.device).flatten()]
        moves = MOVES_GIVEN * kernel / kernel.sum() + self.moves
        return moves / moves.sum()


class PlaneMotion:
    """`Motion` over an area, for a filter. Beliefs are (N+1,): the places, then being off the area.

    Args:
        rates: with moves (M,) by rows and columns, see `Followed`.
    """

    def __init__(self, layout: Layout, rates: Rates) -> None:
        self.layout, self.rates = layout, rates
        side = math.isqrt(len(rates.moves))
        kernel = (1 - rates.jump - rates.leave) * rates.moves.view(side, side)
        self.steps = Steps(kernel, rates.jump, rates.leave, rates.enter, inside_of(layout, kernel))

    def moved(self, belief: Tensor) -> Tensor:
        """The belief before the next query."""
        return self._joined(*self.steps.moved(*self._split(belief)))

    def expected(self, message: Tensor) -> Tensor:
        """What a message of the next query says of the state before: the transpose of `moved`."""
        return self._joined(*self.steps.expected(*self._split(message)))

    def anywhere(self) -> Tensor:
        """The belief before the first query, see `Motion.anywhere`."""
        _, _, leave, enter = self.rates
        off = (leave / (leave + enter).clamp(min=MIN_PROBABILITY)).clamp(max=0.5)
        return torch.cat([((1 - off) / self.layout.places).expand(self.layout.places), off[None]])

    def counts(self, before: Tensor, after: Tensor) -> Counts:
        """Expected numbers of steps, see `Motion.counts`, of one step: (1,N+1)."""
        (on, off), (later, absent) = self._split(before[0]), self._split(after[0])
        _, jump, leave, enter = self.rates
        total, mean = on.sum(), (later * self.steps.even(later)).sum()
        rest = [jump * total * mean, leave * total * absent, enter * off * mean, (1 - enter) * off * absent]
        each = torch.cat([self.steps.pairs(on, later, absent).flatten(), torch.stack(rest)])
        each = each / each.sum().clamp(min=MIN_PROBABILITY)
        return Counts(each[:-4], *each[-4:])

    def _split(self, state: Tensor) -> tuple[Tensor, Tensor]:
        return self.layout.as_plane(state[None, :-1])[0], state[-1]

    def _joined(self, on: Tensor, off: Tensor) -> Tensor:
        return torch.cat([self.layout.by_place(on[None])[0], off[None]])


def inside_of(layout: Layout, like: Tensor) -> Tensor | None:
    """`Layout.inside`, in the type of other numbers."""
    inside = layout.inside
    return None if inside is None else inside.to(like)


def rings(reach: int) -> Tensor:
    """The larger of the rows and columns of each move, (2 V + 1, 2 V + 1) int64."""
    away = torch.arange(-reach, reach + 1).abs()
    return torch.maximum(away[:, None], away)
