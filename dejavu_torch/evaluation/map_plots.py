"""Pictures of the answer to a query, and of the ground motion used for resampling."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill

import torch
from torch import Tensor

from dejavu_torch.evaluation import plots
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.localization import Localization, frame_at
from dejavu_torch.motion.ground_plane import ground_patch
from dejavu_torch.motion.resampling import ResampledTraverse

BLUE = COLOURS["map"]


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
        plots.set_title(rows[0], "middle column of each frame")
    where = run.borders[slice(*chunk)]
    for axis, (title, values, colour) in zip(rows[above:], curves, strict=True):
        axis.plot(where, values, color=colour, linewidth=1.1)
        best = int(values.argmin())
        style = {"color": plots.WRONG, "markersize": 7, "clip_on": False, "label": "best (first of equals)"}
        axis.plot(where[best], values[best], "v", **style)
        plots.set_title(axis, title)
        axis.set_yticks([])
    for axis in rows:
        for place in places:
            style = {"color": plots.DARK, "linewidth": 0.9, "linestyle": "--", "label": "true place"}
            axis.axvline(int(run.borders[place]), **style)
    handles, labels = rows[-1].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    plots.legend(figure, unique.values(), unique.keys(), ncols=2, loc="outside lower right")
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
        plots.set_title(axis, fill(name, plots.LETTERS - 10))
        axis.grid(alpha=0.25)
    axes[-1, 0].set_xlabel("frame (dotted: step between places)")
    return figure, axes
