"""Descriptors of consecutive queries -> matches, with the state of a sequence or a filter."""

from __future__ import annotations

import copy
import math
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.memory import in_one_thread
from dejavu_torch.places.layout import ROUTE, Layout
from dejavu_torch.recognition.calibration import TOLERANCE, Platt, Track, best_pair, confidence_of
from dejavu_torch.recognition.calibration import confidence as confidence_of_pair
from dejavu_torch.recognition.drive import DriveQuery, first_of, localize_drive
from dejavu_torch.recognition.samples import GROUP, RowSearch
from dejavu_torch.recognition.scorer import BestOf, Earlier, Scorer, of_stored
from dejavu_torch.recognition.search import SCORES_AT_ONCE, NmsSpec, Scan, Search, Searcher, num_needed
from dejavu_torch.recognition.select import Acceptance, accept, best_candidates, best_match
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.recognition.taken import (
    AT_FIRST,
    EVERY,
    FAITHFUL,
    SURER,
    Running,
    doubted,
    flipped,
    middle,
)
from dejavu_torch.text import with_progress
from dejavu_torch.types import Match, SequenceModel, Together, expect

ROWS = 4096  # descriptors on the device at a time
CACHED = 2**20  # scores processed at a time: they stay in the cache
SHORT = 2**15  # places of which all scores are kept: selecting the lowest of so few takes longer
MAX_SHARE = 1 / 16  # of a block's places; selecting more of the lowest scores is slower than keeping all
PLACES_PER_NUMBER = 64  # a coarse search holds at most one number of a query per this many places
PER_BEST = 16  # held for each of a query's lowest scores, while two lists are merged


class Matching(NamedTuple):
    """How queries are matched."""

    sequence: SequenceModel | PlaceSmoother | None = None  # None matches each query by itself
    also: Mapping[Together, SequenceModel] = {}  # further ways, see `Match.sequences`; never changed
    k: int | None = None  # candidates per query; None gives matches (Q,)
    radius: int = 0  # suppression radius in places
    acceptance: Acceptance = Acceptance()
    platt: Platt | None = None  # gives probabilities; for a smoother, that of single queries
    single: Platt | None = None  # that of single queries, beside a filter's
    callback: Callable[[Tensor], None] | None = None  # receives the final scores (B,N)
    search: Search = "auto"  # of single queries, see `DejaVu.localize`
    removed: float = 1.0  # of each place's mean score, by a smoother
    apart: int | None = None  # queries are the places themselves; only those over this many before answer
    copies: int = 1  # rows of each query, evenly turned: each place has the best score of them


SINGLE = Matching()  # each query by itself


class Localizer:
    """Consecutive queries -> matches; keeps the state of a sequence or a filter between batches.

    Args:
        route: the map; None if only `match` is used, with scores from elsewhere.
        searcher: finds the best places of single queries; None is a `Scan`.
        layout: of the places, without a map.

    Shape: descriptors (B,K) of the next queries, or (B x copies, K) -> Match of (B,), or (B,k), on the CPU,
        without gradients.

    Convention: memory does not grow with the queries. A call that raises leaves the state unchanged.

    Example:
        >>> from dejavu_torch import SequenceMatcher, SpectralMapper
        >>> wave = torch.sin(torch.arange(500.0)[:, None] * torch.tensor([0.1, 0.23, 0.37]))
        >>> localizer = Localizer(SpectralMapper()(wave), Matching(SequenceMatcher(3)))
        >>> localizer(wave[20:22]).index.tolist(), localizer(wave[22:23]).index.tolist()
        ([20, 21], [22])
    """

    def __init__(
        self,
        place_map: PlaceMap | None = None,
        matching: Matching = SINGLE,
        searcher: Searcher | None = None,
        layout: Layout = ROUTE,
    ) -> None:
        self.layout = layout = layout if place_map is None else place_map.layout  # of the places
        also = {T: one.over(layout) for T, one in matching.also.items()}
        sequence = None if matching.sequence is None else matching.sequence.over(layout)
        matching = matching._replace(sequence=sequence, also=also)
        self.place_map, self.matching, self.track = place_map, matching, Track(layout)
        # what single images say so far, beside mirrored ones, if these are asked
        self.running = Running(SURER[layout.dimensions])
        self.lock = threading.RLock()
        self.total: Tensor | None = None  # of the queries so far
        filters = sequence is not None and sequence.answers == "filter"
        asks = filters and matching.platt is not None and matching.copies == 1
        if asks and place_map is not None and (place_map.fidelity or 0) >= FAITHFUL:
            self.total = torch.zeros(place_map.dimension)
        # probabilities, each by itself, of queries that a filter has yet to answer
        self.alone = torch.empty(0, dtype=torch.float64)
        self.searcher = Scan(place_map) if searcher is None and place_map is not None else searcher
        self.own: Together = "filter" if sequence is None else sequence.key
        self.models: dict[Together, SequenceModel] = {**matching.also}
        if sequence is not None:
            self.models[self.own] = sequence
        self.states: dict[Together, Tensor] = {}  # of the models; empty before the first query
        self.route_starts = layout.starts

    def __call__(self, descriptors: Tensor, progress: bool = False) -> Match:
        with self.alone_asked():
            return self._answered(descriptors, progress)

    @contextmanager
    def alone_asked(self) -> Iterator[None]:
        """Refuse a second thread meanwhile: answers depend on the queries before, in their order."""
        expect(self.lock.acquire(blocking=False), "one for each camera", "two threads ask one localizer")
        try:
            yield
        finally:
            self.lock.release()

    @torch.no_grad()
    def _answered(self, descriptors: Tensor, progress: bool) -> Match:
        place_map, matching = self.place_map, self.matching
        assert place_map is not None
        places = place_map.places
        if not len(descriptors):
            return self.match(descriptors.new_zeros(0, places))
        wanted = [(matching.k or 1, matching.radius), (min(2, places), TOLERANCE)]
        n = num_needed(wanted, self.layout)
        few = n <= max(1, MAX_SHARE * min(places, place_map.block_places)) or places > SCORES_AT_ONCE
        searches = not self.models and matching.callback is None
        searches = searches and (type(self.searcher) is not Scan or (few and places > SHORT))
        per_number = GROUP if isinstance(self.searcher, RowSearch) else PLACES_PER_NUMBER
        size = max(PER_BEST * n, places // per_number) if searches else places
        parts = descriptors.split(whole(min(ROWS, SCORES_AT_ONCE // size), matching.copies))
        moved = (part.to(place_map.device) for part in with_progress(parts, "localizing", progress))
        if searches:
            match = Match.joined(self._search(part, wanted) for part in moved)
        else:
            match = Match.joined(self.match(place_map.scores(part), self._mirrored(part)) for part in moved)
        return self._without_blank(match, descriptors[:: matching.copies])

    def _mirrored(self, descriptors: Tensor) -> Tensor | None:
        """Confidences in some of the queries, mirrored, (B,), NaN for the others, if a filter's answers get
        probabilities."""
        place_map = self.place_map
        if self.total is None:
            return None
        assert place_map is not None
        numbers = torch.arange(len(descriptors)) + self.running.queries
        sums = self.total.to(descriptors) + descriptors.nan_to_num(0).cumsum(0)
        means = middle(sums, 1 + numbers.to(sums)[:, None], place_map.mean)
        found = descriptors.new_full((len(descriptors),), math.nan)
        some = (numbers < AT_FIRST) | (numbers % EVERY == 0)
        if bool(some.any()):
            scores = place_map.scores(flipped(descriptors[some], mean=means[some]))
            found[some] = confidence_of(scores, self.layout)
        self.total = sums[-1]
        return found

    @torch.no_grad()
    def match(self, scores: Tensor, mirrored: Tensor | None = None) -> Match:
        """Match the next queries by their scores: (B,N), or (B x copies, N) -> (B,), or (B,k); mirrored: see
        `_mirrored`."""
        if mirrored is not None:
            odds = self.running(confidence_of(scores, self.layout), mirrored)
            platt = self.matching.single or Platt(0.0, math.inf)
            alone = platt.probability(confidence_of(scores, self.layout, platt.margin))
            self.alone = torch.cat([self.alone, alone])
            match = self.match(scores)
            return self._doubted(match, odds[len(odds) - len(match.index) :])
        turn, copies = None, self.matching.copies
        if copies > 1:
            scores, turn = scores.view(-1, copies, scores.shape[1]).min(1)
        parts = scores.split(max(1, CACHED // scores.shape[1]))
        turns = [None] * len(parts) if turn is None else turn.split(len(parts[0]))
        if not self.models:
            return Match.joined(map(self._alone, parts, turns))
        with in_one_thread(scores.shape[1]):
            return Match.joined(map(self._in_sequence, parts, turns))

    def drive(self, scorer: Scorer, smoother: PlaceSmoother, progress: bool = False) -> Match:
        """Match all queries of a drive by a smoother, which is fitted to them; see `localize_drives`.

        Args:
            scorer: of the queries, and of all copies of them, see `wrapped`.
        """
        scorer = wrapped(scorer, self.matching)
        asked = self.drive_query(scorer, smoother)
        match = localize_drive(asked, progress)
        acceptance = self.matching.acceptance
        # whose scores are distances
        if acceptance.threshold is not None and not smoother.is_drive and not asked.checks:
            acceptance = Acceptance(precision=math.exp(-acceptance.threshold))
        return self._accepted(self._turned(scorer, match), acceptance)

    def match_all(self, scorer: Scorer, progress: bool = False) -> Match:
        """Match all queries by their scores, each by itself, or by a sequence or filter."""
        match = match_scores(scorer, self.matching, progress)
        scorer = wrapped(scorer, self.matching)
        return self._without_blank(self._turned(scorer, match), scorer.descriptors)

    def _turned(self, scorer: Scorer, match: Match) -> Match:
        """The match with its headings, if there are copies of the queries."""
        if self.matching.copies == 1:
            return match
        each = max(1, SCORES_AT_ONCE // (self.matching.copies * scorer.layout.places))
        index = match.index.view(len(scorer), -1 if len(scorer) else 1)
        parts = zip(torch.arange(len(scorer)).split(each), index.split(each), strict=True)
        turn = torch.cat([index[:0], *(scorer.copy_at(*part) for part in parts)]).view_as(match.index)
        return replace(match, heading=self._heading_of(turn, match.index))

    def _without_blank(self, match: Match, descriptors: Tensor) -> Match:
        """The match, in which blank frames find nothing by themselves; descriptors (B,K)."""
        if self.matching.sequence is not None or getattr(self.place_map, "metric", "") != "cosine":
            return match
        shows = descriptors.any(1).cpu().view(-1, *[1] * (match.accepted.ndim - 1))
        return replace(match, accepted=match.accepted & shows)

    def _heading_of(self, turn: Tensor, index: Tensor) -> Tensor:
        """The heading of copies in degrees, NaN where the place `index` is -1."""
        heading = turn * (360 / self.matching.copies) - self.layout.north
        return (heading % 360).float().masked_fill(index < 0, torch.nan)

    def drive_query(self, scorer: Scorer, smoother: PlaceSmoother) -> DriveQuery:
        """What `drive` matches."""
        matching = self.matching
        smoother.map_links, smoother.removed = scorer.links, matching.removed
        settings = matching.k or 1, matching.radius, matching.platt
        return DriveQuery(scorer, smoother, *settings, checks=matching.apart is not None)

    @torch.no_grad()
    def skip(self, queries: int) -> None:
        """Skip queries: a `PlaceFilter` moves once more for each."""
        sequence = self.matching.sequence
        if queries and sequence is not None and self.states:
            state = sequence.skipped(self.states[self.own], queries, self.route_starts)
            self.states = self.states | {self.own: state}

    @torch.no_grad()
    def finish(self) -> Match:
        """The answers that a `PlaceFilter` with a lag still owes, after the last query; else none."""
        places = max(1, self.layout.places)
        if self.matching.sequence is None or not self.matching.sequence.lag or not self.states:
            return self.match(torch.zeros(0, places))
        match = self._in_sequence(self.states[self.own].new_zeros(0, places), last=True)
        return self._doubted(match, torch.tensor(self.running.odds)) if len(self.alone) else match

    def _doubted(self, match: Match, odds: Tensor) -> Match:
        """Answers of a filter with the odds that the queries so far are over the map's ground; where they
        change, an answer is no surer than its query alone."""
        assert match.probability is not None
        count, shape = len(match.index), (-1, *[1] * (match.probability.ndim - 1))
        own, self.alone, odds = self.alone[:count].view(shape), self.alone[count:], odds.view(shape)
        least = torch.where(odds < 1, torch.minimum(match.probability, own), match.probability)
        probability, precision = doubted(least, odds), self.matching.acceptance.precision
        accepted = match.accepted if precision is None else match.accepted & (probability >= precision)
        return replace(match, probability=probability, accepted=accepted)

    @property
    def posterior(self) -> Tensor | None:
        """(N+1,) of a filter for the latest answer; None without a filter, or before the first query."""
        state = self.states.get("filter")
        return state if state is None or state.ndim == 1 else state[0]

    def _alone(self, scores: Tensor, turn: Tensor | None) -> Match:
        return self._answer(self._candidates(scores, turn), best_pair(scores, self.layout))

    def _in_sequence(self, scores: Tensor, turn: Tensor | None = None, last: bool = False) -> Match:
        states = self.states or {T: m.start(scores.shape[1]).to(scores) for T, m in self.models.items()}
        steps = {T: m.step(scores, states[T], self.route_starts) for T, m in self.models.items()}
        sequence, single = self.matching.sequence, self.matching.sequence is None
        if sequence is not None and sequence.lag:
            if last:
                steps[self.own] = sequence.finish(states[self.own], self.route_starts)
            answered = torch.cat([sequence.waiting(states[self.own]), scores])
            scores, turn = answered[: len(steps[self.own][0])], None  # not those of the queries answered
        final = scores if single else steps[self.own][0]
        pair, confidence = best_pair(final, self.layout), None
        if self.matching.platt is not None and not single:
            confidence = self.track(final, scores)
        match = self._answer(self._candidates(final, turn), pair, confidence)
        self.states = {T: state for T, (_, state) in steps.items()}
        sequences = {T: best_match(steps[T][0]).map(Tensor.cpu) for T in self.matching.also}
        return replace(match, sequences=sequences)

    def _candidates(self, scores: Tensor, turn: Tensor | None = None) -> Match:
        if self.matching.callback is not None:
            self.matching.callback(scores)
        match = best_candidates(scores, self.matching.k or 1, self.matching.radius, layout=self.layout)
        best = None if turn is None else turn.gather(1, match.index.clamp(min=0))
        return match if best is None else replace(match, heading=self._heading_of(best, match.index))

    def _answer(self, match: Match, pair: Match, confidence: Tensor | None = None) -> Match:
        """Candidates (B,k) with all that is known of them.

        Args:
            pair: the two best places of each query, see `best_pair`.
            confidence: for the calibration; None is that of single queries.
        """
        platt, k = self.matching.platt, match.index.shape[1]
        match = replace(match, confidence=first_of(confidence_of_pair(pair), k))
        if platt is not None:
            known = confidence_of_pair(pair, platt.margin) if confidence is None else confidence
            match = replace(match, probability=first_of(platt.probability(known), k))
        return self._accepted(match)

    def _accepted(self, match: Match, acceptance: Acceptance | None = None) -> Match:
        """Candidates (B,k) with their acceptance and routes, on the CPU; (B,) for best places alone."""
        matching, match = self.matching, match.map(Tensor.cpu)
        threshold, precision, _ = acceptance or matching.acceptance
        match = replace(match, accepted=accept(match.score, threshold))
        if match.probability is not None and precision is not None:
            match = replace(match, accepted=match.probability >= precision)
        match = replace(match, route=self.layout.told_routes(match.index))
        return match if matching.k is not None else match.map(lambda column: column[:, 0])

    def _search(self, descriptors: Tensor, wanted: list[NmsSpec]) -> Match:
        """Candidates from the lowest scores alone; `wanted` has those of the answer first."""
        assert self.searcher is not None
        score, place = self.searcher(descriptors, wanted)
        copies, each = self.matching.copies, score.shape[1]
        # the best of all copies are among the best of each
        score, place = score.view(-1, copies * each), place.view(-1, copies * each)
        match, pair = (best_candidates(score, *spec, place, self.layout) for spec in wanted)
        if copies > 1:
            found = (place[:, None] == match.index[..., None]) & (score[:, None] == match.score[..., None])
            turn = found.byte().argmax(2) // each
            match = replace(match, heading=self._heading_of(turn, match.index))
        return self._answer(match, pair)


def wrapped(scorer: Scorer, matching: Matching) -> Scorer:
    """The scores by which queries are matched, see `Matching.copies` and `apart`."""
    scorer = BestOf(scorer, matching.copies) if matching.copies > 1 else scorer
    return scorer if matching.apart is None else Earlier(scorer, matching.apart)


def drive_query(
    scorer: Scorer, smoother: PlaceSmoother, asks: bool = False, removed: float | None = None
) -> DriveQuery:
    """Queries as a drive with scores of any kind, for a smoother like this one; `removed`: unless its own."""
    smoother = copy.deepcopy(smoother)
    own = smoother.removed if removed is None else removed
    smoother.map_links, smoother.removed = scorer.links, own
    return DriveQuery(scorer, smoother, radius=0, asks=asks)


@torch.no_grad()
def match_scores(
    scorer: Scorer, matching: Matching = SINGLE, progress: bool = False, verb: str = "localizing"
) -> Match:
    """The matches of queries by their scores alone, sequences and filters by the uncentred ones. Single ones
    find places that are `stored`, sequences also those between."""
    if scorer.uncentred is not None and (matching.also or matching.sequence):
        found = match_scores(scorer.uncentred, matching, progress, verb)
        if matching.sequence is not None:
            return found
        alone = match_scores(scorer, matching._replace(also={}), progress, verb)
        return replace(alone, sequences=found.sequences)
    scorer, how = wrapped(scorer, matching), matching._replace(copies=1, apart=None)
    matcher = Localizer(None, how, layout=scorer.layout)
    singly = Localizer(None, how._replace(sequence=None, also={}), layout=scorer.layout)
    single, parts = matching.sequence is None or matcher.own == 1, list[Match]()
    for part in with_progress(scorer.parts(), verb, progress):
        scores = scorer.rows(part)
        match = matcher.match(scores)
        if scorer.stored is not None and (single or 1 in match.sequences):
            # else another place would be the same stored frame
            one = singly.match(of_stored(scores, scorer.stored))
            sequences = {T: one if T == 1 else several for T, several in match.sequences.items()}
            match = replace(one if single else match, sequences=sequences)
        parts.append(match)
    if matching.sequence is not None and matching.sequence.lag:
        parts.append(matcher.finish())
    return Match.joined(parts)


def whole(rows: int, copies: int) -> int:
    """So many rows at a time, but at least one, and all copies of a query together."""
    return max(1, rows // copies) * copies
