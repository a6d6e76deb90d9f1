"""The lowest scores of queries and their places, from scores that are made a block of places at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, get_args

import torch
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.types import InputError

Search = Literal["auto", "coarse", "exact", "scan"]
Best = tuple[Tensor, Tensor]  # (Q,n) scores and places, of equal scores the lowest place first
Wanted = list[tuple[int, int]]  # (k, radius): how many candidates, further than `radius` places apart
Find = Callable[[Tensor, Wanted], Best]  # finds candidates of queries (Q,K)

SCORES_AT_ONCE = 2**24  # numbers of Q x n held at a time


def check_search(method: str) -> None:
    """Refuse a way to search that does not exist."""
    if method not in get_args(Search):
        removed = " was removed" if method in ("bound", "ivf") else ""
        raise InputError(f"search {method!r}{removed}; expected auto, coarse, exact or scan")


def lowest_needed(wanted: Wanted, places: int) -> int:
    """How many of the lowest scores hold all candidates: each that is chosen rules out 2 radius + 1."""
    return min(places, max((k - 1) * (2 * radius + 1) + 1 for k, radius in wanted))


@torch.no_grad()
def search(route: PlaceMap, queries: Tensor, n: int, scan: bool = False) -> Best:
    """The n lowest scores of queries (Q,K) on a map, ascending; memory holds those of a block of places.

    Args:
        scan: score all places; else `PlaceMap.lowest` is used for n = 1 if the map has it.
    """
    queries = queries.to(torch.promote_types(queries.dtype, torch.float32))
    own = route.lowest(queries) if n == 1 and not scan else None
    if own is not None:
        return own[0][:, None], own[1][:, None]
    score, place = empty_topk(queries, n)
    at_once, first = max(1, SCORES_AT_ONCE // max(1, route.block_places)), 0
    for part in queries.split(at_once):
        for start, scores in route.score_blocks(part):
            better = (scores.amin(1) < score[first : first + len(part), -1]).nonzero()[:, 0]
            if len(better):
                scores = scores[better] if len(better) < len(scores) else scores
                block, better = topk(scores, min(n, scores.shape[1]), start), better + first
                score[better], place[better] = merge_topk((score[better], place[better]), block)
        first += len(part)
    return score, place


def empty_topk(queries: Tensor, n: int) -> Best:
    """Before anything is found for queries (Q,K): +inf, at places beyond all there are."""
    score = queries.new_full(
        (len(queries), n), math.inf, dtype=torch.promote_types(queries.dtype, torch.float32)
    )
    return score, torch.full_like(score, torch.iinfo(torch.int64).max, dtype=torch.int64)


def topk(scores: Tensor, n: int, start: int = 0) -> Best:
    """The n lowest of each row, (Q,W) -> (Q,n); `start` is the place of the first column."""
    if n == 1:
        score, index = scores.min(1, keepdim=True)
        return score, index + start
    worst = scores.topk(n, 1, largest=False).values[:, -1:].nan_to_num(math.inf, math.inf)
    kept = scores < worst
    equal = torch.where(worst.isinf(), ~kept, scores == worst)  # of which topk takes any
    equal &= equal.cumsum(1, dtype=torch.int32) <= n - kept.sum(1, keepdim=True)
    index = (kept | equal).nonzero()[:, 1].view(-1, n)
    score, order = scores.gather(1, index).sort(dim=1, stable=True)
    return score, index.gather(1, order) + start


def merge_topk(one: Best, other: Best) -> Best:
    """The n best of both, which have no place in common; n are those of the first."""
    score, place = (torch.cat(pair, 1) for pair in zip(one, other, strict=True))
    place, order = place.sort(1)
    score, by_score = score.gather(1, order).sort(dim=1, stable=True)
    n = one[0].shape[1]
    return score[:, :n], place.gather(1, by_score)[:, :n]
