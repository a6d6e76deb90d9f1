"""Output files and folders: they appear whole or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dejavu_torch.types import InputError, expect

PREFIX = ".dejavu-"  # of the temporary folders for incomplete files
_temporary: set[Path] = set()  # this process's temporary folders


def check_output_file(path: Path) -> None:
    """Refuse a file that could not be written, before long work starts. Links are followed."""
    with _refusing(path, "cannot be written"):
        target = _target(path)
        expect(not target.is_dir(), "a file to write", f"{path} is a folder")
        if path.exists() and not path.is_file():  # not target: /dev/stdout resolves to no path
            raise InputError(f"{path} is not a regular file; expected a file to write")
        if not target.parent.is_dir():
            raise InputError(f"{path} cannot be written: the folder {target.parent} does not exist")
        for place in (target.parent, target):
            if place.exists() and not os.access(place, os.W_OK):
                raise InputError(f"{path} cannot be written: no permission to write in {place}")
        for stream in range(3) if target.exists() else ():
            with suppress(OSError):  # a closed stream
                same = os.path.samestat(target.stat(), os.fstat(stream))
                expect(not same, "another file", f"{path} is a standard stream of this process")


def check_output_folder(path: Path) -> None:
    """Refuse a folder that could not be created or written to, before long work starts."""
    with _refusing(path, "cannot be made a folder"):
        with suppress(FileNotFoundError, NotADirectoryError):
            path.lstat()  # refuses a name that is too long
        parent = _existing(path)
        kind = "a file" if parent.is_file() else "not a folder"
        expect(parent.is_dir(), "a new path", f"{path} cannot be made a folder: {parent} is {kind}")
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
    followed. The disk always has the complete old or new file.

    Example:
        >>> import tempfile
        >>> target = Path(tempfile.mkdtemp()) / "note.txt"
        >>> with whole_file(target) as temporary:
        ...     _ = temporary.write_text("all of it")
        >>> target.read_text()
        'all of it'
    """
    check_output_file(path)
    target = _target(path)
    with _refusing(path, "was not written"), temporary_folder(target.parent) as folder:
        yield folder / path.name
        _finish(folder / path.name, target)
        (folder / path.name).replace(target)
        with suppress(OSError):
            _sync(target.parent)


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
        for name in names:
            if path.is_dir():
                check_output_file(path / name)
            _finish(folder / name, _target(path / name))
        if not path.is_dir():
            path.parent.mkdir(parents=True, exist_ok=True)
            with suppress(OSError):  # another process has created it meanwhile
                folder.rename(path)
        for name in names if folder.is_dir() else ():
            (folder / name).replace(_target(path / name))
        for name in {*earlier} - {*names}:
            (path / name).unlink(missing_ok=True)
        for place in (path, path.parent):
            with suppress(OSError):
                _sync(place)


def remove_temporaries() -> None:
    """Remove this process's temporary folders before it exits without cleanup."""
    for folder in list(_temporary):
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """A new folder in `parent`, removed after the block or by `remove_temporaries`."""
    folder = parent / f"{PREFIX}{secrets.token_hex(4)}"
    _temporary.add(folder)
    try:
        folder.mkdir()  # with the mode that a new folder has for this user
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        _temporary.discard(folder)


def _finish(written: Path, target: Path) -> None:
    """Flush a file to disk that will replace `target`, with its mode."""
    _sync(written)
    # safetensors makes private files
    mode = target.stat().st_mode & 0o777 if target.exists() else written.parent.stat().st_mode & 0o666
    written.chmod(mode)


def _sync(path: Path) -> None:
    """Flush a file, or the entries of a folder, to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _refusing(path: Path, what: str) -> Iterator[None]:
    """Turn an OSError into an InputError of one line."""
    try:
        yield
    except InputError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise InputError(f"{path} {what}: {getattr(error, 'strerror', None) or error}") from error


def _target(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _existing(path: Path) -> Path:
    """The path or its nearest existing parent; a broken link exists."""
    return next((place for place in (path, *path.parents) if os.path.lexists(place)), path)
