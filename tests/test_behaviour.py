"""Sentences of behaviour that mutants showed no test to assert, at the front door; see tests/mutants."""

from __future__ import annotations

import math

import pytest
import torch

from dejavu_torch import (
    DejaVu,
    FrequencyLayer,
    LiveLocalizer,
    PhaseTemplates,
    PlaceFilter,
    SpectralMapper,
    open_source,
)
from dejavu_torch.data.source import as_traverse
from dejavu_torch.evaluation.controls import null_control
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.growth import average, merge


def noise(places, numbers, seed=0):
    return torch.randn(places, numbers, generator=torch.Generator().manual_seed(seed))


def smooth(places, numbers=8):
    """Descriptors that change slowly and do not come back."""
    steps = noise(places, numbers).cumsum(0)
    return steps - steps.mean(0)


def of_features(mapper, route):
    return DejaVu(whitening="none", mapper=mapper).learn(route)


def test_templates_of_a_long_chunk_are_means():
    frames, period = 100_000, 93
    values = torch.arange(frames, dtype=torch.float64)[:, None].remainder(1009)
    (templates,) = PhaseTemplates()(values, (FrequencyLayer(period, period, 0, frames, (0,)),))
    expected = torch.stack([values[phase::period].mean(0) for phase in range(period)])
    torch.testing.assert_close(templates, expected)


def test_cosine_and_sine_have_the_same_dead_zone():
    # of period 8, at whose length the dead zone is twice 0.65 steps
    turns = torch.arange(16) * (2 * math.pi / 8)
    slow = 20 * torch.cos(turns / 2)
    for size, lines in ((1.0, 1), (1.5, 3)):
        both = size / math.sqrt(8) * torch.stack([turns.cos(), turns.sin()])
        route = torch.stack([*both, slow], 1)
        made = of_features(SpectralMapper(step=1.0, resolution=8.0), route)
        assert made.summary().lines == lines


def test_a_squared_distance_is_never_below_0():
    route = 1000 * noise(64, 8)
    model = of_features(SpectralMapper(step=0.2, metric="l2"), route)
    scores = model(route)
    assert (scores >= 0).all()
    assert (scores.argmin(1) == torch.arange(64)).all()


def test_no_step_is_finer_than_changes_a_score():
    # 64 steps in the RMS of noise are 8.05 bits a number; the coder takes some more
    model = of_features(SpectralMapper(route_bytes_per_place=12.0), noise(1000, 4))
    assert 4 < model.summary().route_bytes / 1000 < 5


def test_a_frequency_is_one_period_of_a_summary():
    turns = torch.arange(120) * (2 * math.pi / 30)
    made = of_features(SpectralMapper(step=0.1), torch.stack([turns.cos(), turns.sin()], 1))
    assert made.summary().chunks[0].periods == (30,)


def test_a_precision_is_inclusive():
    route = open_source("sim:aerial?frames=100&size=32")
    model = DejaVu(whitening="none").learn(route).calibrate(route)
    query = open_source("sim:aerial?frames=100&size=32&traverse=1")
    probability = model.localize(query).probability
    assert probability is not None
    model.precision = float(probability.median())
    match = model.localize(query)
    assert 0 < model.precision < 1
    assert torch.equal(match.accepted, probability >= model.precision)
    assert match.accepted[probability.argsort()[(len(probability) - 1) // 2]]


def test_of_equal_scores_in_several_chunks_the_lowest_place_wins():
    once = noise(50, 8)
    model = of_features(SpectralMapper(step=0.1), once)
    model = merge([model, model, model], ["once", "twice", "thrice"])
    scores = model.map.scores(once)
    assert torch.equal(scores[:, :50], scores[:, 50:100])
    assert torch.equal(model.localize(once).index, torch.arange(50))
    candidates = model.candidates(once, 3, apart=3)
    assert torch.equal(candidates.index, torch.arange(50)[:, None] + 50 * torch.arange(3))


def test_a_filter_counts_neighbours_up_to_within():
    scores = torch.full((1, 60), 1.0)
    scores[0, 30] = 0.0
    found = PlaceFilter(within=5, sharpness=20.0)(scores)[0].detach()
    for away in range(6):
        assert float(found[30 + away]) == pytest.approx(-math.log(1 - away / 6), abs=1e-3)
        assert float(found[30 - away]) == pytest.approx(-math.log(1 - away / 6), abs=1e-3)
    assert (found[[24, 36]] > 10).all()


def test_frames_left_out_move_a_filter_on():
    route = noise(100, 16)
    model = of_features(SpectralMapper(step=0.2), route)
    filter = PlaceFilter(moves=(0.0, 1.0), within=0, sharpness=5.0)
    for left_out in (0, 1, 2, 5):
        live = LiveLocalizer(model, filter)
        assert live(route[40]).place == 40
        assert live(torch.zeros(16), left_out).place == 41 + left_out  # a frame that tells nothing


def test_a_third_visit_weighs_a_third():
    first, others = smooth(60), (smooth(60) + 0.9, smooth(60) - 0.3)
    model = of_features(SpectralMapper(step=0.01, metric="l2", chunk=60), first)
    for visit in others:
        average(model, LabelledFrames(as_traverse(visit), torch.arange(60)))
    assert model(first + 0.2).diagonal().max() < 0.01
    assert model(first + 0.3).diagonal().min() > 0.01
    assert (model.map.visit_counts == 3).all()


def test_a_threshold_is_kept_where_all_maps_have_it():
    def learned(threshold, seed):
        model = of_features(SpectralMapper(step=0.1), noise(40, 4, seed))
        model.threshold = threshold
        return model

    assert merge([learned(0.3, 0), learned(0.3, 1)], ["a", "b"]).threshold == 0.3
    for other in (0.4, None):
        assert merge([learned(0.3, 0), learned(other, 1)], ["a", "b"]).threshold is None


def test_the_null_takes_as_many_bytes_as_the_map():
    route = smooth(300)
    model = of_features(SpectralMapper(step=2.0), route)
    own = model.localize(route).index
    assert (own == torch.arange(300)).float().mean() > 0.7
    null = null_control(model, route, route).index
    # in the map's steps lines of shuffled frames take more bytes, and hold nearly all of these
    assert (null == torch.arange(300)).float().mean() < 0.3


def test_a_summary_names_few_of_many_chunks():
    told = str(of_features(SpectralMapper(step=0.1, chunk=16), noise(400, 4)).summary())
    assert "more chunks" in told
    assert told.count("\n") < 15
