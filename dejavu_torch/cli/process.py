"""The command as a process: its standard streams, and the signals that end it.

Little is imported here, so that signals are handled before slow imports.
"""

from __future__ import annotations

import io
import os
import signal
import sys
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import FrameType
    from typing import NoReturn

    from _typeshed import ReadableBuffer

INTERRUPTED = "dejavu: interrupted\n"
ENDING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
cleanup: list[Callable[[], None]] = []  # called before a signal ends the process
_state = {"process": 0, "interrupted": 0}  # the process id of the command; whether Ctrl-C was raised


class Stream(io.FileIO):
    """A standard stream that ignores writes after the first failure: a command still writes its files."""

    problem: OSError | None = None

    def write(self, data: ReadableBuffer, /) -> int:
        """Write, or do nothing after a failure."""
        if self.problem is None:
            try:
                return super().write(data)
            except OSError as error:
                self.problem = error
        return memoryview(data).nbytes


def take_over() -> None:
    """Handle signals and standard streams, if the command is the process and not a call in a program."""
    _state["process"] = os.getpid()
    for number in ENDING:
        if signal.getsignal(number) != signal.SIG_IGN:  # set by nohup, or by a shell's &
            signal.signal(number, stop)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = getattr(sys, name)
        if stream is None:  # closed: no file may get its number
            os.dup2(os.open(os.devnull, os.O_RDWR), number)
        if name != "stdin" and stream is getattr(sys, f"__{name}__"):
            lines = stream is None or stream.line_buffering or stream.write_through
            encoding = "utf-8" if stream is None else stream.encoding
            buffer = io.BufferedWriter(Stream(number, "w", closefd=False))
            setattr(sys, name, io.TextIOWrapper(buffer, encoding, "backslashreplace", line_buffering=lines))


def output_problem() -> OSError | None:
    """Flush stdout; why printed text was lost, a BrokenPipeError if its reader left, as `| head` does."""
    sys.stdout.flush()
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    return raw.problem if isinstance(raw, Stream) else None


def let_go() -> None:
    """Let no Ctrl-C interrupt the end of the interpreter."""
    if _state["process"]:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        for number in ENDING[1:]:
            signal.signal(number, signal.SIG_DFL)


def stop(number: int, frame: FrameType | None = None) -> NoReturn:
    """Handle a signal: end immediately, with one line after Ctrl-C.

    An exception would pass through imports, extensions and destructors that convert or swallow it.
    """
    if os.getpid() != _state["process"]:  # a worker that was forked
        os._exit(128 + number)
    for one in ENDING:
        signal.signal(one, signal.SIG_IGN)
    for work in cleanup:
        work()
    if number == signal.SIGINT:
        with suppress(OSError):
            os.write(2, b"\n" * os.isatty(2) + INTERRUPTED.encode())  # below ^C or a progress bar
    for one in ENDING:  # a flush may wait for the reader
        signal.signal(one, signal.SIG_DFL)
    with suppress(Exception):  # as in the middle of a print
        sys.stdout.flush()
    os._exit(128 + number)


@contextmanager
def interrupts_raise() -> Iterator[None]:
    """In the block Ctrl-C raises KeyboardInterrupt, for work that keeps its results when interrupted."""
    if signal.getsignal(signal.SIGINT) != stop:
        yield
        return
    signal.signal(signal.SIGINT, _raise)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, stop)


def _raise(number: int, frame: FrameType | None) -> NoReturn:
    signal.signal(number, stop)  # if this exception is swallowed, the next Ctrl-C ends the process
    _state["interrupted"] = 1
    raise KeyboardInterrupt


def end_if_interrupted(error: BaseException) -> None:
    """End as after Ctrl-C if the exception is one or followed one, as extensions convert it."""
    if not isinstance(error, KeyboardInterrupt) and not _state["interrupted"]:
        return
    if _state["process"]:
        stop(signal.SIGINT)
    sys.stderr.write(INTERRUPTED)
    raise SystemExit(128 + signal.SIGINT) from None
