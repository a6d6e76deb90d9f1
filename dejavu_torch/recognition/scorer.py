"""Scores of queries at places, computed where they are read: of a map, of stored frames, and wrapped.

Wrappers are composed from inside out: `Reordered`, `BestOf`, `Earlier`, `Cached`.
"""

from __future__ import annotations

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import Self

from dejavu_torch.maps.distance import Metric, phase_distances
from dejavu_torch.maps.place_map import PlaceMap, ScoreBlocks
from dejavu_torch.places.layout import ROUTE, Layout
from dejavu_torch.places.states import Link
from dejavu_torch.recognition.evidence import standing
from dejavu_torch.recognition.samples import GROUP, RowSearch
from dejavu_torch.recognition.search import SCORES_AT_ONCE, NmsSpec, Scan, Searcher, num_needed
from dejavu_torch.recognition.taken import ALONE, FAITHFUL, flipped, middle

BLOCK_DISTANCES = 2**22  # of queries x stored frames, computed at a time
ROWS = 4096  # descriptors on the device at a time
SHORT = 2**15  # places of which all scores are kept: selecting the lowest of so few takes longer
MAX_SHARE = 1 / 16  # of a block's places; selecting more of the lowest scores is slower than keeping all
PLACES_PER_NUMBER = 64  # a coarse search holds at most one number of a query per this many places
PER_BEST = 16  # held for each of a query's lowest scores, while two lists are merged

Rows = Callable[[Tensor], Tensor]  # scores (B,N) of queries by their numbers (B,)
Wanted = Sequence[NmsSpec]
Lowest = tuple[Tensor, Tensor | None]  # scores (B,n) and their places; None are all places in order


# sums (B,K) and counts (B,1) of the queries that each is mirrored about
SoFar = tuple[Tensor, Tensor]


class Null(Protocol):
    """As `Rows`, of queries that are `flipped`, for a seed, about those so far, or about all."""

    def __call__(self, queries: Tensor, seed: int = 0, so_far: SoFar | None = None) -> Tensor: ...


class Scorer(ABC):
    """Scores of Q queries at N places; lower is better. Without gradients, on any device.

    Attributes:
        layout: of the places. descriptors: (Q,K) of the queries, by which they are alike.
        links: steps from one place to another, see `PlaceSmoother`.
        null: as `rows`, of `flipped` queries, for a seed; without it their order alone tells whether they are
            a drive, by at least `least` nats for each query.
        at_once: numbers that are computed together, of `most` queries. stored: the places that are stored
            themselves, (n,), if others have the scores of these. blank_finds: whether a blank query may find
            a place by itself. checks: whether a drive only lowers the probabilities of single queries.
            copies: of each query, see `BestOf`. unit: about the mean score, the unit of penalties.
        uncentred: of the same queries as they are, for ways that do not know all of them; None if these are.
            It belongs to the outermost: wrappers do not pass it on.
    """

    layout: Layout
    descriptors: Tensor
    links: tuple[Link, ...] = ()
    null: Null | None = None
    least: float = 0.0
    at_once: int = SCORES_AT_ONCE
    most: int = sys.maxsize
    stored: Tensor | None = None
    blank_finds: bool = True
    checks: bool = False
    copies: int = 1
    unit: float = 1.0
    uncentred: Scorer | None = None

    def __len__(self) -> int:
        return len(self.descriptors)

    @abstractmethod
    def rows(self, queries: Tensor) -> Tensor:
        """Scores of queries by their numbers, (B,) int64 -> (B,N)."""

    def at(self, queries: Tensor, places: Tensor) -> Tensor:
        """Scores of queries at some places of each, (B,), (B,k) -> (B,k)."""
        scores = self.rows(queries)
        return scores.gather(1, places.to(scores.device))

    def blocks(self, queries: Tensor) -> ScoreBlocks:
        """The columns of `rows`, block by block."""
        yield 0, self.rows(queries)

    def best(self, queries: Tensor, wanted: Wanted) -> Lowest:
        """Scores that include those of the `wanted` candidates. Places that are not stored are none: each
        would be the same stored one again."""
        scores = self.rows(queries)
        return scores if self.stored is None else of_stored(scores, self.stored), None

    @property
    def width(self) -> int:
        """About how many numbers a query has in a block."""
        return self.layout.places

    def held(self, wanted: Wanted) -> int:
        """How many numbers of a query are in memory, all its scores or what finds the `wanted` ones."""
        return self.layout.places

    def told(self, queries: Tensor, places: Tensor) -> dict[str, Tensor]:
        """What copies of queries tell of them at places, (B,), (B,k) -> (B,k), by the columns of `Match`."""
        return {}

    def beside(self, uncentred: Scorer) -> Self:
        """Let it know the scores of its queries as they are; returns itself."""
        self.uncentred = uncentred
        return self

    def mirrored(self, queries: Tensor, seed: int = 0, so_far: SoFar | None = None) -> Tensor:
        """What `null` gives, if that is not None."""
        assert self.null is not None
        return self.null(queries, seed=seed) if so_far is None else self.null(queries, seed, so_far)

    def parts(self, wanted: Wanted = ()) -> list[Tensor]:
        """The numbers of all queries, as many as are scored, or searched for `wanted` ones, together."""
        size = max(1, min(self.most, self.at_once // max(1, self.held(wanted))))
        return [*torch.arange(len(self)).split(size)]


class OfMap(Scorer):
    """Of a map and descriptors (Q,K); `searcher` finds the best places, by default a `Scan`."""

    most = ROWS

    def __init__(self, place_map: PlaceMap, descriptors: Tensor, searcher: Searcher | None = None) -> None:
        self.place_map, self.descriptors = place_map, descriptors
        self.layout, self.links = place_map.layout, place_map.connections
        self.searcher = Scan(place_map) if searcher is None else searcher
        self.blank_finds = getattr(place_map, "metric", "") != "cosine"

    @cached_property
    def unit(self) -> float:  # type: ignore[override]
        """1 for cosines; for distances that between two places at random, about twice that from the mean."""
        if getattr(self.place_map, "metric", "") == "cosine":
            return 1.0
        scores = self.place_map.scores(self.place_map.mean[None])
        return 2 * float(scores[scores.isfinite()].mean().nan_to_num(0.5))

    @cached_property
    def fidelity(self) -> float | None:
        """That of the map; None of templates, which repeat along the route."""
        return self.place_map.fidelity

    @property
    def null(self) -> Null | None:  # type: ignore[override]
        return self.mirrored if self.fidelity is not None and self.fidelity >= FAITHFUL else None

    @property
    def least(self) -> float:  # type: ignore[override]
        return ALONE if self.fidelity is not None and self.fidelity < FAITHFUL else 0.0

    def best(self, queries: Tensor, wanted: Wanted) -> Lowest:
        found = self._searches(wanted)
        return self.searcher(self._asked(queries), [*wanted]) if found else super().best(queries, wanted)

    def held(self, wanted: Wanted) -> int:
        if not wanted or not self._searches(wanted):
            return self.layout.places
        per_number = GROUP if isinstance(self.searcher, RowSearch) else PLACES_PER_NUMBER
        return max(PER_BEST * num_needed([*wanted], self.layout), self.layout.places // per_number)

    def _searches(self, wanted: Wanted) -> bool:
        """Whether to search for the best places is faster than to look through all scores."""
        places, n = self.layout.places, num_needed([*wanted], self.layout)
        few = n <= max(1, MAX_SHARE * min(places, self.place_map.block_places)) or places > SCORES_AT_ONCE
        return type(self.searcher) is not Scan or (few and places > SHORT)

    def rows(self, queries: Tensor) -> Tensor:
        return self.place_map.scores(self._asked(queries))

    def at(self, queries: Tensor, places: Tensor) -> Tensor:
        return self.place_map.scores_at(self._asked(queries), places.to(self.place_map.device))

    def blocks(self, queries: Tensor) -> ScoreBlocks:
        return self.place_map.score_blocks(self._asked(queries))

    @property
    def width(self) -> int:
        return self.place_map.block_places

    def _asked(self, queries: Tensor) -> Tensor:
        return self.descriptors[queries.to(self.descriptors.device)].to(self.place_map.device)

    def mirrored(self, queries: Tensor, seed: int = 0, so_far: SoFar | None = None) -> Tensor:
        total, count = so_far or (self.descriptors.sum(0), len(self.descriptors))
        asked = self.descriptors[queries.to(self.descriptors.device)]
        asked = flipped(asked, seed, middle(total, count, self.place_map.mean))
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

    @cached_property
    def unit(self) -> float:  # type: ignore[override]
        scores = phase_distances(self.frames[:8], self.frames, self.metric)
        return 1.0 if self.metric == "cosine" else float(scores.mean())

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
        self.links, self.at_once, self.most = scorer.links, scorer.at_once, scorer.most
        self.stored, self.blank_finds = scorer.stored, scorer.blank_finds
        self.checks, self.copies = scorer.checks, scorer.copies

    @property
    def null(self) -> Null | None:  # type: ignore[override]
        return None if self.scorer.null is None else self.mirrored

    def mirrored(self, queries: Tensor, seed: int = 0, so_far: SoFar | None = None) -> Tensor:
        so = {} if so_far is None else {"so_far": so_far}
        return self.changed(self.scorer.mirrored(self.asked(queries), seed=seed, **so), queries)

    @property
    def least(self) -> float:  # type: ignore[override]
        return self.scorer.least

    @property
    def unit(self) -> float:  # type: ignore[override]
        return self.scorer.unit

    def changed(self, scores: Tensor, queries: Tensor) -> Tensor:
        """What becomes of the scores of queries (B,)."""
        return scores

    def asked(self, queries: Tensor) -> Tensor:
        """The numbers of queries in the other scorer."""
        return queries

    def rows(self, queries: Tensor) -> Tensor:
        return self.changed(self.scorer.rows(self.asked(queries)), queries)

    def told(self, queries: Tensor, places: Tensor) -> dict[str, Tensor]:
        return self.scorer.told(self.asked(queries), places)


class Reordered(Wrapped):
    """Scores of a map whose places are the frames `order` (N,), frame by frame. Of a shuffled map, a control,
    nothing is asked first: its order is lost."""

    null, least = None, 0.0

    def __init__(self, scorer: Scorer, order: Tensor) -> None:
        super().__init__(scorer)
        self.place = order.argsort()
        self.stored = None if scorer.stored is None else order[scorer.stored.to(order.device)]

    def changed(self, scores: Tensor, queries: Tensor) -> Tensor:
        return scores[:, self.place.to(scores.device)]

    def at(self, queries: Tensor, places: Tensor) -> Tensor:
        return self.scorer.at(queries, self.place.to(places.device)[places])

    def told(self, queries: Tensor, places: Tensor) -> dict[str, Tensor]:
        return self.scorer.told(queries, self.place.to(places.device)[places.clamp(min=0)])


class Earlier(Wrapped):
    """Queries are the places themselves, from `first` on, or so many copies of each: only places over `apart`
    before one answer, where frames between which nothing moved count as one; blank ones find nothing. Where
    ground repeats, as lane dashes do, a drive alone finds loops that are none."""

    null, least = None, 0.0

    def __init__(self, scorer: Scorer, apart: int, first: int = 0, copies: int = 1) -> None:
        super().__init__(scorer)
        self.apart, self.first, self.each, self.checks = apart, first, copies, True
        places = self.descriptors[::copies]
        whole = len(places) == scorer.layout.places  # of a part, what lies before is unknown
        waits = standing(places) & places.any(1).cpu()  # in the dark a camera may move
        self.passed = (~waits).cumsum(0) if whole else torch.arange(scorer.layout.places)

    def changed(self, scores: Tensor, queries: Tensor) -> Tensor:
        blank = ~self.descriptors[queries.to(self.descriptors.device)].any(1, keepdim=True)
        passed, own = self.passed.to(scores.device), self.first + queries // self.each
        closed = passed >= passed[own.to(scores.device), None] - self.apart
        return scores.masked_fill(closed | blank.to(scores.device), math.inf)


class BestOf(Wrapped):
    """Each query is so many consecutive ones of another scorer, its copies: a place has the best score of
    them.

    Args:
        penalties: added to the scores of each copy in units of these, (V,), +inf for one that never answers;
            none by default. before: those of the first `first` queries.
    """

    def __init__(
        self,
        scorer: Scorer,
        copies: int,
        penalties: Tensor | None = None,
        before: Tensor | None = None,
        first: int = 0,
    ) -> None:
        super().__init__(scorer)
        self.copies, self.descriptors, self.first = copies, scorer.descriptors[::copies], first
        after = torch.zeros(copies) if penalties is None else penalties
        known = torch.stack([after, after if before is None else before])
        self.kept = known.isfinite().any(0).nonzero()[:, 0]  # the copies that answer
        self.penalties = known[:, self.kept]
        self.at_once = scorer.at_once // len(self.kept)
        self.most = max(1, scorer.most // len(self.kept))

    def asked(self, queries: Tensor) -> Tensor:
        return (queries[:, None] * self.copies + self.kept).flatten()

    def held(self, wanted: Wanted) -> int:
        return self.scorer.held(wanted)

    def mirrored(self, queries: Tensor, seed: int = 0, so_far: SoFar | None = None) -> Tensor:
        if so_far is not None:
            total, count = (one.repeat_interleave(len(self.kept), 0) for one in so_far)
            so_far = total, count
        return super().mirrored(queries, seed, so_far)

    def changed(self, scores: Tensor, queries: Tensor) -> Tensor:
        return self._each(scores, queries).amin(1)

    def best(self, queries: Tensor, wanted: Wanted) -> Lowest:
        scores, places = self.scorer.best(self.asked(queries), wanted)
        if places is None:
            return self.changed(scores, queries), None
        # the best of all copies are among the best of each
        return self._each(scores, queries).flatten(1), places.view(len(queries), -1)

    def copy_at(self, queries: Tensor, places: Tensor) -> Tensor:
        """Which copy of each query answers at places, (B,), (B,k) -> (B,k)."""
        places = places.clamp(min=0).repeat_interleave(len(self.kept), 0)
        scores = self._each(self.scorer.at(self.asked(queries), places), queries)
        return self.kept[scores.argmin(1).cpu()]

    def _each(self, scores: Tensor, queries: Tensor) -> Tensor:
        """The scores of each copy of queries, with its penalty: (B x V,n) -> (B,V,n)."""
        scores = scores.view(len(queries), len(self.kept), scores.shape[1])
        if not self.penalties.any():
            return scores
        own = self.unit * self.penalties[(queries < self.first).long().cpu()]
        return scores + own[..., None].to(scores)


class Repeated(Wrapped):
    """Scores of queries of which each stands for so many copies that nobody can tell apart."""

    def __init__(self, scorer: Scorer, copies: int) -> None:
        super().__init__(scorer)
        self.times, self.descriptors = copies, scorer.descriptors.repeat_interleave(copies, 0)

    def asked(self, queries: Tensor) -> Tensor:
        return queries // self.times


class BestHeading(BestOf):
    """As `BestOf`, of evenly turned copies, with the heading of the one that answers."""

    def told(self, queries: Tensor, places: Tensor) -> dict[str, Tensor]:
        turn = self.copy_at(queries, places) * (360 / self.copies)
        return {"heading": ((turn - self.layout.north) % 360).float()}


class Cached(Wrapped):
    """Scores of consecutive queries, of which a sweep asks again on its way back: those of every block, or of
    the last one alone, are kept."""

    def __init__(self, scorer: Scorer, every: bool) -> None:
        super().__init__(scorer)
        self.every, self.known = every, dict[int, Tensor]()

    def rows(self, queries: Tensor) -> Tensor:
        first = int(queries[0])
        if first not in self.known or len(self.known[first]) != len(queries):
            if not self.every:
                self.known.clear()
            self.known[first] = self.scorer.rows(queries)
        return self.known[first]


def of_stored(scores: Tensor, stored: Tensor) -> Tensor:
    """Scores (B,N), +inf but at the places that are stored, (n,)."""
    between = torch.ones(scores.shape[1], dtype=torch.bool).index_fill(0, stored, False)
    return scores.masked_fill(between.to(scores.device), math.inf)
