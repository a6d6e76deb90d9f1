"""Pictures of a map, read back from the figures."""

from __future__ import annotations

from fractions import Fraction

import pytest
import torch
from drawn import layer, render, texts

from dejavu_torch.evaluation.map_plots import plot_activations, plot_chunks, plot_layers
from dejavu_torch.types import FrequencyLayer


def test_activations_show_the_scores_and_mark_the_best() -> None:
    layers, scores = (layer(4, 8, 16), layer(2, 8, 16)), torch.rand(2, 8)
    figure, rows = plot_activations(
        layers, scores, scores.sum(0), 5, torch.arange(21), [11], torch.rand(3, 6, 8)
    )
    for axis, values in zip(rows[1:], (*scores, scores.sum(0)), strict=True):
        curve, best = axis.lines[:2]
        assert curve.get_xdata().tolist() == list(range(8, 16))
        assert curve.get_ydata().tolist() == values.tolist()
        assert float(best.get_xdata()[0]) == 8 + int(values.argmin())
    assert {"period 4, 2 features", "all layers fused", "true place"} <= set(texts(figure))


def test_layers_show_their_phases() -> None:
    layers = [FrequencyLayer(Fraction(tau), tau, 20, 80, tuple(range(tau))) for tau in range(5, 20)]
    plot = plot_layers(layers, torch.arange(81), "frames")
    render(plot[0])
    shown = plot[1].images[0].get_array()
    assert shown.shape == (12, 60)  # the twelve of most features
    assert shown[0].tolist() == pytest.approx([(i % 8) / 8 for i in range(20, 80)])


STANDS = torch.tensor([0, 2, 4, 30, 31, 32, 33, 34, 35])  # the camera stands from frame 4 to 29


def test_convention_11_axes_along_the_route_count_frames_and_periods_count_places() -> None:
    layers = (layer(4, 0, 4), layer(2, 4, 8))
    figure, axis = plot_chunks(layers, STANDS, "places")
    drawn = {tuple(map(tuple, part.get_segments()[0].tolist())) for part in axis.collections}
    assert drawn == {((0, 4), (31, 4)), ((31, 2), (35, 2))}
    assert axis.get_xlim() == (0, 35)
    told = {"place (frame)", "period (places)", "4", "2", "widest bar: 2 features"}
    assert told <= set(texts(figure))
    figure, axis = plot_layers(layers[:1], STANDS, "places")
    assert axis.get_xlim() == (-0.5, 30.5)
    assert {"place (frame)", "period (places)"} <= set(texts(figure))
    assert axis.images[0].get_array().shape[:2] == (1, 4)
    scores = torch.rand(1, 4)
    figure, rows = plot_activations(layers[1:], scores, scores[0], 77, STANDS, [6], torch.rand(1, 6, 4))
    assert rows[-1].lines[0].get_xdata().tolist() == [31, 32, 33, 34]
    assert rows[-1].get_xlim() == (31, 35)
    assert [line.get_xdata()[0] for line in rows[0].lines] == [33]
    assert rows[0].images[0].get_extent()[:2] == [31, 35]
    assert "difference of query 77 (lower is better)" in texts(figure)
