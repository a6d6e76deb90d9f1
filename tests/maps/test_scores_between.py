"""Scores of a stretch of places are those of all places there, for every kind of map."""

from __future__ import annotations

from fractions import Fraction

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch import FrequencyLayer, PlaceMap, SpectralMapper, TemplateMap
from dejavu_torch.types import Plan

PLAN: Plan = (
    FrequencyLayer(Fraction(7), 7, 0, 30, (0, 2)),
    FrequencyLayer(Fraction(25, 2), 13, 12, 30, (1,)),
    FrequencyLayer(Fraction(5), 5, 35, 60, (0, 1, 2)),
)


def templates(**settings: float) -> TemplateMap:
    blocks = [torch.rand(layer.phases, len(layer.features)) for layer in PLAN]
    return TemplateMap(PLAN, blocks, 64, 3, **settings)  # type: ignore[arg-type]


ROUTES = {
    "templates": templates(),
    "templates with a temperature": templates(temperature=0.5),
    "one chunk": SpectralMapper(None, 0.01)(torch.rand(64, 3)),
    "chunks": SpectralMapper(None, 0.01, chunk=16)(torch.rand(64, 3)),
    "chunks, l2": SpectralMapper(None, 0.01, chunk=16, metric="l2")(torch.rand(64, 3)),
}


@pytest.mark.parametrize("kind", list(ROUTES))
@given(st.integers(0, 63), st.integers(1, 64), st.integers(1, 40))
def test_they_are_those_of_all_places(kind: str, start: int, length: int, queries: int) -> None:
    route, rows = ROUTES[kind], torch.rand(queries, 3)
    stop = min(start + length, route.places)
    found = torch.cat([scores for _, scores in route.score_blocks(rows, start, stop)], 1)
    expected = route.scores(rows)[:, start:stop]
    assert found.shape == expected.shape
    assert torch.allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize(("kind", "part"), [("templates", 0.5), ("chunks", 0.3)])
def test_other_chunks_are_not_looked_at(kind: str, part: float, largest_tensor: type) -> None:
    route: PlaceMap = ROUTES[kind]
    queries: Tensor = torch.rand(1000, 3)
    with largest_tensor() as seen:
        list(route.score_blocks(queries, 36, 44))
    assert seen.numel <= max(part * 64, 32) * 1000
