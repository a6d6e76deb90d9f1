"""What the scores of a drive say of each place, by their rank, and how its queries depend on each other."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.compiling import floats_of
from dejavu_torch.recognition import chosen, loops

LOWEST, HIGHEST, PER_DEVIATION = -8, 40, 64  # standard deviations of a rank table, and entries for each
MIN_SHARE = 1e-30  # of wrong scores, for a finite normal score
COLUMNS = 256  # of descriptors that are transformed at a time


class Spacing(NamedTuple):
    """How the queries of a drive depend on each other.

    weight: (Q,) float, 1 over the length of the stop that a query belongs to, and 1 while moving.
    still: (Q,) bool, in a stop of more than `STOP` queries, and not its first.
    correlation: tau, how many queries in a row say as much as one that is independent, at least 1.
    detrended: likewise, without slow changes, which say nothing of the noise of a query.
    """

    weight: Tensor
    still: Tensor
    correlation: float
    detrended: float


def spacing_of(queries: Tensor) -> Spacing:
    """The spacing of consecutive queries by their descriptors (Q,K)."""
    queries = queries.cpu().float()
    same = unchanged(queries)
    length = run_lengths(same)
    moving = queries[~same]
    detrended = correlation_time(moving, lambda part: part - local_mean(part, chosen.DETRENDED))
    return Spacing(1 / length, same & (length > chosen.STOP), correlation_time(moving), detrended)


def unchanged(queries: Tensor) -> Tensor:
    """Which queries hardly differ from the first of their stop, (Q,K) -> (Q,) bool."""
    same = torch.zeros(len(queries), dtype=torch.bool, device=queries.device)
    steps = (queries[1:] - queries[:-1]).norm(dim=1)
    moving = steps[steps > 0].sort().values
    if len(moving):  # a stop may be most of the drive
        moving = moving[moving > chosen.UNCHANGED * moving[len(moving) * 9 // 10]]
    least = chosen.UNCHANGED * float(moving.median()) if len(moving) else 0.0
    first = 0
    for t in ((steps <= least).nonzero()[:, 0] + 1).tolist():
        if not same[t - 1]:
            first = t - 1
        same[t] = (queries[t] - queries[first]).norm() <= least
    return same


def run_lengths(same: Tensor) -> Tensor:
    """Queries of the stop that each belongs to, 1 while moving: (Q,) bool -> (Q,)."""
    run = (~same).cumsum(0) - 1
    return run.bincount()[run]


def local_mean(queries: Tensor, side: int) -> Tensor:
    """The mean of the queries up to `side` before and after each, (Q,K) -> (Q,K)."""
    sums = F.pad(queries.double().cumsum(0), (0, 0, 1, 0))
    at = torch.arange(len(queries), device=queries.device)
    first, last = (at - side).clamp(min=0), (at + side + 1).clamp(max=len(queries))
    return ((sums[last] - sums[first]) / (last - first)[:, None]).to(queries)


def correlation_time(queries: Tensor, change: Callable[[Tensor], Tensor] = Tensor.double) -> float:
    """1 + 2 x the autocorrelations of the centred descriptors (Q,K), up to the first below .05; of columns
    that are changed first.

    Example:
        >>> correlation_time(torch.tensor([[1.0], [-1], [1], [-1]]))
        1.0
    """
    count = len(queries)
    if count < 2:
        return 1.0
    power = torch.zeros(count + 1, dtype=torch.float64, device=queries.device)
    for part in queries.split(COLUMNS, 1):  # which the cache holds
        part = change(part)
        centred = (part - part.mean(0)).double()
        power += torch.fft.rfft(centred, n=2 * count, dim=0).abs().square().sum(1)
    if not power.sum() > 0:
        return 1.0
    lags = torch.fft.irfft(power, n=2 * count)[:count] / torch.arange(count, 0, -1, device=power.device)
    lags = lags / lags[0]
    small = (lags < chosen.SMALLEST).nonzero()
    last = int(small[0]) if len(small) else max(1, count // 2)  # longer lags have few pairs
    return 1 + 2 * float(lags[1:last].sum())


class Standardised(NamedTuple):
    """z: (..., N), how far a score lies below the mean of its query, in standard deviations; the mean of each
    place over the queries is removed first, so that no place is good for all of them. speaks: (...), False
    where all scores are equal, or not finite. valid: (..., N), which scores of the others are finite; None is
    all, at a part of the time."""

    z: Tensor
    speaks: Tensor
    valid: Tensor | None = None

    def map(self, change: Callable[[Tensor], Tensor]) -> Standardised:
        """The same change of all columns."""
        return Standardised(*(None if one is None else change(one) for one in self))  # type: ignore[arg-type]

    def only(self, values: Tensor, other: float) -> Tensor:
        """Values (..., N) of the valid scores, and another for the rest."""
        return values if self.valid is None else values.masked_fill(~self.valid, other)


def all_finite(scores: Tensor) -> bool:
    """Whether no score is NaN or infinite; at times False if their sum is."""
    return bool(scores.sum().isfinite())


def place_means(scores: Tensor, weight: Tensor) -> Tensor:
    """The mean score of each place over the queries that say something, (Q,N), (Q,) -> (N,); 0 for a single
    query, of which nothing would be left."""
    if len(scores) == 1:
        return torch.zeros_like(scores[0])
    weight = weight * speaking(scores)
    if all_finite(scores):
        return weight @ scores / weight.sum().clamp(min=MIN_SHARE)
    valid = scores.isfinite()
    return weight @ torch.where(valid, scores, 0) / (weight @ valid.to(weight)).clamp(min=MIN_SHARE)


def speaking(scores: Tensor) -> Tensor:
    """Which queries have different scores, and no NaN, (Q,N) -> (Q,) bool."""
    if all_finite(scores):
        return scores.amax(1) > scores.amin(1)
    valid = scores.isfinite()
    highest = scores.masked_fill(~valid, -math.inf).amax(1)
    lowest = scores.masked_fill(~valid, math.inf).amin(1)
    return (highest > lowest) & ~scores.isnan().any(1)


def standardised(scores: Tensor, means: Tensor) -> Standardised:
    """Scores (Q,N) without the means (N,) of the places."""
    speaks, centred, valid = speaking(scores), scores - means, None
    count = torch.full_like(scores[:, :1], scores.shape[1])
    if not all_finite(scores):
        valid = scores.isfinite()
        centred, count = torch.where(valid, centred, 0), valid.sum(1, keepdim=True).clamp(min=1)
    centred = centred.sum(1, keepdim=True) / count - centred
    if valid is not None:
        centred = torch.where(valid, centred, 0)
    spread = (centred.square().sum(1, keepdim=True) / count).sqrt()
    speaks = speaks & (spread[:, 0] > MIN_SHARE)
    z = centred / torch.where(speaks[:, None], spread, 1)
    return Standardised(z, speaks, None if valid is None else valid | ~speaks[:, None])


class RankTable:
    """Normal scores: a z that a share u of the wrong ones reaches becomes x = -Phi^-1(u).

    A histogram of z, weighted by the probability of being wrong; `x` interpolates in between.

    Args:
        counts: of another table, to begin with.
    """

    def __init__(self, counts: Tensor | None = None) -> None:
        empty = torch.zeros((HIGHEST - LOWEST) * PER_DEVIATION + 1, dtype=torch.float64)
        self.counts = empty if counts is None else counts.clone()

    def add(self, z: Tensor, weight: Tensor) -> None:
        """Count values z with their weights, of the same shape."""
        bins = self._position(z).long().flatten().cpu()  # some devices have no double precision
        self.counts += torch.bincount(bins, weight.flatten().cpu().double(), minlength=len(self.counts))

    @property
    def values(self) -> Tensor:
        """x at the edge of each bin."""
        reached = self.counts.flip(0).cumsum(0).flip(0)
        share = (reached + 0.5) / (reached[0] + 1)
        values: Tensor = -torch.special.ndtri(share.clamp(MIN_SHARE, 1 - 1e-7)).float()
        return values

    @staticmethod
    def _position(z: Tensor) -> Tensor:
        return ((z - LOWEST) * PER_DEVIATION).clamp(0, (HIGHEST - LOWEST) * PER_DEVIATION - 1)

    @classmethod
    def look_up(cls, values: Tensor, z: Tensor) -> Tensor:
        """x of z by the `values` of a table, differentiable in z."""
        values = values.to(z)
        if z.numel() >= loops.WORTH_COMPILING:
            given, table = floats_of(z.reshape(-1)), floats_of(values)
            if given is not None and table is not None and (kernel := loops.looked_up()) is not None:
                found = np.empty_like(given)
                kernel(given, table, LOWEST, PER_DEVIATION, found)
                return torch.from_numpy(found).view(z.shape)
        at = cls._position(z)
        low = at.detach().long()
        # several times as fast as by brackets
        below, above = (values.index_select(0, one.flatten()).view_as(z) for one in (low, low + 1))
        return torch.lerp(below, above, at - low)
