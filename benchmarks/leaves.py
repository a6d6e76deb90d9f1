"""Abstract images with the statistics of photographs: edges and textures of all sizes, light."""

from __future__ import annotations

import math

import torch
from torch import Tensor

SHAPES = 70  # in an image, from large to small


def leaves(count: int, side: int, seed: int) -> Tensor:
    """Dead leaves: opaque shapes over each other, coloured or striped, with 1 / f noise and uneven light.

    Source: the model is Matheron's; that networks learn from such images, Baradad, Wulff, Wang, Isola and
    Torralba, Learning to See by Looking at Noise (NeurIPS 2021).

    Shape: -> (count, 3, side, side) float in [0, 1].
    """
    generator = torch.Generator().manual_seed(seed)

    def drawn(*shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=generator)

    def noise(power: Tensor) -> Tensor:
        rows, columns = torch.fft.fftfreq(side)[:, None], torch.fft.rfftfreq(side)[None]
        radius = (rows**2 + columns**2).sqrt().clamp(min=1 / side)
        white = torch.fft.rfft2(torch.randn(count, 3, side, side, generator=generator))
        made: Tensor = torch.fft.irfft2(white * radius ** -power[:, None], (side, side))
        return made / made.std((1, 2, 3), keepdim=True)

    y, x = (torch.arange(side) / side).view(1, side, 1), (torch.arange(side) / side).view(1, 1, side)
    base, is_grey = drawn(3, 1, 1), drawn(1, 1, 1) < 0.3
    images = base + 0.15 * drawn(1, 1, 1) * noise(0.8 + drawn(1, 1))
    for shape in range(SHAPES):
        size = 0.02 + 0.5 * (1 - shape / SHAPES) * drawn(1, 1) ** 2 + 0.03 * drawn(1, 1)
        across, down = x - 1.2 * drawn(1, 1) + 0.1, y - 1.2 * drawn(1, 1) + 0.1
        angle, longer = math.pi * drawn(1, 1), (1.5 * drawn(1, 1) - 0.75).exp()
        u = (across * angle.cos() + down * angle.sin()) / size * longer
        v = (down * angle.cos() - across * angle.sin()) / size / longer
        kind = 3 * drawn(1, 1)
        ellipse, rectangle, rhomb = u**2 + v**2 < 1, (u.abs() < 1) & (v.abs() < 1), u.abs() + v.abs() < 1
        inside = torch.where(kind < 1, ellipse, torch.where(kind < 2, rectangle, rhomb))[:, None]
        colour = (base + drawn(3, 1, 1) - 0.5).clamp(0, 1)
        contrast = 0.25 * drawn(1, 1) * (drawn(1, 1) < 0.3)
        stripes = contrast * (2 * math.pi * (2 + 20 * drawn(1, 1)) * u).sin()
        images = torch.where(inside, colour + stripes[:, None], images)
    images = images + 0.08 * drawn(1, 1, 1) ** 2 * noise(0.3 + 1.2 * drawn(1, 1))
    images = images * (
        1 + 1.2 * (drawn(1, 1, 1) - 0.5) * (x - 0.5) + 1.2 * (drawn(1, 1, 1) - 0.5) * (y - 0.5)
    )
    return torch.where(is_grey, images.mean(1, keepdim=True), images).clamp(0, 1)
