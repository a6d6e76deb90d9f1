"""The best places of single queries by samples of a spectral map: the low lines of its chunks are an index.

An inverse transform of the W / d lowest lines of a chunk of W places gives every d-th place, low-passed. The
best places are near the best of these samples; only places near them are scored.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.spectrum import half_cycles
from dejavu_torch.recognition.search import Best, Wanted, lowest_needed, search
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.types import InputError

FEWEST = 20_000  # places; a shorter map is scanned, which takes no longer
OTHERS = 12  # bytes of a sample beside its numbers
MEMORY = 100_000_000  # bytes of the samples at most by default
SPACINGS = (32, 16, 12, 8, 6, 4, 3, 2)  # places from one sample to the next
COARSE, FINE = 0.93, 0.98  # shares of the lines' energy that coarse and fine samples hold
GROUP = 8  # consecutive samples of which the best counts
REFINED = 32  # best groups of a query that are refined; 4 times as many if the samples hold less than COARSE
SPARE = 3  # further windows of a query that are scored if they are as good
CLOSE = 0.02  # cosines that differ by less are as good
UNLIKE = 0.02  # a query whose best cosine is less is scanned: places without a direction have cosine 0
BLOCK, PRODUCTS = 8192, 2**20  # samples, and products with them, at a time: these stay in the cache
LARGE = 6  # standard deviations of a component of a unit vector; larger ones are cut to it in 8 bits
ROUNDING = 1e-5  # of products of unit vectors in float32
MEASURED = 16  # chunks, evenly along the map, whose energy is measured


class Plan(NamedTuple):
    """How a map is sampled.

    coarse, fine: places from one sample to the next. refined: best groups of coarse samples around which fine
    ones are compared. held: share of the lines' energy in the coarse samples. bytes: of all samples.
    """

    coarse: int
    fine: int
    refined: int
    held: float
    bytes: int

    def __str__(self) -> str:
        return (
            f"samples every {self.coarse} places hold {self.held:.1%} of the lines' energy, the best "
            f"{self.refined} groups of {GROUP} are refined every {self.fine}; {self.bytes / 1e6:.1f} MB"
        )


def plan(route: PlaceMap, limit: int = MEMORY, exact: bool = False) -> Plan | None:
    """The widest spacings at which samples hold enough of a map; None for what is scanned: a map of another
    kind or metric, of few places or a single chunk, or whose lines are not low.

    Args:
        limit: bytes. Samples that do not fit are taken further apart, and more of them refined.
        exact: a sample of every place, whatever the limit.

    Raises:
        InputError: a limit below the samples of a single chunk.
    """
    if not isinstance(route, SpectralMap) or route.metric != "cosine" or not route.chunks:
        return None
    longest = max(stop - start for start, stop in route.chunks)

    def size(places: int, *spacings: int) -> int:
        return sum(-(-places // d) * (route.dimension + OTHERS) for d in spacings)

    if route.places < max(FEWEST, 2 * longest):
        return None
    least = size(longest, SPACINGS[0], SPACINGS[1])
    if limit < least:
        seen = f"the limit of the search's memory is {limit} bytes"
        raise InputError(f"{seen}; expected at least {least}, for a chunk")
    if exact:
        return Plan(1, 1, 1, 1.0, size(route.places, 1))
    held = energy_held(route)
    widest = next((d for d in SPACINGS if held[d] >= COARSE), 0)
    enough = next((d for d in SPACINGS if held[d] >= FINE), 2)
    for coarse in [d for d in SPACINGS[::-1] if d >= max(4, widest)] if widest else ():
        for fine in [d for d in SPACINGS[::-1] if min(enough, coarse // 2) <= d <= coarse // 2]:
            if size(route.places, coarse, fine) <= limit:
                refined = REFINED * (1 if coarse == widest else 4)
                return Plan(coarse, fine, refined, held[coarse], size(route.places, coarse, fine))
    return None


def energy_held(route: SpectralMap) -> dict[int, float]:
    """The share of the lines' energy that samples at each of `SPACINGS` hold, over some chunks of a map."""
    below = dict.fromkeys(SPACINGS, 0.0)
    whole = 1e-30
    for chunk in range(0, len(route.chunks), max(1, len(route.chunks) // MEASURED)):
        length = route.chunks[chunk][1] - route.chunks[chunk][0]
        line, _, value = route.lines(chunk)
        energy = value.new_zeros(length + 1, dtype=torch.float64)
        energy.index_add_(0, half_cycles(line, route.transform), value.double().square())
        summed = energy.cumsum(0).tolist()
        whole += summed[-1]
        for d in SPACINGS:
            below[d] += summed[length // d]
    return {d: energy / whole for d, energy in below.items()}


def coarse_search(route: PlaceMap, limit: int = MEMORY, exact: bool = False) -> CoarseSearch | None:
    """A search by samples of a map; None for what is scanned, see `plan`."""
    chosen = plan(route, limit, exact)
    return CoarseSearch(route, chosen) if isinstance(route, SpectralMap) and chosen is not None else None


class Samples:
    """Low-passed descriptors of a map, about every `spacing` places, in whole groups for each chunk.

    Attributes:
        rows: (S,K) int8, their directions, all on one scale. norm: (S,) of the rows.
        place: (S,) that each is nearest to, in order.
    """

    def __init__(self, route: SpectralMap, spacing: int) -> None:
        rows, places = [], []
        for chunk, (start, stop) in enumerate(route.chunks):
            row, at = route.samples(chunk, -(-(stop - start) // spacing))
            padding = -len(row) % GROUP  # rows of 0, which are never the best
            rows.append(F.pad(to_int8(F.normalize(row)), (0, 0, 0, padding)))
            places.append(F.pad(at, (0, padding), value=stop - start - 1) + start)
        self.rows, self.place = torch.cat(rows), torch.cat(places)
        norms = [torch.linalg.vector_norm(some.float(), dim=1) for some in self.rows.split(BLOCK)]
        self.norm = torch.cat(norms).clamp(min=1)

    def products(self, queries: Tensor) -> Iterator[Tensor]:
        """Of blocks of whole groups with queries, (Q,K) int8 -> (n,Q) int32."""
        whole = self.rows.device.type == "cpu" and has_int8_products()
        for rows in self.rows.split(GROUP * max(1, PRODUCTS // (GROUP * len(queries))) if whole else BLOCK):
            yield torch._int_mm(rows, queries.T) if whole else (rows.float() @ queries.T.float()).int()

    def best_of_groups(self, queries: Tensor) -> Tensor:
        """`GROUP` times the largest product in each group of rows, plus its row in the group: (Q,K) int8 ->
        (Q,G) int32. A maximum of one number is several times faster than one with its index."""
        number = torch.arange(GROUP, dtype=torch.int32, device=queries.device)[:, None]
        best = number.new_empty(len(queries), len(self.rows) // GROUP)
        first = 0
        for products in self.products(queries):
            groups = products.view(-1, GROUP, len(queries))
            found = torch.add(number, groups, alpha=GROUP, out=groups).amax(1)
            best[:, first : first + len(found)] = found.T
            first += len(found)
        return best


class CoarseSearch:
    """Finds the best places of queries: coarse samples choose regions, fine ones windows, which are scored.

    If every place has a fine sample, what it finds is exact: all places are ruled out but those that may be
    as good as the best of the windows.

    Args:
        route: the map; it is not changed.
        chosen: see `plan`.

    Shape: queries (Q,K), wanted -> scores and places (Q,m), by place, +inf for none, in which the wanted
        candidates are; see `Wanted`.

    Convention: scores are those of a scan. A query of length 0, or one that is like no place, is scanned.
    """

    def __init__(self, route: SpectralMap, chosen: Plan) -> None:
        self.route, self.plan, self.exact = route, chosen, chosen.fine == 1
        self.starts = torch.tensor([start for start, _ in route.chunks], device=route.norms.device)
        self.fine = Samples(route, chosen.fine)
        self.coarse = self.fine if self.exact else Samples(route, chosen.coarse)
        self.bounds = self._bounds() if self.exact else None

    @torch.no_grad()
    def __call__(self, queries: Tensor, wanted: Wanted) -> Best:
        units = F.normalize(queries.to(torch.promote_types(queries.dtype, torch.float32))).float()
        best = self.coarse.best_of_groups(to_int8(units))
        query, place = self._windows(units, best, wanted)
        shape = len(units), max(k for k, _ in wanted)
        pairs = query, place, self._scores(units, query, place)
        found, last = self._by_query(pairs, shape, wanted)
        if self.exact:
            pairs = self._below(units, best, last.masked_fill(last.isinf(), -1))  # those are scanned
            found, last = self._by_query(pairs, shape, wanted)
        left = last.isinf() | ~(found[0].amin(1) <= 1 - UNLIKE)
        if left.any():
            score, place = search(self.route, queries[left], lowest_needed(wanted, self.route.places))
            row = left.nonzero()[:, 0].repeat_interleave(score.shape[1])
            kept, there = ~left[pairs[0]], score.flatten().isfinite()
            scanned = (one.flatten()[there] for one in (row, place, score))
            both = zip(pairs, scanned, strict=True)
            found, _ = self._by_query([torch.cat([a[kept], b]) for a, b in both], shape, wanted)
        return found

    @torch.no_grad()
    def approximate(self, queries: Tensor) -> Tensor:
        """Scores of all places, (Q,K) -> (Q,N): around the best places their own, elsewhere that of the fine
        sample near them."""
        units = F.normalize(queries.float())
        small = to_int8(units)
        size = torch.linalg.vector_norm(small.float(), dim=1).clamp(min=1)
        cosines = torch.cat([*self.fine.products(small)]) / size / self.fine.norm[:, None]
        nearest = torch.cat([self._nearest(chunk) for chunk in range(len(self.starts))])
        scores: Tensor = (1 - cosines)[nearest].T.contiguous()
        query, place = self._windows(units, self.coarse.best_of_groups(small), [(1, 0)])
        scores[query, place] = self._scores(units, query, place)
        return scores

    def _windows(self, units: Tensor, best: Tensor, wanted: Wanted) -> tuple[Tensor, Tensor]:
        """Pairs (P,) of a query and a place near its best fine samples, by query and place: around each as
        many places as candidates of a single peak may lie apart."""
        coarse, fine, plan = self.coarse, self.fine, self.plan
        count = max(k for k, _ in wanted)
        best, group = best.topk(min(max(plan.refined, 2 * count), best.shape[1]), 1, sorted=False)
        middle = torch.searchsorted(fine.place, coarse.place[GROUP * group + best % GROUP])
        reach = -(-plan.coarse // (2 * plan.fine))
        offsets = torch.arange(-reach, reach + 1, device=middle.device)
        at = (middle[:, :, None] + offsets).clamp(0, len(fine.place) - 1).flatten(1)
        rows = fine.rows.index_select(0, at.flatten()).view(*at.shape, -1)
        cosines = (rows * units[:, None]).sum(2) / fine.norm[at]
        width = plan.fine + 1 + max((k - 1) * (radius + 1) for k, radius in wanted)
        windows = best_candidates(-cosines, min(count + SPARE, at.shape[1]), width, fine.place[at])
        close = windows.score <= windows.score[:, :count].amax(1, keepdim=True) + CLOSE
        query, rank = (windows.accepted & close).nonzero().T
        around = torch.arange(-width, width + 1, device=query.device)
        place = (windows.index[query, rank, None] + around).clamp(0, self.route.places - 1)
        pairs = (query[:, None] * self.route.places + place).flatten().unique()
        return pairs // self.route.places, pairs % self.route.places

    def _scores(self, units: Tensor, query: Tensor, place: Tensor) -> Tensor:
        """Scores of pairs of a query and a place, (P,), by the map's own products."""
        score = torch.empty(place.shape, device=place.device)
        chunk = torch.bucketize(place, self.starts, right=True) - 1
        for g in chunk.unique().tolist():
            some = (chunk == g).nonzero()[:, 0]
            own, row = query[some].unique(return_inverse=True)
            for first, scores in self.route.score_blocks(units[own], *self.route.chunks[g]):  # a single block
                score[some] = scores[row, place[some] - first]
        return score

    def _below(self, units: Tensor, best: Tensor, score: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Query, place and score of all places that score at most so much, (Q,) -> (P,) each.

        For unit vectors q, s and x, the angle of q and x is at least that of q and s less that of s and x.
        Here s are the fine samples of a group, and x the places near them.
        """
        assert self.bounds is not None
        small = to_int8(units).float()
        size = torch.linalg.vector_norm(small, dim=1)
        reach = angle(1 - score) + angle((units * small).sum(1) / size.clamp(min=1))
        reach = reach.clamp(max=math.pi / 2)
        turned = GROUP * size[:, None] * torch.stack([reach.cos(), -reach.sin(), -torch.ones_like(reach)], 1)
        parts = []
        for start in range(0, best.shape[1], BLOCK // GROUP):  # they stay in the cache
            # the cosine of a sum of two angles; a product below 0 is not told from 0
            least = F.threshold(turned @ self.bounds[:, start : start + BLOCK // GROUP], 0, -math.inf)
            pairs = (best[:, start : start + BLOCK // GROUP] >= least).nonzero()
            parts.append(pairs + pairs.new_tensor([0, start]))
        query, group = torch.cat(parts).T.contiguous()
        chunk = torch.bucketize(self.fine.place[group * GROUP], self.starts, right=True) - 1
        found = [(query[:0], query[:0], score[:0])]
        for g in chunk.unique().tolist():
            own = query[chunk == g].unique()
            for first, scores in self.route.score_blocks(units[own], *self.route.chunks[g]):
                row, at = (scores <= score[own, None] + ROUNDING).nonzero().T
                found.append((own[row], at + first, scores[row, at]))
        query, place, score = (torch.cat(column) for column in zip(*found, strict=True))
        return query, place, score

    def _bounds(self) -> Tensor:
        """Of each group of fine samples the least length, times the cosine and the sine of the largest angle
        between a sample and a place near it, and of itself: (3, S / GROUP)."""
        least = torch.ones(len(self.fine.norm) // GROUP, device=self.fine.norm.device)
        for chunk, (start, stop) in enumerate(self.route.chunks):
            nearest, units = self._nearest(chunk), F.normalize(self.route.decode(chunk))
            cosine = (self.fine.rows[nearest] * units).sum(1) / self.fine.norm[nearest]
            cosine = cosine.where(self.route.norms[start:stop] > 0, 1)  # these score 1
            least.scatter_reduce_(0, nearest // GROUP, cosine, "amin")
        least -= ROUNDING
        least = least.where(least > 0, -1)  # from a right angle on nothing is ruled out
        sine, norm = (1 - least.square()).sqrt(), self.fine.norm.view(-1, GROUP).amin(1)
        bounds: Tensor = norm * torch.stack([least, sine, torch.full_like(least, ROUNDING)])
        return bounds

    def _nearest(self, chunk: int) -> Tensor:
        """The fine sample that each place of a chunk is nearest to, (W,)."""
        start, stop = self.route.chunks[chunk]
        at = torch.arange(start, stop, device=self.starts.device)
        first, last = torch.searchsorted(self.fine.place, torch.stack([at[0], at[-1] + 1])).tolist()
        place = self.fine.place[first:last]
        nearest: Tensor = first + torch.bucketize(at, (place[1:] + place[:-1]) / 2)
        return nearest

    def _by_query(
        self, pairs: Sequence[Tensor], shape: tuple[int, int], wanted: Wanted
    ) -> tuple[Best, Tensor]:
        """Query, place and score of pairs as a row for each query, of so many columns at least, by place; and
        the highest score of the candidates that are wanted, (Q,). +inf for none."""
        query, place, score = pairs
        order = (query * self.route.places + place).argsort()
        query, counts = query[order], torch.bincount(query, minlength=shape[0])
        column = torch.arange(len(query), device=query.device) - (counts.cumsum(0) - counts)[query]
        table = score.new_full((shape[0], max(shape[1], int(counts.max()))), math.inf)
        where = torch.full_like(table, self.route.places, dtype=torch.int64)
        table[query, column], where[query, column] = score[order], place[order]
        last = [best_candidates(table, *one, where).score[:, -1] for one in wanted]
        return (table, where), torch.stack(last).amax(0)


def to_int8(units: Tensor) -> Tensor:
    """Unit vectors (n,K) in integers of 8 bits, on a scale that depends on K alone."""
    scale = 127 * max(1.0, math.sqrt(units.shape[1]) / LARGE)
    rounded: Tensor = (units * scale).round().clamp(-127, 127)
    return rounded.to(torch.int8)


@cache
def has_int8_products() -> bool:
    """Whether torch multiplies 8-bit integers fast on this CPU."""
    return torch.backends.mkldnn.is_available() and torch.cpu._is_vnni_supported()


def angle(cosine: Tensor) -> Tensor:
    """The largest angle that a rounded cosine may be of."""
    return (cosine - ROUNDING).clamp(-1, 1).acos()
