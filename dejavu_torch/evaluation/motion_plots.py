"""Pictures of motion over the ground, and of footage resampled by it; each returns (figure, axes)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill

import torch
from torch import Tensor

from dejavu_torch.evaluation.plots import DARK, GREY, LAYERS, LETTERS, WIDTH, Plot, canvas, show_frame


def plot_ground(frame: Tensor, corners: Sequence[Sequence[float]], patch: Tensor) -> Plot:
    """Where on a frame ground is taken to be, and how it looks from above."""
    height, width = frame.shape[-2:]
    figure, (left, right) = canvas(0.65 * WIDTH * height / width + 0.4, 1, 2, width_ratios=(2, 1))
    show_frame(left, frame, "the ground in a frame")
    show_frame(right, patch, "from above")
    x, y = zip(*corners, corners[0], strict=True)
    left.plot(torch.tensor(x) * (width - 1), torch.tensor(y) * (height - 1), color=LAYERS[0], linewidth=1.5)
    return figure, (left, right)


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
