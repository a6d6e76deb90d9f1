"""Coordinates of frames, in metres."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.data.files import as_number, read_rows
from dejavu_torch.data.geotiff import from_degrees
from dejavu_torch.types import Coordinates, InputError, Traverse, expect

log = logging.getLogger("dejavu_torch")

Kind = Literal["utm", "degrees", "metres", "pixels"]
FORMS: dict[Kind, str] = {"utm": "@easting@northing@...", "degrees": "@lat@lon@..."}
FORMS |= {"metres": "@x@y@...", "pixels": "@x@y@..."}
MAJOR, ECCENTRICITY = 6_378_137.0, 0.081819190842622  # of the WGS84 ellipsoid: metres, and e
NAN = (math.nan, math.nan)
EXPECTED = (
    "a csv with the columns x,y or lat,lon, and name or time where rows are not frames; poses of KITTI, "
    "12 numbers a line; or of TUM or EuRoC, with times"
)
PAIRS = ("x", "y"), ("lat", "lon"), ("latitude", "longitude"), ("easting", "northing")  # columns
TIMES = "time", "timestamp"
UNITS = (1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3)  # times above are in nano-, micro- or milliseconds
OF_MAPS = re.compile(r"EPSG:|.*\[")  # coordinate systems, by number or as text; not pixels
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
    """Coordinates of traverses in one frame, (N,2) or (N,3) float64 metres each, NaN for frames without. They
    are those that the traverses carry, for "metres" and "pixels", if one does, else those in names. Degrees
    are converted to the coordinate system of the other traverse, if it is that of a map.

    Raises:
        InputError: as `named_coordinates` and `from_degrees`; some that carry none, or of different kinds
            or frames.
    """
    carried = [traverse.coordinates for traverse in traverses]
    if kind not in ("metres", "pixels") or not any(carried):
        return named_coordinates(traverses, kind)
    for own, traverse in zip(carried, traverses, strict=True):
        if own is None:
            other = next(one.name for one in traverses if one.coordinates is not None)
            seen = f"{other} has coordinates and {traverse.name} none"
            raise InputError(f"{seen}; expected 'SOURCE?coordinates=FILE' for both")
    known = [own for own in carried if own is not None]
    if frame := next((own.frame for own in known if OF_MAPS.match(own.frame)), ""):
        known = [Coordinates(from_degrees(own.values, frame)) if own.degrees else own for own in known]
    expect(len({own.degrees for own in known}) < 2, "one kind", "coordinates in metres and in degrees")
    if known[0].degrees:
        return in_metres([own.values for own in known])
    frames = {own.frame: one.name for own, one in zip(known, traverses, strict=True) if own.frame}
    seen = " and ".join(f"coordinates of {name} in {frame}" for frame, name in frames.items())
    expect(len(frames) < 2, "one system for both, as by gdalwarp -t_srs", seen)
    shared = min(own.values.shape[1] for own in known)
    return [own.values[:, :shared] for own in known]


def read_coordinates(path: Path, traverse: Traverse) -> tuple[Coordinates, Tensor | None]:
    """Where the frames of a traverse were taken, from a file of one row a frame, or with names or times; and
    their headings (N,) in degrees, if there are any.

    Args:
        path: a csv whose header has x,y[,z], easting,northing or lat,lon, and may have `name`, of images, or
            `time`; poses of KITTI (12 numbers: the 4th, 8th and 12th), TUM (`time x y z`, a quaternion), or
            EuRoC (the same between commas, in nanoseconds). Times are compared with those of a video, or with
            image names that are times; both in seconds, or in the unit that their size tells. Between rows up
            to a second apart they are interpolated. A column `heading` has degrees clockwise from north, or
            from the upper side of a picture.

    Raises:
        InputError: another file, or rows that fit no frames.
    """
    rows = [
        (line, re.split(r"[\s,]+", cells[0]) if len(cells) == 1 else cells)
        for line, cells in read_rows(path, EXPECTED)
        if not cells[0].startswith("#")
    ]
    expect(rows, EXPECTED, f"{path} has no rows")
    key, degrees, turns, columns = _columns(path, rows)
    for line, cells in rows:
        seen = f"{path}, line {line}: {len(cells)} columns"
        expect(len(cells) > max(columns), f"{max(columns) + 1} or more", seen)
    values = np.array([[_value(cells[column]) for column in columns] for _, cells in rows])
    if turns:
        known = ~np.isnan(values[:, -1])  # from one to the next the shorter way around
        values[known, -1] = np.unwrap(values[known, -1], period=360)
    if degrees and not (np.abs(np.nan_to_num(values[:, :2])) <= (90, 180)).all():
        raise InputError(f"{path} has latitudes beyond 90 or longitudes beyond 180; expected degrees")
    if key is None:
        seen = f"{path} has {len(values)} rows, {traverse.name} {len(traverse)} frames"
        expect(len(values) == len(traverse), "as many, or a column name or time", seen)
    elif key[1] == "name":
        known = dict(zip((cells[key[0]] for _, cells in rows), values, strict=True))
        values = np.array([known.get(name, np.full(len(columns), math.nan)) for name in traverse.names])
    else:
        values = _at_times(path, np.array([_value(cells[key[0]]) for _, cells in rows]), values, traverse)
    headings = torch.from_numpy(values[:, -1].copy() % 360) if turns else None
    values = values[:, : values.shape[1] - turns]
    missing = int(np.isnan(values).any(1).sum()) if len(values) else len(traverse)
    expect(missing != len(traverse), "its names or times", f"{path} tells of no frame of {traverse.name}")
    if missing:
        log.warning("%s: %d of %d frames have no coordinates", traverse.name, missing, len(traverse))
    if headings is not None and (unknown := int(headings.isnan().sum())):
        log.warning("%s: %d of %d frames have no heading", traverse.name, unknown, len(traverse))
        headings = None if unknown == len(headings) else headings
    return Coordinates(torch.from_numpy(values), degrees), headings


def _columns(
    path: Path, rows: list[tuple[int, list[str]]]
) -> tuple[tuple[int, str] | None, bool, bool, tuple[int, ...]]:
    """The column of names or times, whether coordinates are degrees, whether headings follow them, and their
    columns; a header is removed from the rows."""
    first = rows[0][1]
    if not any(math.isnan(_value(cell)) for cell in first):
        if len(first) == 12:  # KITTI
            return None, False, False, (3, 7, 11)
        if len(first) in (8, 17):  # TUM, EuRoC
            return (0, "time"), False, False, (1, 2, 3)
        raise InputError(f"{path} has {len(first)} columns without a header; expected {EXPECTED}")
    header = [cell.strip().lower() for cell in rows.pop(0)[1]]
    pair = next((pair for pair in PAIRS if {*pair} <= {*header}), None)
    if pair is None or not rows:
        raise InputError(f"{path} has the columns {', '.join(header)}; expected {EXPECTED}")
    degrees = pair[0].startswith("lat")
    names = (*pair, "z") if not degrees and "z" in header else pair
    key = next(((header.index(one), one) for one in ("name", *TIMES) if one in header), None)
    turns = "heading" in header
    names = (*names, "heading") if turns else names
    return key, degrees, turns, tuple(header.index(name) for name in names)


def _value(text: str) -> float:
    """A number of any size; NaN for anything else."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def _seconds(times: np.ndarray) -> np.ndarray:
    """Times in seconds, whatever their unit."""
    largest = float(np.nanmax(times))
    return times * next((factor for least, factor in UNITS if largest > least), 1.0)


def _at_times(path: Path, times: np.ndarray, values: np.ndarray, traverse: Traverse) -> np.ndarray:
    """The values (M,K) at times (M,), at the times of the frames: (N,K), NaN in gaps."""
    if traverse.times is not None:
        asked = traverse.times.numpy()
    else:
        asked = np.array([_value(Path(name).stem) for name in traverse.names])
    if not len(asked) or np.isnan(asked).all() or np.isnan(times).any():
        why = f"{path} has a row without a time" if np.isnan(times).any() else f"{traverse.name} has no times"
        raise InputError(f"{why}; expected a video, image names such as 1305031102.975.png, or a row a frame")
    asked, times = _seconds(asked), _seconds(times)
    if any(a >= b for a, b in pairwise(times.tolist())):
        raise InputError(f"{path} has times that do not rise; expected rows in order")
    at = np.column_stack([np.interp(asked, times, column, math.nan, math.nan) for column in values.T])
    after = np.searchsorted(times, asked).clip(1, max(1, len(times) - 1))
    gap = times[after % len(times)] - times[after - 1] if len(times) > 1 else np.zeros(len(asked))
    exact = np.isin(asked, times)
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
    if kind == "utm" and len({fix.zone for fix in known}) > 1:
        if any(math.isnan(fix.degrees[0]) for fix in known):
            zones = " and ".join(sorted({fix.zone[:-1] or "none" for fix in known}))
            raise InputError(f"UTM zones {zones}; expected one, or @zone@letter@lat@lon in every name")
        fixes = [[fix._replace(first=fix.degrees[0], second=fix.degrees[1]) for fix in own] for own in fixes]
        kind = "degrees"
    tables = [torch.tensor([fix[:2] for fix in own], dtype=torch.float64) for own in fixes]
    return in_metres(tables) if kind == "degrees" else tables


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
        _warn_missing(traverse.name, len(missing), len(names), missing[0])
    return fixes


@cache  # a report asks twice
def _warn_missing(source: str, missing: int, frames: int, example: str) -> None:
    line = "%s: %d of %d frames have no coordinates, such as %s, and are not scored"
    log.warning(line, source, missing, frames, example)


def _fix(name: str) -> Fix:
    parts = name.split("@")[1:]
    numbers = [value if (value := as_number(part)) is not None else math.nan for part in parts[:6]]
    if len(numbers) < 2 or math.isnan(sum(numbers[:2])):
        return Fix(*NAN)
    fix = Fix(numbers[0], numbers[1])
    if len(numbers) < 4 or not (1 <= numbers[2] <= 60 and numbers[2] % 1 == 0):
        return fix
    letter = parts[3].upper()
    if len(letter) != 1 or not "C" <= letter <= "X":
        return fix
    fix = fix._replace(zone=f"{numbers[2]:g}{'N' if letter >= 'N' else 'S'}")
    pair = numbers[4:6]
    fits = len(pair) == 2 and abs(pair[0]) <= 90 and abs(pair[1]) <= 180
    return fix._replace(degrees=(pair[0], pair[1])) if fits else fix
