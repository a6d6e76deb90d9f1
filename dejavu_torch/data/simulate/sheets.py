"""A world drawn along a straight track: flat sheets, textured, with objects that stand on them.

Metres: s along the track, x to the right and y up from the camera's mean position. A sheet runs along
the whole track, so each pixel's ray meets it at a distance ahead that never changes, and a frame taken
at s is one lookup at s + that distance, composited front to back.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

FAR = 240.0  # metres ahead beyond which everything is haze
FOCAL = 0.55  # focal length, of the frame's width: 85 degrees across
HORIZON = 0.38  # how far down the frame the horizon lies, of its height


class View:
    """The rays of a pinhole camera that looks along the track, row by row.

    Args:
        height, width: of the image in pixels.
        margin: rows and columns beyond it on every side.

    Attributes:
        up, right: (P,) metres that each pixel's ray rises and goes aside per metre ahead.

    Convention: square pixels; a point (x, y, ahead) is seen `FOCAL * width * x / ahead` pixels right of the
        frame's middle and `FOCAL * width * y / ahead` above the horizon, `HORIZON * height` below its top.
    """

    def __init__(self, height: int, width: int, margin: int = 0) -> None:
        self.size = height, width
        self.shape = height + 2 * margin, width + 2 * margin
        self.pixel = 1 / (FOCAL * width)  # tangent of one pixel
        down, across = (torch.arange(n) + 0.5 - margin for n in self.shape)
        up = (HORIZON * height - down) * self.pixel
        right = (across - 0.5 * width) * self.pixel
        self.up, self.right = (t.flatten() for t in torch.meshgrid(up, right, indexing="ij"))

    def project(self, x: float, y: float, ahead: float) -> tuple[float, float]:
        """Where a point is seen: (0, 0) the centre of the top left pixel, (1, 1) of the bottom right one."""
        height, width = self.size
        across = 0.5 * width + x / ahead / self.pixel
        down = HORIZON * height - y / ahead / self.pixel
        return (across - 0.5) / (width - 1), (down - 0.5) / (height - 1)


class Thing:
    """Equal boxes that stand on a sheet, one at each position along the track.

    Args:
        low, high: where across the sheet, in metres from its first edge.
        colour: rrggbb.
        at: (n,) increasing positions in metres of the side that faces the camera.
        length: metres along the track.
        depth: metres by which the box rises from the sheet towards the camera's path.
        opacity: 0 to 1. lit: True for what shines by itself.
    """

    def __init__(
        self,
        low: float,
        high: float,
        colour: str,
        at: Tensor,
        length: float,
        depth: float = 0.0,
        opacity: float = 1.0,
        lit: bool = False,
    ) -> None:
        self.low, self.high, self.length, self.depth = low, high, length, depth
        self.opacity, self.lit = opacity, lit
        self.colour = torch.tensor(list(bytes.fromhex(colour))).view(3, 1) / 255
        gap = float(at.diff().min()) if len(at) > 1 else math.inf
        self._cell = min(gap, 64.0) * 0.999  # no cell holds two positions
        self._origin, self._gap = float(at[0]), gap
        self._at = torch.cat([torch.tensor([-math.inf]), at.float()])
        cells = int((float(at[-1]) - self._origin) / self._cell) + 2
        ends = self._origin + self._cell * torch.arange(1, cells + 1, dtype=torch.float64)
        self._upto = torch.searchsorted(at.double(), ends, right=True)
        self.first = self._origin
        # seen from FAR ahead, a box hides what lies behind it
        self.last = float(at[-1]) + length + (FAR if depth else 0)

    def _count(self, s: Tensor) -> Tensor:
        """How many stand at s or before."""
        cell = ((s - self._origin) / self._cell).clamp(-1, len(self._upto) - 1).floor().long()
        count = torch.where(cell >= 0, self._upto[cell.clamp(min=0)], 0)
        return count - (self._at[count] > s).long()

    def behind(self, s: Tensor) -> Tensor:
        """Metres from the last position at s or before, infinite where there is none."""
        return s - self._at[self._count(s)]

    def cover(self, s: Tensor, half: Tensor, slope: Tensor) -> Tensor:
        """The part of [s - half, s + half] on the sheet that the boxes hide.

        Args:
            slope: metres along the sheet that one metre of depth hides.
        """
        extent = (self.length + self.depth * slope).clamp(max=self._gap)
        hidden = []
        for edge in (s - half, s + half):
            count = self._count(edge)
            hidden.append((count, torch.minimum(edge - self._at[count], extent)))
        (first, before), (second, after) = hidden
        return (((second - first) * extent + after - before) / (2 * half)).clamp(0, 1)


class Rays(NamedTuple):
    """Where one view's rays meet one sheet; each (P,)."""

    pixels: Tensor
    ahead: Tensor  # metres along the track
    across: Tensor  # metres from the sheet's first edge
    skew: Tensor  # metres across per metre ahead
    slope: Tensor  # metres ahead per metre towards the camera's path
    wide: Tensor  # pixel's extent along the track, metres
    tall: Tensor  # and across
    detail: list[tuple[int, int, Tensor]]  # each level of the texture, with the rays that see that one


class Sheet:
    """A flat strip along the track, from edge a to edge b of its cross-section.

    Args:
        a, b: (x, y) in metres.
        texture: (4,V,S) float32, colour times opacity and opacity, or None for an invisible sheet.
        cell: metres of one texture cell across and along.
    """

    def __init__(
        self,
        a: tuple[float, float],
        b: tuple[float, float],
        texture: Tensor | None = None,
        cell: tuple[float, float] = (0.1, 0.2),
    ) -> None:
        self.a, self.b, self.texture, self.cell = a, b, texture, cell
        self.size = math.dist(a, b)
        self.along = (b[0] - a[0]) / self.size, (b[1] - a[1]) / self.size
        x, y = self.along[1], -self.along[0]
        distance = x * a[0] + y * a[1]
        self.normal = (x, y) if distance > 0 else (-x, -y)
        self.distance = abs(distance)
        self.things: list[Thing] = []
        self._levels: dict[tuple[int, int], Tensor] = {}

    def add(self, *things: Thing) -> Sheet:
        self.things.extend(things)
        return self

    def rays(self, view: View) -> Rays:
        facing = self.normal[0] * view.right + self.normal[1] * view.up
        ahead = self.distance / facing.clamp(min=1e-6)
        skew = self.along[0] * view.right + self.along[1] * view.up
        across = skew * ahead - (self.along[0] * self.a[0] + self.along[1] * self.a[1])
        tall = view.pixel * ahead
        reach = tall + 0.5
        seen = (facing > 0) & (ahead < FAR) & (across > -reach) & (across < self.size + reach)
        pixels = seen.nonzero().flatten()
        slope = ahead / self.distance
        every = ahead, across, skew, slope, tall * slope, tall
        ahead, across, skew, slope, wide, tall = (values[pixels] for values in every)
        return Rays(pixels, ahead, across, skew, slope, wide, tall, self._detail(wide, tall))

    def _detail(self, wide: Tensor, tall: Tensor) -> list[tuple[int, int, Tensor]]:
        """The levels whose texels are as large as the pixels, and which rays each serves."""
        if self.texture is None:
            return []
        across, along = (
            (a / b).log2().round().clamp(0, 6) for a, b in zip((tall, wide), self.cell, strict=True)
        )
        pairs, which = torch.stack([across, along], 1).long().unique(dim=0, return_inverse=True)
        return [(*pair, (which == k).nonzero().flatten()) for k, pair in enumerate(pairs.tolist())]

    def level(self, down: int, along: int) -> Tensor:
        """The texture averaged over 2^down x 2^along cells."""
        assert self.texture is not None
        if down == along == 0:
            return self.texture
        if (down, along) not in self._levels:
            pooled = F.avg_pool2d(self.texture, (2**down, 2**along), ceil_mode=True)
            self._levels[down, along] = pooled
        return self._levels[down, along]
