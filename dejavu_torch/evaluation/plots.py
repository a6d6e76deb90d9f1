"""Pictures of maps and matches; each function returns (figure, axes)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from dejavu_torch.data.truth import is_right
from dejavu_torch.types import FrequencyLayer, Match, Plan, PRCurve

Plot = tuple[Figure, Any]

BLUE, ORANGE, GREEN, RED, DARK, GREY = "#2166ac", "#d9822b", "#1b8a4b", "#c0392b", "#333333", "#999999"
_CURVES = (BLUE, DARK, ORANGE, "#8e6bb0", GREY, RED)


def _figure(width: float, height: float, rows: int = 1) -> Plot:
    figure = Figure(figsize=(width, height), layout="constrained", dpi=110)
    axes = figure.subplots(rows, 1, sharex=rows > 1)
    for axis in [axes] if rows == 1 else axes:
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def plot_curves(curves: Mapping[str, PRCurve], title: str = "") -> Plot:
    """Precision against recall, one line for each name (figures 8 to 10 of the paper)."""
    figure, axis = _figure(6, 4.9)
    for (name, curve), colour in zip(curves.items(), _CURVES * 2, strict=False):
        if len(curve.recall) == 0:
            axis.plot([], [], color=colour, label=f"{name} (reports nothing)")
        else:
            style = ":" if name.startswith("null") else "-"
            axis.plot(curve.recall, curve.precision, style, color=colour, label=name, linewidth=1.8)
    axis.set(
        xlim=(0, 1.01), ylim=(0, 1.02), xlabel="recall (of all queries)", ylabel="precision", title=title
    )
    axis.grid(alpha=0.25)
    axis.legend(loc="upper left", bbox_to_anchor=(0, -0.13), ncols=2, frameon=False, fontsize=8)
    return figure, axis


def plot_coverage(match: Match, truth: Tensor | None, tolerance: int, places: int) -> Plot:
    """Where along the route each query was put, right or wrong (coverage plot of the paper).

    Args:
        truth: (Q,R) right places, or None where nothing is known.
    """
    figure, axis = _figure(6, 4.6)
    query = torch.arange(len(match.index))
    reported = match.index >= 0
    if truth is None:
        axis.plot(query[reported], match.index[reported], ".", color=BLUE, markersize=3, label="reported")
    else:
        right = is_right(match.index, truth, tolerance)
        wrong = reported & ~right
        axis.plot(
            query[wrong], match.index[wrong], ".", color=RED, markersize=3, label=f"{wrong.sum()} wrong"
        )
        axis.plot(
            query[right], match.index[right], ".", color=GREEN, markersize=4, label=f"{right.sum()} right"
        )
    missing = query[~reported]
    if len(missing):
        label = f"{len(missing)} not reported"
        axis.plot(missing, torch.zeros(len(missing)), "|", color=GREY, markersize=6, label=label)
    axis.set(
        xlabel="query frame", ylabel="reported place", xlim=(0, len(query)), ylim=(-0.01 * places, places)
    )
    axis.set_title(
        f"places reported (right: within {tolerance} frames)" if truth is not None else "places reported"
    )
    axis.legend(
        loc="upper left", bbox_to_anchor=(0, -0.12), ncols=3, frameon=False, fontsize=9, markerscale=2
    )
    return figure, axis


def plot_chunks(plan: Plan, places: int) -> Plot:
    """Chunks along the route and the periods found in each; the wider a bar, the more features."""
    figure, axis = _figure(7, 4.2)
    most = max((len(layer.features) for layer in plan), default=1)
    for layer in plan:
        share = len(layer.features) / most
        axis.hlines(
            float(layer.period),
            layer.start,
            layer.stop,
            color=BLUE,
            linewidth=0.6 + 7 * share,
            alpha=0.35 + 0.65 * share,
        )
    for edge in sorted({layer.start for layer in plan} | {layer.stop for layer in plan}):
        axis.axvline(edge, color=GREY, linewidth=0.8, linestyle=":")
    axis.set(xlim=(0, places), xlabel="place (reference frame)", ylabel="period (frames)")
    if plan:
        axis.set_yscale("log")
        ticks = [
            t for t in (8, 16, 32, 64, 128, 256, 512, 1024) if t <= 1.3 * max(float(p.period) for p in plan)
        ]
        axis.set_yticks(ticks, [str(t) for t in ticks])
        axis.minorticks_off()
        axis.set_title(f"periods per chunk; widest bar: {most} features")
    else:
        axis.set_title("this route does not repeat: no layers")
    return figure, axis


def plot_activations(
    layers: Sequence[FrequencyLayer],
    scores: Sequence[Tensor],
    fused: Tensor,
    query: int,
    places: Sequence[int] = (),
    strip: Tensor | None = None,
) -> Plot:
    """Scores of one query over a chunk: two layers, and all layers fused (figure 17 of the paper).

    Args:
        layers: two layers of one chunk. scores: for each (n,) eq. 3 at the chunk's places.
        fused: (n,) eq. 4 at the same places. query: number of the query frame.
        places: its right places, marked.
        strip: (C,H,n) one image column for each place, drawn above; None leaves it out.
    """
    start, stop = layers[0].start, layers[0].stop
    figure, rows = _figure(8, 5.2 if strip is None else 5.9, rows=len(layers) + 1 + (strip is not None))
    axes = rows[-len(layers) - 1 :]
    if strip is not None:
        image = strip.expand(3, -1, -1).permute(1, 2, 0).clamp(0, 1)
        rows[0].imshow(image.numpy(), extent=(start, stop, 0, 1), aspect="auto")
        rows[0].set_yticks([])
        rows[0].set_ylabel("middle column\nof each frame", fontsize=9)
    where = torch.arange(start, stop)
    names = [f"period {float(layer.period):g}\n{len(layer.features)} features" for layer in layers]
    colours = (ORANGE, GREEN, DARK, GREY)
    for axis, name, values, colour in zip(
        axes, [*names, "all layers\nfused"], [*scores, fused], [*colours[: len(layers)], BLUE], strict=True
    ):
        axis.plot(where, values, color=colour, linewidth=1.1)
        best = int(values.argmin())
        axis.plot(
            where[best],
            values[best],
            "v",
            color=RED,
            markersize=7,
            clip_on=False,
            label="best (first of equals)",
        )
        axis.set_ylabel(name, fontsize=9)
        axis.set_yticks([])
    for axis in rows:
        for place in places:
            axis.axvline(place, color=DARK, linewidth=0.9, linestyle="--", label="true place")
    handles, labels = axes[-1].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    rows[0].legend(
        unique.values(),
        unique.keys(),
        fontsize=8,
        ncols=2,
        frameon=False,
        loc="lower right",
        bbox_to_anchor=(1.0, 0.98),
    )
    rows[0].set_title(f"query {query}: difference to each place (lower is better)", loc="left", fontsize=11)
    rows[-1].set(xlabel="place (reference frame)", xlim=(start, stop))
    return figure, rows
