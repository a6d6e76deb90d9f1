"""Proxies of a route's stretches as a map would hold them: few lines of their spectra, and their bits."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.maps.quantisation import quantise
from dejavu_torch.maps.spectrum import Transform, from_spectrum
from dejavu_torch.training.losses import laplace_bits
from dejavu_torch.types import InputError

STEP = 0.5  # of the lines' RMS, at the start
PER_OCTAVE = 2  # bands of frequency that have a width of their own
LEAST = 1e-24  # of the lines' mean square: the root of 0 has no gradient


class Coded(NamedTuple):
    """proxies: (W,K), whose length means nothing. bits: scalar, what their lines take in all."""

    proxies: Tensor
    bits: Tensor


def bands_of(lines: int, transform: Transform = "dft") -> Tensor:
    """The band of frequencies of each line of a spectrum, half an octave wide; 0 is the mean alone.

    Shape: -> (lines,) int64.

    Example:
        >>> bands_of(9)
        tensor([0, 3, 3, 5, 5, 6, 6, 7, 7])
    """
    line = torch.arange(lines)
    half_cycles = line if transform == "dct" else (line + 1) // 2 * 2
    return ((half_cycles.clamp(min=1).double().log2() * PER_OCTAVE).long() + 1) * (half_cycles > 0)


def coded_proxies(
    lines: Tensor, log_step: Tensor, log_widths: Tensor, transform: Transform = "dft", noise: bool = True
) -> Coded:
    """A proxy for each stretch of a route, rebuilt from the quantised lines of their spectra over the route.

    A network whose descriptors follow the proxies learns features of few frequencies, as a `SpectralMap` of
    few bytes holds them. All arguments are learned: lines, the step that they are coded in, and an entropy
    model, the widths of a Laplace distribution of the levels.

    Args:
        lines: of any RMS, see `spectrum`; W stretches, at least 2.
        log_step: of the step, beside an RMS of 1.
        log_widths: in steps, for each band (`bands_of`) and feature, in this order.
        transform: of the lines.
        noise: whether the bits are those of levels with uniform noise in place of the rounding error.

    Shape: (W,K), scalar, (bands * K,) -> Coded.

    Convention: rounding is that of the map (`quantise`), whose gradient passes straight through.

    Source: Ballé, Laparra and Simoncelli, ICLR 2017, for the bits; Minnen and Singh, ICIP 2020, for noise in
        the bits and rounding in what is rebuilt.

    Raises:
        InputError: shapes that do not fit.

    Example:
        >>> lines, widths = torch.randn(40, 8), torch.zeros(8 * (bands_of(40).max() + 1))
        >>> coded = coded_proxies(lines, torch.tensor(-0.7), widths)
        >>> coded.proxies.shape, bool(coded.bits > 0)
        (torch.Size([40, 8]), True)
    """
    if lines.ndim != 2 or len(lines) < 2 or not lines.shape[1]:
        raise InputError(f"the lines are {tuple(lines.shape)}; expected (W,K), at least 2 stretches")
    band = bands_of(len(lines), transform).to(lines.device)
    expected = (int(band.max()) + 1) * lines.shape[1]
    if tuple(log_widths.shape) != (expected,):
        raise InputError(f"the widths are {tuple(log_widths.shape)}; expected ({expected},)")
    wanted = lines / lines.square().mean().clamp(min=LEAST).sqrt() / log_step.exp()
    levels = wanted + (quantise(wanted.detach(), 1.0) - wanted).detach()
    noisy = wanted + torch.rand(wanted.shape, dtype=wanted.dtype).to(wanted) - 0.5 if noise else wanted
    widths = log_widths.exp().unflatten(0, (-1, lines.shape[1]))[band]
    return Coded(from_spectrum(levels.T, transform).T, laplace_bits(noisy, widths).sum())
