"""`benchmarks storage --drives`: stores of few bytes, asked by one image and by the whole drive."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from benchmarks.drives import ROUTES, SUMMER
from benchmarks.measure import Row, failure, new_row, truth_of, write_bench
from benchmarks.quantisers import Kept, Quantiser, every_kth, spectral
from benchmarks.storage import NEAR, NULL, OURS, best, both, by, named, skipped_lines
from dejavu_torch.data.ground_truth import GroundTruth
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import fitted
from dejavu_torch.evaluation.baselines import as_int8, every
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.report import text_table
from dejavu_torch.maps.distance import Metric, phase_distances
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition.centring import centred
from dejavu_torch.recognition.drive import DriveQuery, localize_drive
from dejavu_torch.recognition.evidence import place_means, standardised
from dejavu_torch.recognition.scorer import OfRows
from dejavu_torch.recognition.select import best_match
from dejavu_torch.recognition.smoother import PlaceSmoother, rows_of
from dejavu_torch.types import InputError, Match

BOOKS = {  # of each route, another one to train codebooks on, which do not count
    **{"city 1": "{data}/robotcar/t2/reference.npy", "city 2": "{data}/robotcar/t5/reference.npy"},
    **{"city 3": "{data}/robotcar/t1/reference.npy", "railway, first half": SUMMER + "start=900"},
    "railway, second half": SUMMER + "stop=900",
    **{"laps": "{data}/rc_car_laps/frames", "corridor": "{data}/floors_rejection/reference.npy"},
}
BUDGETS = (0.25, 0.5, 1.0, 2.0, 5.0, 16.0)
SHOWN = (0.25, 0.5, 1.0, 2.0, 5.0)  # of the table
LARGER = 1.08  # with `NEAR` a tenth more: interpolated stores keep the last place too
CODES = (  # family, key of faiss's factory, divisor that K must have, strides
    *(("PQ", "PQ4x8np", 4, (1, 2, 4, 8, 16)), ("PQ", "PQ16x8np", 16, (1, 4))),
    *(("RQ", "RQ4x8", 1, (1, 4, 16)), ("LSQ", "LSQ4x8", 1, (1, 2, 4, 8, 16))),
)
BETWEEN, HOG_SPACED = (1, 8, 32, 128), (1, 4, 16)
FAMILIES = {  # rows of the table
    **{"**dejavu**": (OURS,), "null": (NULL,), "PQ": ("PQ",), "RQ, LSQ": ("RQ", "LSQ")},
    **{"every k-th": ("interpolated",), "HOG, every k-th": ("HOG",)},
}
ANSWERS = ("one", "window", "drive")
SIDE, SPEEDS = 10, tuple(0.2 * i for i in range(2, 11))  # queries to each side; places a query
KEYS = (
    *("family", "answer", "seconds", "fixed_bytes", "route_bytes", "route_bytes_per_place", "recall_at_1"),
    *("auc", "is_drive", "sequences", "skipped"),
)


class Asked(NamedTuple):
    """A route: descriptors of its places (N,K) and, centred, of its queries (Q,K).

    hog: those of HOG, where there are frames. other: of another route, for codebooks.
    """

    name: str
    places: Tensor
    queries: Tensor
    truth: GroundTruth
    tolerance: int
    hog: tuple[Tensor, Tensor] | None = None
    other: Tensor | None = None


def run_storage_drives(data: Path, out: Path) -> list[str]:
    """See `run_storage`; writes bench.json."""
    rows: list[Row] = []
    for name in BOOKS:
        rows += bench_storage_drives(described(name, data))
        write_bench(out, rows)  # as soon as a route is finished
    write_bench(out, rows)
    note = "AUC by one image, by sums over a window, and by the whole drive"
    return [text_table(drive_table(rows)), *skipped_lines(rows), note]


def described(name: str, data: Path) -> Asked:
    """A route with the descriptors of the default map."""
    route, model = ROUTES[name][0].below(data), DejaVu()
    reference, query = open_source(route.reference), open_source(route.query)
    places, queries = both(model, reference, query)
    plain, other = DejaVu(whitening="none").descriptor, open_source(BOOKS[name].format(data=data))
    hog = plain.all_of(reference).float(), plain.all_of(query).float()
    books = model.descriptor.all_of(fitted(other, reference.frame_shape)).float()
    truth = truth_of(reference, query, route.truth)
    moved = centred(SpectralMapper()(places), queries)  # the mean is the same in any number of bytes
    return Asked(name, places, moved, truth, route.tolerance, hog, books)


def stores_of(route: Asked) -> Iterator[tuple[str, str, Callable[[], Kept]]]:
    """Family, name and store of all contenders, ours first."""
    places, numbers = route.places, route.places.shape[1]
    for family, seed in ((OURS, None), (NULL, 0)):
        for budget in BUDGETS:
            yield family, f"{family} {budget:g}", partial(spectral, places, budget, seed)

    @cache  # one training for all strides
    def quantiser(key: str, multiple: int) -> Quantiser:
        if route.other is None:
            raise InputError("no other route to train codebooks on")
        return Quantiser(route.other, key, multiple)

    def coded(key: str, multiple: int, k: int) -> Kept:
        code = quantiser(key, multiple)
        return every_kth(places, k, code.each, code, k > 1)

    for family, key, multiple, strides in CODES:
        for k in strides:
            yield family, named(key, k), partial(coded, key, multiple, k)
    for k in BETWEEN:
        name = f"{every(k, 'frame')}, int8"
        yield "interpolated", name, partial(every_kth, places, k, numbers, as_int8, k > 1)
    if route.hog is not None:
        features = route.hog[0]
        for k in HOG_SPACED:
            keep = partial(every_kth, features, k, features.shape[1], as_int8, k > 1)
            yield "HOG", f"HOG of {every(k, 'frame')}, int8", keep


def bench_storage_drives(route: Asked) -> Iterator[Row]:
    """Three rows for each store: its answers by one image, by sums over a window on both sides, and by the
    whole drive, from the same scores.

    Yields:
        answer: one, window or drive. is_drive: whether the smoother took the queries for a drive. Other keys
        are those of `bench_storage`.
    """
    for family, name, keep in tqdm(list(stores_of(route)), route.name, disable=None, leave=False):
        rows = [new_row(route.name, name, KEYS, family=family, answer=answer) for answer in ANSWERS]
        try:
            kept = keep()
        except (InputError, ImportError) as error:
            said = str(error) if isinstance(error, InputError) else failure(error)
            yield from (row | {"skipped": said} for row in rows)
            continue
        size = {"route_bytes": kept.route, "route_bytes_per_place": kept.route / len(route.places)}
        metric: Metric = "l1" if family == "HOG" else "cosine"
        queries = route.hog[1] if family == "HOG" and route.hog is not None else route.queries
        scores = phase_distances(queries, kept.descriptors, metric)
        for row in rows:
            began = time.perf_counter()
            match = answered(row["answer"], scores, queries, PlaceSmoother(within=route.tolerance))
            found = evaluate(match, route.truth, route.tolerance)
            seconds = time.perf_counter() - began
            auc = {"auc": found.auc, "recall_at_1": found.recall_at_1}
            whole = match.is_drive if row["answer"] == "drive" else None
            yield row | size | auc | {"sequences": {"1": auc}, "is_drive": whole, "seconds": seconds}


def answered(answer: str, scores: Tensor, queries: Tensor, smoother: PlaceSmoother) -> Match:
    """The best place of each query, (Q,N) and (Q,K) -> Match of (Q,)."""
    if answer == "drive":
        scorer = OfRows(rows_of(scores), queries, Layout(scores.shape[1]))
        return localize_drive(DriveQuery(scorer, smoother)).map(lambda column: column[:, 0])
    return best_match(both_sides(scores) if answer == "window" else scores)


def both_sides(scores: Tensor, side: int = SIDE, speeds: Sequence[float] = SPEEDS) -> Tensor:
    """The mean score along a straight line through each query and place, of up to `side` queries before and
    after; the best of several speeds counts. (Q,N) -> (Q,N), +inf where half of the line is off the map.

    Scores are standardised as for the smoother. Source: SeqSLAM (Milford and Wyeth, 2012), on both sides.
    """
    z = standardised(scores, place_means(scores, scores.new_ones(len(scores)))).z
    queries, places = scores.shape
    at, best = torch.arange(queries), torch.full_like(scores, math.inf)
    used = (at + side).clamp(max=queries - 1) - (at - side).clamp(min=0) + 1
    for speed in speeds:
        total, count = torch.zeros_like(z), torch.zeros_like(z)
        for later in range(-side, side + 1):
            further = math.floor(speed * later + 0.5)
            rows, row_to = line(queries, later)
            columns, column_to = line(places, further)
            total[rows, columns] -= z[row_to, column_to]
            count[rows, columns] += 1
        mean = torch.where(2 * count >= used[:, None], total / count.clamp(min=1), math.inf)
        best = torch.minimum(best, mean)
    return best


def line(count: int, shift: int) -> tuple[slice, slice]:
    """The numbers i below a count for which i + shift is one too, and these."""
    shift = max(-count, min(count, shift))
    first, last = max(0, -shift), min(count, count - shift)
    return slice(first, last), slice(first + shift, last + shift)


def split(rows: Sequence[Row]) -> dict[str, dict[str, list[Row]]]:
    """The rows with figures by answer and family."""
    return {answer: by("family", some) for answer, some in by("answer", rows).items()}


def drive_table(rows: Sequence[Row]) -> list[list[str]]:
    """For each route, the best AUC of each family by bytes per place: by one image, a window, the drive; of
    ours also the recall@1 of the drive."""
    table = [["route bytes per place", *(f"{size:g}" for size in SHOWN), "any"]]
    for case, own in by("case", rows).items():
        found = split(own)
        for name, families in FAMILIES.items():
            cells = []
            for size in (*SHOWN, math.inf):
                some = ([row for one in families for row in found[a].get(one, ())] for a in ANSWERS)
                areas = [best(each, LARGER * size) for each in some]
                cells.append(" ".join(f"{area:.3f}".lstrip("0") for area in areas if area is not None))
            if any(cells):
                table.append([f"{case}: {name}", *cells])
        ours = [row for row in found["drive"][OURS] if row.get("recall_at_1") is not None]
        if not ours:
            continue
        table.append([f"{case}: dejavu, recall@1 of the drive"])
        for size in (*SHOWN, math.inf):
            fits = [row for row in ours if row["route_bytes_per_place"] <= NEAR * LARGER * size]
            most = max((row["recall_at_1"] for row in fits), default=None)
            table[-1].append("" if most is None else f"{most:.3f}".lstrip("0"))
    return table
