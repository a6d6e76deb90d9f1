"""`benchmarks chosen`: what half and double of each constant of evidence and fit would do to whole drives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import mean
from typing import NamedTuple

from torch import Tensor
from tqdm import tqdm

from benchmarks.drives import (
    AS_IT_WAS,
    ELSEWHERE,
    HALF,
    ROUTES,
    Known,
    above,
    asked,
    drives_of,
    learned,
)
from benchmarks.measure import Column, Row, some_of, table, write_bench
from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.rejection import calibration_error, judged
from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.teaching import in_its_light
from dejavu_torch.types import Match

DRIVES = (AS_IT_WAS, "a third of the speed", "three times the speed", "a stop", "stretches of 5 to 15", HALF)
AS_IT_IS = "as it is"
LISTS = {"SLOW": chosen.MOVES, "FAST": chosen.MOVES}  # in place of these: no other start
HALVED = (
    *("SMALLEST", "SHARPENED", "UNCHANGED", "STOP", "RADIUS", "TAIL", "MOST_ABSENT", "MOST_PRESENT"),
    *("MIN_SEPARATION", "ROUNDS", "MOVE_SHARE", "RATE_COUNTS", "ENTER_COUNTS", "OTHER_SPEED", "PER_QUERY"),
    *("CLEARLY", "FITTED", "STRETCH", "CORRELATED", "DOUBT", "SLIP", "CHANGE_COUNTS", "ASKED", "SELDOM"),
)
COLUMNS: dict[str, Column] = {
    **{"AUC": ("auc", ".4f"), "most lost": ("lost", ".3f"), "most gained": ("gained", ".3f")},
    **{"calibration error": ("calibration_error", ".3f"), "another route, p > .5": ("elsewhere", ".3f")},
}


class Asked(NamedTuple):
    """A drive (Q,K) on a map, in its light."""

    name: str
    known: Known
    queries: Tensor
    truth: GroundTruth

    def matched(self) -> Match:
        """By the whole drive."""
        model, tolerance = self.known.model, self.known.tolerance
        matching = model.matching(PlaceSmoother(within=tolerance))._replace(radius=tolerance)
        return model.localize_descriptors(self.queries, matching)


def run_chosen(
    data: Path, *, out: Path, routes: Sequence[str] = (), constants: Sequence[str] = ()
) -> list[str]:
    """What half and double of each constant of evidence and fit would do to whole drives.

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json
        routes: names of routes, as of `drives`; all if not given
        constants: names of constants, in capitals; all if not given
    """
    names = some_of((*HALVED, *LISTS), constants)
    maps = tqdm(some_of(ROUTES, routes), "maps", disable=None, leave=False)
    drives = [one for name in maps for one in _asked(data, name)]
    settings = [(AS_IT_IS, {}), *(pair for name in names for pair in _others(name))]
    rows: list[Row] = []
    base: dict[str, float] = {}
    for name, values in tqdm(settings, "constants", disable=None, leave=False):
        row, found = _row(name, values, drives, base)
        base = base or found
        rows.append(row)
        write_bench(out, rows)
    return [
        table(rows, COLUMNS, "{contender}"),
        "means over drives of the routes; lost and gained on one of them",
    ]


def _asked(data: Path, name: str) -> Iterator[Asked]:
    """The drives of a route."""
    route, other = ROUTES[name]
    known = learned(route.below(data), None if other is None else other.format(data=data))
    for made, numbers in drives_of(len(known.queries), known.other).items():
        if made in (*DRIVES, ELSEWHERE) and numbers is not None:
            queries, truth = asked(known, numbers)
            yield Asked(f"{name}, {made}", known, in_its_light(known.model, queries), truth)


def _others(name: str) -> Iterator[tuple[str, dict[str, object]]]:
    """Other values of a constant."""
    if name in LISTS:
        yield f"{name}: none", {name: LISTS[name]}
        return
    value = getattr(chosen, name)
    for factor in (0.5, 2.0):
        other = type(value)(value * factor)
        yield f"{name} {value:g}: {other:g}", {name: other}


@contextmanager
def changed(values: dict[str, object]) -> Iterator[None]:
    """With other values of constants."""
    before = {name: getattr(chosen, name) for name in values}
    try:
        for key, value in values.items():
            setattr(chosen, key, value)
        yield
    finally:
        for key, value in before.items():
            setattr(chosen, key, value)


def _row(
    name: str, values: dict[str, object], drives: list[Asked], base: dict[str, float]
) -> tuple[Row, dict[str, float]]:
    auc: dict[str, float] = {}
    errors, elsewhere = [], []
    with changed(values):
        for one in drives:
            match, tolerance = one.matched(), one.known.tolerance
            if one.name.endswith(ELSEWHERE):
                elsewhere.append(above(match, 0.5))
                continue
            auc[one.name] = evaluate(match, one.truth, tolerance).auc
            errors.append(calibration_error(*judged(match, one.truth, tolerance)))
    changes = {key: auc[key] - base.get(key, auc[key]) for key in auc}
    least, most = min(changes, key=changes.__getitem__), max(changes, key=changes.__getitem__)
    row: Row = {
        "case": "drives",
        "contender": name,
        "auc": mean(auc.values()),
        "calibration_error": mean(errors),
    }
    row |= {"lost": -changes[least], "lost_by": least, "gained": changes[most], "gained_by": most}
    return row | {"elsewhere": max(elsewhere, default=0.0)}, auc
