"""The matches of a whole drive, from a smoother."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.recognition.calibration import TOLERANCE, Platt, confidence_of
from dejavu_torch.recognition.filter import near_scores
from dejavu_torch.recognition.large import TILE, LargeDrive, Tiles, is_large
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.recognition.smoother import Drive, PlaceSmoother, Rows, normalised
from dejavu_torch.text import progress_of
from dejavu_torch.types import Match

DOUBT = 0.1  # nats for each deviation by which an answer's own score is worse than is usual in the drive
NORMAL = 1.4826  # standard deviations of a Gaussian over its median absolute deviation


class Shown(NamedTuple):
    """What an answer is made of: candidates (Q,k); the rest (Q,)."""

    match: Match
    margin: Tensor  # to the best place elsewhere
    probability: Tensor
    own: Tensor  # the score of the answer by its query alone


@torch.no_grad()
def localize_drive(
    rows: Rows,
    descriptors: Tensor,
    smoother: PlaceSmoother,
    k: int = 1,
    radius: int = 5,
    route_starts: Sequence[int] = (0,),
    platt: Platt | None = None,
    progress: bool = False,
    single: Rows | None = None,
    tiles: Tiles | None = None,
) -> Match:
    """Fit a smoother to a drive and match its queries.

    If they are no drive of the map, the answers are those of single queries, and a probability is the lower
    one of the single query and the smoother; of one query alone it is its own.

    Args:
        rows: scores of queries by their numbers, (B,) -> (B,N). descriptors: (Q,K) of all queries.
        single: likewise, of queries that are no drive, which are not centred; None is as `rows`.
        k: candidates. radius: suppression radius in places.
        platt: the calibration of single queries, if there is one.
        tiles: the scores of `rows` for large maps; None makes them of rows.

    Returns:
        Match of (Q,k) on the CPU, with probability and confidence; all accepted that have a finite score.
    """
    queries = len(descriptors)
    places = rows(torch.arange(min(1, queries))).shape[1]
    if is_large(queries, places):
        tiles = tiles or Tiles(lambda numbers: iter([(0, rows(numbers))]), places)
        settings = places, smoother, route_starts, max(2, k), radius, progress
        seen = _of_windows(LargeDrive(tiles, descriptors, *settings), single or rows)
    else:
        smoother.fit(rows, descriptors, route_starts)
        seen = _of_all_places(smoother, smoother.drive(rows, descriptors), route_starts, single or rows)
    parts: list[Shown] = []
    with progress_of("smoothing", queries, progress, "query") as update:
        for mass, scores, known in seen:
            scores = scores.masked_fill(scores.isnan(), math.inf)
            ranked = near_scores(mass, scores, smoother.within) if smoother.is_drive else scores
            columns = None if known is None else known.expand_as(ranked)
            pair = best_candidates(ranked, min(2, ranked.shape[1]), TOLERANCE, columns)
            match = best_candidates(ranked, k, radius, columns)
            at = match.index[:, :1].clamp(min=0)
            if known is not None:
                at = torch.searchsorted(known, at).clamp(max=len(known) - 1)
            probability = mass_around(mass, at, smoother.within)
            if not smoother.is_drive and platt is not None:
                by_itself = platt.probability(confidence_of(scores))
                probability = by_itself if queries == 1 else torch.minimum(probability, by_itself)
            probability = probability.masked_fill(match.index[:, 0] < 0, 0)
            margin = pair.score[:, -1] - pair.score[:, 0] if places > 1 else pair.score[:, 0] * math.nan
            parts.append(Shown(match, margin, probability, scores.gather(1, at)[:, 0]))
            update(len(scores))
    if not parts:
        empty = torch.zeros(0, k)
        return Match(empty.long(), empty, empty.bool(), empty.double(), confidence=empty)
    parts.reverse()
    match = Match.joined(part.match for part in parts)
    margin = torch.cat([part.margin for part in parts])
    probability = torch.cat([part.probability for part in parts])
    own = torch.cat([part.own for part in parts])
    if smoother.is_drive:
        match = replace(match, score=match.score + doubt(own)[:, None])
    match = replace(match, score=match.score.to(own.dtype))
    return replace(match, probability=first_of(probability, k), confidence=first_of(margin.to(own.dtype), k))


# mass of places (B,n) in double precision, so that answers that are nearly sure differ; scores (B,n); which
# places (n,), or None for all; the last queries come first
Seen = Iterator[tuple[Tensor, Tensor, Tensor | None]]


def _mass(posterior: Tensor) -> Tensor:
    return normalised(PlaceSmoother.folded(posterior.cpu().double()))[:, :-1]


def _of_all_places(smoother: PlaceSmoother, drive: Drive, route_starts: Sequence[int], single: Rows) -> Seen:
    rows = drive.rows if smoother.is_drive else single
    for block in smoother.blocks(drive, route_starts):
        numbers = torch.arange(block.first, block.first + block.log.shape[-1])
        yield _mass(block.posterior), rows(numbers).cpu(), None


def _of_windows(drive: LargeDrive, single: Rows) -> Seen:
    for first, posterior, scores, places in drive:
        mass = _mass(posterior)
        if drive.smoother.is_drive:
            yield mass, scores, places
            continue
        for part in reversed(torch.arange(len(mass)).split(max(1, TILE // drive.places))):
            whole = mass.new_zeros(len(part), drive.places).index_copy(1, places, mass[part])
            yield whole, single(first + part).cpu(), None


def mass_around(mass: Tensor, at: Tensor, radius: int) -> Tensor:
    """The mass of a place (Q,1) and its neighbours up to a radius, (Q,N) -> (Q,)."""
    near = at + torch.arange(-radius, radius + 1)
    inside = (near >= 0) & (near < mass.shape[1])
    return (mass.gather(1, near.clamp(0, mass.shape[1] - 1)) * inside).sum(1).clamp(0, 1)


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
