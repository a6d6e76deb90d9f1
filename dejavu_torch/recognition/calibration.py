"""How probable it is that an answer is right: Platt scaling of how it stands out."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.recognition.filter import PlaceFilter, moments_of
from dejavu_torch.recognition.select import best_candidates, best_match
from dejavu_torch.types import InputError, Match, SequenceModel

TOLERANCE = 5  # places within which an answer is right
MARGIN = 2.0  # weight of the margin beside the score itself
SPREADS = 3.0  # nats of a filter's confidence for each standard deviation that single queries stand out by
MISSED = 20  # wrong answers that a visit may have been spared: they come in stretches of like places
MEMORY = 0.9  # of a track, from one query to the next
NEAR = 2  # places around an answer whose best score counts for a track
SURE = 1e-6  # smallest distance of a filter's probability from 0 and 1
STEPS = 100  # of Newton's method at most


class Platt(NamedTuple):
    """p = 1 / (1 + exp(-(slope * confidence + offset)))"""

    slope: float
    offset: float

    def probability(self, confidence: Tensor) -> Tensor:
        """(Q,) -> (Q,) float64 on the CPU, 0 where the confidence is -inf."""
        confidence = confidence.cpu().double()  # not every device has double precision
        p = torch.sigmoid(self.slope * confidence.nan_to_num(neginf=0.0) + self.offset)
        return torch.where(confidence.isneginf(), 0.0, p)


class Calibration(NamedTuple):
    """What makes probabilities of confidences, None if nothing does."""

    single: Platt | None = None  # of queries by themselves
    filter: Platt | None = None  # of a `PlaceFilter` that searches for every query

    def of(self, sequence: SequenceModel | None) -> Platt | None:
        """The one for a way of matching."""
        if sequence is None:
            return self.single
        return self.filter if isinstance(sequence, PlaceFilter) and sequence.search_every == 1 else None


def fit(confidence: Tensor, right: Tensor, weight: Tensor | None = None) -> Platt:
    """The slope and offset under which the answers that were seen are most likely.

    Args:
        confidence: (n,) float; -inf is left out. right: (n,) bool.
        weight: (n,) how often each answer counts; None is once.

    Convention: the targets are not 1 and 0, but (r + 1) / (r + 2) and 1 / (w + 2) for r right and w wrong
        answers, so that the fit is finite. If right answers had less confidence, the slope is 0.

    Source: Platt, Advances in Large Margin Classifiers (1999); by Newton's method, as of Lin, Lin and Weng,
        Machine Learning 68 (2007).
    """
    known = ~confidence.isneginf()
    if not bool((right & known).any()):
        raise InputError(f"none of {len(right)} answers is right; expected some, to calibrate by")
    x, y = confidence[known].double(), right[known]
    weight = torch.ones_like(x) if weight is None else weight[known].double()
    mean, spread = float(x.mean()), float(x.std(correction=0)) or 1.0
    columns = torch.stack([(x - mean) / spread, torch.ones_like(x)], 1)
    hits, misses = float(weight[y].sum()), float(weight[~y].sum())
    target = torch.where(y, (hits + 1) / (hits + 2), 1 / (misses + 2)).double()
    found = torch.tensor([0.0, math.log((hits + 1) / (misses + 1))], dtype=torch.float64)

    def loss(at: Tensor) -> Tensor:
        return F.binary_cross_entropy_with_logits(columns @ at, target, weight, reduction="sum")

    for _ in range(STEPS):
        p = torch.sigmoid(columns @ found)
        curvature = (columns * (weight * p * (1 - p))[:, None]).T @ columns
        curvature += 1e-9 * torch.eye(2, dtype=torch.float64)
        step = torch.linalg.solve(curvature, columns.T @ (weight * (p - target)))
        while loss(found - step) > loss(found) and float(step.abs().max()) > 1e-9:
            step = step / 2
        found = found - step
        if float(step.abs().max()) < 1e-9:
            break
    slope, offset = found.tolist()
    if slope < 0:
        share = (hits + 1) / (hits + misses + 2)
        return Platt(0.0, math.log(share / (1 - share)))
    return Platt(slope / spread, offset - slope / spread * mean)


def confidence_of(scores: Tensor) -> Tensor:
    """Confidence in the best place of each query, (Q,N) -> (Q,); -inf if none is found: minus its score, plus
    `MARGIN` times how much lower it is than the best beyond `TOLERANCE` places."""
    return confidence(best_candidates(scores, min(2, scores.shape[1]), TOLERANCE))


def confidence(candidates: Match) -> Tensor:
    """As `confidence_of`, by the two best places of each query, (Q,2), more than `TOLERANCE` apart."""
    best, second = candidates.score[:, 0], candidates.score[:, -1]
    margin = torch.where(second.isfinite(), second - best, 0)
    return torch.where(best.isfinite(), MARGIN * margin - best, -math.inf)


class Track:
    """Confidence in a filter's answers: their log odds, and how much single queries stood out there lately.

    The posterior alone does not do: off the map it follows the best of wrong places.
    """

    def __init__(self) -> None:
        self.sum = self.weight = 0.0

    def __call__(self, found: Tensor, scores: Tensor) -> Tensor:
        """Of the filter's scores and those of single queries, each (B,N) -> (B,) float64 on the CPU."""
        match = best_match(found)
        mean, spread, *_ = moments_of(scores)
        own = scores.gather(1, _around(match.index, NEAR, scores)).amin(1)
        rival = scores.scatter(1, _around(match.index, TOLERANCE, scores), math.inf).amin(1)
        margin = torch.where(rival.isfinite(), rival - own, 0)
        deviations = torch.where(own.isfinite(), (mean[:, 0] - own + MARGIN * margin) / spread[:, 0], 0)
        lately = []
        for one in deviations.tolist():
            self.sum = MEMORY * self.sum + (1 - MEMORY) * one
            self.weight = MEMORY * self.weight + 1 - MEMORY
            lately.append(self.sum / self.weight)
        score = match.score.cpu().double()
        odds = (-score).exp().clamp(SURE, 1 - SURE).logit()
        return torch.where(score.isfinite(), odds + SPREADS * odds.new_tensor(lately), -math.inf)


def _around(index: Tensor, radius: int, scores: Tensor) -> Tensor:
    """The places within a radius of each of (B,), as far as there are, (B, 2 radius + 1)."""
    near = index.clamp(min=0)[:, None] + torch.arange(-radius, radius + 1, device=index.device)
    return near.clamp(0, scores.shape[1] - 1)


@torch.no_grad()
def calibrated(
    route: PlaceMap, segments: Iterable[tuple[Tensor, Tensor]], another_visit: bool = False
) -> Calibration:
    """Fit on queries whose places are known, and on the same without the scores near these places: answers
    off the map, of which none is right.

    Args:
        segments: consecutive queries: descriptors (T,K) and places (T,) int64, -1 for unknown.
        another_visit: the queries are of another visit, whose own wrong answers show how often to expect one.
            Those off the map then count, together, for as many as lack to `MISSED`.
    """
    answers: tuple[list[tuple[Tensor, ...]], ...] = [], []  # of single queries, and of a filter
    for descriptors, places in segments:
        scores = torch.cat([route.scores(part) for part in descriptors.split(64)])
        places = places.to(scores.device)
        away = scores.scatter(1, _around(places, 2 * TOLERANCE, scores), math.inf)
        for one, on_map in ((scores, True), (away, False)):
            filtered = PlaceFilter()(one)
            pairs = (one, confidence_of(one)), (filtered, Track()(filtered, one))
            for rows, (found, own) in zip(answers, pairs, strict=True):
                index = best_match(found).index
                right = ((index - places).abs() <= TOLERANCE) & (index >= 0) & on_map
                columns = own, right, torch.full_like(right, on_map)
                rows.append(tuple(column[places >= 0].cpu() for column in columns))
    if not answers[0]:
        raise InputError("there are no queries to calibrate by; expected some")
    platts: list[Platt | None] = []
    for rows in answers:
        own, right, on_the_map = map(torch.cat, zip(*rows, strict=True))
        wrong = int((on_the_map & ~right).sum())
        away_weight = max(0, MISSED - wrong) / max(1, int((~on_the_map).sum())) if another_visit else 1.0
        weight = torch.where(on_the_map, 1.0, away_weight)
        platts.append(fit(own, right, weight) if not platts or bool(right.any()) else None)
    return Calibration(*platts)
