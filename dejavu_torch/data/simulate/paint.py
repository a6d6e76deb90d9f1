"""A painter's tools for the built-in routes: repeatable draws, a canvas, trees, houses and vehicles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from hashlib import blake2b
from typing import NamedTuple, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

ROAD = 40.0  # image row of the road's middle
_SUN = (0.75, -0.66)  # towards the sun, as (x, y)
_T = TypeVar("_T")

# colours, rrggbb
WHITE, GRAVEL, GLASS, DARK = "edebe0", "998f7a", "1a212b", "0d0f12"
_ROOFS = ("99452e", "7a3d2e", "5c5e66", "856b54")
_LEAVES = ("2e5c1f", "3d6626", "4f5e24", "266633", "47612b")
_PAINTS = ("e6e6e8", "b81a1a", "1f3880", "1a1a1f", "9ea3ab", "d4b329", "266161")


class Random:
    """Draws that depend on the key alone and never touch torch's global generator."""

    def __init__(self, *key: object) -> None:
        digest = blake2b(repr(key).encode(), digest_size=4).digest()
        self.generator = torch.Generator().manual_seed(int.from_bytes(digest, "big"))

    def uniform(self, low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def pick(self, items: Sequence[_T]) -> _T:
        return items[int(torch.randint(len(items), (), generator=self.generator))]

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator)

    def texture(self, height: int, width: int, cell: float) -> Tensor:
        """Smooth noise of unit variance; each of 4 octaves has half the cell of the last. (height, width)."""
        total = torch.zeros(height, width)
        for k in range(4):
            knots = self.normal(1, 1, *(2 + int(n * 2**k / cell) for n in (height, width)))
            total += 0.6**k * F.interpolate(knots, (height, width), mode="bicubic")[0, 0]
        return total / total.std()

    def wander(self, frames: int) -> Tensor:
        """A slow curve within [-1, 1], (frames,) float64."""
        i, curve = torch.arange(frames, dtype=torch.float64), torch.zeros(frames, dtype=torch.float64)
        for weight, period in ((0.2, 170.0), (0.35, 420.0), (0.45, 1100.0)):
            turns = i / (period * self.uniform(0.7, 1.3)) + self.uniform(0, 1)
            curve += weight * torch.sin(2 * math.pi * turns)
        return curve


class Canvas(NamedTuple):
    """Pixels (3,h,w) painted in place, at column x and y rows below the road's middle, with a fine grain."""

    pixels: Tensor
    grain: Tensor
    x: Tensor
    y: Tensor
    scale: int  # pixels per image pixel

    @staticmethod
    def over(pixels: Tensor, scale: int, random: Random) -> Canvas:
        y, x = ((torch.arange(n) + 0.5) / scale for n in pixels.shape[1:])
        grain = random.texture(len(y), len(x), 5.0 * scale)
        return Canvas(pixels, grain, x, y[:, None] - ROAD, scale)

    def near(self, x: float, y: float, reach: float = 45.0, turn: float = 0.0) -> Canvas:
        """The square within reach of (x, y), with x and y relative to that point and turned by radians."""
        rows, columns = (
            slice(*(max(0, math.floor((at + side * reach) * self.scale)) for side in (-1, 1)))
            for at in (y + ROAD, x)
        )
        pixels, grain = self.pixels[:, rows, columns], self.grain[rows, columns]
        dx, dy, c, s = self.x[columns] - x, self.y[rows] - y, math.cos(turn), math.sin(turn)
        return Canvas(pixels, grain, c * dx + s * dy, c * dy - s * dx, self.scale)

    def fill(self, distance: Tensor, colour: str, shade: Tensor | float = 1.0, alpha: float = 1.0) -> None:
        """Blend in colour (rrggbb) * shade where distance, in image pixels, is negative; antialiased."""
        rgb = torch.tensor(list(bytes.fromhex(colour))).view(3, 1, 1) / 255
        cover = (0.5 - self.scale * distance).clamp(0, 1) * alpha
        self.pixels.add_(cover * (rgb * shade - self.pixels))

    def box(self, x: float, y: float, length: float, width: float, corner: float = 0.0) -> Tensor:
        """Signed distance to a rounded rectangle around (x, y)."""
        a, b = (self.x - x).abs() - length / 2 + corner, (self.y - y).abs() - width / 2 + corner
        return torch.hypot(a.clamp(min=0), b.clamp(min=0)) + torch.maximum(a, b).clamp(max=0) - corner

    def blob(self, radius: float, random: Random) -> Tensor:
        """Signed distance, roughly, to an uneven disc around the origin."""
        angle = torch.atan2(self.y, self.x)
        bumps = sum(0.09 * torch.sin(k * angle + random.uniform(0, 2 * math.pi)) for k in (2, 3, 5))
        return torch.hypot(self.x, self.y) - radius * (1 + bumps)


def tree(canvas: Canvas, random: Random, x: float, y: float, radius: float) -> None:
    """A tree or bush with its shadow."""
    p, fall = canvas.near(x, y, 2 * radius), 0.75 * radius
    p.fill(torch.hypot(p.x + fall * _SUN[0], p.y + fall * _SUN[1]) - radius, DARK, alpha=0.55)
    light = 1 + 0.38 * (p.x * _SUN[0] + p.y * _SUN[1]) / radius + 0.22 * p.grain
    p.fill(p.blob(radius, random), random.pick(_LEAVES), light)


def house(canvas: Canvas, random: Random, x: float, y: float) -> None:
    """A house with a ridged roof, a chimney and its shadow."""
    p, roof = canvas.near(x, y, turn=random.uniform(-0.15, 0.15)), random.pick(_ROOFS)
    length, width = random.uniform(30, 46), random.uniform(22, 28)
    chimney = length * random.uniform(-0.35, 0.35)
    p.fill(p.box(-7 * _SUN[0], -7 * _SUN[1], length, width), DARK, alpha=0.6)
    slopes = torch.where(p.y < 0, 1.2, 0.78) + 0.05 * torch.sin(2.6 * p.y) + 0.05 * p.grain
    p.fill(p.box(0, 0, length, width), roof, slopes)
    p.fill(p.box(0, 0, length, 0.9), roof, 1.45)
    p.fill(p.box(chimney - 2, -2, 5, 3), DARK, alpha=0.5)
    p.fill(p.box(chimney, -4, 3.2, 3.2), GRAVEL)


def vehicle(canvas: Canvas, random: Random, x: float, y: float, heading: int, lorry: bool = False) -> None:
    """A car or a lorry along the road; heading is +1 towards growing columns, else -1."""
    p, paint = canvas.near(x, y, 26, random.uniform(-0.02, 0.02)), random.pick(_PAINTS)
    length, width, fall = (44.0, 9.6, 3.0) if lorry else (random.uniform(16, 20), 7.6, 1.6)
    p.fill(p.box(-fall * _SUN[0], -fall * _SUN[1], length + 0.6, width + 0.6, 2), DARK, alpha=0.65)
    if lorry:
        p.fill(p.box(-5 * heading, 0, 34, width, 0.6), random.pick(_PAINTS), 1 + 0.05 * p.grain)
        p.fill(p.box(17.5 * heading, 0, 9, width - 0.6, 1.5), paint)
        p.fill(p.box(20.8 * heading, 0, 1.8, width - 2, 0.6), GLASS)
    else:
        p.fill(p.box(0, 0, length, width, 2.4), paint, 1 - 0.03 * p.y)
        p.fill(p.box(-0.8 * heading, 0, 0.62 * length, width - 1.4, 1.6), GLASS)
        p.fill(p.box(-1.0 * heading, 0, 0.34 * length, width - 2.0, 1.0), paint, 1.08)
