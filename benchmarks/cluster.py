"""`benchmarks cluster`: how fast workers encode the chunks of a route, against one process."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from benchmarks.measure import Column, Contender, Row, bars, new_row, table, threads, with_ratios, write_bench
from dejavu_torch.cluster import Cluster
from dejavu_torch.data.arrays import read_array
from dejavu_torch.data.simulate.aerial import AerialRoad
from dejavu_torch.data.traverse import Part, frame_range
from dejavu_torch.learning import ChunkEncoder
from dejavu_torch.maps.spectral import SpectralMapper, encode_chunk
from dejavu_torch.maps.spectral_map import Chunk, SpectralMap
from dejavu_torch.model import DejaVu

CHUNK = 128  # places
SAMPLE = 1000  # frames to learn whitening, mean and step from
FRAMES, REPEATS = 8192, 3  # frames; timed runs of each contender, in turn, of which the best counts
COLUMNS: dict[str, Column] = {
    "seconds": ("seconds", ".2f"),
    "times as fast as the first": ("faster", ".2f"),
    "processor seconds": ("cpu_seconds", ".2f"),
    "other chunks": ("difference", ".0%"),
}


def run_cluster(*, out: Path) -> list[str]:
    """Time of the workers of a cluster, against one process.

    Args:
        out: folder for bench.json and bench.png

    Convention: drawing the frames of sim:aerial and starting the workers is not timed. All contenders make
        the same bytes, which is checked, except the one with several threads, whose matrix products round
        differently; no map is made that way.

    Raises:
        InputError: Ray is not installed.
    """
    with tempfile.TemporaryDirectory() as folder, Cluster() as cluster:
        path = Path(folder) / "route.npy"
        pictures = AerialRoad(frames=FRAMES).batches(64)
        np.save(path, np.concatenate([(255 * one.permute(0, 2, 3, 1)).byte().numpy() for one in pictures]))
        route = read_array(path)
        model = DejaVu(mapper=SpectralMapper(4.0, chunk=CHUNK)).learn(frame_range(route, stop=SAMPLE))
        known = model.map
        assert isinstance(known, SpectralMap)
        settings = known.means[-1], known.step, known.transform, known.resolution
        rows = timed(contenders_of(ChunkEncoder(route, model.descriptor, *settings), cluster))
    write_bench(out, rows, bars(rows))
    faster = [row | {"faster": rows[0]["seconds"] / row["seconds"]} for row in rows]
    note = "other chunks: share that differ from those of one process; processor seconds: of all processes"
    return [table(faster, COLUMNS, "{contender}"), note]


def contenders_of(encode: ChunkEncoder, cluster: Cluster) -> list[Contender]:
    """What encodes all chunks; threads: of all processes together."""
    tasks = [range(i, i + CHUNK) for i in range(0, FRAMES, CHUNK)]

    def every(_: range) -> Any:  # in one task
        return [*map(encode, tasks)]

    def threaded() -> list[Chunk]:
        with threads(cluster.workers), torch.no_grad():
            parts = (encode.descriptor.batches(Part(encode.traverse, task)) for task in tasks)
            settings = encode.mean, encode.step, encode.transform, encode.resolution
            return [encode_chunk(torch.cat([*part]), *settings) for part in parts]

    def works(name: str, count: int, work: Callable[[], list[Chunk]]) -> Contender:
        return Contender(name, lambda: work, count)

    workers = cluster.workers
    return [
        works("dejavu, one process", 1, lambda: [*map(encode, tasks)]),
        works(f"dejavu, one process, {workers} threads", workers, threaded),
        works("dejavu, 1 worker", 1, lambda: cast(Any, next(cluster.map(every, [range(FRAMES)])))),
        works(f"dejavu, {workers} workers", workers, lambda: [*cluster.map(encode, tasks)]),
    ]


def timed(contenders: list[Contender]) -> list[Row]:
    """Time all in turn, round after round, and compare the chunks with those of the first."""
    times: list[list[tuple[float, float]]] = [[] for _ in contenders]
    sums: list[list[int]] = [[] for _ in contenders]
    for _ in range(1 + REPEATS):
        for i, one in enumerate(contenders):
            began, spent = time.perf_counter(), processor_time()
            chunks = one.prepare()()
            times[i].append((time.perf_counter() - began, processor_time() - spent))
            sums[i] = [chunk.stream.checksum for chunk in chunks]
    rows = []
    for one, own, made in zip(contenders, times, sums, strict=True):
        seconds, busy = zip(*own, strict=True)
        facts = {"seconds": min(seconds[1:]), "seconds_first": seconds[0], "cpu_seconds": min(busy[1:])}
        others = float(np.mean(np.array(made) != np.array(sums[0])))
        case = f"chunks of {FRAMES} frames"
        rows.append(new_row(case, one.name, threads=one.threads, difference=others, **facts))
    return with_ratios(rows)


def processor_time() -> float:
    """Processor seconds of this process and its running descendants; without /proc of this process alone."""
    parents: dict[int, int] = {}
    ticks: dict[int, int] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError, ValueError, IndexError):  # a process that has ended
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
