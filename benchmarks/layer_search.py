"""The lowest score of two layers without the scores of all places."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

AHEAD = 2**12  # places compared at a time to find the first of equal scores


@torch.no_grad()
def lowest(one: Tensor, other: Tensor, places: int, divisor: float = 1.0) -> tuple[Tensor, Tensor]:
    """The lowest score of two layers and its first place, bit for bit as a scan of all places finds them.

    The score of place i is (one[i mod tau1] + other[i mod tau2]) / divisor, for at least the longer tau
    places. At the places r, r + tau1, r + 2 tau1, ... the longer layer has a single distance, and the shorter
    one a window of a circle of its residues, whose minimum slides along: O(tau1 + tau2) for any number of
    places. Since rounding makes more sums equal, the first place is searched among all r with the lowest.

    Shape: (Q,tau1), (Q,tau2) -> (Q,), (Q,) int64; `places` if no score is finite.

    Example:
        >>> lowest(torch.tensor([[3.0, 0.0]]), torch.tensor([[1.0, 1.0, 0.0]]), places=6)
        (tensor([0.]), tensor([5]))
    """
    long, short = (one, other) if one.shape[1] >= other.shape[1] else (other, one)
    outer, inner = long.shape[1], short.shape[1]
    end = min(places, math.lcm(outer, inner))
    circle = inner // math.gcd(outer, inner)
    order, position = _circles(outer, inner, long.device)
    times, more = divmod(end, outer)  # the first `more` r have another place
    windows = sliding_minimum(short.index_select(1, order).unflatten(1, (-1, circle)), times)
    least = windows.flatten(1).index_select(1, position)
    last = (torch.arange(more, device=long.device) + times * outer) % inner
    least[:, :more] = torch.minimum(least[:, :more], short.index_select(1, last))
    scores = (long + least) / divisor
    best = scores.amin(1)

    first = torch.full_like(best, places, dtype=torch.int64)
    query, r = ((scores == best[:, None]) & best.isfinite()[:, None]).nonzero(as_tuple=True)
    step, last_step = 0, -(-end // outer)
    while len(query):
        steps = torch.arange(step, min(last_step, step + max(1, AHEAD // len(query))), device=long.device)
        place = r[:, None] + steps * outer
        score = (long[query, r][:, None] + short[query[:, None], place % inner]) / divisor
        missed = (score != best[query, None]) | (place >= end)
        first.scatter_reduce_(0, query, place.masked_fill(missed, places).amin(1), "amin")
        left = first[query] == places
        query, r, step = query[left], r[left], step + len(steps)
    return best, first


@lru_cache(maxsize=16)
def _circles(outer: int, inner: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Residues modulo `inner` in the order in which steps of `outer` visit them, and the start of each r."""
    circles = math.gcd(outer, inner)
    starts, steps = torch.arange(circles), torch.arange(inner // circles)
    order = ((starts[:, None] + steps * outer) % inner).flatten()
    position = order.argsort()[torch.arange(outer) % inner]
    return order.to(device), position.to(device)


def sliding_minimum(values: Tensor, width: int) -> Tensor:
    """The minimum of each value and the next width - 1, in a circle along the last dimension, in O(n): every
    window is the end of one block of `width` values and the start of the next.

    Source: M. van Herk, A fast algorithm for local minimum and maximum filters on rectangular and octagonal
        kernels, Pattern Recognition Letters 13 (1992).
    """
    size = values.shape[-1]
    length = -(-(size + width - 1) // width) * width
    turns = torch.cat([values] * -(-length // size), -1)
    parts = turns[..., :length].unflatten(-1, (-1, width))
    from_start = parts.cummin(-1).values.flatten(-2)
    to_end = parts.flip(-1).cummin(-1).values.flip(-1).flatten(-2)
    return torch.minimum(to_end[..., :size], from_start[..., width - 1 : width - 1 + size])
