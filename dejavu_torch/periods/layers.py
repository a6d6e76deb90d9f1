"""From the periods of single features to layers: features of similar period in one chunk (section III-A)."""

from __future__ import annotations

from fractions import Fraction
from typing import TypeVar

from torch import Tensor

from dejavu_torch.types import FrequencyLayer

Bin = TypeVar("Bin", int, Tensor)


def bin_period(length: int, k: Bin) -> Bin:
    """Period, in whole places, of bin k of a spectrum over `length` places: round(length / k), halves up.

    Example:
        >>> bin_period(1024, 11), bin_period(1024, 6)  # the paper's two periods
        (93, 171)
    """
    return (2 * length + k) // (2 * k)


def layers_of(bins: Tensor, start: int, stop: int) -> list[FrequencyLayer]:
    """Layers of the chunk [start, stop) by increasing period: features of equal `bin_period` share one.

    Args:
        bins: the strongest bins of each feature, -1 for none.

    Shape: bins (count,D) -> layers, phases = period.
    """
    rank, feature = (bins > 0).nonzero(as_tuple=True)
    period = bin_period(stop - start, bins[rank, feature])
    return [
        FrequencyLayer(Fraction(tau), tau, start, stop, tuple(feature[period == tau].unique().tolist()))
        for tau in period.unique().tolist()
    ]
