"""Files and folders written whole or not at all."""

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
except ImportError:  # Windows: what is left behind stays
    fcntl = None  # type: ignore[assignment]

from dejavu_torch.types import InputError

PREFIX = ".dejavu-"  # of the folders where files are written until they are whole
HERE = f"{PREFIX}{zlib.crc32(os.fsencode(socket.gethostname())):08x}-"  # of those of this host
LONGEST_NAME, LONGEST_PATH = 255, 4096 - 64  # bytes; a path leaves room for the files of a folder
SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
_temporary: set[Path] = set()  # the folders of this process that are there now


def check_output_file(path: Path) -> None:
    """Refuse early, before long work, a file that could not be written. A link stands for its target."""
    with _refusing(path, "cannot be written", ValueError):  # a name that the system cannot spell
        _check_name(path)
        target = _target(path)
        if target.is_dir():
            raise InputError(f"{path} is a folder; expected a file to write")
        if path.exists() and not path.is_file():  # of the link: /dev/stdout leads to no path
            raise InputError(f"{path} is no regular file; expected a file to write")
        if target.is_symlink():
            raise InputError(f"{path} is a link to itself; expected a file to write")
        if not target.parent.is_dir():
            raise InputError(f"{path} cannot be written: the folder {target.parent} does not exist")
        for place in (target.parent, target):
            if place.exists() and not os.access(place, os.W_OK):
                raise InputError(f"{path} cannot be written: no permission to write in {place}")
        if target.exists():
            _check_replaced(path, target)


def _check_replaced(path: Path, target: Path) -> None:
    """Refuse to replace a file that somebody else writes or owns."""
    there, folder = target.stat(), target.parent.stat()
    for stream in range(3):
        with suppress(OSError):  # it is closed
            if os.path.samestat(there, os.fstat(stream)):
                raise InputError(f"{path} is a standard stream of this process; expected a file of its own")
    if Path("/proc") in _target(path.parent).parents:  # as /dev/fd is
        raise InputError(f"{path} is an open file of a process; expected a file of its own")
    user = os.geteuid() if hasattr(os, "geteuid") else 0
    if folder.st_mode & stat.S_ISVTX and user not in (0, there.st_uid, folder.st_uid):
        raise InputError(f"{path} cannot be written: in {target.parent} only its owner may replace it")


def check_output_folder(path: Path) -> None:
    """Refuse early, before long work, a folder that could not be made or written in."""
    with _refusing(path, "cannot be made a folder", ValueError):
        _check_name(path)
        there = _existing(path)
        if not there.is_dir():
            kind = "a file" if there.is_file() else "no folder"
            raise InputError(f"{path} cannot be made a folder: {there} is {kind}; expected a new path")
        if not os.access(there, os.W_OK):
            raise InputError(f"no permission to write in the folder {there}")


def make_output_folder(path: Path) -> None:
    """Create the folder and its parents."""
    check_output_folder(path)
    with _refusing(path, "cannot be made a folder"):
        path.mkdir(parents=True, exist_ok=True)


def remove_empty_folders(path: Path) -> None:
    """Remove a folder that holds nothing but folders; files, and the folders they lie in, stay."""
    for folder, _, _ in os.walk(path, topdown=False):
        if not os.listdir(folder):
            os.rmdir(folder)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary path whose file takes the place of `path` only when the block ends well.

    It has the name of `path`, in a folder of its own beside it. A file that is there keeps its mode; where
    `path` is a link, what it leads to is replaced. On the disk is the old file or the new one, whatever
    happens: what a process that was killed left is removed when the next file is written there.

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
        with _signals_later():
            (folder / path.name).replace(_target(path))
        with suppress(OSError):
            _sync(_target(path).parent)


@contextmanager
def whole_folder(path: Path, earlier: Iterable[str] = ()) -> Iterator[Path]:
    """A temporary folder whose files take their places in `path`, one behind the other, when the block ends
    well.

    A folder that is new appears with all of them at once. One that is there keeps its other files.

    Args:
        earlier: names of files of an earlier run, which are removed where the block wrote none.
    """
    check_output_folder(path)
    with _refusing(path, "was not written"), temporary_folder(_existing(path)) as folder:
        yield folder
        names = sorted(file.name for file in folder.iterdir())
        for name in names:
            if path.is_dir():
                check_output_file(path / name)
            _finish(folder / name, path / name)
        with _signals_later():
            if not path.is_dir():
                path.parent.mkdir(parents=True, exist_ok=True)
                mode = _mode_of_new(folder)
                with suppress(OSError):  # another process made one meanwhile
                    folder.rename(path)
                    path.chmod(mode)  # no sooner: one that may not be written in could not be moved
            for name in names if folder.is_dir() else ():
                (folder / name).replace(_target(path / name))
            for name in {*earlier} - {*names}:
                (path / name).unlink(missing_ok=True)
        for place in (path, path.parent):
            with suppress(OSError):
                _sync(place)


def remove_temporaries() -> None:
    """Remove what this process has half written, before it ends at once."""
    for folder in list(_temporary):
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """A folder of this process's own in `parent`, locked while it is in use; removed behind the block, also
    by `remove_temporaries`, or after a kill by the next one in `parent`.
    """
    # the name, which a folder has from its first moment on, says that it is ours, and of this host: locks of
    # a network file system may hold on one host only
    for left in parent.glob(f"{HERE}{'?' * 8}"):  # of tempfile
        if left.is_dir() and not left.is_symlink():
            with _locked(left, wait=False) as abandoned:  # the system took the lock of a process it killed
                if abandoned:
                    shutil.rmtree(left, ignore_errors=True)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=HERE, dir=parent))
        _temporary.add(folder)
        with suppress(FileNotFoundError):  # as below
            folder.chmod(0o700)  # whatever the umask
        with _locked(folder):
            if not folder.is_dir():  # another took it for abandoned before it was locked
                continue
            try:
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)
                _temporary.discard(folder)
            return


@contextmanager
def _locked(folder: Path, wait: bool = True) -> Iterator[bool]:
    """Lock a folder: whether it is, and not where another has it, or the system knows no locks."""
    place: int | None = None
    locked = False
    try:
        with suppress(OSError, AttributeError):
            place = os.open(folder, os.O_RDONLY)
            fcntl.flock(place, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            locked = True
        yield locked
    finally:
        if place is not None:
            os.close(place)


def _finish(written: Path, path: Path) -> None:
    """Have the disk hold a file that is to take the place of `path`, with the mode of what is there.

    Its owner as well, where that is allowed.
    """
    written.chmod(0o600)  # whatever the umask
    _sync(written)
    mode = _mode_of_new(written.parent) & 0o666  # some writers make private files
    with suppress(FileNotFoundError):
        old = path.stat()
        mode = stat.S_IMODE(old.st_mode)
        with suppress(OSError, AttributeError):
            os.chown(written, old.st_uid, old.st_gid)
    written.chmod(mode)


def _sync(path: Path) -> None:
    """Have the disk hold a file, or the names in a folder where the system can be asked to."""
    place = os.open(path, os.O_RDONLY)
    try:
        os.fsync(place)
    finally:
        os.close(place)


@contextmanager
def _signals_later() -> Iterator[None]:
    """Signals that a process may handle are handled behind the block, which is short."""
    came: list[int] = []
    ours = threading.current_thread() is threading.main_thread()  # the only one that handles signals
    kept = {number: signal.getsignal(number) for number in SIGNALS if ours}
    kept = {number: handler for number, handler in kept.items() if callable(handler)}
    for number in kept:
        signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
        for number in came:
            signal.raise_signal(number)


@contextmanager
def _refusing(path: Path, what: str, also: type[Exception] = OSError) -> Iterator[None]:
    """What the system refuses, an OSError or `also`, in one line."""
    try:
        yield
    except InputError:
        raise
    except (OSError, also) as error:
        raise InputError(f"{path} {what}: {getattr(error, 'strerror', None) or error}") from error


def _target(path: Path) -> Path:
    """Where writing to a path goes: through links."""
    return Path(os.path.realpath(path))


def _existing(path: Path) -> Path:
    """The path, or the nearest of its parents, that is there, be it as a link that leads nowhere."""
    return next((place for place in (path, *path.parents) if os.path.lexists(place)), path)


def _check_name(path: Path) -> None:
    if "\0" in str(path):
        raise ValueError("there is a null character in it")
    longest = max((len(os.fsencode(part)) for part in path.parts), default=0)
    length = len(os.fsencode(path.absolute()))
    if longest > LONGEST_NAME or length > LONGEST_PATH:
        expected = f"at most {LONGEST_NAME}, {LONGEST_PATH} in all"
        raise InputError(f"{path} has a name of {longest} bytes, {length} in all; expected {expected}")


def _mode_of_new(folder: Path) -> int:
    """The mode of a folder that is made; asking the system for its mask would change that for a moment."""
    fresh = Path(tempfile.mktemp(dir=folder))  # a name that no file in it has; the folder is our own
    fresh.mkdir()
    mode = fresh.stat().st_mode & 0o777
    fresh.rmdir()
    return mode
