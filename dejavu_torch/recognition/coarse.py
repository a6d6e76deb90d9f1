"""Coarse-to-fine search for single queries: the low-frequency lines of a spectral map are its index.

The inverse transform of the W / d lowest lines of a chunk of W places gives every d-th place, low-passed.
Only places near the best of these samples are scored.
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
from dejavu_torch.maps.spectral_map import SpectralMap, scores_of
from dejavu_torch.maps.spectrum import half_cycles
from dejavu_torch.recognition.search import Best, Wanted, empty_topk, num_needed, search
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.types import InputError

MIN_PLACES = 20_000  # a shorter map is scanned, which is as fast
OVERHEAD = 16  # bytes of a sample besides its descriptor
MEMORY, MEMORY_PER_PLACE = 100_000_000, 100  # default bytes for the samples; the larger one applies
SPACINGS = (32, 16, 12, 8, 6, 4, 3, 2)  # places from one sample to the next
COARSE, FINE = 0.93, 0.98  # shares of the lines' energy that coarse and fine samples should hold
GROUP = 8  # consecutive samples, represented by the best of them
GROUPS_PER_BLOCK = 16  # the best groups are searched for in the best blocks
REFINED = 32  # best groups of a query that are refined; 4 times as many if the samples hold less than COARSE
EXTRA_WINDOWS = 3  # further windows of a query that are scored if they are nearly as good
NEARLY = 0.02  # difference in cosine that counts as nearly as good
MIN_COSINE = 0.02  # a query whose best cosine is lower is scanned: places of norm 0 have cosine 0
QUERIES_AT_ONCE = 16  # whose fine samples are compared at a time, in the cache
BLOCK, PRODUCTS = 8192, 2**20  # samples, and products with them, at a time: these stay in the cache
CLIP = 6  # standard deviations at which a component of a unit vector is clipped in 8 bits
ROUNDING = 1e-5  # error of products of unit vectors in float32
MEASURED_CHUNKS = 16  # evenly along the map, for the energy of the lines


class Plan(NamedTuple):
    """How a map is sampled."""

    coarse: int  # places from one coarse sample to the next
    fine: int
    refined: int  # best groups of coarse samples, around which fine ones are compared
    held: float  # share of the lines' energy in the coarse samples
    bytes: int  # of all samples

    def __str__(self) -> str:
        return (
            f"samples every {self.coarse} places hold {self.held:.1%} of the lines' energy, the best "
            f"{self.refined} groups of {GROUP} are refined every {self.fine}; {self.bytes / 1e6:.1f} MB"
        )


def plan(route: PlaceMap, limit: int | None = None, exact: bool = False) -> Plan | None:
    """The widest spacings at which samples hold enough energy. None if the map has to be scanned: another
    kind or metric, few places, a single chunk, or mainly high frequencies.

    Args:
        limit: bytes; None is 100 MB, or 100 bytes per place if that is more. Samples that exceed it get wider
            spacings, and more of them are refined.
        exact: a sample of every place, whatever the limit.

    Raises:
        InputError: the limit is below the samples of a single chunk.
    """
    if not isinstance(route, SpectralMap) or route.metric != "cosine" or not route.chunks:
        return None
    longest = max(stop - start for start, stop in route.chunks)
    limit = max(MEMORY, MEMORY_PER_PLACE * route.places) if limit is None else limit

    def size(places: int, *spacings: int) -> int:
        return sum(-(-places // d) * (route.dimension + OVERHEAD) for d in spacings)

    if route.places < max(MIN_PLACES, 2 * longest):
        return None
    minimum = size(longest, SPACINGS[0], SPACINGS[1])
    if limit < minimum:
        raise InputError(f"search_memory is {limit} bytes; expected at least {minimum}, for a chunk")
    if exact:
        return Plan(1, 1, 1, 1.0, size(route.places, 1))
    held = energy_held(route)
    widest_coarse = next((d for d in SPACINGS if held[d] >= COARSE), 0)
    widest_fine = next((d for d in SPACINGS if held[d] >= FINE), 2)
    for coarse in [d for d in SPACINGS[::-1] if d >= max(4, widest_coarse)] if widest_coarse else ():
        for fine in [d for d in SPACINGS[::-1] if min(widest_fine, coarse // 2) <= d <= coarse // 2]:
            if size(route.places, coarse, fine) <= limit:
                refined = REFINED * (1 if coarse == widest_coarse else 4)
                return Plan(coarse, fine, refined, held[coarse], size(route.places, coarse, fine))
    return None


def energy_held(route: SpectralMap) -> dict[int, float]:
    """The share of the lines' energy that samples at each of `SPACINGS` hold, from some chunks of a map."""
    held, whole = dict.fromkeys(SPACINGS, 0.0), 1e-30
    for chunk in range(0, len(route.chunks), max(1, len(route.chunks) // MEASURED_CHUNKS)):
        length = route.chunks[chunk][1] - route.chunks[chunk][0]
        line, _, value = route.lines(chunk)
        energy = value.new_zeros(length + 1, dtype=torch.float64)
        energy.index_add_(0, half_cycles(line, route.transform), value.double().square())
        below = energy.cumsum(0).tolist()
        whole += below[-1]
        for d in SPACINGS:
            held[d] += below[length // d]
    return {d: energy / whole for d, energy in held.items()}


def coarse_search(route: PlaceMap, limit: int | None = None, exact: bool = False) -> CoarseSearch | None:
    """The coarse search of a map; None if it has to be scanned, see `plan`."""
    chosen = plan(route, limit, exact)
    return CoarseSearch(route, chosen) if isinstance(route, SpectralMap) and chosen is not None else None


class Samples:
    """Low-passed descriptors of a map, about every `spacing` places, padded to whole groups in each chunk and
    to whole blocks of groups in the map.

    Args:
        rows: as computed before; None computes them.

    Attributes:
        rows: (S,K) int8, unit vectors on one scale. norm: (S,) of the rows. place: (S,) nearest to each, in
            order.
    """

    def __init__(self, route: SpectralMap, spacing: int, rows: Tensor | None = None) -> None:
        places = []
        for chunk, (start, stop) in enumerate(route.chunks):
            at = route.sampled(chunk, -(-(stop - start) // spacing))
            places.append(F.pad(at, (0, -len(at) % GROUP), value=stop - start - 1) + start)
        place = torch.cat(places)
        self.place = F.pad(place, (0, -len(place) % (GROUP * GROUPS_PER_BLOCK)), value=route.places - 1)
        shape = len(self.place), route.dimension
        if rows is None:  # padding is 0, which is never the best
            rows, first = self.place.new_zeros(shape, dtype=torch.int8), 0
            for chunk, (start, stop) in enumerate(route.chunks):
                row = route.samples(chunk, -(-(stop - start) // spacing))
                rows[first : first + len(row)] = to_int8(F.normalize(row))
                first += len(places[chunk])
        self.rows = checked(rows, shape, torch.int8).to(self.place.device)
        norms = [torch.linalg.vector_norm(block.float(), dim=1) for block in self.rows.split(BLOCK)]
        self.norm = torch.cat(norms).clamp(min=1)

    def products(self, queries: Tensor) -> Iterator[Tensor]:
        """Dot products with queries, block by block: (Q,K) int8 -> (n,Q) int32."""
        int8 = self.rows.device.type == "cpu" and has_int8_products()
        for rows in self.rows.split(GROUP * max(1, PRODUCTS // (GROUP * len(queries))) if int8 else BLOCK):
            yield torch._int_mm(rows, queries.T) if int8 else (rows.float() @ queries.T.float()).int()

    def best_of_groups(self, queries: Tensor) -> Tensor:
        """The largest `GROUP` x product + row of each group of rows, (Q,K) int8 -> (G,Q) int32: much faster
        than an argmax."""
        row = torch.arange(GROUP, dtype=torch.int32, device=queries.device)[:, None]
        best = row.new_empty(len(self.rows) // GROUP, len(queries))
        first = 0
        for products in self.products(queries):
            groups = products.view(-1, GROUP, len(queries))
            last = first + len(groups)
            torch.amax(torch.add(row, groups, alpha=GROUP, out=groups), 1, out=best[first:last])
            first = last
        return best


class CoarseSearch:
    """Finds the best places of queries: coarse samples choose regions, fine samples choose windows in them,
    and the places of these windows are scored.

    If every place has a fine sample, the result is exact: bounds exclude all places that cannot be as good as
    the best of the windows.

    Args:
        chosen: see `plan`. kept: `tensors` of a search with the same map and plan; computed if empty.

    Shape: queries (Q,K), wanted -> scores and places (Q,M), by place, +inf for none. They include the wanted
        candidates, see `Wanted`.

    Convention: scores are those of a scan. A query of norm 0, or one that is similar to no place, is scanned.

    Raises:
        InputError: the kept tensors have other shapes or types.
    """

    def __init__(
        self, route: SpectralMap, chosen: Plan, kept: Mapping[str, Tensor] = MappingProxyType({})
    ) -> None:
        self.route, self.plan, self.exact = route, chosen, chosen.fine == 1
        self.starts = torch.tensor([start for start, _ in route.chunks], device=route.device)
        self.fine = Samples(route, chosen.fine, kept.get("fine"))
        self.coarse = self.fine if self.exact else Samples(route, chosen.coarse, kept.get("coarse"))
        self.middle = torch.searchsorted(self.fine.place, self.coarse.place, out_int32=True)
        self.bounds = None
        if self.exact:
            bounds, shape = kept.get("bounds"), (len(self.fine.norm) // GROUP, 3)
            bounds = checked(self._bounds() if bounds is None else bounds, shape, torch.float32)
            self.bounds = bounds.to(self.starts.device)

    @property
    def tensors(self) -> dict[str, Tensor]:
        """What is slow to compute: the rows of samples, and the bounds of an exact search."""
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
        worst = self._worst(found, wanted)
        if self.exact:
            found = self._below(units, best, worst.masked_fill(worst.isinf(), -1))  # +inf is scanned below
            worst = self._worst(found, wanted)
        rest = (worst.isinf() | ~(found[0].amin(1) <= 1 - MIN_COSINE)).nonzero()[:, 0]
        if len(rest):
            scanned = search(self.route, queries[rest], num_needed(wanted, self.route.places))
            place, order = scanned[1].sort(1)
            more = max(0, place.shape[1] - found[0].shape[1])
            found = F.pad(found[0], (0, more), value=math.inf), F.pad(found[1], (0, more))
            found[0][rest] = math.inf
            found[0][rest, : place.shape[1]] = scanned[0].gather(1, order)
            found[1][rest, : place.shape[1]] = place
        return found

    @torch.no_grad()
    def approximate(self, queries: Tensor) -> Tensor:
        """Scores of all places, (Q,K) -> (Q,N): exact around the best places, elsewhere those of the nearest
        fine samples."""
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
        """Places near the best fine samples of each query, (Q,M), by place; -1 for none. A window is wide
        enough for all candidates on one peak."""
        plan, places = self.plan, self.route.places
        count = max(k for k, _ in wanted)
        group, best = topk_groups(best, max(plan.refined, 2 * count))
        reach = -(-plan.coarse // (2 * plan.fine))
        offsets = torch.arange(-reach, reach + 1, device=group.device)
        middle = self.middle[GROUP * group + best % GROUP]
        at = (middle[:, :, None] + offsets).clamp(0, len(self.fine.place) - 1).flatten(1)
        parts = zip(at.split(QUERIES_AT_ONCE), units.split(QUERIES_AT_ONCE), strict=True)
        products = [(self.fine.rows[near] * part[:, None]).sum(2) for near, part in parts]
        cosines = torch.cat(products) / self.fine.norm[at]
        width = min(places, plan.fine + 1 + max((k - 1) * (radius + 1) for k, radius in wanted))
        most = min(count + EXTRA_WINDOWS, at.shape[1])
        windows = best_candidates(-cosines, most, width, self.fine.place[at])
        close = windows.score <= windows.score[:, :count].amax(1, keepdim=True) + NEARLY
        around = torch.arange(-width, width + 1, device=group.device)
        place = (windows.index[:, :, None] + around).clamp(0, places - 1)
        place = place.masked_fill(~(windows.accepted & close)[:, :, None], -1).flatten(1).sort(1).values
        place = place.masked_fill(F.pad(place[:, 1:] == place[:, :-1], (0, 1)), -1)
        if count == 1:
            return place
        place = place.sort(1).values  # windows of several candidates are wide and overlap
        return place[:, -max(1, int((place >= 0).sum(1).amax())) :].contiguous()

    def _scores(self, units: Tensor, place: Tensor) -> Tensor:
        """Exact scores of places (Q,M) for each query; +inf for none."""
        products = torch.full(place.shape, -math.inf, dtype=torch.float32, device=place.device)
        chunk = torch.bucketize(place, self.starts, right=True) - 1
        for g in chunk.unique().tolist():
            if g >= 0:
                query, column = (chunk == g).nonzero().T
                own, row = query.unique_consecutive(return_inverse=True)
                here = self.route.products(units[own], range(g, g + 1))
                products[query, column] = here[row, place[query, column] - self.route.chunks[g][0]]
        norms = self.route.norms[place].masked_fill(place < 0, 1)
        return scores_of(products, norms, norms, "cosine")

    def _worst(self, found: Best, wanted: Wanted) -> Tensor:
        """The highest score of the wanted candidates, (Q,); +inf if not all were found."""
        score, place = found
        if score.shape[1] < max(k for k, _ in wanted):
            return score.new_full((len(score),), math.inf)
        worst = [best_candidates(score, *one, place).score[:, -1] for one in wanted]
        return torch.stack(worst).amax(0)

    def _below(self, units: Tensor, best: Tensor, score: Tensor) -> Best:
        """The places of each query with at most this score (Q,), up to rounding.

        For unit vectors q, s and x, angle(q, x) >= angle(q, s) - angle(s, x). Here s are the fine samples of
        a group, and x the places near them.
        """
        assert self.bounds is not None
        small = to_int8(units).float()
        size = torch.linalg.vector_norm(small, dim=1)
        reach = angle(1 - score) + angle((units * small).sum(1) / size.clamp(min=1))
        reach = reach.clamp(max=math.pi / 2)
        turned = GROUP * size * torch.stack([reach.cos(), -reach.sin(), -torch.ones_like(reach)])
        parts = []
        for start in range(0, len(best), BLOCK // GROUP):  # a block stays in the cache
            block = slice(start, start + BLOCK // GROUP)
            # the cosine of a sum of two angles; one below 0 excludes nothing
            minimum = F.threshold(self.bounds[block] @ turned, 0, -math.inf)
            pairs = (best[block] >= minimum).nonzero()
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
        query, order = query.sort(stable=True)  # keeps the order of places
        counts = torch.bincount(query, minlength=len(units))
        column = torch.arange(len(query), device=query.device) - (counts.cumsum(0) - counts)[query]
        table = score.new_full((len(units), max(1, int(counts.max()))), math.inf)
        places = torch.full_like(table, -1, dtype=torch.int64)
        table[query, column], places[query, column] = score[order], place[order]
        return table, places

    def _bounds(self) -> Tensor:
        """For each group of fine samples, its smallest norm times (cos a, sin a, `ROUNDING`), where a is the
        largest angle between a sample and a place near it: (S / GROUP, 3)."""
        lowest = self.fine.norm.new_ones(len(self.fine.norm) // GROUP)
        for chunk, (start, stop) in enumerate(self.route.chunks):
            nearest, units = self._nearest(chunk), F.normalize(self.route.decode(chunk))
            cosine = (self.fine.rows[nearest] * units).sum(1) / self.fine.norm[nearest]
            cosine = cosine.where(self.route.norms[start:stop] > 0, 1)  # these score 1
            lowest.scatter_reduce_(0, nearest // GROUP, cosine, "amin")
        lowest -= ROUNDING
        lowest = lowest.where(lowest > 0, -1)  # angles of 90 degrees and more exclude nothing
        sine, norm = (1 - lowest.square()).sqrt(), self.fine.norm.view(-1, GROUP).amin(1)
        bounds: Tensor = norm[:, None] * torch.stack([lowest, sine, torch.full_like(lowest, ROUNDING)], 1)
        return bounds

    def _nearest(self, chunk: int) -> Tensor:
        """The nearest fine sample of each place of a chunk, (W,)."""
        start, stop = self.route.chunks[chunk]
        at = torch.arange(start, stop, device=self.starts.device)
        first, last = torch.searchsorted(self.fine.place, torch.stack([at[0], at[-1] + 1])).tolist()
        place = self.fine.place[first:last]
        nearest: Tensor = first + torch.bucketize(at, (place[1:] + place[:-1]) / 2)
        return nearest


def topk_groups(best: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The highest groups of each query, from its best blocks: (G,Q) -> their indices and values (Q,n)."""
    size = GROUPS_PER_BLOCK
    blocks = best.view(-1, size, best.shape[1])
    block = blocks.amax(1).T.topk(min(count, len(blocks)), 1, sorted=False).indices
    inside = blocks.permute(2, 0, 1).gather(1, block[:, :, None].expand(-1, -1, size)).flatten(1)
    value, at = inside.topk(min(count, inside.shape[1]), 1, sorted=False)
    return block.gather(1, at // size) * size + at % size, value


def to_int8(units: Tensor) -> Tensor:
    """Unit vectors (n,K) as 8-bit integers, on a scale that depends on K alone."""
    scale = 127 * max(1.0, math.sqrt(units.shape[1]) / CLIP)
    rounded: Tensor = (units * scale).round().clamp(-127, 127)
    return rounded.to(torch.int8)


def checked(kept: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """The tensor itself; InputError if its shape or type differs."""
    if kept.shape != shape or kept.dtype != dtype:
        raise InputError(f"samples are {tuple(kept.shape)} {kept.dtype}; expected {shape} {dtype}")
    return kept


@cache
def has_int8_products() -> bool:
    """Whether torch multiplies 8-bit integers fast on this CPU."""
    return torch.backends.mkldnn.is_available() and torch.cpu._is_vnni_supported()


def angle(cosine: Tensor) -> Tensor:
    """The largest angle whose cosine rounds to this."""
    return (cosine - ROUNDING).clamp(-1, 1).acos()
