"""Pictures of an area: where queries were found, and what one of them looks like everywhere."""

from __future__ import annotations

import torch
from matplotlib.transforms import Affine2D

from dejavu_torch.evaluation import plots
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.localization import Localization, faults
from dejavu_torch.motion.resampling import source_of
from dejavu_torch.types import Facts

LONG = 1e5
LOWEST, HIGHEST = 0.3, 1.5  # height of a picture, relative to its width; axes of other areas are not equal


def draw_area(run: Localization) -> plots.Pictures:
    """The places reported for the queries, on the ground; lines lead to wrong ones from where they are."""
    layout, match = run.model.map.layout, run.scored
    found = match.index >= 0
    at = layout.coordinates(match.index.clamp(min=0))
    known = source_of(run.query).coordinates
    own = None if known is None else known.values[run.query_frames, :2]
    figure, axis = _ground(run)
    if run.truth is None:
        groups = [
            (found & ~match.accepted, plots.GREY, "not accepted"),
            (found & match.accepted, COLOURS["map"], "accepted"),
        ]
    else:
        scored, wrong = faults(match, run.truth, run.tolerance)
        right = scored & ~wrong
        groups = [
            (right & ~match.accepted, plots.PALE_RIGHT, "right, not accepted"),
            (right & match.accepted, plots.RIGHT, "right, accepted"),
            (wrong & ~match.accepted, plots.PALE_WRONG, "wrong, not accepted"),
            (wrong & match.accepted, plots.WRONG, "wrong, accepted"),
        ]
        if own is not None:
            ends = torch.stack([own, at], 1)[wrong & match.accepted]
            axis.plot(*ends.permute(2, 1, 0), color=plots.WRONG, linewidth=0.4, alpha=0.5)
    for which, colour, name in groups:
        if which.any():
            size = 6 if "wrong" in name else 3
            axis.plot(*at[which].T, ".", color=colour, markersize=size, label=f"{int(which.sum())} {name}")
    if run.answers == "drive":
        single = run.by_one
        missed = faults(single, run.truth, run.tolerance)[1]
        plots.show_wrong(axis, *layout.coordinates(single.index[missed]).T)
    plots.legend(figure, ncols=2, markerscale=2)
    return plots.picture("coverage", (figure, axis), truth=run.truth, area=True, lines=own is not None)


def draw_heat(run: Localization) -> plots.Pictures:
    """The scores of one query in the middle at all places."""
    layout, query = run.model.map.layout, len(run.query_frames) // 2
    scores = run.scores(torch.tensor([query]))[0]
    if not scores.isfinite().any():
        return {}
    cells = layout.cells(torch.arange(layout.places))
    plane = scores.new_full((layout.rows, layout.columns), torch.nan)
    plane[cells[:, 0], cells[:, 1]] = scores.masked_fill(scores.isinf(), torch.nan)
    figure, axis = _ground(run)
    placed = Affine2D.from_values(*layout.right, *layout.down, *layout.first) + axis.transData
    image = axis.imshow(plane.numpy(), cmap="gray", aspect=axis.get_aspect(), transform=placed)
    plots.colour_bar(figure, image, axis, "score", shrink=0.8)
    index = int(run.scored.index[query])
    style: Facts = {"markerfacecolor": "none", "markersize": 9, "linestyle": "none"}
    if index >= 0:
        place = layout.coordinates(torch.tensor(index))
        axis.plot(*place, "o", color=COLOURS["map"], label="reported place", **style)
    known = source_of(run.query).coordinates
    if known is not None:
        axis.plot(*known.values[run.query_frames[query], :2], "s", color=plots.RIGHT, label="query", **style)
    plots.legend(figure, ncols=2)
    return plots.picture("scores", (figure, axis), area=True, query=int(run.query_frames[query]))


def _ground(run: Localization) -> plots.Plot:
    """Axes with the sides of the area."""
    layout = run.model.map.layout
    ends = torch.tensor([[row, column] for row in (0, layout.rows - 1) for column in (0, layout.columns - 1)])
    corners = layout.coordinates(layout.place_at(ends))
    (left, top), (right, bottom) = corners.amin(0).tolist(), corners.amax(0).tolist()
    if torch.tensor([layout.right, layout.down]).det() < 0:  # y grows upwards, as to the north
        top, bottom = bottom, top
    wide, tall = (max(1e-6, abs(side)) for side in (right - left, bottom - top))
    shape = min(HIGHEST, max(LOWEST, tall / wide))
    figure, axis = plots.canvas(plots.WIDTH * shape + 6 * plots.LINE)
    axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal" if shape == tall / wide else "auto")
    axis.set(xlabel=f"x ({layout.units})", ylabel=f"y ({layout.units})")
    axis.locator_params(axis="x", nbins=4 if corners.amax() >= LONG else "auto")  # numbers of six digits
    return figure, axis
