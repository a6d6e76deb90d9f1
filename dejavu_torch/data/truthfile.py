"""TRUTH, as every command takes it: text -> GroundTruth."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from dejavu_torch.data.truth import (
    Shown,
    as_truth,
    near_truth,
    offset_truth,
    position_truth,
    truth_of_places,
)
from dejavu_torch.data.truthformats import (
    LARGEST,
    as_number,
    counts_frames,
    read_matrices,
    read_table,
    utm_coordinates,
)
from dejavu_torch.types import GroundTruth, InputError, Traverse

EXPECTED = (
    "an integer offset such as 0, a .csv of query,place, an .npz with GThard, or utm:25 for coordinates in "
    "image names"
)


def check_truth_text(truth: str, interpolate: bool = False) -> None:
    """Refuse early, before long work, a text that cannot be a truth.

    Raises:
        InputError: neither offset nor utm, a file that cannot be opened, or interpolation of anything
            but a .csv.
    """
    kind = _kind(truth)
    if kind in (".csv", ".npz"):
        try:
            Path(truth).open("rb").close()
        except OSError as error:
            raise InputError(
                f"truth {truth} cannot be read: {error.strerror}; expected {EXPECTED}"
            ) from error
    elif _offset(truth) is None and _radius(truth) is None:
        raise InputError(f"truth {truth!r} is not known; expected {EXPECTED}")
    if interpolate and kind != ".csv":
        raise InputError(f"truth {truth} cannot be interpolated; expected a .csv of query,place")


def find_truth(
    truth: str | None,
    reference: Traverse | None,
    query: Traverse | None,
    places: int | None,
    queries: int | Tensor,
    interpolate: bool = False,
    shown: Shown | None = None,
) -> GroundTruth | None:
    """The truth that a command was given, or what it can know by itself.

    Args:
        truth: what `read_truth` reads, or `utm:25`: every reference frame within 25 metres (inclusive;
            `utm` alone means 25) by the UTM coordinates in the names of both traverses' images,
            `@easting@northing@...@.jpg`. None: the positions that both traverses carry, else query i is
            place i where both are equally long, else no truth.
        reference, query: the traverses as they came; None where there is none at hand.
        places, queries, interpolate, shown: see `read_truth`. Positions and coordinates are of frames.

    Raises:
        InputError: a truth that cannot be read or does not fit, or in which no query has a right answer.
    """
    if truth is None:
        if reference is None or query is None:
            return None
        if reference.place is not None and query.place is not None:
            frames = _numbers(queries, len(query.place), shown)
            return _spaced(as_truth(position_truth(reference.place, query.place[frames])), shown)
        if shown is not None:  # as many steps may be chance
            return None
        count = queries if isinstance(queries, int) else query.length
        return as_truth(offset_truth(queries, places)) if count == places is not None else None
    check_truth_text(truth, interpolate)
    radius = _radius(truth)
    if radius is None:
        return read_truth(truth, places, queries, interpolate, shown)
    if reference is None or query is None:
        raise InputError(f"truth {truth} lies in the names of images; expected both traverses")
    seen = utm_coordinates(query)
    right = near_truth(utm_coordinates(reference), seen[_numbers(queries, len(seen), shown)], radius)
    return _answered(_spaced(as_truth(right), shown), f"within {radius:g} m of {reference.name}")


def _spaced(truth: GroundTruth, shown: Shown | None) -> GroundTruth:
    return truth if shown is None else truth_of_places(truth, shown)


def describe_truth(
    truth: str | None, interpolate: bool = False, positions: bool = False, spaced: bool = False
) -> str:
    """What `find_truth` takes for the truth, in words.

    Args:
        positions: whether both traverses carry their positions.
        spaced: whether places are evenly spaced, so that a .csv may count those or frames.

    Example:
        >>> describe_truth("12"), describe_truth(None)
        ('place = query + 12', 'place = query, since both have as many frames')
    """
    if truth is None:
        carried = "the positions that both traverses carry"
        return carried if positions else "place = query, since both have as many frames"
    offset, radius = _offset(truth), _radius(truth)
    if offset is not None:
        return "place = query" + (f" {'-' if offset < 0 else '+'} {abs(offset)}" if offset else "")
    if radius is not None:
        return f"within {radius:g} m by the coordinates in image names"
    told = truth
    if spaced and _kind(truth) == ".csv":
        told += ", which counts frames" if counts_frames(Path(truth)) else ", which counts even steps"
    return f"{told}, interpolated" if interpolate else told


def read_truth(
    truth: str,
    places: int | None,
    queries: int | Tensor,
    interpolate: bool = False,
    shown: Shown | None = None,
) -> GroundTruth:
    """The truth that a text means.

    Args:
        truth: one of

            - an integer offset: place = query + offset;
            - a `.csv` of `query,place[,place...]`, with or without such a header: every listed place is
              right, so no other columns.
              A query listed without a place, or with -1, has no right answer; a query not listed is not
              known, and is left out of the scores. Under `query_frame,place_frame[,place_frame...]` the
              numbers are of frames, where queries and places are evenly spaced;
            - an `.npz` with the boolean matrices (places, queries) `GThard` and/or `GTsoft`, as the visual
              place recognition tutorial of Schubert et al. keeps them. What is in GThard is right (in
              GTsoft, if that is the only one); what is in GTsoft only counts neither way. Matrices as
              large as the traverses in frames are of frames.
        places: how many places the map has, None where unknown.
        queries: how many, or (Q,) int64 the number of each.
        interpolate: a query between two that the .csv lists gets the place between theirs, rounded.
        shown: the frames that evenly spaced queries and places show; None where they are frames.

    Convention: the tolerance of the scores applies on top, inclusive; with tolerance 0 the places count
        as they stand.

    Raises:
        InputError: a truth that cannot be read or does not fit, or in which no query has a right answer.

    Example:
        >>> read_truth("-1", places=3, queries=3).positives.tolist()
        [[-1], [0], [1]]
    """
    check_truth_text(truth, interpolate)
    if _radius(truth) is not None:
        raise InputError(f"truth {truth} lies in the names of images; expected both traverses")
    numbers = torch.arange(queries) if isinstance(queries, int) else queries
    if _kind(truth) == ".csv":
        return _answered(read_table(Path(truth), places, numbers, interpolate, shown), f"in {truth}")
    if _kind(truth) == ".npz":
        return _answered(read_matrices(Path(truth), places, queries, shown), f"in {truth}")
    if shown is not None and shown.query is None and len(numbers) > 1:
        raise InputError(
            f"truth {truth}: queries are frames as they came, places even steps; expected a truth by frames, "
            "such as a csv of query_frame,place_frame"
        )
    last = "" if places is None else f" to {places - 1 - int(numbers.min())}"
    return _answered(
        as_truth(offset_truth(numbers, places, int(truth))),
        f"with truth {truth}; expected an offset from {-int(numbers.max())}{last}",
    )


def _answered(truth: GroundTruth, told: str) -> GroundTruth:
    if not (truth.positives >= 0).any():
        raise InputError(f"no query has a right answer {told}")
    return truth


def _numbers(queries: int | Tensor, count: int, shown: Shown | None = None) -> Tensor:
    """The frame of each query, all below the number of query frames."""
    numbers = torch.arange(queries) if isinstance(queries, int) else queries
    if shown is not None and shown.query is not None:
        numbers = shown.query
    if int(numbers.max()) >= count:
        raise InputError(f"there is a query {int(numbers.max())}; expected numbers below {count}")
    return numbers


def _kind(truth: str) -> str:
    return Path(truth).suffix.lower()


def _offset(truth: str) -> int | None:
    try:
        offset = int(truth)
    except ValueError:
        return None
    return offset if abs(offset) < LARGEST else None


def _radius(truth: str) -> float | None:
    name, colon, radius = truth.partition(":")
    metres = as_number(radius) if colon else 25.0
    return metres if name == "utm" and metres is not None and metres >= 0 else None
