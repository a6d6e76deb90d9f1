"""Descriptors of a map in 8 bits, and search by one product with those of all places.

With products of whole numbers, equal places have equal scores, on any device.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.recognition.search import NmsSpec, Scan, TopK, empty_topk

GROUP = 8  # consecutive samples, represented by the best of them
GROUPS_PER_BLOCK = 16  # the best groups are searched for in the best blocks
REFINED = 16  # best groups of a query, of which all places are scored
LEVELS = 127  # steps on each side of 0
FINER = 254  # parts of a step
DOUBT = 5 / math.sqrt(12)  # steps, as five standard deviations of what rounding to whole ones changes
SAMPLES_AT_ONCE, PRODUCTS = 8192, 2**20  # samples, and products with them, at a time: these stay in the cache
GATHERED = 2**18  # numbers of samples that are compared at a time
LARGER = 2**7  # times as many at a time on a device
WIDEST = 2**14  # numbers of a descriptor: `GROUP` x products are below 2**31


class Samples:
    """Unit descriptors of a map about every `spacing` places, low-passed, as whole steps; padded to whole
    blocks of groups with zeros.

    Attributes:
        rows: (S,K') int8; K' is K, padded to whole groups. step: () float32. place: (S,) int64, nearest to
            each, in order. groups: number of groups without the padding. finer: (S,K') int8, the rest in
            parts of a step, if all places are samples.
    """

    def __init__(self, place_map: SpectralMap, spacing: int) -> None:
        chunks, size = place_map.chunks, GROUP * GROUPS_PER_BLOCK
        near = [place_map.sampled(g, spacing) + start for g, (start, _) in enumerate(chunks)]
        place = torch.cat(near)
        self.groups = -(-len(place) // GROUP)  # without the padding
        self.place = F.pad(place, (0, -len(place) % size), value=place_map.places - 1)
        self.rows = self.place.new_zeros(len(self.place), width_of(place_map), dtype=torch.int8)
        self.finer = self.rows.clone() if spacing == 1 else None
        largest = [units_at(place_map, g, spacing).abs().amax() for g in range(len(chunks))]
        self.step, first = torch.stack(largest).amax().clamp(min=1e-30) / LEVELS, 0
        for g in range(len(chunks)):
            steps = units_at(place_map, g, spacing) / self.step
            count, whole = len(steps), steps.round()
            some = slice(first, first + count), slice(place_map.dimension)
            self.rows[some] = whole.to(torch.int8)
            if self.finer is not None:
                self.finer[some] = ((steps - whole) * FINER).round().to(torch.int8)
            first += count

    def best_of_groups(self, queries: Tensor) -> Tensor:
        """The largest `GROUP` x product + row of each group of rows, (Q,K) int8 -> (G,Q) int32: much faster
        than an argmax."""
        row = torch.arange(GROUP, dtype=torch.int32, device=queries.device)[:, None]
        best = row.new_empty(len(self.rows) // GROUP, len(queries))
        first = 0
        for products in products_of(self.rows, queries):
            groups = products.view(-1, GROUP, len(queries))
            last = first + len(groups)
            torch.amax(torch.add(row, groups, alpha=GROUP, out=groups), 1, out=best[first:last])
            first = last
        best[self.groups :] = torch.iinfo(torch.int32).min  # padding, which no query finds
        return best

    def cosines(self, units: Tensor, rows: Tensor) -> Tensor:
        """Of queries of length 1 or 0 with some rows of each: (Q,K), (Q,M) -> (Q,M)."""
        units, found = padded(units, self.rows.shape[1]), []
        most = GATHERED * (1 if units.device.type == "cpu" else LARGER)
        count = max(1, most // (rows.shape[1] * units.shape[1]))
        for some, queries in zip(rows.split(count), units.split(count), strict=True):
            every = some.flatten()
            own = self.rows.index_select(0, every)  # several times as fast as by brackets
            if self.finer is not None:
                own = own.float().add_(self.finer.index_select(0, every), alpha=1 / FINER)
            found.append((own.view(*some.shape, -1) * queries[:, None]).sum(2))
        return torch.cat(found) * self.step


class RowSearch(Scan):
    """Finds the best places of queries by the product of their descriptors with those of all places.

    Shape: queries (Q,K), wanted -> scores and places (Q,M), by place, +inf for none.

    Convention: scores are those of a scan to a hundredth of a step. A query whose best place may be another,
        as what 8 bits leave says, is scanned on the CPU; from a device no value is read back.
    """

    place_map: SpectralMap

    def __init__(self, place_map: SpectralMap) -> None:
        super().__init__(place_map)
        self.samples = Samples(place_map, 1)
        self.unrelated = self.samples.step.new_full(self.samples.place.shape, math.inf)  # score of cosine 0
        self.unrelated[: place_map.places] = 1

    @torch.no_grad()
    def __call__(self, queries: Tensor, wanted: list[NmsSpec]) -> TopK:
        if not len(queries):
            return empty_topk(queries, max(k for k, _ in wanted))
        units, samples = units_of(self.place_map, queries), self.samples
        whole, step = to_int8(units)
        best = samples.best_of_groups(whole)
        # each candidate suppresses runs of 2 radius + 1 places
        rows = (self.place_map.layout.near(radius) // (2 * radius + 1) for _, radius in wanted)
        each = zip(wanted, rows, strict=True)
        count = max(2 + (k - 1) * n * (2 * radius // GROUP + 2) for (k, radius), n in each)
        group, value = topk_groups(best, max(REFINED, count))
        row = GROUP * group.sort(1).values[:, :, None] + torch.arange(GROUP, device=group.device)
        row = row.flatten(1)
        score = (self.unrelated[row] - samples.cosines(units, row)).nan_to_num(math.inf, math.inf)
        if len(best) > group.shape[1] and row.device.type == "cpu":
            most = value.amin(1) / GROUP * step * samples.step + DOUBT * torch.hypot(step, samples.step)
            doubtful = (~(1 - score.amin(1) >= most)).nonzero()[:, 0]  # another group may have a better one
            if len(doubtful):
                return replaced((score, row), doubtful, super().__call__(queries[doubtful], wanted))
        return score, row


def width_of(place_map: SpectralMap) -> int:
    """Numbers of a sample: those of a descriptor, in whole groups."""
    return -(-place_map.dimension // GROUP) * GROUP


def units_at(place_map: SpectralMap, chunk: int, spacing: int) -> Tensor:
    """Staged descriptors (M,K) about every `spacing` places of a chunk, of length 1; all are those of the
    map."""
    start, stop = place_map.chunks[chunk]
    if spacing > 1 and stop - start > 1:
        return F.normalize(place_map.staged(place_map.samples(chunk, spacing)))
    norms = place_map.norms[start:stop, None]
    units: Tensor = place_map.staged(place_map.decode(chunk)) * torch.where(norms > 0, 1 / norms, 0)
    return units


def units_of(place_map: SpectralMap, queries: Tensor) -> Tensor:
    """Queries (Q,K) as a map compares them, of length 1 or 0, float32."""
    queries = place_map.staged(queries.to(torch.promote_types(queries.dtype, torch.float32)))
    length = torch.linalg.vector_norm(queries, dim=1, keepdim=True)
    return (queries / torch.where(length > 0, length, 1)).float()


def to_int8(units: Tensor) -> tuple[Tensor, Tensor]:
    """Vectors (n,K) in whole steps, and the step of each, (n,)."""
    step = units.abs().amax(1).clamp(min=1e-30) / LEVELS
    return (units / step[:, None]).round().nan_to_num().to(torch.int8), step


def padded(queries: Tensor, width: int) -> Tensor:
    """Queries (Q,K) with zeros up to this width."""
    return F.pad(queries, (0, width - queries.shape[1])) if queries.shape[1] < width else queries


def products_of(rows: Tensor, queries: Tensor) -> Iterator[Tensor]:
    """Dot products of rows with queries, some whole blocks of groups at a time: (S,K'), (Q,K) int8 -> (n,Q)
    int32."""
    size, device, count = GROUP * GROUPS_PER_BLOCK, rows.device.type, len(queries)
    queries = padded(queries, rows.shape[1])
    int8 = has_int8_products(device)
    if not int8:
        yield from ((part.float() @ queries.T.float()).int() for part in rows.split(SAMPLES_AT_ONCE))
        return
    if device == "cuda":  # which multiplies whole groups
        queries = F.pad(queries, (0, 0, 0, -count % GROUP))
    most = PRODUCTS * (1 if device == "cpu" else LARGER)
    for part in rows.split(size * max(1, most // (size * count))):
        yield torch._int_mm(part, queries.T)[:, :count]


def topk_groups(best: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The highest groups of each query, from its best blocks: (G,Q) -> their indices and values (Q,n)."""
    size = GROUPS_PER_BLOCK
    blocks = best.view(-1, size, best.shape[1])
    block = blocks.amax(1).T.topk(min(count, len(blocks)), 1, sorted=False).indices
    inside = blocks.permute(2, 0, 1).gather(1, block[:, :, None].expand(-1, -1, size)).flatten(1)
    value, at = inside.topk(min(count, inside.shape[1]), 1, sorted=False)
    return block.gather(1, at // size) * size + at % size, value


def replaced(found: TopK, queries: Tensor, rest: TopK) -> TopK:
    """Scores and places (Q,M), by place, with those of some queries from elsewhere."""
    place, order = rest[1].sort(1)
    more = max(0, place.shape[1] - found[0].shape[1])
    scores, places = F.pad(found[0], (0, more), value=math.inf), F.pad(found[1], (0, more))
    scores[queries] = math.inf
    scores[queries, : place.shape[1]] = rest[0].gather(1, order).to(scores)
    places[queries, : place.shape[1]] = place
    return scores, places


@cache
def has_int8_products(device: str = "cpu") -> bool:
    """Whether torch multiplies 8-bit integers fast, and exactly, on this kind of device."""
    if device == "cuda":  # from Turing on; not ROCm
        return torch.version.hip is None and torch.cuda.get_device_capability() >= (7, 5)
    if device != "cpu" or not (torch.backends.mkldnn.is_available() and torch.cpu._is_vnni_supported()):
        return False
    # without VNNI, of which ONEDNN_MAX_CPU_ISA may deprive torch, sums of two products saturate at 16 bits
    most = torch.full((GROUP * GROUPS_PER_BLOCK, GROUP), LEVELS, dtype=torch.int8, device=device)
    return bool((torch._int_mm(most, most.T) == GROUP * LEVELS**2).all())
