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
from dejavu_torch.recognition.calibration import TOLERANCE, confidence
from dejavu_torch.recognition.scorer import BestOf, Scorer
from dejavu_torch.recognition.select import best_candidates
from dejavu_torch.types import Traverse, expect

SHIFTS = (0.0, *(sign * round(0.04 * k, 2) for k in range(1, 7) for sign in (1, -1)))  # of the width
FIRST, LEAST = 100, 40  # queries that penalties are learned from; fewer do not tell
# Constants of penalties: chosen on every second route of `benchmarks views`, checked on the others.
SURE, ROUNDS = 1 / 3, 4  # share of the answers that tell, the surest; times that they are asked
START, NATS = 0.08, 0.04  # first penalty of a moved view, and for each nat by which it is rarer
AS_IT_IS, OTHER = 2.0, 0.3  # answers by the unmoved view, and by each other, that are taken for granted
STEADY = 3  # places between the answers of neighbouring queries; views are of use if more are as near
CHANCE = 0.08  # share of the answers below which a view is left out; by chance each has one of thirteen
MEASURED = 10  # queries whose mean score is the unit of penalties, about 1 for cosines
FLAT = 0.02  # of this unit: scores that differ less over all views do not tell a shift
WIDEST = 180  # degrees of a field of view
MOST_PLACES = 2**17  # of a map on which shifts are measured


@dataclass(frozen=True)
class Views:
    """Copies of each query, moved sideways, of which the first is the query itself.

    shifts: see `Moved`. penalties: of each, in units of a mean score; +inf for a view that is left out.
    learns: whether those of queries in order are learned from these, and given ones hold until then.
    """

    shifts: tuple[float, ...] = (0.0,)
    penalties: tuple[float, ...] = (0.0,)
    learns: bool = False

    @classmethod
    def given(cls, shifts: Sequence[float], learns: bool = False) -> Views:
        """The unmoved view and others, which a user has chosen."""
        moved = [float(one) for one in shifts if one]
        expect(moved and max(map(abs, moved)) <= MOST, f"some up to {MOST} of the width", f"shifts {shifts}")
        return cls((0.0, *moved), (0.0, *[START] * len(moved)), learns)

    @property
    def known(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The shifts of the views that answer, and their penalties."""
        pairs = zip(self.shifts, self.penalties, strict=True)
        shifts, penalties = zip(*(pair for pair in pairs if pair[1] < math.inf), strict=True)
        return shifts, penalties

    def of(self, traverse: Traverse) -> Traverse:
        """The copies of each frame."""
        return traverse if len(self.shifts) == 1 else Moved(traverse, self.shifts)

    def __call__(self, scorer: Scorer) -> Scorer:
        """The scores of the best views; `scorer` has those of all."""
        if len(self.shifts) == 1:
            return scorer
        unit, known = unit_of(scorer, len(self.shifts)), self.learned(scorer)
        return BestView(scorer, self.shifts, unit, unit * torch.tensor(known.penalties))

    def learned(self, scorer: Scorer) -> Views:
        """The same views with the penalties that the first queries tell, if they are enough."""
        copies = len(self.shifts)
        count = len(scorer) // copies
        if not self.learns or count < LEAST:
            return self
        unit = unit_of(scorer, copies)
        penalties = penalties_of(*best_pairs(scorer, copies, min(count, FIRST)), scorer, unit) / unit
        return replace(self, penalties=tuple(penalties.tolist()), learns=False)

    def as_it_drives(self, measures: bool = False) -> Driven:
        """The same, for consecutive queries, of which none knows those after it."""
        return Driven(self, measures)

    def among(self, shifts: tuple[float, ...] = SHIFTS) -> Views:
        """The same views among others, which are left out."""
        known = dict(zip(self.shifts, self.penalties, strict=True))
        return replace(self, shifts=shifts, penalties=tuple(known.get(one, math.inf) for one in shifts))


ALONE = Views()


class Driven:
    """The best views of consecutive queries, batch by batch: penalties are learned from the first `FIRST` of
    them, and hold for those after these. measures: even if no moved view is of use, they tell the shift."""

    def __init__(self, views: Views, measures: bool = False) -> None:
        self.views, self.measures, self.seen, self.unit = views, measures, 0, math.nan
        self.learned: Tensor | None = None  # penalties (V,)
        self.pairs: list[tuple[Tensor, Tensor]] = []

    @property
    def shifts(self) -> tuple[float, ...]:
        """Of the copies of the next query: only the unmoved one, if no other is of use."""
        useful = self.learned is None or bool(self.learned[1:].isfinite().any())
        return self.views.shifts if useful or self.measures else ALONE.shifts

    def __call__(self, scorer: Scorer) -> Scorer:
        """The scores of the best views; `scorer` has those of all views of the next queries."""
        shifts, copies = self.shifts, len(self.shifts)
        count = len(scorer) // copies
        if copies == 1 or not count:
            return scorer
        if not self.seen:
            self.unit = unit_of(scorer)
        before, left = self.unit * torch.tensor(self.views.penalties), FIRST - self.seen
        if self.views.learns and left > 0:
            self.pairs.append(best_pairs(scorer, copies, min(left, count)))
            if count >= left:
                index, score = (torch.cat(column) for column in zip(*self.pairs, strict=True))
                self.learned, self.pairs = penalties_of(index, score, scorer, self.unit), []
        self.seen += count
        after = before if self.learned is None else self.learned
        return BestView(scorer, shifts, self.unit, after, before, max(0, left))


class BestView(BestOf):
    """As `BestOf`, of copies moved sideways, with the shift of the camera at the place of an answer.

    Args:
        shifts: of the copies. unit: of scores, see `unit_of`. penalties, before, first: see `BestOf`.
    """

    def __init__(
        self,
        scorer: Scorer,
        shifts: tuple[float, ...],
        unit: float,
        penalties: Tensor,
        before: Tensor | None = None,
        first: int = 0,
    ) -> None:
        super().__init__(scorer, len(shifts), penalties, before, first)
        self.shifts, self.unit = shifts, unit

    def told(self, queries: Tensor, places: Tensor) -> dict[str, Tensor]:
        shift = torch.full(places.shape, torch.nan)
        if self.layout.places <= MOST_PLACES:
            every = (queries[:, None] * self.copies + torch.arange(self.copies)).flatten()
            scores = self.scorer.rows(every).view(len(queries), self.copies, -1) / self.unit
            at = places[:, None, :1].clamp(min=0).expand(-1, self.copies, -1)
            shift[:, 0] = shift_of(scores.gather(2, at.to(scores.device))[..., 0].cpu(), self.shifts)
        return {"shift": shift}


def degrees(shift: float, fov: float) -> float:
    """By how many degrees a camera points to the right, by its shift and its horizontal field of view."""
    return math.degrees(math.atan(2 * shift * math.tan(math.radians(fov) / 2)))


def check_fov(fov: float | None) -> None:
    """Refuse a field of view that no flat picture has."""
    expect(fov is None or 0 < fov < WIDEST, f"degrees above 0 and below {WIDEST}", fov=fov)


def unit_of(scorer: Scorer, copies: int = 0) -> float:
    """The mean finite score, of the first query or of some with so many copies; the unit of penalties."""
    count = len(scorer) // max(1, copies)
    some = torch.linspace(0, count - 1, min(count, MEASURED)).round().long() * copies
    scores = [block[block.isfinite()] for _, block in scorer.blocks(some if copies else some[:1])]
    known = sum(map(len, scores))
    return sum(float(block.sum()) for block in scores) / known if known else 1.0


def best_pairs(scorer: Scorer, copies: int, queries: int) -> tuple[Tensor, Tensor]:
    """The two best places of each copy of the first queries, more than `TOLERANCE` apart, and their scores:
    two of (queries, 2 x copies)."""
    wanted = [(min(2, scorer.layout.places), TOLERANCE)]
    size = max(1, min(scorer.most, scorer.at_once // max(1, scorer.held(wanted))))
    index, score = [], []
    for part in torch.arange(copies * queries).split(size):
        scores, places = scorer.best(part, wanted)
        pair = best_candidates(scores, *wanted[0], places, scorer.layout)
        index.append(pair.index.cpu())
        score.append(pair.score.cpu())
    return torch.cat(index).view(queries, -1), torch.cat(score).view(queries, -1)


def penalties_of(index: Tensor, score: Tensor, scorer: Scorer, unit: float) -> Tensor:
    """The penalty of each view, (V,), by the `best_pairs` of queries: the fewer of the surest answers a view
    gives, the more it costs, and +inf if these are hardly more than by chance."""
    each = min(2, scorer.layout.places)
    copies = score.shape[1] // each
    penalties = torch.full((copies,), START * unit).index_fill(0, torch.tensor(0), 0.0)
    share = torch.ones(copies)
    for _ in range(ROUNDS):
        total = score + penalties.to(score).repeat_interleave(each)
        pair = best_candidates(total, each, TOLERANCE, index, scorer.layout)
        sure = confidence(pair).topk(max(1, int(SURE * len(total)))).indices
        answers = (total[sure].argmin(1) // each).bincount(minlength=copies) + OTHER
        answers[0] += AS_IT_IS - OTHER
        share = answers / answers.sum()
        penalties = NATS * unit * (share.max() / share).log()
    penalties = torch.where(share < CHANCE, math.inf, penalties).float()
    alone = torch.full((copies,), math.inf).index_fill(0, torch.tensor(0), 0.0)
    steadier = _steady(index, score, penalties, scorer) > _steady(index, score, alone, scorer)
    return penalties if steadier else alone


def _steady(index: Tensor, score: Tensor, penalties: Tensor, scorer: Scorer) -> int:
    """How many answers of views with these penalties are near those of the query before, see `best_pairs`."""
    each = score.shape[1] // len(penalties)
    best = (score + penalties.to(score).repeat_interleave(each)).argmin(1, keepdim=True)
    place = index.gather(1, best)[:, 0].clamp(min=0)
    return int((scorer.layout.distance(place[1:], place[:-1]) <= STEADY).sum())


def shift_of(scores: Tensor, shifts: tuple[float, ...]) -> Tensor:
    """How far a camera points to the right, by the scores of its views at a place, interpolated by a
    parabola; NaN where these are flat: (B,V) -> (B,)."""
    at, order = torch.tensor(shifts).sort()
    scores = scores[:, order].float()
    best = scores.argmin(1).clamp(1, max(1, len(shifts) - 2))
    low, middle, high = (scores.gather(1, (best + i)[:, None])[:, 0] for i in (-1, 0, 1))
    bend = low - 2 * middle + high
    step = torch.where(bend > 0, (low - high) / (2 * bend.clamp(min=1e-12)), 0.0).clamp(-1, 1)
    known = at[best] + step * torch.where(step > 0, at[best + 1] - at[best], at[best] - at[best - 1])
    return torch.where(scores.amax(1) - scores.amin(1) < FLAT, torch.nan, known)
