"""Scenery of railways: periodic structures, textures, rails, waiting people.

Cross-sections are in metres from the camera, which looks along the centre of its track: x right, y up.
These values are frozen: results are measured on them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.simulate.route import Random, rgb
from dejavu_torch.data.simulate.sheets import FAR, Sheet, Thing

RAIL = -2.4  # height of the top of the rails, the datum of platforms
FOOT = RAIL - 0.2  # height of the flat track bed, with sleepers and rails painted on it
GAUGE = 1.5  # between the centres of the rails
STATION = 150.0  # length of a platform

Range = tuple[float, float]


class Structure(NamedTuple):
    """Objects that repeat along the track in [start, stop) with a period; all in metres."""

    name: str
    period: float
    start: float
    stop: float

    @property
    def at(self) -> Tensor:
        """The position of each object, (n,) float64 metres."""
        count = int((self.stop - self.start) / self.period - 1e-9) + 1
        return self.start + self.period * torch.arange(count, dtype=torch.float64)


class World(NamedTuple):
    """A railway: its sheets, nearest first, what repeats, and the start of each station's platform."""

    sheets: dict[str, Sheet]
    structures: tuple[Structure, ...]
    stations: tuple[float, ...]

    def away(self, at: Tensor, margin: float) -> Tensor:
        """The positions farther than `margin` from every platform."""
        clear = [not any(s - margin < x < s + STATION + margin for s in self.stations) for x in at.tolist()]
        return at[torch.tensor(clear)]


def periodic_segments(
    random: Random, name: str, route: float, period: Range, length: Range, gap: Range
) -> Iterator[Structure]:
    """Segments of the route, each with its own period, and gaps between them, drawn from these ranges."""
    start = random.uniform(5, 5 + gap[1])
    while start < route:
        stop = min(start + random.uniform(*length), route + FAR)
        yield Structure(name, round(random.uniform(*period), 2), round(start, 2), round(stop, 2))
        start = stop + random.uniform(*gap)


def rails(sheet: str, middle: float, route: float) -> Iterator[Thing]:
    """The two rails of a track on a sheet of ground."""
    for x in (middle - GAUGE / 2, middle + GAUGE / 2):
        yield Thing(sheet, x - 0.09, x + 0.09, "3d2f28", -FAR, route + 3 * FAR)
        yield Thing(sheet, x - 0.035, x + 0.035, "c3c6cc", -FAR, route + 3 * FAR)


def people(world: World, random: Random, groups: int, foot: float, neck: float) -> Iterator[Thing]:
    """Groups of people waiting along every platform; foot and neck in metres on their sheet."""
    for start in world.stations:
        for _ in range(groups):
            at = random.scattered(start + 3, start + STATION - 10, (4, 40))
            coat = random.pick(("1f2a44", "7a1f22", "d8d2c4", "2f3a2c", "b0762a"))
            yield Thing("people", foot, neck, coat, at, 0.4, 0.5)
            yield Thing("people", neck, neck + 0.3, "c99a7a", at, 0.2, 0.25)


def broad(random: Random, rows: int, columns: int, cell: float) -> Tensor:
    """Smooth noise (V,S), interpolated from a quarter of its size."""
    small = random.texture(rows // 4 + 1, columns // 4 + 1, cell / 4)
    return F.interpolate(small[None, None], (rows, columns), mode="bilinear")[0, 0]


def mottled(random: Random, colour: str, rows: int, columns: int, rough: float, patchy: float) -> Tensor:
    """A colour with fine grain and larger patches, (3,V,S)."""
    grain = rough * random.normal(rows, columns) + patchy * broad(random, rows, columns, 24.0)
    return rgb(colour) * (1 + grain)


def solid(pixels: Tensor) -> Tensor:
    """An opaque texture of colours (3,V,S)."""
    return torch.cat([pixels.clamp(0, 1), torch.ones_like(pixels[:1])])
