"""Renders frames of a straight track: flat sheets along it, with boxes on them.

Metres: s along the track, x right and y up from the camera's mean position. Each pixel's ray meets a sheet at
a constant distance ahead, so a frame is one lookup per sheet at s + that distance, composited front to back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.simulate.route import rgb

FAR = 240.0  # metres ahead; nothing is drawn beyond
FOCAL = 0.55  # focal length in frame widths: 85 degrees horizontally
HORIZON = 0.38  # distance of the horizon from the top of the frame, in frame heights

Point = tuple[float, float]


class View:
    """The rays of a pinhole camera looking along the track; sizes in pixels, the margin on every side.

    Attributes:
        up, right: (P,) slopes of each pixel's ray, row by row, metres per metre ahead.
    """

    def __init__(self, height: int, width: int, margin: int = 0) -> None:
        self.size = height, width
        self.shape = height + 2 * margin, width + 2 * margin
        self.pixel = 1 / (FOCAL * width)  # tangent of one pixel
        down, across = (torch.arange(n) + 0.5 - margin for n in self.shape)
        up = (HORIZON * height - down) * self.pixel
        right = (across - 0.5 * width) * self.pixel
        self.up, self.right = (t.flatten() for t in torch.meshgrid(up, right, indexing="ij"))

    def project(self, x: float, y: float, ahead: float) -> Point:
        """Image coordinates of a point: (0, 0) at the centre of the top left pixel, (1, 1) bottom right."""
        height, width = self.size
        across = 0.5 * width + x / ahead / self.pixel
        down = HORIZON * height - y / ahead / self.pixel
        return (across - 0.5) / (width - 1), (down - 0.5) / (height - 1)


class Rays(NamedTuple):
    """Intersections of the rays of a view with a sheet; each (P,)."""

    pixels: Tensor
    ahead: Tensor  # metres along the track
    across: Tensor  # metres from the sheet's first edge
    skew: Tensor  # metres across per metre ahead
    slope: Tensor  # metres ahead per metre towards the camera's path
    wide: Tensor  # extent of the pixel along the track, metres
    tall: Tensor  # and across
    detail: list[tuple[int, int, Tensor]]  # texture levels, each with the rays that use it


@dataclass(eq=False)
class Thing:
    """Equal boxes on a sheet, one at each position along the track; lengths in metres."""

    sheet: str  # name
    low: float  # extent across the sheet, from its first edge
    high: float
    colour: str  # rrggbb
    at: Tensor | float  # (n,) increasing positions, or one, of the side that faces the camera
    length: float  # along the track
    depth: float = 0.0  # height over the sheet, towards the camera's path
    opacity: float = 1.0
    lit: bool = False  # emits light

    def __post_init__(self) -> None:
        at = torch.as_tensor(self.at, dtype=torch.float64).flatten()
        self._paint = rgb(self.colour)[..., 0]
        self._at = torch.cat([torch.tensor([-math.inf]), at.float()])
        self._gap = float(at.diff().min()) if len(at) > 1 else math.inf
        self.first = float(at[0])
        self.last = float(at[-1]) + self.length + (FAR if self.depth else 0)  # its face hides more

    def _last(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """The number of boxes up to s, and the distance to the last of them, infinite for none."""
        count = torch.searchsorted(self._at, s.contiguous(), right=True) - 1
        return count, s - self._at[count]

    def cover(self, s: Tensor, half: Tensor, slope: Tensor) -> Tensor:
        """The fraction of [s - half, s + half] that boxes hide; a metre of depth hides `slope` metres."""
        extent = (self.length + self.depth * slope).clamp(max=self._gap)
        (first, before), (second, after) = self._last(s - half), self._last(s + half)
        before, after = torch.minimum(before, extent), torch.minimum(after, extent)
        return (((second - first) * extent + after - before) / (2 * half)).clamp(0, 1)

    def draw(self, rays: Rays, s: Tensor, across: Tensor, half: Tensor, paint: Tensor, alpha: Tensor) -> None:
        """Paint the boxes over their sheet, in place."""
        rise = self.depth * rays.slope  # metres of the sheet hidden by the box's face
        top = rays.across - rays.skew * rise
        reach = rays.tall + 0.5
        near = torch.maximum(rays.across, top) > self.low - reach
        here = (near & (torch.minimum(rays.across, top) < self.high + reach)).nonzero().flatten()
        if len(here):
            s, across = s[:, here], across[:, here]
            cover = self.cover(s, half[:, here], rays.slope[here])
            if self.depth:  # the ray meets the box before the sheet
                across = across - rays.skew[here] * torch.minimum(self._last(s)[1], rise[here])
            cover = (cover * _within(across, rays.tall[here], self.low, self.high) * self.opacity)[:, None]
            paint[:, :, here] = torch.lerp(paint[:, :, here], self._paint, cover)
            alpha[:, :, here] = torch.lerp(alpha[:, :, here], torch.ones(()), cover)


class Light(NamedTuple):
    """The light of a traverse."""

    lamp: float  # strength of the headlight next to the train, which falls off over `reach` metres
    reach: float
    ambient: Tensor  # (S,) light along the track, one value per metre
    haze: Tensor  # (3,1) colour of the distance, reached over `fade` metres
    fade: float

    def at(self, ahead: Tensor, s: Tensor) -> Tensor:
        place = s.clamp(0, len(self.ambient) - 2)
        cell = place.long()
        here = torch.lerp(self.ambient[cell], self.ambient[cell + 1], place - cell)
        return here + self.lamp / (1 + (ahead / self.reach) ** 2)


class Sheet:
    """A flat strip along the track.

    Args:
        a, b: (x, y) in metres, the edges of its cross-section.
        texture: (4,V,S) float32, colour times opacity and opacity, or None for an invisible sheet.
        cell: metres of one texture cell across and along.
    """

    def __init__(self, a: Point, b: Point, texture: Tensor | None = None, cell: Point = (0.1, 0.2)) -> None:
        self.a, self.cell = a, cell
        self.size = math.dist(a, b)
        self.along = (b[0] - a[0]) / self.size, (b[1] - a[1]) / self.size
        x, y = self.along[1], -self.along[0]
        distance = x * a[0] + y * a[1]
        self.normal = (x, y) if distance > 0 else (-x, -y)
        self.distance = abs(distance)
        self.things: list[Thing] = []
        self._levels = {} if texture is None else {(0, 0): texture}

    def rays(self, view: View) -> Rays:
        facing = self.normal[0] * view.right + self.normal[1] * view.up
        ahead = self.distance / facing.clamp(min=1e-6)
        skew = self.along[0] * view.right + self.along[1] * view.up
        across = skew * ahead - (self.along[0] * self.a[0] + self.along[1] * self.a[1])
        tall = view.pixel * ahead
        reach = tall + 0.5
        seen = (facing > 0) & (ahead < FAR) & (across > -reach) & (across < self.size + reach)
        pixels = seen.nonzero().flatten()
        ahead, across, skew, tall = (values[pixels] for values in (ahead, across, skew, tall))
        slope = ahead / self.distance
        return Rays(pixels, ahead, across, skew, slope, tall * slope, tall, self._detail(tall * slope, tall))

    def _detail(self, wide: Tensor, tall: Tensor) -> list[tuple[int, int, Tensor]]:
        """The levels whose texels are as large as the pixels, and the rays that use each."""
        if not self._levels:
            return []
        levels = [(a / b).log2().round().clamp(0, 6) for a, b in zip((tall, wide), self.cell, strict=True)]
        pairs, which = torch.stack(levels, 1).long().unique(dim=0, return_inverse=True)
        return [(*pair, (which == k).nonzero().flatten()) for k, pair in enumerate(pairs.tolist())]

    def _level(self, down: int, along: int) -> Tensor:
        """The texture averaged over 2^down x 2^along cells."""
        if (down, along) not in self._levels:
            self._levels[down, along] = F.avg_pool2d(self._levels[0, 0], (2**down, 2**along), ceil_mode=True)
        return self._levels[down, along]

    def draw(self, rays: Rays, light: Light, s: Tensor, step: Tensor, sway: Tensor) -> tuple[Tensor, Tensor]:
        """Colour times opacity (B,3,P) and opacity (B,1,P) of the sheet; arguments as `Painter.draw`."""
        aside, shift = ((sway[:, :1] * x + sway[:, 1:] * y).float() for x, y in (self.normal, self.along))
        ahead = rays.ahead * (1 - aside / self.distance)
        across = rays.across + rays.skew * (ahead - rays.ahead) + shift
        exact = s[:, None] + ahead.double()
        place = exact.float()
        paint, alpha = torch.zeros(len(s), 3, len(rays.pixels)), torch.zeros(len(s), 1, len(rays.pixels))
        for down, along, here in rays.detail:
            image = self._level(down, along)
            u = exact[:, here] / (self.cell[1] * 2**along)
            v = across[:, here] / (self.cell[0] * 2**down)
            grid = torch.stack([(2 * u / image.shape[2] - 1).float(), 2 * v / image.shape[1] - 1], -1)
            images = image.expand(len(s), -1, -1, -1)
            texels = F.grid_sample(images, grid[:, None], padding_mode="border", align_corners=False)[:, :, 0]
            inside = _within(across[:, here], rays.tall[here], 0.0, self.size)[:, None]
            paint[:, :, here], alpha[:, :, here] = texels[:, :3] * inside, texels[:, 3:] * inside
        half = (rays.wide + step[:, None].float()) / 2
        near, far = float(s.min()), float(s.max()) + FAR
        fog = torch.exp(-rays.ahead / light.fade)
        for lit in (False, True):  # things that emit light are not shaded
            for thing in self.things:
                if thing.lit == lit and thing.first < far and thing.last > near:
                    thing.draw(rays, place, across, half, paint, alpha)
            if not lit:
                paint = paint * (light.at(ahead, place) * fog)[:, None] + alpha * (1 - fog) * light.haze
        return paint, alpha


def _within(across: Tensor, tall: Tensor, low: float, high: float) -> Tensor:
    """The fraction of each pixel within [low, high] across the sheet."""
    top, bottom = (across + tall / 2).clamp(max=high), (across - tall / 2).clamp(min=low)
    return ((top - bottom) / tall).clamp(0, 1)


class Painter:
    """Draws frames of a view of sheets, nearest first, and the sky (3,P) behind them."""

    def __init__(self, view: View, sheets: list[Sheet], light: Light, sky: Tensor) -> None:
        self.view, self.sheets, self.light, self.sky = view, sheets, light, sky
        self._rays = [sheet.rays(view) for sheet in sheets]

    def draw(self, s: Tensor, step: Tensor, sway: Tensor) -> Tensor:
        """Frames (B,3,H,W) of the view's shape.

        Args:
            s: (B,) float64 metres. step: (B,) metres of motion during the exposure.
            sway: (B,2) metres right and up of the camera's mean position.
        """
        colour = torch.zeros(len(s), *self.sky.shape)
        clear = torch.ones(len(s), 1, self.sky.shape[1])
        for sheet, rays in zip(self.sheets, self._rays, strict=True):
            if len(rays.pixels):
                paint, alpha = sheet.draw(rays, self.light, s, step, sway)
                rest = clear[:, :, rays.pixels]
                colour[:, :, rays.pixels] += rest * paint
                clear[:, :, rays.pixels] = rest * (1 - alpha)
        return (colour + clear * self.sky).view(len(s), 3, *self.view.shape)
