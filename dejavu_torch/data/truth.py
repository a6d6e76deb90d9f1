"""The right places of each query."""

from __future__ import annotations

import torch
from torch import Tensor

from dejavu_torch.types import InputError, Traverse


def offset_truth(queries: int, places: int, offset: int = 0) -> Tensor:
    """Query i is place i + offset; where that is no place, the query has no right answer (-1).

    Shape: -> (Q,1) int64.

    Example:
        >>> offset_truth(3, 3, offset=1).flatten().tolist()
        [1, 2, -1]
    """
    place = torch.arange(queries) + offset
    return torch.where((place >= 0) & (place < places), place, -1)[:, None]


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


def read_offset(truth: str) -> int:
    """The offset that a text means.

    Raises:
        InputError: no integer.
    """
    try:
        return int(truth)
    except ValueError as error:
        raise InputError(f"truth {truth!r} is not known; expected an integer offset such as 0") from error


def find_truth(
    truth: str | None, reference: Traverse, query: Traverse, places: int, queries: int
) -> Tensor | None:
    """The truth that a command was given, or what it can know by itself.

    Args:
        truth: an integer offset (place = query + offset) as text. None: the positions that both
            traverses carry, else query i is place i where both are equally long, else no truth.

    Shape: -> (Q,R) int64, every right place of each query, -1 as padding; or None.

    Raises:
        InputError: text that is no truth, or a truth in which no query has a right answer.
    """
    if truth is not None:
        offset = read_offset(truth)
        right = offset_truth(queries, places, offset)
        if not (right >= 0).any():
            raise InputError(
                f"with truth {offset} no query has a right answer: {queries} queries, {places} places; "
                f"expected an offset from {1 - queries} to {places - 1}"
            )
        return right
    if reference.place is not None and query.place is not None:
        return position_truth(reference.place, query.place)
    return offset_truth(queries, places) if queries == places else None


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
