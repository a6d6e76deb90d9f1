"""One hidden Markov engine: where a camera is, by its motion and by what each query says of every state.

States are numbered by a motion, (..., S), being off the map last; leading dimensions are drives of their own.
Filter, smoother and flights use it: parameters go in, beliefs and what was learned come out.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.places.rectangles import window_sums
from dejavu_torch.places.states import States
from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.evidence import RankTable, Standardised

MIN_PROBABILITY = 1e-30  # a probability of 0, with a finite gradient
NUMBERS_AT_ONCE = 2**20  # numbers of a block of queries and states, which stays in the cache
HELD = 2**25  # of all of them, up to which they are kept for the way back

Likelihood = Callable[[int, int], Tensor]  # of the queries [first, last), (..., B, S)


class Rates(NamedTuple):
    """Probabilities of a step, as tensors: moves (..., M) add up to 1; jump, leave and enter (...)."""

    moves: Tensor
    jump: Tensor
    leave: Tensor
    enter: Tensor


class Counts(NamedTuple):
    """Expected numbers of steps: moves (M,); jump, leave, enter, and staying off the map, each ()."""

    moves: Tensor
    jump: Tensor
    leave: Tensor
    enter: Tensor
    absent: Tensor


class Motion(ABC):
    """A step of a camera from one query to the next, and its transpose; rates of several drives (C,) go with
    beliefs (C,S).

    One's own needs `moved` and `expected`; its states are the places in order, and being off the map, and it
    learns no rates. `directions` are those of the `States` that a smoother makes it of.
    """

    directions = chains = 1

    def __init__(self, states: States, rates: Rates) -> None:
        self.states, self.rates = states, rates
        # the share of each place of what goes anywhere
        self.each: float | Tensor = states.share / max(1, states.directions * states.places)

    @abstractmethod
    def moved(self, belief: Tensor) -> Tensor:
        """The belief before the next query."""

    @abstractmethod
    def expected(self, message: Tensor) -> Tensor:
        """What a message of the next query says of the state before: the transpose of `moved`."""

    def anywhere(self) -> Tensor:
        """The belief before the first query: in the equilibrium of leaving and entering, but on the map by
        half at least."""
        both = (self.rates.leave + self.rates.enter).clamp(min=MIN_PROBABILITY)
        off = (self.rates.leave / both).clamp(max=0.5)
        on = 1 - off[..., None]
        places = self.chains * self.states.directions * self.states.places
        off = off[..., None] + on * (1 - self.states.share)
        return torch.cat([(on * self.each).expand(*off.shape[:-1], places), off], -1)

    def counts(self, before: Tensor, after: Tensor) -> Counts:
        """Expected numbers of steps (the E-step of Baum and Welch).

        Args:
            before: (..., S) beliefs given all queries so far. after: (..., S) messages of the next query and
                all after it, of any scale.
        """
        moves = torch.zeros_like(self.rates.moves)
        return Counts(moves, *moves.new_zeros(4))

    def wide(self, places: Tensor, off: float | Tensor) -> Tensor:
        """Numbers of the places (..., N), and that off the map, (..., 1), for all states (..., S)."""
        ways = [places, places.flip(-1)][: self.states.directions]
        off = off if isinstance(off, Tensor) else places.new_full((*places.shape[:-1], 1), off)
        return torch.cat([*ways, off], -1)

    def unfolded(self, posterior: Tensor) -> Tensor:
        """A belief in all states by one in the places and in being off the map, (N+1,) -> (S,)."""
        return self.wide(posterior[:-1], posterior[-1:])

    def folded(self, mass: Tensor) -> Tensor:
        """Mass of all states (..., S) -> of the places, whichever way, and off the map, (..., N+1)."""
        if self.states.directions == 1:
            return mass
        places = self.states.places
        return torch.cat([mass[..., :places] + mass[..., places:-1].flip(-1), mass[..., -1:]], -1)

    def told(
        self, block: Block, std: Standardised, normal: Tensor, shares: Tensor, table: RankTable
    ) -> Tensor:
        """What a block tells of the scores: right ones, and those near them, are taken from the table.

        Args:
            std: of its queries. normal: their normal scores (..., B, N). shares: (..., B), what each counts.

        Returns:
            (2,): the sum of the normal scores of right places, without the query's own evidence, so that this
            is not mistaken for that of its place, and the mass of these.
        """
        own, others = (self.folded(one)[..., :-1] for one in (block.posterior, normalised(block.others)))
        shares = shares[..., None]
        table.add(std.z, std.only(-shares * self.near(own, chosen.RADIUS), 0))
        others = std.only(others * shares, 0)
        return torch.stack([(others * normal).nansum(), others.sum()])

    def near(self, mass: Tensor, radius: int) -> Tensor:
        """The mass of each place and its neighbours up to a radius, (..., N) -> (..., N)."""
        return near_mass(mass, radius)

    def ahead(self, belief: Tensor, likelihood: Tensor, still: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Forward over some queries.

        Args:
            belief: (..., S) before any move to the first. likelihood: (..., B, S). still: (..., B) bool, the
                queries to which nothing moves.

        Returns:
            Beliefs before each query (..., B, S), log likelihoods (..., B), and the last belief.
        """
        before, totals = [], []
        for t, (seen, rests) in enumerate(zip(likelihood.unbind(-2), at_rest_in(still), strict=True)):
            belief = self._unless(still[..., t], rests, self.moved, belief)
            before.append(belief.expand_as(seen))
            joint = belief * seen
            total = joint.sum(-1, keepdim=True)
            belief = joint / total
            totals.append(total)
        return torch.stack(before, -2), torch.cat(totals, -1).log(), belief

    def behind(self, message: Tensor, likelihood: Tensor, still: Tensor) -> tuple[Tensor, Tensor]:
        """Backward over some queries: messages (..., S) of those after the last one -> (..., B, S) of those
        after each, and that of the first and all after it."""
        after, rests = [], at_rest_in(still)
        for t in reversed(range(likelihood.shape[-2])):
            after.append(message)
            message = message * likelihood[..., t, :]
            message = message / message.amax(-1, keepdim=True)
            message = self._unless(still[..., t], rests[t], self.expected, message)
        return torch.stack(after[::-1], -2), message

    @staticmethod
    def _unless(still: Tensor, rests: int, step: Callable[[Tensor], Tensor], belief: Tensor) -> Tensor:
        if not rests:
            return step(belief)
        return belief if rests == still.numel() else torch.where(still[..., None], belief, step(belief))


class Block(NamedTuple):
    """Consecutive queries y_t from `first` on, of a sweep, at states x_t: (..., B, S) each, as the motion
    numbers them.

    before: beliefs p(x_t | y_1 .. y_t-1). likelihood: p(y_t | x_t) in relation to that off the map. after:
    messages p(y_t+1 .. | x_t), of any scale. log: (..., B), log p(y_t | y_1 .. y_t-1).
    """

    first: int
    before: Tensor
    likelihood: Tensor
    after: Tensor
    log: Tensor
    motion: Motion

    @property
    def posterior(self) -> Tensor:
        """p(x_t | all queries)."""
        return normalised(self.others * self.likelihood)

    @property
    def by_place(self) -> Tensor:
        """Probabilities of the places, (..., B, N), in double precision, so that those nearly sure differ."""
        return normalised(self.motion.folded(self.posterior.cpu().double()))[..., :-1]

    @property
    def others(self) -> Tensor:
        """The mass of the states by the other queries, p(x_t | all but y_t), of any scale."""
        return self.before * self.after


class Ahead(NamedTuple):
    """As `Block`, of a pass forward alone; start: (..., S), the belief before any move to its first query."""

    first: int
    start: Tensor
    before: Tensor
    likelihood: Tensor
    log: Tensor


def forward(
    motion: Motion,
    likelihood: Likelihood,
    numbers: range,
    still: Tensor,
    start: Tensor | None = None,
) -> Iterator[Ahead]:
    """Forward over the queries, in blocks.

    Args:
        likelihood: of the queries [first, last), (..., B, S). numbers: the first queries of all blocks.
        still: (..., Q) bool, where nothing moves. start: the belief to begin with.
    """
    belief = motion.anywhere() if start is None else start
    for first in numbers:
        last = min(first + numbers.step, numbers.stop)
        start, like = belief, likelihood(first, last)
        before, log, belief = motion.ahead(belief, like, at_rest(still, first, last))
        yield Ahead(first, start, before, like, log)


def sweep(motion: Motion, likelihood: Likelihood, queries: int, still: Tensor, size: int) -> Iterator[Block]:
    """Forward and backward over the queries, in blocks of `size`, which come from the last to the first;
    see `forward`."""
    numbers, parts = range(0, queries, size), []
    for part in forward(motion, likelihood, numbers, still):
        held = part.first == numbers[-1] or part.before[..., 0, :].numel() * queries <= HELD
        parts.append((part.first, part.start, part if held else None))
    message: Tensor | None = None  # of the queries after a block, before any move from its last
    while parts:
        first, start, known = parts.pop()
        part = known or next(forward(motion, likelihood, numbers[first // size :], still, start))
        if message is None:
            message = torch.ones_like(part.likelihood[..., -1, :])
        rests = at_rest(still, first, first + part.likelihood.shape[-2])
        after, message = motion.behind(message, part.likelihood, rests)
        yield Block(part.first, part.before, part.likelihood, after, part.log, motion)


def at_rest(still: Tensor, first: int, last: int) -> Tensor:
    """Which of the queries [first, last) the camera does not move to: also the first of all."""
    rests = still[..., first:last]
    return rests if first else torch.cat([torch.ones_like(rests[..., :1]), rests[..., 1:]], -1)


def at_rest_in(still: Tensor) -> list[int]:
    """In how many drives the camera does not move to each query, (..., B) -> B numbers, read at once."""
    counts: list[int] = still.reshape(-1, still.shape[-1]).sum(0).tolist()
    return counts


class FittedPart(NamedTuple):
    """Stretches of a drive that are learned from: (..., L, N) at some places; weight and still (..., L) as in
    `Spacing`. over: makes the motion over these places."""

    std: Standardised
    weight: Tensor
    still: Tensor
    over: Callable[..., Motion]

    def part(self, first: int, last: int) -> FittedPart:
        """The queries [first, last) of each stretch."""
        std = self.std.map(lambda column: column.narrow(self.weight.ndim - 1, first, last - first))
        return FittedPart(std, self.weight[..., first:last], self.still[..., first:last], self.over)

    def some(self, every: int) -> FittedPart:
        """One of so many stretches, or, of a single one, so much of it."""
        if self.weight.ndim == 1:
            return self.part(0, -(-len(self.weight) // every))
        std = self.std.map(lambda column: column[::every])
        return FittedPart(std, self.weight[::every], self.still[::every], self.over)


class Fit(NamedTuple):
    """What expectation-maximisation found.

    log: nats by which the model beats being off the map. held: likewise, with jumps, and ways off the
    map, as rare as by the prior.
    """

    rates: Rates
    evidence: Evidence
    log: float
    held: float


class Evidence(NamedTuple):
    """What the scores of a part say of each place: by the `values` of a rank table, `separation` apart, as if
    `tempering` queries were one."""

    values: Tensor
    separation: float
    tempering: float

    def __call__(self, std: Standardised, weight: Tensor) -> Tensor:
        """Tempered log likelihood ratio of scores (..., Q, N), right ones beside wrong ones: their normal
        scores are Gaussian with variance 1."""
        return self.of_normal(RankTable.look_up(self.values, std.z), std, weight)

    def of_normal(self, normal: Tensor, std: Standardised, weight: Tensor) -> Tensor:
        """The same, by normal scores (..., Q, N)."""
        shares = (weight * std.speaks / self.tempering)[..., None]
        log = (normal - self.separation / 2) * (self.separation * shares)
        log = log if std.absent is None else log - std.absent[..., None] * shares
        log = std.only(log, -math.inf)
        return log if std.holes is None else log.masked_fill(std.holes, 0)

    def likelihood(self, sample: FittedPart, motion: Motion, normal: Tensor | None = None) -> Likelihood:
        """That of a sample, 1 off the map, by its normal scores, if they are known."""

        def likelihood(first: int, last: int) -> Tensor:
            std, weight, *_ = sample.part(first, last)
            if normal is None:
                return motion.wide(self(std, weight).exp(), 1.0)
            own = normal.narrow(-2, first, last - first)
            return motion.wide(self.of_normal(own, std, weight).exp(), 1.0)

        return likelihood


def explained(
    sample: FittedPart,
    evidence: Evidence,
    motion: Motion,
    size: int | None = None,
    normal: Tensor | None = None,
) -> Iterator[Block]:
    """What follows from a sample, in blocks of `size` queries, the last first."""
    queries, size = sample.weight.shape[-1], size or size_of(motion, sample.weight)
    yield from sweep(motion, evidence.likelihood(sample, motion, normal), queries, sample.still, size)


def size_of(motion: Motion, still: Tensor) -> int:
    """Queries of a block, of drives (..., Q): about the root of their number, or more if they are small."""
    *lead, queries = still.shape
    return max(1, math.isqrt(queries), NUMBERS_AT_ONCE // (math.prod(lead) * motion.anywhere().shape[-1]))


@torch.no_grad()
def learn(
    samples: Sequence[FittedPart],
    ranks: RankTable,
    rates: Rates,
    evidence: Evidence,
    least: float,
    again: Callable[[Counts], Rates],
) -> tuple[Rates, Evidence]:
    """Expectation-maximisation of rates, separation and ranks.

    Args:
        samples: of one drive. ranks: of all their scores. rates, evidence: to begin with. least: separation.
            again: rates by counts, with those of the priors.

    Returns:
        Rates and evidence, by the `values` of the table of wrong scores.
    """
    z = samples[0].std.z
    for _ in range(chosen.ROUNDS):
        table, sums, counts = RankTable(ranks.counts), z.new_zeros(2), []
        for sample in samples:
            motion = sample.over(rates)
            normal = RankTable.look_up(evidence.values, sample.std.z)
            after: Tensor | None = None  # what the block behind says of its first query
            for block in explained(sample, evidence, motion, None, normal):
                first, last = block.first, block.first + block.log.shape[-1]
                std, weight, *_ = sample.part(first, last)
                sums += motion.told(
                    block, std, normal.narrow(-2, first, last - first), weight * std.speaks, table
                )
                counts.append(motion.counts(*steps(block, after, sample.still)))
                after = block.likelihood[..., :1, :] * block.after[..., :1, :]
        separation = max(least, float(sums[0] / sums[1].clamp(min=MIN_PROBABILITY)))
        evidence = Evidence(table.values, separation, evidence.tempering)
        rates = again(Counts(*(torch.stack(kind).sum(0) for kind in zip(*counts, strict=True))))
    return rates, evidence


def steps(block: Block, after: Tensor | None, still: Tensor) -> tuple[Tensor, Tensor]:
    """The steps from the queries of a block to those after them, for `Motion.counts`; `after` is the message
    of the first query behind it."""
    before, seen = block.before * block.likelihood, (block.likelihood * block.after)[..., 1:, :]
    after = seen if after is None else torch.cat([seen, after], -2)
    before, first = before[..., : after.shape[-2], :], block.first + 1
    moving = ~still[..., first : first + after.shape[-2]]
    return (before, after) if moving.all() else (before[moving], after[moving])


@torch.no_grad()
def nats(samples: Sequence[FittedPart], evidence: Evidence, *models: Rates) -> list[float]:
    """By how much each of some models beats being off the map."""
    totals = [0.0 for _ in models]
    for sample in samples:
        normal = RankTable.look_up(evidence.values, sample.std.z)
        for i, rates in enumerate(models):
            motion = sample.over(rates)
            numbers = range(0, sample.weight.shape[-1], size_of(motion, sample.weight))
            parts = forward(motion, evidence.likelihood(sample, motion, normal), numbers, sample.still)
            totals[i] += float(sum(part.log.sum() for part in parts))
    return totals


def normalised(mass: Tensor) -> Tensor:
    """Mass (..., S) that adds up to 1."""
    return mass / mass.sum(-1, keepdim=True)


def near_mass(mass: Tensor, radius: int) -> Tensor:
    """The mass of each place and its neighbours up to a radius, (..., N) -> (..., N)."""
    radius = min(radius, mass.shape[-1])
    return window_sums(F.pad(mass, (radius, radius)), 2 * radius + 1).clamp(0, 1)
