"""Preprocessing of frames: range of values, selection of a channel, normalisation of the contrast."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import permutations
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from dejavu_torch.memory import in_one_thread
from dejavu_torch.text import settings_of
from dejavu_torch.types import InputError, expect

MOST_CLIP = 1e6
Contrast = Literal["patch", "clahe"]
COLOURS = "RGB"
CHANNELS = ("grey", *COLOURS, *map("-".join, permutations(COLOURS, 2)))
SIZE = 160  # default of the longer side of a frame, pixels
FLAT = 1 / 255  # least standard deviation: one step of an 8-bit image
DEEP = 65535  # white in 16 bits
OUTSIDE = 0.5  # per cent of the values at either end that an automatic range leaves outside
BLANK = 2 / 255  # standard deviation below which a frame shows nothing
VALUES_AT_ONCE = 2**19  # of frames, so that intermediate results stay in the cache
ON_A_DEVICE = 2**24  # likewise; on a GPU each operation takes as long for fewer


def check_frames(frames: Tensor, seen: str, other: str = "") -> None:
    """Refuse all but a batch of float frames; the message begins with `seen`, `other` is also expected."""
    if not isinstance(frames, Tensor) or frames.ndim != 4 or not frames.is_floating_point():
        tensor = isinstance(frames, Tensor)
        given = f"{tuple(frames.shape)} {frames.dtype}" if tensor else f"a {type(frames).__name__}"
        raise InputError(f"{seen} {given}; expected a tensor of float frames (B,C,H,W) in [0, 1]{other}")


def in_parts(work: Callable[[Tensor], Tensor], frames: Tensor) -> Tensor:
    """`work` applied to so many values at a time, but at least one frame."""
    if torch.compiler.is_compiling():  # the number of parts would fix the batch size
        return work(frames)
    most = VALUES_AT_ONCE if frames.device.type == "cpu" else ON_A_DEVICE
    size = max(1, most // max(1, math.prod(frames.shape[1:])))
    parts = frames.split(size)
    with in_one_thread(max((part.numel() for part in parts), default=0)):
        return torch.cat([work(part) for part in parts])


def channel_name(channel: str) -> str:
    """The normal form of a channel's name: "grey", "R", "R-B"."""
    name = str(channel).strip().upper().replace("GREY", "grey")
    expected = "'grey', 'R', 'G', 'B' or a difference such as 'R-B'"
    expect(name in CHANNELS, expected, f"channel {channel!r} is unknown")
    return name


def select_channel(frames: Tensor, channel: str) -> Tensor:
    """One channel of frames (B,C,H,W) -> (B,1,H,W), see `Preprocess`; a difference is in [-1, 1]."""
    name, count = channel_name(channel), frames.shape[1]
    if name == "grey" and count == 1:
        return frames
    expect(count == 3, "the 3 of RGB", f"channel {name!r} of frames with {count} channels")
    if name == "grey":
        from kornia.color import rgb_to_grayscale  # loading kornia takes a third of a second

        grey: Tensor = rgb_to_grayscale(frames)
        return grey
    first, *second = (frames[:, COLOURS.index(colour), None] for colour in name.split("-"))
    return first - second[0] if second else first


def range_of(given: Sequence[float] | str | None) -> tuple[float, float] | Literal["auto"] | None:
    """A range of values, as two numbers or text, in [0, 1]; see `Preprocess`."""
    if given is None or given == "auto":
        return given  # type: ignore[return-value]
    try:
        low, high = map(float, given.split(",") if isinstance(given, str) else given)
    except (TypeError, ValueError):
        low = high = math.nan
    low, high = (low / DEEP, high / DEEP) if high > 1 else (low, high)
    expected = "LOW,HIGH in [0, 1], or up to 65535 as of 16 bits, or auto"
    expect(0 <= low < high <= 1, expected, f"preprocess got range={given!r}")
    return low, high


def spread(values: Tensor, span: tuple[float, float]) -> Tensor:
    """Values in a span (low, high) as values in [0, 1]; what lies outside becomes 0 or 1."""
    low, high = span
    return values if span == (0, 1) else ((values - low) / (high - low)).clamp(0, 1)


def measured_range(frames: Sequence[Tensor]) -> tuple[float, float]:
    """The values between which all but .5 % of those of some frames lie at either end; at least one apart in
    16 bits."""
    values = torch.cat([frame.flatten()[:: max(1, frame.numel() // 2**16)] for frame in frames])
    last = len(values) - 1
    ordered = values.double().clamp(0, 1).sort().values
    low, high = (float(ordered[round(last * share / 100)]) for share in (OUTSIDE, 100 - OUTSIDE))
    return (low, high) if high - low >= 1 / DEEP else (0.0, 1.0)


def box_mean(frames: Tensor, side: int) -> Tensor:
    """Mean of the side x side pixels around each, without those outside the frame; faster than pooling."""

    def sums(values: Tensor) -> Tensor:
        running = nn.functional.pad(values, (side // 2 + 1, side // 2)).cumsum(-1)
        return running[..., side:] - running[..., :-side]

    for _ in range(2):  # rows, then columns
        frames = (sums(frames) / sums(frames.new_ones(frames.shape[-1]))).mT
    return frames


def normalise_patches(frames: Tensor, patch: int = 9) -> Tensor:
    """Subtracts the mean, and divides by the standard deviation, of the patch around each pixel, per channel
    (Milford and Wyeth, SeqSLAM, ICRA 2012, with adjacent patches).

    Convention: patches end at the border. The standard deviation is the population's, at least 1/255, to not
        amplify noise in a flat sky; above that, gain and offset cancel. Gradients are finite everywhere.
    """
    height, width = frames.shape[-2:]
    if min(height, width) < patch:
        seen = f"patch normalisation got frames of {height} x {width} pixels"
        raise InputError(f"{seen}; expected at least one patch, {patch} x {patch}")

    def normalise(part: Tensor) -> Tensor:
        exact = part.double()  # the difference of squares below cancels too much in float32
        mean = box_mean(exact, patch)
        variance = box_mean(exact.square(), patch) - mean.square()
        return ((exact - mean) / variance.clamp(min=FLAT**2).sqrt()).to(part)

    return in_parts(normalise, frames)


def equalise(frames: Tensor, clip_limit: float = 2.0, grid: tuple[int, int] = (8, 8)) -> Tensor:
    """Contrast-limited adaptive histogram equalisation (CLAHE) by kornia, for each channel, in [0, 1].

    The table of 256 grey levels has no gradient, so the gradient is that of the identity. Kornia's
    differentiable form gives other values (up to 0.3 away).
    """
    expect(not torch.compiler.is_exporting(), "another contrast", "clahe would fix the number of frames")
    from kornia.enhance import equalize_clahe

    (height, width), (rows, columns) = frames.shape[-2:], grid
    if height <= rows or width <= columns:
        seen = f"clahe got frames of {height} x {width} pixels for a grid of {rows} x {columns} tiles"
        raise InputError(f"{seen}; expected at least {rows + 1} x {columns + 1} pixels")
    if not len(frames):
        return frames
    detached = frames.detach()
    low, high = (bound.item() for bound in detached.aminmax())
    expect(low >= 0 and high <= 1, "values in [0, 1]", f"clahe got values from {low:g} to {high:g}")
    try:
        equalised = in_parts(lambda part: equalize_clahe(part, clip_limit, grid), detached)
    except IndexError as error:
        seen = f"clahe got a grid of {rows} x {columns} tiles"
        raise InputError(f"{seen}; expected as many rows as columns, or kornia 0.9") from error
    return frames + (equalised - detached) if frames.requires_grad else equalised


class Preprocess(nn.Module):
    """Range, `select_channel`, then `normalise_patches` ("patch") or `equalise` ("clahe"), as one module.

    Args:
        channel: "grey" (luminance, 0.299 R + 0.587 G + 0.114 B), "R", "G", "B", or a difference such as
            "R-B", in upper or lower case; None keeps the frames' channels.
        contrast: "patch", "clahe", or None, which keeps it.
        patch: side of the square patch for "patch", pixels, odd, at least 3.
        clip_limit: for "clahe": limit of histogram bins, relative to a flat one, at least 1 pixel; 0 is none.
        grid: (rows, columns) of tiles for "clahe"; they need not divide the frame.
        size: pixels of the longer side to which `DejaVu.at_map_size` reduces frames, but not below the
            features' own `resize`; None keeps their size.
        range: (low, high), or "low,high", which become 0 and 1, with what lies outside: for frames that use
            few of 16 bits, as of a thermal or depth camera. In [0, 1], or up to 65535 as of 16 bits. "auto"
            is measured when a route is learned, see `measured_range`, and then kept, for queries too.
        blank: standard deviation, in this range and of the channel with most, below which a frame counts as
            covered or black: no query finds it, and it finds nothing; 0 for none.

    Shape: (B,C,H,W) -> (B,1,H,W), or (B,C,H,W) if `channel` is None.

    Convention: without range, channel and contrast any input passes unchanged. Before "clahe" a difference d
        becomes (d + 1) / 2.

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
        range: Sequence[float] | str | None = None,
        blank: float = BLANK,
    ) -> None:
        super().__init__()
        got, sized = "preprocess got", size is None or (isinstance(size, int) and size >= 1)
        tiled = len(grid) == 2 and all(tiles >= 1 and tiles == int(tiles) for tiles in grid)
        expect(sized, "pixels of the longer side, at least 1, or null", f"{got} {size=}")
        expect(contrast in (None, *get_args(Contrast)), "'patch', 'clahe' or None", f"{got} {contrast=}")
        expect(patch >= 3 and patch % 2 == 1, "an odd number of pixels, at least 3", f"{got} {patch=}")
        expect(0 <= clip_limit <= MOST_CLIP, f"0 (no limit) to {MOST_CLIP:g}", f"{got} {clip_limit=}")
        expect(0 <= blank < 1, "a standard deviation of at least 0, below 1", f"{got} {blank=}")
        expect(tiled, "(rows, columns), integers of at least 1", f"{got} grid={tuple(grid)}")
        self.channel = None if channel is None else channel_name(channel)
        self.contrast: Contrast | None = contrast
        self.patch, self.clip_limit, self.size = patch, float(clip_limit), size
        self.grid = (int(grid[0]), int(grid[1]))  # a map file holds a list
        self.range, self.blank = range_of(range), blank

    @property
    def span(self) -> tuple[float, float]:
        """The values that become 0 and 1; (0, 1) while they are not known."""
        return self.range if isinstance(self.range, tuple) else (0.0, 1.0)

    def forward(self, frames: Tensor) -> Tensor:
        if self.channel is None and self.contrast is None and self.span == (0, 1):
            return frames
        check_frames(frames, "preprocess got")
        frames = spread(frames, self.span)
        if self.channel is not None:
            frames = select_channel(frames, self.channel)
        if self.contrast == "patch":
            return normalise_patches(frames, self.patch)
        if self.contrast == "clahe":
            difference = self.channel is not None and "-" in self.channel
            return equalise((frames + 1) / 2 if difference else frames, self.clip_limit, self.grid)
        return frames

    def shows(self, frames: Tensor) -> Tensor:
        """Which frames (B,C,H,W) show something, (B,) bool: their contrast is at least `blank`."""
        low, high = self.span
        values = frames.flatten(2)
        # Tensor.var takes 15 times as long
        variance = (values - values.mean(2, keepdim=True)).square().mean(2)
        return variance.amax(1) >= (self.blank * (high - low)) ** 2

    extra_repr = settings_of
