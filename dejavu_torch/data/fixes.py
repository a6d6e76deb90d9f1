"""A look at coordinates before they are believed: what a receiver writes without a fix is no place."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from dejavu_torch.text import rounded

FAR, AWAY = 20, 50.0  # steps of the usual length, and metres, beyond which a fix is far from the next one
RARE = 0.1  # share of fixes that may be far from their neighbours; beyond, frames are in no order
JOINED = 2  # jumps that are told: more are drives that were joined, or a raster
MOST = 20  # rows that leave the path together
HELD, MADE_UP = 5, 3  # rows of a fix that is held, and steps of the usual length that make up for it
ALIKE, LEAST = 0.8, 5  # share of runs of equal fixes that have about one length, and their least number
AHEAD = 0.5  # cosine of the usual turn from a step to the next
SLOWEST = 100  # rows between two changes of a fix
PER_DEGREE = 111_200.0  # metres, of a meridian


Fixes = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


def checked_fixes(values: Fixes, degrees: bool = False, lines: Sequence[int] = ()) -> tuple[Fixes, list[str]]:
    """Coordinates (R,2) or (R,3), NaN where they tell no place, and what was seen, in words.

    Longitudes go on across 180 degrees, so that values between two rows can be interpolated. NaN become

    - fixes at 0, 0 or -1, -1 that repeat and lie far from the next one, as before the first fix;
    - fixes far off the path, of few rows, after which it goes on;
    - all but the first of equal fixes in a row, if the next step makes up for them: they were held. A camera
      that stops goes on from where it was.

    If fixes change every k-th row, those between are interpolated. Jumps after which the path does not come
    back are told.

    Args:
        lines: of the rows in their file, for the words; by default their numbers.

    Example:
        >>> walk = np.stack([np.arange(100.0), np.arange(100.0)], 1)
        >>> walk[40:60] = walk[40]
        >>> checked_fixes(walk)[1]
        ['19 fixes from line 41 on repeat the one before, though the next one makes up for them']
    """
    values, seen, lines = values.copy(), list[str](), lines or range(len(values))
    if degrees:
        known = ~np.isnan(values[:, 1])
        values[known, 1] = np.unwrap(values[known, 1], period=360)
    for none in (0.0, -1.0):
        at = (values[:, :2] == none).all(1)
        if 2 <= at.sum() < len(values) - 1 and _far(metres(values, degrees), at):
            values[at] = math.nan
            seen.append(f"{at.sum()} fixes at {none:g}, {none:g} lie far from the next one")
    path = metres(values, degrees)
    if (off := _astray(path)).any():
        away, first = rounded(float(_steps(path).max())), lines[np.flatnonzero(off)[0]]
        values[off] = math.nan
        many = (
            f"{off.sum()} fixes from line {first} on lie"
            if off.sum() > 1
            else f"the fix in line {first} lies"
        )
        seen.append(f"{many} {away} m off the path")
    values = _held(values, metres(values, degrees), seen, lines)
    path = metres(values, degrees)
    if 0 < len(jumps := _jumps(path)) <= JOINED:
        row, *again = np.flatnonzero(_known(values))[jumps]
        then = f"again after line {lines[again[0]]}" if again else "does not come back"
        away = rounded(float(_steps(path)[jumps[0]]))
        seen.append(f"the path jumps {away} m after line {lines[row]}, and {then}")
    return values, seen


def metres(values: Fixes, degrees: bool) -> Fixes:
    """Coordinates (R,K) in metres, near enough to compare steps."""
    north = values[_known(values), :1]
    across = np.cos(np.radians(north.mean())) if degrees and len(north) else 1.0
    found: Fixes = PER_DEGREE * values[:, :2] * [1.0, across] if degrees else values.copy()
    return found


def _known(path: Fixes) -> Mask:
    known: Mask = np.all(~np.isnan(path), axis=1)
    return known


def _steps(path: Fixes) -> Fixes:
    """The length of the steps between fixes that are known, one after the other."""
    lengths: Fixes = np.linalg.norm(np.diff(path[_known(path)], axis=0), axis=1)
    return lengths


def _usual(path: Fixes) -> float:
    """The usual length of a step that is one; 0 if there is none."""
    steps = _steps(path)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def _limit(path: Fixes) -> float:
    """The length of a step that is no vehicle's."""
    return max(AWAY, FAR * _usual(path))


def _far(path: Fixes, at: Mask) -> bool:
    """Whether the fixes of a mask lie far from all others that follow them, or from those before."""
    others = ~at & _known(path)
    order = np.searchsorted(np.flatnonzero(others), np.flatnonzero(at))
    beside = path[others][np.minimum(order, others.sum() - 1)] if others.any() else path[:0]
    away = np.linalg.norm(beside - path[at][0], axis=1)
    return bool(len(away) and (away > _limit(path[others])).all())


def _jumps(path: Fixes) -> list[int]:
    """The fixes that are known, by their order, after which comes a step that is no vehicle's; none if there
    are many."""
    steps, apart = _steps(path), np.diff(np.flatnonzero(_known(path)))
    jumps = np.flatnonzero(steps > apart * _limit(path)).tolist()
    return jumps if len(steps) >= 2 * LEAST and len(jumps) <= max(2, RARE * len(steps)) else []


def _astray(path: Fixes) -> Mask:
    """Which fixes lie far off a path that goes on after them, (R,) bool: between two steps that are no
    vehicle's, in few rows."""
    off, rows = np.zeros(len(path), dtype=bool), np.flatnonzero(_known(path))
    if not (jumps := _jumps(path)):
        return off
    at, last, alone = path[rows], len(rows) - 1, len(jumps) == 1
    # a jump before the first fix, and one after the last, as if the path went on there
    jumps = [*[-1] * (jumps[0] < LEAST), *jumps, *[last] * (jumps[-1] >= last - LEAST)]
    for i, before in enumerate(jumps):
        for after in jumps[i + 1 :]:
            if off[rows[max(before, 0)]] or after - before > MOST:
                break
            goes_on = alone
            if before >= 0 and after < last:
                away = float(np.linalg.norm(at[after + 1] - at[before]))
                goes_on = away <= _limit(path) + MADE_UP * _usual(path) * (after - before)
            off[rows[before + 1 : after + 1]] |= goes_on
    if off.any():  # what is left may have an end that is off
        off |= _astray(np.where(off[:, None], math.nan, path))
    return off


def _straight(path: Fixes) -> bool:
    """Whether most steps of a path (n,K) go on in about the direction of the one before, as no views do that
    were taken here and there."""
    steps = np.diff(path, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    return bool(np.median((steps[1:] * steps[:-1]).sum(1) / (lengths[1:] * lengths[:-1])) > AHEAD)


def _held(values: Fixes, path: Fixes, seen: list[str], lines: Sequence[int]) -> Fixes:
    """Values, in metres a `path`, without fixes that are held; see `checked_fixes`."""
    known, values = np.flatnonzero(_known(values)), values.copy()
    if len(known) < 2:
        return values
    own = values[known]
    starts = np.concatenate([[0], np.flatnonzero((np.diff(own, axis=0) != 0).any(1)) + 1])
    lengths = np.diff(np.append(starts, len(own)))
    every = float(np.median(lengths[:-1])) if len(lengths) > 1 else 0.0
    near = np.abs(lengths[1:-1] - every) <= max(1.0, every / 4)
    at = path[known][starts]
    if 2 <= every <= SLOWEST and len(lengths) > LEAST and near.mean() >= ALIKE and _straight(at):
        stays = starts[1:][lengths[:-1] > 2 * every] - round(every)  # until then it stood
        knots, between = np.sort(np.append(starts, stays)), known[: starts[-1] + 1]
        for column in own.T:
            column[: len(between)] = np.interp(between, known[knots], column[knots])
        values[known] = own
        seen.append(f"fixes change every {every:g} lines; those between are interpolated")
        return values
    after = np.append(np.linalg.norm(np.diff(at, axis=0), axis=1), 0.0)
    made_up = after > np.maximum(MADE_UP, lengths / MADE_UP) * _usual(path)
    held = np.repeat(made_up & (lengths >= HELD), lengths)
    held[starts] = False
    if held.any():
        values[known[held]] = math.nan
        fixes = f"{held.sum()} fixes from line {lines[known[held][0]]} on"
        seen.append(f"{fixes} repeat the one before, though the next one makes up for them")
    return values
