"""The states of a camera on a map: its places in one or two directions of travel, and being off it."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

Link = tuple[int, int, float]  # a step from one place to another, with its probability


class States(NamedTuple):
    """The states of a route: its N places in D directions of travel, and being off the map.

    A belief is (..., D N + 1): the places in order; with D = 2 the places once more, from the last to the
    first, for the opposite direction; then the off-map state.

    Attributes:
        route_starts: the first place of each route; no move crosses from one route into the next.
        links: further steps, in place of that to the next place; backwards in the opposite direction. Those
            from one place that have more than 1 in all share it.
        turn: probability of turning round in a step, if there are two directions. back: share of what comes
            from elsewhere that travels in the second one.
        share: of the places of a map that these are; the others are off the map.
    """

    places: int
    directions: int = 1
    route_starts: tuple[int, ...] = (0,)
    links: tuple[Link, ...] = ()
    turn: float = 0.0
    share: float = 1.0
    back: float = 0.5

    def of(self, places: Tensor) -> States:
        """The states of some places (n,) in order; moves end at each gap."""
        starts = torch.isin(places, torch.tensor(self.route_starts))
        starts |= F.pad(places[1:] != places[:-1] + 1, (1, 0), value=True)
        at = {place: i for i, place in enumerate(places.tolist())} if self.links else {}
        links = tuple((at[one], at[two], share) for one, two, share in self.links if {one, two} <= at.keys())
        routes, share = tuple(starts.nonzero()[:, 0].tolist()), len(places) / self.places
        return States(len(places), self.directions, routes, links, self.turn, share, self.back)
