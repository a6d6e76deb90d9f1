"""How far a camera moved from each query to the next, where something else than images tells it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.tables import read_table
from dejavu_torch.places.states import States
from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.engine import Rates
from dejavu_torch.recognition.motion import AlongRoute
from dejavu_torch.types import InputError, expect

EXPECTED = "a csv with a column moved, in places, and a row for each frame"
MOST, MOST_AT_ONCE = 100, 1000  # places a query, in the mean and at once


class Steps(NamedTuple):
    """A drive in steps of one place: of queries between which the camera moved by n places, each takes n
    steps, or one in which nothing moves, if it did not.

    queries: (R,) int64, the query of each step, -1 on the way to the next one. still: (R,) bool.
    """

    queries: Tensor
    still: Tensor


def checked_moved(moved: Tensor, queries: int) -> Tensor:
    """Places from each query to the next, (Q,), of which the first does not count; else an InputError."""
    moved = torch.as_tensor(moved).detach().cpu().double()
    seen = f"moved is {tuple(moved.shape)} for {queries} queries"
    expect(moved.shape == (queries,), "as many places moved, each since the query before", seen)
    moved = moved.where(torch.arange(queries) > 0, 0.0)
    for query, one in enumerate(moved.tolist()):
        check_move(one, f" at query {query}")
    mean = float(moved.mean()) if queries else 0.0
    expect(mean <= MOST, f"at most {MOST}", f"moved is {mean:.4g} places a query in the mean")
    return moved


def check_move(moved: float, where: str = "") -> None:
    """Refuse what is no number of places from a query to the next."""
    expect(0 <= moved <= MOST_AT_ONCE, f"0 to {MOST_AT_ONCE} places", f"moved is {moved:g}{where}")


def whole(moved: Tensor, ahead: float = 0.0) -> tuple[list[int | None], list[Tensor]]:
    """Whole places moved to each query, None where it is unknown, and by how much of a place the camera is
    ahead of them before each query and after the last one; (B,) places, and how far it is ahead at first."""
    places, aheads = list[int | None](), [ahead]
    for one in moved.tolist():
        if math.isnan(one):
            places.append(None)
            aheads.append(0.0)
            continue
        check_move(one)
        total = aheads[-1] + one
        places.append(math.floor(total + 0.5))
        aheads.append(total - math.floor(total + 0.5))
    return places, [torch.tensor(one, dtype=torch.float64) for one in aheads]


def steps_of(moved: Tensor) -> Steps:
    """The steps of a drive, by `checked_moved`."""
    places = torch.tensor([one or 0 for one in whole(moved)[0]], dtype=torch.int64)
    at = places.clamp(min=1).cumsum(0) - 1
    queries = torch.full((int(at[-1]) + 1 if len(at) else 0,), -1)
    queries[at] = torch.arange(len(at))
    still = torch.zeros(len(queries), dtype=torch.bool)
    still[at] = places == 0
    return Steps(queries, still)


def moving(states: States, rates: Rates, places: int = 1) -> AlongRoute:
    """The motion by so many places, each of which may be missed, or passed twice as fast."""
    slip, moves = chosen.ODOMETRY / 2, rates.jump.new_ones(1, 1)
    one = rates.jump.new_tensor([slip, 1 - 2 * slip, slip])
    for _ in range(places):
        moves = F.conv1d(moves, one[None, None], padding=2)
    return AlongRoute(states, rates._replace(moves=moves[0].expand(*rates.jump.shape, -1)))


class Told(AlongRoute):
    """A step of so many places in the states of another motion, whose steady speeds tell nothing of it."""

    def __init__(self, motion: AlongRoute, places: int) -> None:
        super().__init__(motion.states, motion.rates, motion.speeds)
        self.step = moving(motion.states, motion.rates, places)
        self.shares = motion.speeds.enter.to(motion.rates.jump)[:, None]

    def moved(self, belief: Tensor) -> Tensor:
        on, off = belief[..., :-1].unflatten(-1, (self.chains, -1)), belief[..., -1:]
        moved = self.step.moved(torch.cat([on.sum(-2), off], -1))
        on = self.shares * moved[..., None, :-1]
        return torch.cat([on.flatten(-2), moved[..., -1:]], -1)

    def expected(self, message: Tensor) -> Tensor:
        on, off = message[..., :-1].unflatten(-1, (self.chains, -1)), message[..., -1:]
        before = self.step.expected(torch.cat([(self.shares * on).sum(-2), off], -1))
        return torch.cat([*[before[..., :-1]] * self.chains, before[..., -1:]], -1)


def read_moved(path: Path) -> Tensor:
    """How many places a camera moved to each frame from the one before, (Q,), from a csv with a column
    `moved`.

    Raises:
        InputError: another file.
    """
    table = read_table(path, EXPECTED)
    expect("moved" in table and table.rows, EXPECTED, f"{table}, and {len(table)} rows")
    cells, found = table.text("moved"), table.numbers("moved")
    found[0] = found[0] if cells[0] else 0.0  # there is no frame before the first
    for row in np.flatnonzero(np.isnan(found))[:1]:
        raise InputError(f"{table.where(row)}: moved is {cells[row]!r}; expected a number")
    return torch.from_numpy(found)
