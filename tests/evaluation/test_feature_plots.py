"""Pictures of single features, read back from the figures."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from drawn import render, texts
from torch import Tensor

from dejavu_torch import HOG
from dejavu_torch.evaluation.map_plots import (
    edges_seen,
    plot_autocorrelogram,
    plot_features,
    plot_spectrogram,
    plot_templates,
)
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.types import FrequencyLayer


def wave(period: float, frames: int = 256) -> Tensor:
    return torch.sin(torch.arange(frames) * 2 * torch.pi / period)


@pytest.mark.parametrize("hop", [None, 64])
def test_spectrogram_is_darkest_at_the_period(hop: int | None) -> None:
    values = torch.cat([wave(32), wave(16)])
    spectra = SpectrogramAnalysis(window=256, hop=hop)(values[:, None])
    figure, (above, below) = plot_spectrogram(
        values, spectra, [[32.0]] * len(spectra), 8, 7, torch.arange(513), "frames"
    )
    assert above.lines[0].get_ydata().tolist() == values.tolist()
    for mesh, period in zip((below.collections[0], below.collections[-1]), (32, 16), strict=True):
        borders = mesh.get_coordinates()[:, 0, 1]
        power = mesh.get_array().ravel()
        assert borders[power.argmax()] > period > borders[power.argmax() + 1]
        assert power.max() == pytest.approx(100 * 2 / 3, rel=1e-3)  # what a pure wave holds under Hann
    starts = [float(mesh.get_coordinates()[0, 0, 0]) for mesh in below.collections]
    assert starts == [start for start, _, _ in spectra]
    assert "feature 7 through time" in texts(figure)


def test_spectrogram_of_a_long_or_constant_feature() -> None:
    values = wave(32, 9000)
    analysis = SpectrogramAnalysis(window=1024)
    _, (above, _) = plot_spectrogram(
        values, analysis(values[:, None]), [[]] * 9, 2, 0, torch.arange(9001), "frames"
    )
    extremes = above.collections[0].get_datalim(above.transData)
    assert extremes.y0 == pytest.approx(-1, abs=1e-3)
    assert extremes.y1 == pytest.approx(1, abs=1e-3)
    flat = torch.ones(64)
    spectra = SpectrogramAnalysis(window=64)(flat[:, None])
    figure, _ = plot_spectrogram(flat, spectra, [[]], 2, 0, torch.arange(65), "frames")
    render(figure)


def test_templates_lie_over_the_frames_they_are_the_mean_of() -> None:
    one = FrequencyLayer(Fraction(5), 5, 3, 15, (4, 9))
    values = torch.arange(3, 15).remainder(5).float()  # the phase itself
    templates = torch.stack([torch.arange(5.0), torch.ones(5)], 1)
    figure, (above, below) = plot_templates(one, values, templates, 0, "places")
    assert [np.stack(line.get_data(), 1).tolist() for line in above.lines[:-1]] == [
        [[3, 3], [4, 4]],
        [[0, 0], [1, 1], [2, 2], [3, 3], [4, 4]],
        [[0, 0], [1, 1], [2, 2], [3, 3], [4, 4]],
    ]
    mean = above.lines[-1]
    assert mean.get_xdata().tolist() == mean.get_ydata().tolist() == [0, 1, 2, 3, 4]
    assert below.images[0].get_array().shape == (2, 5)
    assert [label.get_text() for label in below.get_yticklabels()] == ["4"]
    assert {"feature 4, 3 cycles; thick: their mean", "phase, of a period of 5 (places)"} <= set(
        texts(figure)
    )


@pytest.mark.parametrize(("period", "phases"), [(Fraction(15, 2), 3), (Fraction(2), 1), (Fraction(8), 8)])
def test_templates_of_any_period_and_of_many_features(period: Fraction, phases: int) -> None:
    one = FrequencyLayer(period, phases, 0, 40, tuple(range(100)))
    values = torch.rand(40)
    figure, (above, below) = plot_templates(one, values, torch.rand(phases, 100), 3, "frames")
    shown = above.lines[-1].get_xdata()
    # the mean stands in the middle of the frames it averages
    assert shown[0] - -0.5 == pytest.approx(float(period - Fraction(1, 2)) - shown[-1])
    assert below.images[0].get_array().shape == (64, phases)
    render(figure)


@pytest.mark.parametrize("degrees", [10, 70, 130])
def test_an_edge_in_the_frame_is_drawn_where_it_is(degrees: int) -> None:
    """One edge through the middle of the frame: what lights up there is drawn along it."""
    # the gradient points to `degrees` from x towards y, the middle of a bin
    angle = torch.deg2rad(torch.tensor(float(degrees)))
    y, x = torch.meshgrid(torch.arange(72) - 35.5, torch.arange(72) - 35.5, indexing="ij")
    frame = torch.erf((x * angle.cos() + y * angle.sin()) / 2) + 0.03 * torch.rand(72, 72)  # noise elsewhere
    values = HOG()(frame[None, None])[0]
    lit = (values > 0.75 * values.max()).nonzero().flatten()
    edges, count = edges_seen(lit, (72, 72))
    assert len(edges) >= 3
    assert count.max() <= 4  # blocks that share a cell
    for (x0, y0), (x1, y1) in edges.tolist():
        along = (x1 - x0, y1 - y0)
        length = (along[0] ** 2 + along[1] ** 2) ** 0.5
        across = abs(along[0] * float(angle.cos()) + along[1] * float(angle.sin())) / length
        assert across < 0.35  # perpendicular to the gradient, or the bin beside it: sin(20 degrees)
        off = ((x0 + x1) / 2 - 35.5) * float(angle.cos()) + ((y0 + y1) / 2 - 35.5) * float(angle.sin())
        assert abs(off) < 4 * float(angle.cos().abs() + angle.sin().abs()) + 3  # its cell meets the edge


@pytest.mark.parametrize("shape", [(3, 64, 64), (1, 64, 16)])
def test_features_are_drawn_on_a_frame_of_any_shape(shape: tuple[int, int, int]) -> None:
    frame = torch.rand(shape)
    features = range(0, HOG()(frame[None]).shape[1], 3)
    layers = [FrequencyLayer(Fraction(p), p, 0, 60, tuple(features)) for p in (9, 20)]
    for some in (layers, layers[:1]):
        figure, axes = plot_features(frame, some)
        assert axes.size == len(some)
        lines = axes.flat[0].collections[0]
        seen = edges_seen(torch.tensor(some[0].features), shape[1:])[0]
        assert np.array_equal(lines.get_segments(), seen)
        image = render(figure)
        assert image.width < 5 * image.height


def test_a_feature_that_repeats_is_like_itself_a_period_later() -> None:
    wave = torch.sin(torch.arange(600) * 2 * torch.pi / 50)
    plot = plot_autocorrelogram(wave, [50.0], 0, "frames")
    render(plot[0])
    line = plot[1].lines[0].get_ydata()
    assert line[0] == pytest.approx(1)
    assert line[50] == pytest.approx(550 / 600, abs=0.01)  # biased: as many frames less
    assert line[25] == pytest.approx(-575 / 600, abs=0.01)
