"""From bins to layers: features of the same whole period share one."""

from __future__ import annotations

from fractions import Fraction

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.periods.spectrogram import bin_period, layers_of


@pytest.mark.parametrize(("k", "period"), [(11, 93), (6, 171), (2, 512), (128, 8), (3, 341), (10, 102)])
def test_golden_bins_of_1024(k: int, period: int) -> None:
    assert bin_period(1024, k) == period


@given(st.integers(16, 4096), st.data())
def test_a_bin_names_the_nearest_whole_period(length: int, data: st.DataObject) -> None:
    k = data.draw(st.integers(1, length // 2))
    period = bin_period(length, k)
    assert abs(period - Fraction(length, k)) <= Fraction(1, 2)
    assert int(bin_period(length, torch.tensor(k))) == period


def test_layers_of_a_chunk() -> None:
    bins = torch.tensor([[6, 11, 11, -1], [11, -1, 6, -1]])
    layers = layers_of(bins, 1024, 2048)
    assert [(layer.period, layer.phases, layer.features) for layer in layers] == [
        (Fraction(93), 93, (0, 1, 2)),
        (Fraction(171), 171, (0, 2)),
    ]
    assert {(layer.start, layer.stop) for layer in layers} == {(1024, 2048)}


def test_different_bins_of_one_rounded_period_are_one_layer_and_a_feature_is_in_it_once() -> None:
    # 80 / 33 and 80 / 38 both round to 2
    (layer,) = layers_of(torch.tensor([[33, 38], [38, -1]]), 0, 80)
    assert (layer.period, layer.features) == (2, (0, 1))


def test_no_bins_no_layers() -> None:
    assert layers_of(torch.full((2, 5), -1), 0, 100) == []
