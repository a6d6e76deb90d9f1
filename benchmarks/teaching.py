"""`benchmarks teaching`: maps that learned from a drive whose places nobody told, asked by another one."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from benchmarks.drives import FLOORS, WINTER, railway
from benchmarks.measure import Column, Row, new_row, table, truth_of, write_bench
from benchmarks.trainings import Route, drive
from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import Part, fitted
from dejavu_torch.evaluation.contenders import contend
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.centring import PRIOR, centred
from dejavu_torch.teaching import place_drives, refine
from dejavu_torch.types import InputError

COPIES, PLACED, TOLD = "augmented copies", "the drive, placed by itself", "the drive, true places"
REFINED = "the map refined, without its frames"
KEYS = (
    *("asked", "placed", "of", "right", "rounds", "auc", "auc_by_confidence", "gain", "error", "seconds"),
    "skipped",
)
COLUMNS: dict[str, Column] = {
    **{"placed": ("placed", ".0f"), "of": ("of", ".0f"), "right": ("right", ".3f")},
    **{"rounds": ("rounds", ".0f"), "AUC": ("auc", ".3f"), "by confidence": ("auc_by_confidence", ".3f")},
    **{"gain": ("gain", ".3f"), "error": ("error", ".3f"), "seconds": ("seconds", ".0f")},
}


class Task(NamedTuple):
    """A route with the drive that teaches, and the queries that are asked, of the same route unless it is
    given; queries of either are [start, stop)."""

    learned: Route
    taught: tuple[int, int | None] = (0, None)
    asked: Route | None = None
    queries: tuple[int, int | None] = (0, None)


CITIES = [drive(f"robotcar/{t}", 2) for t in ("t1", "t2")]  # two drives over one reference
HALVES = [railway("stop=900"), railway("start=900")]
LAPS, MIDDLE = drive("donkey_lap", 10), 400
ALIKE = drive("floors_rejection", 1)
TASKS = {
    "railway, first half, then the second": Task(HALVES[0], asked=HALVES[1]),
    "railway, second half, then the first": Task(HALVES[1], asked=HALVES[0]),
    "city, drive 1, then drive 2": Task(CITIES[0], asked=CITIES[1]),
    "city, drive 2, then drive 1": Task(CITIES[1], asked=CITIES[0]),
    "laps, first, then last": Task(LAPS, (0, MIDDLE), None, (MIDDLE, None)),
    "laps, last, then first": Task(LAPS, (MIDDLE, None), None, (0, MIDDLE)),
    "floors, first, then last": Task(ALIKE, (0, 200), None, (200, None)),
    "floors, one that the map lacks, then the others": Task(ALIKE, (300, None), None, (0, 300)),
    "laps by another route": Task(Route(LAPS.reference, FLOORS, 10, None), asked=LAPS),
    "city by another route": Task(Route(CITIES[0].reference, WINTER, 2, None), asked=CITIES[0]),
}


def run_teaching(data: Path, *, out: Path, tasks: Sequence[str] = ()) -> list[str]:
    """Maps learned from augmented copies, from a drive that is placed without truth, and with it.

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json
        tasks: names of drives; all if not given
    """
    if unknown := [name for name in tasks if name not in TASKS]:
        raise InputError(f"{unknown[0]!r} is no drive; expected one of {', '.join(map(repr, TASKS))}")
    rows: list[Row] = []
    for name in tqdm(tasks or list(TASKS), "drives", disable=None, leave=False):
        rows += bench_teaching(name, TASKS[name], data)
        write_bench(out, rows)  # as soon as a drive is finished
    return [table(rows, COLUMNS), "AUC of another drive, one image, centred"]


def bench_teaching(name: str, task: Task, data: Path) -> Iterator[Row]:
    """A row for each way to learn what a drive changes; see `Task`.

    Yields:
        placed, of: frames of the drive that teach, and all. right: share of those placed that are right, of
        those whose place is known. gain, error: see `Refinement`. auc,
        auc_by_confidence: of the queries, by single images.
    """
    learned = task.learned.below(data)
    route = learned if task.asked is None else task.asked.below(data)
    reference = open_source(learned.reference)
    shown = fitted(cut(open_source(learned.query), task.taught), reference.frame_shape)
    other = learned.truth is None  # a drive of another route
    truth = None if other else truth_of(reference, open_source(learned.query), learned.truth)
    for way in (COPIES, PLACED, REFINED, TOLD):
        row, began = new_row(name, way, KEYS), time.perf_counter()
        if way == TOLD and (truth is None or not (truth.positives[slice(*task.taught)] >= 0).any()):
            continue
        model, views = DejaVu(), None
        if way == PLACED:
            views = place_drives(model, reference, [(shown, None)])
        elif way == TOLD:
            assert truth is not None
            views = LabelledFrames(shown, truth.positives[slice(*task.taught), 0])
        model.learn(reference, second=views)
        if views is not None and views.placed is not None:
            row |= {"placed": int((views.places >= 0).sum()), "of": len(views.places)}
            row |= {"rounds": views.placed.rounds}
            row["right"] = None if truth is None else right_of(views, truth, task, learned.tolerance)
        if way == REFINED:
            found = refine(model, shown)
            row |= {"placed": found.placed, "of": found.of}
            row |= {} if math.isnan(found.gain) else {"gain": found.gain, "error": found.error}
        if task.asked is not None and route.reference != learned.reference:
            taught, model = model, DejaVu()
            model.descriptor.take(taught.descriptor, whitening=True)
            model.learn(open_source(route.reference))
            assert isinstance(taught.map, SpectralMap)
            assert isinstance(model.map, SpectralMap)
            if len(taught.map.stage):
                model.replace_map(model.map.refined(taught.map.stage * taught.map.stage_scale))
        yield row | asked(model, route, task) | {"seconds": time.perf_counter() - began}


def cut(traverse: Any, part: tuple[int, int | None]) -> Part:
    """The frames [start, stop) of a traverse."""
    return Part(traverse, range(len(traverse))[slice(*part)])


def right_of(views: LabelledFrames, truth: GroundTruth, task: Task, tolerance: int) -> float | None:
    """The share of placed frames, of those with a known place, that are within the tolerance of it."""
    positives = truth.positives[slice(*task.taught)]
    known = (views.places >= 0) & (positives >= 0).any(1)
    near = ((positives - views.places[:, None]).abs() <= tolerance) & (positives >= 0)
    return float(near.any(1)[known].double().mean()) if known.any() else None


def asked(model: DejaVu, route: Route, task: Task) -> dict[str, Any]:
    """The scores of single queries, centred."""
    query = open_source(route.query)
    positives, judged, ignored = truth_of(open_source(route.reference), query, route.truth)
    some = slice(*task.queries)
    queries = model.descriptor.all_of(cut(query, task.queries)).float()
    queries = centred(model.map, queries) if len(queries) >= PRIOR else queries
    match = model.localize_descriptors(queries, model.matching(None))
    truth = GroundTruth(positives[some], judged[some], ignored[some])
    found = contend("", match, truth, route.tolerance)
    assert found.scores is not None
    return {"asked": len(queries), "auc": found.scores.auc, "auc_by_confidence": found.auc_by_confidence}
