"""The lowest scores of queries and their places, computed one block of places at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, get_args

import torch
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.types import InputError

Search = Literal["auto", "coarse", "exact", "scan"]
Best = tuple[Tensor, Tensor]  # (Q,n) scores and places, the lowest place first among equal scores
Wanted = list[tuple[int, int]]  # (k, radius): k candidates with this suppression radius in places
Find = Callable[[Tensor, Wanted], Best]  # finds candidates of queries (Q,K)

SCORES_AT_ONCE = 2**24  # numbers of Q x n in memory


def check_search(method: str) -> None:
    """Refuse an unknown search method."""
    if method not in get_args(Search):
        raise InputError(f"search {method!r}; expected auto, coarse, exact or scan")


def num_needed(wanted: Wanted, places: int) -> int:
    """How many of the lowest scores include all candidates: each candidate suppresses 2 radius + 1 places."""
    return min(places, max((k - 1) * (2 * radius + 1) + 1 for k, radius in wanted))


@torch.no_grad()
def search(route: PlaceMap, queries: Tensor, n: int, scan: bool = False) -> Best:
    """The n lowest scores of queries (Q,K) on a map, ascending; only the scores of a block are in memory.

    Args:
        scan: score all places, instead of `PlaceMap.lowest`, which some maps have for n = 1.
    """
    queries = queries.to(torch.promote_types(queries.dtype, torch.float32))
    lowest = route.lowest(queries) if n == 1 and not scan else None
    if lowest is not None:
        return lowest[0][:, None], lowest[1][:, None]
    (score, place), first = empty_topk(queries, n), 0
    for part in queries.split(max(1, SCORES_AT_ONCE // max(1, route.block_places))):
        for start, scores in route.score_blocks(part):
            better = (scores.amin(1) < score[first : first + len(part), -1]).nonzero()[:, 0]
            if len(better):
                scores = scores[better] if len(better) < len(scores) else scores
                block, better = topk(scores, min(n, scores.shape[1]), start), better + first
                found, place[better] = merge_topk((score[better], place[better]), block)
                score[better] = found.to(score)  # templates may be double
        first += len(part)
    return score, place


def empty_topk(queries: Tensor, n: int) -> Best:
    """The initial state for queries (Q,K): scores +inf, at places beyond every map."""
    dtype = torch.promote_types(queries.dtype, torch.float32)
    score = queries.new_full((len(queries), n), math.inf, dtype=dtype)
    return score, torch.full_like(score, torch.iinfo(torch.int64).max, dtype=torch.int64)


def topk(scores: Tensor, n: int, start: int = 0) -> Best:
    """The n lowest of each row, (Q,W) -> (Q,n); `start` is the place of the first column."""
    if n == 1:
        score, index = scores.min(1, keepdim=True)
        return score, index + start
    worst = scores.topk(n, 1, largest=False).values[:, -1:].nan_to_num(math.inf, math.inf)
    better = scores < worst
    equal = torch.where(worst.isinf(), ~better, scores == worst)  # torch.topk picks any of these
    equal &= equal.cumsum(1, dtype=torch.int32) <= n - better.sum(1, keepdim=True)
    index = (better | equal).nonzero()[:, 1].view(-1, n)
    score, order = scores.gather(1, index).sort(dim=1, stable=True)
    return score, index.gather(1, order) + start


def merge_topk(one: Best, other: Best) -> Best:
    """The n best of two lists without common places; n is the length of the first."""
    score, place = (torch.cat(pair, 1) for pair in zip(one, other, strict=True))
    place, order = place.sort(1)
    score, by_score = score.gather(1, order).sort(dim=1, stable=True)
    n = one[0].shape[1]
    return score[:, :n], place.gather(1, by_score)[:, :n]
