"""The bench of template search: what it times, and the exponents of what it found."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import refused

from benchmarks.template_search import OURS, SCAN, bench_templates, random_map


def test_times_both_ways_to_the_same_places() -> None:
    sizes = list(bench_templates((5000, 40_000), queries=2, repeats=1))
    assert [[(row["case"], row["contender"]) for row in rows] for rows in sizes] == [
        [(f"templates={places}", name) for name in (OURS, SCAN)] for places in (5000, 40_000)
    ]
    for row in [row for rows in sizes for row in rows]:
        assert (row["difference"], row["skipped"], row["threads"]) == (0, None, 1)
        assert row["seconds"] is not None
        assert 0 < row["seconds"] < 1
    # 64 float32 of each of 71 + 72 and 200 + 201 phases, and a few bytes of the layers
    for rows, phases in zip(sizes, (143, 401), strict=True):
        assert {row["file_bytes"] for row in rows} == {rows[0]["file_bytes"]}
        assert 0 <= (rows[0]["file_bytes"] or 0) - 4 * 64 * phases < 1000


@pytest.mark.parametrize("places", [4, 5, 6, 7, 1000, 10**7])
def test_the_periods_are_the_least_that_tell_the_places_apart(places: int) -> None:
    short, long = (layer.period.numerator for layer in random_map(places, torch.Generator()).plan)
    assert (math.gcd(short, long), long) == (1, short + 1)
    assert short * long >= places > (short - 1) * short


def test_numbers_that_make_no_sense_are_refused() -> None:
    with refused("places=(3,)"):
        next(bench_templates((3,)))
    with refused("queries=0"):
        next(bench_templates(queries=0))
    with refused("repeats=0"):
        next(bench_templates(repeats=0))
