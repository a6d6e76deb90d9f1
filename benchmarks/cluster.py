"""How fast workers of a cluster make the chunks of a route, beside one process: `benchmarks cluster`."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch

from benchmarks.measure import Column, Row, bars, new_row, table, with_ratios, write_bench
from dejavu_torch.cluster import Cluster, code_on
from dejavu_torch.data.arrays import read_array
from dejavu_torch.data.frame_range import FrameRange
from dejavu_torch.data.output import check_output_folder
from dejavu_torch.data.simulate.aerial import AerialRoad
from dejavu_torch.learning import ChunkCoder, encode_local
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import Chunk, SpectralMap
from dejavu_torch.model import DejaVu
from dejavu_torch.types import Traverse

CHUNK = 128  # places
COLUMNS: dict[str, Column] = {
    "seconds": ("seconds", ".2f"),
    "times as fast as the first": ("faster", ".2f"),
    "processor seconds": ("cpu_seconds", ".2f"),
    "other chunks": ("difference", ".0%"),
}
SAMPLE = 1000  # frames that whitening, mean and step are learned from


def run_cluster(out: Path, frames: int = 8192, repeats: int = 3) -> list[Row]:
    """Time the chunks of frames of sim:aerial, drawn beforehand, and write bench.json and bench.png.

    Args:
        frames: of the route. repeats: timed runs of each contender, in turn; the best counts.

    Convention: workers have started, and have what they need, before time counts. All contenders but the one
        with several threads make the same bytes, which is checked; with several threads matrix products
        round otherwise, so that no map is made so.

    Raises:
        InputError: Ray is not there, or a folder that cannot be written in.
    """
    check_output_folder(out)
    with tempfile.TemporaryDirectory() as folder, Cluster() as cluster:
        path = Path(folder) / "route.npy"
        pictures = AerialRoad(frames=frames).batches(64)
        np.save(path, np.concatenate([(255 * one.permute(0, 2, 3, 1)).byte().numpy() for one in pictures]))
        route = read_array(path)
        rows = _timed(_contenders(_coder(route), route, cluster), frames, repeats)
    write_bench(out, rows, bars(rows))
    return rows


def _coder(route: Traverse) -> ChunkCoder:
    model = DejaVu(mapper=SpectralMapper(4.0, chunk=CHUNK)).learn(FrameRange(route, stop=SAMPLE))
    assert isinstance(model.map, SpectralMap)
    return ChunkCoder.like(model.map, model.describer, route.count())


def _contenders(
    coder: ChunkCoder, route: Traverse, cluster: Cluster
) -> dict[tuple[str, int], Callable[[], list[Chunk]]]:
    """By name and number of threads in all: what makes all chunks."""

    def here() -> list[Chunk]:
        return [*encode_local(coder, route, 0)]

    def threaded() -> list[Chunk]:
        threads = torch.get_num_threads()
        torch.set_num_threads(cluster.workers)
        try:
            return [*coder.chunks(route, range(coder.total))]
        finally:
            torch.set_num_threads(threads)

    def one_worker() -> list[Chunk]:
        return [*code_on(cluster, coder, route, 0, together=coder.total)]

    def workers() -> list[Chunk]:
        return [*code_on(cluster, coder, route, 0)]

    return {
        ("dejavu, one process", 1): here,
        (f"dejavu, one process, {cluster.workers} threads", cluster.workers): threaded,
        ("dejavu, 1 worker", 1): one_worker,
        (f"dejavu, {cluster.workers} workers", cluster.workers): workers,
    }


def cluster_table(rows: Sequence[Row]) -> list[list[str]]:
    """The figures as rows of text, the header first."""
    faster = [row | {"faster": rows[0]["seconds"] / row["seconds"]} for row in rows]
    return table(faster, COLUMNS, "{contender}")


def _timed(
    contenders: dict[tuple[str, int], Callable[[], list[Chunk]]], frames: int, repeats: int
) -> list[Row]:
    seconds: dict[tuple[str, int], list[float]] = {key: [] for key in contenders}
    busy: dict[tuple[str, int], list[float]] = {key: [] for key in contenders}
    sums: dict[tuple[str, int], list[int]] = {}
    for _ in range(1 + repeats):
        for key, make in contenders.items():
            began, spent = time.perf_counter(), processor_time()
            chunks = make()
            seconds[key].append(time.perf_counter() - began)
            busy[key].append(processor_time() - spent)
            sums[key] = [one.stream.checksum for one in chunks]
    first = next(iter(sums.values()))
    rows = []
    for (name, threads), times in seconds.items():
        key = name, threads
        others = sum(a != b for a, b in zip(sums[key], first, strict=True)) / len(first)
        row = new_row(f"chunks of {frames} frames", name, threads=threads, difference=others)
        row |= {"seconds": min(times[1:]), "seconds_first": times[0], "cpu_seconds": min(busy[key][1:])}
        rows.append(row)
    return with_ratios(rows)


def processor_time() -> float:
    """Seconds that this process, and all that are there and began with it, have computed; of Linux, else of
    this one alone."""
    parents: dict[int, int] = {}
    ticks: dict[int, int] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError, IndexError):  # it has ended
            numbers = stat.read_text().rpartition(")")[2].split()
            parents[int(stat.parent.name)] = int(numbers[1])
            ticks[int(stat.parent.name)] = int(numbers[11]) + int(numbers[12])
    if not ticks:
        return time.process_time()
    own, count = {os.getpid()}, 0
    while len(own) > count:
        count = len(own)
        own |= {process for process, parent in parents.items() if parent in own}
    return sum(ticks[process] for process in own if process in ticks) / os.sysconf("SC_CLK_TCK")
