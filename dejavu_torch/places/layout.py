"""Where places lie: rows and columns, numbered tile by tile; a route is rows of one column."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch import Tensor

SIDE = 128  # windows of a tile to a side
GAP = 16  # windows between areas that are not of one ground: more than a camera moves from image to image


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


class Layout(NamedTuple):
    """Places in rows and columns: windows over a picture of the ground, or those of a route in one column.

    Args:
        rows, columns: of places. first: (x, y) of the middle of the first window. right, down: (x, y) from a
            window to the next of its row, and of its column. unit: of these, "px" or "m". frame: of the
            coordinates, see `Coordinates`, "" if unknown. corner: row and column of the first window in an
            area of several `parts`, whose places follow each other; not all rows and columns of their bounds
            are windows.

    Convention: places are numbered tile by tile and in a tile row by row, so that a tile is a run of places.
        Tiles are as equal as possible and have about `SIDE`^2 windows, `SIDE` to a side unless the area is
        narrower.

    Example:
        >>> area = Layout(2, 3, first=(32.0, 32.0), right=(4.0, 0.0), down=(0.0, 4.0))
        >>> area.coordinates(torch.tensor([0, 2, 3])).tolist()
        [[32.0, 32.0], [40.0, 32.0], [32.0, 36.0]]
    """

    rows: int
    columns: int = 1
    first: tuple[float, float] = (0.0, 0.0)
    right: tuple[float, float] = (1.0, 0.0)
    down: tuple[float, float] = (0.0, 1.0)
    unit: str = "px"
    frame: str = ""
    corner: tuple[int, int] = (0, 0)
    parts: tuple[Layout, ...] = ()

    @classmethod
    def of(cls, parts: Sequence[Layout]) -> Layout:
        """The area of several parts, whose corners may be negative; places of one part after those of the
        other."""
        top, left = (min(part.corner[axis] for part in parts) for axis in (0, 1))
        frame = next((part.frame for part in parts if part.frame), "")
        moved = [
            part._replace(corner=(part.corner[0] - top, part.corner[1] - left), frame=frame) for part in parts
        ]
        if len(moved) == 1:
            return moved[0]
        rows = max(part.corner[0] + part.rows for part in moved)
        columns = max(part.corner[1] + part.columns for part in moved)
        return moved[0]._replace(rows=rows, columns=columns, corner=(0, 0), parts=(*moved,))

    @property
    def dimensions(self) -> int:
        """1 of a route, along which places are numbered; else 2."""
        return 1 if self.columns == 1 and not self.parts else 2

    @property
    def rectangles(self) -> tuple[Layout, ...]:
        """The parts, or itself."""
        return self.parts or (self,)

    @property
    def places(self) -> int:
        """N, the number of windows."""
        return sum(part.rows * part.columns for part in self.rectangles)

    @property
    def fits(self) -> bool:
        """Whether the parts lie within the bounds, and none on another."""
        if not self.parts:
            return True
        used = torch.zeros(self.rows, self.columns, dtype=torch.bool)
        for part in self.parts:
            (top, left), rows, columns = part.corner, part.rows, part.columns
            used[top : top + rows, left : left + columns] = True
        return Layout.of(self.parts) == self and int(used.sum()) == self.places

    @property
    def north(self) -> float:
        """Degrees clockwise from the upper side of the picture to north, where y grows (in pixels: falls)."""
        (a, b), (c, d) = self.right, self.down
        sign = (a * d - b * c) * (-1 if self.unit == "m" else 1)
        return math.degrees(math.atan2(sign * c, sign * a))

    @property
    def tiles(self) -> list[tuple[int, int]]:
        """Rows and columns of each tile."""
        return [(rows, columns) for rows, columns in _tables(self).size.tolist()]

    @property
    def corners(self) -> list[tuple[int, int]]:
        """Row and column of the first window of each tile."""
        return [(row, column) for row, column in _tables(self).corner.tolist()]

    @property
    def inside(self) -> Tensor | None:
        """Which rows and columns are windows, (R,C) float32; None if all are."""
        order = self.orders()[0]
        return (order < self.places).float().view(self.rows, self.columns) if self.parts else None

    def orders(self) -> tuple[Tensor, Tensor]:
        """The places row by row, (R C,), N where there is none, and the number of each place row by row,
        (N,), int64."""
        with torch.inference_mode(False):  # cached tensors are also used with gradients
            return _cached_orders(self, SIDE)

    def columns_from(self, place: int) -> int:
        """The columns of the tile that begins at a place."""
        tables = _tables(self)
        return int(tables.size[int((tables.start == place).nonzero()[0]), 1])

    def cells(self, places: Tensor) -> Tensor:
        """Row and column of places, int64 of any shape -> (..., 2)."""
        corner, size, start = (table.to(places.device) for table in _tables(self))
        tile = torch.bucketize(places.contiguous(), start, right=True) - 1
        inside, width = places - start[tile], size[tile, 1]
        return corner[tile] + torch.stack([inside // width, inside % width], -1)

    def place_at(self, cells: Tensor) -> Tensor:
        """The places of rows and columns, (..., 2) -> (...); -1 where no window is."""
        row, column = cells[..., 0].clamp(0, self.rows - 1), cells[..., 1].clamp(0, self.columns - 1)
        found = self._numbered(row, column)
        return torch.where((cells[..., 0] == row) & (cells[..., 1] == column), found, -1)

    def _numbered(self, row: Tensor, column: Tensor) -> Tensor:
        """The places of rows and columns within the bounds, which may be broadcast; -1 for none."""
        if self.parts:
            found = self.orders()[0].to(row.device)[row * self.columns + column]
            return found.masked_fill(found == self.places, -1)
        down, across = (edges.to(row.device) for edges in _borders(self.rows, self.columns))
        at, beside = (
            torch.bucketize(cells.contiguous(), edges[1:-1], right=True)
            for cells, edges in ((row, down), (column, across))
        )
        top, left = down[at], across[beside]
        before = top * self.columns + (down[at + 1] - top) * left
        return before + (row - top) * (across[beside + 1] - left) + (column - left)

    def coordinates(self, places: Tensor) -> Tensor:
        """(x, y) of the middle of windows, int64 (...) -> (..., 2) float64."""
        cells = self.cells(places)
        found = torch.zeros(cells.shape, dtype=torch.float64, device=places.device)
        before = 0
        for part in self.rectangles:
            own = ((places >= before) & (places < before + part.places))[..., None]
            before += part.places
            steps = found.new_tensor([part.down, part.right])
            at = (cells - cells.new_tensor(part.corner)).double() @ steps + found.new_tensor(part.first)
            found = torch.where(own, at, found)
        return found

    def place_near(self, points: Tensor) -> Tensor:
        """The places whose middles are nearest to (x, y), (n,2) -> (n,); -1 for over half a step away."""
        found, before = torch.full((len(points),), -1), 0
        for part in self.rectangles:
            first, *steps = torch.tensor([part.first, part.down, part.right], dtype=torch.float64)
            cells = (points.double() - first) @ torch.stack(steps).inverse()
            place = part._replace(corner=(0, 0)).place_at(cells.nan_to_num(-1).round().long())
            found = torch.where(place >= 0, before + place, found)
            before += part.places
        return found

    def distance(self, one: Tensor, other: Tensor) -> Tensor:
        """The larger of the distances in rows and columns, int64."""
        if self.dimensions == 1:
            return (one - other).abs()
        return (self.cells(one) - self.cells(other)).abs().amax(-1)

    def near(self, radius: int) -> int:
        """How many places are at most so far from one of them."""
        side = 2 * radius + 1
        return side if self.dimensions == 1 else side * side

    def around(self, places: Tensor, radius: int) -> Tensor:
        """The places up to a radius in rows and columns, (n,) -> (n, `near`) or fewer; those beyond a border
        are others of them."""
        radius = min(radius, max(self.rows, self.columns))
        offset = torch.arange(-radius, radius + 1, device=places.device)
        if self.dimensions == 1:
            return (places[:, None] + offset).clamp(0, self.rows - 1)
        row, column = (self.cells(places)[:, None] + offset[:, None]).unbind(-1)
        row, column = row.clamp(0, self.rows - 1), column.clamp(0, self.columns - 1)
        near = self._numbered(row[:, :, None], column[:, None]).flatten(1)
        return torch.where(near < 0, places[:, None], near) if self.parts else near

    def strided(self, k: int) -> tuple[Tensor, Tensor]:
        """Every k-th place in each direction, (n,), and of each place which of these is nearest, (N,), int64.

        Example:
            >>> [table.tolist() for table in Layout(6).strided(3)]
            [[0, 3], [0, 0, 1, 1, 1, 1]]
        """

        def along(count: int) -> tuple[Tensor, Tensor]:
            stored = torch.arange(0, count, k)
            return stored, ((torch.arange(count) + k // 2) // k).clamp(max=len(stored) - 1)

        (rows, above), (columns, beside) = along(self.rows), along(self.columns)
        row, column = self.cells(torch.arange(self.places)).unbind(-1)
        stored = self.place_at(torch.cartesian_prod(rows, columns).view(-1, 2))
        return stored, above[row] * len(columns) + beside[column]

    def between(self, start: int, stop: int) -> Layout:
        """The area of some of the parts: those of the places [start, stop)."""
        first = accumulate((part.places for part in self.rectangles), initial=0)
        parts = zip(self.rectangles, first, strict=False)
        return Layout.of([part for part, at in parts if start <= at < stop])


def apart(areas: Sequence[Layout]) -> Layout:
    """The area of several that are not of one ground: none of their windows are near those of another."""

    def along(down: int, across: int) -> Layout:
        parts, top, left = list[Layout](), 0, 0
        for area in areas:
            for part in area.rectangles:
                parts.append(part._replace(corner=(top + part.corner[0], left + part.corner[1])))
            top, left = top + down * (area.rows + GAP), left + across * (area.columns + GAP)
        return Layout.of(parts)

    return min(along(1, 0), along(0, 1), key=lambda area: area.rows * area.columns)


def area_of(stored: Mapping[str, Any]) -> Layout:
    """An area from the values of `stored_area`, as JSON keeps them."""
    points: dict[str, Any] = {name: tuple(stored[name]) for name in ("first", "right", "down")}
    corner, parts = tuple(stored.get("corner", (0, 0))), tuple(map(area_of, stored.get("parts", ())))
    return Layout(**{**stored, **points, "corner": corner, "parts": parts})


def stored_area(area: Layout) -> dict[str, Any]:
    """An area as JSON keeps it; parts only where there are several."""
    stored = area._asdict()
    parts = [stored_area(part) | {"corner": part.corner} for part in stored.pop("parts")]
    del stored["corner"]
    return stored | {"parts": parts} if parts else stored


def agree(one: str, other: str) -> bool:
    """Whether two frames of coordinates may be the same; "" is unknown."""
    return "" in (one, other) or one == other


def same_windows(one: Layout | None, other: Layout | None) -> bool:
    """Whether two areas number their places alike and, if both know their frames, these lie where the other's
    do; also two routes."""
    if one is None or other is None:
        return one is other
    known = bool(one.frame and other.frame)
    mine, yours = (
        [(part.corner, part.rows, part.columns, known and part[2:7]) for part in area.rectangles]
        for area in (one, other)
    )
    return mine == yours


def _tables(area: Layout) -> Tables:
    with torch.inference_mode(False):  # cached tensors are also used with gradients
        return _cached_tables(area, SIDE)


@lru_cache(16)
def _cached_tables(area: Layout, side: int) -> Tables:
    corners, sizes = list[Tensor](), list[Tensor]()
    for part in area.rectangles:
        down, across = _borders(part.rows, part.columns)
        corners.append(torch.cartesian_prod(down[:-1], across[:-1]).view(-1, 2) + torch.tensor(part.corner))
        sizes.append(torch.cartesian_prod(down.diff(), across.diff()).view(-1, 2))
    size = torch.cat(sizes)
    return Tables(torch.cat(corners), size, torch.cat([size.new_zeros(1), size.prod(1).cumsum(0)[:-1]]))


def _borders(rows: int, columns: int) -> tuple[Tensor, Tensor]:
    """The borders of tiles, rows and columns."""
    with torch.inference_mode(False):
        return _cached_borders(rows, columns, SIDE)


@lru_cache(64)
def _cached_borders(rows: int, columns: int, side: int) -> tuple[Tensor, Tensor]:
    down = _edges(rows, max(side, side * side // columns))
    return down, _edges(columns, max(1, side * side // max(1, int(down.diff().max()))))


@lru_cache(2)  # of 16 bytes a window
def _cached_orders(area: Layout, side: int) -> tuple[Tensor, Tensor]:
    cells = area.cells(torch.arange(area.places))
    rank = cells[:, 0] * area.columns + cells[:, 1]
    order = torch.full((area.rows * area.columns,), area.places)
    order[rank] = torch.arange(area.places)
    return order, rank


def _edges(count: int, most: int) -> Tensor:
    """Borders of equal parts of about so many."""
    parts = max(1, round(count / most))
    return torch.arange(parts + 1) * count // parts
