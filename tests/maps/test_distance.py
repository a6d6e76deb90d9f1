"""Distance of a query to every phase of a layer (eq. 3)."""

from __future__ import annotations

from fractions import Fraction

import pytest
import reference
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import FrequencyLayer, phase_distances

METRICS = ["l1", "l2", "cosine"]


def loops(query, templates, metric):
    """Each metric from its definition, pair by pair."""

    def one(a, b):
        if metric == "l1":
            return (a - b).abs().sum()
        if metric == "l2":
            return (a - b).square().sum().sqrt()
        return 1 - (a * b).sum() / (a.square().sum() * b.square().sum()).sqrt()

    return torch.stack([torch.stack([one(a, b) for b in templates]) for a in query])


@given(st.integers(1, 5), st.integers(1, 6), st.integers(1, 8), st.integers(0, 2**16))
def test_eq_3_equals_reference(queries, phases, features, seed):
    generator = torch.Generator().manual_seed(seed)
    query = torch.randn(queries, features, generator=generator, dtype=torch.float64)
    mu = torch.randn(phases, features, generator=generator, dtype=torch.float64)
    layer = FrequencyLayer(Fraction(phases), phases, 0, 1, tuple(range(features)))
    expected = [
        [reference.phase_distance(row, mu.tolist(), k, layer) for k in range(phases)]
        for row in query.tolist()
    ]
    torch.testing.assert_close(phase_distances(query, mu).tolist(), expected, rtol=0, atol=1e-12)


def test_metrics_are_their_definitions():
    for metric in METRICS:
        query, mu = torch.randn(6, 10, dtype=torch.float64), torch.randn(7, 10, dtype=torch.float64)
        torch.testing.assert_close(
            phase_distances(query, mu, metric), loops(query, mu, metric), rtol=0, atol=1e-12
        )


def test_small_distances_between_large_features_are_kept():
    """|a - b| squared as a*a + b*b - 2ab would lose them in float32."""
    for metric in ("l1", "l2"):
        query = 1000 + torch.rand(40, 64)
        mu = query + 0.01
        expected = loops(query.double(), mu.double(), metric)
        torch.testing.assert_close(phase_distances(query, mu, metric).double(), expected, rtol=1e-4, atol=0)


def test_cosine_of_nothing_is_1():
    assert phase_distances(torch.zeros(1, 3), torch.rand(2, 3), "cosine").tolist() == [[1.0, 1.0]]


def test_what_has_no_distance_is_refused():
    with refused("'manhattan' is unknown; expected l1, l2, cosine"):
        phase_distances(torch.rand(3, 4), torch.rand(5, 4), "manhattan")  # type: ignore[arg-type]
    with refused("queries (3, 4); expected (Q, 3)"):
        phase_distances(torch.rand(3, 4), torch.rand(5, 3))


def test_queries_and_templates_of_any_dimension_are_exported():
    class Distances(torch.nn.Module):
        def forward(self, queries, templates):
            return phase_distances(queries, templates, "cosine")

    given, sizes = (torch.rand(3, 8), torch.rand(5, 8)), torch.export.Dim("dimension")
    program = torch.export.export(Distances(), given, dynamic_shapes=({1: sizes}, {1: sizes}))
    other = torch.rand(3, 9), torch.rand(5, 9)
    torch.testing.assert_close(program.module()(*other), phase_distances(*other, "cosine"))


def test_convention_10_float32_whatever_the_autocast():
    for metric in METRICS:
        query, mu = torch.rand(3, 50), torch.rand(5, 50)
        plain = phase_distances(query, mu, metric)
        with torch.autocast("cpu", torch.bfloat16):
            cast = phase_distances(query, mu, metric)
        assert cast.dtype == torch.float32
        assert torch.equal(cast, plain)


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize(
    ("query", "templates", "result"),
    [
        (torch.bfloat16, torch.float32, torch.float32),
        (torch.bfloat16, torch.bfloat16, torch.float32),
        (torch.float16, torch.float16, torch.float32),
        (torch.float64, torch.float32, torch.float64),
        (torch.float32, torch.float64, torch.float64),
    ],
)
def test_convention_10_float32_at_least(query, templates, result, metric):
    a, b = torch.rand(3, 4).to(query), torch.rand(5, 4).to(templates)
    distances = phase_distances(a, b, metric)
    assert distances.dtype == result
    assert torch.equal(distances, phase_distances(a.to(result), b.to(result), metric))


@pytest.mark.parametrize("metric", METRICS)
def test_convention_10_nothing_of_queries_times_phases_times_features(metric, largest_tensor):
    query = torch.rand(50, 40, requires_grad=True)
    mu = torch.rand(60, 40, requires_grad=True)
    with largest_tensor() as seen:
        phase_distances(query, mu, metric).sum().backward()
    assert seen.numel <= 60 * 50


@pytest.mark.parametrize("metric", METRICS)
def test_gradients_are_right(metric):
    query = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    mu = torch.randn(5, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: phase_distances(a, b, metric), (query, mu))


def test_gradients_are_finite_where_query_and_template_are_equal_or_0():
    for metric in METRICS:
        query = torch.rand(3, 4)
        query[0] = 0
        query.requires_grad_()
        mu = query.detach().clone().requires_grad_()
        gradients = torch.autograd.grad(phase_distances(query, mu, metric).sum(), (query, mu))
        assert all(bool(one.isfinite().all()) for one in gradients)
