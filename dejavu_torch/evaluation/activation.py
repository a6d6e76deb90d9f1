"""How single layers answer, and how often they, and their fusion, are right (figure 17 of the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.ground_truth import GroundTruth, counted, is_right
from dejavu_torch.maps.template_map import TemplateMap
from dejavu_torch.types import FrequencyLayer

DISTANCES_AT_ONCE = 2**22  # numbers of Q x P held at a time


class Rate(NamedTuple):
    """Share of right answers among queries inside and outside a chunk, and by chance.

    None where there are no such queries.
    """

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
    route: TemplateMap,
    chosen: Sequence[int],
    queries: Tensor,
    index: Tensor,
    truth: GroundTruth,
    tolerance: int,
) -> list[Rate]:
    """How often each of some layers of one chunk answers in phase, and, last, how often the map is right.

    A query of known truth is *inside* where one of its right places lies in the chunk, *outside* where it has
    right places but none in the chunk.

    A layer is right where its best phase (argmin over k of eq. 3) is within the tolerance of the phase of a
    right place (`in_phase`): inside, one in the chunk; outside, any, as if the layer went on, so that a rate
    near chance says that its period ends with the chunk, or slips there. Chance is the share of phases within
    the tolerance of any one, (2 * tolerance + 1) / period where phases = period.

    The map is right where the reported place is within the tolerance of a right one; outside, that is the
    work of the layers of other chunks. Chance is (2 * tolerance + 1) / places.

    Shape: queries (Q,D), index (Q,) the places reported for them.
    """
    start, stop = route.plan[chosen[0]].start, route.plan[chosen[0]].stop
    right = torch.where(truth.judged[:, None], truth.positives, -1)
    here = torch.where((right >= start) & (right < stop), right, -1)
    inside = (here >= 0).any(1)
    outside = (right >= 0).any(1) & ~inside
    rates = []
    for j in chosen:
        layer, best = route.plan[j], best_phases(route, queries, j)
        near, far = (in_phase(layer, best, which, tolerance) for which in (here, right))
        chance = (2 * _phases_within(layer, tolerance) + 1) / layer.phases
        rates.append(Rate(_share(near, inside), _share(far, outside), min(1.0, chance)))
    found, judged = is_right(index, right, tolerance), counted(index, truth, tolerance)
    shares = _share(found, inside & judged), _share(found, outside & judged)
    return [*rates, Rate(*shares, min(1.0, (2 * tolerance + 1) / route.places))]


def best_phases(route: TemplateMap, queries: Tensor, j: int) -> Tensor:
    """The phase of one layer, among those its chunk has, nearest to each query: (Q,D) -> (Q,) int64."""
    layer = route.plan[j]
    present: Tensor = layer.place_phases.unique()
    parts = queries.split(max(1, DISTANCES_AT_ONCE // max(layer.phases, queries.shape[1])))
    nearest = [layer_distances(route, part, j)[:, present].argmin(1) for part in parts]
    return present[torch.cat(nearest)]


def layer_distances(route: TemplateMap, queries: Tensor, j: int) -> Tensor:
    """Eq. 3 for one layer of the map, on the CPU: (Q,D) -> (Q,P)."""
    with torch.no_grad():
        (distances,) = route.distances(queries.to(route.templates.device), [j])
    return distances.cpu()


def in_phase(layer: FrequencyLayer, best: Tensor, places: Tensor, tolerance: int) -> Tensor:
    """Whether the best phase of each query is the phase of any of these places, within the tolerance.

    Shape: best (Q,) int64, places (Q,R) int64 with -1 as padding -> (Q,) bool.

    Convention: the distance of two phases is counted around the cycle, in places, and may be at most
        the tolerance. Phases count from absolute place 0, so a place outside the layer's chunk has
        the phase it would have if the layer went on.

    Example:
        >>> from fractions import Fraction
        >>> layer = FrequencyLayer(Fraction(10), 10, 0, 40, (0,))
        >>> in_phase(layer, torch.tensor([9, 9]), torch.tensor([[21], [25]]), tolerance=2).tolist()
        [True, False]
    """
    apart = (best[:, None] - layer.phase(places)).abs()
    apart = torch.minimum(apart, layer.phases - apart)
    return ((apart <= _phases_within(layer, tolerance)) & (places >= 0)).any(1)


def _phases_within(layer: FrequencyLayer, tolerance: int) -> int:
    return int(tolerance * layer.phases / layer.period)


def _share(right: Tensor, among: Tensor) -> float | None:
    return float(right[among].double().mean()) if among.any() else None
