"""Pictures of a template map, read back from the figures."""

from __future__ import annotations

from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from drawn import layer, run_of, texts

from dejavu_torch import HOG
from dejavu_torch.evaluation.map_plots import plot_answers
from dejavu_torch.evaluation.template_plots import (
    draw_chunks,
    draw_layers,
    draw_spectrogram,
    draw_templates,
    edges_seen,
)
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.types import FrequencyLayer

STANDS = torch.tensor([0, 2, 4, 30, 31, 32, 33, 34, 35])  # the camera stands from frame 4 to 29


def wave(period, frames=256):
    return torch.sin(torch.arange(frames) * 2 * torch.pi / period)


def described(values, **parts):
    """A run of which only the reference's features (N,D) matter."""
    model = SimpleNamespace(trained=None, mapper=SimpleNamespace(**parts))
    return run_of(torch.zeros(1, len(values)), reference_features=values, model=model, unit="places")


def test_convention_11_axes_along_the_route_count_frames_and_periods_count_places():
    layers = (layer(4, 0, 4), layer(2, 4, 8))
    figure, axis = draw_chunks(layers, STANDS, "places")["chunks"].plot
    drawn = {tuple(map(tuple, part.get_segments()[0].tolist())) for part in axis.collections}
    assert drawn == {((0, 4), (31, 4)), ((31, 2), (35, 2))}
    assert axis.get_xlim() == (0, 35)
    told = {"place (frame)", "period (places)", "4", "2", "widest bar: 2 features"}
    assert told <= set(texts(figure))
    figure, axis = draw_layers(layers[:1], STANDS, "places")["layers"].plot
    assert axis.get_xlim() == (-0.5, 30.5)
    assert {"place (frame)", "period (places)"} <= set(texts(figure))
    assert axis.images[0].get_array().shape[:2] == (1, 4)
    run = run_of(torch.rand(1, 8), borders=STANDS, query_frames=torch.tensor([77]))
    curves, strip = [("one layer", torch.tensor([3.0, 2, 0, 1]), "black")], torch.rand(1, 6, 4)
    figure, rows = plot_answers(run, 0, (4, 8), [6], curves, strip)
    assert rows[-1].lines[0].get_xdata().tolist() == [31, 32, 33, 34]
    assert rows[-1].lines[1].get_xdata().tolist() == [33]  # the best
    assert rows[-1].get_xlim() == (31, 35)
    assert [line.get_xdata()[0] for line in rows[0].lines] == [33]
    assert rows[0].images[0].get_extent()[:2] == [31, 35]
    assert "difference of query 77 (lower is better)" in texts(figure)


@pytest.mark.parametrize("hop", [None, 64])
def test_spectrogram_is_darkest_at_the_period(hop):
    values, analysis = torch.cat([wave(32), wave(16)])[:, None], SpectrogramAnalysis(window=256, hop=hop)
    run = described(values, periods=analysis)
    figure, (above, below) = draw_spectrogram(run, (layer(32, 0, 256, 1),), 0)["spectrogram"].plot
    line = above.collections[0].get_paths()[0].vertices[1:513]
    assert np.allclose(line, torch.stack([torch.arange(512), values[:, 0]], 1))
    for mesh, period in zip((below.collections[0], below.collections[-1]), (32, 16), strict=True):
        borders = mesh.get_coordinates()[:, 0, 1]
        power = mesh.get_array().ravel()
        assert borders[power.argmax()] > period > borders[power.argmax() + 1]
        assert power.max() == pytest.approx(100 * 2 / 3, rel=1e-3)  # what a pure wave holds under Hann
    starts = [float(mesh.get_coordinates()[0, 0, 0]) for mesh in below.collections]
    assert starts == [start for start, _, _ in analysis(values)]
    kept = [line.get_ydata() for line in below.lines if line.get_marker() == "o"]
    assert kept == [[32]]
    assert "feature 0 along the route" in texts(figure)


def test_templates_lie_over_the_frames_they_are_the_mean_of():
    one = FrequencyLayer(Fraction(5), 5, 3, 15, (0, 4))
    values = torch.arange(15).remainder(5).float()[:, None].expand(-1, 5)  # the phase itself
    templates = torch.stack([torch.ones(5), torch.arange(5.0)], 1)
    figure, (above, below) = draw_templates(described(values), one, templates, 1)["templates"].plot
    assert [np.stack(line.get_data(), 1).tolist() for line in above.lines[:-1]] == [
        [[3, 3], [4, 4]],
        [[0, 0], [1, 1], [2, 2], [3, 3], [4, 4]],
        [[0, 0], [1, 1], [2, 2], [3, 3], [4, 4]],
    ]
    mean = above.lines[-1]
    assert mean.get_xdata().tolist() == mean.get_ydata().tolist() == [0, 1, 2, 3, 4]
    assert below.images[0].get_array().shape == (2, 5)
    assert [label.get_text() for label in below.get_yticklabels()] == ["4"]
    told = {"feature 4, 3 cycles; thick: their mean", "phase, of a period of 5 (places)"}
    assert told <= set(texts(figure))


@pytest.mark.parametrize("degrees", [10, 70, 130])
def test_an_edge_in_the_frame_is_drawn_where_it_is(degrees):
    """One edge through the middle of the frame: what lights up there is drawn along it."""
    # the gradient points to `degrees` from x towards y, the middle of a bin
    angle = torch.deg2rad(torch.tensor(float(degrees)))
    gradient = torch.stack([angle.cos(), angle.sin()])
    y, x = torch.meshgrid(torch.arange(72) - 35.5, torch.arange(72) - 35.5, indexing="ij")
    frame = torch.erf((x * gradient[0] + y * gradient[1]) / 2) + 0.03 * torch.rand(72, 72)  # noise elsewhere
    values = HOG()(frame[None, None])[0]
    edges, count = edges_seen((values > 0.75 * values.max()).nonzero().flatten(), (72, 72))
    assert len(edges) >= 3
    assert count.max() <= 4  # blocks that share a cell
    along, middle = edges[:, 1] - edges[:, 0], edges.mean(1) - 35.5
    # perpendicular to the gradient, or the bin beside it: sin(20 degrees)
    assert ((along @ gradient).abs() / along.norm(dim=1)).max() < 0.35
    assert (middle @ gradient).abs().max() < 4 * gradient.abs().sum() + 3  # its cell meets the edge
