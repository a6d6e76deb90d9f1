"""Pictures of a spectral map: the lines that it keeps; each returns (figure, axes)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from torch import Tensor

from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.plots import DARK, GREY, Plot, canvas

FAINTEST = 0.02  # of a step: what is below is drawn there


class Lines(NamedTuple):
    """The spectrum of one number of the descriptor.

    amplitudes: (n,) of its lines, without their signs. kept: (n,) bool, those that the map holds.
    """

    amplitudes: Tensor
    kept: Tensor


def plot_spectrum(features: Mapping[int, Lines], periods: Tensor, step: float, unit: str) -> Plot:
    """Spectra of numbers of the descriptor, a row each, with the lines kept (figure 3 of the paper)."""
    figure, axes = canvas(1.1 + 1.15 * len(features), len(features), squeeze=False, sharex=True, sharey=True)
    for axis, (feature, (amplitudes, kept)) in zip(axes[:, 0], features.items(), strict=True):
        size = (amplitudes / step).clamp(min=FAINTEST)
        axis.plot(periods[~kept], size[~kept], ".", color=GREY, markersize=2, label="coded as 0")
        axis.vlines(periods[kept], FAINTEST, size[kept], color=COLOURS["map"], linewidth=0.5, alpha=0.5)
        axis.plot(periods[kept], size[kept], ".", color=COLOURS["map"], markersize=3.5, label="kept")
        axis.axhline(1, color=DARK, linewidth=0.9, linestyle="--", label="step")
        share = float(amplitudes[kept].square().sum() / amplitudes.square().sum().clamp(min=1e-30))
        text = f"feature {feature}: {int(kept.sum())} of {len(kept)} lines, {100 * share:.0f} % of the energy"
        axis.set_title(text, loc="left", fontsize=9)
    low, high = float(periods.min()), float(periods.max())
    axis.set_xscale("log")
    ticks = [4**k for k in range(20) if low <= 4**k <= high]
    axis.set_xticks(ticks, [str(tick) for tick in ticks])
    axis.set_yscale("log")
    largest = max(float(lines.amplitudes.max()) for lines in features.values()) / step
    sizes = [10.0**k for k in range(-1, 20) if 10.0**k <= max(largest, 1)]
    axis.set_yticks(sizes, [f"{size:g}" for size in sizes])
    axis.minorticks_off()
    axis.set(xlim=(low / 1.05, high * 1.15), xlabel=f"period ({unit})")
    axis.set_ylim(bottom=FAINTEST)
    figure.supylabel("size of a line (steps)", fontsize=10)
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, ncols=3, frameon=False, loc="outside lower right", markerscale=3)
    return figure, axes[:, 0]
