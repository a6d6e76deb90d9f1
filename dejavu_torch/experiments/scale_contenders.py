"""What stands side by side in `dejavu bench scale`: ways to keep descriptors, and to find the nearest."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from dejavu_torch.data.frame_range import IndexedTraverse
from dejavu_torch.database.spectral import SpectralMapper
from dejavu_torch.experiments.repeating import step_that_holds
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.search import Search

TRAINED = 100_000  # samples of an index at most
ROTATED = 20_000  # of one whose rotation is trained as well
ROWS = 8192  # descriptors read at a time
CHUNK = 8192
PROBES = 32  # of the cells of an inverted file
SHARE = 0.8  # of the variance of a repeating route
OURS = "dejavu"


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
