"""Rectangles of places, their tiles, and sums over them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

SIDE = 128  # windows of a tile to a side
GAP = 16  # windows between lattices in one plane: more than a camera moves from image to image
Cell = tuple[int, int]  # row and column
Point = tuple[float, float]  # x and y


class Tables(NamedTuple):
    """The first cell of each tile (T,2), its rows and columns (T,2), and its first place (T,)."""

    corner: Tensor
    size: Tensor
    start: Tensor


class Ground(NamedTuple):
    """Where the pixels of a picture lie.

    Args:
        first: (x, y) of its upper left corner. right, down: (x, y) from a pixel to the next of its row, and
            of its column. unit: of these, "px" or "m". frame: of the coordinates, see `Coordinates`.
    """

    first: Point = (0.0, 0.0)
    right: Point = (1.0, 0.0)
    down: Point = (0.0, 1.0)
    unit: str = "px"
    frame: str = "pixels"

    def scaled(self, across: float, down: float) -> Ground:
        """That of pixels so many times as large."""
        (a, b), (c, d) = self.right, self.down
        return self._replace(right=(a * across, b * across), down=(c * down, d * down))

    def at(self, pixels: Tensor) -> Tensor:
        """(x, y) of points (column, row) in pixels from the corner, (...,2) float64."""
        return pixels @ pixels.new_tensor([self.right, self.down]) + pixels.new_tensor(self.first)


class Rectangle(NamedTuple):
    """Places in rows and columns, whose numbers follow each other.

    Args:
        rows, columns: of places. first: (x, y) of the middle of the first window. right, down: (x, y) from a
            window to the next of its row, and of its column. corner: row and column of the first in the
            lattice of its route. route: its number. frames: of the reference; None is one for each place.
    """

    rows: int
    columns: int = 1
    first: Point = (0.0, 0.0)
    right: Point = (1.0, 0.0)
    down: Point = (0.0, 1.0)
    corner: Cell = (0, 0)
    route: int = 0
    frames: int | None = None

    @property
    def places(self) -> int:
        """The number of windows."""
        return self.rows * self.columns

    @property
    def shown(self) -> int:
        """The number of frames."""
        return self.places if self.frames is None else self.frames


class Run(NamedTuple):
    """Places of one route whose numbers follow each other: the route, and how many places and frames."""

    route: int
    places: int
    frames: int


def boxes(mass: Tensor, radius: int) -> Tensor:
    """Sums over squares of 2 radius + 1 windows to a side, (T,R,C) -> (T,R,C)."""
    side = 2 * radius + 1
    sums: Tensor = F.avg_pool2d(mass[:, None], side, 1, radius, divisor_override=1)[:, 0]
    return sums


def triangles(mass: Tensor, radius: int) -> Tensor:
    """Sums with weights of a triangle that ends at a radius, (Q,N) -> (Q,N): two box filters."""
    radius = min(radius, mass.shape[1])
    return window_sums(window_sums(F.pad(mass, (radius, radius)), radius + 1), radius + 1) / (radius + 1)


def window_sums(values: Tensor, width: int) -> Tensor:
    """Sums of `width` neighbours, (..., N + width - 1) -> (..., N).

    Example:
        >>> window_sums(torch.tensor([1.0, 2, 3, 4]), 3)
        tensor([6., 9.])
    """
    count, size, at, total = values.shape[-1] - width + 1, 1, 0, torch.zeros(())
    while True:  # sums of 1, 2, 4, .. neighbours, which is several times as fast as pooling
        if width & size:
            total, at = total + values.narrow(-1, at, count), at + size
        if (size := 2 * size) > width:
            return total
        values = values[..., : -(size // 2)] + values[..., size // 2 :]


def tables_of(rectangles: Sequence[Rectangle], corners: Sequence[Cell]) -> Tables:
    """Those of rectangles whose corners lie so in one plane."""
    with torch.inference_mode(False):  # cached tensors are also used with gradients
        return _cached_tables((*rectangles,), (*corners,), SIDE)


@lru_cache(16)
def _cached_tables(rectangles: tuple[Rectangle, ...], corners: tuple[Cell, ...], side: int) -> Tables:
    corner, size = list[Tensor](), list[Tensor]()
    for part, first in zip(rectangles, corners, strict=True):
        down, across = borders_of(part.rows, part.columns)
        corner.append(torch.cartesian_prod(down[:-1], across[:-1]).view(-1, 2) + torch.tensor(first))
        size.append(torch.cartesian_prod(down.diff(), across.diff()).view(-1, 2))
    sizes = torch.cat(size)
    return Tables(torch.cat(corner), sizes, torch.cat([sizes.new_zeros(1), sizes.prod(1).cumsum(0)[:-1]]))


def cells_of(places: Tensor, tables: Tables) -> Tensor:
    """Row and column of places, int64 of any shape -> (..., 2)."""
    corner, size, start = (table.to(places.device) for table in tables)
    tile = torch.bucketize(places.contiguous(), start, right=True) - 1
    inside, width = places - start[tile], size[tile, 1]
    return corner[tile] + torch.stack([inside // width, inside % width], -1)


def orders_of(
    rectangles: Sequence[Rectangle], corners: Sequence[Cell], extent: Cell
) -> tuple[Tensor, Tensor]:
    """The places of a plane row by row, (R C,), N where there is none, and the number of each place row by
    row, (N,), int64."""
    with torch.inference_mode(False):
        return _cached_orders((*rectangles,), (*corners,), extent, SIDE)


@lru_cache(2)  # of 16 bytes a window
def _cached_orders(
    rectangles: tuple[Rectangle, ...], corners: tuple[Cell, ...], extent: Cell, side: int
) -> tuple[Tensor, Tensor]:
    every = torch.arange(sum(one.places for one in rectangles))
    cells = cells_of(every, _cached_tables(rectangles, corners, side))
    rank = cells[:, 0] * extent[1] + cells[:, 1]
    order = torch.full((extent[0] * extent[1],), len(every))
    order[rank] = every
    return order, rank


def borders_of(rows: int, columns: int) -> tuple[Tensor, Tensor]:
    """The borders of tiles, rows and columns."""
    with torch.inference_mode(False):
        return _cached_borders(rows, columns, SIDE)


@lru_cache(64)
def _cached_borders(rows: int, columns: int, side: int) -> tuple[Tensor, Tensor]:
    down = _edges(rows, max(side, side * side // columns))
    return down, _edges(columns, max(1, side * side // max(1, int(down.diff().max()))))


def _edges(count: int, most: int) -> Tensor:
    """Borders of equal parts of about so many."""
    parts = max(1, round(count / most))
    return torch.arange(parts + 1) * count // parts
