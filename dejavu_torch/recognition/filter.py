"""A probability for every place, followed along the queries, and for being off the map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.types import InputError, Match, SequenceModel

IMPOSSIBLE = 1e-30  # a probability that gradients still bear
LIKELY = 0.99  # of all probability: a stretch of places with less is not scored alone
UNLIKELY = 1e-4  # of all probability: a place with less ends such a stretch


class Moments(NamedTuple):
    """Mean and standard deviation (Q,1) of each query's finite scores, and whether these differ at all."""

    mean: Tensor
    spread: Tensor
    varied: Tensor


def moments_of(scores: Tensor) -> Moments:
    """Of scores (Q,N); the spread is 1 where all are alike."""
    valid = scores.isfinite()
    count = valid.sum(1, keepdim=True).clamp(min=1)
    mean = torch.where(valid, scores, 0).sum(1, keepdim=True) / count
    variance = torch.where(valid, mean - scores, 0).square().sum(1, keepdim=True) / count
    most = scores.masked_fill(~valid, -math.inf).amax(1, keepdim=True)
    varied = (most > scores.amin(1, keepdim=True)) & (variance > 0)
    return Moments(mean, torch.where(varied, variance, 1).sqrt(), varied)


class PlaceFilter(SequenceModel):
    """Where the latest query is, from all queries so far: the forward algorithm of a hidden Markov model.

    Its states are the N places and one more, off the map. From one query to the next the camera moves forward
    by 0 to V places, jumps to any place, leaves the map or enters it anywhere; driving off its end leaves it.
    A place scored z standard deviations below the mean of a query's scores has the likelihood
    exp(sharpness z), being off the map exp(sharpness off_map).

    Args:
        moves: probabilities of moving by 0, 1, .., V places from one query to the next; they add up to 1.
            A camera that is faster is lost until a jump finds it again.
        jump: probability of being anywhere on the map next, whatever the place before.
        leave: probability of leaving the map. enter: of entering it, from off the map.
        sharpness: nats for a standard deviation; low, as consecutive frames are alike.
        off_map: standard deviations; a place that stands out less than this suggests being off the map.
        within: places; the score of a place counts its neighbours up to here, the less the further away.
        threshold: accept a match whose score is below, math.inf every match; None leaves it to
            `DejaVu.acceptance`, which without a calibrated map accepts what is more likely than not.
        search_every: queries from one search of all places to the next. In between `DejaVu.localize` and
            `LiveLocalizer` score only the stretch of places that holds nearly all of the probability, if
            there is one, as far as the map can score it alone: a spectral map by its chunks, a template map
            by its layers. Probabilities then differ by up to about 0.02, and a jump is noticed at the next
            search.

    Shape: scores (Q,N), the posterior (N+1,) before them or None -> (Q,N), -log of a probability in nats.

    Convention: causal. exp(-score) is at most the probability that the right place lies within `within`
        places. The state is the posterior (N+1,), the last number that of being off the map, and all 0 before
        the first query. A place that nothing covers scores +inf; a query that scores all places alike says
        nothing. The settings from `moves` to `off_map` are parameters; gradients reach them, the scores and
        the state.

    Source: an off-map state is in the topometric filter of Xu, Fischer, Sünderhauf and Milford (RA-L 2021);
        motion model and likelihood are ours.

    Raises:
        InputError: probabilities out of range or that do not add up, other settings out of range; forward:
            scores that are no (Q,N), or a posterior that is none or of another number of places.

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
        rates = {"jump": jump, "leave": leave, "enter": enter}
        if any(not 0 <= rate <= 1 for rate in rates.values()) or jump + leave > 1:
            seen = ", ".join(f"{name} {rate}" for name, rate in rates.items())
            raise InputError(f"{seen}; expected probabilities, jump and leave at most 1 together")
        if not moves or not all(move >= 0 for move in moves) or not abs(sum(moves) - 1) < 1e-6:
            raise InputError(f"the moves are {[*moves]}; expected probabilities that add up to 1")
        if not 0 < sharpness < math.inf or not math.isfinite(off_map):
            raise InputError(
                f"sharpness {sharpness}, off_map {off_map}; expected finite numbers, the sharpness above 0"
            )
        for name, value, least in (("within", within, 0), ("search_every", search_every, 1)):
            if not isinstance(value, int) or value < least:
                raise InputError(f"{name} is {value}; expected a whole number, at least {least}")
        if threshold is not None and math.isnan(threshold):
            raise InputError("the threshold is NaN; expected a number, or None")
        self.move_logits = nn.Parameter(_logits(*moves))
        self.rate_logits = nn.Parameter(_logits(1 - jump - leave, jump, leave))
        self.enter_logit = nn.Parameter(_logits(enter)[0] - _logits(1 - enter)[0])
        self.log_sharpness = nn.Parameter(torch.tensor(float(sharpness)).log())
        self.off_map = nn.Parameter(torch.tensor(float(off_map)))
        self.within, self.threshold, self.search_every = within, threshold, search_every

    def start(self, places: int, fixed: bool = False) -> Tensor:
        """See `SequenceModel`."""
        return torch.zeros(places + 1, device=self.off_map.device)

    def forward(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        return self.unlikely(self.posterior(scores, before)[:, :-1], scores)

    def posterior(self, scores: Tensor, before: Tensor | None = None) -> Tensor:
        """Probability of each place, and of being off the map, after each query.

        Shape: (Q,N), (N+1,) or None -> (Q,N+1), the last column being off the map; rows add up to 1.
        """
        if before is None:
            before = self.start(scores.shape[-1])
        elif before.shape == (scores.shape[-1] + 1,):
            _check_posterior(before)
        return self._posteriors(scores, before)

    def step(self, scores: Tensor, state: Tensor, firsts: Sequence[int] = (0,)) -> tuple[Tensor, Tensor]:
        posteriors = self._posteriors(scores, state)
        return self.unlikely(posteriors[:, :-1], scores), posteriors[-1] if len(scores) else state

    def _posteriors(self, scores: Tensor, state: Tensor) -> Tensor:
        if scores.ndim != 2 or scores.shape[1] < 1 or not scores.is_floating_point():
            raise InputError(f"scores are {tuple(scores.shape)} {scores.dtype}; expected floats (Q,N)")
        places, rows = scores.shape[1], list[Tensor]()
        if state.shape != (places + 1,):
            raise InputError(f"a posterior {tuple(state.shape)} of another map; expected ({places + 1},)")
        if not len(scores):
            return scores.new_zeros(0, places + 1)
        belief = _with_rest(state.to(scores))
        none_before = (belief == 0).all()
        for likelihood in self.likelihoods(scores, moments_of(scores)):
            expected = self.moved(belief, places)
            if not rows:
                expected = torch.where(none_before, self.anywhere(places).to(scores), expected)
            belief = updated(expected, likelihood)
            rows.append(belief)
        return _without_rest(torch.stack(rows))

    def predicted(self, posterior: Tensor) -> Tensor:
        """The posterior after the next move, before a query: (N+1,) -> (N+1,)."""
        _check_posterior(posterior)
        return _without_rest(self.moved(_with_rest(posterior), len(posterior) - 1))

    def likelihoods(self, scores: Tensor, moments: Moments) -> Tensor:
        """Likelihoods of each query up to a factor, the greatest of each row 1.

        Args:
            scores: of W places. moments: of the scores of all places, which may be more.

        Shape: (Q,W) -> (Q,W+2): of each place, of another one that scores as the mean, and of no place.
        """
        mean, spread, varied = moments
        valid = scores.isfinite()
        z = torch.where(valid, mean - scores, 0) / spread
        others = torch.stack([z.new_zeros(()), self.off_map.to(z)]).expand(len(z), 2)
        logits = torch.where(varied, self.log_sharpness.to(z).exp() * torch.cat([z, others], 1), 0)
        closed = torch.cat([~valid, valid.new_zeros(len(z), 2)], 1) & varied
        logits = logits.masked_fill(closed, -math.inf)
        return (logits - logits.amax(1, keepdim=True)).exp()

    def anywhere(self, places: int) -> Tensor:
        """The belief before the first query: off the map or on it, as many as leave and enter."""
        leave, enter = self.rate_logits.softmax(0)[2], self.enter_logit.sigmoid()
        off = (leave / (leave + enter)).clamp(max=0.5)
        return torch.cat([((1 - off) / places).expand(places), off.new_zeros(1), off[None]])

    def moved(self, belief: Tensor, places: int, start: int = 0) -> Tensor:
        """The belief before the next query.

        A belief (W+2,) holds the probability of each of the places [start, start + W), that of all others
        together, and that of being off the map. The result has up to V more places, as far as one can drive.
        """
        moves, rates = (logits.to(belief).softmax(0) for logits in (self.move_logits, self.rate_logits))
        (stay, jump, leave), enter = rates, self.enter_logit.sigmoid().to(belief)
        on, rest, off = belief[:-2], belief[-2], belief[-1]
        furthest = len(moves) - 1
        ahead = min(furthest, places - start - len(on))
        # a convolution, but conv1d takes 100 times as long for one row
        moved = F.pad(on, (furthest, ahead)).unfold(0, furthest + 1, 1) @ moves.flip(0)
        total = on.sum() + rest
        anywhere = (jump * total + enter * off) / places
        rest = stay * rest + anywhere * (places - len(moved))
        off = stay * (on.sum() - moved.sum()) + leave * total + (1 - enter) * off
        return torch.cat([stay * moved + anywhere, rest[None], off[None]])

    def unlikely(self, posterior: Tensor, scores: Tensor) -> Tensor:
        """-log of the probability of each place and its neighbours, (Q,W) -> (Q,W); +inf where scores are."""
        within = min(self.within, posterior.shape[1])  # further neighbours there are not
        side = within + 1  # two means over so many make a triangle
        padded = F.pad(posterior[:, None], (within, within))
        mass = side * F.avg_pool1d(F.avg_pool1d(padded, side, 1), side, 1)[:, 0]
        score = -mass.clamp(torch.finfo(mass.dtype).tiny, 1.0).log()  # an exporter promotes no types
        return score.masked_fill(~scores.isfinite(), math.inf)

    def check(self, queries: int | None, places: int) -> None:
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


class LocalSearch:
    """A filter that between two searches scores only the likely stretch of places; keeps its state.

    All other places count as if they scored as the mean, and mean and spread are those of the last search.
    """

    def __init__(self, filter: PlaceFilter, route: PlaceMap) -> None:
        self.filter, self.route = filter, route
        self.belief: Tensor | None = None  # of the places from `start` on
        self.start = self.since = self.skipped = 0  # queries since the last search; left out before the next
        self.search: tuple[Moments, Tensor] | None = None  # the last: moments, and which places are covered

    def __call__(self, query: Tensor) -> LocalScores:
        """Scores as of `PlaceFilter` of the next query, (1,K)."""
        filter, places = self.filter, self.route.places
        belief, start, since, search = self.belief, self.start, self.since, self.search
        near = None if belief is None or search is None or since >= filter.search_every else _likely(belief)
        if belief is not None and near is not None:
            on = belief[near.start : near.stop]
            rest = belief[-2] + (belief[:-2].sum() - on.sum())
            belief, start = torch.cat([on, rest[None], belief[-1:]]), start + near.start
        elif belief is not None:
            belief, start = self._spread(belief), 0
        expected = filter.anywhere(places) if belief is None else belief
        for _ in range(0 if belief is None else 1 + self.skipped):
            expected = filter.moved(expected, places, start)
        if search is None or near is None:
            scores = self.route.scores(query)
            moments, covered = moments_of(scores), scores.isfinite()
            if moments.varied:  # a query that says nothing is no search
                search, since = (moments, covered), 0
        else:
            blocks = self.route.score_blocks(query, start, start + len(expected) - 2)
            scores = torch.cat([block for _, block in blocks], 1)
            moments, covered = search
        belief = updated(expected.to(scores), filter.likelihoods(scores, moments)[0])
        self.belief, self.start, self.since, self.search, self.skipped = belief, start, since + 1, search, 0
        return self._unlikely(belief, start, scores, covered)

    def _unlikely(self, belief: Tensor, start: int, scores: Tensor, covered: Tensor) -> LocalScores:
        """Of a belief, and the scores (1,W) of its places."""
        within, places, stop = self.filter.within, self.route.places, start + scores.shape[1]
        elsewhere = (within + 1) * belief[-2] / max(1, places - stop + start)
        elsewhere = -elsewhere.clamp(torch.finfo(belief.dtype).tiny, 1).log()
        left, right = min(within, start), min(within, places - stop)  # neighbours beside the W
        on, seen = (F.pad(one, (left, right)) for one in (belief[None, :-2], scores))
        near = torch.minimum(elsewhere, self.filter.unlikely(on, seen))
        open_ = seen.isfinite() & covered[:, start - left : stop + right]
        return LocalScores(near.masked_fill(~open_, math.inf), start - left, elsewhere, covered)

    @property
    def posterior(self) -> Tensor | None:
        """(N+1,), None before the first query."""
        return None if self.belief is None else _without_rest(self._spread(self.belief))

    def _spread(self, belief: Tensor) -> Tensor:
        """A belief of all places from one of those from `start` on."""
        count = len(belief) - 2
        on = (belief[-2] / max(1, self.route.places - count)).repeat(self.route.places)
        on[self.start : self.start + count] = belief[:-2]
        return torch.cat([on, belief.new_zeros(1), belief[-1:]])


class LocalScores(NamedTuple):
    """Scores (1,W) of the places from `start` on; all others that are covered, (1,N), score `elsewhere`."""

    scores: Tensor
    start: int
    elsewhere: Tensor
    covered: Tensor

    def row(self) -> Tensor:
        """(1,N)"""
        row = self.elsewhere.repeat(self.covered.shape).masked_fill_(~self.covered, math.inf)
        row[:, self.start : self.start + self.scores.shape[1]] = self.scores
        return row

    def best(self) -> Match:
        """The best place, (1,1); most often without a row of all places."""
        near = best_candidates(self.scores, 1, 0)
        if bool(near.score < self.elsewhere):
            return near._replace(index=near.index + self.start)
        return best_candidates(self.row(), 1, 0)


def updated(expected: Tensor, likelihood: Tensor) -> Tensor:
    """Bayes' rule; if what is likely was impossible, the expectation stays."""
    joint = expected * likelihood
    total = joint.sum()
    return torch.where(total > IMPOSSIBLE, joint / torch.where(total > IMPOSSIBLE, total, 1), expected)


def _likely(belief: Tensor) -> range | None:
    """The stretch of a belief's places that holds most of it; None if none does."""
    on = belief[:-2]
    (likely,) = (on > UNLIKELY).nonzero(as_tuple=True)
    near = range(int(likely[0]), int(likely[-1]) + 1) if len(likely) else range(0)
    return near if float(on[near.start : near.stop].sum()) > LIKELY else None


def _logits(*probabilities: float) -> Tensor:
    """Logarithms whose gradients are finite where a probability is 0."""
    return torch.tensor(probabilities).clamp(min=IMPOSSIBLE).log()


def _check_posterior(posterior: Tensor) -> None:
    valid = posterior.ndim == 1 and len(posterior) > 1 and bool((posterior >= 0).all())
    if not valid or abs(float(posterior.detach().sum()) - 1) > 1e-3:
        raise InputError(
            f"a posterior {tuple(posterior.shape)} that adds up to {float(posterior.detach().sum()):.4g}; "
            "expected probabilities (N+1,) that add up to 1"
        )


def _with_rest(posterior: Tensor) -> Tensor:
    """A posterior (N+1,) as a belief of all places: there are no others."""
    return torch.cat([posterior[:-1], posterior.new_zeros(1), posterior[-1:]])


def _without_rest(belief: Tensor) -> Tensor:
    return torch.cat([belief[..., :-2], belief[..., -1:]], -1)
