"""A picture of who takes how long."""

from __future__ import annotations

from collections.abc import Mapping

from dejavu_torch.evaluation.plots import BLUE, GREY, Plot, canvas


def plot_ratios(cases: Mapping[str, Mapping[str, float]]) -> Plot:
    """Time of each contender over ours, one bar each, one group for each case.

    Args:
        cases: at least one: case -> contender -> ratio. Names that start with "dejavu" are ours.
    """
    bars = [len(ratios) for ratios in cases.values()]
    figure, axes = canvas(
        0.5 + 0.3 * sum(bars) + 0.5 * len(bars), len(bars), squeeze=False, height_ratios=bars
    )
    for axis, (case, ratios) in zip(axes[:, 0], cases.items(), strict=True):
        colours = [BLUE if name.startswith("dejavu") else GREY for name in ratios]
        drawn = axis.barh(list(ratios), list(ratios.values()), color=colours, height=0.7)
        axis.bar_label(drawn, [f"{ratio:.1f}" for ratio in ratios.values()], padding=3, fontsize=9)
        axis.axvline(1, color=BLUE, linewidth=0.8, linestyle=":")
        axis.set_title(case, loc="left", fontsize=10)
        axis.set_xlim(0, 1.12 * max(ratios.values()))
        axis.invert_yaxis()
        axis.tick_params(labelsize=9)
    axes[-1, 0].set_xlabel("time over that of our fastest (lower is better)")
    return figure, axes[:, 0]
