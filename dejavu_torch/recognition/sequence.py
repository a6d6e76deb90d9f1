"""The place of the latest of several queries, driven past one after another."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor

from dejavu_torch.types import InputError, SequenceModel

LONGEST = 2**16  # queries of a sequence

log = logging.getLogger("dejavu_torch")


class SequenceMatcher(SequenceModel):
    """Scores of places from the latest T queries instead of one, for any map.

    The score of place i is the mean over trajectories that end there: of the query k steps before the latest,
    the score of place i - v k, rounded; of several speeds v the best counts. Only earlier queries are used.

    Args:
        length: T, queries of a sequence; where steps are resampled, steps.
        speeds: each v in places a query: 1 where both traverses went equally fast, negative for the way back.

    Shape: scores (Q,N), the R rows ahead of them or None -> (Q,N), lower is better.

    Convention: the first queries have fewer before them, and use these. The part of a trajectory that lies
        off the map, or on places that nothing covers, is left out of the mean; less than half of it on the
        map scores +inf, and so does a place that nothing covers for the latest query. Half a place is rounded
        up. Gradients reach the scores.

    Source: constant-speed search of SeqSLAM (Milford and Wyeth, ICRA 2012), causal and without its
        normalisation.

    Raises:
        InputError: a length below 1 or above 65536, no speeds, or speeds that are not finite; forward: scores that are no
            (Q,N), or rows ahead of another number of places.

    Example:
        >>> scores = torch.tensor([[0.0, 5, 5, 0], [5, 0.0, 0, 5], [0, 5, 0.0, 5]])
        >>> scores.argmin(1), SequenceMatcher(length=3)(scores).argmin(1)
        (tensor([0, 1, 0]), tensor([0, 1, 2]))
    """

    def __init__(self, length: int = 11, speeds: Sequence[float] = (1.0,)) -> None:
        super().__init__()
        if not isinstance(length, int) or not 1 <= length <= LONGEST:
            raise InputError(f"a sequence of {length} queries; expected a whole number, at least 1, at most {LONGEST}")
        given = tuple(float(speed) for speed in speeds) if isinstance(speeds, Iterable) else ()
        if not given or not all(map(math.isfinite, given)):
            raise InputError(
                f"the speeds are {speeds}; expected finite numbers of places a query, at least one"
            )
        self.length, self.speeds = length, given

    @property
    def shifts(self) -> tuple[tuple[int, ...], ...]:
        """See `SequenceModel`; half a place is rounded up."""
        return tuple(_shifts(speed, self.length) for speed in self.speeds)

    def forward(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        (found,) = self.sums(scores, (self.length,), before)
        return found

    def sums(self, scores: Tensor, lengths: Sequence[int], before: Tensor | None = None) -> Iterator[Tensor]:
        """As `forward`, for each of several lengths: the sums of short ones are on the way to the long.

        Args:
            lengths: each T, ascending.

        Shape: as `forward`, one (Q,N) for each length.
        """
        fits = before is None or before.shape[1:] == scores.shape[1:]
        if scores.ndim != 2 or not fits or not scores.is_floating_point():
            seen = f"{tuple(scores.shape)} {scores.dtype}"
            seen += f" behind {tuple(before.shape)}" if before is not None else ""
            raise InputError(f"scores are {seen}; expected floats (Q,N), and (R,N) ahead of them")
        rows = scores if before is None else torch.cat([_last(before, lengths[-1] - 1), scores])
        ahead, steps = len(rows) - len(scores), min(lengths[-1], len(rows))
        gaps = ~rows.isfinite()
        covered = not gaps.any()
        known = rows if covered else rows.masked_fill(gaps, 0)
        ways = [_Way(scores, speed, steps) for speed in self.speeds]
        done = 0
        for length in lengths:
            for k in range(done, min(length, steps)):
                for way in ways:
                    way.add(known, k, ahead)
                    if not covered:
                        way.leave_out(gaps, k, ahead)
            done = max(done, min(length, steps))
            if length == 1:
                yield scores
                continue
            first = min(ahead + 1, length)  # queries of the first row's sequence; the same for all is one row
            used = torch.arange(first, first + (1 if first == length else len(scores)), device=rows.device)
            means = (way.mean(used.clamp(max=length)) for way in ways)
            best = functools.reduce(torch.minimum, means)
            yield best if covered else best.masked_fill(gaps[ahead:], math.inf)

    def stream(self, batches: Iterable[Tensor]) -> Iterator[Tensor]:
        """See `SequenceModel`; between two batches T - 1 rows are kept."""
        return (found for (found,) in self.stream_sums(batches, (self.length,)))

    def stream_sums(self, batches: Iterable[Tensor], lengths: Sequence[int]) -> Iterator[list[Tensor]]:
        """`sums` of batches (B,N) that come one behind the other; the longest T - 1 rows are kept."""
        before = None
        for scores in batches:
            if not len(scores):
                continue
            yield list(self.sums(scores, lengths, before))
            rows = scores if before is None else torch.cat([before, scores])
            before = _last(rows, lengths[-1] - 1)

    def trajectory(self, scores: Tensor, place: int) -> Tensor:
        """The cells of which the last query's score of a place is the mean.

        Args:
            place: one whose score is finite.

        Shape: (Q,N) -> (C,2) query and place of each of at most T cells, the latest query first.
        """
        means = [float(SequenceMatcher(self.length, (v,))(scores)[-1, place]) for v in self.speeds]
        back = torch.tensor(self.shifts[means.index(min(means))][: len(scores)])
        cells = torch.stack([len(scores) - 1 - torch.arange(len(back)), place - back], 1)
        cells = cells[(cells[:, 1] >= 0) & (cells[:, 1] < scores.shape[1])]
        return cells[scores.cpu()[cells[:, 0], cells[:, 1]].isfinite()]

    def check(self, queries: int | None, places: int) -> None:
        """See `SequenceModel`: warn of fewer queries than T; refuse trajectories longer than the map."""
        for speed, shifts in zip(self.speeds, self.shifts, strict=True):
            if abs(shifts[-1]) >= places:
                raise InputError(
                    f"a sequence of {self.length} queries at {speed:g} places a query on a map of {places} "
                    "places; expected a shorter one, or speeds that do not leave the map"
                )
        if queries is not None and self.length > queries:
            log.warning("a sequence of %d queries, but there are %d: all of them count", self.length, queries)

    def extra_repr(self) -> str:
        return f"length={self.length}, speeds={list(self.speeds)}"


class _Way:
    """Sums along trajectories of one speed that grow a step at a time.

    scores: (Q,N), whose size they have. steps: how many at most.
    """

    def __init__(self, scores: Tensor, speed: float, steps: int) -> None:
        places = scores.shape[1]
        self.shifts = _shifts(speed, steps)
        passed = torch.arange(places) - torch.tensor(self.shifts)[:, None]
        on_map = ((passed >= 0) & (passed < places)).to(scores)
        self.inside = on_map.cumsum(0)  # (steps,N) of the trajectories that end at a place, steps on the map
        self.total = torch.zeros_like(scores)
        self.missing: Tensor | None = None

    def add(self, rows: Tensor, k: int, ahead: int) -> None:
        """The scores k steps before the last; `ahead` of the rows are ahead of the first of these."""
        self._add(self.total, rows, k, ahead)

    def leave_out(self, gaps: Tensor, k: int, ahead: int) -> None:
        """Count steps on the map that have no score."""
        self.missing = torch.zeros_like(self.total) if self.missing is None else self.missing
        self._add(self.missing, gaps, k, ahead)

    def _add(self, total: Tensor, rows: Tensor, k: int, ahead: int) -> None:
        shift, places = self.shifts[k], total.shape[1]
        to = slice(max(0, shift), places + min(0, shift))
        of = slice(max(0, -shift), places - max(0, shift))
        if to.start < to.stop:  # else no trajectory is on the map so far back
            first = max(0, k - ahead)  # the first query that has one k steps before it
            total[first:, to] += rows[ahead + first - k : len(rows) - k, of]

    def mean(self, used: Tensor) -> Tensor:
        """Of the sums so far, over so many queries, (Q,) or one for all; +inf on too little of the map."""
        count = self.inside[used - 1]
        if self.missing is not None:
            count = count - self.missing
        return torch.where(2 * count >= used[:, None], self.total / count.clamp(min=1), math.inf)


def _shifts(speed: float, steps: int) -> tuple[int, ...]:
    """How many places back a trajectory lies 0, 1, .. queries before the latest."""
    return tuple(math.floor(speed * k + 0.5) for k in range(steps))


def _last(rows: Tensor, count: int) -> Tensor:
    return rows[max(0, len(rows) - count) :]
