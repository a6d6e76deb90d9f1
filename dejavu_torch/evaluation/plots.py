"""The shared style of all pictures: width, colours and axes.

Convention 11: axes along a route count frames of its source. Axes that count places, such as periods, are
labelled with the unit of `unit_of`.

Arguments: `borders` (N+1,) is `FrameTable.borders` of the map, `queries` (Q,) the frame of each query, `unit`
that of periods and tolerance, `truth` None if unknown. A contender's key determines its colour. `draw_...`
returns pictures by their names in a report, and an empty dict if there is nothing to draw.
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

WIDTH = 4.0  # inches; phones show about 85 pixels per inch, so 9 points is the smallest font size
LINE, LETTERS = 0.18, 54  # height of a line of text in inches, and letters of 9 points that fit in one
QUERY, PLACE = "query (frame)", "place (frame)"  # axes, named as the columns of matches.csv
DARK, GREY = "#333333", "#bbbbbb"
RIGHT, WRONG = "#2f9463", "#9e1b32"
PALE_RIGHT, PALE_WRONG = "#a9dcc0", "#f4566a"  # of answers that are not accepted
LAYERS = ("#b35806", "#542788")  # the two layers that several pictures show
PHOTOS = ("examples", "pairs", "frames", "ground", "features")
LABELLED = 8  # chunks along a route, beyond which their numbers do not fit
BOX = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}  # makes a number readable on any colour


class Picture(NamedTuple):
    """A plot with a short heading, a caption of a sentence or two, and its numbers for report.json."""

    plot: Plot
    heading: str
    caption: str
    numbers: Mapping[str, Any] = MappingProxyType({})
    photos: bool = False  # whether it shows frames, whose colours stay as they are on a dark page


Pictures = dict[str, Picture]  # by their names in a report


def picture(name: str, plot: Plot, numbers: Mapping[str, Any] | None = None, **facts: Any) -> Pictures:
    """A plot by its name in a report, with heading and caption from captions.html.j2 and these facts."""
    heading, _, caption = sentences("captions.html.j2", name=name, **facts).partition(" | ")
    return {name: Picture(plot, heading, caption, numbers or {}, name in PHOTOS)}


def label(name: str) -> str:
    """A name for a picture: on one line, with dollar signs that do not start a formula."""
    return printable(name).replace("$", r"\$")


def empty(height: float) -> Figure:
    """A figure of the shared width; the height is in inches."""
    return Figure(figsize=(WIDTH, height), layout="constrained", dpi=200)


def canvas(height: float, rows: int = 1, columns: int = 1, **grid: Any) -> Plot:
    """A figure with empty axes, without the top and right spines."""
    figure = empty(height)
    axes = figure.subplots(rows, columns, **grid)
    for axis in figure.axes:
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def set_title(axis: Any, text: str) -> None:
    """The title of a part of a picture, above its left corner."""
    axis.set_title(text, loc="left", fontsize=9)


def legend(owner: Any, *names: Any, loc: str = "outside lower left", **settings: Any) -> None:
    """The legend of a figure, below it, or of axes."""
    narrow = {"handlelength": 1.2, "handletextpad": 0.5, "columnspacing": 1}
    owner.legend(*names, loc=loc, frameon=False, fontsize=9, **narrow, **settings)


def colour_bar(figure: Figure, image: Any, axis: Any, label: str, **settings: Any) -> Any:
    """A thin bar of the colours of an image, beside its axes."""
    return figure.colorbar(image, ax=axis, label=label, pad=0.01, aspect=30, **settings)


def show_wrong(axis: Any, x: Tensor, y: Tensor) -> None:
    """Draw wrong answers by one image over those of the whole drive."""
    if len(x):
        name = f"{len(x)} wrong by one image"
        axis.plot(x, y, "x", color=WRONG, markersize=3, markeredgewidth=0.7, label=name)


def show_frame(axis: Any, frame: Tensor | None, text: str) -> None:
    """Draw a frame (C,H,W) in [0,1] without axes; None leaves it empty."""
    axis.set_axis_off()
    axis.set_title(text, loc="left", fontsize=9, pad=3)
    if frame is not None:
        axis.imshow(pixels(frame))


def frame_axis(axis: Any, colour: str) -> None:
    """Draw a coloured border around what an axis shows."""
    axis.set_axis_on()
    axis.set(xticks=[], yticks=[])
    axis.spines[:].set(visible=True, color=colour, linewidth=2)


def pixels(frame: Tensor) -> np.ndarray[Any, Any]:
    """A frame (C,H,W) in [0,1] for imshow, (H,W,3); other than 1 or 3 channels are averaged."""
    frame = frame if len(frame) in (1, 3) else frame.mean(0, keepdim=True)
    values: np.ndarray[Any, Any] = frame.expand(3, -1, -1).permute(1, 2, 0).clamp(0, 1).numpy()
    return values


def period_axis(axis: Any, low: float, high: float, unit: str) -> None:
    """Make the y axis logarithmic from period `low` to `high`, with powers of two as ticks."""
    axis.set_yscale("log")
    ticks = [2**k for k in range(40) if low <= 2**k <= high]
    axis.set_yticks(ticks, [str(t) for t in ticks])
    axis.minorticks_off()
    axis.set(ylim=(low, high), ylabel=f"period ({unit})")
