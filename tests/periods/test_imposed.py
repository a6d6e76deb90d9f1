"""Imposed periods: the phases of every frame, who uses which features, and what wrong layers cost."""

from __future__ import annotations

import logging
from fractions import Fraction

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch.database.mapfile import build, recipe_of
from dejavu_torch.database.template_map import CompressedMap, Matcher
from dejavu_torch.database.templates import PhaseTemplates
from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.periods.support import support_of, supportive_periods
from dejavu_torch.recognition.select import best_match
from dejavu_torch.types import Plan


def learnt(features: Tensor, plan: Plan) -> CompressedMap:
    return CompressedMap(plan, PhaseTemplates()(features, plan), *features.shape)


@given(
    st.lists(st.integers(2, 12), min_size=1, max_size=4, unique=True), st.integers(1, 6), st.integers(2, 80)
)
def test_every_frame_has_the_phase_of_its_bin(periods: list[int], bin: int, frames: int) -> None:
    plan = ImposedPeriods(periods, bin).plan(torch.rand(frames, 3))
    assert [layer.phases for layer in plan] == periods
    for layer in plan:
        assert (layer.period, layer.start, layer.stop) == (layer.phases * bin, 0, frames)
        assert layer.features == (0, 1, 2)
        assert layer.place_phases.tolist() == [i // bin % layer.phases for i in range(frames)]


def test_the_plan_does_not_depend_on_the_features() -> None:
    finder = ImposedPeriods()
    assert finder.plan(torch.rand(400, 4)) == finder.plan(torch.zeros(400, 4, dtype=torch.float64))


def test_separate_layers_have_their_own_equal_slices_in_the_order_given() -> None:
    plan = ImposedPeriods([7, 4, 5], separate=True).plan(torch.rand(300, 6))
    assert [(layer.phases, layer.features) for layer in plan] == [(7, (0, 1)), (4, (2, 3)), (5, (4, 5))]


def test_no_periods_given_chooses_supportive_ones_for_the_route() -> None:
    finder = ImposedPeriods(bin=5, templates=80, corrects=1)
    chosen = tuple(layer.phases for layer in finder.plan(torch.rand(2698, 2)))
    assert chosen == supportive_periods(540, 80, 1)  # 2698 frames: the last bin is short
    assert len(ImposedPeriods(bin=3, templates=80, layers=4).plan(torch.rand(600, 2))) == 4


@pytest.mark.parametrize("frames", [2, 5, 6, 11])
def test_routes_of_a_few_bins(frames: int) -> None:
    plan = ImposedPeriods().plan(torch.rand(frames, 2))
    assert {layer.stop for layer in plan} == {frames}
    assert len(plan) >= 3


def test_one_long_period_classifies_places() -> None:
    """As many phases as bins, or more: each place is its own bin's, and unused phases do no harm."""
    features = torch.rand(23, 4, dtype=torch.float64)
    means = torch.stack([part.mean(0) for part in features.split(5)])
    for phases in (5, 9):
        plan = ImposedPeriods([phases]).plan(features)
        (block,) = learnt(features, plan).blocks()
        torch.testing.assert_close(block[:5], means)
        assert block[5:].count_nonzero() == 0
        scores = Matcher("l1", "sum")(features, learnt(features, plan))
        expected = torch.cdist(features, means, p=1.0)[:, torch.arange(23) // 5]
        torch.testing.assert_close(scores, expected)


def one_hot(plan: Plan, place: Tensor) -> Tensor:
    """Features that repeat perfectly: each layer's slice tells the phase."""
    return torch.cat([torch.eye(13)[layer.phase(place)] for layer in plan], 1)


def test_a_wrong_layer_is_corrected() -> None:
    finder = ImposedPeriods(separate=True)
    layers = len(finder.periods_for(2700))
    assert finder.support(2700, tolerance=5).corrects == 1
    plan = finder.plan(torch.rand(2700, 13 * layers))
    features = one_hot(plan, torch.arange(2700))
    route = learnt(features, plan)
    place = torch.arange(0, 2700, 7)
    for wrong in range(layers):
        seen = features[place]
        seen[:, 13 * wrong : 13 * (wrong + 1)] = torch.eye(13)[torch.randint(13, (len(place),))]
        found = best_match(Matcher()(seen, route)).index
        assert torch.equal(found // 5, place // 5)


def test_support_counts_in_bins() -> None:
    finder = ImposedPeriods([11, 13], bin=5)
    assert finder.support(100, tolerance=0) == support_of([11, 13], 20, tolerance=0)
    assert finder.support(96, tolerance=5) == support_of([11, 13], 20, tolerance=1)
    assert finder.support(101, tolerance=6) == support_of([11, 13], 21, tolerance=2)
    # nine bins, fewer than either period: the nearest are 1, 2 or 3 bins apart in both layers
    assert [finder.support(45, tolerance).torus_distance for tolerance in (0, 5, 6)] == [2, 4, 6]
    assert ImposedPeriods().support(2700, 5).periods == supportive_periods(540, 53)


def test_places_that_look_alike_are_logged_in_one_line(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "dejavu_torch"):
        ImposedPeriods([4, 6]).plan(torch.rand(60, 2))  # 12 bins, and 12 told apart
        assert caplog.messages == []
        ImposedPeriods([4, 6]).plan(torch.rand(61, 2))
    (line,) = caplog.messages
    assert "12 bins" in line
    assert "13" in line
    assert "60 apart" in line
    assert "\n" not in line


def test_staggered_bins_drift_past_each_other() -> None:
    plan = ImposedPeriods([5, 7, 9], bin=5, stagger=True).plan(torch.rand(900, 4))
    assert [layer.period for layer in plan] == [Fraction(51, 2), Fraction(69, 2), Fraction(91, 2)]
    assert [layer.phases for layer in plan] == [5, 7, 9]
    (alone,) = ImposedPeriods([200], bin=5, stagger=True).plan(torch.rand(900, 4))
    assert alone.period == 1000


def test_staggered_layers_place_a_frame_finer_than_their_bins() -> None:
    """Where each layer names its bin, how far off is the place that all of them agree on?"""
    frames, errors = 900, {}
    for stagger in (False, True):
        finder = ImposedPeriods([5, 7, 8, 9, 11, 13], bin=5, separate=True, stagger=stagger)
        plan = finder.plan(torch.rand(frames, 6 * 13))
        features = one_hot(plan, torch.arange(frames))
        found = best_match(Matcher()(features, learnt(features, plan))).index
        errors[stagger] = (found - torch.arange(frames)).abs()
    assert errors[False].max() == 4
    assert errors[False].float().mean() == 2
    near = errors[True] <= 4
    assert near.float().mean() > 0.98
    assert errors[True][near].float().mean() < 1


@pytest.mark.parametrize(
    "finder", [ImposedPeriods(), ImposedPeriods([4, 9], 3, 20, 0, 2, True, True), ImposedPeriods(layers=5)]
)
def test_it_is_rebuilt_from_its_recipe(finder: ImposedPeriods) -> None:
    again = build(recipe_of(finder), PeriodFinder)
    assert repr(again) == repr(finder)
    assert recipe_of(again) == recipe_of(finder)


def test_it_tells_its_arguments() -> None:
    assert repr(ImposedPeriods([4, 9], separate=True)) == (
        "ImposedPeriods(periods=[4, 9], bin=5, templates=None, corrects=1, layers=None, separate=True, "
        "stagger=False)"
    )


@pytest.mark.parametrize("periods", [[], [1, 4], [4, 4], [4.0, 5], ["4"]])
def test_periods_that_cannot_be_imposed(periods: list[int]) -> None:
    with refused(str(periods), "distinct whole numbers >= 2"):
        ImposedPeriods(periods)


def test_bad_input_is_refused() -> None:
    with refused("bin=0", "at least 1 frame"):
        ImposedPeriods(bin=0)
    with refused("bin=1", "at least 2 frames to stagger"):
        ImposedPeriods(bin=1, stagger=True)
    for shape in [(1, 4), (8,), (8, 0), (2, 3, 4)]:
        with refused(str(shape), "(N,D) with N >= 2, D >= 1"):
            ImposedPeriods().plan(torch.zeros(shape))
    with refused("3 layers", "8 features", "multiple of 3"):
        ImposedPeriods([4, 5, 7], separate=True).plan(torch.rand(50, 8))
    with refused("20 templates", "540 places", "49 templates"):
        ImposedPeriods(templates=20).plan(torch.rand(2700, 8))
