"""Queries without the light of their own day."""

from __future__ import annotations

import pytest
import torch
from helpers import Fixed, template_model

from dejavu_torch import DejaVu, PlaceFilter, SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.recognition.centring import centred
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.types import FrequencyLayer


def noise(rows, columns=12, seed=0):
    return torch.randn(rows, columns, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("metric", ["l2", "cosine"])
def test_the_mean_of_the_queries_is_weighed_against_fifty_of_the_map(metric):
    reference = noise(80) + 0.5
    place_map, queries = SpectralMapper(metric=metric)(reference), noise(150, seed=1) + 2
    assert torch.allclose(place_map.mean, reference.mean(0), atol=3e-3)
    moved = queries - 150 / 200 * (queries.mean(0) - place_map.mean)
    expected = moved if metric == "l2" else moved / moved.norm(dim=1, keepdim=True)
    found = centred(place_map, queries)
    assert torch.allclose(found, expected, atol=1e-5)
    assert metric == "l2" or found.norm(dim=1).tolist() == pytest.approx([1] * 150)
    assert centred(place_map, queries[:0]).shape == (0, 12)


def test_a_stop_is_one_query_of_the_mean():
    """Else the mean of the drive is that of where it stood."""
    place_map, queries = SpectralMapper(metric="l2")(noise(80)), noise(60, seed=1)
    stopped = torch.cat([queries[:30], queries[29:30].repeat(400, 1), queries[30:]])
    found = centred(place_map, stopped)
    assert torch.allclose(found[[*range(30), *range(430, 460)]], centred(place_map, queries), atol=1e-5)


def test_the_mean_of_several_routes_is_that_of_their_places():
    parts = [noise(30) - 1, noise(90, seed=1) + 1]
    whole = SpectralMap.merged([SpectralMapper()(part) for part in parts], ["short", "long"])
    assert torch.allclose(whole.mean, torch.cat(parts).mean(0), atol=3e-3)


def test_maps_without_a_mean_leave_queries_as_they_are():
    layer = FrequencyLayer(3, 3, 0, 12, (0, 1))  # type: ignore[arg-type]
    model = template_model(periods=Fixed(layer)).learn(noise(12, 2))
    queries = noise(60, 2, seed=1)
    assert centred(model.map, queries) is queries


def test_drives_are_centred_and_single_queries_are_not():
    """Queries of another light: what all of them have in common."""
    route = noise(100, 32)
    model, light = DejaVu(whitening="none").learn(route), 3 * noise(1, 32, seed=5)
    queries = torch.nn.functional.normalize(route + light, dim=1)
    found = {
        how: (model.localize(queries, sequence=one, centre=centre).index == torch.arange(100)).double().mean()
        for how, one, centre in (
            ("single", None, None),
            ("single, centred", None, True),
            ("drive", PlaceSmoother(), None),
            ("drive, not centred", PlaceSmoother(), False),
            ("filter", PlaceFilter(), None),
        )
    }
    assert found["single, centred"] > found["single"] + 0.1
    assert found["drive"] > 0.98
    few = model.localize(queries[:49], sequence=PlaceSmoother())
    plain = model.localize(queries[:49], sequence=PlaceSmoother(), centre=False)
    assert torch.equal(few.score, plain.score)
    again = model.localize(queries[[7, 3]], sequence=None)
    assert torch.equal(again.score, model.localize(queries, sequence=None).score[[7, 3]])
