"""Histograms of oriented gradients (section IV-A; Dalal and Triggs, CVPR 2005) as batched tensor ops."""

from __future__ import annotations

import math
from typing import Literal, get_args

import torch
from torch import Tensor, nn

from dejavu_torch.resize import check_size, resize_frames
from dejavu_torch.types import InputError

Bins = Literal["hard", "linear"]
Gradient = Literal["central", "sobel"]
VALUES_AT_ONCE = 2**19  # of the frames of one part, so that what lies between stays in the cache


def parts(frames: Tensor) -> tuple[Tensor, ...]:
    """A batch in parts of at most VALUES_AT_ONCE values, at least one frame each; whole where compiled."""
    if torch.compiler.is_compiling():  # the number of parts would fix the batch
        return (frames,)
    return torch.split(frames, max(1, VALUES_AT_ONCE // max(1, math.prod(frames.shape[1:]))))


def check_names(bins: str, gradient: str) -> None:
    """Refuse names of bins and gradients that are not known."""
    if bins not in get_args(Bins):
        raise InputError(f"HOG got bins={bins!r}; expected 'hard' or 'linear'")
    if gradient not in get_args(Gradient):
        raise InputError(f"HOG got gradient={gradient!r}; expected 'central' or 'sobel'")


def gradients(frames: Tensor, gradient: Gradient = "central") -> tuple[Tensor, Tensor]:
    """Gradients along rows and columns, of the strongest channel; see `hog` for the two kinds.

    Shape: (B,C,H,W) -> two of (B,H,W).
    """
    if gradient == "sobel":
        from kornia.filters import spatial_gradient

        columns, rows = spatial_gradient(frames, "sobel").unbind(2)  # kornia gives x, then y
    else:
        rows = torch.zeros_like(frames)
        columns = torch.zeros_like(frames)
        rows[:, :, 1:-1] = frames[:, :, 2:] - frames[:, :, :-2]
        columns[..., 1:-1] = frames[..., 2:] - frames[..., :-2]
    row, column = rows[:, 0], columns[:, 0]
    longest, *others = torch.hypot(rows.detach(), columns.detach()).unbind(1)
    for channel, length in enumerate(others, 1):  # much faster than argmax and gather
        longer = length > longest
        longest = torch.where(longer, length, longest)
        row = torch.where(longer, rows[:, channel], row)
        column = torch.where(longer, columns[:, channel], column)
    return row, column


def bin_shares(
    rows: Tensor, columns: Tensor, magnitude: Tensor, orientations: int, bins: Bins
) -> list[tuple[Tensor, Tensor]]:
    """The orientation bins that each pixel votes for: one pair (bin, share of the magnitude), or two.

    Shape: three of (B,H,W) -> pairs of (B,H,W) int64 and (B,H,W).
    """
    if bins == "linear":
        # atan2 has no gradient at 0, nor where the square underflows: such a pixel has no vote to share
        columns = columns.masked_fill(rows.square() + columns.square() < torch.finfo(rows.dtype).tiny, 1)
    else:  # detached, not under no_grad: a program with that in it is exported, but cannot be saved
        rows, columns = rows.detach(), columns.detach()
    # in degrees 45, 90 and 135 are exact, also in float32: they lie on bin edges
    degrees = torch.rad2deg(torch.atan2(rows, columns)).remainder(180)
    position = degrees / (180 / orientations)
    if bins == "hard":
        lower = position.long()
        # rounding may reach the end of the circle; NaN may be anything, and stays NaN in the magnitude
        return [(lower.masked_fill_((lower < 0) | (lower >= orientations), 0), magnitude)]
    position = position - 0.5  # bin k has its centre at k + 0.5
    floor = position.detach().floor()
    lower, upper_share = floor.long(), position - floor
    upper = (lower + 1).remainder_(orientations)
    return [
        (lower.remainder_(orientations), magnitude * (1 - upper_share)),
        (upper, magnitude * upper_share),
    ]


def cell_histograms(
    rows: Tensor, columns: Tensor, orientations: int, cell: int, bins: Bins = "hard"
) -> Tensor:
    """Mean gradient magnitude per cell and unsigned orientation bin; see `hog` for the two kinds of bins.

    Shape: (B,H,W), (B,H,W) -> (B, H // cell, W // cell, orientations).
    """
    batch, height, width = rows.shape
    ny, nx = height // cell, width // cell
    rows, columns = rows[:, : ny * cell, : nx * cell], columns[:, : ny * cell, : nx * cell]
    energy = rows.square() + columns.square()
    # sqrt has no gradient at 0: a flat pixel is masked on both sides of it, and its gradient is 0
    flat = energy == 0
    magnitude = energy.masked_fill(flat, 1).sqrt().masked_fill(flat, 0)
    y = torch.arange(ny * cell, device=rows.device).div(cell, rounding_mode="floor")
    x = torch.arange(nx * cell, device=rows.device).div(cell, rounding_mode="floor")
    first = (y[:, None] * nx + x) * orientations
    votes = magnitude.new_zeros(batch, ny * nx * orientations)
    for slot, share in bin_shares(rows, columns, magnitude, orientations, bins):
        votes = votes.scatter_add(1, slot.add_(first).flatten(1), share.flatten(1))
    return votes.view(batch, ny, nx, orientations) / cell**2


def l2_hys(blocks: Tensor, clip: float = 0.2, eps: float = 1e-5) -> Tensor:
    """L2 norm, clip at 0.2, L2 norm again, over the last dimension."""
    blocks = blocks / (blocks.square().sum(-1, keepdim=True) + eps**2).sqrt()
    blocks = blocks.clamp(max=clip)
    return blocks / (blocks.square().sum(-1, keepdim=True) + eps**2).sqrt()


def hog(
    frames: Tensor,
    orientations: int = 9,
    cell: int = 8,
    block: int = 2,
    resize: tuple[int, int] | None = None,
    bins: Bins = "hard",
    gradient: Gradient = "central",
) -> Tensor:
    """Histograms of oriented gradients, by default equal to skimage.feature.hog to 1e-6 (section IV-A).

    Args:
        frames: grey or colour images; of a colour image each pixel takes its strongest channel.
        orientations, cell, block, resize, bins, gradient: see `HOG`.

    Shape: (B,C,H,W) -> (B,D) with D = (ny - block + 1) * (nx - block + 1) * block**2 * orientations,
        ny = H // cell, nx = W // cell; ordered as skimage orders its feature vector.

    Convention: blocks are normalised by L2-Hys. Gradients with respect to the frames are finite
        everywhere, also on a flat image.

    Raises:
        InputError: not (B,C,H,W) float, smaller than one block, or an unknown name.

    Example:
        >>> hog(torch.rand(5, 1, 64, 64)).shape
        torch.Size([5, 1764])
    """
    check_names(bins, gradient)
    if not isinstance(frames, Tensor):
        raise InputError(f"HOG got a {type(frames).__name__}; expected a tensor of frames (B,C,H,W)")
    if frames.ndim != 4 or not frames.is_floating_point():
        raise InputError(
            f"HOG got {tuple(frames.shape)} {frames.dtype}; expected float frames (B,C,H,W) in [0, 1]"
        )
    height, width = frames.shape[-2:] if resize is None else resize
    if min(height, width) < cell * block:
        raise InputError(
            f"HOG got frames of {height} x {width} pixels; "
            f"expected at least one block, {cell * block} x {cell * block}"
        )

    def features(part: Tensor) -> Tensor:
        part = resize_frames(part, resize)
        histograms = cell_histograms(*gradients(part, gradient), orientations, cell, bins)
        blocks = histograms.unfold(1, block, 1).unfold(2, block, 1)  # (B,by,bx,O,block,block)
        blocks = blocks.permute(0, 1, 2, 4, 5, 3).flatten(3)
        return l2_hys(blocks).flatten(1)

    return torch.cat([features(part) for part in parts(frames)])


class HOG(nn.Module):
    """Histograms of oriented gradients: `hog` as a module.

    Args:
        orientations: unsigned orientation bins in [0, 180) degrees.
        cell: side of a square cell, pixels. Pixels beyond the last whole cell only feed gradients.
        block: side of a square block, cells. Blocks overlap: they move by one cell.
        resize: (height, width) in pixels to resize to first, antialiased; None keeps the size.
        bins: "hard": a pixel votes for the bin its orientation lies in (as skimage), so that only the
            magnitude carries gradient to the frames. "linear", the trainable form: it shares its vote between
            the two nearest bin centres, (k + 0.5) * 180 / orientations degrees, cyclic over 180; the
            orientation carries gradient too.
        gradient: "central" differences f(x + 1) - f(x - 1), zero at the border, or "sobel": Sobel's
            smoothed slope, with the border pixels repeated, so that the border votes too. It is half the
            central difference on a ramp, which the blocks' norm takes out again, and slower.

    Shape: (B,C,H,W) -> (B,D).
    """

    def __init__(
        self,
        orientations: int = 9,
        cell: int = 8,
        block: int = 2,
        resize: tuple[int, int] | None = None,
        bins: Bins = "hard",
        gradient: Gradient = "central",
    ) -> None:
        super().__init__()
        check_names(bins, gradient)
        if min(orientations, cell, block) < 1:
            raise InputError(
                f"HOG got orientations={orientations}, cell={cell}, block={block}; expected at least 1 each"
            )
        if resize is not None:
            check_size(resize, cell * block, "HOG got resize")
        self.orientations = orientations
        self.cell = cell
        self.block = block
        self.resize = None if resize is None else (int(resize[0]), int(resize[1]))  # a map gives a list
        self.bins: Bins = bins
        self.gradient: Gradient = gradient

    def forward(self, frames: Tensor) -> Tensor:
        return hog(frames, self.orientations, self.cell, self.block, self.resize, self.bins, self.gradient)

    def extra_repr(self) -> str:
        return (
            f"orientations={self.orientations}, cell={self.cell}, block={self.block}, resize={self.resize}, "
            f"bins={self.bins}, gradient={self.gradient}"
        )
