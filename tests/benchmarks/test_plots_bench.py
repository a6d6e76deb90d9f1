"""Pictures of the benchmarks."""

from __future__ import annotations

import pytest
from drawn import render, texts
from matplotlib.colors import to_rgb

from benchmarks.plots import plot_growth, plot_ratios
from benchmarks.scale_contenders import CONTENDERS
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.plots import GREY


def test_running_times_are_drawn_in_the_colours_of_the_contenders() -> None:
    _, (axis,) = plot_ratios({"one": {"dejavu (numba)": 1.0, "scipy": 3.0, "uncompressed": 2.0}})
    colours = [bar.get_facecolor()[:3] for bar in axis.patches]
    expected = [COLOURS["map"], GREY, COLOURS["uncompressed"]]
    assert colours == [pytest.approx(to_rgb(colour)) for colour in expected]


def test_every_contender_that_grows_has_a_style_of_its_own() -> None:
    shares = {name: [(1e4, 1.0), (1e5, 0.0)] for name in CONTENDERS}
    figure, axes = plot_growth({"recall@1": shares, "ms": {"dejavu 1 B": [(1e4, 1.0)]}}, ["recall@1"])
    render(figure)
    styles = {(line.get_color(), line.get_marker(), line.get_linestyle()) for line in axes[0].lines}
    assert len(styles) == len(CONTENDERS)
    assert set(CONTENDERS) <= set(texts(figure))
    assert [axis.get_yscale() for axis in axes] == ["linear", "log"]
