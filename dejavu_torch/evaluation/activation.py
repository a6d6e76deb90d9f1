"""How often single layers, and all layers fused, are right (figure 17 of the paper)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.ground_truth import GroundTruth, scored_and_right
from dejavu_torch.maps.template_map import TemplateMap
from dejavu_torch.types import FrequencyLayer

BLOCK_DISTANCES = 2**22  # of Q x P, computed at a time


class Rate(NamedTuple):
    """Share of right answers among queries inside and outside a chunk (None without any), and by chance."""

    inside: float | None
    outside: float | None
    chance: float

    def describe(self) -> str:
        """In words, such as "right 91 %, by chance 6 %"."""
        here = "" if self.inside is None else f"{self.inside:.0%}"
        elsewhere = "" if self.outside is None else f"{self.outside:.0%} elsewhere"
        between = " here, " if here and elsewhere else ""
        chance = f"{self.chance:.{int(self.chance < 0.01)}%}"
        return f"right {here}{between}{elsewhere}, by chance {chance}".replace("%", " %")


def activation_rates(
    place_map: TemplateMap,
    chosen: list[int],
    queries: Tensor,
    index: Tensor,
    truth: GroundTruth,
    tolerance: int,
) -> list[Rate]:
    """How often each of the chosen layers of one chunk answers in phase, followed by the rate of the map.

    A query is *inside* if one of its right places lies in the chunk, *outside* if all of them lie elsewhere.

    A layer is right if its best phase (argmin over k of eq. 3) is within the tolerance of the phase of a
    right place (`in_phase`): inside, of one in the chunk; outside, of any, as if the layer continued. A rate
    near chance there means that the period ends, or slips, at the end of the chunk. Chance is the share of
    phases within the tolerance of any one: (2 * tolerance + 1) / period if phases = period.

    The map is right if the reported place is within the tolerance of a right one; outside, the layers of
    other chunks answer. Chance is (2 * tolerance + 1) / places.

    Shape: queries (Q,D), index (Q,) the places reported for them.
    """
    start, stop = place_map.plan[chosen[0]].start, place_map.plan[chosen[0]].stop
    right = torch.where(truth.judged[:, None], truth.positives, -1)
    here = torch.where((right >= start) & (right < stop), right, -1)
    inside = (here >= 0).any(1)
    outside = (right >= 0).any(1) & ~inside
    rates = []
    for j in chosen:
        layer, best = place_map.plan[j], best_phases(place_map, queries, j)
        near, far = (in_phase(layer, best, which, tolerance) for which in (here, right))
        chance = (2 * _phases_within(layer, tolerance) + 1) / layer.phases
        rates.append(Rate(share(near, inside), share(far, outside), min(1.0, chance)))
    judged, found = scored_and_right(index, truth, tolerance)
    shares = share(found, inside & judged), share(found, outside & judged)
    return [*rates, Rate(*shares, min(1.0, (2 * tolerance + 1) / place_map.places))]


def best_phases(place_map: TemplateMap, queries: Tensor, j: int) -> Tensor:
    """The phase of one layer that is nearest to each query, among the phases of its chunk: (Q,D) -> (Q,)."""
    layer = place_map.plan[j]
    present: Tensor = layer.place_phases.unique()
    parts = queries.split(max(1, BLOCK_DISTANCES // max(layer.phases, queries.shape[1])))
    nearest = [layer_distances(place_map, part, j)[:, present].argmin(1) for part in parts]
    return present[torch.cat(nearest)]


def layer_distances(place_map: TemplateMap, queries: Tensor, j: int) -> Tensor:
    """Eq. 3 for one layer of the map, on the CPU: (Q,D) -> (Q,P)."""
    with torch.no_grad():
        (distances,) = place_map.distances(queries.to(place_map.device), [j])
    return distances.cpu()


def in_phase(layer: FrequencyLayer, best: Tensor, places: Tensor, tolerance: int) -> Tensor:
    """Whether the best phase of each query is within the tolerance of the phase of any of these places.

    Shape: best (Q,) int64, places (Q,R) int64 with -1 as padding -> (Q,) bool.

    Convention: the distance of two phases is measured around the cycle, in places. Phases count from absolute
        place 0, so that a place outside the layer's chunk has the phase of a layer that continues.

    Example:
        >>> from fractions import Fraction
        >>> layer = FrequencyLayer(Fraction(10), 10, 0, 40, (0,))
        >>> in_phase(layer, torch.tensor([9, 9]), torch.tensor([[21], [25]]), tolerance=2).tolist()
        [True, False]
    """
    distance = (best[:, None] - layer.phase(places)).abs()
    distance = torch.minimum(distance, layer.phases - distance)
    return ((distance <= _phases_within(layer, tolerance)) & (places >= 0)).any(1)


def _phases_within(layer: FrequencyLayer, tolerance: int) -> int:
    return int(tolerance * layer.phases / layer.period)


def share(right: Tensor, among: Tensor) -> float | None:
    """Share of right answers (Q,) among some of the queries, (Q,) bool; None without any."""
    return float(right[among].double().mean()) if among.any() else None
