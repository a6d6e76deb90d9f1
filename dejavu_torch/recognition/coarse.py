"""The best places of single queries by samples of a spectral map: the low lines of its chunks are an index.

An inverse transform of the W / d lowest lines of a chunk of W places gives every d-th place, low-passed. The
best places are near the best of these samples; only places near them are scored.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

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
MEMORY = 100_000_000  # bytes of the samples at most by default
SPACINGS = (32, 16, 12, 8, 6, 4, 3, 2)  # places from one sample to the next
COARSE, FINE = 0.93, 0.998  # shares of the lines' energy that coarse and fine samples hold
REFINED = 16  # best coarse samples of a query that are refined; 4 times as many if they hold less than COARSE
GROUP = 16  # coarse samples of which the best is kept
ROWS = 8192  # samples that are compared at a time
MEASURED = 16  # chunks, evenly along the map, whose energy is measured
CLOSE = 0.01  # a window of fine samples within this of the best is scored exactly, as the best is
UNLIKE = 0.02  # a query whose best cosine is less is scanned: places without a direction have cosine 0
CELL = 3  # places that one of them rules out in an exact search
PAIRS = 2**16  # of a query and a cell that are compared at a time
ROUNDING = 1e-5  # of products of unit vectors in float32


class Plan(NamedTuple):
    """How a map is sampled.

    coarse, fine: places from one sample to the next. refined: best coarse samples around which fine ones are
    compared. held: share of the lines' energy in the coarse samples. bytes: of all samples.
    """

    coarse: int
    fine: int
    refined: int
    held: float
    bytes: int

    def __str__(self) -> str:
        kind = "8-bit" if has_int8_products() else "16-bit"
        return (
            f"{kind} samples every {self.coarse} places hold {self.held:.1%} of the lines' energy, the best "
            f"{self.refined} are refined every {self.fine}; {self.bytes / 1e6:.1f} MB in memory"
        )


def plan(route: PlaceMap, limit: int = MEMORY) -> Plan | None:
    """The widest spacings at which samples hold enough of a map; None for what is scanned: a map of another
    kind or metric, a short one, or one whose lines are not low.

    Args:
        limit: bytes. Samples that do not fit are taken further apart, and more of them refined.

    Raises:
        InputError: a limit below the samples of a single chunk.
    """
    if not isinstance(route, SpectralMap) or route.metric != "cosine" or not route.chunks:
        return None

    def size(places: int, *spacings: int) -> int:
        return sum(-(-places // d) * (route.dimension + 4) for d in spacings)

    least = size(max(stop - start for start, stop in route.chunks), SPACINGS[0], SPACINGS[1])
    if limit < least:
        raise InputError(
            f"the limit of the search's memory is {limit} bytes; expected at least {least}, for a chunk"
        )
    if route.places < FEWEST:
        return None
    held = energy_held(route)
    widest = next((d for d in SPACINGS if held[d] >= COARSE), 0)
    for coarse in [d for d in SPACINGS[::-1] if d >= max(4, widest)] if widest else ():
        fine = next(d for d in SPACINGS if 2 * d <= coarse and (held[d] >= FINE or d == 2))
        found = size(route.places, coarse, fine)
        if found <= limit:
            return Plan(coarse, fine, REFINED * (1 if coarse == widest else 4), held[coarse], found)
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


def coarse_search(route: PlaceMap, limit: int = MEMORY) -> CoarseSearch | None:
    """A search by samples of a map; None for what is scanned, see `plan`."""
    chosen = plan(route, limit)
    return CoarseSearch(route, chosen) if isinstance(route, SpectralMap) and chosen is not None else None


class CoarseSearch:
    """Finds the best places of queries: coarse samples choose regions, fine ones windows, which are scored.

    Args:
        route: the map; it is not changed.
        chosen: see `plan`.

    Shape: queries (Q,K), wanted -> scores and places (Q,m), by place, +inf for none; see `Wanted`.

    Convention: on the CPU where torch has products of 8-bit integers, coarse samples are compared by these;
        elsewhere in bfloat16. A query of length 0, or one that is like no place, is scanned.
    """

    def __init__(self, route: SpectralMap, chosen: Plan) -> None:
        self.route, self.plan = route, chosen
        self.starts = torch.tensor([start for start, _ in route.chunks], device=route.norms.device)
        rows, self.place = samples(route, chosen.coarse)
        self.coarse = Products(F.normalize(rows))
        rows, self.fine_place = samples(route, chosen.fine)
        self.rows, self.scale = _int8(F.normalize(rows))
        self.table: tuple[Tensor, Tensor, float, Tensor, Tensor] | None = None  # of an exact search

    @torch.no_grad()
    def __call__(self, queries: Tensor, wanted: Wanted, exact: bool = False) -> Best:
        """Scores and places in which the wanted candidates are.

        Args:
            exact: those of a scan, guaranteed: all places are ruled out but those that are as good as what was
                found. For unit vectors q, s and x, the angle of q and x is at least that of q and s minus that
                of s and x: s is a place among `CELL`, then each place in 8 bits.
        """
        queries = queries.to(torch.promote_types(queries.dtype, torch.float32))
        units = F.normalize(queries.float())
        score, place = self._windows(units, wanted, exact)
        if exact:
            last = [best_candidates(score, *one, place).score[:, -1] for one in wanted]
            score, place = self._below(units, torch.stack(last).amax(0))
        unlike = ~(score.amin(1) < 1 - UNLIKE)
        if unlike.any():
            found = search(self.route, queries[unlike], lowest_needed(wanted, self.route.places))
            width = max(score.shape[1], found[0].shape[1])
            score = F.pad(score, (0, width - score.shape[1]), value=math.inf)
            place = F.pad(place, (0, width - place.shape[1]), value=self.route.places)
            score[unlike], place[unlike] = math.inf, self.route.places
            score[unlike, : found[0].shape[1]], place[unlike, : found[1].shape[1]] = found
            place, order = place.sort(1)
            score = score.gather(1, order)
        return score, place

    @torch.no_grad()
    def approximate(self, queries: Tensor) -> Tensor:
        """Scores of all places, (Q,K) -> (Q,N): around the best places their own, elsewhere that of the coarse
        sample near them."""
        units = F.normalize(queries.float())
        cells = self._cells(self.plan.coarse)
        scores = 1 - torch.cat([*self.coarse(units)], 1).index_select(1, cells)
        score, place = self._windows(units, [(1, 0)])
        return scores.scatter(1, place, torch.where(score.isfinite(), score, scores.gather(1, place)))

    def _cells(self, spacing: int) -> Tensor:
        """The number of the sample that each place is near to, (N,)."""
        cells, first = [], 0
        for start, stop in self.route.chunks:
            at = sample_places(stop - start, spacing, self.route.transform).to(self.starts.device)
            between = (at[1:] + at[:-1]) / 2
            cells.append(torch.bucketize(torch.arange(stop - start, device=at.device), between) + first)
            first += len(at)
        return torch.cat(cells)

    def _windows(self, units: Tensor, wanted: Wanted, exact: bool = False) -> Best:
        """Places around the best fine samples, further apart than any two candidates that are wanted."""
        near, value = self._refined(units)
        width = max(radius for _, radius in wanted) + self.plan.fine + 1
        count = min(max(2, *(k for k, _ in wanted)), near.shape[1])
        windows = best_candidates(-value, count, width, near)
        scored = (windows.score <= windows.score[:, :1] + CLOSE) | exact
        scored[:, : wanted[0][0]] = True
        offsets = torch.arange(-width, width + 1, device=units.device)
        place = (windows.index[:, :, None] + offsets).clamp(0, self.route.places - 1)
        score = torch.full(place.shape, math.inf, device=place.device)
        score[..., width] = 1 + windows.score  # what the sample says
        query, rank = (scored & windows.accepted).nonzero().T
        some = place[query, rank]
        score[query, rank] = self._scores(
            units, query.repeat_interleave(some.shape[1]), some.flatten()
        ).view_as(some)
        place, order = place.flatten(1).sort(1)
        return score.flatten(1).gather(1, order), place

    def _refined(self, units: Tensor) -> tuple[Tensor, Tensor]:
        """Places (Q,m) of fine samples near the best coarse ones, and their products with the queries."""
        best = self.coarse.topk(units, self.plan.refined)
        reach = self.plan.coarse // self.plan.fine // 2 + 1
        centre = torch.searchsorted(self.fine_place, self.place[best])
        at = centre[:, :, None] + torch.arange(-reach, reach + 1, device=centre.device)
        at = at.clamp(0, len(self.rows) - 1).flatten(1)
        products = torch.bmm(self.rows[at].to(units), units[:, :, None])[..., 0]
        return self.fine_place[at], products * self.scale[at]

    def _scores(self, units: Tensor, query: Tensor, place: Tensor) -> Tensor:
        """Scores of pairs of a query and a place, (P,), by the map's own products."""
        score = torch.empty(place.shape, device=place.device)
        chunk = torch.bucketize(place, self.starts, right=True) - 1
        for g in chunk.unique().tolist():
            some = (chunk == g).nonzero()[:, 0]
            own, which = query[some].unique(return_inverse=True)
            for first, scores in self.route.score_blocks(units[own], *self.route.chunks[g]):  # a single block
                score[some] = scores[which, place[some] - first]
        return score

    def _below(self, units: Tensor, score: Tensor) -> Best:
        """All places that score no more than so much, (Q,): as a scan scores them, by place."""
        self.table = self.table or _table(self.route)
        rows, inverse, stored, middle, angles = self.table
        cosine = (1 - score).clamp(-1, 1)
        sine = (1 - cosine.square()).sqrt()
        beside = torch.cat([units, -cosine[:, None], sine[:, None]], 1)
        found = []
        for start in range(0, len(middle), ROWS):
            at = middle[start : start + ROWS]
            # the cosine of query and sample is at least that of the sum of two angles
            samples = torch.cat([rows[at].to(units) * inverse[at, None], angles[start : start + ROWS]], 1)
            query, cell = (beside @ samples.T >= -ROUNDING).nonzero().T
            for some, near in zip(query.split(PAIRS), at[cell].split(PAIRS), strict=True):
                place = (near[:, None] + torch.arange(CELL, device=near.device) - CELL // 2).clamp(
                    0, len(rows) - 1
                )
                products = torch.bmm(rows[place].to(units), units[some, :, None])[..., 0] * inverse[place]
                least = cosine[some] * stored - sine[some] * (1 - stored**2) ** 0.5 - ROUNDING
                pair, which = (products >= least[:, None]).nonzero().T
                found.append(some[pair] * self.route.places + place[pair, which])
        pairs = torch.cat(found).unique()
        query, place = pairs // self.route.places, pairs % self.route.places
        scores = self._scores(units, query, place)
        kept = scores <= score[query] + ROUNDING
        return _padded(query[kept], place[kept], scores[kept], len(units), self.route.places)


def _table(route: SpectralMap) -> tuple[Tensor, Tensor, float, Tensor, Tensor]:
    """What rules places out: all of them in 8 bits, and the angles by which these and their neighbours differ.

    Returns:
        rows: (N,K) int8 of each place. inverse: (N,) of their lengths. stored: the least cosine of a place with
        its row. middle: (C,) a place of every `CELL`. angles: (C,2), cosine and sine of the largest angle of its
        row with the places of the cell.
    """
    rows, inverse, middle, angles, stored = [], [], [], [], 1.0
    for chunk, (start, stop) in enumerate(route.chunks):
        units = F.normalize(route.decode(chunk))
        whole, _ = _int8(units)
        length = torch.linalg.vector_norm(whole.float(), dim=1).clamp(min=1)
        directions, there = whole / length[:, None], route.norms[start:stop] > 0  # else the score is 1
        near = torch.arange(stop - start, device=units.device)
        centre = (near // CELL * CELL + CELL // 2).clamp(max=stop - start - 1)
        cosine = (directions[centre] * units).sum(1).where(there, 1).clamp(-1, 1)
        least = cosine.new_ones(-(-len(near) // CELL)).scatter_reduce(0, near // CELL, cosine, "amin")
        stored = min(stored, float((directions * units).sum(1).where(there, 1).amin()))
        rows.append(whole)
        inverse.append(1 / length)
        middle.append(centre[::CELL] + start)
        angles.append(torch.stack([least, (1 - least.square()).sqrt()], 1))
    return torch.cat(rows), torch.cat(inverse), stored, torch.cat(middle), torch.cat(angles)


def samples(route: SpectralMap, spacing: int) -> tuple[Tensor, Tensor]:
    """Low-passed descriptors at even positions of each chunk, (S,K), and the places nearest to them, (S,)."""
    units, rows, places = torch.eye(route.dimension, device=route.means.device), [], []
    for chunk, (start, stop) in enumerate(route.chunks):
        at = sample_places(stop - start, spacing, route.transform).to(units.device)
        rows.append(route.products(units, range(chunk, chunk + 1), len(at)).T)
        places.append((at.round().long() + start).clamp(max=stop - 1))
    return torch.cat(rows), torch.cat(places)


def sample_places(length: int, spacing: int, transform: str) -> Tensor:
    """Where in a chunk of so many places the samples of its lowest lines lie, (M,) float64."""
    count = math.ceil(length / spacing)
    half = 0.5 if transform == "dct" else 0.0  # of the cosine transform in the middle of a place
    return (torch.arange(count, dtype=torch.float64) + half) * (length / count) - half


class Products:
    """Rows (S,K) of length 1, and their products with queries, a block of rows at a time.

    In integers of 8 bits where torch multiplies these, else in bfloat16, or in float32 on a CPU without it.
    """

    def __init__(self, rows: Tensor) -> None:
        blocks = rows.split(ROWS)
        self.blocks: list[Any]
        self.integers = rows.device.type == "cpu" and has_int8_products()
        if self.integers:
            self.blocks = [_packed(block) for block in blocks]
        else:
            halves = rows.device.type != "cpu" or has_bfloat16_products()
            self.blocks = [block.to(torch.bfloat16 if halves else torch.float32) for block in blocks]

    def __call__(self, queries: Tensor) -> Iterator[Tensor]:
        """Products with queries (Q,K), (Q,n) of each block of n rows."""
        for block in self.blocks:
            if self.integers:
                yield torch.ops.quantized.linear_dynamic(queries, block, True)
            else:
                yield (queries.to(block.dtype) @ block.T).float()

    def topk(self, queries: Tensor, count: int) -> Tensor:
        """Numbers of the rows of the largest products, of each `GROUP` rows one at most: (Q,count)."""
        values, index, start = [], [], 0
        for products in self(queries):
            rows = products.shape[1]
            groups = -(-rows // GROUP)  # rows apart, so that neighbours are in several groups
            products = F.pad(products, (0, groups * GROUP - rows), value=-math.inf)
            best, which = products.unflatten(1, (GROUP, groups)).max(1)
            values.append(best)
            index.append(which * groups + torch.arange(start, start + groups, device=which.device))
            start += rows
        value = torch.cat(values, 1)
        at = value.topk(min(count, value.shape[1]), 1, sorted=False).indices
        return torch.cat(index, 1).gather(1, at).clamp(max=start - 1)


@cache
def has_int8_products() -> bool:
    """Whether torch multiplies 8-bit integers on this CPU."""
    return "x86" in torch.backends.quantized.supported_engines


def has_bfloat16_products() -> bool:
    """Whether this CPU multiplies numbers of 16 bits itself."""
    return bool(torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported())


def _packed(rows: Tensor) -> Any:
    scale = rows.abs().amax(1).double().clamp(min=1e-30) / 127
    zero = torch.zeros(len(rows), dtype=torch.int64)
    return torch.ops.quantized.linear_prepack(torch.quantize_per_channel(rows, scale, zero, 0, torch.qint8))


def _int8(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Rows as integers of 8 bits, and what they are multiplied by: (S,K) -> (S,K), (S,)."""
    scale = rows.abs().amax(1).clamp(min=1e-30) / 127
    return (rows / scale[:, None]).round().to(torch.int8), scale


def _padded(query: Tensor, place: Tensor, score: Tensor, queries: int, places: int) -> Best:
    """What was found, by query and place, as a row for each query; +inf at no place."""
    counts = torch.bincount(query, minlength=queries)
    column = torch.arange(len(query), device=query.device) - (counts.cumsum(0) - counts)[query]
    table = score.new_full((queries, max(1, int(counts.max()))), math.inf)
    where = torch.full_like(table, places, dtype=torch.int64)
    table[query, column], where[query, column] = score, place
    return table, where
