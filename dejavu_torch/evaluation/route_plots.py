"""Pictures of a route and of the map made of it; each returns (figure, axes)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.evaluation.plots import BLUE, DARK, GREEN, GREY, ORANGE, RED, WIDTH, Plot, canvas
from dejavu_torch.types import FrequencyLayer

SHOWN = 12  # layers of a chunk
MARKED = 12  # multiples of a period


class Length(NamedTuple):
    """What a map with chunks of `window` frames recognises, and what it stores.

    recall_at_1_comparable: with scores that are comparable between chunks, `reduction="mean"`.
    """

    window: int
    recall_at_1: float
    auc: float
    recall_at_1_comparable: float
    map_bytes: int
    bytes_per_place: float


def plot_frames(first: Tensor, second: Tensor, numbers: Sequence[int]) -> Plot:
    """Frames of both traverses at the same places (figures 5 to 7 of the paper).

    Shape: first, second (K,C,H,W) in [0,1]; numbers: K places.
    """
    height, width = first.shape[-2:]
    most = max(1, min(len(numbers), round(2 + 2 * height / width)))  # wide frames need room
    columns = next(n for n in range(most, 0, -1) if len(numbers) % n == 0)
    rows = -(-len(numbers) // columns)
    side = WIDTH / columns * height / width
    figure, axes = canvas(2 * rows * (side + 0.28), 2 * rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for k, number in enumerate(numbers):
        for below, frames, name in ((0, first, "reference"), (1, second, "second")):
            axis = axes[2 * (k // columns) + below, k % columns]
            axis.imshow(frames[k].expand(3, -1, -1).permute(1, 2, 0).clamp(0, 1).numpy())
            axis.set_title(f"{name}, place {number}", fontsize=9, pad=2)
    return figure, axes


def plot_ground(frame: Tensor, corners: Sequence[Sequence[float]], patch: Tensor) -> Plot:
    """Where on a frame ground is taken to be, and how it looks from above.

    Args:
        frame: (C,H,W) in [0,1]. corners: (x, y) in fractions of the frame. patch: (1,h,w) in [0,1].
    """
    height, width = frame.shape[-2:]
    figure, (left, right) = canvas(0.65 * WIDTH * height / width + 0.4, 1, 2, width_ratios=(2, 1))
    left.imshow(frame.expand(3, -1, -1).permute(1, 2, 0).clamp(0, 1).numpy())
    around = [*corners, corners[0]]
    left.plot(
        [x * (width - 1) for x, _ in around],
        [y * (height - 1) for _, y in around],
        color=ORANGE,
        linewidth=1.5,
    )
    right.imshow(patch[0].clamp(0, 1).numpy(), cmap="gray")
    left.set_title("the ground in a frame", loc="left", fontsize=10)
    right.set_title("from above", loc="left", fontsize=10)
    left.set_axis_off()
    right.set_axis_off()
    return figure, (left, right)


def plot_velocity(ways: Mapping[str, Tensor], step: float) -> Plot:
    """How fast the ground moves along traverses, and at which steps it is sampled (section IV-B).

    Args:
        ways: name -> (N,) pixels of ground at each frame. step: pixels from one place to the next.
    """
    figure, axes = canvas(1.6 + 1.5 * len(ways), len(ways), squeeze=False, sharey=True)
    for axis, (name, way), colour in zip(axes.flat, ways.items(), (BLUE, ORANGE), strict=False):
        axis.plot(torch.arange(1, len(way)), way.diff(), color=colour, linewidth=0.8)
        axis.axhline(0, color=GREY, linewidth=0.6)
        axis.axhline(step, color=DARK, linewidth=0.8, linestyle=":")
        axis.set(xlim=(0, len(way)), ylabel="pixels of ground\nper frame")
        axis.set_title(name, loc="left", fontsize=9)
        axis.grid(alpha=0.25)
    axes[-1, 0].set_xlabel("frame as it came (dotted: one step of the evenly spaced places)")
    return figure, axes


def plot_autocorrelogram(values: Tensor, periods: Sequence[float], feature: int = 0) -> Plot:
    """How alike a feature is to itself some frames later (figure 1 (c) of the paper).

    Args:
        values: (n,) the feature along one chunk. periods: those the map keeps of it, frames.
        feature: its number.

    Convention: the biased autocorrelation of the feature minus its mean, 1 at lag 0.
    """
    figure, axis = canvas(3.4)
    spectrum = torch.fft.rfft(values.double() - values.double().mean(), n=2 * len(values)).abs().square()
    correlation = torch.fft.irfft(spectrum)[: len(values)]
    axis.plot(correlation / correlation[0].clamp(min=1e-30), color=DARK, linewidth=1)
    for period, colour in zip(periods, (ORANGE, GREEN), strict=False):
        lags = [k * period for k in range(1, MARKED) if k * period < len(values)]
        axis.vlines(lags, -1, 1, color=colour, linewidth=0.9, linestyle=":", label=f"multiples of {period:g}")
    axis.set(xlim=(0, len(values)), ylim=(-1, 1.02), xlabel="lag (frames)", ylabel="autocorrelation")
    axis.set_title(f"feature {feature} against itself", loc="left", fontsize=10)
    if periods:
        axis.legend(loc="upper right", ncols=2, frameon=False, fontsize=9)
    return figure, axis


def plot_layers(layers: Sequence[FrequencyLayer]) -> Plot:
    """Layers of one chunk and their phases along it (figure 2 of the paper).

    Convention: one row a layer, those of most features, by period; the colour is the phase, so that a
    column of colours is what names a place.
    """
    shown = sorted(sorted(layers, key=lambda layer: -len(layer.features))[:SHOWN], key=lambda p: p.period)
    start, stop = shown[0].start, shown[0].stop
    figure, axis = canvas(0.24 * len(shown) + 1.5)
    phases = torch.stack([layer.place_phases / layer.phases for layer in shown])
    extent = (start - 0.5, stop - 0.5, len(shown) - 0.5, -0.5)
    image = axis.imshow(
        phases.numpy(), aspect="auto", extent=extent, cmap="twilight", vmin=0, vmax=1, interpolation="nearest"
    )
    axis.set_yticks(range(len(shown)), [f"{float(layer.period):.4g}" for layer in shown])
    axis.set(xlabel="place", ylabel="period (frames)")
    axis.set_title(f"phase in {len(shown)} of {len(layers)} layers", loc="left", fontsize=10)
    figure.colorbar(image, ax=axis, label="phase / period", pad=0.01, aspect=20)
    return figure, axis


def plot_lengths(datasets: Mapping[str, Sequence[Length]]) -> Plot:
    """Recall and storage over the length of the chunks (section VI)."""
    figure, (above, below) = canvas(5.4, 2, sharex=True)
    for (name, rows), colour in zip(datasets.items(), (BLUE, ORANGE, GREEN, RED, GREY), strict=False):
        windows = [row.window for row in rows]
        above.plot(windows, [row.recall_at_1_comparable for row in rows], "o-", color=colour, label=name)
        above.plot(windows, [row.recall_at_1 for row in rows], "o:", color=colour, markersize=3)
        below.plot(windows, [row.bytes_per_place for row in rows], "o-", color=colour)
    windows = sorted({row.window for rows in datasets.values() for row in rows})
    below.set_xscale("log", base=2)
    below.set_xticks(windows, [str(window) for window in windows])
    below.minorticks_off()
    above.set(ylabel="recall@1", ylim=(0, 1.02))
    below.set(xlabel="length of a chunk (frames)", ylabel="bytes per place")
    below.set_ylim(bottom=0)
    for axis in (above, below):
        axis.grid(alpha=0.25)
    if windows:
        above.legend(loc="best", frameon=False, fontsize=9)
    return figure, (above, below)
