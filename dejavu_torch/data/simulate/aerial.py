"""A road seen from a drone, painted procedurally: the built-in route.

One image column is one frame step, about 0.25 m of road. The lane dashes repeat exactly every
`DASH_PERIOD` frames and the chevrons every `CHEVRON_PERIOD`; everything else is found once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.simulate.paint import DARK, GRAVEL, ROAD, WHITE, Canvas, Random, house, tree, vehicle
from dejavu_torch.types import InputError, Traverse

DASH_PERIOD = 93
CHEVRON_PERIOD = 171
VIEW = 64  # the camera sees VIEW x VIEW image pixels
MARGIN = 8  # columns beyond the first and the last view, so that yaw never leaves the image
HEIGHT = 96  # rows of the painted image; the camera flies along the middle one

HALF, LANE = 14.0, 6.3  # rows from the road's middle to its edge, to a lane's middle
ASPHALT, MEADOW = "69696b", "597036"
CROPS = (("4d6e2b", 0.20), ("ad9459", 0.10), ("755940", 0.20), (MEADOW, 0.0), ("918052", 0.15))
PLOTS = ("trees", "trees", "trees", "bushes", "bushes", "house", "house", "lane", "pond", "parking")


def _paint_fields(canvas: Canvas, random: Random, tone: Tensor) -> None:
    """Fields on both sides, each with its crop and rows, and a grass verge along the road."""
    for side in (-1, 1):
        x = random.uniform(-150, -50)
        while x < canvas.x[-1] + 60:  # the next field covers the far end of this one
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
    """What lies flat on the ground beside the road."""
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
    """Coverage of the markings that repeat, the lane dashes and the chevrons.

    Column x of either equals column x + its period, exactly.

    Args:
        columns: width of the image, in columns of one frame step each.
        scale: samples per image pixel.

    Shape: two (HEIGHT * scale, columns * scale) float32 in [0,1].
    """
    y = (torch.arange(HEIGHT * scale) + 0.5)[:, None] / scale - ROAD
    x = torch.arange(columns * scale)
    dash, chevron = ((x % (period * scale) + 0.5) / scale for period in (DASH_PERIOD, CHEVRON_PERIOD))
    dashes = torch.maximum((dash - 40).abs() - 19, y.abs() - 1.0)
    slant = chevron - 48 + 1.1 * (y - LANE).abs()  # constant along the edges of an arrow that points to +x
    chevrons = torch.maximum(((slant.abs() - 10).abs() - 2.4) / 1.5, (y - LANE).abs() - 4.6)
    return (0.5 - scale * dashes).clamp(0, 1), (0.5 - scale * chevrons).clamp(0, 1)


def _paint_road(canvas: Canvas, random: Random, tone: Tensor, lanes: list[tuple[float, int]]) -> None:
    """The carriageway with its grain, repairs, cracks and markings; lanes cut the edge line."""
    speckle, half = random.normal(*tone.shape), canvas.y.abs() - HALF
    tracks = torch.cos((canvas.y.abs() - LANE) * 0.98)  # where the wheels roll
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
            bend = (
                random.uniform(-0.6, 0.6) * p.x + 1.6 * torch.sin(p.x / random.uniform(3, 6)) + 0.7 * p.grain
            )
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
    """Paint the route from above, without the vehicles that only one flight meets.

    Args:
        frames: number of camera positions, one image column apart.
        seed: chooses everything that is found once; the markings are the same for every seed.

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
            tree(canvas, random, x + random.uniform(-35, 35), side * across, radius)
        if kind == "house":
            house(canvas, random, x, side * random.uniform(36, 42))
        if kind == "parking":
            for place in (-14, 12)[: random.pick((1, 2))]:
                vehicle(canvas, random, x + place, side * (HALF + 6.5), side)
    return F.avg_pool2d(canvas.pixels.clamp(0, 1), scale)


class AerialRoad(Traverse):
    """A flight along a painted road, one image column per frame.

    Frame i of every flight over the same seed is centred on the same column, so place i is frame i.
    Each flight has its own standing vehicles, light, drift, yaw and sensor noise. Flight 0, the
    reference, flies steadier than the others.

    Args:
        seed: chooses the route.
        traverse: chooses the flight; 0 is the reference.
        frames: number of frames.
        size: height and width of a frame in pixels; it always shows VIEW x VIEW image pixels.
        noise: standard deviation of the sensor noise, on the scale where white is 1.
        drift: largest sideways drift, in image pixels.
        yaw: largest turn of the camera, in degrees.
    """

    length: int
    place: Tensor

    def __init__(
        self,
        seed: int = 0,
        traverse: int = 0,
        frames: int = 3072,
        size: int = 64,
        noise: float = 0.025,
        drift: float = 3.0,
        yaw: float = 1.5,
    ) -> None:
        query = []
        for key, value, low, high, usual in (
            ("seed", seed, 0, 2**63 - 1, None),
            ("traverse", traverse, 0, 2**63 - 1, None),
            ("frames", frames, 1, 2**15, None),
            ("size", size, 16, 256, 64),
            ("noise", noise, 0, 1, 0.025),
            ("drift", drift, 0, 8, 3.0),
            ("yaw", yaw, 0, 5, 1.5),
        ):
            if not low <= value <= high:
                raise InputError(f"sim:aerial has {key}={value}; expected {low} <= {key} <= {high}")
            if value != usual:
                query.append(f"{key}={value}")
        self.name = "sim:aerial?" + "&".join(query)
        self.seed, self.traverse, self.size, self.noise = seed, traverse, size, noise
        self.length, self.place = frames, torch.arange(frames, dtype=torch.float64)

        random, swing = Random("flight", seed, traverse), 1.0 if traverse else 0.4
        looks = [random.pick(values) for values in ((0.78, 0.84, 1.16), (0.86, 1.16), (-0.06, 0.06))]
        level, gamma, tint = looks if traverse else (1.0, 1.0, 0.0)
        self._drift = drift * swing * random.wander(frames)
        self._yaw = math.radians(yaw) * swing * random.wander(frames)
        warm = tint + 0.03 * random.wander(frames)
        balance = torch.stack([1 + warm, torch.ones_like(warm), 1 - warm], 1)
        self._gain = (balance * level * (1 + 0.12 * swing * random.wander(frames))[:, None]).float()
        self._gamma = (gamma + 0.06 * swing * random.wander(frames)).float()

    @cached_property
    def _scene(self) -> Tensor:
        """The painted route with this flight's vehicles on it, (3, HEIGHT, W)."""
        image, random = paint_route(self.length, self.seed), Random("traffic", self.seed, self.traverse)
        canvas = Canvas.over(image, 1, random)
        for heading in (-1, 1):
            x = random.uniform(0, 200)
            while x < image.shape[2]:
                y, lorry = heading * LANE + random.uniform(-0.8, 0.8), random.uniform(0, 1) < 0.25
                vehicle(canvas, random, x, y, heading, lorry)
                x += random.uniform(90, 600)
        return image.clamp_(0, 1)

    def batches(self, size: int) -> Iterator[Tensor]:
        """Yield the frames in order, at most `size` at a time. Shape: (B,3,S,S) float32 in [0,1]."""
        if size < 1:
            raise InputError(f"a batch holds {size} frames; expected at least 1")
        fine = math.ceil(VIEW / self.size)  # a small frame averages samples that lie an image pixel apart
        across = ((torch.arange(fine * self.size).double() + 0.5) / (fine * self.size) - 0.5) * VIEW
        down, (height, width) = across[:, None], self._scene.shape[1:]
        for start in range(0, self.length, size):
            at = torch.arange(start, min(start + size, self.length))
            c, s, drift = (curve[at, None, None] for curve in (self._yaw.cos(), self._yaw.sin(), self._drift))
            column = at[:, None, None] + (MARGIN + VIEW / 2) + c * across - s * down
            row = HEIGHT / 2 + drift + s * across + c * down
            grid = torch.stack([2 * column / width - 1, 2 * row / height - 1], -1).float()
            seen = F.grid_sample(self._scene.expand(len(at), -1, -1, -1), grid, align_corners=False)
            seen = F.avg_pool2d(seen, fine) * self._gain[at, :, None, None]
            seen = seen ** self._gamma[at, None, None, None]
            for frame, i in zip(seen, at.tolist(), strict=True):
                random = Random("noise", self.seed, self.traverse, i)
                frame += self.noise * random.normal(3, self.size, self.size)
            yield seen.clamp_(0, 1)
