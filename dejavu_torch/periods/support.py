"""How many places a set of periods can tell apart: the mutual support of frequencies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction


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
