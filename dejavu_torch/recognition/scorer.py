"""Scores of queries at places, computed where they are read: of a map, of stored frames, and wrapped.

Wrappers are composed from inside out: `Reordered`, `BestOf`, `Earlier`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor
from typing_extensions import Self

from dejavu_torch.maps.distance import Metric, phase_distances
from dejavu_torch.maps.place_map import PlaceMap, ScoreBlocks
from dejavu_torch.places.layout import ROUTE, Layout
from dejavu_torch.places.states import Link
from dejavu_torch.recognition.search import SCORES_AT_ONCE
from dejavu_torch.recognition.taken import ALONE, FAITHFUL, flipped, middle

BLOCK_DISTANCES = 2**22  # of queries x stored frames, computed at a time

Rows = Callable[[Tensor], Tensor]  # scores (B,N) of queries by their numbers (B,)
Null = Callable[..., Tensor]  # as `Rows`, of queries that show no place, for a `seed`


class Scorer(ABC):
    """Scores of Q queries at N places; lower is better. Without gradients, on any device.

    Attributes:
        layout: of the places. descriptors: (Q,K) of the queries, by which they are alike.
        links: steps from one place to another, see `PlaceSmoother`.
        null: as `rows`, of `flipped` queries, for a seed; without it their order alone tells whether they are
            a drive, by at least `least` nats for each query.
        at_once: numbers that are computed together. stored: the places that are stored themselves, (n,), if
            others have the scores of these. uncentred: of the same queries as they are, for ways that do not
            know all of them; None if these are. It belongs to the outermost: wrappers do not pass it on.
    """

    layout: Layout
    descriptors: Tensor
    links: tuple[Link, ...] = ()
    null: Null | None = None
    least: float = 0.0
    at_once: int = SCORES_AT_ONCE
    stored: Tensor | None = None
    uncentred: Scorer | None = None

    def __len__(self) -> int:
        return len(self.descriptors)

    @abstractmethod
    def rows(self, queries: Tensor) -> Tensor:
        """Scores of queries by their numbers, (B,) int64 -> (B,N)."""

    def blocks(self, queries: Tensor) -> ScoreBlocks:
        """The columns of `rows`, block by block."""
        yield 0, self.rows(queries)

    @property
    def width(self) -> int:
        """About how many numbers a query has in a block."""
        return self.layout.places

    def copy_at(self, queries: Tensor, places: Tensor) -> Tensor:
        """Which copy of each query answers at places, (B,), (B,k) -> (B,k)."""
        return torch.zeros_like(places)

    def beside(self, uncentred: Scorer) -> Self:
        """Let it know the scores of its queries as they are; returns itself."""
        self.uncentred = uncentred
        return self

    def parts(self) -> list[Tensor]:
        """The numbers of all queries, as many as are scored together."""
        size = max(1, self.at_once // max(1, self.layout.places))
        return [*torch.arange(len(self)).split(size)]


class OfMap(Scorer):
    """Of a map and descriptors (Q,K)."""

    def __init__(self, place_map: PlaceMap, descriptors: Tensor) -> None:
        self.place_map, self.descriptors = place_map, descriptors
        self.layout, self.links = place_map.layout, place_map.connections
        if (kept := place_map.fidelity) is not None:  # templates repeat along the route
            self.null, self.least = (self._mirrored, 0.0) if kept >= FAITHFUL else (None, ALONE)

    def rows(self, queries: Tensor) -> Tensor:
        return self.place_map.scores(self._asked(queries))

    def blocks(self, queries: Tensor) -> ScoreBlocks:
        return self.place_map.score_blocks(self._asked(queries))

    @property
    def width(self) -> int:
        return self.place_map.block_places

    def _asked(self, queries: Tensor) -> Tensor:
        return self.descriptors[queries.to(self.descriptors.device)].to(self.place_map.device)

    def _mirrored(self, queries: Tensor, seed: int) -> Tensor:
        mean = middle(self.descriptors.sum(0), len(self.descriptors), self.place_map.mean)
        asked = flipped(self.descriptors[queries.to(self.descriptors.device)], seed, mean)
        return self.place_map.scores(asked.to(self.place_map.device))


class OfStored(Scorer):
    """Of stored frames: distances of queries (Q,D) from frames (N,D), of which every k-th is stored in each
    direction; other places have the distance of the nearest stored one."""

    at_once = BLOCK_DISTANCES

    def __init__(
        self, frames: Tensor, queries: Tensor, k: int = 1, metric: Metric = "l1", layout: Layout = ROUTE
    ) -> None:
        self.layout, self.descriptors, self.metric = layout.reaching(len(frames)), queries, metric
        self.links = self.layout.joins
        self.frames, self.nearest = frames, None
        if k > 1:
            self.stored, nearest = self.layout.strided(k)
            self.frames = frames[self.stored.to(frames.device)]
            self.nearest = nearest.to(frames.device)

    def rows(self, queries: Tensor) -> Tensor:
        asked = self.descriptors[queries.to(self.descriptors.device)].to(self.frames.device)
        scores = phase_distances(asked, self.frames, self.metric)
        return scores if self.nearest is None else scores[:, self.nearest]


class OfRows(Scorer):
    """By a function of the numbers of queries."""

    def __init__(
        self, rows: Rows, descriptors: Tensor, layout: Layout, null: Null | None = None, least: float = 0.0
    ) -> None:
        self._rows, self.descriptors, self.layout = rows, descriptors, layout
        self.null, self.least = null, least

    def rows(self, queries: Tensor) -> Tensor:
        return self._rows(queries)


class Wrapped(Scorer):
    """Scores of another scorer, changed by `changed`."""

    def __init__(self, scorer: Scorer) -> None:
        self.scorer, self.layout, self.descriptors = scorer, scorer.layout, scorer.descriptors
        self.links, self.least, self.at_once = scorer.links, scorer.least, scorer.at_once
        self.stored = scorer.stored
        if (null := scorer.null) is not None:
            self.null = lambda queries, seed: self.changed(null(self.asked(queries), seed=seed), queries)

    def changed(self, scores: Tensor, queries: Tensor) -> Tensor:
        """What becomes of the scores of queries (B,)."""
        return scores

    def asked(self, queries: Tensor) -> Tensor:
        """The numbers of queries in the other scorer."""
        return queries

    def rows(self, queries: Tensor) -> Tensor:
        return self.changed(self.scorer.rows(self.asked(queries)), queries)

    def copy_at(self, queries: Tensor, places: Tensor) -> Tensor:
        return self.scorer.copy_at(self.asked(queries), places)


class Reordered(Wrapped):
    """Scores of a map whose places are the frames `order` (N,), frame by frame. Of a shuffled map, a control,
    nothing is asked first: its order is lost."""

    def __init__(self, scorer: Scorer, order: Tensor) -> None:
        super().__init__(scorer)
        self.place, self.null, self.least = order.argsort(), None, 0.0
        self.stored = None if scorer.stored is None else order[scorer.stored.to(order.device)]

    def changed(self, scores: Tensor, queries: Tensor) -> Tensor:
        return scores[:, self.place.to(scores.device)]

    def copy_at(self, queries: Tensor, places: Tensor) -> Tensor:
        return self.scorer.copy_at(queries, self.place.to(places.device)[places.clamp(min=0)])


class Earlier(Wrapped):
    """Queries are the places themselves: only those over `apart` before a query answer; blank ones find
    nothing."""

    def __init__(self, scorer: Scorer, apart: int) -> None:
        super().__init__(scorer)
        self.apart, self.null, self.least = apart, None, 0.0

    def changed(self, scores: Tensor, queries: Tensor) -> Tensor:
        blank = ~self.descriptors[queries.to(self.descriptors.device)].any(1, keepdim=True)
        return earlier(scores, queries, self.apart).masked_fill(blank.to(scores.device), math.inf)


class BestOf(Wrapped):
    """Each query is so many consecutive ones of another scorer, such as its turned copies: a place has the
    best score of them."""

    def __init__(self, scorer: Scorer, copies: int) -> None:
        self.copies = copies
        super().__init__(scorer)
        self.descriptors, self.at_once = scorer.descriptors[::copies], scorer.at_once // copies

    def asked(self, queries: Tensor) -> Tensor:
        return (queries[:, None] * self.copies + torch.arange(self.copies)).flatten()

    def changed(self, scores: Tensor, queries: Tensor) -> Tensor:
        return scores.view(-1, self.copies, scores.shape[1]).amin(1)

    def copy_at(self, queries: Tensor, places: Tensor) -> Tensor:
        scores = self.scorer.rows(self.asked(queries)).cpu().view(-1, self.copies, self.layout.places)
        at = places.clamp(min=0)[:, None].expand(-1, self.copies, -1)
        return scores.gather(2, at).argmin(1)


def earlier(scores: Tensor, numbers: Tensor, apart: int) -> Tensor:
    """Scores (B,N) of the places `numbers` (B,) as queries, infinite but for those over `apart` before."""
    place = torch.arange(scores.shape[1], device=scores.device)
    return scores.masked_fill(place >= (numbers[:, None] - apart).to(scores.device), math.inf)


def of_stored(scores: Tensor, stored: Tensor) -> Tensor:
    """Scores (B,N), +inf but at the places that are stored, (n,)."""
    between = torch.ones(scores.shape[1], dtype=torch.bool).index_fill(0, stored, False)
    return scores.masked_fill(between.to(scores.device), math.inf)
