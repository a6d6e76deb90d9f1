"""Pictures of queries and the places reported for them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.colors import LogNorm
from matplotlib.patches import Rectangle
from torch import Tensor

from dejavu_torch.data.ground_truth import GroundTruth, counted, is_right
from dejavu_torch.data.positions import look_up
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.plots import (
    DARK,
    GREY,
    LAYERS,
    LETTERS,
    LINE,
    PLACE,
    QUERY,
    RIGHT,
    WIDTH,
    WRONG,
    Picture,
    Plot,
    canvas,
    empty,
    pixels,
    show_cells,
)
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import Match

CELLS = 400  # rows and columns of a score matrix, at most
PIXELS = 1000  # rows and columns of a posterior, at most
MARKS = 24  # queries whose right places are marked on a posterior, at most
DECADES = 6  # of probabilities
SEQUENCE = LAYERS[0]
LINES = 8  # about as many right places of a query are drawn
SCORES_AT_ONCE = 2**22  # numbers of Q x N held at a time


class Example(NamedTuple):
    """A query worth showing: why, its number, the place reported, and the nearest right place.

    right is -1 where no right place is known.
    """

    why: str
    query: int
    place: int
    right: int = -1


class Row(NamedTuple):
    """Frames (C,H,W) beside each other, and what stands above them.

    heading: above all of them, or nothing. titles: above each; one more says what is missing.
    """

    heading: str
    titles: Sequence[str]
    frames: Sequence[Tensor]


class Diagonal(NamedTuple):
    """The cells that a sequence adds up for its latest query, and the scores of single queries around them.

    query, place: (C,) of each cell. first: query and place of the upper left one of values (h,w), in [0,1] as
    those of `ScoreMatrix`.
    """

    query: Tensor
    place: Tensor
    first: tuple[int, int]
    values: Tensor


class PosteriorImage(NamedTuple):
    """Probabilities of places behind each query, small enough to draw.

    values: (h,w) each the greatest of a block of blocks[0] neighbouring queries and blocks[1] places.
    off: (Q,) of being off the map.
    """

    values: Tensor
    off: Tensor
    blocks: tuple[int, int]


class ScoreMatrix(NamedTuple):
    """Scores of queries at places, small enough to draw.

    query: (h,) the number of each row's query. values: (h,w) in [0,1], 0 at the query's best score, 1 at its
    median and above, NaN where nothing covers; each the least of `block` neighbouring places.
    """

    query: Tensor
    values: Tensor
    block: int


def plot_rows(rows: Sequence[Row]) -> Plot:
    """Rows of frames, such as queries beside what was found."""
    columns = max(len(row.titles) for row in rows)
    letters, heights, texts = LETTERS // columns, [], []
    for heading, titles, frames in rows:
        wrapped = ["\n".join(fill(line, letters) for line in title.split("\n")) for title in titles]
        lines = max(text.count("\n") for text in wrapped)
        texts.append([text + "\n" * (lines - text.count("\n")) for text in wrapped])
        lines += 1 + bool(heading) * len(fill(heading, LETTERS).split("\n"))
        side = max(frame.shape[1] / frame.shape[2] for frame in frames)
        heights.append(WIDTH / columns * side + lines * LINE)
    figure, axes = empty(sum(heights)), []
    parts = figure.subfigures(len(rows), 1, squeeze=False, height_ratios=heights)[:, 0]
    for part, row, titles in zip(parts, rows, texts, strict=True):
        if row.heading:
            part.suptitle(fill(row.heading, LETTERS), x=0.01, ha="left", fontsize=9, weight="bold")
        axes.append(part.subplots(1, columns, squeeze=False)[0])
        for axis in axes[-1]:
            axis.set_axis_off()
        for axis, title in zip(axes[-1], titles, strict=False):
            axis.set_title(title, loc="left", fontsize=9, pad=3)
        for axis, frame in zip(axes[-1], row.frames, strict=False):
            axis.imshow(pixels(frame))
    return figure, np.stack(axes)


def example_matches(match: Match, truth: GroundTruth | None, tolerance: int) -> list[Example]:
    """The queries that a report shows: the surest right, the surest wrong, and one at the border.

    The last is the surest that is not accepted, or, where all are, the least sure of all.
    Without ground truth the surest of all stands for the first two. A query that is several of these is one
    example.

    Example:
        >>> from dejavu_torch.data.ground_truth import as_ground_truth
        >>> match = Match(torch.tensor([0, 9]), torch.tensor([0.1, 0.2]), torch.tensor([True, False]))
        >>> for example in example_matches(match, as_ground_truth(torch.tensor([[0], [1]])), tolerance=0):
        ...     print(example)
        Example(why='surest right answer, score 0.1', query=0, place=0, right=0)
        Example(why='surest wrong answer, surest not accepted, score 0.2', query=1, place=9, right=1)
    """
    reported = match.index >= 0
    rejected = reported & ~match.accepted
    if truth is None:
        groups = {"surest answer": reported}
    else:
        scored = reported & counted(match.index, truth, tolerance)
        right = is_right(match.index, truth.positives, tolerance)
        groups = {"surest right answer": scored & right, "surest wrong answer": scored & ~right}
    if rejected.any():
        groups["surest not accepted"] = rejected
    else:
        groups["least sure answer"] = reported
    reasons: dict[int, list[str]] = {}
    for why, group in groups.items():
        if group.any():
            sign = -1 if why.startswith("least") else 1
            query = int(torch.where(group, sign * match.score, torch.inf).argmin())
            reasons.setdefault(query, []).append(why)
    examples = []
    for query, whys in reasons.items():
        place, nearest = int(match.index[query]), -1
        if truth is not None and truth.judged[query] and (truth.positives[query] >= 0).any():
            positives = truth.positives[query][truth.positives[query] >= 0]
            nearest = int(positives[(positives - place).abs().argmin()])
        text = f"{', '.join(whys)}, score {float(match.score[query]):.3g}"
        examples.append(Example(text, query, place, nearest))
    return examples


def score_matrix(
    scores: Callable[[Tensor], Tensor], queries: Tensor, cells: int = CELLS
) -> ScoreMatrix | None:
    """Scores of queries at all places, brought to at most `cells` rows and columns; None where all are +inf.

    Convention: only a few rows of Q x N are held at a time. Each query is scaled by itself, from its best
        score to its median, since scores grow with all that a query has in no place.
    """
    chosen = torch.arange(0, len(queries), -(-len(queries) // cells))
    rows: list[Tensor] = []
    at_once, block, places = 1, 1, 0
    done = 0
    while done < len(chosen):
        part = chosen[done : done + at_once].to(queries.device)
        with torch.no_grad():
            values = scores(queries.index_select(0, part)).float().cpu()
        done += len(part)
        places = values.shape[1]
        block, at_once = -(-places // cells), max(1, SCORES_AT_ONCE // places)
        values = _scaled(values)
        padded = torch.nn.functional.pad(values, (0, -places % block), value=torch.inf)
        rows.append(padded.unflatten(1, (-1, block)).amin(2))
    matrix = torch.cat(rows)
    matrix = matrix.masked_fill(matrix.isinf(), torch.nan)
    return None if matrix.isnan().all() else ScoreMatrix(chosen, matrix, block)


def _scaled(scores: Tensor) -> Tensor:
    """Each query's scores from 0, its best, to 1, its median and above; +inf where nothing covers."""
    closed, least = scores.isinf(), scores.amin(1, keepdim=True)
    median = scores.masked_fill(closed, torch.nan).nanmedian(1, keepdim=True).values
    scaled = ((scores - least) / (median - least).clamp(min=1e-12)).clamp(max=1)
    return scaled.masked_fill(closed, torch.inf)


def diagonal(
    scores: Callable[[Tensor], Tensor], queries: Tensor, matcher: SequenceMatcher, query: int, place: int
) -> Diagonal:
    """What a sequence adds up for a query and the place reported for it, with as much on all sides of it."""
    room = matcher.length
    back = [round(speed * (room - 1)) for speed in matcher.speeds]
    top, bottom = max(0, query - 2 * room + 1), min(len(queries), query + room + 1)
    left, right = max(0, place - max(0, *back) - room), place - min(0, *back) + room + 1
    seen, scaled = [], []
    for part in range(top, bottom):
        with torch.no_grad():
            row = scores(queries[part : part + 1]).float().cpu()
        seen.append(row[:, left:right].clone())  # a view would keep the whole row
        scaled.append(_scaled(row)[:, left:right].clone())
    cells = matcher.trajectory(torch.cat(seen)[: query - top + 1], place - left)
    values = torch.cat(scaled)
    return Diagonal(
        cells[:, 0] + top, cells[:, 1] + left, (top, left), values.masked_fill(values.isinf(), torch.nan)
    )


def plot_score_matrix(
    matrix: ScoreMatrix,
    match: Match,
    truth: GroundTruth | None,
    borders: Tensor,
    queries: Tensor,
    example: Diagonal | None = None,
) -> Plot:
    """How much each query differs from each place, with the places reported and those that are right."""
    figure, axes = canvas(3.8) if example is None else canvas(6.9, 2)
    axis = figure.axes[0]
    edges = torch.cat([queries, queries[-1:] + 1])
    x = torch.cat([queries[matrix.query], edges[-1:]])
    y = torch.cat([borders[: -1 : matrix.block], borders[-1:]])
    image = _show_scores(axis, x, y, matrix.values, match, truth, borders, queries)
    bar = figure.colorbar(image, ax=axis, pad=0.01, aspect=30, ticks=[0, 1])
    bar.ax.set_yticklabels(["best", "median"])
    bar.set_label("score within a query")
    legend: dict[str, Any] = {"loc": "outside lower left", "frameon": False}
    if example is None:
        figure.legend(ncols=2, markerscale=4, **legend)
        return figure, axis
    (top, left), (height, width) = example.first, example.values.shape
    x, y = edges[top : top + height + 1], borders[left : left + width + 1]
    corner, *size = (int(x[0]), int(y[0])), int(x[-1] - x[0]), int(y[-1] - y[0])
    axis.add_patch(Rectangle(corner, *size, fill=False, color=SEQUENCE, linewidth=1))
    axis.set_xlabel("")
    axis = axes[1]
    _show_scores(axis, x, y, example.values, match, truth, borders, queries, dots=4)
    cells = queries[example.query], borders[example.place]
    axis.plot(
        *cells,
        "o-",
        color=SEQUENCE,
        markersize=min(5, 60 / len(cells[0])),
        mfc="none",
        linewidth=0.8,
        label="added up",
    )
    axis.set_title("the marked part", loc="left", fontsize=10)
    figure.legend(*axis.get_legend_handles_labels(), ncols=3, handlelength=1, columnspacing=1, **legend)
    return figure, axes


def _show_scores(
    axis: Any,
    x: Tensor,
    y: Tensor,
    values: Tensor,
    match: Match,
    truth: GroundTruth | None,
    borders: Tensor,
    queries: Tensor,
    dots: float = 2,
) -> Any:
    """Draw scores (h,w) between the frames x (h+1,) and y (w+1,), the places reported, and those right."""
    axis.set_facecolor(GREY)  # where nothing covers
    image = show_cells(axis, x - 0.5, y - 0.5, values.T, cmap="gray", vmin=0, vmax=1)
    found = match.index >= 0
    style = {"color": COLOURS["map"], "markersize": dots, "label": "reported place"}
    axis.plot(queries[found], borders[match.index[found]], ".", **style)
    if truth is not None:
        right = _right_frames(truth, borders)
        style = {"color": RIGHT, "linewidth": 1, "dashes": (4, 4)}
        axis.plot(queries, right, **style)
        axis.plot([], [], label="right place", **style)
    for low, high, limit in ((x[0], x[-1], axis.set_xlim), (y[0], y[-1], axis.set_ylim)):
        limit(float(low) - 0.5, float(high) - 0.5)
    axis.set(xlabel=QUERY, ylabel=PLACE)
    return image


def _right_frames(truth: GroundTruth, borders: Tensor) -> Tensor:
    """(Q,R) frames of some right places of each query, NaN where there is none."""
    known = truth.judged[:, None] & (truth.positives >= 0)
    right = torch.where(known, look_up(borders, truth.positives), torch.nan)
    return right[:, :: max(1, right.shape[1] // LINES)]


def posterior_image(
    scores: Callable[[Tensor], Tensor], queries: Tensor, model: PlaceFilter, cells: int = PIXELS
) -> PosteriorImage:
    """Posterior of a filter behind each query, brought to at most `cells` queries and places.

    Convention: only a few rows of Q x N are held at a time.
    """
    block = -(-len(queries) // cells)
    before, off = None, []
    at_once, done, width = 1, 0, 1
    values = torch.zeros(-(-len(queries) // block), 0)
    while done < len(queries):
        with torch.no_grad():
            posterior = model.posterior(scores(queries[done : done + at_once]), before)
        before, places = posterior[-1], posterior.shape[1] - 1
        width, at_once = -(-places // cells), max(1, SCORES_AT_ONCE // places)
        off.append(posterior[:, -1].float().cpu().clone())  # a view would keep all of them
        padded = torch.nn.functional.pad(posterior[:, :-1].float().cpu(), (0, -places % width))
        rows = padded.unflatten(1, (-1, width)).amax(2)
        values = values if done else values.new_zeros(len(values), rows.shape[1])
        for k, row in enumerate(rows, done):
            values[k // block] = torch.maximum(values[k // block], row)
        done += len(rows)
    return PosteriorImage(values, torch.cat(off), (block, width))


def plot_posterior(
    image: PosteriorImage, truth: GroundTruth | None, borders: Tensor, queries: Tensor
) -> Plot:
    """Probability of each place behind each query, and below it that of being off the map."""
    figure, axes = canvas(5.2, 2, sharex=True, height_ratios=(4, 1))
    axis, below = axes
    x = torch.cat([queries[:: image.blocks[0]], queries[-1:] + 1]) - 0.5
    y = torch.cat([borders[: -1 : image.blocks[1]], borders[-1:]]) - 0.5
    least = 10.0**-DECADES
    scale = LogNorm(least, 1)
    shown = show_cells(axis, x, y, image.values.T.clamp(least, 1), cmap="gray_r", norm=scale)
    bar = figure.colorbar(shown, ax=axis, pad=0.01, aspect=30)
    bar.set_label("probability of a place")
    below.plot(queries, image.off, color=COLOURS["map"], linewidth=1)
    if truth is not None:
        right, some = _right_frames(truth, borders), slice(None, None, -(-len(queries) // MARKS))
        style = {"color": RIGHT, "markersize": 5, "markerfacecolor": "none", "clip_on": False}
        axis.plot(queries[some], right[some], "o", **style)
        figure.legend(axis.lines[:1], ["right place"], loc="outside lower left", frameon=False)
        nowhere = truth.judged & right.isnan().all(1)
        if nowhere.any():
            below.fill_between(queries, 0, 1, where=nowhere.numpy(), step="mid", color=GREY, linewidth=0)
    axis.set(xlim=(float(x[0]), float(x[-1])), ylim=(float(y[0]), float(y[-1])), ylabel=PLACE)
    below.set(ylim=(0, 1), xlabel=QUERY, ylabel="off the map")
    return figure, axes


def draw_coverage(
    match: Match,
    truth: GroundTruth | None,
    tolerance: int,
    borders: Tensor,
    queries: Tensor,
    unit: str,
) -> dict[str, Picture]:
    """Where along the route each query was put, right or wrong (coverage plot of the paper, figure 9)."""
    figure, axis = canvas(3.8)
    caption = "Where along the route each query was found."
    reported, frames = match.index >= 0, int(borders[-1])

    def dots(which: Tensor, colour: str, label: str, size: float = 3) -> None:
        if which.any():
            place = match.index[which]
            shown = borders[place] if len(borders) > 1 else place
            axis.plot(queries[which], shown, ".", color=colour, markersize=size, label=label)

    missing = ~reported
    if truth is None and match.probability is not None and reported.any():
        order = match.probability.argsort()  # the surest above the others
        order = order[reported[order]]
        place = match.index[order]
        places = borders[place] if len(borders) > 1 else place
        style: dict[str, Any] = {"cmap": "viridis_r", "vmin": 0, "vmax": 1, "linewidths": 0}
        dotted = queries[order].numpy(), places.numpy()
        shown = axis.scatter(*dotted, s=9, c=match.probability[order].numpy(), **style)
        bar = figure.colorbar(shown, ax=axis, pad=0.01, aspect=30)
        bar.set_label("probability of being right")
        caption += " The darker a dot, the more probable its place."
    elif truth is None:
        dots(reported, COLOURS["map"], f"{reported.sum()} reported")
    else:
        scored = counted(match.index, truth, tolerance)
        right = scored & is_right(match.index, truth.positives, tolerance)
        wrong = scored & reported & ~right
        dots(reported & ~scored, GREY, f"{(~scored).sum()} not scored")
        dots(wrong, WRONG, f"{wrong.sum()} wrong")
        dots(right, RIGHT, f"{right.sum()} right", 4)
        caption += " A query in its right place is green, in a wrong one red."
        axis.set_title(f"right within {tolerance} {unit}", fontsize=10)
        missing &= scored
    if missing.any():
        label = f"{missing.sum()} not reported"
        axis.plot(queries[missing], torch.zeros(int(missing.sum())), "|", color=DARK, label=label)
    first, last = int(queries.min()), int(queries.max())
    axis.set(xlabel=QUERY, ylabel=f"reported {PLACE}")
    axis.set(xlim=(first, max(last, first + 1)), ylim=(-0.01 * frames, frames))
    if axis.get_legend_handles_labels()[0]:
        figure.legend(loc="outside lower left", ncols=2, frameon=False, markerscale=3)
    return {"coverage": Picture((figure, axis), "places reported", caption)}
