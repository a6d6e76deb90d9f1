"""The contenders of `benchmarks scale`: ways to store descriptors and to find the nearest one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from benchmarks.measure import OURS, Find, Store
from benchmarks.repeating import step_that_holds
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.coarse import searcher
from dejavu_torch.recognition.search import Search
from dejavu_torch.types import Traverse

ROWS = 8192  # descriptors read together
CHUNK = 8192
SHARE = 0.8  # of the variance of a repeating route
TRAINED, ROTATED = 100_000, 20_000  # most samples to train an index of faiss, and its rotation
CELLS_PER_PROBE, PROBED_AT_LEAST = 32, 32  # in an inverted file
EF_SEARCH = 64  # candidates while a graph is searched


class Mapped(Store):
    """Our map, of frames with the default whitening (None), or of descriptors ("none").

    Args:
        shuffled: learn in random order, the null. search: see `DejaVu.localize`.
    """

    model: DejaVu  # after loading

    def __init__(
        self,
        mapper: SpectralMapper | TemplateMapper,
        whitening: Literal["none"] | None = "none",
        shuffled: bool = False,
        search: Search = "auto",
    ) -> None:
        self.mapper, self.whitening, self.shuffled, self.search = mapper, whitening, shuffled, search

    def prepare(self, route: Traverse) -> float | None:
        return getattr(self.mapper, "step", None)

    def learn(self, route: Traverse, path: Path) -> int:
        model = DejaVu(whitening=self.whitening, mapper=self.mapper)
        if self.shuffled:
            order = torch.randperm(len(route), generator=torch.Generator().manual_seed(0))
            rows = torch.cat(list(route.batches(ROWS)))
            model.learn(rows[order])
            np.save(path.with_suffix(".npy"), order.numpy())
        else:
            model.learn(route)
        model.save(path)
        return model.map.summary().route_bytes

    def load(self, path: Path, device: str = "cpu") -> Find:
        self.model = DejaVu.load(path).to(device)
        self.model.make_searcher = partial(searcher, method=self.search)
        locate = self.model.localize_descriptors if self.whitening else self.model.localize
        order = torch.from_numpy(np.load(path.with_suffix(".npy"))) if self.shuffled else None

        def find(queries: Tensor) -> tuple[Tensor, Tensor]:
            match = locate(queries.to(device))
            index = match.index.cpu()
            return match.score.cpu(), index if order is None else order[index]

        return find


class Held(Mapped):
    """Our map with the step that holds `SHARE` of the variance of a route."""

    mapper: SpectralMapper

    def prepare(self, route: Traverse) -> float | None:
        self.mapper.step = step_that_holds(SHARE, route, self.mapper.chunk)
        return self.mapper.step


class Faiss(Store):
    """An index of faiss over descriptors of length 1.

    Args:
        factory: key for `faiss.index_factory`; {cells} stands for the number of cells of an inverted file.
        probes: number of cells to search; None chooses it by `CELLS_PER_PROBE`.
    """

    def __init__(self, factory: str, probes: int | None = None) -> None:
        self.factory, self.probes = factory, probes

    def parts(self, route: Traverse) -> Iterable[Tensor]:
        """The descriptors of a route to store, in batches."""
        return route.batches(ROWS)

    def describe(self, queries: Tensor) -> Tensor:
        return queries

    def learn(self, route: Traverse, path: Path) -> int:
        import faiss

        faiss.omp_set_num_threads(torch.get_num_threads())
        every = -(-len(route) // TRAINED)
        cells = max(1, min(4 * math.isqrt(len(route)), -(-len(route) // every) // 40))
        numbers = self.describe(route.read(range(1))).shape[1]
        index: Any = faiss.index_factory(numbers, self.factory.format(cells=cells))
        if isinstance(
            index, faiss.IndexPreTransform
        ):  # without this limit, training it takes longer than all the rest
            chain: Any = index.chain
            rotation: Any = faiss.downcast_VectorTransform(chain.at(0))
            rotation.max_train_points = ROTATED
        if not index.is_trained:
            index.train(route[::every].numpy())
        faiss.write_index(index, str(path))
        empty = path.stat().st_size
        for part in self.parts(route):
            index.add(part.numpy())
        faiss.write_index(index, str(path))
        names = 8 * len(route) if "IVF" in self.factory else 0
        return path.stat().st_size - empty - names

    def load(self, path: Path, device: str = "cpu") -> Find:
        import faiss

        faiss.omp_set_num_threads(torch.get_num_threads())
        index: Any = faiss.read_index(str(path))
        if "IVF" in self.factory:
            cells = faiss.extract_index_ivf(index)
            cells.nprobe = self.probes or max(PROBED_AT_LEAST, cells.nlist // CELLS_PER_PROBE)
        elif "HNSW" in self.factory:
            index.hnsw.efSearch = EF_SEARCH

        def find(queries: Tensor) -> tuple[Tensor, Tensor]:
            score, place = index.search(self.describe(queries).numpy(), 1)
            return torch.from_numpy(score[:, 0]), torch.from_numpy(place[:, 0])

        return find


class Usearch(Store):
    """A graph of usearch over descriptors of length 1, in 8 bits per dimension."""

    def learn(self, route: Traverse, path: Path) -> int:
        from usearch.index import Index

        index: Any = Index(ndim=route.frame_shape[0], metric="cos", dtype="i8")
        for first, part in zip(range(0, len(route), ROWS), route.batches(ROWS), strict=True):
            index.add(np.arange(first, first + len(part)), part.numpy(), threads=torch.get_num_threads())
        index.save(str(path))
        return path.stat().st_size - 8 * len(route)  # names

    def load(self, path: Path, device: str = "cpu") -> Find:
        from usearch.index import Index

        index: Any = Index.restore(str(path))
        index.expansion_search = EF_SEARCH

        def find(queries: Tensor) -> tuple[Tensor, Tensor]:
            found = index.search(queries.numpy(), 1, threads=torch.get_num_threads())
            place = torch.from_numpy(found.keys.reshape(-1).astype(np.int64))
            return torch.from_numpy(found.distances.reshape(-1)), place

        return find


class Interpolated(Store):
    """Every k-th descriptor in int8, interpolated, in this many bytes per place."""

    def __init__(self, room: float) -> None:
        self.room = room

    def learn(self, route: Traverse, path: Path) -> int:
        from dejavu_torch.evaluation.baselines import as_int8, keyframes

        each = route.frame_shape[0]
        k = max(1, math.ceil((len(route) - 1) / max(1, self.room * len(route) // each - 1)))
        chosen = keyframes(len(route), k)
        rows = route[chosen]
        scale = rows.abs().max() / 127
        small = (as_int8(rows) / scale).round().to(torch.int8)
        save_file({"keys": small, "scale": scale.view(1), "k": torch.tensor([k, len(route)])}, path)
        return small.nbytes

    def load(self, path: Path, device: str = "cpu") -> Find:
        from dejavu_torch.evaluation.baselines import between_keyframes

        state = load_file(path)
        keys = state["keys"].float() * state["scale"]
        k, places = state["k"].tolist()

        def find(queries: Tensor) -> tuple[Tensor, Tensor]:
            best = torch.full((len(queries),), -math.inf)
            index = torch.zeros(len(queries), dtype=torch.int64)
            pieces = max(1, ROWS // k)
            for start in range(0, places, k * pieces):
                ends = keys[start // k : start // k + pieces + 1]
                rows = between_keyframes(ends, min((len(ends) - 1) * k + 1, places - start), k)
                score, at = (queries @ torch.nn.functional.normalize(rows, dim=1).T).max(1)
                index = torch.where(score > best, at + start, index)
                best = torch.maximum(best, score)
            return -best, index

        return find


WHOLE = 2**31 - 1  # places of a chunk, more than any route has
ONE_CHUNK = f"{OURS}, one chunk"
FIXED = f"{OURS}, chunks of {CHUNK}"
FLOWN = f"{OURS}, one chunk, of noisy frames"

# functions of the route bytes per place and the step of `ONE_CHUNK` at this size, for contenders that use the
# same. "np" skips the training of faiss's filter by Hamming distances, which is slow and not used here
PLACED: dict[str, Callable[[float, float], Store]] = {
    f"{OURS} 1 B": lambda *_: Mapped(SpectralMapper(1.0, chunk=CHUNK)),
    f"{OURS} 1 B, scan": lambda *_: Mapped(SpectralMapper(1.0, chunk=CHUNK), search="scan"),
    f"{OURS} 4 B": lambda *_: Mapped(SpectralMapper(4.0, chunk=CHUNK)),
    f"{OURS} 4 B, scan": lambda *_: Mapped(SpectralMapper(4.0, chunk=CHUNK), search="scan"),
    f"{OURS} 1 B, one chunk": lambda *_: Mapped(SpectralMapper(1.0, chunk=WHOLE)),
    f"{OURS} 4 B, one chunk": lambda *_: Mapped(SpectralMapper(4.0, chunk=WHOLE)),
    "null 1 B": lambda *_: Mapped(SpectralMapper(1.0, chunk=CHUNK), shuffled=True),
    "null 4 B": lambda *_: Mapped(SpectralMapper(4.0, chunk=CHUNK), shuffled=True),
    "faiss flat": lambda *_: Faiss("Flat"),
    "faiss IVF-PQ, 4 B": lambda *_: Faiss("IVF{cells},PQ4np"),
    "faiss IVF-PQ, 8 B": lambda *_: Faiss("IVF{cells},PQ8np"),
    "faiss IVF-PQ, 16 B": lambda *_: Faiss("IVF{cells},PQ16np"),
    "faiss IVF-PQ, 32 B": lambda *_: Faiss("IVF{cells},PQ32np"),
    "faiss IVF-PQ, 32 B, 64 probes": lambda *_: Faiss("IVF{cells},PQ32np", 64),
    "faiss IVF-PQ FastScan, 32 B, refined": lambda *_: Faiss("IVF{cells},PQ64x4fs,RFlat"),
    "faiss OPQ, IVF-PQ, 16 B": lambda *_: Faiss("OPQ16,IVF{cells},PQ16np"),
    "faiss HNSW": lambda *_: Faiss("HNSW16,Flat"),
    "usearch int8": lambda *_: Usearch(),
}
REPEATED: dict[str, Callable[[float, float], Store]] = {
    ONE_CHUNK: lambda *_: Held(SpectralMapper(None, 1.0, WHOLE)),
    FIXED: lambda *_: Held(SpectralMapper(None, 1.0, CHUNK)),
    FLOWN: lambda _, step: Mapped(SpectralMapper(None, step, WHOLE)),
    "null": lambda room, _: Mapped(SpectralMapper(room, chunk=WHOLE), shuffled=True),
    "interpolated frames": lambda room, _: Interpolated(room),
}
CONTENDERS = PLACED | REPEATED
REQUESTED = ("usearch int8",)  # only measured if named: it is slow to learn 10^6 places
SEARCHED = ("scan", "64 probes")  # ways to search the file of the contender without them in its name
GIVEN = CONTENDERS.keys() - {
    ONE_CHUNK,
    FIXED,
    FLOWN,
}  # contenders whose bytes per place are set, not measured
