"""`benchmarks terrain`: a square kilometre of simulated ground, a window each metre, in bytes and seconds."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import Tensor

from benchmarks.areas import flight
from benchmarks.front import summarised
from benchmarks.measure import Row, write_bench
from benchmarks.ways import Scoring, in_order, stored_by
from dejavu_torch import DejaVu, PlaceSmoother, SpectralMapper
from dejavu_torch.data.simulate.terrain import open_terrain
from dejavu_torch.data.traverse import Part
from dejavu_torch.evaluation.controls import shuffled
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition.drive import DriveQuery, localize_drive

SEEDS = (1, 2, 3)  # of ground, whitening and queries; settings were chosen on others
SIZES = (0.3, 1.0, 2.2)  # bytes of the lines per place
LEARNED = 1.0  # of which time, file and a single query are measured
FLOWN_AT = (0.3, 1.0)  # bytes at which flights and the control are measured
QUERIES, FLOWN = 500, 60  # single images, and images of a flight, of the other traverse
RADII = (1, 2, 5)  # metres
ALONE = 100  # images that are searched one by one
FOUND = [f"{kind}recall_{radius}m" for kind in ("", "flight_") for radius in RADII]
NAMES = {"map": "this map", "null": "shuffled windows", "uncompressed": "float32, every window"}


def found_within(places: Tensor, area: Layout, where: Tensor) -> list[float]:
    """Shares of places (Q,) within some distances of the middles (Q,2) of queries."""
    off = (area.coordinates(places.clamp(min=0)) - where).norm(dim=1).masked_fill(places < 0, torch.inf)
    return [float((off <= radius).double().mean()) for radius in RADII]


def learned(model: DejaVu, seed: int, metres: int, queries: int = ALONE) -> Row:
    """Seconds to learn a map, bytes of its file, and milliseconds of a single query."""
    reference, second = open_terrain(seed, 0, metres), open_terrain(seed, 1, metres, stride=1)
    began = time.perf_counter()
    model.learn(reference)
    seconds, ms = time.perf_counter() - began, []
    asked = torch.randint(len(second), (queries,), generator=torch.Generator().manual_seed(seed))
    for query in model.descriptor.all_of(Part(second, asked)).float().split(1):
        began = time.perf_counter()
        model.localize_descriptors(query)
        ms.append(1e3 * (time.perf_counter() - began))
    with TemporaryDirectory() as folder:
        model.save(Path(folder) / "map.safetensors")
        size = (Path(folder) / "map.safetensors").stat().st_size
    return {"learn_seconds": seconds, "bytes": size, "ms": sorted(ms)[len(ms) // 2]}


def ways_of(places: Tensor, area: Layout, seed: int) -> Iterator[tuple[str, float, Scoring]]:
    """Keys, bytes per place and scores of the map, of its control and of all descriptors (N,K)."""
    order, mixed = shuffled(places, seed)
    for size in SIZES:
        for key, rows in (("map", places), ("null", mixed))[: 1 + (size in FLOWN_AT)]:
            made = SpectralMapper(size)(rows, area)
            score = in_order(made, order if key == "null" else None)
            yield key, size, score
    yield "uncompressed", 4.0 * places.shape[1], stored_by(places, area)


@torch.no_grad()
def measured(seed: int, metres: int) -> list[Row]:
    """The rows of a seed."""
    reference, second = open_terrain(seed, 0, metres), open_terrain(seed, 1, metres, stride=1)
    assert second.coordinates is not None
    area, where, draw = reference.layout, second.coordinates.values, torch.Generator().manual_seed(seed)
    model = DejaVu(whitening=Whitening(seed=seed), mapper=SpectralMapper(LEARNED))
    facts = learned(model, seed, metres)
    asked = torch.randint(len(second), (QUERIES,), generator=draw)
    path = second.layout.place_at(flight(second.layout, draw)[:FLOWN])
    places = torch.cat([*model.descriptor.batches(reference, shared=True)]).float()  # as the map's
    queries, flown = (model.descriptor.all_of(Part(second, one)).float() for one in (asked, path))
    rows: list[Row] = []
    for key, size, score in ways_of(places, area, seed):
        asked_by = score(queries)
        single = torch.cat([asked_by.rows(part).argmin(1) for part in torch.arange(len(queries)).split(20)])
        found = found_within(single, area, where[asked])
        if size in FLOWN_AT or key == "uncompressed":
            drive = DriveQuery(score(flown), PlaceSmoother(), radius=0, asks=False)
            whole = localize_drive(drive).index[:, 0]
            found += found_within(whole, area, where[path])
        row: Row = {"seed": seed, "contender": key, "bytes_per_place": size, "places": len(reference)}
        rows.append(row | dict(zip(FOUND, found, strict=False)))
        if (key, size) == ("map", LEARNED):
            rows[-1] |= facts
    return rows


def run_terrain(*, out: Path, metres: int = 1015) -> list[str]:
    """Squares of simulated ground at several sizes: time to learn, bytes, milliseconds, and what is found, in
    two processes.

    Args:
        out: folder for bench.json
        metres: side of a square; 1015 are 10^6 places
    """
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        rows = [row for found in pool.map(measured, SEEDS, repeat(metres)) for row in found]
    means = summarised(rows, (*FOUND, "learn_seconds", "bytes", "ms"))
    write_bench(out, means, metres=metres, seeds=list(SEEDS))
    lines = [f"{'within 1/2/5 m':<26}{'bytes':>8}{'one image':>20}{'a flight':>20}"]
    for row in means:
        parts = (FOUND[:3], FOUND[3:])
        shares = ["/".join(f"{row[key]:.3f}" for key in part if key in row) for part in parts]
        lines.append(
            f"{NAMES[row['contender']]:<26}{row['bytes_per_place']:>8.2f}" + f"{shares[0]:>20}{shares[1]:>20}"
        )
    return lines
