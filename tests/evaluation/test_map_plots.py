"""Pictures of a spectral map, read back from the figures."""

from __future__ import annotations

import pytest
import torch
from drawn import texts

from dejavu_torch import DejaVu
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.ground_truth import as_ground_truth, offset_truth
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.localization import Localization
from dejavu_torch.evaluation.map_plots import draw_spectrum
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.spectrum import period_of

PLACES = 240


def route(seed):
    noise = torch.randn(PLACES, 6, generator=torch.Generator().manual_seed(seed))
    angle = 2 * torch.pi * torch.arange(PLACES)[:, None] / torch.tensor([60.0, 24, 16, 12, 8, 5])
    return (angle + 0.7).sin() * torch.tensor([3.5, 2, 3, 4, 5, 0.1]) + 0.1 * noise


def localized(chunk=10_000, scored=True):
    model = DejaVu(whitening="none", mapper=SpectralMapper(None, 1.0, chunk)).learn(route(0))  # type: ignore[arg-type]
    truth = as_ground_truth(offset_truth(PLACES, PLACES)) if scored else None
    match = model.localize(route(1))
    traverses = ArrayTraverse(route(0)), ArrayTraverse(route(1))
    assert isinstance(model.map, SpectralMap)
    return Localization(model, *traverses, route(0), route(1), match, truth, 2), model.map


@pytest.mark.parametrize("chunk", [10_000, 150])
def test_the_lines_that_are_marked_are_those_of_the_map(chunk):
    run, held = localized(chunk)
    picture = draw_spectrum(run, held)["spectrum"]
    figure, axes = picture.plot
    start, stop = held.chunks[0]
    every = held.lines(0)
    assert [axis.get_title(loc="left").split(":")[0] for axis in axes] == [f"feature {j}" for j in (4, 3, 0)]
    for axis, feature in zip(axes, (4, 3, 0), strict=True):
        lines = every.line[every.feature == feature]
        expected = sorted(float(period_of(line, stop - start)) for line in lines.tolist() if line)
        zero, kept = (sorted(one.get_xdata().tolist()) for one in axis.lines[:2])
        assert kept == pytest.approx(expected)
        assert len(kept) + len(zero) == stop - start - 1
        assert f"{len(kept)} of {stop - start - 1} lines" in axis.get_title(loc="left")
        assert min(axis.lines[1].get_ydata()) >= 0.65  # a dead zone of 1.3 steps around 0
        assert axis.lines[2].get_ydata() == [1, 1]
        assert axis.lines[1].get_color() == COLOURS["map"]
    assert {"period (frames)", "size of a line (steps)", "kept", "coded as 0", "step"} <= set(texts(figure))
    assert ("in the chunk of frames 0 to 150" in picture.caption) == (chunk == 150)


def test_a_map_without_lines_has_no_such_pictures():
    run, held = localized()[0], SpectralMapper(None, 1e6)(route(0))
    assert draw_spectrum(run, held) == {}
