"""Memory of learning a route and of finding places on it, as `benchmarks memory` measures it."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor
from tqdm import tqdm

from benchmarks.measure import (
    PROCESS,
    Column,
    Found,
    Opened,
    Row,
    Store,
    bars,
    give_back,
    in_process,
    new_row,
    peak_memory,
    resident,
    with_ratios,
    write_bench,
)
from dejavu_torch.data.frame_range import IndexedTraverse
from dejavu_torch.data.output import check_output_folder, temporary_folder
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
BATCH = 64  # queries
COLUMNS: dict[str, Column] = {
    "peak MB": ("peak_bytes", ".1f", 1e6),
    "file MB": ("bytes", ".2f", 1e6),
    "seconds": ("seconds", ".1f"),
    "recall@1": ("recall_at_1", ".3f"),
}


class Mapped(Store):
    """Ours: a map."""

    def __init__(self, mapper: TemplateMapper | SpectralMapper) -> None:
        self.mapper = mapper

    def learn(self, route: IndexedTraverse, path: Path) -> int:
        model = DejaVu(mapper=self.mapper).learn(route)
        model.save(path)
        return model.summary().route_bytes

    def load(self, path: Path, device: str = "cpu") -> Opened:
        model = DejaVu.load(path)

        def find(frames: Tensor) -> Found:
            match = model.localize(frames)
            return Found(match.score, match.index)

        return Opened(find)


class Held(Store):
    """Descriptors of all frames in float32, compared with those of each query by one matrix product."""

    def __init__(self, whitened: bool) -> None:
        self.whitened = whitened

    def model(self) -> DejaVu:
        return DejaVu(whitening=Whitening() if self.whitened else "none").eval()

    def learn(self, route: IndexedTraverse, path: Path) -> int:
        model = self.model()
        fixed = {}
        if model.whitening is None:
            held = gathered(model.describer.descriptors(route), route)
        else:
            held = model.describe_reference(route)
            fixed = model.whitening.state_dict()
        save_file({"held": held, **fixed}, path)
        return held.nbytes

    def load(self, path: Path, device: str = "cpu") -> Opened:
        model, state = self.model(), load_file(path)
        held = state.pop("held")
        if model.whitening is not None:
            model.whitening.load_state_dict(state)
        lengths = torch.linalg.vector_norm(held, dim=1).square()

        def find(frames: Tensor) -> Found:
            return Found(*(lengths - 2 * model.whitened(model.describe(frames)) @ held.T).min(1))

        return Opened(find)


class Faiss(Store):
    """HOG of all frames in a flat index of faiss."""

    def learn(self, route: IndexedTraverse, path: Path) -> int:
        import faiss

        index: Any = None
        for part in DejaVu(whitening="none").describer.descriptors(route):
            index = faiss.IndexFlatL2(part.shape[1]) if index is None else index
            index.add(part.numpy())
        faiss.write_index(index, str(path))
        return path.stat().st_size

    def load(self, path: Path, device: str = "cpu") -> Opened:
        import faiss

        faiss.omp_set_num_threads(torch.get_num_threads())
        index, model = faiss.read_index(str(path)), DejaVu(whitening="none").eval()

        def find(frames: Tensor) -> Found:
            score, place = index.search(model.describe(frames).numpy(), 1)
            return Found(torch.from_numpy(score[:, 0]), torch.from_numpy(place[:, 0]))

        return Opened(find)


CONTENDERS: dict[str, Store] = {
    OURS: Mapped(SpectralMapper()),
    "dejavu templates": Mapped(TemplateMapper()),
    "whitened, float32": Held(whitened=True),
    "HOG, float32": Held(whitened=False),
    "faiss, HOG": Faiss(),
}


@torch.no_grad()
def localize(store: Store, path: Path, queries: Traverse) -> Tensor:
    """The place of each query on the route of a file, (Q,)."""
    find = store.load(path).find
    return gathered((find(part).place for part in queries.batches(BATCH)), queries)


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
        What it knows of a row.
    """
    torch.set_num_threads(task.threads)
    contender, file = CONTENDERS[task.contender], task.file(folder)
    route, queries = (np.load(folder / f"{name}.npy") for name in NAMES)
    trial = file.with_suffix(".trial")
    contender.learn(Drive(route, torch.arange(TRIAL)), trial)
    localize(contender, trial, Drive(queries, torch.arange(1)))
    trial.unlink()
    l1_backend()
    give_back()
    if not task.places:
        return {"peak_bytes": resident() if PROCESS.exists() else None}
    shown = shown_by(task.queries or task.places, task.places)
    frames = Drive(queries if task.queries else route, shown)
    found = torch.empty(0)

    def run() -> None:
        nonlocal found
        if task.queries:
            found = localize(contender, file, frames)
        else:
            contender.learn(frames, file)

    began = time.perf_counter()
    peak = peak_memory(run)
    facts = {"seconds": time.perf_counter() - began, "peak_bytes": peak, "bytes": file.stat().st_size}
    if task.queries:
        right = (found - shown).abs() <= TOLERANCE
        facts["recall_at_1"] = float(right.double().mean())
    return facts


def measured(task: Task, folder: Path) -> dict[str, Any]:
    """`measure` in a process of its own; why there are no figures where it fails."""
    return in_process(__name__, [task, str(folder)])


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
            yield new_row(task.case, task.contender, **{"threads": threads} | facts)


def run_memory(out: Path, places: Sequence[int] = ()) -> list[Row]:
    """`bench_memory`, written as bench.json and bench.png into the folder `out`.

    Raises:
        InputError: as `bench_memory`, or a folder that cannot be made or written in.
    """
    check_output_folder(out)  # before the long work
    rows = with_ratios(list(bench_memory(places)))
    drawn = [row for row in rows if row["case"] != LOADED]
    write_bench(out, rows, bars(drawn, "peak_bytes", 1e6, label="memory at most, in MB; less is better"))
    return rows


if __name__ == "__main__":
    given, place = json.loads(sys.argv[1])
    sys.stdout.write(json.dumps(measure(Task(*given), Path(place))) + "\n")
