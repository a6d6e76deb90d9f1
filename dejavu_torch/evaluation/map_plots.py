"""Pictures of a map: its chunks, its layers, and how they answer a query; each returns (figure, axes)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dejavu_torch.evaluation.activation import ActivationRates
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.plots import (
    DARK,
    GREY,
    LABELLED,
    LAYERS,
    PLACE,
    WRONG,
    Plot,
    canvas,
    period_axis,
    pixels,
    show_cells,
)
from dejavu_torch.types import FrequencyLayer, Plan

SHOWN = 12  # layers of a chunk
BLUE = COLOURS["map"]


def plot_chunks(plan: Plan, borders: Tensor, unit: str) -> Plot:
    """Chunks along the route and the periods found in each; the wider a bar, the more features."""
    figure, axis = canvas(3.6)
    axis.set(xlim=(0, int(borders[-1])), xlabel=PLACE, ylabel=f"period ({unit})")
    if not plan:
        axis.set(yticks=[])
        axis.text(0.5, 0.5, "this route does not repeat: no layers", ha="center", transform=axis.transAxes)
        return figure, axis
    most = max(len(layer.features) for layer in plan)
    chunks = sorted({(layer.start, layer.stop) for layer in plan})
    for start, stop in chunks:
        first, last = (int(borders[edge]) for edge in (start, stop))
        members = [layer for layer in plan if (layer.start, layer.stop) == (start, stop)]
        for layer in members:
            share = len(layer.features) / most
            style = {"linewidth": 0.6 + 7 * share, "alpha": 0.35 + 0.65 * share}
            axis.hlines(float(layer.period), first, last, color=BLUE, **style)
        leading = sorted(members, key=lambda layer: -len(layer.features))[:2]
        for layer, along in zip(leading, (0.3, 0.7), strict=False):
            if len(chunks) <= LABELLED:
                text = f"{float(layer.period):.4g}"
                box = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
                where = first + along * (last - first), float(layer.period)
                axis.text(*where, text, fontsize=9, ha="center", va="center_baseline", bbox=box)
    for edge in {edge for chunk in chunks for edge in chunk}:
        axis.axvline(int(borders[edge]), color=GREY, linewidth=0.8, linestyle=":")
    periods = [float(layer.period) for layer in plan]
    period_axis(axis, min(periods) / 1.2, max(periods) * 1.2, unit)
    axis.set_title(f"widest bar: {most} features", fontsize=10, loc="left")
    return figure, axis


def plot_layers(layers: Sequence[FrequencyLayer], borders: Tensor, unit: str) -> Plot:
    """Layers of one chunk and their phases along it (figure 2 of the paper).

    Convention: one row a layer, those of most features, by period; the colour is the phase, so that a
    column of colours is what names a place.
    """
    shown = sorted(sorted(layers, key=lambda layer: -len(layer.features))[:SHOWN], key=lambda p: p.period)
    start, stop = shown[0].start, shown[0].stop
    figure, axis = canvas(0.24 * len(shown) + 1.5)
    phases = torch.stack([layer.place_phases / layer.phases for layer in shown])
    x, y = borders[start : stop + 1] - 0.5, torch.arange(len(shown) + 1) - 0.5
    image = show_cells(axis, x, y, phases, cmap="twilight", vmin=0, vmax=1)
    axis.invert_yaxis()
    axis.set_yticks(range(len(shown)), [f"{float(layer.period):.4g}" for layer in shown])
    axis.set(xlabel=PLACE, ylabel=f"period ({unit})")
    axis.set_title(f"phase in {len(shown)} of {len(layers)} layers", loc="left", fontsize=10)
    figure.colorbar(image, ax=axis, label="phase / period", pad=0.01, aspect=20)
    return figure, axis


def plot_activations(
    layers: Sequence[FrequencyLayer],
    scores: Sequence[Tensor],
    fused: Tensor,
    query: int,
    borders: Tensor,
    places: Sequence[int] = (),
    strip: Tensor | None = None,
    rates: ActivationRates | None = None,
) -> Plot:
    """Scores of one query over a chunk: two layers, and all layers fused (figure 17 of the paper)."""
    names = [f"period {float(layer.period):.4g}, {len(layer.features)} features" for layer in layers]
    texts = [""] * (len(layers) + 1)
    if rates is not None:
        texts = [rate.describe() for rate in (*rates.layers, rates.fused)]
    titles = [
        f"{name}:\n{text}" if text else name
        for name, text in zip([*names, "all layers fused"], texts, strict=True)
    ]
    curves = list(zip(titles, [*scores, fused], [*LAYERS[: len(layers)], BLUE], strict=True))
    return plot_answers(curves, query, borders, layers[0].start, layers[0].stop, places, strip)


def plot_answers(
    curves: Sequence[tuple[str, Tensor, str]],
    query: int,
    borders: Tensor,
    start: int,
    stop: int,
    places: Sequence[int] = (),
    strip: Tensor | None = None,
    sharey: bool = False,
) -> Plot:
    """Scores of one query over the places [start, stop), a row for each way to score them."""
    where, begin, end = borders[start:stop], int(borders[start]), int(borders[stop])
    above = strip is not None
    figure, rows = canvas(
        0.6 + 0.9 * (len(curves) + above) + 0.8, len(curves) + above, squeeze=False, sharex=True
    )
    rows = rows[:, 0]
    axes = rows[above:]
    if strip is not None:
        rows[0].imshow(pixels(strip), extent=(begin, end, 0, 1), aspect="auto")
        rows[0].set_yticks([])
        rows[0].set_title("middle image column of each frame", loc="left", fontsize=10)
    for axis, (title, values, colour) in zip(axes, curves, strict=True):
        axis.plot(where, values, color=colour, linewidth=1.1)
        best = int(values.argmin())
        style = {"color": WRONG, "markersize": 7, "clip_on": False, "label": "best (first of equals)"}
        axis.plot(where[best], values[best], "v", **style)
        axis.set_title(title, loc="left", fontsize=9)
        axis.set_yticks([])
        if sharey:
            axis.set_ylim(*spread(torch.cat([values for _, values, _ in curves])))
    for axis in rows:
        for place in places:
            axis.axvline(int(borders[place]), color=DARK, linewidth=0.9, linestyle="--", label="true place")
    handles, labels = axes[-1].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), ncols=2, frameon=False, loc="outside lower right")
    figure.supylabel(f"difference of query {query} (lower is better)", fontsize=10)
    rows[-1].set(xlabel=PLACE, xlim=(begin, end))
    return figure, rows


def spread(values: Tensor) -> tuple[float, float]:
    """Limits of an axis that shows all values."""
    low, high = float(values.min()), float(values.max())
    room = 0.06 * (high - low) or 1.0
    return low - room, high + room
