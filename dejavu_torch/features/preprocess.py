"""What may be done to frames before the features: choose a channel, normalise the contrast."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import permutations
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from dejavu_torch.text import settings_of
from dejavu_torch.types import InputError

MOST_CLIP = 1e6
Contrast = Literal["patch", "clahe"]
COLOURS = "RGB"
CHANNELS = ("grey", *COLOURS, *map("-".join, permutations(COLOURS, 2)))
SIZE = 160  # pixels of the longer side of a frame, unless said otherwise
FLAT = 1 / 255  # one step of an 8-bit image: a smaller standard deviation says nothing
VALUES_AT_ONCE = 2**19  # of frames, so that intermediate results stay in the cache


def check_frames(frames: Tensor, seen: str, other: str = "") -> None:
    """Refuse all but a batch of float frames; the message begins with `seen`, and names what else may be."""
    if not isinstance(frames, Tensor) or frames.ndim != 4 or not frames.is_floating_point():
        tensor = isinstance(frames, Tensor)
        kind = f"{tuple(frames.shape)} {frames.dtype}" if tensor else f"a {type(frames).__name__}"
        raise InputError(f"{seen} {kind}; expected a tensor of float frames (B,C,H,W) in [0, 1]{other}")


def in_parts(work: Callable[[Tensor], Tensor], frames: Tensor) -> Tensor:
    """`work` on at most VALUES_AT_ONCE values at a time, at least one frame."""
    if torch.compiler.is_compiling():  # the number of parts would fix the batch
        return work(frames)
    size = max(1, VALUES_AT_ONCE // max(1, math.prod(frames.shape[1:])))
    return torch.cat([work(part) for part in frames.split(size)])


def channel_name(channel: str) -> str:
    """A channel in the case that is stored: "grey", "R", "R-B"."""
    name = str(channel).strip().upper().replace("GREY", "grey")
    if name not in CHANNELS:
        raise InputError(
            f"channel {channel!r} is unknown; expected 'grey', 'R', 'G', 'B' or a difference such as 'R-B'"
        )
    return name


def select_channel(frames: Tensor, channel: str) -> Tensor:
    """One channel of frames (B,C,H,W) -> (B,1,H,W), see `Preprocess`; a difference lies in [-1, 1]."""
    name, count = channel_name(channel), frames.shape[1]
    if name == "grey" and count == 1:
        return frames
    if count != 3:
        raise InputError(f"channel {name!r} of frames with {count} channels; expected the 3 of RGB")
    if name == "grey":
        from kornia.color import rgb_to_grayscale  # loading kornia takes a third of a second

        grey: Tensor = rgb_to_grayscale(frames)
        return grey
    first, *second = (frames[:, COLOURS.index(colour), None] for colour in name.split("-"))
    return first - second[0] if second else first


def box_mean(frames: Tensor, side: int) -> Tensor:
    """Mean of the pixels inside the frame of the side x side around each; faster than pooling."""

    def sums(values: Tensor) -> Tensor:
        running = nn.functional.pad(values, (side // 2 + 1, side // 2)).cumsum(-1)
        return running[..., side:] - running[..., :-side]

    for _ in range(2):  # rows, then columns
        frames = (sums(frames) / sums(torch.ones_like(frames[0, 0, 0]))).mT
    return frames


def normalise_patches(frames: Tensor, patch: int = 9) -> Tensor:
    """Each pixel minus the mean, divided by the standard deviation, of the patch around it, for each channel
    (Milford and Wyeth, SeqSLAM, ICRA 2012; there in patches side by side).

    Convention: at the border only pixels inside the frame count. The standard deviation divides by their
        number, and is at least 1/255, so that noise in a flat sky is not amplified; above that a gain and an
        offset of brightness change nothing. Gradients are finite everywhere.
    """
    height, width = frames.shape[-2:]
    if min(height, width) < patch:
        raise InputError(
            f"patch normalisation got frames of {height} x {width} pixels; "
            f"expected at least one patch, {patch} x {patch}"
        )

    def normalise(part: Tensor) -> Tensor:
        exact = part.double()  # the difference of the squares below cancels: too much for float32
        mean = box_mean(exact, patch)
        variance = box_mean(exact.square(), patch) - mean.square()
        return ((exact - mean) / variance.clamp(min=FLAT**2).sqrt()).to(part)

    return in_parts(normalise, frames)


def equalise(frames: Tensor, clip_limit: float = 2.0, grid: tuple[int, int] = (8, 8)) -> Tensor:
    """Contrast-limited adaptive histogram equalisation (CLAHE) by kornia, for each channel, in [0, 1].

    A table of 256 grey levels has no gradient: it passes as if the output followed the input one to one.
    Kornia's differentiable form gives other values (up to 0.3 away).
    """
    if torch.compiler.is_exporting():
        raise InputError("clahe, by kornia, would fix the number of frames; expected another contrast")
    from kornia.enhance import equalize_clahe

    (height, width), (rows, columns) = frames.shape[-2:], grid
    if height <= rows or width <= columns:
        raise InputError(
            f"clahe got frames of {height} x {width} pixels for a grid of {rows} x {columns} tiles; "
            f"expected at least {rows + 1} x {columns + 1} pixels"
        )
    fixed = frames.detach()
    low, high = (one.item() for one in fixed.aminmax())
    if not (low >= 0 and high <= 1):
        raise InputError(f"clahe got values from {low:g} to {high:g}; expected values in [0, 1]")
    even = in_parts(lambda part: equalize_clahe(part, clip_limit, grid), fixed)
    return frames + (even - fixed) if frames.requires_grad else even


class Preprocess(nn.Module):
    """`select_channel`, then `normalise_patches` ("patch") or `equalise` ("clahe"), as one module.

    Args:
        channel: "grey" (luminance, 0.299 R + 0.587 G + 0.114 B), "R", "G", "B", or a difference such as
            "R-B", in upper or lower case; None keeps the frames' channels.
        contrast: "patch", "clahe", or None, which keeps it.
        patch: side of the square patch for "patch", pixels, odd, at least 3.
        clip_limit: for "clahe": a grey level counts at most this many times as often as in a flat histogram,
            and at least once, as all do in tiles under 256 / clip_limit pixels; 0 is no limit.
        grid: (rows, columns) of tiles for "clahe"; they need not divide the frame.
        size: pixels that `DejaVu.fit` reduces the longer side of a traverse's frames to, but no further than
            the features' own `resize`; None keeps the frames' size. `forward` does not.

    Shape: (B,C,H,W) -> (B,1,H,W), or (B,C,H,W) if `channel` is None.

    Convention: without channel and contrast the input itself is returned, whatever it is. Before "clahe"
        a difference of channels d in [-1, 1] becomes (d + 1) / 2.

    Raises:
        InputError: settings out of range; forward: frames that do not fit them.

    Example:
        >>> Preprocess(channel="grey", contrast="patch")(torch.rand(2, 3, 32, 48)).shape
        torch.Size([2, 1, 32, 48])
    """

    def __init__(
        self,
        channel: str | None = None,
        contrast: Contrast | None = None,
        patch: int = 9,
        clip_limit: float = 2.0,
        grid: tuple[int, int] = (8, 8),
        size: int | None = SIZE,
    ) -> None:
        super().__init__()
        if size is not None and (not isinstance(size, int) or size < 1):
            raise InputError(f"size is {size!r}; expected pixels of the longer side, at least 1, or null")
        if contrast is not None and contrast not in get_args(Contrast):
            raise InputError(f"contrast {contrast!r} is unknown; expected 'patch', 'clahe' or None")
        if patch < 3 or patch % 2 == 0:
            raise InputError(f"patch is {patch}; expected an odd number of pixels, at least 3")
        if not 0 <= clip_limit <= MOST_CLIP:
            raise InputError(
                f"clip_limit is {clip_limit}; expected at least 0 (no limit), at most {MOST_CLIP:g}"
            )
        if len(grid) != 2 or any(tiles < 1 or tiles != int(tiles) for tiles in grid):
            raise InputError(f"grid is {tuple(grid)}; expected (rows, columns), whole numbers of at least 1")
        self.channel = None if channel is None else channel_name(channel)
        self.contrast: Contrast | None = contrast
        self.patch, self.clip_limit, self.size = patch, float(clip_limit), size
        self.grid = (int(grid[0]), int(grid[1]))  # a map gives a list

    def forward(self, frames: Tensor) -> Tensor:
        if self.channel is None and self.contrast is None:
            return frames
        check_frames(frames, "preprocess got")
        if self.channel is not None:
            frames = select_channel(frames, self.channel)
        if self.contrast == "patch":
            return normalise_patches(frames, self.patch)
        if self.contrast == "clahe":
            difference = self.channel is not None and "-" in self.channel
            return equalise((frames + 1) / 2 if difference else frames, self.clip_limit, self.grid)
        return frames

    extra_repr = settings_of
