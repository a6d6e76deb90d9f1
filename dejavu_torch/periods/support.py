"""How many places a set of periods can tell apart: the mutual support of frequencies."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import count
from typing import NamedTuple

import numpy as np

from dejavu_torch.types import InputError


def common_period(periods: Sequence[Fraction | int]) -> Fraction:
    """Least common multiple of the periods, at least one: the number of places they can tell apart.

    Not their product: the paper's 93 and 171 share a factor 3.

    Example:
        >>> common_period([93, 171]), common_period([Fraction(195, 2), 171])
        (Fraction(5301, 1), Fraction(11115, 1))
    """
    numerators, denominators = zip(*(Fraction(period).as_integer_ratio() for period in periods), strict=True)
    return Fraction(math.lcm(*numerators), math.gcd(*denominators))


def shared_factor(a: Fraction | int, b: Fraction | int) -> Fraction:
    """Greatest common divisor of two periods; 1 for co-prime whole periods.

    Example:
        >>> shared_factor(93, 171), shared_factor(Fraction(195, 2), 171)
        (Fraction(3, 1), Fraction(3, 2))
    """
    a, b = Fraction(a), Fraction(b)
    return Fraction(math.gcd(a.numerator, b.numerator), math.lcm(a.denominator, b.denominator))


class Support(NamedTuple):
    """How whole periods support each other over a route.

    code_distance: least number of layers in which two places differ, the Hamming distance of their residue
    code; 0 if some look alike. torus_distance: least distance of two places D > 1 apart on the torus of
    their phases, sum over layers of min(D mod tau, tau - D mod tau).

    Source: R. W. Watson and C. W. Hastings, Self-checked computation using residue arithmetic, Proc. IEEE
        54 (1966).
    """

    code_distance: int
    torus_distance: int

    @property
    def corrects(self) -> int:
        """How many wrong layers the nearest code word survives."""
        return max(0, (self.code_distance - 1) // 2)


def support_of(periods: Sequence[int], places: int) -> Support:
    """The mutual support of whole periods, each at least 1, over a route of at least 3 places.

    Example:
        >>> support_of([4, 5, 7], 100)
        Support(code_distance=1, torus_distance=1)
    """
    tau = np.array(periods)[:, None]
    phase = np.arange(1, places) % tau  # of every difference D
    around = np.minimum(phase, tau - phase).sum(0)
    return Support(int((phase != 0).sum(0).min()), int(around[1:].min()))


def supportive_periods(places: int, corrects: int = 1, smallest: int = 4) -> tuple[int, ...]:
    """Distinct whole periods, increasing, that tell the places apart, also with some layers wrong.

    Args:
        places: N, places to tell apart, at least 2.
        corrects: wrong layers to survive, >= 0.
        smallest: shortest period allowed, >= 2; a layer of 2 or 3 phases hardly tells places from noise.

    Convention: the pairwise co-prime set of the fewest templates; of several the one of the largest code
        distance, then of the largest torus distance, then of the longest shortest period.

    Raises:
        InputError: an argument out of range.

    Example:
        >>> supportive_periods(540), supportive_periods(540, corrects=0)
        ((4, 5, 7, 9, 11, 13), (4, 5, 7, 9))
    """
    if places < 2 or corrects < 0 or smallest < 2:
        raise InputError(
            f"supportive_periods got {places=}, {corrects=}, {smallest=}; expected places >= 2, "
            "corrects >= 0, smallest >= 2"
        )

    def suffices(chosen: tuple[int, ...]) -> bool:
        """Whether any but 2 * corrects of them, at worst the smallest, tell the places apart."""
        core = len(chosen) - 2 * corrects
        return core > 0 and math.prod(chosen[:core]) >= places

    totals = ([*filter(suffices, _co_prime_sets(total, smallest))] for total in count(smallest))
    return max(next(filter(None, totals)), key=lambda chosen: (support_of(chosen, max(places, 3)), chosen))


def _co_prime_sets(total: int, smallest: int, chosen: tuple[int, ...] = ()) -> Iterator[tuple[int, ...]]:
    """Rising pairwise co-prime sets that begin with those chosen and go on with some of this total."""
    if not total:
        yield chosen
    for period in (*range(smallest, (total + 1) // 2), total):  # the last one, or one that leaves a larger
        if period >= smallest and all(math.gcd(period, other) == 1 for other in chosen):
            yield from _co_prime_sets(total - period, period + 1, (*chosen, period))
