"""Descriptors of consecutive queries -> matches, with what the queries before showed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.recognition.calibration import TOLERANCE, Platt, Track, confidence, confidence_of
from dejavu_torch.recognition.filter import LocalSearch, PlaceFilter
from dejavu_torch.recognition.search import SCORES_AT_ONCE, Best, Search, search
from dejavu_torch.recognition.select import Acceptance, accept, best_candidates, best_match
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import Match, SequenceModel

LENGTHS = (1, 5, 11, 21)  # queries of the sequences that a report sets side by side
ROWS = 4096  # descriptors on the device at a time
CACHED = 2**20  # scores summed at a time: they stay in the processor's cache
FEW = 1 / 16  # of the places of a block: of more, to keep the best takes longer than all scores
LISTED = 16  # numbers held for each of the best of a query, while two lists are merged


class Matching(NamedTuple):
    """How queries are matched.

    sequence: scores consecutive queries together; None takes each by itself.
    lengths: each T of the sequences that are matched beside it, at the speeds of a `SequenceMatcher`.
    k: candidates of a query; None gives matches (Q,). radius: places, any two of them differ by more.
    rule: which are accepted. platt: makes probabilities; None makes none.
    on_scores: is given the scores (B,N) that places are found by.
    search: of single queries, see `search`.
    """

    sequence: SequenceModel | None = None
    lengths: tuple[int, ...] = ()
    k: int | None = None
    radius: int = 0
    rule: Acceptance = Acceptance()
    platt: Platt | None = None
    on_scores: Callable[[Tensor], None] | None = None
    search: Search = "auto"

    @property
    def single(self) -> bool:
        """Whether each query is matched by itself."""
        sequence = self.sequence
        return sequence is None or (isinstance(sequence, SequenceMatcher) and sequence.length == 1)


SINGLE = Matching()  # each query by itself


def lengths_beside(sequence: SequenceModel | None, queries: int, places: int) -> tuple[int, ...]:
    """The T to set beside a sequence, its own among them, that so many queries and places have room for.

    Example:
        >>> lengths_beside(SequenceMatcher(7), queries=100, places=12)
        (1, 5, 7, 11)
    """
    if sequence is None:
        return ()
    own = {sequence.length} if isinstance(sequence, SequenceMatcher) else set()
    return tuple(length for length in sorted({*LENGTHS, *own}) if length <= min(queries, places))


class Matcher:
    """Scores of consecutive queries -> matches; keeps the state of a sequence or a filter between batches.

    Args:
        matching: how. firsts: the first place of each route of the map.

    Shape: scores (B,N) of the next queries -> Match of (B,) or (B,k) on the CPU, without gradients.

    Convention: memory does not grow with the queries. A call that raises leaves the state as it was.
    """

    def __init__(self, matching: Matching = SINGLE, firsts: Sequence[int] = (0,)) -> None:
        self.matching, self.firsts = matching, firsts
        sequence = matching.sequence
        speeds = sequence.speeds if isinstance(sequence, SequenceMatcher) else (1.0,)
        self.own = sequence.length if isinstance(sequence, SequenceMatcher) else 0
        self.models: dict[int, SequenceModel] = {}  # by T, 0 of a filter
        if sequence is not None:
            beside = {T: SequenceMatcher(T, speeds) for T in matching.lengths}
            self.models = beside | {self.own: sequence}
        self.states: dict[int, Tensor] = {}  # of the models, none before the first query
        self.track = Track()

    @torch.no_grad()
    def match(self, scores: Tensor) -> Match:
        """Match the next queries."""
        if not self.models:
            return self.matched(scores, None if self.matching.platt is None else confidence_of(scores))
        return Match.joined(map(self._in_sequence, scores.split(max(1, CACHED // scores.shape[1]))))

    def _in_sequence(self, scores: Tensor) -> Match:
        """Of so few scores that they stay in the cache."""
        states = self.states or {T: one.start(scores.shape[1]).to(scores) for T, one in self.models.items()}
        steps = {T: one.step(scores, states[T], self.firsts) for T, one in self.models.items()}
        together = steps[self.own][0]
        match = self.matched(together, None if self.matching.platt is None else self.track(together, scores))
        self.states = {T: state for T, (_, state) in steps.items()}
        beside = {T: best_match(steps[T][0]).map(Tensor.cpu) for T in self.matching.lengths}
        return match.with_probability(match.probability, beside)

    def matched(self, scores: Tensor, confidence: Tensor | None = None) -> Match:
        """The best places by the scores that they are found by."""
        if self.matching.on_scores is not None:
            self.matching.on_scores(scores)
        k, threshold = self.matching.k or 1, self.matching.rule.threshold
        return self.answer(best_candidates(scores, k, self.matching.radius, threshold), confidence)

    def answer(self, match: Match, confidence: Tensor | None = None) -> Match:
        """Candidates (B,k) as they are handed out, with the probability that the first is right."""
        matching, match = self.matching, match.map(Tensor.cpu)
        if matching.platt is not None and confidence is not None:
            probability = matching.platt.probability(confidence)[:, None]
            probability = F.pad(probability, (0, match.index.shape[1] - 1), value=math.nan)
            if matching.rule.precision is not None:
                match = match._replace(accepted=probability >= matching.rule.precision)
            match = match.with_probability(probability)
        return match if matching.k is not None else match.map(lambda column: column[:, 0])


class Localizer(Matcher):
    """Descriptors of consecutive queries -> matches on a map; keeps the state as `Matcher` does.

    Args:
        route: the map. matching: how.
        find: finds the n lowest scores of queries in place of `search`, as the workers of a cluster do.

    Shape: descriptors (B,K) of the next queries -> Match of (B,) or (B,k) on the CPU, without gradients.

    Example:
        >>> from dejavu_torch import SpectralMapper
        >>> wave = torch.sin(torch.arange(500.0)[:, None] * torch.tensor([0.1, 0.23, 0.37]))
        >>> localizer = Localizer(SpectralMapper()(wave), Matching(SequenceMatcher(3)))
        >>> localizer(wave[20:22]).index.tolist(), localizer(wave[22:23]).index.tolist()
        ([20, 21], [22])
    """

    def __init__(
        self,
        route: PlaceMap,
        matching: Matching = SINGLE,
        find: Callable[[Tensor, int], Best] | None = None,
    ) -> None:
        starts = (sum(one.places for one in route.routes[:i]) for i in range(1, len(route.routes)))
        super().__init__(matching, (0, *starts))
        self.route, self.find, sequence = route, find, matching.sequence
        self.local: LocalSearch | None = None
        if isinstance(sequence, PlaceFilter) and sequence.search_every > 1 and not matching.lengths:
            self.local = LocalSearch(sequence, route)

    @torch.no_grad()
    def __call__(self, descriptors: Tensor) -> Match:
        if not len(descriptors):
            return self.match(descriptors.new_zeros(0, self.route.places))
        if self.local is not None:
            way = self._by_local_search
        elif self.matching.sequence is None and self.matching.on_scores is None:
            way = self._by_search
        else:
            way = self._by_scores
        device = self.route.positions.device  # many descriptors are in a file
        return Match.joined(way(part.to(device)) for part in descriptors.split(ROWS))

    @torch.no_grad()
    def skip(self, queries: int) -> None:
        """So many queries were left out: a `PlaceFilter` moves once more for each."""
        filter = self.matching.sequence
        if not isinstance(filter, PlaceFilter):
            return
        if self.local is not None:
            self.local.skipped += queries
        for _ in range(queries if self.states else 0):
            self.states = self.states | {self.own: filter.predicted(self.states[self.own])}

    @property
    def posterior(self) -> Tensor | None:
        """(N+1,) probabilities of each place, and of being off the map, after the latest query; None without
        a filter, or before the first query."""
        if self.local is not None:
            return self.local.posterior
        is_filter = isinstance(self.matching.sequence, PlaceFilter)
        return self.states.get(self.own) if is_filter else None

    def _by_scores(self, descriptors: Tensor) -> Match:
        parts = descriptors.split(max(1, SCORES_AT_ONCE // max(1, self.route.places)))
        return Match.joined(self.match(self.route.scores(part)) for part in parts)

    def _by_local_search(self, descriptors: Tensor) -> Match:
        """By a filter that rarely searches; scores of all places are made only if they are asked for."""
        assert self.local is not None
        near = map(self.local, descriptors.split(1))
        if self.matching.k is not None or self.matching.on_scores is not None:
            return Match.joined(self.matched(one.row()) for one in near)
        score, place = (torch.stack(column) for column in zip(*(one.best() for one in near), strict=True))
        return self.answer(Match(place, score, accept(score, self.matching.rule.threshold)))

    def _by_search(self, descriptors: Tensor) -> Match:
        """By the lowest scores alone, unless they are too many."""
        route, matching = self.route, self.matching
        wanted = [(matching.k or 1, matching.radius)]
        if matching.platt is not None:
            wanted.append((min(2, route.places), TOLERANCE))
        # each candidate that is chosen rules out 2 radius + 1
        n = min(route.places, max((k - 1) * (2 * radius + 1) + 1 for k, radius in wanted))
        few = max(1, FEW * min(route.places, route.block_places))
        if self.find is None and n > few and route.places <= SCORES_AT_ONCE:
            return self._by_scores(descriptors)
        parts = []
        for part in descriptors.split(max(1, SCORES_AT_ONCE // (LISTED * n))):
            score, place = (
                search(route, part, n, matching.search) if self.find is None else self.find(part, n)
            )
            match, *second = (best_candidates(score, *one, matching.rule.threshold, place) for one in wanted)
            parts.append(self.answer(match, *map(confidence, second)))
        return Match.joined(parts)
