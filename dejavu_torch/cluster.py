"""Coding the chunks of a route, and searching parts of a map, on a Ray cluster."""

from __future__ import annotations

import importlib
import logging
import os
import signal
import socket
import sys
import sysconfig
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import Chunk, SpectralMap
from dejavu_torch.recognition.coarse import searcher
from dejavu_torch.recognition.search import NmsSpec, Search, TopK
from dejavu_torch.text import one_line
from dejavu_torch.types import InputError

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
AUTO = "auto"
RETRIES = 3  # of a task whose worker died
AHEAD = 2  # submitted tasks per worker
TASK = 1024  # minimum number of places per task
QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}  # no telemetry, no advice


class Cluster:
    """The workers of a Ray cluster, or of one started on this machine.

    Args:
        address: "auto" starts one worker for each processor of this machine; otherwise the address of a
            cluster, such as `10.0.0.1:6379`, or `ray://10.0.0.1:10001` from outside it.

    Convention: workers receive all that a task needs by value, including the user's code; this package has to
        be installed there. Relative paths are relative to this process's folder, if a worker has it.

    Raises:
        InputError: Ray is not installed, or there is no cluster at that address.
    """

    def __init__(self, address: str = AUTO) -> None:
        os.environ.update({name: value for name, value in QUIET.items() if name not in os.environ})
        self.ray: ModuleType = check_installed()
        logging.getLogger("ray").setLevel(logging.ERROR)
        quiet = {"log_to_driver": False, "logging_level": logging.ERROR, "configure_logging": False}
        handlers = {number: signal.getsignal(number) for number in SIGNALS}
        local = {"address": "local", "num_cpus": _processors(), "include_dashboard": False}
        try:
            self.ray.init(**(local if address == AUTO else {"address": address}), **quiet)
        except Exception as error:  # of any type
            seen = f"no Ray cluster at {address}: {one_line(error)[:200]}"
            raise InputError(f"{seen}; expected `auto`, or the address from `ray start --head`") from error
        finally:  # Ray replaces them
            for number, handler in handlers.items():
                signal.signal(number, handler)
        self.workers = max(1, int(self.ray.cluster_resources().get("CPU", 1)))

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: object) -> None:
        self.ray.shutdown()  # with the workers that `auto` started

    def map(self, encode: Callable[[range], Chunk], tasks: list[range]) -> Iterator[Chunk]:
        """As `map`: the same bytes in the same order. Short chunks are encoded several at a time, and the
        task of a dead worker runs again.

        Raises:
            InputError: a chunk failed; all chunks before it have been yielded.
        """
        together = max(1, TASK // max(len(task) for task in tasks))
        remote = self.ray.remote(num_cpus=1, max_retries=RETRIES)(_encode)
        with _by_value(self.ray, vars(encode).values()):
            sent = [self.ray.put(encode)]
        waiting = deque(tasks[i : i + together] for i in range(0, len(tasks), together))
        running: deque[tuple[list[range], object]] = deque()
        try:
            while waiting or running:
                while waiting and len(running) < AHEAD * self.workers:
                    task = waiting.popleft()
                    running.append((task, remote.remote(sent, task, os.getcwd())))
                task, reference = running[0]
                done, failure = self._result(reference)
                running.popleft()
                yield from done
                if failure:
                    raise InputError(f"frames {task[len(done)].start} to {task[-1].stop - 1}{failure}")
        finally:
            for _, reference in running:
                with suppress(Exception):
                    self.ray.cancel(reference, force=True)

    def _result(self, reference: object) -> tuple[list[Chunk], str]:
        try:
            return self.ray.get(reference)  # type: ignore[no-any-return]
        except self.ray.exceptions.RayTaskError:  # raised by our code
            raise
        except self.ray.exceptions.RayError as error:
            seen = f"its worker died, {RETRIES + 1} times ({one_line(error)[:100]})"
            return [], f": {seen}; expected workers that stay alive, with enough memory"


class ClusterSearch:
    """A `Searcher` of a spectral map, with consecutive chunks on each worker.

    Args:
        cluster: its workers hold the chunks; a worker that dies is started again.
        method: of each worker on its part. memory: bytes for the samples of all workers together.

    Convention: places equal those of a search in this process; scores may differ by the processor's rounding.

    Raises:
        InputError: a map of another kind; a worker that cannot be restarted.
    """

    def __init__(
        self, cluster: Cluster, place_map: PlaceMap, method: Search = "auto", memory: int | None = None
    ) -> None:
        if not isinstance(place_map, SpectralMap):
            raise InputError(f"a map of kind {place_map.kind!r} cannot be divided; expected a spectral one")
        seen = "the map of an area cannot be divided among workers"
        place_map.layout.expect_route("that of a route, or no --cluster", seen)
        actor = cluster.ray.remote(num_cpus=1, max_restarts=RETRIES, max_task_retries=RETRIES)(_Searcher)
        self.cluster, self.actors = cluster, []
        self.parts: list[object] = []  # kept for restarted actors
        starts, workers = [start for start, _ in place_map.chunks], cluster.workers
        bounds = [bisect_left(starts, worker * place_map.places / workers) for worker in range(workers)]
        for first, stop in pairwise([*bounds, len(starts)]):
            if first < stop:
                self.parts.append(cluster.ray.put(place_map.between(first, stop).cpu()))
                how = method, None if memory is None else memory // workers
                self.actors.append(actor.remote(self.parts[-1], starts[first], *how))

    @torch.no_grad()
    def __call__(self, queries: Tensor, wanted: list[NmsSpec]) -> TopK:
        """Scores and places that include the wanted candidates."""
        try:
            answers = self.cluster.ray.get(
                [actor.search.remote(queries.cpu().numpy(), wanted) for actor in self.actors]
            )
        except self.cluster.ray.exceptions.RayError as error:
            seen = f"a worker died with its part of the map ({one_line(error)[:100]})"
            raise InputError(f"{seen}; expected workers that stay alive, with enough memory") from error
        columns = zip(*answers, strict=True)
        score, place = (torch.cat([torch.from_numpy(one.copy()) for one in column], 1) for column in columns)
        return score, place


class _Searcher:
    """Searches a part of a map, which begins at place `first`."""

    def __init__(self, part: SpectralMap, first: int, method: Search, memory: int | None) -> None:
        torch.set_num_threads(1)
        self.first = first
        self.searcher = searcher(part, method, memory)

    def search(self, queries: np.ndarray, wanted: list[NmsSpec]) -> tuple[np.ndarray, np.ndarray]:
        """Scores and places that include the wanted candidates of the part, as arrays."""
        score, place = self.searcher(torch.from_numpy(queries.copy()), wanted)
        return score.numpy(), torch.where(score.isfinite(), place + self.first, place).numpy()


def check_installed() -> ModuleType:
    """The module `ray`; InputError if it is not installed."""
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        seen = f"Ray cannot be imported ({one_line(error)})"
        raise InputError(f"{seen}; expected it: pip install 'dejavu_torch[cluster]'") from error


def _processors() -> int:
    """Processors that this process may use, or all of them if the system does not say."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@lru_cache(1)
def _received(reference: Hashable) -> Any:
    """The encoder, unpacked once by each worker process instead of for each task."""
    return check_installed().get(reference)


def _encode(sent: list[Hashable], tasks: list[range], folder: str) -> tuple[list[Chunk], str]:
    """In a worker: the chunks of some tasks, and the error that ended them early, or ""."""
    with suppress(OSError):
        os.chdir(folder)
    encode: Callable[[range], Chunk] = _received(sent[0])
    chunks: list[Chunk] = []
    try:
        chunks.extend(map(encode, tasks))
    except (InputError, OSError, RuntimeError, MemoryError) as error:
        kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        return chunks, f", read on {socket.gethostname()}: {kind}{one_line(error)}"
    return chunks, ""


@contextmanager
def _by_value(ray: ModuleType, values: Iterable[object]) -> Iterator[None]:
    """Sends classes from the user's own files as code, since workers do not have these files."""
    modules = {module.__name__: module for value in values for module in _modules_of(value)}
    for module in modules.values():
        ray.cloudpickle.register_pickle_by_value(module)
    try:
        yield
    finally:
        for module in modules.values():
            ray.cloudpickle.unregister_pickle_by_value(module)


def _modules_of(value: object) -> Iterator[ModuleType]:
    """The modules from the user's own files that define the classes of a value and its parts."""
    if isinstance(value, tuple | list):
        for item in value:
            yield from _modules_of(item)
    for part in value.modules() if isinstance(value, nn.Module) else [value]:
        module = part if isinstance(part, ModuleType) else sys.modules.get(type(part).__module__)
        file = getattr(module, "__file__", None)
        if module is None or file is None or module.__name__.split(".")[0] in ("__main__", "dejavu_torch"):
            continue
        installed = {Path(place).resolve() for place in sysconfig.get_paths().values()}
        if not any(Path(file).resolve().is_relative_to(place) for place in installed):
            yield module
