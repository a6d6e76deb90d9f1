"""Probabilities of all places, and of being off the map, filtered along the queries."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cache, partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from typing_extensions import Self

from dejavu_torch.memory import is_plain, without_autocast
from dejavu_torch.places.layout import ROUTE, Layout
from dejavu_torch.places.states import States
from dejavu_torch.recognition import chosen, odometry
from dejavu_torch.recognition.engine import MIN_PROBABILITY, Motion, Rates
from dejavu_torch.recognition.motion import AlongRoute, checked_rates, logits
from dejavu_torch.recognition.online import UNKNOWN, Learned, Nearness
from dejavu_torch.recognition.plane import SHARP, Followed, PlaneMotion
from dejavu_torch.recognition.sequence import each
from dejavu_torch.recognition.speeds import FREE, steady
from dejavu_torch.types import InputError, SequenceModel, expect

# by the dimensions of a layout; over an area images are farther apart
MOVES = {1: (0.2, 0.6, 0.2), 2: (1 / 6,) * 6}
SHARPNESS = {1: 1.0, 2: 2.0}


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


class FilterState(NamedTuple):
    """What a filter knows between queries.

    Attributes:
        belief: (S,), of the states of the motion given the queries so far, being off the map last; all 0
            before the first one.
        posterior: (N+1,), of the latest answer, which with a lag depends on later queries as well.
        learned: what the queries so far tell, if the filter learns.
        waiting: (R,N), scores of the queries that wait for their answers.
        left_out: after each of these, how many queries were left out. told: (R,3), how much speaks for being
            off the map, places moved and their spread, NaN where unknown; see `PlaceFilter.step`.
        ahead: (), of a place, by which the camera is ahead of whole places moved.
        counts: (bins,), best scores so far, see `Nearness`.
    """

    belief: Tensor
    posterior: Tensor
    learned: Learned | Followed | None
    waiting: Tensor
    left_out: tuple[int, ...]
    told: Tensor
    ahead: Tensor
    counts: Tensor

    def to(self, like: Tensor) -> FilterState:
        """The same, of the type and on the device of a tensor."""
        learned = self.learned and type(self.learned)(*(one.to(like) for one in self.learned))
        rows = self.belief, self.posterior, self.waiting, self.told
        belief, posterior, waiting, told = (one.to(like) for one in rows)
        counts = self.counts.to(like.device)  # which half precision cannot count
        return FilterState(belief, posterior, learned, waiting, self.left_out, told, self.ahead, counts)


class PlaceFilter(SequenceModel):
    """The place of the latest query given all queries: the forward algorithm of a hidden Markov model.

    Its states are the N places, in both directions of travel and at several speeds, and one off-map state. A
    place scored z standard deviations below the mean of a query's scores has the likelihood exp(sharpness z),
    the off-map state exp(sharpness off_map).

    Args:
        moves: probabilities of moving by 0, 1, .., V places from one query to the next, where no steady speed
            is kept; they add up to 1. Moving past the end of the map leaves it. In an area, weights of the
            windows so many rows or columns away, whichever are more; from there on the moves of the latest
            queries count. The default is replaced there by equal weights of windows up to 5 away.
        jump: probability of being anywhere on the map next. leave, enter: of leaving and entering the map.
        turn: probability of turning round in a step. back: share of the cameras that travel against the order
            of the places; with 0, none does, and none turns.
        speeds: steady ones, in places a query, see `Speeds`; a filter that learns keeps none.
        sharpness: nats per standard deviation; low, since consecutive frames are similar. The default is
            replaced by 2 in an area.
        off_map: standard deviations; a query with no place further below the mean suggests being off the map.
        within: places; the score of a place includes its neighbours up to this distance, with weights that
            decrease with it.
        threshold: accept a match if its score is below; None leaves it to `DejaVu.acceptance`.
        lag: queries. An answer comes so many queries later and takes them into account: `step` gives the
            answers that are due, in the order of the queries, and `finish` the rest.
        learns: moves, sharpness and off_map are learned from the queries so far, see `Learned`; those given
            are where they begin. In an area only the moves are, in any case.

    Shape: scores (..., Q, N), the posterior (..., N+1) before them or None -> (..., Q, N), -log of a
        probability in nats. From B queries `step` has B answers; with a lag L, those of the queries up to the
        L-th before the latest that it has not given yet.

    Convention: causal. exp(-score) is at most the probability that the right place is within `within` places.
        A place that nothing covers is passed as one off the map, and scores +inf. `moves` to `off_map`,
        but for `turn`, `back` and `speeds`, are parameters. The state of `step` is a `FilterState`; an
        exported graph has one tensor, see `packed`.
        With a lag of all queries but one, the answers are those of forward-backward smoothing.

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
    answers = "filter"

    def __init__(
        self,
        moves: Sequence[float] = MOVES[1],
        jump: float = 0.001,
        leave: float = 0.001,
        enter: float = 0.01,
        sharpness: float = 1.0,
        off_map: float = 1.25,
        within: int = 5,
        threshold: float | None = None,
        lag: int = 0,
        learns: bool = False,
        turn: float = 0.002,
        back: float = chosen.BACK,
        speeds: Sequence[Fraction | float] = chosen.LIVE,
    ) -> None:
        super().__init__()
        moves = checked_rates(moves, jump, leave, enter)
        expect(0 <= turn <= 1 and 0 <= back <= 1, "probabilities", f"turn {turn}, back {back}")
        fits = 0 < sharpness < math.inf and math.isfinite(off_map)
        expect(fits, "finite numbers, the sharpness above 0", f"sharpness {sharpness}, off_map {off_map}")
        expect(isinstance(within, int) and within >= 0, "a whole number, at least 0", within=within)
        expect(threshold is None or not math.isnan(threshold), "a number, or None", "the threshold is NaN")
        expect(isinstance(lag, int) and lag >= 0, "a whole number of queries, at least 0", lag=lag)
        self.move_logits = nn.Parameter(logits(*moves))
        self.rate_logits = nn.Parameter(logits(1 - jump - leave, jump, leave))
        self.enter_logit = nn.Parameter(logits(enter)[0] - logits(1 - enter)[0])
        self.log_sharpness = nn.Parameter(torch.tensor(float(sharpness), dtype=torch.float32).log())
        self.off_map = nn.Parameter(torch.tensor(float(off_map), dtype=torch.float32))
        self.within, self.threshold, self.lag, self.learns = within, threshold, lag, learns
        self.turn, self.back, self.steady = turn, back, steady(speeds, chosen.KEEPS_LIVE, chosen.USUAL)
        self.layout = ROUTE  # of the places, see `over`
        self.nearness = UNKNOWN  # of queries to the map: in exported files

    def over(self, layout: Layout) -> Self:
        """A copy for places that lie so; moves and sharpness for an area replace those for a route by
        default."""
        before, after = MOVES[self.layout.dimensions], MOVES[layout.dimensions]
        moves, sharpness = self.move_logits, self.log_sharpness
        if before != after and torch.equal(moves.cpu().float(), logits(*before)):
            moves = nn.Parameter(logits(*after).to(self.off_map))
        if before != after and float(sharpness.detach().exp()) == SHARPNESS[self.layout.dimensions]:
            own = math.log(SHARPNESS[layout.dimensions])
            sharpness = nn.Parameter(torch.full_like(sharpness.detach(), own))
        return self.changed(layout=layout, move_logits=moves, log_sharpness=sharpness)

    def start(self, places: int, fixed: bool = False) -> FilterState:
        new = self.off_map.detach().new_zeros
        kind, moves, states = self._learned, len(self.move_logits), self._states(places)
        learned = None if kind is None else kind.unpacked(new(kind.size(places, moves)), places, moves)
        none = new(0, places), (), new(0, 3), torch.zeros((), dtype=torch.float64)
        return FilterState(new(states), new(places + 1), learned, *none, new(self.counted))

    @property
    def _ways(self) -> int:
        """How many states of the motion each place has."""
        return (1 if self.learns else len(self.steady.change)) * (2 if self.back else 1)

    def _places(self, states: int) -> int:
        """How many places a belief in so many states is of."""
        return self.layout.places or (states - 1) // self._ways

    def _states(self, places: int) -> int:
        """How many states a belief has."""
        layout = self.layout
        return 1 + {1: self._ways * places, 2: layout.rows * layout.columns}[layout.dimensions]

    def packed(self, state: FilterState) -> Tensor:
        """The state of a filter without a lag: `counted` numbers and its belief, (C+S,), or, if it learns,
        its belief and what is learned in rows (R,S)."""
        if state.learned is None:
            return torch.cat([state.counts, state.belief])
        numbers = torch.cat([state.belief, *state.learned])
        return F.pad(numbers, (0, -len(numbers) % len(state.belief))).view(-1, len(state.belief))

    def unpacked(self, state: Tensor) -> FilterState:
        """The state that was packed."""
        counts, state = state[..., : self.counted].flatten(), state[..., self.counted :]
        places, rows = self._places(state.shape[-1]), state.reshape(-1, state.shape[-1])
        kind, learned = self._learned, rows[1:].flatten()
        known = None if kind is None else kind.unpacked(learned, places, len(self.move_logits))
        none = state.new_zeros(0, places), (), state.new_zeros(0, 3), state.new_zeros(())
        return FilterState(rows[0], state.new_zeros(places + 1), known, *none, counts)

    def forward(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        if scores.ndim > 2:
            check_posterior(before, scores.shape[-1])
            return each(self, scores, before)
        return self.near(self.posterior(scores, before)[:, :-1], scores)

    def near(self, posterior: Tensor, scores: Tensor) -> Tensor:
        """`near_scores` of this filter."""
        return near_scores(posterior, scores, self.within, self.layout)

    def posterior(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        """Probability of each place, and of being off the map, after each query; with a lag, given the
        queries after it too.

        Shape: (Q,N), (N+1,) or None -> (Q,N+1), off the map last; rows add up to 1.
        """
        check_posterior(before, scores.shape[-1])
        state = self.start(scores.shape[-1])
        if before is not None:
            motion = self.motion(scores, (0,), state.learned)
            belief = motion.unfolded(before.to(scores))
            state = state._replace(belief=belief, posterior=before)
        return self.followed(scores, state)[0]

    def followed(self, scores: Tensor, state: FilterState | None = None) -> tuple[Tensor, FilterState]:
        """As `posterior`, from the state after the queries before, and the next state."""
        start = self.start(scores.shape[-1]) if state is None else state
        found, _, state = self._answers(scores, start, last=True)
        return found, state

    def step(
        self,
        scores: Tensor,
        state: FilterState,
        route_starts: Sequence[int] = (0,),
        last: bool = False,
        absent: Tensor | None = None,
        moved: Tensor | tuple[Tensor, Tensor | float] | None = None,
    ) -> tuple[Tensor, FilterState]:
        """As of every `SequenceModel`.

        Args:
            last: no queries follow, so all that wait are answered. absent: (B,), nats that speak for being
                off the map, by what is known of each query beside its scores; none by default.
            moved: (B,), places from the query before to each, as odometry tells, NaN where unknown, or these
                and their standard deviation, (B,) or (); along a route.
        """
        told: Tensor | None = None  # neither in an exported graph
        if absent is not None or moved is not None:
            places, spread = moved if isinstance(moved, tuple) else (moved, None)
            own = (absent, 0.0), (places, math.nan), (spread, math.nan)
            told = torch.stack([_or(one, len(scores), default) for one, default in own], 1)
        posteriors, answered, state = self._answers(scores, state, route_starts, last, told)
        return self.near(posteriors[:, :-1], answered), state

    def finish(self, state: FilterState, route_starts: Sequence[int] = (0,)) -> tuple[Tensor, FilterState]:
        """The answers that wait for later queries, at the end of all: -> scores (B,N), the next state."""
        return self.step(state.waiting[:0], state, route_starts, last=True)

    def skipped(self, state: FilterState, queries: int, route_starts: Sequence[int] = (0,)) -> FilterState:
        """The state after queries that are left out: the camera moved once more for each."""
        belief = state.belief
        if state.left_out:
            return state._replace(left_out=(*state.left_out[:-1], state.left_out[-1] + queries))
        motion = self.motion(state.posterior[:-1], route_starts, state.learned)
        for _ in range(queries if bool(belief.any()) else 0):
            belief = motion.moved(belief)
        return state._replace(belief=belief, posterior=state.posterior if self.lag else motion.folded(belief))

    def waiting(self, state: FilterState) -> Tensor:
        """Scores (R,N) of the queries that wait for their answers."""
        return state.waiting

    @property
    def _learned(self) -> type[Learned] | type[Followed] | None:
        """The kind of what is learned on the way."""
        return {1: Learned if self.learns else None, 2: Followed}[self.layout.dimensions]

    @property
    def _nearness(self) -> Nearness:
        """How near queries come to the map; a filter that learns finds in another way what is off it."""
        return self.nearness if self._learned is None else UNKNOWN

    @property
    def counted(self) -> int:  # type: ignore[override]
        return self._nearness.bins

    @without_autocast
    def _answers(
        self,
        scores: Tensor,
        state: FilterState,
        route_starts: Sequence[int] = (0,),
        last: bool = False,
        told: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, FilterState]:
        """Posteriors (A,N+1) of the queries whose answers are due, or of all, their scores (A,N), and the
        next state."""
        if scores.ndim != 2 or scores.shape[1] < 1 or not scores.is_floating_point():
            raise InputError(f"scores are {tuple(scores.shape)} {scores.dtype}; expected floats (Q,N)")
        places = scores.shape[1]
        if not isinstance(state, FilterState):
            raise InputError(f"the state is a {type(state).__name__}; expected that of `start` or of a step")
        if self.layout.places and self.layout.places != places:
            own = f"those of the map's {self.layout.places} places"
            raise InputError(f"scores are {tuple(scores.shape)}; expected {own}")
        if state.posterior.shape != (places + 1,) or len(state.belief) != self._states(places):
            shapes = f"the posterior is {tuple(state.posterior.shape)}, of {len(state.belief)} states"
            own = f"({places + 1},), and {self._states(places)} states, for this map and filter"
            raise InputError(f"{shapes}; expected {own}")
        belief, posterior, learned, waiting, left, known, camera, counts = state.to(scores)
        unknown = scores.new_tensor([0.0, math.nan, math.nan]).expand(len(scores), 3)
        odometry_known = told is not None or len(known) > 0
        left_out, new = (*left, *[0] * len(scores)), scores
        scores = torch.cat([waiting, scores]) if len(waiting) else scores
        moments, motion = moments_of(scores), self.motion(scores, route_starts, learned)
        nats, counts = self._nearness.after(new, moments.varied[len(waiting) :, 0], counts)
        told = (unknown if told is None else told.to(scores)) + F.pad(nats[:, None], (0, 2))
        told = torch.cat([known, told])
        absent = told[:, 0]
        if odometry_known and len(told) and not bool(belief.any()):
            told[0, 1] = math.nan  # there is no query before the first
        likelihoods = scores if learned else self.likelihoods(scores, moments, None, absent)  # else in turn
        posteriors, due = [], len(scores) if last else max(0, len(scores) - self.lag)
        by_odometry = self._by_odometry(motion, told[:, 1:], camera) if odometry_known else None
        for t in range(due):
            ahead = slice(t, t + 1 + self.lag)
            seen = likelihoods[ahead]
            if learned is not None:
                motion = self.motion(scores, route_starts, learned)
                some = Moments(*(one[ahead] for one in moments))
                seen = self.likelihoods(scores[ahead], some, learned, absent[ahead])
            seen = motion.wide(seen[:, :-1], seen[:, -1:])
            moves = [None] * len(seen) if by_odometry is None else by_odometry[0][ahead]
            motions = [one or motion for one in moves]
            expected = motions[0].moved(belief)
            if t == 0:
                expected = torch.where((belief == 0).all(), motion.anywhere(), expected)
            before, belief = belief, updated(expected, seen[0])
            posterior = belief
            if self.lag:
                posterior = updated(belief, self._message(motion, motions, seen, left_out[ahead]))
            posteriors.append(motion.folded(posterior))
            if learned is not None:
                z = (moments.mean[t] - scores[t]).where(moments.valid[t], 0) / moments.spread[t]
                made = motion.counts(before[None], seen[:1]).moves
                learned = learned.after(z, moments.varied[t, 0], motion.folded(expected)[:-1], made)
            for _ in range(left_out[t]):
                belief = motion.moved(belief)
        answers = torch.stack(posteriors) if posteriors else scores.new_zeros(0, places + 1)
        latest = answers[-1] if posteriors else posterior
        camera = camera if by_odometry is None else by_odometry[1][due]
        waits = scores[due:], left_out[due:], told[due:]
        after = FilterState(belief, latest, learned, *waits, camera, counts)
        return answers, scores[:due], after

    @staticmethod
    def _by_odometry(motion: Motion, moved: Tensor, ahead: Tensor) -> tuple[Sequence[Motion | None], Tensor]:
        """The motion to each query of which the places moved are known, by these and their spread, (B,2), and
        by how much of a place the camera is ahead before each and after all."""
        known = ~moved[:, 0].isnan()
        places, aheads = odometry.whole(moved[:, 0], ahead)
        if not bool(known.any()):
            return [None] * len(known), aheads
        if not isinstance(motion, AlongRoute):
            raise InputError("places moved, and the map of an area; expected a route")
        told = cache(partial(odometry.Told, motion))
        slips = odometry.slips(*moved.unbind(1)).double().round(decimals=2)  # so that motions are few
        each = zip(known.tolist(), places.tolist(), slips.tolist(), strict=True)
        return [told(one, slip) if here else None for here, one, slip in each], aheads

    def _message(
        self, motion: Motion, motions: Sequence[Motion], likelihoods: Tensor, left_out: Sequence[int]
    ) -> Tensor:
        """What the queries after the first one say of it, (R,S) -> (S,), by the motion to each."""
        message = torch.ones_like(likelihoods[0])
        for t in range(len(likelihoods) - 1, 0, -1):
            message = message * likelihoods[t]
            message = message / message.amax().clamp(min=MIN_PROBABILITY)
            message = motions[t].expected(message)
            for _ in range(left_out[t - 1]):
                message = motion.expected(message)
        return message

    def likelihoods(
        self,
        scores: Tensor,
        moments: Moments,
        learned: Learned | Followed | None = None,
        absent: Tensor | None = None,
    ) -> Tensor:
        """Likelihoods of the places and of being off the map, (Q,N) -> (Q,N+1), scaled to a maximum of 1 in
        each row; `absent` as in `step`."""
        valid, sharpness = scores.isfinite(), self.log_sharpness.to(scores).exp()
        z = torch.where(valid, moments.mean - scores, 0) / moments.spread
        off = self.off_map.to(z)
        if learned is not None:
            sharpness, off = learned.likelihood(sharpness, off)
        # a query at a place without a score is off the map, but the camera may pass
        off = off.expand(len(z), 1) if absent is None else off + absent[:, None] / sharpness
        logits = sharpness * torch.cat([z.where(valid, off), off], 1)
        logits = torch.where(moments.varied, logits, 0)
        return (logits - logits.amax(1, keepdim=True)).exp()

    def motion(
        self, like: Tensor, route_starts: Sequence[int] = (0,), learned: Learned | Followed | None = None
    ) -> Motion:
        """The transitions of a map, in the type of its scores (..., N)."""
        moves, (_, jump, leave) = (one.to(like).softmax(0) for one in (self.move_logits, self.rate_logits))
        moves = moves if learned is None else learned.moves_after(moves)
        rates = Rates(moves, jump, leave, self.enter_logit.to(like).sigmoid())
        kinds: dict[int, Callable[[], Motion]] = {
            1: lambda: self._along(rates, like.shape[-1], route_starts),
            2: lambda: PlaneMotion(self.layout, rates),
        }
        return kinds[self.layout.dimensions]()

    def _along(self, rates: Rates, places: int, route_starts: Sequence[int]) -> Motion:
        layout, directions = self.layout, 2 if self.back else 1
        states = layout.states() if layout.places else States(places, route_starts=tuple(route_starts))
        states = states._replace(directions=directions, turn=self.turn, back=self.back)
        return AlongRoute(states, rates, FREE if self.learns else self.steady)

    def check(self, queries: int | None, places: int) -> None:
        seen = f"a lag of {self.lag} where all queries are known"
        expect(not self.lag or queries is None, "a PlaceSmoother, or a LiveLocalizer", seen)
        furthest = len(self.move_logits) - 1
        expect(furthest < places, "fewer", f"moves of up to {furthest} places on a map of {places}")

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
            + f", turn={self.turn:.3g}, back={self.back:.3g}"
            + f", speeds=[{', '.join(map(str, self.steady.speeds))}]"
            + (f", lag={self.lag}" if self.lag else "")
            + (", learns=True" if self.learns else "")
        )


def _or(told: Tensor | float | None, queries: int, default: float) -> Tensor:
    """What is told of each of some queries, (B,), or of all, or a default."""
    told = torch.as_tensor(default if told is None else told).detach().cpu()
    told = told.expand(queries) if told.ndim == 0 else told
    seen = f"what is told of {queries} queries is {tuple(told.shape)}"
    expect(told.shape == (queries,), "a number of each", seen)
    return told.to(torch.float64)


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
def near_scores(posterior: Tensor, scores: Tensor, within: int, layout: Layout = ROUTE) -> Tensor:
    """-log of the probability of each place and its neighbours, weighted by a triangle that ends `within`
    places away, in an area by a pyramid that ends sooner, (Q,N) -> (Q,N); +inf if the place's score is."""
    mass = layout.blurred(posterior, min(within, SHARP[layout.dimensions]))
    mass = mass.clamp(torch.finfo(mass.dtype).tiny, 1.0)  # an exporter promotes no types
    return (-mass.log()).masked_fill(~scores.isfinite(), math.inf)


def updated(expected: Tensor, likelihood: Tensor) -> Tensor:
    """Bayes' rule for a belief (N+1,), which stays if the query rules it out."""
    joint = expected * likelihood
    total = joint.sum()
    possible = total > MIN_PROBABILITY
    return torch.where(possible, joint / torch.where(possible, total, 1), expected)
