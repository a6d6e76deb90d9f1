"""A rate in the loss: what levels cost, proxies made of few lines, and trainings that pay for their bits."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from pytorch_lightning import Callback
from small_training import data_of, fit, footage, new_descriptor, recall, trainer

from dejavu_torch.maps.quantisation import quantise
from dejavu_torch.maps.spectrum import from_spectrum
from dejavu_torch.training.losses import bands_of, coded_proxies, laplace_bits


def rated(rate=1.0, **settings):
    return new_descriptor(rate=rate, **settings)


# ------------------------------------------------------------------------ bits


def mass(level, width):
    """Of a Laplace distribution within half a step, from its distribution function."""

    def below(x):
        return 0.5 * math.exp(x / width) if x < 0 else 1 - 0.5 * math.exp(-x / width)

    return below(level + 0.5) - below(level - 0.5)


@given(st.floats(-6, 6), st.floats(0.3, 20))
def test_the_bits_are_those_of_the_mass_within_half_a_step(level, width):
    bits = laplace_bits(torch.tensor(level, dtype=torch.float64), torch.tensor(width, dtype=torch.float64))
    assert float(bits) == pytest.approx(-math.log2(mass(level, width)), rel=1e-6, abs=1e-9)


def test_bits_and_their_gradients_are_finite_however_far_a_level_lies_out():
    levels = torch.tensor([0.0, 0.5, 1e4, -1e4, 0.49999], requires_grad=True)
    widths = torch.tensor([1e-3, 1e-3, 1e-2, 1e4, 1e-4], requires_grad=True)
    bits = laplace_bits(levels, widths)
    bits.sum().backward()
    assert levels.grad is not None
    assert widths.grad is not None
    assert all(bool(one.isfinite().all()) for one in (bits, levels.grad, widths.grad))
    assert bits[2] > 1e5


# --------------------------------------------------------------------- proxies


def widths_of(lines, width, transform="dft"):
    return torch.full((int(bands_of(len(lines), transform).max() + 1) * lines.shape[1],), math.log(width))


def noise(count, dimension, seed=0):
    return torch.randn(count, dimension, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("transform", ["dft", "dct"])
def test_proxies_are_rebuilt_from_their_quantised_lines(transform):
    lines, step = 3 * noise(21, 3), torch.tensor(0.4)
    coded = coded_proxies(lines, step.log(), widths_of(lines, 0.7, transform), transform, noise=False)
    unit = lines / lines.square().mean().sqrt()
    assert torch.allclose(coded.proxies, from_spectrum(quantise(unit, step).T, transform).T, atol=1e-5)
    assert torch.allclose(coded.bits, laplace_bits(unit / step, torch.tensor(0.7)).sum())


@pytest.mark.parametrize(("transform", "halves"), [("dft", [0, 2, 2, 4, 4, 6]), ("dct", range(6))])
def test_bands_are_half_an_octave_wide(transform, halves):
    wanted = [1 + math.floor(2 * math.log2(cycles)) if cycles else 0 for cycles in halves]
    assert bands_of(6, transform).tolist() == wanted


def test_the_widths_are_of_one_band_and_feature():
    lines, band = noise(40, 3), bands_of(40)
    widths = widths_of(lines, 1.0).unflatten(0, (-1, 3)).clone()
    widths[4, 1] = math.log(5.0)
    changed = laplace_bits(lines / lines.square().mean().sqrt(), widths.exp()[band]).sum()
    coded = coded_proxies(lines, torch.zeros(()), widths.flatten(), noise=False)
    assert torch.allclose(coded.bits, changed)


def test_gradients_of_the_code():
    """Straight through the rounding to the lines; of bits to all three."""
    lines = noise(12, 3).double().requires_grad_()
    step = torch.tensor(-0.5, dtype=torch.float64, requires_grad=True)
    widths = widths_of(lines, 0.8).double().requires_grad_()

    def bits(*given):
        return coded_proxies(*given, noise=False).bits

    assert torch.autograd.gradcheck(bits, (lines, step, widths))
    weights = noise(12, 3, 1).double()
    coded = coded_proxies(lines, step, widths)
    own = torch.autograd.grad((coded.proxies * weights).sum(), lines)[0]
    plain = from_spectrum((lines / lines.square().mean().sqrt() / step.exp()).T).T
    assert torch.allclose(own, torch.autograd.grad((plain * weights).sum(), lines)[0])
    nothing = torch.zeros_like(lines, requires_grad=True)
    (gradient,) = torch.autograd.grad(coded_proxies(nothing, step, widths).bits, nothing)
    assert gradient.isfinite().all()


@pytest.mark.parametrize(
    ("lines", "widths", "facts"),
    [
        (torch.ones(1, 4), torch.zeros(4), ("(1, 4)", "W>=2")),
        (torch.ones(5, 0), torch.zeros(0), ("(5, 0)", "W>=2")),
        (torch.ones(5, 4), torch.zeros(3), ("the widths are (3,)", "expected (24,)")),
    ],
    ids=["short", "empty", "widths"],
)
def test_shapes_that_do_not_fit(lines, widths, facts):
    with refused(*facts):
        coded_proxies(lines, torch.zeros(()), widths)


# -------------------------------------------------------------------- training


def test_bits_count_for_more_and_more(tmp_path):
    """Nothing at the first step, so that the descriptor learns places first."""
    seen = []

    class Losses(Callback):
        def on_train_batch_end(self, trainer, *_):
            now = {name: float(value) for name, value in trainer.callback_metrics.items()}
            seen.append((now["train/loss"] - now["train/descriptor"]) / now["train/bits"])

    trainer(tmp_path, Losses(), max_steps=4).fit(rated(2.0), data_of())
    assert seen == pytest.approx([0.0, 0.5, 1.0, 1.5], abs=1e-3)


def test_bits_are_saved_where_they_count(tmp_path):
    bits = []
    for rate in (1e-6, 10.0):
        torch.manual_seed(1)
        task = rated(rate, lr=0.02)
        model = fit(tmp_path / str(rate), task, data_of(), max_steps=60, limit_val_batches=0)
        bits.append(float(task.trainer.callback_metrics["train/bits"]))
        assert recall(model, footage()) > 0.9
    assert bits[1] < 0.7 * bits[0]
