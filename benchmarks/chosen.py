"""`benchmarks chosen`: what half and double of each constant of evidence and fit would do to whole drives."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import mean
from typing import NamedTuple

from torch import Tensor
from tqdm import tqdm

from benchmarks.drives import AS_IT_WAS, ELSEWHERE, HALF, ROUTES, Known, above, asked, drives_of, learned
from benchmarks.measure import Column, Row, table, write_bench
from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.rejection import calibration_error, judged
from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.teaching import in_its_light
from dejavu_torch.types import InputError

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
    for names, known in ((routes, [*ROUTES]), (constants, [*HALVED, *LISTS])):
        if unknown := [name for name in names if name not in known]:
            raise InputError(f"{unknown[0]!r} is unknown; expected one of {', '.join(map(repr, known))}")
    drives = [
        one
        for name in tqdm(routes or ROUTES, "maps", disable=None, leave=False)
        for one in _asked(data, name)
    ]
    settings = [(AS_IT_IS, {}), *(pair for name in constants or (*HALVED, *LISTS) for pair in _others(name))]
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


def _row(
    name: str, values: dict[str, object], drives: list[Asked], base: dict[str, float]
) -> tuple[Row, dict[str, float]]:
    before = {name: getattr(chosen, name) for name in values}
    auc: dict[str, float] = {}
    errors, elsewhere = [], []
    try:
        for key, value in values.items():
            setattr(chosen, key, value)
        for one in drives:
            smoother, tolerance = PlaceSmoother(within=one.known.tolerance), one.known.tolerance
            matching = one.known.model.matching(smoother)._replace(radius=tolerance)
            match = one.known.model.localize_descriptors(one.queries, matching)
            if one.name.endswith(ELSEWHERE):
                elsewhere.append(above(match, 0.5))
                continue
            auc[one.name] = evaluate(match, one.truth, tolerance).auc
            errors.append(calibration_error(*judged(match, one.truth, tolerance)))
    finally:
        for key, value in before.items():
            setattr(chosen, key, value)
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
