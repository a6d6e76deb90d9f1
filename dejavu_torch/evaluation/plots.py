"""Pictures of maps and matches; each function returns (figure, axes)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dejavu_torch.data.ground_truth import as_ground_truth, counted, is_right
from dejavu_torch.evaluation.activation import ActivationRates
from dejavu_torch.types import FrequencyLayer, GroundTruth, Match, Plan, PRCurve

Plot = tuple[Figure, Any]

WIDTH = 6.0  # inches; a phone shows about 60 pixels an inch, so 9 points are the smallest letters
BLUE, ORANGE, GREEN, RED, DARK, GREY = "#2166ac", "#d9822b", "#1b8a4b", "#c0392b", "#333333", "#999999"
LAYERS = (ORANGE, GREEN)  # the two layers that several pictures show keep their colours
_CURVES = (BLUE, DARK, ORANGE, "#8e6bb0", GREY, RED)
LABELLED = 8  # chunks along a route that leave room for numbers


class Picture(NamedTuple):
    """A plot and what a reader needs beside it.

    heading: a few words. caption: what one sees, in a sentence or two. numbers: those written on it,
    for report.json.
    """

    plot: Plot
    heading: str
    caption: str
    numbers: Mapping[str, Any] = MappingProxyType({})


def canvas(height: float, rows: int = 1, columns: int = 1, **grid: Any) -> Plot:
    """An empty figure of the width all pictures have, without the upper and right frame line."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained", dpi=130)
    axes = figure.subplots(rows, columns, **grid)
    for axis in figure.axes:
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def period_axis(axis: Any, low: float, high: float) -> None:
    """Make the y axis logarithmic from `low` to `high` frames, with powers of two as ticks."""
    axis.set_yscale("log")
    ticks = [2**k for k in range(40) if low <= 2**k <= high]
    axis.set_yticks(ticks, [str(t) for t in ticks])
    axis.minorticks_off()
    axis.set(ylim=(low, high), ylabel="period (frames)")


def plot_curves(curves: Mapping[str, PRCurve], title: str = "") -> Plot:
    """Precision against recall, one line for each name (figures 8 to 10 of the paper)."""
    figure, axis = canvas(5.6)
    for (name, curve), colour in zip(curves.items(), _CURVES * 2, strict=False):
        if len(curve.recall) == 0:
            axis.plot([], [], color=colour, label=f"{name} (reports nothing)")
        else:
            style = ":" if name.startswith("null") else "-"
            axis.plot(curve.recall, curve.precision, style, color=colour, label=name, linewidth=1.8)
    axis.set(xlim=(0, 1.01), ylim=(0, 1.02), xlabel="recall (of all queries)", ylabel="precision")
    axis.set_title(title, fontsize=11)
    axis.grid(alpha=0.25)
    figure.legend(loc="outside lower left", frameon=False)
    return figure, axis


def plot_auc(areas: Mapping[str, float]) -> Plot:
    """Area under each precision-recall curve as a bar, in the colours of `plot_curves`."""
    figure, axis = canvas(0.9 + 0.55 * len(areas))
    names = list(areas)
    bars = axis.barh(names, list(areas.values()), height=0.42, color=(_CURVES * 2)[: len(names)])
    for bar, name in zip(bars, names, strict=True):
        if name.startswith("null"):  # as its curve is dotted
            bar.set(alpha=0.55, hatch="//", edgecolor="white")
        axis.text(0.008, bar.get_y() - 0.06, name, va="bottom")
        axis.text(bar.get_width() + 0.01, bar.get_y() + 0.21, f"{areas[name]:.3f}", va="center")
    axis.set(xlim=(0, 1.1), ylim=(len(names) - 0.6, -0.7), yticks=[], xticks=[0, 0.25, 0.5, 0.75, 1])
    axis.set_xlabel("area under the precision-recall curve (recall of all queries)")
    axis.spines["bottom"].set_bounds(0, 1)
    return figure, axis


def plot_coverage(
    match: Match,
    truth: Tensor | GroundTruth | None,
    tolerance: int,
    places: int,
    queries: Tensor | None = None,
) -> Plot:
    """Where along the route each query was put, right or wrong (coverage plot of the paper, figure 9).

    Args:
        truth: (Q,R) right places, or with what is not to be judged, or None where nothing is known.
        queries: (Q,) the number of each query frame; None is 0..Q-1.
    """
    figure, axis = canvas(5)
    number = torch.arange(len(match.index)) if queries is None else queries
    reported = match.index >= 0

    def dots(which: Tensor, colour: str, label: str, size: float = 3) -> None:
        if which.any():
            axis.plot(number[which], match.index[which], ".", color=colour, markersize=size, label=label)

    missing = ~reported
    if truth is None:
        dots(reported, BLUE, f"{reported.sum()} reported")
    else:
        truth = as_ground_truth(truth)
        judged = counted(match.index, truth, tolerance)
        right = judged & is_right(match.index, truth.positives, tolerance)
        wrong = judged & reported & ~right
        dots(reported & ~judged, GREY, f"{(~judged).sum()} not judged")
        dots(wrong, RED, f"{wrong.sum()} wrong")
        dots(right, GREEN, f"{right.sum()} right (within {tolerance} places)", 4)
        missing &= judged
    if missing.any():
        label = f"{missing.sum()} not reported"
        axis.plot(number[missing], torch.zeros(int(missing.sum())), "|", color=DARK, label=label)
    first, last = int(number.min()), int(number.max())
    axis.set(xlabel="query", ylabel="reported place")
    axis.set(xlim=(first, max(last, first + 1)), ylim=(-0.01 * places, places))
    figure.legend(loc="outside lower left", ncols=2, frameon=False, markerscale=3)
    return figure, axis


def plot_chunks(plan: Plan, places: int) -> Plot:
    """Chunks along the route and the periods found in each; the wider a bar, the more features."""
    figure, axis = canvas(4.2)
    axis.set(xlim=(0, places), xlabel="place", ylabel="period (frames)")
    if not plan:
        axis.set(yticks=[])
        axis.text(0.5, 0.5, "this route does not repeat: no layers", ha="center", transform=axis.transAxes)
        return figure, axis
    most = max(len(layer.features) for layer in plan)
    chunks = sorted({(layer.start, layer.stop) for layer in plan})
    for start, stop in chunks:
        members = [layer for layer in plan if (layer.start, layer.stop) == (start, stop)]
        for layer in members:
            share = len(layer.features) / most
            style = {"linewidth": 0.6 + 7 * share, "alpha": 0.35 + 0.65 * share}
            axis.hlines(float(layer.period), start, stop, color=BLUE, **style)
        leading = sorted(members, key=lambda layer: -len(layer.features))[:2]
        for layer, along in zip(leading, (0.3, 0.7), strict=False):
            if len(chunks) <= LABELLED:
                text = f"{float(layer.period):.4g}"
                box = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
                where = start + along * (stop - start), float(layer.period)
                axis.text(*where, text, fontsize=9, ha="center", va="center_baseline", bbox=box)
    for edge in {edge for chunk in chunks for edge in chunk}:
        axis.axvline(edge, color=GREY, linewidth=0.8, linestyle=":")
    periods = [float(layer.period) for layer in plan]
    period_axis(axis, min(periods) / 1.2, max(periods) * 1.2)
    axis.set_title(f"widest bar: {most} features", fontsize=10, loc="left")
    return figure, axis


def plot_activations(
    layers: Sequence[FrequencyLayer],
    scores: Sequence[Tensor],
    fused: Tensor,
    query: int,
    places: Sequence[int] = (),
    strip: Tensor | None = None,
    rates: ActivationRates | None = None,
) -> Plot:
    """Scores of one query over a chunk: two layers, and all layers fused (figure 17 of the paper).

    Args:
        layers: two layers of one chunk. scores: for each (n,) eq. 3 at the chunk's places.
        fused: (n,) eq. 4 at the same places. query: number of the query frame.
        places: its right places, marked.
        strip: (C,H,n) one image column for each place, drawn above; None leaves it out.
        rates: how often each is right, written above it; None leaves it out.
    """
    start, stop = layers[0].start, layers[0].stop
    figure, rows = canvas(4.7 if strip is None else 5.8, len(layers) + 1 + (strip is not None), sharex=True)
    axes = rows[-len(layers) - 1 :]
    if strip is not None:
        image = strip.expand(3, -1, -1).permute(1, 2, 0).clamp(0, 1)
        rows[0].imshow(image.numpy(), extent=(start, stop, 0, 1), aspect="auto")
        rows[0].set_yticks([])
        rows[0].set_title("middle image column of each frame", loc="left", fontsize=10)
    names = [f"period {float(layer.period):.4g}, {len(layer.features)} features" for layer in layers]
    texts = [""] * len(axes) if rates is None else [rate.describe() for rate in (*rates.layers, rates.fused)]
    drawn = zip(
        axes,
        [*names, "all layers fused"],
        texts,
        [*scores, fused],
        [*LAYERS[: len(layers)], BLUE],
        strict=True,
    )
    where = torch.arange(start, stop)
    for axis, name, text, values, colour in drawn:
        axis.plot(where, values, color=colour, linewidth=1.1)
        best = int(values.argmin())
        style = {"color": RED, "markersize": 7, "clip_on": False, "label": "best (first of equals)"}
        axis.plot(where[best], values[best], "v", **style)
        axis.set_title(f"{name}: {text}" if text else name, loc="left", fontsize=10)
        axis.set_yticks([])
    for axis in rows:
        for place in places:
            axis.axvline(place, color=DARK, linewidth=0.9, linestyle="--", label="true place")
    handles, labels = axes[-1].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), ncols=2, frameon=False, loc="outside lower right")
    figure.supylabel(f"difference of query {query} (lower is better)", fontsize=10)
    rows[-1].set(xlabel="place", xlim=(start, stop))
    return figure, rows
