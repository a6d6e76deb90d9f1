"""How maps grow with the route, beside the indexes of faiss on the same descriptors: `dejavu bench scale`."""

from __future__ import annotations

import json
import math
import sys
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
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
from dejavu_torch.database.spectral import SpectralMapper
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.score_plots import plot_growth
from dejavu_torch.experiments.bench import Row, peak_memory
from dejavu_torch.experiments.footprint import give_back, in_process
from dejavu_torch.experiments.made import Likeness, MadeRoute, likeness
from dejavu_torch.experiments.repeating import TiledRoute, step_that_holds, tiles_of
from dejavu_torch.experiments.template_search import PLACES as TEMPLATES
from dejavu_torch.experiments.template_search import bench_templates
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.search import Search
from dejavu_torch.types import InputError, Match

PLACES = (10_000, 100_000, 1_000_000)
FEWEST = 500
RENDERED = 100_000  # places that are drawn; beyond them descriptors are made
DESCRIBED = 10_000  # places that the whitening has seen
QUERIES, SINGLE, BATCH = 2000, 20, 256  # in all, those of them that are timed one by one, of a batch
CHECKED = 10_000  # places at which made descriptors stand beside drawn ones
SHUFFLED = 100_000  # places of a null at most
TRAINED = 100_000  # samples of an index at most
ROTATED = 20_000  # of one whose rotation is trained as well
ROWS = 8192  # descriptors read at a time
CHUNK = 8192
MEMORY = 8_000_000_000  # bytes of a process
PROBES = 32  # of the cells of an inverted file
TOLERANCE = 5
SHARE = 0.8  # of the variance of a repeating route
GROWING = ("bytes_per_place", "route_bytes", "seconds", "seconds_one", "peak_bytes", "learn_rate")
OURS = "dejavu"


class ScaleRow(NamedTuple):
    """What one contender takes at one size; None where it is not known.

    places: N. seconds: of a query of a batch of `BATCH`; seconds_one: of a query by itself, the median; both
    on one thread, from the descriptor to the place. peak_bytes: most memory while localizing beyond that of
    the programs, learn_peak_bytes while learning, each in a process of its own. bytes: of the file.
    route_bytes: of ours all that grows with the route, mean and tables with it; of an index its codes and
    links alone, without identifiers and codebooks. learn_rate: descriptors a second. ratio_to_ours: seconds
    over those of our fastest. threads: that learned.
    """

    case: str
    contender: str
    places: int
    seconds: float | None = None
    seconds_one: float | None = None
    peak_bytes: int | None = None
    learn_peak_bytes: int | None = None
    bytes: int | None = None
    route_bytes: int | None = None
    bytes_per_place: float | None = None
    learn_rate: float | None = None
    recall_at_1: float | None = None
    auc: float | None = None
    queries: int | None = None
    threads: int | None = None
    ratio_to_ours: float | None = None
    skipped: str | None = None


class Found(NamedTuple):
    """The best place of each query and its score, lower is better: (Q,), (Q,)."""

    score: Tensor
    place: Tensor


Find = Callable[[Tensor], Found]


class Contender(ABC):
    """A way to keep descriptors in a file, and to find the nearest."""

    @abstractmethod
    def learn(self, route: IndexedTraverse, path: Path) -> int:
        """Keep the descriptors of a route in a file; how many bytes of it are the route's."""

    @abstractmethod
    def load(self, path: Path, device: str) -> Find:
        """What finds the places of queries (Q,K) in a file."""


class Mapped(Contender):
    """Ours: a spectral map.

    Args:
        budget: route bytes per place. chunk: places, or "route". step: in place of the budget.
        shuffled: in random order, the null. search: as of `DejaVu.localize`.
    """

    def __init__(
        self,
        budget: float | None,
        chunk: Any,
        step: float | None = None,
        shuffled: bool = False,
        search: Search = "auto",
    ) -> None:
        self.mapper, self.shuffled, self.search = SpectralMapper(budget, step, chunk), shuffled, search

    def learn(self, route: IndexedTraverse, path: Path) -> int:
        model = DejaVu(whitening="none", mapper=self.mapper)
        if self.shuffled:
            order = torch.randperm(route.length, generator=torch.Generator().manual_seed(0))
            rows = torch.cat(list(route.batches(ROWS)))
            model.learn(rows[order])
            np.save(path.with_suffix(".npy"), order.numpy())
        else:
            model.learn(route)
        model.save(path)
        return model.map.summary().route_bytes

    def load(self, path: Path, device: str) -> Find:
        model = DejaVu.load(path).to(device)
        order = torch.from_numpy(np.load(path.with_suffix(".npy"))) if self.shuffled else None

        def find(queries: Tensor) -> Found:
            match = model.localize_descriptors(queries.to(device), order=order, search=self.search)
            return Found(match.score, match.index)

        return find


class Faiss(Contender):
    """An index of faiss over descriptors of length 1.

    Args:
        factory: what `faiss.index_factory` takes; {cells} stands for the cells of an inverted file.
        trained: samples that it is trained on, at most.
    """

    def __init__(self, factory: str, trained: int = TRAINED) -> None:
        self.factory, self.trained = factory, trained

    def learn(self, route: IndexedTraverse, path: Path) -> int:
        import faiss

        faiss.omp_set_num_threads(torch.get_num_threads())
        every = -(-route.length // self.trained)
        sample = torch.cat(list(route.select(range(0, route.length, every), ROWS)))
        cells = max(1, min(4 * math.isqrt(route.length), len(sample) // 40))
        index = faiss.index_factory(sample.shape[1], self.factory.format(cells=cells))
        index.train(sample.numpy())
        del sample
        faiss.write_index(index, str(path))
        empty = path.stat().st_size
        for part in route.batches(ROWS):
            index.add(part.numpy())
        faiss.write_index(index, str(path))
        names = 8 * route.length if "IVF" in self.factory else 0
        return path.stat().st_size - empty - names

    def load(self, path: Path, device: str) -> Find:
        import faiss

        faiss.omp_set_num_threads(torch.get_num_threads())
        index = faiss.read_index(str(path))
        with suppress(RuntimeError):  # it has no cells
            faiss.extract_index_ivf(index).nprobe = PROBES

        def find(queries: Tensor) -> Found:
            score, place = index.search(queries.numpy(), 1)
            return Found(torch.from_numpy(score[:, 0]), torch.from_numpy(place[:, 0]))

        return find


class Interpolated(Contender):
    """Every k-th descriptor in int8 and straight lines between them, in so many bytes per place."""

    def __init__(self, room: float) -> None:
        self.room = room

    def learn(self, route: IndexedTraverse, path: Path) -> int:
        from dejavu_torch.evaluation.baselines import as_int8, keyframes

        each = len(next(route.batches(1))[0])
        k = max(1, math.ceil((route.length - 1) / max(1, self.room * route.length // each - 1)))
        chosen = keyframes(route.length, k)
        rows = torch.cat([route.read(range(i, i + 1)) for i in chosen.tolist()])
        scale = rows.abs().max() / 127
        small = (as_int8(rows) / scale).round().to(torch.int8)
        save_file({"keys": small, "scale": scale.view(1), "k": torch.tensor([k, route.length])}, path)
        return small.nbytes

    def load(self, path: Path, device: str) -> Find:
        from dejavu_torch.evaluation.baselines import between_keyframes

        state = load_file(path)
        keys = state["keys"].float() * state["scale"]
        k, places = state["k"].tolist()

        def find(queries: Tensor) -> Found:
            best = torch.full((len(queries),), -math.inf)
            index = torch.zeros(len(queries), dtype=torch.int64)
            pieces = max(1, ROWS // k)
            for start in range(0, places, k * pieces):
                ends = keys[start // k : start // k + pieces + 1]
                rows = between_keyframes(ends, min((len(ends) - 1) * k + 1, places - start), k)
                score, at = (queries @ torch.nn.functional.normalize(rows, dim=1).T).max(1)
                index = torch.where(score > best, at + start, index)
                best = torch.maximum(best, score)
            return Found(-best, index)

        return find


class Held(Mapped):
    """Ours, in steps that keep so much of the variance of a route."""

    def __init__(self, chunk: Any) -> None:
        super().__init__(None, chunk, step=1.0)

    def learn(self, route: IndexedTraverse, path: Path) -> int:
        self.mapper.step = step_that_holds(SHARE, route, self.mapper.chunk)
        return super().learn(route, path)


ONE_CHUNK = f"{OURS}, one chunk"
FIXED = f"{OURS}, chunks of {CHUNK}"
FLOWN = f"{OURS}, one chunk, of noisy frames"

# "np" leaves out the training of faiss's filter by Hamming distances, which is not used here and takes long
# by name: what it is made of, given the route bytes per place of ours where it is to take as many
PLACED: dict[str, Callable[[float], Contender]] = {
    f"{OURS} 1 B": lambda room: Mapped(1.0, CHUNK),
    f"{OURS} 4 B": lambda room: Mapped(4.0, CHUNK),
    f"{OURS} 1 B, one chunk": lambda room: Mapped(1.0, "route"),
    f"{OURS} 4 B, one chunk": lambda room: Mapped(4.0, "route"),
    f"{OURS} 1 B, ivf": lambda room: Mapped(1.0, CHUNK, search="ivf"),
    f"{OURS} 4 B, ivf": lambda room: Mapped(4.0, CHUNK, search="ivf"),
    "null 1 B": lambda room: Mapped(1.0, CHUNK, shuffled=True),
    "null 4 B": lambda room: Mapped(4.0, CHUNK, shuffled=True),
    "faiss flat": lambda room: Faiss("Flat"),
    "faiss IVF-PQ, 4 B": lambda room: Faiss("IVF{cells},PQ4np"),
    "faiss IVF-PQ, 8 B": lambda room: Faiss("IVF{cells},PQ8np"),
    "faiss IVF-PQ, 16 B": lambda room: Faiss("IVF{cells},PQ16np"),
    "faiss IVF-PQ, 32 B": lambda room: Faiss("IVF{cells},PQ32np"),
    "faiss OPQ, IVF-PQ, 16 B": lambda room: Faiss("OPQ16,IVF{cells},PQ16np", ROTATED),
    "faiss HNSW": lambda room: Faiss("HNSW16,Flat"),
}
REPEATED: dict[str, Callable[[float], Contender]] = {
    ONE_CHUNK: lambda room: Held("route"),
    FIXED: lambda room: Held(CHUNK),
    FLOWN: lambda room: Mapped(room, "route"),
    "null": lambda room: Mapped(room, "route", shuffled=True),
    "interpolated frames": lambda room: Interpolated(room),
}
CONTENDERS = PLACED | REPEATED


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


def exponents(rows: Sequence[ScaleRow]) -> dict[str, dict[str, dict[str, float]]]:
    """How each figure of each contender grows with N, by kind of case: the slope of a line in logarithms.

    Example:
        >>> rows = [ScaleRow(f"places={n}", "dejavu", n, seconds=1e-6 * n**0.5) for n in (100, 10_000)]
        >>> round(exponents(rows)["places"]["dejavu"]["seconds"], 3)
        0.5
    """
    found: dict[str, dict[str, dict[str, float]]] = {}
    kinds = {(row.case.partition("=")[0], row.contender): None for row in rows}
    for kind, name in kinds:
        own = [row for row in rows if row.contender == name and row.case.partition("=")[0] == kind]
        for key in GROWING:
            points = [(row.places, getattr(row, key)) for row in own if getattr(row, key)]
            if len(points) > 1:
                x, y = np.log(np.array(points, dtype=float)).T
                found.setdefault(kind, {}).setdefault(name, {})[key] = float(np.polyfit(x, y, 1)[0])
    return found


def with_ratios(rows: Sequence[ScaleRow]) -> list[ScaleRow]:
    """The rows with their seconds over those of our fastest of the case."""
    fastest: dict[str, float] = {}
    for row in rows:
        if row.contender.startswith(OURS) and row.seconds:
            fastest[row.case] = min(row.seconds, fastest.get(row.case, math.inf))
    return [
        row._replace(ratio_to_ours=row.seconds / fastest[row.case])
        if row.seconds and row.case in fastest
        else row
        for row in rows
    ]


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


def pictured(rows: Sequence[ScaleRow]) -> dict[str, dict[str, list[tuple[float, float]]]]:
    """What is drawn over the number of places: heading -> contender -> points."""
    panels = {
        "recall@1": ("places", "recall_at_1", 1.0),
        "milliseconds of a query in a batch": ("places", "seconds", 1e3),
        "MB while localizing": ("places", "peak_bytes", 1e-6),
        "route bytes of ground that repeats": ("repeat", "route_bytes", 1.0),
    }
    found: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for heading, (kind, key, unit) in panels.items():
        for row in rows:
            value = getattr(row, key)
            if value and row.case.partition("=")[0] == kind:
                found.setdefault(heading, {}).setdefault(row.contender, []).append((row.places, unit * value))
    return found


def scale_tables(rows: Sequence[ScaleRow]) -> Iterator[tuple[str, list[list[str]]]]:
    """A table of each case, and one of the exponents: a heading and rows of text.

    Example:
        >>> next(scale_tables([ScaleRow("places=100", "dejavu", 100, bytes_per_place=1.0)]))[1][1][:2]
        ['dejavu', '1']
    """

    def text(value: float | None, form: str, unit: float = 1.0) -> str:
        return "" if value is None else format(value * unit, form)

    head = ["", "B/place", "recall@1", "AUC", "ms one", "ms of 256", "peak MB", "learn MB", "learned/s", ""]
    for case in dict.fromkeys(row.case for row in rows):
        yield (
            case,
            [head]
            + [
                [
                    row.contender,
                    text(row.bytes_per_place, ".3g"),
                    text(row.recall_at_1, ".3f"),
                    text(row.auc, ".3f"),
                    text(row.seconds_one, ".3g", 1e3),
                    text(row.seconds, ".3g", 1e3),
                    text(row.peak_bytes, ".0f", 1e-6),
                    text(row.learn_peak_bytes, ".0f", 1e-6),
                    text(row.learn_rate, ".0f"),
                    f"skipped: {row.skipped}" if row.skipped else "",
                ]
                for row in rows
                if row.case == case
            ],
        )
    for kind, grown in exponents(rows).items():
        yield (
            f"{kind}=N: exponents of N",
            [["", *GROWING]]
            + [[name, *(text(one.get(key), ".2f") for key in GROWING)] for name, one in grown.items()],
        )


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
