"""Shared by all benchmarks: contenders, rows, time, memory, processes, and output."""

from __future__ import annotations

import ctypes
import gc
import json
import math
import os
import platform
import shlex
import signal
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

import dejavu_torch
from benchmarks.plots import plot_ratios
from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.data.output import whole_folder
from dejavu_torch.evaluation.plots import Plot
from dejavu_torch.evaluation.report import text_table
from dejavu_torch.maps.distance import l1_backend
from dejavu_torch.motion.resampling import ground_truth_of
from dejavu_torch.text import one_line
from dejavu_torch.types import InputError, Traverse

COMPARED = ("torch", "numpy", "numba", "scikit-image", "scipy", "faiss-cpu", "onnxruntime")
PROCESS = Path("/proc/self")
OURS = "dejavu"  # start of the names of our contenders

Row = dict[str, Any]  # a row of bench.json; unknown values are None
KEYS = (
    *("seconds", "seconds_first", "ratio_to_ours", "peak_bytes", "bytes", "threads", "difference"),
    *("measured_rows", "skipped", "recall_at_1", "file_bytes", "cpu_seconds"),
)
Column = tuple[str, str] | tuple[str, str, float]  # key of a row, format, unit
Run = Callable[[], Tensor]
Find = Callable[[Tensor], tuple[Tensor, Tensor]]  # queries -> best score, lower is better, and its place


class Contender(NamedTuple):
    """One of the alternatives that are measured; the names of ours start with "dejavu".

    prepare: imports what it needs and returns a function that does the work; its exceptions say why there are
    no figures. threads: the number it may use. family: of contenders that form one front.
    """

    name: str
    prepare: Callable[[], Callable[..., Any]]
    threads: int = 1
    family: str = ""


class Store(ABC):
    """A way to keep a route in a file and to find places on it, each in a process of its own."""

    def prepare(self, route: Traverse) -> float | None:
        """Choose settings by the route, outside of learning; returns the step of a map learned with one."""
        return None

    @abstractmethod
    def learn(self, route: Traverse, path: Path) -> int:
        """Write a route to a file; returns the bytes that grow with the route."""

    @abstractmethod
    def load(self, path: Path, device: str = "cpu") -> Find:
        """A function that finds queries in a file, on the device or, if it cannot use that, on the CPU."""


def new_row(case: str, contender: str, keys: Sequence[str] = KEYS, **facts: Any) -> Row:
    """A row with all keys, of which these facts are known."""
    return {"case": case, "contender": contender} | dict.fromkeys(keys) | facts


def some_of(known: Iterable[str], names: Sequence[str]) -> Sequence[str]:
    """Names, or all that are known; InputError if one is not."""
    known = [*known]
    for name in names:
        if name not in known:
            raise InputError(f"{name!r} is unknown; expected one of {', '.join(map(repr, known))}")
    return names or known


def failure(error: Exception) -> str:
    """What a row says about an error."""
    return f"{type(error).__name__}: {one_line(error)}"[:200]


@contextmanager
def threads(count: int) -> Iterator[None]:
    """In the block torch uses this many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def benchmark(case: str, contenders: Sequence[Contender], repeats: int) -> list[Row]:
    """Time all in turn, round after round, and compare every result with that of the first, which is ours.

    A result with fewer rows than the case is from a part of the work.

    Convention: two runs of each are not timed: one that loads and compiles, and one that measures memory. An
        error of the first contender is raised; errors of others become rows.

    Returns:
        seconds: for the whole case, best of the repeats. seconds_first: of the first run, including loading
        and compiling. ratio_to_ours: seconds over those of our fastest. peak_bytes: most memory held during a
        run, minus that before. bytes: of the result. difference: largest one to our result. measured_rows: if
        only a part of the case was run: seconds and bytes are scaled up from it, seconds_first and peak_bytes
        are not. skipped: why there are no figures.
    """
    rows = [new_row(case, one.name) for one in contenders]
    runs: list[tuple[Row, Run, float, int]] = []
    expected: Tensor | None = None
    for row, contender in tqdm(list(zip(rows, contenders, strict=True)), case, disable=None, leave=False):
        try:
            with threads(contender.threads):
                began = time.perf_counter()
                run = contender.prepare()
                result = run()
                row["seconds_first"] = time.perf_counter() - began
                row["peak_bytes"] = peak_memory(run)
            expected = result if expected is None else expected
            row["difference"] = float((result - expected[: len(result)]).abs().max())
        except Exception as error:  # another program may raise anything
            if expected is None:
                raise
            row |= new_row(case, contender.name, skipped=failure(error))
            continue
        scale = len(expected) / len(result)
        row |= {"bytes": round(result.nbytes * scale), "threads": contender.threads}
        row["measured_rows"] = len(result) if scale > 1 else None
        runs.append((row, run, scale, contender.threads))
        del result  # its memory would hide that of the next one
    for _ in range(repeats):
        for row, run, scale, count in runs:
            with threads(count):
                began = time.perf_counter()
                run()
                row["seconds"] = min(row["seconds"] or math.inf, scale * (time.perf_counter() - began))
    return with_ratios(rows)


def with_ratios(rows: Sequence[Row]) -> list[Row]:
    """The rows with their seconds over those of our fastest in the case, of the family `OURS` or none."""
    fastest: dict[str, float] = {}
    for row in rows:
        ours = row["contender"].startswith(OURS) and row.get("family", OURS) == OURS
        if ours and row["seconds"]:
            fastest[row["case"]] = min(row["seconds"], fastest.get(row["case"], math.inf))
    rated = []
    for row in rows:
        known = row["seconds"] and row["case"] in fastest
        rated.append(row | {"ratio_to_ours": row["seconds"] / fastest[row["case"]] if known else None})
    return rated


def peak_memory(run: Callable[[], object]) -> int | None:
    """Most bytes of memory during a run, minus those before it; None except on Linux."""
    try:
        (PROCESS / "clear_refs").write_text("5")  # Linux: resets the peak
    except OSError:
        run()
        return None
    before = resident()
    run()
    return resident("VmHWM") - before


def resident(what: str = "VmRSS") -> int:
    """Bytes of memory that this process holds now, or held at most ("VmHWM"), on Linux."""
    lines = (PROCESS / "status").read_text().splitlines()
    return 1024 * int(next(line.split()[1] for line in lines if line.startswith(what)))


def give_back() -> None:
    """Return free memory of the heap to the system, if its C library can."""
    gc.collect()
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


def in_process(module: str, arguments: object) -> dict[str, Any]:
    """The JSON that a module prints when it is run on arguments; if it fails, the reason as `skipped`."""
    # without the current folder (from Python 3.11 on), but with the same search path
    search = os.pathsep.join(filter(None, sys.path))
    done = subprocess.run(
        [sys.executable, "-m", module, json.dumps(arguments)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": search, "PYTHONSAFEPATH": "1"},
        preexec_fn=end_with_parent if sys.platform == "linux" else None,
    )
    if done.returncode < 0:
        return {"skipped": f"ended by signal {-done.returncode}, perhaps for lack of memory"}
    if done.returncode:
        return {"skipped": (done.stderr.strip().splitlines() or ["it failed"])[-1][:200]}
    facts: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return facts


def done_once(
    words: Sequence[str], folder: Path, made: Path, environment: dict[str, str] | None = None
) -> str | None:
    """Run `dejavu`, with a log in a folder, unless the same command has made a file already.

    This lets a stopped run of many commands continue.

    Args:
        environment: variables of the command, beside those of this process.

    Returns:
        its last message if it failed.
    """
    well, log = folder / "command.txt", folder / "log.txt"
    if made.exists() and well.exists() and well.read_text(encoding="utf-8") == shlex.join(words):
        return None
    folder.mkdir(parents=True, exist_ok=True)
    well.unlink(missing_ok=True)
    alone = os.environ | {"OMP_NUM_THREADS": "1"} | (environment or {})  # several commands run at a time
    with log.open("w", encoding="utf-8") as file:
        command = [sys.executable, "-m", "dejavu_torch.cli", *words]
        status = subprocess.run(command, stdout=file, stderr=file, check=False, env=alone).returncode
    if status:
        said = log.read_text(encoding="utf-8").strip().splitlines()
        known = status == 2 and said
        return one_line(said[-1].removeprefix("dejavu: ") if known else f"ended with status {status}")
    well.write_text(shlex.join(words), encoding="utf-8")
    return None


def end_with_parent() -> None:
    """Let the system end this process with its parent, such as by Ctrl-C."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def truth_of(
    reference: Traverse,
    query: Traverse,
    given: str | None = None,
) -> GroundTruth:
    """The given ground truth, that of the sources, or frame i is place i.

    Raises:
        InputError: there is no ground truth.
    """
    truth = ground_truth_of(given, reference, query)
    if truth is None and len(reference) == len(query):
        truth = ground_truth_of("0", reference, query)
    if truth is None:
        seen = f"{reference.name} has {len(reference)} frames and {query.name} {len(query)}"
        raise InputError(f"{seen}; expected as many, frame i being place i")
    return truth


def write_bench(out: Path, rows: Sequence[Row], picture: Plot | None = None, **facts: Any) -> None:
    """Write bench.json, and bench.png if there is a picture, into a folder: both or nothing.

    bench.json also has the versions and settings that the figures depend on.
    """
    with whole_folder(out) as folder:
        text = json.dumps({"rows": rows} | facts | programs(), indent=1)
        (folder / "bench.json").write_text(text + "\n", encoding="utf-8")
        if picture is not None:
            picture[0].savefig(folder / "bench.png")


def programs() -> dict[str, Any]:
    """The versions and settings that figures depend on."""
    versions: dict[str, str | None] = {"dejavu_torch": dejavu_torch.__version__}
    for package in COMPARED:
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return {
        "threads": torch.get_num_threads(),
        "l1_backend": l1_backend(),
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "version": dejavu_torch.__version__,
        "versions": dict.fromkeys(COMPARED) | versions,
        "date": f"{datetime.now(timezone.utc):%Y-%m-%d}",
        "machine": f"{os.cpu_count()} cores, {platform.machine()}",
        "commit": commit(),
    }


@cache
def commit() -> str | None:
    """The commit of this clone."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    with suppress(OSError, subprocess.SubprocessError):
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    return None


def bars(rows: Sequence[Row], key: str = "ratio_to_ours", unit: float = 1.0, **label: str) -> Plot | None:
    """Bars of one figure of the rows, by case and contender; None if no row has it."""
    cases: dict[str, dict[str, float]] = {}
    for row in rows:
        if row[key] is not None:
            cases.setdefault(row["case"], {})[row["contender"]] = row[key] / unit
    return plot_ratios(cases, **label) if cases else None


def table(rows: Sequence[Row], columns: Mapping[str, Column], name: str = "{case}: {contender}") -> str:
    """The figures as aligned text under a header, with the reason if there are none."""

    def text(value: float | None, form: str, unit: float = 1.0) -> str:
        return "" if value is None else format(value / unit, form)

    body = []
    for row in rows:
        figures = [text(row[key], *form) for key, *form in columns.values()]
        note = f"{row['measured_rows']} measured" if row.get("measured_rows") else ""
        note = f"skipped: {row['skipped']}" if row.get("skipped") else note
        body.append([name.format(**row), *figures, note])
    return text_table([["", *columns, ""], *body])
