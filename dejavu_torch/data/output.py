"""Atomic output: files and folders are written completely or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dejavu_torch.types import InputError

PREFIX = ".dejavu-"  # of the temporary folders for incomplete files
MAX_NAME_BYTES, MAX_PATH_BYTES = 255, 4096 - 64  # a folder's path leaves room for its files
_temporary: set[Path] = set()  # this process's temporary folders


def check_output_file(path: Path) -> None:
    """Refuse a file that could not be written, before long work starts. Links are followed."""
    with _refusing(path, "cannot be written", ValueError):  # ValueError: an invalid name
        _check_name(path)
        target = _target(path)
        if target.is_dir():
            raise InputError(f"{path} is a folder; expected a file to write")
        if path.exists() and not path.is_file():  # not target: /dev/stdout resolves to no path
            raise InputError(f"{path} is not a regular file; expected a file to write")
        if target.is_symlink():
            raise InputError(f"{path} is a link to itself; expected a file to write")
        if not target.parent.is_dir():
            raise InputError(f"{path} cannot be written: the folder {target.parent} does not exist")
        for place in (target.parent, target):
            if place.exists() and not os.access(place, os.W_OK):
                raise InputError(f"{path} cannot be written: no permission to write in {place}")


def check_output_folder(path: Path) -> None:
    """Refuse a folder that could not be created or written to, before long work starts."""
    with _refusing(path, "cannot be made a folder", ValueError):
        _check_name(path)
        parent = _existing(path)
        if not parent.is_dir():
            kind = "a file" if parent.is_file() else "not a folder"
            raise InputError(f"{path} cannot be made a folder: {parent} is {kind}; expected a new path")
        if not os.access(parent, os.W_OK):
            raise InputError(f"no permission to write in the folder {parent}")


def make_output_folder(path: Path) -> None:
    """Create the folder and its parents."""
    check_output_folder(path)
    with _refusing(path, "cannot be made a folder"):
        path.mkdir(parents=True, exist_ok=True)


def remove_empty_folders(path: Path) -> None:
    """Remove empty folders under `path`, and `path` itself if nothing is left in it."""
    for folder, _, _ in os.walk(path, topdown=False):
        if not os.listdir(folder):
            os.rmdir(folder)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary path whose file replaces `path` when the block ends without an exception.

    It has the name of `path`, in a `temporary_folder` next to it. An existing file keeps its mode; links are
    followed. The disk always has the complete old or new file; of two writers the last one wins.

    Example:
        >>> target = Path(tempfile.mkdtemp()) / "note.txt"
        >>> with whole_file(target) as temporary:
        ...     _ = temporary.write_text("all of it")
        >>> target.read_text()
        'all of it'
    """
    check_output_file(path)
    with _refusing(path, "was not written"), temporary_folder(_target(path).parent) as folder:
        yield folder / path.name
        _replace(folder / path.name, path)


@contextmanager
def whole_folder(path: Path, earlier: Iterable[str] = ()) -> Iterator[Path]:
    """A temporary folder whose files move to `path` when the block ends without an exception.

    A new folder appears with all its files at once; in an existing one, files are replaced one by one, others
    stay, and those named in `earlier`, from an earlier run, are removed if the block did not write them.
    """
    check_output_folder(path)
    with _refusing(path, "was not written"), temporary_folder(_existing(path)) as folder:
        yield folder
        names = sorted(file.name for file in folder.iterdir())
        if path.is_dir():
            for name in names:
                check_output_file(path / name)
        else:
            for name in names:
                _finish(folder / name, path / name)
            path.parent.mkdir(parents=True, exist_ok=True)
            with suppress(OSError):  # another process has created it meanwhile
                folder.rename(path)
                path.chmod(0o777 & ~_umask())
        for name in names if folder.is_dir() else ():
            _replace(folder / name, path / name)
        for name in {*earlier} - {*names}:
            (path / name).unlink(missing_ok=True)


def remove_temporaries() -> None:
    """Remove this process's temporary folders before it exits without cleanup."""
    for folder in list(_temporary):
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """A new folder in `parent`, removed after the block or by `remove_temporaries`."""
    folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
    _temporary.add(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        _temporary.discard(folder)


def _replace(written: Path, path: Path) -> None:
    """Flush a file to disk and let it replace `path`."""
    _finish(written, path)
    written.replace(_target(path))
    with suppress(OSError):
        _sync(_target(path).parent)


def _finish(written: Path, path: Path) -> None:
    """Flush a file to disk, with the mode of the one at `path`; some writers make private files."""
    _sync(written)
    written.chmod(0o666 & ~_umask())
    with suppress(FileNotFoundError):
        shutil.copymode(path, written)


def _sync(path: Path) -> None:
    """Flush a file, or the entries of a folder, to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _refusing(path: Path, what: str, also: type[Exception] = OSError) -> Iterator[None]:
    """Turn an OSError or `also` into an InputError of one line."""
    try:
        yield
    except InputError:
        raise
    except (OSError, also) as error:
        raise InputError(f"{path} {what}: {getattr(error, 'strerror', None) or error}") from error


def _target(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _existing(path: Path) -> Path:
    """The path or its nearest existing parent; a broken link exists."""
    return next((place for place in (path, *path.parents) if os.path.lexists(place)), path)


def _check_name(path: Path) -> None:
    if "\0" in str(path):
        raise ValueError("it contains a null character")
    longest = max((len(os.fsencode(part)) for part in path.parts), default=0)
    length = len(os.fsencode(path.absolute()))
    if longest > MAX_NAME_BYTES or length > MAX_PATH_BYTES:
        seen = f"{path} has a name of {longest} bytes, {length} in all"
        raise InputError(f"{seen}; expected at most {MAX_NAME_BYTES}, {MAX_PATH_BYTES} in all")


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
