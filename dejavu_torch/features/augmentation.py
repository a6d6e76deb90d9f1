"""What another day does to a frame, for learning features that are robust to it."""

from __future__ import annotations

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
from torch import Tensor, nn

from dejavu_torch.types import InputError

# the largest strength of each kind; two numbers where the argument is a pair
LARGEST: dict[str, tuple[float, ...]] = {
    "colour": (1, 1),
    "rotation": (180,),
    "shift": (1, 1),
    "scale": (0.9,),
    "exposure": (1, 1),
    "gamma": (10,),
    "illumination": (1,),
    "blur": (20,),
    "occlusion": (1,),
    "noise": (1,),
}
NOISY = 0.7  # the chance that a clip gets noise
OCCLUDED = 0.7  # and that something stands in its way


class Augmentation(nn.Module):
    """Light, lens and view of another day, drawn anew for every clip (by `kornia.augmentation`).

    Every argument is the largest strength of one kind of change; what happens to a clip is drawn
    uniformly up to it, and 0 switches the kind off. They act in this order; warp stands for rotation,
    shift and scale together.

    Args:
        colour: per channel, (gain, offset): x * (1 +- gain) +- offset, both at most 1. A grey frame
            has one channel. Always acts.
        rotation: degrees, in the plane of the frame: the yaw of a camera that looks down, the roll of one
            that looks ahead. Warp acts on 9 clips of 10 and repeats the border.
        shift: (horizontal, vertical), fractions of the width and of the height, at most 1: lateral
            displacement; small yaw and pitch of a camera that looks ahead.
        scale: fraction, 1 +- scale, at most 0.9: height above the ground, focal length.
        exposure: all channels alike, (gain, offset): (x +- offset) * (1 +- gain), both at most 1, clamped
            to [0, 1] after each step. Always acts.
        gamma: x ** g with g from 1 / (1 + gamma) to 1 + gamma. Acts on 7 clips of 10.
        illumination: how much is added or taken at one side of the frame, falling evenly to 0 at the
            opposite side; at most 1. Acts on 1 clip of 2.
        blur: sigma of a Gaussian, pixels, cut off at the whole number of pixels nearest to it (at least
            1). Acts on 1 clip of 2.
        occlusion: fraction of the frame's area that a rectangle out of another clip covers, as a vehicle
            does that stands there on one day only; its sides are in the ratio of 1:3 to 3:1 and rounded to
            whole pixels. The frames of a clip are covered by those of the other clip in their order; a
            clip alone is covered with black. Acts on 7 clips of 10.
        noise: standard deviation of Gaussian noise, of values in [0, 1]. Acts on 7 clips of 10.

    Shape: frames (B,C,H,W) or clips (B,T,C,H,W), float32 in [0, 1] -> the same, clamped to [0, 1].

    Convention: all frames of a clip get the same change, as one camera on one day does; only the noise
        is of each frame. Clips, and frames that come without T, differ. Random numbers come from torch's
        generators, so `torch.manual_seed` repeats them. No gradient passes: it is for images, ahead of
        what learns. In eval mode the input itself comes back. There is no state to save.

    Raises:
        InputError: a strength that is negative or too large, or frames of another shape or dtype.

    Example:
        >>> frames = torch.rand(4, 3, 32, 32)
        >>> augmentation = Augmentation(occlusion=0.0)
        >>> augmentation(frames).shape, augmentation.eval()(frames) is frames
        (torch.Size([4, 3, 32, 32]), True)
    """

    def __init__(
        self,
        colour: tuple[float, float] = (0.2, 0.05),
        rotation: float = 3.0,
        shift: tuple[float, float] = (0.02, 0.04),
        scale: float = 0.05,
        exposure: tuple[float, float] = (0.4, 0.3),
        gamma: float = 0.5,
        illumination: float = 0.25,
        blur: float = 1.2,
        occlusion: float = 0.4,
        noise: float = 0.03,
    ) -> None:
        super().__init__()
        given = locals()
        self.strengths = {name: _checked(name, given[name]) for name in LARGEST}
        self.colour, self.noise, self.occlusion = self.strengths["colour"], noise, occlusion
        self.radius = max(1, round(blur)) if blur else 0
        gain, offset = exposure
        steps: list[nn.Module] = []
        if rotation or any(shift) or scale:
            zoom = (1.0 - scale, 1.0 + scale)
            steps.append(RandomAffine(float(rotation), tuple(shift), zoom, padding_mode="border", p=0.9))
        if offset:  # kornia's brightness is an offset, its factor less 1
            steps.append(RandomBrightness((1.0 - offset, 1.0 + offset)))
        if gain:  # and its contrast is a gain
            steps.append(RandomContrast((1.0 - gain, 1.0 + gain)))
        if gamma:
            steps.append(RandomGamma((1 / (1 + gamma), 1.0 + gamma), p=0.7))
        if illumination:
            steps.append(RandomLinearIllumination((min(0.01, illumination), float(illumination))))
        if blur:
            size = 2 * self.radius + 1
            apart = size > 3  # 3 x 3 in one go takes half the time of rows and columns apart
            steps.append(RandomGaussianBlur((size, size), (min(0.1, blur), float(blur)), separable=apart))
        # in a tuple, which keeps kornia's buffers out of checkpoints: they hold strengths, nothing learned
        self._steps = (VideoSequential(*steps),)

    @property
    def acts(self) -> bool:
        """Whether any strength is above 0."""
        return any(max(strength) > 0 for strength in self.strengths.values())

    @torch.no_grad()
    def forward(self, frames: Tensor) -> Tensor:
        if not self.training:
            return frames
        shape = tuple(frames.shape)
        if frames.ndim not in (4, 5) or frames.dtype != torch.float32:
            raise InputError(
                f"the frames are {shape} {frames.dtype}; expected float32 (B,C,H,W) or clips (B,T,C,H,W)"
            )
        if min(shape) < 1 or min(shape[-2:]) <= self.radius:
            raise InputError(
                f"the frames are {shape}; expected some, of more than {self.radius} pixels a side to blur"
            )
        (steps,) = self._steps
        clips: Tensor = frames if frames.ndim == 5 else frames[:, None]
        clips = steps(self._coloured(clips))
        if self.occlusion:
            clips = self._occluded(clips)
        if self.noise:
            noisy = torch.rand(len(clips), 1, 1, 1, 1, device=clips.device) < NOISY
            clips = torch.randn_like(clips).mul_(self.noise * noisy).add_(clips)
        return clips.clamp_(0, 1).reshape(shape)  # in place: the input was copied for its colour

    def _coloured(self, clips: Tensor) -> Tensor:
        """Gain and offset of each channel."""
        gain, offset = self.colour
        draw = torch.rand(2, len(clips), 1, clips.shape[2], 1, 1, device=clips.device) * 2 - 1
        return (clips * (1 + gain * draw[0]) + offset * draw[1]).clamp_(0, 1)

    def _occluded(self, clips: Tensor) -> Tensor:
        """A rectangle of each clip taken from the one before."""
        count, (height, width) = len(clips), clips.shape[-2:]
        area, ratio, y, x, chance = torch.rand(5, count, 1, 1, device=clips.device)
        area, ratio = area * self.occlusion, 3 ** (2 * ratio - 1)

        def inside(pixels: int, side: Tensor, where: Tensor) -> Tensor:
            side = (side.clamp(max=1) * pixels).round()
            first = (where * (pixels - side + 1)).floor()
            along = torch.arange(pixels, device=clips.device)
            return (along >= first) & (along < first + side)

        rows = inside(height, (area / ratio).sqrt(), y).transpose(1, 2)
        covered = rows & inside(width, (area * ratio).sqrt(), x) & (chance < OCCLUDED)
        other = clips.roll(1, 0) if count > 1 else torch.zeros_like(clips)
        return torch.where(covered[:, None, None], other, clips)

    def extra_repr(self) -> str:
        shown = {name: value if len(value) > 1 else value[0] for name, value in self.strengths.items()}
        return ", ".join(f"{name}={value}" for name, value in shown.items())


def _checked(name: str, value: object) -> tuple[float, ...]:
    """The numbers of a strength, refused where they are not what they should be."""
    numbers = tuple(value) if isinstance(value, (tuple, list)) else (value,)
    most = LARGEST[name]
    fit = len(numbers) == len(most) and all(isinstance(number, (int, float)) for number in numbers)
    if not fit or not all(0 <= number <= limit for number, limit in zip(numbers, most, strict=True)):
        expected = " and ".join(f"a number from 0 to {limit}" for limit in most)
        raise InputError(f"{name} is {value!r}; expected {expected}")
    return numbers
