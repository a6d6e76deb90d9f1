"""Which features repeat, by the spectrogram of each: known waves go in, known periods come out."""

from __future__ import annotations

import logging
import math
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import SpectrogramAnalysis
from dejavu_torch.periods import spectrogram
from dejavu_torch.periods.spectrogram import bin_period, layers_of, noise_share, strongest_bins


def wave(frames, cycles, over=None, phase=0.3):
    """A sine of so many cycles per `over` frames (default: all), (N,) float64."""
    return torch.sin(2 * math.pi * cycles * torch.arange(frames).double() / (over or frames) + phase)


def literal(window=1024, **other):
    """The paper's letter."""
    return SpectrogramAnalysis(window, **{"peaks": "bins", "false_alarm": None, "short": "refuse", **other})


def periods_of(plan, feature):
    return [int(layer.period) for layer in plan if feature in layer.features]


def test_a_known_sine_is_found():
    for peaks in ("bins", "local"):
        for cycles, period in ((11, 93), (6, 171), (2, 512), (128, 8)):
            plan = SpectrogramAnalysis(peaks=peaks, strongest=1).plan(wave(1024, cycles)[:, None])
            assert [
                (layer.period, layer.phases, layer.start, layer.stop, layer.features) for layer in plan
            ] == [(Fraction(period), period, 0, 1024, (0,))]


def test_power_is_that_of_numpy():
    features = torch.randn(50, 3, dtype=torch.float64)
    (spectrum,) = SpectrogramAnalysis(50)(features)
    centred = features.numpy() - features.numpy().mean(0)
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(50) / 50)
    expected = np.abs(np.fft.rfft(centred * hann[:, None], axis=0)) ** 2
    np.testing.assert_allclose(spectrum.power.numpy(), expected, rtol=1e-5, atol=1e-5)


def test_strongest_bins_by_hand():
    power = torch.tensor([[9.0, 8.0, 0.0, 1.0, 4.0, 3.0, 0.0, 2.0, 0.5, 7.0]]).T
    assert strongest_bins(power, 2, 8, "bins").T.tolist() == [[4, 5]]  # the second is leakage of the first
    assert strongest_bins(power, 2, 8, "local").T.tolist() == [[4, 7]]
    # bins 0 and 1 and those beyond `last` never count, also as peaks
    assert strongest_bins(power, 3, 7, "local").T.tolist() == [[4, 7, -1]]
    assert strongest_bins(power, 9, 8, "bins").T.tolist() == [[4, 5, 7, 3, 8, -1, -1, -1, -1]]
    plateau = torch.tensor([[0.0, 0.0, 1.0, 5.0, 5.0, 5.0, 1.0, 0.0]]).T
    assert strongest_bins(plateau, 2, 7, "local").T.tolist() == [[3, -1]]
    equal = torch.tensor([[0.0, 0.0, 1.0, 5.0, 1.0, 5.0, 1.0, 5.0, 0.0]]).T
    for peaks in ("bins", "local"):
        assert strongest_bins(equal, 2, 8, peaks).T.tolist() == [[3, 5]]  # of equal ones the lower
        assert strongest_bins(torch.zeros(9, 2), 3, 8, peaks).tolist() == [[-1, -1]] * 3


def test_as_many_periods_as_asked_for_and_leakage_is_none_of_local_maxima():
    features = (wave(256, 8) + 0.8 * wave(256, 20) + 0.6 * wave(256, 28))[:, None]
    for strongest, periods in ((1, [32]), (2, [13, 32]), (3, [9, 13, 32])):
        assert periods_of(SpectrogramAnalysis(256, strongest=strongest).plan(features), 0) == periods
    # amplitude 0.4: power 0.16 at bin 20, less than the 0.25 that bin 8 leaks into bins 7 and 9
    features = (wave(256, 8.1) + 0.4 * wave(256, 20))[:, None]
    assert periods_of(literal(256).plan(features), 0) == [bin_period(256, 9), 32]
    assert periods_of(SpectrogramAnalysis(256).plan(features), 0) == [13, 32]


def test_periods_lie_between_the_shortest_and_half_the_window():
    for peaks in ("bins", "local"):
        plan = SpectrogramAnalysis(100, min_period=10, peaks=peaks, false_alarm=None).plan(
            torch.randn(100, 40)
        )
        assert plan
        assert all(10 <= layer.period <= 50 for layer in plan)


def test_chunks():
    for arguments, frames, chunks in (
        ({"window": 100}, 300, [(0, 100), (100, 200), (200, 300)]),
        ({"window": 100}, 350, [(0, 100), (100, 200), (200, 300), (300, 350)]),
        ({"window": 100}, 308, [(0, 100), (100, 200), (200, 300), (300, 308)]),
        ({"window": 100}, 307, [(0, 100), (100, 200), (200, 300)]),  # under two periods of 4
        ({"window": 100, "min_period": 30}, 350, [(0, 100), (100, 200), (200, 300)]),
        ({"window": 100, "hop": 50}, 250, [(0, 100), (50, 150), (100, 200), (150, 250)]),
        ({"window": 100, "hop": 50}, 230, [(0, 100), (50, 150), (100, 200), (150, 230)]),
        ({"window": 100, "hop": 100}, 200, [(0, 100), (100, 200)]),
        ({"window": 100}, 60, [(0, 60)]),
        ({"window": 100, "hop": 80}, 60, [(0, 60)]),
    ):
        analysis = SpectrogramAnalysis(**arguments)
        assert analysis.chunks(frames) == chunks
        spectra = analysis(torch.randn(frames, 2))
        assert [(spectrum.start, spectrum.stop) for spectrum in spectra] == chunks
        assert all(s.power.shape == ((s.stop - s.start) // 2 + 1, 2) for s in spectra)


@given(st.integers(16, 60), st.integers(1, 60), st.integers(16, 400))
def test_chunks_leave_out_less_than_two_of_the_shortest_periods(window, hop, frames):
    chunks = SpectrogramAnalysis(window, hop=min(hop, window), min_period=8).chunks(frames)
    assert all(16 <= stop - start <= window for start, stop in chunks)
    assert chunks[0][0] == 0
    assert all(b[0] <= a[1] for a, b in pairwise(chunks))
    assert 0 <= frames - chunks[-1][1] < 16


def test_each_chunk_has_its_own_periods():
    features = torch.cat([wave(100, 10), wave(100, 5), wave(50, 5)])[:, None]
    plan = SpectrogramAnalysis(100, strongest=1).plan(features)
    assert [(layer.start, layer.stop, int(layer.period)) for layer in plan] == [
        (0, 100, 10),
        (100, 200, 20),
        (200, 250, 10),
    ]


def test_convention_3_hann_window_of_1024_not_centred_remainder_of_its_own():
    analysis = SpectrogramAnalysis()
    assert (analysis.window, analysis.strongest) == (1024, 2)
    assert analysis.chunks(3072) == [(0, 1024), (1024, 2048), (2048, 3072)]
    assert analysis.chunks(2500)[-1] == (2048, 2500)
    features = torch.randn(2500, 1)
    alone = analysis(features[1024:2048])[0].power  # nothing beyond the chunk is read
    torch.testing.assert_close(analysis(features)[1].power, alone)


def test_convention_3_others_shrink_a_long_window_and_say_so(caplog):
    features = wave(300, 10)[:, None]
    with caplog.at_level(logging.WARNING, "dejavu_torch"):
        (layer,) = SpectrogramAnalysis(1024, strongest=1).plan(features)
    assert (layer.period, layer.start, layer.stop) == (30, 0, 300)
    (record,) = caplog.records
    assert "1024" in record.getMessage()
    assert "300" in record.getMessage()


def test_convention_3_the_paper_refuses_a_long_window():
    with refused("300 places", "1024"):
        literal()(torch.randn(300, 1))
    assert len(literal()(torch.randn(1024, 1))) == 1


def test_a_chunk_too_short_to_tell_says_so(caplog):
    features = wave(24, 2)[:, None].repeat(1, 500)
    assert SpectrogramAnalysis(24).plan(features) == ()
    assert "places 0-23: too few to distinguish" in caplog.text
    assert SpectrogramAnalysis(24, false_alarm=None).plan(features) != ()


def test_white_noise_gives_no_layers():
    for frames in (64, 256, 1000):
        for _ in range(5):
            assert SpectrogramAnalysis(256).plan(torch.randn(frames, 30)) == ()
    assert SpectrogramAnalysis(512).plan(torch.randn(512, 20).cumsum(0)) != ()  # it is smooth


def test_one_periodic_feature_among_noise_is_enough_for_its_chunk():
    features = torch.randn(1024, 20)
    features[512:, 7] += 1.5 * wave(512, 16).float()
    plan = SpectrogramAnalysis(512, strongest=1).plan(features)
    (layer,) = (layer for layer in plan if layer.period == 32)
    assert 7 in layer.features
    assert {(layer.start, layer.stop) for layer in plan} == {(512, 1024)}


def test_noise_share_is_fishers_test():
    """Shares of independent, exponentially distributed powers: the case the bound is made for."""
    least = noise_share(64, 5, 0.2)
    power = torch.empty(4000, 64, 5).exponential_()
    exceeded = (power / power.sum(1, keepdim=True) > least).flatten(1).any(1).double().mean()
    assert 0.14 < exceeded < 0.21
    assert noise_share(64, 5, 0.01) > least
    assert noise_share(64, 50, 0.2) > least
    assert noise_share(512, 5, 0.2) < least


@pytest.mark.parametrize("value", [0.0, -3.7, 1e6])
def test_a_constant_feature_has_no_period(value):
    features = torch.stack([torch.full((512,), value), wave(512, 16).float()], 1)
    for analysis in (literal(256), SpectrogramAnalysis(256)):
        assert all(spectrum.power[:, 0].count_nonzero() == 0 for spectrum in analysis(features))
        plan = analysis.plan(features)
        assert plan
        assert periods_of(plan, 0) == []
        assert analysis.plan(features[:, :1]) == ()


def test_offset_and_scale_do_not_matter():
    for analysis in (literal(128), SpectrogramAnalysis(128)):
        features = torch.randn(300, 6, dtype=torch.float64) + 3 * wave(300, 16, over=128)[:, None]
        assert analysis.plan(features)
        assert analysis.plan(4 * features + 0.5) == analysis.plan(features)


@pytest.mark.parametrize(("k", "period"), [(11, 93), (6, 171), (2, 512), (128, 8), (3, 341), (10, 102)])
def test_golden_bins_of_1024(k, period):
    assert bin_period(1024, k) == period


@given(st.integers(16, 4096), st.data())
def test_a_bin_names_the_nearest_whole_period(length, data):
    k = data.draw(st.integers(1, length // 2))
    period = bin_period(length, k)
    assert abs(period - Fraction(length, k)) <= Fraction(1, 2)
    assert int(bin_period(length, torch.tensor(k))) == period


def test_features_of_the_same_whole_period_share_a_layer():
    layers = layers_of(torch.tensor([[6, 11, 11, -1], [11, -1, 6, -1]]), 1024, 2048)
    assert [(layer.period, layer.phases, layer.features) for layer in layers] == [
        (Fraction(93), 93, (0, 1, 2)),
        (Fraction(171), 171, (0, 2)),
    ]
    assert {(layer.start, layer.stop) for layer in layers} == {(1024, 2048)}
    # 80 / 33 and 80 / 38 both round to 2: a feature is in the layer once
    (layer,) = layers_of(torch.tensor([[33, 38], [38, -1]]), 0, 80)
    assert (layer.period, layer.features) == (2, (0, 1))
    assert layers_of(torch.full((2, 5), -1), 0, 100) == []


def test_gradients_are_right():
    features = torch.randn(28, 2, dtype=torch.float64, requires_grad=True)
    analysis = SpectrogramAnalysis(12, min_period=2)
    assert len(analysis(features)) == 3
    assert torch.autograd.gradcheck(lambda x: tuple(s.power for s in analysis(x)), features)


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: SpectrogramAnalysis(7), ("window=7, min_period=4", "window >= 2 * min_period")),
        (lambda: SpectrogramAnalysis(min_period=1), ("min_period=1", "min_period >= 2")),
        (lambda: SpectrogramAnalysis(strongest=0), ("strongest=0", "strongest >= 1")),
        (lambda: SpectrogramAnalysis(hop=0), ("hop=0", "1..1024")),
        (lambda: SpectrogramAnalysis(hop=1025), ("hop=1025", "1..1024")),
        (lambda: SpectrogramAnalysis(peaks="all"), ("peaks='all'", "'local' or 'bins'")),
        (lambda: SpectrogramAnalysis(short="pad"), ("short='pad'", "'shrink' or 'refuse'")),
        (lambda: SpectrogramAnalysis(false_alarm=0.0), ("false_alarm=0.0", "(0, 1)")),
        (lambda: SpectrogramAnalysis(false_alarm=1.0), ("false_alarm=1.0", "(0, 1)")),
        (lambda: SpectrogramAnalysis()(torch.randn(100)), ("(100,) torch.float32", "(N,D)")),
        (lambda: SpectrogramAnalysis().plan(torch.zeros(100, 2).long()), ("torch.int64", "float")),
        (lambda: SpectrogramAnalysis().plan(np.zeros((100, 2))), ("ndarray", "tensor (N,D)")),
        (lambda: SpectrogramAnalysis().plan(torch.full((100, 2), torch.nan)), ("not finite",)),
        (lambda: SpectrogramAnalysis()(torch.randn(7, 2)), ("7 places", "at least 8", "two periods of 4")),
        (lambda: SpectrogramAnalysis().plan(torch.randn(1, 2)), ("1 place;", "at least 8")),
    ],
)
def test_what_is_refused(call, facts):
    with refused(*facts):
        call()


def test_planning_transforms_few_features_at_a_time(monkeypatch):
    sizes = []
    power = spectrogram.chunk_power

    def watched(chunk):
        sizes.append(chunk.numel())
        return power(chunk)

    monkeypatch.setattr(spectrogram, "NUMBERS_AT_ONCE", 1024)
    monkeypatch.setattr(spectrogram, "chunk_power", watched)
    features = torch.randn(2048, 64) + torch.sin(torch.arange(2048)[:, None] * torch.arange(64) / 9)
    plan = SpectrogramAnalysis(window=128).plan(features)
    assert sizes == [1024] * (2048 * 64 // 1024)
    monkeypatch.undo()
    assert plan == SpectrogramAnalysis(window=128).plan(features) != ()


def test_a_feature_without_candidates_passes_no_test_for_noise():
    """All its power lies in bin 1, where no period is sought."""
    features = torch.stack([wave(256, 1), torch.randn(256, dtype=torch.float64)], 1)
    assert SpectrogramAnalysis(window=256, min_period=100, false_alarm=1e-6).plan(features) == ()
