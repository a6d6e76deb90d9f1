"""Memory of learning a route and of finding places on it, as `benchmarks memory` measures it."""

from __future__ import annotations

import ctypes
import gc
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor
from tqdm import tqdm

from benchmarks.matcher import MEMORY, Row, bars, peak_memory, resident, write_bench
from benchmarks.plots import plot_ratios
from dejavu_torch.data.frame_range import IndexedTraverse
from dejavu_torch.data.output import check_output_folder, temporary_folder, whole_folder
from dejavu_torch.data.simulate.aerial import HEIGHT, VIEW, paint_route
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.maps.distance import l1_backend
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.types import InputError, Traverse

PLACES = (1000, 10_000, 50_000)
QUERIES = (100, 10_000)
FEWEST = 64  # places that every contender can learn
PIECE = 4096  # frames painted at a time
TRIAL = 16  # frames of the route that loads what is loaded late
TOLERANCE = 5  # frames
NAMES = ("places", "queries")  # of the two drives' files
OURS = "dejavu"
LOADED = "programs loaded"


class Contender(ABC):
    """A way to keep a route in a file, and to find places on it."""

    @abstractmethod
    def learn(self, route: Traverse, path: Path) -> None:
        """Describe the frames of a route, and keep it in a file."""

    @abstractmethod
    def localize(self, path: Path, queries: Traverse) -> Tensor:
        """The place of each query on the route of a file, (Q,)."""


class Mapped(Contender):
    """Ours: a map."""

    def __init__(self, mapper: TemplateMapper | SpectralMapper) -> None:
        self.mapper = mapper

    def learn(self, route: Traverse, path: Path) -> None:
        DejaVu(mapper=self.mapper).learn(route).save(path)

    def localize(self, path: Path, queries: Traverse) -> Tensor:
        matches = DejaVu.load(path).matches(queries)
        return gathered((match.index for match in matches), queries)


class Held(Contender):
    """Descriptors of all frames in float32, compared with those of each query by one matrix product."""

    def __init__(self, whitened: bool) -> None:
        self.whitened = whitened

    def model(self) -> DejaVu:
        return DejaVu(whitening=Whitening() if self.whitened else "none")

    def learn(self, route: Traverse, path: Path) -> None:
        model = self.model()
        fixed = {}
        if model.whitening is None:
            held = gathered(model.describer.descriptors(route), route)
        else:
            held = model.describe_reference(route)
            fixed = model.whitening.state_dict()
        save_file({"held": held, **fixed}, path)

    def localize(self, path: Path, queries: Traverse) -> Tensor:
        model, state = self.model(), load_file(path)
        held = state.pop("held")
        if model.whitening is not None:
            model.whitening.load_state_dict(state)
        lengths = torch.linalg.vector_norm(held, dim=1).square()
        return gathered(
            ((lengths - 2 * part @ held.T).argmin(1) for part in model.describer.descriptors(queries)),
            queries,
        )


class Faiss(Contender):
    """HOG of all frames in a flat index of faiss."""

    def learn(self, route: Traverse, path: Path) -> None:
        import faiss

        index: Any = None
        for part in DejaVu(whitening="none").describer.descriptors(route):
            index = faiss.IndexFlatL2(part.shape[1]) if index is None else index
            index.add(part.numpy())
        faiss.write_index(index, str(path))

    def localize(self, path: Path, queries: Traverse) -> Tensor:
        import faiss

        faiss.omp_set_num_threads(torch.get_num_threads())
        index = faiss.read_index(str(path))
        parts = DejaVu(whitening="none").describer.descriptors(queries)
        return gathered((torch.from_numpy(index.search(part.numpy(), 1)[1][:, 0]) for part in parts), queries)


CONTENDERS: dict[str, Contender] = {
    OURS: Mapped(SpectralMapper()),
    "dejavu templates": Mapped(TemplateMapper()),
    "whitened, float32": Held(whitened=True),
    "HOG, float32": Held(whitened=False),
    "faiss, HOG": Faiss(),
}


def gathered(parts: Iterator[Tensor], traverse: Traverse) -> Tensor:
    """What is made of all frames of a traverse of known length, batch by batch, each written once.

    Many small tensors between large ones would keep the heap from being used again.
    """
    whole, done = torch.empty(0), 0
    for part in parts:
        whole = whole if done else part.new_empty(traverse.length or 0, *part.shape[1:])
        whole[done : done + len(part)] = part
        done += len(part)
    return whole


class Task(NamedTuple):
    """What one process measures.

    contender: of `CONTENDERS`. places: of the route; 0 only loads the programs. queries: that are localized;
    0 learns. threads: of torch.
    """

    contender: str
    places: int
    queries: int
    threads: int

    @property
    def case(self) -> str:
        if not self.places:
            return LOADED
        if not self.queries:
            return f"learn {self.places} frames"
        return f"localize {self.queries} queries, {self.places} places"

    def file(self, folder: Path) -> Path:
        """What the contender keeps of the route."""
        return folder / f"{list(CONTENDERS).index(self.contender)}-{self.places}"


def paint_drives(folder: Path, places: int) -> None:
    """Two drives over pieces of `sim:aerial`, one behind the other, the second in other light and with noise.

    Each is one long image, of which a frame is a window: thousands of frames take no memory of their own.

    Raises:
        InputError: no room for the files.
    """
    columns = places + VIEW
    pieces = [paint_route(PIECE, seed)[..., :PIECE] for seed in range(-(-columns // PIECE))]
    middle = (HEIGHT - VIEW) // 2
    image = torch.cat(pieces, 2)[:, middle : middle + VIEW, :columns]
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    for name, seen in zip(NAMES, (image, 0.85 * image + 0.02 * noise + 0.05), strict=True):
        pixels = (255 * seen.clamp(0, 1)).byte().permute(1, 2, 0).contiguous()
        try:
            np.save(folder / f"{name}.npy", pixels.numpy())
        except OSError as error:
            raise InputError(
                f"{len(NAMES) * pixels.nbytes / 1e6:.0f} MB do not fit into {folder}: {error.strerror}; "
                "expected room there, or TMPDIR set to a folder with room"
            ) from error


class Drive(IndexedTraverse):
    """The frames of a drive at some places.

    Args:
        image: of the drive, (VIEW,W,3). shown: (N,) the first column of each frame.
    """

    def __init__(self, image: NDArray[np.uint8], shown: Tensor) -> None:
        self.name, self.length = "drive", len(shown)
        self.windows = sliding_window_view(image, VIEW, 1).transpose(1, 0, 3, 2)
        self.shown = shown.numpy()

    def read(self, frames: range) -> Tensor:
        part = self.windows[self.shown[frames.start : frames.stop : frames.step]]
        return torch.from_numpy(part).permute(0, 3, 1, 2).float() / 255


def shown_by(queries: int, places: int) -> Tensor:
    """The places that queries show, (Q,): evenly along the route, from its start again where it ends."""
    return torch.arange(queries) * max(1, places // queries) % places


def measure(task: Task, folder: Path) -> dict[str, Any]:
    """Do the work of a task and watch the memory of this process, which has done nothing else.

    Convention: a trial on few frames goes ahead, which loads what is loaded late; what it leaves free is
        given back, so that the run cannot use it.

    Returns:
        The fields of a `Row` that it knows.
    """
    torch.set_num_threads(task.threads)
    contender, file = CONTENDERS[task.contender], task.file(folder)
    route, queries = (np.load(folder / f"{name}.npy") for name in NAMES)
    trial = file.with_suffix(".trial")
    contender.learn(Drive(route, torch.arange(TRIAL)), trial)
    contender.localize(trial, Drive(queries, torch.arange(1)))
    trial.unlink()
    l1_backend()
    give_back()
    if not task.places:
        return {"peak_bytes": resident() if MEMORY.exists() else None}
    shown = shown_by(task.queries or task.places, task.places)
    frames = Drive(queries if task.queries else route, shown)
    found = torch.empty(0)

    def run() -> None:
        nonlocal found
        if task.queries:
            found = contender.localize(file, frames)
        else:
            contender.learn(frames, file)

    began = time.perf_counter()
    peak = peak_memory(run)
    facts = {"seconds": time.perf_counter() - began, "peak_bytes": peak, "bytes": file.stat().st_size}
    if task.queries:
        right = (found - shown).abs() <= TOLERANCE
        facts["recall_at_1"] = float(right.double().mean())
    return facts


def give_back() -> None:
    """Return to the system what is free in the heap, where its library can."""
    gc.collect()
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)


def measured(task: Task, folder: Path) -> dict[str, Any]:
    """`measure` in a process of its own; why there are no figures where it fails."""
    return in_process(__name__, [task, str(folder)])


def in_process(module: str, arguments: object) -> dict[str, Any]:
    """What a module prints as JSON, run by itself on arguments; where it fails why, as `skipped`."""
    # without the current folder, from which nothing is imported
    search = os.pathsep.join(filter(None, sys.path))
    done = subprocess.run(
        [sys.executable, "-P", "-m", module, json.dumps(arguments)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": search},
        preexec_fn=end_with_parent if sys.platform == "linux" else None,
    )
    if done.returncode < 0:
        return {"skipped": f"ended by signal {-done.returncode}, such as for want of memory"}
    if done.returncode:
        return {"skipped": (done.stderr.strip().splitlines() or ["it failed"])[-1][:200]}
    facts: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return facts


def end_with_parent() -> None:
    """Have the system end this process when its parent ends, as by Ctrl-C."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def bench_memory(places: Sequence[int] = (), queries: Sequence[int] = QUERIES) -> Iterator[Row]:
    """Memory that each contender takes to learn routes and to localize on one, each time in a new process.

    Args:
        places: frames of the routes that are learned, `PLACES` where none is given. Queries are localized
            on the route of the middle size.
        queries: how many are localized at once, of frames of a second drive, evenly along the route.

    Yields:
        A row for each case and contender. peak_bytes: most memory during the run beyond what the process
        held before, when it had done all on `TRIAL` frames; a row "programs loaded" has that itself. bytes:
        of the file. seconds: of the only run.

    Raises:
        InputError: fewer than `FEWEST` places, or no query.
    """
    sizes = sorted(set(places or PLACES))
    if sizes[0] < FEWEST or min(queries) < 1:
        raise InputError(
            f"bench memory got places {sizes} and queries {list(queries)}; "
            f"expected at least {FEWEST} places and 1 query"
        )
    threads, middle = torch.get_num_threads(), sizes[len(sizes) // 2]
    cases = [(n, 0) for n in sizes] + [(middle, q) for q in queries]
    tasks = [Task(OURS, 0, 0, threads)]
    tasks += [Task(name, n, q, threads) for n, q in cases for name in CONTENDERS]
    with temporary_folder(Path(tempfile.gettempdir())) as folder:
        paint_drives(folder, sizes[-1])
        for task in tqdm(tasks, "memory", disable=None, leave=False):
            facts = measured(task, folder)
            if not task.queries and task.places != middle:
                task.file(folder).unlink(missing_ok=True)
            yield Row(task.case, task.contender, threads=threads, **facts)


def run_memory(out: Path, places: Sequence[int] = ()) -> list[Row]:
    """`bench_memory`, written as bench.json and bench.png into the folder `out`.

    Raises:
        InputError: as `bench_memory`, or a folder that cannot be made or written in.
    """
    check_output_folder(out)  # before the long work
    rows = with_ratios(list(bench_memory(places)))
    peaks = bars(rows, lambda row: row.peak_bytes and row.peak_bytes / 1e6)
    peaks.pop(LOADED, None)
    picture = plot_ratios(peaks, "memory at most, in MB; less is better") if peaks else None
    with whole_folder(out) as folder:
        write_bench(folder, rows, picture)
    return rows


def with_ratios(rows: Sequence[Row]) -> list[Row]:
    """The rows with their seconds over those of our fastest of the case."""
    fastest: dict[str, float] = {}
    for row in rows:
        if row.contender.startswith("dejavu") and row.seconds is not None:
            fastest[row.case] = min(row.seconds, fastest.get(row.case, row.seconds))
    return [
        row._replace(ratio_to_ours=row.seconds / fastest[row.case])
        if row.seconds is not None and row.case in fastest
        else row
        for row in rows
    ]


def memory_table(rows: Sequence[Row]) -> list[list[str]]:
    """The figures as rows of text, the header first.

    Example:
        >>> memory_table([Row("learn", "dejavu", 2.0, peak_bytes=3_000_000, bytes=10_000)])[1]
        ['learn: dejavu', '3.0', '0.01', '2.0', '', '']
    """

    def text(value: float | None, form: str, unit: float = 1) -> str:
        return "" if value is None else format(value / unit, form)

    head = ["", "peak MB", "file MB", "seconds", "recall@1", ""]
    body = [
        [
            f"{row.case}: {row.contender}",
            text(row.peak_bytes, ".1f", 1e6),
            text(row.bytes, ".2f", 1e6),
            text(row.seconds, ".1f"),
            text(row.recall_at_1, ".3f"),
            f"skipped: {row.skipped}" if row.skipped else "",
        ]
        for row in rows
    ]
    return [head, *body]


if __name__ == "__main__":
    given, place = json.loads(sys.argv[1])
    sys.stdout.write(json.dumps(measure(Task(*given), Path(place))) + "\n")
