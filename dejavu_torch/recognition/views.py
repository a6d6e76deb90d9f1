"""Views of a query: what a camera that points a little further right or left than at learning would see.

Each query is described as it is and moved sideways, and has the score of its best view at a place. Each view
has a penalty, which is learned from the surest answers of the queries, without truth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dejavu_torch.data.moving import MOST, Moved
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition.calibration import TOLERANCE, confidence
from dejavu_torch.recognition.scorer import BestOf, Scorer
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.types import Match, Traverse, expect

WIDE, APART = 0.24, 0.04  # shares of the width: how far views are moved, and from one to the next
FIRST, LEAST = 100, 40  # queries that penalties are learned from; fewer do not tell
# Constants of penalties: see `benchmarks views --choose`; also by drives over other ground.
SURE, ROUNDS = 1 / 3, 4  # share of the answers that tell, the surest; times that they are asked
START, NATS = 0.08, 0.04  # first penalty of a moved view, and for each nat by which it is rarer
AS_IT_IS, OTHER = 2.0, 0.3  # answers by the unmoved view, and by each other, that are taken for granted
STEP = 3  # places, from 1 on, between the answers of a query and the next where a camera moves on
MORE = 0.03  # share of the queries where it has to do so more often with moved views, beside chance
CHANCE = 0.08  # share of the answers below which a view is left out; by chance each has one of thirteen
FLAT = 0.02  # of the unit of scores: if those of all views differ less, they do not tell the shift
WIDEST = 180  # degrees of a field of view


def evenly(apart: float = APART, wide: float = WIDE) -> tuple[float, ...]:
    """Even shifts to both sides, 0 first."""
    each = (round(k * apart, 4) for k in range(1, round(wide / apart) + 1))
    return 0.0, *(side for one in each for side in (one, -one))


SHIFTS = evenly()


@dataclass(frozen=True)
class Views:
    """Copies of each query, moved sideways, of which the first is the query itself.

    shifts: see `Moved`. penalties: of each, see `BestOf`; +inf for a view that is left out.
    learns: whether those of queries in order are learned from these, and given ones hold until then.
    fov: horizontal field of view in degrees; if it is known, shifts are told even if no moved view is of use.
    """

    shifts: tuple[float, ...] = (0.0,)
    penalties: tuple[float, ...] = (0.0,)
    learns: bool = False
    fov: float | None = None

    def __post_init__(self) -> None:
        fits = self.fov is None or 0 < self.fov < WIDEST
        expect(fits, f"degrees above 0 and below {WIDEST}", fov=self.fov)

    @classmethod
    def given(cls, shifts: Sequence[float], learns: bool = False, fov: float | None = None) -> Views:
        """The unmoved view and others, which a user has chosen."""
        moved = [float(one) for one in shifts if one]
        expect(moved and max(map(abs, moved)) <= MOST, f"some up to {MOST} of the width", f"shifts {shifts}")
        return cls((0.0, *moved), (0.0, *[START] * len(moved)), learns, fov)

    @property
    def known(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The shifts of the views that answer, and their penalties."""
        pairs = zip(self.shifts, self.penalties, strict=True)
        shifts, penalties = zip(*(pair for pair in pairs if pair[1] < math.inf), strict=True)
        return shifts, penalties

    @property
    def with_unmoved(self) -> Views:
        """Those that answer, and the unmoved one: of images alone, any camera may have taken one."""
        known = dict(zip(*self.known, strict=True))
        known = {0.0: known.pop(0.0, START), **known}
        return replace(self, shifts=tuple(known), penalties=tuple(known.values()))

    def of(self, traverse: Traverse) -> Traverse:
        """The copies of each frame."""
        return traverse if self.shifts == ALONE.shifts else Moved(traverse, self.shifts)

    def __call__(self, scorer: Scorer) -> Scorer:
        """The scores of the best views; `scorer` has those of all."""
        return scorer if self.shifts == ALONE.shifts else BestView(scorer, self.learned(scorer))

    def learned(self, scorer: Scorer) -> Views:
        """The same views with the penalties that the first queries tell, if they are enough."""
        count = len(scorer) // len(self.shifts)
        if not self.learns or count < LEAST:
            return self
        return self.told_by(best_pairs(scorer, len(self.shifts), min(count, FIRST)), scorer.layout)

    def told_by(self, pairs: Match, layout: Layout) -> Views:
        """The same views with the penalties that the `best_pairs` of queries tell."""
        return replace(self, penalties=tuple(penalties_of(pairs, layout).tolist()), learns=False)

    def as_it_drives(self, describes: bool = False) -> Driven:
        """The same, for consecutive queries, of which none knows those after it; see `Driven`."""
        return Driven(self, describes)

    def among(self, shifts: tuple[float, ...] = SHIFTS) -> Views:
        """The same views among others, which are left out."""
        known = dict(zip(self.shifts, self.penalties, strict=True))
        return replace(self, shifts=shifts, penalties=tuple(known.get(one, math.inf) for one in shifts))


ALONE = Views()


class Driven:
    """The best views of consecutive queries, batch by batch: penalties are learned from the first `FIRST` of
    them, and hold for those after these. describes: scorers have only the copies by `shifts`."""

    def __init__(self, views: Views, describes: bool = False) -> None:
        self.views, self.before, self.describes, self.seen = views, views, describes, 0
        self.pairs: list[Match] = []

    @property
    def shifts(self) -> tuple[float, ...]:
        """Of the copies of the next query: only the unmoved one, if no other is of use."""
        alone = not self.views.learns and self.views.fov is None and self.views.known[0] == ALONE.shifts
        return ALONE.shifts if alone and self.describes else self.views.shifts

    def __call__(self, scorer: Scorer) -> Scorer:
        """The scores of the best views; `scorer` has those of all views of the next queries."""
        copies = len(self.shifts)
        count, left = len(scorer) // copies, max(0, FIRST - self.seen)
        if copies == 1 or not count:
            return scorer
        if self.views.learns:
            self.pairs.append(best_pairs(scorer, copies, min(left, count)))
            if count >= left:
                self.views = self.views.told_by(Match.joined(self.pairs), scorer.layout)
                self.pairs = []
        self.seen += count
        return BestView(scorer, self.views, self.before, left)


class BestView(BestOf):
    """As `BestOf`, of copies moved sideways, with the shift of the camera at the place of an answer; `before`
    are the views of the first `first` queries."""

    def __init__(self, scorer: Scorer, views: Views, before: Views = ALONE, first: int = 0) -> None:
        after, known = (torch.tensor(one.among(views.shifts).penalties) for one in (views, before))
        super().__init__(scorer, len(views.shifts), after, known, first)
        self.shifts, self.fov = views.shifts, views.fov

    def told(self, queries: Tensor, places: Tensor) -> dict[str, Tensor]:
        shift = torch.full(places.shape, torch.nan)
        every = (queries[:, None] * self.copies + torch.arange(self.copies)).flatten()
        at = places[:, :1].clamp(min=0).repeat_interleave(self.copies, 0)
        scores = self.scorer.at(every, at).view(len(queries), self.copies).cpu() / self.unit
        shift[:, 0] = shift_of(scores, self.shifts)
        return {"shift": shift} | ({} if self.fov is None else {"shift_degrees": degrees(shift, self.fov)})


def degrees(shift: Tensor, fov: float) -> Tensor:
    """By how many degrees a camera points to the right, by its shift and its horizontal field of view."""
    return (2 * shift * math.tan(math.radians(fov) / 2)).atan().rad2deg()


def best_pairs(scorer: Scorer, copies: int, queries: int) -> Match:
    """The two best places of each copy of the first queries, more than `TOLERANCE` apart, with their scores
    in units: Match of (queries, 2 x copies)."""
    wanted = [(min(2, scorer.layout.places), TOLERANCE)]
    size = max(1, min(scorer.most, scorer.at_once // max(1, scorer.held(wanted))))
    pairs = []
    for part in torch.arange(copies * queries).split(size):
        scores, places = scorer.best(part, wanted)
        pairs.append(best_candidates(scores / scorer.unit, *wanted[0], places, scorer.layout))
    return Match.joined(pairs).map(lambda column: column.cpu().view(queries, -1))


def penalties_of(
    pairs: Match,
    layout: Layout,
    start: float = START,
    nats: float = NATS,
    chance: float = CHANCE,
    more: float = MORE,
) -> Tensor:
    """The penalty of each view, (V,), by the `best_pairs` of queries: the fewer of the surest answers a view
    gives, the more it costs, and +inf if these are hardly more than by chance. Moved views are left out
    unless answers then follow each other more often.

    Args:
        start: penalty of moved views to begin with. nats: penalty for each nat by which a view is rarer.
        chance: share of the surest answers below which a view is left out. more: share of the queries whose
            answers have to follow each other more often with moved views.
    """
    each = min(2, layout.places)
    copies = pairs.score.shape[1] // each
    alone = torch.full((copies,), math.inf).index_fill(0, torch.tensor(0), 0.0)
    penalties, share = alone.clamp(max=start), torch.ones(copies)

    def answered(penalties: Tensor) -> Match:
        total = pairs.score + penalties.to(pairs.score).repeat_interleave(each)
        return best_candidates(total, each, TOLERANCE, pairs.index, layout)

    def steps(penalties: Tensor) -> int:
        place = answered(penalties).index[:, 0].clamp(min=0)
        distance = layout.distance(place[1:], place[:-1])
        return int(((distance >= 1) & (distance <= STEP)).sum())

    for _ in range(ROUNDS):
        sure = confidence(answered(penalties)).topk(max(1, int(SURE * len(pairs)))).indices
        total = pairs.score[sure] + penalties.to(pairs.score).repeat_interleave(each)
        answers = (total.argmin(1) // each).bincount(minlength=copies) + OTHER
        answers[0] += AS_IT_IS - OTHER
        share = answers / answers.sum()
        penalties = nats * (share.max() / share).log()
    penalties = torch.where(share < chance, math.inf, penalties).float()
    near = math.sqrt(len(pairs) * 2 * STEP / layout.places)  # by chance: a standard deviation
    return penalties if steps(penalties) >= steps(alone) + max(more * len(pairs), near) else alone


def shift_of(scores: Tensor, shifts: tuple[float, ...]) -> Tensor:
    """How far a camera points to the right, by the scores of its views at a place, interpolated by a
    parabola; NaN where these are flat: (B,V) -> (B,)."""
    at, order = torch.tensor(shifts).sort()
    scores = scores[:, order].float()
    if len(shifts) < 3:  # between which there is no parabola
        return at[scores.argmin(1)]
    best = scores.argmin(1).clamp(1, len(shifts) - 2)
    low, middle, high = (scores.gather(1, (best + i)[:, None])[:, 0] for i in (-1, 0, 1))
    bend = low - 2 * middle + high
    step = torch.where(bend > 0, (low - high) / (2 * bend.clamp(min=1e-12)), 0.0).clamp(-1, 1)
    known = at[best] + step * torch.where(step > 0, at[best + 1] - at[best], at[best] - at[best - 1])
    return torch.where(scores.amax(1) - scores.amin(1) < FLAT, torch.nan, known)
