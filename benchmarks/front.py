"""`benchmarks front`: the picture of README, recall over bytes on the road of the demo."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.measure import Row, write_bench
from benchmarks.ways import Scoring, in_order, stored_by
from dejavu_torch import DejaVu, PlaceSmoother, SpectralMapper, Whitening, open_source
from dejavu_torch.data.ground_truth import is_right
from dejavu_torch.evaluation.baselines import (
    as_int8,
    quantised_every_kth,
    stride_bytes,
)
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.controls import shuffled, with_mapper
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.evaluation.plots import Plot, legend, show_frame
from dejavu_torch.places.layout import ROUTE
from dejavu_torch.recognition.drive import DriveQuery, localize_drives
from dejavu_torch.recognition.localizer import answer

ROAD = ("demo:road?traverse=0", "demo:road?traverse=1")
OTHER = "sim:aerial?seed={seed}&size=96"  # another route, to learn codebooks on
SEEDS = (1, 2, 3)  # of the whitening, the order of the control and the codebooks; settings were chosen on 0
BYTES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # per place
FEW = (16, 64)  # centroids of codebooks that are counted per place
SHOWN_MAP = 5  # bytes per place, at most, of the map whose answers are shown: the largest of these
STRIDE, TOLERANCE = 10, 5
SHOWN = (420, 1500)  # queries of the picture, besides the hardest
COLUMNS = ("bytes_per_place", "one_image", "at_99_precision", "whole_drive")
WAYS = {"map": "this map", "product_quantiser": "product quantiser, every k-th", "null": "shuffled frames"}
ACCOUNTS = {  # of the codebooks
    "product_quantiser_free": "the same, codebooks of another route",
    "product_quantiser_small": "the same, few centroids, counted",
}
POINTS = {"uncompressed": "float32, every frame", "stride": "int8, every 10th frame"}


class Way(NamedTuple):
    """A way to store the descriptors: its key, the bytes per place that it may take, those that it takes, the
    scores that it gives, the stride of the frames that it stores, and bytes that do not grow with the route,
    besides those of the whitening."""

    key: str
    room: float
    bytes: float
    score: Scoring
    k: int = 1
    fixed: int = 0


def ways_of(model: DejaVu, places: Tensor, other: Tensor, seed: int) -> Iterator[Way]:
    """All ways to store descriptors (N,K); `other`: descriptors of another route."""
    (count, width), (order, mixed) = places.shape, shuffled(places, seed)
    for size in BYTES:
        for key, rows in (("map", places), ("null", mixed)):
            small = with_mapper(model, SpectralMapper(size))
            small.learn_features(rows)
            taken = small.summary().route_bytes / count
            yield Way(key, size, taken, in_order(small.map, None if key == "map" else order))
        fitted = partial(quantised_every_kth, places, tolerance=TOLERANCE, seed=seed)
        few = [
            fitted(room, centroids=one)
            for one in FEW
            if (room := size - 4 * one * width / count) > 0 and 4 * one <= count
        ]
        found = {"product_quantiser": fitted(size), "product_quantiser_free": fitted(size, training=other)}
        if few:  # the better one on the route itself
            found["product_quantiser_small"] = max(few, key=lambda one: one.share)
        for key, one in found.items():
            counted = key == "product_quantiser_small"
            taken = (one.bytes + one.codebooks * counted) / count
            score = stored_by(one.restored, ROUTE, one.k)
            yield Way(key, size, taken, score, one.k, one.codebooks * (key == "product_quantiser"))
    yield Way("uncompressed", 4.0 * width, 4.0 * width, stored_by(places, ROUTE))
    keys = stride_bytes(count, width, 1, STRIDE) / count
    yield Way("stride", keys, keys, stored_by(as_int8(places), ROUTE, STRIDE), STRIDE)


@torch.no_grad()
def measured(seed: int) -> tuple[list[Row], Tensor, Tensor]:
    """The rows of a seed; the answers (Q,) of single images on its map in 4 bytes, and their scores, -inf for
    wrong ones."""
    first, second = map(open_source, ROAD)
    model = DejaVu(whitening=Whitening(seed=seed))
    places = model.descriptor.learn(first, None)
    queries = model.descriptor.all_of(second)
    other = model.descriptor.all_of(open_source(OTHER.format(seed=seed)))
    truth, rows = torch.arange(len(queries))[:, None], []
    ways = [*ways_of(model, places, other, seed)]
    driven = [way for way in ways if way.key not in ACCOUNTS]
    smoother = PlaceSmoother(within=TOLERANCE)
    asked = [DriveQuery(way.score(queries), smoother, radius=0, asks=False) for way in driven]
    drives = dict(zip(map(id, driven), localize_drives(asked), strict=True))
    answers = hard = torch.empty(0)
    for way in ways:
        single, drive = answer(way.score(queries)), drives.get(id(way))
        scores, right = evaluate(single, truth, TOLERANCE), is_right(single.index, truth, TOLERANCE)
        row = {"seed": seed, "contender": way.key, "bytes_per_place": way.room, "taken": way.bytes}
        row |= {"k": way.k, "with_codebooks": way.bytes + way.fixed / len(places), "auc": scores.auc}
        row |= {"one_image": scores.recall_at_1, "at_99_precision": scores.recall_at_99_precision}
        if drive is not None:
            row["whole_drive"] = evaluate(drive, truth, TOLERANCE).recall_at_1
        rows.append(row)
        if way.key == "map" and way.room < SHOWN_MAP:
            answers, hard = single.index, single.score.masked_fill(~right, -torch.inf)
    return rows, answers, hard


def summarised(rows: list[Row], figures: Sequence[str] = COLUMNS[1:]) -> list[Row]:
    """Means and extremes over the seeds, a row for each way and size."""
    groups: dict[tuple[Any, Any], list[Row]] = {}
    for row in rows:
        size = row["bytes_per_place"]
        groups.setdefault((row["contender"], round(size, 1 if size > 1 else 2)), []).append(row)
    found = []
    for (key, size), same in groups.items():
        known = [name for name in figures if name in same[0]]
        means = {name: float(np.mean([row[name] for row in same])) for name in known}
        spread = {f"{name}_span": [min(r[name] for r in same), max(r[name] for r in same)] for name in means}
        found.append({"contender": key, "bytes_per_place": size, **means, **spread})
    return found


def plot_front(rows: list[Row], answers: Tensor, hardest: int) -> Plot:
    """Three queries with the places found for them, beside recall over bytes: of all answers, and of the most
    confident ones of which 99 % are right."""
    figure = Figure(figsize=(10, 3.3), layout="constrained", dpi=160)
    parts: Any = figure.subfigures(1, 2, width_ratios=(1, 2.4))
    left, right = parts
    frames = left.subplots(2, 3)
    first, second = map(open_source, ROAD)
    for column, query in enumerate((*SHOWN, hardest)):
        show_frame(
            frames[0, column], second[query], f"hardest: {query}" if query == hardest else f"query {query}"
        )
        show_frame(frames[1, column], first[int(answers[query])], f"found: {int(answers[query])}")
    axes = right.subplots(1, 2)
    for key, name in (WAYS | POINTS).items():
        points = sorted(
            (r["bytes_per_place"], *map(r.get, COLUMNS[1:])) for r in rows if r["contender"] == key
        )
        size, one, sure, whole = zip(*points, strict=True)
        style = {"color": COLOURS[key], "markersize": 4}
        axes[0].plot(size, one, "o-", label=name, **style)
        axes[0].plot(size, whole, "s--", fillstyle="none", **style)
        axes[1].plot(size, sure, "o-", **style)
    axes[0].plot([], [], "ok-", label="one image", markersize=4)
    axes[0].plot([], [], "sk--", label="whole drive", fillstyle="none", markersize=4)
    for axis, what in zip(axes, ("found within 5 frames", "one image: found, 99 % right"), strict=True):
        axis.set_xscale("log")
        axis.set_xticks([0.25, 1, 4, 16, 64, 512], ["¼", "1", "4", "16", "64", "512"])
        axis.minorticks_off()
        axis.set(xlabel="bytes per place, beside fixed ones", ylabel=what, ylim=(0, 1.03))
        axis.spines[["top", "right"]].set_visible(False)
    legend(axes[0], loc="lower right")
    return figure, axes


def run_front(*, out: Path) -> list[str]:
    """Recall over bytes on the real road of the demo: map, product quantiser of every k-th frame, shuffled
    frames.

    Args:
        out: folder for bench.json and bench.png
    """
    found = [measured(seed) for seed in SEEDS]
    each = [row for rows, *_ in found for row in rows]
    means, (_, answers, hard) = summarised(each, (*COLUMNS[1:], "taken", "with_codebooks")), found[0]
    picture = plot_front(means, answers, int(hard.argmax()))
    quantised = [row for row in each if row["contender"] in (*ACCOUNTS, "product_quantiser")]
    strides = [
        {name: row[name] for name in ("contender", "bytes_per_place", "seed", "k")} for row in quantised
    ]
    write_bench(out, means, picture, seeds=list(SEEDS), tolerance=TOLERANCE, strides=strides)
    lines = [f"{'':<38}{'bytes':>8}{'+ codebooks':>12}{'one image':>11}{'at 99 %':>11}{'whole drive':>13}"]
    for row in means:
        name = (WAYS | ACCOUNTS | POINTS)[row["contender"]]
        whole = f"{row['whole_drive']:>13.3f}" if "whole_drive" in row else ""
        sizes = f"{row['bytes_per_place']:>8}{row['with_codebooks']:>12.2f}"
        shares = f"{row['one_image']:>11.3f}{row['at_99_precision']:>11.3f}{whole}"
        lines.append(f"{name:<38}{sizes}{shares}")
    return [*lines, f"means of {len(SEEDS)} seeds"]
