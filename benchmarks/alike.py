"""`benchmarks alike`: which answers are accepted where places look alike, and loops within one drive."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.drives import ROUTES, learned
from benchmarks.measure import Column, Row, new_row, table, truth_of, write_bench
from benchmarks.trainings import Route, drive, road
from dejavu_torch.data.ground_truth import counted, is_right
from dejavu_torch.data.source import open_source
from dejavu_torch.model import DejaVu
from dejavu_torch.types import Match

APART = 50  # frames before a query that are no loop
PRECISIONS = 0.5, 0.9, 0.99
CAPPED, UNCAPPED = "the map's look-alikes known", "not known"
CHECKED, SINGLE = "checked by the whole drive", "each image by itself"
KEYS = ("precision", "accepted", "right", "judged", "frames")
COLUMNS: dict[str, Column] = {
    **{"precision": ("precision", "g"), "accepted": ("accepted", ".0f"), "judged": ("judged", ".0f")},
    "right": ("right", ".0f"),
}
# laps, of which the frames have a place on another lap; and drives that pass each place once
LAPS = {"laps": drive("donkey_lap", 10), "magnetometer": drive("magnetic_laps", 5)}
ONCE = {
    **{name: route.reference for name, (route, _) in ROUTES.items() if name not in (*LAPS, "lidar")},
    "road": road().reference,
}


def run_alike(data: Path, *, out: Path) -> list[str]:
    """What is accepted where places look alike: of other drives, and as loops within one drive.

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json
    """
    rows: list[Row] = []
    for name, (route, other) in tqdm(ROUTES.items(), "look-alikes", disable=None, leave=False):
        rows += look_alikes(name, route.below(data), other and other.format(data=data))
    for name, route in tqdm(LAPS.items(), "laps", disable=None, leave=False):
        rows += loops(name, route.below(data).query, places_of(route.below(data)), route.tolerance)
        write_bench(out, rows)
    for name, source in tqdm(ONCE.items(), "driven once", disable=None, leave=False):
        rows += loops(f"{name}, once", source.format(data=data))
        write_bench(out, rows)
    return [table(rows, COLUMNS), f"accepted answers; loops of over {APART} frames"]


def look_alikes(name: str, route: Route, other: str | None) -> Iterator[Row]:
    """The accepted answers to single queries, those of the other route included, with and without the limits
    that the map's own look-alikes set; none if the map is not calibrated."""
    known = learned(route, other)
    model, queries = known.model, known.queries
    calibration = model.calibration
    if calibration is None or calibration.single is None:
        return
    asked = queries if known.other is None else torch.cat([queries, known.other])
    for way, single in ((CAPPED, calibration.single), (UNCAPPED, calibration.single._replace(most=()))):
        model.calibration = calibration._replace(single=single)
        match = model.localize_descriptors(asked)
        own = match.map(lambda column: column[: len(queries)])
        scored = torch.ones(len(asked), dtype=torch.bool)
        scored[: len(queries)] = counted(own.index, known.truth, known.tolerance)
        right = torch.zeros_like(scored)
        right[: len(queries)] = is_right(own.index, known.truth.positives, known.tolerance)
        yield from at_precisions(name, way, match, scored, right)


def places_of(route: Route) -> Tensor:
    """(Q,) one place of each query on a lap that was driven once, -1 for those without any."""
    reference, query = open_source(route.reference), open_source(route.query)
    return truth_of(reference, query, route.truth).positives[:, 0]


def loops(name: str, source: str, places: Tensor | None = None, tolerance: int = 0) -> Iterator[Row]:
    """The accepted loops within a drive, whose frames are at these places (N,) of a lap; None if it passes
    each place once, so that every loop is wrong."""
    traverse = open_source(source)
    model = DejaVu().learn(traverse)
    if traverse.frame_shape[1:]:
        model.calibrate(traverse)
    for way, whole in ((CHECKED, True), (SINGLE, False)):
        match = model.loops(traverse, APART, whole)
        found = match.index >= 0
        if places is None:
            scored, right = found, torch.zeros_like(found)
        else:
            earlier = places[match.index.clamp(min=0)]
            scored = found & (places >= 0) & (earlier >= 0)
            right = scored & ((places - earlier).abs() <= tolerance)
        yield from at_precisions(f"loops: {name}", way, match, scored, right)


def at_precisions(case: str, way: str, match: Match, scored: Tensor, right: Tensor) -> Iterator[Row]:
    """A row for each precision that is asked for; without probabilities one for what is accepted."""
    probability = match.probability
    for precision in PRECISIONS if probability is not None else (None,):
        kept = match.accepted
        if probability is not None and precision is not None:
            kept = probability >= precision
        counts = {"accepted": int(kept.sum()), "judged": int((kept & scored).sum())}
        counts |= {"right": int((kept & right).sum()), "frames": len(kept)}
        yield new_row(case, way, KEYS, precision=precision, **counts)
