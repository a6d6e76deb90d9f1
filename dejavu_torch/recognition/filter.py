"""Probabilities of all places, and of being off the map, filtered along the queries."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dejavu_torch.memory import is_plain, without_autocast
from dejavu_torch.recognition.motion import MIN_PROBABILITY, Layout, Motion, Rates, checked_rates, logits
from dejavu_torch.recognition.sequence import each
from dejavu_torch.types import InputError, SequenceModel


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
    ) -> None:
        super().__init__()
        moves = checked_rates(moves, jump, leave, enter)
        if not 0 < sharpness < math.inf or not math.isfinite(off_map):
            seen = f"sharpness {sharpness}, off_map {off_map}"
            raise InputError(f"{seen}; expected finite numbers, the sharpness above 0")
        if not isinstance(within, int) or within < 0:
            raise InputError(f"within is {within}; expected a whole number, at least 0")
        if threshold is not None and math.isnan(threshold):
            raise InputError("the threshold is NaN; expected a number, or None")
        self.move_logits = nn.Parameter(logits(*moves))
        self.rate_logits = nn.Parameter(logits(1 - jump - leave, jump, leave))
        self.enter_logit = nn.Parameter(logits(enter)[0] - logits(1 - enter)[0])
        self.log_sharpness = nn.Parameter(torch.tensor(float(sharpness), dtype=torch.float32).log())
        self.off_map = nn.Parameter(torch.tensor(float(off_map), dtype=torch.float32))
        self.within, self.threshold = within, threshold

    def start(self, places: int, fixed: bool = False) -> Tensor:
        return self.off_map.new_zeros(places + 1)

    def forward(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        if scores.ndim > 2:
            check_posterior(before, scores.shape[-1])
            return each(self, scores, before)
        return near_scores(self.posterior(scores, before)[:, :-1], scores, self.within)

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
        posteriors = self._posteriors(scores, state, route_starts)
        return near_scores(posteriors[1:, :-1], scores, self.within), posteriors[-1]

    @without_autocast
    def _posteriors(self, scores: Tensor, state: Tensor, route_starts: Sequence[int] = (0,)) -> Tensor:
        """The state before the first and after each query, (Q+1,N+1)."""
        if scores.ndim != 2 or scores.shape[1] < 1 or not scores.is_floating_point():
            raise InputError(f"scores are {tuple(scores.shape)} {scores.dtype}; expected floats (Q,N)")
        places = scores.shape[1]
        if state.shape != (places + 1,):
            raise InputError(f"the posterior is {tuple(state.shape)}; expected ({places + 1},) for this map")
        rows, motion = [state.to(scores)], self.motion(scores, route_starts)
        for likelihood in self.likelihoods(scores, moments_of(scores)):
            expected = motion.moved(rows[-1])
            if len(rows) == 1:
                expected = torch.where((state == 0).all(), motion.anywhere(), expected)
            rows.append(updated(expected, likelihood))
        return torch.stack(rows)

    def likelihoods(self, scores: Tensor, moments: Moments) -> Tensor:
        """Likelihoods of the places and of being off the map, (Q,N) -> (Q,N+1), scaled to a maximum of 1 in
        each row."""
        valid, sharpness = scores.isfinite(), self.log_sharpness.to(scores).exp()
        z = torch.where(valid, moments.mean - scores, 0) / moments.spread
        off = self.off_map.to(z).expand(len(z), 1)
        logits = torch.cat([(sharpness * z).masked_fill(~valid, -math.inf), sharpness * off], 1)
        logits = torch.where(moments.varied, logits, 0)
        return (logits - logits.amax(1, keepdim=True)).exp()

    def motion(self, like: Tensor, route_starts: Sequence[int] = (0,)) -> Motion:
        """The transitions of a map, in the type of its scores (..., N)."""
        moves, (_, jump, leave) = (one.to(like).softmax(0) for one in (self.move_logits, self.rate_logits))
        rates = Rates(moves, jump, leave, self.enter_logit.to(like).sigmoid())
        return Motion(Layout(like.shape[-1], route_starts=tuple(route_starts)), rates)

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


def check_posterior(before: Tensor | None, places: int) -> None:
    """Refuse what are no probabilities (..., N+1), unless their numbers cannot be read."""
    if before is None or not is_plain(before) or not before.numel():
        return
    total = before.detach().sum(-1)
    if not bool((before >= 0).all()) or not bool(((total - 1).abs() <= 1e-3).all()):
        worst = float(total.flatten()[(total - 1).abs().argmax()])
        seen = f"a posterior {tuple(before.shape)} that adds up to {worst:.4g}"
        raise InputError(f"{seen}; expected ({places + 1},) probabilities that add up to 1")


@without_autocast
def near_scores(posterior: Tensor, scores: Tensor, within: int) -> Tensor:
    """-log of the probability of each place and its neighbours, weighted by a triangle that ends `within`
    places away, (Q,N) -> (Q,N); +inf if the place's score is."""
    within = min(within, posterior.shape[1])
    side = within + 1  # two box filters make a triangle
    padded = F.pad(posterior[:, None], (within, within))
    mass = side * F.avg_pool1d(F.avg_pool1d(padded, side, 1), side, 1)[:, 0]
    mass = mass.clamp(torch.finfo(mass.dtype).tiny, 1.0)  # an exporter promotes no types
    return (-mass.log()).masked_fill(~scores.isfinite(), math.inf)


def updated(expected: Tensor, likelihood: Tensor) -> Tensor:
    """Bayes' rule for a belief (N+1,), which stays if the query rules it out."""
    joint = expected * likelihood
    total = joint.sum()
    possible = total > MIN_PROBABILITY
    return torch.where(possible, joint / torch.where(possible, total, 1), expected)
