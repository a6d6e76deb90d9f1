"""What would make sure answers agree with a ground truth that rejects them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.coordinates import Near
from dejavu_torch.evaluation.answers import MIN_WIDTH, OVER_CHANCE, confident
from dejavu_torch.text import rounded
from dejavu_torch.types import Doubt, Match

SURE = 0.9  # probability of answers that are believed, where they have one
LEAST = 20  # of them, at different queries and places
REJECTED, EXPLAINED = 0.2, 0.9  # shares: of them that the truth rejects; that a relation makes right
SPREADS = 3.0  # of what is left, by which its mean is beyond chance
AS_WELL = 0.02  # share of the answers by which a simpler relation may explain fewer
PAIRS, SOME = 2000, 500  # of answers that propose a relation; answers that judge it
OVERLAP = 0.4  # share of the answers that a relation has to explain, where others lack coordinates
MISSING = 0.8, 1.25  # slopes between which frames may be missing
CHANGES = 5  # of a value that was rounded
FLOOR, FEW = 2.0, 1500  # metres that a floor is above another, at least; places that are looked at
BETTER = 3  # times as many answers as the truth that a relation makes right within the tolerance
RUN = 15  # consecutive answers whose median tells an offset that changes
GROWN = 0.5  # of the queries, by which an offset may grow
APART = 6.0  # of that way a part, within which offsets lie that change at once
STRAY = 1.2  # of the way from its first value to its last, that such an offset may take
TURN, STRETCH = 1.0, 0.01  # degrees, and share, below which coordinates are merely moved
SHOWN, ABOVE, FULL = 0.1, 5.0, 0.5  # share of single images that agree with a drive; of chance; of the rest


class Relation(NamedTuple):
    """place = slope x query + offset, within some frames of which `answers` of `confident` answers lie; or
    offsets that grow from the first to the `last`, at a slope of one, either way: all at once if at a `jump`,
    the first query with the last."""

    slope: float
    offset: float
    answers: int
    confident: int
    last: float | None = None
    jump: int | None = None

    def at(self, queries: Tensor) -> Tensor:
        """The places of queries, by a slope and an offset, or two."""
        first = self.slope * queries + self.offset
        if self.jump is not None and self.last is not None:
            first += (queries >= self.jump) * (self.last - self.offset)
        return first.round().long()

    def __str__(self) -> str:
        if self.last is not None:
            sign, there = "- " * (self.slope < 0), "" if self.jump is None else f" at query {self.jump}"
            goes = f"goes from {round(self.offset)} to {round(self.last)}{there}"
            return f"place = {sign}query + an offset that {goes}"
        factor = "" if abs(self.slope) == 1 else f"{abs(self.slope):.4g} "
        if self.slope < 0:
            return f"place = {round(self.offset)} - {factor}query"
        by = f" {'-' if self.offset < 0 else '+'} {abs(self.offset):.0f}" * (abs(self.offset) >= 0.5)
        return f"place = {factor}query{by}"


class Ground(NamedTuple):
    """Coordinates that a truth compares, in one frame, (...,2) or, with heights, (...,3) float64, NaN where
    unknown.

    found: (Q,K) of the answers. asked: (Q,K) of the queries. stored: (N,K) of all reference frames, own:
    (F,K) of all frames of the query's source; names: of both. second: mean seconds between the latter, None
    if unknown. apart: how far both lie apart, in words.
    """

    near: Near
    found: Tensor
    asked: Tensor
    stored: Tensor
    own: Tensor
    names: tuple[str, str]
    second: float | None = None
    apart: str = ""


def coarse(ground: Ground) -> list[Doubt]:
    """Coordinates that cannot tell what a radius asks for: with few digits, or of floors within it, of one
    visit, as two differ where their heights count from elsewhere."""
    radius, unit, doubts = ground.near.radius, ground.near.unit, list[Doubt]()
    for name, table in dict(zip(ground.names, (ground.stored, ground.own), strict=True)).items():
        known = table[table.isfinite().all(1), :2]
        for axis, title in enumerate("xy"):
            if (size := _rounded_to(known, axis)) > radius / 2:
                seen = f"the {title} of {name} are multiples of {rounded(size)} {unit}"
                doubts.append(Doubt("digits", f"{seen}, too coarse for a distance of {radius:g} {unit}"))
    if floors := max(_floors(table, radius) for table in (ground.stored, ground.own)):
        seen = f"places lie {rounded(floors)} {unit} above others, all within {radius:g} {unit} of a query"
        expected = f"--truth {ground.near.kind}:{floors / 2:.2g}"
        doubts.append(Doubt("heights", f"{seen}: a smaller distance tells floors apart", expected))
    return doubts


def _rounded_to(path: Tensor, axis: int) -> float:
    """The number that all values of an axis are multiples of, if a path (n,2) was rounded to it; else 0. Of a
    path along streets or a grid each step goes on, and values change in several steps one after the other."""
    values, steps = path[:, axis].unique(), path.diff(dim=0)
    if len(values) < 3:
        return 0.0
    size = float(values.diff().min())
    even = [
        bool(((one / size) - (one / size).round()).abs().max() < 1e-3) for one in (values.diff(), *steps.T)
    ]
    moves = steps[:, axis] != 0
    alone = moves[1:-1] & ~moves[:-2] & ~moves[2:]
    goes_on = all(even) and bool((steps != 0).any(1).all())
    rounded_off = int(alone.sum()) >= max(CHANGES, EXPLAINED * int(moves[1:-1].sum()))
    return size if even[0] and rounded_off and not goes_on else 0.0


def _floors(places: Tensor, radius: float) -> float:
    """How far floors lie above each other, if some lie within a radius; else 0."""
    places = places[places.isfinite().all(1)]
    if places.shape[1] < 3 or len(places) < LEAST:
        return 0.0
    some = places[_some(len(places), FEW)]
    near = torch.cdist(some[:, :2], some[:, :2]) <= min(radius / 5, FLOOR)
    above = (some[:, None, 2] - some[None, :, 2]).abs()[near]
    higher = above[above >= FLOOR]
    if len(higher) < LEAST or (gap := float(higher.median())) > radius:
        return 0.0
    among = above[above >= FLOOR / 2]
    alike = ((among - gap).abs() <= 0.3 * gap).double().mean()  # else heights merely vary
    return gap if float(alike) >= EXPLAINED else 0.0


class Judged(NamedTuple):
    """Answers that a truth judges, in frames of the sources: (Q,) each, but for `alone`, places that single
    images report, which speak for a drive or against it; None if they are the answers. tolerance: frames."""

    match: Match
    queries: Tensor
    right: Tensor
    judged: Tensor
    tolerance: int
    truth: str
    places: int | None = None
    alone: Tensor | None = None

    @property
    def within(self) -> int:
        """Frames to each side of a relation."""
        return max(self.tolerance, MIN_WIDTH)

    def sure(self) -> Tensor:
        """Numbers of the answers that are believed; none unless they are many, of many places."""
        sure = self.match.probability
        chosen = confident(self.match) if sure is None else sure >= SURE
        numbers = (chosen & self.judged & (self.match.index >= 0)).nonzero()[:, 0]
        distinct = min(len(one[numbers].unique()) for one in (self.match.index, self.queries))
        return numbers if distinct >= LEAST and self._shown(numbers) else numbers[:0]

    def _shown(self, numbers: Tensor) -> bool:
        """Whether single images agree with a drive more often than by chance, as they do not elsewhere."""
        if self.alone is None or self.places is None:
            return True
        near = (self.alone[numbers] - self.match.index[numbers]).abs() <= self.within
        chance = min(1.0, (2 * self.within + 1) / max(1, self.places))
        least = min(max(SHOWN, ABOVE * chance), chance + FULL * (1 - chance))
        return bool(near.double().mean() >= least)


def contradictions(asked: Judged, ground: Ground | None = None) -> list[Doubt]:
    """Relations that make sure answers right which the truth rejects, or by which all of them differ from it.
    Several that explain as many are told together."""
    numbers = asked.sure()
    if not len(numbers):
        return []
    rejected = float((~asked.right[numbers]).double().mean()) > REJECTED
    if ground is not None:
        return _of_coordinates(asked, numbers, ground, rejected)
    places, queries = asked.match.index[numbers], asked.queries[numbers]
    relation = relation_of(places, queries, asked.within) if rejected else None
    if relation is None or relation.answers < EXPLAINED * len(numbers):
        return []
    near = int(((places - relation.at(queries)).abs() <= asked.tolerance).sum())
    # else a small tolerance rejects them
    least = min(BETTER * int(asked.right[numbers].sum()), EXPLAINED * len(numbers))
    better = relation.last is not None or near >= least
    return [_of_frames(relation, asked)] if better else []


class Motion(NamedTuple):
    """found = turn x asked + move, a similarity of the plane in complex numbers, of the mirrored asked, if
    `mirrored`; a line, if they are real. away: (n,), how far pairs are off it."""

    turn: complex
    move: complex
    away: Tensor
    mirrored: bool = False

    def __str__(self) -> str:
        angle, size = math.degrees(math.atan2(self.turn.imag, self.turn.real)), abs(self.turn)
        exchanged = self.mirrored and abs(angle - 90) < TURN
        parts = {
            "with x and y exchanged": exchanged,
            "mirrored (y negated)": self.mirrored and not exchanged,
            f"turned by {angle:.1f} degrees": abs(angle) >= TURN and not exchanged,
            f"scaled by {size:.4g}": abs(size - 1) >= STRETCH,
            _vector(self.move.real, self.move.imag): abs(self.move) >= 0.05,
        }
        return " and ".join(part for part, applies in parts.items() if applies)


def consensus(asked: Tensor, found: Tensor, within: float) -> Motion | None:
    """The motion within some distance of which most pairs (n,) lie, by least squares of these; None if they
    are no more than with pairs drawn at random."""
    some = _some(len(asked))
    one, other = torch.randint(len(asked), (2, PAIRS), generator=torch.Generator().manual_seed(0))
    run = asked[other] - asked[one]
    kept = run.abs() > run.abs().median() / 2
    if not kept.any():
        return None
    turns = (found[other] - found[one])[kept] / run[kept]
    moves = found[one][kept] - turns * asked[one][kept]
    away = (turns[:, None] * asked[some] + moves[:, None] - found[some]).abs()
    best = int((away <= within).sum(1).argmax())
    turn, move = turns[best], moves[best]
    for _ in range(3):
        near = (turn * asked + move - found).abs() <= within
        middle, height = asked[near].mean(), found[near].mean()
        run = asked[near] - middle
        turn = (run.conj() * (found[near] - height)).sum() / run.abs().square().sum()
        move = height - turn * middle
    made = turn * asked + move
    plain = _is_plain(torch.view_as_real(made), torch.view_as_real(found), within)
    return Motion(turn.item(), move.item(), (made - found).abs()) if plain else None


def _is_plain(made: Tensor, found: Tensor, within: float) -> bool:
    """Whether more points (n,K) lie near those found than of pairs drawn at random."""
    some, near = _some(len(made)), (made - found).norm(dim=1) <= within
    by_chance = (torch.cdist(made[some], found[some]) <= within).double().mean()
    return float(near.double().mean()) > OVER_CHANCE * float(by_chance)


def _some(count: int, most: int = SOME) -> Tensor:
    return torch.linspace(0, count - 1, min(most, count)).round().long()


def relation_of(places: Tensor, queries: Tensor, within: int) -> Relation | None:
    """The relation near which most answers lie; None if they are no more than with pairs drawn at random.

    Example:
        >>> queries = torch.arange(60)
        >>> str(relation_of(6 * queries + 3, queries, within=5))
        'place = 6 query + 3'
    """
    x, y = queries.double(), places.double()
    fit, relation, answers = consensus(x + 0j, y + 0j, within), None, 0
    if fit is not None:
        near = fit.away <= within
        slope, offset, answers = fit.turn.real, fit.move.real, int(near.sum())
        simple = float(round(slope)) if abs(slope) >= 1 else 1 / round(1 / (slope or 1.0))
        level = float((y - simple * x)[near].median())
        if (as_many := int(((y - simple * x - level).abs() <= within).sum())) >= answers - AS_WELL * len(x):
            slope, offset, answers = simple, level, as_many
        relation = Relation(slope, offset, answers, len(x))
    growing = _growing(x, y, within)
    return growing if growing and growing.answers > answers + AS_WELL * len(x) else relation


def _growing(x: Tensor, y: Tensor, within: int) -> Relation | None:
    """An offset that only grows, or only falls, from the first query on, as where frames are missing."""
    order = x.argsort(stable=True)
    x, y = x[order], y[order]
    for slope in (1.0, -1.0):
        offset = y - slope * x
        runs = offset.unfold(0, RUN, 1).median(1).values
        middle = runs[(torch.arange(len(x)) - RUN // 2).clamp(0, len(runs) - 1)]
        near = int(((offset - middle).abs() <= within).sum())
        first, last = float(runs[0]), float(runs[-1])
        way, steps = abs(last - first), float(runs[:: RUN // 2].diff().abs().sum())
        if float((x + slope * middle).diff().min()) < -within:  # back to places that were passed
            continue
        one_way = float(steps) <= STRAY * way + within and within < way <= GROWN * float(x[-1] - x[0])
        if near >= EXPLAINED * len(x) and one_way:
            limit = min(within, way / APART)
            before, after = (((offset - one).abs() <= limit).long() for one in (first, last))
            fits = before.cumsum(0)[:-1] + after.flip(0).cumsum(0).flip(0)[1:]
            at = int(fits.argmax())
            jump = int(x[at + 1]) if int(fits[at]) >= EXPLAINED * len(x) else None
            return Relation(slope, first, near, len(x), last, jump)
    return None


def _of_frames(relation: Relation, asked: Judged) -> Doubt:
    """A relation between numbers of frames in words, with what would make the truth agree."""
    many = f"{relation.answers} of {relation.confident} confident answers"
    text = f"the answers contradict the truth ({asked.truth}): {many} follow {relation}"
    jump, last = relation.jump, relation.last
    if last is not None and jump is None:
        what = "frames are missing, or their rates differ; pair frames by name or time in a --truth FILE.csv"
        return Doubt("offset", f"{text}: {what}")
    if relation.slope == 1.0 and jump is None:
        return Doubt("offset", text, f"--truth {round(relation.offset)}")
    at = relation.at(asked.queries)
    there = asked.queries[(at >= 0) & (at < (asked.places or at.max() + 1))]
    parts = [there] if jump is None else [there[there < jump], there[there >= jump]]
    knots = [int(one) for part in parts if len(part) for one in part.aminmax()]
    *some, end = (f"{query},{int(relation.at(torch.tensor(query)))}" for query in knots)
    in_file = f"--interpolate and --truth FILE.csv with the lines {', '.join(some)} and {end}"
    if last is not None:
        grown = round(relation.slope * (last - relation.offset))
        whose = "queries" if grown > 0 else "reference"
        return Doubt("offset", f"{text}: {abs(grown)} frames of the {whose} are missing there", in_file)
    if relation.slope < 0:
        return Doubt("backwards", f"{text}: the queries run backwards", in_file)
    if MISSING[0] < relation.slope < MISSING[1]:
        grown, by = (round(relation.offset + (relation.slope - 1) * query) for query in knots)
        text += f", so the offset goes from {grown} to {by}: frames are missing, or rates differ"
    return Doubt("rate", text, in_file)


def motion_of(found: Tensor, asked: Tensor, radius: float, mirrored: bool = False) -> Motion | None:
    """The similarity that brings most points (n,2) of queries within a radius of those of their answers."""
    own, there = (torch.complex(*one.T) for one in (asked, found))
    motion = consensus(own.conj().resolve_conj() if mirrored else own, there, radius)
    return motion and motion._replace(mirrored=mirrored)


class Way(NamedTuple):
    """What would make answers agree with coordinates, its cause and in words; how many it makes right, and
    whether that explains what the truth rejects: nine in ten of those of which it tells something, of many,
    while the truth rejects the others."""

    cause: str
    words: str
    answers: int
    holds: bool

    @classmethod
    def of(cls, cause: str, words: str, away: Tensor, right: Tensor, limit: float) -> Way:
        """By how far answers (n,) are off by it, NaN where it tells nothing; `right` by the truth."""
        untold, answers = away.isnan(), int((away <= limit).sum())
        most = answers >= EXPLAINED * int((~untold).sum())
        wrong = int((right & untold).sum()) <= REJECTED * int(untold.sum())
        many = answers >= max(LEAST, OVERLAP * len(away))
        return cls(cause, words, answers, most and many and wrong)


def _of_coordinates(asked: Judged, numbers: Tensor, ground: Ground, rejected: bool) -> list[Doubt]:
    """What makes answers and coordinates agree, in words."""
    found, own = ground.found[numbers], ground.asked[numbers]
    known = (found.isfinite() & own.isfinite()).all(1)
    found, own, numbers, confident = found[known], own[known], numbers[known], len(numbers)
    if len(found) < LEAST:
        return []
    radius, unit, left, name = ground.near.radius, ground.near.unit, found - own, ground.names[1]
    middle = left.median(0).values
    moved, off = f"{_vector(*middle.tolist())} {unit}", (left - middle).norm(dim=1)
    if not rejected:
        away, spread = float(middle.norm()), float(off.median())
        if away <= max(SPREADS * spread, radius / 2, _step(ground.stored)):  # as between two places
            return []
        seen = f"the confident answers lie {rounded(away)} {unit} from the coordinates of their queries"
        seen = f"{seen}, in one direction, with a spread of {rounded(spread)} {unit}"
        return [Doubt("shift", f"{seen}: they agree if those of {name} are {moved}")]
    queries, right = asked.queries[numbers], asked.right[numbers]
    ways = [Way.of("shift", moved, off, right, radius)] * _is_plain(found - middle, own, radius)
    exchanged = (_at(ground.own, asked.match.index[numbers]) - _at(ground.stored, queries)).norm(dim=1)
    ways.append(Way.of("exchanged", "with the two files exchanged", exchanged, right, radius))
    flat, found, own = found.shape[1] == 2 or any(way.holds for way in ways), found[:, :2], own[:, :2]
    if not flat:
        ways.append(Way.of("heights", "without heights", (found - own).norm(dim=1), right, radius))
    ways += _rows(found, queries, right, ground)
    if not any(way.holds and way.answers >= EXPLAINED * len(found) for way in ways):
        own_frames = all(_at_origin(table) for table in (ground.stored, ground.own))
        both = ", as both begin at 0, 0" * own_frames
        motions = (motion_of(found, own, radius, mirrored) for mirrored in (False, True))
        ways += [Way.of("frame", f"{one}{both}", one.away, right, radius) for one in motions if one]
    ways = [way for way in ways if way.holds]
    if not ways:
        return []
    # a move or a late clock supposes less than a turn or another rate
    ways.sort(key=lambda way: (way.cause == "frame" or "run" in way.words, -way.answers))
    many = f"{ways[0].answers} of {confident} confident answers agree with the coordinates of {name}"
    words = ", or ".join(way.words for way in ways)
    return [Doubt(ways[0].cause, f"the answers contradict the truth ({asked.truth}): {many} {words}")]


def _rows(found: Tensor, queries: Tensor, right: Tensor, ground: Ground) -> Iterator[Way]:
    """How numbers of queries are related to the frames whose coordinates are those of the answers: by a
    difference of clocks, else another relation."""
    own = ground.own[:, :2]
    rows = own.isfinite().all(1).nonzero()[:, 0]
    nearest = [torch.cdist(part, own[rows]).min(1) for part in found.split(256)]
    away, at = (torch.cat(part) for part in zip(*nearest, strict=True))
    near, at, usual = away <= ground.near.radius, rows[at], _step(own[rows]) or 1.0
    if near.sum() < LEAST:
        return
    within, limit = max(1, math.ceil(ground.near.radius / usual)), max(ground.near.radius, usual)
    some, late = _some(len(found)), (at - queries)[near].unique()
    late = late[_some(len(late))]
    apart = (_at(own, queries[some] + late[:, None]) - found[some]).norm(dim=-1)
    best = int(apart.nan_to_num(limit).clamp(max=limit).sum(1).argmin())
    clock = Relation(1.0, float(late[best]), 0, 0)
    other = relation_of(at[near], queries[near], min(within, len(rows) // 10))
    for relation in filter(None, (clock, other)):
        off = (_at(own, relation.at(queries)) - found).norm(dim=1)
        if relation.last is not None:
            off = away.where(near, math.nan)  # the others lie where rows are missing
        way = Way.of("clock", _clock(relation, ground), off, right, limit)
        if way.holds:
            if relation[:2] != (1, 0) or relation.last is not None:
                yield way
            return


def _at(table: Tensor, frames: Tensor) -> Tensor:
    """The coordinates of frames, NaN beyond the ends."""
    there = (frames >= 0) & (frames < len(table))
    return table[frames.clamp(0, len(table) - 1)].where(there[..., None], math.nan)


def _clock(relation: Relation, ground: Ground) -> str:
    """A relation between queries and the frames whose coordinates they should have, in words."""
    missing = "rows are missing, or rates differ; pair by time or name"
    if relation.last is not None:
        sign, later = (1, "earlier") if relation.offset + relation.last > 0 else (-1, "later")
        ends = " to ".join(str(round(sign * one)) for one in (relation.offset, relation.last))
        return f"if its rows are {ends} frames {later}: {missing}"
    if relation.slope != 1:
        rate = f"{abs(relation.slope):.4g} times as fast" * (abs(relation.slope) != 1)
        how = " and ".join(filter(None, ["backwards" * (relation.slope < 0), rate]))
        return f"if its rows run {how}" + f": {missing}" * (MISSING[0] < relation.slope < MISSING[1])
    later = "earlier" if relation.offset > 0 else "later"
    if ground.second is None:
        return f"if its rows are {abs(relation.offset):.0f} frames {later}"
    return f"if its times are {abs(relation.offset) * ground.second:.1f} s {later}"


def _step(path: Tensor) -> float:
    """The usual step from one known place of a path (n,K) to the next; 0 if there is none."""
    steps = path[:, :2].diff(dim=0).norm(dim=1)
    return float(steps[steps > 0].median()) if (steps > 0).any() else 0.0


def _at_origin(table: Tensor) -> bool:
    known = table[table.isfinite().all(1), :2]
    return bool(len(known) and (known[0].abs() < 1e-9).all())


def _vector(*moved: float) -> str:
    """A move in two or three numbers; the third is left out if it is about 0."""
    numbers = [round(one, 1) + 0.0 for one in moved]  # never -0.0
    return f"moved by ({', '.join(map(str, numbers if any(numbers[2:]) else numbers[:2]))})"
