"""`benchmarks own_copies`: whether altered copies of a map's frames could choose how drives are matched."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from statistics import mean

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.chosen import AS_IT_IS, Asked, changed
from benchmarks.drives import ROUTES, Known, asked, drives_of, learned
from benchmarks.measure import Column, Row, new_row, some_of, table, write_bench
from benchmarks.storage_drives import BOOKS
from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import Frames, as_shape
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.features.views import SEGMENT, STRONGER
from dejavu_torch.teaching import in_its_light
from dejavu_torch.types import Traverse

REAL = (
    *("as it was", "there and back", "three times the speed", "a stop"),
    *("stretches of 5 to 15", "stretches of 20 to 40"),
)
COPIED, MOST_PACE = 600, 3.0  # frames of a route that are copied, the first; places a query, irregularly
LASTS = {"each frame by itself": 1, f"{SEGMENT} frames alike": SEGMENT}  # frames that share a change
RATES: dict[str, float | None] = {"": None, ", half a byte": 0.5}
# of chosen.py: which speeds a drive has, and how long free motion goes on; how many queries count as one
FAMILIES: dict[str, dict[str, object]] = {
    "free": {"SELDOM": 2.0},  # no speed occurs as often
    "both": {},
    "steady": {"STAYS_FREE": 0.5},
}
SETTINGS = {
    f"{family}, {tempering:g}": {**values, "SHARPENED": tempering}
    for (family, values), tempering in product(FAMILIES.items(), (0.3, 0.6, 1.2))
}
USUAL, HINDSIGHT = "both, 0.6", "in hindsight"
KEYS = "setting", "auc", "copies", "tau", "skipped"
COLUMNS: dict[str, Column] = {"AUC": ("auc", ".3f"), "of copies": ("copies", ".3f"), "tau": ("tau", ".1f")}


def run_copies(data: Path, *, out: Path, routes: Sequence[str] = ()) -> list[str]:
    """Whether altered copies of a map's frames could choose how its drives are matched, at two rates.

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json
        routes: names of routes, as of `drives`; all with pictures if not given
    """
    rows: list[Row] = []
    pairs = [(name, rate) for name in some_of(ROUTES, routes) for rate in RATES if not rate or name in BOOKS]
    for name, rate in tqdm(pairs, "maps", disable=None, leave=False):
        route = ROUTES[name][0].below(data)
        reference = open_source(route.reference)
        if len(reference.frame_shape) == 3:
            known = learned(route, None, RATES[rate])
            rows += bench_copies(name + rate, known, reference)
            write_bench(out, rows)  # as soon as a route is finished
    note = "mean AUC of drives of another visit, and of copies of the map's frames"
    return [table(rows, COLUMNS, "{case}: {contender} ({setting})"), note]


def bench_copies(case: str, known: Known, reference: Traverse) -> Iterator[Row]:
    """A row for the usual setting, for the one that is best on copies of each kind, and for the best of all.

    Yields:
        setting; auc: mean over drives of another visit with it. copies: likewise over drives of copies.
            tau: mean correlation of queries, of these copies or else of the visit.
    """
    real, tau = _by_setting(_visits(known))
    yield new_row(case, AS_IT_IS, KEYS, setting=USUAL, auc=real[USUAL], tau=tau)
    for name, frames in LASTS.items():
        copies, tau = _by_setting(_copies(known, reference, frames))
        best = max(copies, key=lambda one: (copies[one], one == USUAL))
        yield new_row(case, name, KEYS, setting=best, auc=real[best], copies=copies[best], tau=tau)
    best = max(real, key=real.__getitem__)
    yield new_row(case, HINDSIGHT, KEYS, setting=best, auc=real[best])


def _by_setting(drives: Sequence[Asked]) -> tuple[dict[str, float], float]:
    """The mean AUC of drives by setting, and their mean correlation."""
    found, tau = {}, []
    for name, values in SETTINGS.items():
        with changed(values):
            matches = [(one, one.matched()) for one in drives]
        areas = [evaluate(match, one.truth, one.known.tolerance).auc for one, match in matches]
        found[name] = mean(areas)
        tau += [getattr(match.smoother, "correlation", 1.0) for _, match in matches]
    return found, mean(tau)


def _visits(known: Known) -> list[Asked]:
    """Drives of another visit."""
    made = ((name, drives_of(len(known.queries), None)[name]) for name in REAL)
    pairs = [(name, *asked(known, numbers)) for name, numbers in made if numbers is not None]
    return [Asked(name, known, in_its_light(known.model, some), truth) for name, some, truth in pairs]


def _copies(known: Known, reference: Traverse, frames: int) -> list[Asked]:
    """Drives of altered copies of the map's frames, at steady, irregular and random speeds."""
    count = min(COPIED, len(reference))
    change, draw = Augmentation().stronger(STRONGER), torch.Generator().manual_seed(1)
    altered = [
        change.train()(reference[numbers.tolist()][None], draw)[0]
        for numbers in torch.arange(count).split(frames)
    ]
    shape = known.model.frame_shape or ()
    descriptors = known.model.descriptor.all_of(Frames(as_shape(torch.cat(altered), shape))).float()
    found = []
    for name, numbers in _paths(count, draw).items():
        places, none = numbers[:, None], torch.full((len(numbers), 1), -1)
        truth = GroundTruth(places, torch.ones_like(numbers).bool(), none)
        found.append(Asked(name, known, in_its_light(known.model, descriptors[numbers]), truth))
    return found


def _paths(count: int, draw: torch.Generator) -> dict[str, Tensor]:
    """Numbers of the frames of a route, as drives pass them."""
    whole, steps = torch.arange(count), MOST_PACE * torch.rand(count, generator=draw)
    irregular = steps.cumsum(0).long()
    firsts = torch.randint(0, max(1, count - SEGMENT), (max(1, count // SEGMENT),), generator=draw)
    return {
        "steady": whole,
        "twice as fast": whole[::2],
        "irregular": irregular[irregular < count],
        "random": torch.cat([whole[first : first + SEGMENT] for first in firsts.tolist()]),
    }
