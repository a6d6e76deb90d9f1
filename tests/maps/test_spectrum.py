"""Orthonormal transforms along time, against their definition."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from dejavu_torch.maps.spectrum import from_spectrum, period_of, spectrum

TRANSFORMS = ("dft", "dct")


def definition(count, transform):
    """The lines as rows (W,W), by the letter of the docstring."""
    time = torch.arange(count, dtype=torch.float64)
    rows = []
    for line in range(count):
        if transform == "dct":
            row = torch.cos(math.pi * line * (time + 0.5) / count)
        else:
            cycles = (line + 1) // 2
            angle = 2 * math.pi * cycles * time / count
            row = -torch.sin(angle) if line and line % 2 == 0 else torch.cos(angle)
        rows.append(row / row.norm())
    return torch.stack(rows)


@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("count", [1, 2, 3, 8, 13, 30])
def test_lines_are_those_of_the_definition(transform, count):
    series = torch.randn(2, 3, count, dtype=torch.float64)
    rows = definition(count, transform)
    assert torch.allclose(rows @ rows.T, torch.eye(count, dtype=torch.float64), atol=1e-12)
    expected = torch.einsum("rw,...w->...r", rows, series)
    assert torch.allclose(spectrum(series, transform), expected, atol=1e-12)
    assert torch.allclose(from_spectrum(expected, transform), series, atol=1e-12)


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_gradients(transform):
    for count in (6, 7):
        series = torch.randn(2, count, dtype=torch.float64, requires_grad=True)
        for function in (spectrum, from_spectrum):
            assert torch.autograd.gradcheck(lambda x, f=function: f(x, transform), series)


def test_periods():
    assert [period_of(line, 12) for line in (1, 2, 3, 11)] == [12, 12, 6, 2]
    assert [period_of(line, 12, "dct") for line in (1, 2, 5)] == [24, 12, Fraction(24, 5)]


def test_a_whole_number_of_cycles_is_one_line_of_the_dft_and_many_of_the_dct():
    wave = torch.sin(2 * math.pi * torch.arange(120, dtype=torch.float64) / 8 + 1)
    lines = {name: int((spectrum(wave, name).abs() > 1e-9).sum()) for name in TRANSFORMS}
    assert lines["dft"] == 2
    assert lines["dct"] > 50


def test_what_an_inference_or_a_fake_tensor_left_serves_gradients():
    with torch.inference_mode():
        from_spectrum(torch.randn(37))
    with FakeTensorMode():
        from_spectrum(torch.zeros(38))
    for count in (37, 38):
        lines = torch.randn(count, requires_grad=True)
        from_spectrum(lines).square().sum().backward()
        torch.testing.assert_close(lines.grad, 2 * lines.detach())
