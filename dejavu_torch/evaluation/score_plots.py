"""Pictures of scores: curves, storage and sequences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from textwrap import fill, wrap
from types import MappingProxyType
from typing import Any, NamedTuple

from dejavu_torch.evaluation.contenders import COLOURS, Contender, colour_of, distinct, sequences_as_json
from dejavu_torch.evaluation.curves import Scores
from dejavu_torch.evaluation.plots import (
    LETTERS,
    LINE,
    Pictures,
    canvas,
    label,
    legend,
    picture,
    set_title,
)
from dejavu_torch.types import Facts, Together

_SHADES = (COLOURS["map"], "#00406b", "#5aa9d6")  # one map on several datasets
MIN_GAIN = 0.001  # of an area
SHOWN = (1.0, 2.5, 5.0)  # route bytes per place at which the map is also drawn
MIN_RATIO = 1.1  # of bytes, between two sizes that are drawn
LOWEST, HIGHEST = 0.01, 0.999  # limits at which areas are drawn
_LINES = {"hog": "--", "null": ":"}  # by the first part of a key


class Stored(NamedTuple):
    """The scores of a route coded at this size; `sequences` as in a `Contender`."""

    route_bytes_per_place: float
    auc: float
    recall_at_1: float
    sequences: Mapping[Together, Scores] = MappingProxyType({})

    def as_json(self) -> Facts:
        """The entry of report.json."""
        entry = self._asdict() | {"sequences": sequences_as_json(self.sequences)}
        return {name: value for name, value in entry.items() if value != {}}


def _style(key: str) -> Facts:
    """The colour and line of a contender, by its key."""
    line = _LINES.get(key.partition("_")[0], "-")
    return {"color": colour_of(key), "linestyle": line, "linewidth": 2.4 if key == "map" else 1.6}


def draw_curves(contenders: Mapping[str, Contender], tolerance: str) -> Pictures:
    """Precision over recall (figures 8 to 10 of the paper)."""
    shown = [
        (key, label(one.name), one.curve)
        for key, one in distinct(contenders).items()
        if one.curve and one.scores and key != "leave_out"  # its queries are others
    ]
    if not shown:
        return {}
    figure, axis = canvas(3.4 + 1.1 * LINE * sum(len(wrap(name, LETTERS - 8)) for _, name, _ in shown))
    for key, name, curve in reversed(shown):  # the first on top
        name += " (reports nothing)" * (len(curve.recall) == 0)
        axis.plot(curve.recall, curve.precision, label=fill(name, LETTERS - 8), **_style(key))
    axis.set(xlim=(0, 1.01), ylim=(0, 1.02), xlabel="recall (of all queries)", ylabel="precision")
    set_title(axis, f"right within {tolerance}")
    axis.grid(alpha=0.25)
    legend(figure, reverse=True)
    return picture("pr", (figure, axis))


def draw_storage(
    contenders: Mapping[str, Contender], storage: Mapping[str, Sequence[Stored]], tolerance: str
) -> Pictures:
    """Areas over bytes; empty without any."""
    names = {
        "map": "this map",
        "null": "null: the same, shuffled",
        "interpolated": "keyframes in int8, interpolated",
    }
    curves = {key: points for key, points in storage.items() if points}
    if not curves:
        return {}
    levels = [
        (key, one.name, one.scores.auc)
        for key, one in contenders.items()
        if key in ("uncompressed", "hog") and one.scores
    ]
    figure, axis = canvas(3.4 + 1.1 * LINE * (len(curves) + len(levels)))
    every = [one.route_bytes_per_place for points in curves.values() for one in points]
    for key, points in curves.items():
        sizes, areas = [one.route_bytes_per_place for one in points], [one.auc for one in points]
        style = _style(key) | {"linestyle": "-", "marker": "o", "markersize": 5}
        axis.plot(sizes, areas, label=names[key], zorder=3, **style)
    for key, name, area in levels:
        axis.axhline(area, label=name, linestyle="--", linewidth=1.2, color=colour_of(key))
    ticks = [2**k for k in range(-6, 20) if min(every) / 1.5 <= 2**k <= 1.5 * max(every)]
    axis.set_xscale("log")
    axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.minorticks_off()
    axis.set(ylim=(0, 1.02), xlabel="route bytes per place", ylabel="area under the PR curve")
    set_title(axis, f"right within {tolerance}")
    axis.grid(alpha=0.25)
    legend(figure)
    factors = [null / ours for ours, null in equally_good(*(storage.get(key, ()) for key in ("map", "null")))]
    numbers: Facts = {key: [one.as_json() for one in points] for key, points in storage.items()}
    numbers["null_over_map"] = factors
    return picture("storage", (figure, axis), numbers, factors=factors)


def draw_sequences(
    contenders: Mapping[str, Contender], coded: Sequence[Stored], places: int, tolerance: str
) -> Pictures:
    """Areas over the number of queries matched together, and of a filter; empty without T > 1.

    The map is also drawn at some of its other sizes, if they differ enough.
    """
    lines = {key: one for key, one in distinct(contenders).items() if one.sequences}
    if not lines:
        return {}
    drawn = [(one.name, one.by_length, _style(key) | {"linewidth": 1.4}) for key, one in lines.items()]
    if "map" in lines and coded:
        own, style = (lines["map"].route_bytes or 0) / places, _style("map")
        drawn[0] = (f"this map, {own:.3g} route bytes per place", lines["map"].by_length, style)
        sizes = [own]
        for budget in SHOWN if coded[0].sequences else ():
            nearest = min(coded, key=lambda size: abs(size.route_bytes_per_place - budget))
            size = nearest.route_bytes_per_place
            if all(max(size, other) > MIN_RATIO * min(size, other) for other in sizes):
                mark = {"marker": "osD^"[len(sizes)], "markerfacecolor": "white", "linewidth": 1.0}
                name = f"the map in {size:.3g} byte{'s' * (f'{size:.3g}' != '1')}"
                drawn.insert(len(sizes), (name, nearest.sequences, style | mark))
                sizes.append(size)
    figure, axis = canvas(3.6 + 1.1 * LINE * sum(len(wrap(name, LETTERS - 8)) for name, *_ in drawn))
    lengths = sorted({T for _, found, _ in drawn for T in found if isinstance(T, int)})
    at: dict[Together, float] = {T: T for T in lengths}
    models: tuple[Together, ...] = "filter", "smoother"
    for model in (one for one in models if any(one in found for _, found, _ in drawn)):
        at[model] = max(at.values()) + max(1, lengths[-1] / 4)
    for name, found, style in reversed(drawn):  # the first on top
        areas = drawn_areas([scores.auc for scores in found.values()])
        style = {"marker": "o", "markersize": 4.5} | style
        axis.plot([at[T] for T in found], areas, label=fill(name, LETTERS - 8), **style)
    axis.set_xticks([*at.values()], [str(T) for T in at])
    area_axis(axis)
    axis.set(xlabel="queries matched together, T")
    set_title(axis, f"right within {tolerance}")
    legend(figure, reverse=True)
    return picture("sequences", (figure, axis))


def equally_good(ours: Sequence[Stored], others: Sequence[Stored]) -> list[tuple[float, float]]:
    """Pairs of our bytes and the bytes at which the others reach the same area, if they do.

    Convention: between two points of the others the area grows with the logarithm of the bytes. A point of
    ours is skipped unless it is better, by more than .001, than all smaller ones.

    Example:
        >>> others = Stored(4, 0.5, 0.5), Stored(16, 0.9, 0.9)
        >>> [(ours, theirs)] = equally_good([Stored(1, 0.7, 0.7), Stored(2, 0.95, 0.95)], others)
        >>> ours, round(theirs, 6)
        (1, 8.0)
    """
    pairs, best = [], -1.0
    for one in ours:
        if one.auc <= best + MIN_GAIN:
            continue
        best = one.auc
        for low, high in pairwise(others):
            if low.auc <= one.auc <= high.auc and low.auc < high.auc:
                share = (one.auc - low.auc) / (high.auc - low.auc)
                sizes = low.route_bytes_per_place, high.route_bytes_per_place
                pairs.append((one.route_bytes_per_place, sizes[0] * (sizes[1] / sizes[0]) ** share))
                break
    return pairs


def drawn_areas(areas: Sequence[float]) -> list[float]:
    """Areas clipped to the range of `area_axis`."""
    return [min(max(area, LOWEST), HIGHEST) for area in areas]


def area_axis(axis: Any) -> None:
    """Make the y axis a logit axis of areas: logarithmic towards 0 and towards 1."""
    axis.set_yscale("logit")
    levels = [LOWEST, 0.1, 0.5, 0.9, 0.99, HIGHEST]
    axis.set_yticks(levels, [f"{level:g}" for level in levels])
    axis.minorticks_off()
    axis.set(ylim=(0.8 * LOWEST, 1 - 0.8 * (1 - HIGHEST)), ylabel="area under the PR curve")
    axis.grid(alpha=0.25)
