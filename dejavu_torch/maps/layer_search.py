"""The best place on a template map without the scores of all places."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from dejavu_torch.maps.template_map import Segment, TemplateMap

LOOK_UP = 8  # how many places are scored in the time that one phase of two layers takes
FIXED = 2**15  # and in that of a search of any size
AT_ONCE = 2**22  # numbers of all layers' distances that are searched at a time
AHEAD = 2**12  # places that are looked at together for the first of equal ones


class Pair(NamedTuple):
    """Two layers that together cover places [start, stop), and what of their phases meets at which place.

    Place start + r + j * outer has residue r of the longer period, `outer`; as j counts up, its residue of
    the shorter one, `inner`, goes around one of gcd(outer, inner) circles.

    long, short: the layers, by their positions in the plan.
    circles: (inner,) the residues of the shorter period in the order of their circles.
    at: (outer,) where in `circles` the first place of each r stands.
    """

    segment: Segment
    long: int
    short: int
    outer: int
    inner: int
    circles: Tensor
    at: Tensor


class LayerSearch:
    """The lowest score and the first place that has it, as a scan of all scores finds them, bit for bit.

    A score is a sum over layers of d[i mod tau]. Of one layer, and of any layers behind the least common
    multiple of their periods, places only repeat. Two layers are searched in O(tau1 + tau2) whatever the
    number of places: of the places r, r + tau1, r + 2 tau1, .. the first layer knows one distance, and the
    lowest of the second is that of a window that slides along a circle of its phases. Rounded sums are equal
    more often than their terms, so that the first of equal scores is looked up among the r that reach it.

    Args:
        route: a map with layers.

    Attributes:
        worth: whether that is less work than the scores of all places. `lowest` is for maps where it is.
    """

    def __init__(self, route: TemplateMap) -> None:
        self.route, self.device = route, route.layers.device
        self.scanned: list[Segment] = []
        self.paired: list[Segment] = []
        self.sizes = [layer.period.numerator for layer in route.plan]
        work = FIXED
        for segment in route.segments:
            sizes = [self.sizes[j] for j in segment.layers]
            length = min(segment.stop - segment.start, math.lcm(*sizes))  # without layers a place
            segment = segment._replace(stop=segment.start + length)
            phases = LOOK_UP * sum(sizes)
            if len(sizes) == 2 and phases < length:
                self.paired.append(segment)
                work += phases
            else:
                self.scanned.append(segment)
                work += length
        self.worth = bool(route.plan) and work < route.places

    @cached_property
    def pairs(self) -> list[Pair]:
        """The segments of two layers that are worth a search."""
        return [_pair(segment, self.sizes, self.device) for segment in self.paired]

    @cached_property
    def places(self) -> Tensor:
        """The places of all other segments until they repeat, int64."""
        stretches = [torch.arange(start, stop) for start, stop, _ in self.scanned]
        return torch.cat(stretches).to(self.device) if stretches else torch.arange(0)

    @cached_property
    def at_once(self) -> int:
        """Queries that are searched together."""
        numbers = sum(self.sizes[j] for pair in self.paired for j in pair.layers) + len(self.places)
        return max(1, AT_ONCE // max(1, numbers))

    def lowest(self, rows: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """The lowest score and its place, from the phase distances of each layer.

        Shape: L tensors (Q,P) -> (Q,), (Q,) int64, -1 where no place has a finite score.
        """
        found = [self._of_pair(pair, rows) for pair in self.pairs]
        if self.scanned:
            score, index = self.route.combine(rows, self.scanned).min(1)
            found.append((score, self.places[index]))
        scores, places = (torch.stack(column, 1) for column in zip(*found, strict=True))
        score = scores.amin(1)
        place = places.masked_fill(scores != score[:, None], self.route.places).amin(1)
        return score, torch.where(score.isfinite(), place, -1)

    def _of_pair(self, pair: Pair, rows: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """The lowest score in a segment of two layers and the first place that has it."""
        start, stop, members = pair.segment
        along = {
            j: self.route.along(rows[j], j, start, start + size)
            for j, size in ((pair.long, pair.outer), (pair.short, pair.inner))
        }
        times, more = divmod(stop - start, pair.outer)  # the first `more` r have a place more
        circles = along[pair.short].index_select(1, pair.circles).unflatten(1, (-1, _around(pair)))
        low = sliding_minimum(circles, times).flatten(1).index_select(1, pair.at)
        last = (torch.arange(more, device=self.device) + times * pair.outer) % pair.inner
        low[:, :more] = torch.minimum(low[:, :more], along[pair.short].index_select(1, last))
        lowest = {pair.long: along[pair.long], pair.short: low}
        scores = self.route.added(members, [lowest[j] for j in members])
        best = scores.amin(1)
        reached = (scores == best[:, None]) & best.isfinite()[:, None]
        return best, start + self._first(pair, along, best, reached)

    def _first(self, pair: Pair, along: dict[int, Tensor], best: Tensor, reached: Tensor) -> Tensor:
        """How many places behind the segment's first one a score is `best` first.

        Args:
            reached: (Q,outer) the r that have such a place.
        """
        start, stop, members = pair.segment
        none = self.route.places
        first = torch.full_like(best, none, dtype=torch.int64)
        query, r = reached.nonzero(as_tuple=True)
        step, last = 0, -(-(stop - start) // pair.outer)
        while len(query):
            steps = torch.arange(step, min(last, step + max(1, AHEAD // len(query))), device=self.device)
            place = r[:, None] + steps * pair.outer
            own = {
                pair.long: along[pair.long][query, r][:, None].expand(place.shape),
                pair.short: along[pair.short][query[:, None], place % pair.inner],
            }
            hit = self.route.added(members, [own[j] for j in members]) == best[query, None]
            place = place.masked_fill(~hit | (place >= stop - start), none).amin(1)
            first.scatter_reduce_(0, query, place, "amin")
            left = first[query] == none
            query, r, step = query[left], r[left], step + len(steps)
        return first


def sliding_minimum(values: Tensor, width: int) -> Tensor:
    """The lowest of each value and the width - 1 behind it, around the circle of the last dimension.

    In O(n) whatever the width: every window is the end of one stretch of `width` values and the beginning of
    the next, whose running minima are made once.

    Args:
        width: from 1 to n.

    Shape: (...,n) -> (...,n).

    Source: M. van Herk, A fast algorithm for local minimum and maximum filters on rectangular and octagonal
        kernels, Pattern Recognition Letters 13 (1992).

    Example:
        >>> sliding_minimum(torch.tensor([3, 1, 4, 2, 5]), 2)
        tensor([1, 1, 2, 2, 3])
    """
    size = values.shape[-1]
    behind = -(size + width - 1) % width  # of the last whole stretch
    stretches = torch.cat([values, values[..., : width - 1], values[..., :behind]], -1)
    stretches = stretches.unflatten(-1, (-1, width))
    begun = stretches.cummin(-1).values.flatten(-2)
    ended = stretches.flip(-1).cummin(-1).values.flip(-1).flatten(-2)
    return torch.minimum(ended[..., :size], begun[..., width - 1 : width - 1 + size])


def _around(pair: Pair) -> int:
    """Places of one r until the shorter period's residues repeat."""
    return pair.inner // math.gcd(pair.outer, pair.inner)


def _pair(segment: Segment, sizes: Sequence[int], device: torch.device) -> Pair:
    short, long = sorted(segment.layers, key=lambda j: sizes[j])
    outer, inner = sizes[long], sizes[short]
    circles = math.gcd(outer, inner)
    first, step = torch.arange(circles, device=device), torch.arange(inner // circles, device=device)
    order = ((first[:, None] + step * outer) % inner).flatten()
    where = torch.empty_like(order)
    where[order] = torch.arange(inner, device=device)
    at = where[torch.arange(outer, device=device) % inner]
    return Pair(segment, long, short, outer, inner, order, at)
