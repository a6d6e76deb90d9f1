"""How exact periods support each other, against literal definitions."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import combinations, count

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.periods.support import common_period, support_of, supportive_periods

PERIODS = st.builds(Fraction, st.integers(1, 60), st.integers(1, 6))
WHOLE = st.lists(st.integers(1, 15), min_size=1, max_size=4)


def around(lag, period):
    return min(abs(lag - k * period) for k in range(lag // period + 2))


def differing(a, b, periods):
    return sum(a % period != b % period for period in periods)


def best_by_trying_all(places):
    for total in count(4):
        fitting = [
            chosen
            for length in range(1, 6)
            for chosen in combinations(range(4, total + 1), length)
            if sum(chosen) == total
            and all(math.gcd(a, b) == 1 for a, b in combinations(chosen, 2))
            and support_of(chosen, places)[0] >= 3
        ]
        if fitting:
            found = {chosen: support_of(chosen, places) for chosen in fitting}
            return max(fitting, key=lambda c: (found[c], c))
    raise AssertionError


def test_the_papers_periods_share_a_factor_3():
    assert common_period([93, 171]) == 93 * 171 / 3


@given(st.lists(PERIODS, min_size=1, max_size=3))
def test_common_period_is_the_first_time_all_are_back(periods):
    common = common_period(periods)
    first = next(
        n * periods[0] for n in count(1) if all((n * periods[0] / p).denominator == 1 for p in periods)
    )
    assert common == first


@given(WHOLE, st.integers(3, 30))
def test_code_distance_and_torus_distance_are_those_of_all_pairs(periods, places):
    pairs = list(combinations(range(places), 2))
    code, torus = support_of(periods, places)
    assert code == min(differing(a, b, periods) for a, b in pairs)
    assert (code == 0) == (common_period(periods) < places)
    apart = [b - a for a, b in pairs if b - a > 1]
    assert torus == min(sum(around(lag, period) for period in periods) for lag in apart)


@given(WHOLE, st.integers(1, 15), st.integers(3, 60))
def test_one_more_layer_never_brings_places_closer(periods, more, places):
    before, after = support_of(periods, places), support_of([*periods, more], places)
    assert 0 <= after[0] - before[0] <= 1
    assert after[1] >= before[1]


@pytest.mark.parametrize("places", [3, 6, 12, 25, 40])
def test_the_chosen_set_is_the_best_of_all(places):
    assert supportive_periods(places) == best_by_trying_all(places)


@pytest.mark.parametrize(("places", "templates"), [(540, 49), (20000, 70), (2, 16)])
def test_the_chosen_set_keeps_what_it_promises(places, templates):
    chosen = supportive_periods(places)
    assert sum(chosen) == templates
    assert support_of(chosen, max(places, 3))[0] >= 3  # one wrong layer is survived
    assert math.prod(chosen) == common_period(chosen) >= places  # co-prime
    assert sorted(set(chosen)) == list(chosen)
