"""`benchmarks odometry`: drives and filters with and without odometry that is made from the truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.drives import ROUTES, Known, learned
from benchmarks.measure import Column, Row, new_row, some_of, table, write_bench
from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.odometry import checked_moved
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.teaching import in_its_light
from dejavu_torch.types import InputError, Odometer

DRIVEN = tuple(name for name in ROUTES if name != "walks")  # which are joined, and jump
RATES: dict[str, float | None] = {"": None, ", half a byte": 0.5, ", a quarter byte": 0.25}
NOISE, LONGER = 0.1, 1.1  # of each step, as a standard deviation; of all of them
KEYS = "drive", "filter", "is_drive", "skipped"
COLUMNS: dict[str, Column] = {"whole drive": ("drive", ".3f"), "filter": ("filter", ".3f")}


def run_odometry(data: Path, *, out: Path, routes: Sequence[str] = (), seed: int = 0) -> list[str]:
    """Whole drives and filters with and without odometry, at three rates: AUC.

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json
        routes: names of routes, as of `drives`; all but walks if not given
        seed: of the noise
    """
    rows: list[Row] = []
    pairs = [(name, rate) for name in some_of(DRIVEN, routes) for rate in RATES]
    for name, rate in tqdm(pairs, "maps", disable=None, leave=False):
        try:
            known = learned(ROUTES[name][0].below(data), None, RATES[rate])
            rows += bench_odometry(name + rate, known, seed)
        except InputError as error:  # no map of so few bytes
            rows.append(new_row(name + rate, "without", KEYS, skipped=str(error)))
        write_bench(out, rows, seed=seed)  # as soon as a route is finished
    note = f"AUC of another visit's drive; odometry with {NOISE:.0%} of noise a step, or all too long"
    return [table(rows, COLUMNS), note]


def bench_odometry(case: str, known: Known, seed: int = 0) -> Iterator[Row]:
    """A row without odometry, one with noise in each step, one with steps that are all too long, and one with
    the right steps in random order: the null control."""
    model, tolerance = known.model, known.tolerance
    moved, draw = moves_of(known.truth, model.map.places), torch.Generator().manual_seed(seed)
    noise = 1 + NOISE * torch.randn(len(moved), generator=draw).double()
    told: dict[str, Odometer | None] = {
        "without": None,
        "noise": checked_moved(moved * noise.clamp(min=0), len(moved)),
        "too long": checked_moved(LONGER * moved, len(moved)),
        "null": checked_moved(moved[torch.randperm(len(moved), generator=draw)], len(moved)),
    }
    lit = in_its_light(model, known.queries)
    for name, odometer in told.items():
        ways = (("drive", PlaceSmoother(within=tolerance), lit), ("filter", PlaceFilter(), known.queries))
        row = new_row(case, name, KEYS)
        for way, sequence, queries in ways:
            matching = model.matching(sequence)._replace(radius=tolerance, moved=odometer)
            match = model.localize_descriptors(queries, matching)
            row[way] = evaluate(match, known.truth, tolerance).auc
            row["is_drive"] = match.is_drive if way == "drive" else row["is_drive"]
        yield row


def moves_of(truth: GroundTruth, places: int) -> Tensor:
    """By how many places a camera moved to each query, (Q,) float64, either way, also past the ends of laps:
    between the means of right places, interpolated where there is none."""
    right = truth.positives.double().masked_fill(truth.positives < 0, torch.nan).nanmean(1)
    some = (~right.isnan()).nonzero()[:, 0]
    at = torch.from_numpy(np.interp(np.arange(len(right)), some.numpy(), right[some].numpy()))
    steps = at.diff(prepend=at[:1]).abs()
    return torch.minimum(steps, places - steps)
