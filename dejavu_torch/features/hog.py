"""Histograms of oriented gradients (section IV-A; Dalal and Triggs, CVPR 2005) in batches."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dejavu_torch.data.moving import sideways
from dejavu_torch.features.preprocess import check_frames, in_parts
from dejavu_torch.resize import check_size, resize_frames
from dejavu_torch.text import settings_of
from dejavu_torch.types import InputError, expect

MOST_ORIENTATIONS = 360
CELL, LARGE = 8, 100  # pixels: side of a cell, and the longer side of frames above which it is doubled
Bins = Literal["hard", "linear"]


class HOG(nn.Module):
    """Histograms of oriented gradients, by default equal to skimage.feature.hog to 1e-6 (section IV-A).

    Args:
        orientations: unsigned orientation bins in [0, 180) degrees.
        cell: side of a square cell, pixels; None is 8, or 16 of frames whose longer side exceeds 100 pixels.
            Pixels beyond the last whole cell only enter gradients.
        block: side of a square block, cells. Blocks overlap: they move by one cell.
        resize: (height, width) in pixels to resize to first, antialiased; None keeps the size.
        bins: "hard": a pixel votes for one bin, as in skimage. "linear": it shares its vote between the two
            nearest bin centres, (k + 0.5) * 180 / orientations, cyclic, which gives orientation a gradient.

    Shape: (B,C,H,W) -> (B,D) with D = (ny - block + 1) * (nx - block + 1) * block**2 * orientations,
        ny = H // cell, nx = W // cell; ordered as in skimage.

    Convention: each pixel has the gradient of its strongest channel. Blocks are normalised by L2-Hys.
        Gradients with respect to the frames are finite everywhere.

    Raises:
        InputError: settings out of range; forward: not (B,C,H,W) float, or smaller than one block.
    """

    def __init__(
        self,
        orientations: int = 9,
        cell: int | None = 8,
        block: int = 2,
        resize: tuple[int, int] | None = None,
        bins: Bins = "hard",
    ) -> None:
        super().__init__()
        self.resize = _checked(orientations, CELL if cell is None else cell, block, resize, bins)
        self.orientations, self.cell, self.block = orientations, cell, block
        self.chooses = cell is None
        self.bins: Bins = bins

    def forward(self, frames: Tensor) -> Tensor:
        cell = self.cell or cell_for(*(self.resize or frames.shape[2:]))
        return hog(frames, self.orientations, cell, self.block, self.resize, self.bins)

    def moved(self, frames: Tensor, shifts: Sequence[float]) -> Tensor:
        """The features of frames moved sideways, see `Moved`, by histograms that are computed once, of
        quarters of a cell: (B,C,H,W) -> (B,V,D)."""
        cell = self.cell or cell_for(*(self.resize or frames.shape[2:]))
        parts = next(parts for parts in (4, 2, 1) if cell % parts == 0)
        part = cell // parts

        def described(some: Tensor) -> Tensor:
            exact = some.to(torch.promote_types(some.dtype, torch.float32))
            rows, columns = gradients(resize_frames(exact, self.resize))
            ny, nx = (side // cell for side in rows.shape[1:])
            rows, columns = rows[:, : ny * cell], columns[:, : ny * cell]
            votes = cell_histograms(rows, columns, self.orientations, part, self.bins)
            votes = F.avg_pool2d(votes.permute(0, 3, 1, 2), (parts, 1))  # (B,O,ny,columns of parts)
            by = torch.tensor(shifts, device=votes.device)[:, None] * columns.shape[2] / part
            at = torch.arange(nx * parts, device=votes.device) - by
            cells = sideways(votes, at.flatten(), lambda seen: seen.flip(1))
            cells = F.avg_pool2d(cells, (1, parts)).unflatten(3, (len(shifts), nx))
            found = blocks_of(cells.permute(0, 3, 2, 4, 1).flatten(0, 1), self.block)
            return found.view(-1, len(shifts), found.shape[1])

        return in_parts(described, frames).to(frames.dtype)

    def for_frames(self, height: int, width: int) -> HOG:
        """The same, but with the cell of frames of this size, if it was None: a map's file names it."""
        if not self.chooses:
            return self
        sized = copy.copy(self)
        sized.cell = cell_for(*(self.resize or (height, width)))
        return sized

    extra_repr = settings_of


def hog(
    frames: Tensor,
    orientations: int = 9,
    cell: int = 8,
    block: int = 2,
    resize: tuple[int, int] | None = None,
    bins: Bins = "hard",
) -> Tensor:
    """`HOG` as a function.

    Example:
        >>> hog(torch.rand(5, 1, 64, 64)).shape
        torch.Size([5, 1764])
    """
    resize = _checked(orientations, cell, block, resize, bins)
    check_frames(frames, "HOG got")
    height, width = frames.shape[-2:] if resize is None else resize
    if min(height, width) < cell * block:
        least = f"{cell * block} x {cell * block}"
        raise InputError(f"HOG got frames of {height} x {width}; expected at least {least}")

    def described(part: Tensor) -> Tensor:
        exact = part.to(torch.promote_types(part.dtype, torch.float32))
        rows, columns = gradients(resize_frames(exact, resize))
        histograms = cell_histograms(rows, columns, orientations, cell, bins)
        return blocks_of(histograms, block).to(part.dtype)

    return in_parts(described, frames)


def blocks_of(histograms: Tensor, block: int) -> Tensor:
    """Normalised overlapping blocks of the histograms of cells: (B,ny,nx,O) -> (B,D)."""
    blocks = histograms.unfold(1, block, 1).unfold(2, block, 1)  # (B,by,bx,O,block,block)
    return normalised(blocks.permute(0, 1, 2, 4, 5, 3).flatten(3)).flatten(1)


def cell_for(*size: int) -> int:
    """The side of a cell for frames of this size, in pixels: on large frames small cells only take bytes."""
    return 2 * CELL if max(size) > LARGE else CELL


def _checked(
    orientations: int, cell: int, block: int, resize: tuple[int, int] | None, bins: str
) -> tuple[int, int] | None:
    """The size to resize to, if all settings of `HOG` are in range."""
    least, most = min(orientations, cell, block), MOST_ORIENTATIONS
    seen = f"orientations={orientations}, cell={cell}, block={block}, bins={bins!r}"
    expected = f"at least 1 each, at most {most} orientations, bins 'hard' or 'linear'"
    expect(least >= 1 and orientations <= most and bins in ("hard", "linear"), expected, f"HOG got {seen}")
    return None if resize is None else check_size(resize, cell * block, "HOG got resize")


def gradients(frames: Tensor) -> tuple[Tensor, Tensor]:
    """f(x + 1) - f(x - 1) of rows and columns, 0 at borders, in the strongest channel, two (B,H,W)."""
    rows, columns = torch.zeros_like(frames), torch.zeros_like(frames)
    rows[:, :, 1:-1] = frames[:, :, 2:] - frames[:, :, :-2]
    columns[..., 1:-1] = frames[..., 2:] - frames[..., :-2]
    row, column = rows[:, 0], columns[:, 0]
    longest, *others = torch.hypot(rows.detach(), columns.detach()).unbind(1)
    for channel, length in enumerate(others, 1):  # much faster than argmax and gather
        longer = length > longest
        longest = torch.maximum(longest, length)
        # 0 or 1, for which lerp of finite numbers is exact, and six times as fast as where
        chosen = longer.to(row.dtype)
        row = torch.lerp(row, rows[:, channel], chosen)
        column = torch.lerp(column, columns[:, channel], chosen)
    return row, column


def cell_histograms(dy: Tensor, dx: Tensor, orientations: int, cell: int, bins: Bins = "hard") -> Tensor:
    """Mean gradient magnitude per cell and bin: two of (B,H,W) -> (B, H // cell, W // cell, orientations)."""
    batch, height, width = dy.shape
    ny, nx = height // cell, width // cell
    dy, dx = dy[:, : ny * cell, : nx * cell], dx[:, : ny * cell, : nx * cell]
    energy = dy.square() + dx.square()
    # sqrt has no gradient at 0: flat pixels are masked before and after it, which makes their gradient 0
    flat = energy == 0
    magnitude = energy.masked_fill(flat, 1).sqrt().masked_fill(flat, 0)
    if bins == "linear":
        # atan2 has no gradient at 0 or if the square underflows; such a pixel has no vote to share
        dx = dx.masked_fill(energy < torch.finfo(energy.dtype).tiny, 1)
    else:  # detach, since torch.export cannot save no_grad
        dy, dx = dy.detach(), dx.detach()
    # in degrees, the bin edges 45, 90 and 135 are exact in float32 too
    position = torch.rad2deg(torch.atan2(dy, dx)).remainder(180) / (180 / orientations)
    if bins == "hard":  # rounding may reach the end of the circle; the magnitude passes NaN on
        shares = [(position.long().masked_fill_(~(position < orientations), 0), magnitude)]
    else:
        position = position - 0.5
        floor = position.detach().floor()
        lower, upper_share = floor.long(), position - floor
        shares = [
            (lower.remainder(orientations), magnitude * (1 - upper_share)),
            ((lower + 1).remainder_(orientations), magnitude * upper_share),
        ]
    if dy.device.type != "cpu":  # three operations, and the same sums each time
        bin = torch.arange(orientations, device=dy.device)[:, None, None]
        voted = torch.stack([(slot[:, None] == bin) * share[:, None] for slot, share in shares])
        return F.avg_pool2d(voted.sum(0), cell).permute(0, 2, 3, 1).contiguous()
    y, x = (torch.arange(n * cell, device=dy.device).div(cell, rounding_mode="floor") for n in (ny, nx))
    first = (y[:, None] * nx + x) * orientations
    votes = magnitude.new_zeros(batch, ny * nx * orientations)
    for slot, share in shares:
        votes = votes.scatter_add(1, slot.add_(first).flatten(1), share.flatten(1))
    return votes.view(batch, ny, nx, orientations) / cell**2


def normalised(blocks: Tensor) -> Tensor:
    """L2-Hys of the histograms of blocks (.., V)."""
    return _unit(_unit(blocks).clamp(max=0.2))


def _unit(blocks: Tensor) -> Tensor:
    return blocks / (blocks.square().sum(-1, keepdim=True) + 1e-5**2).sqrt()
