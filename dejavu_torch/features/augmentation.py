"""Augmentation of frames by changes of light, lens and view between days."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dejavu_torch.memory import without_autocast
from dejavu_torch.types import InputError

# the largest strength of each change; two numbers if the argument is a pair
LARGEST: dict[str, tuple[float, ...]] = {
    "colour": (1, 1),
    "rotation": (180,),
    "shift": (1, 1),
    "scale": (0.9,),
    "perspective": (45,),
    "exposure": (1, 1),
    "gamma": (10,),
    "illumination": (1,),
    "blur": (20,),
    "occlusion": (1,),
    "noise": (1,),
}
# the probability that a clip gets each change
WARPED, DEVELOPED, LIT, BLURRED, OCCLUDED, NOISY = 0.9, 0.7, 0.5, 0.5, 0.7, 0.7
LARGE_BLUR = 4  # pixels; above this, separable filters of kornia are faster than square ones
NO_BLUR = 1e-3  # sigma of a kernel that changes nothing


class Augmentation(nn.Module):
    """Random changes of light, lens and view, drawn for every clip, up to the strength of each change.

    Args:
        colour: per channel, (gain, offset), at most 1: x * (1 +- gain) +- offset.
        rotation: degrees, in the plane of the frame, at most 180.
        shift: (horizontal, vertical), fractions of the width and of the height, at most 1.
        scale: fraction, 1 +- scale, at most 0.9.
        exposure: for all channels, (gain, offset), at most 1: (x +- offset) * (1 +- gain), clamped twice.
        gamma: x ** g with g from 1 / (1 + gamma) to 1 + gamma, at most 10.
        illumination: added or subtracted at one side, falling linearly to 0 at the opposite side; at most 1.
        blur: largest sigma of a Gaussian, pixels, at most 20; the kernel reaches as many pixels, rounded.
        occlusion: fraction of the frame that a rectangle of another clip covers, sides 1:3 to 3:1, at most 1.
        noise: standard deviation of Gaussian noise, at most 1.
        perspective: degrees, at most 45, about both axes; distance and focal length are the longer side.

    Shape: frames (B,C,H,W) or clips (B,T,C,H,W), float32 in [0, 1] -> the same.

    Convention: changes follow in this order. Rotation, shift, scale and perspective, together, change 90 %
        of clips and repeat the border; gamma, occlusion and noise 70 %, illumination and blur 50 %. Frames of
        a clip share all but the noise; a single clip is covered with black. No gradient passes. Random
        numbers are from torch's generator of the frames' device, or from the one that is given, as of the CPU
        for the same copies on every device. Eval mode returns the input itself.

    Raises:
        InputError: a strength out of range; forward: frames of another shape or dtype, or too small to blur.

    Example:
        >>> Augmentation(occlusion=0.0)(torch.rand(4, 3, 32, 32)).shape
        torch.Size([4, 3, 32, 32])
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
        perspective: float = 0.0,
    ) -> None:
        super().__init__()
        arguments = locals()
        self.strengths: dict[str, tuple[float, ...]] = {}
        for name, most in LARGEST.items():
            value = arguments[name]
            numbers = tuple(value) if isinstance(value, (tuple, list)) else (value,)
            fit = len(numbers) == len(most) and all(isinstance(number, (int, float)) for number in numbers)
            if not fit or not all(0 <= number <= limit for number, limit in zip(numbers, most, strict=True)):
                expected = " and ".join(f"a number from 0 to {limit}" for limit in most)
                raise InputError(f"{name} is {value!r}; expected {expected}")
            self.strengths[name] = numbers

    @property
    def acts(self) -> bool:
        """Whether any strength is above 0."""
        return any(max(strength) > 0 for strength in self.strengths.values())

    def stronger(self, factor: float) -> Augmentation:
        """The augmentation with every strength times a factor, up to the largest allowed."""
        other = Augmentation()
        for name, most in LARGEST.items():
            scaled = (factor * strength for strength in self.strengths[name])
            other.strengths[name] = tuple(map(min, scaled, most))
        return other

    @torch.no_grad()
    @without_autocast
    def forward(self, frames: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if not self.training:
            return frames
        (blur,), (noise,) = self.strengths["blur"], self.strengths["noise"]
        radius = max(1, round(blur)) if blur else 0
        shape, dtype = tuple(frames.shape), frames.dtype
        fits = len(shape) in (4, 5) and dtype == torch.float32 and min(shape[1:]) >= 1
        if not fits or min(shape[-2:]) <= radius:
            expected = "float32 (B,C,H,W) or clips (B,T,C,H,W), of more than"
            raise InputError(f"the frames are {shape} {dtype}; expected {expected} {radius} pixels a side")
        if not len(frames):
            return frames
        clips = frames if frames.ndim == 5 else frames[:, None]
        draw = _Draw(len(clips), clips.device, generator)
        gain, offset = self.strengths["colour"]
        colour = draw.numbers(2, len(clips), 1, clips.shape[2], 1, 1) * 2 - 1
        # a copy, to change in place
        clips = torch.addcmul(offset * colour[1], clips, 1 + gain * colour[0]).clamp_(0, 1)
        clips = self._lit(self._warped(clips, draw), draw)
        clips = self._occluded(_blurred(clips, blur, radius, draw) if blur else clips, draw)
        if noise:
            clips.addcmul_(draw.normal(*clips.shape), noise * draw.happens(NOISY))
        return clips.clamp_(0, 1).reshape(shape)

    def _warped(self, clips: Tensor, draw: _Draw) -> Tensor:
        """Rotation, shift, scale and perspective by one homography."""
        names = ("rotation", "scale", "perspective", "shift")
        (turn,), (zoom,), (slant,), shift = (self.strengths[name] for name in names)
        if not max(turn, zoom, slant, *shift):
            return clips
        height, width = clips.shape[-2:]
        longest = max(height, width)  # the unit of length
        sides = clips.new_tensor([width, height]) / longest
        drawn = (2 * draw.numbers(6, len(clips)) - 1) * draw.happens(WARPED).flatten()
        angle, tilts = (turn * drawn[0]).deg2rad(), (slant * drawn[1:3]).deg2rad()
        zooms, moves = 1 + zoom * drawn[3], drawn[4:] * sides[:, None] * clips.new_tensor(shift)[:, None]
        u, v = (torch.arange(1 - n, n, 2, device=clips.device) for n in (width, height))
        u, v = (pixels.to(clips) / (2 * longest) for pixels in (u, v))
        points = torch.stack(torch.broadcast_tensors(u, v[:, None], u.new_ones(()))).flatten(1)
        homography = _homography(angle, zooms, moves, tilts)
        if slant:
            source = homography @ points
            source = source[:, :2] / source[:, 2:]
        else:  # the third row is 0, 0, 1
            source = homography[:, :2] @ points
        grid = source.mT * (2 / sides)
        images, grid = clips.flatten(1, 2), grid.view(-1, height, width, 2)
        return F.grid_sample(images, grid, padding_mode="border", align_corners=False).view(clips.shape)

    def _lit(self, clips: Tensor, draw: _Draw) -> Tensor:
        """Exposure, gamma and illumination, in place."""
        names = ("exposure", "gamma", "illumination")
        (gain, offset), (gamma,), (slope,) = (self.strengths[name] for name in names)
        add = draw.between(-offset, offset) if offset else 0
        times = draw.between(1 - gain, 1 + gain) if gain else 1
        if offset or gain:  # clamped after each of both: the bounds of the first are multiplied by the second
            low, high = (torch.as_tensor(bound).to(clips) for bound in (0.0, times))
            clips = clips.add_(add).mul_(times)
            clips = clips.clamp_(low, torch.minimum(high, torch.ones_like(high)))
        if gamma:
            power = draw.between(1 / (1 + gamma), 1 + gamma)
            power = torch.where(draw.happens(DEVELOPED), power, 1)
            clips = clips.log_().mul_(power).exp_()  # faster than pow; 0 stays 0
        if slope:
            height, width = clips.shape[-2:]
            x = torch.linspace(0, 1, width, dtype=clips.dtype, device=clips.device)
            y = torch.linspace(0, 1, height, dtype=clips.dtype, device=clips.device)[:, None]
            ramps = torch.stack(torch.broadcast_tensors(x, 1 - x, y, 1 - y))
            side = draw.below(4)
            most = draw.between(-slope, slope) * draw.happens(LIT)
            clips = clips.add_(most * ramps[side][:, None, None]).clamp_(0, 1)
        return clips

    def _occluded(self, clips: Tensor, draw: _Draw) -> Tensor:
        """A rectangle of each clip is replaced by that of the clip before."""
        (most,) = self.strengths["occlusion"]
        if not most:
            return clips
        area, ratio, y, x = draw.numbers(4, len(clips), 1, 1, 1, 1)
        area, ratio = most * area, 3 ** (2 * ratio - 1)

        def inside(pixels: int, side: Tensor, where: Tensor) -> Tensor:
            side = (side.clamp(max=1) * pixels).round()
            first = (where * (pixels - side + 1)).floor()
            along = torch.arange(pixels, device=clips.device)
            return (along >= first) & (along < first + side)

        height, width = clips.shape[-2:]
        covered = inside(height, (area / ratio).sqrt(), y).mT & inside(width, (area * ratio).sqrt(), x)
        other = clips.roll(1, 0) if len(clips) > 1 else torch.zeros_like(clips)
        # of 0 or 1 lerp is exact, and several times as fast as where
        return clips.lerp_(other, (covered & draw.happens(OCCLUDED)).to(clips))

    def extra_repr(self) -> str:
        shown = {name: value if len(value) > 1 else value[0] for name, value in self.strengths.items()}
        return ", ".join(f"{name}={value}" for name, value in shown.items())


class _Draw(NamedTuple):
    """Random numbers for clips, float32."""

    clips: int
    device: torch.device
    generator: torch.Generator | None

    def numbers(self, *shape: int) -> Tensor:
        """Between 0 and 1."""
        return torch.rand(shape, **self._where).to(self.device)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, **self._where).to(self.device)

    def below(self, most: int) -> Tensor:
        """(B,) int64."""
        return torch.randint(most, (self.clips,), **(self._where | {"dtype": torch.int64})).to(self.device)

    def between(self, low: float, high: float) -> Tensor:
        """For each clip, (B,1,1,1,1)."""
        return low + (high - low) * self.numbers(self.clips, 1, 1, 1, 1)

    def happens(self, chance: float) -> Tensor:
        """For each clip, (B,1,1,1,1) bool."""
        return self.between(0, 1) < chance

    @property
    def _where(self) -> dict[str, Any]:
        if self.generator is None:  # which compiles
            return {"dtype": torch.float32, "device": self.device}
        return {"dtype": torch.float32, "device": self.generator.device, "generator": self.generator}


def _homography(angle: Tensor, zoom: Tensor, shift: Tensor, tilt: Tensor) -> Tensor:
    """(B,3,3), from points of a warped frame to their source: relative to the centre, in longer sides.

    angle, zoom: (B,). shift: (2,B). tilt: (2,B), about the vertical and the horizontal axis.
    """
    one, zero = torch.ones_like(angle), torch.zeros_like(angle)
    cos, sin = angle.cos() / zoom, angle.sin() / zoom
    (cos_u, cos_v), (sin_u, sin_v) = tilt.cos(), tilt.sin()
    x, y = -shift
    turned = [cos, -sin, cos * x - sin * y, sin, cos, sin * x + cos * y, zero, zero, one]
    seen = [cos_u, sin_v * sin_u, zero, zero, cos_v, zero, -sin_u, sin_v * cos_u, one]
    return torch.stack(turned, 1).view(-1, 3, 3) @ torch.stack(seen, 1).view(-1, 3, 3)


def _blurred(clips: Tensor, most: float, radius: int, draw: _Draw) -> Tensor:
    from kornia.filters import gaussian_blur2d  # loading kornia takes a second

    sigma = draw.between(min(0.1, most), most)
    sigma = torch.where(draw.happens(BLURRED), sigma, NO_BLUR).view(-1, 1).expand(-1, 2)
    size = (2 * radius + 1, 2 * radius + 1)
    blurred: Tensor = gaussian_blur2d(clips.flatten(1, 2), size, sigma, separable=radius > LARGE_BLUR)
    return blurred.view(clips.shape)
