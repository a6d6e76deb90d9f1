"""Whether queries are a drive of a map at all: what single images say of it, then what their order says.

Queries and maps are smooth, so a drive over other ground finds a path on any map if it may stand still, jump
and wander. Its single images, however, are no more sure of a place than queries that show nothing, and a path
of jumps explains little once jumps have to be rare.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.evidence import Presence, presence_of

OF_MAP = 10  # queries that the map's own mean counts as, about which queries are mirrored
FEW = 10  # queries of a drive: of fewer, single images tell nothing, and more is asked of their motion
ASKED = 256  # queries of a drive that are asked singly, at most
DRAWN = 512  # queries that show nothing, at least, for the upper tenth to be the same each time
AT_FIRST, EVERY = 40, 4  # of a filter's queries, those that are asked mirrored as well: the first, then some
UPPER = 0.1  # share of the queries that have to be sure: the others may be off the map
# of `python -m benchmarks cross`: by what share of the null's level the surest tenth is surer; the second one
# will do if the motion alone shows so many nats for each query
STANDS_OUT, A_LITTLE, PLAINLY = 0.21, 0.1, 3.0
BY_THEMSELVES = 0.4  # likewise: of 417 drives over other ground one has more than .2, and it has .37
OF_AREA = 0.34  # in place of `STANDS_OUT`: over a plane a path may turn anywhere, so its motion tells less
SURER = {1: STANDS_OUT, 2: OF_AREA}  # by the dimensions of a layout
FAITHFUL = 0.7  # of the descriptors are kept: the code of a map that keeps less hides what single images tell
ALONE = 0.55  # nats for each query that its motion alone has to show there
NATS = 10.0  # by which a drive beats being off the map throughout
PER_QUERY = 0.23  # likewise, for each query that is independent: with less, one image finds more
AT_ONCE = 2**24  # scores
SUREST = 1e-6  # of a confidence below 0, for its logarithm
PER_E = 64  # bins of a histogram of logarithms in each factor e

Score = Callable[[Tensor], Tensor]  # numbers of queries (B,) -> scores (B,N)


class Singly(NamedTuple):
    """How sure the surest tenth of a drive's single images is, and of queries that show no place: means of
    their confidences, at most 0, in any unit. queries: how many were asked. nats: for each, of their motion.
    least: by what share the surest tenth has to be surer. presence: by how near they come to the map.
    """

    shown: float
    null: float
    queries: int
    nats: float = 0.0
    least: float = STANDS_OUT
    presence: Presence | None = None

    @property
    def stands_out(self) -> bool:
        """Whether single images find the map."""
        return self.shown >= (1 - (A_LITTLE if self.nats >= PLAINLY else self.least)) * self.null

    @property
    def enough(self) -> bool:
        """Whether single images find the map so plainly that they need no motion, as of a drive whose other
        half is off the map."""
        return self.shown >= (1 - BY_THEMSELVES) * self.null

    @property
    def odds(self) -> float:
        """By which the odds of an answer change: if single images do not find the map, less than a tenth of
        them are on it, while a calibration takes half of its queries to be."""
        return 1.0 if self.stands_out else UPPER / (1 - UPPER)


def doubted(probability: Tensor, odds: Tensor | float) -> Tensor:
    """Probabilities whose odds change by a factor."""
    return odds * probability / (1 + (odds - 1) * probability)


def middle(total: Tensor, count: Tensor | int, of_map: Tensor) -> Tensor:
    """About what queries are mirrored: their mean, of a sum (...,K), drawn to that of the map, (K,)."""
    return (total + OF_MAP * of_map.to(total)) / (count + OF_MAP)


def flipped(queries: Tensor, seed: int = 0, mean: Tensor | None = None) -> Tensor:
    """Queries that show no place but vary as these do: about a mean, dimensions of all are mirrored at
    random, (B,K) -> (B,K). The order of queries and how alike they are stay.

    Args:
        mean: (K,), or (B,K) for each query; None is that of the queries.

    Example:
        >>> queries = torch.rand(4, 3)
        >>> torch.allclose(torch.cdist(flipped(queries), flipped(queries)), torch.cdist(queries, queries))
        True
    """
    mean = queries.mean(0) if mean is None else mean.to(queries)
    draw = torch.Generator().manual_seed(seed)
    sign = 2 * torch.randint(0, 2, (queries.shape[1],), generator=draw) - 1
    return (queries - mean) * sign.to(queries) + mean


def upper(confidences: Tensor) -> float:
    """The mean of the upper tenth of confidences (n,)."""
    return float(confidences.topk(max(1, round(UPPER * len(confidences)))).values.mean())


@torch.no_grad()
def singly(own: Score, null: Callable[..., Tensor], weight: Tensor, sure: Score) -> Singly:
    """What single images of a drive say, each of all places: no order and no preselection has a part in it.

    Args:
        own: numbers of queries (B,) -> their scores (B,N). null: the same of `flipped` ones, for a `seed`.
        weight: (Q,) of the queries, so that a stop counts once. sure: scores (B,N) -> their confidences (B,).
    """
    total = weight.double().cumsum(0)
    asked = torch.linspace(0, float(total[-1]), min(ASKED, math.ceil(total[-1])) + 1)[:-1]
    numbers = torch.searchsorted(total, asked.double(), right=True).clamp(max=len(total) - 1)
    parts = numbers.split(max(1, AT_ONCE // own(numbers[:1]).shape[1]))

    def shown(score: Score) -> tuple[Tensor, Tensor]:
        """Confidences, and best scores."""
        found = (score(part).cpu().float() for part in parts)
        found = (scores.masked_fill(scores.isnan(), torch.inf) for scores in found)
        pairs = [(sure(scores), scores.amin(1)) for scores in found]
        confidences, best = (torch.cat(column) for column in zip(*pairs, strict=True))
        return confidences, best

    draws = [shown(partial(null, seed=seed)) for seed in range(math.ceil(DRAWN / len(numbers)))]
    (own_sure, own_best), (others, far) = shown(own), (torch.cat(one) for one in zip(*draws, strict=True))
    presence = presence_of(own_best, far)
    return Singly(upper(own_sure), upper(others), len(numbers), presence=presence)


class Running:
    """`Singly.odds` and `Presence` of the queries so far, from histograms, which do not grow with them."""

    def __init__(self, least: float = STANDS_OUT) -> None:
        self.least = least
        self.counts = Counter[int](), Counter[int]()  # by -log(-confidence), of queries and of mirrored ones
        self.best = Counter[int](), Counter[int]()  # by the logarithm of their best score
        self.odds, self.queries = 1.0, 0
        self.presence: Presence | None = None

    def __call__(self, own: Tensor, mirrored: Tensor) -> tuple[Tensor, Tensor]:
        """The odds at each of the next queries, and nats that speak for being off the map, (B,) float64 each.

        Args:
            own, mirrored: confidences in the queries and in some of them mirrored, and their best scores,
                (B,2), NaN for the others.
        """
        odds, absent = [], []
        for pair in torch.stack([own, mirrored], 1).cpu().double().tolist():
            for counts, best, (confidence, score) in zip(self.counts, self.best, pair, strict=True):
                if confidence > -math.inf:  # nor NaN
                    counts[round(PER_E * math.log(max(-confidence, SUREST)))] += 1
                    best[round(PER_E * math.log(max(score, SUREST)))] += 1
            self.queries += 1
            if all(self.counts):
                shown, null = map(self._upper, self.counts)
                self.odds = Singly(shown, null, self.queries, least=self.least).odds
            odds.append(self.odds)
            absent.append(self._absent(pair[0][1]))
        return torch.tensor(odds, dtype=torch.float64), torch.tensor(absent, dtype=torch.float64)

    def _absent(self, best: float) -> float:
        """`Presence.absent`, of a filter; 0 while few queries are known."""
        if self.queries % EVERY == 0 and min(one.total() for one in self.best) >= chosen.KNOWN:
            self.presence = presence_of(*map(self._sample, self.best))
        if self.presence is None or not best > 0:
            return 0.0
        return float(self.presence.absent(torch.tensor(best))) / chosen.FILTERED

    @staticmethod
    def _sample(counts: Counter[int]) -> Tensor:
        """Best scores, of a histogram, at most about `DRAWN`."""
        each = max(1, counts.total() // DRAWN)
        places, times = torch.tensor([*counts.items()]).unbind(1)
        return (places / PER_E).exp().repeat_interleave(-(-times // each))

    @staticmethod
    def _upper(counts: Counter[int]) -> float:
        """As `upper`, of a histogram."""
        wanted, total = max(1, round(UPPER * counts.total())), 0.0
        left = wanted
        for place in sorted(counts):
            taken = min(left, counts[place])
            total, left = total - taken * math.exp(place / PER_E), left - taken
            if not left:
                break
        return total / wanted


def moves_along(nats: float, per_query: float) -> bool:
    """Whether the order of queries makes a drive: by so many nats does its motion, with rare jumps, beat
    being off the map throughout, in all and for each query."""
    return nats >= NATS and per_query >= PER_QUERY
