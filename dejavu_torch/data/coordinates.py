"""Coordinates of frames, in metres."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.files import as_number
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")

Kind = Literal["utm", "degrees", "metres"]
FORMS: dict[Kind, str] = {"utm": "@easting@northing@...", "degrees": "@lat@lon@...", "metres": "@x@y@..."}
MAJOR, ECCENTRICITY = 6_378_137.0, 0.081819190842622  # of the WGS84 ellipsoid: metres, and e
NAN = (math.nan, math.nan)


class Near(NamedTuple):
    """A ground truth by coordinates: every place within a radius in metres, inclusive."""

    kind: Kind
    radius: float


class Fix(NamedTuple):
    """What the name of an image tells of where it was taken; NaN for what it does not."""

    first: float
    second: float
    zone: str = ""  # of UTM, with its hemisphere
    degrees: tuple[float, float] = NAN


def named_coordinates(traverses: Sequence[Traverse], kind: Kind) -> list[Tensor]:
    """Coordinates in the names of the images of traverses, (N,2) float64 metres each, NaN for frames without.

    Args:
        kind: "utm": the names have fields @easting@northing[@zone@letter[@lat@lon]]@, as of
            VPR-datasets-downloader; where frames lie in different zones, latitude and longitude are used.
            "degrees": @lat@lon@. "metres": @x@y@.

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
    """Latitudes and longitudes (N,2) in degrees as metres north and east of their mean, (N,2) each.

    Source: radii of curvature of the WGS84 ellipsoid. Within 50 km of the mean lengths are right to 1 %.

    Example:
        >>> (one,) = in_metres([torch.tensor([[48.0, 11.0], [48.001, 11.0]], dtype=torch.float64)])
        >>> round(float(one[1, 0] - one[0, 0]), 1)
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
    return [(one - centre).deg2rad() * scale for one in wrapped]


def _fixes(traverse: Traverse, kind: Kind) -> list[Fix]:
    names = traverse.names
    if not names:
        seen = f"{traverse.name} has no image names"
        raise InputError(f"{seen}; expected a folder of images for truth {kind}")
    fixes = [_fix(name) for name in names]
    missing = [name for name, fix in zip(names, fixes, strict=True) if math.isnan(fix.first)]
    if len(missing) == len(names):
        raise InputError(f"{traverse.name}: {missing[0]} has no coordinates; expected {FORMS[kind]}")
    if missing:
        line = "%s: %d of %d frames have no coordinates, such as %s, and are not scored"
        log.warning(line, traverse.name, len(missing), len(names), missing[0])
    return fixes


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
