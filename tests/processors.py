"""`python -m tests.processors [NAME ...]`: the tests that compare figures, as several processors run them.

Libraries choose their kernels by the processor, and divide sums by the threads, so that another machine
rounds otherwise. All processors that this one can imitate, or those named, run with one and with two threads.
With `--part` they run a part that takes half a minute. Exit status 1: a test failed somewhere.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import subprocess
import sys
import time
from itertools import product
from pathlib import Path

import torch

from benchmarks.spread import PROCESSORS, THREADS, environment_of, imitable

TESTS = Path(__file__).parent
FIGURES = "test_readme_figures.py"  # of the whole demo, which takes minutes: once, on this processor
WHOLE = ("test_golden.py", FIGURES)
# a sixth of the time, for what one machine computes twice
ALIKE = ("test_notebooks.py", "test_several_processes.py")
# what finds places and what scores them, where rounding decides first; the other files of these folders,
# of calibration and of large maps, take as long as all of these
PART = {
    "recognition": "centring coarse drive evidence filter matcher motion search select sequence smoother",
    "maps": "codec distance file l1 scores spectral spectral_map spectrum template_map templates weights",
}
CLOSE = re.compile(r"approx|allclose|assert_close|[ar]tol\b|close\(")


def compares_figures(test):
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


def chosen():
    """The files and names of the tests."""
    for path in sorted(TESTS.rglob("test_*.py")):
        if path.name in ALIKE or path.parent.name == "benchmarks":
            continue
        for node in ast.parse(path.read_text()).body:
            test = isinstance(node, ast.FunctionDef) and node.name.startswith("test")
            if test and (path.name in WHOLE or compares_figures(node)):
                yield path, node.name


def pytest_collection_modifyitems(config, items):
    """As a plugin of pytest: leaves the chosen tests."""
    tests = set(chosen())
    others = [item for item in items if (item.path, item.originalname) not in tests]
    config.hook.pytest_deselected(items=others)
    items[:] = [item for item in items if (item.path, item.originalname) in tests]


def part():
    """The files of the part. All quick tests in them run: exact results hold on any processor, too."""
    named = ((folder, name) for folder, names in PART.items() for name in names.split())
    return [str(TESTS / folder / f"test_{name}.py") for folder, name in named]


def run(processor, threads, more, only_part=False):
    """Runs the chosen tests, or the part, as one processor."""
    words = ["-n", str(os.cpu_count()), "--dist", "loadfile", "--tb", "line", "-rfE"]
    once = (processor, threads) == ("this", 1)
    if only_part:
        words += ["-m", "not slow and not figures", *more, *part()]
    else:
        files = sorted({str(path) for path, _ in chosen() if once or path.name != FIGURES})
        words += ["-p", "tests.processors", "-m", "", *more, *files]
    return subprocess.run(
        [sys.executable, "-m", "pytest", *words],
        cwd=TESTS.parent,
        env=os.environ | environment_of(processor, threads) | {"DEJAVU_TEST_THREADS": str(threads)},
        capture_output=True,
        text=True,
    )


def main():
    given, _, more = " ".join(sys.argv[1:]).partition(" -- ")
    parser = argparse.ArgumentParser(prog="python -m tests.processors", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of {', '.join(imitable())}")
    parser.add_argument("--threads", type=int, nargs="+", default=THREADS, help="1 and 2 unless given")
    parser.add_argument("--part", action="store_true", help="only some quick tests, for half a minute")
    parser.add_argument("--list", action="store_true", help="print the tests, and run none")
    options = parser.parse_args(given.split())
    if options.list:
        print(*(part() if options.part else (f"{path}::{name}" for path, name in chosen())), sep="\n")
        return 0
    here = imitable()
    if options.part and options.names and set(options.names) <= PROCESSORS.keys() - set(here):
        print(f"{', '.join(options.names)}: skipped, kernels that do not run here")
        return 0
    if unknown := set(options.names) - set(here):
        parser.error(f"{', '.join(unknown)}: expected some of {', '.join(here)}, whose kernels run here")
    own = torch.backends.cpu.get_cpu_capability().lower()  # which is this one
    failed, names = False, options.names or [name for name in here if name != own]
    for processor, threads in product(names, options.threads):
        began = time.monotonic()
        done = run(processor, threads, more.split(), options.part)
        lines = (done.stdout.strip() or done.stderr.strip() or "nothing was printed").splitlines()
        took = f"{time.monotonic() - began:.0f} s"
        print(f"{processor}, {threads} thread{'s' * (threads > 1)}: {lines[-1]} ({took})")
        print(*(f"  {line}" for line in lines if line.startswith(("FAILED", "ERROR"))), sep="\n", flush=True)
        failed = failed or done.returncode != 0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
