"""Pictures of queries and the places reported for them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np
import torch
from matplotlib.colors import LogNorm
from torch import Tensor
from torch.nn.functional import max_pool1d

from dejavu_torch.data.ground_truth import GroundTruth, scored_and_right
from dejavu_torch.evaluation import plots
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.localization import Localization, faults, frame_at, nearest_query
from dejavu_torch.motion.resampling import source_of
from dejavu_torch.places.positions import look_up
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.types import Facts, Match, Traverse

CELLS = 400  # rows and columns of a score matrix, at most
PIXELS = 1000  # rows and columns of a posterior, at most
MARKS = 24  # queries whose right places are marked on a posterior, at most
MIN_PROBABILITY = 1e-6  # lower ones are drawn as this
LINES = 8  # right places drawn for each query, about
BLOCK_SCORES = 2**22  # of Q x N, computed at a time
ALONG, COLUMNS = 12, 4  # queries shown along a drive, and how many side by side
PAIRS, APART = 6, 5  # answers shown with their frames, and queries between two of them, at least
EXAMPLES = 4  # places at which frames of both traverses are shown


def draw_examples(run: Localization) -> plots.Pictures:
    """Queries along the drive above the frames reported for them; empty for ready features."""
    match, truth = run.scored, run.truth
    if not run.has_frames or not (match.index >= 0).any():
        return {}
    chosen = torch.linspace(0, len(match.index) - 1, ALONG).round().long().unique().tolist()
    scored, right = (None, None) if truth is None else scored_and_right(match.index, truth, run.tolerance)
    columns = min(COLUMNS, len(chosen))
    rows = -(-len(chosen) // columns)
    side = run.query.frame_shape[1] / run.query.frame_shape[2]
    height = rows * (2 * side * plots.WIDTH / columns + 3 * plots.LINE)
    figure, axes = plots.canvas(height, 2 * rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for i, query in enumerate(chosen):
        top, below = axes[2 * (i // columns) : 2 * (i // columns) + 2, i % columns]
        place = int(match.index[query])
        sure = "" if match.probability is None or place < 0 else f", {float(match.probability[query]):.2f}"
        plots.show_frame(top, frame_at(run.query, query), f"{int(run.query_frames[query])}")
        found = f"{int(run.borders[place])}{sure}" if place >= 0 else "none"
        plots.show_frame(below, frame_at(run.reference, place) if place >= 0 else None, found)
        colour = plots.GREY
        if bool(match.accepted[query]) and place >= 0:
            known = scored is not None and right is not None and bool(scored[query])
            told = known and bool(right[query])  # type: ignore[index]
            colour = COLOURS["map"] if not known else plots.RIGHT if told else plots.WRONG
        for axis in (top, below):
            plots.frame_axis(axis, colour)
    facts: Facts = {"truth": truth, "probable": match.probability is not None, "count": len(chosen)}
    return plots.picture("examples", (figure, axes), **facts)


def draw_pairs(run: Localization) -> plots.Pictures:
    """The worst answers by one image with their frames; empty for ready features, or if none is reported."""
    match, truth = run.by_one, run.truth
    judged, wrong = faults(match, truth, run.tolerance)
    worst = worst_answers(match, judged, wrong, max(APART, 2 * run.tolerance)) if run.has_frames else []
    if not worst:
        return {}

    def named(role: str, traverse: Traverse, frame: Tensor) -> str:
        names = source_of(traverse).names
        return plots.label(f"{role} {frame} {names[int(frame)] if names else ''}".strip())

    rows, colours = [], []
    for query in worst:
        place, sure = int(match.index[query]), f"score {float(match.score[query]):.3g}"
        frames: dict[str, Tensor | None] = {
            named("query", run.query, run.query_frames[query]): frame_at(run.query, query),
            named("reported", run.reference, run.borders[place]): frame_at(run.reference, place),
        }
        if match.probability is not None:
            sure = f"probability {float(match.probability[query]):.2f}"
        told, colour = ("wrong, ", plots.WRONG) if wrong[query] else ("right, ", plots.RIGHT)
        if truth is None:
            told, colour, frames[""] = "", plots.GREY, None  # as wide as with right ones
        elif len(right := truth.positives[query][truth.positives[query] >= 0]):
            nearest = int(right[(right - place).abs().argmin()])
            frames[named("right", run.reference, run.borders[nearest])] = frame_at(run.reference, nearest)
        else:
            frames["right: none"] = None
        rows.append((told + sure, frames))
        colours.append(colour)
    figure, axes = plot_rows(rows)
    for row, colour in zip(axes, colours, strict=True):
        for axis in row[:2]:
            plots.frame_axis(axis, colour)
    facts: Facts = {"truth": truth, "judged": int(judged.sum()), "wrong": int(wrong.sum())}
    facts |= {"shown": len(worst), "shown_wrong": int(wrong[worst].sum()), "answers": run.answers}
    facts |= {"accepted": int((wrong & match.accepted).sum()), "probable": match.probability is not None}
    return plots.picture("pairs", (figure, axes), **facts)


def worst_answers(match: Match, judged: Tensor, wrong: Tensor, apart: int) -> list[int]:
    """The queries of `PAIRS` judged answers: the surest wrong ones, then the least sure; while there are
    others, none within `apart` queries of a worse one, as neighbours share a mistake."""
    sure = next(one for one in (match.probability, match.confidence, -match.score) if one is not None)
    mistakes, others = (which.nonzero()[:, 0] for which in (wrong, judged & ~wrong))
    falling, rising = sure[mistakes].argsort(descending=True), sure[others].argsort()
    order: list[int] = torch.cat([mistakes[falling], others[rising]]).tolist()
    chosen: list[int] = []
    for query in order:
        if len(chosen) < PAIRS and all(abs(query - other) > apart for other in chosen):
            chosen.append(query)
    near = [query for query in order if query not in chosen]
    return sorted((chosen + near)[:PAIRS], key=order.index)


def draw_frames(run: Localization) -> plots.Pictures:
    """The same places in both traverses; empty for ready features, or if no right place is known."""
    if run.truth is None or not (run.truth.positives >= 0).any() or not run.has_frames:
        return {}
    rows = []
    for k in range(EXAMPLES):
        query = nearest_query(run.truth, len(run.reference_features) * (k + 0.5) / EXAMPLES)
        place = int(run.truth.positives[query].amax())
        frames = {
            f"reference, frame {run.borders[place]}": frame_at(run.reference, place),
            f"second, frame {run.query_frames[query]}": frame_at(run.query, query),
        }
        rows.append(("", frames))
    return plots.picture("frames", plot_rows(rows))


def plot_rows(rows: Sequence[tuple[str, Mapping[str, Tensor | None]]]) -> plots.Plot:
    """Rows of frames by their titles, each row with a heading ("" for none); a frame may be None."""
    columns = max(len(frames) for _, frames in rows)
    headings = [fill(heading, plots.LETTERS) for heading, _ in rows]
    titles, heights = [], []
    for heading, (_, frames) in zip(headings, rows, strict=True):
        titles.append(
            ["\n".join(fill(line, plots.LETTERS // columns) for line in text.split("\n")) for text in frames]
        )
        lines = 1 + max(title.count("\n") for title in titles[-1]) + len(heading.splitlines())
        side = max(one.shape[1] / one.shape[2] for one in frames.values() if one is not None)
        heights.append(plots.WIDTH / columns * side + lines * plots.LINE)
    figure, axes = plots.empty(sum(heights)), []
    parts = figure.subfigures(len(rows), 1, squeeze=False, height_ratios=heights)[:, 0]
    for part, heading, above, (_, frames) in zip(parts, headings, titles, rows, strict=True):
        if heading:
            part.suptitle(heading, x=0.01, ha="left", fontsize=9, weight="bold")
        axes.append(part.subplots(1, columns, squeeze=False)[0])
        for axis, title, frame in zip(axes[-1], above, frames.values(), strict=True):
            plots.show_frame(axis, frame, title)
    return figure, np.stack(axes)


def draw_coverage(
    match: Match,
    truth: GroundTruth | None,
    tolerance: int,
    borders: Tensor,
    queries: Tensor,
    unit: str,
    by_one: Match | None = None,
) -> plots.Pictures:
    """The place reported for each query, right or wrong (coverage plot of the paper, figure 9), and the wrong
    ones of other answers `by_one` image, if any."""
    figure, axis = plots.canvas(3.8)
    reported, frames = match.index >= 0, int(borders[-1])
    shown = borders[match.index] if len(borders) > 1 else match.index
    probability = match.probability if truth is None and reported.any() else None
    missing, groups = ~reported, []
    if truth is not None:
        scored, right = scored_and_right(match.index, truth, tolerance)
        groups.append((reported & ~scored, plots.GREY, 3, f"{(~scored).sum()} not scored"))
        for which, colours, size, what in (  # errors on top
            (right, (plots.PALE_RIGHT, plots.RIGHT), 4, "right"),
            (scored & reported & ~right, (plots.PALE_WRONG, plots.WRONG), 6, "wrong"),
        ):
            kept = which & match.accepted
            groups.append((which & ~kept, colours[0], size, f"{(which & ~kept).sum()} {what}, not accepted"))
            groups.append((kept, colours[1], size, f"{kept.sum()} {what}, accepted"))
        plots.set_title(axis, f"right within {tolerance} {unit}")
        missing = missing & scored
    elif probability is not None:
        order = probability.argsort()  # the surest drawn last
        order = order[reported[order]]
        style: Facts = {"cmap": "viridis_r", "vmin": 0, "vmax": 1, "linewidths": 0}
        points = axis.scatter(queries[order], shown[order], s=9, c=probability[order], **style)
        figure.colorbar(points, ax=axis, pad=0.01, aspect=30, label="probability of being right")
    else:
        groups.append((reported, COLOURS["map"], 3, f"{reported.sum()} reported"))
    for which, colour, size, name in groups:
        if which.any():
            axis.plot(queries[which], shown[which], ".", color=colour, markersize=size, label=name)
    if by_one is not None:
        wrong = faults(by_one, truth, tolerance)[1]
        plots.show_wrong(axis, queries[wrong], borders[by_one.index[wrong]])
    if missing.any():
        where = queries[missing]
        axis.plot(where, torch.zeros(len(where)), "|", color=plots.DARK, label=f"{len(where)} not reported")
    first, last = int(queries.min()), int(queries.max())
    axis.set(xlabel=plots.QUERY, ylabel=f"reported {plots.PLACE}")
    axis.set(xlim=(first, max(last, first + 1)), ylim=(-0.01 * frames, frames))
    if axis.get_legend_handles_labels()[0]:
        plots.legend(figure, ncols=2, markerscale=2)
    return plots.picture("coverage", (figure, axis), truth=truth, probable=probability is not None)


def draw_scores(run: Localization, cells: int = CELLS) -> plots.Pictures:
    """The scores of all queries at all places; empty if all are +inf.

    Convention: at most `cells` queries and blocks of neighbouring places are drawn. Each query is scaled
        from its best score (0) to its median (1), since content that is in no place raises all its scores.
    """
    queries, borders = run.query_frames, run.borders
    chosen = torch.arange(0, len(queries), -(-len(queries) // cells))
    block = -(-(len(borders) - 1) // cells)
    parts = [-max_pool1d(-_scaled(part), block, ceil_mode=True) for _, part in _score_rows(run, chosen)]
    values = torch.cat(parts)
    if values.isinf().all():
        return {}
    figure, axis = plots.canvas(3.8)
    x = torch.cat([queries[chosen], queries[-1:] + 1])
    image = _show_scores(axis, run, x, torch.cat([borders[:-1:block], borders[-1:]]), values)
    bar = figure.colorbar(image, ax=axis, pad=0.01, aspect=30, ticks=[0, 1], label="score of the query")
    bar.ax.set_yticklabels(["best", "median"])
    handles, names = axis.get_legend_handles_labels()
    plots.legend(figure, handles, names, ncols=len(names), markerscale=4)
    shown = []
    if len(chosen) < len(queries):
        shown.append(f"{len(chosen)} of {len(queries)} queries")
    if block > 1:
        shown.append(f"the best of every {block} neighbouring places")
    return plots.picture("scores", (figure, axis), drawn="; ".join(shown), sequence=run.sequence)


def _score_rows(run: Localization, indices: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Indices of queries and their scores at all places, a few rows of Q x N at a time."""
    for part in indices.split(max(1, BLOCK_SCORES // (len(run.borders) - 1))):
        yield part, run.scores(part)


def _scaled(scores: Tensor) -> Tensor:
    """Scores scaled for each query: its best to 0, its median and all above to 1; uncovered stays +inf."""
    uncovered, best = scores.isinf(), scores.amin(1, keepdim=True)
    median = scores.masked_fill(uncovered, torch.nan).nanmedian(1, keepdim=True).values
    scaled = ((scores - best) / (median - best).clamp(min=1e-12)).clamp(max=1)
    return scaled.masked_fill(uncovered, torch.inf)


def _show_scores(axis: Any, run: Localization, x: Tensor, y: Tensor, values: Tensor) -> Any:
    """Draw scores (h,w) between the frames x (h+1,) and y (w+1,), with the reported and right places."""
    axis.set_facecolor(plots.GREY)  # uncovered places
    values = values.masked_fill(values.isinf(), torch.nan)
    x, y = x - 0.5, y - 0.5
    image = axis.pcolorfast(x.numpy(), y.numpy(), values.T.numpy(), cmap="gray", vmin=0, vmax=1)
    index, queries = run.scored.index, run.query_frames
    found = index >= 0
    style: Facts = {"color": COLOURS["map"], "markersize": 2, "label": "reported place"}
    axis.plot(queries[found], run.borders[index[found]], ".", **style)
    if run.truth is not None:
        style = {"color": plots.RIGHT, "linewidth": 1, "dashes": (4, 4)}
        axis.plot(queries, _right_frames(run.truth, run.borders), **style)
        axis.plot([], [], label="right place", **style)
    axis.set(xlim=x[[0, -1]].tolist(), ylim=y[[0, -1]].tolist(), xlabel=plots.QUERY, ylabel=plots.PLACE)
    return image


def _right_frames(truth: GroundTruth, borders: Tensor) -> Tensor:
    """(Q,R) frames of some right places of each query, padded with NaN."""
    known = truth.judged[:, None] & (truth.positives >= 0)
    right = torch.where(known, look_up(borders, truth.positives), torch.nan)
    return right[:, :: max(1, right.shape[1] // LINES)]


def draw_posterior(run: Localization, cells: int = PIXELS) -> plots.Pictures:
    """The probabilities of all places after each query, by a filter; empty without one.

    Convention: the highest probability in each of at most `cells` blocks of queries and places is drawn.
    """
    if not isinstance(run.sequence, PlaceFilter):
        return {}
    queries, borders, truth = run.query_frames, run.borders, run.truth
    block, width = -(-len(queries) // cells), -(-(len(borders) - 1) // cells)
    x = torch.cat([queries[::block], queries[-1:] + 1]) - 0.5
    y = torch.cat([borders[:-1:width], borders[-1:]]) - 0.5
    values, off, state = torch.zeros(len(x) - 1, len(y) - 1), torch.zeros(len(queries)), None
    for indices, scores in _score_rows(run, torch.arange(len(queries))):
        with torch.no_grad():
            posterior, state = run.sequence.followed(scores, state)
        off[indices] = posterior[:, -1]
        pooled = max_pool1d(posterior[:, :-1], width, ceil_mode=True)
        values.scatter_reduce_(0, (indices // block)[:, None].expand_as(pooled), pooled, "amax")
    figure, (axis, below) = plots.canvas(5.2, 2, sharex=True, height_ratios=(4, 1))
    shown, norm = values.T.clamp(MIN_PROBABILITY, 1).numpy(), LogNorm(MIN_PROBABILITY, 1)
    image = axis.pcolorfast(x.numpy(), y.numpy(), shown, cmap="gray_r", norm=norm)
    figure.colorbar(image, ax=axis, pad=0.01, aspect=30, label="probability of a place")
    below.plot(queries, off, color=COLOURS["map"], linewidth=1)
    if truth is not None:
        right, some = _right_frames(truth, borders), slice(None, None, -(-len(queries) // MARKS))
        style = {"color": plots.RIGHT, "markersize": 5, "markerfacecolor": "none", "clip_on": False}
        axis.plot(queries[some], right[some], "o", **style)
        plots.legend(figure, axis.lines[:1], ["right place"])
        off_map = truth.judged & right.isnan().all(1)
        if off_map.any():
            style = {"step": "mid", "color": plots.GREY, "linewidth": 0}
            below.fill_between(queries, 0, 1, where=off_map.numpy(), **style)
    axis.set(xlim=x[[0, -1]].tolist(), ylim=y[[0, -1]].tolist(), ylabel=plots.PLACE)
    below.set(ylim=(0, 1), xlabel=plots.QUERY, ylabel="off the map")
    return plots.picture("posterior", (figure, (axis, below)), truth=truth, queries=block, places=width)
