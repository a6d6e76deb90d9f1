"""Matches as a csv of query,place,score,accepted, and the frames of evenly spaced ones."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.files import whole_file
from dejavu_torch.data.truth import Shown
from dejavu_torch.data.truthformats import as_number, read_text
from dejavu_torch.types import InputError, Match

EXPECTED = "columns query,place,score and, if wanted, accepted"
FRAMES = ("query_frame", "place_frame")
_ACCEPTED = {"1": True, "true": True, "0": False, "false": False}


class Matches(NamedTuple):
    """Matches read from a file, in its order.

    query: (Q,) int64, the number of each query. match: Match of (Q,). query_frame, place_frame: (Q,) int64,
    the frames that evenly spaced queries and their reported places show, -1 for no place; None where the
    file has no such column.
    """

    query: Tensor
    match: Match
    query_frame: Tensor | None
    place_frame: Tensor | None


def write_matches(path: Path, matches: Iterable[Match], shown: Shown | None = None) -> tuple[int, int]:
    """Write query,place,score,accepted for matches that come in parts; (queries, accepted) written.

    Args:
        shown: the frames that evenly spaced queries and places show: adds query_frame,place_frame, which is
            -1 where no place is reported.
    """
    total = accepted = 0
    places = None if shown is None or shown.place is None else shown.place.tolist()
    queries = None if shown is None or shown.query is None else shown.query.tolist()
    with whole_file(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["query", "place", "score", "accepted", *(FRAMES if places else ())])
        for match in matches:
            digits = 17 if match.score.dtype == torch.float64 else 9  # so that reading gives the same number
            rows = zip(match.index.tolist(), match.score.tolist(), match.accepted.tolist(), strict=True)
            for place, score, good in rows:
                also = [queries[total] if queries else total] if places else []
                also += [places[place] if place >= 0 else -1] if places else []
                writer.writerow([total, place, f"{score:.{digits}g}", int(good), *also])
                total += 1
                accepted += good
    return total, accepted


def read_matches(path: Path) -> Matches:
    """The matches of a csv, which may come from any method.

    Args:
        path: a csv with a header. query: number of the query frame, each once, in any order. place: the
            reported place, -1 for none. score: lower is better, inf for none. accepted: 1 or 0; where the
            column is missing, every match with a finite score is accepted. query_frame, place_frame: the
            frames that an evenly spaced query and place show, -1 for no place. Other columns are ignored.

    Convention: a row whose place is -1 or whose score is inf reports nothing: place -1, score inf, not
        accepted.

    Raises:
        InputError: what cannot be read, with the number of the line.
    """
    rows: dict[int, tuple[int, float, bool]] = {}
    frames: dict[str, list[int]] = {name: [] for name in FRAMES}
    for where, cells in _rows(path):
        query, place = (
            _whole(cells[name], name, least, where) for name, least in (("query", 0), ("place", -1))
        )
        if query in rows:
            raise InputError(f"{where}: query {query} is there twice; expected each once")
        score = _score(cells["score"], where)
        accepted = _ACCEPTED.get(cells.get("accepted", "1").lower())
        if accepted is None:
            raise InputError(f"{where}: accepted is {cells['accepted']!r}; expected 1 or 0")
        for name, least in zip(FRAMES, (0, -1), strict=True):
            if name in cells:
                frames[name].append(_whole(cells[name], name, least, where))
        nothing = place < 0 or math.isinf(score)
        rows[query] = (-1, math.inf, False) if nothing else (place, score, accepted)
    if not rows:
        raise InputError(f"{path} holds no matches; expected a line for each query")
    index, scores, accepted_ = zip(*rows.values(), strict=True)
    match = Match(torch.tensor(index), torch.tensor(scores, dtype=torch.float64), torch.tensor(accepted_))
    of_query, of_place = (torch.tensor(frames[name]) if frames[name] else None for name in FRAMES)
    return Matches(torch.tensor(list(rows)), match, of_query, of_place)


def _rows(path: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Where each row stands, and its cells by name."""
    reader = csv.reader(read_text(path, EXPECTED).splitlines(), skipinitialspace=True)
    names: list[str] = []
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            where = f"{path}, line {reader.line_num}"
            if not any(cells):
                continue
            if not names:
                names = [name.lower() for name in cells]
                missing = [name for name in ("query", "place", "score") if name not in names]
                if missing:
                    raise InputError(f"{where}: no column {missing[0]}; expected {EXPECTED}")
            elif len(cells) < len(names):
                raise InputError(f"{where}: {len(cells)} cells; expected {len(names)} as in the header")
            else:
                yield where, dict(zip(names, cells, strict=False))
    except csv.Error as error:
        raise InputError(f"{path}, line {reader.line_num}: {error}; expected {EXPECTED}") from error


def _whole(text: str, name: str, least: int, where: str) -> int:
    value = as_number(text)
    if value is None or value % 1 or value < least:
        raise InputError(f"{where}: {name} is {text!r}; expected a whole number of at least {least}")
    return int(value)


def _score(text: str, where: str) -> float:
    try:
        score = float(text)
    except ValueError:
        score = math.nan
    if math.isnan(score) or score == -math.inf:
        raise InputError(f"{where}: score is {text!r}; expected a number, or inf where nothing is reported")
    return score
