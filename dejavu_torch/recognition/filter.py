"""A probability for every place, followed along the queries, and for being off the map."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.types import InputError, SequenceModel

IMPOSSIBLE = 1e-30  # a probability that still has a gradient
LIKELY = 0.99  # of all probability: a stretch of places with less is not scored alone
UNLIKELY = 1e-4  # of all probability: a place with less ends such a stretch


class Moments(NamedTuple):
    """Mean and standard deviation (Q,1) of the finite scores, 1 if all are alike; and which are finite."""

    mean: Tensor
    spread: Tensor
    varied: Tensor  # (Q,1), whether the scores differ at all
    valid: Tensor  # (Q,N)


def moments_of(scores: Tensor) -> Moments:
    """Of scores (Q,N)."""
    valid = scores.isfinite()
    count = valid.sum(1, keepdim=True).clamp(min=1)
    mean = torch.where(valid, scores, 0).sum(1, keepdim=True) / count
    variance = torch.where(valid, mean - scores, 0).square().sum(1, keepdim=True) / count
    most = scores.masked_fill(~valid, -math.inf).amax(1, keepdim=True)
    varied = (most > scores.amin(1, keepdim=True)) & (variance > 0)
    return Moments(mean, torch.where(varied, variance, 1).sqrt(), varied, valid)


class PlaceFilter(SequenceModel):
    """Where the latest query is, from all queries so far: the forward algorithm of a hidden Markov model.

    Its states are the N places and one more, off the map. A place scored z standard deviations below the mean
    of a query's scores has the likelihood exp(sharpness z), being off the map exp(sharpness off_map).

    Args:
        moves: probabilities of moving by 0, 1, .., V places from one query to the next; they add up to 1.
            Driving off the end of the map leaves it.
        jump: probability of being anywhere on the map next. leave, enter: of leaving and entering the map.
        sharpness: nats for a standard deviation; low, as consecutive frames are alike.
        off_map: standard deviations; a place that stands out less than this suggests being off the map.
        within: places; the score of a place counts its neighbours up to here, the less the further away.
        threshold: accept a match whose score is below; None leaves it to `DejaVu.acceptance`.
        search_every: queries from one search of all places to the next. In between only the stretch of places
            that holds nearly all of the probability is scored, if there is one. Probabilities then differ by
            up to about 0.02, and a jump is noticed at the next search.

    Shape: scores (Q,N), the posterior (N+1,) before them or None -> (Q,N), -log of a probability in nats.

    Convention: causal. exp(-score) is at most the probability that the right place lies within `within`
        places. The state is the posterior, its last element that of being off the map, and all 0 before the
        first query. A place that nothing covers scores +inf. `moves` to `off_map` are parameters.

    Source: an off-map state is in the topometric filter of Xu, Fischer, Sünderhauf and Milford (RA-L 2021);
        motion model and likelihood are ours.

    Raises:
        InputError: settings, scores or a posterior of another shape or out of range.

    Example:
        >>> scores = torch.tensor([[0.0, 5, 5, 5, 5, 5], [5, 0, 5, 5, 0, 5], [5, 5, 0, 5, 5, 5]])
        >>> PlaceFilter(within=0)(scores).argmin(1)
        tensor([0, 1, 2])
    """

    likely = math.log(2)

    def __init__(
        self,
        moves: Sequence[float] = (0.2, 0.6, 0.2),
        jump: float = 0.001,
        leave: float = 0.001,
        enter: float = 0.01,
        sharpness: float = 1.0,
        off_map: float = 1.25,
        within: int = 5,
        threshold: float | None = None,
        search_every: int = 1,
    ) -> None:
        super().__init__()
        moves = tuple(float(move) for move in moves)
        if not all(0 <= rate <= 1 for rate in (jump, leave, enter)) or jump + leave > 1:
            seen = f"jump {jump}, leave {leave}, enter {enter}"
            raise InputError(f"{seen}; expected probabilities, jump and leave at most 1 together")
        if not all(move >= 0 for move in moves) or not abs(sum(moves) - 1) < 1e-6:
            raise InputError(f"the moves are {[*moves]}; expected probabilities that add up to 1")
        if not 0 < sharpness < math.inf or not math.isfinite(off_map):
            seen = f"sharpness {sharpness}, off_map {off_map}"
            raise InputError(f"{seen}; expected finite numbers, the sharpness above 0")
        for name, value, lowest in (("within", within, 0), ("search_every", search_every, 1)):
            if not isinstance(value, int) or value < lowest:
                raise InputError(f"{name} is {value}; expected a whole number, at least {lowest}")
        if threshold is not None and math.isnan(threshold):
            raise InputError("the threshold is NaN; expected a number, or None")
        self.move_logits = nn.Parameter(_logits(*moves))
        self.rate_logits = nn.Parameter(_logits(1 - jump - leave, jump, leave))
        self.enter_logit = nn.Parameter(_logits(enter)[0] - _logits(1 - enter)[0])
        self.log_sharpness = nn.Parameter(torch.tensor(float(sharpness)).log())
        self.off_map = nn.Parameter(torch.tensor(float(off_map)))
        self.within, self.threshold, self.search_every = within, threshold, search_every

    def start(self, places: int, fixed: bool = False) -> Tensor:
        return torch.zeros(places + 1, device=self.off_map.device)

    def forward(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        return self.near_scores(self.posterior(scores, before)[:, :-1], scores)

    def posterior(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        """Probability of each place, and of being off the map, after each query.

        Shape: (Q,N), (N+1,) or None -> (Q,N+1), the last column being off the map; rows add up to 1.
        """
        if before is None:
            before = self.start(scores.shape[-1])
        elif not (bool((before >= 0).all()) and abs(float(before.detach().sum()) - 1) <= 1e-3):
            seen = f"a posterior {tuple(before.shape)} that adds up to {float(before.detach().sum()):.4g}"
            raise InputError(f"{seen}; expected ({scores.shape[-1] + 1},) probabilities that add up to 1")
        return self._posteriors(scores, before)[1:]

    def step(self, scores: Tensor, state: Tensor, firsts: Sequence[int] = (0,)) -> tuple[Tensor, Tensor]:
        posteriors = self._posteriors(scores, state)
        return self.near_scores(posteriors[1:, :-1], scores), posteriors[-1]

    def _posteriors(self, scores: Tensor, state: Tensor) -> Tensor:
        """The state and what it becomes with each query, (Q+1,N+1)."""
        if scores.ndim != 2 or scores.shape[1] < 1 or not scores.is_floating_point():
            raise InputError(f"scores are {tuple(scores.shape)} {scores.dtype}; expected floats (Q,N)")
        places = scores.shape[1]
        if state.shape != (places + 1,):
            raise InputError(f"a posterior {tuple(state.shape)} of another map; expected ({places + 1},)")
        rows = [state.to(scores)]
        for likelihood in self.likelihoods(scores, moments_of(scores)):
            expected = self.moved(rows[-1], places)
            if len(rows) == 1:
                expected = torch.where((state == 0).all(), self.anywhere(places).to(scores), expected)
            rows.append(updated(expected, likelihood))
        return torch.stack(rows)

    def likelihoods(self, scores: Tensor, moments: Moments) -> Tensor:
        """Likelihoods of W places, of being off the map, and of a place that scores as the mean, up to a
        factor: (Q,W) -> (Q,W+2), the greatest of each row 1."""
        valid, sharpness = scores.isfinite(), self.log_sharpness.to(scores).exp()
        z = torch.where(valid, moments.mean - scores, 0) / moments.spread
        others = torch.stack([self.off_map.to(z), z.new_zeros(())]).expand(len(z), 2)
        logits = torch.cat([(sharpness * z).masked_fill(~valid, -math.inf), sharpness * others], 1)
        logits = torch.where(moments.varied, logits, 0)
        return (logits - logits.amax(1, keepdim=True)).exp()

    def anywhere(self, places: int) -> Tensor:
        """The belief before the first query: off the map or on it, as many as leave and enter."""
        leave, enter = self.rate_logits.softmax(0)[2], self.enter_logit.sigmoid()
        off = (leave / (leave + enter)).clamp(max=0.5)
        return torch.cat([((1 - off) / places).expand(places), off[None]])

    def moved(self, belief: Tensor, places: int, start: int = 0) -> Tensor:
        """The belief before the next query, of up to V more places, if there are.

        A belief (W+1,) holds the probability of each of the places [start, start + W) and of being off the
        map; all other places have the rest together.
        """
        moves, rates = (logits.to(belief).softmax(0) for logits in (self.move_logits, self.rate_logits))
        (stay, jump, leave), enter = rates, self.enter_logit.sigmoid().to(belief)
        on, off, furthest = belief[:-1], belief[-1], len(moves) - 1
        ahead = min(furthest, places - start - len(on))
        moved = F.pad(on, (furthest, ahead)).unfold(0, furthest + 1, 1) @ moves.flip(0)
        anywhere = (jump * (1 - off) + enter * off) / places
        off = stay * (on.sum() - moved.sum()) + leave * (1 - off) + (1 - enter) * off
        return torch.cat([stay * moved + anywhere, off[None]])

    def near_scores(self, posterior: Tensor, scores: Tensor, lowest: Tensor | None = None) -> Tensor:
        """-log of the probability of each place and its neighbours, at least `lowest`, (Q,W) -> (Q,W); +inf
        where scores are."""
        within = min(self.within, posterior.shape[1])  # further neighbours there are not
        side = within + 1  # two means over so many make a triangle
        padded = F.pad(posterior[:, None], (within, within))
        mass = side * F.avg_pool1d(F.avg_pool1d(padded, side, 1), side, 1)[:, 0]
        mass = mass.clamp(torch.finfo(mass.dtype).tiny, 1.0)  # an exporter promotes no types
        score = -(mass if lowest is None else torch.maximum(mass, lowest)).log()
        return score.masked_fill(~scores.isfinite(), math.inf)

    def check(self, queries: int | None, places: int) -> None:
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


class LocalSearch:
    """A filter that between two searches scores only the likely stretch of places; keeps its state.

    All other places count as if they scored as the mean; mean and spread are those of the last search.

    Args:
        scores: of all places, (1,K) -> (1,N), when it searches.
    """

    def __init__(self, filter: PlaceFilter, route: PlaceMap, scores: Callable[[Tensor], Tensor]) -> None:
        self.filter, self.route, self.all_scores = filter, route, scores
        self.belief: Tensor | None = None  # of the places from `start` on, and of being off the map
        self.start = self.skipped = 0  # skipped: queries before the next
        self.search: Moments | None = None  # of the last search
        self.since = 0  # queries from it on

    def __call__(self, query: Tensor, whole: bool = False) -> tuple[Tensor, int]:
        """Scores (1,W) for the next query (1,K), the best among them, and the first of these places; `whole`:
        of all places."""
        filter, places, moments, since = self.filter, self.route.places, self.search, self.since
        near = None if moments is None or since >= filter.search_every else self._likely()
        belief, start = (self.posterior, 0) if near is None else near
        expected = filter.anywhere(places) if belief is None else belief
        for _ in range(0 if belief is None else 1 + self.skipped):
            expected = filter.moved(expected, places, start)
        if moments is None or near is None:
            scores = self.all_scores(query)
            moments = moments_of(scores)
        else:
            blocks = self.route.score_blocks(query, start, start + len(expected) - 1)
            scores = torch.cat([block for _, block in blocks], 1)
        others = places - scores.shape[1]  # places that are not scored
        expected = expected.to(scores)
        belief = updated(expected, filter.likelihoods(scores, moments)[0], _rest(expected, others))
        if near is None and moments.varied:  # a query that says nothing is no search
            self.search, since = moments, 0
        self.belief, self.start, self.since, self.skipped = belief, start, since + 1, 0
        lowest = (filter.within + 1) * _rest(belief, others) / max(1, others)
        lowest = lowest.clamp(torch.finfo(belief.dtype).tiny, 1)
        found, elsewhere = filter.near_scores(belief[None, :-1], scores, lowest), -lowest.log()
        if not others or (not whole and bool(found.amin() < elsewhere)):
            return found, start
        row = elsewhere.repeat(1, places).masked_fill_(~moments.valid, math.inf)
        row[:, start : start + found.shape[1]] = found
        return row, 0

    def _likely(self) -> tuple[Tensor, int] | None:
        """The belief of a stretch that holds nearly all of it, if any, with a margin; and its first place."""
        assert self.belief is not None
        on, within = self.belief[:-1], self.filter.within
        (likely,) = (on > UNLIKELY).nonzero(as_tuple=True)
        first, last = (int(likely[0]), int(likely[-1])) if len(likely) else (0, -1)
        on = on[first : last + 1]
        if float(on.sum()) <= LIKELY:
            return None
        first += self.start
        left, right = min(within, first), min(within, self.route.places - first - len(on))
        return torch.cat([F.pad(on, (left, right)), self.belief[-1:]]), first - left

    @property
    def posterior(self) -> Tensor | None:
        """(N+1,), None before the first query."""
        if self.belief is None:
            return None
        on, places = self.belief[:-1], self.route.places
        others = places - len(on)
        whole = (_rest(self.belief, others) / max(1, others)).repeat(places + 1)
        whole[self.start : self.start + len(on)], whole[-1] = on, self.belief[-1]
        return whole


def updated(expected: Tensor, likelihood: Tensor, rest: Tensor | float = 0) -> Tensor:
    """Bayes' rule, of a belief (W+1,) and the rest; if what is likely was impossible, the belief stays."""
    joint = expected * likelihood[:-1]
    total = joint.sum() + rest * likelihood[-1]
    return torch.where(total > IMPOSSIBLE, joint / torch.where(total > IMPOSSIBLE, total, 1), expected)


def _rest(belief: Tensor, others: int) -> Tensor:
    """The probability of so many other places together."""
    return (1 - belief.sum()).clamp(min=0) * (others > 0)


def _logits(*probabilities: float) -> Tensor:
    """Logarithms whose gradients are finite where a probability is 0."""
    return torch.tensor(probabilities).clamp(min=IMPOSSIBLE).log()
