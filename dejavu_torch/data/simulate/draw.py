"""Frames drawn from a world's sheets: each a lookup ahead of the camera, composited front to back."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.simulate.sheets import FAR, Rays, Sheet, Thing, View


class Light(NamedTuple):
    """What a traverse's light does to a world.

    lamp: strength of the headlight next to the train; it falls off over `reach` metres.
    ambient: (S,) light along the track, one value per metre. haze: (3,1) what distance fades into.
    fade: metres over which it does.
    """

    lamp: float
    reach: float
    ambient: Tensor
    haze: Tensor
    fade: float

    def shine(self, ahead: Tensor, s: Tensor) -> Tensor:
        place = s.clamp(0, len(self.ambient) - 2)
        cell = place.long()
        here = torch.lerp(self.ambient[cell], self.ambient[cell + 1], place - cell)
        return here + self.lamp / (1 + (ahead / self.reach) ** 2)


class Painter:
    """Draws the frames of one view on a list of sheets, nearest first."""

    def __init__(self, view: View, sheets: list[Sheet], light: Light) -> None:
        self.view, self.sheets, self.light = view, sheets, light

    @cached_property
    def _rays(self) -> list[Rays]:
        return [sheet.rays(self.view) for sheet in self.sheets]

    def draw(self, s: Tensor, step: Tensor, sway: Tensor, sky: Tensor) -> Tensor:
        """Frames at these places.

        Args:
            s: (B,) float64 metres. step: (B,) metres that the camera moves during the exposure.
            sway: (B,2) metres of the camera right and up of its mean. sky: (3,P) behind everything.

        Shape: -> (B,3,H,W), the view's shape.
        """
        colour = torch.zeros(len(s), *sky.shape)
        clear = torch.ones(len(s), 1, sky.shape[1])
        for sheet, rays in zip(self.sheets, self._rays, strict=True):
            if len(rays.pixels):
                paint, alpha = _paint(sheet, rays, self.light, s, step, sway)
                left = clear[:, :, rays.pixels]
                colour[:, :, rays.pixels] += left * paint
                clear[:, :, rays.pixels] = left * (1 - alpha)
        return (colour + clear * sky).view(len(s), 3, *self.view.shape)


def _paint(
    sheet: Sheet, rays: Rays, light: Light, s: Tensor, step: Tensor, sway: Tensor
) -> tuple[Tensor, Tensor]:
    """One sheet's colour times opacity (B,3,P), and its opacity (B,1,P)."""
    aside = (sway[:, :1] * sheet.normal[0] + sway[:, 1:] * sheet.normal[1]).float()
    shift = (sway[:, :1] * sheet.along[0] + sway[:, 1:] * sheet.along[1]).float()
    ahead = rays.ahead * (1 - aside / sheet.distance)
    across = rays.across + rays.skew * (ahead - rays.ahead) + shift
    where = s[:, None] + ahead.double()
    place = where.float()
    paint, alpha = torch.zeros(len(s), 3, len(rays.pixels)), torch.zeros(len(s), 1, len(rays.pixels))
    if sheet.texture is not None:
        for down, along, here in rays.detail:
            image = sheet.level(down, along)
            u = where[:, here] / (sheet.cell[1] * 2**along)
            v = across[:, here] / (sheet.cell[0] * 2**down)
            grid = torch.stack([(2 * u / image.shape[2] - 1).float(), 2 * v / image.shape[1] - 1], -1)
            texels = F.grid_sample(
                image.expand(len(s), -1, -1, -1), grid[:, None], padding_mode="border", align_corners=False
            )[:, :, 0]
            paint[:, :, here], alpha[:, :, here] = texels[:, :3], texels[:, 3:]
        inside = _between(across, rays.tall, 0.0, sheet.size)[:, None]
        paint, alpha = paint * inside, alpha * inside
    half = (rays.wide + step[:, None].float()) / 2
    near, far = float(s.min()), float(s.max()) + FAR
    live = [thing for thing in sheet.things if thing.first < far and thing.last > near]
    for lit in (False, True):
        if lit:
            fog = torch.exp(-rays.ahead / light.fade)
            shine = (light.shine(ahead, place) * fog)[:, None]
            paint = paint * shine + alpha * (1 - fog) * light.haze
        for thing in live:
            if thing.lit == lit:
                _stand(thing, rays, place, across, half, paint, alpha)
    return paint, alpha


def _between(across: Tensor, tall: Tensor, low: float, high: float) -> Tensor:
    """The part of each pixel within [low, high] across the sheet."""
    top, bottom = (across + tall / 2).clamp(max=high), (across - tall / 2).clamp(min=low)
    return ((top - bottom) / tall).clamp(0, 1)


def _stand(
    thing: Thing, rays: Rays, place: Tensor, across: Tensor, half: Tensor, paint: Tensor, alpha: Tensor
) -> None:
    """Paint one thing over its sheet, in place."""
    rise = thing.depth * rays.slope  # metres of sheet that the box's face hides
    top = rays.across - rays.skew * rise
    reach = rays.tall + 0.5
    near = torch.maximum(rays.across, top) > thing.low - reach
    here = (near & (torch.minimum(rays.across, top) < thing.high + reach)).nonzero().flatten()
    if len(here):
        s, tall = place[:, here], rays.tall[here]
        cover = thing.cover(s, half[:, here], rays.slope[here])
        met = across[:, here]
        if thing.depth:  # the ray meets the box before it meets the sheet
            met = met - rays.skew[here] * torch.minimum(thing.behind(s), rise[here])
        cover = (cover * _between(met, tall, thing.low, thing.high) * thing.opacity)[:, None]
        paint[:, :, here] = torch.lerp(paint[:, :, here], thing.colour, cover)
        alpha[:, :, here] = torch.lerp(alpha[:, :, here], torch.ones(()), cover)
