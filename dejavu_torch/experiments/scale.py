"""How maps grow with the route, beside the indexes of faiss on the same descriptors: `dejavu bench scale`."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from tqdm import tqdm

import dejavu_torch
from dejavu_torch.data.arrays import read_array
from dejavu_torch.data.frame_range import FrameRange, IndexedTraverse
from dejavu_torch.data.output import check_output_folder, temporary_folder, whole_file, whole_folder
from dejavu_torch.data.simulate.aerial import LONGEST, AerialRoad
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.score_plots import plot_growth
from dejavu_torch.experiments.bench import Row, peak_memory
from dejavu_torch.experiments.footprint import give_back, in_process
from dejavu_torch.experiments.made import Likeness, MadeRoute, likeness
from dejavu_torch.experiments.repeating import TiledRoute, tiles_of
from dejavu_torch.experiments.scale_contenders import (
    CONTENDERS,
    FLOWN,
    ONE_CHUNK,
    PLACED,
    REPEATED,
    Find,
    Found,
)
from dejavu_torch.experiments.scale_report import ScaleRow, exponents, pictured, with_ratios
from dejavu_torch.experiments.template_search import PLACES as TEMPLATES
from dejavu_torch.experiments.template_search import bench_templates
from dejavu_torch.model import DejaVu
from dejavu_torch.types import InputError, Match

PLACES = (10_000, 100_000, 1_000_000)
FEWEST = 500
RENDERED = 100_000  # places that are drawn; beyond them descriptors are made
DESCRIBED = 10_000  # places that the whitening has seen
QUERIES, SINGLE, BATCH = 2000, 20, 256  # in all, those of them that are timed one by one, of a batch
CHECKED = 10_000  # places at which made descriptors stand beside drawn ones
SHUFFLED = 100_000  # places of a null at most
MEMORY = 8_000_000_000  # bytes of a process
TOLERANCE = 5


class Task(NamedTuple):
    """What is measured of a contender.

    case: of the rows. source: of the descriptors, see `Folder`. places: N. room: route bytes per place that
    it is to take, of those that do not say themselves. threads: that learn. device: that localizes.
    """

    case: str
    contender: str
    source: str
    places: int
    room: float
    threads: int
    device: str

    def file(self, folder: Path) -> Path:
        return folder / f"kept-{list(CONTENDERS).index(self.contender)}"


def route_of(task: Task, folder: Path) -> IndexedTraverse:
    """The descriptors of a task: "drawn" and "flown" lie in a file, "made" and "tiles" are made as read."""
    if task.source == "made":
        return MadeRoute(Likeness(**load_file(folder / "made.safetensors")), task.places)
    if task.source == "tiles":
        return TiledRoute(**load_file(folder / "tiles.safetensors"), length=task.places)
    return Part(read_array(folder / f"{task.source}.npy"), task.places)


class Part(IndexedTraverse):
    """The first places of a route."""

    def __init__(self, route: IndexedTraverse, length: int) -> None:
        self.route, self.length, self.name = route, length, route.name

    def read(self, frames: range) -> Tensor:
        return self.route.read(frames)


def learn(task: Task, folder: Path) -> dict[str, Any]:
    """Keep the descriptors; the fields of a `ScaleRow` that this tells."""
    torch.set_num_threads(task.threads)
    contender, route, file = CONTENDERS[task.contender](task.room), route_of(task, folder), task.file(folder)
    size = 0

    def run() -> None:
        nonlocal size
        size = contender.learn(route, file)

    began = time.perf_counter()
    peak = peak_memory(run)
    return {
        "learn_rate": task.places / (time.perf_counter() - began),
        "learn_peak_bytes": peak,
        "bytes": file.stat().st_size,
        "route_bytes": size,
        "bytes_per_place": size / task.places,
    }


def localize(task: Task, folder: Path) -> dict[str, Any]:
    """Find the queries in what was kept, one by one and in batches; the fields that this tells."""
    torch.set_num_threads(1)
    contender, state = CONTENDERS[task.contender](task.room), load_file(folder / f"{task.case}.safetensors")
    queries, truth = state["queries"], state["truth"]
    one: list[float] = []
    batch: list[float] = []
    found: list[Found] = []

    def timed(find: Find, part: Tensor) -> tuple[float, Found]:
        began = time.perf_counter()
        result = find(part)
        return (time.perf_counter() - began) / len(part), result

    def run() -> None:
        find = contender.load(task.file(folder), task.device)
        find(queries[:2])  # loads what is loaded late
        one.extend(timed(find, query)[0] for query in queries[:SINGLE].split(1))
        for part in queries.split(BATCH):
            seconds, result = timed(find, part)
            found.append(result)
            if len(part) == BATCH or len(queries) < BATCH:
                batch.append(seconds)

    peak = peak_memory(run)
    score, index = (torch.cat(parts) for parts in zip(*found, strict=True))
    match = Match(index.cpu(), score.cpu(), torch.ones(len(index), dtype=torch.bool))
    scores = evaluate(match, truth[:, None], TOLERANCE)
    return {
        "seconds": float(np.median(batch)),
        "seconds_one": float(np.median(one)),
        "peak_bytes": peak,
        "recall_at_1": scores.recall_at_1,
        "auc": scores.auc,
        "queries": len(queries),
    }


def measured(task: Task, folder: Path) -> ScaleRow:
    """A contender's row: it learns in one process and localizes in another."""
    facts: dict[str, Any] = {}
    for what in (learn, localize):
        facts |= in_process(__name__, [what.__name__, task, str(folder)])
        if "skipped" in facts:
            break
    for file in folder.glob(task.file(folder).name + "*"):
        file.unlink()
    return ScaleRow(task.case, task.contender, task.places, threads=task.threads, **facts)


class Folder:
    """Descriptors of all cases, drawn once.

    Args:
        path: an empty folder. sizes: places of the cases.
    """

    def __init__(self, path: Path, sizes: Sequence[int], progress: bool = False) -> None:
        self.path, self.progress = path, progress
        drawn = [n for n in sizes if n <= RENDERED]
        self.drawn = RENDERED if len(drawn) < len(sizes) else max(drawn)
        self.model = DejaVu()
        self.second: AerialRoad

    def draw(self) -> None:
        """`sim:aerial`, its first places for the whitening, and what made descriptors are to be like."""
        first = AerialRoad(frames=self.drawn)
        self.model.describe_reference(FrameRange(first, 0, min(self.drawn, DESCRIBED)))
        places = self._kept("drawn", first, self.drawn)
        self.second = AerialRoad(frames=self.drawn, traverse=1)
        shown = spread(self.drawn)
        like = likeness(places, self._described(self.second, shown), shown)
        save_file(
            {name: one.contiguous() for name, one in like._asdict().items()}, self.path / "made.safetensors"
        )

    def draw_again(self, flown: int) -> None:
        """The ground that repeats: its tiles, and the frames of a flight over the first places."""
        assert self.model.whitening is not None
        tiles = tiles_of(self.model)
        save_file(tiles, self.path / "tiles.safetensors")
        if flown:
            self._kept("flown", AerialRoad(frames=flown, ground="repeat"), flown)

    def ask(self, case: str, source: str, places: int) -> None:
        """Describe the queries of a case: the second flight, evenly along the route."""
        shown = spread(places)
        if source == "made":
            route = route_of(Task(case, "", source, places, 0, 1, "cpu"), self.path)
            assert isinstance(route, MadeRoute)
            queries = route.seen_again(shown)
        elif source == "drawn":
            queries = self._described(self.second, shown)
        else:
            queries = self._described(AerialRoad(frames=places, ground="repeat", traverse=1), shown)
        save_file({"queries": queries, "truth": shown}, self.path / f"{case}.safetensors")

    def _described(self, road: AerialRoad, shown: Tensor) -> Tensor:
        step = int(shown[1] - shown[0])
        frames = range(0, step * len(shown), step)
        parts = (self.model.whitened(self.model.describe(part)) for part in road.select(frames, 64))
        with torch.no_grad():
            return torch.cat(list(parts))

    def _kept(self, name: str, road: AerialRoad, places: int) -> Tensor:
        """Described frames as a file, which is read where it lies."""
        parts = road.select(range(places), 64)
        bar = tqdm(parts, name, -(-places // 64), disable=None if self.progress else True, leave=False)
        with torch.no_grad():
            rows = torch.cat([self.model.whitened(self.model.describe(part)) for part in bar])
        np.save(self.path / f"{name}.npy", rows.numpy())
        return rows


def spread(places: int) -> Tensor:
    """The places that queries show, (Q,), evenly along the route."""
    count = min(QUERIES, places)
    return torch.arange(count) * (places // count)


def bench_scale(
    places: Sequence[int] = (), device: str = "cpu", progress: bool = False
) -> Iterator[ScaleRow]:
    """All contenders at all sizes, a row at a time.

    Args:
        places: N of each size, `PLACES` where none is given.
        device: that our maps localize on.
        progress: show progress bars on a terminal.

    Yields:
        Rows of the cases `places=N`: up to `RENDERED` places `sim:aerial`, beyond it descriptors that are
        made to be like it, see `MadeRoute`; `made=N`: such descriptors at a size that is drawn as well;
        `repeat=N`: ground that repeats, see `TiledRoute`; `templates=N`: see `bench_templates`.

    Raises:
        InputError: too few places, or more than the ground that repeats has.
    """
    sizes = sorted(set(places or PLACES))
    longest = 10**8
    if sizes[0] < FEWEST or sizes[-1] > longest:
        raise InputError(f"bench scale got places {sizes}; expected {FEWEST} to {longest} each")
    threads = torch.get_num_threads()
    made = min((n for n in sizes if n > RENDERED), default=None)  # ahead of which they are checked
    with temporary_folder(Path(tempfile.gettempdir())) as path:
        folder = Folder(path, sizes, progress)
        folder.draw()
        if sizes[0] <= LONGEST["repeat"]:
            folder.draw_again(max([n for n in sizes if n <= RENDERED], default=0))
        for n in sizes:
            if n == made:
                yield from _case(folder, f"made={CHECKED}", "made", CHECKED, threads, device)
            yield from _case(folder, f"places={n}", "drawn" if n <= RENDERED else "made", n, threads, device)
            if n <= LONGEST["repeat"]:
                yield from _repeating(folder, n, threads, device)
        if not places:  # whole cycles of both tiles
            yield from _repeating(folder, LONGEST["repeat"], threads, device)
    for found in bench_templates(sizes if places else TEMPLATES):
        yield from map(_of_templates, found)


def _of_templates(row: Row) -> ScaleRow:
    """A row of template search: a query by itself takes as long as one of many."""
    places = int(row.case.partition("=")[2])
    size = row.file_bytes
    return ScaleRow(
        row.case,
        row.contender,
        places,
        row.seconds,
        row.seconds,
        row.peak_bytes,
        route_bytes=size,
        bytes_per_place=None if size is None else size / places,
        threads=row.threads,
        skipped=row.skipped,
    )


def _case(
    folder: Folder, case: str, source: str, places: int, threads: int, device: str
) -> Iterator[ScaleRow]:
    folder.ask(case, source, places)
    for name in PLACED:
        task = Task(case, name, source, places, 0, threads, device)
        if name.startswith("null") and places > SHUFFLED:
            yield ScaleRow(case, name, places, skipped=f"shuffled orders are of at most {SHUFFLED} places")
        else:
            yield measured(task, folder.path)


def _repeating(folder: Folder, places: int, threads: int, device: str) -> Iterator[ScaleRow]:
    case = f"repeat={places}"
    folder.ask(case, "tiles", places)
    room = 0.0
    for name in REPEATED:
        source = "flown" if name == FLOWN else "tiles"
        if (name in (FLOWN, "null")) and places > SHUFFLED:
            why = "noisy frames are drawn" if name == FLOWN else "shuffled orders are"
            yield ScaleRow(case, name, places, skipped=f"{why} of at most {SHUFFLED} places")
            continue
        row = measured(Task(case, name, source, places, room, threads, device), folder.path)
        room = row.bytes_per_place or 0.0 if name == ONE_CHUNK else room
        yield row


def run_scale(
    out: Path, places: Sequence[int] = (), device: str = "cpu", progress: bool = False
) -> list[ScaleRow]:
    """`bench_scale`, written into a folder as rows are finished: bench.json, and bench.png at the end.

    Raises:
        InputError: as `bench_scale`, or a folder that cannot be made or written in.
    """
    check_output_folder(out)
    rows: list[ScaleRow] = []
    for row in bench_scale(places, device, progress):
        rows = with_ratios([*rows, row])
        with whole_folder(out) as folder:
            write_rows(folder, rows, device)
    figure, _ = plot_growth(pictured(rows))
    with whole_file(out / "bench.png") as temporary:
        figure.savefig(temporary)
    return rows


def write_rows(folder: Path, rows: Sequence[ScaleRow], device: str) -> None:
    """Write bench.json into a folder that exists."""
    facts = {
        "rows": [row._asdict() for row in rows],
        "exponents": exponents(rows),
        "tolerance": TOLERANCE,
        "device": device,
        "threads": torch.get_num_threads(),
        "version": dejavu_torch.__version__,
    }
    (folder / "bench.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


def limit_memory() -> None:
    """Have the system refuse this process more than `MEMORY`, where it can."""
    with suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))


if __name__ == "__main__":
    what, given, place = json.loads(sys.argv[1])
    with suppress(ImportError):  # loaded ahead of what is measured
        import faiss  # noqa: F401
    limit_memory()
    give_back()
    done = {"learn": learn, "localize": localize}[what](Task(*given), Path(place))
    sys.stdout.write(json.dumps(done) + "\n")
