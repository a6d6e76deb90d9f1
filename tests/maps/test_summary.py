"""What a map can tell apart and what it costs."""

from __future__ import annotations

from fractions import Fraction

import pytest
import torch

from dejavu_torch import FrequencyLayer, TemplateMap

PLAN = (
    FrequencyLayer(Fraction(93), 93, 0, 1024, (0, 1, 2)),
    FrequencyLayer(Fraction(171), 171, 0, 1024, (1, 3)),
    FrequencyLayer(Fraction(195, 2), 98, 1500, 2000, (0,)),
    FrequencyLayer(Fraction(4), 4, 1900, 2100, (0, 1)),
    FrequencyLayer(Fraction(6), 6, 1900, 2100, (2,)),
    FrequencyLayer(Fraction(15), 15, 1900, 2100, (3,)),
)


def summary_of(plan, places):
    blocks = [torch.zeros(layer.phases, len(layer.features)) for layer in plan]
    return TemplateMap(plan, blocks, places, 4).summary()


@pytest.fixture
def summary():
    return summary_of(PLAN, 2500).with_parts(fixed={"header": 1000, "backbone": 0})


def test_chunks_of_a_plan_made_by_hand(summary):
    first, second, third = summary.chunks
    assert (first.start, first.stop, first.periods, first.features) == (0, 1024, (93, 171), (3, 2))
    assert first.common_period == 5301  # not the product, 15903
    assert (second.periods, second.common_period) == ((Fraction(195, 2),), Fraction(195, 2))
    assert (third.start, third.stop, third.common_period) == (1900, 2100, 60)


def test_description_tells_the_numbers(summary):
    assert str(summary).splitlines() == [
        "places 0-1023: 2 layers, periods 93 (3 features), 171 (2 features); together 5301 places",
        "places 1500-1999: 1 layer, periods 97.5 (1 features)",
        "places 1900-2099: 3 layers, periods 4 (2 features), 6 (1 features), 15 (1 features); together 60 "
        "places",
        # the last two chunks overlap: 1024 + 600
        "1624 of 2500 places covered; 387 templates, 748 numbers",
        "4328 bytes, 1.7 per place: 3328 of the route, 1.33 per place (templates 2992, layers 336), and 1000 "
        "fixed (header 1000)",
    ]


def test_description_of_many_layers_stays_short():
    plan = tuple(FrequencyLayer(Fraction(p), p, 0, 1024, (0,)) for p in range(8, 108))
    first, *_ = str(summary_of(plan, 1024)).splitlines()
    assert "100 layers" in first
    assert len(first) < 300
