"""Whether queries are a drive of a map at all: what single images say of it, then what their order says.

Queries and maps are smooth, so a drive over other ground finds a path on any map if it may stand still, jump
and wander. Its single images, however, are no more sure of a place than queries that show nothing, and a path
of jumps explains little once jumps are as rare as a drive's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.area import Area
from dejavu_torch.recognition.calibration import TOLERANCE, confidence
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.types import Match

ASKED = 256  # queries of a drive that are asked singly, at most
DRAWS = 2  # of signs
UPPER = 0.1  # share of the queries that have to be sure: the others may be off the map
STANDS_OUT = 0.17  # of `python -m benchmarks cross --choose`
NATS = 10.0  # by which a drive beats being off the map throughout
ALONG = 0.5  # share of the nats that rare jumps have to leave: else jumps explain the drive, and nothing else
AT_ONCE = 2**24  # scores


class Singly(NamedTuple):
    """How sure the surest tenth of a drive's single images is, and of queries that show no place: means of
    their confidences in scores over the null's typical one, at most 0. queries: how many were asked."""

    shown: float
    null: float
    queries: int

    @property
    def stands_out(self) -> bool:
        """Whether single images find the map."""
        return self.shown - self.null >= STANDS_OUT


def flipped(queries: Tensor, seed: int = 0) -> Tensor:
    """Queries that show no place but vary as these do: about their mean, dimensions of all are mirrored at
    random, (B,K) -> (B,K). The order of queries, their lengths and how alike they are stay.

    Example:
        >>> queries = torch.rand(4, 3)
        >>> torch.allclose(torch.cdist(flipped(queries), flipped(queries)), torch.cdist(queries, queries))
        True
    """
    draw, mean = torch.Generator().manual_seed(seed), queries.mean(0)
    sign = 2 * torch.randint(0, 2, (queries.shape[1],), generator=draw) - 1
    return (queries - mean) * sign.to(queries) + mean


def upper(confidences: Tensor) -> float:
    """The mean of the upper tenth of confidences (n,)."""
    return float(confidences.topk(max(1, round(UPPER * len(confidences)))).values.mean())


@torch.no_grad()
def singly(
    rows: Callable[[Tensor], Tensor],
    null: Callable[..., Tensor],
    queries: int,
    area: Area | None = None,
    apart: int = TOLERANCE,
) -> Singly:
    """What single images of a drive say, each of all places: no order and no preselection has a part in it.

    Args:
        rows: numbers of queries (B,) -> their scores (B,N). null: the same of `flipped` ones, for a `seed`.
        apart: places between the two best, at least.
    """
    numbers = torch.linspace(0, queries - 1, min(ASKED, queries)).round().long()
    size = max(1, AT_ONCE // rows(numbers[:1]).shape[1])

    def pairs(score: Callable[[Tensor], Tensor]) -> Match:
        found = []
        for part in numbers.split(size):
            scores = score(part).cpu().float()
            scores, most = scores.masked_fill(scores.isnan(), torch.inf), min(2, scores.shape[1])
            found.append(best_candidates(scores, most, max(TOLERANCE, apart), None, area))
        return Match.joined(found)

    own, others = pairs(rows), Match.joined(pairs(partial(null, seed=seed)) for seed in range(DRAWS))
    known = others.score[others.score.isfinite()]
    unit = max(float(known.median()), torch.finfo().tiny) if len(known) else 1.0
    shown, none = (upper(confidence(replace(one, score=one.score / unit))) for one in (own, others))
    return Singly(shown, none, len(numbers))


def moves_along(nats: float, held: float) -> bool:
    """Whether the order of queries makes a drive.

    Args:
        nats: by which the fitted motion beats being off the map throughout. held: the same with jumps as rare
            as those of a drive.
    """
    return held >= max(NATS, ALONG * nats)
