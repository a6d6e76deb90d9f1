"""The changes of `Augmentation` by kornia, which take about twice as long."""

from __future__ import annotations

from typing import Any

import torch
from kornia.augmentation import (
    RandomAffine,
    RandomBrightness,
    RandomContrast,
    RandomGamma,
    RandomGaussianBlur,
    RandomLinearIllumination,
    VideoSequential,
)
from kornia.geometry.transform import warp_perspective
from torch import Tensor, nn

from dejavu_torch.features.augmentation import WARPED, Augmentation


class KorniaAugmentation(Augmentation):
    """As `Augmentation`, of the same arguments, with view and light by `kornia.augmentation`.

    Args:
        strengths: see `Augmentation`.

    Shape: frames (B,C,H,W) or clips (B,T,C,H,W), float32 in [0, 1] -> the same.
    """

    def __init__(self, **strengths: Any) -> None:
        super().__init__(**strengths)
        (across, along), (gain, offset) = self.strengths["shift"], self.strengths["exposure"]
        turn, zoom, gamma, slope, blur = (
            float(self.strengths[name][0]) for name in ("rotation", "scale", "gamma", "illumination", "blur")
        )
        steps: list[nn.Module] = []
        if turn or across or along or zoom:
            scale = (1.0 - zoom, 1.0 + zoom)
            steps.append(RandomAffine(turn, (across, along), scale, padding_mode="border", p=0.9))
        if offset:  # kornia's brightness is an offset, its factor less 1
            steps.append(RandomBrightness((1.0 - offset, 1.0 + offset)))
        if gain:  # and its contrast is a gain
            steps.append(RandomContrast((1.0 - gain, 1.0 + gain)))
        if gamma:
            steps.append(RandomGamma((1 / (1 + gamma), 1.0 + gamma), p=0.7))
        if slope:
            steps.append(RandomLinearIllumination((min(0.01, slope), slope)))
        if blur:
            size = 2 * self.radius + 1
            apart = size > 3  # 3 x 3 in one go takes half the time of rows and columns apart
            steps.append(RandomGaussianBlur((size, size), (min(0.1, blur), blur), separable=apart))
        # in a tuple, which keeps kornia's buffers out of checkpoints: they hold strengths, nothing learned
        self._steps = (VideoSequential(*steps),)

    def _as_on_another_day(self, clips: Tensor) -> Tensor:
        (steps,) = self._steps
        slant = self._of("perspective")
        if slant:
            drawn = (2 * torch.rand(len(clips), 2, device=clips.device) - 1) * slant
            chosen = torch.rand(len(clips), 1, device=clips.device) < WARPED
            clips = slanted(clips, (drawn * chosen).deg2rad())
        changed: Tensor = steps(clips)
        return changed


def slanted(clips: Tensor, slants: Tensor) -> Tensor:
    """Clips (B,T,C,H,W) seen aslant by (B,2) radians, as in `Augmentation`, by kornia."""
    height, width = clips.shape[-2:]
    (cos_u, cos_v), (sin_u, sin_v) = slants.cos().unbind(1), slants.sin().unbind(1)
    none, one, away = torch.zeros_like(cos_u), torch.ones_like(cos_u), float(max(height, width))
    to_middle = clips.new_tensor([[1, 0, (width - 1) / 2], [0, 1, (height - 1) / 2], [0, 0, 1]])
    plane = [cos_u, sin_v * sin_u, none, none, cos_v, none, -sin_u / away, sin_v * cos_u / away, one]
    seen = to_middle @ torch.stack(plane, 1).view(-1, 3, 3) @ to_middle.inverse()  # of each pixel: its source
    images, size = clips.flatten(1, 2), (height, width)
    warped = warp_perspective(images, seen.inverse(), size, padding_mode="border", align_corners=True)
    return warped.view(clips.shape)
