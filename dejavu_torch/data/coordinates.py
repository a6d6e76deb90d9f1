"""Coordinates of frames, in metres."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.data.fixes import checked_fixes
from dejavu_torch.data.folder import natural
from dejavu_torch.data.geotiff import from_degrees
from dejavu_torch.data.tables import Table, check_frames, number, read_table, whole
from dejavu_torch.types import Coordinates, InputError, Odometer, Traverse, expect

log = logging.getLogger("dejavu_torch")

Key = TypeVar("Key", str, int)
Kind = Literal["utm", "degrees", "metres", "pixels"]
FORMS: dict[Kind, str] = {"utm": "@easting@northing@...", "degrees": "@lat@lon@..."}
FORMS |= {"metres": "@x@y@...", "pixels": "@x@y@..."}
MAJOR, ECCENTRICITY = 6_378_137.0, 0.081819190842622  # of the WGS84 ellipsoid: metres, and e
NAN = (math.nan, math.nan)
EXPECTED = (
    "a csv with the columns x,y or lat,lon, and name or time where rows are not frames; poses of KITTI, "
    "12 numbers a line; or of TUM or EuRoC, with times"
)
MOVED = "a csv with a column moved, in places, or moved_m, and a row for each frame, or names or times"
PAIRS = ("x", "y"), ("lat", "lon"), ("easting", "northing")  # columns
POSES = {12: ",,,x,,,,y,,,,z", 8: "time,x,y,z", 17: "time,x,y,z"}  # of KITTI, TUM and EuRoC, by their width
UNITS = (1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3)  # times above are in nano-, micro- or milliseconds
OF_MAPS = re.compile(r"EPSG:|.*\[")  # coordinate systems, by number or as text; not pixels
COUNTED = 1e8  # whole numbers in names below count frames; times in seconds are larger
COVERED = 0.5  # of such numbers within the times of a table, to be times
GAP = 1.0  # seconds between two rows within which no frame has coordinates


class Near(NamedTuple):
    """A ground truth by coordinates: every place within a radius in metres, inclusive."""

    kind: Kind
    radius: float

    @property
    def unit(self) -> str:
        """ "px" or "m"."""
        return "px" if self.kind == "pixels" else "m"


class Fix(NamedTuple):
    """What the name of an image tells of where it was taken; NaN for what it does not."""

    first: float
    second: float
    zone: str = ""  # of UTM, with its hemisphere
    degrees: tuple[float, float] = NAN


def coordinates_of(traverses: Sequence[Traverse], kind: Kind) -> list[Tensor]:
    """Coordinates of traverses in one frame, (N,2) or (N,3) float64 metres each, the height last, NaN for
    frames without. They are those that the traverses carry, for "metres" and "pixels", if one does, else
    those in names. Degrees are converted to the coordinate system of the other traverse, if it is that of a
    map.

    Raises:
        InputError: as `named_coordinates` and `from_degrees`; some that carry none, or of different kinds
            or frames.
    """
    carried = [traverse.coordinates for traverse in traverses]
    if kind not in ("metres", "pixels") or not any(carried):
        return named_coordinates(traverses, kind)
    names = {one.coordinates is None: one.name for one in traverses}
    seen = f"{names.get(False)} has coordinates and {names.get(True)} none"
    expect(all(carried), "'SOURCE?coordinates=FILE' for both", seen)
    known = [own for own in carried if own is not None]
    if frame := next((own.frame for own in known if OF_MAPS.match(own.frame)), ""):
        known = [Coordinates(from_degrees(own.values, frame)) if own.degrees else own for own in known]
    expect(len({own.degrees for own in known}) < 2, "one kind", "coordinates in metres and in degrees")
    if known[0].degrees:
        return in_metres([own.values for own in known])
    frames = {own.frame: one.name for own, one in zip(known, traverses, strict=True) if own.frame}
    seen = " and ".join(f"coordinates of {name} in {frame}" for frame, name in frames.items())
    expect(len(frames) < 2, "one system for both, as by gdalwarp -t_srs", seen)
    widths = [own.values.shape[1] for own in known]
    if len({*widths}) > 1:
        flat = f"{traverses[widths.index(2)].name} has coordinates of two numbers: the other's heights"
    elif len({own.height for own in known}) > 1:
        flat = f"{traverses[0].name} has coordinates of another axis for heights than the other visit: they"
    else:
        return [own.upright() for own in known]
    _warn(f"{flat} are not compared")
    return [own.upright()[:, :2] for own in known]


def read_coordinates(path: Path, traverse: Traverse) -> tuple[Coordinates, Tensor | None, Odometer | None]:
    """Where the frames of a traverse were taken, from a file of one row a frame, or with names, times or
    numbers of frames; their headings (N,) in degrees, and what an odometer reads, if the file tells. What is
    no place is told and left out, see `checked_fixes`.

    Args:
        path: a table whose header has x,y[,z], easting,northing or lat,lon, and may have `name`, of images,
            `time`, or `frame`, from 0, also by other names and with units, see `read_table`. Poses of KITTI
            (12 numbers: the 4th, 8th and 12th), TUM (`time x y z`, a quaternion), or EuRoC (the same between
            commas, in nanoseconds). Times are compared with those of a video, or with image names that are
            times; both in seconds, or in the unit that their size tells. Between rows up to a second apart
            coordinates are interpolated. A column `heading` has degrees clockwise from
            north, or from the upper side of a picture; for `moved` see `read_odometer`.

    Raises:
        InputError: another file, or rows that fit no frames.
    """
    table = read_table(path, EXPECTED)
    expect(table.rows or table.header, EXPECTED, f"{path} has no rows")
    columns, degrees, height = _columns(table)
    table = table.distinct() if "time" in table and len(table) != len(traverse) else table
    turns = "heading" in table
    columns += ["heading"] * turns
    table.check_width(*columns)
    values, dimensions = np.stack([table.numbers(column) for column in columns], 1), len(columns) - turns
    if turns:
        known = ~np.isnan(values[:, -1])  # from one to the next the shorter way around
        values[known, -1] = np.unwrap(values[known, -1], period=360)
    if degrees and not (np.abs(np.nan_to_num(values[:, :2])) <= (90, 180)).all():
        raise InputError(f"{path} has latitudes beyond 90 or longitudes beyond 180; expected degrees")
    order = _in_order(table)
    lines = [table.rows[row][0] for row in order]
    values[order, :dimensions], seen = checked_fixes(values[order, :dimensions], degrees, lines)
    values = _of_frames(table, values, traverse)
    odometer = None
    try:
        if "moved" in table:
            odometer = read_odometer(table, traverse)
            seen.append("the column moved is read as odometry, for drives and filters")
    except InputError as error:
        seen.append(f"the column moved is not used: {error}")
    if unused := table.unused():
        many, are = ("s", "are") if unused[1:] else ("", "is")
        seen.append(f"the column{many} {', '.join(unused)} {are} not used")
    for line in seen:
        log.warning("%s: %s", path, line)
    where, towards = np.split(values, [dimensions], 1)
    told = not np.isnan(where).any(1).all()
    expect(told, "its names or times", f"{path} tells of no frame of {traverse.name}")
    for what, part in (("coordinates", where), ("heading", towards)):
        if missing := int(np.isnan(part).any(1).sum()):
            log.warning("%s: %d of %d frames have no %s", traverse.name, missing, len(traverse), what)
    headings = None if np.isnan(towards).all() else torch.from_numpy(towards[:, 0] % 360)
    return Coordinates(torch.from_numpy(where.copy()), degrees, height=height), headings, odometer


def read_odometer(table: Table, traverse: Traverse) -> Odometer:
    """What an odometer reads at the frames of a traverse, from rows as `read_coordinates` takes them: `moved`
    is how far the camera moved since the row before, in places, or in metres, as in moved_m or "moved [cm]";
    `moved_spread` its standard deviation, in the same unit. Raises an InputError if it is another table."""
    expect("moved" in table and table.rows, MOVED, f"{table}, and {len(table)} rows")
    roles = [role for role in ("moved", "moved_spread") if role in table]
    columns = [table.header[table.at(role)] for role in roles]
    if "time" in table:
        table = table.distinct()
    unit, titles = columns[0].unit, " and ".join(column.title for column in columns)
    expect(columns[-1].unit in (None, unit), "one unit", f"{table.path} has the columns {titles}")
    cells = [table.text(role) for role in roles]
    found = np.array([[number(cell) for cell in column] for column in cells]).T
    found[0] = 0  # there is no row before the first
    for row, column in np.argwhere(~(found >= 0))[:1]:
        seen = f"{table.where(row)}: {columns[column].title} is {cells[column][row]!r}"
        raise InputError(f"{seen}; expected a number of at least 0")
    read = np.full((len(table), 2), math.nan)
    read[:, : len(roles)] = (((unit or 1.0) * found) ** (1, 2)[: len(roles)]).cumsum(0)
    return Odometer(torch.from_numpy(_of_frames(table, read, traverse)), unit is not None)


def odometer_of(traverse: Traverse) -> Odometer:
    """What an odometer would read at frames by their coordinates, even where some have none; an InputError
    without any in metres or degrees."""
    own, expected = traverse.coordinates, "those of 'SOURCE?coordinates=FILE', in metres or degrees"
    expect(own is not None and own.frame != "pixels", expected, f"{traverse.name} without coordinates")
    (at,) = coordinates_of([traverse], "metres")
    known = ~at.isnan().any(1)
    expect(bool(known.any()), "those of some frames", f"{traverse.name} has no coordinates of its frames")
    way = F.pad(at[known].diff(dim=0).norm(dim=1), (1, 0)).cumsum(0)
    frames, seen = np.arange(len(at)), known.nonzero()[:, 0].numpy()
    beyond = frames - frames.clip(seen[0], seen[-1])  # of the fixes, which the mean speed continues
    even = np.interp(frames, seen, way) + beyond * float(way[-1]) / max(1, seen[-1] - seen[0])
    return Odometer(torch.from_numpy(np.stack([even, np.full(len(at), math.nan)], 1)), True)


def _columns(table: Table) -> tuple[list[str], bool, int]:
    """The columns of coordinates, whether they are degrees, and which of them is the height."""
    if not table.header:
        roles = POSES.get(width := len(table.rows[0][1]), "")
        expect(roles, EXPECTED, str(table))
        table.named(*roles.split(","))
        return [*"xyz"], False, 1 if width == 12 else 2  # of KITTI they point right, down, ahead
    pair = next((pair for pair in PAIRS if all(one in table for one in pair)), ("", ""))
    expect(all(pair) and table.rows, EXPECTED, str(table))
    degrees = pair[0] == "lat"
    # heights of receivers, of other names, are no better than tens of metres
    height = "z" in table and (pair[0] == "x" or any(column.title == "z" for column in table.header))
    return [*pair, *["z"] * (height and not degrees)], degrees, 2


def _in_order(table: Table) -> list[int]:
    """The rows in the order in which they were taken, as far as it is known."""
    if "time" in table or "frame" in table:
        order = np.argsort(table.numbers("time" if "time" in table else "frame"), kind="stable")
        return [int(row) for row in order]
    names = table.text("name") if "name" in table else []
    return sorted(range(len(table)), key=lambda row: natural(names[row])) if names else [*range(len(table))]


def _of_frames(table: Table, values: np.ndarray, traverse: Traverse) -> np.ndarray:
    """The rows (R,K) of the frames of a traverse, (N,K), NaN where there is none."""
    path, frames = table.path, len(traverse)

    def picked(rows: Iterable[int | None]) -> np.ndarray:
        none = np.full(values.shape[1], math.nan)
        return np.array([none if row is None else values[row] for row in rows])

    numbered = "frame" in table and not np.isnan(table.numbers("frame")).all()  # else of another frame
    if "name" in table and (
        any(traverse.names) or not ("time" in table or numbered or len(values) == frames)
    ):
        rows = _rows_by(table, "name", table.text("name"), values)
        # names of a file may have folders, or no suffix
        for way, asked in (str, str), (_last, _last), (_last, _stem), (_stem, _stem):
            by = {way(name): row for name, row in rows.items()}
            if len(by) == len(rows) and any(asked(name) in by for name in traverse.names):
                return picked(by.get(asked(name)) for name in traverse.names)
        seen = f"{path} tells of no frame of {traverse.name}"
        raise InputError(f"{seen}; expected its names or times, such as {[*traverse.names, 'none'][0]}")
    taken = _times(table, traverse) if "time" in table else None
    if "time" in table and (taken is not None or len(values) != frames):
        times = table.numbers("time")
        if "nsec" in table and not (times % 1).any():  # else they have the fractions
            times = times + 1e-9 * table.numbers("nsec")
        return _at_times(table, times, values, traverse.name, taken)
    if numbered and not ("time" in table and len(values) == frames):
        numbers = [whole(cell, "frame", 0, table.where(row)) for row, cell in enumerate(table.text("frame"))]
        check_frames(numbers, frames, path, "frame")
        return picked(map(_rows_by(table, "frame", numbers, values).get, range(frames)))
    seen = f"{path} has {len(values)} rows, {traverse.name} {frames} frames"
    expect(len(values) == frames, "as many, or a column name or time or frame", seen)
    return values


def _rows_by(table: Table, role: str, keys: Sequence[Key], values: np.ndarray) -> dict[Key, int]:
    """The rows of names or numbers; refuses one that is there twice, with other values."""
    rows: dict[Key, int] = {}
    for row, key in enumerate(keys):
        first = rows.setdefault(key, row)
        same = first == row or np.array_equal(values[first], values[row], equal_nan=True)
        seen = f"{role} {key} twice"
        expect(same, f"the row of line {table.rows[first][0]} alone", f"{table.where(row)}: {seen}")
    return rows


def _last(name: str) -> str:
    return re.split(r"[/\\]", name)[-1]


def _stem(name: str) -> str:
    return Path(_last(name)).stem


def _seconds(times: np.ndarray) -> np.ndarray:
    """Times in seconds, whatever their unit."""
    largest = float(np.nanmax(times))
    return times * next((factor for least, factor in UNITS if largest > least), 1.0)


def _times(table: Table, traverse: Traverse) -> np.ndarray | None:
    """When frames were taken (N,), as they or their names tell; numbers in names that merely count are times
    only if the table's are about as large."""
    if traverse.times is not None:
        asked: np.ndarray = traverse.times.numpy()
        return asked
    named = np.array([number(_stem(name)) for name in traverse.names])
    known, times = (one[~np.isnan(one)] for one in (named, table.numbers("time")))
    if not len(known):
        return None
    within = (known >= times.min(initial=math.inf)) & (known <= times.max(initial=-math.inf))
    counts = known.max() < COUNTED and not (known % 1).any()
    return None if counts and within.mean() < COVERED else named


def _range(times: np.ndarray) -> str:
    return f"{np.nanmin(times):.14g} to {np.nanmax(times):.14g} s"


def _at_times(
    table: Table, times: np.ndarray, values: np.ndarray, name: str, asked: np.ndarray | None
) -> np.ndarray:
    """The values (M,K) at times (M,), at the times of the frames: (N,K), NaN in gaps."""
    path = table.path
    if asked is None or np.isnan(times).any():
        why = f"{path} has a row without a time"
        why = why if np.isnan(times).any() else f"{name} has no times within those of {path}, {_range(times)}"
        raise InputError(f"{why}; expected a video, image names such as 1305031102.975.png, or a row a frame")
    asked, times = _seconds(asked), _seconds(times)
    kept = np.append(True, (np.diff(times) != 0) | (np.diff(values, axis=0) != 0).any(1))
    times, values = times[kept], values[kept]
    expect((np.diff(times) >= 0).all(), "rows in order", f"{path} has times that do not rise")
    for row in (equal := np.flatnonzero(np.diff(times) == 0))[:1]:
        one, other = np.array([line for line, _ in table.rows])[kept][row : row + 2]
        seen = f"{path} has {len(equal)} times twice: lines {one} and {other} both have {times[row]:.17g} s"
        raise InputError(f"{seen}; expected times with more digits")
    at = np.column_stack([np.interp(asked, times, column, math.nan, math.nan) for column in values.T])
    after = np.searchsorted(times, asked).clip(1, max(1, len(times) - 1))
    gap = times[after % len(times)] - times[after - 1] if len(times) > 1 else np.zeros(len(asked))
    exact = np.isin(asked, times)
    seen = f"{path} has the times {_range(times)}, {name} {_range(asked)}"
    within = (asked >= times[0]) & (asked <= times[-1])
    expect(within.any(), "times of one clock", seen)
    return np.where(((gap <= GAP) | exact)[:, None], at, math.nan)


def named_coordinates(traverses: Sequence[Traverse], kind: Kind) -> list[Tensor]:
    """Coordinates in the names of the images of traverses, (N,2) float64 metres each, NaN for frames without.

    Args:
        kind: "utm": the names have fields @easting@northing[@zone@letter[@lat@lon]]@, as of
            VPR-datasets-downloader; where frames lie in different zones, latitude and longitude are used.
            "degrees": @lat@lon@. "metres", "pixels": @x@y@.

    Raises:
        InputError: no names, no coordinates in any of them, degrees where metres were asked for, or zones
            that differ without latitudes.
    """
    fixes = [_fixes(traverse, kind) for traverse in traverses]
    known = [fix for own in fixes for fix in own if not math.isnan(fix.first)]
    looks = all(abs(fix.first) <= 90 and abs(fix.second) <= 180 for fix in known)
    one = known[0]
    if kind == "degrees" and not looks:
        wrong = next(fix for fix in known if abs(fix.first) > 90 or abs(fix.second) > 180)
        seen = f"{wrong.first:g}, {wrong.second:g} are no degrees"
        raise InputError(f"{seen}; expected latitude and longitude, or --truth utm:25 or metres:25")
    if kind == "utm" and looks:
        expected = "expected --truth degrees:25 (lat, lon) or metres:25"
        raise InputError(f"{one.first:g}, {one.second:g} look like degrees; {expected}")
    if differ := kind == "utm" and len({fix.zone for fix in known}) > 1:
        seen = f"UTM zones {' and '.join(sorted({fix.zone[:-1] or 'none' for fix in known}))}"
        told = not any(math.isnan(fix.degrees[0]) for fix in known)
        expect(told, "one, or @zone@letter@lat@lon in every name", seen)
    rows = [[fix.degrees if differ else fix[:2] for fix in own] for own in fixes]
    tables = [torch.tensor(own, dtype=torch.float64) for own in rows]
    return in_metres(tables) if differ or kind == "degrees" else tables


def in_metres(tables: Sequence[Tensor]) -> list[Tensor]:
    """Latitudes and longitudes (N,2) in degrees as metres east and north of their mean, (N,2) each.

    Source: radii of curvature of the WGS84 ellipsoid. Within 50 km of the mean lengths are right to 1 %.

    Example:
        >>> (one,) = in_metres([torch.tensor([[48.0, 11.0], [48.001, 11.0]], dtype=torch.float64)])
        >>> round(float(one[1, 1] - one[0, 1]), 1)
        111.2
    """
    every = torch.cat([*tables])
    known = every[~every.isnan().any(1)]
    base = float(known[0, 1])
    wrapped = [torch.stack([one[:, 0], (one[:, 1] - base + 180) % 360 - 180], 1) for one in tables]
    every = torch.cat(wrapped)
    centre = every[~every.isnan().any(1)].mean(0)
    latitude = math.radians(float(centre[0]))
    flat = 1 - (ECCENTRICITY * math.sin(latitude)) ** 2
    along = MAJOR * (1 - ECCENTRICITY**2) / flat**1.5  # radius of a meridian
    across = MAJOR / math.sqrt(flat) * math.cos(latitude)
    scale = torch.tensor([along, across], dtype=torch.float64)
    return [((one - centre).deg2rad() * scale).fliplr() for one in wrapped]


def _fixes(traverse: Traverse, kind: Kind) -> list[Fix]:
    names = traverse.names
    expect(names, f"a folder of images for truth {kind}", f"{traverse.name} has no image names")
    fixes = [_fix(name) for name in names]
    missing = [name for name, fix in zip(names, fixes, strict=True) if math.isnan(fix.first)]
    if len(missing) == len(names):
        raise InputError(f"{traverse.name}: {missing[0]} has no coordinates; expected {FORMS[kind]}")
    if missing:
        some = f"{len(missing)} of {len(names)} frames have no coordinates, such as {missing[0]}"
        _warn(f"{traverse.name}: {some}, and are not scored")
    return fixes


@cache  # a report asks twice
def _warn(line: str) -> None:
    log.warning("%s", line)


def _fix(name: str) -> Fix:
    parts = [*name.split("@")[1:7], *[""] * 6]
    first, second, zone, _, *degrees = (number(part) for part in parts[:6])
    if math.isnan(first + second):
        return Fix(*NAN)
    letter = parts[3].upper()
    if not (1 <= zone <= 60 and zone % 1 == 0 and len(letter) == 1 and "C" <= letter <= "X"):
        return Fix(first, second)
    fits = abs(degrees[0]) <= 90 and abs(degrees[1]) <= 180
    hemisphere = "N" if letter >= "N" else "S"
    return Fix(first, second, f"{zone:g}{hemisphere}", (degrees[0], degrees[1]) if fits else NAN)
