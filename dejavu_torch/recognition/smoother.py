"""The places of all queries of a drive, each given all of them, before and after."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from typing_extensions import Self

from dejavu_torch.places.layout import Layout
from dejavu_torch.places.states import Link, States
from dejavu_torch.recognition import chosen, odometry
from dejavu_torch.recognition.engine import (
    Block,
    Counts,
    Evidence,
    Fit,
    FittedPart,
    Likelihood,
    Motion,
    Rates,
    explained,
    forward,
    learn,
    nats,
    size_of,
    steps,
    sweep,
)
from dejavu_torch.recognition.evidence import (
    Presence,
    RankTable,
    Spacing,
    place_means,
    spacing_of,
    speaking,
    standardised,
)
from dejavu_torch.recognition.filter import near_scores
from dejavu_torch.recognition.motion import AlongRoute, checked_rates, logits
from dejavu_torch.recognition.speeds import FREE, Speeds, steady
from dejavu_torch.recognition.taken import Singly, moves_along
from dejavu_torch.types import Facts, InputError, Odometer, SequenceModel, expect

WHOLE = "a smoother has to know the whole drive; expected a PlaceFilter, or a SequenceMatcher"

Rows = Callable[[Tensor], Tensor]  # numbers of queries (B,) -> their scores (B,N)


class PlaceSmoother(SequenceModel):
    """The place of each query given the whole drive: the forward-backward algorithm, with evidence by rank.

    The states of a hidden Markov model are the places, in both directions of travel, and being off the map.
    A score that a share u of the wrong scores of the drive reaches has the normal score x = -Phi^-1(u), and
    its place the log evidence (separation x - separation^2 / 2) / tempering, relative to being off the map:
    the likelihood ratio of Gaussians that are `separation` apart, tempered since consecutive queries are
    alike. `fit` learns all of it from the queries, without ground truth, with the moves and rates below as
    priors.

    Args:
        moves: probabilities of moving by 0, 1, .., V places from one query to the next.
        jump, leave, enter: of being anywhere next, of leaving the map and of entering it.
        turn: of turning round.
        separation: mu, mean normal score of right places, in standard deviations.
        tempering: tau', consecutive queries that say as much as one; at least 1.
        within: places; as in `PlaceFilter`.
        threshold: accept a match if its score is below; None leaves it to `DejaVu.acceptance`.
        links: further steps (from, to, probability) in place of that to the next place.
        loop: the last place leads to the first one.
        motion: a kind of motion of one's own along a route, which is made of `States` and `Rates`; not for
            large maps, which are searched in parts.
        moved: (Q,), how many places the camera moved to each query of a drive from the one before it, as
            odometry tells, see `checked_moved`; the first does not count.

    Shape: scores (..., Q, N) -> (..., Q, N), -log of a probability in nats. Descriptors (Q,K), where given,
        tell how the queries depend on each other; else the scores tell it.

    Convention: exp(-score) is at most the probability that the right place is within `within` places. A query
        whose scores are all equal, or NaN or infinite, says nothing. Where a score is NaN or infinite, so is
        the result. A state holds moves and rates; `fit` learns the rest again.

    Source: Rabiner (1989) for forward-backward and Baum-Welch; evidence and motion model are ours.

    Raises:
        InputError: settings or scores of another shape or out of range.

    Example:
        >>> scores = torch.rand(60, 60, generator=torch.Generator().manual_seed(0)) - torch.eye(60) / 2
        >>> scores[20] = 0.0  # says nothing
        >>> PlaceSmoother(within=0).fit(scores)(scores)[19:22].argmin(1)
        tensor([19, 20, 21])
    """

    values: Tensor
    means: Tensor

    answers, whole = "drive", True

    def __init__(
        self,
        moves: Sequence[float] = chosen.MOVES,
        jump: float = 0.001,
        leave: float = 0.001,
        enter: float = 0.01,
        turn: float = 0.002,
        separation: float = 1.5,
        tempering: float = 1.0,
        within: int = 5,
        threshold: float | None = None,
        links: Sequence[Link] = (),
        loop: bool = False,
        motion: type[Motion] = AlongRoute,
        moved: odometry.Moved | None = None,
    ) -> None:
        super().__init__()
        moves = checked_rates(moves, jump, leave, enter)
        expect(0 <= turn <= 1, "a probability", turn=turn)
        fits = 0 < separation < math.inf and 1 <= tempering < math.inf
        expect(fits, "finite, above 0 and at least 1", f"separation {separation}, tempering {tempering}")
        expect(isinstance(within, int) and within >= 0, "a whole number, at least 0", within=within)
        expect(threshold is None or not math.isnan(threshold), "a number, or None", "the threshold is NaN")
        for link in links:
            if len(link) != 3 or not all(isinstance(place, int) for place in link[:2]):
                raise InputError(f"a link is {link}; expected a place, another one, and a probability")
        self.move_logits = nn.Parameter(logits(*moves))
        self.rate_logits = nn.Parameter(logits(1 - jump - leave, jump, leave))
        self.enter_logit = nn.Parameter(logits(enter)[0] - logits(1 - enter)[0])
        self.turn, self.separation, self.tempering = turn, float(separation), float(tempering)
        self.within, self.threshold = within, threshold
        self.links, self.loop, self.motion, self.moved = tuple(links), loop, motion, moved
        self.map_links: tuple[Link, ...] = ()  # those of the map
        self.removed = 1.0  # share of each place's mean score that is removed
        self.log_likelihood: float | None = None  # nats above being off the map throughout, as fitted
        self.nats_per_query = 0.0  # likewise, with rare jumps, as if queries did not depend on each other
        self.jumps = 0.0  # nats that learned jumps add, in place of rare ones
        self.singly: Singly | None = None  # what single images say, if they were asked
        self.correlation = 1.0  # tau of these queries
        self.steady = FREE  # beside free motion, of a fitted drive
        self.is_drive = True  # whether the queries that were fitted to are a drive of the map
        self.prior, self.rate_prior, self.first_separation = moves, (jump, leave, enter), float(separation)
        self.register_buffer("values", torch.zeros(0), persistent=False)  # of the rank table
        self.register_buffer("means", torch.zeros(0), persistent=False)  # scores of each place

    def over(self, layout: Layout) -> Self:
        return self

    def start(self, places: int, fixed: bool = False) -> Tensor:
        raise InputError(WHOLE)

    def step(self, *_: object) -> tuple[Tensor, Tensor]:
        raise InputError(WHOLE)

    def check(self, queries: int | None, places: int) -> None:
        """Nothing: few queries, and maps of few places, are answered by single queries."""

    def threshold_of(self, threshold: float | None) -> float | None:
        """The smoother's own threshold: its scores are probabilities, not distances."""
        return self.threshold

    def forward(
        self, scores: Tensor, descriptors: Tensor | None = None, route_starts: Sequence[int] = (0,)
    ) -> Tensor:
        if scores.ndim > 2:
            lead = scores.shape[:-2]
            each = [self(one, None, route_starts) for one in scores.flatten(0, -3)]
            return torch.stack(each).view(*lead, *each[0].shape) if each else scores.clone()
        posterior = self.posterior(scores, descriptors, route_starts)
        return near_scores(posterior[:, :-1], scores, self.within).to(scores.dtype)

    def posterior(
        self, scores: Tensor, descriptors: Tensor | None = None, route_starts: Sequence[int] = (0,)
    ) -> Tensor:
        """Probability of each place, and of being off the map, for each query.

        Shape: (Q,N), (Q,K) or None -> (Q,N+1), off the map last; rows add up to 1.
        """
        blocks = self.blocks(self.drive(scores, descriptors), route_starts)
        parts = [block.motion.folded(block.posterior) for block in blocks]
        return torch.cat(parts[::-1]) if parts else scores.new_zeros(0, scores.shape[1] + 1)

    def log_evidence(
        self, scores: Tensor, descriptors: Tensor | None = None, route_starts: Sequence[int] = (0,)
    ) -> Tensor:
        """Log likelihood of the queries, relative to being off the map throughout, in nats: ().

        Differentiable in `move_logits`, `rate_logits` and `enter_logit`.
        """
        blocks = self.blocks(self.drive(scores, descriptors), route_starts)
        return torch.stack([scores.new_zeros(()), *(block.log.sum() for block in blocks)]).sum()

    @torch.no_grad()
    def path(
        self, scores: Tensor, descriptors: Tensor | None = None, route_starts: Sequence[int] = (0,)
    ) -> Tensor:
        """The most probable sequence of places (Viterbi): (Q,N) -> (Q,) int64, -1 off the map.

        Of several ways from one place to another, as by a link, the best one counts.
        """
        drive = self.drive(scores, descriptors)
        motion, still = self.steps(scores.shape[1], route_starts, drive.means), drive.spacing.stopped
        if not isinstance(motion, AlongRoute):
            raise InputError(f"the motion is a {type(motion).__name__}; expected one along a route")
        expect(self.moved is None, "`posterior`", "a path, and places moved")
        log = motion.wide(drive.log_likelihood(torch.arange(len(scores))), 0.0)
        best = [motion.anywhere().log() + log[0]] if len(scores) else []
        for t in range(1, len(scores)):
            best.append((best[-1] if still[t] else motion.best_moved(best[-1])) + log[t])
        states: list[int] = []
        for t in reversed(range(len(best))):
            reached = best[t]
            if states and still[t + 1]:
                states.append(states[-1])
                continue
            if states:
                target = F.one_hot(torch.tensor(states[-1]), reached.shape[-1]).to(reached)
                reached = reached + motion.expected(target).log()
            states.append(int(reached.argmax()))
        state, n = torch.tensor(states[::-1], dtype=torch.int64), scores.shape[1]
        off, place = motion.anywhere().shape[-1] - 1, state % (motion.states.directions * n)
        return torch.where(state < off, torch.where(place < n, place, 2 * n - 1 - place), -1)

    def steps(self, places: int, route_starts: Sequence[int], like: Tensor) -> Motion:
        """The transitions of a map, in the type of its scores."""
        return self.over_states(self.states(places, route_starts), self.rates(like))

    def over_states(self, states: States, rates: Rates) -> Motion:
        """The transitions between some states, with the speeds of the drive."""
        return AlongRoute(states, rates, self.steady) if self.steady.speeds else self.motion(states, rates)

    def rates(self, like: Tensor) -> Rates:
        moves, (_, jump, leave) = (one.to(like).softmax(0) for one in (self.move_logits, self.rate_logits))
        return Rates(moves, jump, leave, self.enter_logit.to(like).sigmoid())

    def states(self, places: int, route_starts: Sequence[int] = (0,)) -> States:
        links = self.links + self.map_links
        if self.loop:
            ends = (*route_starts[1:], places)
            links += tuple((end - 1, start, 1.0) for start, end in zip(route_starts, ends, strict=True))
        for first, second, share in links:
            if not (0 <= first < places and 0 <= second < places and 0 <= share <= 1):
                seen = f"the link {(first, second, share)} on {places} places"
                raise InputError(f"{seen}; expected two of these places and a probability")
        return States(places, self.motion.directions, tuple(route_starts), links, self.turn)

    def drive(
        self, scores: Tensor | Rows, descriptors: Tensor | None = None, spacing: Spacing | None = None
    ) -> Drive:
        """The evidence of a drive's queries, by what was fitted; for a matrix, also if nothing was."""
        means, values, presence = (
            self.means,
            self.values,
            None if self.singly is None else self.singly.presence,
        )
        if not isinstance(scores, Tensor):
            rows, spacing = scores, spacing or spacing_of(check_descriptors(descriptors))
        else:
            known = check_scores(scores, descriptors)
            given, rows = known.detach(), rows_of(known)
            spacing = spacing_of(spoken(given) if descriptors is None else check_descriptors(descriptors))
            means = means.to(given)
            if len(means) != scores.shape[1]:
                means = self.removed * place_means(given, spacing.weight.to(given))
            if not len(values):
                std, table = standardised(given, means), RankTable()
                table.add(std.z, std.only(std.speaks[:, None].expand_as(std.z), False))
                values = table.values
        moved = self.moved
        if moved is not None:
            expect(self.motion is AlongRoute, "one of the two", "places moved, and a motion of one's own")
            moved = odometry.checked_moved(moved, len(spacing.stopped))
        return Drive(rows, means, values, spacing, self.separation, self.tempering, presence, moved)

    def blocks(
        self, drive: Drive, route_starts: Sequence[int] = (0,), size: int | None = None
    ) -> Iterator[Block]:
        """Sweep forward, then backward: blocks of queries, the last first. Of long drives, one block of
        queries is in memory, and the belief before each of the others.

        Args:
            size: queries of a block; None is as in `size_of`.
        """
        for block in blocks_together([(self, drive)], route_starts, size):
            first, before, likelihood, after, log, motion = block
            yield Block(first, before[0], likelihood[0], after[0], log[0], motion)

    @torch.no_grad()
    def fit(
        self,
        scores: Tensor | Rows,
        descriptors: Tensor | None = None,
        route_starts: Sequence[int] = (0,),
        spacing: Spacing | None = None,
    ) -> Self:
        """Learn moves, rates, separation, tempering and ranks from the queries of a drive, without truth.

        Expectation-maximisation from one place a query, and, if that explains nothing, from a slower and a
        faster start, on at most `FITTED` queries in up to ten stretches.

        Args:
            scores: (Q,N), or a function of the numbers of queries (B,) that returns their scores (B,N).
            descriptors: (Q,K) of the queries; needed with a function.
            spacing: `spacing_of` these, if it is known.

        Returns:
            A copy that has learned it; `is_drive` tells whether the queries are a drive of the map at all.
        """
        if isinstance(scores, Tensor):
            known = check_scores(scores, descriptors)
            scores, descriptors = rows_of(known), spoken(known) if descriptors is None else descriptors
        descriptors = check_descriptors(descriptors)
        if not len(descriptors):
            return self.forgetful()
        spacing = spacing or spacing_of(descriptors)
        places = scores(torch.zeros(1, dtype=torch.int64)).shape[1]
        repeated = len(descriptors) / float(spacing.weight.sum())  # where frames repeat, stretches are longer
        picked = stretches(len(descriptors), spacing.correlation, places, repeated)
        known = scores(picked.flatten())
        weight, still = spacing.weight.to(known), spacing.stopped.to(known.device)
        means = self.removed * place_means(known, weight[picked.flatten()])
        std = standardised(known, means).map(lambda column: column.unflatten(0, picked.shape))
        ranks = RankTable()
        ranks.add(std.z, std.only((weight[picked] * std.speaks)[..., None].expand_as(std.z), 0))
        states = self.states(places, route_starts)
        samples = [FittedPart(std, weight[picked], still[picked], partial(self.motion, states))]
        return self.taught(samples, ranks, spacing, means)

    def forgetful(self) -> Self:
        """A copy with parameters of its own, without what an earlier drive told."""
        own = {name: nn.Parameter(rate.detach().clone()) for name, rate in self.named_parameters()}
        told = {"log_likelihood": None, "singly": None, "nats_per_query": 0.0, "jumps": 0.0, "steady": FREE}
        return self.changed(is_drive=False, **told, **own)

    @torch.no_grad()
    def taught(
        self, samples: Sequence[FittedPart], ranks: RankTable, spacing: Spacing, means: Tensor
    ) -> Self:
        """As `fit`, from stretches of the drive, the ranks of all their scores, and the `means` of places."""
        like = self.forgetful().changed(correlation=spacing.correlation, tempering=tempering_of(spacing))
        moving = float(sum((~sample.still).sum() for sample in samples))
        different = float(sum(sample.weight.sum() for sample in samples))
        others = (chosen.SLOW, chosen.FAST) if self.prior == chosen.MOVES else ()
        fits = (like._fitted(samples, ranks, start, moving) for start in (self.prior, *others))
        best = first_that_explains(fits, moving, different)
        nats_per_query = like.tempering * best.held / max(1.0, different)
        is_drive, speeds = moves_along(best.held, nats_per_query), FREE
        if is_drive and self.motion is AlongRoute and self.moved is None:
            speeds = speeds_of(samples, best)
        jump, leave, enter = map(float, best.rates[1:])
        learned = {
            "move_logits": logits(*best.rates.moves.tolist()),
            "rate_logits": logits(1 - jump - leave, jump, leave),
            "enter_logit": logits(enter)[0] - logits(1 - enter)[0],
        }
        return like.changed(
            nats_per_query=nats_per_query,
            is_drive=is_drive,
            steady=speeds,
            log_likelihood=best.log,
            jumps=best.log - best.held,
            separation=best.evidence.separation,
            means=means,
            values=best.evidence.values,
            **{name: nn.Parameter(rate.to(self.enter_logit)) for name, rate in learned.items()},
        )

    def _fitted(
        self, samples: Sequence[FittedPart], ranks: RankTable, start: Sequence[float], moved: float
    ) -> Fit:
        """Expectation-maximisation from a start of the moves, which is their prior; `moved` queries move."""
        prior = samples[0].std.z.new_tensor(start)
        rare = [prior.new_tensor(rate) for rate in self.rate_prior]
        again = partial(updated_rates, prior=prior * (chosen.MOVE_SHARE * moved), rates=self.rate_prior)
        first = Evidence(ranks.values, self.first_separation, self.tempering)
        rates, found = learn(samples, ranks, Rates(prior, *rare), first, chosen.MIN_SEPARATION, again)
        log, held = nats(samples, found, rates, rates._replace(jump=rare[0], leave=rare[1]))
        return Fit(rates, found, log, held)

    @torch.no_grad()
    def settled(self) -> Facts:
        """What the smoother settled on, for a report."""
        _, jump, leave = self.rate_logits.softmax(0).tolist()
        singly = {} if self.singly is None else self.singly._asdict()
        singly = {key: value for key, value in singly.items() if key not in ("nats", "least", "presence")}
        return {
            "is_drive": self.is_drive,
            "taken": self.is_drive,
            "log_likelihood": self.log_likelihood,
            "nats_per_query": self.nats_per_query,
            "jumps": self.jumps,
            **singly,
            "moves": self.move_logits.softmax(0).tolist(),
            "speeds": [float(speed) for speed in self.steady.speeds],
            "jump": jump,
            "leave": leave,
            "enter": float(self.enter_logit.sigmoid()),
            "separation": self.separation,
            "correlation": self.correlation,
            "tempering": self.tempering,
        }

    def extra_repr(self) -> str:
        known = self.settled()
        moves = ", ".join(f"{move:.3g}" for move in known.pop("moves"))
        told = ", ".join(f"{name}={value:.3g}" for name, value in known.items() if type(value) is float)
        return f"moves=[{moves}], {told}, within={self.within}"


class Drive(NamedTuple):
    """What a smoother knows of the queries of a drive.

    means: (N,), mean score of each place. values: of the rank table. presence: how near queries come to the
    map, if single images were asked. moved: see `PlaceSmoother`.
    """

    rows: Rows
    means: Tensor
    values: Tensor
    spacing: Spacing
    separation: float
    tempering: float
    presence: Presence | None = None
    moved: Odometer | None = None

    def log_likelihood(self, numbers: Tensor) -> Tensor:
        """Log likelihood of the places for some queries, 0 being off the map: (B,) -> (B,N)."""
        std = standardised(self.rows(numbers), self.means, self.presence)
        weight = self.spacing.weight.cpu()[numbers].to(std.z)
        return Evidence(self.values, self.separation, self.tempering)(std, weight)


def blocks_together(
    drives: Sequence[tuple[PlaceSmoother, Drive]], route_starts: Sequence[int] = (0,), size: int | None = None
) -> Iterator[Block]:
    """As `PlaceSmoother.blocks`, of C drives in one sweep: (C,B,S). All have as many queries, places and
    moves, and the same links and speeds."""
    means = [drive.means for _, drive in drives]
    queries, places = len(drives[0][1].spacing.stopped), len(means[0])
    rates = (smoother.rates(mean) for (smoother, _), mean in zip(drives, means, strict=True))
    first = drives[0][0]
    together = Rates(*map(torch.stack, zip(*rates, strict=True)))
    if queries and drives[0][1].moved is not None:
        yield from _by_odometry(drives[0][1], first.states(places, route_starts), together, size)
        return
    motion = first.over_states(first.states(places, route_starts), together)

    def likelihood(first: int, last: int) -> Tensor:
        numbers = torch.arange(first, last)
        logs = torch.stack([drive.log_likelihood(numbers) for _, drive in drives])
        return motion.wide(logs.exp(), 1.0)

    still = torch.stack([drive.spacing.stopped for _, drive in drives]).to(means[0].device)
    yield from sweep(motion, likelihood, queries, still, size or size_of(motion, still))


def _by_odometry(drive: Drive, states: States, rates: Rates, size: int | None) -> Iterator[Block]:
    """As `blocks_together`, of one drive whose moves are known but for their scale."""
    moved, queries = drive.moved, torch.arange(len(drive.spacing.stopped))
    assert moved is not None
    every = torch.cat([drive.log_likelihood(part) for part in queries.split(math.isqrt(len(queries)))])

    def along(moved: Odometer) -> tuple[Motion, Likelihood, Tensor, Tensor]:
        asked, still = odometry.steps_of(moved)
        motion = odometry.moving(states, rates, 1, float(odometry.slips(*moved.between(0, -1))))

        def likelihood(first: int, last: int) -> Tensor:
            numbers = asked[first:last, None].to(every.device)
            log = torch.where(numbers < 0, 0, every[numbers[:, 0].clamp(min=0)])  # 0 on the way
            return motion.wide(log.exp()[None], 1.0)

        return motion, likelihood, still[None].to(every.device), asked

    @torch.no_grad()
    def log_of(moved: Odometer) -> float:
        motion, likelihood, still, _ = along(moved)
        numbers = range(0, still.shape[1], size_of(motion, still))
        return sum(float(part.log.sum()) for part in forward(motion, likelihood, numbers, still))

    for scales in odometry.paces(moved), chosen.SCALES:
        moved = max(map(moved.times, scales), key=log_of)
    motion, likelihood, still, asked = along(moved)
    for block in sweep(motion, likelihood, still.shape[1], still, size or size_of(motion, still)):
        numbers = asked[block.first : block.first + block.log.shape[-1]]
        known = numbers >= 0
        if known.any():
            before, like, after, log = (one[:, known] for one in block[1:5])
            yield Block(int(numbers[known][0]), before, like, after, log, motion)


def speeds_of(samples: Sequence[FittedPart], fit: Fit) -> Speeds:
    """The steady speeds that occur in stretches of a drive, by its evidence and free motion, and how it
    changes between them: of all speeds from some queries, then of those left from all."""
    speeds, every = steady(), sum(sample.weight.numel() for sample in samples) / chosen.ASKED
    for parts in ([sample.some(math.ceil(every)) for sample in samples], samples):
        counts = []
        for sample in parts:
            motion, after = sample.over(fit.rates, speeds), None
            assert isinstance(motion, AlongRoute)
            for block in explained(sample, fit.evidence, motion):
                counts.append(motion.changes(*steps(block, after, sample.still)))
                after = block.likelihood[..., :1, :] * block.after[..., :1, :]
        speeds = speeds.learned(torch.stack(counts).sum(0).cpu())
    return speeds


def first_that_explains(fits: Iterator[Fit], moving: float, different: float) -> Fit:
    """What was found from the first start, or, if that explains little of the queries that are moving, from
    another speed, if this explains far more of those that are different."""
    first = next(fits)
    if first.log >= max(chosen.OTHER_SPEED, chosen.PER_QUERY * moving):
        return first
    other = max(fits, key=lambda one: one.log, default=first)
    least = max(chosen.OTHER_SPEED, chosen.PER_QUERY * different, chosen.CLEARLY * first.log)
    return other if other.log >= least else first


def rows_of(scores: Tensor) -> Rows:
    """The rows of a matrix by their numbers."""
    return lambda numbers: scores[numbers.to(scores.device)]


def spoken(scores: Tensor) -> Tensor:
    """Scores as descriptors of the queries: queries that say nothing are as the one before them, and 0 is in
    place of infinity."""
    speaks = speaking(scores)
    before = torch.where(speaks, torch.arange(len(scores), device=scores.device), 0).cummax(0).values
    return torch.where(speaks[before, None], scores[before], 0).nan_to_num(0, 0, 0)


def check_descriptors(descriptors: Tensor | None) -> Tensor:
    """Descriptors (Q,K), or an InputError that tells why not."""
    if descriptors is None:
        raise InputError("a function of scores without descriptors; expected those of the queries")
    seen = f"descriptors are {tuple(descriptors.shape)} {descriptors.dtype}"
    expect(descriptors.ndim == 2 and bool(descriptors.isfinite().all()), "finite ones (Q,K)", seen)
    return descriptors


def updated_rates(counts: Counts, prior: Tensor, rates: Sequence[float] = chosen.RATES) -> Rates:
    """The M-step: counts with those of the priors, of moves (V+1,), and of jump, leave and enter."""
    moves, on = counts.moves + prior, counts.moves.sum() + counts.jump + counts.leave + chosen.RATE_COUNTS
    jump, leave, enter = rates
    return Rates(
        moves / moves.sum(),
        (counts.jump + chosen.RATE_COUNTS * jump) / on,
        (counts.leave + chosen.RATE_COUNTS * leave) / on,
        (counts.enter + chosen.ENTER_COUNTS * enter) / (counts.enter + counts.absent + chosen.ENTER_COUNTS),
    )


def stretches(queries: int, correlation: float, places: int = 1, repeated: float = 1.0) -> Tensor:
    """Numbers of queries in evenly spaced stretches, (n,L); of few queries on a large map."""
    used = min(queries, chosen.FITTED, max(chosen.FEWEST_FITTED, chosen.SAMPLED // places))
    length = math.ceil(repeated * max(chosen.STRETCH, chosen.CORRELATED * correlation))
    n = max(1, min(chosen.STRETCHES, used // length))
    length = used // n
    first = torch.linspace(0, queries - length, n).round().long()
    return first[:, None] + torch.arange(length)


def tempering_of(spacing: Spacing) -> float:
    """tau', for how many consecutive queries count as one."""
    return max(1.0, chosen.SHARPENED * spacing.correlation)


def check_scores(scores: Tensor, descriptors: Tensor | None = None) -> Tensor:
    """Scores (Q,N), at least in single precision; refuses what are none, or not those of the descriptors."""
    if scores.ndim != 2 or scores.shape[1] < 1 or not scores.is_floating_point():
        raise InputError(f"scores are {tuple(scores.shape)} {scores.dtype}; expected floats (Q,N)")
    if descriptors is not None and len(descriptors) != len(scores):
        raise InputError(f"{len(descriptors)} descriptors of {len(scores)} queries; expected as many")
    return scores if scores.dtype == torch.float64 else scores.float()
