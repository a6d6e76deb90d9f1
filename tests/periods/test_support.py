"""How exact periods support each other, against literal definitions."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import combinations, count

import pytest
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.periods import support
from dejavu_torch.periods.support import (
    code_distance,
    common_period,
    corrects,
    shared_factor,
    support_of,
    supportive_periods,
    torus_distance,
)

PERIODS = st.builds(Fraction, st.integers(1, 60), st.integers(1, 6))
WHOLE = st.lists(st.integers(1, 15), min_size=1, max_size=4)


def around(lag: int, period: Fraction) -> Fraction:
    return min(abs(lag - k * period) for k in range(int(lag / period) + 2))


def differing(a: int, b: int, periods: list[int]) -> int:
    return sum(a % period != b % period for period in periods)


def best_by_trying_all(
    places: int, templates: int, wrong: int, layers: int | None, smallest: int
) -> tuple[int, ...]:
    fitting = [
        chosen
        for length in range(1, 6)
        for chosen in combinations(range(smallest, templates + 1), length)
        if sum(chosen) <= templates
        and layers in (None, length)
        and all(math.gcd(a, b) == 1 for a, b in combinations(chosen, 2))
        and code_distance(chosen, places) >= 2 * wrong + 1
    ]
    return max(
        fitting, key=lambda c: (code_distance(c, places), torus_distance(c, places, 1), -sum(c), min(c), c)
    )


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


@pytest.mark.parametrize(("periods", "distance"), [((93, 171), 3), ((92, 171), 12), ((126, 138), 12)])
def test_torus_distance_of_two_periods(periods: tuple[int, int], distance: int) -> None:
    assert torus_distance(periods, 1024, tolerance=5) == distance
    assert torus_distance(periods, 1024) == 2  # neighbours, one phase apart in either


@given(st.lists(PERIODS, min_size=1, max_size=3), st.integers(0, 5), st.integers(2, 60))
def test_torus_distance_by_its_definition(periods: list[Fraction], tolerance: int, further: int) -> None:
    places = tolerance + further
    lags = range(tolerance + 1, places)
    distance = torus_distance(periods, places, tolerance)
    assert distance == min(sum(around(lag, period) for period in periods) for lag in lags)
    assert isinstance(distance, int) or any(period.denominator > 1 for period in periods)


def test_torus_distance_is_exact_beyond_64_bits() -> None:
    assert torus_distance([10**30, 3], 7) == 2
    assert torus_distance([2**63 + 1, 3], 7) == 2
    assert torus_distance([10**30 + Fraction(1, 7), 3], 7, tolerance=2) == 3
    assert torus_distance([1 + Fraction(1, 10**25)], 5) == Fraction(1, 10**25)


@given(WHOLE, st.integers(2, 30))
def test_code_distance_and_torus_distance_of_all_pairs(periods: list[int], places: int) -> None:
    pairs = list(combinations(range(places), 2))
    assert code_distance(periods, places) == min(differing(a, b, periods) for a, b in pairs)
    assert (code_distance(periods, places) == 0) == (common_period(periods) < places)
    assert (torus_distance(periods, places) == 0) == (common_period(periods) < places)


@given(WHOLE, st.integers(1, 15), st.integers(2, 60))
def test_one_more_layer_never_brings_places_closer(periods: list[int], more: int, places: int) -> None:
    assert 0 <= code_distance([*periods, more], places) - code_distance(periods, places) <= 1
    assert torus_distance([*periods, more], places) >= torus_distance(periods, places)


def test_periods_beyond_any_integer_of_the_machine_differ_everywhere() -> None:
    assert code_distance([10**30, 10**30], 50) == 2


@pytest.mark.parametrize(("periods", "places"), [([3, 4, 5], 3), ([3, 4, 5, 7, 11], 12), ([2, 3, 5], 6)])
def test_the_nearest_code_survives_as_many_wrong_layers_as_promised(periods: list[int], places: int) -> None:
    survives = corrects(periods, places)
    codes = [[place % period for period in periods] for place in range(places)]

    def decided(seen: list[int]) -> set[int]:
        wrong = [sum(a != b for a, b in zip(code, seen, strict=True)) for code in codes]
        return {place for place in range(places) if wrong[place] == min(wrong)}

    def misled(count_wrong: int) -> bool:
        """Whether copying that many residues of another place makes a place look like it, or as much so."""
        return any(
            decided([codes[b][j] if j in bad else code for j, code in enumerate(codes[a])]) != {a}
            for a in range(places)
            for b in range(places)
            for bad in combinations(range(len(periods)), count_wrong)
        )

    assert not misled(survives)
    assert misled(survives + 1)


def test_support_tells_all_of_a_set() -> None:
    told = support_of([4, 6, 9], 30)
    assert told._asdict() == {
        "periods": (4, 6, 9),
        "templates": 19,
        "common_period": 36,
        "shared_factors": (2, 1, 3),
        "torus_distance": 2,  # 18 places apart: 2 + 0 + 0
        "corrects": 0,
    }
    assert support_of([4, 6, 9], 30, tolerance=18).torus_distance == 3  # 19 places apart: 1 + 1 + 1


@pytest.mark.parametrize(
    ("places", "templates", "wrong", "layers", "smallest"),
    [
        (30, 20, 0, None, 2),
        (30, 26, 0, None, 4),
        (100, 30, 0, None, 4),
        (60, 30, 0, 3, 4),
        (6, 25, 1, 3, 4),
        (12, 26, 1, None, 3),
        (25, 28, 0, 1, 4),
        (9, 30, 0, 2, 4),
        (3, 16, 1, None, 2),
    ],
)
def test_the_chosen_set_is_the_best_of_all(
    places: int, templates: int, wrong: int, layers: int | None, smallest: int
) -> None:
    chosen = supportive_periods(places, templates, wrong, layers, smallest)
    assert chosen == best_by_trying_all(places, templates, wrong, layers, smallest)


@pytest.mark.parametrize(("places", "templates", "wrong"), [(540, 53, 1), (540, 120, 2), (20000, 80, 1)])
def test_the_chosen_set_keeps_what_it_promises(places: int, templates: int, wrong: int) -> None:
    chosen = supportive_periods(places, templates, wrong)
    told = support_of(chosen, places)
    assert told.templates <= templates
    assert told.corrects >= wrong
    assert told.common_period >= places
    assert set(told.shared_factors) == {1}
    assert sorted(set(chosen)) == list(chosen)


@pytest.mark.parametrize(
    ("places", "wrong", "layers", "fewest"),
    [(540, 1, None, 49), (20000, 1, None, 70), (540, 0, 1, 540), (20000, 0, 2, 283), (2000, 1, 3, 6004)],
)
def test_the_smallest_budget_is_named(places: int, wrong: int, layers: int | None, fewest: int) -> None:
    with refused(f"{fewest - 1} templates", f"{places} places", f"{wrong} layers wrong", f"least {fewest} t"):
        supportive_periods(places, fewest - 1, wrong, layers)
    if fewest < 500:
        assert sum(supportive_periods(places, fewest, wrong, layers)) == fewest


def test_of_two_places_the_most_layers_differ() -> None:
    assert supportive_periods(2, 24) == (4, 5, 7)


def test_where_too_many_sets_fit_the_cheapest_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(support, "COMPARED", 1)
    assert supportive_periods(20000, 200, 0, layers=3) == (23, 29, 30)
    assert code_distance(supportive_periods(540, 80), 540) == 4


def test_bad_input_is_refused() -> None:
    with refused("torus_distance", "[]", "at least one"):
        torus_distance([], 10)
    with refused("torus_distance", "[3, 0]", "all > 0"):
        torus_distance([3, 0], 10)
    with refused("places=6, tolerance=5", "tolerance <= places - 2"):
        torus_distance([3], 6, tolerance=5)
    with refused("tolerance=-1", "0 <= tolerance"):
        torus_distance([3], 6, tolerance=-1)
    for function in (code_distance, corrects, support_of):
        with refused("code_distance", "[]", "at least one"):
            function([], 10)
        with refused("[2.5]", "whole and >= 1"):
            function([2.5], 10)
        with refused("1 places", "at least 2"):
            function([3], 1)
    with refused("places=1", "places >= 2"):
        supportive_periods(1, 50)
    with refused("corrects=-1", "corrects >= 0"):
        supportive_periods(10, 50, corrects=-1)
    with refused("layers=2", "layers > 2 * corrects"):
        supportive_periods(10, 50, corrects=1, layers=2)
    with refused("smallest=1", "smallest >= 2"):
        supportive_periods(10, 50, smallest=1)
