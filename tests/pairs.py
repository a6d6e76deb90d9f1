"""`python -m tests.pairs [--part] [--write] [NAME ...]`: every capability with every other, as a table.

Each cell learns a tiny map with two capabilities, and asks it. What must come of it stands in `pairs.json`:

- `works`, the least share of queries that have to be found, and of those that have to be accepted;
- `refused` and the line that says so, at once, before any work;
- `fails` and why: it does not work yet, which nobody says. A cell that starts to work is an error, too,
  until the table says so.

Names choose rows or columns, or with a `+` between two a cell. Exit status 1: a cell is not as the table
says.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import csv
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))  # helpers of the tests, when it runs as a program

from footage import QUERY, REFERENCE, SIDE, STEP, footage
from PIL import Image

from dejavu_torch import DejaVu, open_source
from dejavu_torch.cli import main as dejavu
from dejavu_torch.types import InputError

TABLE = Path(__file__).parent / "pairs.json"
NEAR = 5  # places within which an answer is right
SOON = 5.0  # seconds of processor time before a refusal, on any machine; most take a hundredth
WORKS, ACCEPTED = 0.85, 0.5  # shares that a cell finds and accepts, from which on it does not fail
FEW = ("--features", "HOG", "--whitening.numbers", "48", "--whitening.views", "1")
STEPS = ("--velocity.corners", "[[0,0],[1,0],[1,1],[0,1]]", "--velocity.size", f"[{SIDE},{SIDE}]")
STEPS += ("--velocity.step", str(STEP))
AREA = "demo:area?rows=16:144&stride=16&columns="
SEES = "demo:area?traverse=1&rows=48:112&stride=8&columns="
Rows = list[dict[str, str]]
Shares = tuple[float, float]  # of queries that are found, and that are accepted


class Subject(NamedTuple):
    """What is learned: its sources, further words, and commands that make the map from it.

    second, drive, more: other visits, and new ground. truth: of the visits. asked: words of all commands
    that ask. then: commands after learning. longer: words of an --append.
    """

    sources: tuple[str, ...]
    words: tuple[str, ...]
    query: str
    second: str
    drive: str
    more: str
    truth: str = "0"
    asked: tuple[str, ...] = ()
    then: tuple[tuple[str, ...], ...] = ()
    longer: tuple[str, ...] = ()


def seen(route: int, visit: int, cut: str = "") -> str:
    """A folder of images of a visit to a simulated route."""
    return f"{{made}}/{route}_{visit}{cut}"


ROUTE = Subject((seen(1, 0),), FEW, seen(1, 1), seen(1, 2), seen(1, 3), seen(2, 0, "?stop=60"))
SUBJECTS = {
    "route": ROUTE,
    "several sources": ROUTE._replace(sources=(seen(1, 0, "?stop=70"), seen(1, 0, "?start=70"))),
    "area": Subject(
        *((f"{AREA}0:512",), (*FEW[2:], "--features", "HOG", "--features.cell", "16"), f"{SEES}0:512"),
        *("demo:area?traverse=1&rows=16:144&stride=24&columns=0:512", f"{SEES}0:512", f"{AREA}512:800"),
        *("pixels:16",),
    ),
    "loops": Subject(
        *(("{made}/twice.npy",), FEW, "{made}/twice.npy", "{made}/thrice.npy", "{made}/thrice.npy"),
        *(seen(2, 0, "?stop=60"), "{made}/twice.csv", ("--loops", "40", "--ordered")),
    ),
    "merged": ROUTE._replace(
        then=(
            ("learn", seen(2, 0), "--map", "{out}/other.safetensors", *FEW[:2], "--whitening", "{map}"),
            ("merge", "{out}/other.safetensors", "{map}", "--map", "{out}/both.safetensors"),
            ("mv", "{out}/both.safetensors", "{map}"),
        ),
        longer=("--route", "map"),
    ),
    "grown": ROUTE._replace(
        sources=(seen(1, 0, "?stop=90"),),
        then=(("learn", seen(1, 0, "?start=90"), "--append", "{map}"),),
    ),
    "refined": ROUTE._replace(then=(("refine", "{map}", seen(1, 4)),)),
    "ready descriptors": Subject(
        *(("{made}/0.npy",), ("--whitening.numbers", "16"), "{made}/1.npy", "{made}/2.npy", "{made}/3.npy"),
        *("{made}/more.npy",),
    )._replace(asked=("--ordered",)),
    "even steps": Subject(
        *(("{made}/reference.npy",), (*STEPS, *FEW), "{made}/query.npy", "{made}/again.npy"),
        *("{made}/again.npy", "{made}/more_frames.npy", "{made}/truth.csv", ("--ordered",)),
    ),
    "templates": ROUTE._replace(
        words=("--config", "local_maxima", "--mapper.periods.window", "128"),
        sources=(seen(1, 5),),
        query=seen(1, 6),
    ),
}


class Action(NamedTuple):
    """What is done: words of learning, an edit, words of asking, or another command that asks."""

    learn: tuple[str, ...] = ()
    edit: tuple[str, ...] = ()
    ask: tuple[str, ...] = ()
    command: str = "localize"
    query: Callable[[str, Path], str] | None = None  # makes the queries another source


def in_half(source: str, folder: Path) -> str:
    """The frames of a source as float16."""
    frames = open_source(source.format(made=folder))[:]
    if frames.ndim == 4:
        frames = frames.permute(0, 2, 3, 1)
    np.save(folder / "half.npy", frames.half().numpy())
    return "{made}/half.npy"


def in_h5(source: str, folder: Path) -> str:
    """Descriptors as hloc writes them."""
    import h5py

    rows = np.load(folder / "1.npy")
    with h5py.File(folder / "query.h5", "w") as file:
        for i, row in enumerate(rows):
            file.create_dataset(f"query/{i:04}.jpg/global_descriptor", data=row)
    return "{made}/query.h5"


MATCH = "--match"
ACTIONS = {
    "single": Action(ask=(MATCH, "single")),
    "sequence": Action(ask=(MATCH, "sequence:5")),
    "filter": Action(ask=(MATCH, "filter")),
    "drive": Action(ask=(MATCH, "drive")),
    "headings": Action(ask=("--headings", "4")),
    "views": Action(ask=("--shifts", "[-.1,.1]")),
    "second": Action(learn=("--second", "{second}", "--second_truth", "{truth}")),
    "refine": Action(edit=("refine", "{map}", "{drive}")),
    "update": Action(edit=("update", "{map}", "{drive}")),
    "append": Action(edit=("learn", "{more}", "--append", "{map}")),
    "average": Action(learn=("--average", "{second}", "--average_truth", "{truth}")),
    "calibrate": Action(learn=("--calibration", "{drive}", "--calibration_truth", "{truth}")),
    "precision": Action(ask=("--precision", ".9")),
    "export": Action(command="export"),
    "export of a filter": Action(command="export", ask=(MATCH, "filter")),
    "live": Action(command="live"),
    "pairs file": Action(ask=("--pairs", "{out}/pairs.txt")),
    "h5": Action(query=in_h5),
    "distractors": Action(command="compare", ask=("--distractors", "{more}")),
    "storage curve": Action(command="compare", ask=("--storage_curve",)),
    "cluster": Action(ask=("--cluster", "{cluster}", MATCH, "single")),
    "fp16": Action(query=in_half, ask=("--ordered",)),
}
TRIPLES = (
    ("area", "headings", "storage curve"),
    ("merged", "calibrate", "single"),
    ("even steps", "second", "calibrate"),
)
FIXED = (  # a minute of them, in `.ci/run`
    *(("route", "drive"), ("route", "filter"), ("area", "single"), ("area", "headings"), ("loops", "drive")),
    *(("merged", "single"), ("grown", "drive"), ("refined", "filter"), ("ready descriptors", "export")),
    *(("even steps", "drive"), ("templates", "sequence"), ("area", "refine"), ("route", "append")),
    *(("route", "filter", "second"), ("route", "average", "export"), ("route", "precision", "live")),
    *(("route", "filter", "append"), ("route", "drive", "views")),
)


class Outcome(NamedTuple):
    """works: the shares of queries found and accepted. refused: the line. broken: the end of a traceback."""

    kind: str
    told: str
    seconds: float = 0.0
    found: float = 0.0
    accepted: float = 0.0


def made(folder: Path) -> None:
    """Sources that no name makes: ready descriptors, frames of even steps, a route seen twice."""
    random = np.random.default_rng(7)
    i, waves = np.arange(150)[:, None], random.integers(1, 40, 16)
    route = sum(np.sin(2 * np.pi * (k * waves * i / 150 + random.random(16))) for k in (1, 2, 3))
    for visit in range(4):
        noise = np.random.default_rng(visit).normal(size=(150, 16)) * 0.3
        np.save(folder / f"{visit}.npy", (route + noise).astype(np.float32))
    np.save(folder / "more.npy", random.normal(size=(60, 16)).astype(np.float32).cumsum(0) / 3)
    for name, where, noise in (("reference", REFERENCE, 0.0), ("query", QUERY, 0.02), ("again", QUERY, 0.03)):
        np.save(folder / f"{name}.npy", (255 * footage(where, noise)[:, 0]).byte().numpy())
    np.save(folder / "more_frames.npy", (255 * footage(REFERENCE[:60] + 20)[:, 0].flip(2)).byte().numpy())
    nearest = (REFERENCE - QUERY[:, None]).abs().argmin(1).tolist()
    (folder / "truth.csv").write_text("query,place\n" + "".join(f"{q},{p}\n" for q, p in enumerate(nearest)))
    visits = {(1, visit): (visit, 150) for visit in range(5)} | {(1, 5): (0, 256), (1, 6): (1, 256)}
    for (route, number), (visit, frames) in (visits | {(2, 0): (0, 150)}).items():
        images = open_source(f"sim:aerial?seed={route}&traverse={visit}&frames={frames}&size=32")[:]
        (folder / f"{route}_{number}").mkdir()
        for i, image in enumerate((255 * images).byte().permute(0, 2, 3, 1).numpy()):
            Image.fromarray(image).save(folder / f"{route}_{number}" / f"{number}{i:04}.png")
    laps = [open_source(f"{folder}/1_{visit}")[:120] for visit in range(4)]
    for name, (one, other) in {"twice": (0, 1), "thrice": (2, 3)}.items():
        frames = (255 * torch.cat([laps[one], laps[other]])).byte().permute(0, 2, 3, 1)
        np.save(folder / f"{name}.npy", frames.numpy())
    lines = "".join(f"{q},{q % 120}\n" for q in range(240))
    (folder / "twice.csv").write_text(f"query,place\n{lines}")


class Table:
    """Runs cells, in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.learned = folder, {}
        self.made = folder / "made"
        self.made.mkdir()
        made(self.made)

    def cell(self, name: str, *actions: str) -> Outcome:
        """A subject by name, with actions."""
        subject, done = SUBJECTS[name], [ACTIONS[one] for one in actions]
        out = Path(tempfile.mkdtemp(dir=self.folder))
        began = time.process_time()
        try:
            found, accepted = self._found(name, subject, done, out)
            return Outcome("works", f"{found:.2f} {accepted:.2f}", 0.0, found, accepted)
        except (Refused, InputError) as refused:
            seen = re.sub(r"/tmp\w+/", "/tmp/", str(refused).replace(str(self.folder), ""))
            seen = re.sub(r"\d+(\.\d+){3}:\d+", "ADDRESS", seen)
            return Outcome("refused", seen, getattr(refused, "seconds", 0.0))
        except Exception:
            lines = traceback.format_exc().strip().splitlines()
            return Outcome("broken", f"{lines[-1]} ({lines[-3].strip()})", time.process_time() - began)
        finally:
            shutil.rmtree(out)

    def _found(self, name: str, subject: Subject, done: list[Action], out: Path) -> Shares:
        marks = {"map": out / "map.safetensors", "out": out, "made": self.made}
        marks |= {key: getattr(subject, key).format(made=self.made) for key in ("second", "drive", "more")}
        marks["truth"] = subject.truth.format(made=self.made)
        if ACTIONS["cluster"] in done:
            marks["cluster"] = cluster()

        def words(given: tuple[str, ...]) -> list[str]:
            return [re.sub(r"\{(\w+)\}", lambda found: str(marks[found[1]]), word) for word in given]

        def learn(more: tuple[str, ...] = ()) -> None:
            call(words(("learn", *subject.sources, "--map", "{map}", *subject.words, *more)))
            for command in subject.then:
                shutil.move(*words(command[1:])) if command[0] == "mv" else call(words(command))

        told = tuple(word for action in done for word in action.learn)
        if told or name not in self.learned:
            learn(told)
        if not told:
            self.learned.setdefault(name, marks["map"].read_bytes() if marks["map"].exists() else b"")
            marks["map"].write_bytes(self.learned[name])
        for action in done:
            if action.edit:
                call(words((*action.edit, *subject.longer * ("--append" in action.edit))))
        query = subject.query
        for action in done:
            if action.query is not None:
                query = action.query(query, self.made)
        marks["query"] = query.format(made=self.made)
        asked = words(subject.asked)
        for action in done:
            asked += [word for word in words(action.ask) if word != "--ordered" or word not in asked]
        commands = {action.command for action in done} - {"localize"}
        command = commands.pop() if commands else "localize"
        ask = {"localize": localized, "compare": compared, "export": exported, "live": lived}[command]
        return ask(name, subject, {key: str(value) for key, value in marks.items()}, asked)


@cache
def cluster() -> str:
    """The address of a cluster on this machine, which takes many seconds to start; it ends as this does."""
    begun = "ray.init(num_cpus=2, include_dashboard=False).address_info['gcs_address']"
    program = f"import ray, sys; print({begun}, flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", program]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    os.environ["RAY_AUTH_MODE"] = "disabled"  # of this machine alone
    started = subprocess.Popen(command, text=True, **pipes)
    atexit.register(started.kill)
    return started.stdout.readline().strip()


class Refused(Exception):
    """A command ended with one line; the processor time that it took."""

    def __init__(self, line: str, seconds: float) -> None:
        super().__init__(line)
        self.seconds = seconds


def call(words: list[str]) -> str:
    """What a command prints."""
    out, err, began = io.StringIO(), io.StringIO(), time.process_time()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            dejavu(words)
        except SystemExit as stop:
            if stop.code:
                lines = [line for line in err.getvalue().splitlines() if line.startswith("dejavu: ")]
                raise Refused(lines[-1], time.process_time() - began) from None
    return out.getvalue()


def shares(name: str, rows: Rows, query: str) -> Shares:
    """Of the queries that have a right place, those found and those accepted."""
    queries, places = (torch.tensor([int(row[key]) for row in rows]) for key in ("query", "place"))
    accepted = torch.tensor([row.get("accepted") in ("1", "True") for row in rows])
    right, judged = (places - queries).abs() <= NEAR, torch.ones(len(rows), dtype=torch.bool)
    if name == "area":
        seen = open_source(query).coordinates
        assert seen is not None
        found = torch.tensor([[float(row["x"] or "nan"), float(row["y"] or "nan")] for row in rows])
        right = (found - seen.values[queries, :2]).norm(dim=1) <= 16
    elif name == "even steps":
        judged = queries < len(QUERY)
        at, shown = places.clamp(0, len(REFERENCE) - 1), queries.clamp(max=len(QUERY) - 1)
        right = ((REFERENCE[at] - QUERY[shown]).abs() <= 2 * STEP) & (places >= 0)
    elif name == "loops":
        judged = queries >= 120
        right = ((queries - 120 - places).abs() <= NEAR) & (places >= 0)
    elif rows and rows[0].get("route"):
        right &= torch.tensor([row["route"] == "map" for row in rows])
    found, sure = (float(one[judged].double().mean()) for one in (right, accepted))
    return found, sure


def localized(name: str, subject: Subject, marks: dict[str, str], asked: list[str]) -> Shares:
    call(["localize", marks["map"], marks["query"], "--out", f"{marks['out']}/m.csv", *asked])
    with open(f"{marks['out']}/m.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return shares(name, rows, marks["query"])


def compared(name: str, subject: Subject, marks: dict[str, str], asked: list[str]) -> Shares:
    sources = [source.format(made=marks["made"]) for source in subject.sources[:1]]
    sources += [] if "--loops" in asked else [marks["query"]]
    given = ["--map", marks["map"], "--truth", marks["truth"], "--out", f"{marks['out']}/report"]
    with patch("dejavu_torch.evaluation.report.as_png", lambda picture: b""):
        call(["compare", *sources, *given, *asked])
    with open(f"{marks['out']}/report/report.json") as file:
        report = json.load(file)
    if "--storage_curve" in asked and not report.get("storage"):
        return 0.0, 0.0
    way = {"drive": "smoother", "filter": "filter"}.get(report.get("answers"))
    found = report["sequences"][way]["recall_at_1"] if way else report["recall_at_1"]
    return float(found), report["accepted"] / report["queries"]


def exported(name: str, subject: Subject, marks: dict[str, str], asked: list[str]) -> Shares:
    """What onnxruntime finds, image by image."""
    from dejavu_torch.export import run_session, session_of

    asked = [word for word in asked if word != "--ordered"]
    call(["export", marks["map"], "--onnx", f"{marks['out']}/map.onnx", *asked])
    query, model, rows = open_source(marks["query"]), DejaVu.load(marks["map"]), []
    query = query if model.step is None else model.resample(query, model.step, shape=model.frame_shape)
    numbers = getattr(query, "frame", torch.arange(len(query))).tolist()
    places = run_session(session_of(f"{marks['out']}/map.onnx"), query[:]).argmin(1)
    for i, place, frame in zip(numbers, places.tolist(), model.map.frame_of(places).tolist(), strict=True):
        row = {"query": str(i), "place": str(frame)}
        if model.map.area is not None:
            x, y = model.map.area.coordinates(torch.tensor([place]))[0].tolist()
            row |= {"x": str(x), "y": str(y)}
        if model.map.routes:
            numbers = [route.places for route in model.map.routes]
            first = sum(numbers[:-1])
            row |= {"place": str(place - first), "route": "map" if place >= first else "other"}
        rows.append(row)
    return shares(name, rows, marks["query"])


def lived(name: str, subject: Subject, marks: dict[str, str], asked: list[str]) -> Shares:
    asked = [word for word in asked if word != "--ordered"]
    lines = [json.loads(line) for line in call(["live", marks["map"], marks["query"], *asked]).splitlines()]
    rows = []
    for line in lines:
        place = line.get("reference_frame", line.get("place"))
        place = -1 if place is None else place
        row = {"query": str(line["frame"]), "place": str(place)}
        row |= {key: str(line[key]) for key in ("x", "y", "route", "accepted") if key in line}
        rows.append(row)
    return shares(name, rows, marks["query"])


def cells() -> list[tuple[str, ...]]:
    """A subject and its actions, of every cell of the table."""
    found = [(subject, action) for subject in SUBJECTS for action in ACTIONS]
    for pair in combinations(ACTIONS, 2):
        if not exclusive(*pair):
            subject = "area" if "headings" in pair else "ready descriptors" if "h5" in pair else "route"
            found.append((subject, *pair))
    return [*found, *TRIPLES]


def exclusive(one: str, other: str) -> bool:
    """Whether two actions are one option, or two commands."""
    first, second = ACTIONS[one], ACTIONS[other]
    commands = {first.command, second.command} - {"localize"}
    if len(commands) == 2 or (MATCH in first.ask and MATCH in second.ask):
        return True
    return first.query is not None and second.query is not None


def differs(outcome: Outcome, wanted: list[str | float] | None) -> str:
    """Why an outcome is not as the table says; nothing if it is."""
    if wanted is None:
        return "is not in the table"
    kind, *told = wanted
    if kind == "works":
        least = [float(one) for one in told]
        good = outcome.kind == "works" and outcome.found >= least[0] and outcome.accepted >= least[1]
        return "" if good else f"expected to find {least[0]:g} and to accept {least[1]:g}"
    if kind == "refused":
        good = outcome.kind == "refused" and outcome.told == told[0] and outcome.seconds <= SOON
        return "" if good else f"expected to be refused within {SOON:g} s by: {told[0]}"
    works = outcome.kind == "works" and outcome.found >= WORKS and outcome.accepted >= ACCEPTED
    return f"works now; the table says that it fails: {told[0]}" if works or outcome.kind == "refused" else ""


def written(outcome: Outcome) -> list[str | float]:
    """What the table says of an outcome from now on, to be read before it is believed."""
    if outcome.kind == "works":
        return ["works", *(max(0.0, round(one - 0.05, 2)) for one in (outcome.found, outcome.accepted))]
    return ["fails" if outcome.kind == "broken" else "refused", outcome.told]


def named(cell: tuple[str, ...]) -> str:
    return " + ".join(cell)


@cache
def wanted() -> dict[str, list[str | float]]:
    found: dict[str, list[str | float]] = json.loads(TABLE.read_text()) if TABLE.exists() else {}
    return found


def as_text(table: dict[str, list[str | float]]) -> str:
    """A line for each cell, in their order."""
    order = {named(cell): i for i, cell in enumerate(cells())}
    lines = (
        f" {json.dumps(cell)}: {json.dumps(table[cell])}" for cell in sorted(table, key=order.__getitem__)
    )
    return "{\n" + ",\n".join(lines) + "\n}\n"


def quick() -> contextlib.ExitStack:
    """As in the tests: whitening and calibration learn from few copies of frames."""
    stack = contextlib.ExitStack()
    for where in ("whitening.VIEWS", "whitening.VIEWS_PER_COMPONENT", "whitening.COPIES"):
        stack.enter_context(patch(f"dejavu_torch.features.{where}", 1))
    stack.enter_context(patch("dejavu_torch.features.views.FEWEST", 100))
    return stack


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.pairs", description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="of rows, columns or cells")
    parser.add_argument("--part", action="store_true", help="the minute of them that .ci/run asks for")
    parser.add_argument("--write", action="store_true", help="write what comes of the cells to the table")
    options = parser.parse_args()
    torch.set_num_threads(1)
    chosen = [cell for cell in cells() if not options.part or cell in FIXED]
    if options.names:
        asked = [set(name.split("+")) for name in options.names]
        chosen = [cell for cell in chosen if any(one <= set(cell) for one in asked)]
    table, failed = dict(wanted()), 0
    with tempfile.TemporaryDirectory() as folder, quick():
        runs = Table(Path(folder))
        for cell in chosen:
            began = time.monotonic()
            outcome = runs.cell(*cell)
            why = differs(outcome, wanted().get(named(cell)))
            failed += bool(why)
            took = time.monotonic() - began
            sign = "!" if why else " "
            print(f"{sign} {named(cell)}: {outcome.kind} {outcome.told} ({took:.1f} s) {why}", flush=True)
            if options.write and why:
                table[named(cell)] = written(outcome)
    if options.write:
        TABLE.write_text(as_text(table))
    print(f"{len(chosen)} cells, {failed} not as the table says")
    return int(failed > 0 and not options.write)


if __name__ == "__main__":
    sys.exit(main())
