"""`benchmarks scale`: how maps grow with the route, against the indexes of faiss on the same descriptors."""

from __future__ import annotations

import json
import math
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from tqdm import tqdm

from benchmarks.made import Likeness, MadeRoute, likeness
from benchmarks.measure import Row, give_back, in_process, peak_memory, with_ratios, write_bench
from benchmarks.plots import plot_growth
from benchmarks.repeating import TiledRoute, tiles_of
from benchmarks.scale_contenders import (
    CELLS_PER_PROBE,
    CONTENDERS,
    EF_SEARCH,
    FLOWN,
    ONE_CHUNK,
    PLACED,
    PROBED_AT_LEAST,
    REPEATED,
    REQUESTED,
    ROTATED,
    ROWS,
    SEARCHED,
    TRAINED,
    Mapped,
)
from benchmarks.scale_report import RECALL, exponents, pictured, scale_row, scale_tables
from benchmarks.template_search import PLACES as TEMPLATES
from benchmarks.template_search import bench_templates
from dejavu_torch.cli.device import device_of
from dejavu_torch.data.output import temporary_folder
from dejavu_torch.data.simulate.aerial import LONGEST, AerialRoad
from dejavu_torch.data.traverse import Part, frame_range
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.features.hog import HOG
from dejavu_torch.maps import codec, distance
from dejavu_torch.model import DejaVu
from dejavu_torch.types import InputError, Match, Traverse

PLACES = (10_000, 100_000, 1_000_000)
FEWEST, MOST = 500, 10**8
RENDERED = 100_000  # places whose frames are drawn; for more, descriptors are made
DESCRIBED = 10_000  # places to learn the whitening from
QUERIES, SINGLE, BATCH = 2000, 20, 256  # all queries, those timed one by one, those in a batch
CHECKED = 10_000  # places at which made descriptors are compared with drawn ones
SHUFFLED = 100_000  # most places of a null
MEMORY = 8_000_000_000  # most bytes of a process
COPIED = 2**27  # bytes of a copy that measures the bandwidth
TOLERANCE = 5
FAISS = {
    "trained": TRAINED,
    "trained_rotation": ROTATED,
    "cells_per_probe": CELLS_PER_PROBE,
    "probes_at_least": PROBED_AT_LEAST,
    "ef_search": EF_SEARCH,
}


class Task(NamedTuple):
    """One contender to measure.

    case: of the rows. source: of the descriptors, see `Folder`. places: N. threads: for learning. device: for
    localizing. room, step: route bytes per place and step, for contenders that use those of another.
    """

    case: str
    contender: str
    source: str
    places: int
    threads: int
    device: str
    room: float = 0.0
    step: float = 0.0

    def file(self, folder: Path) -> Path:
        learned = self.contender
        for search in SEARCHED:  # these share one file
            learned = learned.removesuffix(f", {search}")
        return folder / f"kept-{self.case}-{list(CONTENDERS).index(learned)}"


class Kept(Traverse):
    """The first places of the descriptors in a file.

    The file is mapped again for each part: pages that stay mapped would count as memory of the process.
    """

    def __init__(self, path: Path, length: int) -> None:
        self.path, self.length, self.name = path, length, path.stem

    def __len__(self) -> int:
        return self.length

    def read(self, frames: range | list[int]) -> Tensor:
        values = np.load(self.path, mmap_mode="r")
        return torch.from_numpy(np.array(values[frames]))


def learn(task: Task, folder: Path) -> dict[str, Any]:
    """Store the descriptors; returns figures of a row."""
    torch.set_num_threads(task.threads)
    contender, file = CONTENDERS[task.contender](task.room, task.step), task.file(folder)
    route = Kept(folder / f"{task.source}.npy", task.places)
    step = contender.prepare(route)
    give_back()
    sizes: list[int] = []
    began = time.perf_counter()
    peak = peak_memory(lambda: sizes.append(contender.learn(route, file)))
    return {
        "step": step,
        "learn_rate": task.places / (time.perf_counter() - began),
        "learn_peak_bytes": peak,
        "bytes": file.stat().st_size,
        "route_bytes": sizes[0],
        "bytes_per_place": sizes[0] / task.places,
    }


def localize(task: Task, folder: Path) -> dict[str, Any]:
    """Find the queries in the stored file, one by one and in batches; returns figures of a row."""
    torch.set_num_threads(1)
    state = load_file(folder / f"{task.case}.safetensors")
    queries, truth = state["queries"], state["truth"]
    contender = CONTENDERS[task.contender](task.room, task.step)
    parts = [
        queries[:1],
        *queries[:SINGLE].split(1),
        *queries.split(BATCH),
    ]  # the first loads what is loaded late
    alone = 1 + len(queries[:SINGLE])
    seconds: list[float] = []
    found: list[tuple[Tensor, Tensor]] = []

    def run() -> None:
        began = time.perf_counter()
        find = contender.load(task.file(folder), task.device)
        for part in parts:
            found.append(find(part))
            seconds.append(time.perf_counter() - began)
            began = time.perf_counter()

    def of_batch() -> float:
        pairs = zip(seconds, parts, strict=True)
        return float(np.median([taken for taken, part in pairs if len(part) == len(parts[alone])]))

    peak, device, share, batch = peak_memory(run), "cpu", None, of_batch()
    one, load, answers = float(np.median(seconds[1:alone])), seconds[0], found[alone:]
    torch.set_num_threads(task.threads)
    seconds.clear()
    run()
    if isinstance(contender, Mapped):
        device = task.device
        scanned = sum(buffer.nbytes for buffer in contender.model.map.buffers())
        share = scanned / batch / bandwidth(device)
    if device.startswith("cuda"):
        peak = torch.cuda.max_memory_allocated(device)
    score, index = (torch.cat(columns) for columns in zip(*answers, strict=True))
    match = Match(index, score, torch.ones(len(index), dtype=torch.bool))
    scores = evaluate(match, truth[:, None], TOLERANCE)
    return {
        "seconds": batch / len(parts[alone]),
        "seconds_one": one,
        "seconds_threads": of_batch() / len(parts[alone]),
        "seconds_one_threads": float(np.median(seconds[1:alone])),
        "seconds_load": load,
        "peak_bytes": peak,
        "recall_at_1": scores.recall_at_1,
        "auc": scores.auc,
        "queries": len(queries),
        "device": device,
        "bandwidth_share": share,
    }


def bandwidth(device: str) -> float:
    """Bytes per second that a copy reads and writes, on one thread of a CPU or on another device."""
    source = torch.zeros(COPIED, dtype=torch.uint8, device=device)
    target = torch.ones_like(source)
    fastest = math.inf
    for _ in range(5):
        began = time.perf_counter()
        target.copy_(source)
        target[-1].item()  # waits for the copy
        fastest = min(fastest, time.perf_counter() - began)
    return 2 * COPIED / fastest


def measured(task: Task, folder: Path) -> Row:
    """The row of a contender, which learns in one process and localizes in another. Its file is kept until
    the next one learns, for other ways to search it."""
    known = task.file(folder).with_suffix(".json")
    if not known.exists():
        for file in folder.glob("kept-*"):
            file.unlink()
        known.write_text(json.dumps(in_process(__name__, [learn.__name__, task, str(folder)])))
    facts: dict[str, Any] = json.loads(known.read_text())
    if "skipped" not in facts:
        facts |= in_process(__name__, [localize.__name__, task, str(folder)])
    return scale_row(task.case, task.contender, task.places, **{"threads": task.threads} | facts)


class Folder:
    """The descriptors of all cases, each made once, in files named by their `source`.

    "drawn": of frames. "made": with the statistics of those, see `MadeRoute`. "tiles", "flown": of ground
    that repeats, from its two tiles, see `TiledRoute`, and from frames.

    Args:
        path: an empty folder. drawn: places of `sim:aerial`, of which the first ones train the whitening.
    """

    def __init__(self, path: Path, drawn: int) -> None:
        self.path, self.model = path, DejaVu(HOG())  # `tiles_of` splits it
        first, self.second = AerialRoad(frames=drawn), AerialRoad(frames=drawn, traverse=1)
        self.model.descriptor.learn(frame_range(first, 0, min(drawn, DESCRIBED)))
        self.keep("drawn", drawn, self.seen(first, range(drawn)))
        shown, places = spread(drawn), torch.from_numpy(np.load(path / "drawn.npy"))
        self.like: Likeness = likeness(places, self.described(self.second, shown), shown)

    def make(self, places: int) -> None:
        """Make descriptors like those drawn; shorter routes are their first places."""
        self.keep("made", places, MadeRoute(self.like, places).batches(ROWS))

    def draw_again(self, places: int, flown: int) -> None:
        """Make descriptors of ground that repeats, from its tiles and from a flight over its first places."""
        self.keep("tiles", places, TiledRoute(**tiles_of(self.model), length=places).batches(ROWS))
        if flown:
            self.keep("flown", flown, self.seen(AerialRoad(frames=flown, ground="repeat"), range(flown)))

    def ask(self, case: str, source: str, places: int) -> None:
        """Describe the queries of a case: frames of a second flight, evenly along the route."""
        shown = spread(places)
        if source == "made":
            queries = MadeRoute(self.like, places).seen_again(shown)
        elif source == "drawn":
            queries = self.described(self.second, shown)
        else:
            queries = self.described(AerialRoad(frames=places, ground="repeat", traverse=1), shown)
        save_file({"queries": queries, "truth": shown}, self.path / f"{case}.safetensors")

    def described(self, road: AerialRoad, shown: Tensor) -> Tensor:
        step = int(shown[1] - shown[0])
        return torch.cat(list(self.seen(road, range(0, step * len(shown), step))))

    @torch.no_grad()
    def seen(self, road: AerialRoad, frames: range) -> Iterator[Tensor]:
        for part in Part(road, frames).batches(64):
            yield self.model.descriptor.whitened(self.model.descriptor.describe(part))

    def keep(self, name: str, places: int, parts: Iterator[Tensor]) -> None:
        """Write descriptors as they are made.

        Raises:
            InputError: they do not fit.
        """
        bar = tqdm(total=places, desc=name, disable=None, leave=False)
        try:
            with bar, (self.path / f"{name}.npy").open("wb") as file:
                for part in parts:
                    if not file.tell():
                        shape, kind = (places, part.shape[1]), np.dtype(np.float32).str
                        head = {"descr": kind, "fortran_order": False, "shape": shape}
                        np.lib.format.write_array_header_1_0(file, head)
                    file.write(part.numpy().tobytes())
                    bar.update(len(part))
        except OSError as error:
            raise InputError(
                f"{places} descriptors do not fit into {self.path}: {error.strerror}; "
                "expected room there, or TMPDIR set to a folder with room"
            ) from error


def spread(places: int) -> Tensor:
    """The places of the queries, (Q,), evenly along the route."""
    count = min(QUERIES, places)
    return torch.arange(count) * (places // count)


def bench_scale(
    places: Sequence[int] = (), device: str = "cpu", contenders: Sequence[str] = ()
) -> Iterator[Row]:
    """All contenders at all sizes, a row at a time.

    Args:
        places: N of each size, `PLACES` if not given. device: for our maps to localize on.
        contenders: only these of the cases `places=N`, and no other cases.

    Yields:
        Rows of the cases `places=N`: `sim:aerial` up to `RENDERED` places, for more descriptors with its
        statistics, see `MadeRoute`; `made=N`: such descriptors at a size that is also drawn; `repeat=N`:
        ground that repeats, see `TiledRoute`; `templates=N`: see `bench_templates`.

    Raises:
        InputError: too few or too many places, an unknown contender, or descriptors that do not fit.
    """
    if unknown := set(contenders) - PLACED.keys():
        raise InputError(f"contenders are {sorted(unknown)}; expected some of {list(PLACED)}")
    sizes = sorted(set(places or PLACES))
    if sizes[0] < FEWEST or sizes[-1] > MOST:
        raise InputError(f"bench scale got places {sizes}; expected {FEWEST} to {MOST} each")
    made = [n for n in sizes if n > RENDERED]
    placed = contenders or [name for name in PLACED if name not in REQUESTED]
    whole = [] if places or contenders else [LONGEST["repeat"]]  # cycles of both tiles
    repeating = [] if contenders else [n for n in sizes if n <= LONGEST["repeat"]] + whole
    with temporary_folder(Path(tempfile.gettempdir())) as path:
        folder = Folder(path, RENDERED if made else sizes[-1])
        if made:
            folder.make(sizes[-1])
        if repeating:
            folder.draw_again(repeating[-1], max([n for n in repeating if n <= RENDERED], default=0))
        for n in sizes:
            if n in made[:1] and not contenders:  # check made descriptors before using them
                yield from rows_of(folder, "made", "made", CHECKED, device, placed)
            yield from rows_of(folder, "places", "made" if n in made else "drawn", n, device, placed)
            if n in repeating:
                yield from rows_of(folder, "repeat", "tiles", n, device, REPEATED)
        for n in whole:
            yield from rows_of(folder, "repeat", "tiles", n, device, REPEATED)
    if contenders:
        return
    for row in bench_templates(sizes if places else TEMPLATES):  # batches are no faster than single queries
        count, size = int(row["case"].partition("=")[2]), row["file_bytes"]
        same = {key: row[key] for key in ("seconds", "peak_bytes", "threads", "skipped", "difference")}
        same |= {"seconds_one": row["seconds"], "route_bytes": size, "bytes_per_place": size and size / count}
        yield scale_row(row["case"], row["contender"], count, **same)


def rows_of(
    folder: Folder, kind: str, source: str, places: int, device: str, names: Iterable[str]
) -> Iterator[Row]:
    """The rows of a case, `kind=places`."""
    case, threads = f"{kind}={places}", torch.get_num_threads()
    folder.ask(case, source, places)
    room = step = 0.0
    for name in names:
        if places > SHUFFLED and (name == FLOWN or name.startswith("null")):
            why = "noisy frames are drawn" if name == FLOWN else "shuffled orders are"
            yield scale_row(case, name, places, skipped=f"{why} of at most {SHUFFLED} places")
            continue
        of = "flown" if name == FLOWN else source
        row = measured(Task(case, name, of, places, threads, device, room, step), folder.path)
        if name == ONE_CHUNK:
            room, step = row["bytes_per_place"] or 0.0, row["step"] or 0.0
        yield row


def run_scale(
    *, out: Path, places: Sequence[int] = (), device: str = "cpu", contenders: Sequence[str] = ()
) -> list[str]:
    """Time, memory, bytes and accuracy over the number of places, against the indexes of faiss.

    Args:
        out: folder for bench.json and bench.png
        places: numbers of places; 10000, 100000 and 1000000 if not given
        device: device to localize on, as in `dejavu localize`
        contenders: names of contenders to run, in this order; all but "usearch int8" if not given
    """
    device = str(device_of(device))
    rows: list[Row] = []
    facts: dict[str, Any] = {"tolerance": TOLERANCE, "device": device, "faiss": FAISS}
    bar = tqdm(bench_scale(places, device, contenders), "rows", disable=None, leave=False)
    try:
        for row in bar:
            rows = with_ratios([*rows, row])
            write_bench(out, rows, exponents=exponents(rows), **facts)
            if not bar.disable:
                bar.write(f"{row['case']}: {row['contender']}", sys.stderr)
    finally:  # even if a later row fails
        panels = pictured(rows)
        if panels:
            picture = plot_growth(panels, linear=[RECALL])
            write_bench(out, rows, picture, exponents=exponents(rows), **facts)
    return [*scale_tables(rows), f"recall within {TOLERANCE} places; localized on one thread"]


def limit_memory() -> None:
    """Let the system refuse this process more than `MEMORY`, if it can."""
    with suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))


if __name__ == "__main__":
    what, given, place = json.loads(sys.argv[1])
    with suppress(ImportError):  # loaded before measuring, like the loops that numba compiles
        import faiss  # noqa: F401
    for module in (codec, distance):
        module._compiled()
    limit_memory()
    give_back()
    done = {"learn": learn, "localize": localize}[what](Task(*given), Path(place))
    sys.stdout.write(json.dumps(done) + "\n")
