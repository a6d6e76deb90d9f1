"""Atomic output: files and folders are written completely or not at all."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import stat
import tempfile
import threading
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows: folders of killed processes are not removed
    fcntl = None  # type: ignore[assignment]

from dejavu_torch.types import InputError

PREFIX = ".dejavu-"  # of the temporary folders for incomplete files
HOST_PREFIX = f"{PREFIX}{zlib.crc32(os.fsencode(socket.gethostname())):08x}-"  # of those of this host
MAX_NAME_BYTES, MAX_PATH_BYTES = 255, 4096 - 64  # a folder's path leaves room for its files
SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
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
        if target.exists():
            _check_replaceable(path, target)


def _check_replaceable(path: Path, target: Path) -> None:
    """Refuse to replace a file that is open as a stream or owned by somebody else."""
    old, folder = target.stat(), target.parent.stat()
    for stream in range(3):
        with suppress(OSError):  # a closed stream
            if os.path.samestat(old, os.fstat(stream)):
                raise InputError(f"{path} is a standard stream of this process; expected another file")
    if Path("/proc") in _target(path.parent).parents:  # such as /dev/fd
        raise InputError(f"{path} is an open file of a process; expected another file")
    user = os.geteuid() if hasattr(os, "geteuid") else 0
    if folder.st_mode & stat.S_ISVTX and user not in (0, old.st_uid, folder.st_uid):
        raise InputError(f"{path} cannot be written: in {target.parent} only its owner may replace it")


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
    followed. The disk always has the complete old or new file.

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
        _finish(folder / path.name, path)
        with _delayed_signals():
            (folder / path.name).replace(_target(path))
        with suppress(OSError):
            _sync(_target(path).parent)


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
            _finish(folder / name, path / name)
        with _delayed_signals():
            if not path.is_dir():
                path.parent.mkdir(parents=True, exist_ok=True)
                mode = _default_mode(folder)
                with suppress(OSError):  # another process has created it meanwhile
                    folder.rename(path)
                    path.chmod(mode)  # after the rename, which needs write permission
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
    """A new folder in `parent`, locked while in use. It is removed after the block, by `remove_temporaries`,
    or, if the process was killed, by the next call for `parent`."""
    # the prefix names the host: on a network file system, locks may hold on one host only
    for old in parent.glob(f"{HOST_PREFIX}{'?' * 8}"):  # 8 characters of tempfile
        if old.is_dir() and not old.is_symlink():
            with _locked(old, wait=False) as abandoned:  # the system releases locks of killed processes
                if abandoned:
                    shutil.rmtree(old, ignore_errors=True)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=HOST_PREFIX, dir=parent))
        _temporary.add(folder)
        with suppress(FileNotFoundError):  # see below
            folder.chmod(0o700)  # whatever the umask
        with _locked(folder):
            if not folder.is_dir():  # another process removed it before it was locked
                continue
            try:
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)
                _temporary.discard(folder)
            return


@contextmanager
def _locked(folder: Path, wait: bool = True) -> Iterator[bool]:
    """Lock a folder; yields False if another process has locked it, or the system has no locks."""
    descriptor, locked = -1, False
    try:
        with suppress(OSError, AttributeError):
            descriptor = os.open(folder, os.O_RDONLY)
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            locked = True
        yield locked
    finally:
        if descriptor >= 0:
            os.close(descriptor)


def _finish(written: Path, path: Path) -> None:
    """Flush a file to disk that will replace `path`, with the mode of `path` and, if allowed, its owner."""
    written.chmod(0o600)  # whatever the umask
    _sync(written)
    mode = _default_mode(written.parent) & 0o666  # some writers make private files
    with suppress(FileNotFoundError):
        old = path.stat()
        mode = stat.S_IMODE(old.st_mode)
        with suppress(OSError, AttributeError):
            os.chown(written, old.st_uid, old.st_gid)
    written.chmod(mode)


def _sync(path: Path) -> None:
    """Flush a file, or the entries of a folder, to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _delayed_signals() -> Iterator[None]:
    """Handle signals after the block, which is short."""
    received: list[int] = []
    main = threading.current_thread() is threading.main_thread()  # the only thread that handles signals
    old = {number: handler for number in SIGNALS if main and callable(handler := signal.getsignal(number))}
    for number in old:
        signal.signal(number, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
        for number in received:
            signal.raise_signal(number)


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


def _default_mode(folder: Path) -> int:
    """The mode of a new folder. Querying the umask instead would change it for a moment."""
    fresh = Path(tempfile.mktemp(dir=folder))  # an unused name; nobody else writes in this folder
    fresh.mkdir()
    mode = fresh.stat().st_mode & 0o777
    fresh.rmdir()
    return mode
