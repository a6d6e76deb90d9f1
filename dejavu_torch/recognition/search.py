"""The lowest scores of queries and their places, from scores that are made a block of places at a time."""

from __future__ import annotations

import math
from typing import Literal, get_args

import torch
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.types import InputError

Search = Literal["auto", "scan"]
Best = tuple[Tensor, Tensor]  # (Q,n) scores, the lowest first, and places, of equal scores the lowest first

SCORES_AT_ONCE = 2**24  # numbers of Q x n held at a time


def check_search(method: str) -> None:
    """Refuse a way to search that does not exist."""
    if method not in get_args(Search):
        removed = " was removed" if method in ("bound", "ivf") else ""
        raise InputError(f"search {method!r}{removed}; expected auto or scan")


@torch.no_grad()
def search(route: PlaceMap, queries: Tensor, n: int, method: Search = "auto") -> Best:
    """The n lowest scores of queries (Q,K) on a map; memory holds the scores of a block of places.

    Args:
        method: "scan" scores all places; "auto" uses `PlaceMap.lowest` for n = 1 if the map has it.
    """
    queries = queries.to(torch.promote_types(queries.dtype, torch.float32))
    own = route.lowest(queries) if n == 1 and method == "auto" else None
    if own is not None:
        return own[0][:, None], own[1][:, None]
    found = []
    for part in queries.split(max(1, SCORES_AT_ONCE // max(1, route.block_places))):
        best = empty_topk(part, n)
        for start, scores in route.score_blocks(part):
            best = with_block(best, scores, start)
        found.append(best)
    score, place = (torch.cat(column) for column in zip(*found, strict=True))
    return score, place


def empty_topk(queries: Tensor, n: int) -> Best:
    """Before anything is found for queries (Q,K): +inf, at places beyond all there are."""
    score = queries.new_full(
        (len(queries), n), math.inf, dtype=torch.promote_types(queries.dtype, torch.float32)
    )
    return score, torch.full_like(score, torch.iinfo(torch.int64).max, dtype=torch.int64)


def with_block(best: Best, scores: Tensor, start: int) -> Best:
    """The best of these and of the scores (Q,W) of later places, from `start` on."""
    n = best[0].shape[1]
    (better,) = (scores.amin(1) < best[0][:, -1]).nonzero(as_tuple=True)
    if not len(better):
        return best
    block = topk(scores[better] if len(better) < len(scores) else scores, min(n, scores.shape[1]), start)
    score, place = merge_topk((best[0][better], best[1][better]), block)
    return best[0].to(score).index_copy(0, better, score), best[1].index_copy(0, better, place)


def topk(scores: Tensor, n: int, start: int = 0) -> Best:
    """The n lowest of each row, (Q,W) -> (Q,n); `start` is the place of the first column.

    Example:
        >>> topk(torch.tensor([[3.0, 1.0, 1.0, 0.0]]), 2)[1]
        tensor([[3, 1]])
    """
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
