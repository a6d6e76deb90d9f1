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
from dejavu_torch.recognition.calibration import Platt, best_pair, confidence, confidence_of
from dejavu_torch.recognition.evidence import Spacing, spacing_of
from dejavu_torch.recognition.filter import near_scores
from dejavu_torch.recognition.flight import place_flight
from dejavu_torch.recognition.large import TILE, LargeDrive, Tiles, is_large
from dejavu_torch.recognition.plane import FLOWN
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.recognition.smoother import (
    Drive,
    PlaceSmoother,
    Rows,
    blocks_together,
    check_descriptors,
    normalised,
)
from dejavu_torch.recognition.taken import ALONE, FEW, SURER, UPPER, doubted, singly
from dejavu_torch.text import progress_of
from dejavu_torch.types import Match

DOUBT = 0.1  # nats for each deviation by which an answer's own score is worse than is usual in the drive
SCORES_KEPT = 2**26  # scores of drives that are smoothed together, up to which they are computed once
NORMAL = 1.4826  # standard deviations of a Gaussian over its median absolute deviation


class Shown(NamedTuple):
    """What an answer is made of: candidates (Q,k); the rest (Q,)."""

    match: Match
    absent: Tensor  # probability of being off the map
    confidence: Tensor  # in the best place
    probability: Tensor
    own: Tensor  # the score of the answer by its query alone


class DriveQuery(NamedTuple):
    """A drive to match by a smoother, which is fitted to it.

    Attributes:
        rows: scores of queries by their numbers, (B,) -> (B,N). descriptors: (Q,K) of all queries.
        k: candidates. radius: suppression radius in places.
        platt: the calibration of single queries, if there is one.
        tiles: the scores of `rows` for large maps; None makes them of rows.
        null: as `rows`, of `flipped` queries, for a seed; without it their order alone tells whether they are
            a drive, by at least so many nats for each query.
        checks: the drive only checks the answers of single queries: it lowers their probability. Where ground
            repeats, as lane dashes do, a drive alone finds loops that are none.
    """

    rows: Rows
    descriptors: Tensor
    smoother: PlaceSmoother
    k: int = 1
    radius: int = 5
    route_starts: Sequence[int] = (0,)
    platt: Platt | None = None
    tiles: Tiles | None = None
    checks: bool = False
    null: Callable[..., Tensor] | None = None
    least: float = 0.0

    @property
    def answers(self) -> bool:
        """Whether the drive answers, once the smoother is fitted."""
        return self.smoother.is_drive and not self.checks

    def ask_singly(self, spacing: Spacing) -> None:
        """Leave to the smoother only what single images find as well."""
        few = float(spacing.weight.sum()) < FEW
        self.smoother.is_drive &= self.smoother.nats_per_query >= (
            max(self.least, ALONE) if few else self.least
        )
        if self.null is not None and not few:
            known, apart = self.smoother, self.radius
            sure = lambda scores: confidence(best_pair(scores, known.layout, apart=apart))  # noqa: E731
            found = singly(self.rows, self.null, spacing.weight.cpu(), sure)
            least = SURER[known.layout.dimensions]
            known.singly = found._replace(nats=known.nats_per_query, least=least)
            known.is_drive &= known.singly.stands_out


class Seen(NamedTuple):
    """Some queries of a drive, the last of which come first.

    mass: (B,n) of places, in double precision, so that answers that are nearly sure differ. scores: (B,n).
    known: which places, (n,); None for all.
    """

    mass: Tensor
    scores: Tensor
    known: Tensor | None = None


class Answers(NamedTuple):
    """The matches (Q,k) of a drive, and the probability that each query is off the map, (Q,)."""

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
    several = len(drives) > 1  # of which each takes about as long
    count = len(drives) if several else sum(len(asked.descriptors) for asked in drives)
    sizes = [one.rows(torch.arange(min(1, len(one.descriptors)))).shape[1] for one in drives]
    large = any(is_large(len(one.descriptors), size) for one, size in zip(drives, sizes, strict=True))
    one_thread = in_one_thread(math.inf if large else 2 * sum(sizes))
    unit = "drive" if several else "query"
    with one_thread, progress_of("smoothing", count, progress, unit) as update:
        for i, seen in _seen(drives, sizes, progress, update if several else lambda _: None):
            shown[i].append(_shown(drives[i], seen))
            update(0 if several else len(seen.scores))
    return [_joined(asked, parts[::-1]) for asked, parts in zip(drives, shown, strict=True)]


def _shown(asked: DriveQuery, seen: Seen) -> Shown:
    """The answers of some queries."""
    mass, scores, known = seen
    smoother, queries = asked.smoother, len(asked.descriptors)
    layout, within = smoother.layout, smoother.within
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
        match = Match(empty.long(), empty, empty.bool(), empty.double(), confidence=empty)
        return Answers(match, torch.zeros(0).double())
    match = Match.joined(part.match for part in parts)
    absent, sure, probability, own = (torch.cat(column) for column in [*zip(*parts, strict=True)][1:])
    if asked.answers:
        doubts = doubt(own)
        match, sure = replace(match, score=match.score + doubts[:, None]), sure - doubts
    match = replace(match, score=match.score.to(own.dtype))
    confidences = first_of(sure.to(own.dtype), k)
    return Answers(replace(match, probability=first_of(probability, k), confidence=confidences), absent)


def _seen(
    drives: Sequence[DriveQuery], sizes: Sequence[int], progress: bool, fitted_one: Callable[[int], object]
) -> Iterator[tuple[int, Seen]]:
    """Fit the smoothers to drives on so many places; then the numbers of the drives with what is seen.

    fitted_one: called with 1 for each drive, when its smoother is fitted.
    """
    spacings: dict[int, Spacing] = {}  # of descriptors that several drives share
    fitted: dict[tuple[int, States, int], list[tuple[int, Drive]]] = {}
    for i, (asked, places) in enumerate(zip(drives, sizes, strict=True)):
        rows, descriptors, smoother, _, _, starts, *_ = asked
        along = _of_windows if is_large(len(descriptors), places) else None
        if alone := {1: along, 2: _of_flight}[smoother.layout.dimensions]:
            fitted_one(1)
            yield from ((i, seen) for seen in alone(asked, places, progress))
            continue
        spacing = spacings.get(id(descriptors))
        spacing = spacings[id(descriptors)] = spacing_of(descriptors) if spacing is None else spacing
        smoother.fit(rows, descriptors, starts, spacing)
        asked.ask_singly(spacing)
        fitted_one(1)
        kind = len(descriptors), smoother.states(places, starts), len(smoother.move_logits)
        fitted.setdefault(kind, []).append((i, smoother.drive(rows, descriptors, spacing)))
    for (queries, states, _), alike in fitted.items():
        every = len(alike) * queries * states.places <= SCORES_KEPT
        alike = [(i, drive._replace(rows=_kept(drive.rows, every))) for i, drive in alike]
        pairs = [(drives[i].smoother, drive) for i, drive in alike]
        for block in blocks_together(pairs, drives[alike[0][0]].route_starts):
            numbers = torch.arange(block.first, block.first + block.log.shape[-1])
            for (i, drive), posterior in zip(alike, block.posterior, strict=True):
                asked = drives[i]
                yield i, Seen(_mass(posterior), drive.rows(numbers).cpu())


def _of_flight(asked: DriveQuery, places: int, progress: bool) -> Iterator[Seen]:
    """What is seen of a drive over an area."""
    spacing, queries = spacing_of(check_descriptors(asked.descriptors)), len(asked.descriptors)
    mass = place_flight(asked.smoother, asked.rows, queries, asked.smoother.layout, spacing)
    asked.ask_singly(spacing)
    yield Seen(mass.double(), asked.rows(torch.arange(queries)).cpu())


def _of_windows(asked: DriveQuery, places: int, progress: bool) -> Iterator[Seen]:
    """What is seen of a drive on a large map."""
    rows, descriptors, smoother, k, radius, starts, _, tiles, *_ = asked
    tiles = tiles or Tiles(lambda numbers: iter([(0, rows(numbers))]), places)
    settings = places, smoother, starts, max(2, k), radius, progress
    drive = LargeDrive(tiles, descriptors, *settings)
    asked.ask_singly(drive.spacing)
    for first, posterior, scores, known in drive:
        mass = _mass(posterior)
        if asked.answers:
            yield Seen(mass, scores, known)
            continue
        for part in reversed(torch.arange(len(mass)).split(max(1, TILE // places))):
            whole = mass.new_zeros(len(part), places).index_copy(1, known, mass[part])
            yield Seen(whole, rows(first + part).cpu())


def _kept(rows: Rows, every: bool) -> Rows:
    """The same rows of consecutive queries, which a sweep asks for again on its way back: the blocks that it
    got, or the last one alone, are kept."""
    blocks: dict[int, Tensor] = {}

    def known(numbers: Tensor) -> Tensor:
        first = int(numbers[0])
        if first not in blocks or len(blocks[first]) != len(numbers):
            if not every:
                blocks.clear()
            blocks[first] = rows(numbers)
        return blocks[first]

    return known


def _mass(posterior: Tensor) -> Tensor:
    return normalised(PlaceSmoother.folded(posterior.cpu().double()))[:, :-1]


def doubt(own: Tensor) -> Tensor:
    """What is added to the scores of answers whose own scores (Q,) are worse than the drive's median: the
    whole drive makes its answers sure of places that only look alike as well."""
    known = own[own.isfinite()]
    if not len(known):
        return torch.zeros_like(own)
    median = known.median()
    deviation = NORMAL * (known - median).abs().median()
    worse = (own - median) / deviation.clamp(min=1e-12)
    return DOUBT * worse.nan_to_num(0, 0, 0).clamp(0, 1 / DOUBT**2)


def first_of(column: Tensor, k: int) -> Tensor:
    """What is known of the first candidate, (Q,) -> (Q,k), NaN for the others."""
    return F.pad(column[:, None], (0, k - 1), value=torch.nan)
