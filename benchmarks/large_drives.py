"""`benchmarks drives --large`: time and memory of whole drives on large maps."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.measure import Column, Row, give_back, in_process, new_row, peak_memory
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.recognition import drive as driving
from dejavu_torch.recognition.large import is_large
from dejavu_torch.recognition.localizer import Matching, answer
from dejavu_torch.recognition.scorer import OfMap
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.types import Match

NUMBERS, NOISE = 128, 3.0  # of a descriptor, and the length of the noise of a query's
SMOOTH, PART = 8, 100_000  # places that are alike, and that are made at a time
TOLERANCE, SINGLE = 5, 200  # places; queries that are asked by one image
KEYS = (
    "queries",
    "places",
    "room",
    "recall_one",
    "recall",
    "recall_all",
    "drive_seconds",
    "drive_bytes",
    "skipped",
)
COLUMNS: dict[str, Column] = {
    **{"one image": ("recall_one", ".3f"), "whole drive": ("recall", ".3f")},
    **{
        "at all places": ("recall_all", ".3f"),
        "s": ("drive_seconds", ".0f"),
        "MB": ("drive_bytes", ".0f", 1e6),
    },
}


class Task(NamedTuple):
    """A drive of so many queries on a map of so many places, with a room in route bytes per place."""

    queries: int
    places: int
    room: float


TASKS = (
    *(Task(1000, 3000, room) for room in (5, 0.5)),
    *(Task(10_000, 100_000, room) for room in (4, 0.5)),
    *(Task(1000, 1_000_000, room) for room in (4, 0.5)),
)


def bench_large_drives() -> Iterator[Row]:
    """A row for each task, measured in a process of its own.

    Yields:
        recall_one, recall, recall_all: share of the queries placed within 5 places by one image, by the whole
        drive, and by a smoother of all places, if the map is small. drive_seconds, drive_bytes: of the whole
        drive, fit included; memory beyond that of the programs, the map and the queries.
    """
    for task in TASKS:
        row = new_row("made", f"{task.queries} on {task.places}, {task.room:g} B", KEYS)
        yield row | task._asdict() | in_process(__name__, task)


def made(task: Task) -> tuple[SpectralMap, Tensor, Tensor]:
    """A map of a smooth random route, queries along a part of it, and their places."""
    random = torch.Generator().manual_seed(0)
    truth, maps, queries = torch.arange(task.queries) + task.places // 3, [], []
    for start in range(0, task.places, PART):
        count = min(PART, task.places - start)
        at = torch.arange(count) / SMOOTH
        anchors, low = torch.randn(count // SMOOTH + 2, NUMBERS, generator=random), at.long()
        route = F.normalize(torch.lerp(anchors[low], anchors[low + 1], (at - low)[:, None]))
        maps.append(SpectralMapper(task.room)(route))
        own = truth[(truth >= start) & (truth < start + count)] - start
        queries.append(route[own])
    noise = F.normalize(torch.randn(task.queries, NUMBERS, generator=random))
    whole = maps[0] if len(maps) == 1 else SpectralMap.merged(maps, [[str(i)] for i in range(len(maps))])
    return whole, F.normalize(torch.cat(queries) + NOISE * noise), truth


def measured(task: Task) -> dict[str, Any]:
    """The figures of a row."""
    place_map, queries, truth = made(task)
    give_back()

    def whole() -> Match:
        smoother = PlaceSmoother(within=TOLERANCE)
        return answer(OfMap(place_map, queries), Matching(smoother, radius=TOLERANCE))

    def recall(index: Tensor) -> float:
        return float(((index - truth[: len(index)]).abs() <= TOLERANCE).double().mean())

    one = torch.cat([place_map.scores(part).argmin(1) for part in queries[:SINGLE].split(10)])
    found: list[Match] = []
    known = {"recall_one": recall(one)}
    if not is_large(task.queries, task.places):
        known["recall_all"] = recall(whole().index)
    setattr(driving, "is_large", lambda *_: True)  # noqa: B010
    began = time.perf_counter()
    peak = peak_memory(lambda: found.append(whole()))
    seconds = time.perf_counter() - began
    return known | {"recall": recall(found[0].index), "drive_seconds": seconds, "drive_bytes": peak}


if __name__ == "__main__":
    with torch.no_grad():
        sys.stdout.write(json.dumps(measured(Task(*json.loads(sys.argv[1])))) + "\n")
