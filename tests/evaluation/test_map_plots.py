"""Pictures of a map, read back from the figures."""

from __future__ import annotations

from fractions import Fraction

import pytest
import torch
from drawn import layer, render, texts

from dejavu_torch.evaluation.map_plots import plot_activations, plot_chunks, plot_layers
from dejavu_torch.types import FrequencyLayer


def test_chunks_are_drawn_at_their_periods() -> None:
    plan = (layer(93, 0, 512, 4), layer(171, 0, 512), layer(Fraction(195, 2), 512, 1024))
    figure, axis = plot_chunks(plan, 1024)
    drawn = {tuple(map(tuple, part.get_segments()[0].tolist())) for part in axis.collections}
    assert drawn == {
        ((0, 93), (512, 93)),
        ((0, 171), (512, 171)),
        ((512, 97.5), (1024, 97.5)),
    }
    assert {"93", "171", "97.5", "widest bar: 4 features"} <= set(texts(figure))


def test_chunks_of_a_route_without_layers() -> None:
    assert "this route does not repeat: no layers" in texts(plot_chunks((), 100)[0])


def test_activations_show_the_scores_and_mark_the_best() -> None:
    layers, scores = (layer(4, 8, 16), layer(2, 8, 16)), torch.rand(2, 8)
    figure, rows = plot_activations(layers, scores, scores.sum(0), 5, [11], torch.rand(3, 6, 8))
    for axis, values in zip(rows[1:], (*scores, scores.sum(0)), strict=True):
        curve, best = axis.lines[:2]
        assert curve.get_xdata().tolist() == list(range(8, 16))
        assert curve.get_ydata().tolist() == values.tolist()
        assert float(best.get_xdata()[0]) == 8 + int(values.argmin())
    assert {"period 4, 2 features", "all layers fused", "true place"} <= set(texts(figure))


def test_layers_show_their_phases() -> None:
    layers = [FrequencyLayer(Fraction(tau), tau, 20, 80, tuple(range(tau))) for tau in range(5, 20)]
    plot = plot_layers(layers)
    render(plot[0])
    shown = plot[1].images[0].get_array()
    assert shown.shape == (12, 60)  # the twelve of most features
    assert shown[0].tolist() == pytest.approx([(i % 8) / 8 for i in range(20, 80)])
