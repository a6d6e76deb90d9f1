"""How many places a set of periods can tell apart: the mutual support of frequencies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from functools import cache
from itertools import combinations, count, islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dejavu_torch.types import InputError

COMPARED = 2**14  # sets whose torus distances `supportive_periods` compares, about a second's worth


def common_period(periods: Sequence[Fraction | int]) -> Fraction:
    """Least common multiple of the periods, in frames: the number of places they can tell apart.

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


def torus_distance(periods: Sequence[Fraction | int], places: int, tolerance: int = 0) -> Fraction | int:
    """Least distance of two places on the torus of their phases: sum of min(D mod tau, tau - D mod tau).

    Args:
        periods: tau of each layer, > 0, in places.
        places: N, places of the route, more than tolerance + 1.
        tolerance: places this far apart or less count as one, so they are not compared.

    Convention: the least over all lags tolerance < D < places, hence at most L * (tolerance + 1) for L
        layers; 0 is a pair of places that no layer tells apart. Exact, an int where all periods are whole.

    Raises:
        InputError: no periods, a period <= 0, a tolerance < 0, or no two places further apart than that.

    Example:
        >>> torus_distance([93, 171], 1024, tolerance=5), torus_distance([92, 171], 1024, tolerance=5)
        (3, 12)
    """
    exact = [Fraction(period) for period in periods]
    if not exact or min(exact) <= 0:
        raise InputError(f"torus_distance got the periods {[*periods]}; expected at least one, all > 0")
    if tolerance < 0 or places < tolerance + 2:
        raise InputError(f"torus_distance got {places=}, {tolerance=}; expected 0 <= tolerance <= places - 2")
    unit = math.lcm(*(period.denominator for period in exact))
    fits = unit * max(places, sum(exact)) < 2**62
    lags = np.arange(tolerance + 1, places, dtype=np.int64 if fits else object) * unit
    least = int(np.sum([_around(lags, int(period * unit)) for period in exact], 0).min())
    return least if unit == 1 else Fraction(least, unit)


def code_distance(periods: Sequence[int], places: int) -> int:
    """Least number of layers in which two places differ: the Hamming distance of their residue code.

    Args:
        periods: whole, >= 1, in places.
        places: N, places of the route, at least 2.

    Convention: the least over all lags 0 < D < places; 0 where two places agree in all layers.

    Raises:
        InputError: no periods, a period that is not a whole number >= 1, or fewer than 2 places.

    Source: R. W. Watson and C. W. Hastings, Self-checked computation using residue arithmetic, Proc. IEEE
        54 (1966).

    Example:
        >>> code_distance([5, 7, 8, 9, 11, 13], 540), code_distance([5, 7], 36)
        (3, 0)
    """
    if not periods or any(period < 1 or period != int(period) for period in periods):
        raise InputError(f"code_distance got the periods {[*periods]}; expected at least one, whole and >= 1")
    if places < 2:
        raise InputError(f"code_distance got {places} places; expected at least 2")
    differ = [np.arange(1, places) % min(int(period), places) != 0 for period in periods]
    return int(np.sum(differ, 0).min())


def corrects(periods: Sequence[int], places: int) -> int:
    """How many wrong layers the nearest code word survives: floor((code_distance - 1) / 2).

    Args, Raises: see `code_distance`.

    Convention: 0 where one wrong layer can mislead, and for aliases too, which right layers confuse.

    Example:
        >>> corrects([5, 7, 8, 9, 11, 13], 540), corrects([5, 7], 36)
        (1, 0)
    """
    return max(0, (code_distance(periods, places) - 1) // 2)


class Support(NamedTuple):
    """How a set of whole periods supports each other over a route.

    periods: in places. templates: their sum. common_period: places they can tell apart. shared_factors:
    of each pair. torus_distance, corrects: see the functions; a torus distance of 0 says aliases.
    """

    periods: tuple[int, ...]
    templates: int
    common_period: int
    shared_factors: tuple[int, ...]
    torus_distance: int
    corrects: int


def support_of(periods: Sequence[int], places: int, tolerance: int = 1) -> Support:
    """The mutual support of whole periods over a route; by default neighbours count as one place.

    Args, Raises: see `torus_distance` and `code_distance`.

    Example:
        >>> support_of([4, 5, 7], 100)
        Support(periods=(4, 5, 7), templates=16, common_period=140, shared_factors=(1, 1, 1),
                torus_distance=1, corrects=0)
    """
    survives = corrects(periods, places)
    whole = tuple(int(period) for period in periods)
    shared = tuple(math.gcd(a, b) for a, b in combinations(whole, 2))
    apart = int(torus_distance(whole, places, tolerance))
    return Support(whole, sum(whole), math.lcm(*whole), shared, apart, survives)


def supportive_periods(
    places: int,
    templates: int | None = None,
    corrects: int = 1,
    layers: int | None = None,
    smallest: int = 4,
) -> tuple[int, ...]:
    """Distinct whole periods, increasing, that tell the places apart, also with some layers wrong.

    Args:
        places: N, places to tell apart, at least 2.
        templates: the most the periods may sum to; None is the least that will do. The search is quick up to
            a few hundred.
        corrects: wrong layers to survive, >= 0.
        layers: L; None lets the search choose.
        smallest: shortest period allowed, >= 2; a layer of 2 or 3 phases hardly tells places from noise.

    Convention: of the pairwise co-prime sets that fit (others are not tried) the one of the largest code
        distance, then of the largest torus distance with a tolerance of 1, then of the fewest templates,
        then of the longest shortest period. The torus distance is in places, not in shares of a circle: it
        prefers long periods where the code distance prefers many. Of more than `COMPARED` sets of the
        largest code distance those of fewest templates are compared.

    Raises:
        InputError: an argument out of range, or no set that fits, naming the smallest budget that would.

    Example:
        >>> supportive_periods(540), supportive_periods(540, 104, layers=4)
        ((4, 5, 7, 9, 11, 13), (23, 25, 27, 29))
    """
    if places < 2 or corrects < 0 or smallest < 2 or (layers is not None and layers <= 2 * corrects):
        raise InputError(
            f"supportive_periods got {places=}, {corrects=}, {layers=}, {smallest=}; expected places >= 2, "
            "corrects >= 0, layers > 2 * corrects, smallest >= 2"
        )
    distance = 2 * corrects + 1
    fewest = sum(next(_co_prime_sets(places, distance, layers, smallest, count(smallest))))
    most = fewest if templates is None else templates
    if fewest > most:
        raise InputError(
            f"no {layers or 'set of'} co-prime periods >= {smallest} with {templates} templates tell "
            f"{places} places apart with {corrects} layers wrong; expected at least {fewest} templates"
        )
    totals = range(fewest, most + 1)
    while next(_co_prime_sets(places, distance + 1, layers, smallest, totals), None):
        distance += 1
    lags, small = np.arange(2, places), np.min_scalar_type(most)  # small numbers add up faster
    around = cache(lambda period: _around(lags, period).astype(small))
    best: tuple[int, int, tuple[int, ...]] = (-1, 0, ())
    for chosen in islice(_co_prime_sets(places, distance, layers, smallest, totals), COMPARED):
        if layers and best[0] == 2 * layers and sum(chosen) > -best[1]:
            break  # the lag 2 allows no more, and from here on the sets only cost more
        apart = sum((around(period) for period in chosen), np.zeros(1, small))
        best = max(best, (int(apart.min(initial=2 * len(chosen))), -sum(chosen), chosen))
    return best[2]


def _around(lags: NDArray[Any], period: int) -> Any:
    """How far around the circle of one period each lag ends from where it began."""
    phase = lags % period
    return np.minimum(phase, period - phase)


def _co_prime_sets(
    places: int, distance: int, layers: int | None, smallest: int, totals: Iterable[int]
) -> Iterator[tuple[int, ...]]:
    """Pairwise co-prime sets of at least this code distance, in the order of what they sum to."""
    for total in totals:
        for length in [layers] if layers else range(distance, total // smallest + 1):
            # where distance - 1 layers agree, the rest must tell the places apart; so many 2s always do
            core = min(length - distance + 1, places.bit_length())
            if core > 0 and (total / length) ** core >= places:
                yield from _summing_to(total, range(smallest, total + 1), length, core, places)


def _summing_to(
    total: int, candidates: Sequence[int], length: int, core: int, places: int
) -> Iterator[tuple[int, ...]]:
    """Pairwise co-prime choices of rising candidates whose `core` smallest multiply to `places` or more."""
    if length == 1:
        if total in candidates and (not core or total >= places):
            yield (total,)
        return
    # no two of a choice share their least prime factor: it sums to no less than the first of each
    firsts = sorted({_least_factor(period): period for period in reversed(candidates)}.values())
    if len(firsts) < length or sum(firsts[:length]) > total:
        return
    for position, period in enumerate(candidates):
        rest = total - period
        if period * length > total:
            return
        if core and period * (rest / (length - 1)) ** (core - 1) < places:
            continue  # even all equal, the others would multiply to too little
        others = [other for other in candidates[position + 1 :] if math.gcd(period, other) == 1]
        for more in _summing_to(rest, others, length - 1, max(core - 1, 0), -(-places // period)):
            yield (period, *more)


@cache
def _least_factor(number: int) -> int:
    return next((factor for factor in range(2, math.isqrt(number) + 1) if number % factor == 0), number)
