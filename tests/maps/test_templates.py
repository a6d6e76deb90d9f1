"""Phase masks (eq. 2) and templates (eq. 1)."""

from __future__ import annotations

from fractions import Fraction

import pytest
import reference
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import FrequencyLayer, PhaseTemplates, phase_mask


def whole(period, stop, features=(0,), start=0):
    """The paper's case: as many phases as frames in a period."""
    return FrequencyLayer(Fraction(period), period, start, stop, features)


@given(st.integers(1, 12), st.integers(1, 40))
def test_mask_is_eq_2_to_the_letter(period, n):
    mask = phase_mask(n, period)
    assert mask.tolist() == [[float((i - k) % period == 0) for i in range(n)] for k in range(period)]


@given(reference.routes(most_layers=1))
def test_mask_equals_reference(route):
    (layer,) = route.plan
    n = len(route.values)
    mask = phase_mask(n, layer.period, layer.phases, layer.start, layer.stop)
    assert mask.tolist() == [[reference.mask(i, k, layer) for i in range(n)] for k in range(layer.phases)]


def test_phases_of_far_frames_are_exact():
    layer = FrequencyLayer(Fraction(195, 2), 98, 0, 1, (0,))
    far = [10**7, 10**12 + 1]
    assert layer.phase(torch.tensor(far)).tolist() == [reference.phase(i, layer) for i in far]


def test_convention_1_phases_count_from_absolute_frame_0():
    assert phase_mask(10, 4, start=3, stop=9)[3].tolist() == [0, 0, 0, 1, 0, 0, 0, 1, 0, 0]
    values = torch.arange(8.0)[:, None]
    (mu,) = PhaseTemplates()(values, [whole(4, stop=8, start=2)])
    assert mu[:, 0].tolist() == [4, 5, (2 + 6) / 2, (3 + 7) / 2]


def test_convention_1_the_mask_is_zero_outside_the_half_open_chunk():
    assert phase_mask(6, 2, start=2, stop=4).sum(0).tolist() == [0, 0, 1, 1, 0, 0]
    values = torch.tensor([[9.0], [9.0], [1.0], [2.0], [9.0], [9.0]])
    (mu,) = PhaseTemplates()(values, [whole(2, stop=4, start=2)])
    assert mu.tolist() == [[1.0], [2.0]]


@given(reference.routes())
def test_templates_equal_reference(route):
    found = PhaseTemplates()(route.values, route.plan)
    for mu, layer in zip(found, route.plan, strict=True):
        expected = torch.tensor(reference.templates(route.values.tolist(), layer), dtype=torch.float64)
        torch.testing.assert_close(mu, expected, rtol=0, atol=1e-12)


def test_a_phase_without_frames_is_finite():
    values = torch.ones(3, 1, requires_grad=True)
    (mu,) = PhaseTemplates()(values, [whole(5, stop=3)])
    assert mu[:, 0].tolist() == [1, 1, 1, 0, 0]
    mu.sum().backward()
    assert values.grad is not None
    assert values.grad.isfinite().all()


def test_gradients_are_right():
    values = torch.randn(14, 3, dtype=torch.float64, requires_grad=True)
    plan = [
        whole(4, 14, (0, 2)),
        FrequencyLayer(Fraction(5, 2), 3, 2, 11, (0, 1)),
        FrequencyLayer(Fraction(6), 2, 5, 9, (1,)),
    ]
    assert torch.autograd.gradcheck(lambda x: PhaseTemplates()(x, plan), values)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: phase_mask(10, Fraction(5, 2)), "period 5/2 and no phases; expected phases"),
        (lambda: phase_mask(10, 3, stop=11), "chunk [0, 11); expected it inside 10 frames"),
        (lambda: phase_mask(10, 3, start=5, stop=5), "covers [5, 5); expected 0 <= start < stop"),
        (lambda: phase_mask(10, 3, start=-1), "covers [-1, 0); expected 0 <= start < stop"),
        (lambda: phase_mask(10, -3, 3), "period -3 and 3 phases; expected period > 0"),
        (lambda: phase_mask(10, 3, 0), "0 phases; expected period > 0, phases >= 1"),
        (lambda: PhaseTemplates()(torch.rand(10, 2), [whole(3, 11)]), "inside 10 places of 2 features"),
        (lambda: PhaseTemplates()(torch.rand(10, 2), [whole(3, 10, (0, 2))]), "and feature 2; expected"),
    ],
)
def test_what_makes_no_templates_is_refused(make, message):
    with refused(message):
        make()


@given(reference.routes())
def test_templates_are_means_under_the_mask(route):
    n = len(route.values)
    for mu, layer in zip(PhaseTemplates()(route.values, route.plan), route.plan, strict=True):
        mask = phase_mask(n, layer.period, layer.phases, layer.start, layer.stop, torch.float64)
        total = mask @ route.values[:, list(layer.features)]
        torch.testing.assert_close(mu, total / mask.sum(1, keepdim=True).clamp(min=1), rtol=0, atol=1e-12)
