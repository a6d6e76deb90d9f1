"""`benchmarks memory`: memory for learning a route and for localizing on it."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor
from tqdm import tqdm

from benchmarks import scale_contenders
from benchmarks.measure import (
    OURS,
    PROCESS,
    Column,
    Find,
    Row,
    Store,
    bars,
    give_back,
    in_process,
    new_row,
    peak_memory,
    resident,
    table,
    with_ratios,
    write_bench,
)
from benchmarks.scale_contenders import Mapped
from dejavu_torch.data.output import temporary_folder
from dejavu_torch.data.simulate.aerial import HEIGHT, VIEW, paint_route
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.maps.distance import l1_backend
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.types import InputError, Traverse

PLACES = (1000, 10_000, 50_000)
QUERIES = (100, 10_000)
FEWEST = 64  # places that every contender can learn
PIECE = 4096  # frames painted together
TRIAL = 16  # frames of the trial run, which loads what is loaded late
TOLERANCE = 5  # frames
NAMES = ("places", "queries")  # of the two drives' files
LOADED = "programs loaded"
BATCH = 64  # queries
COLUMNS: dict[str, Column] = {
    "peak MB": ("peak_bytes", ".1f", 1e6),
    "file MB": ("bytes", ".2f", 1e6),
    "seconds": ("seconds", ".1f"),
    "recall@1": ("recall_at_1", ".3f"),
}


class Held(Store):
    """Descriptors of all frames in float32, compared with those of each query by one matrix product."""

    def __init__(self, whitened: bool) -> None:
        self.model = DejaVu(HOG(), Whitening() if whitened else "none").eval()

    def learn(self, route: Traverse, path: Path) -> int:
        model, fixed = self.model, {}
        if model.whitening is None:
            held = model.descriptor.all_of(route)
        else:
            held, fixed = model.descriptor.learn(route), model.whitening.state_dict()
        save_file({"held": held, **fixed}, path)
        return held.nbytes

    def load(self, path: Path, device: str = "cpu") -> Find:
        model, state = self.model, load_file(path)
        held = state.pop("held")
        if model.whitening is not None:
            model.whitening.load_state_dict(state)
        lengths = torch.linalg.vector_norm(held, dim=1).square()

        def find(frames: Tensor) -> tuple[Tensor, Tensor]:
            score, place = (lengths - 2 * model.descriptor(frames) @ held.T).min(1)
            return score, place

        return find


class Faiss(scale_contenders.Faiss):
    """HOG of all frames in an index of faiss."""

    def __init__(self) -> None:
        super().__init__("Flat")
        self.model = DejaVu(whitening="none").eval()

    def parts(self, route: Traverse) -> Iterable[Tensor]:
        return self.model.descriptor.batches(route)

    def describe(self, queries: Tensor) -> Tensor:
        return self.model.descriptor.describe(queries)


CONTENDERS: dict[str, Store] = {
    OURS: Mapped(SpectralMapper(), None),
    "dejavu templates": Mapped(TemplateMapper(), None),
    "whitened, float32": Held(whitened=True),
    "HOG, float32": Held(whitened=False),
    "faiss, HOG": Faiss(),
}


@torch.no_grad()
def localize(store: Store, path: Path, queries: Traverse) -> Tensor:
    """The place of each query on the route of a file, (Q,)."""
    find, found = store.load(path), []
    for part in queries.batches(BATCH):  # small tensors kept between large ones would fragment the heap
        found += find(part)[1].tolist()
    return torch.tensor(found)


def kept(folder: Path, contender: str, places: int) -> Path:
    """The file of a contender for a route."""
    return folder / f"{list(CONTENDERS).index(contender)}-{places}"


def paint_drives(folder: Path, places: int) -> None:
    """Two drives over consecutive pieces of `sim:aerial`, the second in other light and with noise.

    Each is one long image whose windows are the frames, so that thousands of frames need no memory.
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


class Drive(Traverse):
    """The frames of a drive: windows of an image (VIEW,W,3) that start at the columns `shown`, (N,)."""

    def __init__(self, image: NDArray[np.uint8], shown: Tensor) -> None:
        self.name = "drive"
        self.windows = sliding_window_view(image, VIEW, 1).transpose(1, 0, 3, 2)
        self.shown = shown.numpy()

    def __len__(self) -> int:
        return len(self.shown)

    def read(self, frames: range | list[int]) -> Tensor:
        part = self.windows[self.shown[frames]]
        return torch.from_numpy(part).permute(0, 3, 1, 2).float() / 255


def shown_by(queries: int, places: int) -> Tensor:
    """The places of the queries, (Q,): evenly along the route, which they pass again if there are more."""
    return torch.arange(queries) * max(1, places // queries) % places


def measure(contender: str, places: int, queries: int, threads: int, folder: Path) -> dict[str, Any]:
    """Measure the memory of this process, which has done nothing else: the facts of a row.

    Args:
        places: of the route; 0 only loads the programs. queries: number to localize; 0 learns.

    Convention: a trial on few frames first loads what is loaded late; the memory it frees is returned to the
        system, so that the run cannot reuse it.
    """
    torch.set_num_threads(threads)
    store, file = CONTENDERS[contender], kept(folder, contender, places)
    route, second = (np.load(folder / f"{name}.npy") for name in NAMES)
    trial = file.with_suffix(".trial")
    store.learn(Drive(route, torch.arange(TRIAL)), trial)
    localize(store, trial, Drive(second, torch.arange(1)))
    trial.unlink()
    l1_backend()
    give_back()
    if not places:
        return {"peak_bytes": resident() if PROCESS.exists() else None}
    shown = shown_by(queries or places, places)
    frames = Drive(second if queries else route, shown)
    found: list[Any] = []

    def run() -> None:
        found.append(localize(store, file, frames) if queries else store.learn(frames, file))

    began = time.perf_counter()
    peak = peak_memory(run)
    facts = {"seconds": time.perf_counter() - began, "peak_bytes": peak, "bytes": file.stat().st_size}
    if queries:
        facts["recall_at_1"] = float(((found[0] - shown).abs() <= TOLERANCE).double().mean())
    return facts


def bench_memory(places: Sequence[int] = (), queries: Sequence[int] = QUERIES) -> Iterator[Row]:
    """Memory that each contender needs to learn routes and to localize on one, each in a new process.

    Queries are frames of a second drive, evenly along the route of the middle size.

    Yields:
        A row for each case and contender. peak_bytes: most memory during the run, minus that after a trial on
        `TRIAL` frames, which the row "programs loaded" has. bytes: of the file. seconds: of the only run.
    """
    sizes = sorted(set(places or PLACES))
    if sizes[0] < FEWEST:
        raise InputError(f"bench memory got places {sizes}; expected at least {FEWEST} each")
    threads, middle = torch.get_num_threads(), sizes[len(sizes) // 2]
    learned = [(f"learn {n} frames", name, n, 0) for n in sizes for name in CONTENDERS]
    found = [
        (f"localize {q} queries, {middle} places", name, middle, q) for q in queries for name in CONTENDERS
    ]
    tasks = [(LOADED, OURS, 0, 0), *learned, *found]
    with temporary_folder(Path(tempfile.gettempdir())) as folder:
        paint_drives(folder, sizes[-1])
        for case, name, n, q in tqdm(tasks, "memory", disable=None, leave=False):
            facts = in_process(__name__, [name, n, q, threads, str(folder)])
            if n != middle:  # no queries
                kept(folder, name, n).unlink(missing_ok=True)
            yield new_row(case, name, **{"threads": threads} | facts)


def run_memory(*, out: Path, places: Sequence[int] = ()) -> list[str]:
    """Memory for learning a route and for localizing on it.

    Args:
        out: folder for bench.json and bench.png
        places: numbers of frames to learn; 1000, 10000 and 50000 if not given
    """
    rows = with_ratios(list(bench_memory(places)))
    drawn = [row for row in rows if row["case"] != LOADED]
    write_bench(out, rows, bars(drawn, "peak_bytes", 1e6, label="peak memory in MB; less is better"))
    return [table(rows, COLUMNS), "peak: without that of the loaded programs"]


if __name__ == "__main__":
    name, places, queries, threads, folder = json.loads(sys.argv[1])
    sys.stdout.write(json.dumps(measure(name, places, queries, threads, Path(folder))) + "\n")
