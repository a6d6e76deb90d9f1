"""`benchmarks features`: features beside the default ones, on all routes, with several seeds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import torch
from torch import nn
from tqdm import tqdm

from benchmarks.drives import ROUTES
from benchmarks.measure import Column, Row, failure, new_row, table, truth_of, write_bench
from benchmarks.trainings import Route, drive, road
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation.controls import null_control
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.features.xfeat import XFeat
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.teaching import in_its_light
from dejavu_torch.types import InputError

Ways = dict[str, Callable[[Whitening, int], DejaVu]]  # of a whitening, for so many frames
FEATURES: Ways = {
    "HOG, Distilled": lambda whitening, _: DejaVu(whitening=whitening),
    "HOG, Distilled, XFeat": lambda whitening, _: described(
        [HOG(cell=None), Distilled(), XFeat()], whitening
    ),
}
COPIES: Ways = {
    "default": lambda whitening, _: DejaVu(whitening=whitening),
    "twice as many": lambda whitening, frames: DejaVu(whitening=with_copies(2, whitening, frames)),
}
CELLS = (8, 12, 16)  # pixels
LARGE = ("corridor", "corridor laps")  # whose frames are above 100 pixels
WIDE = 1000  # features, more than there are components
LAPS, NEAR = (194, 590, 982, 1356), 15  # first frames of a small car's laps, about; frames
FOOTAGE: dict[str, Route] = {  # with frames
    **{
        name: route for name, (route, _) in ROUTES.items() if name not in ("magnetometer", "lidar", "gardens")
    },
    **{"corridor laps": drive("corridor_laps", 0)},
    **{"road, first half": road("&stop=1348"), "road, second half": road("&start=1348")},
}
KEYS = ("seed", "auc_one", "auc", "null", "map_bytes", "seconds", "skipped")
COLUMNS: dict[str, Column] = {
    **{"seed": ("seed", ".0f"), "one image": ("auc_one", ".3f"), "null": ("null", ".3f")},
    **{"whole drive": ("auc", ".3f"), "kB": ("map_bytes", ".0f", 1000.0), "seconds": ("seconds", ".0f")},
}


def run_features(
    data: Path, *, out: Path, seeds: int = 3, cells: bool = False, copies: bool = False
) -> list[str]:
    """XFeat beside the default features: AUC of one image and of the whole drive, and of the null.

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json
        seeds: of the whitening and of the null, from 0 on
        cells: instead, the sides of HOG's cells, in pixels, on frames above 100 pixels
        copies: instead, twice as many altered copies for the whitening, on routes of over 500 frames
    """
    rows: list[Row] = []
    ways, routes = FEATURES, FOOTAGE
    if cells:
        ways = {f"{side} x {side}": partial(with_cells, side) for side in CELLS}
        routes = {name: FOOTAGE[name] for name in LARGE} | {f"lap {n}": lap(n, out) for n in (2, 3)}
    if copies:
        kinds, long = ("aerial", "outdoor", "underground"), ("road", "railway")
        routes = {name: route for name, route in FOOTAGE.items() if name.startswith(long)}
        routes |= {
            f"sim:{kind}": Route(f"sim:{kind}?seed=3", f"sim:{kind}?seed=3&traverse=1") for kind in kinds
        }
        ways = COPIES
    for name, route in tqdm(routes.items(), "features", disable=None, leave=False):
        for seed in range(seeds):
            rows += bench_features(name, route.below(data), seed, ways)
            write_bench(out, rows)
    return [table(rows, COLUMNS), "AUC, centred where there are enough queries"]


def lap(number: int, out: Path) -> Route:
    """The first lap of a small car and another, whose places are in proportion; their file goes to `out`."""
    start, stop = LAPS[number - 1 : number + 1]
    place = torch.linspace(0, LAPS[1] - LAPS[0] - 1, stop - start).round().long().tolist()
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"lap{number}.csv"
    path.write_text("query,place\n" + "".join(f"{query},{at}\n" for query, at in enumerate(place)))
    frames = "{{data}}/rc_car_laps/frames?start={}&stop={}"
    return Route(frames.format(*LAPS[:2]), frames.format(start, stop), NEAR, str(path))


def described(features: list[nn.Module], whitening: Whitening) -> DejaVu:
    return DejaVu(Joined(features), whitening)


def with_cells(side: int, whitening: Whitening, frames: int) -> DejaVu:
    return described([HOG(cell=side), Distilled()], whitening)


def with_copies(factor: int, whitening: Whitening, frames: int) -> Whitening:
    whitening.views = factor * whitening.copies(frames, WIDE)
    return whitening


def bench_features(name: str, route: Route, seed: int, ways: Ways = FEATURES) -> Iterator[Row]:
    """A row for each way to describe frames."""
    reference, query = open_source(route.reference), open_source(route.query)
    truth, tolerance = truth_of(reference, query, route.truth), route.tolerance
    for way, made in ways.items():
        began = time.perf_counter()
        try:
            model = made(Whitening(seed=seed), len(reference))
        except InputError as error:  # the package is missing
            yield new_row(name, way, KEYS, seed=seed, skipped=failure(error))
            continue
        rows = model.descriptor.learn(reference)
        model.learn_features(rows, reference)
        queries = model.descriptor.all_of(query)
        moved = in_its_light(model, queries)
        smoother = model.matching(PlaceSmoother(within=tolerance))._replace(radius=tolerance)
        matches = {
            "auc_one": model.localize_descriptors(moved),
            "auc": model.localize_descriptors(moved, smoother),
            "null": null_control(model, rows, moved, seed),
        }
        figures = {key: evaluate(match, truth, tolerance).auc for key, match in matches.items()}
        size = model.summary().map_bytes
        yield new_row(
            name, way, KEYS, seed=seed, **figures, map_bytes=size, seconds=time.perf_counter() - began
        )
