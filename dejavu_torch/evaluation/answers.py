"""What answers tell by themselves, also where nothing says which of them are right."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.recognition.select import PROBABLE
from dejavu_torch.types import Match

COUNTED = (0.9, PROBABLE)  # the answers that are at least so probably right
THIRD = 3  # without probabilities, one of so many is, by its score
FEWEST = 10  # answers that show a line,
SHARE = 0.2  # and of all queries: few that are sure by mistake are so one behind the other
NEAR = 5  # frames from a line, at least
TIMES = 2  # as many answers near a line as the same places and queries in any order


class Line(NamedTuple):
    """The line place = query + offset near which most confident answers lie, in frames of the sources.

    answers: how many of the `confident` ones lie near it.
    """

    offset: int
    answers: int
    confident: int

    def __str__(self) -> str:
        sign = "-" if self.offset < 0 else "+"
        line = f"place = query {sign} {abs(self.offset)}" if self.offset else "place = query"
        return f"most confident answers ({self.answers} of {self.confident}) lie at {line}"


def probable_counts(match: Match) -> dict[str, int]:
    """How many answers are at least so probably right, by that probability; empty without probabilities."""
    if match.probability is None:
        return {}
    return {f"{least:g}": int((match.probability >= least).sum()) for least in COUNTED}


def told_probable(counts: Mapping[str, int], answers: int) -> str:
    """The counts in words.

    Example:
        >>> told_probable({"0.9": 106, "0.5": 209}, 392)
        '106 of 392 answers are probably right (at least .9), 209 at .5'
    """
    (high, many), (low, more) = counts.items()
    return f"{many} of {answers} answers are probably right (at least {high[1:]}), {more} at {low[1:]}"


def next_steps(together: bool, strict: bool) -> list[str]:
    """What to try on answers that have a probability, in words."""
    steps = {
        "--filter also uses the preceding queries, if they are consecutive": not together,
        "--precision .9 accepts only answers that are at least that probable": not strict,
    }
    return [step for step, fits in steps.items() if fits]


def confident(match: Match) -> Tensor:
    """Which answers (Q,) are believed most: by their probability, else the third that scores best; bool."""
    if match.probability is not None:
        return match.probability >= PROBABLE
    found = match.score.isfinite()
    if not found.any():
        return found
    count = -(-int(found.sum()) // THIRD)
    return found & (match.score <= match.score[found].sort().values[count - 1])


def line_of(places: Tensor, queries: Tensor, within: int, fewest: float = FEWEST) -> Line | None:
    """The line of slope one that more than half of some answers lie near, None where there is none.

    Convention: the offset is the median of those in the densest stretch of twice `within`. A line has to have
        twice as many answers as the same places and queries have when paired at random: in few frames, and
        where all answers are one place, any line is near.

    Example:
        >>> line_of(torch.arange(40) + 7, torch.arange(40), within=5)
        Line(offset=7, answers=40, confident=40)
    """
    n = len(places)
    if n < fewest:
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
    shows = near >= fewest and near > n / 2 and near >= TIMES * by_chance
    return Line(offset, near, n) if shows else None


def own_facts(
    match: Match, queries: Tensor, tolerance: int, scored: bool, offset: int | None = None
) -> dict[str, Any]:
    """What report.json holds of answers by themselves."""
    counts = probable_counts(match)
    facts: dict[str, Any] = {"probably_right": counts} if counts else {}
    if scored and offset is None:
        return facts
    within, sure = max(tolerance, NEAR), confident(match) & (match.index >= 0)
    fewest = max(FEWEST, SHARE * len(queries))
    line = line_of(match.index[sure], queries[sure], within, fewest)
    if line is not None and not (scored and abs(line.offset - (offset or 0)) <= within):
        facts["line"] = line._asdict()
    return facts


def told_line(facts: Mapping[str, Any], scored: bool) -> str:
    """What `own_facts` found of a line, in words; "" for nothing."""
    if "line" not in facts:
        return ""
    line = Line(**facts["line"])
    text = f"{line}: is it --truth {line.offset}?"
    return f"the answers contradict the truth ({facts['truth']}): {text}" if scored else text
