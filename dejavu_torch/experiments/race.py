"""Programs that do the same work, timed side by side in one process."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import NamedTuple

from torch import Tensor
from tqdm import tqdm

Run = Callable[[], Tensor]

_PAGES = Path("/proc/self/statm")


class Runner(NamedTuple):
    """Someone who can do the work of a case.

    name: ours start with "dejavu". threads: that it may use. ready: imports what it needs and returns
    what does the work; a result with fewer rows than the case has stands for a part of the work.
    """

    name: str
    threads: int
    ready: Callable[[], Run]


class Row(NamedTuple):
    """What one contender took for one case; None where it is not known.

    seconds: for the whole case, best of the repeats. seconds_first: of the first run, with all that is
    loaded and compiled for it. ratio_to_ours: seconds over those of our fastest. peak_bytes: most
    memory held during a run beyond what was held before. bytes: of the result. difference: largest to
    our result. measured_rows: where only a part of the case was run: seconds and bytes are scaled up
    from it, seconds_first and peak_bytes are its own. skipped: why there are no figures.
    """

    case: str
    contender: str
    seconds: float | None = None
    seconds_first: float | None = None
    ratio_to_ours: float | None = None
    peak_bytes: int | None = None
    bytes: int | None = None
    threads: int | None = None
    difference: float | None = None
    measured_rows: int | None = None
    skipped: str | None = None


def race(case: str, ours: Runner, others: Sequence[Runner], repeats: int) -> list[Row]:
    """Time all in turn, round after round, and compare every result with ours.

    Convention: not counted are one run of each that loads and compiles, and one that watches memory.
        Another's error is a row that says so; one of `ours` is raised.
    """
    rows, runs = {}, {}
    expected: Tensor | None = None
    bar = tqdm(total=(1 + len(others)) * (1 + repeats), desc=case, disable=None, leave=False)
    for name, threads, ready in (ours, *others):
        bar.update()
        try:
            began = time.perf_counter()
            run = ready()
            result = run()
            first = time.perf_counter() - began
            peak = peak_memory(run)
            expected = result if expected is None else expected
            difference = float((result - expected[: len(result)]).abs().max())
        except Exception as error:  # whatever a contender stumbles over
            if expected is None:
                raise
            line = " ".join(str(error).split())
            rows[name] = Row(case, name, skipped=f"{type(error).__name__}: {line}"[:200])
            continue
        rows[name] = Row(
            case,
            name,
            seconds_first=first,
            peak_bytes=peak,
            bytes=result.nbytes * len(expected) // len(result),
            threads=threads,
            difference=difference,
            measured_rows=len(result) if len(result) < len(expected) else None,
        )
        runs[name] = run, len(expected) / len(result)
        del result  # it would hide what the next one needs
    best = dict.fromkeys(runs, inf)
    for _ in range(repeats):
        for name, (run, scale) in runs.items():
            began = time.perf_counter()
            run()
            best[name] = min(best[name], scale * (time.perf_counter() - began))
            bar.update()
    bar.close()
    fastest = min(seconds for name, seconds in best.items() if name.startswith("dejavu"))
    for name, seconds in best.items():
        rows[name] = rows[name]._replace(seconds=seconds, ratio_to_ours=seconds / fastest)
    return list(rows.values())


def peak_memory(run: Run) -> int | None:
    """Most bytes of resident memory during a run beyond those before it; None where nobody tells."""
    if not _PAGES.exists():
        return None
    before = most = _resident()
    done = threading.Event()

    def watch() -> None:
        nonlocal most
        while not done.wait(0.002):
            most = max(most, _resident())

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        result = run()
        last = _resident()  # with the result: who never lets go of Python's lock blinds the watcher
        del result
    finally:
        done.set()
        watcher.join()
    return max(most, last) - before


def _resident() -> int:
    return int(_PAGES.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
