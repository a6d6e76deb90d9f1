"""`benchmarks front`: the picture of README, recall over bytes on the road of the demo."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from benchmarks.measure import Row, write_bench
from dejavu_torch import DejaVu, PlaceSmoother, SpectralMapper, Whitening, open_source
from dejavu_torch.data.ground_truth import is_right
from dejavu_torch.evaluation.baselines import as_int8, scores_of_stored
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.controls import shuffled, with_mapper
from dejavu_torch.evaluation.plots import Plot, legend, show_frame
from dejavu_torch.evaluation.quantiser import product_quantised
from dejavu_torch.recognition.drive import localize_drives
from dejavu_torch.recognition.localizer import Scoring, drive_query
from dejavu_torch.recognition.select import best_match

ROAD = ("demo:road?traverse=0", "demo:road?traverse=1")
SEEDS = (1, 2, 3)  # of the whitening, the order of the control and the codebooks; settings were chosen on 0
BYTES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # per place, of maps and controls
CODES = (1, 2, 4, 8, 16)  # of a product quantiser
SHOWN_MAP = 5  # bytes per place, at most, of the map whose answers are shown: the largest of these
STRIDE, TOLERANCE = 10, 5
SHOWN = (420, 1500)  # queries of the picture, besides the hardest
COLUMNS = ("bytes_per_place", "one_image", "whole_drive")
FAISS = "faiss_product_quantiser"  # not drawn: its recall should be that of ours
WAYS = {"map": "this map", "product_quantiser": "product quantiser", "null": "shuffled frames"}
POINTS = {"uncompressed": "float32, every frame", "stride": "int8, every 10th frame"}


class Way(NamedTuple):
    """A way to store the descriptors: its key, bytes per place, and the scores that it gives."""

    key: str
    bytes: float
    score: Scoring


def ways_of(model: DejaVu, places: Tensor, seed: int) -> Iterator[Way]:
    """All ways to store descriptors (N,K)."""
    order, mixed = shuffled(places, seed)
    for size in BYTES:
        for key, rows in (("map", places), ("null", mixed)):
            small = with_mapper(model, SpectralMapper(size))
            small.learn_features(rows)
            taken = small.summary().route_bytes / len(places)
            score = small.map.scores if key == "map" else small.scores_in(order)
            yield Way(key, taken, score)
    for code in CODES:
        restored, _ = product_quantised(places, code, seed)
        yield Way("product_quantiser", code, scores_of_stored(restored, 1, "cosine"))
        if places.shape[1] % code == 0:
            yield Way(FAISS, code, scores_of_stored(by_faiss(places, code, seed), 1, "cosine"))
    width = places.shape[1]
    yield Way("uncompressed", 4.0 * width, scores_of_stored(places, 1, "cosine"))
    yield Way("stride", width / STRIDE, scores_of_stored(as_int8(places), STRIDE, "cosine"))


def by_faiss(places: Tensor, code: int, seed: int) -> Tensor:
    """Descriptors (N,K) as the product quantiser of faiss restores them, which needs equal parts."""
    import faiss

    quantiser: Any = faiss.ProductQuantizer(places.shape[1], code, 8)
    quantiser.cp.seed, quantiser.cp.min_points_per_centroid = seed, 1
    rows = places.float().numpy()
    quantiser.train(rows)
    return torch.from_numpy(quantiser.decode(quantiser.compute_codes(rows)))


@torch.no_grad()
def measured(seed: int) -> tuple[list[Row], Tensor, Tensor]:
    """The rows of a seed; the answers (Q,) of single images on its map in 4 bytes, and their scores, -inf for
    wrong ones."""
    first, second = map(open_source, ROAD)
    model = DejaVu(whitening=Whitening(seed=seed))
    places = model.descriptor.learn(first, None)
    queries = model.descriptor.all_of(second)
    truth, rows = torch.arange(len(queries))[:, None], []
    ways = [*ways_of(model, places, seed)]
    asked = [drive_query(queries, PlaceSmoother(within=TOLERANCE), way.score) for way in ways]
    answers = hard = torch.empty(0)
    for way, drive in zip(ways, localize_drives(asked), strict=True):
        single = best_match(way.score(queries))
        found = [single.index, drive.index[:, 0]]
        if way.key == "stride":  # of equal scores, the place that is stored
            found[0] = STRIDE * ((found[0] + STRIDE // 2) // STRIDE)
        right = [is_right(index, truth, TOLERANCE) for index in found]
        one, whole = (float(each.double().mean()) for each in right)
        size = {"seed": seed, "contender": way.key, "bytes_per_place": way.bytes}
        rows.append(size | {"one_image": one, "whole_drive": whole})
        if way.key == "map" and way.bytes < SHOWN_MAP:
            answers, hard = single.index, single.score.masked_fill(~right[0], -torch.inf)
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
    """Three queries with the places found for them, beside recall over bytes."""
    figure = Figure(figsize=(9, 3.3), layout="constrained", dpi=160)
    parts: Any = figure.subfigures(1, 2, width_ratios=(1, 1.7))
    left, right = parts
    frames = left.subplots(2, 3)
    first, second = map(open_source, ROAD)
    for column, query in enumerate((*SHOWN, hardest)):
        show_frame(
            frames[0, column], second[query], f"hardest: {query}" if query == hardest else f"query {query}"
        )
        show_frame(frames[1, column], first[int(answers[query])], f"found: {int(answers[query])}")
    axis = right.subplots()
    for key, name in (WAYS | POINTS).items():
        points = sorted(
            (r["bytes_per_place"], r["one_image"], r["whole_drive"]) for r in rows if r["contender"] == key
        )
        size, one, whole = zip(*points, strict=True)
        style = {"color": COLOURS[key], "markersize": 4}
        axis.plot(size, one, "o-", label=name, **style)
        axis.plot(size, whole, "s--", fillstyle="none", **style)
    axis.plot([], [], "ok-", label="one image", markersize=4)
    axis.plot([], [], "sk--", label="whole drive", fillstyle="none", markersize=4)
    axis.set_xscale("log")
    axis.set_xticks([0.25, 1, 4, 16, 64, 512], ["¼", "1", "4", "16", "64", "512"])
    axis.minorticks_off()
    axis.set(xlabel="bytes per place, beside fixed ones", ylabel="found within 5 frames", ylim=(0, 1.03))
    axis.spines[["top", "right"]].set_visible(False)
    legend(axis, loc="lower right")
    return figure, axis


def run_front(*, out: Path) -> list[str]:
    """Recall over bytes on the real road of the demo: map, product quantiser, float and shuffled frames.

    Args:
        out: folder for bench.json and bench.png
    """
    found = [measured(seed) for seed in SEEDS]
    means, (_, answers, hard) = summarised([row for rows, *_ in found for row in rows]), found[0]
    picture = plot_front(means, answers, int(hard.argmax()))
    write_bench(out, means, picture, seeds=list(SEEDS), tolerance=TOLERANCE)
    lines = [f"{'':<20}{'bytes':>8}{'one image':>12}{'whole drive':>13}"]
    for row in means:
        name = (WAYS | POINTS | {FAISS: "the same by faiss"})[row["contender"]]
        lines.append(
            f"{name:<20}{row['bytes_per_place']:>8}{row['one_image']:>12.3f}{row['whole_drive']:>13.3f}"
        )
    return [*lines, f"means of {len(SEEDS)} seeds"]
