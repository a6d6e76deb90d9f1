"""Probabilities of all places, and of being off the map, filtered along the queries."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.memory import is_plain, without_autocast
from dejavu_torch.recognition.sequence import each
from dejavu_torch.types import InputError, SequenceModel

MIN_PROBABILITY = 1e-30  # a probability of 0, with a finite gradient
LOCAL_MASS = 0.99  # minimum probability of a range of places that is scored alone
LOCAL_EDGE = 1e-4  # places with less probability are cut off the ends of that range


class Moments(NamedTuple):
    """Statistics of the finite scores of each query."""

    mean: Tensor  # (Q,1)
    spread: Tensor  # (Q,1) standard deviation, 1 if all scores are equal
    varied: Tensor  # (Q,1) whether the scores differ
    valid: Tensor  # (Q,N) which are finite


def moments_of(scores: Tensor) -> Moments:
    """Moments of scores (Q,N)."""
    valid = scores.isfinite()
    count = valid.sum(1, keepdim=True).clamp(min=1)
    mean = torch.where(valid, scores, 0).sum(1, keepdim=True) / count
    variance = torch.where(valid, mean - scores, 0).square().sum(1, keepdim=True) / count
    highest = scores.masked_fill(~valid, -math.inf).amax(1, keepdim=True)
    varied = (highest > scores.amin(1, keepdim=True)) & (variance > 0)
    return Moments(mean, torch.where(varied, variance, 1).sqrt(), varied, valid)


class PlaceFilter(SequenceModel):
    """The place of the latest query given all queries: the forward algorithm of a hidden Markov model.

    Its states are the N places and one off-map state. A place scored z standard deviations below the mean of
    a query's scores has the likelihood exp(sharpness z), the off-map state exp(sharpness off_map).

    Args:
        moves: probabilities of moving by 0, 1, .., V places from one query to the next; they add up to 1.
            Moving past the end of the map leaves it.
        jump: probability of being anywhere on the map next. leave, enter: of leaving and entering the map.
        sharpness: nats per standard deviation; low, since consecutive frames are similar.
        off_map: standard deviations; a query with no place further below the mean suggests being off the map.
        within: places; the score of a place includes its neighbours up to this distance, with weights that
            decrease with it.
        threshold: accept a match if its score is below; None leaves it to `DejaVu.acceptance`.
        search_every: queries from one search of all places to the next. Between them, only a range of places
            with nearly all of the probability is scored, if there is one. Probabilities then differ by up to
            about 0.02, and a jump is noticed at the next search.

    Shape: scores (..., Q, N), the posterior (..., N+1) before them or None -> (..., Q, N), -log of a
        probability in nats.

    Convention: causal. exp(-score) is at most the probability that the right place is within `within` places.
        The state is the posterior, the off-map probability last, and all 0 before the first query. A place
        that nothing covers scores +inf. `moves` to `off_map` are parameters.

    Source: the topometric filter of Xu, Fischer, Sünderhauf and Milford (RA-L 2021) has an off-map state; the
        motion model and the likelihood are ours.

    Raises:
        InputError: settings, scores or a posterior of another shape or out of range; compiled, and within
            torch.func, the numbers of a posterior are not looked at.

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
            raise InputError(f"{seen}; expected probabilities, jump + leave at most 1")
        if not all(move >= 0 for move in moves) or not abs(sum(moves) - 1) < 1e-6:
            raise InputError(f"the moves are {[*moves]}; expected probabilities that add up to 1")
        if not 0 < sharpness < math.inf or not math.isfinite(off_map):
            seen = f"sharpness {sharpness}, off_map {off_map}"
            raise InputError(f"{seen}; expected finite numbers, the sharpness above 0")
        for name, value, minimum in (("within", within, 0), ("search_every", search_every, 1)):
            if not isinstance(value, int) or value < minimum:
                raise InputError(f"{name} is {value}; expected a whole number, at least {minimum}")
        if threshold is not None and math.isnan(threshold):
            raise InputError("the threshold is NaN; expected a number, or None")
        self.move_logits = nn.Parameter(_logits(*moves))
        self.rate_logits = nn.Parameter(_logits(1 - jump - leave, jump, leave))
        self.enter_logit = nn.Parameter(_logits(enter)[0] - _logits(1 - enter)[0])
        self.log_sharpness = nn.Parameter(torch.tensor(float(sharpness), dtype=torch.float32).log())
        self.off_map = nn.Parameter(torch.tensor(float(off_map), dtype=torch.float32))
        self.within, self.threshold, self.search_every = within, threshold, search_every

    def start(self, places: int, fixed: bool = False) -> Tensor:
        return self.off_map.new_zeros(places + 1)

    def forward(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        if scores.ndim > 2:
            check_posterior(before, scores.shape[-1])
            return each(self, scores, before)
        return self.near_scores(self.posterior(scores, before)[:, :-1], scores)

    def posterior(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        """Probability of each place, and of being off the map, after each query.

        Shape: (Q,N), (N+1,) or None -> (Q,N+1), off the map last; rows add up to 1.
        """
        check_posterior(before, scores.shape[-1])
        if before is None:
            before = self.start(scores.shape[-1])
        return self._posteriors(scores, before)[1:]

    def step(
        self, scores: Tensor, state: Tensor, route_starts: Sequence[int] = (0,)
    ) -> tuple[Tensor, Tensor]:
        posteriors = self._posteriors(scores, state)
        return self.near_scores(posteriors[1:, :-1], scores), posteriors[-1]

    @without_autocast
    def _posteriors(self, scores: Tensor, state: Tensor) -> Tensor:
        """The state before the first and after each query, (Q+1,N+1)."""
        if scores.ndim != 2 or scores.shape[1] < 1 or not scores.is_floating_point():
            raise InputError(f"scores are {tuple(scores.shape)} {scores.dtype}; expected floats (Q,N)")
        places = scores.shape[1]
        if state.shape != (places + 1,):
            raise InputError(f"the posterior is {tuple(state.shape)}; expected ({places + 1},) for this map")
        rows = [state.to(scores)]
        for likelihood in self.likelihoods(scores, moments_of(scores)):
            expected = self.moved(rows[-1], places)
            if len(rows) == 1:
                expected = torch.where((state == 0).all(), self.anywhere(places).to(scores), expected)
            rows.append(updated(expected, likelihood))
        return torch.stack(rows)

    def likelihoods(self, scores: Tensor, moments: Moments) -> Tensor:
        """Likelihoods of W places, of being off the map, and of a place with the mean score, (Q,W) ->
        (Q,W+2), scaled to a maximum of 1 in each row."""
        valid, sharpness = scores.isfinite(), self.log_sharpness.to(scores).exp()
        z = torch.where(valid, moments.mean - scores, 0) / moments.spread
        off_and_mean = torch.stack([self.off_map.to(z), z.new_zeros(())]).expand(len(z), 2)
        logits = torch.cat([(sharpness * z).masked_fill(~valid, -math.inf), sharpness * off_and_mean], 1)
        logits = torch.where(moments.varied, logits, 0)
        return (logits - logits.amax(1, keepdim=True)).exp()

    def anywhere(self, places: int) -> Tensor:
        """The belief before the first query: on or off the map in the equilibrium of leaving and entering."""
        leave, enter = self.rate_logits.softmax(0)[2], self.enter_logit.sigmoid()
        off = (leave / (leave + enter)).clamp(max=0.5)
        return torch.cat([((1 - off) / places).expand(places), off[None]])

    def moved(self, belief: Tensor, places: int, start: int = 0) -> Tensor:
        """The belief before the next query, extended by up to V places.

        A belief (W+1,) holds the probability of each of the places [start, start + W) and of being off the
        map; the other places share the rest.
        """
        moves, rates = (logits.to(belief).softmax(0) for logits in (self.move_logits, self.rate_logits))
        (stay, jump, leave), enter = rates, self.enter_logit.sigmoid().to(belief)
        on, off, furthest = belief[:-1], belief[-1], len(moves) - 1
        ahead = min(furthest, places - start - len(on))
        moved = F.pad(on, (furthest, ahead)).unfold(0, furthest + 1, 1) @ moves.flip(0)
        anywhere = (jump * (1 - off) + enter * off) / places
        off = stay * (on.sum() - moved.sum()) + leave * (1 - off) + (1 - enter) * off
        return torch.cat([stay * moved + anywhere, off[None]])

    @without_autocast
    def near_scores(self, posterior: Tensor, scores: Tensor, lowest: Tensor | None = None) -> Tensor:
        """-log of the probability, at least `lowest`, of each place and its neighbours, (Q,W) -> (Q,W); +inf
        if the place's score is."""
        within = min(self.within, posterior.shape[1])
        side = within + 1  # two box filters make a triangle
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
        """The filter's own threshold: its scores are probabilities, not distances."""
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
    """A filter that scores only the likely range of places between two searches, and keeps its state.

    All other places get the mean score; mean and spread are those of the last search.

    Args:
        scores: of all places, (1,K) -> (1,N), for a search.
    """

    def __init__(self, filter: PlaceFilter, route: PlaceMap, scores: Callable[[Tensor], Tensor]) -> None:
        self.filter, self.route, self.all_scores = filter, route, scores
        self.belief: Tensor | None = None  # of the places from `start` on, and of being off the map
        self.start = self.skipped = 0  # skipped: queries since the last
        self.search: Moments | None = None  # of the last search
        self.since = 0  # queries since then

    def __call__(self, query: Tensor, whole: bool = False) -> tuple[Tensor, int]:
        """Scores (1,W) of a range that includes the best place of the next query (1,K), or of all places if
        `whole`; and the first of these places."""
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
        if near is None and moments.varied:  # a query with equal scores is not a search
            self.search, since = moments, 0
        self.belief, self.start, self.since, self.skipped = belief, start, since + 1, 0
        lowest = (filter.within + 1) * _rest(belief, others) / max(1, others)
        lowest = lowest.clamp(torch.finfo(belief.dtype).tiny, 1)
        local, elsewhere = filter.near_scores(belief[None, :-1], scores, lowest), -lowest.log()
        if not others or (not whole and bool(local.amin() < elsewhere)):
            return local, start
        row = elsewhere.repeat(1, places).masked_fill_(~moments.valid, math.inf)
        row[:, start : start + local.shape[1]] = local
        return row, 0

    def _likely(self) -> tuple[Tensor, int] | None:
        """The belief in a range with nearly all of the probability, plus a margin, and its first place; None
        if there is no such range."""
        assert self.belief is not None
        on, within = self.belief[:-1], self.filter.within
        (likely,) = (on > LOCAL_EDGE).nonzero(as_tuple=True)
        first, last = (int(likely[0]), int(likely[-1])) if len(likely) else (0, -1)
        on = on[first : last + 1]
        if float(on.sum()) <= LOCAL_MASS:
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


def check_posterior(before: Tensor | None, places: int) -> None:
    """Refuse what are no probabilities (..., N+1), unless their numbers cannot be read."""
    if before is None or not is_plain(before) or not before.numel():
        return
    total = before.detach().sum(-1)
    if not bool((before >= 0).all()) or not bool(((total - 1).abs() <= 1e-3).all()):
        worst = float(total.flatten()[(total - 1).abs().argmax()])
        seen = f"a posterior {tuple(before.shape)} that adds up to {worst:.4g}"
        raise InputError(f"{seen}; expected ({places + 1},) probabilities that add up to 1")


def updated(expected: Tensor, likelihood: Tensor, rest: Tensor | float = 0) -> Tensor:
    """Bayes' rule for a belief (W+1,) and the rest; the belief stays if the query rules it out."""
    joint = expected * likelihood[:-1]
    total = joint.sum() + rest * likelihood[-1]
    possible = total > MIN_PROBABILITY
    return torch.where(possible, joint / torch.where(possible, total, 1), expected)


def _rest(belief: Tensor, others: int) -> Tensor:
    """The total probability of the other places."""
    return (1 - belief.sum()).clamp(min=0) * (others > 0)


def _logits(*probabilities: float) -> Tensor:
    """Logarithms, finite for a probability of 0."""
    return torch.tensor(probabilities, dtype=torch.float32).clamp(min=MIN_PROBABILITY).log()
