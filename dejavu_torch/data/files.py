"""Files read, whatever they hold; `expected` is what messages say that a file should hold."""

from __future__ import annotations

import csv
import stat
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path

from dejavu_torch.memory import check_room
from dejavu_torch.text import one_line
from dejavu_torch.types import InputError

LARGEST = 2**53  # beyond it a float does not hold every whole number
BYTES_A_CHARACTER = 64  # that the lines of a table take once they are read


def check_regular(path: Path, expected: str) -> int:
    """The bytes of a file; refuses what is none, such as a fifo or a device, which would be waited for."""
    try:
        status = path.stat()
    except FileNotFoundError as error:
        raise InputError(f"{path} is not there; expected {expected}") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise InputError(f"{path} cannot be read: {why(error)}; expected {expected}") from error
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "no regular file"
        raise InputError(f"{path} is {kind}; expected {expected}")
    return status.st_size


def state_of(*paths: Path) -> str:
    """A digest of names, sizes and times of files, which a file that is changed changes."""
    digest = blake2b(digest_size=8)
    for path in paths:
        try:
            status = path.stat()
        except OSError as error:
            raise InputError(f"{path} cannot be read: {why(error)}; expected the file as before") from error
        digest.update(f"{path.name}/{status.st_size}/{status.st_mtime_ns}/".encode(errors="surrogateescape"))
    return digest.hexdigest()


@contextmanager
def reading(path: Path, seen: str, expected: str) -> Iterator[None]:
    """Read a file by what is not ours: whatever that raises is one refusal, whatever it warns of is no line.

    Args:
        seen: what a message says of a file that cannot be read, such as "is no image".
    """
    check_regular(path, expected)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception as error:  # a decoder may raise anything: struct.error, KeyError, MemoryError, ..
        raise InputError(f"{path} {seen}: {why(error)}; expected {expected}") from error


def why(error: Exception) -> str:
    """An exception in words of one line."""
    return one_line(getattr(error, "strerror", None) or str(error) or type(error).__name__)


def read_text(path: Path, expected: str) -> str:
    """A whole text file, without a byte order mark, its lines ended by "\\n"."""
    check_room(BYTES_A_CHARACTER * check_regular(path, expected), f"the text of {path}")
    with reading(path, "cannot be read as UTF-8 text", expected):
        text = path.read_text(encoding="utf-8-sig")
        if "\0" in text:
            raise ValueError("there is a null character in it")
    return text


def read_rows(path: Path, expected: str) -> list[tuple[int, list[str]]]:
    """Number and cells of each line of a csv that is not blank.

    Cells are separated by semicolons, tabs, commas or spaces: by the first of these that the first line with
    several cells has. Where semicolons separate, a comma may be a decimal one, and stays in its cell.
    """
    lines = read_text(path, expected).splitlines()
    separator = next((sign for line in lines for sign in ";\t," if sign in line), " ")
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    try:
        rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        raise InputError(f"{path}, line {reader.line_num}: {error}; expected {expected}") from error
    return [(number, cells) for number, cells in rows if any(cells)]


def as_number(text: str) -> float | None:
    """A number that a frame or a coordinate can have, else None."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if abs(value) < LARGEST else None
