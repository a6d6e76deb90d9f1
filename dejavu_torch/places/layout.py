"""Where places lie: rectangles of rows and columns, numbered tile by tile; a route is rows of one column."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from itertools import accumulate, groupby, pairwise
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from typing_extensions import Self

from dejavu_torch.places.rectangles import (
    GAP,
    Cell,
    Point,
    Rectangle,
    Run,
    borders_of,
    boxes,
    cells_of,
    orders_of,
    tables_of,
    triangles,
)
from dejavu_torch.places.states import Link, States
from dejavu_torch.text import expect

LARGEST = 2**31 - 1  # places of a map
FAR = 2**31  # places that are never near
SPARSE = 4  # a lattice may span so many times as many rows x columns as it has windows
NORTH, STRIDE = 1.0, 1e-3  # degrees that windows of one map may differ by, and share of a step


class Reach(NamedTuple):
    """Within which an answer is right: what is added to numbers of places, so many places, and a distance in
    the unit of the layout."""

    tolerance: int
    within: int
    radius: float


class Layout:
    """Where the places of a map lie, along a route or over an area, and all that follows from it: which are
    near each other, where a camera can go, which frame and coordinates they have, and what they are called.

    It is one or more rectangles, which lie in the lattice of their route: in one lattice places are near by
    rows and columns, those of different routes never are. A route is a rectangle of one column, an area has
    coordinates. Edits add rectangles, so that the number of a place never changes.

    Args:
        rows, columns: of places. first, right, down: see `Rectangle`. unit: of coordinates, "px" or "m", and
            "" along a route, which has none; by default pixels if there are columns. frame: of the
            coordinates, see `Coordinates`, "" if unknown.

    Attributes:
        rectangles: in the order of the places. routes: the names of several routes; () of a single one.
        dimensions: 1 along routes, 2 over areas; what is tuned for each is a table by it, beside its user.
        places, count: N, and the number of routes. runs, starts: those of consecutive places of one
            route, and the first place of each. rows, columns: of a plane in which all lie, lattices apart
            from each other; not all rows and columns are places.

    Convention: places are numbered tile by tile and in a tile row by row, so that a tile is a run of places.
        Tiles are as equal as possible and have about `SIDE`^2 windows, `SIDE` to a side unless the area is
        narrower. Subclass it for places that lie otherwise, and add it to `KINDS`.

    Example:
        >>> area = Layout(2, 3, first=(32.0, 32.0), right=(4.0, 0.0), down=(0.0, 4.0))
        >>> area.coordinates(torch.tensor([0, 2, 3])).tolist()
        [[32.0, 32.0], [40.0, 32.0], [32.0, 36.0]]
        >>> Layout(6).distance(torch.tensor(2), torch.tensor(5))
        tensor(3)
    """

    def __init__(
        self,
        rows: int = 0,
        columns: int = 1,
        first: Point = (0.0, 0.0),
        right: Point = (1.0, 0.0),
        down: Point = (0.0, 1.0),
        unit: str | None = None,
        frame: str = "",
    ) -> None:
        self._set([Rectangle(rows, columns, first, right, down)], unit, frame)

    def _set(
        self, rectangles: Sequence[Rectangle], unit: str | None, frame: str, routes: Sequence[str] = ()
    ) -> None:
        # all at once, since compilers do not follow cached properties
        least = {
            route: [min(one.corner[axis] for one in rectangles if one.route == route) for axis in (0, 1)]
            for route in {one.route for one in rectangles}
        }
        self.rectangles = tuple(
            one._replace(corner=(one.corner[0] - top, one.corner[1] - left))
            for one in rectangles
            for top, left in [least[one.route]]
        )
        wide = any(one.columns > 1 for one in rectangles)
        self.unit = ("px" if wide else "") if unit is None else unit
        self.frame, self.routes = frame, (*routes,)
        self.dimensions = 1 if not self.unit and not wide else 2
        self.places = sum(one.places for one in rectangles)
        self.count = 1 + max(one.route for one in rectangles)
        self._corners, (self.rows, self.columns) = self._in_a_plane()
        self._plain = self.dimensions == len(rectangles) == 1  # along which places are numbered
        self.runs = tuple(
            Run(route, *map(sum, zip(*((one.places, one.shown) for one in parts), strict=True)))
            for route, parts in groupby(self.rectangles, lambda one: one.route)
        )
        self.starts = (*accumulate((run.places for run in self.runs[:-1]), initial=0),)

    @classmethod
    def of(
        cls,
        rectangles: Sequence[Rectangle],
        unit: str | None = None,
        frame: str = "",
        routes: Sequence[str] = (),
    ) -> Self:
        """A layout of these rectangles, whose corners may be negative."""
        layout = cls.__new__(cls)
        layout._set(rectangles, unit, frame, routes)
        return layout

    @classmethod
    def merged(cls, layouts: Sequence[Layout], names: Sequence[Sequence[str]]) -> Layout:
        """Several layouts one after another, with the names of their routes, not of other kinds."""
        kinds = {type(one).__name__ for one in layouts} - {"Layout"}
        expect(not kinds, "routes or areas", f"a layout {' and '.join(sorted(kinds))} among several")
        count = [*accumulate((one.count for one in layouts), initial=0)]
        rectangles = [
            part._replace(route=part.route + before)
            for one, before in zip(layouts, count, strict=False)
            for part in one.rectangles
        ]
        frame = next((one.frame for one in layouts if one.frame), "")
        return Layout.of(rectangles, layouts[0].unit, frame, [name for own in names for name in own])

    def _key(self) -> tuple[object, ...]:
        return type(self), self.rectangles, self.unit, self.frame, self.routes

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def __repr__(self) -> str:
        sizes = " and ".join(f"{one.rows} x {one.columns}" for one in self.rectangles)
        return f"{type(self).__name__}({sizes})"

    # ------------------------------------------------------------------ what there is

    @property
    def ahead(self) -> bool:
        """Whether a camera looks along a way, to the left or right of which it may point."""
        return self.dimensions == 1

    @property
    def area(self) -> Layout | None:
        """Itself, if it is that of an area; None along routes."""
        return self if self.dimensions == 2 else None

    def names(self, own: str) -> tuple[str, ...]:
        """Of the routes; `own` of a single one without a name."""
        return self.routes or (own,)

    def places_of(self, route: int) -> int:
        """The number of places of a route."""
        return sum(run.places for run in self.runs if run.route == route)

    def route_of(self, places: Tensor) -> Tensor:
        """The number of the route of each place, int64 of any shape; -1 stays."""
        if self.count == 1:
            return places.clamp(-1, 0)
        ends = torch.tensor([run.places for run in self.runs], device=places.device).cumsum(0)
        routes = torch.tensor([run.route for run in self.runs], device=places.device)
        at = torch.searchsorted(ends, places.contiguous(), right=True)
        return torch.where(places >= 0, routes[at.clamp(max=len(routes) - 1)], -1)

    def told_routes(self, places: Tensor) -> Tensor | None:
        """The number of the route of each place; None unless routes have names."""
        return self.route_of(places) if self.routes else None

    def reaching(self, places: int) -> Layout:
        """Itself, or of a route whose length is not known one of so many places."""
        return self if self.places else type(self)(places)

    def sizes(self, chunk: int) -> list[Cell]:
        """Rows and columns of each chunk: tiles of an area, up to `chunk` places of a route.

        Example:
            >>> Layout(25).sizes(10)
            [(10, 1), (10, 1), (5, 1)]
        """
        if self.dimensions == 2:
            return self.tiles
        runs = (run.places for run in self.runs)
        return [(min(chunk, n - start), 1) for n in runs for start in range(0, n, chunk)]

    @property
    def tiles(self) -> list[Cell]:
        """Rows and columns of each tile."""
        return [(rows, columns) for rows, columns in tables_of(self.rectangles, self._corners).size.tolist()]

    @property
    def corners(self) -> list[Cell]:
        """Row and column of the first window of each tile."""
        return [(row, column) for row, column in tables_of(self.rectangles, self._corners).corner.tolist()]

    def columns_from(self, place: int) -> int:
        """The columns of the chunk that begins at a place."""
        if self.dimensions == 1:
            return 1
        tables = tables_of(self.rectangles, self._corners)
        return int(tables.size[int((tables.start == place).nonzero()[0]), 1])

    # ------------------------------------------------------------------ in rows and columns

    def _in_a_plane(self) -> tuple[tuple[Cell, ...], Cell]:
        """The corner of each rectangle in one plane, in which lattices are apart, and its extent."""
        extents = []
        for route in range(self.count):
            own = [one for one in self.rectangles if one.route == route]
            rows = max([0, *(one.corner[0] + one.rows for one in own)])
            extents.append((rows, max([0, *(one.corner[1] + one.columns for one in own)])))

        def along(down: int, across: int) -> tuple[tuple[Cell, ...], Cell]:
            starts, top, left = list[Cell](), 0, 0
            for rows, columns in extents:
                starts.append((top, left))
                top, left = top + down * (rows + GAP), left + across * (columns + GAP)
            corners = tuple(
                (one.corner[0] + starts[one.route][0], one.corner[1] + starts[one.route][1])
                for one in self.rectangles
            )
            ends = [(at[0] + size[0], at[1] + size[1]) for at, size in zip(starts, extents, strict=True)]
            return corners, (max(row for row, _ in ends), max(column for _, column in ends))

        ways = [along(1, 0), along(0, 1)][: self.dimensions]  # routes of one column follow each other
        return min(ways, key=lambda way: math.prod(way[1]))

    @property
    def first(self) -> Point:
        """(x, y) of the first row and column."""
        one, (row, column) = self.rectangles[0], self._corners[0]
        x, y = (one.first[i] - row * one.down[i] - column * one.right[i] for i in (0, 1))
        return (x, y)

    @property
    def right(self) -> Point:
        """(x, y) from a window to the next of its row."""
        return self.rectangles[0].right

    @property
    def down(self) -> Point:
        """(x, y) from a window to the next of its column."""
        return self.rectangles[0].down

    @property
    def fits(self) -> bool:
        """Whether no rectangle lies on another."""
        if len(self.rectangles) == 1:
            return True
        used = torch.zeros(self.rows, self.columns, dtype=torch.bool)
        for (top, left), one in zip(self._corners, self.rectangles, strict=True):
            used[top : top + one.rows, left : left + one.columns] = True
        return int(used.sum()) == self.places

    @property
    def extents(self) -> tuple[Cell, ...]:
        """Rows and columns of each rectangle of an area; () along routes."""
        return tuple((one.rows, one.columns) for one in self.rectangles if self.dimensions == 2)

    def expect_tiles(self, tiles: Sequence[Cell]) -> None:
        """Refuse rectangles that lie on each other, routes without names, and rows and columns of chunks, in
        order, that are not those of an area."""
        seen = "the map does not fit together"
        expect(
            self.fits, "one beside the other", f"{seen}: parts of an area that do not lie beside each other"
        )
        expect(all(self.routes), "a name for each", f"{seen}: routes {self.routes}")
        wanted = f"those of {' and '.join(f'{rows} x {columns}' for rows, columns in self.extents)}"
        fits = self.dimensions == 1 or [*tiles] == self.tiles[: len(tiles)]
        expect(fits, wanted, f"{seen}: tiles {tiles!s:.100}")

    @property
    def inside(self) -> Tensor | None:
        """Which rows and columns are places, (R,C) float32; None if all are."""
        if len(self.rectangles) == 1:
            return None
        return (self._orders()[0] < self.places).float().view(self.rows, self.columns)

    def _orders(self) -> tuple[Tensor, Tensor]:
        """See `orders_of`."""
        return orders_of(self.rectangles, self._corners, (self.rows, self.columns))

    def cells(self, places: Tensor) -> Tensor:
        """Row and column of places, int64 of any shape -> (..., 2)."""
        return cells_of(places, tables_of(self.rectangles, self._corners))

    def place_at(self, cells: Tensor) -> Tensor:
        """The places of rows and columns, (..., 2) -> (...); -1 where none is."""
        row, column = cells[..., 0].clamp(0, self.rows - 1), cells[..., 1].clamp(0, self.columns - 1)
        found = self._numbered(row, column)
        return torch.where((cells[..., 0] == row) & (cells[..., 1] == column), found, -1)

    def _numbered(self, row: Tensor, column: Tensor) -> Tensor:
        """The places of rows and columns within the bounds, which may be broadcast; -1 for none."""
        if len(self.rectangles) > 1:
            found = self._orders()[0].to(row.device)[row * self.columns + column]
            return found.masked_fill(found == self.places, -1)
        down, across = (edges.to(row.device) for edges in borders_of(self.rows, self.columns))
        at, beside = (
            torch.bucketize(cells.contiguous(), edges[1:-1], right=True)
            for cells, edges in ((row, down), (column, across))
        )
        top, left = down[at], across[beside]
        before = top * self.columns + (down[at + 1] - top) * left
        return before + (row - top) * (across[beside + 1] - left) + (column - left)

    def as_plane(self, values: Tensor) -> Tensor:
        """Values by place, (T,N) -> (T,R,C), 0 where there is none."""
        order = self._orders()[0].to(values.device)
        values = F.pad(values, (0, 1)) if len(self.rectangles) > 1 else values
        return values.index_select(1, order).view(len(values), self.rows, self.columns)

    def by_place(self, plane: Tensor) -> Tensor:
        """Values of a plane by place, (T,R,C) -> (T,N)."""
        return plane.flatten(1).index_select(1, self._orders()[1].to(plane.device))

    # ------------------------------------------------------------------ which are near

    def distance(self, one: Tensor, other: Tensor) -> Tensor:
        """The larger of the distances in rows and columns, int64; `FAR` and more on another route."""
        if self._plain:
            return (one - other).abs()
        apart = (self.cells(one) - self.cells(other)).abs().amax(-1)
        return apart + FAR * (self.route_of(one) != self.route_of(other))

    def near(self, radius: int) -> int:
        """How many places are at most so far from one of them."""
        side: int = (2 * radius + 1) ** self.dimensions
        return side

    def around(self, places: Tensor, radius: int) -> Tensor:
        """The places up to a radius in rows and columns, (n,) -> (n, `near`) or fewer; those beyond a border
        are others of them."""
        near = self.neighbours(places, radius)
        return torch.where(near < 0, places[:, None], near)

    def neighbours(self, places: Tensor, radius: int) -> Tensor:
        """As `around`, -1 beyond a border."""
        radius = min(radius, max(self.rows, self.columns))
        offset = torch.arange(-radius, radius + 1, device=places.device)
        if self._plain:
            near = places[:, None] + offset
            return near.masked_fill((near < 0) | (near >= self.places), -1)
        row, column = self.cells(places)[..., None].unbind(1)
        across = {1: offset[:1] * 0, 2: offset}[self.dimensions]
        row, column = row + offset, column + across
        at = row.clamp(0, self.rows - 1)[:, :, None], column.clamp(0, self.columns - 1)[:, None]
        inside = (at[0] == row[:, :, None]) & (at[1] == column[:, None])
        near = self._numbered(*at).masked_fill(~inside, -1).flatten(1)
        if self.count > 1:
            near = near.masked_fill(self.route_of(near) != self.route_of(places)[:, None], -1)
        return near

    def mass_near(self, mass: Tensor, places: Tensor, radius: int) -> Tensor:
        """The mass of places (Q,) and of those up to a radius, (Q,N) -> (Q,)."""
        if self.dimensions == 1:
            near = self.neighbours(places, min(radius, self.places))
            return (mass.gather(1, near.clamp(min=0)) * (near >= 0)).sum(1).clamp(0, 1)
        if self.count > 1 and radius > GAP:
            routes = self.route_of(torch.arange(self.places, device=mass.device))
            mass = mass * (routes == self.route_of(places)[:, None])
        sums = self.by_place(boxes(self.as_plane(mass), radius)).clamp(0, 1)
        return sums.gather(1, places[:, None])[:, 0]

    def blurred(self, mass: Tensor, radius: int) -> Tensor:
        """The mass of each place and those up to a radius, with weights that fall with the distance: a
        triangle along a route, over an area a pyramid of up to `GAP` windows, (Q,N) -> (Q,N)."""
        if self._plain or not radius:
            return triangles(mass, radius) if radius else mass
        if self.dimensions == 1:
            parts = [*mass.split([run.places for run in self.runs], 1)]
            for route in range(self.count):
                own = [i for i, run in enumerate(self.runs) if run.route == route]
                whole = triangles(torch.cat([parts[i] for i in own], 1), radius)
                for i, part in zip(own, whole.split([self.runs[i].places for i in own], 1), strict=True):
                    parts[i] = part
            return torch.cat(parts, 1)
        half = max(1, radius // 2)  # two boxes make a pyramid, whole also at a border
        padded = F.pad(self.as_plane(mass), 4 * (half,))
        pyramid = boxes(boxes(padded, half), half)[:, half:-half, half:-half]
        return self.by_place(pyramid / (2 * half + 1) ** 2).clamp(0, 1)

    def strided(self, k: int) -> tuple[Tensor, Tensor]:
        """Every k-th place in each direction, (n,), and of each place which of these is nearest, (N,), int64.

        Example:
            >>> [table.tolist() for table in Layout(6).strided(3)]
            [[0, 3], [0, 0, 1, 1, 1, 1]]
        """
        if len(self.rectangles) > 1:
            kept, nearest, count = list[Tensor](), list[Tensor](), 0
            for one, start in zip(self.rectangles, self._firsts, strict=True):
                stored, near = self._alone(one).strided(k)
                kept.append(stored + start)
                nearest.append(near + count)
                count += len(stored)
            return torch.cat(kept), torch.cat(nearest)

        def along(count: int) -> tuple[Tensor, Tensor]:
            stored = torch.arange(0, count, k)
            return stored, ((torch.arange(count) + k // 2) // k).clamp(max=len(stored) - 1)

        (rows, above), (columns, beside) = along(self.rows), along(self.columns)
        row, column = self.cells(torch.arange(self.places)).unbind(-1)
        stored = self.place_at(torch.cartesian_prod(rows, columns).view(-1, 2))
        return stored, above[row] * len(columns) + beside[column]

    def thinned(self, most: int, places: int) -> Tensor:
        """Every 2^j-th place of each route, of its first `places`, ascending, with the smallest j that leaves
        at most so many, or one of each route: (n,) int64.

        Example:
            >>> Layout(30).thinned(4, places=9).tolist()
            [0, 4, 8]
        """
        routes, k = [self.places_in(route) for route in range(self.count)], 1
        routes = [route[route < places] for route in routes]
        while sum(len(route[::k]) for route in routes) > most and k < max(map(len, routes)):
            k *= 2
        return torch.cat([route[::k] for route in routes]).sort().values

    def passed_again(self, places: Tensor, apart: int) -> Tensor:
        """The places about so many before and after each, (n,) -> (n,M), with the ends of a route beside each
        other, as it may end where it begins; of an area as many around."""
        if self.dimensions == 2:
            return self.around(places, round(apart**0.5))
        near = places[:, None] + torch.arange(-apart, apart + 1, device=places.device)
        return near.remainder(self.places)

    # ------------------------------------------------------------------ where a camera can go

    @property
    def joins(self) -> tuple[Link, ...]:
        """The steps from one rectangle of a route to the next."""
        if self._plain:
            return ()
        parts = sorted(
            (one.route, one.corner[0], start, start + one.places - 1)
            for one, start in zip(self.rectangles, self._firsts, strict=True)
            if self.dimensions == 1
        )
        return tuple(
            (last, first, 1.0)
            for (route, _, _, last), (other, _, first, _) in pairwise(parts)
            if route == other
        )

    def states(self, directions: int = 1, links: Sequence[Link] = (), turn: float = 0.0) -> States:
        """The states of a camera that goes along routes, by further links too."""
        return States(self.places, directions, self.starts, (*links, *self.joins), turn)

    # ------------------------------------------------------------------ on the ground

    def _alone(self, one: Rectangle) -> Layout:
        """One rectangle by itself."""
        return Layout.of([one._replace(route=0)], self.unit)

    @property
    def _firsts(self) -> list[int]:
        """The first place of each rectangle."""
        return [*accumulate((one.places for one in self.rectangles), initial=0)][:-1]

    def coordinates(self, places: Tensor) -> Tensor:
        """(x, y) of the middle of windows, int64 (...) -> (..., 2) float64; NaN along a route, and of -1."""
        found = torch.full((*places.shape, 2), math.nan, dtype=torch.float64, device=places.device)
        if self.dimensions == 1:
            return found
        cells = self.cells(places.clamp(min=0))
        for one, corner, start in zip(self.rectangles, self._corners, self._firsts, strict=True):
            own = ((places >= start) & (places < start + one.places))[..., None]
            steps = found.new_tensor([one.down, one.right])
            at = (cells - cells.new_tensor(corner)).double() @ steps + found.new_tensor(one.first)
            found = torch.where(own, at, found)
        return found

    def place_near(self, points: Tensor) -> Tensor:
        """The places whose middles are nearest to (x, y), (n,2) -> (n,); -1 for over half a step away."""
        found = torch.full((len(points),), -1)
        for one, start, cells in self._among(points):
            place = self._alone(one).place_at(cells.nan_to_num(-1).round().long())
            found = torch.where(place >= 0, start + place, found)
        return found

    def _among(self, points: Tensor) -> list[tuple[Rectangle, int, Tensor]]:
        """Each rectangle, its first place, and the rows and columns of points (n,2) in it, (n,2) float64."""
        each = []
        for one, start in zip(self.rectangles, self._firsts, strict=True):
            first, *steps = torch.tensor([one.first, one.down, one.right], dtype=torch.float64)
            each.append((one, start, (points.double() - first) @ torch.stack(steps).inverse()))
        return each if self.dimensions == 2 else []

    def within(self, points: Tensor, distance: float) -> Tensor:
        """The windows whose middles are at most so far from (x, y), (n,2) -> (n,M) int64, -1 as padding."""
        found = [torch.full((len(points), 1), -1)]
        for one, start, cells in self._among(points):
            alone = self._alone(one)
            last = cells.new_tensor([one.rows - 1, one.columns - 1])
            nearest = cells.nan_to_num(-1).clamp(torch.zeros_like(last), last).round().long()
            reach = 1 + math.ceil(distance / min(math.hypot(*one.down), math.hypot(*one.right)))
            near = alone.neighbours(alone.place_at(nearest), reach)
            away = (alone.coordinates(near) - points.double()[:, None]).norm(dim=2)
            found.append(torch.where(away <= distance, start + near, -1))
        table = torch.cat(found, 1).sort(1, descending=True).values
        return table[:, : max(1, int((table >= 0).sum(1).max()))] if len(table) else table

    @property
    def spacing(self) -> float:
        """The distance from a place to the next, in the unit of coordinates; 1 along a route."""
        return math.hypot(*self.right)

    @property
    def on_ground(self) -> bool:
        """Whether its windows look in a known direction, as those over the ground do."""
        return self.dimensions == 2

    @property
    def north(self) -> float:
        """Degrees clockwise from the upper side of the picture to north, where y grows (in pixels: falls)."""
        (a, b), (c, d) = self.right, self.down
        sign = (a * d - b * c) * (-1 if self.unit == "m" else 1)
        return math.degrees(math.atan2(sign * c, sign * a))

    def reach(self, tolerance: int, distance: float | None = None) -> Reach:
        """Within how many places an answer is right: the tolerance along a route; over an area, whose numbers
        of places tell no distance, those within a distance, by default the tolerance."""
        if self.dimensions == 1:
            return Reach(tolerance, tolerance, float(tolerance))
        radius = float(tolerance) if distance is None else distance
        return Reach(0, round(radius / self.spacing), radius)

    # ------------------------------------------------------------------ in words

    @property
    def kind(self) -> str:
        """What it is of: "a route" or "an area"."""
        return ("a route", "an area")[self.dimensions - 1]

    @property
    def noun(self) -> str:
        """What a place is: "frame" or "window"."""
        return ("frame", "window")[self.dimensions - 1]

    @property
    def units(self) -> str:
        """Of its coordinates: "metres" or "pixels"; "" along a route."""
        return {"": "", "m": "metres"}.get(self.unit, "pixels")

    @property
    def extent(self) -> dict[str, Any]:
        """Rows and columns of an area, as reports have them; {} along a route."""
        return {"area": {"rows": self.rows, "columns": self.columns}} if self.dimensions == 2 else {}

    def radii(self, counts: Sequence[int]) -> list[float]:
        """So many metres, or windows in pixels; none along a route."""
        each = {"": [], "m": [1.0]}.get(self.unit, [self.spacing])
        return [one * count for one in each for count in counts]

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of its coordinates; none along a route."""
        return ("x", "y")[: 2 * (self.dimensions - 1)]

    @property
    def system(self) -> str:
        """What its coordinates count from, or their unit."""
        return self.frame or self.unit

    def truth(self, distance: float) -> str | None:
        """The ground truth by coordinates within a distance, see `find_ground_truth`; None along a route."""
        return None if self.dimensions == 1 else f"{self.units}:{distance:.15g}"

    def expect_route(self, to_be: str, seen: str) -> None:
        """Refuse an area."""
        expect(self.dimensions == 1, to_be, seen)

    def expect_area(self, to_be: str, seen: str) -> None:
        """Refuse a route."""
        expect(self.dimensions == 2, to_be, seen)

    def expect_one(self, to_be: str, seen: str = "the map") -> None:
        """Refuse several routes of what is `seen`."""
        expect(not self.routes, to_be, f"{seen} has the routes {', '.join(self.routes)}")

    def expect_several(self, to_be: str, seen: str) -> None:
        """Refuse a single route without a name."""
        expect(self.routes, to_be, seen)

    def expect_unit(self, unit: str, seen: str) -> None:
        """Refuse distances in pixels over an area in metres, and the reverse."""
        expect(
            self.dimensions == 1 or unit == self.unit,
            "the same unit",
            f"{seen}, and coordinates of the area in {self.system}",
        )

    def same(self, other: Layout) -> bool:
        """Whether the places of another are numbered alike and, if both know their frames, lie where these
        do; of routes, whether it is one too."""
        if self.dimensions == 1 or other.dimensions == 1:
            return self.dimensions == other.dimensions
        known = bool(self.frame and other.frame)
        mine, yours = (
            [(one.route, one.corner, one[:2], known and one[2:5]) for one in layout.rectangles]
            for layout in (self, other)
        )
        return mine == yours and (not known or self.system == other.system)

    def unlike(self, other: Layout) -> str:
        """Why places of another cannot be in one map with these; "" if they can."""
        if self.dimensions != other.dimensions:
            return f"{other.kind} and {self.kind}"
        if self.dimensions == 1:
            return ""
        if self.unit != other.unit or not agree(self.frame, other.frame):
            return f"coordinates are in {self.system} and {other.system}"
        for way in ("right", "down"):
            mine, yours = (math.hypot(*getattr(layout, way)) for layout in (self, other))
            if abs(mine - yours) > STRIDE * mine:
                return f"windows are {mine:g} and {yours:g} {self.unit} apart"
        if abs((self.north - other.north + 180) % 360 - 180) > NORTH:
            return f"north is {self.north:g} and {other.north:g} degrees from up"
        return ""

    # ------------------------------------------------------------------ edits

    def number(self, route: str) -> int:
        """The number of a route; an InputError if there is none of this name."""
        known = f"one of {', '.join(self.routes)}" if self.routes else "none, as the only one has no name"
        expect(route in self.routes, known, f"there is no route {route!r}")
        return self.routes.index(route)

    def showing(self, frames: int) -> Layout:
        """A route that knows how many frames it shows; several do."""
        if len(self.rectangles) > 1:
            return self
        return type(self).of([self.rectangles[0]._replace(frames=frames)], self.unit, self.frame, self.routes)

    def only(self, route: int) -> Layout:
        """That of one route."""
        parts = [one._replace(route=0, frames=None) for one in self.rectangles if one.route == route]
        if self.dimensions == 1:
            parts = [parts[0]._replace(rows=sum(one.rows for one in parts), corner=(0, 0))]
        return type(self).of(parts, self.unit, self.frame)

    def ranges(self, route: int) -> list[range]:
        """The runs of places of a route."""
        runs = zip(self.runs, self.starts, strict=True)
        return [range(start, start + run.places) for run, start in runs if run.route == route]

    def places_in(self, route: int) -> Tensor:
        """The places of a route, in its order, int64."""
        parts = zip(self.rectangles, self._firsts, strict=True)
        return torch.cat(
            [torch.arange(start, start + one.places) for one, start in parts if one.route == route]
        )

    def cut(self, start: int, stop: int) -> Layout:
        """That of consecutive places along routes."""
        parts = [
            one._replace(rows=rows, frames=None)
            for one, first in zip(self.rectangles, self._firsts, strict=True)
            if (rows := min(stop, first + one.rows) - max(start, first)) > 0
        ]
        numbers = sorted({one.route for one in parts})
        parts = [one._replace(route=numbers.index(one.route)) for one in parts]
        return Layout.of(parts, "", "", [self.routes[r] for r in numbers] if self.routes else ())

    def grown(self, other: Layout, name: str, frames: int | None = None, route: int = 0) -> Layout:
        """That of these places and more of a route: behind its last, or windows where their coordinates put
        them.

        Args:
            other: of a traverse. name: of it, for messages. frames: see `Rectangle`. route: its number.

        Raises:
            InputError: a route and an area, other distances between windows, windows of both at one place,
                or areas far apart.
        """
        seen = f"{name} is {other.kind}, the map is of {self.kind}"
        expect(self.dimensions == other.dimensions, "a route for a route, an area for an area", seen)
        seen = self.unlike(other)
        expect(not seen, "the same", f"{name} does not continue the map: {seen}")
        own, last = [one for one in self.rectangles if one.route == route], self.rectangles[-1]
        if self.dimensions == 2:
            added = self._beside(own, other, name)._replace(route=route)
        elif last.route == route:  # its chunks follow
            rows, shown = last.rows + other.places, last.shown + (frames or other.places)
            longer = last._replace(rows=rows, frames=None if shown == rows else shown)
            return type(self).of([*self.rectangles[:-1], longer], self.unit, self.frame, self.routes)
        else:
            end = max(one.corner[0] + one.rows for one in own)
            added = Rectangle(other.places, corner=(end, 0), route=route, frames=frames)
        return type(self).of([*self.rectangles, added], self.unit, self.frame or other.frame, self.routes)

    def _beside(self, own: Sequence[Rectangle], other: Layout, name: str) -> Rectangle:
        """More windows in the lattice of some rectangles."""
        one, (added,) = own[0], other.rectangles
        steps, ends = (
            torch.tensor(pair, dtype=torch.float64)
            for pair in ((one.down, one.right), (one.first, added.first))
        )
        away = torch.linalg.solve(steps.T, ends[1] - ends[0]).round().long()
        row, column = (away + torch.tensor(one.corner)).tolist()
        for (top, left), rows, columns in ((part.corner, part.rows, part.columns) for part in own):
            tall = min(row + added.rows, top + rows) - max(row, top)
            wide = min(column + added.columns, left + columns) - max(column, left)
            seen = f"{name} and the map share {tall} x {wide} windows"
            expect(min(tall, wide) <= 0, "ground that the map lacks", seen)
        added = added._replace(corner=(row, column))
        joined = Layout.of([*(part._replace(route=0) for part in own), added])
        seen = f"{name} and the map lie in {joined.rows} x {joined.columns} windows, of which they have few"
        expect(joined.rows * joined.columns <= SPARSE * joined.places, "areas nearby, or maps to merge", seen)
        return added

    # ------------------------------------------------------------------ in a file

    def stored(self) -> dict[str, Any]:
        """What a map file keeps, beside the number of places, as JSON values."""
        facts, names = dict[str, Any](), self.routes
        if names or self.dimensions == 2:
            routes = ({"name": names[r], "places": n, "frames": f} for r, n, f in self.runs if names)
            facts["routes"] = [*routes]
        if self.dimensions == 2:
            parts = [
                {name: getattr(one, name) for name in ("rows", "columns", "first", "right", "down")}
                | {"unit": self.unit, "frame": self.frame, "corner": corner}
                for one, corner in zip(self.rectangles, self._corners, strict=True)
            ]
            area = parts[0] | {"rows": self.rows, "columns": self.columns}
            del area["corner"]
            facts["area"] = area | ({"parts": parts} if len(parts) > 1 else {})
        return facts if type(self) is Layout else facts | {"layout": type(self).__name__}

    @staticmethod
    def restored(facts: Mapping[str, Any], places: int) -> Layout:
        """The layout of so many places from the results of `stored`."""
        name, area = facts.get("layout", "Layout"), facts.get("area")
        expect(name in KINDS, f"one of {', '.join(KINDS)}, or its line in `KINDS`", f"a layout {name!r:.40}")
        kind, routes = KINDS[name], facts.get("routes", [])
        if area is None and not routes:
            return ROUTE if kind is Layout else kind(places)
        names = [*dict.fromkeys(run["name"] for run in routes)]
        numbers = [names.index(run["name"]) for run in routes]
        rectangles, ends = [], [0] * len(names)
        if area is None:
            for run, route in zip(routes, numbers, strict=True):
                n, shown = run["places"], run["frames"]
                one = Rectangle(n, corner=(ends[route], 0), route=route)
                rectangles.append(one if shown == n else one._replace(frames=shown))
                ends[route] += n
            return kind.of(rectangles, "", "", names)
        last, start = [*accumulate(run["places"] for run in routes)], 0
        for part in area.get("parts", [area]):
            first, right, down = (_pair(part[name]) for name in ("first", "right", "down"))
            top, left = part.get("corner", (0, 0))
            route = numbers[bisect_right(last, start)] if routes else 0
            rectangles.append(
                Rectangle(part["rows"], part["columns"], first, right, down, (top, left), route)
            )
            start += rectangles[-1].places
        expect(0 <= start <= LARGEST, f"up to {LARGEST}", f"{start} windows of an area")
        return kind.of(rectangles, area["unit"], area["frame"], names)


KINDS: dict[str, type[Layout]] = {"Layout": Layout}  # that a map file may name
ROUTE = Layout()  # a route whose length is not yet known, see `Layout.reaching`


def agree(one: str, other: str) -> bool:
    """Whether two frames of coordinates may be the same; "" is unknown."""
    return "" in (one, other) or one == other


def _pair(values: Sequence[float]) -> Point:
    x, y = values
    return x, y
