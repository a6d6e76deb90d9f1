"""Coarse-to-fine search for single queries: the low-frequency lines of a spectral map are its index.

The inverse transform of the W / d lowest lines of a chunk of W places gives every d-th place, low-passed.
Only places near the best of these samples are scored. Where memory allows, d is 1: see `RowSearch`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import SpectralMap, scores_of
from dejavu_torch.maps.spectrum import frequencies
from dejavu_torch.recognition.samples import (
    GROUP,
    WIDEST,
    RowSearch,
    Samples,
    has_int8_products,
    replaced,
    to_int8,
    topk_groups,
    units_of,
    width_of,
)
from dejavu_torch.recognition.search import (
    NmsSpec,
    Scan,
    Search,
    TopK,
    check_search,
    empty_topk,
    num_needed,
)
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.types import expect

MIN_PLACES = 20_000  # a map whose places are not all compared is scanned if it is shorter
OVERHEAD = 16  # bytes of a sample besides its descriptor
MEMORY, MEMORY_PER_PLACE = 300_000_000, 100  # default bytes for the samples; the larger one applies
FREE = 2  # on a GPU, samples take at most one in this many of its free bytes
MOST = 2**17  # places that are all compared: each has a share of a number for each query of a batch
COMPARED = 2**24  # numbers of a map whose places are all compared, by products of 8 bits in the cache
COMPARED_IN_FLOAT = 2**21  # without such products
DECODED = 2**24  # numbers of a chunk that are decoded at a time, at most
SPACINGS = (32, 16, 12, 8, 6, 4, 3, 2)  # places from one sample to the next
COARSE, FINE = 0.93, 0.98  # shares of the lines' energy that coarse and fine samples should hold
REFINED = 32  # best groups of a query that are refined; 4 times as many if the samples hold less than COARSE
PEAKS = 4  # of an area, around which more windows are scored, and one for each candidate
EXTRA_WINDOWS = 3  # further windows of a query that are scored if they are nearly as good
NEARLY = 0.02  # difference in cosine that counts as nearly as good
MIN_COSINE = 0.02  # a query whose best cosine is lower is scanned: places of norm 0 have cosine 0
MEASURED_CHUNKS = 16  # evenly along the map, for the energy of the lines


class SamplingPlan(NamedTuple):
    """How a map is sampled."""

    coarse: int  # places from one coarse sample to the next; 1 compares all places, as a `RowSearch`
    fine: int  # 1 holds the descriptors of all places
    refined: int  # best groups of coarse samples, around which fine ones are compared
    held: float  # share of the lines' energy in the coarse samples
    bytes: int  # of all samples

    def __str__(self) -> str:
        size = f"{self.bytes / 1e6:.1f} MB"
        if self.coarse == 1:
            return f"all places are compared in 8 bits, and the best of them scored; {size}"
        return (
            f"samples every {self.coarse} places hold {self.held:.1%} of the lines' energy, the best "
            f"{self.refined} groups of {GROUP} are refined every {self.fine}; {size}"
        )


def plan(place_map: PlaceMap, limit: int | None = None) -> SamplingPlan | None:
    """All places if they fit and are few, or on a GPU; else the widest spacings at which samples hold enough
    energy. None if the map has to be scanned: another kind or metric, mainly high frequencies, or a single
    chunk of more places than fit.

    Args:
        limit: bytes; None is half of what a GPU has free, else 300 MB, or 100 bytes per place if that is
            more. Samples that exceed it get wider spacings, and more of them are refined.

    Raises:
        InputError: the limit is below the samples of a single chunk.
    """
    if not isinstance(place_map, SpectralMap) or place_map.metric != "cosine" or not place_map.chunks:
        return None
    longest, device = max(stop - start for start, stop in place_map.chunks), place_map.device
    width = width_of(place_map)
    if limit is None:
        limit = max(MEMORY, MEMORY_PER_PLACE * place_map.places)
        if device.type == "cuda":
            limit = torch.cuda.mem_get_info(device)[0] // FREE

    def size(places: int, *spacings: int) -> int:
        each = {d: d**place_map.layout.dimensions for d in spacings}
        return sum(-(-places // n) * (width * (2 if d == 1 else 1) + OVERHEAD) for d, n in each.items())

    every = SamplingPlan(1, 1, 0, 1.0, size(place_map.places, 1))
    fits = every.bytes <= limit and longest * width <= DECODED and width <= WIDEST
    most = math.inf if device.type == "cuda" else COMPARED if has_int8_products() else COMPARED_IN_FLOAT
    # places of no frame are not to be found, nor in the way
    seen = fits and not bool(place_map.norms.isinf().any())
    few = device.type == "cuda" or place_map.places <= MOST
    if seen and few and place_map.places * width <= most:
        return every
    if place_map.places < max(MIN_PLACES, 2 * longest) or width > WIDEST:
        return every if seen else None
    minimum = size(longest, SPACINGS[0], SPACINGS[1])
    expect(limit >= minimum, f"at least {minimum}, for a chunk", f"search_memory is {limit} bytes")
    held = explained_variance(place_map)
    widest_coarse = next((d for d in SPACINGS if held[d] >= COARSE), 0)
    widest_fine = next((d for d in SPACINGS if held[d] >= FINE), 2)
    for coarse in [d for d in SPACINGS[::-1] if d >= max(4, widest_coarse)] if widest_coarse else ():
        spacings = [d for d in SPACINGS[::-1] if min(widest_fine, coarse // 2) <= d <= coarse // 2]
        spacings = {1: spacings, 2: []}[place_map.layout.dimensions]
        for fine in [1, *spacings] if fits else spacings:
            if size(place_map.places, coarse, fine) <= limit:
                refined = REFINED * (1 if coarse == widest_coarse else 4)
                return SamplingPlan(coarse, fine, refined, held[coarse], size(place_map.places, coarse, fine))
    return every if seen else None


def explained_variance(place_map: SpectralMap) -> dict[int, float]:
    """The share of the lines' energy that samples at each of `SPACINGS` hold, from some chunks of a map."""
    held, whole = dict.fromkeys(SPACINGS, 0.0), 1e-30
    for chunk in range(0, len(place_map.chunks), max(1, len(place_map.chunks) // MEASURED_CHUNKS)):
        size, (line, _, value) = place_map.size_of(chunk), place_map.lines(chunk)
        energy = value.new_zeros(math.prod(size), dtype=torch.float64)
        energy.index_add_(0, line, value.double().square())
        half_cycles = 2 * frequencies(*size, place_map.transform).to(energy) * energy.new_tensor(size)
        whole += float(energy.sum())
        for d in SPACINGS:
            most = energy.new_tensor([n // d + 0.5 for n in size])
            held[d] += float(energy[(half_cycles <= most).all(1)].sum())
    return {d: energy / whole for d, energy in held.items()}


def searcher(place_map: PlaceMap, method: Search = "auto", memory: int | None = None) -> Scan:
    """The searcher of a map.

    Args:
        method: "auto" and "coarse" are what `plan` says: a `RowSearch`, a `CoarseSearch` or a `Scan`;
            "exact" and "scan" are a `Scan`.
        memory: bytes of the samples, see `plan`.
    """
    check_search(method)
    chosen = plan(place_map, memory) if method in ("auto", "coarse") else None
    if chosen is None or not isinstance(place_map, SpectralMap):
        return Scan(place_map)
    return RowSearch(place_map) if chosen.coarse == 1 else CoarseSearch(place_map, chosen)


class CoarseSearch(Scan):
    """Finds the best places of queries: coarse samples choose regions, fine samples choose windows in them,
    and the places of these windows are scored.

    Args:
        chosen: see `plan`.

    Shape: queries (Q,K), wanted -> scores and places (Q,M), by place, +inf for none.

    Convention: scores are those of a scan, to 1e-5 if the fine samples are all places. A query of norm 0, or
        one that is similar to no place, is scanned.
    """

    place_map: SpectralMap

    def __init__(self, place_map: SpectralMap, chosen: SamplingPlan) -> None:
        super().__init__(place_map)
        self.plan = chosen
        self.fine, self.coarse = Samples(place_map, chosen.fine), Samples(place_map, chosen.coarse)
        self.middle = torch.searchsorted(self.fine.place, self.coarse.place, out_int32=True)

    @torch.no_grad()
    def __call__(self, queries: Tensor, wanted: list[NmsSpec]) -> TopK:
        if not len(queries):
            return empty_topk(queries, max(k for k, _ in wanted))
        units = units_of(self.place_map, queries)
        place = self._windows(units, self.coarse.best_of_groups(to_int8(units)[0]), wanted)
        score = self._scores(units, place)
        far = self._incomplete(score, place, wanted) | ~(score.amin(1) <= 1 - MIN_COSINE)
        rest = far.nonzero()[:, 0]
        if len(rest):
            score, place = replaced((score, place), rest, super().__call__(queries[rest], wanted))
        return score, place

    def _windows(self, units: Tensor, best: Tensor, wanted: list[NmsSpec]) -> Tensor:
        """Places near the best fine samples of each query, (Q,M), by place; -1 for none. A window is wide
        enough for all candidates on one peak."""
        count = max(k for k, _ in wanted)
        groups = topk_groups(best, max(self.plan.refined, 2 * count))
        windows = {1: self._along_route, 2: self._over_area}[self.place_map.layout.dimensions]
        return windows(units, groups, wanted, count)

    def _over_area(self, units: Tensor, groups: TopK, wanted: list[NmsSpec], count: int) -> Tensor:
        (group, best), layout = groups, self.place_map.layout
        best, order = best.sort(1, descending=True)
        middle = self.coarse.place[GROUP * group.gather(1, order) + best % GROUP]
        # further candidates lie around the highest peaks
        peaks, reach = PEAKS + count, self.plan.coarse // 2
        wide = reach + max((k > 1) * radius for k, radius in wanted)
        parts = (middle[:, :peaks], wide), (middle[:, peaks:], reach)
        near = [layout.around(some.flatten(), far).view(*some.shape, -1).flatten(1) for some, far in parts]
        place = torch.cat(near, 1).sort(1).values
        return place.masked_fill(F.pad(place[:, 1:] == place[:, :-1], (0, 1)), -1)

    def _along_route(self, units: Tensor, groups: TopK, wanted: list[NmsSpec], count: int) -> Tensor:
        (group, best), plan, places = groups, self.plan, self.place_map.places
        reach = -(-plan.coarse // (2 * plan.fine))
        offsets = torch.arange(-reach, reach + 1, device=group.device)
        middle = self.middle[GROUP * group + best % GROUP]
        at = (middle[:, :, None] + offsets).clamp(0, len(self.fine.place) - 1).flatten(1)
        cosines = self.fine.cosines(units, at)
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
        if self.fine.finer is not None:
            cosines = self.fine.cosines(units, place.clamp(min=0))
            seen = self.place_map.norms[place].isfinite() & (place >= 0)
            return torch.where(seen, 1 - cosines, math.inf)
        products = self.place_map.products_at(units, place)
        norms = self.place_map.norms[place].masked_fill(place < 0, 1)
        return scores_of(products, norms, norms, "cosine")

    def _incomplete(self, score: Tensor, place: Tensor, wanted: list[NmsSpec]) -> Tensor:
        """Which queries lack some of the wanted candidates, (Q,)."""
        if score.shape[1] < max(k for k, _ in wanted):
            return score.new_ones(len(score), dtype=torch.bool)
        enough = num_needed(wanted, self.place_map.layout) - 1
        if bool((score.isfinite().sum(1) > enough).all()):
            return score.new_zeros(len(score), dtype=torch.bool)
        layout = self.place_map.layout
        last = [best_candidates(score, *spec, place, layout).score[:, -1] for spec in wanted]
        return torch.stack(last).isinf().any(0)
