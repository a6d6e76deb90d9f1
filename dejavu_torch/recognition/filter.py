"""A probability for every place, driven along with the queries, and for being off the map."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dejavu_torch.types import InputError, Scorer, SequenceModel

LIKELY = 0.5  # of all probability has to lie in a stretch of places for these to be scored alone
FLOOR = 1e-9  # probability below which a place is not likely, however few jump


class Moments(NamedTuple):
    """Mean and standard deviation (Q,1) of each query's finite scores, and whether these differ at all."""

    mean: Tensor
    spread: Tensor
    tells: Tensor


def moments_of(scores: Tensor) -> Moments:
    """Of scores (Q,N); the spread is 1 where all are alike."""
    known = scores.isfinite()
    count = known.sum(1, keepdim=True).clamp(min=1)
    mean = torch.where(known, scores, 0).sum(1, keepdim=True) / count
    variance = torch.where(known, mean - scores, 0).square().sum(1, keepdim=True) / count
    tells = variance > torch.finfo(scores.dtype).eps ** 2 * mean.square()
    return Moments(mean, torch.where(tells, variance, 1).sqrt(), tells)


class PlaceFilter(SequenceModel):
    """Where the latest query is, from all queries so far: the forward algorithm of a hidden Markov model.

    Its states are the N places and one more, off the map. From one query to the next the camera moves on by 0
    to V places, jumps to any place, leaves the map or enters it anywhere; driving off its end leaves it too.
    A place scored z standard deviations below the mean of a query's scores has the likelihood
    exp(sharpness z), being off the map exp(sharpness off_map).

    Args:
        moves: probabilities of moving by 0, 1, .., V places; they add up to 1.
        jump: probability of being anywhere on the map next, whatever the place before.
        leave: probability of leaving the map. enter: of entering it, from off the map.
        sharpness: nats for a standard deviation. Consecutive frames are alike, so that they tell less than
            as many independent ones.
        off_map: standard deviations; a place that stands out less than this speaks for being off the map.
        within: places; neighbours up to here count for a place's score, in proportion to how near they are,
            as next to the right place is nearly right.
        threshold: accept a match whose score is below; the default is what is more likely than not, None
            accepts every match.
        search_every: score all places for every so many queries, and where the last posterior has no single
            stretch of places that is likely; in between only that stretch is scored, as far as the map can
            score a stretch alone: a spectral map by its chunks.

    Shape: scores (Q,N), the posterior (N+1,) of the query before them or None -> (Q,N), -log of a
        probability in nats, lower is better.

    Convention: only earlier queries are used. exp(-score) is at most the probability that the right place
        lies within `within` places. A place that nothing covers scores +inf; a query that scores all places
        alike says nothing. Gradients reach the scores, and all settings but `within` and `threshold`, which
        are parameters: `posterior` is what to train.

    Source: a filter with an off-map state is that of Xu, Fischer and Milford (RA-L 2021); the likelihood is
        ours.

    Raises:
        InputError: probabilities out of range or that do not add up, other settings out of range; forward:
            scores that are no (Q,N), or a posterior of another number of places.

    Example:
        >>> scores = torch.tensor([[0.0, 5, 5, 5, 5, 5], [5, 0, 5, 5, 0, 5], [5, 5, 0, 5, 5, 5]])
        >>> PlaceFilter(within=0)(scores).argmin(1)
        tensor([0, 1, 2])
    """

    def __init__(
        self,
        moves: Sequence[float] = (0.2, 0.6, 0.2),
        jump: float = 0.001,
        leave: float = 0.001,
        enter: float = 0.01,
        sharpness: float = 1.0,
        off_map: float = 1.25,
        within: int = 5,
        threshold: float | None = math.log(2),
        search_every: int = 1,
    ) -> None:
        super().__init__()
        rates = {"jump": jump, "leave": leave, "enter": enter}
        if any(not 0 <= rate <= 1 for rate in rates.values()) or jump + leave > 1:
            seen = ", ".join(f"{name} {rate}" for name, rate in rates.items())
            raise InputError(f"{seen}; expected probabilities, jump and leave at most 1 together")
        if not moves or not all(move >= 0 for move in moves) or not abs(sum(moves) - 1) < 1e-6:
            raise InputError(f"the moves are {list(moves)}; expected probabilities that add up to 1")
        if not 0 < sharpness < math.inf or not math.isfinite(off_map) or within < 0:
            raise InputError(
                f"sharpness {sharpness}, off_map {off_map}, within {within}; expected finite numbers, a "
                "sharpness above 0 and at least 0 places"
            )
        if search_every < 1:
            raise InputError(f"search_every is {search_every}; expected at least 1 query")
        stay = max(0.0, 1 - jump - leave)
        self.move_logits = nn.Parameter(torch.tensor(moves).log())
        self.rate_logits = nn.Parameter(torch.tensor([stay, jump, leave]).log())
        self.enter_logit = nn.Parameter(torch.tensor(enter).logit())
        self.log_sharpness = nn.Parameter(torch.tensor(sharpness).log())
        self.off_map = nn.Parameter(torch.tensor(float(off_map)))
        self.within, self.threshold, self.search_every = within, threshold, search_every

    def forward(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        return self._scores(self.posterior(scores, before), scores.isfinite())

    def posterior(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        """Probability of each place, and of being off the map, behind each query.

        Shape: (Q,N), (N+1,) or None -> (Q,N+1), the last column being off the map; rows add up to 1.
        """
        if scores.ndim != 2 or scores.shape[1] < 1 or not scores.is_floating_point():
            raise InputError(f"scores are {tuple(scores.shape)} {scores.dtype}; expected floats (Q,N)")
        places = scores.shape[1]
        if before is not None and before.shape != (places + 1,):
            raise InputError(
                f"a posterior {tuple(before.shape)} of another map, of {places} places; expected "
                f"({places + 1},)"
            )
        rows = []
        for row in self.evidence(scores):
            before = self._updated(self._expected(before, places).to(row), row)
            rows.append(before)
        return torch.stack(rows) if rows else scores.new_zeros(0, places + 1)

    def _expected(self, before: Tensor | None, places: int) -> Tensor:
        return self.start(places) if before is None else self.predicted(before)

    def _updated(self, expected: Tensor, likelihood: Tensor) -> Tensor:
        """Bayes' rule; where what is likely was impossible, what was expected stands."""
        joint = expected * likelihood
        total = joint.sum()
        return torch.where(total > 0, joint / torch.where(total > 0, total, 1), expected)

    def evidence(self, scores: Tensor, moments: Moments | None = None) -> Tensor:
        """Likelihoods of each query up to a factor: (Q,N) -> (Q,N+1), the greatest of each row 1.

        Args:
            moments: mean and spread that are not those of these scores.
        """
        known = scores.isfinite()
        mean, spread, tells = moments_of(scores) if moments is None else moments
        z = torch.where(known, mean - scores, 0) / spread
        z = torch.cat([z, self.off_map.to(z).expand(len(z), 1)], 1)
        logits = torch.where(tells, self.log_sharpness.to(z).exp() * z, 0)
        open_ = torch.cat([known, known.new_ones(len(z), 1)], 1) | ~tells
        logits = logits.masked_fill(~open_, -math.inf)
        return (logits - logits.amax(1, keepdim=True)).exp()

    def predicted(self, posterior: Tensor) -> Tensor:
        """What the motion makes of a posterior, ahead of the next query: (N+1,) -> (N+1,)."""
        on, off = posterior[:-1], posterior[-1]
        stay, jump, leave = self.rate_logits.to(on).softmax(0)
        enter = self.enter_logit.to(on).sigmoid()
        moves = self.move_logits.to(on).softmax(0)
        # a convolution turns its kernel round
        moved = F.conv1d(F.pad(on, (len(moves) - 1, 0))[None], moves.flip(0)[None, None])[0]
        total = on.sum()
        anywhere = (jump * total + enter * off) / len(on)
        beyond = stay * (total - moved.sum()) + leave * total + (1 - enter) * off
        return torch.cat([stay * moved + anywhere, beyond[None]])

    def start(self, places: int) -> Tensor:
        """What is expected ahead of the first query: any of so many places alike, or off the map. (N+1,)"""
        leave, enter = self.rate_logits.softmax(0)[2], self.enter_logit.sigmoid()
        off = leave / (leave + enter).clamp(min=1e-30)  # where as many leave as enter
        return torch.cat([((1 - off) / places).expand(places), off[None]])

    def stream(self, batches: Iterable[Tensor]) -> Iterator[Tensor]:
        """See `SequenceModel`; between two batches one posterior is kept."""
        before = None
        for scores in batches:
            posterior = self.posterior(scores, before)
            before = posterior[-1] if len(posterior) else before
            yield self._scores(posterior, scores.isfinite())

    def follow(self, batches: Iterable[Tensor], route: Scorer) -> Iterator[Tensor]:
        """See `SequenceModel`; between two searches only what is likely is scored.

        Other places then count as if they scored as the mean, and mean and spread are those of the last
        search.
        """
        if self.search_every == 1:
            yield from super().follow(batches, route)
            return
        before: Tensor | None = None
        moments: Moments | None = None
        since = 0
        for queries in batches:
            found = []
            for query in queries.split(1):
                expected = self._expected(before, route.places)
                near = self._likely(expected) if since < self.search_every else None
                if moments is None or near is None:
                    scores, since = route.scores(query), 0
                    moments = moments_of(scores)
                else:
                    scores = moments.mean.expand(1, route.places).clone()
                    scores[:, near.start : near.stop] = route.scores_between(query, near.start, near.stop)
                since += 1
                before = self._updated(expected.to(scores), self.evidence(scores, moments)[0])
                found.append(self._scores(before[None], scores.isfinite()))
            yield torch.cat(found)

    def _likely(self, expected: Tensor) -> range | None:
        """The stretch of places that more leads to than a jump; None where it is not where the camera is."""
        on, places = expected[:-1].detach(), len(expected) - 1
        jump, enter = self.rate_logits.detach().softmax(0)[1], self.enter_logit.detach().sigmoid()
        anywhere = (jump * on.sum() + enter * expected[-1].detach()) / places  # as much comes to every place
        (likely,) = (on > 2 * anywhere.clamp(min=FLOOR)).nonzero(as_tuple=True)
        if not len(likely):
            return None
        near = range(int(likely[0]), int(likely[-1]) + 1)
        return near if float(on[near.start : near.stop].sum()) > LIKELY else None

    def _scores(self, posterior: Tensor, covered: Tensor) -> Tensor:
        near = 1 - torch.arange(-self.within, self.within + 1).abs().to(posterior) / (self.within + 1)
        mass = F.conv1d(posterior[:, None, :-1], near[None, None], padding=self.within)[:, 0]
        score = -mass.clamp(torch.finfo(mass.dtype).tiny, 1).log()
        return score.masked_fill(~covered, math.inf)

    def check(self, queries: int, places: int) -> None:
        """See `SequenceModel`: refuse moves that leave the map at once."""
        furthest = len(self.move_logits) - 1
        if furthest >= places:
            raise InputError(f"moves of up to {furthest} places on a map of {places}; expected fewer")

    def threshold_of(self, threshold: float | None) -> float | None:
        """The filter's own: its scores are probabilities, not distances."""
        return self.threshold

    @torch.no_grad()
    def extra_repr(self) -> str:
        moves = [round(move, 4) for move in self.move_logits.softmax(0).tolist()]
        _, jump, leave = self.rate_logits.softmax(0).tolist()
        enter, sharpness = float(self.enter_logit.sigmoid()), float(self.log_sharpness.exp())
        return (
            f"moves={moves}, jump={jump:.3g}, leave={leave:.3g}, enter={enter:.3g}, "
            f"sharpness={sharpness:.3g}, off_map={float(self.off_map):.3g}, within={self.within}"
        )
