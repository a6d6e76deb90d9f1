"""`benchmarks drives`: drives cut from those of real routes, answered by one image and by the whole drive."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.large_drives import COLUMNS as LARGE
from benchmarks.large_drives import TASKS, bench_large_drives
from benchmarks.measure import Column, Row, new_row, some_of, table, truth_of, write_bench
from benchmarks.trainings import Route, drive
from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import fitted
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.rejection import calibration_error, judged
from dejavu_torch.growth import calibrate_if_possible
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.teaching import in_its_light
from dejavu_torch.types import Match

SUMMER, WINTER = "{data}/nordland/summer?", "{data}/nordland/winter?"
FLOORS, CORRIDOR = "{data}/floors_rejection/query.npy", "{data}/corridor/query"
GARDENS = "{{data}}/gardens_night_hdc/{}.npy"


def railway(part: str) -> Route:
    return Route(SUMMER + part, WINTER + part, 1, "0")


# two traverses, and queries of another route; features that no other route has go without
ROUTES: dict[str, tuple[Route, str | None]] = {
    **{
        f"city {i}": (drive(f"robotcar/{t}", 2), WINTER + "stop=900")
        for i, t in enumerate(("t1", "t2", "t5"), 1)
    },
    "laps": (drive("donkey_lap", 10), FLOORS),
    "corridor": (Route("{data}/corridor/ref", CORRIDOR, 0, "{data}/corridor/truth.csv"), FLOORS),
    "railway, first half": (railway("stop=900"), WINTER + "start=900"),
    "railway, second half": (railway("start=900"), WINTER + "stop=900"),
    "corridor laps": (drive("corridor_laps", 0), FLOORS),
    "magnetometer": (drive("magnetic_laps", 5), None),
    "lidar": (drive("lidar_fhw", 1), None),
    "walks": (drive("wifi_mall", 0), None),
    "floors": (drive("floors_rejection", 1), CORRIDOR),
    "gardens": (Route(GARDENS.format("reference"), GARDENS.format("query"), 1, "0"), None),
}
NOISE = 0.01  # of a typical step, in frames that repeat one
STOP, BESIDE, THRICE, RANDOM = 200, 150, 400, 500  # queries
STRETCHES = ((5, 15), (5, 40), (20, 40))
AS_IT_WAS, HALF, ELSEWHERE = "as it was", "half of it off the map", "another route"
NO_OTHER = "no other route has such features"
KEYS = (
    *("queries", "auc_uncentred", "auc_one", "auc", "is_drive", "above_half", "above_nine_tenths"),
    *("one_above_half", "accepted_right", "calibration_error", "seconds", "skipped"),
)
COLUMNS: dict[str, Column] = {
    **{"queries": ("queries", ".0f"), "one image": ("auc_one", ".3f"), "whole drive": ("auc", ".3f")},
    **{
        "a drive": ("is_drive", ".0f"),
        "p > .5": ("above_half", ".3f"),
        "p > .9": ("above_nine_tenths", ".3f"),
    },
    **{"accepted right": ("accepted_right", ".3f"), "calibration error": ("calibration_error", ".3f")},
    "seconds": ("seconds", ".2f"),
}


class Known(NamedTuple):
    """A map, the descriptors of a drive (Q,K), their truth, and descriptors of another route, if any."""

    model: DejaVu
    queries: Tensor
    truth: GroundTruth
    tolerance: int
    other: Tensor | None = None


def run_drives(
    data: Path, *, out: Path, routes: Sequence[str] = (), seed: int = 0, large: bool = False
) -> list[str]:
    """Drives cut from real ones, each answered by one image and by the whole drive.

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json
        routes: names of routes; all if not given
        seed: of the stretches in random order
        large: instead, time and memory on large maps, of made descriptors
    """
    if large:
        rows = list(tqdm(bench_large_drives(), "large maps", len(TASKS), disable=None, leave=False))
        write_bench(out, rows)
        return [table(rows, LARGE, "{contender}"), "places found; seconds, and memory beyond map and queries"]
    rows = []
    for name in tqdm(some_of(ROUTES, routes), "drives", disable=None, leave=False):
        route, other = ROUTES[name]
        source = None if other is None else other.format(data=data)
        rows += bench_drives(name, learned(route.below(data), source), seed)
        write_bench(out, rows, seed=seed)  # as soon as a route is finished
    return [table(rows, COLUMNS), "AUC of one image and of the whole drive"]


def learned(route: Route, other: str | None, budget: float | None = None) -> Known:
    """The map of a route, calibrated if it can be, and what is asked of it; `budget`: bytes per place."""
    model, reference = DejaVu(mapper=SpectralMapper(budget)), open_source(route.reference)
    model.learn(reference)
    calibrate_if_possible(model, reference)
    query = open_source(route.query)
    elsewhere = None
    if other is not None:
        elsewhere = model.descriptor.all_of(fitted(open_source(other), query.frame_shape)).float()
    truth = truth_of(reference, query, route.truth)
    return Known(model, model.descriptor.all_of(query).float(), truth, route.tolerance, elsewhere)


def bench_drives(name: str, known: Known, seed: int = 0) -> Iterator[Row]:
    """A row for each drive made of a route's.

    Yields:
        auc_one, auc: of one image and of the whole drive, both with centred queries; auc_uncentred: of one
        image as it is. is_drive: whether the smoother took the queries for a drive of the map.
        above_half, above_nine_tenths: share of all queries with a larger probability; one_above_half:
        that by one image. accepted_right: share of right ones of those with at least .5. seconds: of the
        whole drive's answers.
    """
    for made, numbers in drives_of(len(known.queries), known.other, seed).items():
        row = new_row(name, made, KEYS)
        if numbers is None:
            yield row | {"skipped": NO_OTHER}
            continue
        yield row | facts_of(known, numbers)


def drives_of(count: int, other: Tensor | None, seed: int = 0) -> dict[str, Tensor | None]:
    """Drives made of one with so many queries: the number of each query, or -1 - i for i of the other route;
    None for a drive that needs another route, if there is none."""
    random, whole, half = torch.Generator().manual_seed(seed), torch.arange(count), count // 2
    before, after = max(0, half - BESIDE), min(count, half + BESIDE)
    stop = [whole[before:half], whole[half : half + 1].repeat(STOP), whole[half:after]]
    drives: dict[str, Tensor | None] = {
        AS_IT_WAS: whole,
        "reversed": whole.flip(0),
        "there and back": torch.cat([whole[:half], whole[:half].flip(0)]),
        "a third of the speed": whole[:THRICE].repeat_interleave(3),
        "three times the speed": whole[::3],
        "five times the speed": whole[::5],
        "a stop": torch.cat(stop),
    }

    def stretch(frames: int, low: int, high: int) -> Tensor:
        length = min(frames, int(torch.randint(low, high + 1, (), generator=random)))
        first = int(torch.randint(0, frames - length + 1, (), generator=random))
        return torch.arange(first, first + length)

    def stretches(low: int, high: int, others: int = 0) -> Tensor:
        parts: list[Tensor] = []
        while sum(map(len, parts)) < min(count, RANDOM):
            part = stretch(count, low, high)
            parts.append(part.flip(0) if torch.rand((), generator=random) < 0.5 else part)
            if others:
                parts.append(-1 - stretch(others, low, high))
        return torch.cat(parts)

    for low, high in STRETCHES:
        drives[f"stretches of {low} to {high}"] = stretches(low, high)
    off = None if other is None else -1 - torch.arange(len(other))
    drives["stretches of 5 to 40, others between"] = None if other is None else stretches(5, 40, len(other))
    drives[HALF] = None if off is None else torch.cat([whole[:half], off[: count - half]])
    drives[ELSEWHERE] = off
    return drives


def asked(known: Known, numbers: Tensor) -> tuple[Tensor, GroundTruth]:
    """The queries of a drive by their numbers, and their truth: those of the other route have no place."""
    own, at = numbers >= 0, numbers.clamp(min=0)
    queries, (positives, judged, ignored) = known.queries[at], known.truth
    queries = queries + _noise(queries, numbers)
    if known.other is not None:
        queries = torch.where(own[:, None], queries, known.other[(-1 - numbers).clamp(min=0)])
    places = [torch.where(own[:, None], table[at], -1) for table in (positives, ignored)]
    return queries, GroundTruth(places[0], judged[at] | ~own, places[1])


def _noise(queries: Tensor, numbers: Tensor) -> Tensor:
    """A little noise, (Q,K), of queries that repeat the frame before them: as of a camera that stands, whose
    pictures are never the same bit by bit. Those that are belong to a stream that has stalled."""
    steps = (queries[1:] - queries[:-1]).norm(dim=1)
    typical = float(steps[steps > 0].median()) if bool((steps > 0).any()) else 0.0
    noise = torch.randn(queries.shape, generator=torch.Generator().manual_seed(0))
    again = torch.cat([numbers[:1] != numbers[:1], numbers[1:] == numbers[:-1]])
    return again[:, None] * noise * (NOISE * typical / math.sqrt(max(1, queries.shape[1])))


def facts_of(known: Known, numbers: Tensor) -> dict[str, Any]:
    """The figures of a drive; see `bench_drives`."""
    model, tolerance = known.model, known.tolerance
    queries, truth = asked(known, numbers)
    moved = in_its_light(model, queries)
    single = model.matching()._replace(radius=tolerance)
    together = model.matching(PlaceSmoother(within=tolerance))._replace(radius=tolerance)
    plain, one = (model.localize_descriptors(some, single) for some in (queries, moved))
    began = time.perf_counter()
    whole = model.localize_descriptors(moved, together)
    assert whole.probability is not None
    seconds = time.perf_counter() - began
    found: dict[str, Any] = {"queries": len(queries), "is_drive": whole.is_drive, "seconds": seconds}
    found |= {"above_half": above(whole, 0.5), "above_nine_tenths": above(whole, 0.9)}
    found["one_above_half"] = None if one.probability is None else above(one, 0.5)
    probability, right = judged(whole, truth, tolerance)
    kept = right[probability >= 0.5]
    found["accepted_right"] = float(kept.double().mean()) if len(kept) else None
    found["calibration_error"] = calibration_error(probability, right)
    if bool((numbers >= 0).any()):
        matches = {"auc_uncentred": plain, "auc_one": one, "auc": whole}
        found |= {key: evaluate(match, truth, tolerance).auc for key, match in matches.items()}
    return found


def above(match: Match, probability: float) -> float:
    """The share of answers with a larger probability."""
    assert match.probability is not None
    return float((match.probability > probability).double().mean())
