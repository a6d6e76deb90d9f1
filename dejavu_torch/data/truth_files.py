"""Files of a ground truth: lines of query,place, lists in JSON, matrices in .npz."""

from __future__ import annotations

import json
import logging
import math
import re
import zipfile
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.data.files import LARGEST, as_number, read_text, reading
from dejavu_torch.data.tables import check_frames, read_table, whole
from dejavu_torch.memory import check_room
from dejavu_torch.types import InputError, Traverse, expect

log = logging.getLogger("dejavu_torch")

FEW, PART = 10, 5  # queries, and parts of a visit of which a file tells one, that look like seconds
Listed = dict[int, list[float]]  # the places of each query in a file


def places_of_queries(
    path: Path, listed: Listed, numbers: Tensor, length: int | None, interpolate: bool, resampled: bool
) -> tuple[list[Tensor], Tensor]:
    """The places (n,) int64 that a file lists for each query, and which queries it lists, (Q,) bool.

    Args:
        listed: the content of the file. numbers: (Q,) the frame of each query in its source.
        length: of the query's source, if it is known.
    """
    first, last = min(listed), max(listed)
    if length is not None:
        check_frames(listed, length, path, "query")
    queries = numbers.tolist()
    if interpolate:
        knots = sorted(listed)
        between = np.interp(numbers.numpy(), knots, [listed[query][0] for query in knots]).tolist()
        listed = {query: [at] for query, at in zip(queries, between, strict=True) if first <= query <= last}
    elif resampled:
        listed = _to_queries(listed, numbers)
    judged = torch.tensor([query in listed for query in queries])
    wanted = f"{int(numbers.min())} to {int(numbers.max())}"
    expect(judged.any(), f"some of {wanted}", f"{path} lists queries from {first} to {last}")
    rows = [[_rounded(place) for place in listed.get(query, ())] for query in queries]
    return [torch.tensor(row, dtype=torch.int64) for row in rows], judged


def _to_queries(listed: Listed, frames: Tensor) -> Listed:
    """Add the places of each listed frame to the nearest of the queries' `frames`, unless it is listed."""
    ordered = frames.sort().values
    moved = {frame: list(places) for frame, places in listed.items()}
    for frame in listed:
        after = int(torch.searchsorted(ordered, frame))
        near = ordered[max(0, after - 1) : after + 1].tolist()
        nearest = min(near, key=lambda other: abs(other - frame))
        if nearest not in listed:
            moved.setdefault(nearest, []).extend(listed[frame])
    return moved


def read_listed(
    path: Path, query: Traverse | None, reference: Traverse | None, frames: int | None, interpolate: bool
) -> Listed:
    """As `read_csv`, up to a `stop=` of the sources. Asks whether the file counts something longer than
    frames, if it goes from 0 on without a gap, but over a small part of both visits."""
    more = 0 if reference is None else reference.beyond
    listed = read_csv(path, None if frames is None else frames + more, interpolate)
    listed = until(listed, query, reference, path)
    last, counts = max(chain(*listed.values()), default=LARGEST), sorted(listed) == [*range(len(listed))]
    ends = 0 if query is None else len(query), frames or 0
    if counts and len(listed) >= FEW and PART * len(listed) < ends[0] and PART * last < ends[1]:
        line = "%s ends at query %d of %d and place %d of %d: does it count seconds, not frames?"
        log.warning(line, path, max(listed), ends[0], last, ends[1])
    return listed


def until(listed: Listed, query: Traverse | None, reference: Traverse | None, name: object) -> Listed:
    """Without queries and places that a `stop=` of their sources left out, which are counted in one line."""
    ends = [LARGEST if source is None or not source.beyond else len(source) for source in (query, reference)]
    kept = {
        query: [one for one in places if one < ends[1]] for query, places in listed.items() if query < ends[0]
    }
    left = sum(map(len, listed.values())) - sum(map(len, kept.values()))
    if kept and left:
        log.warning("%s: %d of its right places lie beyond a stop, of queries or of places", name, left)
    return kept or listed


def read_csv(path: Path, frames: int | None, interpolate: bool) -> Listed:
    """The places of lines of query,place[,place...]."""
    table = read_table(path, "lines of query,place")
    names, titles = [one.role for one in table.header], ",".join(one.title for one in table.header)
    # any other column, such as a distance, would be read as a right place
    fits = not names or (names[0] == "query" and all(re.match("place|$", name) for name in names[1:]))
    expect(fits, "query,place[,place...]", f"{path}, line {table.line}: columns {titles}")
    end, valid = (LARGEST, "0") if frames is None else (frames, f"0 to {frames - 1}")
    listed: Listed = {}
    for row, (_, cells) in enumerate(table.rows):
        where = table.where(row)
        while not cells[-1]:
            del cells[-1]
        bad = next((cell for cell in cells if as_number(cell) is None), None)
        expect(bad is None, "query,place", f"{where}: {bad!r} is not a frame number")
        query = whole(cells[0], "query", 0, where)
        expect(query not in listed, "each once", f"{where}: query {query} is listed twice")
        listed[query] = [place for place in map(float, cells[1:]) if place != -1]
        for place in listed[query]:
            seen, inside = f"{where}: place {place:.12g}", place >= 0 and _rounded(place) < end
            expect(inside, f"a reference frame from {valid}, or -1 for none", seen)
            expect(interpolate or place % 1 == 0, "a whole number, or interpolation", seen)
        places = len(listed[query])
        expect(not interpolate or places == 1, "one per line to interpolate", f"{where}: {places} places")
    expect(listed, "lines of query,place", f"{path} lists no query")
    return listed


def read_json(path: Path, frames: int | None, count: int | None, minimum: int) -> Listed:
    """The places of `count` queries, None if unknown, at least `minimum`."""
    expected = "a list of whole numbers, its right places, for each query"
    with reading(path, "is not JSON", expected):
        rows = json.loads(read_text(path, expected))
    if not isinstance(rows, list) or len(rows) < minimum or count not in (None, len(rows)):
        seen = f"a list of {len(rows)}" if isinstance(rows, list) else f"a {type(rows).__name__}"
        queries = f"{minimum} queries or more" if count is None else f"{count} queries"
        raise InputError(f"{path} contains {seen}; expected {expected}, {queries}")
    end, valid = (LARGEST, "0") if frames is None else (frames, f"0 to {frames - 1}")
    for query, row in enumerate(rows):
        listed = isinstance(row, list)
        wrong = [item for item in (row if listed else [row]) if type(item) is not int or not 0 <= item < end]
        if wrong or not listed:
            seen = f"{path}, query {query}: {json.dumps(wrong[0] if listed else row)[:40]}"
            raise InputError(f"{seen}; expected a list of reference frames from {valid}")
    return dict(enumerate(rows))


def _rounded(place: float) -> int:
    return math.floor(place) + (place % 1 >= 0.5)  # floor(place + 0.5) is wrong for large numbers


def read_matrices(path: Path, numbers: Tensor, frames: int | None, all_frames: bool) -> list[Tensor]:
    """The matrices GThard and/or GTsoft of an npz, (reference frames, query frames), each as (Q,N) bool."""
    expected = "boolean matrices GThard and/or GTsoft"
    matrices: list[np.ndarray] = []
    with reading(path, "is not a complete .npz file of arrays", expected), zipfile.ZipFile(path) as archive:
        stored = [name.removesuffix(".npy") for name in archive.namelist()]
        for name in ("GThard", "GTsoft"):
            if name not in stored:
                continue
            with archive.open(f"{name}.npy") as file:
                np.lib.format.read_magic(file)
                shape, by_columns, dtype = np.lib.format.read_array_header_1_0(file)  # of a plain matrix
                _check_shape(f"{path}: {name} is {shape} {dtype}", shape, dtype, numbers, frames, all_frames)
                size = math.prod(shape) * dtype.itemsize
                check_room(2.0 * size + 16.0 * math.prod(shape), f"{path}: {name} {shape}")
                data = file.read(size + 1)
            if len(data) != size:
                raise ValueError(f"{name} has {len(data)} bytes or more instead of {size}")
            matrices.append(np.frombuffer(data, dtype).reshape(shape, order="F" if by_columns else "C"))
    expect(matrices, expected, f"{path} contains {', '.join(stored) or 'nothing'}")
    expect(matrices[0].shape == matrices[-1].shape, "the same", f"{path}: GThard and GTsoft differ in shape")
    if not all(np.isfinite(matrix).all() for matrix in matrices):
        raise InputError(f"{path} contains values that are not finite; expected {expected}")
    return [torch.from_numpy(matrix[:, numbers.numpy()] != 0).T for matrix in matrices]


def _check_shape(
    seen: str,
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    numbers: Tensor,
    frames: int | None,
    all_frames: bool,
) -> None:
    """Refuse anything but a matrix (reference frames, query frames), with a hint if it is transposed."""
    count = int(numbers.max()) + 1

    def fits(rows: int, columns: int) -> bool:
        # queries given by number may be a subset of the columns
        return frames in (None, rows) and (columns == count or (columns > count and not all_frames))

    plain = len(shape) == 2 and dtype.kind in "biuf"
    # without a known reference, a row for each query suggests that the matrix is transposed
    transposed = plain and frames is None and shape[1] != count == shape[0]
    if not plain or transposed or not fits(*shape):
        rows = "reference frames" if frames is None else frames
        hint = "; its transpose fits" if plain and fits(*shape[::-1]) else ""
        raise InputError(f"{seen}; expected a matrix of ({rows}, {count}), one column per query frame{hint}")
