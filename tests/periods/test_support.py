"""Least common multiples and greatest common divisors of exact periods."""

from __future__ import annotations

from fractions import Fraction
from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.periods.support import common_period, shared_factor

PERIODS = st.builds(Fraction, st.integers(1, 60), st.integers(1, 6))


def test_the_papers_periods_share_a_factor_3() -> None:
    assert shared_factor(93, 171) == 3
    assert common_period([93, 171]) == 5301


@given(st.lists(PERIODS, min_size=1, max_size=3))
def test_common_period_is_the_first_time_all_are_back(periods: list[Fraction]) -> None:
    common = common_period(periods)
    first = next(
        n * periods[0] for n in count(1) if all((n * periods[0] / p).denominator == 1 for p in periods)
    )
    assert common == first


@given(PERIODS, PERIODS)
def test_shared_factor_divides_both_into_co_prime_wholes(a: Fraction, b: Fraction) -> None:
    factor = shared_factor(a, b)
    assert (a / factor).denominator == (b / factor).denominator == 1
    assert shared_factor(a / factor, b / factor) == 1
    assert shared_factor(b, a) == factor
    assert factor * common_period([a, b]) == a * b


@given(PERIODS)
def test_a_period_with_itself(period: Fraction) -> None:
    assert (
        common_period([period]) == common_period([period, period]) == shared_factor(period, period) == period
    )


def test_no_periods_are_refused() -> None:
    with pytest.raises(ValueError, match=r"no periods; expected at least one"):
        common_period([])
