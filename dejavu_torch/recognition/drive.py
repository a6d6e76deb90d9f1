"""The matches of whole drives, from a smoother."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.memory import in_one_thread
from dejavu_torch.places.layout import ROUTE
from dejavu_torch.places.states import States
from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.calibration import Platt, best_pair, confidence, confidence_of
from dejavu_torch.recognition.engine import Motion
from dejavu_torch.recognition.evidence import Spacing, spacing_of
from dejavu_torch.recognition.filter import near_scores
from dejavu_torch.recognition.flight import Flight
from dejavu_torch.recognition.large import TILE, LargeDrive, is_large
from dejavu_torch.recognition.motion import AlongRoute
from dejavu_torch.recognition.plane import FLOWN
from dejavu_torch.recognition.scorer import Cached, Scorer
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.recognition.smoother import (
    Drive,
    PlaceSmoother,
    blocks_together,
    check_descriptors,
)
from dejavu_torch.recognition.taken import ALONE, FEW, SURER, UPPER, doubted, singly
from dejavu_torch.text import progress_of
from dejavu_torch.types import Match, expect

SCORES_KEPT = 2**26  # scores of drives that are smoothed together, up to which they are computed once
FEWER = "a route of fewer places, or, along one, a filter"
AROUND = 5  # queries, whose answers tell the speed
NORMAL = 1.4826  # standard deviations of a Gaussian over its median absolute deviation


class Shown(NamedTuple):
    """What an answer is made of: candidates (Q,k); the rest (Q,)."""

    match: Match
    absent: Tensor  # probability of being off the map
    confidence: Tensor  # in the best place
    probability: Tensor
    own: Tensor  # the score of the answer by its query alone


class DriveQuery(NamedTuple):
    """A drive to match by a smoother, a copy of which is fitted to it.

    Attributes:
        scorer: of all queries. k: candidates. radius: suppression radius in places.
        platt: the calibration of single queries, if there is one.
        asks: single images say first whether it is a drive of the map at all.
        stale: (Q,), see `Spacing`; None before the smoother is fitted.
    """

    scorer: Scorer
    smoother: PlaceSmoother
    k: int = 1
    radius: int = 5
    platt: Platt | None = None
    asks: bool = True
    stale: Tensor | None = None

    @property
    def answers(self) -> bool:
        """Whether the drive answers, by a fitted smoother."""
        return self.smoother.is_drive and not self.scorer.checks

    def fitted(self, smoother: PlaceSmoother, spacing: Spacing) -> DriveQuery:
        """The same by a fitted smoother, to which is left only what single images find as well."""
        few, scorer = float(spacing.weight.sum()) < FEW, self.scorer
        least, found = scorer.least if self.asks else 0.0, None
        is_drive = smoother.is_drive and smoother.nats_per_query >= (max(least, ALONE) if few else least)
        if self.asks and scorer.null is not None and not few:
            layout, apart = scorer.layout, self.radius
            sure = lambda scores: confidence(best_pair(scores, layout, apart=apart))  # noqa: E731
            found = singly(scorer.rows, scorer.null, spacing.weight.cpu(), sure)
            found = found._replace(nats=smoother.nats_per_query, least=SURER[layout.dimensions])
            is_drive &= found.stands_out
        smoother = smoother.changed(is_drive=is_drive, singly=found)
        return self._replace(smoother=smoother, stale=spacing.stale)


class Seen(NamedTuple):
    """Some queries of a drive, the last of which come first.

    mass: (B,n) of places, in double precision, so that answers that are nearly sure differ. scores: (B,n).
    known: which places, (n,); None for all.
    """

    mass: Tensor
    scores: Tensor
    known: Tensor | None = None


class Answers(NamedTuple):
    """The matches (Q,k) of a drive, with its smoother, and the probability that each query is off the map,
    (Q,)."""

    match: Match
    absent: Tensor


def localize_drive(asked: DriveQuery, progress: bool = False) -> Match:
    """As `localize_drives`, of one."""
    return localize_drives([asked], progress)[0]


def localize_drives(drives: Sequence[DriveQuery], progress: bool = False) -> list[Match]:
    """The matches of `answer_drives`."""
    return [answers.match for answers in answer_drives(drives, progress)]


@torch.no_grad()
def answer_drives(drives: Sequence[DriveQuery], progress: bool = False) -> list[Answers]:
    """Match the queries of drives. Those of as many queries and places, as of one drive on several maps, are
    smoothed in one pass, which takes hardly longer than that of a single one.

    Of queries that are no drive of the map, the answers are those of single queries, and a probability is the
    lower one of the single query and the smoother; of one query alone, or where single queries find the map
    plainly, it is their own.

    Returns:
        For each a Match of (Q,k), with probability and confidence, all accepted that have a finite score;
        on the CPU.
    """
    shown: list[list[Shown]] = [[] for _ in drives]
    fitted = [*drives]
    several = len(drives) > 1  # of which each takes about as long
    scorers = [asked.scorer for asked in drives]
    count = len(drives) if several else sum(map(len, scorers))
    large = any(is_large(len(one), one.layout.places) for one in scorers)
    one_thread = in_one_thread(math.inf if large else 2 * sum(one.layout.places for one in scorers))
    unit = "drive" if several else "query"
    with one_thread, progress_of("smoothing", count, progress, unit) as update:
        for i, fitted[i], seen in _seen(drives, progress, update if several else lambda _: None):
            shown[i].append(_shown(fitted[i], seen))
            update(0 if several else len(seen.scores))
    return [_joined(asked, parts[::-1]) for asked, parts in zip(fitted, shown, strict=True)]


def _shown(asked: DriveQuery, seen: Seen) -> Shown:
    """The answers of some queries."""
    mass, scores, known = seen
    smoother, queries = asked.smoother, len(asked.scorer)
    layout, within = asked.scorer.layout, smoother.within
    beside = (layout if known is None else ROUTE).reaching(mass.shape[1])  # of the columns
    ranked = scores = scores.masked_fill(scores.isnan(), math.inf)
    if asked.answers:
        ranked = near_scores(mass, scores, max(within, FLOWN[layout.dimensions]), beside)
    columns = None if known is None else known.expand_as(ranked)
    sure = confidence(best_pair(ranked, layout, columns))
    match = best_candidates(ranked, asked.k, asked.radius, columns, layout)
    at = match.index[:, :1].clamp(min=0)
    if known is not None:
        at = torch.searchsorted(known, at).clamp(max=len(known) - 1)
    probability = beside.mass_near(mass, at[:, 0], within)
    if not asked.answers and asked.platt is not None:
        by_itself = asked.platt.probability(confidence_of(scores, layout, asked.platt.margin))
        trusted = queries == 1 or (smoother.singly is not None and smoother.singly.enough)
        probability = by_itself if trusted else torch.minimum(probability, by_itself)
    if not asked.answers and smoother.singly is not None:
        probability = doubted(probability, smoother.singly.odds)
        if asked.platt is None and not smoother.singly.stands_out:
            probability = probability.clamp(max=UPPER)  # of so few at most is a single image right
    probability = probability.masked_fill(match.index[:, 0] < 0, 0)
    return Shown(match, 1 - mass.sum(1), sure, probability, scores.gather(1, at)[:, 0])


def _joined(asked: DriveQuery, parts: list[Shown]) -> Answers:
    """The answers to all queries of a drive."""
    k = asked.k
    if not parts:
        empty = torch.zeros(0, k)
        smoother = asked.smoother.forgetful()
        match = Match(empty.long(), empty, empty.bool(), empty.double(), confidence=empty, stale=empty.long())
        return Answers(replace(match, smoother=smoother), torch.zeros(0).double())
    match = Match.joined(part.match for part in parts)
    absent, sure, probability, own = (torch.cat(column) for column in [*zip(*parts, strict=True)][1:])
    if asked.answers:
        doubts = doubt(own)
        match, sure = replace(match, score=match.score + doubts[:, None]), sure - doubts
    match = replace(match, score=match.score.to(own.dtype))
    confidences = first_of(sure.to(own.dtype), k)
    match = replace(match, probability=first_of(probability, k), confidence=confidences)
    stale = None if asked.stale is None else asked.stale[:, None].expand_as(match.index)
    if asked.answers and not asked.scorer.layout.axes:
        match = replace(match, speed=first_of(speed_of(match.index[:, 0], probability), k))
    return Answers(replace(match, smoother=asked.smoother, stale=stale), absent)


def _seen(
    drives: Sequence[DriveQuery], progress: bool, fitted_one: Callable[[int], object]
) -> Iterator[tuple[int, DriveQuery, Seen]]:
    """The numbers of drives, with smoothers that are fitted to them and what these see.

    fitted_one: called with 1 for each drive, when its smoother is fitted.
    """
    spacings: dict[int, Spacing] = {}  # of descriptors that several drives share
    fitted: dict[tuple[int, States, int, type[Motion], int], list[tuple[int, DriveQuery, Drive]]] = {}
    for i, asked in enumerate(drives):
        scorer, smoother = asked.scorer, asked.smoother.changed(map_links=asked.scorer.links)
        asked = asked._replace(smoother=smoother)
        descriptors, layout = scorer.descriptors, scorer.layout
        along = _of_windows if is_large(len(scorer), layout.places) else None
        if alone := {1: along, 2: _of_flight}[layout.dimensions]:
            seen = f"a motion of one's own, and {len(scorer)} queries on {layout.places} places"
            expect(smoother.motion is AlongRoute, "a route of fewer places", seen)
            seen = f"places moved, and {len(scorer)} queries on {layout.places} places"
            expect(smoother.moved is None, FEWER, seen)
            fitted_one(1)
            yield from ((i, known, seen) for known, seen in alone(asked, progress))
            continue
        spacing = spacings.get(id(descriptors))
        spacing = spacings[id(descriptors)] = spacing_of(descriptors) if spacing is None else spacing
        asked = asked.fitted(smoother.fit(scorer.rows, descriptors, layout.starts, spacing), spacing)
        smoother = asked.smoother
        fitted_one(1)
        kind = (
            len(scorer),
            smoother.states(layout.places, layout.starts),
            len(smoother.move_logits),
            smoother.motion,
            id(smoother.steady) if smoother.moved is None else -i,  # each by itself
        )
        fitted.setdefault(kind, []).append((i, asked, smoother.drive(scorer.rows, descriptors, spacing)))
    for (queries, states, *_), alike in fitted.items():
        every = len(alike) * queries * states.places <= SCORES_KEPT
        alike = [
            (i, asked, drive._replace(rows=Cached(asked.scorer, every).rows)) for i, asked, drive in alike
        ]
        pairs = [(asked.smoother, drive) for _, asked, drive in alike]
        for block in blocks_together(pairs, drives[alike[0][0]].scorer.layout.starts):
            numbers = torch.arange(block.first, block.first + block.log.shape[-1])
            for (i, asked, drive), mass in zip(alike, block.by_place, strict=True):
                yield i, asked, Seen(mass, drive.rows(numbers).cpu())


def _of_flight(asked: DriveQuery, progress: bool) -> Iterator[tuple[DriveQuery, Seen]]:
    """What is seen of a drive over an area."""
    scorer = asked.scorer
    spacing, queries = spacing_of(check_descriptors(scorer.descriptors), monotone=True), len(scorer)
    flight = Flight(asked.smoother, scorer.rows, queries, scorer.layout, spacing)
    asked = asked.fitted(flight.smoother, spacing)
    yield asked, Seen(flight.masses(asked.smoother).double(), flight.scores)


def _of_windows(asked: DriveQuery, progress: bool) -> Iterator[tuple[DriveQuery, Seen]]:
    """What is seen of a drive on a large map."""
    scorer, places = asked.scorer, asked.scorer.layout.places
    drive = LargeDrive(scorer, asked.smoother, max(2, asked.k), asked.radius, progress)
    asked = asked.fitted(drive.smoother, drive.spacing)
    for first, mass, scores, known in drive.masses(asked.smoother):
        if asked.answers:
            yield asked, Seen(mass, scores, known)
            continue
        for part in reversed(torch.arange(len(mass)).split(max(1, TILE // places))):
            whole = mass.new_zeros(len(part), places).index_copy(1, known, mass[part])
            yield asked, Seen(whole, scorer.rows(first + part).cpu())


def doubt(own: Tensor) -> Tensor:
    """What is added to the scores of answers whose own scores (Q,) are worse than the drive's median: the
    whole drive makes its answers sure of places that only look alike as well."""
    known = own[own.isfinite()]
    if not len(known):
        return torch.zeros_like(own)
    median = known.median()
    deviation = NORMAL * (known - median).abs().median()
    worse = (own - median) / deviation.clamp(min=1e-12)
    return chosen.DOUBT * worse.nan_to_num(0, 0, 0).clamp(0, 1 / chosen.DOUBT**2)


def speed_of(places: Tensor, probability: Tensor) -> Tensor:
    """Places a query that a drive goes at its answers (Q,), by those up to `AROUND` before and after."""
    at = F.pad(places.double().masked_fill(probability < 0.5, math.nan), (AROUND, AROUND), value=math.nan)
    steps = at.diff().unfold(0, 2 * AROUND, 1)
    return steps.where(steps.abs() <= 2 * chosen.PACES[-1], math.nan).nanmean(1)


def first_of(column: Tensor, k: int) -> Tensor:
    """What is known of the first candidate, (Q,) -> (Q,k), NaN for the others."""
    return F.pad(column[:, None], (0, k - 1), value=torch.nan)
