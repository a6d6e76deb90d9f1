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
from dejavu_torch.types import Traverse

LOWEST, HIGHEST, PER_DEVIATION = -8, 40, 64  # standard deviations of a rank table, and entries for each
MIN_SHARE = 1e-30  # of wrong scores, for a finite normal score
COLUMNS = 256  # of descriptors that are transformed at a time
LEAST_WIDE = 1e-3  # of `Presence`, as a share of `off`
LOW, MIDDLE = torch.special.ndtri(torch.tensor(chosen.NEAREST)).tolist()  # standard deviations from the mean
NORMALISER = math.lgamma((chosen.TAIL + 1) / 2) - math.lgamma(chosen.TAIL / 2)  # log, of Student's t
NORMALISER -= math.log(chosen.TAIL * math.pi) / 2


class Spacing(NamedTuple):
    """How the queries of a drive depend on each other.

    weight: (Q,) float, 1 over the length of the stop that a query belongs to, 1 while moving, 0 if stale.
    stopped: (Q,) bool, in a stop of more than `STOP` queries, and not its first.
    correlation: tau, how many queries in a row say as much as one that is independent, at least 1.
    stale: (Q,) int64, how many queries in a row have repeated the picture before them, see `repeats`.
    """

    weight: Tensor
    stopped: Tensor
    correlation: float
    stale: Tensor


def spacing_of(queries: Tensor, monotone: bool = False) -> Spacing:
    """The spacing of consecutive queries by their descriptors (Q,K); monotone: as in `correlation_time`."""
    queries = queries.cpu().float()
    same, stale = unchanged(queries) | standing(queries), repeats(queries)
    fresh = stale == 0
    length = run_lengths(same, fresh)
    stopped = same & fresh & (length > chosen.STOP)
    return Spacing(fresh / length, stopped, correlation_time(queries[~same], monotone), stale)


def repeats(queries: Tensor, before: Tensor | None = None, so_far: int = 0) -> Tensor:
    """How many queries in a row, up to each, repeat the picture of the one before but for rounding, as of a
    stream that has stalled: (Q,K) -> (Q,) int64. Those of 0, as of dark frames, show no picture.

    Args:
        before: (K,), the query before the first. so_far: how many, up to that one.

    Example:
        >>> repeats(torch.tensor([[1.0], [1], [1], [2], [0], [0]])).tolist()
        [0, 1, 2, 0, 0, 0]
    """
    rows = queries if before is None else torch.cat([before[None].to(queries), queries])
    same = torch.zeros(len(rows), dtype=torch.int64)
    steps, sizes = (rows[1:] - rows[:-1]).norm(dim=1), rows[1:].norm(dim=1)
    same[1:] = ((steps <= chosen.ROUNDING * sizes) & (sizes > 0)).cpu()
    runs = same.cumsum(0)
    found = (runs - torch.where(same == 0, runs, 0).cummax(0).values)[len(rows) - len(queries) :]
    return found + so_far * (found == torch.arange(1, len(found) + 1))


def standing(queries: Tensor) -> Tensor:
    """Which queries show that nothing has moved since the one before, (Q,K) -> (Q,) bool.

    In a window of queries the mean square of the steps is twice the variance if they differ by noise alone,
    and less if they change (von Neumann's ratio, 1941). Of coordinates (Q,2) likewise.
    """
    size, count = chosen.WAIT, len(queries)
    stands = torch.zeros(count, dtype=torch.bool)
    if count < 2 * size:
        return stands

    def windows(column: Tensor, width: int) -> Tensor:
        sums: Tensor = F.pad(column.cumsum(0), (0, 0, 1, 0))
        return sums[width:] - sums[:-width]

    lost = queries.isnan().any(1).cpu()
    variance = torch.zeros(count - size + 1).double()
    steps, apart = torch.zeros(count - 1).double(), [count // 2, count // 3]
    unlike = [torch.zeros(count - lag).double() for lag in apart]
    for part in queries.split(COLUMNS, 1):
        rows = part.double().cpu()
        rows = (rows - rows.nanmean(0)).nan_to_num(0)
        squares = windows(rows.square(), size) - windows(rows, size).square() / size
        variance += squares.sum(1) / (size - 1)
        steps += (rows[1:] - rows[:-1]).square().sum(1)
        for total, lag in zip(unlike, apart, strict=True):
            total += (rows[lag:] - rows[:-lag]).square().sum(1)
    step = windows(steps[:, None], size - 1)[:, 0] / (size - 1)
    far = max(total.median() for total in unlike)  # laps of one length are alike half a drive apart
    still = (step >= chosen.NOISE * variance) | (variance <= 1e-9 * far)
    still &= (variance <= chosen.ALIKE * far) & (windows(lost[:, None].double(), size)[:, 0] == 0)
    still &= steps.unfold(0, size - 1, 1).amax(1) <= chosen.JUMP * variance + 1e-9 * far
    near = F.max_pool1d(F.pad(still.double(), (size - 2, size - 2))[None], size - 1, 1)[0]
    stands[1:] = near > 0
    return stands


def passed_of(drive: Traverse | None) -> Tensor | None:
    """How many frames of a drive have moved up to each, (N,), by its coordinates; None without them. A fix
    that is held for some frames, as of a receiver slower than the camera, is no wait."""
    if drive is None or drive.coordinates is None:
        return None
    fixes, run, length = drive.coordinates.values.unique_consecutive(
        dim=0, return_inverse=True, return_counts=True
    )
    waits = standing(fixes) | (length > max(chosen.WAIT, 3 * int(length.median())))
    first = F.pad(run[1:] != run[:-1], (1, 0), value=True)
    held = ~first & ~waits[run]  # the camera goes on
    passed: Tensor = (held | (first & ~standing(fixes)[run])).cumsum(0)
    return passed


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


def run_lengths(same: Tensor, counts: Tensor | None = None) -> Tensor:
    """Queries of the stop that each belongs to, 1 while moving, of those that count: (Q,) bool -> (Q,)."""
    run = (~same).cumsum(0) - 1
    return run.bincount(None if counts is None else counts.double())[run].float()


def correlation_time(queries: Tensor, monotone: bool = False) -> float:
    """1 + 2 x the autocorrelations of the centred descriptors (Q,K), up to the first below .05.

    Args:
        monotone: or up to the first above the two before it: beyond that, places that are passed again make
            queries alike, as in lines there and back over an area. Source: the initial monotone sequence of
            Geyer, Statistical Science 7 (1992), but for what alternates.

    Example:
        >>> correlation_time(torch.tensor([[1.0], [-1], [1], [-1]]))
        1.0
    """
    count = len(queries)
    if count < 2:
        return 1.0
    power = torch.zeros(count + 1, dtype=torch.float64, device=queries.device)
    for part in queries.split(COLUMNS, 1):  # which the cache holds
        part = part.double()
        centred = part - part.mean(0)
        power += torch.fft.rfft(centred, n=2 * count, dim=0).abs().square().sum(1)
    if not power.sum() > 0:
        return 1.0
    lags = torch.fft.irfft(power, n=2 * count)[:count] / torch.arange(count, 0, -1, device=power.device)
    lags = lags / lags[0]
    before = F.pad(lags, (2, 0), value=1.0).unfold(0, 2, 1).amax(1)[:count]
    ends = ((lags < chosen.SMALLEST) | (monotone & (lags > before))).nonzero()
    last = int(ends[0]) if len(ends) else max(1, count // 2)  # longer lags have few pairs
    return 1 + 2 * float(lags[1:last].sum())


class Standardised(NamedTuple):
    """z: (..., N), how far a score lies below the mean of its query, in standard deviations; the mean of each
    place over the queries is removed first, so that no place is good for all of them. speaks: (...), False
    where all scores are equal, or not finite. valid: (..., N), which scores of the others are finite; None is
    all, at a part of the time. absent: (...), log likelihood ratio of being off the map by how near a query
    comes to it, see `Presence`. holes: (..., N), places that no query has a score at: a query there is off
    the map, but the camera may pass; None is no place."""

    z: Tensor
    speaks: Tensor
    valid: Tensor | None = None
    absent: Tensor | None = None
    holes: Tensor | None = None

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
    """The mean score of each place over the queries that say something, (Q,N), (Q,) -> (N,); +inf where none
    has a score, and 0 for a single query, of which nothing would be left."""
    if len(scores) == 1:
        return torch.zeros_like(scores[0])
    weight = weight * speaking(scores)
    if all_finite(scores):
        return weight @ scores / weight.sum().clamp(min=MIN_SHARE)
    valid = scores.isfinite()
    total, share = weight @ torch.where(valid, scores, 0), weight @ valid.to(weight)
    return torch.where(share > 0, total / share.clamp(min=MIN_SHARE), math.inf)


def speaking(scores: Tensor) -> Tensor:
    """Which queries have different scores, and no NaN, (Q,N) -> (Q,) bool."""
    if all_finite(scores):
        return scores.amax(1) > scores.amin(1)
    valid = scores.isfinite()
    highest = scores.masked_fill(~valid, -math.inf).amax(1)
    lowest = scores.masked_fill(~valid, math.inf).amin(1)
    return (highest > lowest) & ~scores.isnan().any(1)


class Presence(NamedTuple):
    """How near queries come to a map, by the best score of each.

    On the map, they are about `on`, by a scale of `wide`, with some that are hard to recognise (Student's t).
    Those that show nothing of it are about `off`, with a deviation of `spread`; those of ground that looks
    like it, between `on` and `off`, the more often the farther. Each is one number, or one for each query.
    """

    on: float | Tensor
    wide: float | Tensor
    off: float | Tensor
    spread: float | Tensor

    def absent(self, best: Tensor) -> Tensor:
        """Log likelihood ratio of being off the map by the best scores (...) of queries. It is bounded, and
        says little of being on the map, as an image of other ground may come near, too."""
        on, wide, off, spread = (torch.as_tensor(one, dtype=best.dtype, device=best.device) for one in self)
        x = torch.minimum(torch.maximum(best, on), off)
        # written out, since torch.distributions cannot be exported
        own = NORMALISER - wide.log() - (chosen.TAIL + 1) / 2 * (((x - on) / wide) ** 2 / chosen.TAIL).log1p()
        null = (-(((x - off) / spread) ** 2) / 2).exp() / (spread * math.sqrt(2 * math.pi))
        alike = 2 * (x - on) / (off - on) ** 2
        told: Tensor = ((alike + null) / 2).clamp(min=MIN_SHARE).log() - own
        return told.clamp(-chosen.MOST_PRESENT, chosen.MOST_ABSENT).nan_to_num(0, 0, 0)


def presence_of(best: Tensor, null: Tensor) -> Presence | None:
    """From the best scores of queries (n,), of which under half may be off the map, and of queries that show
    nothing of it, (m,); None if those are no nearer than these."""
    best, null = (one[one.isfinite()].float().cpu() for one in (best, null))
    if min(len(best), len(null)) < 2:
        return None
    low, on = best.quantile(best.new_tensor(chosen.NEAREST)).tolist()
    off, least = float(null.mean()), LEAST_WIDE * float(null.abs().mean()) + MIN_SHARE
    wide = max(least, (on - low) / (MIDDLE - LOW))
    return Presence(on, wide, off, max(least, float(null.std()))) if on < off else None


def standardised(scores: Tensor, means: Tensor, presence: Presence | None = None) -> Standardised:
    """Scores (Q,N) without the means (N,) of the places."""
    speaks, valid, known = speaking(scores), None, means.isfinite()
    centred = scores - (means if bool(known.all()) else means.where(known, 0))
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
    absent = None if presence is None else presence.absent(scores.amin(1))
    holes = None if valid is None or known.all() or not known.any() else ~known & ~valid
    return Standardised(z, speaks, None if valid is None else valid | ~speaks[:, None], absent, holes)


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
