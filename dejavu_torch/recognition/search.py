"""The best places of queries, from scores that are made a block of places at a time."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from dejavu_torch.maps.coefficients import Coefficients
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral import SpectralMap
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


class Bound:
    """Below which no score of a chunk can be, without scoring its places.

    The low lines alone give samples of every descriptor, one for each `COARSE` places. A place differs from
    the nearest sample by its residual, whose product with a query is at most the product of their lengths. So
    a chunk's largest product with a sample, and the query's length times the chunk's largest residual, are
    together more than any product with a place; the metric makes a score of it by the shortest or the longest
    descriptor of the chunk.

    Args:
        route: a spectral map.

    Shape: queries (Q,K) -> (Q,G), for each chunk.
    """

    def __init__(self, route: SpectralMap) -> None:
        self.metric = route.metric
        self.low = _low_lines(route)
        # one small tensor for each chunk, made beside large ones that go, would leave the heap full of holes
        self.residual, self.least, self.most = (route.steps.new_empty(len(route.chunks)) for _ in range(3))
        self.silent = torch.zeros_like(self.residual, dtype=torch.bool)
        for g, (start, stop) in enumerate(route.chunks):
            samples = self.low.rebuilt(g)
            nearest = _nearest_sample(stop - start, len(samples), route.transform)
            norms = route.norms[start:stop]
            heard = norms > route.audible
            away = route.rebuilt(g) - samples[nearest.to(samples.device)]
            self.residual[g] = torch.linalg.vector_norm(away, dim=1).max()
            self.least[g] = torch.where(heard, norms, math.inf).min()
            self.most[g] = norms.max()
            self.silent[g] = ~heard.all()

    def __call__(self, queries: Tensor) -> Tensor:
        length: Tensor = torch.linalg.vector_norm(queries, dim=1, keepdim=True)
        if self.metric == "cosine":
            queries = queries / torch.where(length > 0, length, 1)
            length = (length > 0).to(length)
        products = torch.cat([part.amax(2) for part in self.low.product_blocks(queries)], 1)
        products += length * self.residual
        if self.metric == "l2":
            square = length.square()
            least = torch.where(self.silent, 0, self.least)
            return square - 2 * products + least.square() - SLACK * (square + self.most.square())
        products = torch.where(self.silent, products.clamp(min=0), products)  # a silent place scores 1
        return 1 - products / torch.where(products < 0, self.most, self.least) - SLACK


def _low_lines(route: SpectralMap) -> SpectralMap:
    """Samples of the descriptors by the low lines alone: a map of as many chunks, `COARSE` times shorter."""
    parts, lengths, steps = [], [], []
    for g, (start, stop) in enumerate(route.chunks):
        count = max(1, (stop - start) // COARSE)
        lines = max(1, count - (route.transform == "dft" and count % 2 == 0))  # a cosine without its sine
        counts = route.counts[start:stop][:count].clone()
        counts[lines:] = 0
        first = route.bounds[g]
        last = first + int(counts.sum())
        parts.append(Coefficients(counts, route.feature[first:last], route.level[first:last]))
        lengths.append(count)
        steps.append(route.steps[g] * math.sqrt(count / (stop - start)))
    coefficients = Coefficients(*(torch.cat(column) for column in zip(*parts, strict=True)))
    sizes = torch.tensor(lengths, device=route.lengths.device)
    return SpectralMap(coefficients, sizes, torch.stack(steps), route.mean, "l2", route.transform)


def _nearest_sample(places: int, samples: int, transform: str) -> Tensor:
    """Of each place of a chunk, (W,) int64; a cosine transform's samples lie half a step off its ends."""
    place = torch.arange(places, dtype=torch.float64)
    if transform == "dct":
        return ((place + 0.5) * samples / places).long().clamp(max=samples - 1)
    return (place * samples / places).round().long() % samples


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

    Example:
        >>> wave = torch.sin(torch.arange(500.0)[:, None] * torch.tensor([0.1, 0.23, 0.37]))
        >>> from dejavu_torch import SpectralMapper
        >>> searcher = Searcher(SpectralMapper(chunk=100)(wave), "bound")
        >>> searcher(wave[20:22], 1).index.tolist(), searcher.told.chunks
        ([[20], [21]], 5)
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
        self._bound: Bound | None = None
        self._index: Any = None
        chunks = len(route.chunks) if isinstance(route, SpectralMap) else 0
        self.told = Searched(method, chunks=chunks)

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
        if self.told.method == "auto":
            self.told = self.told._replace(method=self._chosen(queries))
        method, before = self.told.method, self.told.queries
        self.told = self.told._replace(queries=before + len(queries))
        if method == "bound":
            return self._by_bound(queries, n)
        if method == "ivf":
            found = self._by_lists(queries, n)
            self._check(queries, found)
            return found
        own = self.route.lowest(queries) if n == 1 else None
        if own is not None:
            return Best(own[0][:, None], own[1][:, None])
        return scan(self.route, queries, n)

    def _chosen(self, queries: Tensor) -> Search:
        """Bounds where they spare enough of some chunks for some queries; they are the same either way."""
        route = self.route
        if not isinstance(route, SpectralMap) or route.chunk == "route":
            return "scan"
        if route.places * route.dimension < WORTH_BOUNDS:
            return "scan"
        some = part_of(route, TRIAL_CHUNKS)
        trial = Searcher(some, "bound")
        trial(queries[:TRIAL_QUERIES], 1)
        return "bound" if (trial.told.pruned or 0) >= SPARED else "scan"

    def _by_bound(self, queries: Tensor, n: int) -> Best:
        route = self.route
        assert isinstance(route, SpectralMap)
        if self._bound is None:
            self._bound = Bound(route)
        parts, spared = [], 0.0
        for some in queries.split(max(1, SCORES_AT_ONCE // max(1, route.block_places, len(route.chunks)))):
            best, visits = _visited(route, self._bound(some), some, n)
            parts.append(best)
            spared += len(some) - visits / max(1, len(route.chunks))
        done = self.told.queries
        before = (self.told.pruned or 0) * (done - len(queries))
        self.told = self.told._replace(pruned=(before + spared) / max(1, done))
        return _joined(parts)

    def _by_lists(self, queries: Tensor, n: int) -> Best:
        route = self.route
        assert isinstance(route, SpectralMap)
        if self._index is None:
            self._index = inverted_lists(route, *self.sizes)
        _faiss().omp_set_num_threads(torch.get_num_threads())
        wanted = queries.float()
        if route.metric == "cosine":
            wanted = torch.nn.functional.normalize(wanted)
        # products with the rebuilt descriptors themselves: the scores are those of the map
        found, index = map(torch.from_numpy, self._index.search(wanted.cpu().numpy(), n))
        score = (1 - found if route.metric == "cosine" else found).masked_fill(index < 0, math.inf)
        return merged(none_yet(queries.cpu().float(), n), Best(score, index))

    def _check(self, queries: Tensor, found: Best) -> None:
        """Compare with a scan until there is a sample."""
        count = min(self.sample - self.told.sampled, math.ceil(len(queries) * CHECKED))
        if count > 0:
            some = torch.arange(count) * len(queries) // count
            exact = scan(self.route, queries[some.to(queries.device)], 1)
            right = exact.index.cpu() == found.index[some, :1]
            sampled = self.told.sampled + count
            hits = (self.told.recall or 0) * self.told.sampled + float(right.sum())
            self.told = self.told._replace(recall=hits / sampled, sampled=sampled)


def _visited(route: SpectralMap, lower: Tensor, queries: Tensor, n: int) -> tuple[Best, int]:
    """The n best, from the chunks that may hold them by (Q,G) bounds, and how many were scored for a query.

    The best chunk of each query comes first, then the others, that of the lowest bound of any query first.
    """
    rebuild, best, visits = route.rebuilds(len(queries)), none_yet(queries, n), 0
    first = lower.argmin(1)
    order = lower.amin(0).argsort().tolist()
    seen = torch.zeros_like(lower, dtype=torch.bool)
    for once in (True, False):
        if once:
            wanted = torch.nn.functional.one_hot(first, lower.shape[1]).bool()
        else:
            wanted = (lower <= best.score[:, -1:]) & ~seen
        some = wanted.any(0).tolist()
        for g in (g for g in order if some[g]):
            (rows,) = (wanted[:, g] & (lower[:, g] <= best.score[:, -1])).nonzero(as_tuple=True)
            if not len(rows):
                continue
            start, stop = route.chunks[g]
            for begins, scores in route.score_blocks(queries[rows], start, stop, rebuild):
                best = improved(best, scores, begins, rows)
            seen[rows, g] = True
            visits += len(rows)
    return best, visits


def part_of(route: SpectralMap, chunks: int) -> SpectralMap:
    """The map of so many of its chunks, spread over the route; all of them where there are no more."""
    count = len(route.chunks)
    some = [g * count // min(chunks, count) for g in range(min(chunks, count))]
    parts = [route.coefficients(range(g, g + 1)) for g in some]
    return SpectralMap(
        Coefficients(*(torch.cat(column) for column in zip(*parts, strict=True))),
        route.lengths[some],
        route.steps[some],
        route.mean,
        route.metric,
        route.transform,
        route.chunk,
    )


def inverted_lists(route: SpectralMap, lists: int | None = None, probes: int | None = None) -> Any:
    """A faiss index of the rebuilt descriptors of a map, see `Searcher`; of cosine, scaled to length 1."""
    faiss = _faiss()
    faiss.omp_set_num_threads(torch.get_num_threads())
    places, cosine = route.places, route.metric == "cosine"
    most = max(1, places // TRAINED_PER_LIST)
    lists = min(most, math.ceil(LISTS_PER_ROOT * math.sqrt(places))) if lists is None else lists
    probes = min(lists, max(PROBED_AT_LEAST, math.ceil(lists * PROBED))) if probes is None else probes
    if not 1 <= lists <= places or not 1 <= probes <= lists:
        raise InputError(
            f"{lists} lists and {probes} probes on {places} places; expected at most as many lists as "
            "places, and as many probes as lists, at least one"
        )
    kind = faiss.METRIC_INNER_PRODUCT if cosine else faiss.METRIC_L2
    index = faiss.index_factory(route.dimension, f"IVF{lists},Flat", kind)
    index.nprobe = probes
    every = max(1, places // (lists * TRAINED_PER_LIST))

    def rebuilt(g: int) -> Tensor:
        start, stop = route.chunks[g]
        scale = route.per_norm(start, stop)[:, None] if cosine else 1
        return (route.rebuilt(g) * scale).float().cpu().contiguous()

    index.train(torch.cat([rebuilt(g)[::every] for g in range(len(route.chunks))]).numpy())
    for g in range(len(route.chunks)):
        index.add(rebuilt(g).numpy())
    return index


def check_search(method: str, route: PlaceMap | None = None) -> None:
    """Refuse a method that there is not, or that a map does not have.

    Raises:
        InputError: naming both.
    """
    if method not in get_args(Search):
        raise InputError(f"search {method!r}; expected one of {', '.join(get_args(Search))}")
    if route is None or method in ("auto", "scan"):
        return
    if not isinstance(route, SpectralMap):
        raise InputError(f"search {method!r} on a map of kind {route.kind!r}; expected auto or scan")
    if method == "bound" and route.chunk == "route":
        raise InputError(
            "search 'bound' on a map of one chunk, the route, of which it passes over none; expected auto or "
            "scan, or a map learned with a chunk of so many places"
        )
    if method == "ivf":
        _faiss()


def check_scanned(method: Search) -> None:
    """Refuse to search for the best places where all scores are wanted.

    Raises:
        InputError: a method that does not score all places.
    """
    if method in ("bound", "ivf"):
        raise InputError(
            f"search {method!r} of queries together, which takes all scores; expected auto or scan"
        )


def _faiss() -> Any:
    try:
        import faiss
    except ImportError as error:
        raise InputError(
            f"search 'ivf' needs faiss ({error}); expected it to be there: pip install 'dejavu_torch[bench]'"
        ) from error
    return faiss


def _joined(parts: Iterable[Best]) -> Best:
    return Best(*(torch.cat(column) for column in zip(*parts, strict=True)))
