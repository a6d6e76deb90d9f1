"""Scores of several queries along trajectories, added up in the layers of a map instead of at its places."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import reduce
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.types import SequenceModel

if TYPE_CHECKING:
    from dejavu_torch.maps.template_map import Segment, TemplateMap


LOOK_UP = 4  # how many scores of neighbouring places are added in the time of one number of a table


class LayerSums:
    """The mean score along trajectories, from sums of phase distances: O(T sum tau) for a query, whatever N.

    A score is a sum over layers of d[phase of i], so that the sum of the scores of place i - s_k, k queries
    back, is the sum over layers of the sums of d_k[phase of i - s_k]. That is a function of i modulo the
    period's numerator, of the phase alone only where there are as many phases: a layer's table is as long as
    its numerator. It holds where all of a trajectory lies between two cuts of the plan; places nearer to a
    cut or to an end of the map take `sequence` of their scores.

    Args:
        route: without a temperature, which does not add up.
        sequence: its `shifts` are the trajectories; not ().

    Attributes:
        worth: whether that is less to add up than the scores of all places. `scores` is for maps where it is.
    """

    def __init__(self, route: TemplateMap, sequence: SequenceModel) -> None:
        self.route, self.sequence, self.shifts = route, sequence, sequence.shifts
        every = [shift for shifts in self.shifts for shift in shifts]
        back, ahead = max(0, *every), max(0, -min(every))  # how far from a place trajectories go
        self.near = list(_near_cuts(route.segments, back + ahead))
        self.sizes = [layer.period.numerator for layer in route.plan]
        near = sum(piece.stop - piece.start for piece in self.near)
        several = len(self.shifts[0]) > 1 and bool(route.plan)
        self.worth = several and LOOK_UP * (sum(self.sizes) + near) < route.places
        if not self.worth:
            return
        device = route.layers.device
        places = torch.cat([torch.arange(piece.start, piece.stop) for piece in self.near])
        cuts = torch.tensor([0, *(segment.stop for segment in route.segments)])
        after = torch.searchsorted(cuts, places, right=True)
        direct = (places - cuts[after - 1] < back) | (cuts[after] - places <= ahead)
        self.to, self.of = places[direct].to(device), direct.nonzero()[:, 0].to(device)
        # of each column of the tables: its layer's first one and size, and where it lies behind the first
        size = torch.tensor(self.sizes)
        self.size = size.repeat_interleave(size).to(device)
        self.start = (size.cumsum(0) - size).repeat_interleave(size).to(device)
        self.residue = torch.arange(len(self.size), device=device) - self.start
        pairs = list(zip(route.plan, self.sizes, strict=True))
        self.phases = [layer.phase(torch.arange(size)).to(device) for layer, size in pairs]
        self.laps = [(torch.arange(size, device=device) + layer.start) % size for layer, size in pairs]

    def scores(self, rows: Sequence[Tensor], ahead: int) -> Tensor:
        """Scores of the last Q queries, from the phase distances of each layer to them and to those ahead.

        Args:
            ahead: rows ahead of the Q queries, at most T - 1.

        Shape: L tensors (ahead + Q,P) -> (Q,N).
        """
        combine, sequence = self.route.combine, self.sequence
        if not all(bool(row.isfinite().all()) for row in rows):  # what is inf is left out of a mean
            scores = combine(rows)
            together: Tensor = sequence(scores[ahead:], scores[:ahead])
            return together
        steps = min(len(self.shifts[0]), len(rows[0]))
        missing = max(0, steps - 1 - ahead)  # rows, ahead of the first query there was
        pairs = zip(rows, self.phases, strict=True)
        table = torch.cat([row.index_select(1, phases) for row, phases in pairs], 1)
        table = F.pad(table, (0, 0, missing, 0))
        first, last = ahead + missing, len(table)
        used = torch.arange(first + 1, last + 1, device=table.device) - missing
        used = used.clamp(max=steps)[:, None]
        ways = []
        for shifts in self.shifts:
            total = torch.zeros_like(table[first:])
            for k, shift in enumerate(shifts[:steps]):
                of = self.start + (self.residue - shift) % self.size
                total = total + table[first - k : last - k].index_select(1, of)
            ways.append(combine((total / used).split(self.sizes, 1), laps=self.laps))
        near = combine(rows, self.near)
        edges = sequence(near[ahead:], near[:ahead])[:, self.of]
        best: Tensor = reduce(torch.minimum, ways)
        return best.index_copy_(1, self.to, edges)


def _near_cuts(segments: Sequence[Segment], reach: int) -> Iterator[Segment]:
    """The stretches of places within `reach` of a cut, in order.

    A trajectory of a place near a cut does not leave them, so that they can be matched side by side.
    """
    for segment in segments:
        start, stop, _ = segment
        if stop - start <= 2 * reach:
            yield segment
        else:
            yield segment._replace(stop=start + reach)
            yield segment._replace(start=stop - reach)
