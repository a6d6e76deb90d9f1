"""Places in a plane: the rows and columns of windows over an area, numbered tile by tile."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

SIDE = 128  # windows of a tile to a side
Tables = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


class Ground(NamedTuple):
    """Where the pixels of a picture lie.

    Args:
        first: (x, y) of its upper left corner. right, down: (x, y) from a pixel to the next of its row, and
            of its column. unit: of these, "px" or "m". frame: of the coordinates, see `Coordinates`.
    """

    first: tuple[float, float] = (0.0, 0.0)
    right: tuple[float, float] = (1.0, 0.0)
    down: tuple[float, float] = (0.0, 1.0)
    unit: str = "px"
    frame: str = "pixels"

    def scaled(self, across: float, down: float) -> Ground:
        """That of pixels so many times as large."""
        (a, b), (c, d) = self.right, self.down
        return self._replace(right=(a * across, b * across), down=(c * down, d * down))

    def at(self, pixels: Tensor) -> Tensor:
        """(x, y) of points (column, row) in pixels from the corner, (...,2) float64."""
        return pixels @ pixels.new_tensor([self.right, self.down]) + pixels.new_tensor(self.first)


class Area(NamedTuple):
    """Windows in rows and columns, as over a picture of the ground.

    Args:
        rows, columns: of windows. first: (x, y) of the middle of the first window. right, down: (x, y) from a
            window to the next of its row, and of its column. unit: of these, "px" or "m".

    Convention: places are numbered tile by tile and in a tile row by row, so that a tile is a run of places.
        Tiles are as equal as possible and have about `SIDE`^2 windows, `SIDE` to a side unless the area is
        narrower.

    Example:
        >>> area = Area(2, 3, first=(32.0, 32.0), right=(4.0, 0.0), down=(0.0, 4.0))
        >>> area.coordinates(torch.tensor([0, 2, 3])).tolist()
        [[32.0, 32.0], [40.0, 32.0], [32.0, 36.0]]
    """

    rows: int
    columns: int
    first: tuple[float, float] = (0.0, 0.0)
    right: tuple[float, float] = (1.0, 0.0)
    down: tuple[float, float] = (0.0, 1.0)
    unit: str = "px"

    @property
    def places(self) -> int:
        """N, the number of windows."""
        return self.rows * self.columns

    @property
    def north(self) -> float:
        """Degrees clockwise from the upper side of the picture to north, where y grows (in pixels: falls)."""
        (a, b), (c, d) = self.right, self.down
        sign = (a * d - b * c) * (-1 if self.unit == "m" else 1)
        return math.degrees(math.atan2(sign * c, sign * a))

    @property
    def tiles(self) -> list[tuple[int, int]]:
        """Rows and columns of each tile."""
        _, size, *_ = _tiles(self.rows, self.columns)
        return [(rows, columns) for rows, columns in size.tolist()]

    @property
    def corners(self) -> list[tuple[int, int]]:
        """Row and column of the first window of each tile."""
        corner, *_ = _tiles(self.rows, self.columns)
        return [(row, column) for row, column in corner.tolist()]

    def orders(self) -> tuple[Tensor, Tensor]:
        """The places row by row, and the number of each place row by row, (N,) int64."""
        with torch.inference_mode(False):  # as `_tiles`
            return _cached_orders(self.rows, self.columns, SIDE)

    def columns_from(self, place: int) -> int:
        """The columns of the tile that begins at a place."""
        _, size, start, *_ = _tiles(self.rows, self.columns)
        return int(size[int((start == place).nonzero()[0]), 1])

    def cells(self, places: Tensor) -> Tensor:
        """Row and column of places, int64 of any shape -> (..., 2)."""
        corner, size, start, *_ = (table.to(places.device) for table in _tiles(self.rows, self.columns))
        tile = torch.bucketize(places.contiguous(), start, right=True) - 1
        inside, width = places - start[tile], size[tile, 1]
        return corner[tile] + torch.stack([inside // width, inside % width], -1)

    def place_at(self, cells: Tensor) -> Tensor:
        """The places of rows and columns inside the area, (..., 2) -> (...)."""
        tables = (table.to(cells.device) for table in _tiles(self.rows, self.columns))
        corner, size, start, tops, lefts = tables
        row = torch.bucketize(cells[..., 0].contiguous(), tops, right=True) - 1
        column = torch.bucketize(cells[..., 1].contiguous(), lefts, right=True) - 1
        tile = row * len(lefts) + column
        inside = cells - corner[tile]
        return start[tile] + inside[..., 0] * size[tile, 1] + inside[..., 1]

    def coordinates(self, places: Tensor) -> Tensor:
        """(x, y) of the middle of windows, int64 (...) -> (..., 2) float64."""
        steps = torch.tensor([self.down, self.right], dtype=torch.float64, device=places.device)
        return self.cells(places).double() @ steps + steps.new_tensor(self.first)

    def distance(self, one: Tensor, other: Tensor) -> Tensor:
        """The larger of the distances in rows and columns, int64."""
        return (self.cells(one) - self.cells(other)).abs().amax(-1)

    def around(self, places: Tensor, radius: int) -> Tensor:
        """The windows up to a radius in rows and columns, (n,) -> (n, (2 radius + 1)^2); those beyond a
        border are others of them."""
        offset = torch.arange(-radius, radius + 1, device=places.device)
        cells = self.cells(places)[:, None] + torch.cartesian_prod(offset, offset)
        most = torch.tensor([self.rows - 1, self.columns - 1], device=places.device)
        return self.place_at(torch.minimum(cells.clamp(min=0), most))


def area_of(stored: Mapping[str, Any]) -> Area:
    """An area from the values of `_asdict`, as JSON keeps them."""
    points: dict[str, Any] = {name: tuple(stored[name]) for name in ("first", "right", "down")}
    return Area(**{**stored, **points})


def distance(one: Tensor, other: Tensor, area: Area | None) -> Tensor:
    """Places between two, along a route or in an area."""
    return (one - other).abs() if area is None else area.distance(one, other)


def around(places: Tensor, radius: int, count: int, area: Area | None) -> Tensor:
    """The places up to a radius from each, (n,) -> (n, m), of N = `count`; some may be named twice."""
    if area is not None:
        return area.around(places, radius)
    radius = min(radius, count)
    offset = torch.arange(-radius, radius + 1, device=places.device)
    return (places[:, None] + offset).clamp(0, count - 1)


def _tiles(rows: int, columns: int) -> Tables:
    """The first cell of each tile (T,2), its rows and columns (T,2), and its first place (T,); the first rows
    of tiles, and the first columns."""
    with torch.inference_mode(False):  # cached tensors are also used with gradients
        return _cached_tiles(rows, columns)


@lru_cache(16)
def _cached_tiles(rows: int, columns: int) -> Tables:
    down = _edges(rows, max(SIDE, SIDE * SIDE // columns))
    across = _edges(columns, SIDE * SIDE // int(down.diff().max()))
    corner = torch.cartesian_prod(down[:-1], across[:-1]).view(-1, 2)
    size = torch.cartesian_prod(down.diff(), across.diff()).view(-1, 2)
    start = torch.cat([size.new_zeros(1), size.prod(1).cumsum(0)[:-1]])
    return corner, size, start, down[:-1].contiguous(), across[:-1].contiguous()


@lru_cache(2)  # of 16 bytes a window
def _cached_orders(rows: int, columns: int, side: int) -> tuple[Tensor, Tensor]:
    cells = torch.cartesian_prod(torch.arange(rows), torch.arange(columns)).view(-1, 2)
    order = Area(rows, columns).place_at(cells)
    return order, order.argsort()


def _edges(count: int, most: int) -> Tensor:
    """Borders of equal parts of about so many."""
    parts = max(1, round(count / most))
    return torch.arange(parts + 1) * count // parts
