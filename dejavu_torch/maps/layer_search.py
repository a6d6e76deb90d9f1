"""The lowest score of two layers without the scores of all places."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

AHEAD = 2**12  # places that are compared together to find the first of equal ones


@torch.no_grad()
def lowest(one: Tensor, other: Tensor, places: int, divisor: float = 1.0) -> tuple[Tensor, Tensor]:
    """The lowest score of two layers and the first place that has it, bit for bit as a scan finds them.

    The score of place i is (one[i mod tau1] + other[i mod tau2]) / divisor. Among the places r, r + tau1,
    r + 2 tau1, ... the longer layer has one distance, and those of the shorter one are a window that slides
    along a circle of its residues: O(tau1 + tau2) for any number of places, which is at least the longer tau.
    Rounded sums are equal more often than their terms are, so the first of equal scores is sought among all r
    that reach the lowest.

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
    times, more = divmod(end, outer)  # the first `more` r have one place more
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
    """Residues modulo `inner` in the order in which steps of `outer` visit them, and where each r begins."""
    circles = math.gcd(outer, inner)
    starts, steps = torch.arange(circles), torch.arange(inner // circles)
    order = ((starts[:, None] + steps * outer) % inner).flatten()
    position = order.argsort()[torch.arange(outer) % inner]
    return order.to(device), position.to(device)


def sliding_minimum(values: Tensor, width: int) -> Tensor:
    """The lowest of each value and the width - 1 after it, around the circle of the last dimension, in O(n):
    every window is the end of one block of `width` values and the beginning of the next.

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
