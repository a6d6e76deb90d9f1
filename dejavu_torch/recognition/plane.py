"""How a camera moves over an area from one query to the next, and masses of windows near each other."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.places.layout import Layout
from dejavu_torch.places.rectangles import boxes
from dejavu_torch.places.states import States
from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.engine import MIN_PROBABILITY, Counts, Motion, Rates

# places around one whose mass an answer is chosen by, at most, and that of a drive at least, by the
# dimensions of a layout
SHARP, FLOWN = {1: 2**31, 2: 2}, {1: 0, 2: 2}
PERSISTENCE = 0.95  # of learned moves from one query to the next
MOVES_GIVEN = 5.0  # queries that the given moves count as


class PlaneMotion(Motion):
    """A step over an area, by rows and columns; a move over the border leaves it. States are the rows and
    columns of the plane, in which places may lie in another order and leave gaps.

    Args:
        rates: with moves (M,), M = (2 V + 1)^2, by rows and columns, see `Followed`.
        headings: H, evenly around, of which a camera keeps one for long; the moves of each are those that go
            its way. States are (H,R,C), then being off the map. One is any way; `counts` is for that.
    """

    def __init__(self, layout: Layout, rates: Rates, headings: int = 1) -> None:
        super().__init__(States(layout.rows * layout.columns), rates)
        self.layout, side = layout, math.isqrt(len(rates.moves))
        self.chains, self.reach, self.inside = headings, side // 2, None
        moves = (1 - rates.jump - rates.leave) * rates.moves.view(side, side)
        self.kernel, self.change = by_heading(moves, headings)[:, None], turns(headings).to(moves)
        self.each = self.each / headings
        if layout.inside is not None:
            self.inside = layout.inside.to(self.kernel)
            self.each = (self.inside / (headings * self.inside.sum())).flatten().repeat(headings)

    def moved(self, belief: Tensor) -> Tensor:
        on, off = self._split(belief)
        kernel, groups = self.kernel.flip(2, 3), self.chains
        goes = F.conv2d(self._turned(on), kernel, padding=self.reach, groups=groups)
        goes = (goes if self.inside is None else goes * self.inside).flatten(1)
        total = on.sum((1, 2, 3))[:, None]
        lost = (self.kernel[0].sum() * total - goes.sum(1, keepdim=True)).clamp(min=0)
        anywhere = (self.rates.jump * total + self.rates.enter * off) * self.each
        off = (1 - self.rates.enter) * off + self.rates.leave * total + lost
        return torch.cat([goes + anywhere, off], 1).view_as(belief)

    def expected(self, message: Tensor) -> Tensor:
        on, off = self._split(message)
        _, jump, leave, enter = self.rates
        goes = self._turned(F.conv2d(self._bordered(on, off), self.kernel, groups=self.chains)).flatten(1)
        anywhere = (on.flatten(1) * self.each).sum(1, keepdim=True)
        back = goes + jump * anywhere + leave * off
        return torch.cat([back, enter * anywhere + (1 - enter) * off], 1).view_as(message)

    def counts(self, before: Tensor, after: Tensor) -> Counts:
        (on, off), (later, absent) = self._split(before), self._split(after)
        if not len(on):
            return super().counts(before, after)
        _, jump, leave, enter = self.rates
        around = self._bordered(later, absent).transpose(0, 1)
        pairs = self.kernel[0] * F.conv2d(around, on, groups=len(on))[0]  # (B, 2 V + 1, 2 V + 1)
        total, mean = on.sum((1, 2, 3))[:, None], (later.flatten(1) * self.each).sum(1, keepdim=True)
        rest = [jump * total * mean, leave * total * absent, enter * off * mean, (1 - enter) * off * absent]
        each = torch.cat([pairs.flatten(1), *rest], 1)
        each = (each / each.sum(1, keepdim=True).clamp(min=MIN_PROBABILITY)).sum(0)
        return Counts(each[:-4], *each[-4:])

    def wide(self, places: Tensor, off: float | Tensor) -> Tensor:
        plane = self.layout.as_plane(places.reshape(-1, places.shape[-1])).flatten(1)
        plane = plane.view(*places.shape[:-1], -1)
        return super().wide(torch.cat([plane] * self.chains, -1), off)

    def folded(self, mass: Tensor) -> Tensor:
        on, off = self._split(mass)
        return torch.cat([self.layout.by_place(on.sum(1)), off], 1).view(*mass.shape[:-1], -1)

    def near(self, mass: Tensor, radius: int) -> Tensor:
        plane = self.layout.as_plane(mass.flatten(0, -2))
        return self.layout.by_place(boxes(plane, radius)).clamp(0, 1).view_as(mass)

    def _split(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """The plane (B,H,R,C), and being off it (B,1)."""
        states, plane = states.reshape(-1, states.shape[-1]), (self.layout.rows, self.layout.columns)
        return states[:, :-1].unflatten(1, (self.chains, *plane)), states[:, -1:]

    def _turned(self, on: Tensor) -> Tensor:
        """The plane (B,H,R,C), some of it at the headings beside; its own transpose."""
        return on if self.chains == 1 else torch.einsum("bhrc,hg->bgrc", on, self.change)

    def _bordered(self, on: Tensor, off: Tensor) -> Tensor:
        """Messages, with those of being off the area around them, (B, H, R + 2 V, C + 2 V)."""
        v, off = self.reach, off[..., None, None]
        on = on if self.inside is None else torch.where(self.inside > 0, on, off)
        _, headings, rows, columns = on.shape
        around = off.repeat(1, headings, rows + 2 * v, columns + 2 * v)
        around[..., v : v + rows, v : v + columns] = on
        return around


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


def by_heading(moves: Tensor, headings: int) -> Tensor:
    """Moves (2 V + 1, 2 V + 1) by rows and columns, those of each heading (H, 2 V + 1, 2 V + 1), around which
    directions have the distribution of von Mises; each stands still as often."""
    if headings == 1:
        return moves[None]
    away = torch.arange(len(moves)).to(moves) - len(moves) // 2
    course = torch.atan2(away[:, None], away) - 2 * math.pi / headings * torch.arange(headings)[:, None, None]
    stands = (away == 0) & (away == 0)[:, None]
    found = (moves * (chosen.COURSE * (course.cos() - 1)).exp()).masked_fill(stands, 0)
    total = found.sum((1, 2), keepdim=True).clamp(min=MIN_PROBABILITY)
    return torch.where(stands, moves, found * ((moves * ~stands).sum() / total))


def turns(headings: int) -> Tensor:
    """The share of each heading that goes on as each, (H,H): it is kept, or changes to one beside it."""
    change = torch.eye(headings)
    beside = (change.roll(1, 0) + change.roll(-1, 0)) / 2
    return chosen.KEEPS_COURSE * change + (1 - chosen.KEEPS_COURSE) * beside


def rings(reach: int) -> Tensor:
    """The larger of the rows and columns of each move, (2 V + 1, 2 V + 1) int64."""
    away = torch.arange(-reach, reach + 1).abs()
    return torch.maximum(away[:, None], away)
