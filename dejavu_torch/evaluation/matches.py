"""Matches as a csv: query,place,score,accepted, what else is known (see `write_matches`), two names."""

from __future__ import annotations

import csv
import itertools
import logging
import math
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, TextIO

import torch
from torch import Tensor

from dejavu_torch.data.files import as_number
from dejavu_torch.data.output import whole_file
from dejavu_torch.data.tables import read_table, whole
from dejavu_torch.places.frame_table import FrameTable
from dejavu_torch.places.layout import ROUTE
from dejavu_torch.text import printable
from dejavu_torch.types import InputError, Match, expect

log = logging.getLogger("dejavu_torch")

KNOWN = "probability", "confidence", "heading", "shift", "shift_degrees", "stale", "speed"  # if they are
DIGITS = {"shift": 3, "shift_degrees": 3, "speed": 3}
NUMBERS, NAMES = ("query", "place", "score", "accepted"), ("query_name", "place_name")
EXPECTED = "columns query,place,score and optionally accepted, probability, confidence, rank, route"
ELSEWHERE = -2  # the place of an answer on another route
_ACCEPTED = {"1": True, "true": True, "0": False, "false": False}


class Matches(NamedTuple):
    """Matches read from a file, in its order.

    Attributes:
        query: (Q,) int64, the frame number of each query.
        match: Match of (Q,), whose index is also a frame number.
        candidates: (Q,K) int64, the frames of the K ranks of each query, -1 for none; K is 1 without ranks.
            Both have `ELSEWHERE` for places on another route than the given one.
    """

    query: Tensor
    match: Match
    candidates: Tensor


def write_matches(
    path: Path,
    matches: Iterable[Match],
    query_frames: Tensor | None = None,
    table: FrameTable | None = None,
    query_names: Sequence[str] = (),
    place_names: Sequence[str] = (),
    ranks: int | None = None,
    pairs: Path | None = None,
) -> tuple[int, int]:
    """Write batches of matches as a csv; return the numbers of (queries, queries with an accepted match).

    Args:
        matches: one per query, in order; with `ranks`, that many per query, the best first.
        query_frames: (Q,) int64, the source frame of each query; None: query i is frame i.
        table: of the map: the reference frame of each place; of a merged map with the name of its route, and
            of an area with x and y of the middles of windows. None: place i is frame i.
        query_names, place_names: of the frames; () leaves the column empty. Unprintable characters, such as
            line breaks, are escaped.
        ranks: matches per query; None is one, without a column for the rank.
        pairs: another file, with a line `query_name place_name` for each reported place: the image pairs
            that hloc and COLMAP read.

    Convention 11: query and place count frames of the sources; -1 if no place is reported.
    """
    total = accepted = 0
    each = 1 if ranks is None else ranks
    table = FrameTable(ROUTE, torch.zeros(0)) if table is None else table
    layout, names = table.layout, table.layout.routes
    matches = iter(matches)
    start = next(matches, None)
    present = {} if start is None else start.columns
    known = [name for name in KNOWN if name in present]
    with ExitStack() as stack:

        def opened(path: Path) -> TextIO:
            temporary = stack.enter_context(whole_file(path))
            return stack.enter_context(temporary.open("w", newline="", encoding="utf-8"))

        file, paired = opened(path), None if pairs is None else opened(pairs)
        others = ["rank"] * (ranks is not None) + ["route"] * bool(names) + [*layout.axes]
        columns = [*NUMBERS, *known, *others, *NAMES]
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        for match in () if start is None else itertools.chain([start], matches):
            digits = 17 if match.score.dtype == torch.float64 else 9  # exact when read again
            first, total = total, total + len(match.index) // each
            queries = torch.arange(first, total) if query_frames is None else query_frames[first:total]
            places, own = table.frame_of(match.index), table.own_frame_of(match.index)
            rank = torch.arange(each).repeat(len(queries)) + 1
            told = (match.columns.get(name, match.score) for name in known)
            route, at = layout.route_of(match.index), layout.coordinates(match.index)
            whole = queries.repeat_interleave(each), places, own, match.accepted, rank, route
            parts = match.score, *told, *at.unbind(1)
            rows = (zip(*(one.tolist() for one in columns), strict=True) for columns in (whole, parts))
            for (query, place, number, good, order, on), own in zip(*rows, strict=True):
                score, *numbers, x, y = own
                row = {
                    "query": query,
                    "place": number,
                    "score": f"{score:.{digits}g}",
                    "accepted": int(good),
                    **{name: _told(name, one) for name, one in zip(known, numbers, strict=True)},
                    "rank": order,
                    "route": printable(layout.names("")[on]) if on >= 0 else "",
                    "x": _number(x, 9),
                    "y": _number(y, 9),
                    "query_name": _name(query_names, query),
                    "place_name": _name(place_names, place),
                }
                writer.writerow(row)
                if paired and place >= 0:
                    paired.write(f"{row['query_name']} {row['place_name']}\n")
                accepted += good and order == 1
    return total, accepted


def _told(name: str, value: float) -> str:
    """With its digits; of a probability as many as tell how far it is from 1."""
    sure = name == "probability" and value > 0.5
    return _number(value, 6 - round(math.log10(max(1 - value, 1e-9))) if sure else DIGITS.get(name, 6))


def _number(value: float, digits: int = 6) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}g}"


def check_pair_names(names: Sequence[str], whose: str) -> None:
    """Refuse frame names that a file of pairs, separated by spaces, cannot hold; `whose` names the source."""
    for name in names or [""]:
        if name.split() != [name]:
            seen = f"the name {name!r}" if name else "a frame without a name"
            raise InputError(f"{whose} has {seen}; expected names without spaces for --pairs")


def _name(names: Sequence[str], frame: int) -> str:
    return printable(names[frame]) if names and frame >= 0 else ""


def read_matches(
    path: Path, route: str | None = None, repeats: bool = False, higher_is_better: bool = False
) -> Matches:
    """Read the matches in a csv, from any method.

    Args:
        path: a csv whose header has these columns, also by other usual names; others are ignored.
            query: number of the query frame, in any order, each once; in consecutive lines with ranks, or
            with `repeats`. place: number of the reported reference frame, -1 for none. score: lower is
            better, inf for none.
            accepted: 1 or 0; without this column every match with a finite score is. probability: of being
            right. confidence: higher is surer; used if all have one. rank: the lines of a query are its
            candidates, ranks 1 to K in this order, with the same K for all queries; the first is its match,
            and only its probability and confidence are used.
            route: the route of the place.
        route: the route whose places can be right; needed if the file has that column.
        repeats: whether a query may be there several times, as resampled footage shows a frame.
        higher_is_better: the scores are similarities, whose signs change.

    Convention: a row with place -1 or score inf reports nothing: place -1, score inf, not accepted,
        probability 0.

    Raises:
        InputError: an unreadable file, with the number of the line, or a route without such a column, or the
            reverse.
    """
    answers: list[_Answer] = []  # of rank 1
    ranked: list[list[int]] = []
    seen: set[int] = set()
    named: dict[str, None] = {}
    table = read_table(path, EXPECTED)
    for name in ("query", "place", "score") if table.header or table.rows else ():
        expect(name in table, EXPECTED, f"{path}, line {table.line}: no column {name}")
    for where, cells in table.cells("a dot in decimal numbers, or semicolons between"):
        answer = _answer(where, cells)
        query, rank, last = answer.query, answer.rank, answers[-1].query if answers else None
        if rank > 1 and not (query == last and rank == len(ranked[-1]) + 1):
            follows = f" or rank {len(ranked[-1]) + 1} of query {last}" if ranked else ""
            raise InputError(f"{where}: rank {rank} of query {query}; expected rank 1{follows}")
        if rank == 1 and query in seen and not (query == last and (repeats or "rank" in cells)):
            expected = "each once, a column rank 1, 2, .. for several answers"
            expected += ", or --map MAP of a map at even steps" * (query == last)
            raise InputError(f"{where}: query {query} is there twice; expected {expected}")
        if route is not None and "route" not in cells:
            raise InputError(f"{where}: no column route for --route {route}; expected no --route")
        if "route" in cells and answer.place >= 0:
            named[cells["route"]] = None
            answer = answer if cells["route"] == route else answer._replace(place=ELSEWHERE)
        if rank == 1:
            answers.append(answer)
            seen.add(query)
            ranked.append([])
        ranked[-1].append(answer.place)
    if not answers:
        raise InputError(f"{path} holds no matches; expected a line for each query")
    if route is None and "route" in cells:
        known = f", with answers on {', '.join(named)}" if named else ""
        raise InputError(f"{path} has a column route{known}; expected --route with the one of the truth")
    if route is not None and route not in named:
        known = f"; it has answers on {', '.join(named)}" if named else ""
        log.warning("%s: no answer is on route %s%s", path, route, known)
    for one, places in zip(answers, ranked, strict=True):
        if len(places) != len(ranked[0]):
            found = f"query {one.query} has {len(places)} ranks"
            raise InputError(f"{path}: {found}; expected {len(ranked[0])}, as query {answers[0].query} has")
    queries, _, index, scores, accepted, probability, sure = zip(*answers, strict=True)
    score = torch.tensor(scores, dtype=torch.float64)
    score = torch.where(score.isfinite(), -score, math.inf) if higher_is_better else score
    match = Match(torch.tensor(index), score, torch.tensor(accepted))
    if None not in sure:
        match = replace(match, confidence=torch.tensor(sure, dtype=torch.float64))
    if "probability" in cells:
        match = replace(match, probability=torch.tensor(probability, dtype=torch.float64))
    return Matches(torch.tensor(queries), match, torch.tensor(ranked))


class _Answer(NamedTuple):
    """A row; by default one that reports nothing. Only rank 1 has a probability and a confidence."""

    query: int
    rank: int
    place: int = -1
    score: float = math.inf
    accepted: bool = False
    probability: float = 0.0
    confidence: float | None = -math.inf


def _answer(where: str, cells: dict[str, str]) -> _Answer:
    query = whole(cells["query"], "query", 0, where)
    place = whole(cells["place"], "place", -1, where)
    rank = whole(cells.get("rank", "1"), "rank", 1, where)
    try:
        score = float(cells["score"])
    except ValueError:
        score = math.nan
    if math.isnan(score) or score == -math.inf:
        seen = f"score is {cells['score']!r}"
        raise InputError(f"{where}: {seen}; expected a number, or inf if nothing is reported")
    accepted = _ACCEPTED.get(cells.get("accepted", "1").lower())
    if accepted is None:
        raise InputError(f"{where}: accepted is {cells['accepted']!r}; expected 1 or 0")
    if place < 0 or math.isinf(score):
        return _Answer(query, rank)
    probability = as_number(cells.get("probability", "0")) if rank == 1 else 0.0
    if probability is None or not 0 <= probability <= 1:
        seen = f"probability is {cells['probability']!r}"
        raise InputError(f"{where}: {seen}; expected a number from 0 to 1")
    return _Answer(query, rank, place, score, accepted, probability, as_number(cells.get("confidence", "")))
