"""Tables in files, with named columns that carry units: truths, coordinates, paths, moves and matches."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dejavu_torch.data.files import read_rows
from dejavu_torch.types import InputError, expect

# names of a column that mean the same; of times, places and angles with a unit, as in timestamp_ns or "x [m]"
ALIKE = {
    "name": "filename file_name file image image_name image_file img frame_name path image_path",
    "time": "timestamp stamp t sec secs seconds second unix_time",
    "nsec": "nanosec nsecs nanoseconds",
    "query": "query_idx query_index query_id query_frame q_idx",
    "place": "place_idx place_index reference ref ref_idx ref_index ref_id reference_index match_idx",
    "score": "distance dist cost",
    "frame": "frame_id frame_number frame_index",
    "x": "tx p_x pos_x position_x p_rs_r_x",
    "y": "ty p_y pos_y position_y p_rs_r_y",
    "z": "tz p_z pos_z position_z p_rs_r_z alt altitude height elevation ele",
    "lat": "latitude",
    "lon": "longitude lng long",
    "easting": "east utm_east utm_easting utm_x",
    "northing": "north utm_north utm_northing utm_y",
    "moved": "",
    "moved_spread": "",
}
UNITS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}  # of times, in seconds
UNITS |= {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "deg": 1.0, "degrees": 1.0, "rad": 180 / math.pi}
NAMED = {name: role for role, names in ALIKE.items() for name in (role, *names.split())}
IN_BRACKETS = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]$")
AFTER = re.compile(rf"^(.*)_({'|'.join(UNITS)})$")


class Column(NamedTuple):
    """A column of a table: its name in the file, what it holds if that is known, else that name, and its unit
    in seconds, metres or degrees, None unless the header tells."""

    title: str
    role: str
    unit: float | None = None


@dataclass
class Table:
    """Rows of cells with the names of their columns.

    Attributes:
        header: its columns; empty without one. rows: line number and cells of each line, but for the header.
        line: number of that of the header. used: numbers of the columns that are asked for, or need not be.
    """

    path: Path
    header: list[Column]
    rows: list[tuple[int, list[str]]]
    line: int = 1
    used: set[int] = field(default_factory=set)

    def __len__(self) -> int:
        return len(self.rows)

    def __contains__(self, role: str) -> bool:
        return any(column.role == role for column in self.header)

    def named(self, *roles: str) -> None:
        """Name the first columns of a table without a header."""
        self.header = [Column("", role) for role in roles]

    def distinct(self) -> Table:
        """Without rows that repeat the cells of the one before, as of messages that were written twice."""
        rows = [row for i, row in enumerate(self.rows) if not i or row[1] != self.rows[i - 1][1]]
        return replace(self, rows=rows)

    def where(self, row: int) -> str:
        """The line of a row, for messages."""
        return f"{self.path}, line {self.rows[row][0]}"

    def at(self, role: str) -> int:
        """The number of a column."""
        column = next(i for i, one in enumerate(self.header) if one.role == role)
        self.used.add(column)
        return column

    def text(self, role: str) -> list[str]:
        """The cells of a column, "" where a row is too short."""
        column = self.at(role)
        return [cells[column] if column < len(cells) else "" for _, cells in self.rows]

    def numbers(self, role: str) -> np.ndarray:
        """The numbers of a column in its unit, (R,) float64; NaN for cells that are none."""
        unit = self.header[self.at(role)].unit
        return np.array([number(cell) for cell in self.text(role)]) * (1.0 if unit is None else unit)

    def check_width(self, *roles: str) -> None:
        """Refuse rows that lack cells of these columns."""
        width = 1 + max(map(self.at, roles))
        for row, (_, cells) in enumerate(self.rows):
            expect(len(cells) >= width, f"{width} or more", f"{self.where(row)}: {len(cells)} columns")

    def cells(self, expected: str) -> Iterator[tuple[str, dict[str, str]]]:
        """The line of each row, for messages, and its cells by what their columns hold."""
        names = [column.role for column in self.header]
        for row, (_, cells) in enumerate(self.rows):
            seen = f"{self.where(row)}: {len(cells)} cells"
            expect(len(cells) >= len(names), f"{len(names)} as in the header", seen)
            expect(not any(cells[len(names) :]), f"{len(names)} as in the header, {expected}", seen)
            yield self.where(row), dict(zip(names, cells, strict=False))

    def unused(self) -> list[str]:
        """The titles of the columns that nobody has asked for."""
        return [column.title for i, column in enumerate(self.header) if i not in self.used and column.title]

    def __str__(self) -> str:
        if self.header:
            return f"{self.path} has the columns {', '.join(column.title for column in self.header)}"
        known = f"{len(self.rows[0][1])} columns without a header" if self.rows else "no rows and no columns"
        return f"{self.path} has {known}"


def read_table(path: Path, expected: str) -> Table:
    """The table in a text file: values between commas, semicolons, tabs or spaces.

    The first line is the header, unless a cell of it is a number; a comment, after "#", is one if it has a
    name for each cell and no other line is.

    Args:
        expected: the second half of error messages.
    """
    rows = read_rows(path, expected)
    comments = [
        re.split("[,;\t]+", ",".join(cells).lstrip("#%, ")) for _, cells in rows if cells[0][:1] == "#"
    ]
    rows = [row for row in rows if row[1][0][:1] != "#"]
    titles, at, known = list[str](), 1, False
    if rows and all(math.isnan(number(cell)) and cell.lower() != "nan" for cell in rows[0][1] if cell):
        at, titles = rows.pop(0)
    elif rows and comments and len(comments[-1]) == len(rows[0][1]):
        titles, known = comments[-1], True  # as in files of a standard form
    titles = [title.strip(" %").lower() for title in titles]
    columns = [column_of(title) for title in titles]
    taken: set[str] = set()
    for i, column in enumerate(columns):  # the first of two that mean the same; a plain name goes first
        plain = column.title == column.role or column.role not in titles
        if column.role in taken or not plain:
            columns[i] = Column(column.title, column.title, column.unit)
        taken.add(columns[i].role)
    return Table(path, columns, rows, at, {*range(len(columns))} if known else set())


def column_of(title: str) -> Column:
    """The column of a title in lower case.

    Example:
        >>> column_of("timestamp_ns"), column_of("x [m]").role
        (Column(title='timestamp_ns', role='time', unit=1e-09), 'x')
    """
    base, unit = title, None
    for pattern in (IN_BRACKETS, AFTER):
        if (found := pattern.match(base)) and found[2] in UNITS and not unit:
            base, unit = found[1].strip("_ "), UNITS[found[2]]
    base = base if base in NAMED else re.split("[./]", base)[-1]  # as in pose.position.x
    return Column(title, NAMED.get(base, title), unit)


def check_frames(numbers: Collection[int], length: int, path: Path, what: str) -> None:
    """Refuse numbers of frames beyond the last, and ask whether they count from 1 if it looks so."""
    beyond = sorted(number for number in numbers if number >= length)
    if beyond:
        seen = f"{path} has {len(beyond)} beyond the last frame: {what} {beyond[0]}"
        seen += f" to {beyond[-1]}" * (len(beyond) > 1)
        from_one = "; do they count from 1?" * (min(numbers) == 1 and max(numbers) == length)
        raise InputError(f"{seen}{from_one}; expected frames from 0 to {length - 1}")


def number(text: str) -> float:
    """A number of any size, also with a decimal comma; NaN for anything else."""
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def whole(text: str, name: str, minimum: int, where: str) -> int:
    """A whole number of at least a minimum."""
    value = number(text)
    if math.isnan(value) or value % 1 or value < minimum or value >= 2**53:
        raise InputError(f"{where}: {name} is {text!r}; expected a whole number of at least {minimum}")
    return int(value)
