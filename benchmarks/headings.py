"""`benchmarks headings`: images of any heading, found on the map of a road by another flight."""

from __future__ import annotations

import time
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.areas import RADIUS, SEEDS, STRIDE, flight
from benchmarks.front import summarised
from benchmarks.measure import Row, write_bench
from dejavu_torch import DejaVu, PlaceSmoother, Whitening
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.demo import FOLDER, open_area
from dejavu_torch.data.folder import read_image
from dejavu_torch.places.layout import Layout

QUERIES, SIDE, MARGIN = 500, 64, 46  # images, their sides, and pixels from their middle that they need
HEADINGS, OF_FLIGHT = (8, 12, 24, 36), 24
WANDER = 10.0  # degrees from one image of a flight to the next, standard deviation
NAMES = {"unturned": "north up", "turned": "of any heading, as they are", "known": "with known headings"}
NAMES |= {str(count): f"`--headings {count}`" for count in HEADINGS}
NAMES |= {"flight, known": "a flight, known headings", "flight, 24": "a flight, `--headings 24`"}
FIGURES = ("recall_at_1", "accepted", "accepted_wrong", "ms")


def seen(picture: Tensor, middle: Tensor, heading: Tensor) -> Tensor:
    """What a camera over places (n,2) in pixels sees of a picture (C,H,W), bilinear, (n,C,64,64)."""
    x, y, angle = (column.float().view(-1, 1, 1) for column in (*middle.T, heading.deg2rad()))
    across = torch.arange(SIDE) - (SIDE - 1) / 2
    right, down = across[None, None], across[None, :, None]
    at = x + angle.cos() * right - angle.sin() * down, y + angle.sin() * right + angle.cos() * down
    size = picture.shape[2], picture.shape[1]
    grid = torch.stack([2 * one / side - 1 for one, side in zip(at, size, strict=True)], -1)
    parts = (F.grid_sample(picture.expand(len(g), -1, -1, -1), g, align_corners=False) for g in grid.split(8))
    return torch.cat([*parts])


def measured(seed: int) -> list[Row]:
    """The rows of a seed."""
    reference, picture = open_area(0, stride=STRIDE), read_image(FOLDER / "flight_1.jpg")
    model = DejaVu(whitening=Whitening(seed=seed)).learn(reference).calibrate(reference)
    draw = torch.Generator().manual_seed(seed)
    inner = torch.tensor([picture.shape[2], picture.shape[1]]) - 2 * MARGIN
    middle = MARGIN + inner * torch.rand(QUERIES, 2, generator=draw)
    heading = 360 * torch.rand(QUERIES, generator=draw)
    path = MARGIN + flight(Layout(int(inner[1]), int(inner[0])), draw).flip(1).double()
    wandering = (WANDER * torch.randn(len(path), generator=draw)).cumsum(0)
    turned, flown = seen(picture, middle, heading), seen(picture, path, wandering)
    cases: list[tuple[str, Tensor, Tensor, int, Tensor | None]]
    cases = [("unturned", seen(picture, middle, 0 * heading), middle, 1, None)]
    cases += [("turned", turned, middle, 1, None), ("known", turned, middle, 1, heading)]
    cases += [(str(one), turned, middle, one, None) for one in HEADINGS]
    cases += [("flight, known", flown, path, 1, wandering)]
    cases += [(f"flight, {OF_FLIGHT}", flown, path, OF_FLIGHT, None)]
    rows: list[Row] = []
    for key, images, where, count, known in cases:
        query, began = ArrayTraverse(images), time.perf_counter()
        query.headings = known
        within = PlaceSmoother(within=round(RADIUS / STRIDE)) if key.startswith("flight") else None
        match = model.localize(query, sequence=within, headings=count)
        passed = 1000 * (time.perf_counter() - began) / len(images)
        right = (reference.layout.coordinates(match.index) - where).norm(dim=1) <= RADIUS
        shares = (right, match.accepted, match.accepted & ~right)
        figures = [*(float(one.double().mean()) for one in shares), passed]
        row: Row = {"seed": seed, "contender": key, "bytes_per_place": 8.0}
        rows.append(row | dict(zip(FIGURES, figures, strict=True)))
    return rows


def run_headings(*, out: Path) -> list[str]:
    """Images of any heading on the demo's road: recall, accepted although wrong, and milliseconds.

    Args:
        out: folder for bench.json
    """
    means = summarised([row for seed in SEEDS for row in measured(seed)], FIGURES)
    write_bench(out, means, seeds=list(SEEDS), radius=RADIUS)
    lines = [" ".join(f"{name:>16}" for name in ("", *FIGURES))]
    lines += [
        f"{row['contender']:>16} " + " ".join(f"{row[name]:>16.3f}" for name in FIGURES) for row in means
    ]
    return [*lines, f"means of {len(SEEDS)} seeds"]
