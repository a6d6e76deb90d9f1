"""The place of the latest of several queries, driven past one after another."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor, nn

from dejavu_torch.types import InputError

log = logging.getLogger("dejavu_torch")


class SequenceModel(nn.Module, ABC):
    """Scores of places from consecutive queries, not from one: what `sequence` of `DejaVu.localize` takes.

    Convention: causal; the score of a query tells of the place of that query.
    """

    @abstractmethod
    def stream(self, batches: Iterable[Tensor]) -> Iterator[Tensor]:
        """Scores of batches (B,N) that come one behind the other, from those of single queries.

        Memory does not grow with the queries.
        """

    @abstractmethod
    def check(self, queries: int, places: int) -> None:
        """Refuse, or warn of, a number of queries or places that it makes no sense for.

        Raises:
            InputError: naming both.
        """

    def threshold_of(self, threshold: float | None) -> float | None:
        """What a score has to be below to be accepted, where it is `threshold` for single queries."""
        return threshold


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
        InputError: a length below 1, no speeds, or speeds that are not finite; forward: scores that are no
            (Q,N), or rows ahead of another number of places.

    Example:
        >>> scores = torch.tensor([[0.0, 5, 5, 0], [5, 0.0, 0, 5], [0, 5, 0.0, 5]])
        >>> scores.argmin(1), SequenceMatcher(length=3)(scores).argmin(1)
        (tensor([0, 1, 0]), tensor([0, 1, 2]))
    """

    def __init__(self, length: int = 11, speeds: Sequence[float] = (1.0,)) -> None:
        super().__init__()
        if not isinstance(length, int) or length < 1:
            raise InputError(f"a sequence of {length} queries; expected a whole number, at least 1")
        if not len(speeds) or not all(math.isfinite(speed) for speed in speeds):
            raise InputError(f"the speeds are {list(speeds)}; expected finite numbers of places a query")
        self.length, self.speeds = length, tuple(float(speed) for speed in speeds)

    def forward(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        fits = before is None or before.shape[1:] == scores.shape[1:]
        if scores.ndim != 2 or not fits or not scores.is_floating_point():
            seen = f"{tuple(scores.shape)} {scores.dtype}"
            seen += f" behind {tuple(before.shape)}" if before is not None else ""
            raise InputError(f"scores are {seen}; expected floats (Q,N), and (R,N) ahead of them")
        if self.length == 1:
            return scores
        rows = scores if before is None else torch.cat([before[1 - self.length :], scores])
        ahead = len(rows) - len(scores)
        on_map = rows.isfinite()
        known, count = torch.where(on_map, rows, 0), on_map.to(rows.dtype)
        used = torch.arange(ahead + 1, len(rows) + 1, device=rows.device).clamp(max=self.length)[:, None]
        best = torch.full_like(scores, math.inf)
        for speed in self.speeds:
            total, inside = torch.zeros_like(scores), torch.zeros_like(scores)
            for k in range(min(self.length, len(rows))):
                shift = math.floor(speed * k + 0.5)
                first = max(0, k - ahead)  # the first query that has one k steps before it
                to = slice(max(0, shift), scores.shape[1] + min(0, shift))
                of = slice(max(0, -shift), scores.shape[1] - max(0, shift))
                if to.start >= to.stop:
                    break  # so far back no trajectory is on the map
                part = slice(ahead + first - k, len(rows) - k)
                total[first:, to] += known[part, of]
                inside[first:, to] += count[part, of]
            mean = total / inside.clamp(min=1)
            best = torch.minimum(best, torch.where(2 * inside >= used, mean, math.inf))
        return torch.where(scores.isfinite(), best, math.inf)

    def stream(self, batches: Iterable[Tensor]) -> Iterator[Tensor]:
        """See `SequenceModel`; between two batches T - 1 rows are kept."""
        before = None
        for scores in batches:
            yield self(scores, before)
            rows = scores if before is None else torch.cat([before, scores])
            before = rows[max(0, len(rows) - self.length + 1) :]

    def trajectory(self, scores: Tensor, place: int) -> Tensor:
        """The cells of which the last query's score of a place is the mean.

        Args:
            place: one whose score is finite.

        Shape: (Q,N) -> (C,2) query and place of each of at most T cells, the latest query first.
        """
        means = [float(SequenceMatcher(self.length, (v,))(scores)[-1, place]) for v in self.speeds]
        k = torch.arange(min(self.length, len(scores)))
        shift = [math.floor(self.speeds[means.index(min(means))] * j + 0.5) for j in k.tolist()]
        cells = torch.stack([len(scores) - 1 - k, place - torch.tensor(shift)], 1)
        cells = cells[(cells[:, 1] >= 0) & (cells[:, 1] < scores.shape[1])]
        return cells[scores.cpu()[cells[:, 0], cells[:, 1]].isfinite()]

    def check(self, queries: int, places: int) -> None:
        """See `SequenceModel`: say where there are fewer queries than T; refuse fewer places."""
        if self.length > places:
            raise InputError(
                f"a sequence of {self.length} queries on a map of {places} places; expected at most as many"
            )
        if self.length > queries:
            log.warning("a sequence of %d queries, but there are %d: all of them count", self.length, queries)

    def extra_repr(self) -> str:
        return f"length={self.length}, speeds={list(self.speeds)}"
