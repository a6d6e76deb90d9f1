"""How many places a set of periods can tell apart: the mutual support of frequencies."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import combinations, count
from typing import NamedTuple

import numpy as np

from dejavu_torch.types import InputError


def common_period(periods: Sequence[Fraction | int]) -> Fraction:
    """Least common multiple of the periods: the number of places they can tell apart.

    Not their product: the paper's 93 and 171 share a factor 3. With fractions it is the shortest
    time after which all of them are back at phase 0.

    Raises:
        ValueError: no periods.

    Example:
        >>> common_period([93, 171]), common_period([Fraction(195, 2), 171])
        (Fraction(5301, 1), Fraction(11115, 1))
    """
    exact = [Fraction(period) for period in periods]
    if not exact:
        raise ValueError("common_period got no periods; expected at least one")
    return Fraction(
        math.lcm(*(period.numerator for period in exact)), math.gcd(*(period.denominator for period in exact))
    )


def shared_factor(a: Fraction | int, b: Fraction | int) -> Fraction:
    """Greatest common divisor of two periods; 1 for co-prime whole periods.

    Example:
        >>> shared_factor(93, 171), shared_factor(Fraction(195, 2), 171)
        (Fraction(3, 1), Fraction(3, 2))
    """
    a, b = Fraction(a), Fraction(b)
    return Fraction(math.gcd(a.numerator, b.numerator), math.lcm(a.denominator, b.denominator))


class Support(NamedTuple):
    """How whole periods support each other over a route of N places.

    periods: in places. templates: their sum. common_period: places they can tell apart. shared_factors:
    greatest common divisor of each pair. code_distance: least number of layers in which two places differ,
    the Hamming distance of their residue code; 0 where no layer tells them apart. corrects: how many wrong
    layers the nearest code word survives, floor((code_distance - 1) / 2), at least 0. torus_distance: least
    distance of two places on the torus of their phases, sum over layers of min(D mod tau, tau - D mod tau)
    for two places D > 1 apart.

    Source: R. W. Watson and C. W. Hastings, Self-checked computation using residue arithmetic, Proc. IEEE
        54 (1966).
    """

    periods: tuple[int, ...]
    templates: int
    common_period: int
    shared_factors: tuple[int, ...]
    code_distance: int
    corrects: int
    torus_distance: int


def support_of(periods: Sequence[int], places: int) -> Support:
    """The mutual support of whole periods over a route.

    Args:
        periods: in places, each at least 1.
        places: N, places of the route, at least 3.

    Raises:
        InputError: no periods, one that is not a whole number >= 1, or too few places.

    Example:
        >>> support_of([4, 5, 7], 100)
        Support(periods=(4, 5, 7), templates=16, common_period=140, shared_factors=(1, 1, 1),
                code_distance=1, corrects=0, torus_distance=1)
    """
    if not periods or any(period < 1 or period != int(period) for period in periods) or places < 3:
        raise InputError(
            f"support_of got the periods {[*periods]} for {places} places; expected at least one, whole and "
            ">= 1, and at least 3 places"
        )
    whole = tuple(int(period) for period in periods)
    phases = [np.arange(1, places) % period for period in whole]  # of every difference D
    differ = int(np.sum([phase != 0 for phase in phases], 0).min())
    around = [np.minimum(phase, period - phase) for phase, period in zip(phases, whole, strict=True)]
    return Support(
        whole,
        sum(whole),
        math.lcm(*whole),
        tuple(math.gcd(a, b) for a, b in combinations(whole, 2)),
        differ,
        max(0, (differ - 1) // 2),
        int(np.sum(around, 0)[1:].min()),
    )


def supportive_periods(places: int, corrects: int = 1, smallest: int = 4) -> tuple[int, ...]:
    """Distinct whole periods, increasing, that tell the places apart, also with some layers wrong.

    Args:
        places: N, places to tell apart, at least 2.
        corrects: wrong layers to survive, >= 0.
        smallest: shortest period allowed, >= 2; a layer of 2 or 3 phases hardly tells places from noise.

    Convention: the pairwise co-prime set of the fewest templates that does so. Of several the one of the
        largest code distance, then of the largest torus distance, then of the longest shortest period.

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

    def quality(chosen: tuple[int, ...]) -> tuple[int, int, tuple[int, ...]]:
        support = support_of(chosen, max(places, 3))
        return support.code_distance, support.torus_distance, chosen

    def tells(chosen: tuple[int, ...]) -> bool:
        """Whether any but 2 * corrects of them, at worst the smallest, tell the places apart."""
        core = len(chosen) - 2 * corrects
        return core > 0 and math.prod(chosen[:core]) >= places

    totals = (list(filter(tells, _co_prime_sets(total, smallest))) for total in count(smallest))
    return max(next(filter(None, totals)), key=quality)


def _co_prime_sets(total: int, smallest: int, chosen: tuple[int, ...] = ()) -> Iterator[tuple[int, ...]]:
    """Rising pairwise co-prime sets that begin with those chosen and go on with some of this total."""
    if not total:
        yield chosen
    for period in (*range(smallest, (total + 1) // 2), total):  # the last one, or one that leaves a larger
        if period >= smallest and all(math.gcd(period, other) == 1 for other in chosen):
            yield from _co_prime_sets(total - period, period + 1, (*chosen, period))
