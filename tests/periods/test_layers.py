"""From bins to layers: which periods count as similar."""

from __future__ import annotations

from fractions import Fraction

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.periods.layers import cluster_layers, cluster_periods


def clustered(periods: list[int], counts: list[int], length: int, similar: float) -> list[int]:
    return cluster_periods(torch.tensor(periods), torch.tensor(counts), length, similar).tolist()


@pytest.mark.parametrize(
    ("similar", "owner"),
    [
        (0.0, [93, 102, 114, 171]),
        (1.0, [102, 102, 114, 171]),  # 1024/93, 1024/102 and 1024/114 lie 0.97 and 1.06 bins apart
        (1.1, [102, 102, 102, 171]),
        (4.1, [102, 102, 102, 102]),
    ],
)
def test_similar_means_within_so_many_bins_of_the_most_common(similar: float, owner: list[int]) -> None:
    assert clustered([93, 102, 114, 171], [3, 9, 3, 5], 1024, similar) == owner


def test_the_most_common_period_founds_a_layer_and_of_equals_the_shortest() -> None:
    assert clustered([20, 21], [1, 2], 100, 1.0) == [21, 21]
    assert clustered([20, 21], [2, 2], 100, 1.0) == [20, 20]


def test_a_period_is_not_passed_on_along_a_chain() -> None:
    # bins 10, 9 and 8: the middle one takes both neighbours, an end only the middle
    assert clustered([10, 11, 12], [1, 5, 1], 100, 1.0) == [11, 11, 11]
    assert clustered([10, 11, 12], [5, 1, 1], 100, 1.0) == [10, 10, 12]


@given(st.dictionaries(st.integers(8, 200), st.integers(1, 9), min_size=1, max_size=12), st.floats(0, 3))
def test_clusters_keep_what_they_promise(features_of: dict[int, int], similar: float) -> None:
    periods = sorted(features_of)
    counts = [features_of[period] for period in periods]
    owner = clustered(periods, counts, 1024, similar)
    founders = set(owner)
    for period, layer in zip(periods, owner, strict=True):
        assert abs(1024 / period - 1024 / layer) <= similar + 1e-9
        assert features_of[layer] >= features_of[period]
        assert owner[periods.index(layer)] == layer
    for a in founders:  # two founders are never similar
        assert all(a == b or abs(1024 / a - 1024 / b) > similar - 1e-9 for b in founders)


def test_layers_of_a_chunk() -> None:
    bins = torch.tensor([[6, 11, 11, -1], [11, -1, 6, -1]])
    layers = cluster_layers(bins, 1024, 2048, similar=0.0)
    assert [(layer.period, layer.phases, layer.features) for layer in layers] == [
        (Fraction(93), 93, (0, 1, 2)),
        (Fraction(171), 171, (0, 2)),
    ]
    assert {(layer.start, layer.stop) for layer in layers} == {(1024, 2048)}


def test_a_feature_stands_in_a_layer_once() -> None:
    # both its bins, 10 and 11, go to one layer
    (layer,) = cluster_layers(torch.tensor([[10, 10], [11, -1]]), 0, 1024, similar=1.0)
    assert layer.features == (0, 1)


def test_different_bins_of_one_rounded_period_are_one_layer() -> None:
    # 80 / 33 and 80 / 38 both round to 2
    (layer,) = cluster_layers(torch.tensor([[33, 38]]), 0, 80, similar=0.0)
    assert (layer.period, layer.features) == (2, (0, 1))


def test_no_bins_no_layers() -> None:
    assert cluster_layers(torch.full((2, 5), -1), 0, 100, similar=1.0) == []
