"""A query's scores as a sum of periods."""

from __future__ import annotations

from fractions import Fraction

import pytest
import torch
from torch import Tensor

from dejavu_torch.evaluation.components import components
from dejavu_torch.maps.spectral import SpectralMapper


def waves(places: int = 240) -> Tensor:
    """Two numbers that repeat after 24 places and after 15, the first twice as large."""
    angle = 2 * torch.pi * torch.arange(places)[:, None] / torch.tensor([24.0, 15.0])
    return torch.cat([angle.sin(), angle.cos()], 1) * torch.tensor([2.0, 1.0, 2.0, 1.0])


@pytest.mark.parametrize(
    ("transform", "metric", "chunk"), [("dft", "l2", 10_000), ("dct", "cosine", 70), ("dct", "l2", 70)]
)
def test_the_sum_of_all_periods_is_the_map_s_score(transform: str, metric: str, chunk: object) -> None:
    torch.manual_seed(0)
    route = SpectralMapper(None, 0.5, chunk, transform, metric)(waves() + 0.3 * torch.randn(240, 4) + 1)  # type: ignore[arg-type]
    query = torch.randn(4)
    expected = route.scores(query[None])[0]
    for number, (start, stop) in enumerate(route.chunks):
        *some, every = components(route, query, number)
        assert torch.allclose(every.scores, expected[start:stop], atol=1e-4)
        assert [len(one.periods) for one in some] == [n for n in (1, 4, 16) if n < len(every.periods)]
        assert all(one.periods == every.periods[: len(one.periods)] for one in some)


def test_the_strongest_period_alone_is_a_wave() -> None:
    route = SpectralMapper(None, 0.01, metric="l2")(waves())
    query = waves()[100]
    first, every = components(route, query)
    assert (first.periods, every.periods) == ((Fraction(24),), (Fraction(24), Fraction(15)))
    place = torch.arange(240)
    # |query|^2 + |place|^2 - 2 query . place
    wave = 10 - 8 * (2 * torch.pi * (place - 100) / 24).cos()
    assert torch.allclose(first.scores, wave, atol=0.05)
    assert int(every.scores.argmin()) % 120 == 100  # both waves begin anew after 120 places
