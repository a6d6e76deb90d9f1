"""From the periods of single features to layers: features of similar period in one chunk (section III-A)."""

from __future__ import annotations

from fractions import Fraction

import torch
from torch import Tensor

from dejavu_torch.types import FrequencyLayer


def cluster_periods(periods: Tensor, counts: Tensor, length: int, similar: float) -> Tensor:
    """Name for each period the layer it goes to: the most common period not further than `similar` bins.

    Two periods a, b of a chunk of `length` frames are |length / a - length / b| bins apart. The most
    common period (of equals the shortest) founds a layer and takes in all free periods within
    `similar` bins of it; then the most common of those left, and so on.

    Shape: (T,) distinct periods, (T,) how many features have each -> (T,) the period of its layer.

    Example:
        >>> cluster_periods(torch.tensor([93, 102, 171]), torch.tensor([9, 2, 5]), 1024, similar=1.0)
        tensor([ 93,  93, 171])
    """
    owner = torch.zeros_like(periods)
    frequency = length / periods.double()
    for index in sorted(range(len(periods)), key=lambda j: (-int(counts[j]), int(periods[j]))):
        if owner[index] == 0:
            near = (frequency - frequency[index]).abs() <= similar
            owner[near & (owner == 0)] = periods[index]
    return owner


def cluster_layers(bins: Tensor, start: int, stop: int, similar: float) -> list[FrequencyLayer]:
    """Group the features of the chunk [start, stop) by similar period into layers.

    Args:
        bins: (count,D) the strongest bins of each feature, -1 for none.
        similar: see `cluster_periods`.

    Returns:
        Layers by increasing period, phases = period; a feature stands in a layer once.
    """
    length = stop - start
    rank, feature = (bins > 0).nonzero(as_tuple=True)
    k = bins[rank, feature]
    period = (2 * length + k) // (2 * k)  # round(length / k), halves up: bin_period
    distinct, member, counts = period.unique(return_inverse=True, return_counts=True)
    owner = cluster_periods(distinct, counts, length, similar)[member]
    layers = []
    for tau in owner.unique().tolist():
        chosen = feature[owner == tau].unique().tolist()
        layers.append(FrequencyLayer(Fraction(tau), tau, start, stop, tuple(chosen)))
    return layers
