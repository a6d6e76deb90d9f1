"""Pictures of single features: through time, folded, and on a frame; each returns (figure, axes)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from matplotlib.collections import LineCollection
from matplotlib.colors import PowerNorm
from torch import Tensor

from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.plots import (
    DARK,
    GREY,
    LABELLED,
    LAYERS,
    LINE,
    PLACE,
    WIDTH,
    Plot,
    canvas,
    period_axis,
)
from dejavu_torch.periods.spectrogram import Spectrum
from dejavu_torch.types import FrequencyLayer, InputError

ROWS, CYCLES, MARKED = 64, 100, 12  # templates, cycles and multiples of a period drawn at most
_BESIDE = {  # a number next to a mark, readable on any colour
    "textcoords": "offset points",
    "va": "center",
    "fontsize": 9,
    "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 0.8},
}
_DOTS = 4000  # along a picture; a longer line is drawn as the range it covers


def edges_seen(
    features: Tensor, size: tuple[int, int], orientations: int = 9, cell: int = 8, block: int = 2
) -> tuple[Tensor, Tensor]:
    """The edges that HOG features respond to, as line segments, and how many of the features share each.

    Shape: (F,) int64 -> (E,2,2) end points (x, y) in pixels, where (0, 0) is the middle of the first pixel;
        (E,) int64, in how many (overlapping) blocks the features have this cell and orientation.

    Convention: an edge lies across its gradient, through the middle of its cell. Bin o holds gradients of
        about (o + 1/2) * 180 / orientations degrees.

    Raises:
        InputError: an index that HOG of such frames does not have.
    """
    rows, columns = (max(0, pixels // cell - block + 1) for pixels in size)
    shape = (rows, columns, block, block, orientations)
    if len(features) and not 0 <= int(features.min()) <= int(features.max()) < math.prod(shape):
        raise InputError(
            f"got features {int(features.min())}..{int(features.max())}; HOG of frames of {size[0]} x "
            f"{size[1]} pixels has {math.prod(shape)}"
        )
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
    above.plot(phase, templates[:, chosen], color=COLOURS["map"], linewidth=2.2)
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
