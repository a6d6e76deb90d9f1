"""What another day does to a frame, for learning features that are robust to it."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dejavu_torch.types import InputError

# the largest strength of each kind; two numbers where the argument is a pair
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
# the chance that a clip gets each kind
WARPED, DEVELOPED, LIT, BLURRED, OCCLUDED, NOISY = 0.9, 0.7, 0.5, 0.5, 0.7, 0.7


class Augmentation(nn.Module):
    """Light, lens and view of another day, drawn anew for every clip.

    Every argument is the largest strength of one kind of change; what happens to a clip is drawn
    uniformly up to it, and 0 switches the kind off. They act in this order; warp stands for rotation,
    shift, scale and perspective together.

    Args:
        colour: per channel, (gain, offset): x * (1 +- gain) +- offset, both at most 1. A grey frame
            has one channel. Always acts.
        rotation: degrees, in the plane of the frame: the yaw of a camera that looks down, the roll of one
            that looks ahead. Warp acts on 9 clips of 10 and repeats the border.
        shift: (horizontal, vertical), fractions of the width and of the height, at most 1: lateral
            displacement; small yaw and pitch of a camera that looks ahead.
        scale: fraction, 1 +- scale, at most 0.9: height above the ground, focal length.
        perspective: degrees, at most 45, about the vertical and about the horizontal axis: the middle of the
            frame is seen from another side, as from a camera in the hand; see `seen_aslant`.
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
        perspective: float = 0.0,
    ) -> None:
        super().__init__()
        given = locals()
        self.strengths = {name: _checked(name, given[name]) for name in LARGEST}
        self.radius = max(1, round(blur)) if blur else 0

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
        clips = frames if frames.ndim == 5 else frames[:, None]
        clips = self._as_on_another_day(self._coloured(clips))
        if self._of("occlusion"):
            clips = self._occluded(clips)
        if self._of("noise"):
            noisy = torch.rand(len(clips), 1, 1, 1, 1, device=clips.device) < NOISY
            clips = torch.randn_like(clips).mul_(self._of("noise") * noisy).add_(clips)
        return clips.clamp_(0, 1).reshape(shape)  # in place: the input was copied for its colour

    def _of(self, name: str) -> float:
        """The one number of a strength."""
        return self.strengths[name][0]

    def _as_on_another_day(self, clips: Tensor) -> Tensor:
        """View and light of clips (B,T,C,H,W), which may be written to."""
        count, device = len(clips), clips.device

        def drawn(low: float, high: float) -> Tensor:
            return low + (high - low) * torch.rand(count, device=device)

        def happens(chance: float) -> Tensor:
            return torch.rand(count, device=device) < chance

        (across, along), (gain, offset) = self.strengths["shift"], self.strengths["exposure"]
        turn, zoom, gamma, slant = (self._of(name) for name in ("rotation", "scale", "gamma", "perspective"))
        if turn or across or along or zoom or slant:
            angle = drawn(-turn, turn).deg2rad()
            moved = torch.stack([drawn(-across, across), drawn(-along, along)], 1)
            chosen, scale = happens(WARPED), drawn(1 - zoom, 1 + zoom)
            # drawn where there is any, so that the others stay as they are without
            slants = torch.stack([drawn(-slant, slant), drawn(-slant, slant)], 1) if slant else None
            clips = torch.where(
                _each(chosen),
                warped(clips, angle, moved, scale, None if slants is None else slants.deg2rad()),
                clips,
            )
        if offset:
            clips = clips.add_(_each(drawn(-offset, offset))).clamp_(0, 1)
        if gain:
            clips = clips.mul_(_each(drawn(1 - gain, 1 + gain))).clamp_(0, 1)
        if gamma:
            power = _each(drawn(1 / (1 + gamma), 1 + gamma))
            clips = torch.where(_each(happens(DEVELOPED)), clips.log().mul_(power).exp_(), clips)  # 0 of 0
        if self._of("illumination"):
            most = torch.where(happens(LIT), drawn(-1, 1) * self._of("illumination"), 0.0)
            side = torch.randint(4, (count,), device=device)
            clips = clips.add_(_falling(most, side, *clips.shape[-2:])).clamp_(0, 1)
        if self.radius:
            sigma = torch.where(happens(BLURRED), drawn(min(0.1, self._of("blur")), self._of("blur")), 0.0)
            clips = blurred(clips, sigma, self.radius)
        return clips

    def _coloured(self, clips: Tensor) -> Tensor:
        """Gain and offset of each channel."""
        gain, offset = self.strengths["colour"]
        draw = torch.rand(2, len(clips), 1, clips.shape[2], 1, 1, device=clips.device) * 2 - 1
        return (clips * (1 + gain * draw[0]) + offset * draw[1]).clamp_(0, 1)

    def _occluded(self, clips: Tensor) -> Tensor:
        """A rectangle of each clip taken from the one before."""
        count, (height, width) = len(clips), clips.shape[-2:]
        area, ratio, y, x, chance = torch.rand(5, count, 1, 1, device=clips.device)
        area, ratio = area * self._of("occlusion"), 3 ** (2 * ratio - 1)

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


def warped(
    clips: Tensor, angle: Tensor, shift: Tensor, scale: Tensor, slants: Tensor | None = None
) -> Tensor:
    """Clips (B,T,C,H,W) turned by `angle` (B,) radians, enlarged by `scale` (B,), shifted by `shift` (B,2),
    fractions of width and height, and `seen_aslant` by `slants` (B,2); the border is repeated."""
    images, (height, width) = clips.flatten(1, 2), clips.shape[-2:]
    aspect = height / width
    # of the middle of each pixel, the frame being -1..1
    y, x = (torch.arange(1 - n, n, 2, dtype=clips.dtype, device=clips.device) / n for n in (height, width))
    x, y = x[None, None, :, None], y[None, :, None, None]
    if slants is not None:
        x, y = seen_aslant(x, y, slants[:, :, None, None, None], height, width)
    x = x - 2 * shift[:, :1, None, None]
    y = y - 2 * shift[:, 1:, None, None]
    cos, sin = angle.cos() / scale, angle.sin() / scale
    along_x = torch.stack([cos, sin / aspect], 1)[:, None, None]
    along_y = torch.stack([-aspect * sin, cos], 1)[:, None, None]
    grid = (x * along_x).add(y * along_y)
    sampled = F.grid_sample(images, grid, padding_mode="border", align_corners=False)
    return sampled.view(clips.shape)


def seen_aslant(x: Tensor, y: Tensor, slants: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Where points of a frame lie in another that shows the same plane from straight ahead.

    The plane is turned by `slants` (B,2,...), radians about its vertical and its horizontal axis, at a
    distance of the longer side of the frame, which is the focal length too: 53 degrees across that side.
    x, y: with the frame being -1..1.
    """
    longest = max(height, width)
    u, v = x * (width / longest / 2), y * (height / longest / 2)
    (cos_u, cos_v), (sin_u, sin_v) = slants.cos().unbind(1), slants.sin().unbind(1)
    depth = 1 + v * (sin_v * cos_u) - u * sin_u  # above 0 up to 45 degrees
    across, along = (u * cos_u + v * (sin_v * sin_u)) / depth, v * cos_v / depth
    return across * (2 * longest / width), along * (2 * longest / height)


def blurred(clips: Tensor, sigma: Tensor, radius: int) -> Tensor:
    """Clips (B,T,C,H,W) under a Gaussian of `sigma` (B,) pixels, 0 for none, cut off at `radius`; the border
    reflects."""
    away = torch.arange(radius + 1, device=clips.device)[:, None]
    weight = torch.exp(-0.5 * (away / sigma.clamp(min=1e-3)).square())
    weight = weight / (2 * weight.sum(0) - weight[0])  # (radius + 1, B)
    images = clips.flatten(1, 2)
    for axis, sides in ((3, (radius, radius, 0, 0)), (2, (0, 0, radius, radius))):
        padded, size = F.pad(images, sides, mode="reflect"), images.shape[axis]
        images = images * _each(weight[0])[:, 0]
        for k in range(1, radius + 1):
            both = padded.narrow(axis, radius - k, size) + padded.narrow(axis, radius + k, size)
            images = images.addcmul_(both, _each(weight[k])[:, 0])
    return images.view(clips.shape)


def _falling(most: Tensor, side: Tensor, height: int, width: int) -> Tensor:
    """(B,1,1,H,W): `most` (B,) at one side of the frame, evenly down to 0 at the opposite one."""
    x = torch.linspace(0, 1, width, device=most.device).expand(height, width)
    y = torch.linspace(0, 1, height, device=most.device)[:, None].expand(height, width)
    ramps = torch.stack([x, 1 - x, y, 1 - y])
    return (_each(most)[:, 0] * ramps[side][:, None])[:, None]


def _each(values: Tensor) -> Tensor:
    """One number for each clip, (B,) -> (B,1,1,1,1)"""
    return values[:, None, None, None, None]
