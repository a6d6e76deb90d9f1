"""Pictures of the benchmarks; each returns (figure, axes)."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from textwrap import fill
from types import MappingProxyType
from typing import Any

from matplotlib.figure import Figure

from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.plots import GREY, LETTERS, LINE, Plot, canvas, label, legend, set_title
from dejavu_torch.evaluation.score_plots import area_axis, drawn_areas

OURS = COLOURS["map"]
RATIO = "time over that of our fastest; less is better"
# colours of the families in `plot_growth`
_GROWTH = {
    "dejavu": ("#5aa9d6", "#00406b", OURS),
    "null": (COLOURS["null"], COLOURS["null_same_plan"], GREY),
}
_OTHERS = ("#222222", "#e07b00", "#c21f0a", "#10b248", "#b43cff", "#f2b80f", "#7a4a1f")
FAMILIES = {  # colours and lines in `plot_frontiers`
    "dejavu": (OURS, "-"),
    "dejavu, given maps": ("#00406b", "--"),
    "null": (COLOURS["null"], ":"),
    "frames": (COLOURS["stride"], "-"),
    "interpolated": (COLOURS["interpolated"], "-"),
    "PCA": ("#10b248", "-"),
    "binary": ("#785567", "-"),
    "PQ": ("#c21f0a", "-"),
    "OPQ": ("#c21f0a", "--"),
    "RQ": ("#e07b00", "-"),
    "LSQ": ("#e07b00", "--"),
    "PRQ": ("#e07b00", ":"),
    "PQ, own codebooks": ("#f28e6b", "-"),
    "OPQ, own codebooks": ("#f28e6b", "--"),
    "TurboQuant": ("#b43cff", "-"),
    "RaBitQ": ("#7a4a1f", "-"),
    "EDEN": ("#7a4a1f", ":"),
    "video": ("#56b4e9", "-"),
    "HOG": (COLOURS["hog"], "--"),
    "the paper": (COLOURS["paper"], "-"),
}


def plot_ratios(cases: Mapping[str, Mapping[str, float]], label: str = RATIO) -> Plot:
    """A bar for each contender of each case: its time over ours unless `label` says otherwise."""
    bars = [len(ratios) for ratios in cases.values()]
    height = 0.5 + 0.42 * sum(bars) + 0.5 * len(bars)
    figure, axes = canvas(height, len(bars), squeeze=False, height_ratios=bars)
    for axis, (case, ratios) in zip(axes[:, 0], cases.items(), strict=True):
        colours = [OURS if name.startswith("dejavu") else COLOURS.get(name, GREY) for name in ratios]
        drawn = axis.barh(range(len(ratios)), list(ratios.values()), color=colours, height=0.42)
        for row, name in enumerate(ratios):
            axis.text(0, row - 0.24, fill(name, LETTERS), fontsize=9, va="bottom")
        axis.bar_label(drawn, [f"{ratio:.1f}" for ratio in ratios.values()], padding=3, fontsize=9)
        if label == RATIO:
            axis.axvline(1, color=OURS, linewidth=0.8, linestyle=":")
        set_title(axis, fill(case, LETTERS))
        axis.set(xlim=(0, 1.15 * max(ratios.values())), ylim=(len(ratios) - 0.6, -0.8), yticks=[])
    axes[-1, 0].set_xlabel(label)
    return figure, axes[:, 0]


def plot_areas(cases: Mapping[str, Mapping[str, float]], kinds: Mapping[str, str]) -> Plot:
    """Areas of contenders, a row for each case.

    Args:
        kinds: colours by the beginning of a name; the rest of the name gives the marker.
    """
    figure, axis = canvas(1.2 + 0.3 * len(kinds) + 0.5 * len(cases))
    marks: dict[str, str] = {}
    for row, areas in enumerate(cases.values()):
        for name, area in areas.items():
            kind = next(kind for kind in kinds if name.startswith(kind))
            mark = marks.setdefault(name.removeprefix(kind).strip(), "Dsov^"[len(marks) % 5])
            axis.plot(area, row, mark, color=kinds[kind], markersize=7, alpha=0.8)
    for name, mark in marks.items():
        if name:
            axis.plot([], [], mark, color=GREY, label=name)
    for kind, colour in kinds.items():
        axis.plot([], [], "-", color=colour, linewidth=4, label=kind)
    axis.set(yticks=range(len(cases)), yticklabels=[fill(case, 18) for case in cases], xlim=(-0.02, 1.02))
    axis.set_ylim(len(cases) - 0.5, -0.5)
    axis.grid(axis="x", alpha=0.25)
    axis.set_xlabel("AUC, mean of the seeds")
    legend(figure, *axis.get_legend_handles_labels(), ncols=2)
    return figure, axis


def plot_visits(cases: Mapping[str, Mapping[str, Sequence[float]]]) -> Plot:
    """The AUC after 0, 1, .. drives, a panel for each case, "WHAT asked", a line for each way to learn."""
    figure, axes = wide(2.3, 1, len(cases))
    most = max(len(areas) for ways in cases.values() for areas in ways.values())
    drawn: dict[str, Any] = {}
    for axis, (case, ways) in zip(axes.flat, cases.items(), strict=False):
        for (way, areas), style in zip(ways.items(), ("o-", "s--"), strict=True):
            colour = OURS if style == "o-" else COLOURS["hog"]
            (drawn[way],) = axis.plot(range(len(areas)), areas, style, color=colour, markersize=5)
        low, high = min(map(min, ways.values())), max(map(max, ways.values()))
        axis.set_ylim(min(low - 0.03, high - 0.2), min(high + 0.03, 1.005))
        set_title(axis, label(case.removesuffix(" asked")))
        axis.set_xticks(range(most))
        axis.set_xlabel("drives that taught", fontsize=9)
        axis.grid(alpha=0.25)
    axes[0, 0].set_ylabel("AUC, one image", fontsize=9)
    legend(figure, [*drawn.values()], [*drawn], ncols=2)
    return figure, axes


def plot_growth(
    panels: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]], linear: Collection[str] = ()
) -> Plot:
    """Lines of contenders over the number of places, both axes logarithmic, two panels beside each other.

    Args:
        panels: heading -> contender -> points (places, figure). The part of a name before the first comma is
            the family, which gives the colour; those that start with "dejavu" are ours.
        linear: panels of shares from 0 to 1.
    """
    names = list(dict.fromkeys(name for lines in panels.values() for name in lines))
    styles = _growth_styles(names)
    rows = math.ceil(len(panels) / 2)
    figure, axes = wide(2.4 * rows + 1.1 * LINE * math.ceil(len(names) / 4), rows, 2)
    drawn = {}
    for axis, (heading, lines) in zip(axes.flat, panels.items(), strict=False):
        for name, points in lines.items():
            drawn[name] = axis.plot(*zip(*points, strict=True), **styles[name])[0]
        axis.set(xscale="log", xlabel="places")
        if heading in linear:
            axis.set_ylim(0, 1.02)
        else:
            axis.set_yscale("log")
        set_title(axis, heading)
        axis.grid(alpha=0.25)
    for axis in axes.flat[len(panels) :]:
        axis.axis("off")
    legend(figure, [drawn[name] for name in names], names, ncols=4)
    return figure, axes.flat[: len(panels)]


def wide(height: float, rows: int, columns: int, **grid: Any) -> Plot:
    """A figure for pages, with empty axes: as wide as two of a report."""
    figure = Figure(figsize=(7.2, height), layout="constrained", dpi=160)
    axes = figure.subplots(rows, columns, squeeze=False, **grid)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _growth_styles(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """A style for each contender: a colour of its family, a marker and a line of its own."""
    colours: dict[str, str] = {}
    members: Counter[str] = Counter()
    styles = {}
    for name in names:
        family = name.partition(",")[0]
        if family not in colours:
            among = _GROWTH.get(family.partition(" ")[0], _OTHERS)
            used = sum(colour in among for colour in colours.values())
            colours[family] = among[used % len(among)]
        order = members[family]
        members[family] += 1
        styles[name] = {
            "color": colours[family],
            "marker": "os^Dv"[order % 5],
            "markerfacecolor": colours[family] if order % 2 == 0 else "white",
            "markersize": 4,
            "linestyle": ":" if family.startswith("null") else ("-", "--", "-.")[order % 3],
            "linewidth": 1.6 if family.startswith("dejavu") else 1.2,
        }
    return styles


def plot_frontiers(
    cases: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]],
    whitenings: Mapping[str, Sequence[tuple[str, int, float]]] = MappingProxyType({}),
) -> Plot:
    """The largest AUC of each family of stores over route bytes per place, a panel for each route.

    Convention: areas are clipped to `LOWEST` and `HIGHEST`.

    Args:
        cases: case -> family -> bytes per place and area, ascending.
        whitenings: case -> name, fixed bytes and area of a map by each, in a panel below that of the case.
    """
    names = list(dict.fromkeys(name for families in cases.values() for name in families))
    panels = [share for case in cases for share in ([1.0, 0.6] if case in whitenings else [1.0])]
    height = 3.0 * sum(panels) + 1.1 * LINE * math.ceil(len(names) / 2)
    figure, axes = canvas(height, len(panels), squeeze=False, height_ratios=panels)
    column = iter(axes[:, 0])
    shown = []
    for case, families in cases.items():
        axis = next(column)
        shown.append(axis)
        for name, points in reversed(list(families.items())):  # ours, the first, on top
            colour, line = FAMILIES.get(name) or FAMILIES.get(name.partition(",")[0], (GREY, "-"))
            ours = name.startswith("dejavu")
            style = {"color": colour, "linestyle": line, "linewidth": 3 if ours else 1.4}
            sizes, areas = zip(*points, strict=True)
            axis.plot(sizes, drawn_areas(areas), marker="o", markersize=5 if ours else 3, label=name, **style)
        axis.set_xscale("log")
        ticks = [0.5, 1, 2, 5, 10, 20, 50, 200]
        axis.set_xlim(0.4, 1.2 * max([50.0, *(size for points in families.values() for size, _ in points)]))
        axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.minorticks_off()
        area_axis(axis)
        title = re.sub(r"[^ :]*/", "", case)  # sources without their folders
        set_title(axis, fill(label(title), LETTERS - 10))
        axis.set_xlabel("route bytes per place")
        if case in whitenings:
            _plot_whitenings(next(column), whitenings[case])
    lines = {text: h for a in shown for h, text in zip(*a.get_legend_handles_labels(), strict=True)}
    handles = [lines[name] for name in names]
    legend(figure, handles, names, ncols=2)
    return figure, axes[:, 0]


def _plot_whitenings(axis: Any, whitenings: Sequence[tuple[str, int, float]]) -> None:
    """The AUC of a map with each whitening, with its name and bytes, the largest on top."""
    ordered = sorted(whitenings, key=lambda one: one[1])
    areas = [area for _, _, area in ordered]
    axis.scatter(areas, range(len(ordered)), color=OURS)
    for row, (name, size, _) in enumerate(ordered):
        text = f"{name}, {size / 1000:.0f} kB"
        axis.text(0.01, row, text, transform=axis.get_yaxis_transform(), va="center", fontsize=9)
    reach = max(max(areas) - min(areas), 0.01)
    axis.set_xlim(min(areas) - 1.2 * reach, max(areas) + 0.1 * reach)  # names in the left half
    axis.locator_params(axis="x", nbins=5)
    axis.set(ylim=(-0.6, len(ordered) - 0.4), yticks=[], xlabel="AUC of the map, by whitening")
    axis.grid(alpha=0.25)
