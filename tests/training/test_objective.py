"""The weighted sum of the losses: each is the one of `training.losses` on what it is meant to see."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import pytest
import torch
from helpers import refused
from torch import Tensor

from dejavu_torch import CompressedMap, FrequencyLayer, Matcher, PhaseTemplates
from dejavu_torch.database.template_map import combine_layers, log_posterior
from dejavu_torch.training.losses import (
    decorrelation_loss,
    periodicity_loss,
    phase_cross_entropy,
    place_cross_entropy,
    support_loss,
)
from dejavu_torch.training.objective import Losses, Objective

T = torch.tensor(0.5)
OFF = {"place": 0.0, "phase": 0.0}


class Route:
    """A batch of frames of a route of two layers, and what the task would hand over of it."""

    def __init__(self, places: int, matcher: Matcher | None = None, batch: int = 40) -> None:
        self.plan = tuple(FrequencyLayer(*layer[:2], 0, places, layer[2]) for layer in LAYERS)
        stored = torch.randn(places, 3)
        self.map = CompressedMap(self.plan, PhaseTemplates()(stored, self.plan), places, 3)
        self.right = torch.randint(places, (batch, 1))
        self.features = stored[self.right[:, 0]] + 0.3 * torch.randn(batch, 3)
        self.matcher = Matcher() if matcher is None else matcher
        self.distances = self.matcher.distances(self.features, self.map)
        how = self.matcher.metric, self.matcher.reduction
        self.scores = log_posterior(combine_layers(self.distances, self.plan, places, *how), T)

    def losses(self, objective: Objective, tolerance: int = 1) -> Losses:
        given = (self.features, self.distances, self.scores, self.right, self.map, self.matcher, T)
        return objective(*given, tolerance)

    def periodicity(self, *periods: Fraction | int) -> Tensor:
        """Of these periods; of the layers, with their phases, where none are given."""
        known = self.right[:, 0] >= 0
        phases = None if periods else (3, 5)
        return periodicity_loss(self.features[known], self.right[known, 0], periods or (6, 5), phases=phases)


LAYERS = ((6, 3, (0, 1)), (5, 5, (2,)))  # the first of two frames a phase


def test_the_total_is_the_weighted_sum_of_the_parts() -> None:
    route = Route(30)
    route.right[4] = -1
    weights = {"place": 0.5, "phase": 2.0, "periodicity": 0.25, "decorrelation": 3.0, "support": 0.125}
    total, parts, left_out = route.losses(Objective(**weights))
    assert list(parts) == list(weights)
    torch.testing.assert_close(total, sum(weights[name] * part for name, part in parts.items()))
    assert left_out == 1
    torch.testing.assert_close(parts["place"], place_cross_entropy(route.scores, route.right, 1, 1.0).loss)
    groups = [route.features[:, :2], route.features[:, 2:]]
    torch.testing.assert_close(parts["decorrelation"], decorrelation_loss(groups))
    torch.testing.assert_close(parts["periodicity"], route.periodicity())


def test_what_counts_0_is_not_made_but_the_place_is_told() -> None:
    route = Route(30)
    total, parts, _ = route.losses(Objective(place=0.0, phase=2.0))
    assert list(parts) == ["place", "phase"]
    torch.testing.assert_close(total, 2 * parts["phase"])


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_phases_are_told_in_the_units_of_the_scores(reduction: Any) -> None:
    route = Route(30, Matcher(reduction=reduction))
    per = (2, 1) if reduction == "mean" else (1, 1)
    distances = [one / features for one, features in zip(route.distances, per, strict=True)]
    expected = phase_cross_entropy(distances, route.plan, route.right, T)
    torch.testing.assert_close(route.losses(Objective()).parts["phase"], expected)


@pytest.mark.parametrize(
    ("candidates", "periods"),
    [([4.0, 7.0], [4, 7]), ([7.5], [Fraction(15, 2)]), ([1500.3], [Fraction(15003, 10)])],
    ids=str,
)
def test_candidates_are_the_periods_that_are_looked_for(
    candidates: list[float], periods: list[Fraction]
) -> None:
    route = Route(30 if max(candidates) < 30 else 4000, batch=40 if max(candidates) < 30 else 3000)
    objective = Objective(**OFF, periodicity=1.0, candidates=candidates)
    found = route.losses(objective).parts["periodicity"]
    torch.testing.assert_close(found, route.periodicity(*periods))
    assert not torch.isclose(found, route.periodicity(), atol=1e-4)


def test_frames_of_unknown_place_are_not_place_0() -> None:
    route = Route(12)
    before = route.losses(objective := Objective(**OFF, periodicity=1.0)).parts["periodicity"]
    route.right[::3] = -1
    found = route.losses(objective).parts["periodicity"]
    torch.testing.assert_close(found, route.periodicity())
    assert not torch.isclose(found, before)
    route.features[::3] += 100
    torch.testing.assert_close(route.losses(objective).parts["periodicity"], found)


def test_support_compares_places_beyond_the_tolerance_only() -> None:
    route = Route(8)  # of tolerance 6 there is one such pair
    found = route.losses(Objective(**OFF, support=1.0, margin=3.0), tolerance=6).parts["support"]
    expected = support_loss(route.map.blocks(), route.plan, torch.tensor([[0, 7]]), 3.0)
    torch.testing.assert_close(found, expected)
    assert found > 0


NAN = math.nan


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"place": -1.0}, ("'place': -1.0", "expected 0 or more")),
        ({"phase": NAN}, ("'phase': nan", "expected 0 or more")),
        ({"support": math.inf}, ("'support': inf",)),
        (OFF, ("one of them above 0",)),
        ({"margin": 0.0}, ("margin 0.0", "a margin above 0")),
        ({"margin": NAN}, ("margin nan",)),
        ({"candidates": [3.0, 1.5]}, ("candidates [3.0, 1.5]", "periods of at least 2")),
        ({"candidates": [NAN]}, ("candidates [nan]",)),
        ({"candidates": [math.inf]}, ("candidates [inf]",)),
    ],
    ids=str,
)
def test_what_does_not_count_is_refused(settings: dict[str, Any], words: tuple[str, ...]) -> None:
    with refused(*words):
        Objective(**settings)
