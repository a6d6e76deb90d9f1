"""`benchmarks results`: runs the commands for the figures of the documentation and keeps the reports."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from benchmarks.measure import Row, done_once, write_bench
from benchmarks.trainings import ROAD, drive
from dejavu_torch.types import InputError

SEEDS = (0, 3, 4)  # of the simulated routes; settings were chosen with other seeds


class Footage(NamedTuple):
    """Two traverses and their options of `dejavu compare`; {data} is the folder of the footage.

    distractors: footage of other places, for which all answers are wrong.
    """

    reference: str
    query: str
    words: str = ""
    distractors: str = ""


def road(part: str = "", distractors: str = "sim:outdoor?stop=2000") -> Footage:
    return Footage(ROAD.format(1, part), ROAD.format(2, part), distractors=distractors)


def railway(part: str, distractors: str) -> Footage:
    summer, winter = (f"{{data}}/nordland/{one}?" for one in ("summer", "winter"))
    return Footage(summer + part, winter + part, "--truth 0 --tolerance 1", winter + distractors)


def filmed(name: str, tolerance: int) -> Footage:
    one = drive(name, tolerance)
    return Footage(one.reference, one.query, f"--truth {one.truth} --tolerance {tolerance}")


def simulated(kind: str, seed: int, distractors: str) -> Footage:
    one = f"sim:{kind}?seed={seed}"
    return Footage(one, f"{one}&traverse=1", "", f"sim:{distractors}?stop=2000")


FOOTAGE = {
    "city 1": filmed("robotcar/t1", 2),
    "city 2": filmed("robotcar/t2", 2),
    "city 3": filmed("robotcar/t5", 2),
    "laps": filmed("donkey_lap", 10),
    "corridor": Footage(
        "{data}/corridor/ref", "{data}/corridor/query", "--truth {data}/corridor/truth.csv --tolerance 0"
    ),
    "railway, first half": railway("stop=900", "start=900"),
    "railway, second half": railway("start=900", "stop=900"),
    "road, first half": road("&stop=1348", ROAD.format(2, "&start=1348")),
    "road, second half": road("&start=1348", ROAD.format(2, "&stop=1348")),
    "road": road(),
    **{
        f"sim:{kind}, seed {seed}": simulated(kind, seed, distractors)
        for kind, distractors in (
            ("aerial", "outdoor"),
            ("outdoor", "underground"),
            ("underground", "outdoor"),
        )
        for seed in SEEDS
    },
}
IN_ORDER = (  # a route of each kind, long enough for sequences of 21
    *("city 1", "city 2", "laps", "railway, first half", "railway, second half", "road, second half"),
    *("sim:aerial, seed 0", "sim:outdoor, seed 0", "sim:underground, seed 0"),
)
SEEDED = ("default",)  # run with all seeds, the others with the first
SECOND = "railway, second half"
WAYS = {  # options of `dejavu compare`; {default} and {visits} are folders of maps
    "default": "--storage_curve --drives all",
    "HOG": "--features HOG --calibration none",
    "drive": "--map {default}/{footage}/map.safetensors --ordered --drives all",
    "filter": "--map {default}/{footage}/map.safetensors --match filter",
    "sequence": "--map {default}/{footage}/map.safetensors --match sequence:21",
    "visits": "--whitening {visits}/first.safetensors --match sequence:21 --storage_curve",
}
VISITS = (
    "learn {data}/nordland/summer?stop=900 --second {data}/nordland/winter?stop=900 --second_truth 0 "
    "--map {visits}/first.safetensors"
)


class Run(NamedTuple):
    """A command line of `dejavu compare`."""

    footage: str
    way: str
    words: list[str]


def runs(ways: Sequence[str]) -> Iterator[Run]:
    """Every way on all footage that it applies to."""
    for way in ways:
        for name, one in FOOTAGE.items():
            for_it = {"sequence": name in IN_ORDER, "filter": bool(one.distractors), "visits": name == SECOND}
            again = name.endswith(tuple(f"seed {seed}" for seed in SEEDS[1:]))
            if not for_it.get(way, True) or (again and way not in SEEDED):
                continue
            words = ["compare", one.reference, one.query, *shlex.split(one.words), *shlex.split(WAYS[way])]
            words = [word.replace("{footage}", slug(name)) for word in words]
            if way in ("default", "drive", "filter") and one.distractors:
                words += ["--distractors", one.distractors]
            yield Run(name, way, words)


def slug(name: str) -> str:
    """A name as the name of a folder."""
    return re.sub(r"\W+", "_", name)


def kept(report: dict[str, Any]) -> Row:
    """The figures of a report for the map, its curve, and everything it is compared with."""
    figures = (
        *("auc", "auc_by_confidence", "recall_at_1", "recall_at_99_precision", "recall_at_100_precision"),
        *("route_bytes", "bytes", "k", "sequences"),
    )
    own = (
        *(
            "frames",
            "seconds_learn",
            "seconds_localize",
            "fixed_bytes",
            "route_bytes_per_place",
            "noise_over_map",
            "storage",
            "rejection",
        ),
        *("answers", "drive", "accepted", "accepted_right", "with_answer"),
    )
    rivals = {
        name: of for name, of in report.items() if isinstance(of, dict) and "auc" in of and name not in own
    }
    row = {name: report[name] for name in (*figures, *own) if name in report}
    return row | {name: {key: of[key] for key in figures if key in of} for name, of in rivals.items()}


def rounded(value: Any) -> Any:
    """Round the numbers in a value to four decimals."""
    if isinstance(value, dict):
        return {name: rounded(one) for name, one in value.items()}
    if isinstance(value, list):
        return [rounded(one) for one in value]
    return round(value, 4) if isinstance(value, float) else value


def run_results(
    data: Path, *, out: Path, ways: Sequence[str] = (), footage: Sequence[str] = (), jobs: int = 1
) -> list[str]:
    """`dejavu compare` on footage of every kind, for the tables of the documentation.

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json and the reports, which later runs reuse
        ways: names of ways to run; all if not given. "drive", "filter" and "sequence" use the maps of
            "default"
        footage: names of footage; all if not given. Other rows of bench.json are kept
        jobs: commands that run in parallel, with one thread each

    Convention: commands in bench.json have data/, default/ and visits/ for the folders.

    Raises:
        InputError: an unknown way or footage, or less than one job.
    """
    for kind, names, known in (("way", ways, WAYS), ("footage", footage, FOOTAGE)):
        if unknown := [name for name in names if name not in known]:
            raise InputError(f"{unknown[0]!r} is no {kind}; expected one of {', '.join(map(repr, known))}")
    if jobs < 1:
        raise InputError(f"bench results got {jobs} jobs; expected at least one")
    shown = {"{data}": "data", "{default}": "default", "{visits}": "visits"}
    folders = {"{data}": str(data), "{default}": str(out / "default"), "{visits}": str(out / "visits")}

    def placed(words: Sequence[str], where: dict[str, str]) -> list[str]:
        return [reduce(lambda text, name: text.replace(name, where[name]), where, word) for word in words]

    def row_of(run: Run) -> Row:
        folder = out / slug(run.way) / slug(run.footage)
        row = {"case": run.footage, "contender": run.way}
        row["command"] = shlex.join(["dejavu", *placed(run.words, shown)])
        words, report = [*placed(run.words, folders), "--out", str(folder)], folder / "report.json"
        if (said := done_once(words, folder, report)) is not None:
            return row | {"skipped": said}
        said = report.read_text(encoding="utf-8").replace(str(data), "data")  # in the names of sources
        return row | kept(json.loads(said))

    planned = [run for run in runs(ways or list(WAYS)) if not footage or run.footage in footage]
    if any(run.way == "visits" for run in planned):
        made = out / "visits" / "first.safetensors"
        if (said := done_once(placed(VISITS.split(), folders), made.parent, made)) is not None:
            raise InputError(said)
    rows: list[Row] = []
    for first in (True, False):  # the other ways need the maps of the default
        part = [run for run in planned if (run.way == "default") == first]
        with ThreadPoolExecutor(jobs) as pool:
            rows += tqdm(pool.map(row_of, part), "results", len(part), disable=None, leave=False)
    failed = [f"{row['case']}, {row['contender']}: {row['skipped']}" for row in rows if "skipped" in row]
    count, kept_file, new = len(rows), out / "bench.json", {(row["case"], row["contender"]) for row in rows}
    if footage and kept_file.exists():
        before = json.loads(kept_file.read_text(encoding="utf-8"))
        others = [row for row in before["rows"] if (row["case"], row["contender"]) not in new]
        rows += [{"commit": before["commit"]} | row for row in others]
    write_bench(out, rounded(rows))
    return [*failed, f"{count} reports"]
