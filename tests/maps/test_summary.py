"""What a map can tell apart and what it costs."""

from __future__ import annotations

from fractions import Fraction

import pytest

from dejavu_torch import FrequencyLayer
from dejavu_torch.maps.summary import summarise
from dejavu_torch.types import Plan

PLAN: Plan = (
    FrequencyLayer(Fraction(93), 93, 0, 1024, (0, 1, 2)),
    FrequencyLayer(Fraction(171), 171, 0, 1024, (1, 3)),
    FrequencyLayer(Fraction(195, 2), 98, 1500, 2000, (0,)),
    FrequencyLayer(Fraction(4), 4, 1900, 2100, (0, 1)),
    FrequencyLayer(Fraction(6), 6, 1900, 2100, (2,)),
    FrequencyLayer(Fraction(15), 15, 1900, 2100, (3,)),
)


def test_numbers_of_a_plan_made_by_hand() -> None:
    summary = summarise(PLAN, places=2500, route={"templates": 9000}).with_parts(
        fixed={"header": 1000, "backbone": 0}
    )
    assert summary.places == 2500
    assert summary.covered == 1024 + 600  # the last two chunks overlap
    assert summary.templates == 93 + 171 + 98 + 4 + 6 + 15
    assert summary.template_numbers == 93 * 3 + 171 * 2 + 98 + 4 * 2 + 6 + 15
    assert (summary.map_bytes, summary.route_bytes, summary.fixed_bytes) == (10_000, 9000, 1000)
    assert summary.bytes_per_place == pytest.approx(4.0)


def test_chunks_of_a_plan_made_by_hand() -> None:
    first, second, third = summarise(PLAN, places=2500, route={}).chunks
    assert (first.start, first.stop, first.periods, first.features) == (0, 1024, (93, 171), (3, 2))
    assert first.common_period == 5301  # not the product, 15903
    assert (second.periods, second.common_period) == ((Fraction(195, 2),), Fraction(195, 2))
    assert (third.start, third.stop, third.common_period) == (1900, 2100, 60)


def test_a_plan_without_layers() -> None:
    summary = summarise((), places=50, route={"layers": 200})
    assert (summary.places, summary.covered, summary.templates, summary.chunks) == (50, 0, 0, ())
    assert (summary.map_bytes, summary.bytes_per_place) == (200, 4.0)
    assert summarise((), places=0, route={"layers": 200}).bytes_per_place == 200


def test_description_tells_the_numbers() -> None:
    lines = str(
        summarise(PLAN, places=2500, route={"templates": 9000}).with_parts(
            fixed={"header": 1000, "backbone": 0}
        )
    ).splitlines()
    assert len(lines) == 5
    for number in ("0-1023", "93", "171", "5301"):
        assert number in lines[0]
    assert "97.5" in lines[1]
    for number in ("1624 of 2500", "387 templates", "748 numbers"):
        assert number in lines[3]
    for number in ("10000 bytes", "4.0 per place", "templates 9000", "header 1000"):
        assert number in lines[4]
    assert "backbone" not in lines[4]


def test_description_of_many_layers_stays_short() -> None:
    plan = tuple(FrequencyLayer(Fraction(p), p, 0, 1024, (0,)) for p in range(8, 108))
    first, *_ = str(summarise(plan, 1024, {})).splitlines()
    assert "100 layers" in first
    assert len(first) < 300
