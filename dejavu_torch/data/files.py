"""Reading files that may hold anything; `expected` is the second half of error messages."""

from __future__ import annotations

import csv
import re
import stat
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dejavu_torch.memory import check_room
from dejavu_torch.text import one_line
from dejavu_torch.types import InputError, expect

LARGEST = 2**53  # a float64 holds every whole number up to here
BYTES_PER_CHARACTER = 64  # of memory that a table takes once it is parsed


def check_regular(path: Path, expected: str) -> int:
    """The size of a file in bytes; refuses all but regular files, as reading a fifo or device can block."""
    try:
        status = path.stat()
    except FileNotFoundError as error:
        raise InputError(f"{path} is not there; expected {expected}") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise InputError(f"{path} cannot be read: {why(error)}; expected {expected}") from error
    kind = "a folder" if stat.S_ISDIR(status.st_mode) else "not a regular file"
    expect(stat.S_ISREG(status.st_mode), expected, f"{path} is {kind}")
    return status.st_size


@contextmanager
def reading(path: Path, seen: str, expected: str) -> Iterator[None]:
    """Read a file by a third-party library: its exceptions become InputErrors, its warnings are dropped.

    Args:
        seen: the message for a file that cannot be read, such as "is not an image".
    """
    check_regular(path, expected)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception as error:  # decoders raise anything: struct.error, KeyError, MemoryError, ...
        raise InputError(f"{path} {seen}: {why(error)}; expected {expected}") from error


def why(error: Exception) -> str:
    """An exception's message in one line."""
    return one_line(getattr(error, "strerror", None) or str(error) or type(error).__name__)


def read_text(path: Path, expected: str) -> str:
    """A whole text file without byte order mark, lines ending in "\\n"."""
    check_room(BYTES_PER_CHARACTER * check_regular(path, expected), f"the text of {path}")
    with reading(path, "cannot be read as UTF-8 text", expected):
        text = path.read_text(encoding="utf-8-sig")
        if "\0" in text:
            raise ValueError("it contains a null character")
    return text


def read_rows(path: Path, expected: str) -> list[tuple[int, list[str]]]:
    """Line number and cells of each line of a csv that is not blank.

    The separator is the first of semicolon, tab, comma and space that occurs in the first line with several
    cells that is no comment, after "#". Between semicolons, a comma stays in its cell: it may be a decimal
    comma.
    """
    lines = read_text(path, expected).splitlines()
    cells = (line for line in lines if line[:1] != "#")
    separator = next((sign for line in cells for sign in ";\t," if sign in line), " ")
    if separator == " ":  # a unit stays with its name, as in "moved [m]"
        lines = [re.sub(r" +(?=[\[(]\w+[\])])", "", line.rstrip()) for line in lines]
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    try:
        rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        raise InputError(f"{path}, line {reader.line_num}: {error}; expected {expected}") from error
    return [(number, cells) for number, cells in rows if any(cells)]


def as_number(text: str) -> float | None:
    """A number below 2^53, as of a frame or a coordinate, else None."""
    with suppress(ValueError):
        return value if abs(value := float(text)) < LARGEST else None
    return None
