"""Descriptors of consecutive queries -> matches, with the state of a sequence or a filter."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.memory import in_one_thread
from dejavu_torch.places.layout import ROUTE, Layout
from dejavu_torch.recognition.calibration import TOLERANCE, Platt, Track, best_pair, confidence_of
from dejavu_torch.recognition.calibration import confidence as confidence_of_pair
from dejavu_torch.recognition.drive import DriveQuery, answer_drives, first_of
from dejavu_torch.recognition.evidence import repeats
from dejavu_torch.recognition.filter import FilterState
from dejavu_torch.recognition.scorer import OfMap, Scorer, of_stored
from dejavu_torch.recognition.search import Search, Searcher
from dejavu_torch.recognition.select import Acceptance, accept, best_candidates, best_match
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.recognition.taken import (
    AT_FIRST,
    EVERY,
    SURER,
    Running,
    doubted,
)
from dejavu_torch.recognition.views import Views
from dejavu_torch.text import with_progress
from dejavu_torch.types import Match, Odometer, SequenceModel, State, Together, check_shape, expect

AGES = 0.9  # by which a single image's probability falls with each repeat of its picture
CACHED = 2**20  # scores processed at a time: they stay in the cache


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
    wrappers: tuple[Callable[[Scorer], Scorer], ...] = ()  # of the scores, from inside out
    ordered: bool = False  # single images, too: one that repeats is of a stream that has stalled
    moved: Odometer | None = None  # in places, unless for a drive, see `checked_moved`

    def as_it_drives(self) -> Matching:
        """The same for one drive whose queries come one after another."""
        views = (one.as_it_drives() if isinstance(one, Views) else one for one in self.wrappers)
        return self._replace(wrappers=tuple(views))


SINGLE = Matching()  # each query by itself


class Localizer:
    """Consecutive queries -> matches; keeps the state of a sequence or a filter between batches.

    Args:
        place_map: None if only `next` and `match` are used, with scores from elsewhere.
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
        self.lock = threading.RLock()
        # what single images say so far, beside mirrored ones, if these are asked
        self.running, self.total = Running(SURER[layout.dimensions]), torch.zeros(())  # sum of the queries
        filters = sequence is not None and sequence.answers == "filter"
        # None if the first query will tell
        self.asks = None if filters and matching.platt is not None else False
        # probabilities, each by itself, of queries that a filter has yet to answer
        self.alone = torch.empty(0, dtype=torch.float64)
        self.last: Tensor | None = None  # the latest query
        moved, none = matching.moved, torch.empty(0, 2, dtype=torch.float64)
        self.moved = none if moved is None or moved.metres else moved.moves  # to the next queries
        self.run = 0  # how many have repeated one picture up to it, see `repeats`
        self.stale = torch.empty(0, dtype=torch.int64)  # likewise, of queries that wait for their answers
        self.searcher = searcher
        self.own: Together = "filter" if sequence is None else sequence.key
        self.models: dict[Together, SequenceModel] = {**matching.also}
        if sequence is not None:
            self.models[self.own] = sequence
        self.states: dict[Together, State] = {}  # of the models; empty before the first query
        self.route_starts = layout.starts

    def __call__(self, descriptors: Tensor, progress: bool = False) -> Match:
        assert self.place_map is not None
        with self.alone_asked():
            return self.next(OfMap(self.place_map, descriptors, self.searcher), progress)

    @contextmanager
    def alone_asked(self) -> Iterator[None]:
        """Refuse a second thread meanwhile: answers depend on the queries before, in their order."""
        expect(self.lock.acquire(blocking=False), "one for each camera", "two threads ask one localizer")
        try:
            yield
        finally:
            self.lock.release()

    @torch.no_grad()
    def next(self, scorer: Scorer, progress: bool = False, verb: str = "localizing") -> Match:
        """Match the next queries, which are those of a scorer, or all copies of them, see `wrapped`."""
        scorer, k, radius = wrapped(scorer, self.matching), self.matching.k or 1, self.matching.radius
        if not len(scorer):
            return self._with_stale(self.match(torch.zeros(0, max(1, self.layout.places))))
        if self.last is not None:
            check_shape(scorer.descriptors, f"B {len(self.last)}", "the queries are")
        wanted = [(k, radius), (min(2, self.layout.places), TOLERANCE)]
        if self.models or self.matching.callback is not None:  # they need all scores
            wanted = []
        parts, stale = list[Match](), repeats(scorer.descriptors, self.last, self.run)
        for part in with_progress(scorer.parts(wanted), verb, progress):
            if wanted:
                match = self._alone(*scorer.best(part, wanted))
            else:
                again = stale[part][:, None] > 0 if self.own == "filter" else None
                match = self.match(scorer.rows(part), scorer.stored, self._mirrored(scorer, part), again)
            parts.append(self._told(match, scorer, part))
        self.last, self.run = scorer.descriptors[-1].clone(), int(stale[-1])
        self.stale = torch.cat([self.stale, stale])
        return self._with_stale(self._without_blank(Match.joined(parts), scorer))

    def _with_stale(self, match: Match) -> Match:
        """Answers with how often their pictures had been repeated. Those of single images know of no motion:
        they get less sure from the second repeat on, as videos of another rate repeat one."""
        count, shape = len(match), (-1, *[1] * (match.index.ndim - 1))
        stale, self.stale = self.stale[:count].view(shape).expand_as(match.index), self.stale[count:]
        if not self.models and not self.matching.ordered:
            return match
        probability, accepted = match.probability, match.accepted
        if not self.models and probability is not None:
            probability = probability * AGES ** (stale - 1).clamp(min=0)
            precision = self.matching.acceptance.precision
            accepted = accepted if precision is None else accepted & (probability >= precision)
        return replace(match, stale=stale, probability=probability, accepted=accepted)

    def _mirrored(self, scorer: Scorer, queries: Tensor) -> Tensor | None:
        """Confidences in some of the queries, mirrored, and their best scores, (B,2), NaN for the others, if
        a filter's answers get probabilities."""
        if self.asks is None:
            self.asks = scorer.null is not None
        if not self.asks:
            return None
        descriptors = scorer.descriptors[queries.to(scorer.descriptors.device)]
        numbers = torch.arange(len(descriptors)) + self.running.queries
        sums = self.total.to(descriptors) + descriptors.nan_to_num(0).cumsum(0)
        found = torch.full((len(descriptors), 2), math.nan)
        some = (numbers < AT_FIRST) | (numbers % EVERY == 0)
        if bool(some.any()):
            so_far = sums[some], 1 + numbers.to(sums)[some, None]
            found[some] = self._alone_told(scorer.mirrored(queries[some], so_far=so_far)).to(found)
        self.total = sums[-1]
        return found

    def _alone_told(self, scores: Tensor) -> Tensor:
        """Confidences in single images, and their best scores, (B,N) -> (B,2)."""
        best = scores.masked_fill(scores.isnan(), math.inf).amin(1)
        return torch.stack([confidence_of(scores, self.layout).cpu(), best.cpu()], 1)

    @torch.no_grad()
    def match(
        self,
        scores: Tensor,
        stored: Tensor | None = None,
        mirrored: Tensor | None = None,
        again: Tensor | None = None,
    ) -> Match:
        """Match the next queries by their scores: (B,N) -> (B,), or (B,k).

        Args:
            stored: the only places that single images find, (n,). mirrored: see `_mirrored`. again: (B,1),
                which repeat a picture: they tell a filter nothing, but the camera may have moved.
        """
        if not self.models:
            return self._alone(scores if stored is None else of_stored(scores, stored))
        again = torch.zeros(len(scores), 1, dtype=torch.bool) if again is None else again
        if bool(again.any()):
            known = scores.isfinite()
            most = scores.where(known, -math.inf).amax(1, keepdim=True)
            scores = torch.where(again.to(scores.device) & known, most, scores)
        absent = odds = None
        if mirrored is not None:
            odds, absent = self.running(self._alone_told(scores).masked_fill(again, math.nan), mirrored)
            platt = self.matching.single or Platt(0.0, math.inf)
            alone = platt.probability(confidence_of(scores, self.layout, platt.margin))
            self.alone = torch.cat([self.alone, alone])
        size = max(1, CACHED // scores.shape[1])
        absent = torch.zeros(len(scores)) if absent is None else absent
        moved = self._moved(len(scores))
        with in_one_thread(scores.shape[1]):
            parts = zip(scores.split(size), absent.split(size), moved.split(size), strict=True)
            match = Match.joined(self._in_sequence(part, stored, False, *told) for part, *told in parts)
        return match if odds is None else self._doubted(match, odds[len(odds) - len(match.index) :])

    def told(self, moved: Tensor) -> None:
        """By how many places the camera moved to the next query, (1,), or that and its deviation, (2,)."""
        self.moved = F.pad(moved, (0, 2 - len(moved)), value=math.nan)[None]

    def _moved(self, count: int) -> Tensor:
        """How far the camera moved to each of the next queries, and the spread; NaN where nothing tells."""
        known, self.moved = self.moved[:count], self.moved[count:]
        return F.pad(known, (0, 0, 0, count - len(known)), value=math.nan)

    def _told(self, match: Match, scorer: Scorer, queries: Tensor) -> Match:
        """The match of queries with what copies tell of them, if these answer now."""
        late = self.matching.sequence is not None and self.matching.sequence.lag
        return match if late else told(match, scorer, queries)

    def _without_blank(self, match: Match, scorer: Scorer) -> Match:
        """The match, in which blank frames find nothing by themselves."""
        if self.matching.sequence is not None or scorer.blank_finds:
            return match
        shows = scorer.descriptors.any(1).cpu().view(-1, *[1] * (match.accepted.ndim - 1))
        return replace(match, accepted=match.accepted & shows)

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
            return self._with_stale(self.match(torch.zeros(0, places)))
        owed = self.matching.sequence.waiting(self.states[self.own])
        match = self._with_stale(self._in_sequence(owed[:0], last=True))
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
        state: FilterState | None = self.states.get("filter")
        return state if state is None else state.posterior

    def _alone(self, scores: Tensor, places: Tensor | None = None) -> Match:
        """Match single images by their scores, of all places or of those that are named."""
        if places is not None:
            return self._answer(self._candidates(scores, places), best_pair(scores, self.layout, places))
        parts = scores.split(max(1, CACHED // scores.shape[1]))
        return Match.joined(
            self._answer(self._candidates(part), best_pair(part, self.layout)) for part in parts
        )

    def _in_sequence(
        self,
        scores: Tensor,
        stored: Tensor | None = None,
        last: bool = False,
        absent: Tensor | None = None,
        moved: Tensor | None = None,
    ) -> Match:
        states = self.states or {T: m.start(scores.shape[1]) for T, m in self.models.items()}
        known = {} if absent is None or moved is None else {"absent": absent, "moved": moved.unbind(1)}
        told: dict[str, dict[str, Any]] = {"filter": known}
        steps = {
            T: m.step(scores, states[T], self.route_starts, **told.get(m.answers, {}))
            for T, m in self.models.items()
        }
        sequence, found = self.matching.sequence, {T: final for T, (final, _) in steps.items()}
        if sequence is not None and sequence.lag:
            if last:
                steps[self.own] = sequence.finish(states[self.own], self.route_starts)
                found[self.own] = steps[self.own][0]
            answered = torch.cat([sequence.waiting(states[self.own]), scores])
            scores = answered[: len(found[self.own])]
        if stored is not None:
            found[1] = of_stored(scores, stored)  # else another place would be the same stored frame
        final = found.get(1, scores) if sequence is None else found[self.own]
        pair, confidence = best_pair(final, self.layout), None
        if self.matching.platt is not None and sequence is not None:
            confidence = self.track(final, scores)
        match = self._answer(self._candidates(final), pair, confidence)
        self.states = {T: state for T, (_, state) in steps.items()}
        return replace(match, sequences={T: best_match(found[T]).map(Tensor.cpu) for T in self.matching.also})

    def _candidates(self, scores: Tensor, places: Tensor | None = None) -> Match:
        if self.matching.callback is not None:
            self.matching.callback(scores)
        return best_candidates(scores, self.matching.k or 1, self.matching.radius, places, self.layout)

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
        return judged(match, self.matching, self.layout)


def judged(match: Match, matching: Matching, layout: Layout, acceptance: Acceptance | None = None) -> Match:
    """Candidates (B,k), found in any way, with their acceptance and routes, on the CPU; (B,) of best places
    alone."""
    match = match.map(Tensor.cpu)
    threshold, precision, _ = acceptance or matching.acceptance
    match = replace(match, accepted=accept(match.score, threshold))
    if match.probability is not None and precision is not None:
        match = replace(match, accepted=match.probability >= precision)
    match = replace(match, route=layout.told_routes(match.index))
    return match if matching.k is not None else match.map(lambda column: column[:, 0])


def told(match: Match, scorer: Scorer, queries: Tensor) -> Match:
    """The match of queries (B,) with what their copies tell, if there are some."""
    columns = scorer.told(queries, match.index.view(len(queries), -1 if len(queries) else 1))
    shape, lost = match.index.shape, match.index < 0
    known = {name: one.view(shape).masked_fill(lost, torch.nan) for name, one in columns.items()}
    names = ("heading", "shift", "shift_degrees")
    heading, shift, turn = (known.get(name) for name in names)
    return replace(match, heading=heading, shift=shift, shift_degrees=turn)


def wrapped(scorer: Scorer, matching: Matching) -> Scorer:
    """The scores by which queries are matched."""
    for wrap in matching.wrappers:
        scorer = wrap(scorer)
    return scorer


@torch.no_grad()
def answer(
    scorer: Scorer, matching: Matching = SINGLE, progress: bool = False, verb: str = "localizing"
) -> Match:
    """Match all queries of a scorer, sequences and filters by the uncentred ones. Single images find places
    that are `stored`, sequences also those between."""
    way = matching.sequence
    if isinstance(way, PlaceSmoother):
        return _of_drive(scorer, way, matching, progress)
    if matching.also and way is None and (scorer.uncentred is not None or matching.wrappers):
        alone = answer(scorer, matching._replace(also={}), progress, verb)
        found = _as_it_drives(scorer, matching, progress, verb)
        return replace(alone, sequences=found.sequences)
    if way is not None:
        return _as_it_drives(scorer, matching, progress, verb)
    return Localizer(None, matching, layout=scorer.layout).next(scorer, progress, verb)


def _as_it_drives(scorer: Scorer, matching: Matching, progress: bool, verb: str) -> Match:
    """Match all queries in order, none of which knows those after it."""
    way, matching = matching.sequence, matching.as_it_drives()
    scorer = scorer if scorer.uncentred is None else scorer.uncentred
    localizer = Localizer(None, matching, layout=scorer.layout)
    match = localizer.next(scorer, progress, verb)
    return Match.joined([match, localizer.finish()]) if way is not None and way.lag else match


def _of_drive(scorer: Scorer, smoother: PlaceSmoother, matching: Matching, progress: bool) -> Match:
    """Match all queries of a drive."""
    scorer = wrapped(scorer, matching)
    smoother = smoother if matching.moved is None else smoother.changed(moved=matching.moved)
    asked = DriveQuery(scorer, smoother, matching.k or 1, matching.radius, matching.platt)
    (answers,) = answer_drives([asked], progress)
    match, acceptance = answers.match, matching.acceptance
    # whose scores are distances
    if acceptance.threshold is not None and not match.is_drive and not scorer.checks:
        acceptance = Acceptance(precision=math.exp(-acceptance.threshold))
    match = judged(match, matching, scorer.layout, acceptance)
    if scorer.copies == 1:
        return match
    parts = torch.arange(len(scorer)).split(max(1, scorer.at_once // scorer.layout.places))
    return Match.joined(told(match[part], scorer, part) for part in parts)
