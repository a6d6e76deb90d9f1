"""Descriptors of consecutive queries -> matches, with what the queries before showed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from itertools import accumulate
from types import MappingProxyType
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.recognition.calibration import TOLERANCE, Platt, Track, confidence, confidence_of
from dejavu_torch.recognition.filter import LocalSearch, PlaceFilter
from dejavu_torch.recognition.search import SCORES_AT_ONCE, Find, Search, Wanted, lowest_needed, search
from dejavu_torch.recognition.select import Acceptance, accept, best_candidates, best_match
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.text import bar
from dejavu_torch.types import Match, SequenceModel, Together

ROWS = 4096  # descriptors on the device at a time
CACHED = 2**20  # scores summed at a time: they stay in the processor's cache
FEW = 1 / 16  # of the places of a block: to keep more of the best takes longer than all scores
SAMPLED = 64  # places at least for a number that a search by samples holds of a query
LISTED = 16  # numbers held for each of the best of a query, while two lists are merged


class Matching(NamedTuple):
    """How queries are matched."""

    sequence: SequenceModel | None = None  # None matches each query by itself
    beside: Mapping[Together, SequenceModel] = MappingProxyType({})  # further ways, see `Match.sequences`
    k: int | None = None  # candidates of a query; None gives matches (Q,)
    radius: int = 0  # places, any two candidates differ by more
    rule: Acceptance = Acceptance()
    platt: Platt | None = None  # makes probabilities
    on_scores: Callable[[Tensor], None] | None = None  # is given the scores (B,N) that places are found by
    search: Search = "auto"  # of single queries


SINGLE = Matching()  # each query by itself


class Localizer:
    """Consecutive queries -> matches; keeps the state of a sequence or a filter between batches.

    Args:
        route: the map; None for scores that are made elsewhere, which only `match` takes.
        find: finds candidates of single queries in place of `search`, as a `CoarseSearch` or the workers of a
            cluster do.
        approximate: scores of all places, about, for a `PlaceFilter` that does not always search; None is the
            map's own.

    Shape: descriptors (B,K) of the next queries -> Match of (B,), or (B,k), on the CPU, without gradients.

    Convention: memory does not grow with the queries. A call that raises leaves the state as it was.

    Example:
        >>> from dejavu_torch import SpectralMapper
        >>> wave = torch.sin(torch.arange(500.0)[:, None] * torch.tensor([0.1, 0.23, 0.37]))
        >>> localizer = Localizer(SpectralMapper()(wave), Matching(SequenceMatcher(3)))
        >>> localizer(wave[20:22]).index.tolist(), localizer(wave[22:23]).index.tolist()
        ([20, 21], [22])
    """

    def __init__(
        self,
        route: PlaceMap | None = None,
        matching: Matching = SINGLE,
        find: Find | None = None,
        approximate: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        self.route, self.matching, self.find, self.track = route, matching, find, Track()
        sequence, routes = matching.sequence, () if route is None else route.routes
        self.own: Together = sequence.length if isinstance(sequence, SequenceMatcher) else "filter"
        self.models = {**matching.beside, **({} if sequence is None else {self.own: sequence})}
        self.states: dict[Together, Tensor] = {}  # of the models; none before the first query
        self.firsts = (0, *accumulate(one.places for one in routes[:-1]))  # the first place of each route
        self.local: LocalSearch | None = None
        if route is not None and isinstance(sequence, PlaceFilter) and not matching.beside:
            every = sequence.search_every
            self.local = LocalSearch(sequence, route, approximate or route.scores) if every > 1 else None

    @torch.no_grad()
    def __call__(self, descriptors: Tensor, progress: str | None = None) -> Match:
        route, matching = self.route, self.matching
        assert route is not None
        places = route.places
        if not len(descriptors):
            return self.match(descriptors.new_zeros(0, places))
        wanted = [(matching.k or 1, matching.radius)]
        if matching.platt is not None:
            wanted.append((min(2, places), TOLERANCE))
        n = lowest_needed(wanted, places)
        few = self.find is not None or places > SCORES_AT_ONCE
        few = few or n <= max(1, FEW * min(places, route.block_places))
        way, size = self._by_scores, places
        if not self.models and matching.on_scores is None and few:
            way, size = partial(self._by_search, wanted), max(LISTED * n, places // SAMPLED)
        parts = descriptors.split(max(1, min(ROWS, SCORES_AT_ONCE // size)))
        return Match.joined(way(part.to(route.positions.device)) for part in bar(parts, progress))

    @torch.no_grad()
    def match(self, scores: Tensor) -> Match:
        """Match the next queries by their scores: (B,N) -> (B,), or (B,k)."""
        if not self.models:
            confidence = None if self.matching.platt is None else confidence_of(scores)
            return self._answer(self._candidates(scores), confidence)
        return Match.joined(map(self._in_sequence, scores.split(max(1, CACHED // scores.shape[1]))))

    @torch.no_grad()
    def skip(self, queries: int) -> None:
        """So many queries were skipped: a `PlaceFilter` moves once more for each."""
        filter = self.matching.sequence
        if self.local is not None:
            self.local.skipped += queries
        elif isinstance(filter, PlaceFilter) and self.states:
            for _ in range(queries):
                state = self.states["filter"]
                self.states = self.states | {"filter": filter.moved(state, len(state) - 1)}

    @property
    def posterior(self) -> Tensor | None:
        """(N+1,) of a filter after the latest query; None without one, or before the first query."""
        return self.states.get("filter") if self.local is None else self.local.posterior

    def _in_sequence(self, scores: Tensor) -> Match:
        states = self.states or {T: one.start(scores.shape[1]).to(scores) for T, one in self.models.items()}
        steps = {T: one.step(scores, states[T], self.firsts) for T, one in self.models.items()}
        single = self.matching.sequence is None
        together, confidence = scores if single else steps[self.own][0], None
        if self.matching.platt is not None:
            confidence = confidence_of(scores) if single else self.track(together, scores)
        match = self._answer(self._candidates(together), confidence)
        self.states = {T: state for T, (_, state) in steps.items()}
        beside = {T: best_match(steps[T][0]).map(Tensor.cpu) for T in self.matching.beside}
        return match._replace(sequences=beside)

    def _locally(self, descriptor: Tensor) -> Match:
        assert self.local is not None
        whole = self.matching.k is not None or self.matching.on_scores is not None
        scores, start = self.local(descriptor, whole)
        match = self._candidates(scores)
        return match._replace(index=match.index + start)

    def _candidates(self, scores: Tensor) -> Match:
        if self.matching.on_scores is not None:
            self.matching.on_scores(scores)
        return best_candidates(scores, self.matching.k or 1, self.matching.radius)

    def _answer(self, match: Match, confidence: Tensor | None = None) -> Match:
        """Candidates (B,k) as they are handed out, with the probability that the first is right."""
        matching, match = self.matching, match.map(Tensor.cpu)
        match = match._replace(accepted=accept(match.score, matching.rule.threshold))
        if matching.platt is not None and confidence is not None:
            others = match.index.shape[1] - 1
            probability = F.pad(matching.platt.probability(confidence)[:, None], (0, others), value=math.nan)
            if matching.rule.precision is not None:
                match = match._replace(accepted=probability >= matching.rule.precision)
            match = match._replace(probability=probability)
        return match if matching.k is not None else match.map(lambda column: column[:, 0])

    def _by_scores(self, descriptors: Tensor) -> Match:
        assert self.route is not None
        if self.local is None:
            return self.match(self.route.scores(descriptors))
        return self._answer(Match.joined(map(self._locally, descriptors.split(1))))

    def _by_search(self, wanted: Wanted, descriptors: Tensor) -> Match:
        """By some of the lowest scores alone, of which candidates (k, radius) are chosen."""
        if self.find is not None:
            score, place = self.find(descriptors, wanted)
        else:
            assert self.route is not None
            n, scan = lowest_needed(wanted, self.route.places), self.matching.search == "scan"
            score, place = search(self.route, descriptors, n, scan)
        match, *second = (best_candidates(score, *one, places=place) for one in wanted)
        return self._answer(match, *map(confidence, second))
