"""Draw the pictures of docs from kept json files: `python -m benchmarks.pictures`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.measure import Row
from benchmarks.plots import plot_growth, plot_visits, wide
from benchmarks.scale_report import KEYS, MEMORY, RECALL, pictured
from benchmarks.tables import DOCS, by_seeds, read, reports
from benchmarks.visits import curves
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.plots import Plot, legend, set_title

Points = list[tuple[float, float]]  # route bytes per place, recall@1; without bytes, a single one is a level
WAYS = {
    **{
        "map": "this map",
        "null": "its frames shuffled",
        "product_quantiser": "quantiser, every k-th",
    },
    **{"uncompressed": "float32", "hog": "HOG"},
}


def recalls() -> dict[str, dict[str, Points]]:
    """Recall@1 over bytes: route -> way -> points."""

    def figures(row: Row) -> list[float]:
        curves = [point["recall_at_1"] for way in ("map", "null") for point in row["storage"][way]]
        known = [row[way]["recall_at_1"] for way in ("product_quantiser", "uncompressed", "hog")]
        return [*curves, *known, row["product_quantiser"]["route_bytes"] / row["frames"]]

    panels: dict[str, dict[str, Points]] = {}
    for name, means in by_seeds(reports("default"), figures):
        found = [one or 0.0 for one in means]
        sizes = [1, 2.5, 5, 10, 20, 1, 2.5, 5, 10, 20, found[-1], 0, 0]
        points = [*zip(sizes, found[:-1], strict=True)]
        parts = (points[:5], points[5:10], *([one] for one in points[10:]))
        panels[name.strip("`")] = dict(zip(WAYS, parts, strict=True))
    demo = panels.setdefault("road of the demo", {})
    for row in read("front")["rows"]:
        if row["contender"] in WAYS:
            size = 0 if row["contender"] == "uncompressed" else row["bytes_per_place"]
            demo.setdefault(row["contender"], []).append((size, row["one_image"]))
    return panels


def plot_recalls(panels: Mapping[str, Mapping[str, Points]]) -> Plot:
    """A panel for each route, and the legend in the last two."""
    rows = -(-(len(panels) + 2) // 4)
    figure, axes = wide(1.5 * rows, rows, 4, sharex=True, sharey=True)
    drawn: dict[str, Any] = {}
    for axis, (title, lines) in zip(axes.flat, panels.items(), strict=False):
        for way, points in lines.items():
            x, y = zip(*points, strict=True)
            style = {"color": COLOURS[way], "linewidth": 1.2, "markersize": 3}
            if x == (0,):
                drawn[way] = axis.axhline(*y, linestyle=":" if way == "hog" else "--", **style)
            else:
                (drawn[way],) = axis.plot(x, y, "s-" if way == "product_quantiser" else "o-", **style)
        set_title(axis, title)
        axis.grid(alpha=0.25)
    axes[0, 0].set(xscale="log", xlim=(0.2, 30), ylim=(0, 1.03), yticks=[0, 0.5, 1])
    axes[0, 0].set_xticks([0.25, 1, 4, 16], ["¼", "1", "4", "16"])
    for axis in axes.flat:
        axis.minorticks_off()
    for axis in axes.flat[len(panels) :]:
        axis.axis("off")
    for axis in axes.flat[len(panels) - 4 : len(panels)]:
        axis.tick_params(labelbottom=True)
    figure.supylabel("recall@1 of one image", fontsize=9)
    figure.supxlabel("route bytes per place", fontsize=9)
    legend(axes.flat[-2], [drawn[way] for way in WAYS], [*WAYS.values()], loc="center left")
    axes.flat[-2].get_legend().set_in_layout(False)  # it is wider than a panel
    return figure, axes


def growth() -> dict[str, dict[str, Points]]:
    """Recall@1 and memory over the number of places."""
    panels = pictured([dict.fromkeys(KEYS) | row for row in read("scale")["rows"]])
    return {heading: panels[heading] for heading in (RECALL, MEMORY)}


def main() -> None:
    plot_recalls(recalls())[0].savefig(DOCS / "bytes.png")
    plot_growth(growth(), linear=[RECALL])[0].savefig(DOCS / "scale.png")
    plot_visits(curves(read("visits")["rows"]))[0].savefig(DOCS / "visits.png")


if __name__ == "__main__":
    main()
