"""`benchmarks visits`: a map after more and more drives whose places nobody told, asked by another."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from benchmarks.measure import Column, Row, new_row, table, write_bench
from benchmarks.plots import plot_visits
from benchmarks.teaching import CITIES, LAPS, Task, asked, cut
from benchmarks.trainings import Route
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import fitted
from dejavu_torch.model import DejaVu
from dejavu_torch.teaching import place_drives
from dejavu_torch.updating import update

ANEW, UPDATED = "learned anew with the drives", "updated, one drive after another"
KEYS = ("drives", "asked", "auc", "auc_by_confidence", "map_bytes", "routes", "told", "seconds")
COLUMNS: dict[str, Column] = {
    **{"drives": ("drives", ".0f"), "AUC": ("auc", ".3f"), "by confidence": ("auc_by_confidence", ".3f")},
    **{"bytes": ("map_bytes", ".0f"), "routes": ("routes", ".0f"), "seconds": ("seconds", ".0f")},
}


class Visits(NamedTuple):
    """Drives [start, stop) of a file, one after another, and the queries that are asked; a route's own."""

    asked: Route
    queries: tuple[int, int | None]
    drives: tuple[tuple[str, int, int | None], ...]


ONE, OTHER = CITIES
LATER = "{data}/robotcar/t5/query.npy"
QUARTERS = [(LAPS.query, start, start + 200) for start in range(0, 800, 200)]
VISITS = {
    "city, drive 2 asked": Visits(OTHER, (0, None), ((ONE.query, 0, None), (LATER, 0, None))),
    "city, drive 1 asked": Visits(ONE, (0, None), ((OTHER.query, 0, None), (LATER, 0, None))),
    "laps, last quarter asked": Visits(LAPS, (600, None), tuple(QUARTERS[:3])),
    "laps, first quarter asked": Visits(LAPS, (0, 200), tuple(QUARTERS[:0:-1])),
}


def run_visits(data: Path, *, out: Path) -> list[str]:
    """Maps after more and more drives without ground truth: learned anew with all of them, and updated.

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json and bench.png
    """
    rows: list[Row] = []
    for name in tqdm(VISITS, "visits", disable=None, leave=False):
        rows += bench_visits(name, VISITS[name], data)
        write_bench(out, rows)  # as soon as one is finished
    write_bench(out, rows, plot_visits(curves(rows)))
    return [table(rows, COLUMNS), "AUC of another drive, one image, centred"]


def bench_visits(name: str, visits: Visits, data: Path) -> Iterator[Row]:
    """A row for each number of drives, learned anew and updated.

    Yields:
        auc, auc_by_confidence: of single queries. map_bytes, routes: of the map. told: what an update says.
    """
    route = visits.asked.below(data)
    reference = open_source(route.reference)
    drives = [
        fitted(cut(open_source(file.format(data=data)), (first, last)), reference.frame_shape)
        for file, first, last in visits.drives
    ]
    task = Task(route, queries=visits.queries)
    for way in (ANEW, UPDATED):
        model, told = DejaVu().learn(reference), ""
        for count in range(len(drives) + 1):
            began = time.perf_counter()
            if count and way == ANEW:
                model, taught = DejaVu(), [(drive, None) for drive in drives[:count]]
                model.learn(reference, second=place_drives(model, reference, taught))
            elif count:
                told = str(update(model, drives[count - 1], name=f"drive {count}"))
            found = asked(model, route, task)
            row = new_row(name, way, KEYS) | found | {"drives": count, "told": told}
            row |= {"map_bytes": model.summary().map_bytes, "routes": max(1, len(model.map.routes))}
            yield row | {"seconds": time.perf_counter() - began}


def curves(rows: list[Row]) -> dict[str, dict[str, list[float]]]:
    """The areas after 0, 1, .. drives, by case and way."""
    found: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        found.setdefault(row["case"], {}).setdefault(row["contender"], []).append(row["auc"])
    return found
