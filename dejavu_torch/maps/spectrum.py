"""Orthonormal real transforms along time; the coefficients are called lines."""

from __future__ import annotations

import math
from fractions import Fraction
from functools import lru_cache
from typing import Literal, TypeVar

import torch
from torch import Tensor, nn

Transform = Literal["dft", "dct"]
N = TypeVar("N", int, Tensor)


def spectrum(series: Tensor, transform: Transform = "dft") -> Tensor:
    """The W lines of a series of W numbers.

    Args:
        series: float; gradients pass.
        transform: "dft": line 0 is the mean, lines 2k - 1 and 2k are the cosine and the sine of k cycles (at
            W / 2 cycles only the cosine). "dct" (DCT-II): line r is the cosine of r half cycles.

    Shape: (...,W) -> (...,W).

    Convention: orthonormal: the squares of the lines add up to those of the series.

    Example:
        >>> wave = torch.cos(torch.arange(8) * torch.pi / 2)  # two cycles
        >>> spectrum(wave).round(decimals=4).abs().tolist()
        [0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0]
    """
    count = series.shape[-1]
    if transform == "dct":
        halves: Tensor = torch.fft.rfft(torch.cat([series, series.flip(-1)], -1), norm="ortho")[..., :count]
        cosine, sine = _quarter_steps(series)
        return (halves.real * cosine + halves.imag * sine) * _scale(series, transform)
    parts = torch.view_as_real(torch.fft.rfft(series, norm="ortho")).flatten(-2)
    lines = torch.cat([parts[..., :1], parts[..., 2 : count + 1]], -1)  # 0 and W / 2 cycles have no sine
    return lines * _scale(series, transform)


def from_spectrum(lines: Tensor, transform: Transform = "dft") -> Tensor:
    """The inverse of `spectrum`: (...,W) -> (...,W)."""
    count = lines.shape[-1]
    slot, factor = slots(count, transform, lines.dtype, lines.device)
    slotted = lines.new_zeros(*lines.shape[:-1], len(factor)).index_copy(-1, slot, lines)
    return from_slots(slotted * factor, count, transform)


def lines_of(series: Tensor, columns: int = 1, transform: Transform = "dft") -> Tensor:
    """The W lines of W places in rows of some columns, one row after the other; of a route in one column.

    Shape: (...,W) -> (...,W).

    Convention: `spectrum` along columns and along rows; the lines in the order of `by_frequency`.
    """
    if columns == 1:
        return spectrum(series, transform)
    plane = spectrum(series.unflatten(-1, (-1, columns)), transform)
    plane = spectrum(plane.mT, transform).mT
    rows = plane.shape[-2]
    return plane.flatten(-2)[..., by_frequency(rows, columns, transform, series.device)]


def from_lines(lines: Tensor, columns: int = 1, transform: Transform = "dft") -> Tensor:
    """The inverse of `lines_of`: (...,W) -> (...,W)."""
    if columns == 1:
        return from_spectrum(lines, transform)
    rows = lines.shape[-1] // columns
    order = by_frequency(rows, columns, transform, lines.device)
    plane = torch.zeros_like(lines).index_copy(-1, order, lines).unflatten(-1, (rows, columns))
    plane = from_spectrum(plane.mT.contiguous(), transform).mT.contiguous()
    return from_spectrum(plane, transform).flatten(-2)


def by_frequency(rows: int, columns: int, transform: Transform, device: torch.device) -> Tensor:
    """The lines of a plane, row x columns + column, by the sum of the squares of both frequencies, (W,)
    int64: alike ones then are near each other, as the coder expects. Cached: do not change it."""
    with torch.inference_mode(False):  # cached tensors are also used with gradients
        return _by_frequency(rows, columns, transform, device)


@lru_cache(64)
def _by_frequency(rows: int, columns: int, transform: Transform, device: torch.device) -> Tensor:
    # whole numbers, whose order is the same on any machine
    down, across = (half_cycles(torch.arange(n), transform).square() for n in (rows, columns))
    key = down[:, None] * columns**2 + across * rows**2
    return key.flatten().argsort(stable=True).to(device)


def slots(n: int, transform: Transform, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """For `from_slots`: the slot of each of n lines, (n,) int64, and the factor of each of S slots, (S,), 0
    without a line. Both are cached: do not change them."""
    if torch.compiler.is_compiling() or type(torch.empty(0)) is not Tensor:  # a mode of fake tensors
        return _slots(n, transform, dtype, device)
    with torch.inference_mode(False):  # cached tensors are also used with gradients
        return _cached_slots(n, transform, dtype, device)


def _slots(n: int, transform: Transform, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    slot, size = torch.arange(n, device=device), n
    if transform == "dft":  # pairs of a cosine and a sine; the mean has no sine
        slot, size = slot + (slot > 0), 2 * (n // 2) + 2
    scale = 1 / _scale(torch.empty(n, dtype=dtype, device=device), transform)
    return slot, scale.new_zeros(size).index_copy(0, slot, scale)


_cached_slots = lru_cache(32)(_slots)  # computing them takes longer than the transform of a single query


def from_slots(slotted: Tensor, count: int, transform: Transform) -> Tensor:
    """The series of W = `count` numbers from lines in their `slots`: (...,S) -> (...,W)."""
    if transform == "dct":
        parts = [nn.functional.pad(slotted * factor, (0, 1)) for factor in _quarter_steps(slotted)]
        mirrored: Tensor = torch.fft.irfft(torch.complex(*parts), n=2 * count, norm="ortho")
        return mirrored[..., :count]
    pairs = torch.view_as_complex(slotted.unflatten(-1, (-1, 2)))
    series: Tensor = torch.fft.irfft(pairs, n=count, norm="ortho")
    return series


def half_cycles(line: N, transform: Transform) -> N:
    """Number of half cycles of a line over the series."""
    return line if transform == "dct" else (line + 1) // 2 * 2


def frequencies(rows: int, columns: int, transform: Transform) -> Tensor:
    """Cycles per place of each line of `lines_of`, down the rows and across the columns, (W,2) float64."""
    down, across = (half_cycles(torch.arange(n), transform).double() / (2 * n) for n in (rows, columns))
    return torch.cartesian_prod(down, across).view(-1, 2)[
        by_frequency(rows, columns, transform, torch.device("cpu"))
    ]


def period_of(line: int, count: int, transform: Transform = "dft") -> Fraction:
    """The period of a line above 0, in steps of a series of W = `count`: W / k for k cycles."""
    return Fraction(2 * count, half_cycles(line, transform))


def _scale(values: Tensor, transform: str) -> Tensor:
    """The factors that make torch's transform orthonormal, (W,)."""
    count = values.shape[-1]
    scale = torch.ones(count, dtype=values.dtype, device=values.device)
    if transform == "dct":
        scale[:1] /= math.sqrt(2)
    else:
        scale[1 : count - (count % 2 == 0)] *= math.sqrt(2)
    return scale


def _quarter_steps(values: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine and sine of pi r / 2W, (W,): the mirrored series starts half a step before the first place."""
    count = values.shape[-1]
    angles = torch.arange(count, dtype=torch.float64, device=values.device) * (math.pi / (2 * count))
    return angles.cos().to(values.dtype), angles.sin().to(values.dtype)
