"""What all pictures share: their width, colours and axes, and how one is put into a report.

Convention 11: axes along a route count frames of its source. What counts places, such as periods, is labelled
with the unit of `unit_of`.

In pictures `borders` (N+1,) is `FrameTable.borders` of the map, `queries` (Q,) the frame of each query,
`unit` that of periods and tolerance, `truth` None where none is known. A contender's key gives its colour.
What `draw_...` returns is by the names of report.json; nothing where there is nothing to draw.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from dejavu_torch.evaluation.prose import sentences
from dejavu_torch.text import printable

Plot = tuple[Figure, Any]

WIDTH = 4.0  # inches; a phone shows about 85 pixels an inch, so 9 points are the smallest letters
LINE, LETTERS = 0.18, 54  # inches that a line of text takes, and letters of 9 points that fit in one
QUERY, PLACE = "query (frame)", "place (frame)"  # axes, named as the columns of matches.csv
DARK, GREY = "#333333", "#bbbbbb"
RIGHT, WRONG = "#4daf7c", "#9e1b32"
LAYERS = ("#b35806", "#542788")  # the two layers that several pictures show
LABELLED = 8  # chunks along a route that leave room for numbers
BOX = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}  # of a number that is readable on any colour


class Picture(NamedTuple):
    """A plot and what a reader needs beside it.

    heading: a few words. caption: what it shows, in a sentence or two. numbers: those written on it, for
    report.json.
    """

    plot: Plot
    heading: str
    caption: str
    numbers: Mapping[str, Any] = MappingProxyType({})


def picture(
    name: str, plot: Plot, numbers: Mapping[str, Any] | None = None, **facts: Any
) -> dict[str, Picture]:
    """A plot by its name in a report, with the words that captions.html.j2 has for it and these facts."""
    heading, _, caption = sentences("captions.html.j2", name=name, **facts).partition(" | ")
    return {name: Picture(plot, heading, caption, numbers or {})}


def label(name: str) -> str:
    """A name that others gave, as a picture shows it: of one line, and its dollars are no formulas."""
    return printable(name).replace("$", r"\$")


def empty(height: float) -> Figure:
    """A figure of the width all pictures have, in inches."""
    return Figure(figsize=(WIDTH, height), layout="constrained", dpi=200)


def canvas(height: float, rows: int = 1, columns: int = 1, **grid: Any) -> Plot:
    """A figure with empty axes, without the upper and right frame line."""
    figure = empty(height)
    axes = figure.subplots(rows, columns, **grid)
    for axis in figure.axes:
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def show_frame(axis: Any, frame: Tensor | None, title: str) -> None:
    """Draw a frame (C,H,W) in [0,1] without axes; None leaves its room empty."""
    axis.set_axis_off()
    axis.set_title(title, loc="left", fontsize=9, pad=3)
    if frame is not None:
        axis.imshow(pixels(frame))


def show_cells(axis: Any, x: Tensor, y: Tensor, values: Tensor, **style: Any) -> Any:
    """Draw cells (h,w) between the borders x (w+1,) and y (h+1,), which need not be even."""
    return axis.pcolorfast(x.numpy(), y.numpy(), values.numpy(), **style)


def pixels(frame: Tensor) -> np.ndarray[Any, Any]:
    """A frame (C,H,W) in [0,1] as imshow takes it, (H,W,3); of other than 1 or 3 channels the mean of all."""
    frame = frame if len(frame) in (1, 3) else frame.mean(0, keepdim=True)
    values: np.ndarray[Any, Any] = frame.expand(3, -1, -1).permute(1, 2, 0).clamp(0, 1).numpy()
    return values


def period_axis(axis: Any, low: float, high: float, unit: str) -> None:
    """Make the y axis logarithmic from a period of `low` to one of `high`, with powers of two as ticks."""
    axis.set_yscale("log")
    ticks = [2**k for k in range(40) if low <= 2**k <= high]
    axis.set_yticks(ticks, [str(t) for t in ticks])
    axis.minorticks_off()
    axis.set(ylim=(low, high), ylabel=f"period ({unit})")
