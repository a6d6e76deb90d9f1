"""Text files read, and files written whole or not at all."""

from __future__ import annotations

import os
import stat
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dejavu_torch.memory import check_room
from dejavu_torch.types import InputError

LARGEST = 2**53  # beyond it a float does not hold every whole number

BYTES_A_CHARACTER = 64  # that the lines of a table take once they are read


def check_regular(path: Path, expected: str) -> int:
    """The bytes of a file; refuses what is none, such as a fifo or a device, which would be waited for.

    Args:
        expected: what the file should hold, for messages.

    Raises:
        InputError: no such file, or no regular one.
    """
    try:
        status = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise InputError(f"{path} cannot be read: {_why(error)}; expected {expected}") from error
    if not stat.S_ISREG(status.st_mode):
        kind = "a directory" if stat.S_ISDIR(status.st_mode) else "no regular file"
        raise InputError(f"{path} is {kind}; expected {expected}")
    return status.st_size


@contextmanager
def reading(path: Path, seen: str, expected: str) -> Iterator[None]:
    """Read a file by what is not ours: whatever that raises is one refusal, whatever it warns of is no line.

    Args:
        seen: what a message says of a file that cannot be read, such as "is no image".
        expected: what the file should hold, for messages.

    Raises:
        InputError: no regular file, or one that cannot be read; those of the block as they are.
    """
    check_regular(path, expected)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception as error:  # a decoder may raise anything: struct.error, KeyError, MemoryError, ..
        raise InputError(f"{path} {seen}: {_why(error)}; expected {expected}") from error


def _why(error: Exception) -> str:
    """An exception in words of one line."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(text).split())


def read_text(path: Path, expected: str) -> str:
    """A whole text file, without a byte order mark, its lines ended by "\\n".

    Args:
        expected: what the file should hold, for messages.

    Raises:
        InputError: it cannot be read, is no text, or larger than the memory.
    """
    check_room(BYTES_A_CHARACTER * check_regular(path, expected), f"the text of {path}")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {_why(error)}; expected {expected}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no UTF-8 text; expected {expected}") from error
    if "\0" in text:
        raise InputError(f"{path} is no text; expected {expected}")
    return text


def as_number(text: str) -> float | None:
    """A number that a frame or a coordinate can have, else None."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if abs(value) < LARGEST else None


def check_output_file(path: Path) -> None:
    """Refuse early, before long work, a file that could not be written.

    Raises:
        InputError: the parent folder is missing or not writable, or the path is a folder.
    """
    if path.is_dir():
        raise InputError(f"{path} is a folder; expected a file to write")
    if not path.parent.is_dir():
        raise InputError(f"{path} cannot be written: the folder {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path} cannot be written: no permission to write in {path.parent}")


def check_output_folder(path: Path) -> None:
    """Refuse early, before long work, a folder that could not be made or written in.

    Raises:
        InputError: a file is in the way, or there is no permission.
    """
    there = next(folder for folder in (path, *path.parents) if folder.exists())
    if not there.is_dir():
        raise InputError(f"{path} cannot be made a folder: {there} is a file; expected a new path")
    if not os.access(there, os.W_OK):
        raise InputError(f"no permission to write in the folder {there}")


def make_output_folder(path: Path) -> None:
    """Create the folder and its parents.

    Raises:
        InputError: see `check_output_folder`, or the system refuses it.
    """
    check_output_folder(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path} cannot be made a folder: {error.strerror}; expected a new path") from error


def remove_empty_folders(path: Path) -> None:
    """Remove a folder that holds nothing but folders; files, and the folders they lie in, stay."""
    for folder, _, _ in os.walk(path, topdown=False):
        if not os.listdir(folder):
            os.rmdir(folder)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its place only when the block ends well.

    Example:
        >>> import tempfile
        >>> target = Path(tempfile.mkdtemp()) / "note.txt"
        >>> with whole_file(target) as temporary:
        ...     _ = temporary.write_text("all of it")
        >>> target.read_text()
        'all of it'
    """
    check_output_file(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())  # some writers make private files
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"{path} was not written: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
