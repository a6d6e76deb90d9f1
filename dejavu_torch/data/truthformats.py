"""The files and names that hold a truth: csv, npz, and UTM coordinates."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.data.truth import Shown, padded, truth_of_places
from dejavu_torch.types import GroundTruth, InputError, Traverse

Rows = list[tuple[int, list[str]]]  # number of a line, and its cells
LARGEST = 2**53  # beyond it a float does not hold every whole number


def read_text(path: Path, expected: str) -> str:
    """A whole text file, byte order mark and kind of line ends taken away.

    Raises:
        InputError: it cannot be read, or is no text.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; expected {expected}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no UTF-8 text; expected {expected}") from error
    if "\0" in text:
        raise InputError(f"{path} is no text; expected {expected}")
    return text


def utm_coordinates(traverse: Traverse) -> Tensor:
    """Easting and northing in the names of a traverse's images, metres: (N,2) float64.

    Raises:
        InputError: no folder of images, or a name without them.
    """
    files: list[Path] | None = getattr(traverse, "files", None)
    if files is None:
        raise InputError(f"{traverse.name} has no image names; expected folders of images for truth utm")
    rows = []
    for file in files:
        row = [as_number(part) for part in file.name.split("@")[1:3]]
        if len(row) != 2 or None in row:
            raise InputError(
                f"{file} has no UTM coordinates in its name; expected @easting@northing@...@.jpg"
            )
        rows.append(row)
    return torch.tensor(rows, dtype=torch.float64)


def read_table(
    path: Path, places: int | None, numbers: Tensor, interpolate: bool = False, shown: Shown | None = None
) -> GroundTruth:
    """A csv of `query,place[,place...]`; see `read_truth`.

    Args:
        places: how many places the map has, None where unknown. numbers: (Q,) the number of each query.
        interpolate: queries between two listed ones get the place between theirs.
        shown: the frames of evenly spaced queries and places.
    """
    rows, of_frames = _table_rows(path)
    if shown is None or not of_frames:
        hint = "" if shown is None else " (frames stand under the header query_frame,place_frame)"
        return _table(path, _listed(path, rows, places, interpolate, hint), numbers, interpolate)
    frames = numbers if shown.query is None else shown.query
    listed = _listed(path, rows, None, interpolate)
    if shown.frames is not None and max(listed) >= shown.frames:
        raise InputError(
            f"{path} lists query frame {max(listed)}; expected frames from 0 to {shown.frames - 1}"
        )
    if not interpolate:
        listed = _at_shown(listed, frames)
    return truth_of_places(_table(path, listed, frames, interpolate), shown)


def counts_frames(path: Path) -> bool:
    """Whether a csv says in its header that it counts frames."""
    return _table_rows(path)[1]


def _at_shown(listed: dict[int, list[float]], frames: Tensor) -> dict[int, list[float]]:
    """Listed query frames that no query shows as the one nearest to them that is shown and not listed."""
    ordered = frames.sort().values
    moved = dict(listed)
    for frame in listed:
        after = int(torch.searchsorted(ordered, frame))
        near = ordered[max(0, after - 1) : after + 1].tolist()
        nearest = min(near, key=lambda other: abs(other - frame))
        if nearest not in listed:
            moved[nearest] = [*moved.get(nearest, []), *listed[frame]]
    return moved


def _table(path: Path, listed: dict[int, list[float]], numbers: Tensor, interpolate: bool) -> GroundTruth:
    queries, first, last = numbers.tolist(), min(listed), max(listed)
    if interpolate:
        knots = sorted(listed)
        between = np.interp(queries, knots, [listed[query][0] for query in knots]).tolist()
        known = (numbers >= first) & (numbers <= last)
        sets = [[place] if inside else [] for place, inside in zip(between, known.tolist(), strict=True)]
    else:
        known = torch.tensor([query in listed for query in queries])
        sets = [listed.get(query, []) for query in queries]
    if not known.any():
        wanted = f"{min(queries)} to {max(queries)}"
        raise InputError(f"{path} lists queries from {first} to {last}; expected some of {wanted}")
    row = torch.arange(len(sets)).repeat_interleave(torch.tensor([len(found) for found in sets]))
    flat = torch.tensor([_rounded(place) for found in sets for place in found], dtype=torch.int64)
    right = padded(row, flat, len(sets))
    return GroundTruth(right, known, right.new_zeros(len(right), 0))


def _listed(
    path: Path, rows: Rows, places: int | None, interpolate: bool, hint: str = ""
) -> dict[int, list[float]]:
    """The places of each query that a csv lists."""
    listed: dict[int, list[float]] = {}
    for line, cells in rows:
        where = f"{path}, line {line}"
        values = []
        for cell in cells:
            value = as_number(cell)
            if value is None:
                raise InputError(f"{where}: {cell!r} is no frame number; expected query,place")
            values.append(value)
        query, found = values[0], [place for place in values[1:] if place != -1]
        if query < 0 or query % 1:
            raise InputError(f"{where}: query {cells[0]}; expected a whole number of at least 0")
        if query in listed:
            raise InputError(f"{where}: query {cells[0]} is listed twice; expected each once")
        for place in found:
            if place < 0 or (places is not None and _rounded(place) >= places):
                last = "" if places is None else f" to {places - 1}"
                raise InputError(
                    f"{where}: place {place:.12g}; expected a place from 0{last}, or -1 for none{hint}"
                )
            if place % 1 and not interpolate:
                raise InputError(f"{where}: place {place:.12g}; expected a whole number, or interpolation")
        if interpolate and len(found) != 1:
            raise InputError(f"{where}: {len(found)} places; expected one in each line to interpolate")
        listed[int(query)] = found
    if not listed:
        raise InputError(f"{path} lists no query; expected lines of query,place")
    return listed


def _table_rows(path: Path) -> tuple[Rows, bool]:
    """Number and cells of each line that is not blank, without the header, and whether that says frames."""
    text = read_text(path, "lines of query,place").replace('"', "")
    # where semicolons separate, a comma may be a decimal one: it stays in its cell and is refused
    separator = next((sign for sign in ";\t," if sign in text), None)
    rows, of_frames = [], False
    for number, line in enumerate(text.split("\n"), 1):
        cells = [cell.strip() for cell in line.strip(" ").split(separator)]
        while cells and not cells[-1]:
            del cells[-1]
        if cells:
            rows.append((number, cells))
    if rows and all(as_number(cell) is None for cell in rows[0][1]):
        number, names = rows.pop(0)
        first, *others = [name.lower() for name in names]
        of_frames = first == "query_frame"
        begins = "place_frame" if of_frames else "place"
        # another column, such as a distance, would count as a right place
        wrong = any(name and not name.startswith(begins) for name in others)
        if first not in ("query", "query_frame") or wrong or ("place_frame" in others) != of_frames:
            raise InputError(
                f"{path}, line {number}: columns {','.join(names)}; expected query,place[,place...], or "
                "query_frame,place_frame[,place_frame...]"
            )
    return rows, of_frames


def read_matrices(
    path: Path, places: int | None, queries: int | Tensor, shown: Shown | None = None
) -> GroundTruth:
    """An npz of the matrices (places, queries) GThard and/or GTsoft; see `read_truth`."""
    matrices = _load_matrices(path)
    if shown is not None and _of_frames(matrices, shown):
        numbers = queries if shown.query is None else shown.query
        rows = next(iter(matrices.values())).shape[0]
        return truth_of_places(_matrices(path, matrices, rows, numbers), shown)
    return _matrices(path, matrices, places, queries)


def _of_frames(matrices: Mapping[str, np.ndarray], shown: Shown) -> bool:
    """Whether matrices are as large as the traverses are in frames."""
    shape = next(iter(matrices.values())).shape
    if shown.place_of is None or len(shape) != 2 or shape[0] != len(shown.place_of):
        return False
    last = -1 if shown.query is None else int(shown.query.max())
    return bool(shape[1] > last if shown.frames is None else shape[1] == shown.frames)


def _matrices(
    path: Path, matrices: Mapping[str, np.ndarray], places: int | None, queries: int | Tensor
) -> GroundTruth:
    for name, matrix in matrices.items():
        _check_shape(f"{path}: {name}", matrix, places, queries)
    if len({matrix.shape for matrix in matrices.values()}) > 1:
        raise InputError(f"{path}: GThard and GTsoft differ in shape; expected the same")
    columns = slice(None) if isinstance(queries, int) else queries.numpy()
    first, *others = [
        torch.from_numpy(matrix[:, columns].astype(bool, copy=False)).T for matrix in matrices.values()
    ]
    right = _columns(first)
    known = torch.ones(len(right), dtype=torch.bool)
    if not others:
        return GroundTruth(right, known, right.new_zeros(len(right), 0))
    return GroundTruth(right, known, _columns(others[0] & ~first))


def _columns(which: Tensor) -> Tensor:
    """(Q,N) bool -> (Q,R), the columns that are true in each row."""
    row, column = which.nonzero().T
    return padded(row, column, len(which))


def _load_matrices(path: Path) -> dict[str, np.ndarray]:
    """GThard and GTsoft in this order, those that are there."""
    expected = "boolean matrices GThard and/or GTsoft"
    try:
        file = np.load(path, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ValueError("one bare array")
        with file:
            found: dict[str, np.ndarray] = {
                name: file[name] for name in ("GThard", "GTsoft") if name in file.files
            }
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path} is no whole .npz file of arrays; expected {expected}") from error
    if not found:
        raise InputError(f"{path} holds {', '.join(file.files) or 'nothing'}; expected {expected}")
    return found


def _check_shape(name: str, matrix: np.ndarray, places: int | None, queries: int | Tensor) -> None:
    count = queries if isinstance(queries, int) else int(queries.max()) + 1
    seen = f"{name} is {matrix.shape} {matrix.dtype}"
    wanted = f"expected a matrix of ({'places' if places is None else places}, {count}), a column a query"
    if matrix.ndim != 2 or matrix.dtype.kind not in "biuf":
        raise InputError(f"{seen}; {wanted}")

    def fits(rows: int, columns: int) -> bool:
        # queries that are given by number may be some of those in the matrix
        enough = columns == count or (columns > count and not isinstance(queries, int))
        return enough and places in (None, rows)

    rows, columns = matrix.shape
    # where the places are not known, as many rows as queries speak for a transposed matrix
    if not fits(rows, columns) or (places is None and columns != count == rows):
        raise InputError(f"{seen}; {wanted}{'; transposed it fits' if fits(columns, rows) else ''}")


def as_number(text: str) -> float | None:
    """A number that a frame or a coordinate can have, else None."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if abs(value) < LARGEST else None


def _rounded(place: float) -> int:
    return math.floor(place + 0.5)
