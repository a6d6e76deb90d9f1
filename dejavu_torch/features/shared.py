"""Features of windows that overlap: the cells and feature maps that windows share are computed once.

A window is described with what lies around it: gradients and convolutions reach over its border. Queries are
windows alone, whose features differ there; the mean difference is added, see `Sharing.offset`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dejavu_torch.data.grid import Grid
from dejavu_torch.data.traverse import Kept, Part
from dejavu_torch.features.distilled import SIZE, STRIDES, WIDEST, Distilled
from dejavu_torch.features.hog import HOG, cell_histograms, gradients, normalised
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.views import AugmentedFrames
from dejavu_torch.resize import resize_frames
from dejavu_torch.types import Traverse

REACH = 16  # pixels of Distilled's frames that its convolutions reach over a border
PIXELS, WINDOWS = 2**22, 2**12  # that are described together
OVERLAP = 6  # strides of a window from which on this is faster
MOST = 7  # values of a feature map in a stride, likewise
SIDE, BLOCKS, ALONE = 16, 4, 32  # of blocks to a side whose windows are described both ways, so many of each


Cells = tuple[int, int]
Block = tuple[Cells, Cells]  # row and column of its first window, and how many rows and columns


class Windows(NamedTuple):
    """Windows of a picture: blocks of rows and columns, one after another, and row by row."""

    grid: Grid
    blocks: Sequence[Block]

    @classmethod
    def of(cls, traverse: Traverse | AugmentedFrames) -> Windows | None:
        """Those that a traverse is, if it is a picture, whole tiles of one, or `Blocks`."""
        grid, frames = traverse, range(len(traverse))
        if type(traverse) in (Part, Kept, Blocks):  # others change frames
            grid = cast(Part, traverse).traverse
        if not isinstance(grid, Grid):
            return None
        if isinstance(traverse, Blocks):
            starts = [*accumulate((rows * columns for rows, columns in traverse.sizes[:-1]), initial=0)]
            corners = grid.layout.cells(torch.as_tensor(traverse.frame)[starts]).tolist()
            return cls(grid, [((y, x), size) for (y, x), size in zip(corners, traverse.sizes, strict=True)])
        if isinstance(traverse, Part):
            if not isinstance(traverse.frame, range) or traverse.frame.step != 1:
                return None
            frames = traverse.frame
        ends = [*accumulate((rows * columns for rows, columns in grid.layout.tiles), initial=0)]
        if not {frames.start, frames.stop} <= {*ends}:
            return None
        tiles = [*zip(grid.layout.corners, grid.layout.tiles, strict=True)]
        return cls(grid, tiles[ends.index(frames.start) : ends.index(frames.stop)])


class Blocks(Part):
    """Frames that are blocks of an area one after another, each row by row. sizes: their rows and columns."""

    def __init__(self, traverse: Traverse, frame: Tensor, sizes: Sequence[Cells]) -> None:
        super().__init__(traverse, frame)
        self.sizes = sizes


class Sharing(NamedTuple):
    """Describes windows of a picture with what they share."""

    preprocess: Preprocess
    features: nn.Module
    device: torch.device

    @property
    def members(self) -> list[nn.Module]:
        """The features that are joined, or the only ones."""
        return [*self.features.members] if isinstance(self.features, Joined) else [self.features]

    def fits(self, grid: Grid) -> bool:
        """Whether the features of these windows are known."""
        own = self.preprocess
        plain = own.channel is None and own.contrast is None and own.span == (0, 1)
        return plain and all(_shares(member, grid.window, grid.stride) for member in self.members)

    def batches(self, windows: Windows, offset: Tensor | float = 0.0) -> Iterator[Tensor]:
        """Features (B,D) of windows, in the order of places, 0 for those that show nothing; see `offset`."""
        for corner, (rows, columns) in windows.blocks:
            for band in self._bands(windows.grid, corner, rows, columns):
                batch, shown = self._described(windows.grid, *band)
                yield (batch + offset) * shown[:, None].to(batch)

    def _bands(self, grid: Grid, corner: Cells, rows: int, columns: int) -> Iterator[Block]:
        """A block in parts of a few rows, whose cells, maps and features fit into memory."""
        (top, left), stride = corner, grid.stride
        width = (columns - 1) * stride + grid.window
        # a cell of HOG is computed every `step` pixels
        step = min([4, *(math.gcd(stride, one.cell or 1) for one in self.members if isinstance(one, HOG))])
        height = max(2 * grid.window, PIXELS // 4 * step // width)
        count = max(1, min((height - grid.window) // stride + 1, WINDOWS // columns))
        for first in range(0, rows, count):
            yield (top + first, left), (min(count, rows - first), columns)

    def _described(self, grid: Grid, corner: Cells, shape: Cells) -> tuple[Tensor, Tensor]:
        """Features of rows and columns of windows, (B,D), and which show something, (B,)."""
        (rows, columns), window, stride = shape, grid.window, grid.stride
        scaled = stride * SIZE[0] // window  # in the frames of Distilled
        strides = -(-REACH * window // (stride * SIZE[0]))
        margin = strides * stride
        pixels = grid.around(corner, shape, margin).to(self.device)
        shown = self._shows(pixels[..., margin:-margin, margin:-margin], window, stride)
        maps = [
            _cells(member, pixels, margin, window, stride)
            if isinstance(member, HOG)
            else _convolved(cast(Distilled, member), pixels, strides, scaled, shape)
            for member in self.members
        ]
        parts = [one[:rows, :columns].flatten(0, 1).flatten(1) for one in maps]
        return torch.cat(parts, 1), shown.flatten()

    def offset(self, grid: Grid) -> Tensor:
        """The mean difference (D,) of features of windows alone to those of `batches`, of some all over
        the picture."""
        rows, columns = grid.layout.rows, grid.layout.columns
        tall, wide = min(SIDE, rows), min(SIDE, columns)
        tops = torch.linspace(0, rows - tall, min(BLOCKS, rows // tall)).round().long()
        lefts = torch.linspace(0, columns - wide, min(BLOCKS, columns // wide)).round().long()
        inside = torch.cartesian_prod(torch.arange(tall), torch.arange(wide)).view(-1, 2)
        every, differences, shows = max(1, len(inside) // ALONE), [], []
        for top, left in torch.cartesian_prod(tops, lefts).view(-1, 2).tolist():
            shared, shown = self._described(grid, (top, left), (tall, wide))
            places = grid.layout.place_at(torch.tensor([top, left]) + inside[::every])
            differences.append(self.features(grid[places.tolist()].to(self.device)) - shared[::every])
            shows.append(shown[::every])
        shown = torch.cat(shows)
        return torch.cat(differences)[shown if shown.any() else ~shown].mean(0)

    def _shows(self, pixels: Tensor, window: int, stride: int) -> Tensor:
        """`Preprocess.shows` of the windows of pixels (1,C,H,W), in rows and columns."""
        mean, square = (
            F.avg_pool2d(F.avg_pool2d(one, (window, 1), (stride, 1)), (1, window), (1, stride))
            for one in (pixels.double(), pixels.double().square())
        )
        return (square - mean.square()).clamp(min=0).amax(1)[0] >= self.preprocess.blank**2


def _shares(member: nn.Module, window: int, stride: int) -> bool:
    if window < OVERLAP * stride:
        return False
    if type(member) is HOG:
        return member.resize is None and bool(member.cell) and window >= (member.cell or 1) * member.block
    scaled, rest = divmod(stride * SIZE[0], window)
    few = scaled // math.gcd(scaled, math.prod(STRIDES)) <= MOST
    return type(member) is Distilled and rest == 0 and few and WIDEST % member.grid == 0


def _cells(hog: HOG, pixels: Tensor, margin: int, window: int, stride: int) -> Tensor:
    """The blocks of HOG of each window, a view of blocks that windows share: (rows, columns, by, bx, ..)."""
    cell = hog.cell
    assert cell is not None
    step = math.gcd(stride, cell)
    dy, dx = (one[:, margin:-margin, margin:-margin] for one in gradients(pixels))
    parts = cell_histograms(dy, dx, hog.orientations, step, hog.bins).permute(0, 3, 1, 2)
    cells = F.avg_pool2d(parts, cell // step, 1)[0]  # (O,y,x), a cell at each step
    apart, block = cell // step, hog.block
    count = window // cell - block + 1
    reach = (block - 1) * apart
    high, wide = (side - reach for side in cells.shape[1:])
    stacked = torch.stack(
        [
            cells[:, y : y + high, x : x + wide]
            for y in range(0, reach + 1, apart)
            for x in range(0, reach + 1, apart)
        ]
    )
    blocks = normalised(stacked.permute(2, 3, 0, 1).flatten(2))  # (y,x,values)
    return _windows(blocks.permute(2, 0, 1), stride // step, apart, count).permute(0, 1, 3, 4, 2)


def _convolved(net: Distilled, pixels: Tensor, strides: int, stride: int, shape: tuple[int, int]) -> Tensor:
    """The pooled feature maps of each window, a view of maps that windows share: (rows, columns, 40, y, x).

    Args:
        strides: in the margin. stride: in pixels of the net's frames. shape: rows and columns of windows.
    """
    margin = strides * stride
    height, width = ((count - 1) * stride + SIZE[0] + 2 * margin for count in shape)
    pixels = pixels if pixels.shape[1] in (1, 3) else pixels.mean(1, True)
    values = 2 * resize_frames(pixels, (height, width)) - 1
    layers = dict(net.named_buffers())
    apart, step, first = 1, 1, 0  # pixels between taps, between values, and before the first value
    for i, halves in enumerate(STRIDES):
        weight, bias = (layers[f"{name}{i}"].to(values) for name in ("weight", "bias"))
        if not i and values.shape[1] == 1:  # see `distilled_maps`
            weight = weight.sum(1, keepdim=True)
        next_step = math.gcd(stride, apart * halves)
        values = F.conv2d(values.relu_() if i else values, weight, bias, next_step // step, 0, apart // step)
        first += weight.shape[-1] // 2 * apart
        apart, step = apart * halves, next_step
    values = values[0, :, (margin - first) // step :, (margin - first) // step :]
    taps = WIDEST // net.grid
    spacing = apart // step
    for axis in (1, 2):  # means of neighbours, as of a grid
        length = values.shape[axis] - (taps - 1) * spacing
        values = torch.stack([values.narrow(axis, spacing * k, length) for k in range(taps)]).mean(0)
    return _windows(values, stride // step, taps * spacing, net.grid)


def _windows(maps: Tensor, stride: int, apart: int, count: int) -> Tensor:
    """Values of each window, `count` x `count` of them `apart`, of maps (C,H,W): (rows, columns, C, y, x)."""
    maps = maps.contiguous()
    span = (count - 1) * apart + 1
    rows, columns = ((side - span) // stride + 1 for side in maps.shape[1:])
    of_channel, of_row, of_column = maps.stride()
    shape = (rows, columns, len(maps), count, count)
    strides = (stride * of_row, stride * of_column, of_channel, apart * of_row, apart * of_column)
    return maps.as_strided(shape, strides)
