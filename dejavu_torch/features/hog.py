"""Histograms of oriented gradients (section IV-A; Dalal and Triggs, CVPR 2005) as batched tensor ops."""

from __future__ import annotations

import torch
from kornia.geometry.transform import resize as antialiased_resize
from torch import Tensor, nn

from dejavu_torch.types import InputError


def gradients(frames: Tensor) -> tuple[Tensor, Tensor]:
    """Central differences along rows and columns, zero at the border, of the strongest channel.

    Shape: (B,C,H,W) -> two of (B,H,W).
    """
    rows = torch.zeros_like(frames)
    columns = torch.zeros_like(frames)
    rows[:, :, 1:-1] = frames[:, :, 2:] - frames[:, :, :-2]
    columns[..., 1:-1] = frames[..., 2:] - frames[..., :-2]
    if frames.shape[1] == 1:
        return rows[:, 0], columns[:, 0]
    strongest = torch.hypot(rows.detach(), columns.detach()).argmax(1, keepdim=True)
    return rows.gather(1, strongest)[:, 0], columns.gather(1, strongest)[:, 0]


def cell_histograms(rows: Tensor, columns: Tensor, orientations: int, cell: int) -> Tensor:
    """Mean gradient magnitude per cell and unsigned orientation bin; each pixel votes for one bin.

    Shape: (B,H,W), (B,H,W) -> (B, H // cell, W // cell, orientations).
    """
    batch, height, width = rows.shape
    ny, nx = height // cell, width // cell
    rows, columns = rows[:, : ny * cell, : nx * cell], columns[:, : ny * cell, : nx * cell]
    energy = rows.square() + columns.square()
    # sqrt has no gradient at 0: a flat pixel takes the constant branch, and its gradient is 0
    flat = energy == 0
    magnitude = torch.where(flat, energy, torch.where(flat, torch.ones_like(energy), energy).sqrt())
    with torch.no_grad():
        # in degrees 45, 90 and 135 are exact, also in float32: they lie on bin edges
        degrees = torch.rad2deg(torch.atan2(rows, columns)).remainder(180)
        slot = (degrees / (180 / orientations)).long().remainder_(orientations)
        y = torch.arange(ny * cell, device=rows.device).div(cell, rounding_mode="floor")
        x = torch.arange(nx * cell, device=rows.device).div(cell, rounding_mode="floor")
        slot += (y[:, None] * nx + x) * orientations
        slot += (torch.arange(batch, device=rows.device) * (ny * nx * orientations))[:, None, None]
    votes = magnitude.new_zeros(batch * ny * nx * orientations)
    votes = votes.scatter_add(0, slot.flatten(), magnitude.flatten())
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
) -> Tensor:
    """Histograms of oriented gradients, equal to skimage.feature.hog to 1e-6 (section IV-A).

    Args:
        frames: grey or colour images; of a colour image each pixel takes its strongest channel.
        orientations: unsigned orientation bins in [0, 180) degrees.
        cell: side of a square cell, pixels. Pixels beyond the last whole cell only feed gradients.
        block: side of a square block, cells. Blocks overlap: they move by one cell.
        resize: (height, width) in pixels to resize to first, antialiased; None keeps the size.

    Shape: (B,C,H,W) -> (B,D) with D = (ny - block + 1) * (nx - block + 1) * block**2 * orientations,
        ny = H // cell, nx = W // cell; ordered as skimage orders its feature vector.

    Convention: bins are hard (a pixel votes for one bin) and blocks are normalised by L2-Hys.
        Gradients with respect to the frames are finite everywhere, also on a flat image.

    Raises:
        InputError: not (B,C,H,W) float, or smaller than one block.

    Example:
        >>> hog(torch.rand(5, 1, 64, 64)).shape
        torch.Size([5, 1764])
    """
    if frames.ndim != 4 or not frames.is_floating_point():
        raise InputError(
            f"HOG got {tuple(frames.shape)} {frames.dtype}; expected float frames (B,C,H,W) in [0, 1]"
        )
    if resize is not None and tuple(frames.shape[-2:]) != tuple(resize):
        frames = antialiased_resize(frames, resize, antialias=True)
    height, width = frames.shape[-2:]
    if min(height, width) < cell * block:
        raise InputError(
            f"HOG got frames of {height} x {width} pixels; "
            f"expected at least one block, {cell * block} x {cell * block}"
        )
    histograms = cell_histograms(*gradients(frames), orientations, cell)
    blocks = histograms.unfold(1, block, 1).unfold(2, block, 1)  # (B,by,bx,O,block,block)
    blocks = blocks.permute(0, 1, 2, 4, 5, 3).flatten(3)
    return l2_hys(blocks).flatten(1)


class HOG(nn.Module):
    """`hog` as a module; the arguments are those of the function.

    Shape: (B,C,H,W) -> (B,D).
    """

    def __init__(
        self,
        orientations: int = 9,
        cell: int = 8,
        block: int = 2,
        resize: tuple[int, int] | None = None,
    ) -> None:
        super().__init__()
        if min(orientations, cell, block) < 1:
            raise InputError(
                f"HOG got orientations={orientations}, cell={cell}, block={block}; expected at least 1 each"
            )
        if resize is not None and (len(resize) != 2 or min(resize) < cell * block):
            raise InputError(
                f"HOG got resize={resize}; expected (height, width), at least {cell * block} pixels each"
            )
        self.orientations = orientations
        self.cell = cell
        self.block = block
        self.resize = None if resize is None else (int(resize[0]), int(resize[1]))  # a map gives a list

    def forward(self, frames: Tensor) -> Tensor:
        return hog(frames, self.orientations, self.cell, self.block, self.resize)

    def extra_repr(self) -> str:
        return f"orientations={self.orientations}, cell={self.cell}, block={self.block}, resize={self.resize}"
