"""What stands where along the two railways: textures, and structures with their periods.

Cross-sections are in metres from the camera, which looks along the middle of its track: x to the right,
y up. These figures are frozen: results are judged on them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.simulate.paint import Random
from dejavu_torch.data.simulate.sheets import FAR, Sheet, Thing

RAIL = -2.4  # where the top of the rails would be: platforms are measured from here
FOOT = RAIL - 0.2  # the track bed, flat, with sleepers and rails painted on it
GAUGE = 1.5  # from the middle of one rail to that of the other
STATION = 150.0  # metres of platform


class Structure(NamedTuple):
    """Something that repeats along a stretch of the track.

    name: what it is. period: metres. start, stop: metres; the first one stands at start, none at stop
    or beyond.
    """

    name: str
    period: float
    start: float
    stop: float

    @property
    def at(self) -> Tensor:
        """Where each one stands, (n,) float64 metres."""
        count = int((self.stop - self.start) / self.period - 1e-9) + 1
        return self.start + self.period * torch.arange(count, dtype=torch.float64)


class World(NamedTuple):
    """A railway: its sheets nearest first, what repeats, where each station's platform begins."""

    sheets: dict[str, Sheet]
    structures: tuple[Structure, ...]
    stations: tuple[float, ...]


def stretches(
    random: Random,
    name: str,
    route: float,
    period: tuple[float, float],
    length: tuple[float, float],
    gap: tuple[float, float],
) -> list[Structure]:
    """Stretches with a period each, drawn from these ranges, with gaps between them."""
    found, start = [], random.uniform(5, 5 + gap[1])
    while start < route:
        stop = min(start + random.uniform(*length), route + FAR)
        found.append(Structure(name, round(random.uniform(*period), 2), round(start, 2), round(stop, 2)))
        start = stop + random.uniform(*gap)
    return found


def scattered(random: Random, start: float, stop: float, gap: tuple[float, float]) -> Tensor:
    """Positions without a period, (n,) float64 metres, at least one."""
    found = [start + random.uniform(0, gap[1])]
    while (after := found[-1] + random.uniform(*gap)) < stop:
        found.append(after)
    return torch.tensor(found, dtype=torch.float64)


def rgb(colour: str) -> Tensor:
    """rrggbb -> (3,1,1) in [0,1]."""
    return torch.tensor(list(bytes.fromhex(colour))).view(3, 1, 1) / 255


def solid(pixels: Tensor) -> Tensor:
    """An opaque texture of colours (3,V,S)."""
    return torch.cat([pixels.clamp(0, 1), torch.ones_like(pixels[:1])])


def broad(random: Random, rows: int, columns: int, cell: float) -> Tensor:
    """Smooth noise painted at a quarter of the size, (V,S)."""
    small = random.texture(rows // 4 + 1, columns // 4 + 1, cell / 4)
    return F.interpolate(small[None, None], (rows, columns), mode="bilinear")[0, 0]


def mottled(random: Random, colour: str, rows: int, columns: int, rough: float, patchy: float) -> Tensor:
    """Colour with a fine grain and larger patches, (3,V,S)."""
    grain = rough * random.normal(rows, columns) + patchy * broad(random, rows, columns, 24.0)
    return rgb(colour) * (1 + grain)


def place_on(image: Tensor, colour: Tensor, cover: Tensor) -> Tensor:
    """Blend colour (3,..) over an image (3,V,S) where cover (V,S) is 1."""
    return (colour - image).mul_(cover).add_(image)


def ground(
    random: Random, columns: int, half: float, cell: tuple[float, float], tracks: list[float]
) -> Tensor:
    """Ballast under the tracks, a path beside them and grass beyond, (4,V,S); edge a is the left one."""
    rows = round(2 * half / cell[0])
    x = ((torch.arange(rows) + 0.5) * cell[0] - half)[:, None]
    rim = 0.35 * broad(random, rows, columns, 12.0)
    image = mottled(random, "5d6b33", rows, columns, 0.10, 0.14)
    dry = (broad(random, rows, columns, 90.0) - 0.6).clamp(0, 1)
    image = place_on(image, rgb("9a8a55"), dry)
    off = torch.stack([(x - track).abs() for track in tracks]).amin(0)
    gravel = mottled(random, "8a8074", rows, columns, 0.16, 0.06)
    image = place_on(image, gravel, ((3.1 - off + rim) / 0.4).clamp(0, 1))
    ballast = mottled(random, "6d6258", rows, columns, 0.22, 0.05)
    image = place_on(image, ballast, ((1.75 - off + 0.3 * rim) / 0.2).clamp(0, 1))
    weeds = (broad(random, rows, columns, 30.0) - 1.3).clamp(0, 0.8)
    return solid(place_on(image, rgb("55662c"), weeds))


def growth(
    random: Random,
    columns: int,
    height: float,
    cell: tuple[float, float],
    leaves: tuple[str, str],
    gaps: float,
) -> Tensor:
    """Bushes or trees seen from the side, (4,V,S), row 0 at the foot; gaps is the part that stays bare."""
    rows = round(height / cell[0])
    y = ((torch.arange(rows) + 0.5) * cell[0])[:, None]
    crowns = random.texture(1, columns, 0.9 * height / cell[1])[0]
    clearing = random.texture(1, columns, 60 / cell[1])[0]
    bare = clearing.quantile(gaps) if gaps else clearing.min() - 1
    top = height * (0.55 + 0.2 * crowns) * ((clearing - bare) / 0.15).clamp(0, 1)
    ragged = random.texture(rows, columns, 5.0)
    alpha = ((top - y + 0.07 * height * ragged) / (2 * cell[0])).clamp(0, 1)
    kind = (0.5 + 0.5 * random.texture(1, columns, 14 / cell[1])).clamp(0, 1)
    colour = rgb(leaves[0]) + kind * (rgb(leaves[1]) - rgb(leaves[0]))
    light = 0.55 + 0.5 * (y / top.clamp(min=0.5)).clamp(0, 1) + 0.22 * random.texture(rows, columns, 9.0)
    return torch.cat([(colour * light).clamp(0, 1) * alpha, alpha[None]])


def houses(random: Random, texture: Tensor, cell: tuple[float, float], at: Tensor) -> None:
    """Buildings with rows of windows painted into a side texture, in place."""
    for s in at.tolist():
        width, height = random.uniform(9, 34), random.uniform(4, 10)
        colour = rgb(random.pick(("c9bda3", "a2553f", "d8d4cc", "8a8f98", "c48f5a", "e2d9b8")))
        rows, first, last = round(height / cell[0]), round(s / cell[1]), round((s + width) / cell[1])
        part = texture[:, :rows, first:last]
        if part.shape[2] == 0:
            continue
        y = ((torch.arange(part.shape[1]) + 0.5) * cell[0])[:, None]
        x = (torch.arange(part.shape[2]) + 0.5) * cell[1]
        pitch = random.uniform(2.4, 4.5)
        window = ((x % pitch) < 0.5 * pitch) & ((y % 3.0) > 1.1) & ((y % 3.0) < 2.5) & (y < height - 1.2)
        roof = y > height - 1.0
        wall = torch.where(window, rgb("2b343f"), colour) * torch.where(roof, 0.45, 1.0)
        part[:3], part[3] = wall, 1.0


def concrete(random: Random, size: float, columns: int, cell: tuple[float, float], colour: str) -> Tensor:
    """A tunnel's lining with stains that run down it, (4,V,S)."""
    rows = max(2, round(size / cell[0]))
    image = mottled(random, colour, rows, columns, 0.05, 0.10)
    streaks = random.texture(1, columns, 6.0) + 0.4 * random.texture(rows, columns, 10.0)
    damp = (random.texture(1, columns, 160.0) - 0.2).clamp(0, 1)
    image = image * (1 - 0.5 * ((streaks - 0.8).clamp(0, 1) * damp))
    tone = 1 + 0.22 * random.texture(1, columns, 300.0).clamp(-2, 2)
    return solid(image * tone)


def rails(sheet: Sheet, tracks: list[float], route: float, left: float) -> None:
    """Two rails per track on a ground sheet whose first edge lies at x = left."""
    start, length = torch.tensor([-FAR]), route + 3 * FAR
    for track in tracks:
        for side in (-GAUGE / 2, GAUGE / 2):
            x = track + side - left
            sheet.add(
                Thing(x - 0.09, x + 0.09, "3d2f28", start, length),
                Thing(x - 0.035, x + 0.035, "c3c6cc", start, length),
            )


def waiting(world: World, random: Random, groups: int, foot: float, neck: float) -> None:
    """Groups of people, each in coats of one colour, along every platform.

    Args:
        foot, neck: where a coat begins and ends, metres from the lower edge of the sheet of people.
    """
    for start in world.stations:
        for _ in range(groups):
            at = scattered(random, start + 3, start + STATION - 10, (4, 40))
            coat = random.pick(("1f2a44", "7a1f22", "d8d2c4", "2f3a2c", "b0762a"))
            world.sheets["people"].add(
                Thing(foot, neck, coat, at, 0.4, 0.5), Thing(neck, neck + 0.3, "c99a7a", at, 0.2, 0.25)
            )
