"""`benchmarks views`: images compared as they are, and moved sideways as well."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from tqdm import tqdm

from benchmarks.cross import FOOTAGE as EVERY
from benchmarks.measure import Column, Row, new_row, some_of, table, truth_of, write_bench
from dejavu_torch.data.ground_truth import GroundTruth, scored_and_right
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import Cropped, Part, chained
from dejavu_torch.evaluation.curves import area, by_confidence, curve_of, evaluate
from dejavu_torch.evaluation.rejection import calibration_error, judged
from dejavu_torch.growth import calibrate_if_possible
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.localizer import answer
from dejavu_torch.recognition.querying import Querying
from dejavu_torch.recognition.scorer import BestOf
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.recognition.views import ALONE, APART, FIRST, Views, best_pairs, evenly, penalties_of
from dejavu_torch.types import InputError, Match, Traverse

FOOTAGE = {name: one for name, one in EVERY.items() if one.features == "images"}
MARGIN = 0.2  # of the width that is cut off on either side, so that the second visit can show another part
POINTED = (0.0, 0.1, -0.17)  # of what is left: by how much the second camera points to the right
POINTED_WITHIN = 0.03  # of these, in whole pixels
RATES = {"default": None, "half a byte": 0.5}
ASKED = 1000  # queries, from the middle
APART_LOOPS, MOST_LOOPED = 50, 4000  # frames before one that are no loop; frames of a drive
STEPS = (0.02, APART, 0.08)  # between views, in shares of the width
SETTINGS: dict[str, dict[str, float]] = {
    "as it is": {},
    **{f"start {value:g}": {"start": value} for value in (0.04, 0.16)},
    **{f"{value:g} a nat": {"nats": value} for value in (0.02, 0.08)},
    **{f"share above {value:g}": {"chance": value} for value in (0.02, 0.05, 0.12)},
    **{f"{value:g} more follow": {"more": value} for value in (0.0, 0.06)},
}
WAYS: tuple[Literal["none", "auto"], ...] = ("none", "auto")
KEYS = ("rate", "shift", "views", "auc_one", "auc", "error", "shift_error", "ms", "missed")


def pointed(reference: Traverse, query: Traverse, shift: float) -> tuple[Traverse, Traverse, float]:
    """The middle of the frames of a reference, a part of a query's further right, and how far that is."""
    width = reference.frame_shape[2]
    margin, other = round(MARGIN * width), round(MARGIN * query.frame_shape[2])
    aside = round(shift * (query.frame_shape[2] - 2 * other))
    cut = Cropped(query, (0, 0, other + aside, other - aside))
    return Cropped(reference, (0, 0, margin, margin)), cut, aside / (query.frame_shape[2] - 2 * other)


class Case(NamedTuple):
    """A map, a second visit of its route, and how far its camera points to the right, None if as filmed."""

    model: DejaVu
    query: Traverse
    truth: GroundTruth
    tolerance: int
    shift: float | None


def case_of(name: str, data: Path, rate: str = "default", shift: float | None = None) -> Case:
    """The case of a route; InputError if there is no map in so few bytes."""
    one = FOOTAGE[name]
    reference, query = (open_source(source.format(data=data)) for source in (one.reference, one.query))
    truth, known = truth_of(reference, query, one.truth and one.truth.format(data=data)), None
    if shift is not None:
        reference, query, known = pointed(reference, query, shift)
    first = max(0, len(query) - ASKED) // 2
    some = range(first, min(len(query), first + ASKED))
    query, truth = Part(query, some), GroundTruth(*(column[some.start : some.stop] for column in truth))
    model = DejaVu(mapper=SpectralMapper(RATES[rate])).learn(reference)
    calibrate_if_possible(model, reference)
    return Case(model, query, truth, one.tolerance, known)


def bench_views(name: str, data: Path, rate: str, shift: float | None) -> Iterator[Row]:
    """A row for each way on the map of a route.

    Args:
        shift: of a second camera that sees a part of the frames; None: the visits are as they are.

    Yields:
        auc_one, auc: of single images in order, by confidence, and of the whole drive. error: of the
        probabilities of single images. views: that answer. shift, shift_error: known, and median. ms: of
        processor time for a query, describing included. missed: why there is no map.
    """
    row = new_row(name, "none", KEYS, rate=rate, shift=shift)
    try:
        model, query, truth, tolerance, known = case_of(name, data, rate, shift)
    except InputError as error:
        yield row | {"missed": str(error)}
        return
    row["shift"] = known
    for way in WAYS:
        asked = Querying(ordered=True, shifts=way)
        began = time.process_time()
        drive = _all(model, query, replace(asked, match=PlaceSmoother(within=max(1, tolerance))))
        passed = 1000 * (time.process_time() - began) / len(query)
        centre: Literal["mean", "none"] = "mean" if model.centres(len(query)) else "none"
        alone = _all(model, query, replace(asked, match="single", centre=centre))
        figures: dict[str, Any] = {"auc_one": area(curve_of(by_confidence(alone), truth, tolerance))}
        figures |= {"auc": evaluate(drive, truth, tolerance).auc, "ms": passed}
        if alone.probability is not None:
            figures["error"] = calibration_error(*judged(alone, truth, max(1, tolerance)))
        if drive.shift is not None and known is not None:
            figures["shift_error"] = float((drive.shift - known).abs().nanmedian())
        yield row | {"contender": way, "views": drive.shift is not None} | figures


def bench_settings(name: str, data: Path, shift: float | None) -> Iterator[Row]:
    """A row for each of the settings of penalties, and for each step between views, on the map of a route:
    AUC of single images in order, by confidence, and the processor time of a query, describing included."""
    model, query, truth, tolerance, known = case_of(name, data, shift=shift)
    if model.views_at_first(Querying(), True, True) == ALONE:  # no views are of use
        return
    for apart in STEPS:
        views = Views(evenly(apart), (0.0,) * len(evenly(apart)))
        began = time.process_time()
        rows = model.described(query, Querying(views=views), model.centres(len(query)))
        scorer, copies = model.scorer(rows), len(views.shifts)
        pairs = best_pairs(scorer, copies, min(FIRST, len(query)))
        for setting, given in SETTINGS.items() if apart == APART else [("as it is", {})]:
            penalties = penalties_of(pairs, scorer.layout, **given)
            match = answer(BestOf(scorer, copies, penalties))
            passed = 1000 * (time.process_time() - began) / len(query)
            own = f"steps of {apart:g}" if setting == "as it is" else setting
            figures = {"auc_one": area(curve_of(by_confidence(match), truth, tolerance)), "ms": passed}
            yield new_row(name, own, KEYS, rate="default", shift=known) | figures
            began = time.process_time()
    alone = answer(BestOf(scorer, copies, torch.full((copies,), math.inf).index_fill(0, torch.tensor(0), 0)))
    figures = {"auc_one": area(curve_of(by_confidence(alone), truth, tolerance))}
    yield new_row(name, "none", KEYS, rate="default", shift=known) | figures


def bench_loops(name: str, data: Path, shift: float | None) -> Iterator[Row]:
    """A row for each way of the loops of one drive, the first visit of a route and then the second: shares of
    the second's frames whose answer is right, right and accepted, and wrong and accepted."""
    one = FOOTAGE[name]
    visits = [open_source(source.format(data=data)) for source in (one.reference, one.query)]
    truth, known = truth_of(visits[0], visits[1], one.truth and one.truth.format(data=data)), None
    if shift is not None:
        *visits, known = pointed(visits[0], visits[1], shift)
    if visits[0].frame_shape != visits[1].frame_shape or sum(map(len, visits)) > MOST_LOOPED:
        return
    drive, first = chained(visits), len(visits[0])
    drive.ordered = True
    model = DejaVu().learn(drive)
    calibrate_if_possible(model, drive)
    for way in WAYS:
        match = model.loops(drive, APART_LOOPS, shifts=way)[first:]
        kept, right = scored_and_right(match.index, truth, one.tolerance)
        shares = {"right": right, "taken": match.accepted & right, "wrong": match.accepted & ~right}
        figures = {key: float(one[kept].double().mean()) for key, one in shares.items()}
        yield new_row(name, way, ("shift", *figures), shift=known) | figures


def _all(model: DejaVu, query: Traverse, querying: Querying) -> Match:
    return Match.joined(model.matches(query, querying))


COLUMNS: dict[str, Column] = {
    **{"one image": ("auc_one", ".3f"), "whole drive": ("auc", ".3f"), "error": ("error", ".3f")},
    **{"shift": ("shift", ".2f"), "its error": ("shift_error", ".3f"), "ms": ("ms", ".1f")},
}
LOOPED: dict[str, Column] = {
    **{"right": ("right", ".3f"), "accepted": ("taken", ".3f"), "wrongly": ("wrong", ".3f")},
    "shift": ("shift", ".2f"),
}


def run_views(
    data: Path, *, out: Path, routes: Sequence[str] = (), choose: bool = False, loops: bool = False
) -> list[str]:
    """Images compared as they are and moved sideways: AUC of one image and of the whole drive, and the shift.

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json
        routes: names of routes; all if not given
        choose: instead, steps between views and the constants of penalties
        loops: instead, loops of one drive that is both visits, one after the other
    """
    some = some_of(FOOTAGE, routes)
    planned = [(name, rate, None) for rate in RATES for name in some]
    planned += [(name, "default", shift) for shift in POINTED for name in some]  # type: ignore[misc]
    rows: list[Row] = []
    if choose or loops:
        for name, shift in tqdm([*product(some, (None, *POINTED[1:]))], "routes", disable=None, leave=False):
            rows += (bench_settings if choose else bench_loops)(name, data, shift)
            write_bench(out, rows)
        return [table(rows, COLUMNS if choose else LOOPED, "{case}, {contender}"), "AUC, or shares"]
    for name, rate, shift in tqdm(planned, "routes", disable=None, leave=False):
        rows += bench_views(name, data, rate, shift)
        write_bench(out, rows)
    return [table(rows, COLUMNS, "{case}, {rate}, {contender}"), "AUC; shares of the width"]
