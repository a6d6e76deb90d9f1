"""A procedurally painted ground from above, in rows and columns: `sim:terrain`.

Much of it repeats: furrows, roofs, lane dashes, rows of equal houses, of orchard trees and of parked cars.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise, product
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.grid import Grid
from dejavu_torch.data.simulate.aerial import (
    ASPHALT,
    DARK,
    GRAVEL,
    LEAVES,
    ROOFS,
    SUN,
    WHITE,
    Canvas,
    paint_car,
    paint_house,
    paint_tree,
)
from dejavu_torch.data.simulate.route import Random, rgb
from dejavu_torch.memory import check_room, in_float32, in_one_thread
from dejavu_torch.places.rectangles import Ground
from dejavu_torch.types import expect

PIXELS = 4  # per metre
SMALLEST, MOST = 32, 2048  # metres
ROOM, ROOM_OF_BLOCK = 40.0, 5e7  # bytes per pixel while it is painted, and those of one block between roads
VERGE = 7.0  # pixels of grass beside a road
DASH = 48.0  # pixels from a lane dash to the next
SAME = 0.955  # of the fine grain, what all flights share
BEND = 0.7  # pixels, standard deviation of the error of registration, which is at most three times as much
NOISE = 0.02  # of the sensor; white is 1
STRIP = 256  # rows that are photographed together
BLOCKS = ("farm", "farm", "farm", "farm", "village", "village", "wood", "yard")
PARCELS = ("crop", "crop", "crop", "crop", "meadow", "orchard")
FURROWS = (0.09, 0.07, 0.1, 0.07)  # how much they show, by crop
HALLS = ("8d9196", "a3a49f", "6f7f8a")
# beds, pools and sheds of gardens
THINGS = (26, 20, "6b5440", 0.25), (30, 16, "5d9aa8", 0.02), (17, 13, "856b54", 0.06)
Box = Sequence[float]  # left, top, right, bottom


class Season(NamedTuple):
    """Colours of a flight; cover is how dense leaves are."""

    grass: str
    cover: float
    leaves: Sequence[str]
    crops: Sequence[str]


SEASONS = [
    Season(grass, cover, leaves.split(), crops.split())
    for grass, cover, leaves, crops in (
        ("5f7638", 1.0, " ".join(LEAVES), "4d6e2b b39a5c 7d6247 87923f"),  # of the reference
        ("76753f", 0.9, "7a5c26 8c6a2b 6b5a28 8f4f24 5f5a2e", "8a7a45 a8966b 6b5440 6f7a3a"),
        ("6a8442", 0.85, "4f7a2c 5d8434 6a8a3c 48702c 77884a", "5f8534 b5a93a 80664a 6f8f3f"),
        ("6b6c48", 0.75, "6b5a44 5a5648 75664e 4d4436 80735c", "6f6a45 857556 5e4c3c 5d6d3c"),
    )
]


class Road(NamedTuple):
    """A road from left to right that bends like a sine."""

    at: float
    swing: float
    wave: float
    phase: float
    half: float  # of its width

    def middle(self, x: Tensor) -> Tensor:
        return self.at + self.swing * torch.sin(x / self.wave + self.phase)

    def point(self, x: float, beside: float) -> tuple[float, float, float]:
        """A place of the road, or so far below it, and the road's direction in radians."""
        turn = math.atan(self.swing / self.wave * math.cos(x / self.wave + self.phase))
        return x, float(self.middle(torch.tensor(x))) + beside, turn


class Block(NamedTuple):
    """The ground between two roads from left to right and two from top to bottom."""

    top: Road
    bottom: Road
    left: Road
    right: Road

    def edge(self, x: Tensor, y: Tensor) -> Tensor:
        """Signed distance to the verges of the roads, negative inside."""
        ways = ((road.middle(at), road.half) for road, at in zip(self, (x, x, y, y), strict=True))
        (top, above), (bottom, below), (left, before), (right, after) = ways
        down = torch.maximum(top + above - y, y - bottom + below)
        return torch.maximum(down, torch.maximum(left + before - x, x - right + after)) + VERGE


@dataclass
class Terrain:
    """What is painted where, by `random`, which is the same in all flights, and by `later` what differs."""

    canvas: Canvas
    season: Season
    random: Random
    later: Random
    tall: list[Callable[[], None]] = field(default_factory=list)  # casts shadows on all that is flat

    def cover(self, block: Block, box: Box, colour: str, light: float, rough: float) -> None:
        """Fill a block with one colour."""
        x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
        p = self.canvas.near(x, y, max(box[2] - box[0], box[3] - box[1]) / 2 + 30)
        p.fill(block.edge(p.x + x, p.y + y), colour, light + rough * p.grain)

    def trees(self, block: Block, x: Tensor, y: Tensor, low: float, high: float) -> None:
        """Those trees that stand in a block, of radii in this range."""
        for at in torch.stack([x, y], -1)[block.edge(x, y) < -low].tolist():
            radius = self.random.uniform(low, high)
            look = at[0], at[1], radius, self.season.leaves, self.season.cover
            self.tall.append(partial(paint_tree, self.canvas, self.random, *look))

    def scatter(self, block: Block, box: Box, count: int, low: float, high: float) -> None:
        x, y = torch.rand(2, count, generator=self.random.generator)
        self.trees(block, box[0] + x * (box[2] - box[0]), box[1] + y * (box[3] - box[1]), low, high)

    def wood(self, block: Block, box: Box, turn: float) -> None:
        self.cover(block, box, "454a2a", 0.9, 0.15)
        self.scatter(block, box, int((box[2] - box[0]) * (box[3] - box[1]) / 240), 7, 16)

    def farm(self, block: Block, box: Box, turn: float) -> None:
        """Parcels of crops, grass or fruit trees, with rows of trees on some of their borders."""
        sides, r = (box[2] - box[0], box[3] - box[1]), self.random
        if (size := max(sides)) > 520 or (size > 260 and r.uniform(0, 1) < 0.7):
            axis = int(sides[1] > sides[0])
            cut = box[axis] + r.uniform(0.35, 0.65) * sides[axis]
            for k in (axis + 2, axis):
                self.farm(block, [*box[:k], cut, *box[k + 1 :]], turn)
            return
        x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
        p, turned = (self.canvas.near(x, y, size, angle) for angle in (0.0, turn))
        inside = torch.maximum(turned.box(0, 0, sides[0] + 2, sides[1] + 2), block.edge(p.x + x, p.y + y))
        kind, along = r.pick(PARCELS), turn + r.pick((0.0, math.pi / 2)) + r.uniform(-0.1, 0.1)
        c, s = math.cos(turn), math.sin(turn)
        if kind == "crop":
            self.crop(x, y, size, along, inside)
        else:
            mown = 0.05 * torch.sin(self.canvas.near(x, y, size, along).x / 5)
            p.fill(inside, self.season.grass, 1 + mown + 0.12 * p.grain)
        if kind == "meadow":
            self.scatter(block, box, int(r.uniform(0, 9)), 8, 14)
            if r.uniform(0, 1) < 0.4:
                pond = p._replace(x=0.7 * (p.x - r.uniform(-40, 40)), y=p.y - r.uniform(-40, 40))
                shore = torch.maximum(pond.blob(r.uniform(24, 40), r), inside + 6)
                p.fill(shore - 4, GRAVEL, 0.8 + 0.1 * p.grain)
                p.fill(shore, "29454f", 1 + 0.05 * p.grain)
        if kind == "orchard":
            spacing, radius = r.uniform(19, 26), r.uniform(6, 8.5)
            a, b = torch.cartesian_prod(*(torch.arange(14 - n / 2, n / 2 - 8, spacing) for n in sides)).T
            a, b = torch.stack([a, b])[:, torch.rand(len(a), generator=r.generator) < 0.96]
            self.trees(block, x + c * a - s * b, y + s * a + c * b, radius, radius + 1)
        if r.uniform(0, 1) < 0.45:
            b = torch.arange(-sides[1] / 2, sides[1] / 2, r.uniform(13, 24))
            self.trees(block, x - c * sides[0] / 2 - s * b, y - s * sides[0] / 2 + c * b, 6, 11)

    def crop(self, x: float, y: float, reach: float, along: float, inside: Tensor) -> None:
        """A field with furrows, those at its ends across, and the tracks of tractors."""
        kind, pace = self.random.pick(range(len(FURROWS))), self.random.uniform(0.8, 1.3)
        if self.later.uniform(0, 1) < 0.12:  # another crop, or ploughed across
            kind = self.later.pick(range(len(FURROWS)))
            along += self.later.pick((0.0, math.pi / 2))
        p, colour = self.canvas.near(x, y, reach, along), self.season.crops[kind]
        furrow = torch.sin(torch.where(inside > -36, inside, p.x) / pace + 0.45 * p.grain)
        p.fill(inside, colour, 1 + FURROWS[kind] * furrow + 0.13 * p.grain)
        track = ((torch.remainder(p.x, 96) - 48).abs() - 4).abs() - 0.8
        p.fill(torch.maximum(track, inside + 36), colour, 0.7, 0.6)

    def village(self, block: Block, box: Box, turn: float) -> None:
        """A row of equal houses along the upper and the lower road, and their gardens."""
        self.cover(block, box, self.season.grass, 1.12, 0.1)
        r = self.random
        for road, side in ((block.top, 1), (block.bottom, -1)):
            roof, length, width = r.pick(ROOFS), r.uniform(40, 54), r.uniform(32, 42)
            pitch, back, x = length + r.uniform(28, 48), r.uniform(24, 40), box[0] + r.uniform(40, 70)
            while x < box[2] - 45:
                self.lot(*road.point(x, side * road.half), side, pitch, (box[3] - box[1]) / 2 - 14)
                x, y, turn = road.point(x, side * (road.half + back + width / 2))
                if float(block.edge(torch.tensor(x), torch.tensor(y))) < -18:
                    self.tall.append(partial(self.house, x, y, turn, roof, length, width))
                x += pitch
        self.scatter(block, box, int((box[2] - box[0]) / 8), 4, 10)

    def lot(self, x: float, y: float, turn: float, side: int, pitch: float, deep: float) -> None:
        """A garden with a hedge, a drive, beds and sheds, on a side of a road."""
        r, p = self.random, self.canvas.near(x, y, pitch + deep, turn)
        hedge = (p.x - pitch / 2).abs() - 2.2 - 0.9 * p.grain
        hedge = torch.maximum(hedge, (p.y - side * (deep + 12) / 2).abs() - deep / 2 + 6)
        p.fill(hedge, self.season.leaves[3], 0.9 + 0.2 * p.grain)
        p.fill(p.box(pitch / 2 - 13, side * 22, 11, 46), GRAVEL, 1.05 + 0.06 * p.grain)
        for far in (0.45, 0.65, 0.85):
            q = p._replace(x=p.x - r.uniform(-0.22, 0.22) * pitch, y=p.y - side * far * deep)
            length, width, colour, waves = r.pick(THINGS)
            shade = 1 + waves * torch.sin(1.4 * q.x) + 0.1 * q.grain
            if r.uniform(0, 1) < 0.6:
                q.fill(q.box(-2 * q.sun[0], -2 * q.sun[1], length, width), DARK, alpha=0.4)
                q.fill(q.box(0, 0, length, width, 2), colour, shade)

    def house(self, x: float, y: float, turn: float, roof: str, length: float, width: float) -> None:
        p = lit(self.canvas, turn).near(x, y, length / 2 + 30, turn)
        paint_house(p, roof, length, width, 0.22 * length, (1 - 0.3 * p.sun[1], 1 + 0.3 * p.sun[1]))

    def yard(self, block: Block, box: Box, turn: float) -> None:
        """A hall, and rows of parked cars."""
        self.cover(block, box, ASPHALT, 1.15, 0.05)
        wide, tall = (box[k + 2] - box[k] for k in (0, 1))
        x, y = box[0] + wide / 2, box[1] + tall / 2
        hall = x, y - tall / 6, 0.0, self.random.pick(HALLS), 0.6 * wide, 0.35 * tall
        self.tall.append(partial(self.house, *hall))
        for line in (y + 0.16 * tall, y + 0.16 * tall + 46):
            bays = self.canvas.near(x, line, wide)
            marks = (torch.remainder(bays.x, 11) - 5.5).abs() - 0.5
            bays.fill(torch.maximum(marks, bays.box(0, 0, 0.6 * wide, 40)), WHITE, alpha=0.7)
            for bay, lane in product(range(round(-0.3 * wide / 11) + 1, round(0.3 * wide / 11)), (-10, 10)):
                if self.later.uniform(0, 1) < 0.6:
                    self.car(self.canvas, x + 11 * bay, line + lane, math.pi / 2, 1)

    def car(self, canvas: Canvas, x: float, y: float, turn: float, heading: int, lorry: bool = False) -> None:
        self.tall.append(partial(paint_car, lit(canvas, turn), self.later, x, y, heading, lorry, turn))

    def road(self, canvas: Canvas, road: Road, others: list[Road]) -> None:
        """A road from left to right of a canvas, whose markings end at those it crosses, and its traffic."""
        rows = slice(*(max(0, int(road.at + side * (road.swing + 40))) for side in (-1, 1)))
        p = canvas._replace(pixels=canvas.pixels[:, rows], grain=canvas.grain[rows], y=canvas.y[rows])
        off, r, columns = p.y - road.middle(p.x), self.random, canvas.pixels.shape[2]
        out = off.abs() - road.half
        p.fill(out - 1.5 - 0.6 * p.grain, GRAVEL, 0.95 + 0.1 * p.grain)
        p.fill(out, ASPHALT, 1 + 0.04 * torch.cos(0.9 * (off.abs() - road.half / 2)) + 0.06 * p.grain)
        x = 0.0
        while (x := x + r.uniform(20, 130)) < columns:  # repairs
            x, y, turn = road.point(x, r.uniform(-0.6, 0.6) * road.half)
            patch = canvas.near(x, y, 30, turn)
            repair = patch.box(0, 0, r.uniform(8, 50), r.uniform(4, 10), 0.5)
            patch.fill(repair, ASPHALT, r.pick((0.7, 0.8, 1.2)), 0.8)
        at = torch.tensor(road.at)
        ways = torch.stack([(p.x - other.middle(at)).abs() - other.half for other in others]).amin(0)
        dashes = torch.maximum(off.abs() - 0.6, (torch.remainder(p.x, DASH) - DASH / 2).abs() - 9)
        p.fill(torch.maximum(dashes, 32 - ways), WHITE, alpha=0.85)
        p.fill(torch.maximum((out + 2).abs() - 0.5, 8 - ways), WHITE, alpha=0.7)
        if road.half > 15:
            stripes = torch.maximum((torch.remainder(off, 5) - 2.5).abs() - 1.2, out + 2)
            p.fill(torch.maximum(stripes, (ways - 16).abs() - 6), WHITE, 0.95, 0.8)
        for heading in (-1, 1):
            x = self.later.uniform(0, 300)
            while x < columns:
                lorry = self.later.uniform(0, 1) < 0.2
                self.car(canvas, *road.point(x, heading * road.half / 2), heading, lorry)
                x += self.later.uniform(100, 700)


def lit(canvas: Canvas, turn: float) -> Canvas:
    """A canvas whose sun is where it is for what is turned by radians."""
    (x, y), c, s = canvas.sun, math.cos(turn), math.sin(turn)
    return canvas._replace(sun=(c * x + s * y, c * y - s * x))


def roads(random: Random, side: int) -> list[Road]:
    """Roads that cross a square, the first and the last beyond it."""
    at, found = random.uniform(-420, -60), list[Road]()
    while not found or found[-1].at < side + 60:
        half = random.pick((14.0, 16.0, 18.0))
        found.append(Road(at, random.uniform(8, 26), random.uniform(130, 260), random.uniform(0, 6.3), half))
        at += random.uniform(310, 520)
    return found


@in_float32()
@in_one_thread()  # the rounding of sums depends on their number
def paint_ground(seed: int, traverse: int, metres: int) -> Tensor:
    """The picture of a flight, (3,H,W) uint8."""
    side, random, later = PIXELS * metres, Random("terrain", seed), Random("season", seed, traverse)
    season, sun = SEASONS[0], SUN
    if traverse:
        season, high, angle = later.pick(SEASONS[1:]), later.uniform(0.8, 1.2), later.uniform(-1.6, 0.1)
        sun = high * math.cos(angle), high * math.sin(angle)
    grain = SAME * random.texture(side, side, 8) + math.sqrt(1 - SAME**2) * later.texture(side, side, 8)
    x = torch.arange(side) + 0.5
    canvas = Canvas(rgb(season.grass).repeat(1, side, side), grain, x, x[:, None], 1, sun)
    canvas.pixels.mul_(1 + 0.12 * grain)
    ground, across, down = Terrain(canvas, season, random, later), roads(random, side), roads(random, side)
    kinds: list[str] = []
    for (top, bottom), (left, right) in product(pairwise(across), pairwise(down)):
        if not kinds:  # every kind, in any order
            kinds = [BLOCKS[i] for i in torch.randperm(len(BLOCKS), generator=random.generator)]
        block, box = Block(top, bottom, left, right), (left.at, top.at, right.at, bottom.at)
        getattr(ground, kinds.pop())(block, box, random.uniform(-0.3, 0.3))
    canvas.pixels.mul_(1 + 0.18 * random.texture(side, side, 64.0).clamp(-2, 2))
    turned = Canvas(canvas.pixels.transpose(1, 2), grain.T, x, x[:, None], 1, sun[::-1])
    for surface, own, others in ((canvas, across, down), (turned, down, across)):
        for road in own:
            ground.road(surface, road, others)
    for paint in ground.tall:
        paint()
    return photograph(canvas.pixels, later, float(traverse > 0))


def photograph(pixels: Tensor, later: Random, change: float) -> Tensor:
    """The ground (3,H,W) in a flight's light, with haze, clouds, errors of registration and noise, as uint8;
    without change in that of the reference."""
    side = pixels.shape[1]
    level, gamma, tint = later.uniform(0.85, 1.15), later.uniform(0.8, 1.25), later.uniform(-0.06, 0.06)
    level, gamma = (1 + change * (value - 1) for value in (level, gamma))
    gain = level * torch.tensor([1 + tint, 1.0, 1 - tint]).view(3, 1, 1)
    shade = 0.12 * later.texture(side, side, 280.0).clamp(-2, 2)
    bends = [BEND * change * later.texture(side, side, 400.0).clamp(-3, 3) for _ in range(2)]
    x, seen = torch.arange(side) + 0.5, torch.empty(3, side, side, dtype=torch.uint8)
    for start in range(0, side, STRIP):
        rows = slice(start, start + STRIP)
        at = torch.stack([x + bends[0][rows], x[rows, None] + bends[1][rows]], -1) * 2 / side - 1
        strip = F.grid_sample(pixels[None], at[None], padding_mode="border", align_corners=False)[0]
        strip = 0.25 * strip.mean(0) + 0.75 * strip
        strip = (strip * gain * (1 + shade[rows])).clamp(0, 1) ** gamma
        seen[:, rows] = (255 * (strip + NOISE * later.normal(*strip.shape)).clamp(0, 1)).round().byte()
    return seen


def open_terrain(
    seed: int = 0, traverse: int = 0, metres: int = 256, window: int = 64, stride: int = 4
) -> Grid:
    """Windows in rows and columns over a square of ground, with coordinates in metres.

    Args:
        seed: selects the ground. traverse: selects the flight, in its own season, light and traffic; 0 is the
            reference. metres: side of the square, 32 to 2048. window, stride: see `Grid`; pixels of 25 cm.

    Example:
        >>> ground = open_terrain(metres=32, stride=16)
        >>> ground.frame_shape, ground.layout.rows, ground.coordinates.values[0].tolist()
        ((3, 64, 64), 5, [8.0, 8.0])
    """
    name, side = f"sim:terrain?seed={seed}&traverse={traverse}&metres={metres}", PIXELS * metres
    expect(seed >= 0 and traverse >= 0, "seed >= 0 and traverse >= 0", name)
    expect(SMALLEST <= metres <= MOST, f"{SMALLEST} <= metres <= {MOST}", name)
    name += f"&window={window}&stride={stride}"
    expect(1 <= stride <= window <= side, f"1 <= stride <= window <= {side} pixels", name)
    check_room(ROOM * side**2 + ROOM_OF_BLOCK, name)
    where = Ground(unit="m", frame=f"sim:terrain?seed={seed}").scaled(1 / PIXELS, 1 / PIXELS)
    return Grid(paint_ground(seed, traverse, metres), window, stride, name=name, ground=where)
