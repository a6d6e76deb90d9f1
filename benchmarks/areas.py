"""`benchmarks areas`: windows of one flight over a road, found on the map of another, over bytes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.front import summarised
from benchmarks.measure import Row, write_bench
from benchmarks.quantisers import Quantiser
from benchmarks.ways import Scoring, in_order, stored_by
from dejavu_torch import DejaVu, PlaceFilter, PlaceSmoother, SpectralMapper, Whitening
from dejavu_torch.data.demo import open_area
from dejavu_torch.evaluation.baselines import as_int8, stored_frames
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.controls import shuffled
from dejavu_torch.evaluation.plots import Plot, legend
from dejavu_torch.evaluation.quantiser import product_quantised
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition.drive import DriveQuery, localize_drive
from dejavu_torch.recognition.localizer import Localizer, Matching

SEEDS = (1, 2, 3)  # of whitening, queries, codebooks and the order of the control; settings were chosen on 0
STRIDE, QUERIES = 4, 1500  # pixels of 12.5 cm; queries at any offset
RADIUS = 10.0  # pixels
PACE = 8.0  # pixels from one image of a flight to the next, on a course that winds
APART, LINE, SURVEYED = 25, 700, 400  # pixels between lines of a survey, and of a line; its images
FLOWN = ("map", "null", "uncompressed")
SKIPPED = int(
    2 * RADIUS / STRIDE
)  # windows from one that is stored to the next: as many as the radius allows
BYTES = (0.3, 0.42, 1.0, 2.2, 4.0)
CODES = (1, 2, 4)
FLIGHT = ("flight", "flight_accepted_wrong", "flight_on_the_way")
SURVEY = ("survey", "survey_accepted_wrong", "survey_on_the_way")
NAMES = {
    "map": "this map, both directions",
    "rows": "maps of its rows",
    "null": "shuffled windows",
    "product_quantiser": "product quantiser",
    "PQ": "the same, codebooks of another area",
    "RQ": "residual quantiser, likewise",
    "stride": "int8, every 5th window",
    "uncompressed": "float32, every window",
}


def ways_of(places: Tensor, area: Layout, seed: int) -> Iterator[tuple[str, float, Scoring]]:
    """Keys, bytes per place and scores of all ways to store descriptors (N,K) of an area."""
    order, mixed = shuffled(places, seed)
    by_row = torch.cartesian_prod(torch.arange(area.rows), torch.arange(area.columns))
    in_rows = area.place_at(by_row)
    for size in BYTES:
        for key, rows in (("map", places), ("null", mixed), ("rows", places[in_rows])):
            if key == "rows":
                made = SpectralMapper(size, chunk=area.columns)(rows)
            else:
                made = SpectralMapper(size)(rows, area)
            where = {"map": None, "null": order, "rows": in_rows}[key]
            yield key, made.summary().route_bytes / len(places), in_order(made, where)
    # codebooks of the other half of the road
    half = area.cells(torch.arange(len(places)))[:, 1] < area.columns // 2
    for code in CODES:
        restored, _ = product_quantised(places, code, seed)
        yield "product_quantiser", code, stored_by(restored, area)
        for kind in ("PQ", "RQ"):
            restored = torch.empty_like(places)
            for one, other in ((half, ~half), (~half, half)):
                restored[one] = Quantiser(places[other], f"{kind}{code}x8")(places[one])
            yield kind, code, stored_by(restored, area)
    kept = len(stored_frames(len(places), SKIPPED, area)[0]) / len(places)
    yield "stride", kept * places.shape[1], stored_by(as_int8(places), area, SKIPPED)
    yield "uncompressed", 4.0 * places.shape[1], stored_by(places, area)


@torch.no_grad()
def measured(seed: int) -> list[Row]:
    """The rows of a seed."""
    reference, second = open_area(0, stride=STRIDE), open_area(1, stride=1)
    draw = torch.Generator().manual_seed(seed)
    asked = torch.randint(len(second), (QUERIES,), generator=draw)
    model = DejaVu(whitening=Whitening(seed=seed))
    places = model.descriptor.learn(reference).float()
    queries = torch.cat([model.descriptor(second[part.tolist()]) for part in asked.split(64)])
    where, own = reference.coordinates, second.coordinates
    assert where is not None
    assert own is not None
    flights = []
    for names, cells in ((FLIGHT, flight(second.layout, draw)), (SURVEY, survey(second.layout, draw))):
        path = second.layout.place_at(cells)
        described = [model.descriptor(second[part.tolist()]) for part in path.split(64)]
        flights.append((names, own.values[path], torch.cat(described)))
    rows = []
    for key, size, score in ways_of(places, reference.layout, seed):
        asked_by = score(queries)
        best = torch.cat([asked_by.rows(part).argmin(1) for part in torch.arange(len(queries)).split(256)])
        if key == "stride":  # of equal scores, the place that is stored
            kept, nearest = stored_frames(len(places), SKIPPED, reference.layout)
            best = kept[nearest[best]]
        right = (where.values[best] - own.values[asked]).norm(dim=1) <= RADIUS
        row: Row = {"seed": seed, "contender": key, "bytes_per_place": size}
        rows.append(row | {"recall_at_1": float(right.double().mean())})
        for names, at, flown in flights[: {"map": 2}.get(key, 1)] if key in FLOWN else ():
            smoother = PlaceSmoother(within=round(RADIUS / STRIDE))
            scorer = score(flown)
            found = localize_drive(DriveQuery(scorer, smoother, radius=0, asks=False))
            right = (where.values[found.index[:, 0]] - at).norm(dim=1) <= RADIUS
            sure = found.probability[:, 0] >= 0.5 if found.probability is not None else right
            matcher = Localizer(None, Matching(PlaceFilter()), layout=reference.layout)
            live = matcher.match(
                torch.cat([scorer.rows(part) for part in torch.arange(len(flown)).split(64)])
            ).index
            on_the_way = (where.values[live] - at).norm(dim=1) <= RADIUS
            shares = right, sure & ~right, on_the_way
            rows[-1] |= {name: float(one.double().mean()) for name, one in zip(names, shares, strict=True)}
    return rows


def flight(area: Layout, draw: torch.Generator) -> Tensor:
    """Cells of windows along a flight that winds over the area from left to right, (n,2)."""
    at, course, cells = torch.tensor([area.rows / 2, 0.0]), 0.0, []
    while float(at[1]) < area.columns - 1:
        cells.append(at.round().long())
        course = 0.9 * course + 0.25 * float(torch.randn((), generator=draw))
        at = at + PACE * torch.tensor([math.sin(course), max(0.1, math.cos(course))])
        if not 0 <= at[0] <= area.rows - 1:  # turns back at the border
            at[0], course = at[0].clamp(0, area.rows - 1), -course
    return torch.stack(cells)


def survey(area: Layout, draw: torch.Generator) -> Tensor:
    """Cells of windows along lines there and back, from the middle on, with a little wind, (n,2)."""
    at, cells = torch.tensor([float(APART) / 2, area.columns / 2]), []
    pace, first = PACE, float(at[1])
    for _ in range(SURVEYED):
        wind = 2 * torch.randn(2, generator=draw)
        cells.append((at + wind).round().long())
        at[1] += pace
        if not first <= at[1] < first + LINE:  # the next line
            pace, at[0] = -pace, (at[0] + APART) % area.rows
    most = torch.tensor([area.rows - 1, area.columns - 1])
    return torch.stack(cells).clamp(min=0).minimum(most)


def plot_areas(rows: list[Row]) -> Plot:
    """Recall over bytes."""
    figure = Figure(figsize=(5, 3.4), layout="constrained", dpi=160)
    axis: Any = figure.subplots()
    colours = COLOURS | {"rows": "#7f6fb0", "PQ": "#b35806", "RQ": "#e08214"}
    for key, name in NAMES.items():
        same = sorted((r["bytes_per_place"], r["recall_at_1"]) for r in rows if r["contender"] == key)
        axis.plot(*zip(*same, strict=True), "o-", label=name, color=colours[key], markersize=4)
    axis.set_xscale("log")
    axis.set_xticks([0.5, 1, 2, 4, 16, 64, 512], ["½", "1", "2", "4", "16", "64", "512"])
    axis.minorticks_off()
    axis.set(xlabel="bytes per window", ylabel="found within 10 pixels", ylim=(0, 1.03))
    axis.spines[["top", "right"]].set_visible(False)
    legend(figure, ncols=2)
    return figure, axis


def run_areas(*, out: Path) -> list[str]:
    """Recall over bytes on an area, the road of the demo in two directions: map, rows, quantisers, controls.

    Args:
        out: folder for bench.json and bench.png
    """
    means = summarised([row for seed in SEEDS for row in measured(seed)], ("recall_at_1", *FLIGHT, *SURVEY))
    write_bench(out, means, plot_areas(means), seeds=list(SEEDS), radius=RADIUS)
    lines = [f"{'':<38}{'bytes':>8}{'one image':>11}{'flight':>8}{'on the way':>12}{'survey':>8}"]
    for row in means:
        name = NAMES[row["contender"]]
        whole = "".join(
            f"{row[key]:>{8 + 4 * (key == FLIGHT[2])}.3f}" for key in (*FLIGHT[::2], SURVEY[0]) if key in row
        )
        lines.append(f"{name:<38}{row['bytes_per_place']:>8}{row['recall_at_1']:>11.3f}{whole}")
    return [*lines, f"means of {len(SEEDS)} seeds"]
