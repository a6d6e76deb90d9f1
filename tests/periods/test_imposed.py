"""Imposed periods: the phases of every frame, who uses which features, and what wrong layers cost."""

from __future__ import annotations

import logging
from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from helpers import Fixed, refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.periods.support import support_of, supportive_periods
from dejavu_torch.recognition.select import best_match


def learned(features, plan):
    return TemplateMapper(Fixed(*plan))(features)


@given(
    st.lists(st.integers(2, 12), min_size=1, max_size=4, unique=True), st.integers(1, 6), st.integers(2, 80)
)
def test_every_frame_has_the_phase_of_its_bin(periods, bin, frames):
    plan = ImposedPeriods(periods, bin).plan(torch.rand(frames, 3))
    assert [layer.phases for layer in plan] == periods
    for layer in plan:
        assert (layer.period, layer.start, layer.stop) == (layer.phases * bin, 0, frames)
        assert layer.features == (0, 1, 2)
        assert layer.place_phases.tolist() == [i // bin % layer.phases for i in range(frames)]


def test_the_plan_does_not_depend_on_the_features():
    finder = ImposedPeriods()
    assert finder.plan(torch.rand(400, 4)) == finder.plan(torch.zeros(400, 4, dtype=torch.float64))


def test_no_periods_given_chooses_supportive_ones_for_the_route():
    chosen = tuple(layer.phases for layer in ImposedPeriods(bin=5).plan(torch.rand(2698, 2)))
    assert chosen == supportive_periods(540)  # 2698 frames: the last bin is short
    assert support_of(chosen, 540)[0] >= 3


@pytest.mark.parametrize("frames", [2, 5, 6, 11])
def test_routes_of_a_few_bins(frames):
    plan = ImposedPeriods().plan(torch.rand(frames, 2))
    assert {layer.stop for layer in plan} == {frames}
    assert len(plan) >= 3


def separate(plan):
    """The same layers, each of 13 features of its own."""
    slices = [tuple(range(13 * j, 13 * (j + 1))) for j in range(len(plan))]
    return tuple(replace(layer, features=own) for layer, own in zip(plan, slices, strict=True))


def one_hot(plan, place):
    """Features that repeat perfectly: each layer's slice tells the phase."""
    return torch.cat([torch.eye(13)[layer.phase(place)] for layer in plan], 1)


def test_a_wrong_layer_is_corrected():
    plan = separate(ImposedPeriods().plan(torch.rand(2700, 1)))
    features = one_hot(plan, torch.arange(2700))
    route = learned(features, plan)
    place = torch.arange(0, 2700, 7)
    for wrong in range(len(plan)):
        seen = features[place]
        seen[:, 13 * wrong : 13 * (wrong + 1)] = torch.eye(13)[torch.randint(13, (len(place),))]
        found = best_match(route.scores(seen)).index
        assert torch.equal(found // 5, place // 5)


def test_places_that_look_alike_are_logged_in_one_line(caplog):
    with caplog.at_level(logging.WARNING, "dejavu_torch"):
        ImposedPeriods([4, 6]).plan(torch.rand(60, 2))  # 12 bins, and 12 told apart
        assert caplog.messages == []
        ImposedPeriods([4, 6]).plan(torch.rand(61, 2))
    (line,) = caplog.messages
    assert "12 bins" in line
    assert "13" in line
    assert "60 apart" in line
    assert "\n" not in line


def test_staggered_bins_drift_past_each_other():
    plan = ImposedPeriods([5, 7, 9], bin=5, stagger=True).plan(torch.rand(900, 4))
    assert [layer.period for layer in plan] == [Fraction(51, 2), Fraction(69, 2), Fraction(91, 2)]
    assert [layer.phases for layer in plan] == [5, 7, 9]
    (alone,) = ImposedPeriods([200], bin=5, stagger=True).plan(torch.rand(900, 4))
    assert alone.period == 1000


def test_staggered_layers_place_a_frame_finer_than_their_bins():
    """Where each layer names its bin, how far off is the place that all of them agree on?"""
    frames, errors = 900, {}
    for stagger in (False, True):
        finder = ImposedPeriods([5, 7, 8, 9, 11, 13], bin=5, stagger=stagger)
        plan = separate(finder.plan(torch.rand(frames, 1)))
        features = one_hot(plan, torch.arange(frames))
        found = best_match(learned(features, plan).scores(features)).index
        errors[stagger] = (found - torch.arange(frames)).abs()
    assert errors[False].max() == 4
    assert errors[False].float().mean() == 2
    near = errors[True] <= 4
    assert near.float().mean() > 0.98
    assert errors[True][near].float().mean() < 1


WHOLE = "distinct integers from 2 to"


@pytest.mark.parametrize(
    ("call", "facts"),
    [
        (lambda: ImposedPeriods([]), ("[]", WHOLE)),
        (lambda: ImposedPeriods([1, 4]), ("[1, 4]", WHOLE)),
        (lambda: ImposedPeriods([4, 4]), ("[4, 4]", WHOLE)),
        (lambda: ImposedPeriods([4.0, 5]), ("[4.0, 5]", WHOLE)),
        (lambda: ImposedPeriods(bin=0), ("bin=0", "at least 1 place")),
        (lambda: ImposedPeriods(bin=1, stagger=True), ("bin=1", "at least 2 places to stagger")),
        (lambda: ImposedPeriods().plan(torch.zeros(1, 4)), ("(1, 4)", "(N>=2, D>=1)")),
        (lambda: ImposedPeriods().plan(torch.zeros(8, 0)), ("(8, 0)", "(N>=2, D>=1)")),
        (lambda: ImposedPeriods().plan(torch.zeros(8)), ("(8,)", "(N>=2, D>=1)")),
    ],
)
def test_what_is_refused(call, facts):
    with refused(*facts):
        call()
