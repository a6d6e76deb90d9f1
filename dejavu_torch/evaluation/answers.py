"""What the answers show by themselves, with or without a ground truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.coordinates import Near
from dejavu_torch.recognition.select import PROBABLE
from dejavu_torch.text import rounded
from dejavu_torch.types import Facts, Match

LEVELS = (0.9, PROBABLE)  # probabilities of being right at which answers are counted
CONFIDENT = 3  # without probabilities, one answer in three is confident, by its score
MIN_ANSWERS = 10  # that a line needs,
MIN_SHARE = 0.2  # and as a share of all queries: consecutive queries may share a confident mistake
MIN_WIDTH = 5  # frames to each side of a line
OVER_CHANCE = 2  # times as many answers near a line as with places and queries paired at random
SHIFTED = 1000  # answers of which a shift is told


class Line(NamedTuple):
    """The line place = query + offset, in frames, near which `answers` of the `confident` answers lie; or
    place = offset - query, if they run `backwards`."""

    offset: int
    answers: int
    confident: int
    backwards: bool = False

    def __str__(self) -> str:
        if self.backwards:
            lie = f"{self.answers} of {self.confident} confident answers lie at place = {self.offset} - query"
            return f"the queries run backwards along the route: {lie}"
        sign = "-" if self.offset < 0 else "+"
        line = f"place = query {sign} {abs(self.offset)}" if self.offset else "place = query"
        return f"most confident answers ({self.answers} of {self.confident}) lie at {line}"


class Shift(NamedTuple):
    """How far, in metres or pixels, `answers` of the `confident` answers lie from the coordinates of their
    queries, all in one direction."""

    x: float
    y: float
    unit: str
    answers: int
    confident: int

    def __str__(self) -> str:
        x, y = (f"{'-' if by < 0 else '+'} {rounded(abs(by))} {self.unit}" for by in self[:2])
        return f"most confident answers ({self.answers} of {self.confident}) lie at x {x}, y {y}"


def probable_counts(match: Match) -> dict[str, int]:
    """Number of answers whose probability of being right is at least each level; empty without any."""
    if match.probability is None:
        return {}
    return {f"{level:g}": int((match.probability >= level).sum()) for level in LEVELS}


def describe_probable(counts: Mapping[str, int], answers: int) -> str:
    """The counts of `probable_counts` in words.

    Example:
        >>> describe_probable({"0.9": 106, "0.5": 209}, 392)
        '106 of 392 answers have a probability of at least 0.9, 209 of at least 0.5'
    """
    (high, many), (low, more) = counts.items()
    return f"{many} of {answers} answers have a probability of at least {high}, {more} of at least {low}"


def next_steps(together: bool, strict: bool) -> list[str]:
    """What to try next on answers that have a probability, in words."""
    steps = {
        "--ordered matches the queries as a whole drive, if they are consecutive": not together,
        "--precision .9 accepts only answers with at least that probability": not strict,
    }
    return [step for step, applies in steps.items() if applies]


def confident(match: Match) -> Tensor:
    """The most confident answers, (Q,) bool: by their probability, else the third with the best scores."""
    if match.probability is not None:
        return match.probability >= PROBABLE
    reported = match.score.isfinite()
    if not reported.any():
        return reported
    count = -(-int(reported.sum()) // CONFIDENT)
    return reported & (match.score <= match.score[reported].sort().values[count - 1])


def line_of(places: Tensor, queries: Tensor, within: int, min_answers: float = MIN_ANSWERS) -> Line | None:
    """The line of slope one near which more than half of the answers lie; None if there is none.

    Convention: the offset is the median of the differences in their densest interval of width 2 * `within`.
        A line needs twice as many answers as lie near it if places and queries are paired at random: with
        few frames, or a single reported place, every line has some.

    Example:
        >>> line_of(torch.arange(40) + 7, torch.arange(40), within=5)
        Line(offset=7, answers=40, confident=40, backwards=False)
    """
    n = len(places)
    if n < min_answers:
        return None
    difference = (places - queries).sort().values
    starts = torch.searchsorted(difference, difference - within)
    stops = torch.searchsorted(difference, difference + within, right=True)
    densest = int((stops - starts).argmax())
    offset = int(difference[starts[densest] : stops[densest]].median())
    near = int(((difference - offset).abs() <= within).sum())
    ordered, middle = queries.sort().values, places - offset
    pairs = torch.searchsorted(ordered, middle + within, right=True)
    pairs = pairs - torch.searchsorted(ordered, middle - within)
    by_chance = float(pairs.sum()) / n
    significant = near >= max(min_answers, OVER_CHANCE * by_chance) and near > n / 2
    return Line(offset, near, n) if significant else None


def shift_of(found: Tensor, asked: Tensor, within: float, unit: str) -> Shift | None:
    """The shift near which more than half of the answers lie; None if there is none, or none above `within`.

    Shape: coordinates of answers and of their queries, (n,2) float64 each; at most `SHIFTED` are used.

    Convention: as `line_of`; within the distance is near.

    Example:
        >>> asked = torch.rand(40, 2).double() * 100
        >>> shift_of(asked + torch.tensor([30.0, 0.0]), asked, 2.0, "m")
        Shift(x=30.0, y=0.0, unit='m', answers=40, confident=40)
    """
    if len(found) < MIN_ANSWERS:
        return None
    some = torch.linspace(0, len(found) - 1, min(SHIFTED, len(found))).round().long()
    found, asked = found[some].double(), asked[some].double()
    shifts = found - asked
    densest = shifts[int((torch.cdist(shifts, shifts) <= within).sum(1).argmax())]
    near = (shifts - densest).norm(dim=1) <= within
    x, y = shifts[near].median(0).values.tolist()
    by_chance = float((torch.cdist(found - densest, asked) <= within).sum()) / len(found)
    answers = int(near.sum())
    plain = answers > max(len(found) / 2, OVER_CHANCE * by_chance) and math.hypot(x, y) > within
    return Shift(round(x, 3), round(y, 3), unit, answers, len(found)) if plain else None


def shift_facts(near: Near, match: Match, found: Tensor, asked: Tensor) -> Facts:
    """The entry `shift` of report.json, of answers found at coordinates (Q,K) where queries were taken at
    (Q,K), if most of the confident ones lie in one direction from them."""
    found, asked = found[:, :2], asked[:, :2]
    sure = confident(match) & (match.index >= 0) & (found - asked).isfinite().all(1)
    enough = int(sure.sum()) >= MIN_SHARE * len(found)
    shift = shift_of(found[sure], asked[sure], near.radius, near.unit) if enough else None
    return {} if shift is None else {"shift": shift._asdict()}


def answer_facts(
    match: Match, queries: Tensor, tolerance: int, scored: bool, offset: int | None = None
) -> Facts:
    """The entries of report.json about the answers by themselves."""
    counts = probable_counts(match)
    facts: Facts = {"probably_right": counts} if counts else {}
    if scored and offset is None:
        return facts
    within, sure = max(tolerance, MIN_WIDTH), confident(match) & (match.index >= 0)
    least = max(MIN_ANSWERS, MIN_SHARE * len(queries))
    places, frames = match.index[sure], queries[sure]
    line = line_of(places, frames, within, least)
    if line is None and not scored and (mirrored := line_of(places, -frames, within, least)) is not None:
        line = mirrored._replace(backwards=True)
    if line is not None and not (scored and abs(line.offset - (offset or 0)) <= within):
        facts["line"] = {name: value for name, value in line._asdict().items() if value is not False}
    return facts


def describe_line(facts: Mapping[str, Any], scored: bool) -> str:
    """The line of `answer_facts`, or the shift of `metric_facts`, in words; "" without one."""
    if "shift" in facts:
        shift = f"{Shift(**facts['shift'])} of the coordinates of their queries"
        hint = "are these the middles of the images, in the same coordinates?"
        return f"the answers contradict the truth ({facts['truth']}): {shift}; {hint}"
    if "line" not in facts:
        return ""
    line = Line(**facts["line"])
    if line.backwards:
        return str(line)
    hint = f"if the visits started {abs(line.offset)} frames apart, give --truth {line.offset}"
    text = f"{line}; {hint if line.offset else 'if frame i shows place i, give --truth 0'}"
    return f"the answers contradict the truth ({facts['truth']}): {text}" if scored else text
