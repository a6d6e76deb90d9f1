"""`benchmarks ends`: drives that leave the map, stand still, or see it through another lens."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm import tqdm

from benchmarks.cross import FOOTAGE, SHARES, WAYS, Board, described, map_beside, matches, traverses
from benchmarks.measure import Column, Row, some_of, table, write_bench
from dejavu_torch.data.ground_truth import GroundTruth, all_judged
from dejavu_torch.data.traverse import Frames, Part, fitted
from dejavu_torch.evaluation.rejection import judged
from dejavu_torch.growth import calibrate_if_possible, merge
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.model import DejaVu

TENTH, THIRD = 0.1, 1 / 3
HOLE = 40  # places
DOOR = 25  # frames between two routes
STALLS = 5, 20  # frames that repeat the one before them while the camera moves on
WAITED, WAITS, LOOPS = 500, 120, 50  # frames of a drive, and of a wait, and those that a loop is apart
BETWEEN = 60  # frames between two stalls
ZOOMS = 1.2, 1.5
# frames beyond the end of a map that still see its ground, by the kind of footage
SEES = {"road from above": 96, "sim:aerial": 64, "motorway": 30, "mat": 20}
SEES_OTHERWISE = 10
BESIDE = {  # routes whose maps are merged, with a door between
    "city 1": "laps",
    "corridor": "floors",
    "railway, first half": "city 3",
    "road, first half": "laps",
    "sim:aerial, seed 1": "sim:outdoor, seed 1",
}
ON, SHARED, APART = "on", "shared", "off"
COLUMNS: dict[str, Column] = {
    **{f"{way}: off {share:g}": (f"{way}_off_{share:g}", ".3f") for way, share in product(WAYS, SHARES)},
    **{f"{way}: on": (f"{way}_on_0.5", ".3f") for way in WAYS},
    **{f"{way}: wrong .9": (f"{way}_on_wrong", ".3f") for way in WAYS},
}


class Case(NamedTuple):
    """Queries of a map, descriptors of all views (Q, V x K).

    off: (Q,) bool, which are off the map. apart: which of these share no ground with it.
    """

    name: str
    board: Board
    queries: Tensor
    truth: GroundTruth
    off: Tensor
    apart: Tensor


def run_ends(data: Path, *, out: Path, routes: Sequence[str] = ()) -> list[str]:
    """Drives that leave the map, stand still, or see it through another lens: what is accepted?

    Args:
        data: folder of the footage, as for the tests
        out: folder for bench.json
        routes: names of routes; all if not given
    """
    rows: list[Row] = []
    for name in tqdm(some_of(FOOTAGE, routes), "routes", disable=None, leave=False):
        for case in cases(name, data):
            rows.append({"case": name, "contender": case.name} | facts_of(case))
            write_bench(out, rows)
        rows += waits(name, data)
    write_bench(out, rows)
    most = max((row["loops_in_wait"] for row in rows if "loops_in_wait" in row), default=0)
    asked = [row for row in rows if "taken" in row]
    note = f"the worst route of each row; loops within a wait, at most: {most}"
    return [table(worst(asked), COLUMNS, "{contender}"), note]


def cases(name: str, data: Path) -> Iterator[Case]:
    """All that is asked of a route."""
    footage = FOOTAGE[name]
    reference, query, truth = traverses(footage, data)
    frames, count = reference[:], len(reference)
    sees = SEES.get(footage.kind, SEES_OTHERWISE)

    def board(frames: Tensor) -> Board:
        return Board(model_of(frames), (name,), torch.zeros(0), truth, footage.tolerance)

    def part(title: str, known: Board, lacks: Tensor, shift: int | Tensor = 0) -> Case:
        """All queries on a map that lacks some places (N,), before each of which are so many places fewer."""
        missing = torch.where(truth.positives >= 0, lacks[truth.positives.clamp(min=0)], True)
        fewer = shift if isinstance(shift, int) else shift[truth.positives.clamp(min=0)]
        positives = torch.where(missing, -1, truth.positives - fewer)
        beyond = _distances(lacks)
        far = torch.where(truth.positives >= 0, beyond[truth.positives.clamp(min=0)], 2**31).amin(1)
        off = missing.all(1) & truth.judged
        told = GroundTruth(positives, truth.judged, torch.full_like(positives[:, :0], -1))
        return Case(title, known, described(known.model, query), told, off, off & (far > sees))

    whole = board(frames)
    none = torch.zeros(count, dtype=torch.bool)
    yield part("as it is", whole, none)
    for share, end in product((TENTH, THIRD), ("start", "end")):
        cut = round(share * count)
        lacks = none.clone()
        lacks[:cut] = True
        lacks, kept = (lacks, frames[cut:]) if end == "start" else (lacks.flip(0), frames[:-cut])
        yield part(f"{end} cut, {share:.0%}", board(kept), lacks, cut if end == "start" else 0)
    for size in dict.fromkeys((min(HOLE, count // 3), round(TENTH * count))):
        lacks = none.clone()
        lacks[count // 2 - size // 2 :][:size] = True
        title = "a hole of 10 %" if size == round(TENTH * count) else "a hole of 40"
        dark = torch.where(lacks.view(-1, *[1] * (frames.ndim - 1)), 0, frames)
        yield part(title, board(dark), lacks)
    lacks = none.clone()
    lacks[count // 2 - min(HOLE, count // 3) // 2 :][: min(HOLE, count // 3)] = True
    yield part("frames missing, 40", board(frames[~lacks]), lacks, torch.cumsum(lacks, 0))
    asked = query[:]
    for made, (numbers, moves) in _stalls(len(asked)).items():
        own, moved = described(whole.model, query), GroundTruth(*(one[moves] for one in truth))
        stale = numbers != moves
        yield Case(made, whole, own[numbers], moved, stale & False, stale & False)
    if frames.ndim == 4:
        for zoom in ZOOMS:
            seen = described(whole.model, Frames(_zoomed(asked, zoom)))
            nothing = torch.zeros(len(asked), dtype=torch.bool)
            yield Case(f"a lens of {zoom:g}", whole, seen, truth, nothing, nothing)
    if name in BESIDE:
        yield _half(name, data, whole)
        yield _door(name, data, whole)


def waits(name: str, data: Path) -> Iterator[Row]:
    """Loops that are accepted within a wait: among the first frames of a route, one is there `WAITS` times,
    by the same picture or with noise of one grey level in 255."""
    reference, _, _ = traverses(FOOTAGE[name], data)
    frames = reference[:WAITED]
    half = len(frames) // 2
    if frames.ndim != 4:
        return
    for noise in (0.0, 1 / 255):
        draw = torch.Generator().manual_seed(0)
        still = frames[half : half + 1].expand(WAITS, *frames.shape[1:])
        still = (still + noise * torch.randn(still.shape, generator=draw)).clamp(0, 1)
        drive = Frames(torch.cat([frames[:half], still, frames[half:]]))
        model = DejaVu().learn(drive)
        match = model.loops(drive, LOOPS)
        title = "a wait" if not noise else "a wait with noise"
        some = slice(half, half + WAITS)
        accepted = int((match.accepted[some] & (match.index[some] >= half)).sum())
        yield {"case": name, "contender": title, "queries": len(drive), "loops_in_wait": accepted}


def _half(name: str, data: Path, whole: Board) -> Case:
    """Half of a drive, then as many frames of a drive over another route."""
    query, shape = traverses(FOOTAGE[name], data)[1], whole.model.frame_shape
    assert shape is not None
    there, half = fitted(traverses(FOOTAGE[BESIDE[name]], data)[1], shape), len(query) // 2
    parts = [Part(query, range(half)), Part(there, range(min(half, len(there))))]
    own = whole.truth.positives[:half]
    positives = torch.cat([own, own.new_full((len(parts[1]), own.shape[1]), -1)])
    off = torch.arange(len(positives)) >= half
    seen = torch.cat([described(whole.model, one) for one in parts])
    return Case("half elsewhere", whole, seen, all_judged(positives), off, off)


def _door(name: str, data: Path, whole: Board) -> Case:
    """Half of a drive, a door, and half of a drive over another route that was merged."""
    other = FOOTAGE[BESIDE[name]]
    more, model = traverses(other, data), whole.model
    shape = model.frame_shape
    assert shape is not None
    added, query = fitted(more[0], shape), traverses(FOOTAGE[name], data)[1]
    merged = merge([model, map_beside(model, added)], (name, BESIDE[name]))
    merged.calibration = model.calibration  # of one route, as the other has none of its own
    door, draw = torch.rand(shape[0], 4, 6, generator=torch.Generator().manual_seed(0)), torch.Generator()
    still = F.interpolate(door[None], size=shape[1:], mode="bilinear").expand(DOOR, *shape)
    noisy = Frames((still + 0.02 * torch.randn(still.shape, generator=draw.manual_seed(1))).clamp(0, 1))
    there = fitted(more[1], shape)
    parts = [Part(query, range(len(query) // 2)), noisy, Part(there, range(min(400, len(there))))]
    seen = torch.cat([described(merged, one) for one in parts])
    width = max(whole.truth.positives.shape[1], more[2].positives.shape[1])

    def places(truth: GroundTruth, rows: int, shift: int) -> Tensor:
        own = truth.positives[:rows]
        own = torch.where(own >= 0, own + shift, -1)
        return F.pad(own, (0, width - own.shape[1]), value=-1)

    own = places(whole.truth, len(parts[0]), 0)
    far = places(more[2], len(parts[2]), model.map.places)
    truth = all_judged(torch.cat([own, own.new_full((DOOR, width), -1), far]))
    off = torch.zeros(len(seen), dtype=torch.bool)
    off[len(own) : len(own) + DOOR] = True
    return Case("a door", whole._replace(model=merged), seen, truth, off, off)


def model_of(frames: Tensor) -> DejaVu:
    """The default map of frames."""
    model, traverse = DejaVu(mapper=SpectralMapper()), Frames(frames)
    model.learn(traverse)
    calibrate_if_possible(model, traverse)
    return model


def _distances(lacks: Tensor) -> Tensor:
    """How many places away is the next one that a map has, (N,) bool -> (N,)."""
    here, at = (~lacks).nonzero()[:, 0], torch.arange(len(lacks))
    return (at[:, None] - here).abs().amin(1)


def _stalls(queries: int) -> dict[str, tuple[Tensor, Tensor]]:
    """By name, the frame that each query repeats, and the one that it would show."""
    whole, made = torch.arange(queries), {}
    for stall in STALLS:
        numbers = whole.clone()
        for first in range(BETWEEN // 2, queries - stall, BETWEEN):
            numbers[first : first + stall + 1] = first
        made[f"stalls of {stall}"] = numbers, whole
    return made


def _zoomed(frames: Tensor, zoom: float) -> Tensor:
    """Pictures (B,C,H,W) that are so many times as large."""
    height, width = frames.shape[2:]
    rows, columns = round(height / zoom), round(width / zoom)
    top, left = (height - rows) // 2, (width - columns) // 2
    middle = frames[:, :, top : top + rows, left : left + columns]
    return F.interpolate(middle, size=(height, width), mode="bilinear", align_corners=False)


def facts_of(case: Case) -> dict[str, Any]:
    """The figures of a case.

    Returns:
        queries, off, apart, taken; by way, shares accepted at each of `SHARES` of the queries on the map, of
        those off it that share ground with it and of those that share none, and `_on_wrong`: of all queries
        that are on it, those with at least .9 that are wrong.
    """
    ways, within = matches(case.board, case.queries), max(1, case.board.tolerance)
    on, shared = ~case.off & case.truth.judged, case.off & ~case.apart
    found: dict[str, Any] = {"queries": len(case.queries), "taken": ways["drive"].is_drive}
    found |= {ON: int(on.sum()), SHARED: int(shared.sum()), APART: int(case.apart.sum())}
    for way in WAYS:
        match = ways.get(way)
        for group, some in ((ON, on), (SHARED, shared), (APART, case.apart)):
            for share in SHARES:
                known = None if match is None or not some.any() else match.probability
                above = None if known is None else float((known[some] >= share).double().mean())
                found[f"{way}_{group}_{share:g}"] = above
        wrong = None
        if match is not None and on.any():
            probability, right = judged(match, case.truth._replace(judged=torch.ones_like(on)), within)
            wrong = float(((probability >= 0.9) & ~right)[on].double().mean())
        found[f"{way}_on_wrong"] = wrong
    return found


def worst(rows: Sequence[Row]) -> list[Row]:
    """Of each kind of case, the worst figure of all routes."""
    lowest = {f"{way}_on_0.5" for way in WAYS}

    def figure(some: Sequence[Row], key: str) -> float | None:
        known = [row[key] for row in some if row[key] is not None]
        choose: Callable[[list[float]], float] = min if key in lowest else max
        return choose(known) if known else None

    kinds: Mapping[str, None] = dict.fromkeys(row["contender"] for row in rows)
    keys = [key for key, *_ in COLUMNS.values()]
    return [
        {"case": "", "contender": kind}
        | {key: figure([row for row in rows if row["contender"] == kind], key) for key in keys}
        for kind in kinds
    ]
