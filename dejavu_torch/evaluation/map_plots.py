"""Pictures of a spectral map, of the answer to a query, and of the ground motion used for resampling."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.evaluation import plots
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.localization import Localization, frame_at
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.spectrum import period_of, spectrum
from dejavu_torch.motion.ground_plane import ground_patch
from dejavu_torch.motion.resampling import ResampledTraverse

BLUE = COLOURS["map"]
STRONGEST = 3  # descriptor dimensions whose spectrum is shown
FAINTEST = 0.02  # of a step: smaller lines are drawn at this size


class Lines(NamedTuple):
    """The absolute spectrum of one descriptor dimension, (n,), and which of its lines the map keeps."""

    amplitudes: Tensor
    kept: Tensor


def longest_chunk(place_map: SpectralMap) -> int:
    """The number of the longest chunk; of equals the first."""
    return max(range(len(place_map.chunks)), key=lambda j: place_map.chunks[j][1] - place_map.chunks[j][0])


def draw_spectrum(run: Localization, place_map: SpectralMap) -> plots.Pictures:
    """The spectra of the descriptor dimensions of which the longest chunk keeps the most energy."""
    chunk = longest_chunk(place_map)
    start, stop = place_map.chunks[chunk]
    lines = place_map.lines(chunk)
    if stop - start < 2 or not len(lines.value):
        return {}
    energy = lines.value.new_zeros(place_map.dimension).index_add(0, lines.feature, lines.value.square())
    chosen = energy.argsort(descending=True, stable=True)[:STRONGEST].cpu()
    values = (
        run.reference_features[start:stop].cpu()[:, chosen].float() - place_map.means[0].cpu()[chosen].float()
    )
    amplitudes = spectrum(values.T, place_map.transform).abs()
    kept = torch.zeros(place_map.dimension, stop - start, dtype=torch.bool)
    kept[lines.feature.cpu(), lines.line.cpu()] = True
    periods = [float(period_of(j, stop - start, place_map.transform)) for j in range(1, stop - start)]
    features = {int(j): Lines(own[1:], kept[j, 1:]) for j, own in zip(chosen, amplitudes, strict=True)}
    plot = plot_spectrum(features, torch.tensor(periods), float(place_map.steps[chunk]), run.unit)
    edges = run.borders[[start, stop]].tolist() if len(place_map.chunks) > 1 else None
    return plots.picture("spectrum", plot, chunk=edges)


def plot_spectrum(features: Mapping[int, Lines], periods: Tensor, step: float, unit: str) -> plots.Plot:
    """Spectra of descriptor dimensions, a row each, with the kept lines marked (figure 3 of the paper)."""
    count, grid = len(features), {"squeeze": False, "sharex": True, "sharey": True}
    figure, axes = plots.canvas(1.1 + 1.15 * count, count, **grid)
    for axis, (feature, (amplitudes, kept)) in zip(axes[:, 0], features.items(), strict=True):
        size = (amplitudes / step).clamp(min=FAINTEST)
        axis.plot(periods[~kept], size[~kept], ".", color=plots.GREY, markersize=2, label="coded as 0")
        axis.vlines(periods[kept], FAINTEST, size[kept], color=BLUE, linewidth=0.5, alpha=0.5)
        axis.plot(periods[kept], size[kept], ".", color=BLUE, markersize=3.5, label="kept")
        axis.axhline(1, color=plots.DARK, linewidth=0.9, linestyle="--", label="step")
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


def plot_answers(
    run: Localization,
    query: int,
    chunk: tuple[int, int],
    places: Sequence[int],
    curves: Sequence[tuple[str, Tensor, str]],
    strip: Tensor | None = None,
) -> plots.Plot:
    """Scores of one query over the places of a chunk, a row for each (title, scores, colour).

    places: the right ones. strip: (C,H,W), drawn along the chunk at the top.
    """
    begin, end = (int(run.borders[edge]) for edge in chunk)
    above = strip is not None
    count = len(curves) + above
    figure, rows = plots.canvas(1.4 + 0.9 * count, count, squeeze=False, sharex=True)
    rows = rows[:, 0]
    if strip is not None:
        rows[0].imshow(plots.pixels(strip), extent=(begin, end, 0, 1), aspect="auto")
        rows[0].set_yticks([])
        rows[0].set_title("middle column of each frame", loc="left", fontsize=10)
    where = run.borders[slice(*chunk)]
    for axis, (title, values, colour) in zip(rows[above:], curves, strict=True):
        axis.plot(where, values, color=colour, linewidth=1.1)
        best = int(values.argmin())
        style = {"color": plots.WRONG, "markersize": 7, "clip_on": False, "label": "best (first of equals)"}
        axis.plot(where[best], values[best], "v", **style)
        axis.set_title(title, loc="left", fontsize=9)
        axis.set_yticks([])
    for axis in rows:
        for place in places:
            style = {"color": plots.DARK, "linewidth": 0.9, "linestyle": "--", "label": "true place"}
            axis.axvline(int(run.borders[place]), **style)
    handles, labels = rows[-1].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), ncols=2, frameon=False, loc="outside lower right")
    figure.supylabel(f"difference of query {run.query_frames[query]} (lower is better)", fontsize=10)
    rows[-1].set(xlabel=plots.PLACE, xlim=(begin, end))
    return figure, rows


def draw_motion(run: Localization) -> plots.Pictures:
    """The ground and its motion; empty if the reference is not resampled."""
    reference = run.reference
    if not isinstance(reference, ResampledTraverse):
        return {}
    frame, odometry = frame_at(reference, len(reference) // 2), reference.odometry
    corners, (height, width) = odometry.corners, frame.shape[-2:]
    figure, (left, right) = plots.canvas(0.65 * plots.WIDTH * height / width + 0.4, 1, 2, width_ratios=(2, 1))
    plots.show_frame(left, frame, "the ground in a frame")
    plots.show_frame(right, ground_patch(frame[None], corners, odometry.size)[0], "from above")
    x, y = (torch.tensor([*edge, edge[0]]) for edge in zip(*corners, strict=True))
    left.plot(x * (width - 1), y * (height - 1), color=plots.LAYERS[0], linewidth=1.5)
    ground = plots.picture("ground", (figure, (left, right)))
    distances = {
        plots.label(f"{role}: {one.name}"): one.positions * one.step
        for role, one in (("reference", reference), ("query", run.query))
        if isinstance(one, ResampledTraverse)
    }
    return ground | plots.picture("velocity", plot_velocity(distances, reference.step))


def plot_velocity(distances: Mapping[str, Tensor], step: float) -> plots.Plot:
    """The speed of the ground along traverses, and the step of the resampling (section IV-B)."""
    figure, axes = plots.canvas(1 + 1.4 * len(distances), len(distances), squeeze=False, sharey=True)
    for axis, (name, travelled), colour in zip(axes.flat, distances.items(), plots.LAYERS, strict=False):
        axis.plot(torch.arange(1, len(travelled)), travelled.diff(), color=colour, linewidth=0.8)
        axis.axhline(0, color=plots.GREY, linewidth=0.6)
        axis.axhline(step, color=plots.DARK, linewidth=0.8, linestyle=":")
        axis.set(xlim=(0, len(travelled)), ylabel="pixels of ground\nper frame")
        axis.set_title(fill(name, plots.LETTERS - 10), loc="left", fontsize=9)
        axis.grid(alpha=0.25)
    axes[-1, 0].set_xlabel("frame (dotted: step between places)")
    return figure, axes
