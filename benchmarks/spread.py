"""`benchmarks spread`: how far the answers of a map depend on the processor and on the seed."""

from __future__ import annotations

import csv
import json
import shlex
import statistics
from collections.abc import Sequence
from pathlib import Path

import torch
from tqdm import tqdm

from benchmarks.measure import Column, Row, done_once, table, write_bench
from dejavu_torch.types import InputError

# Libraries choose their kernels by the processor, and sum in another order: these variables make one machine
# behave like several.
PROCESSORS: dict[str, dict[str, str]] = {
    "this": {},
    "oldest": {"ATEN_CPU_CAPABILITY": "default", "MKL_CBWR": "COMPATIBLE", "ONEDNN_MAX_CPU_ISA": "SSE41"},
    "avx2": {"ATEN_CPU_CAPABILITY": "avx2", "MKL_CBWR": "AVX2", "ONEDNN_MAX_CPU_ISA": "AVX2"},
    "avx512": {"ATEN_CPU_CAPABILITY": "avx512", "MKL_CBWR": "AVX512", "ONEDNN_MAX_CPU_ISA": "AVX512_CORE"},
}
KERNELS = ("default", "avx2", "avx512")  # of torch, each includes those before
THREADS = (1, 2)
FIGURES = ("auc", "recall_at_1")


def imitable() -> list[str]:
    """The processors whose kernels this machine can run."""
    here = torch.backends.cpu.get_cpu_capability().lower()
    known = KERNELS[: KERNELS.index(here) + 1] if here in KERNELS else KERNELS[:1]
    return [name for name, own in PROCESSORS.items() if own.get("ATEN_CPU_CAPABILITY", "default") in known]


def environment_of(processor: str, threads: int) -> dict[str, str]:
    """The variables that make commands run as on a processor, with a number of threads."""
    # threads that spin would wait for those of another process
    return PROCESSORS[processor] | {"OMP_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": "passive"}


def run_spread(
    reference: str,
    query: str,
    *,
    out: Path,
    tolerance: int,
    truth: str = "0",
    seeds: int = 10,
    options: str = "",
) -> list[str]:
    """`dejavu compare` as on several processors, and with several seeds: the spread of its figures.

    Args:
        reference: traverse to learn, as of `dejavu compare`
        query: traverse to localize, likewise
        out: folder for bench.json and the reports, which later runs reuse
        tolerance: places within which an answer is right
        truth: ground truth, in the formats of `dejavu compare`
        seeds: number of seeds, from 1 on, on this processor; all processors run with seed 0
        options: further options of `dejavu compare`, in one string

    Raises:
        InputError: fewer than two seeds, or a comparison that fails.
    """
    if seeds < 2:
        raise InputError(f"bench spread got {seeds} seeds; expected at least 2")
    words = [reference, query, "--truth", truth, "--tolerance", str(tolerance), "--calibration", "none"]
    cases = [("processor", f"{name}, {count}", name, count, 0) for name in imitable() for count in THREADS]
    cases += [("seed", str(seed), "this", 1, seed) for seed in range(1, seeds + 1)]
    rows: list[Row] = []
    first: list[str] = []  # places that the first run finds
    for case, contender, processor, threads, seed in tqdm(cases, "spread", disable=None, leave=False):
        folder = out / f"{processor}_{threads}_{seed}"
        own = ["compare", *words, *shlex.split(options), "--seed", str(seed), "--out", str(folder)]
        said = done_once(own, folder, folder / "report.json", environment_of(processor, threads))
        if said is not None:
            raise InputError(said)
        report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        with (folder / "matches.csv").open(encoding="utf-8", newline="") as file:
            places = [row["place"] for row in csv.DictReader(file)]
        first = first or places
        differ = sum(one != other for one, other in zip(places, first, strict=True)) / len(first)
        row = {"case": case, "contender": contender, "differ": differ, "fixed_bytes": report["fixed_bytes"]}
        rows.append(row | {name: report[name] for name in FIGURES})
    write_bench(out, rows)
    columns: dict[str, Column] = {name: (name, ".3f") for name in (*FIGURES, "differ")}
    return [
        table(rows, columns),
        *(spread_of(rows, case) for case in ("processor", "seed")),
        f"{len(rows)} runs",
    ]


def spread_of(rows: Sequence[Row], case: str) -> str:
    """Mean and standard deviation of the figures over the rows of a case."""
    parts = []
    for name in FIGURES:
        values = [row[name] for row in rows if row["case"] == case]
        mean, spread = statistics.mean(values), statistics.stdev(values)
        parts.append(f"{name} {mean:.3f}, standard deviation {spread:.3f}")
    return f"by {case}: {'; '.join(parts)}"
