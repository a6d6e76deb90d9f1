"""What a store of few bytes gives back."""

from __future__ import annotations

import pytest
import torch
from helpers import refused
from torch import Tensor
from torch.nn.functional import normalize

from benchmarks.quantisers import (
    Kept,
    ProductQuantiser,
    every_kth,
    principal,
    signs,
    spectral,
)
from dejavu_torch.evaluation.baselines import as_int8, between_keyframes, keyframes


def route(places: int = 300, numbers: int = 12, seed: int = 0) -> Tensor:
    walk = torch.randn(places, numbers, generator=torch.Generator().manual_seed(seed)).cumsum(0)
    return normalize(walk, dim=1)


def error(kept: Kept | Tensor, places: Tensor) -> float:
    back = kept if isinstance(kept, Tensor) else kept.descriptors
    return float((back - places).square().mean())


def test_keyframes_and_what_lies_between() -> None:
    line = torch.arange(10.0)[:, None] * torch.tensor([1.0, -2.0])
    for k in (1, 3, 9, 20):
        keys = keyframes(10, k)
        assert (int(keys[0]), int(keys[-1])) == (0, 9)
        assert torch.allclose(between_keyframes(line[keys], 10, k), line, atol=1e-5)


def test_every_kth_place_gives_back_the_one_before() -> None:
    places = route()
    kept = every_kth(places, 7, each=48)
    assert torch.equal(kept.descriptors, places[torch.arange(300) // 7 * 7])
    assert (kept.route, kept.fixed, kept.apart) == (43 * 48, 0, 7)
    between = every_kth(places, 7, 12, as_int8, between=True, beside=5)
    assert (between.route, between.apart) == (44 * 12 + 5, 1)  # and the last place
    assert error(between, places) < error(kept, places)


def test_the_map_and_its_null_take_the_same_bytes_and_give_back_places_in_order() -> None:
    places = route()
    ours, null = spectral(places, 2.0), spectral(places, 2.0, seed=0)
    assert 0.9 * 600 < ours.route <= 600
    assert 0.9 * 600 < null.route <= 600
    assert error(ours, places) < error(null, places) < error(torch.zeros_like(places), places)
    with refused("route_bytes_per_place is 0.001"):
        spectral(places, 0.001)


def test_all_components_give_back_all() -> None:
    places = route()
    few, whole = principal(places, 2), principal(places, 12)
    assert error(whole, places) < 1e-5 < error(few, places)
    assert (few.route, few.fixed) == (600, 2 * 12 + 2 * 4 + 12 * 4)
    with refused("13 principal components", "(300, 12)"):
        principal(places, 13)


def test_signs() -> None:
    assert signs(torch.tensor([[-0.5, 0.0, 3.0]])).tolist() == [[-1, 1, 1]]


def test_longer_codes_give_back_more() -> None:
    pytest.importorskip("faiss")
    places, other = route(), normalize(torch.randn(2000, 12), dim=1)
    errors = [error(ProductQuantiser(other, m)(places), places) for m in (1, 4, 12)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < error(torch.zeros_like(places), places) / 10


def test_a_rotation_helps_where_numbers_go_together() -> None:
    pytest.importorskip("faiss")
    torch.manual_seed(0)
    mixed = torch.randn(600, 12) * 0.6 ** torch.arange(12)  # some parts hold all, others nothing
    plain, turned = (ProductQuantiser(mixed, 3, rotated=rotated) for rotated in (False, True))
    assert error(turned(mixed), mixed) < 0.9 * error(plain(mixed), mixed)
    assert (plain.bytes, turned.bytes) == (256 * 12, 256 * 12 + 144)


def test_codebooks_in_int8_and_descriptors_that_are_padded() -> None:
    pytest.importorskip("faiss")
    places, other = route(numbers=13), normalize(torch.randn(2000, 13), dim=1)
    quantisers = [ProductQuantiser(other, 4, rotated=True, int8=int8) for int8 in (False, True)]
    assert [quantiser.width for quantiser in quantisers] == [16, 16]
    backs = [quantiser(places) for quantiser in quantisers]
    assert backs[0].shape == places.shape
    assert error(backs[1], places) < 1.1 * error(backs[0], places)


def test_fewer_places_than_centroids_are_refused() -> None:
    pytest.importorskip("faiss")
    with refused("255 places", "at least 256"):
        ProductQuantiser(route(255), 4)
