"""Draw the pictures of docs/results from kept json files: `python -m benchmarks.pictures`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from benchmarks.measure import Row
from benchmarks.plots import growth_styles
from benchmarks.tables import DOCS, by_seeds, read, reports
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.plots import Plot, legend, set_title

Lines = Mapping[str, Sequence[tuple[float, float]]]  # way -> points (x, y); a single one at 0 is a level
CURVES = {"map": "this map", "null": "its frames shuffled"}
WAYS = CURVES | {"product_quantiser": "product quantiser", "uncompressed": "float32", "hog": "HOG"}
BUDGETS = (1, 2.5, 5, 10, 20)  # of the curves in a report


def recall_over_bytes() -> dict[str, Lines]:
    """Recall@1 over route bytes per place, for each route."""

    def figures(row: Row) -> list[float]:
        curves = [point["recall_at_1"] for way in CURVES for point in row["storage"][way]]
        quantised = row["product_quantiser"]
        sized = [quantised["route_bytes"] / row["frames"], quantised["recall_at_1"]]
        return [*curves, *sized, row["uncompressed"]["recall_at_1"], row["hog"]["recall_at_1"]]

    panels: dict[str, Lines] = {}
    for name, found in by_seeds(reports("default"), figures):
        means = [one or 0.0 for one in found]
        curves = {way: [*zip(BUDGETS, means[5 * i :], strict=False)] for i, way in enumerate(CURVES)}
        size, quantised, exact, hog = means[10:]
        levels = {"uncompressed": [(0.0, exact)], "hog": [(0.0, hog)]}
        panels[name.strip("`")] = {**curves, "product_quantiser": [(size, quantised)], **levels}
    demo: dict[str, list[tuple[float, float]]] = {}
    for row in read("front")["rows"]:
        if row["contender"] in WAYS:
            demo.setdefault(row["contender"], []).append((row["bytes_per_place"], row["one_image"]))
    panels["road of the demo"] = demo | {"uncompressed": [(0.0, demo["uncompressed"][0][1])]}
    return panels


def plot_recall(panels: Mapping[str, Lines]) -> Plot:
    """A panel for each route, and the legend in the last ones."""
    figure = Figure(figsize=(7.2, 1.5 * -(-(len(panels) + 2) // 4)), layout="constrained", dpi=160)
    axes = figure.subplots(-(-(len(panels) + 2) // 4), 4, squeeze=False, sharex=True, sharey=True)
    drawn: dict[str, Any] = {}
    for axis, (title, lines) in zip(axes.flat, panels.items(), strict=False):
        for way, points in lines.items():
            x, y = zip(*points, strict=True)
            if x == (0.0,):
                mark: Any = axis.axhline(y[0], color=COLOURS[way], linestyle=":" if way == "hog" else "--")
            else:
                (mark,) = axis.plot(x, y, "s-" if way == "product_quantiser" else "o-", color=COLOURS[way])
                mark.set_markersize(3)
            mark.set_linewidth(1.2)
            drawn[way] = mark
        set_title(axis, title)
    axes[0, 0].set(xscale="log", xlim=(0.2, 30), ylim=(0, 1.03), yticks=[0, 0.5, 1])
    axes[0, 0].set_xticks([0.25, 1, 4, 16], ["¼", "1", "4", "16"])
    for axis in axes.flat:
        axis.minorticks_off()
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25)
    for axis in axes.flat[len(panels) :]:
        axis.axis("off")
    for axis in axes.flat[len(panels) - 4 : len(panels)]:
        axis.tick_params(labelbottom=True)
    figure.supylabel("recall@1 of one image", fontsize=9)
    figure.supxlabel("route bytes per place", fontsize=9)
    legend(axes.flat[-2], [drawn[way] for way in WAYS], [*WAYS.values()], loc="center left")
    axes.flat[-2].get_legend().set_in_layout(False)  # it is wider than a panel
    return figure, axes


def growth() -> dict[str, Lines]:
    """Recall@1, and memory while localizing, over the number of places."""
    panels: dict[str, dict[str, list[tuple[float, float]]]] = {"recall@1": {}, "MB of memory": {}}
    for row in read("scale")["rows"]:
        figures = row.get("recall_at_1"), row.get("peak_bytes", 0) / 1e6
        for lines, figure in zip(panels.values(), figures, strict=True):
            if figure:
                lines.setdefault(row["contender"], []).append((row["places"], figure))
    return dict(panels)


def plot_scale(panels: Mapping[str, Lines]) -> Plot:
    """The panels side by side, with the legend beside them."""
    figure = Figure(figsize=(7.2, 2.8), layout="constrained", dpi=160)
    axes = figure.subplots(1, len(panels))
    for axis, (title, lines) in zip(axes, panels.items(), strict=True):
        for name, style in growth_styles([*lines]).items():
            axis.plot(*zip(*lines[name], strict=True), label=called(name), **style | {"markersize": 4})
        axis.set(xscale="log", xlabel="places")
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25)
        set_title(axis, title)
    axes[0].set_ylim(0.5, 1.02)
    axes[1].set_yscale("log")
    legend(figure, *axes[0].get_legend_handles_labels(), loc="outside right upper")
    return figure, axes


def called(contender: str) -> str:
    """A contender of `benchmarks scale` as readers know it."""
    known = {"dejavu": "this map,", "null": "shuffled,", "faiss flat": "float32, 512 B", "faiss ": ""}
    for name, words in known.items():
        contender = contender.replace(name, words)
    return contender


def main() -> None:
    plot_recall(recall_over_bytes())[0].savefig(DOCS / "bytes.png")
    plot_scale(growth())[0].savefig(DOCS / "scale.png")


if __name__ == "__main__":
    main()
