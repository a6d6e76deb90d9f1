from __future__ import annotations

import io
from fractions import Fraction

import pytest
import torch

from dejavu_torch.evaluation.plots import Plot
from dejavu_torch.evaluation.route_plots import (
    Length,
    plot_autocorrelogram,
    plot_frames,
    plot_layers,
    plot_lengths,
)
from dejavu_torch.types import FrequencyLayer


def assert_drawn(plot: Plot) -> None:
    buffer = io.BytesIO()
    plot[0].savefig(buffer, format="png")
    assert buffer.tell() > 5000


def test_a_feature_that_repeats_is_like_itself_a_period_later() -> None:
    wave = torch.sin(torch.arange(600) * 2 * torch.pi / 50)
    plot = plot_autocorrelogram(wave, [50.0])
    assert_drawn(plot)
    line = plot[1].lines[0].get_ydata()
    assert line[0] == pytest.approx(1)
    assert line[50] == pytest.approx(550 / 600, abs=0.01)  # biased: as many frames less
    assert line[25] == pytest.approx(-575 / 600, abs=0.01)


def test_a_constant_feature_has_no_autocorrelation() -> None:
    line = plot_autocorrelogram(torch.ones(64), [])[1].lines[0].get_ydata()
    assert torch.tensor(line).isfinite().all()


def test_layers_show_their_phases() -> None:
    layers = [FrequencyLayer(Fraction(tau), tau, 20, 80, tuple(range(tau))) for tau in range(5, 20)]
    plot = plot_layers(layers)
    assert_drawn(plot)
    shown = plot[1].images[0].get_array()
    assert shown.shape == (12, 60)  # the twelve of most features
    assert shown[0].tolist() == pytest.approx([(i % 8) / 8 for i in range(20, 80)])


@pytest.mark.parametrize(("channels", "height", "width"), [(1, 32, 32), (3, 32, 64), (3, 20, 100)])
def test_frames_of_any_shape(channels: int, height: int, width: int) -> None:
    frames = torch.rand(4, channels, height, width)
    assert_drawn(plot_frames(frames, 1 - frames, [1, 5, 9, 13]))


def test_recall_and_bytes_over_the_length_of_a_chunk() -> None:
    rows = [Length(256, 0.8, 0.7, 0.85, 4000, 40.0), Length(512, 0.9, 0.8, 0.95, 3000, 30.0)]
    plot = plot_lengths({"aerial": rows, "nothing": []})
    assert_drawn(plot)
    comparable, printed, *_ = (list(line.get_ydata()) for line in plot[1][0].lines)
    assert (comparable, printed) == ([0.85, 0.95], [0.8, 0.9])
    assert list(plot[1][1].lines[0].get_ydata()) == [40.0, 30.0]
