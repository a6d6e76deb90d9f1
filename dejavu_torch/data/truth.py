"""The right places of each query."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.types import GroundTruth, InputError

PAIRS_AT_ONCE = 2**20


class Shown(NamedTuple):
    """The frames that evenly spaced places, and queries, show.

    query: (Q,) int64, the frame of the query's traverse that each query shows; None where queries are frames.
    place: (N,) int64, never falling, the reference frame that each place shows; None where unknown.
    place_of: (F,) int64, the place nearest to each reference frame, -1 for none; None where unknown.
    frames: how many frames the query's traverse has, None where unknown.
    """

    query: Tensor | None
    place: Tensor | None = None
    place_of: Tensor | None = None
    frames: int | None = None


def unit_of(shown: Shown | None) -> str:
    """What queries and places, and so tolerances, count."""
    return "frames" if shown is None else "evenly spaced places"


def as_truth(truth: Tensor | GroundTruth) -> GroundTruth:
    """A tensor of right places (Q,R), -1 as padding, as a GroundTruth in which every query is known."""
    if isinstance(truth, GroundTruth):
        return truth
    known = torch.ones(len(truth), dtype=torch.bool)
    return GroundTruth(truth, known, truth.new_zeros(len(truth), 0))


def padded(row: Tensor, place: Tensor, rows: int) -> Tensor:
    """Pairs of row and place as a table, a line a row, -1 as padding.

    Args:
        row: (n,) int64, in increasing order. place: (n,) int64.

    Shape: -> (rows,R) int64, R the most places of any row.

    Example:
        >>> padded(torch.tensor([0, 2, 2]), torch.tensor([5, 6, 7]), rows=3).tolist()
        [[5, -1], [-1, -1], [6, 7]]
    """
    count = torch.bincount(row, minlength=rows)
    slot = torch.arange(len(row)) - (count.cumsum(0) - count)[row]
    table = place.new_full((rows, int(count.max()) if rows else 0), -1)
    table[row, slot] = place
    return table


def offset_truth(queries: int | Tensor, places: int | None, offset: int = 0) -> Tensor:
    """Query i is place i + offset; where that is no place, the query has no right answer (-1).

    Args:
        queries: how many, or (Q,) int64 the number of each. places: how many, None where unknown.

    Shape: -> (Q,1) int64.

    Example:
        >>> offset_truth(3, 3, offset=1).flatten().tolist()
        [1, 2, -1]
    """
    place = (torch.arange(queries) if isinstance(queries, int) else queries) + offset
    there = place >= 0 if places is None else (place >= 0) & (place < places)
    return torch.where(there, place, -1)[:, None]


def position_truth(reference: Tensor, query: Tensor) -> Tensor:
    """The reference frame nearest to each query by position along the route.

    Args:
        reference: (N,) positions of the reference frames. query: (Q,) positions of the queries, in
            the same unit.

    Shape: -> (Q,1) int64, -1 for a query further than the widest step of the reference from all
        of its frames.
    """
    ordered, order = reference.double().sort()
    slot = torch.searchsorted(ordered, query.double()).clamp(1, max(1, len(ordered) - 1))
    pair = torch.stack([slot - 1, slot.clamp(max=len(ordered) - 1)])
    gaps = (ordered[pair] - query.double()).abs()
    nearest = gaps.argmin(0, keepdim=True)
    widest = float(ordered.diff().max()) if len(ordered) > 1 else 0.0
    place = torch.where(gaps.gather(0, nearest) <= widest, order[pair.gather(0, nearest)], -1)
    return place.T


def near_truth(reference: Tensor, query: Tensor, radius: float) -> Tensor:
    """Every reference frame within a distance of each query.

    Args:
        reference: (N,K) coordinates of the reference frames. query: (Q,K) those of the queries.
        radius: inclusive, in the unit of the coordinates.

    Shape: -> (Q,R) int64, -1 as padding.

    Example:
        >>> near_truth(torch.tensor([[0.0, 0.0], [3.0, 4.0]]), torch.zeros(1, 2), radius=5.0).tolist()
        [[0, 1]]
    """
    found = []
    at_once = max(1, PAIRS_AT_ONCE // max(1, len(reference)))
    for start in range(0, len(query), at_once):
        part = query[start : start + at_once].double()
        # matrix products would cancel the metres of large coordinates
        distance = torch.cdist(part, reference.double(), compute_mode="donot_use_mm_for_euclid_dist")
        found.append((distance <= radius).nonzero() + torch.tensor([start, 0]))
    row, place = torch.cat(found).T
    return padded(row, place, len(query))


def is_right(index: Tensor, truth: Tensor, tolerance: int) -> Tensor:
    """Whether each reported place is within the tolerance of any of its right places.

    Shape: index (Q,) int64, truth (Q,R) int64 -> (Q,) bool.

    Convention: the tolerance is inclusive, |index - truth| <= tolerance; -1 is no place.

    Example:
        >>> is_right(torch.tensor([5, 6, -1]), torch.tensor([[0], [0], [0]]), tolerance=5).tolist()
        [True, False, False]
    """
    near = (index[:, None] - truth).abs() <= tolerance
    return (near & (truth >= 0) & (index >= 0)[:, None]).any(1)


def counted(index: Tensor, truth: GroundTruth, tolerance: int) -> Tensor:
    """Which queries a score counts: those of known truth that do not report a soft place.

    Shape: (Q,) -> (Q,) bool.
    """
    soft = is_right(index, truth.ignored, 0)
    return truth.judged & (is_right(index, truth.positives, tolerance) | ~soft)


def places_of_frames(frames: Tensor, shown: Shown) -> Tensor:
    """The evenly spaced place nearest to each reference frame; -1, no frame, stays -1.

    Shape: int64 of any shape, as are the places.

    Raises:
        InputError: the frames of the places are not known, or a frame that the reference has not.

    Example:
        >>> shown = Shown(None, place=torch.tensor([0, 2, 3]), place_of=torch.tensor([0, 0, 1, 2]))
        >>> places_of_frames(torch.tensor([3, 1, -1]), shown).tolist()
        [2, 0, -1]
    """
    if shown.place_of is None:
        raise InputError(
            "the truth counts frames and the matches count evenly spaced places; expected the map (--map), "
            "which tells the frame of each place"
        )
    if frames.numel() and int(frames.max()) >= len(shown.place_of):
        raise InputError(
            f"the truth names frame {int(frames.max())} of the reference; expected frames from 0 to "
            f"{len(shown.place_of) - 1}"
        )
    return torch.where(frames >= 0, shown.place_of[frames], -1)


def truth_of_places(truth: GroundTruth, shown: Shown) -> GroundTruth:
    """A truth whose places are reference frames as one of evenly spaced places.

    Convention: where several places show the same frame, all of them are right.

    Raises:
        InputError: see `places_of_frames`.
    """
    shows = torch.zeros(0) if shown.place is None else shown.place

    def among_places(table: Tensor) -> Tensor:
        nearest = places_of_frames(table, shown)
        row, column = (nearest >= 0).nonzero().T
        frame = shows[nearest[row, column]]
        start, stop = (torch.searchsorted(shows, frame, right=right) for right in (False, True))
        count = stop - start
        within = torch.arange(int(count.sum())) - (count.cumsum(0) - count).repeat_interleave(count)
        return padded(row.repeat_interleave(count), start.repeat_interleave(count) + within, len(table))

    return GroundTruth(among_places(truth.positives), truth.judged, among_places(truth.ignored))
