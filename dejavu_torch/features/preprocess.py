"""What may be done to frames ahead of the features: choose a channel, normalise the contrast."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor, nn

from dejavu_torch.features.hog import parts
from dejavu_torch.types import InputError

MOST_CLIP = 1e6
Contrast = Literal["patch", "clahe"]
COLOURS = "RGB"
SIZE = 160  # pixels of the longer side of a frame, unless said otherwise
FLAT = 1 / 255  # one step of an 8-bit image: a smaller standard deviation says nothing


def check_frames(frames: Tensor) -> None:
    """Refuse what is not a batch of float frames."""
    if frames.ndim != 4 or not frames.is_floating_point():
        raise InputError(
            f"preprocess got {tuple(frames.shape)} {frames.dtype}; expected float frames (B,C,H,W) in [0, 1]"
        )


def channel_name(channel: str) -> str:
    """The name of a channel as it is kept: "grey", "R", "R-B"; upper and lower case mean the same."""
    name = str(channel).strip().upper()
    letters = name.split("-")
    if name == "GREY":
        return "grey"
    if len(letters) > 2 or len(set(letters)) < len(letters) or not set(letters) <= set(COLOURS):
        raise InputError(
            f"channel {channel!r} is unknown; expected 'grey', 'R', 'G', 'B' or a difference such as 'R-B'"
        )
    return name


def check_patch(patch: int) -> None:
    """Refuse a patch without a middle pixel, or without neighbours."""
    if patch < 3 or patch % 2 == 0:
        raise InputError(f"patch is {patch}; expected an odd number of pixels, at least 3")


def check_clahe(clip_limit: float, grid: tuple[int, int]) -> None:
    """Refuse a limit or a grid that makes no sense."""
    if not 0 <= clip_limit <= MOST_CLIP:
        raise InputError(
            f"clip_limit is {clip_limit}; expected a number of at least 0 (no limit), at most {MOST_CLIP:g}"
        )
    if len(grid) != 2 or any(tiles < 1 or tiles != int(tiles) for tiles in grid):
        raise InputError(f"grid is {tuple(grid)}; expected (rows, columns), whole numbers of at least 1")


def select_channel(frames: Tensor, channel: str) -> Tensor:
    """One channel of colour frames.

    Args:
        frames: RGB; for "grey" also frames that are grey already, which pass unchanged.
        channel: "grey" (luminance, 0.299 R + 0.587 G + 0.114 B), "R", "G", "B", or the difference of
            two of them such as "R-B", in upper or lower case. A difference lies in [-1, 1].

    Shape: (B,C,H,W) -> (B,1,H,W).

    Raises:
        InputError: not (B,C,H,W) float, an unknown channel, or frames that do not have it.

    Example:
        >>> sky = torch.tensor([0.25, 0.5, 1.0]).view(1, 3, 1, 1)
        >>> select_channel(sky, "R-B").item()
        -0.75
    """
    check_frames(frames)
    name = channel_name(channel)
    count = frames.shape[1]
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
    """Mean of the side x side pixels around each pixel; at the border only those inside count."""
    if torch.compiler.is_exporting():  # no onnxruntime pools in double precision
        return _row_mean(_row_mean(frames, side).mT, side).mT
    reach = side // 2
    pool = nn.functional.avg_pool2d  # one axis at a time: 2 * side values a pixel instead of side**2
    frames = pool(frames, (1, side), 1, (0, reach), count_include_pad=False)
    return pool(frames, (side, 1), 1, (reach, 0), count_include_pad=False)


def _row_mean(frames: Tensor, side: int) -> Tensor:
    """Mean of the side pixels of its row around each pixel, as a sum of rows that are moved."""
    width, reach = frames.shape[-1], side // 2
    padded, there = (nn.functional.pad(one, (reach, reach)) for one in (frames, frames.new_ones(width)))
    total, count = torch.zeros_like(frames), frames.new_zeros(width)
    for k in range(side):
        total, count = total + padded[..., k : k + width], count + there[k : k + width]
    return total / count


def normalise_patches(frames: Tensor, patch: int = 9) -> Tensor:
    """Each pixel minus the mean, divided by the standard deviation, of the patch around it.

    Args:
        frames: each channel is treated by itself.
        patch: side of the square patch in pixels, odd.

    Shape: (B,C,H,W) -> (B,C,H,W), mean about 0, unbounded.

    Convention: the patch slides with the pixel, so that there are no edges between patches; at the border
        only pixels inside the frame count. The standard deviation is that of the patch (divided by the
        number of pixels), and at least 1/255, so that noise in a flat sky is not blown up. Above that
        floor a gain and an offset of brightness change nothing. Gradients are finite everywhere.

    Source: Milford and Wyeth, SeqSLAM, ICRA 2012; there in patches side by side.

    Raises:
        InputError: not (B,C,H,W) float, an even patch or one under 3, or a frame smaller than the patch.

    Example:
        >>> checks = (torch.arange(8)[:, None] + torch.arange(8)).remainder(2)[None, None]
        >>> dark, bright = normalise_patches(0.5 + 0.1 * checks, patch=3)[0, 0, 0, :2]
        >>> round(dark.item(), 3), round(bright.item(), 3)  # half of four pixels, half of six
        (-1.0, 1.0)
    """
    check_frames(frames)
    check_patch(patch)
    height, width = frames.shape[-2:]
    if min(height, width) < patch:
        raise InputError(
            f"patch normalisation got frames of {height} x {width} pixels; "
            f"expected at least one patch, {patch} x {patch}"
        )

    def normalised(part: Tensor) -> Tensor:
        exact = part.double()  # the difference of the squares below cancels: too much for float32
        mean = box_mean(exact, patch)
        variance = box_mean(exact.square(), patch) - mean.square()
        return ((exact - mean) / variance.clamp(min=FLAT**2).sqrt()).to(part)

    return torch.cat([normalised(part) for part in parts(frames)])


def equalise(frames: Tensor, clip_limit: float = 2.0, grid: tuple[int, int] = (8, 8)) -> Tensor:
    """Contrast-limited adaptive histogram equalisation (CLAHE) by kornia, of each channel by itself.

    Args:
        frames: in [0, 1].
        clip_limit: a grey level counts at most this many times as often as in a flat histogram, and at
            least once; 0 is no limit. Of tiles under 256 / clip_limit pixels every level counts once.
        grid: (rows, columns) of tiles; they need not divide the frame.

    Shape: (B,C,H,W) -> (B,C,H,W), in [0, 1].

    Convention: a table of 256 grey levels has no gradient: it is passed straight through, as if the output
        followed the input one to one. The values do not depend on whether a gradient is asked for. Kornia's
        own differentiable form is not used: it gives other values (up to 0.3 away), and its gradient, that of
        the histograms without the pixel's own, does not follow the slope of what it computes.

    Raises:
        InputError: not (B,C,H,W) float, a bad clip limit or grid, values outside [0, 1], or a frame
            without a pixel more than the grid has tiles along both sides.

    Example:
        >>> dull = 0.4 + 0.2 * torch.rand(1, 1, 64, 64)
        >>> bool(equalise(dull, grid=(2, 2)).std() > dull.std())
        True
    """
    check_frames(frames)
    check_clahe(clip_limit, grid)
    if torch.compiler.is_exporting():
        raise InputError("clahe, by kornia, would fix the number of frames; expected another contrast")
    from kornia.enhance import equalize_clahe

    rows, columns = int(grid[0]), int(grid[1])
    height, width = frames.shape[-2:]
    if height <= rows or width <= columns:
        raise InputError(
            f"clahe got frames of {height} x {width} pixels for a grid of {rows} x {columns} tiles; "
            f"expected at least {rows + 1} x {columns + 1} pixels"
        )
    fixed = frames.detach()
    if not ((fixed >= 0) & (fixed <= 1)).all():
        low, high = fixed.min().item(), fixed.max().item()
        raise InputError(f"clahe got values from {low:g} to {high:g}; expected values in [0, 1]")
    even = torch.cat([equalize_clahe(part, float(clip_limit), (rows, columns)) for part in parts(fixed)])
    return frames + (even - fixed) if frames.requires_grad else even


class Preprocess(nn.Module):
    """`select_channel`, then `normalise_patches` ("patch") or `equalise` ("clahe"), as one module.

    Args:
        channel: "grey", "R", "G", "B", or a difference such as "R-B"; None keeps the frames' channels.
        contrast: "patch" normalises each pixel by the patch around it, "clahe" equalises the
            histograms of tiles; None keeps the contrast.
        patch: side of the patch for "patch", pixels, odd.
        clip_limit: for "clahe": a grey level counts at most this many times as often as in a flat
            histogram; 0 is no limit.
        grid: (rows, columns) of tiles for "clahe".
        size: pixels that the longer side of a traverse's frames is reduced to where it has more, but no
            further than the features' own `resize`; None keeps the frames' size. `DejaVu.fit` does so as
            frames are read, ahead of all else; forward does not.

    Shape: (B,C,H,W) -> (B,1,H,W), or (B,C,H,W) where `channel` is None.

    Convention: without channel and contrast the input itself is returned, whatever it is. Ahead of "clahe"
        a difference of channels d in [-1, 1] becomes (d + 1) / 2, in [0, 1].

    Raises:
        InputError: an unknown channel or contrast, a bad patch, clip limit, grid or size; forward: frames
            that do not fit them.

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
        check_patch(patch)
        check_clahe(clip_limit, grid)
        self.channel = None if channel is None else channel_name(channel)
        self.contrast: Contrast | None = contrast
        self.patch, self.size = patch, size
        self.clip_limit = float(clip_limit)
        self.grid = (int(grid[0]), int(grid[1]))  # a map gives a list

    def forward(self, frames: Tensor) -> Tensor:
        if self.channel is not None:
            frames = select_channel(frames, self.channel)
        if self.contrast == "patch":
            return normalise_patches(frames, self.patch)
        if self.contrast == "clahe":
            if self.channel is not None and "-" in self.channel:
                frames = (frames + 1) / 2
            return equalise(frames, self.clip_limit, self.grid)
        return frames

    def extra_repr(self) -> str:
        return (
            f"channel={self.channel!r}, contrast={self.contrast!r}, patch={self.patch}, "
            f"clip_limit={self.clip_limit}, grid={self.grid}, size={self.size}"
        )
