"""What the answers show by themselves, with or without a ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.recognition.select import PROBABLE
from dejavu_torch.types import Facts, Match

LEVELS = (0.9, PROBABLE)  # probabilities of being right at which answers are counted
CONFIDENT = 3  # without probabilities, one answer in three is confident, by its score
MIN_ANSWERS = 10  # that a line needs,
MIN_SHARE = 0.2  # and as a share of all queries: consecutive queries may share a confident mistake
MIN_WIDTH = 5  # frames to each side of a line
OVER_CHANCE = 2  # times as many answers near a line as with places and queries paired at random


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
    """The line of `answer_facts` in words; "" without one."""
    if "line" not in facts:
        return ""
    line = Line(**facts["line"])
    if line.backwards:
        return str(line)
    hint = f"if the visits started {abs(line.offset)} frames apart, give --truth {line.offset}"
    text = f"{line}; {hint if line.offset else 'if frame i shows place i, give --truth 0'}"
    return f"the answers contradict the truth ({facts['truth']}): {text}" if scored else text
