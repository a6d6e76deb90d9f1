"""How many places a set of periods can distinguish: the mutual support of frequencies."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import count

import numpy as np

MIN_PERIOD = 4  # with 2 or 3 phases a layer hardly stands out from noise
CORRECTS = 1  # wrong layers that supportive periods tolerate


def common_period(periods: Sequence[Fraction | int]) -> Fraction:
    """Least common multiple of one or more periods: the number of places they can distinguish.

    Example:
        >>> common_period([93, 171]), common_period([Fraction(195, 2), 171])  # 93 and 171 share a factor 3
        (Fraction(5301, 1), Fraction(11115, 1))
    """
    numerators, denominators = zip(*(Fraction(period).as_integer_ratio() for period in periods), strict=True)
    return Fraction(math.lcm(*numerators), math.gcd(*denominators))


def support_of(periods: Sequence[int], places: int) -> tuple[int, int]:
    """Code distance and torus distance of integer periods >= 1 over a route of at least 3 places.

    Two places differ in at least d layers, the code distance, which corrects (d - 1) // 2 wrong layers. The
    torus distance is the minimum over D > 1 of the sum over layers of min(D mod tau, tau - D mod tau).

    Source: Watson and Hastings, Self-checked computation using residue arithmetic, Proc. IEEE 54 (1966).

    Example:
        >>> support_of([4, 5, 7], 100)
        (1, 1)
    """
    tau = np.array(periods)[:, None]
    phase = np.arange(1, places) % tau  # of every difference D
    torus = np.minimum(phase, tau - phase).sum(0)
    return int((phase != 0).sum(0).min()), int(torus[1:].min())


def supportive_periods(places: int) -> tuple[int, ...]:
    """Distinct integer periods >= 4, increasing, that distinguish the places even with one layer wrong.

    Convention: the pairwise co-prime set with the fewest templates; among several, the one with the largest
        code distance, then the largest torus distance, then the longest shortest period.

    Example:
        >>> supportive_periods(540)
        (4, 5, 7, 9, 11, 13)
    """

    def suffices(chosen: tuple[int, ...]) -> bool:
        """Whether the smallest, all but 2 * CORRECTS of them, distinguish the places."""
        core = len(chosen) - 2 * CORRECTS
        return core > 0 and math.prod(chosen[:core]) >= places

    totals = ([*filter(suffices, _co_prime_sets(total, MIN_PERIOD))] for total in count(MIN_PERIOD))
    return max(next(filter(None, totals)), key=lambda chosen: (support_of(chosen, max(places, 3)), chosen))


def _co_prime_sets(total: int, smallest: int, chosen: tuple[int, ...] = ()) -> Iterator[tuple[int, ...]]:
    """Increasing pairwise co-prime sets: the chosen periods, then others that add up to `total`."""
    if not total:
        yield chosen
    for period in (*range(smallest, (total + 1) // 2), total):  # the last one, or one that leaves a larger
        if period >= smallest and all(math.gcd(period, other) == 1 for other in chosen):
            yield from _co_prime_sets(total - period, period + 1, (*chosen, period))
