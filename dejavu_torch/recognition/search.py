"""The lowest scores of queries and their places, computed one block of places at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, get_args

import torch
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.places.layout import Layout
from dejavu_torch.types import expect

Search = Literal["auto", "coarse", "exact", "scan"]
NmsSpec = tuple[int, int]  # (k, radius): k candidates with this suppression radius in places
TopK = tuple[Tensor, Tensor]  # (Q,n) scores and places, the lowest place first among equal scores
# queries (Q,K), wanted -> scores and places that include the wanted candidates, +inf for none
Searcher = Callable[[Tensor, list[NmsSpec]], TopK]

SCORES_AT_ONCE = 2**24  # numbers of Q x n in memory


def check_search(method: str) -> None:
    """Refuse an unknown search method."""
    expect(method in get_args(Search), "auto, coarse, exact or scan", f"search {method!r}")


def num_needed(wanted: list[NmsSpec], layout: Layout) -> int:
    """How many of the lowest scores include all candidates, each of which suppresses those near it."""
    return min(layout.places, max((k - 1) * layout.near(radius) + 1 for k, radius in wanted))


class Scan:
    """The `Searcher` that scores all places of a map: only the scores of a block are in memory."""

    def __init__(self, place_map: PlaceMap) -> None:
        self.place_map, self.norms = place_map, getattr(place_map, "norms", None)

    def fits(self, place_map: PlaceMap) -> bool:
        """Whether it searches this map, and the map still has the tensors that it had."""
        return place_map is self.place_map and getattr(place_map, "norms", None) is self.norms

    @torch.no_grad()
    def __call__(self, queries: Tensor, wanted: list[NmsSpec]) -> TopK:
        place_map, n = self.place_map, num_needed(wanted, self.place_map.layout)
        queries = queries.to(torch.promote_types(queries.dtype, torch.float32))
        (score, place), first = empty_topk(queries, n), 0
        for part in queries.split(max(1, SCORES_AT_ONCE // max(1, place_map.block_places))):
            for start, scores in place_map.score_blocks(part):
                better = (scores.amin(1) < score[first : first + len(part), -1]).nonzero()[:, 0]
                if len(better):
                    scores = scores[better] if len(better) < len(scores) else scores
                    block, better = topk(scores, min(n, scores.shape[1]), start), better + first
                    merged, place[better] = merge_topk((score[better], place[better]), block)
                    score[better] = merged.to(score)  # templates may be double
            first += len(part)
        return score, place


def empty_topk(queries: Tensor, n: int) -> TopK:
    """The initial state for queries (Q,K): scores +inf, at places beyond every map."""
    dtype = torch.promote_types(queries.dtype, torch.float32)
    score = queries.new_full((len(queries), n), math.inf, dtype=dtype)
    return score, torch.full_like(score, torch.iinfo(torch.int64).max, dtype=torch.int64)


def topk(scores: Tensor, n: int, start: int = 0) -> TopK:
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


def merge_topk(one: TopK, other: TopK) -> TopK:
    """The n best of two lists without common places; n is the length of the first."""
    score, place = (torch.cat(pair, 1) for pair in zip(one, other, strict=True))
    place, order = place.sort(1)
    score, by_score = score.gather(1, order).sort(dim=1, stable=True)
    n = one[0].shape[1]
    return score[:, :n], place.gather(1, by_score)[:, :n]
