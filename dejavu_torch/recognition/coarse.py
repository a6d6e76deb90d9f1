"""The best places of single queries by samples of a spectral map: the low lines of its chunks are an index.

An inverse transform of the W / d lowest lines of a chunk of W places gives every d-th place, low-passed. The
best places are near the best of these samples; only places near them are scored.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import cache
from types import MappingProxyType
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.spectrum import half_cycles
from dejavu_torch.recognition.search import Best, Wanted, empty_topk, lowest_needed, search
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.types import InputError

FEWEST = 20_000  # places; a shorter map is scanned, which takes no longer
OTHERS = 16  # bytes of a sample beside its numbers
MEMORY, A_PLACE = 100_000_000, 100  # bytes of the samples at most by default, or for each place of more
SPACINGS = (32, 16, 12, 8, 6, 4, 3, 2)  # places from one sample to the next
COARSE, FINE = 0.93, 0.98  # shares of the lines' energy that coarse and fine samples hold
GROUP = 8  # consecutive samples of which the best counts
BESIDE = 16  # groups of a block; the best groups are in the best blocks
REFINED = 32  # best groups of a query that are refined; 4 times as many if the samples hold less than COARSE
SPARE = 3  # further windows of a query that are scored if they are as good
CLOSE = 0.02  # cosines that differ by less are as good
UNLIKE = 0.02  # a query whose best cosine is less is scanned: places without a direction have cosine 0
TOGETHER = 16  # queries whose fine samples are compared at a time
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


def plan(route: PlaceMap, limit: int | None = None, exact: bool = False) -> Plan | None:
    """The widest spacings at which samples hold enough of a map; None for what is scanned: a map of another
    kind or metric, of few places or a single chunk, or whose lines are not low.

    Args:
        limit: bytes; None is 100 MB, of over 10^6 places 100 bytes each. Samples that do not fit are taken
            further apart, and more of them refined.
        exact: a sample of every place, whatever the limit.

    Raises:
        InputError: a limit below the samples of a single chunk.
    """
    if not isinstance(route, SpectralMap) or route.metric != "cosine" or not route.chunks:
        return None
    longest = max(stop - start for start, stop in route.chunks)
    limit = max(MEMORY, A_PLACE * route.places) if limit is None else limit

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


def coarse_search(route: PlaceMap, limit: int | None = None, exact: bool = False) -> CoarseSearch | None:
    """A search by samples of a map; None for what is scanned, see `plan`."""
    chosen = plan(route, limit, exact)
    return CoarseSearch(route, chosen) if isinstance(route, SpectralMap) and chosen is not None else None


class Samples:
    """Low-passed descriptors of a map, about every `spacing` places, in whole groups for each chunk, and
    whole blocks of groups for the map.

    Attributes:
        rows: (S,K) int8, their directions, all on one scale. norm: (S,) of the rows.
        place: (S,) that each is nearest to, in order.
    """

    def __init__(self, route: SpectralMap, spacing: int, rows: Tensor | None = None) -> None:
        """Make the rows, if they are not given as they were made before: then only their shape is checked."""
        places = []
        for chunk, (start, stop) in enumerate(route.chunks):
            at = route.sampled(chunk, -(-(stop - start) // spacing))
            places.append(F.pad(at, (0, -len(at) % GROUP), value=stop - start - 1) + start)
        place = torch.cat(places)
        self.place = F.pad(place, (0, -len(place) % (GROUP * BESIDE)), value=route.places - 1)
        shape = len(self.place), route.dimension
        if rows is None:  # those that fill up groups and blocks are 0, which are never the best
            rows, first = self.place.new_zeros(shape, dtype=torch.int8), 0
            for chunk, (start, stop) in enumerate(route.chunks):
                row = route.samples(chunk, -(-(stop - start) // spacing))
                rows[first : first + len(row)] = to_int8(F.normalize(row))
                first += len(places[chunk])
        self.rows = fitting(rows, shape, torch.int8).to(self.place.device)
        norms = [torch.linalg.vector_norm(some.float(), dim=1) for some in self.rows.split(BLOCK)]
        self.norm = torch.cat(norms).clamp(min=1)

    def products(self, queries: Tensor) -> Iterator[Tensor]:
        """Of blocks of whole groups with queries, (Q,K) int8 -> (n,Q) int32."""
        whole = self.rows.device.type == "cpu" and has_int8_products()
        for rows in self.rows.split(GROUP * max(1, PRODUCTS // (GROUP * len(queries))) if whole else BLOCK):
            yield torch._int_mm(rows, queries.T) if whole else (rows.float() @ queries.T.float()).int()

    def best_of_groups(self, queries: Tensor) -> Tensor:
        """`GROUP` times the largest product in each group of rows, plus its row in the group: (Q,K) int8 ->
        (G,Q) int32. A maximum of one number is several times faster than one with its index."""
        number = torch.arange(GROUP, dtype=torch.int32, device=queries.device)[:, None]
        best = number.new_empty(len(self.rows) // GROUP, len(queries))
        first = 0
        for products in self.products(queries):
            groups = products.view(-1, GROUP, len(queries))
            last = first + len(groups)
            torch.amax(torch.add(number, groups, alpha=GROUP, out=groups), 1, out=best[first:last])
            first = last
        return best


class CoarseSearch:
    """Finds the best places of queries: coarse samples choose regions, fine ones windows, which are scored.

    If every place has a fine sample, what it finds is exact: all places are ruled out but those that may be
    as good as the best of the windows.

    Args:
        route: the map; it is not changed.
        chosen: see `plan`. kept: what another search of the same map and plan has `made`; made here if empty.

    Shape: queries (Q,K), wanted -> scores and places (Q,M), by place, +inf for none, in which the wanted
        candidates are; see `Wanted`.

    Convention: scores are those of a scan. A query of length 0, or one that is like no place, is scanned.

    Raises:
        InputError: what is kept is of other shapes or types than what would be made.
    """

    def __init__(
        self, route: SpectralMap, chosen: Plan, kept: Mapping[str, Tensor] = MappingProxyType({})
    ) -> None:
        self.route, self.plan, self.exact = route, chosen, chosen.fine == 1
        self.starts = torch.tensor([start for start, _ in route.chunks], device=route.norms.device)
        self.fine = Samples(route, chosen.fine, kept.get("fine"))
        self.coarse = self.fine if self.exact else Samples(route, chosen.coarse, kept.get("coarse"))
        self.middle = torch.searchsorted(self.fine.place, self.coarse.place, out_int32=True)
        self.bounds = None
        if self.exact:
            bounds, shape = kept.get("bounds"), (len(self.fine.norm) // GROUP, 3)
            bounds = fitting(self._bounds() if bounds is None else bounds, shape, torch.float32)
            self.bounds = bounds.to(self.starts.device)

    @property
    def made(self) -> dict[str, Tensor]:
        """What takes long to make: the rows of samples, and the bounds of an exact search."""
        coarse = {"coarse": self.coarse.rows} if self.bounds is None else {"bounds": self.bounds}
        return {"fine": self.fine.rows, **coarse}

    @torch.no_grad()
    def __call__(self, queries: Tensor, wanted: Wanted) -> Best:
        if not len(queries):
            return empty_topk(queries, max(k for k, _ in wanted))
        units = F.normalize(queries.to(torch.promote_types(queries.dtype, torch.float32))).float()
        best = self.coarse.best_of_groups(to_int8(units))
        place = self._windows(units, best, wanted)
        found = self._scores(units, place), place
        last = self._last(found, wanted)
        if self.exact:
            found = self._below(units, best, last.masked_fill(last.isinf(), -1))  # those are scanned
            last = self._last(found, wanted)
        left = (last.isinf() | ~(found[0].amin(1) <= 1 - UNLIKE)).nonzero()[:, 0]
        if len(left):
            scanned = search(self.route, queries[left], lowest_needed(wanted, self.route.places))
            place, order = scanned[1].sort(1)
            more = max(0, place.shape[1] - found[0].shape[1])
            found = F.pad(found[0], (0, more), value=math.inf), F.pad(found[1], (0, more))
            found[0][left] = math.inf
            found[0][left, : place.shape[1]] = scanned[0].gather(1, order)
            found[1][left, : place.shape[1]] = place
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
        place = self._windows(units, self.coarse.best_of_groups(small), [(1, 0)])
        own = self._scores(units, place)
        query, column = own.isfinite().nonzero().T
        scores[query, place[query, column]] = own[query, column]
        return scores

    def _windows(self, units: Tensor, best: Tensor, wanted: Wanted) -> Tensor:
        """Places near the best fine samples of each query, (Q,M), by place; -1 for none. Around each as many
        as candidates of a single peak may lie apart."""
        plan, places = self.plan, self.route.places
        count = max(k for k, _ in wanted)
        group, best = highest(best, max(plan.refined, 2 * count))
        reach = -(-plan.coarse // (2 * plan.fine))
        offsets = torch.arange(-reach, reach + 1, device=group.device)
        middle = self.middle[GROUP * group + best % GROUP]
        at = (middle[:, :, None] + offsets).clamp(0, len(self.fine.place) - 1).flatten(1)
        parts = zip(at.split(TOGETHER), units.split(TOGETHER), strict=True)  # these stay in the cache
        products = [(self.fine.rows[near] * some[:, None]).sum(2) for near, some in parts]
        cosines = torch.cat(products) / self.fine.norm[at]
        width = min(places, plan.fine + 1 + max((k - 1) * (radius + 1) for k, radius in wanted))
        windows = best_candidates(-cosines, min(count + SPARE, at.shape[1]), width, self.fine.place[at])
        close = windows.score <= windows.score[:, :count].amax(1, keepdim=True) + CLOSE
        around = torch.arange(-width, width + 1, device=group.device)
        place = (windows.index[:, :, None] + around).clamp(0, places - 1)
        place = place.masked_fill(~(windows.accepted & close)[:, :, None], -1).flatten(1).sort(1).values
        place = place.masked_fill(F.pad(place[:, 1:] == place[:, :-1], (0, 1)), -1)
        if count == 1:
            return place
        place = place.sort(1).values  # windows of several candidates are wide and overlap
        return place[:, -max(1, int((place >= 0).sum(1).amax())) :].contiguous()

    def _scores(self, units: Tensor, place: Tensor) -> Tensor:
        """Scores of places for each query, (Q,M), by the map's own products; +inf for none."""
        products = torch.full(place.shape, -math.inf, device=place.device)
        chunk = torch.bucketize(place, self.starts, right=True) - 1
        for g in chunk.unique().tolist():
            if g >= 0:
                query, column = (chunk == g).nonzero().T
                own, row = query.unique_consecutive(return_inverse=True)
                here = self.route.products(units[own], range(g, g + 1))
                products[query, column] = here[row, place[query, column] - self.route.chunks[g][0]]
        norms = self.route.norms[place]
        inverse = torch.where(norms > 0, 1 / norms, 0).masked_fill(place < 0, 1)
        return torch.addcmul(products.new_ones(()), products, inverse, value=-1)

    def _last(self, found: Best, wanted: Wanted) -> Tensor:
        """The highest score of the candidates that are wanted, (Q,); +inf if not all were found."""
        score, place = found
        if score.shape[1] < max(k for k, _ in wanted):
            return score.new_full((len(score),), math.inf)
        last = [best_candidates(score, *one, place).score[:, -1] for one in wanted]
        return torch.stack(last).amax(0)

    def _below(self, units: Tensor, best: Tensor, score: Tensor) -> Best:
        """Places of each query that score at most so much, (Q,), but for rounding.

        For unit vectors q, s and x, the angle of q and x is at least that of q and s less that of s and x.
        Here s are the fine samples of a group, and x the places near them.
        """
        assert self.bounds is not None
        small = to_int8(units).float()
        size = torch.linalg.vector_norm(small, dim=1)
        reach = angle(1 - score) + angle((units * small).sum(1) / size.clamp(min=1))
        reach = reach.clamp(max=math.pi / 2)
        turned = GROUP * size * torch.stack([reach.cos(), -reach.sin(), -torch.ones_like(reach)])
        parts = []
        for start in range(0, len(best), BLOCK // GROUP):  # they stay in the cache
            some = slice(start, start + BLOCK // GROUP)
            # the cosine of a sum of two angles; a product below 0 is not told from 0
            least = F.threshold(self.bounds[some] @ turned, 0, -math.inf)
            pairs = (best[some] >= least).nonzero()
            parts.append(pairs + pairs.new_tensor([start, 0]))
        group, query = torch.cat(parts).T.contiguous()
        chunk = torch.bucketize(self.fine.place[group * GROUP], self.starts, right=True) - 1
        found = [(query[:0], query[:0], score[:0])]
        for g in chunk.unique().tolist():
            own = query[chunk == g].unique()
            for first, scores in self.route.score_blocks(units[own], *self.route.chunks[g]):
                row, at = (scores <= score[own, None] + ROUNDING).nonzero().T
                found.append((own[row], at + first, scores[row, at]))
        query, place, score = (torch.cat(column) for column in zip(*found, strict=True))
        query, order = query.sort(stable=True)  # they are by place
        counts = torch.bincount(query, minlength=len(units))
        column = torch.arange(len(query), device=query.device) - (counts.cumsum(0) - counts)[query]
        table = score.new_full((len(units), max(1, int(counts.max()))), math.inf)
        where = torch.full_like(table, -1, dtype=torch.int64)
        table[query, column], where[query, column] = score[order], place[order]
        return table, where

    def _bounds(self) -> Tensor:
        """Of each group of fine samples the least length, times the cosine and the sine of the largest angle
        between a sample and a place near it, and of itself: (S / GROUP, 3)."""
        least = torch.ones(len(self.fine.norm) // GROUP, device=self.fine.norm.device)
        for chunk, (start, stop) in enumerate(self.route.chunks):
            nearest, units = self._nearest(chunk), F.normalize(self.route.decode(chunk))
            cosine = (self.fine.rows[nearest] * units).sum(1) / self.fine.norm[nearest]
            cosine = cosine.where(self.route.norms[start:stop] > 0, 1)  # these score 1
            least.scatter_reduce_(0, nearest // GROUP, cosine, "amin")
        least -= ROUNDING
        least = least.where(least > 0, -1)  # from a right angle on nothing is ruled out
        sine, norm = (1 - least.square()).sqrt(), self.fine.norm.view(-1, GROUP).amin(1)
        bounds: Tensor = norm[:, None] * torch.stack([least, sine, torch.full_like(least, ROUNDING)], 1)
        return bounds

    def _nearest(self, chunk: int) -> Tensor:
        """The fine sample that each place of a chunk is nearest to, (W,)."""
        start, stop = self.route.chunks[chunk]
        at = torch.arange(start, stop, device=self.starts.device)
        first, last = torch.searchsorted(self.fine.place, torch.stack([at[0], at[-1] + 1])).tolist()
        place = self.fine.place[first:last]
        nearest: Tensor = first + torch.bucketize(at, (place[1:] + place[:-1]) / 2)
        return nearest


def highest(best: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """So many rows of (G,Q) with the highest numbers, and these, (Q,n): they are in the best blocks."""
    blocks = best.view(-1, BESIDE, best.shape[1])
    block = blocks.amax(1).T.topk(min(count, len(blocks)), 1, sorted=False).indices
    inside = blocks.permute(2, 0, 1).gather(1, block[:, :, None].expand(-1, -1, BESIDE)).flatten(1)
    number, at = inside.topk(min(count, inside.shape[1]), 1, sorted=False)
    return block.gather(1, at // BESIDE) * BESIDE + at % BESIDE, number


def to_int8(units: Tensor) -> Tensor:
    """Unit vectors (n,K) in integers of 8 bits, on a scale that depends on K alone."""
    scale = 127 * max(1.0, math.sqrt(units.shape[1]) / LARGE)
    rounded: Tensor = (units * scale).round().clamp(-127, 127)
    return rounded.to(torch.int8)


def fitting(kept: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """A tensor, if it is of this shape and type; else an InputError."""
    if kept.shape != shape or kept.dtype != dtype:
        raise InputError(f"samples are {tuple(kept.shape)} {kept.dtype}; expected {shape} {dtype}")
    return kept


@cache
def has_int8_products() -> bool:
    """Whether torch multiplies 8-bit integers fast on this CPU."""
    return torch.backends.mkldnn.is_available() and torch.cpu._is_vnni_supported()


def angle(cosine: Tensor) -> Tensor:
    """The largest angle that a rounded cosine may be of."""
    return (cosine - ROUNDING).clamp(-1, 1).acos()
