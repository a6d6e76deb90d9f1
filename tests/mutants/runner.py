"""Breaks one sentence of behaviour after another, and tells which of them no test notices.

    python -m tests.mutants              all of them, in two processes
    python -m tests.mutants 12 40-50     some
    python -m tests.mutants --check      only whether each text occurs exactly once
    python -m tests.mutants --unchanged  the tests that mutants name, on the code as it is: all must pass

Each mutant is applied in a copy of the working tree, never in the tree itself, and only the tests named
beside it run, in a process of their own forked from one that has imported what is slow to import.
Exit status 1: a mutant survived, does not apply, or names tests that are not there.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue

from .by_reader import MUTANTS as BY_READER
from .by_tester import MUTANTS as BY_TESTER
from .mutant import Mutant

ROOT = Path(__file__).parents[2]
COPIED = (
    "dejavu_torch",
    "benchmarks",
    "configs",
    "tests",
    "docs",
    "README.md",
    "CONTRIBUTING.md",
    "pyproject.toml",
)
MUTANTS: list[Mutant] = [*BY_READER, *BY_TESTER]
SLOW_IMPORTS = ("torch", "kornia", "numpy", "pytest", "hypothesis", "PIL.Image", "safetensors.torch")
LIMIT = 120  # seconds; a mutant whose tests take longer counts as killed
KILLED, SURVIVED, NO_TESTS, IN_VAIN = "killed", "SURVIVED", "NO TESTS", "DOES NOT APPLY"


def problem(mutant: Mutant) -> str:
    """Why a mutant does not apply; empty where it does."""
    path = ROOT / mutant.file
    if not path.is_file():
        return f"{mutant.file} is not there"
    text = path.read_text()
    found = text.count(mutant.old)
    if found != 1:
        return f"{mutant.old!r} occurs {found} times in {mutant.file}"
    if mutant.old == mutant.new:
        return "it changes nothing"
    try:
        compile(text.replace(mutant.old, mutant.new), mutant.file, "exec")
    except SyntaxError as error:
        return f"what it makes is no Python: {error}"
    return ""


@contextlib.contextmanager
def copies(count: int) -> Iterator[list[Path]]:
    """So many copies of the working tree, in a temporary folder."""
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        made = [Path(folder) / str(i) for i in range(count)]
        for copy in made:
            copy.mkdir()
            for name in COPIED:
                source = ROOT / name
                (shutil.copytree if source.is_dir() else shutil.copy2)(source, copy / name)
        yield made


@contextlib.contextmanager
def applied(mutant: Mutant, copy: Path) -> Iterator[None]:
    """In the block a copy has the mutant."""
    path = copy / mutant.file
    text = path.read_text()
    for stale in (path.parent / "__pycache__").glob(f"{path.stem}.*"):  # also what numba compiled
        stale.unlink()
    try:
        path.write_text(text.replace(mutant.old, mutant.new))
        yield
    finally:
        path.write_text(text)
        for stale in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
            stale.unlink()


def words_of(tests: Sequence[str]) -> list[list[str]]:
    """Arguments of pytest for tests: `file::name` are run together, `file::-k EXPRESSION` each alone."""
    named = [one for one in tests if "::-k " not in one]
    chosen = [one.partition("::-k ") for one in tests if "::-k " in one]
    return [named] * bool(named) + [[file, "-k", expression] for file, _, expression in chosen]


def outcome(tests: Sequence[str], copy: Path, log: Path) -> int:
    """Exit status of pytest of these tests in a copy: 0 if all pass, 1 if one fails; 124 out of time."""
    for words in words_of(tests):
        child = os.fork()
        if child == 0:
            _run_tests(words, copy, log)
        status = _wait(child)
        if status:
            return status
    return 0


def _run_tests(words: list[str], copy: Path, log: Path) -> None:
    """In a forked process: the tests of a copy; ends the process."""
    status = 70
    try:
        os.setsid()
        os.chdir(copy)
        os.environ["PYTHONPATH"] = str(copy)
        sys.path[:] = [str(copy)] + [one for one in sys.path if Path(one or ".").resolve() != ROOT]
        for name in [one for one in sys.modules if one.partition(".")[0] in ("dejavu_torch", "tests")]:
            del sys.modules[name]
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(file, 1)
        os.dup2(file, 2)
        import pytest

        plain = ["-o", "addopts=", "-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--tb=line"]
        status = int(pytest.main([*plain, *words]))
    finally:
        sys.stdout.flush()
        os._exit(status)


def _wait(child: int) -> int:
    """The exit status of a child; 124 where it took too long, and was ended."""
    began = time.monotonic()
    while time.monotonic() < began + LIMIT:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) & 255
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return 124


def judged(mutant: Mutant, copy: Path, log: Path, unchanged: bool) -> str:
    """What becomes of a mutant in a copy."""
    why = problem(mutant)
    if why:
        return f"{IN_VAIN}: {why}"
    if unchanged:
        status = outcome(mutant.tests, copy, log)
        return "passes" if status == 0 else f"FAILS UNCHANGED ({status})"
    with applied(mutant, copy):
        status = outcome(mutant.tests, copy, log)
    if status == 0:
        return SURVIVED
    return KILLED if status in (1, 124) else f"{NO_TESTS} ({status})"


def chosen(words: Sequence[str]) -> list[int]:
    """Numbers of mutants, from 1: `12`, `40-50`; all without any."""
    numbers: list[int] = []
    for word in words:
        first, dash, last = word.partition("-")
        numbers += range(int(first), int(last if dash else first) + 1)
    outside = [n for n in numbers if not 1 <= n <= len(MUTANTS)]
    if outside:
        raise SystemExit(f"there is no mutant {outside[0]}; expected 1 to {len(MUTANTS)}")
    return numbers or list(range(1, len(MUTANTS) + 1))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("mutants", nargs="*", help="numbers, or ranges of them; all if none is given")
    parser.add_argument("--check", action="store_true", help="only whether all apply")
    parser.add_argument("--unchanged", action="store_true", help="run the tests on the code as it is")
    parser.add_argument("--processes", type=int, default=2, help="how many at a time")
    parser.add_argument("--log", type=Path, help="file that what the tests print is appended to")
    given = parser.parse_args()
    numbers = chosen(given.mutants)
    if given.check:
        wrong = [(n, problem(MUTANTS[n - 1])) for n in numbers if problem(MUTANTS[n - 1])]
        for n, why in wrong:
            print(f"{n:3} {why}")
        print(f"{len(numbers)} mutants, {len(wrong)} do not apply")
        return int(bool(wrong))
    os.environ["OMP_NUM_THREADS"] = "1"
    for name in SLOW_IMPORTS:
        importlib.import_module(name)
    began, found = time.monotonic(), {}
    with copies(given.processes) as made, ThreadPoolExecutor(given.processes) as pool:
        free: SimpleQueue[Path] = SimpleQueue()
        for copy in made:
            free.put(copy)

        def run(number: int) -> tuple[int, str, float]:
            copy, start = free.get(), time.monotonic()
            log = given.log or copy / "tests.log"
            try:
                told = judged(MUTANTS[number - 1], copy, log.resolve(), given.unchanged)
            finally:
                free.put(copy)
            return number, told, time.monotonic() - start

        for number, told, seconds in pool.map(run, numbers):
            found[number] = told
            mutant = MUTANTS[number - 1]
            print(f"{number:3} {told:9} {seconds:5.1f} s  {mutant.sentence}", flush=True)
    wrong = [n for n, told in found.items() if told not in (KILLED, "passes")]
    took = time.monotonic() - began
    print(f"{len(found)} mutants in {took:.0f} s, {len(wrong)} not killed: {' '.join(map(str, wrong))}")
    return int(bool(wrong))
