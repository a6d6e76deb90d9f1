"""A procedurally painted road as seen from a drone: `sim:aerial`.

One image column is one frame step, about 0.25 m of road. The lane dashes repeat exactly every `DASH_PERIOD`
frames and the chevrons every `CHEVRON_PERIOD`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.simulate.route import Random, SimulatedRoute, choice, option, rgb
from dejavu_torch.types import expect

DASH_PERIOD = 93
CHEVRON_PERIOD = 171
VIEW = 64  # the camera sees VIEW x VIEW image pixels
MARGIN = 8  # columns before the first and after the last view, for yaw
HEIGHT = 96  # rows of the painted image; the camera follows the middle one
TILES = (997, 1009)  # columns of the two repeating tiles; coprime, so each pair of phases is unique
LONGEST = {"once": 2**17, "repeat": math.lcm(*TILES)}  # frames, by ground
PLAIN = 9  # rows from the middle of the view to the edge of the plain road in tiles: over a cell of HOG

ROAD = 40.0  # image row of the road's centre
HALF, LANE = 14.0, 6.3  # rows from the road's centre to its edge, to the centre of a lane
SUN = (0.75, -0.66)  # direction towards the sun, (x, y)

WHITE, GRAVEL, GLASS, DARK = "edebe0", "998f7a", "1a212b", "0d0f12"  # colours, rrggbb
ASPHALT, MEADOW = "69696b", "597036"
ROOFS = ("99452e", "7a3d2e", "5c5e66", "856b54")
LEAVES = ("2e5c1f", "3d6626", "4f5e24", "266633", "47612b")
PAINTS = ("e6e6e8", "b81a1a", "1f3880", "1a1a1f", "9ea3ab", "d4b329", "266161")
CROPS = (("4d6e2b", 0.20), ("ad9459", 0.10), ("755940", 0.20), (MEADOW, 0.0), ("918052", 0.15))
PLOTS = ("trees", "trees", "trees", "bushes", "bushes", "house", "house", "lane", "pond", "parking")


class Canvas(NamedTuple):
    """Pixels (3,h,w) to paint in place, at column x and y rows below the road's centre, with fine grain."""

    pixels: Tensor
    grain: Tensor
    x: Tensor
    y: Tensor
    scale: int  # canvas pixels per image pixel
    sun: tuple[float, float] = SUN

    @staticmethod
    def over(pixels: Tensor, scale: int, random: Random) -> Canvas:
        y, x = ((torch.arange(n) + 0.5) / scale for n in pixels.shape[1:])
        grain = random.texture(len(y), len(x), 5.0 * scale)
        return Canvas(pixels, grain, x, y[:, None] - ROAD, scale)

    @property
    def top(self) -> float:
        """The first row's upper edge."""
        return float(self.y[0]) - 0.5 / self.scale

    def near(self, x: float, y: float, reach: float = 45.0, turn: float = 0.0) -> Canvas:
        """The square within reach of (x, y), in coordinates relative to that point, rotated by radians."""
        rows, columns = (
            slice(*(max(0, math.floor((at + side * reach) * self.scale)) for side in (-1, 1)))
            for at in (y - self.top, x)
        )
        pixels, grain = self.pixels[:, rows, columns], self.grain[rows, columns]
        dx, dy, c, s = self.x[columns] - x, self.y[rows] - y, math.cos(turn), math.sin(turn)
        return Canvas(pixels, grain, c * dx + s * dy, c * dy - s * dx, self.scale, self.sun)

    def fill(self, distance: Tensor, colour: str, shade: Tensor | float = 1.0, alpha: float = 1.0) -> None:
        """Blend in colour * shade at negative distances (in image pixels), antialiased."""
        cover = (0.5 - self.scale * distance).clamp(0, 1) * alpha
        self.pixels.add_(cover * (rgb(colour) * shade - self.pixels))

    def box(self, x: float, y: float, length: float, width: float, corner: float = 0.0) -> Tensor:
        """Signed distance to a rounded rectangle around (x, y)."""
        a, b = (self.x - x).abs() - length / 2 + corner, (self.y - y).abs() - width / 2 + corner
        return torch.hypot(a.clamp(min=0), b.clamp(min=0)) + torch.maximum(a, b).clamp(max=0) - corner

    def blob(self, radius: float, random: Random) -> Tensor:
        """Approximate signed distance to an irregular disc around the origin."""
        angle = torch.atan2(self.y, self.x)
        bumps = sum(0.09 * torch.sin(k * angle + random.uniform(0, 2 * math.pi)) for k in (2, 3, 5))
        return torch.hypot(self.x, self.y) - radius * (1 + bumps)


def paint_tree(
    canvas: Canvas,
    random: Random,
    x: float,
    y: float,
    radius: float,
    leaves: Sequence[str] = LEAVES,
    cover: float = 1.0,
) -> None:
    """A round tree; cover is below 1 with fewer leaves."""
    p, fall = canvas.near(x, y, 2 * radius), 0.75 * radius
    p.fill(torch.hypot(p.x + fall * p.sun[0], p.y + fall * p.sun[1]) - radius, DARK, alpha=0.55 * cover)
    light = 1 + 0.38 * (p.x * p.sun[0] + p.y * p.sun[1]) / radius + 0.22 * p.grain
    p.fill(p.blob(radius, random), random.pick(leaves), light, cover)


def _paint_house(canvas: Canvas, random: Random, x: float, y: float) -> None:
    turn, roof = random.uniform(-0.15, 0.15), random.pick(ROOFS)
    length, width = random.uniform(30, 46), random.uniform(22, 28)
    chimney = length * random.uniform(-0.35, 0.35)
    paint_house(canvas.near(x, y, turn=turn), roof, length, width, chimney)


def paint_house(
    p: Canvas,
    roof: str,
    length: float,
    width: float,
    chimney: float,
    slopes: tuple[float, float] = (1.2, 0.78),
) -> None:
    """A house in the middle of a canvas, along its x; slopes: the light on the two sides of its roof."""
    p.fill(p.box(-7 * p.sun[0], -7 * p.sun[1], length, width), DARK, alpha=0.6)
    shade = torch.where(p.y < 0, *slopes) + 0.05 * torch.sin(2.6 * p.y) + 0.05 * p.grain
    p.fill(p.box(0, 0, length, width), roof, shade)
    p.fill(p.box(0, 0, length, 0.9), roof, 1.45)
    p.fill(p.box(chimney - 2, -2, 5, 3), DARK, alpha=0.5)
    p.fill(p.box(chimney, -4, 3.2, 3.2), GRAVEL)


def paint_car(
    canvas: Canvas,
    random: Random,
    x: float,
    y: float,
    heading: int,
    lorry: bool = False,
    turn: float = 0.0,
) -> None:
    """A car or lorry; heading is +1 towards higher columns, else -1, before the turn in radians."""
    p, paint = canvas.near(x, y, 26, turn + random.uniform(-0.02, 0.02)), random.pick(PAINTS)
    length, width, fall = (44.0, 9.6, 3.0) if lorry else (random.uniform(16, 20), 7.6, 1.6)
    p.fill(p.box(-fall * p.sun[0], -fall * p.sun[1], length + 0.6, width + 0.6, 2), DARK, alpha=0.65)
    if lorry:
        p.fill(p.box(-5 * heading, 0, 34, width, 0.6), random.pick(PAINTS), 1 + 0.05 * p.grain)
        p.fill(p.box(17.5 * heading, 0, 9, width - 0.6, 1.5), paint)
        p.fill(p.box(20.8 * heading, 0, 1.8, width - 2, 0.6), GLASS)
    else:
        p.fill(p.box(0, 0, length, width, 2.4), paint, 1 - 0.03 * p.y)
        p.fill(p.box(-0.8 * heading, 0, 0.62 * length, width - 1.4, 1.6), GLASS)
        p.fill(p.box(-1.0 * heading, 0, 0.34 * length, width - 2.0, 1.0), paint, 1.08)


def _paint_fields(canvas: Canvas, random: Random, tone: Tensor) -> None:
    """Fields with crops on both sides, and the verge of the road."""
    for side in (-1, 1):
        x = random.uniform(-150, -50)
        while x < canvas.x[-1] + 60:  # each field overlaps the end of the previous one
            (colour, rows), length = random.pick(CROPS), random.uniform(110, 330)
            p, turned = (canvas.near(x, 0, length + 60, turn) for turn in (0.0, random.uniform(-1.2, 1.2)))
            furrow = torch.sin(turned.x / random.uniform(0.7, 1.1) + 0.45 * p.grain)
            beyond, border = -side * p.y, random.uniform(-0.6, 0.6) * p.y - p.x
            p.fill(torch.maximum(border, beyond), colour, 1 + rows * furrow + 0.11 * p.grain)
            p.fill(torch.maximum(border.abs() - 1.5, beyond), MEADOW, 0.75 + 0.2 * p.grain)
            x += length
    canvas.pixels.mul_(1 + 0.09 * tone)
    canvas.fill(canvas.y.abs() - HALF - 5 - 1.2 * tone, MEADOW, 1 + 0.16 * canvas.grain + 0.07 * tone)
    canvas.fill(canvas.y.abs() - HALF - 1.2 - 0.5 * canvas.grain, GRAVEL, 1 + 0.12 * canvas.grain)


def _paint_plot(canvas: Canvas, random: Random, kind: str, x: float, side: int) -> None:
    """The flat parts of a plot next to the road."""
    if kind == "lane":
        p = canvas.near(x, 0, 60, random.uniform(-0.25, 0.25))
        mouth = 6.5 + 5 * (3 - side * p.y / 7).clamp(0, 1) ** 2
        shape = torch.maximum(p.x.abs() - mouth, -side * p.y)
        p.fill(shape, random.pick((ASPHALT, GRAVEL)), 1 + 0.09 * p.grain)
    elif kind == "pond":
        p = canvas.near(x, side * random.uniform(32, 38))
        shore = p._replace(x=0.6 * p.x).blob(random.uniform(11, 14), random)
        p.fill(shore - 2, GRAVEL, 0.8 + 0.1 * p.grain)
        p.fill(shore, "29454f", 1 + 0.04 * p.grain - 0.02 * p.y)
    elif kind == "parking":
        p = canvas.near(x, side * (HALF + 6))
        p.fill(p.box(0, 0, 60, 14, 5), GRAVEL, 0.85 + 0.08 * p.grain)
    elif kind == "house":
        p = canvas.near(x, side * 40)
        p.fill(p.box(0, 0, 72, 42, 3) - p.grain, MEADOW, 1.1 + 0.1 * p.grain)
        p.fill(p.box(24, -side * 12, 8, 30), GRAVEL, 1 + 0.07 * p.grain)


def road_markings(columns: int, scale: int = 1) -> tuple[Tensor, Tensor]:
    """Coverage of the periodic markings, lane dashes and chevrons, at `scale` samples per pixel.

    Shape: two (HEIGHT * scale, columns * scale) float32 in [0,1].
    """
    y = (torch.arange(HEIGHT * scale) + 0.5)[:, None] / scale - ROAD
    x = torch.arange(columns * scale)
    dash, chevron = ((x % (period * scale) + 0.5) / scale for period in (DASH_PERIOD, CHEVRON_PERIOD))
    dashes = torch.maximum((dash - 40).abs() - 19, y.abs() - 1.0)
    slant = chevron - 48 + 1.1 * (y - LANE).abs()  # constant along the edges of an arrow towards +x
    chevrons = torch.maximum(((slant.abs() - 10).abs() - 2.4) / 1.5, (y - LANE).abs() - 4.6)
    return (0.5 - scale * dashes).clamp(0, 1), (0.5 - scale * chevrons).clamp(0, 1)


def _paint_road(canvas: Canvas, random: Random, tone: Tensor, lanes: list[tuple[float, int]]) -> None:
    """The carriageway with repairs, cracks and markings; side lanes (x, side) interrupt the edge line."""
    speckle, half = random.normal(*tone.shape), canvas.y.abs() - HALF
    tracks = torch.cos((canvas.y.abs() - LANE) * 0.98)  # worn by wheels
    canvas.fill(half, ASPHALT, 1 + 0.05 * speckle + 0.05 * tone + 0.035 * tracks)
    x = 0.0
    while (x := x + random.uniform(20, 110)) < canvas.x[-1]:
        y, length = random.uniform(-11, 11), random.uniform(8, 46)
        p = canvas.near(x, y, 26)
        within = (p.y + y).abs() - HALF
        if random.uniform(0, 1) < 0.4:
            repair = p.box(0, 0, length, random.uniform(4, 9), 0.5)
            p.fill(torch.maximum(repair, within), ASPHALT, random.pick((0.68, 0.78, 1.16)) + 0.06 * p.grain)
        else:
            slant, wave = random.uniform(-0.6, 0.6), random.uniform(3, 6)
            bend = slant * p.x + 1.6 * torch.sin(p.x / wave) + 0.7 * p.grain
            crack = torch.maximum((p.y + bend).abs() - 0.45, torch.hypot(p.x, p.y) - length / 2)
            p.fill(torch.maximum(crack, within), DARK, 2.5, alpha=0.8)
    edges = (half + 1.6).abs() - 0.65
    for x, side in lanes:
        edges = edges + 9.0 * ((canvas.x - x).abs() < 13) * (side * canvas.y > 0)
    wear = (1 + 0.05 * speckle + 0.04 * tone).clamp(0, 1.05)
    canvas.fill(edges, WHITE, wear, 0.85)
    for cover in road_markings(len(canvas.x) // canvas.scale, canvas.scale):
        canvas.fill((0.5 - cover) / canvas.scale, WHITE, wear, 0.92)


def paint_route(frames: int, seed: int = 0) -> Tensor:
    """Paint the route from above without traffic; the seed determines all but the markings.

    Shape: (3, HEIGHT, frames + VIEW + 2 * MARGIN) float32 in [0,1].
    """
    random, scale, columns = Random("route", seed), 2, frames + VIEW + 2 * MARGIN
    canvas = Canvas.over(torch.zeros(3, HEIGHT * scale, columns * scale), scale, random)
    tone = random.texture(HEIGHT * scale, columns * scale, 90.0 * scale)
    plots: list[tuple[str, float, int]] = []
    for side in (-1, 1):
        x = random.uniform(0, 40)
        while x < columns:
            plots.append((random.pick(PLOTS), x, side))
            x += random.uniform(60, 100)
    _paint_fields(canvas, random, tone)
    for kind, x, side in plots:
        _paint_plot(canvas, random, kind, x, side)
    _paint_road(canvas, random, tone, [(x, side) for kind, x, side in plots if kind == "lane"])
    for kind, x, side in plots:
        count = {"trees": random.pick((2, 5, 12)), "bushes": 12, "house": 4}.get(kind, 0)
        for _ in range(count):
            radius = random.uniform(6, 12) if kind == "trees" else random.uniform(2, 4.5)
            across = HALF + 4 + radius + random.uniform(0, 34 - radius)
            paint_tree(canvas, random, x + random.uniform(-35, 35), side * across, radius)
        if kind == "house":
            _paint_house(canvas, random, x, side * random.uniform(36, 42))
        if kind == "parking":
            for place in (-14, 12)[: random.pick((1, 2))]:
                paint_car(canvas, random, x + place, side * (HALF + 6.5), side)
    return F.avg_pool2d(canvas.pixels.clamp(0, 1), scale)


@lru_cache(1)  # shared by all flights of a seed
def paint_tiles(seed: int = 0) -> tuple[Tensor, Tensor]:
    """Paint the two repeating tiles of ground, above and below the middle of the view: each has half of a
    plain road, the same in every column, and the roadside of a route of its own.

    Shape: two (3, HEIGHT / 2, TILES[k]) float32 in [0,1], row 0 nearest to the middle.
    """
    tiles = []
    for side, period in enumerate(TILES):
        edge = round(ROAD + HALF)
        roadside = paint_route(period, 2 * seed + side)[:, edge : edge + HEIGHT // 2 - PLAIN, :period]
        road = rgb(ASPHALT).repeat(1, PLAIN, 1)
        road[:, PLAIN - 3] = rgb(WHITE)[:, 0]  # the edge line
        tiles.append(torch.cat([road.expand(-1, -1, period), roadside], 1))
    return tiles[0], tiles[1]


@dataclass(eq=False)
class AerialRoad(SimulatedRoute):
    """A flight along a painted road, one image column per frame: `sim:aerial`.

    Frame i of all flights of a seed is centred on the same column, so place i is frame i. Each flight has its
    own traffic, light, drift, yaw and sensor noise; flight 0, the reference, is steadier than the others.

    Args:
        seed: selects the route, at least 0.
        traverse: selects the flight, at least 0; 0 is the reference.
        frames: number of frames, 1 to 131072; with ground="repeat" to 1005973, the tiles' common period.
        size: height and width of a frame in pixels, 16 to 256; it always shows VIEW x VIEW image pixels.
        noise: standard deviation of the sensor noise, 0 to 1; white is 1.
        drift: maximal sideways drift, 0 to 8 image pixels.
        yaw: maximal rotation of the camera, 0 to 5 degrees.
        ground: "once": only the lane dashes and chevrons repeat. "repeat": the upper half of the view repeats
            every `TILES[0]` frames, the lower every `TILES[1]`, without traffic: two phases identify a place.

    Example:
        >>> AerialRoad(traverse=1, frames=3)[:].shape
        torch.Size([3, 3, 64, 64])
    """

    seed: int = option(0, 0)
    traverse: int = option(0, 0)
    frames: int = option(3072, 1, LONGEST["repeat"])
    size: int = option(64, 16, 256)
    noise: float = option(0.025, 0, 1)
    drift: float = option(3.0, 0, 8)
    yaw: float = option(1.5, 0, 5)
    ground: str = choice("once", "repeat")

    kind = "aerial"

    def __post_init__(self) -> None:
        super().__post_init__()
        expected = f"1 <= frames <= {LONGEST[self.ground]}, with ground=repeat {LONGEST['repeat']}"
        expect(self.frames <= LONGEST[self.ground], expected, f"{self.name} has frames={self.frames}")
        self.length, self.places = self.frames, torch.arange(self.frames, dtype=torch.float64)
        random, swing = Random("flight", self.seed, self.traverse), 1.0 if self.traverse else 0.4
        looks = [random.pick(values) for values in ((0.78, 0.84, 1.16), (0.86, 1.16), (-0.06, 0.06))]
        level, gamma, tint = looks if self.traverse else (1.0, 1.0, 0.0)
        self._drift = self.drift * swing * random.wander(self.frames)
        self._yaw = math.radians(self.yaw) * swing * random.wander(self.frames)
        warm = tint + 0.03 * random.wander(self.frames)
        balance = torch.stack([1 + warm, torch.ones_like(warm), 1 - warm], 1)
        self._gain = (balance * level * (1 + 0.12 * swing * random.wander(self.frames))[:, None]).float()
        self._gamma = (gamma + 0.06 * swing * random.wander(self.frames)).float()

    @cached_property
    def _scene(self) -> Tensor:
        """The painted route with this flight's traffic, (3, HEIGHT, W)."""
        image, random = paint_route(self.length, self.seed), Random("traffic", self.seed, self.traverse)
        canvas = Canvas.over(image, 1, random)
        for heading in (-1, 1):
            x = random.uniform(0, 200)
            while x < image.shape[2]:
                y, lorry = heading * LANE + random.uniform(-0.8, 0.8), random.uniform(0, 1) < 0.25
                paint_car(canvas, random, x, y, heading, lorry)
                x += random.uniform(90, 600)
        return image.clamp_(0, 1)

    @cached_property
    def _tiles(self) -> list[Tensor]:
        """The tiles (3, HEIGHT, P + margins), mirrored at the middle, so that samples do not mix them."""
        tiles = [torch.cat([tile.flip(1), tile], 1) for tile in paint_tiles(self.seed)]
        return [torch.cat([tile, tile[..., : VIEW + 2 * MARGIN]], 2) for tile in tiles]

    def _frames(self, at: Tensor) -> Tensor:
        fine = math.ceil(VIEW / self.size)  # a small frame averages samples one image pixel apart
        across = ((torch.arange(fine * self.size).double() + 0.5) / (fine * self.size) - 0.5) * VIEW
        down = across[:, None]
        c, s, drift = (curve[at, None, None] for curve in (self._yaw.cos(), self._yaw.sin(), self._drift))
        column = MARGIN + VIEW / 2 + c * across - s * down  # relative to the frame's first column
        row = HEIGHT / 2 + drift + s * across + c * down
        if self.ground == "once":
            seen = _sample(self._scene, at, column, row)
        else:
            tiles = zip(self._tiles, TILES, strict=True)
            upper, lower = (_sample(tile, at % period, column, row) for tile, period in tiles)
            seen = torch.where((row < HEIGHT / 2)[:, None], upper, lower)
        seen = F.avg_pool2d(seen, fine) * self._gain[at, :, None, None]
        seen = seen ** self._gamma[at, None, None, None]
        for frame, i in zip(seen, at.tolist(), strict=True):
            frame += self.noise * Random("noise", self.seed, self.traverse, i).normal(*frame.shape)
        return seen.clamp_(0, 1)


def _sample(image: Tensor, first: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """Samples of an image (3,H,W) at rows and, relative to each frame's first column, columns (B,h,w)."""
    height, width = image.shape[1:]
    column = first[:, None, None] + column
    grid = torch.stack([2 * column / width - 1, 2 * row / height - 1], -1).float()
    return F.grid_sample(image.expand(len(first), -1, -1, -1), grid, align_corners=False)
