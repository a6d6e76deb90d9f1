"""`python -m tests.processors [NAME ...]`: the tests that compare figures, as several processors run them.

Libraries choose their kernels by the processor, and divide sums by the threads, so that another machine
rounds otherwise. All processors that this one can imitate, or those named, run with one and with two threads.
Exit status 1: a test failed somewhere.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path

from benchmarks.spread import THREADS, environment_of, imitable

TESTS = Path(__file__).parent
WHOLE = ("test_golden.py", "test_readme_figures.py")  # files, the second although it is marked `figures`
CLOSE = re.compile(r"approx|allclose|assert_close|[ar]tol\b|close\(")


def compares_figures(test: ast.FunctionDef) -> bool:
    """Whether a test allows for rounding, or compares with a share or another literal that is not whole.

    Those marked `figures` would take hours.
    """
    text = ast.unparse(test)
    literals = (
        part.value
        for compare in ast.walk(test)
        if isinstance(compare, ast.Compare)
        for part in ast.walk(compare)
        if isinstance(part, ast.Constant)
    )
    shares = any(isinstance(value, float) and not value.is_integer() for value in literals)
    return "@pytest.mark.figures" not in text and (shares or bool(CLOSE.search(text)))


def chosen() -> Iterator[str]:
    """The tests, as pytest names them."""
    for path in sorted(TESTS.rglob("test_*.py")):
        if path.name in WHOLE:
            yield str(path)
            continue
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test") and compares_figures(node):
                yield f"{path}::{node.name}"


def run(processor: str, threads: int, tests: Path, more: list[str]) -> subprocess.CompletedProcess[str]:
    """Runs the tests that a file lists, as one processor."""
    words = ["-n", str(os.cpu_count()), "--dist", "loadfile", "--tb", "line", "-m", "", "-rfE", *more]
    return subprocess.run(
        [sys.executable, "-m", "pytest", *words, f"@{tests}"],
        cwd=TESTS.parent,
        env=os.environ | environment_of(processor, threads) | {"DEJAVU_TEST_THREADS": str(threads)},
        capture_output=True,
        text=True,
    )


def main() -> int:
    given, _, more = " ".join(sys.argv[1:]).partition(" -- ")
    parser = argparse.ArgumentParser(prog="python -m tests.processors", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of {', '.join(imitable())}")
    parser.add_argument("--threads", type=int, nargs="+", default=THREADS, help="1 and 2 unless given")
    parser.add_argument("--list", action="store_true", help="print the tests, and run none")
    options = parser.parse_args(given.split())
    tests = "\n".join(chosen())
    if options.list:
        print(tests)
        return 0
    if unknown := set(options.names) - set(imitable()):
        parser.error(
            f"{', '.join(unknown)}: expected some of {', '.join(imitable())}, whose kernels run here"
        )
    failed = False
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as listed:
        print(tests, file=listed, flush=True)
        for processor, threads in product(options.names or imitable(), options.threads):
            began = time.monotonic()
            done = run(processor, threads, Path(listed.name), more.split())
            lines = (done.stdout.strip() or done.stderr.strip() or "nothing was printed").splitlines()
            took = f"{time.monotonic() - began:.0f} s"
            print(f"{processor}, {threads} thread{'s' * (threads > 1)}: {lines[-1]} ({took})")
            print(
                *(f"  {line}" for line in lines if line.startswith(("FAILED", "ERROR"))), sep="\n", flush=True
            )
            failed = failed or done.returncode != 0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
