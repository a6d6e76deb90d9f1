"""`dejavu`: every stage as a command."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import NoReturn

from dejavu_torch import __version__
from dejavu_torch.cli import process
from dejavu_torch.cli.names import COMMANDS, FIRST_DAY, function_of
from dejavu_torch.text import one_line, printable

SPINS = "10000"  # some ten microseconds
LONGEST = 300  # characters kept of torch's messages


def main(
    arguments: Sequence[str] | None = None, program: Callable[[Sequence[str]], None] | None = None
) -> None:
    """Entry point of `dejavu` and of `python -m benchmarks`.

    Args:
        program: runs a command line; that of `dejavu` by default.

    Environment: OMP_NUM_THREADS, the number of threads of torch. Unless OMP_WAIT_POLICY is set, its threads
        wait for work a few microseconds, then sleep: those that spin for long, the default of most builds,
        take the cores from other programs, and to wake one takes longer than most of its work.
    """
    if arguments is None:
        process.take_over()
    if "OMP_WAIT_POLICY" not in os.environ:  # read when torch is loaded, which is below
        os.environ["OMP_WAIT_POLICY"] = "passive"
        os.environ.setdefault("GOMP_SPINCOUNT", SPINS)  # GNU's, of the torch for Linux
    try:
        with _shortages_of_one_line():
            (program or run_command)(sys.argv[1:] if arguments is None else arguments)
        _check_output()
    except SystemExit as error:
        if not error.code:
            _check_output()
        raise
    except BaseException as error:
        process.end_if_interrupted(error)
        raise
    finally:
        process.let_go()


@contextmanager
def _shortages_of_one_line() -> Iterator[None]:
    """In the block a lack of memory, or too deep a recursion, ends the command with one line."""
    try:
        yield
    except (MemoryError, RuntimeError, ImportError, OSError) as error:
        text = one_line(str(error))
        if isinstance(error, RecursionError):
            fail(f"nested too deeply: {text}")
        phrases = ("an't allocate memory", "annot allocate memory", "out of memory")
        if not isinstance(error, MemoryError) and not any(phrase in text for phrase in phrases):
            raise
        fail(f"not enough memory: {text.rpartition('DefaultCPUAllocator: ')[2][:LONGEST] or 'it ran out'}")


@contextmanager
def errors_of_one_line(given: Sequence[str]) -> Iterator[None]:
    """In the block, which imports torch, errors in the command line or in files end it with one line."""
    _log_to_stderr()
    try:
        os.getcwd()
    except FileNotFoundError:  # which would crash some libraries
        fail("the current folder no longer exists; expected one that does")
    from dejavu_torch.cli.messages import UsageError
    from dejavu_torch.data.output import remove_temporaries
    from dejavu_torch.types import InputError

    process.cleanup[:] = [remove_temporaries]
    try:
        yield
    except UsageError as error:
        config = [value for name, value in pairwise(given) if name == "--config"]
        fail(f"{error} (with --config {' --config '.join(config)})" if config else f"{error} (see --help)")
    except (InputError, OSError) as error:
        fail(str(error))


def run_command(given: Sequence[str]) -> None:
    """Run a command of `dejavu`."""
    if not given or given[0] not in COMMANDS:
        overview(given[0] if given else "--help")
    with errors_of_one_line(given):
        from dejavu_torch.cli.parser import COMMAND, parse  # and with it torch, which takes seconds to import

        name, words = given[0], given[1:]
        if name == "train":  # Lightning's own command line
            from dejavu_torch.cli.train import run_train

            run_train(words)
            return
        function = function_of(name)
        chosen = parse(name, function, words)
        if COMMAND in function.__annotations__:
            chosen[COMMAND] = shlex.join(["dejavu", *given])
        function(**chosen)


def _log_to_stderr() -> None:
    """Print messages and warnings of all libraries as lines of ours."""
    import logging
    import warnings

    class OneLine(logging.Formatter):
        def format(self, record: logging.LogRecord) -> str:
            return printable(one_line(super().format(record)))

    handler = logging.StreamHandler()
    handler.setFormatter(OneLine("dejavu: %(message)s"))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)
    logging.getLogger("PIL").setLevel(logging.CRITICAL)  # our errors quote it
    log = logging.getLogger("dejavu_torch")
    warnings.showwarning = lambda message, *_, **__: log.warning("%s", message)


def _check_output() -> None:
    problem = process.output_problem()
    if not isinstance(problem, BrokenPipeError | None):
        fail(f"the printed output is incomplete: {problem.strerror}")


def overview(word: str) -> NoReturn:
    """Print version, help or an error for a first word that is no command, and exit."""
    if word == "--version":
        print(f"dejavu_torch {__version__}")
    elif word in ("--help", "-h"):
        print("usage: dejavu COMMAND ...\n\nFind where on a known route each image was taken.")
        more = [name for name in COMMANDS if name not in FIRST_DAY]
        for heading, names in (("commands", FIRST_DAY), ("more", more)):
            print(f"\n{heading}:", *(f"  {name:<10}  {COMMANDS[name]}" for name in names), sep="\n")
        print("\n`dejavu COMMAND --help` shows its options, `dejavu --version` the version.")
    elif word == "bench":
        where = "in a clone of the repository, after pip install '.[bench]'"
        fail(f"the benchmarks are not part of the package; expected `python -m benchmarks` {where}")
    else:
        fail(f"{word!r} is no command; expected one of {', '.join(COMMANDS)} (see --help)")
    raise SystemExit(0)


def fail(message: str) -> NoReturn:
    """Print one line on stderr and exit with status 2."""
    print(f"dejavu: {printable(one_line(message))}", file=sys.stderr)
    raise SystemExit(2)
