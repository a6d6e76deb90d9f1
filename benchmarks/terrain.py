"""`benchmarks terrain`: a square kilometre of simulated ground, a window each metre, in bytes and seconds."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import Tensor

from benchmarks.areas import flight
from benchmarks.measure import Row, write_bench
from dejavu_torch import DejaVu, PlaceSmoother, SpectralMapper
from dejavu_torch.data.grid import Grid
from dejavu_torch.data.simulate.terrain import open_terrain
from dejavu_torch.data.traverse import Part
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.types import Match

SIZES = (0.3, 1.0)  # bytes of the lines per place
QUERIES, FLOWN = 1000, 60  # single images, and images of a flight, of the other traverse
RADII = (1, 2, 5)  # metres
ALONE = 100  # images that are searched one by one


def found_within(match: Match, reference: Grid, where: Tensor) -> dict[str, float]:
    """Shares of answers within some distances of the middles (Q,2) of queries, and those accepted although
    wrong."""
    off = (reference.area.coordinates(match.index.clamp(min=0)) - where).norm(dim=1)
    off = off.masked_fill(match.index < 0, torch.inf)
    shares = {f"recall_{radius}m": float((off <= radius).double().mean()) for radius in RADII}
    return shares | {"accepted_wrong": float((match.accepted & (off > RADII[-1])).double().mean())}


def measured(size: float, metres: int, seed: int) -> Row:
    """A map of so many bytes per place."""
    reference, second = open_terrain(seed, 0, metres), open_terrain(seed, 1, metres, stride=1)
    draw = torch.Generator().manual_seed(seed)
    began = time.perf_counter()
    model = DejaVu(whitening=Whitening(seed=seed), mapper=SpectralMapper(size)).learn(reference)
    learned = time.perf_counter() - began
    model.calibrate(reference)
    asked = torch.randint(len(second), (QUERIES,), generator=draw)
    course = second.area.place_at(flight(second.area, draw)[:FLOWN])
    assert second.coordinates is not None
    where = second.coordinates.values
    queries = model.descriptor.all_of(Part(second, asked)).float()
    single = found_within(model.localize_descriptors(queries), reference, where[asked])
    one = []
    for query in queries[:ALONE].split(1):
        began = time.perf_counter()
        model.localize_descriptors(query)
        one.append(1e3 * (time.perf_counter() - began))
    flown = model.descriptor.all_of(Part(second, course)).float()
    whole = found_within(model.localize_descriptors(flown, PlaceSmoother()), reference, where[course])
    with TemporaryDirectory() as folder:
        stored = Path(folder) / "map.safetensors"
        model.save(stored)
        sizes = {
            "bytes_per_place": model.map.summary().route_bytes / len(reference),
            "bytes": stored.stat().st_size,
        }
    facts = {"places": len(reference), "learn_seconds": learned, "ms": sorted(one)[len(one) // 2]}
    return {"seed": seed, **sizes, **facts, **single} | {
        f"flight_{key}": share for key, share in whole.items()
    }


def run_terrain(*, out: Path, metres: int = 1015, seed: int = 0) -> list[str]:
    """A square of simulated ground at two sizes: time to learn it, bytes, milliseconds, and what is found.

    Args:
        out: folder for bench.json
        metres: side of the square; 1015 are 10^6 places
        seed: of the ground, the whitening and the queries
    """
    rows = [measured(size, metres, seed) for size in SIZES]
    write_bench(out, rows, metres=metres)
    return [f"{key:>24}" + "".join(f"{row[key]:>14.6g}" for row in rows) for key in rows[0]]
