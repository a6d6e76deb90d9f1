"""The best places of queries, from scores that are made a block of places at a time."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.recognition.candidates import Candidates
from dejavu_torch.types import InputError

Search = Literal["auto", "scan", "bound", "ivf"]

SCORES_AT_ONCE = 2**24  # numbers of Q x n held at a time
FEW = 1 / 16  # of the places of a block: of more, to keep the best takes longer than all scores
LISTED = 16  # numbers held for each of the best of a query, while two lists are merged
COARSE = 4  # places for each of which a bound has one sample of the low lines
SLACK = 1e-5  # of a bound, for rounding; of l2, times the squares of the lengths
WORTH_BOUNDS = 2**24  # N x K; a smaller map is scanned before a bound pays
TRIAL_CHUNKS, TRIAL_QUERIES = 64, 8  # by which `auto` finds out how many chunks bounds spare
SPARED = 0.95  # of the chunks, for `auto` to go by bounds: one alone takes as long as ten in a scan
LISTS_PER_ROOT, TRAINED_PER_LIST = 2, 39  # of inverted lists
PROBED, PROBED_AT_LEAST = 1 / 32, 32
CHECKED = 1 / 16  # of the queries that come together, until there is a sample


class Best(NamedTuple):
    """The n best places of each query, the lowest score first and of equal scores the lowest place.

    score: (Q,n), +inf where there is no place. index: (Q,n) int64.
    """

    score: Tensor
    index: Tensor  # type: ignore[assignment]  # the field shadows tuple.index

    def candidates(self, k: int, apart: int) -> Candidates:
        """What `best_candidates` finds among all places, if `enough(k, apart)` of the best are here."""
        left, ranks = self.score, []
        for _ in range(k):
            score, at = left.min(1)
            index = self.index.gather(1, at[:, None])
            near = (self.index - index).abs() <= apart
            left = left.masked_fill(near | ~score.isfinite()[:, None], math.inf)
            ranks.append((torch.where(score.isfinite(), index[:, 0], -1), score))
        index, score = (torch.stack(column, 1) for column in zip(*ranks, strict=True))
        return Candidates(index, score)


def enough(k: int, apart: int) -> int:
    """How many of the best places hold k of which any two differ by more than `apart`.

    Each that is taken rules out 2 apart + 1.
    """
    return (k - 1) * (2 * apart + 1) + 1


def lowest(scores: Tensor, n: int, start: int = 0) -> Best:
    """The n lowest of each row, n at most the number of columns; `start` is the place of the first column.

    Shape: (Q,W) -> Best of (Q,n).

    Example:
        >>> lowest(torch.tensor([[3.0, 1.0, 1.0, 0.0]]), 2).index
        tensor([[3, 1]])
    """
    if n == 1:
        score, index = scores.min(1, keepdim=True)
        return Best(score, index + start)
    worst = scores.topk(n, 1, largest=False).values[:, -1:].nan_to_num(math.inf, math.inf)
    kept = scores < worst
    equal = torch.where(worst.isinf(), ~kept, scores == worst)  # of which topk takes any
    wanted = n - kept.sum(1)
    (more,) = (equal.sum(1) > wanted).nonzero(as_tuple=True)
    if len(more):
        equal[more] &= equal[more].cumsum(1, dtype=torch.int32) <= wanted[more, None]
    index = (kept | equal).nonzero()[:, 1].view(-1, n)
    score, order = scores.gather(1, index).sort(dim=1, stable=True)
    return Best(score, index.gather(1, order) + start)


def merged(one: Best, other: Best) -> Best:
    """The n best of both, which have no place in common; n are those of the first."""
    score, index = (torch.cat(pair, 1) for pair in zip(one, other, strict=True))
    index, order = index.sort(1)
    score, by_score = score.gather(1, order).sort(dim=1, stable=True)
    n = one.score.shape[1]
    return Best(score[:, :n], index.gather(1, by_score)[:, :n])


def none_yet(queries: Tensor, n: int) -> Best:
    """Of queries (Q,K) for which nothing is found so far: places beyond all there are."""
    shape = queries.shape[0], n
    most = torch.iinfo(torch.int64).max
    return Best(
        queries.new_full(shape, math.inf, dtype=torch.promote_types(queries.dtype, torch.float32)),
        torch.full(shape, most, dtype=torch.int64, device=queries.device),
    )


def improved(best: Best, scores: Tensor, start: int, rows: Tensor | None = None) -> Best:
    """With the scores (Q,W) of places behind all so far, or of any places (R,W) of some rows."""
    held = best.score[:, -1:] if rows is None else best.score[rows, -1:]
    least, n = scores.amin(1, keepdim=True), best.score.shape[1]
    (better,) = (least < held if rows is None else least <= held).squeeze(1).nonzero(as_tuple=True)
    if not len(better):
        return best
    found = lowest(scores[better], min(n, scores.shape[1]), start)
    to = better if rows is None else rows[better]
    score, index = merged(Best(best.score[to], best.index[to]), found)
    return Best(
        best.score.to(score).index_copy(0, to, score),
        best.index.index_copy(0, to, index),
    )


def scan(route: PlaceMap, queries: Tensor, n: int) -> Best:
    """The n best of all places; memory holds the scores of a block of them.

    Shape: (Q,K) -> Best of (Q,n).
    """
    # a few small tensors for each query, made beside large ones that go, would leave the heap full of holes
    found, done = none_yet(queries, n), 0
    for some in queries.split(max(1, SCORES_AT_ONCE // max(1, route.block_places))):
        best: Best | None = None
        for start, scores in route.score_blocks(some):
            if best is None and scores.shape[1] >= n:
                best = lowest(scores, n, start)
            else:
                best = improved(none_yet(some, n) if best is None else best, scores, start)
        if best is not None:
            for column, part in zip(found, best, strict=True):
                column[done : done + len(some)] = part
        done += len(some)
    return found


class Searched(NamedTuple):
    """How queries were searched for.

    method: the one that was taken. queries: how many. chunks: of the map. pruned: the share of them that
    bounds spared, on average. recall: of a sample of so many queries, the share for which the best place was
    that of a scan. pruned and recall are None where they are not known.
    """

    method: Search
    queries: int = 0
    chunks: int = 0
    pruned: float | None = None
    recall: float | None = None
    sampled: int = 0

    def __str__(self) -> str:
        text = f"search: {self.method}"
        if self.pruned is not None:
            text += f", {self.pruned:.0%} of {self.chunks} chunks a query spared by bounds"
        if self.recall is not None:
            text += f", the best place that of a scan for {self.recall:.1%} of {self.sampled} queries"
        return text


class Searcher:
    """Finds the n best places of queries on a map.

    Args:
        route: the map. What a method needs is made of it when it is first asked for.
        method: "scan" scores all places. "bound" passes over chunks that cannot hold a better place, which
            gives the same places; of a spectral map with an integer chunk. "ivf" scores the places of the
            lists nearest to a query alone, which misses some: faiss inverted lists of the rebuilt
            descriptors, float32, in memory; of a spectral map. "auto" is the exact method that is faster:
            bounds where they spare 95 % of the chunks for the first queries, of a template map its own
            way to the best place where it has one, else the scan.
        lists: of "ivf", how many; None is 2 sqrt(N). probes: how many are searched; None is one
            in 32, but at least 32: at 10 000 places one in 6.
        sample: of so many queries the places that "ivf" finds are compared with those of a scan.

    Shape: queries (Q,K), n -> Best of (Q,n).

    Attributes:
        told: see `Searched`.

    Raises:
        InputError: an unknown method, or one that the map does not have; "ivf" without faiss.

    """

    def __init__(
        self,
        route: PlaceMap,
        method: Search = "auto",
        lists: int | None = None,
        probes: int | None = None,
        sample: int = 0,
    ) -> None:
        check_search(method, route)
        self.route, self.asked, self.sample, self.sizes = route, method, sample, (lists, probes)
        self._made = [*route.buffers()]
        self.told = Searched(method)

    def fits(self, route: PlaceMap, method: Search) -> bool:
        """Whether it is for this map as it is now, and this method."""
        made = [*route.buffers()]
        same = len(made) == len(self._made) and all(map(operator.is_, made, self._made))
        return same and route is self.route and method == self.asked

    def pays(self, n: int) -> bool:
        """Whether to search for n places, rather than to take them from all scores."""
        places = self.route.places
        most = max(1, FEW * min(places, self.route.block_places))
        return n <= most or places > SCORES_AT_ONCE or self.asked in ("bound", "ivf")

    @torch.no_grad()
    def __call__(self, queries: Tensor, n: int) -> Best:
        queries = queries.to(torch.promote_types(queries.dtype, torch.float32))
        n = min(n, self.route.places)
        if not len(queries):
            return none_yet(queries, n)
        method, before = self.told.method, self.told.queries
        self.told = self.told._replace(queries=before + len(queries))
        own = self.route.lowest(queries) if n == 1 else None
        if own is not None:
            return Best(own[0][:, None], own[1][:, None])
        return scan(self.route, queries, n)


def check_search(method: str, route: PlaceMap | None = None) -> None:
    """Refuse a method that there is not, or that a map does not have.

    Raises:
        InputError: naming both.
    """
    if method not in get_args(Search):
        raise InputError(f"search {method!r}; expected one of {', '.join(get_args(Search))}")


def check_scanned(method: Search) -> None:
    """Refuse to search for the best places where all scores are wanted.

    Raises:
        InputError: a method that does not score all places.
    """
    if method in ("bound", "ivf"):
        raise InputError(
            f"search {method!r} of queries together, which takes all scores; expected auto or scan"
        )


def _joined(parts: Iterable[Best]) -> Best:
    return Best(*(torch.cat(column) for column in zip(*parts, strict=True)))
