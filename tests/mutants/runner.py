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
import importlib
import os
import shutil
import signal
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue

from .by_reader import MUTANTS as BY_READER
from .by_tester import MUTANTS as BY_TESTER

ROOT = Path(__file__).parents[2]
FOLDERS, FILES = ("dejavu_torch", "benchmarks", "configs", "tests", "docs"), ("README.md", "CONTRIBUTING.md")
MUTANTS = [*BY_READER, *BY_TESTER]
SLOW_IMPORTS = ("torch", "kornia", "numpy", "pytest", "hypothesis", "PIL.Image", "safetensors.torch")
LIMIT = 120  # seconds; a mutant whose tests take longer counts as killed
PYTEST = ("-o", "addopts=", "-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--tb=line")


def problem(mutant):
    """Why a mutant does not apply; empty where it does."""
    path = ROOT / mutant.file
    if not path.is_file():
        return f"{mutant.file} is not there"
    text = path.read_text()
    if text.count(mutant.old) != 1:
        return f"{mutant.old!r} occurs {text.count(mutant.old)} times in {mutant.file}"
    if mutant.old == mutant.new:
        return "it changes nothing"
    try:
        compile(text.replace(mutant.old, mutant.new), mutant.file, "exec")
    except SyntaxError as error:
        return f"what it makes is no Python: {error}"
    return ""


def copied(copy):
    """A copy of the working tree."""
    for name in FOLDERS:
        shutil.copytree(ROOT / name, copy / name)
    for name in (*FILES, "pyproject.toml"):
        shutil.copy2(ROOT / name, copy / name)
    return copy


def rewrite(path, text):
    """Write a module, and forget what Python and numba compiled of it."""
    for stale in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
        stale.unlink()
    path.write_text(text)


def outcome(tests, copy, log):
    """Exit status of pytest of these tests in a copy: 0 if all pass, 1 if one fails; 124 out of time.

    `file::name` are run together, `file::-k EXPRESSION` each alone.
    """
    named = [one for one in tests if "::-k " not in one]
    chosen = [one.partition("::-k ") for one in tests if "::-k " in one]
    for words in [named] * bool(named) + [[file, "-k", expression] for file, _, expression in chosen]:
        child = os.fork()
        if child == 0:
            _run_tests(words, copy, log)
        late = time.monotonic() + LIMIT
        while True:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                break
            if time.monotonic() > late:
                os.killpg(child, signal.SIGKILL)
                os.waitpid(child, 0)
                return 124
            time.sleep(0.05)
        if status:
            return os.waitstatus_to_exitcode(status) & 255
    return 0


def _run_tests(words, copy, log):
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

        status = int(pytest.main([*PYTEST, *words]))
    finally:
        sys.stdout.flush()
        os._exit(status)


def judged(mutant, copy, log, unchanged):
    """Whether all is well with a mutant in a copy, and what becomes of it."""
    why = problem(mutant)
    if why:
        return False, f"DOES NOT APPLY: {why}"
    path, text = copy / mutant.file, (ROOT / mutant.file).read_text()
    rewrite(path, text if unchanged else text.replace(mutant.old, mutant.new))
    try:
        status = outcome(mutant.tests, copy, log)
    finally:
        rewrite(path, text)
    if unchanged:
        return status == 0, f"FAILS UNCHANGED ({status})" if status else "passes"
    told = {0: "SURVIVED", 1: "killed", 124: "killed"}
    return status in (1, 124), told.get(status, f"NO TESTS ({status})")


def chosen(words):
    """Numbers of mutants, from 1: `12`, `40-50`; all without any."""
    numbers = []
    for word in words:
        first, dash, last = word.partition("-")
        numbers += range(int(first), int(last if dash else first) + 1)
    if numbers and not 1 <= min(numbers) <= max(numbers) <= len(MUTANTS):
        raise SystemExit(f"mutants {' '.join(words)}; expected 1 to {len(MUTANTS)}")
    return numbers or list(range(1, len(MUTANTS) + 1))


def main():
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
        wrong = {n: problem(MUTANTS[n - 1]) for n in numbers if problem(MUTANTS[n - 1])}
        for n, why in wrong.items():
            print(f"{n:3} {why}")
        print(f"{len(numbers)} mutants, {len(wrong)} do not apply")
        return int(bool(wrong))
    os.environ["OMP_NUM_THREADS"] = "1"
    for name in SLOW_IMPORTS:
        importlib.import_module(name)
    free = SimpleQueue()

    def run(number):
        copy, start = free.get(), time.monotonic()
        try:
            log = (given.log or copy / "tests.log").resolve()
            well, told = judged(MUTANTS[number - 1], copy, log, given.unchanged)
        finally:
            free.put(copy)
        line = f"{number:3} {told:9} {time.monotonic() - start:5.1f} s  {MUTANTS[number - 1].sentence}"
        return number, well, line

    began, failed = time.monotonic(), []
    with (
        tempfile.TemporaryDirectory(prefix="mutants-") as folder,
        ThreadPoolExecutor(given.processes) as pool,
    ):
        for i in range(given.processes):
            free.put(copied(Path(folder) / str(i)))
        for number, well, line in pool.map(run, numbers):
            failed += [str(number)] * (not well)
            print(line, flush=True)
    took = time.monotonic() - began
    print(f"{len(numbers)} mutants in {took:.0f} s, {len(failed)} not killed: {' '.join(failed)}")
    return int(bool(failed))
