"""Pictures of a map: its periods, features and lines, how they answer a query, and the ground measured."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import torch
from matplotlib.collections import LineCollection
from matplotlib.colors import PowerNorm
from torch import Tensor

from dejavu_torch.evaluation.activation import ActivationRates
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.plots import (
    DARK,
    GREY,
    LABELLED,
    LAYERS,
    LETTERS,
    LINE,
    PLACE,
    WIDTH,
    WRONG,
    Plot,
    canvas,
    period_axis,
    pixels,
    show_cells,
)
from dejavu_torch.periods.spectrogram import Spectrum
from dejavu_torch.types import FrequencyLayer, Plan

SHOWN = 12  # layers of a chunk
BLUE = COLOURS["map"]
ROWS, CYCLES, MARKED = 64, 100, 12  # templates, cycles and multiples of a period drawn at most
_BESIDE = {  # a number next to a mark, readable on any colour
    "textcoords": "offset points",
    "va": "center",
    "fontsize": 9,
    "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 0.8},
}
_DOTS = 4000  # along a picture; a longer line is drawn as the range it covers
FAINTEST = 0.02  # of a step: what is below is drawn there


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


def edges_seen(
    features: Tensor, size: tuple[int, int], orientations: int = 9, cell: int = 8, block: int = 2
) -> tuple[Tensor, Tensor]:
    """The edges that HOG features respond to, as line segments, and how many of the features share each.

    Shape: (F,) int64 -> (E,2,2) end points (x, y) in pixels, where (0, 0) is the middle of the first pixel;
        (E,) int64, in how many (overlapping) blocks the features have this cell and orientation.

    Convention: an edge lies across its gradient, through the middle of its cell. Bin o holds gradients of
        about (o + 1/2) * 180 / orientations degrees.
    """
    rows, columns = (max(0, pixels // cell - block + 1) for pixels in size)
    shape = (rows, columns, block, block, orientations)
    row, column, down, right, orientation = torch.unravel_index(features, shape)
    cells = torch.stack([row + down, column + right, orientation], 1)
    distinct, count = cells.unique(dim=0, return_counts=True)
    middle = (distinct[:, :2].flip(1) + 0.5) * cell - 0.5
    angle = (distinct[:, 2] + 0.5) * math.pi / orientations  # of the gradient, from x towards y
    along = torch.stack([-angle.sin(), angle.cos()], 1) * (0.45 * cell)
    return torch.stack([middle - along, middle + along], 1), count


def plot_spectrogram(
    values: Tensor,
    spectra: Sequence[Spectrum],
    kept: Sequence[Sequence[float]],
    shortest: float,
    feature: int,
    borders: Tensor,
    unit: str,
) -> Plot:
    """One feature through time, and its spectrogram, a column a chunk (figure 3 of the paper).

    Convention: where chunks overlap, each column ends where the next begins.
    """
    figure, (above, below) = canvas(4.4, 2, sharex=True, height_ratios=(1, 1.7))
    if len(values) > _DOTS:
        step = -(-len(values) // (_DOTS // 2))
        low, high = zip(*((float(part.min()), float(part.max())) for part in values.split(step)), strict=True)
        above.fill_between(borders[:-1:step], low, high, color=DARK, linewidth=0.5)
    else:
        above.plot(borders[:-1], values, color=DARK, linewidth=0.7)
    above.set_title(f"feature {feature} through time", loc="left", fontsize=10)
    above.set(ylabel="value")
    shares = [(power[2:] / power[1:].sum()).nan_to_num() for _, _, power in spectra]
    strongest = max(float(share.max()) for share in shares)
    norm = PowerNorm(0.5, 0, max(strongest, 1e-6) * 100)
    ends = [*(spectrum.start for spectrum in spectra[1:]), spectra[-1].stop]
    mesh: Any = None
    for (start, stop, _), share, end, periods in zip(spectra, shares, ends, kept, strict=True):
        left, right = int(borders[start]), int(borders[min(stop, end)])
        between = (stop - start) / (torch.arange(len(share) + 1) + 1.5)  # two bins
        mesh = below.pcolormesh([left, right], between.numpy(), share.numpy() * 100, norm=norm, cmap="Blues")
        for axis in (above, below):
            axis.axvline(left, color=GREY, linewidth=0.8, linestyle=":")
        for period in periods:
            middle = (left + right) / 2
            size = 11 if len(spectra) <= LABELLED else 3
            below.plot(middle, period, "o", color=LAYERS[0], markersize=size, markerfacecolor="none")
            if len(spectra) <= LABELLED:
                below.annotate(f"{period:.4g}", (middle, period), (10, 0), **_BESIDE)
    figure.colorbar(mesh, ax=below, label="% of its power", pad=0.01, aspect=30)
    period_axis(below, shortest, max((stop - start) / 1.5 for start, stop, _ in spectra), unit)
    below.set(xlim=(0, int(borders[-1])), xlabel=PLACE)
    below.set_title("power at each period; circles: kept", loc="left", fontsize=10)
    return figure, (above, below)


def plot_autocorrelogram(values: Tensor, periods: Sequence[float], feature: int, unit: str) -> Plot:
    """How alike a feature is to itself some places later (figure 1 (c) of the paper).

    Convention: the biased autocorrelation of the feature minus its mean, 1 at lag 0.
    """
    figure, axis = canvas(3)
    spectrum = torch.fft.rfft(values.double() - values.double().mean(), n=2 * len(values)).abs().square()
    correlation = torch.fft.irfft(spectrum)[: len(values)]
    axis.plot(correlation / correlation[0].clamp(min=1e-30), color=DARK, linewidth=1)
    for period, colour in zip(periods, LAYERS, strict=False):
        lags = [k * period for k in range(1, MARKED) if k * period < len(values)]
        axis.vlines(lags, -1, 1, color=colour, linewidth=0.9, linestyle=":", label=f"multiples of {period:g}")
    axis.set(xlim=(0, len(values)), ylim=(-1, 1.02), xlabel=f"lag ({unit})", ylabel="autocorrelation")
    axis.set_title(f"feature {feature} against itself", loc="left", fontsize=10)
    if periods:
        axis.legend(loc="upper right", ncols=2, frameon=False, fontsize=9)
    return figure, axis


def plot_templates(
    layer: FrequencyLayer,
    values: Tensor,
    templates: Tensor,
    chosen: int,
    unit: str,
    thick: str = "their mean",
) -> Plot:
    """The places of equal phase averaged into templates (figure 4 of the paper).

    Convention: of more than 100 cycles every k-th is drawn. Of more than 64 features those are drawn that
        vary most from phase to phase; rows are ordered by where in the cycle they are high, each from
        its lowest (white) to its highest (dark).
    """
    figure, (above, below) = canvas(4.8, 2, sharex=True, height_ratios=(1, 1.4))
    period, number = float(layer.period), layer.features[chosen]
    places = torch.arange(layer.start, layer.stop)
    cycle = places * layer.period.denominator // layer.period.numerator
    within = places - cycle.double() * period
    parts = torch.unique_consecutive(cycle, return_counts=True)[1].tolist()
    cycles = list(zip(within.split(parts), values.split(parts), strict=True))
    for x, y in cycles[:: -(-len(cycles) // CYCLES)]:
        above.plot(x, y, color=GREY, linewidth=0.6, alpha=0.6)
    # phase k holds the places that lie from k to k + 1 phases into their cycle
    phase = (torch.arange(layer.phases) + 0.5) * period / layer.phases - 0.5
    above.plot(phase, templates[:, chosen], color=BLUE, linewidth=2.2)
    text = f"feature {number}, {len(cycles)} cycles; thick: {thick}"
    above.set_title(text, loc="left", fontsize=10)
    above.set(ylabel="value")
    rows = templates.var(0, correction=0).argsort(descending=True, stable=True)[:ROWS]
    wave = torch.fft.fft(templates[:, rows].double(), dim=0)[1 % layer.phases]
    rows = rows[wave.angle().neg().remainder(2 * math.pi).argsort(stable=True)]
    picture = templates[:, rows].T
    low, high = picture.amin(1, keepdim=True), picture.amax(1, keepdim=True)
    picture = (picture - low) / (high - low).clamp(min=torch.finfo(picture.dtype).tiny)
    extent = (-0.5, period - 0.5, len(rows) - 0.5, -0.5)
    below.imshow(picture.numpy(), aspect="auto", extent=extent, cmap="Blues", interpolation="nearest")
    total = len(layer.features)
    text = f"{total} features" if len(rows) == total else f"{len(rows)} of {total} features"
    below.set_title(f"templates of {text}; dark: highest", loc="left", fontsize=10)
    mark = (rows == chosen).nonzero().flatten().tolist()
    below.set_yticks(mark, [str(number)] * len(mark))
    below.set(
        xlabel=f"phase, of a period of {period:.4g} ({unit})", ylabel="feature", xlim=(-0.5, period - 0.5)
    )
    return figure, (above, below)


def plot_features(
    frame: Tensor,
    layers: Sequence[FrequencyLayer],
    orientations: int = 9,
    cell: int = 8,
    block: int = 2,
) -> Plot:
    """HOG features that take part in a layer, on a frame of the route (figures 15 and 16 of the paper).

    Convention: each is drawn as the edge it responds to, across its gradient; the stronger the line, the
        more of the overlapping blocks have this cell and orientation in the layer.
    """
    height, width = frame.shape[-2:]
    beside = width <= 1.6 * height and width <= 12 * cell
    rows, columns = (1, len(layers)) if beside else (len(layers), 1)
    wide = 0.97 * WIDTH / columns
    figure, axes = canvas(
        (min(2 * WIDTH, wide * height / width) + 2 * LINE) * rows, rows, columns, squeeze=False
    )
    points = 72 * wide * cell / width  # a cell's side
    grey = frame.mean(0)
    if grey.min() < 0 or grey.max() > 1:
        grey = (grey - grey.min()) / (grey.max() - grey.min())
    for axis, layer, colour in zip(axes.flat, layers, LAYERS * len(layers), strict=False):
        axis.imshow(
            (0.35 + 0.65 * grey).numpy(), cmap="gray", vmin=0, vmax=1
        )  # pale, so that lines stand out
        edges, count = edges_seen(torch.tensor(layer.features), (height, width), orientations, cell, block)
        strength = count / count.max()
        axis.add_collection(
            LineCollection(
                list(edges.numpy()),
                colors=colour,
                linewidths=(points * (0.02 + 0.07 * strength)).tolist(),
                alpha=(0.3 + 0.7 * strength).tolist(),
            )
        )
        axis.set_axis_off()
        axis.set_title(f"period {float(layer.period):.4g},\n{len(layer.features)} features", fontsize=10)
    return figure, axes


class Lines(NamedTuple):
    """The spectrum of one number of the descriptor.

    amplitudes: (n,) of its lines, without their signs. kept: (n,) bool, those that the map holds.
    """

    amplitudes: Tensor
    kept: Tensor


def plot_spectrum(features: Mapping[int, Lines], periods: Tensor, step: float, unit: str) -> Plot:
    """Spectra of numbers of the descriptor, a row each, with the lines kept (figure 3 of the paper)."""
    figure, axes = canvas(1.1 + 1.15 * len(features), len(features), squeeze=False, sharex=True, sharey=True)
    for axis, (feature, (amplitudes, kept)) in zip(axes[:, 0], features.items(), strict=True):
        size = (amplitudes / step).clamp(min=FAINTEST)
        axis.plot(periods[~kept], size[~kept], ".", color=GREY, markersize=2, label="coded as 0")
        axis.vlines(periods[kept], FAINTEST, size[kept], color=BLUE, linewidth=0.5, alpha=0.5)
        axis.plot(periods[kept], size[kept], ".", color=BLUE, markersize=3.5, label="kept")
        axis.axhline(1, color=DARK, linewidth=0.9, linestyle="--", label="step")
        share = float(amplitudes[kept].square().sum() / amplitudes.square().sum().clamp(min=1e-30))
        text = f"feature {feature}: {int(kept.sum())} of {len(kept)} lines, {100 * share:.0f} % of the energy"
        axis.set_title(text, loc="left", fontsize=9)
    low, high = float(periods.min()), float(periods.max())
    axis.set_xscale("log")
    ticks = [4**k for k in range(20) if low <= 4**k <= high]
    axis.set_xticks(ticks, [str(tick) for tick in ticks])
    axis.set_yscale("log")
    largest = max(float(lines.amplitudes.max()) for lines in features.values()) / step
    sizes = [10.0**k for k in range(-1, 20) if 10.0**k <= max(largest, 1)]
    axis.set_yticks(sizes, [f"{size:g}" for size in sizes])
    axis.minorticks_off()
    axis.set(xlim=(low / 1.05, high * 1.15), xlabel=f"period ({unit})")
    axis.set_ylim(bottom=FAINTEST)
    figure.supylabel("size of a line (steps)", fontsize=10)
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, ncols=3, frameon=False, loc="outside lower right", markerscale=3)
    return figure, axes[:, 0]


def plot_velocity(distances: Mapping[str, Tensor], step: float) -> Plot:
    """How fast the ground moves along traverses, and at which steps it is sampled (section IV-B)."""
    figure, axes = canvas(1 + 1.4 * len(distances), len(distances), squeeze=False, sharey=True)
    for axis, (name, travelled), colour in zip(axes.flat, distances.items(), LAYERS, strict=False):
        axis.plot(torch.arange(1, len(travelled)), travelled.diff(), color=colour, linewidth=0.8)
        axis.axhline(0, color=GREY, linewidth=0.6)
        axis.axhline(step, color=DARK, linewidth=0.8, linestyle=":")
        axis.set(xlim=(0, len(travelled)), ylabel="pixels of ground\nper frame")
        axis.set_title(fill(name, LETTERS - 10), loc="left", fontsize=9)
        axis.grid(alpha=0.25)
    axes[-1, 0].set_xlabel("frame (dotted: step between places)")
    return figure, axes
