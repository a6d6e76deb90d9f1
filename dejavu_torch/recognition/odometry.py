"""How far a camera moved from each query to the next, where something else than images tells it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.coordinates import MOVED, odometer_of, read_odometer
from dejavu_torch.data.files import as_number
from dejavu_torch.data.source import open_source
from dejavu_torch.data.tables import read_table
from dejavu_torch.places.states import States
from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.engine import Rates
from dejavu_torch.recognition.motion import AlongRoute
from dejavu_torch.types import Odometer, Traverse, expect

MOST, MOST_AT_ONCE = 100, 1000  # places a query, in the mean and at once
Moved: TypeAlias = Odometer | Tensor | tuple[Tensor, Tensor | float]  # see `checked_moved`


def checked_moved(told: Moved, queries: int) -> Odometer:
    """An odometer, or the places from each query to the next, (Q,), of which the first does not count, or
    these and their standard deviation, (Q,) or (), as an odometer; else an InputError."""
    if not isinstance(told, Odometer):
        given = told if isinstance(told, tuple) else (told, math.nan)
        moved, spread = (torch.as_tensor(one).detach().cpu().double() for one in given)
        seen = f"moved is {tuple(moved.shape)} for {queries} queries"
        fits = moved.shape == (queries,) and spread.shape in ((), (queries,))
        expect(fits, "as many places moved, each since the query before", seen)
        moved = moved.where(torch.arange(queries) > 0, 0.0)
        told = Odometer(torch.stack([moved, spread.square().expand(queries)], 1).cumsum(0))
    expect(queries in (0, len(told.values)), f"{queries} queries", f"moved is of {len(told.values)} queries")
    moved = told.times(max(paces(told))).moves[:, 0]  # of metres, as many places as there may be
    for query, one in enumerate(moved.tolist()):
        check_move(one, f" at query {query}")
    mean = float(moved.mean()) if queries else 0.0
    expect(mean <= MOST, f"at most {MOST}", f"moved is {mean:.4g} places a query in the mean")
    return told


def moves_of(
    queries: Traverse, told: str | Path | Moved | None, metres: float | str | None
) -> Odometer | None:
    """What an odometer reads at queries: by a csv, "coordinates", which are theirs, or as it is told; without
    any of these, their own. `metres` are those from a place to the next: a number, or a reference, whose
    coordinates tell it in the mean; None leaves it open.

    Raises:
        InputError: another file, or what cannot be moves.
    """
    if isinstance(told, str | Path):
        own = str(told) == "coordinates"
        told = odometer_of(queries) if own else read_odometer(read_table(Path(told), MOVED), queries)
    elif told is None and (told := queries.odometer) is None:
        expect(metres is None, "moves in metres", f"{metres} metres a place, and no moves")
        return None
    if metres is None:
        return checked_moved(told, len(queries))
    each = as_number(str(metres))
    if each is None:
        way = odometer_of(open_source(str(metres))).values[:, 0]
        each = float(way[~way.isnan()].diff().mean())
    odometer = told if isinstance(told, Odometer) else checked_moved(told, len(queries))
    seen = f"{metres} metres a place, and moves in {'metres' if odometer.metres else 'places'}"
    expect(each > 0 and odometer.metres, "a number above 0, and metres", seen)
    return checked_moved(odometer.times(1 / each), len(queries))


def check_move(moved: float, where: str = "") -> None:
    """Refuse what is no number of places from a query to the next."""
    expect(0 <= moved <= MOST_AT_ONCE, f"0 to {MOST_AT_ONCE} places", f"moved is {moved:g}{where}")


def whole(moved: Tensor, ahead: float | Tensor = 0.0) -> tuple[Tensor, Tensor]:
    """Whole places moved to each query, (B,), and by how much of a place the camera is ahead of them before
    each query and after the last one, (B+1,); by places moved, NaN where unknown, and how far it is ahead."""
    for one in moved[~moved.isnan()].tolist():
        check_move(one)
    ways = F.pad(moved.detach().cpu().double().nan_to_num(0).cumsum(0), (1, 0)) + ahead
    places = (ways + 0.5).floor()
    return places.diff().long(), ways - places


def steps_of(odometer: Odometer) -> tuple[Tensor, Tensor]:
    """A drive in steps of one place: of queries between which the camera moved by n places, each takes n
    steps, or one in which nothing moves, if it did not: the query of each step, (R,) int64, -1 on the way to
    the next one, and where nothing moves, (R,) bool."""
    places, _ = whole(odometer.moves[:, 0])
    at = places.clamp(min=1).cumsum(0) - 1
    queries = torch.full((int(at[-1]) + 1 if len(at) else 0,), -1)
    queries[at] = torch.arange(len(at))
    still = torch.zeros(len(queries), dtype=torch.bool)
    still[at] = places == 0
    return queries, still


def paces(odometer: Odometer) -> list[float]:
    """Scales of an odometer in metres, at which a drive has a usual speed; 1 in places."""
    moves = odometer.moves[:, 0]
    some = moves[moves > 0]
    return [pace / float(some.mean()) for pace in chosen.PACES] if odometer.metres and len(some) else [1.0]


def slips(way: Tensor, spread: Tensor) -> Tensor:
    """The share of places that is missed, or counted twice, if so many have this standard deviation."""
    return (spread.square() / way.clamp(min=1e-9)).clamp(max=1).nan_to_num(chosen.ODOMETRY)


def moving(states: States, rates: Rates, places: int = 1, slip: float = chosen.ODOMETRY) -> AlongRoute:
    """The motion by so many places, a share of which is missed, or passed twice as fast."""
    slip, moves = slip / 2, rates.jump.new_ones(1, 1)
    one = rates.jump.new_tensor([slip, 1 - 2 * slip, slip])
    for _ in range(places):
        moves = F.conv1d(moves, one[None, None], padding=2)
    return AlongRoute(states, rates._replace(moves=moves[0].expand(*rates.jump.shape, -1)))


class Told(AlongRoute):
    """A step of so many places in the states of another motion, whose steady speeds tell nothing of it."""

    def __init__(self, motion: AlongRoute, places: int, slip: float = chosen.ODOMETRY) -> None:
        super().__init__(motion.states, motion.rates, motion.speeds)
        self.step = moving(motion.states, motion.rates, places, slip)
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
