"""Coarse-to-fine search for single queries: the low-frequency lines of a spectral map are its index.

The inverse transform of the W / d lowest lines of a chunk of W places gives every d-th place, low-passed.
Only places near the best of these samples are scored.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import SpectralMap, scores_of
from dejavu_torch.maps.spectrum import half_cycles
from dejavu_torch.recognition.search import NmsSpec, Scan, Search, TopK, check_search, empty_topk
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.types import expect

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
MEASURED_CHUNKS = 16  # evenly along the map, for the energy of the lines


class SamplingPlan(NamedTuple):
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


def plan(place_map: PlaceMap, limit: int | None = None) -> SamplingPlan | None:
    """The widest spacings at which samples hold enough energy. None if the map has to be scanned: another
    kind or metric, few places, a single chunk, or mainly high frequencies.

    Args:
        limit: bytes; None is 100 MB, or 100 bytes per place if that is more. Samples that exceed it get wider
            spacings, and more of them are refined.

    Raises:
        InputError: the limit is below the samples of a single chunk.
    """
    if not isinstance(place_map, SpectralMap) or place_map.metric != "cosine" or not place_map.chunks:
        return None
    longest = max(stop - start for start, stop in place_map.chunks)
    limit = max(MEMORY, MEMORY_PER_PLACE * place_map.places) if limit is None else limit

    def size(places: int, *spacings: int) -> int:
        return sum(-(-places // d) * (place_map.dimension + OVERHEAD) for d in spacings)

    if place_map.places < max(MIN_PLACES, 2 * longest):
        return None
    minimum = size(longest, SPACINGS[0], SPACINGS[1])
    expect(limit >= minimum, f"at least {minimum}, for a chunk", f"search_memory is {limit} bytes")
    held = explained_variance(place_map)
    widest_coarse = next((d for d in SPACINGS if held[d] >= COARSE), 0)
    widest_fine = next((d for d in SPACINGS if held[d] >= FINE), 2)
    for coarse in [d for d in SPACINGS[::-1] if d >= max(4, widest_coarse)] if widest_coarse else ():
        for fine in [d for d in SPACINGS[::-1] if min(widest_fine, coarse // 2) <= d <= coarse // 2]:
            if size(place_map.places, coarse, fine) <= limit:
                refined = REFINED * (1 if coarse == widest_coarse else 4)
                return SamplingPlan(coarse, fine, refined, held[coarse], size(place_map.places, coarse, fine))
    return None


def explained_variance(place_map: SpectralMap) -> dict[int, float]:
    """The share of the lines' energy that samples at each of `SPACINGS` hold, from some chunks of a map."""
    held, whole = dict.fromkeys(SPACINGS, 0.0), 1e-30
    for chunk in range(0, len(place_map.chunks), max(1, len(place_map.chunks) // MEASURED_CHUNKS)):
        length = place_map.chunks[chunk][1] - place_map.chunks[chunk][0]
        line, _, value = place_map.lines(chunk)
        energy = value.new_zeros(length + 1, dtype=torch.float64)
        energy.index_add_(0, half_cycles(line, place_map.transform), value.double().square())
        below = energy.cumsum(0).tolist()
        whole += below[-1]
        for d in SPACINGS:
            held[d] += below[length // d]
    return {d: energy / whole for d, energy in held.items()}


def searcher(place_map: PlaceMap, method: Search = "auto", memory: int | None = None) -> Scan:
    """The searcher of a map.

    Args:
        method: "auto" and "coarse" are a `CoarseSearch` if `plan` has one; "exact" and "scan" a `Scan`.
        memory: bytes of the samples, see `plan`.
    """
    check_search(method)
    chosen = plan(place_map, memory) if method in ("auto", "coarse") else None
    return (
        CoarseSearch(place_map, chosen) if isinstance(place_map, SpectralMap) and chosen else Scan(place_map)
    )


class Samples:
    """Low-passed descriptors of a map, about every `spacing` places, padded to whole groups in each chunk and
    to whole blocks of groups in the map.

    Attributes:
        rows: (S,K) int8, unit vectors on one scale. norm: (S,) of the rows. place: (S,) nearest to each, in
            order.
    """

    def __init__(self, place_map: SpectralMap, spacing: int) -> None:
        places = []
        for chunk, (start, stop) in enumerate(place_map.chunks):
            at = place_map.sampled(chunk, -(-(stop - start) // spacing))
            places.append(F.pad(at, (0, -len(at) % GROUP), value=stop - start - 1) + start)
        place = torch.cat(places)
        self.place = F.pad(place, (0, -len(place) % (GROUP * GROUPS_PER_BLOCK)), value=place_map.places - 1)
        # padding is 0, which is never the best
        self.rows, first = self.place.new_zeros(len(self.place), place_map.dimension, dtype=torch.int8), 0
        for chunk, (start, stop) in enumerate(place_map.chunks):
            row = place_map.staged(place_map.samples(chunk, -(-(stop - start) // spacing)))
            self.rows[first : first + len(row)] = to_int8(F.normalize(row))
            first += len(places[chunk])
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


class CoarseSearch(Scan):
    """Finds the best places of queries: coarse samples choose regions, fine samples choose windows in them,
    and the places of these windows are scored.

    Args:
        chosen: see `plan`.

    Shape: queries (Q,K), wanted -> scores and places (Q,M), by place, +inf for none.

    Convention: scores are those of a scan. A query of norm 0, or one that is similar to no place, is scanned.
    """

    place_map: SpectralMap

    def __init__(self, place_map: SpectralMap, chosen: SamplingPlan) -> None:
        super().__init__(place_map)
        self.plan = chosen
        self.starts = torch.tensor([start for start, _ in place_map.chunks], device=place_map.norms.device)
        self.fine, self.coarse = Samples(place_map, chosen.fine), Samples(place_map, chosen.coarse)
        self.middle = torch.searchsorted(self.fine.place, self.coarse.place, out_int32=True)

    @torch.no_grad()
    def __call__(self, queries: Tensor, wanted: list[NmsSpec]) -> TopK:
        if not len(queries):
            return empty_topk(queries, max(k for k, _ in wanted))
        queries = queries.to(torch.promote_types(queries.dtype, torch.float32))
        units = F.normalize(self.place_map.staged(queries)).float()
        place = self._windows(units, self.coarse.best_of_groups(to_int8(units)), wanted)
        score = self._scores(units, place)
        far = self._incomplete(score, place, wanted) | ~(score.amin(1) <= 1 - MIN_COSINE)
        rest = far.nonzero()[:, 0]
        if len(rest):
            scanned = super().__call__(queries[rest], wanted)
            at, order = scanned[1].sort(1)
            more = max(0, at.shape[1] - score.shape[1])
            score, place = F.pad(score, (0, more), value=math.inf), F.pad(place, (0, more))
            score[rest] = math.inf
            score[rest, : at.shape[1]] = scanned[0].gather(1, order)
            place[rest, : at.shape[1]] = at
        return score, place

    def _windows(self, units: Tensor, best: Tensor, wanted: list[NmsSpec]) -> Tensor:
        """Places near the best fine samples of each query, (Q,M), by place; -1 for none. A window is wide
        enough for all candidates on one peak."""
        plan, places = self.plan, self.place_map.places
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
                queries, row = query.unique_consecutive(return_inverse=True)
                here = self.place_map.products(units[queries], range(g, g + 1))
                products[query, column] = here[row, place[query, column] - self.place_map.chunks[g][0]]
        norms = self.place_map.norms[place].masked_fill(place < 0, 1)
        return scores_of(products, norms, norms, "cosine")

    def _incomplete(self, score: Tensor, place: Tensor, wanted: list[NmsSpec]) -> Tensor:
        """Which queries lack some of the wanted candidates, (Q,)."""
        if score.shape[1] < max(k for k, _ in wanted):
            return score.new_ones(len(score), dtype=torch.bool)
        last = [best_candidates(score, *spec, place).score[:, -1] for spec in wanted]
        return torch.stack(last).isinf().any(0)


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


@cache
def has_int8_products() -> bool:
    """Whether torch multiplies 8-bit integers fast on this CPU."""
    return torch.backends.mkldnn.is_available() and torch.cpu._is_vnni_supported()
