"""How many places a set of periods can tell apart: the mutual support of frequencies."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import count

import numpy as np

SMALLEST = 4  # period: a layer of 2 or 3 phases hardly tells places from noise
CORRECTS = 1  # wrong layers that supportive periods survive


def common_period(periods: Sequence[Fraction | int]) -> Fraction:
    """Least common multiple of one or more periods: the number of places they can tell apart.

    Example:
        >>> common_period([93, 171]), common_period([Fraction(195, 2), 171])  # 93 and 171 share a factor 3
        (Fraction(5301, 1), Fraction(11115, 1))
    """
    numerators, denominators = zip(*(Fraction(period).as_integer_ratio() for period in periods), strict=True)
    return Fraction(math.lcm(*numerators), math.gcd(*denominators))


def support_of(periods: Sequence[int], places: int) -> tuple[int, int]:
    """How whole periods >= 1 support each other over a route of at least 3 places: two distances.

    The code distance d is in how many layers any two places differ at least; (d - 1) // 2 wrong layers are
    survived. The torus distance is the least sum over layers of min(D mod tau, tau - D mod tau), D > 1 places
    apart.

    Source: R. W. Watson and C. W. Hastings, Self-checked computation using residue arithmetic, Proc. IEEE
        54 (1966).

    Example:
        >>> support_of([4, 5, 7], 100)
        (1, 1)
    """
    tau = np.array(periods)[:, None]
    phase = np.arange(1, places) % tau  # of every difference D
    around = np.minimum(phase, tau - phase).sum(0)
    return int((phase != 0).sum(0).min()), int(around[1:].min())


def supportive_periods(places: int) -> tuple[int, ...]:
    """Distinct whole periods >= 4, increasing, that tell the places apart, also with one layer wrong.

    Convention: the pairwise co-prime set of the fewest templates; of several the one of the largest code
        distance, then of the largest torus distance, then of the longest shortest period.

    Example:
        >>> supportive_periods(540)
        (4, 5, 7, 9, 11, 13)
    """

    def suffices(chosen: tuple[int, ...]) -> bool:
        """Whether any but 2 * CORRECTS of them, at worst the smallest, tell the places apart."""
        core = len(chosen) - 2 * CORRECTS
        return core > 0 and math.prod(chosen[:core]) >= places

    totals = ([*filter(suffices, _co_prime_sets(total, SMALLEST))] for total in count(SMALLEST))
    return max(next(filter(None, totals)), key=lambda chosen: (support_of(chosen, max(places, 3)), chosen))


def _co_prime_sets(total: int, smallest: int, chosen: tuple[int, ...] = ()) -> Iterator[tuple[int, ...]]:
    """Rising pairwise co-prime sets that begin with those chosen and go on with some of this total."""
    if not total:
        yield chosen
    for period in (*range(smallest, (total + 1) // 2), total):  # the last one, or one that leaves a larger
        if period >= smallest and all(math.gcd(period, other) == 1 for other in chosen):
            yield from _co_prime_sets(total - period, period + 1, (*chosen, period))
