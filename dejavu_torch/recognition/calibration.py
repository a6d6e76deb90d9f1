"""The probability that an answer is right: Platt scaling of a confidence."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.places.layout import ROUTE, Layout
from dejavu_torch.recognition.engine import normalised
from dejavu_torch.recognition.filter import FilterState, PlaceFilter, moments_of
from dejavu_torch.recognition.select import best_candidates, best_match
from dejavu_torch.recognition.smoother import Drive, PlaceSmoother
from dejavu_torch.types import InputError, Match, SequenceModel, expect

TOLERANCE = 5  # places within which an answer is right, as files of maps hold it
POWER = 0.75  # of the best score elsewhere in a confidence, chosen by `python -m benchmarks order`
SAME = 1e-6  # two places whose scores are both below it equal the query, and nothing tells them apart
MARGIN = 2.0  # weight of the margin beside the score itself in a track, and in confidences of older files
NATS_PER_DEVIATION = 3.0  # weight in a filter's confidence of how far single queries stand out
MIN_WRONG = 20  # wrong answers to expect of a visit that shows fewer, as they occur in clusters
DECAY = 0.9  # of a track's running mean, per query
ANSWER_RADIUS = 2  # places around an answer whose best score counts for a track
MIN_PROBABILITY = 1e-6  # a filter's probabilities are clamped to [this, 1 - this]
MAX_STEPS = 100  # of Newton's method
STRETCH = 50  # places on each side that are held out with a place, for its look-alikes to answer
AGAIN, SURE = 0.05, 0.9  # more places than this, with look-alikes as sure as this: roads passed again


class Platt(NamedTuple):
    """p = 1 / (1 + exp(-(slope * confidence + offset))), but at most p_k for confidences up to c_k, where
    `most` is ((c_1, p_1), ..): what `look_alikes` allow. margin: of a file of an older version, see
    `confidence`."""

    slope: float
    offset: float
    most: tuple[tuple[float, float], ...] = ()
    margin: float | None = None

    def probability(self, confidence: Tensor) -> Tensor:
        """(Q,) -> (Q,) float64 on the CPU, 0 for a confidence of -inf."""
        confidence = confidence.cpu().double()  # not every device has double precision
        p = torch.sigmoid(self.slope * confidence.nan_to_num(neginf=0.0) + self.offset)
        for upper, most in self.most:
            p = torch.where(confidence <= upper, p.clamp(max=most), p)
        return torch.where(confidence.isneginf(), 0.0, p)


class Calibration(NamedTuple):
    """The Platt scaling of each way of matching that is calibrated."""

    single: Platt | None = None  # single queries
    filter: Platt | None = None  # a `PlaceFilter`

    def of(self, sequence: SequenceModel | None) -> Platt | None:
        """The scaling for a way of matching; None if that is not calibrated."""
        if sequence is None:
            return self.single
        return self.filter if sequence.answers == "filter" else None


def strictest(known: Sequence[Calibration | None]) -> Calibration | None:
    """Of the calibrations of several routes, the scalings that give the lower probabilities; None if one
    route has none."""

    def strict(column: Sequence[Platt | None], low: float, high: float) -> Platt | None:
        some, grid = [platt for platt in column if platt is not None], torch.linspace(low, high, 101)
        lowest = min(some, key=lambda platt: float(platt.probability(grid).mean()), default=None)
        return lowest if len(some) == len(column) else None

    single, filtered = zip(*(one or Calibration() for one in known), strict=True)
    found = Calibration(strict(single, -1, 0), strict(filtered, -14, 40))
    return found if any(found) else None


def fit(confidence: Tensor, right: Tensor, weight: Tensor | None = None) -> Platt:
    """Maximum-likelihood slope and offset.

    Args:
        confidence: (n,) float; -inf is ignored. right: (n,) bool. weight: (n,) of each answer; None is 1.

    Convention: the targets are (r + 1) / (r + 2) and 1 / (w + 2) for r right and w wrong answers, instead of
        1 and 0, so that the fit is finite. A negative slope becomes 0.

    Source: Platt, Advances in Large Margin Classifiers (1999), by the Newton method of Lin, Lin and Weng,
        Machine Learning 68 (2007).
    """
    known = ~confidence.isneginf()
    if not bool((right & known).any()):
        raise InputError(f"none of {len(right)} answers is right; calibration needs some right answers")
    x, y = confidence[known].double(), right[known]
    weight = torch.ones_like(x) if weight is None else weight[known].double()
    mean, spread = float(x.mean()), float(x.std(correction=0)) or 1.0
    columns = torch.stack([(x - mean) / spread, torch.ones_like(x)], 1)
    hits, misses = float(weight[y].sum()), float(weight[~y].sum())
    target = torch.where(y, x.new_tensor((hits + 1) / (hits + 2)), 1 / (misses + 2))
    params = x.new_tensor([0.0, math.log((hits + 1) / (misses + 1))])

    def loss(at: Tensor) -> Tensor:
        return F.binary_cross_entropy_with_logits(columns @ at, target, weight, reduction="sum")

    for _ in range(MAX_STEPS):
        p = torch.sigmoid(columns @ params)
        curvature = (columns * (weight * p * (1 - p))[:, None]).T @ columns
        curvature.diagonal().add_(1e-9)
        step = torch.linalg.solve(curvature, columns.T @ (weight * (p - target)))
        while loss(params - step) > loss(params) and float(step.abs().max()) > 1e-9:
            step = step / 2
        params = params - step
        if float(step.abs().max()) < 1e-9:
            break
    slope, offset = params.tolist()
    if slope < 0:
        share = (hits + 1) / (hits + misses + 2)
        return Platt(0.0, math.log(share / (1 - share)))
    return Platt(slope / spread, offset - slope / spread * mean)


def look_alikes(platt: Platt, right: Tensor, own: Tensor, others: Tensor) -> Platt:
    """The same, but no more than the share of right answers among all at least as confident, if half of the
    queries are on the map, and the other half look like some place of it.

    Args:
        right: (r,) confidences in right answers, -inf for wrong ones. own: (n,), of the map's own frames.
        others: (n,), of these without the places around each, whose look-alikes then answer.

    Convention: where the latter are often sure, a route passes places twice: nothing changes.
    """
    most, again = [], float((platt.probability(others) >= SURE).double().mean())
    ordered = others[others.isfinite()].double().sort(descending=True).values
    for k in (2**i for i in range(1, len(ordered).bit_length()) if again <= AGAIN):  # one is chance
        upper = float(ordered[k - 1])
        found = sum(float((known.cpu() >= upper).double().mean()) for known in (right, own)) / 2
        limit = found / (found + k / len(others))
        if limit < float(platt.probability(others.new_tensor([upper]))):
            most.append((float(f"{upper:.6g}"), round(limit, 3)))
    return platt._replace(most=tuple(most))


def best_pair(
    scores: Tensor, layout: Layout = ROUTE, places: Tensor | None = None, apart: int = TOLERANCE
) -> Match:
    """The two best places of each query that are more than `TOLERANCE` apart, or more, (Q,N) -> (Q,2)."""
    return best_candidates(scores, min(2, scores.shape[1]), max(TOLERANCE, apart), places, layout)


def confidence_of(scores: Tensor, layout: Layout = ROUTE, margin: float | None = None) -> Tensor:
    """`confidence` in the best place of each query, (Q,N) -> (Q,)."""
    return confidence(best_pair(scores, layout), margin)


def confidence(pair: Match, margin: float | None = None) -> Tensor:
    """Confidence in the better of two places that are more than `TOLERANCE` apart, (Q,2) -> (Q,): -s1 / s2^p
    for their scores and p = `POWER`; at most 0, -inf if no place is found. With p = 1 it would be the ratio
    of Lowe's test (2004), with p = 0 the score itself. The unit of scores does not matter to the order.

    Args:
        margin: the weight w in w (s2 - s1) - s1, which calibrations of older files were fitted to.
    """
    best, second = pair.score[:, 0], pair.score[:, -1]
    second = torch.where(second.isfinite(), second, best)
    if margin is None:  # a cosine distance may be rounded to less than 0
        sure = torch.where(second > SAME, -best.clamp(min=0) / second.clamp(min=SAME) ** POWER, -1)
    else:
        sure = margin * (second - best) - best
    return torch.where(best.isfinite(), sure, -math.inf)


class Track:
    """Confidence in a filter's answers: their log odds, plus a running mean of how far the scores of single
    queries stand out at these places. The posterior alone is overconfident off the map, where it follows the
    best of the wrong places."""

    def __init__(self, layout: Layout = ROUTE) -> None:
        self.layout, self.sum, self.weight = layout, 0.0, 0.0

    def __call__(self, filtered: Tensor, scores: Tensor) -> Tensor:
        """The filter's scores and those of single queries, each (B,N) -> (B,) float64 on the CPU."""
        match = best_match(filtered)
        mean, spread, *_ = moments_of(scores)
        own = scores.gather(1, _window(match.index, ANSWER_RADIUS, scores, self.layout)).amin(1)
        rival = scores.scatter(1, _window(match.index, TOLERANCE, scores, self.layout), math.inf).amin(1)
        margin = torch.where(rival.isfinite(), rival - own, 0)
        deviations = torch.where(own.isfinite(), (mean[:, 0] - own + MARGIN * margin) / spread[:, 0], 0)
        means = []
        for deviation in deviations.tolist():
            self.sum = DECAY * self.sum + (1 - DECAY) * deviation
            self.weight = DECAY * self.weight + 1 - DECAY
            means.append(self.sum / self.weight)
        score = match.score.cpu().double()
        odds = (-score).exp().clamp(MIN_PROBABILITY, 1 - MIN_PROBABILITY).logit()
        return torch.where(score.isfinite(), odds + NATS_PER_DEVIATION * odds.new_tensor(means), -math.inf)


def _window(index: Tensor, radius: int, scores: Tensor, layout: Layout = ROUTE) -> Tensor:
    """The places within a radius of each index, (B,) -> (B,n), clamped to the map."""
    return layout.reaching(scores.shape[1]).around(index.clamp(min=0), radius)


@torch.no_grad()
def calibrated(
    place_map: PlaceMap,
    segments: Iterable[tuple[Tensor, Tensor]],
    another_visit: bool = False,
    own: tuple[Tensor, Tensor] | None = None,
    reach: int = TOLERANCE,
) -> Calibration:
    """Fit on queries with known places, once as they are and once without the scores near these places. The
    latter stand for queries off the map, whose answers are all wrong.

    Args:
        segments: consecutive queries: descriptors (T,K) and places (T,) int64, -1 for unknown.
        another_visit: the queries are of another visit, whose own wrong answers show how frequent they are.
            The answers off the map then weigh, in total, only `MIN_WRONG` minus the number of these.
        own: descriptors (n,K) of the map's own frames, and their places: what look like them elsewhere limits
            the probability of single queries, see `look_alikes`.
        reach: places within which an answer is right.
    """
    layout, around_own = place_map.layout, min(2 * max(reach, TOLERANCE), place_map.places)
    answers: tuple[list[tuple[Tensor, ...]], ...] = [], []  # of single queries, of a filter
    for descriptors, places in segments:
        scores = torch.cat([place_map.scores(part) for part in descriptors.split(64)])
        places = places.to(scores.device)
        off_map = scores.scatter(1, _window(places, around_own, scores, layout), math.inf)
        for single, on_map in ((scores, True), (off_map, False)):
            filtered = PlaceFilter(within=reach).over(layout)(single)
            pairs = (single, confidence_of(single, layout)), (filtered, Track(layout)(filtered, single))
            for rows, (scored, confidences) in zip(answers, pairs, strict=True):
                index = best_match(scored).index
                near = layout.distance(index.clamp(min=0), places.clamp(min=0)) <= reach
                right = near & (index >= 0) & (places >= 0) & on_map
                columns = confidences, right, torch.full_like(right, on_map)
                rows.append(tuple(column.cpu()[places.cpu() >= 0] for column in columns))
    expect(answers[0], "some", "there are no queries to calibrate by")
    platts: list[Platt | None] = []
    for rows in answers:
        confidences, right, on_the_map = map(torch.cat, zip(*rows, strict=True))
        sure, p, off = confidences[on_the_map], right[on_the_map].double(), confidences[~on_the_map]
        platts.append(_fit_all(sure, p, off, another_visit) if not platts or bool(right.any()) else None)
        if own is not None and len(platts) == 1 and platts[0] is not None:
            known = torch.where(right, confidences, -math.inf)[on_the_map]
            scores = torch.cat([place_map.scores(part) for part in own[0].split(64)])
            places, apart = own[1].to(scores.device), min(STRETCH, place_map.places // 4)
            near = layout.passed_again(places, apart)
            pair = (confidence_of(one, layout).cpu() for one in (scores, scores.scatter(1, near, math.inf)))
            platts[0] = look_alikes(platts[0], known, *pair)
    return Calibration(*platts)


@torch.no_grad()
def calibrated_by_drive(
    blocks: Iterable[Tensor],
    places: Tensor,
    smoother: PlaceSmoother,
    drive: Drive,
    layout: Layout,
) -> Calibration:
    """Fit on all queries of a drive whose places nobody told: each counts as right with the probability that
    the others of the drive give its answer.

    Args:
        blocks: the scores of consecutive queries, (B,N) each. places: (Q,), where a smoother is sure, else
            -1: without the scores near these, queries stand for some off the map.
        smoother, drive: fitted to all queries. layout: of the places.
    """
    single: tuple[list[Tensor], ...] = [], [], []  # answers, confidences, and those off the map
    filtered: tuple[list[Tensor], ...] = [], [], []
    tracks, first = (Track(layout), Track(layout)), 0
    filters = [PlaceFilter().over(layout) for _ in tracks]
    states: list[FilterState] = []
    for scores in blocks:
        place = places[first : first + len(scores)].to(scores.device)
        first, known = first + len(scores), place >= 0
        states = states or [filter.start(scores.shape[1]) for filter in filters]
        near = scores.scatter(1, layout.around(place.clamp(min=0), 2 * TOLERANCE), math.inf)
        for i, rows in enumerate((scores, torch.where(known[:, None], near, scores))):
            belief, states[i] = filters[i].step(rows, states[i], layout.starts)
            track = tracks[i](belief, rows)
            pairs = (single, rows, confidence_of(rows, layout).cpu()), (filtered, belief, track)
            for found, scored, confidences in pairs:
                if i:
                    found[2].append(confidences[known.cpu()])
                else:
                    found[0].append(best_match(scored).index.cpu())
                    found[1].append(confidences)
    answers = [torch.cat(found[0]) for found in (single, filtered)]
    right: tuple[list[Tensor], list[Tensor]] = [], []
    for block in smoother.blocks(drive, layout.starts):
        others = normalised(block.motion.folded(block.others.cpu().double()))[:, :-1]
        own = slice(block.first, block.first + len(others))
        for masses, index in zip(right, answers, strict=True):
            near = layout.mass_near(others, index[own].clamp(min=0), TOLERANCE)
            masses.append(torch.where(index[own] >= 0, near, 0.0))
    platts = []
    for (_, sure, off), masses in zip((single, filtered), right, strict=True):
        known, p = torch.cat(sure).double(), torch.cat(masses[::-1]).clamp(0, 1)
        platts.append(_fit_all(known, p, torch.cat(off).double()))
    return Calibration(*platts)


def _fit_all(sure: Tensor, p: Tensor, off: Tensor, another_visit: bool = True) -> Platt:
    """Fit to confidences in answers that are right with probabilities p, (n,) each, and in answers off the
    map, which weigh, in total, what another visit lacks to `MIN_WRONG` wrong ones, else as much as others."""
    weight = max(0.0, MIN_WRONG - float((1 - p).sum())) / max(1, len(off)) if another_visit else 1.0
    weights = torch.cat([p, 1 - p, torch.full_like(off, weight, dtype=p.dtype)])
    labels = torch.arange(len(weights)) < len(p)
    some = weights > 0
    return fit(torch.cat([sure, sure, off])[some], labels[some], weights[some])
