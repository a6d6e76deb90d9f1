"""Controls: maps learnt from shuffled frames, and queries taken out of their own templates."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
import torch
from helpers import Fixed, refused, template_model

from dejavu_torch import DejaVu, SequenceMatcher, SpectralMapper
from dejavu_torch.evaluation.controls import leave_out_match, null_control
from dejavu_torch.evaluation.curves import evaluate
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.types import FrequencyLayer, Training


def layer(period, start, stop, *features, phases=None):
    return FrequencyLayer(Fraction(period), phases or int(period), start, stop, features)


def route(frames, dimension=80, noise=0.2, seed=0):
    """Waves of 16 and of 27 frames, each feature with its own phase; each traverse has its own noise."""
    fixed, fresh = torch.Generator().manual_seed(99), torch.Generator().manual_seed(seed)
    period = torch.tensor([16.0, 27.0]).repeat(dimension // 2)
    turn = torch.arange(frames)[:, None] / period + torch.rand(dimension, generator=fixed)
    return torch.cos(2 * torch.pi * turn) + noise * torch.randn(frames, dimension, generator=fresh)


def recall(match, tolerance=0):
    return evaluate(match, torch.arange(len(match.index))[:, None], tolerance).recall_at_1


# the null control


def test_convention_8_the_null_of_a_repeating_route_finds_no_layers():
    """White noise plus a strong periodic part: in shuffled order it is white noise."""
    reference, query = route(432), route(432, seed=1)
    model = template_model(periods=SpectrogramAnalysis(window=432, strongest=1, false_alarm=1e-6)).learn(
        reference
    )
    ours, null = model.localize(query), null_control(model, reference, query)
    assert recall(ours) > 0.9
    assert null.index.tolist() == [-1] * 432
    assert not null.accepted.any()
    assert evaluate(null, torch.arange(432)[:, None], 5) == (0.0,) * 8


def test_convention_8_the_null_of_the_paper_is_at_chance():
    reference, query = route(432), route(432, seed=1)
    paper = SpectrogramAnalysis(window=432, peaks="bins", false_alarm=None)
    model = template_model(periods=paper, reduction="sum").learn(reference)
    null = null_control(model, reference, query)
    # its second strongest bins are leakage, which costs it many a place, but not all
    assert recall(model.localize(query)) > 0.3
    assert (null.index >= 0).all()
    assert recall(null) < 0.05


def test_convention_8_a_match_of_the_null_names_the_frame_that_is_stored():
    """One template for each frame: every frame is found, wherever the shuffling has put it."""
    reference = torch.rand(50, 6)
    model = template_model(periods=Fixed(layer(50, 0, 50, 0, 1, 2, 3, 4, 5))).learn(reference)
    match = null_control(model, reference, reference)
    assert match.index.tolist() == list(range(50))
    assert match.score.tolist() == [0.0] * 50


@pytest.mark.parametrize("kind", ["templates", "spectral"])
def test_a_sequence_of_the_null_runs_along_the_route(kind):
    """Its map is of shuffled frames, and its scores are added up along the frames as they were."""
    reference = torch.rand(60, 5)
    query = reference + 0.3 * torch.rand(60, 5)
    if kind == "templates":
        model = template_model(periods=Fixed(layer(60, 0, 60, 0, 1, 2, 3, 4)))
    else:
        model = DejaVu(whitening="none", mapper=SpectralMapper(None, step=0.05))
    model.learn_features(reference)
    single, many = (null_control(model, reference, query, sequence=one) for one in (None, SequenceMatcher(9)))
    assert recall(single) < 0.9
    assert recall(many) > 0.95


def test_the_null_shuffles_by_its_seed_and_leaves_the_model_alone():
    reference, query = torch.rand(64, 3), torch.rand(64, 3)
    model = template_model(periods=Fixed(layer(8, 0, 64, 0, 1, 2)), threshold=0.2).learn(reference)
    before = model(query)
    first, again, other = (null_control(model, reference, query, seed) for seed in (0, 0, 1))
    assert torch.equal(first.index, again.index)
    assert torch.equal(first.score, again.score)
    assert not torch.equal(first.score, other.score)
    assert torch.equal(model(query), before)
    assert torch.equal(first.accepted, first.score < 0.2)


def test_the_null_of_the_same_plan_keeps_the_weights_of_the_features():
    """A template a frame: every frame is found at 0 only where both sides are weighted."""
    reference = torch.rand(30, 4)
    model = template_model(periods=Fixed(layer(30, 0, 30, 0, 1, 2, 3))).learn_features(reference)
    model.map.trainable(weights=True, start=torch.tensor([0.0, 1.0, 2.0, 5.0]))
    model.map.freeze()
    templates = model.map.templates.clone()
    query = reference + torch.tensor([9.0, 0.0, 0.0, 0.0])  # what differs counts nothing
    match = null_control(model, reference, query, same_plan=True)
    assert match.index.tolist() == list(range(30))
    assert match.score.abs().max() < 1e-6
    assert torch.equal(model.map.templates, templates)


# leave out

DISTANCES = {
    "l1": lambda a, b: (a - b).abs().sum().item(),
    "l2": lambda a, b: (a - b).square().sum().sqrt().item(),
    "cosine": lambda a, b: 1 - torch.nn.functional.cosine_similarity(a, b, dim=0).item(),
}
WEIGHTS = {"l1": lambda f: f, "l2": math.sqrt, "cosine": lambda f: 1}


def literal_leave_out(features, plan, width, metric, reduction):
    """Learn anew for each query without the frames near it, then look the query up; loops only."""
    index, best = [], []
    for q in range(len(features)):
        scores = []
        for i in range(len(features)):
            total, weight = 0.0, 0.0
            for part in plan:
                if not part.start <= i < part.stop:
                    continue
                chosen = list(part.features)
                phase = [
                    math.floor((j % part.period) * part.phases / part.period) for j in range(len(features))
                ]
                kept = [
                    features[j, chosen]
                    for j in range(part.start, part.stop)
                    if phase[j] == phase[i] and abs(j - q) > width
                ]
                mean = torch.stack(kept).mean(0) if kept else None
                total += math.inf if mean is None else DISTANCES[metric](features[q, chosen], mean)
                weight += WEIGHTS[metric](len(chosen))
            scores.append(math.inf if not weight else total / weight if reduction == "mean" else total)
        lowest = min(scores)
        best.append(lowest)
        index.append(scores.index(lowest) if lowest < math.inf else -1)
    return index, best


PLANS = {
    "whole": (layer(5, 0, 24, 0, 2), layer(7, 0, 24, 1)),
    "fractional": (
        layer(Fraction(11, 2), 0, 24, 0, 1, 2, phases=6),
        layer(Fraction(15, 4), 0, 24, 1, phases=3),
    ),
    "chunks": (layer(4, 0, 10, 0), layer(3, 2, 16, 1, 2), layer(6, 16, 22, 0, 2)),
    "once": (layer(24, 0, 24, 0, 1, 2),),
}


@pytest.mark.parametrize(
    ("plan", "width", "metric", "reduction"),
    [
        (PLANS["whole"], 0, "l2", "mean"),
        (PLANS["fractional"], 3, "l1", "sum"),
        (PLANS["chunks"], 3, "cosine", "mean"),
        (PLANS["chunks"], 0, "l1", "mean"),
        (PLANS["once"], 0, "l2", "mean"),
    ],
)
def test_convention_8_leave_out_equals_learning_without_those_frames(plan, width, metric, reduction):
    features = torch.rand(24, 3, generator=torch.Generator().manual_seed(width), dtype=torch.float64)
    model = template_model(periods=Fixed(*plan), metric=metric, reduction=reduction).learn(features)
    found = leave_out_match(model, features, width)
    index, score = literal_leave_out(features, plan, width, metric, reduction)
    assert found.score.tolist() == pytest.approx(score, abs=1e-9)
    assert found.index.tolist() == index


def test_a_phase_left_without_frames_is_no_place():
    """One frame to a phase: without itself the query finds the places of other frames only."""
    features = torch.arange(6.0)[:, None]
    model = template_model(periods=Fixed(layer(6, 0, 6, 0))).learn(features)
    assert model.localize(features).index.tolist() == list(range(6))
    assert leave_out_match(model, features, 0).index.tolist() == [1, 0, 1, 2, 3, 4]
    everything = leave_out_match(model, features, 6)
    assert everything.index.tolist() == [-1] * 6
    assert everything.score.tolist() == [math.inf] * 6
    assert not everything.accepted.any()


def test_convention_8_the_self_match_trap():
    """Pure noise, folded, recognises itself; not so when each query is taken out of the means."""
    noise, fresh = torch.randn(2, 256, 400, generator=torch.Generator().manual_seed(0))
    chosen = range(400)
    model = template_model(periods=Fixed(layer(29, 0, 256, *chosen), layer(43, 0, 256, *chosen))).learn(noise)
    assert recall(model.localize(noise)) > 0.99
    assert recall(leave_out_match(model, noise, 0)) < 0.03
    assert recall(model.localize(fresh)) < 0.03
    assert recall(null_control(model, noise, fresh)) < 0.03


def test_convention_8_on_sliding_footage_the_neighbours_carry_the_answer():
    """Each frame equals its neighbours but for little: width 0 cures nothing, a wider one does."""
    steps = torch.randn(256, 300, generator=torch.Generator().manual_seed(0))
    kernel = torch.hann_window(9, periodic=False)
    sliding = torch.nn.functional.conv1d(steps.T[:, None], kernel[None, None], padding="same")[:, 0].T
    model = template_model(periods=Fixed(*(layer(p, 0, 256, *range(300)) for p in (29, 43)))).learn(sliding)
    assert recall(leave_out_match(model, sliding, 0), tolerance=5) > 0.8
    assert recall(leave_out_match(model, sliding, 10), tolerance=5) < 0.2


def test_the_threshold_and_an_empty_map():
    features = torch.rand(40, 3)
    model = template_model(periods=Fixed(layer(4, 0, 40, 0, 1, 2)), threshold=0.25).learn(features)
    match = leave_out_match(model, features)
    assert torch.equal(match.accepted, match.score < 0.25)
    empty = template_model(periods=Fixed()).learn(features)
    assert leave_out_match(empty, features).index.tolist() == [-1] * 40
    assert null_control(empty, features, features).index.tolist() == [-1] * 40


def test_leave_out_scores_as_the_model_does():
    """With its temperature, and with the weights of the features."""
    features = torch.rand(40, 3, dtype=torch.float64)
    model = template_model(periods=Fixed(layer(4, 0, 40, 0, 1, 2), layer(5, 0, 30, 0, 1))).learn(features)
    plain = leave_out_match(model, features, 2)
    model.map.temperature = 0.1
    likely = leave_out_match(model, features, 2)
    assert torch.equal(likely.index, plain.index)
    assert not torch.allclose(likely.score, plain.score)
    weights = torch.tensor([0.5, 2.0, 0.0], dtype=torch.float64)
    weighted = template_model(periods=model.mapper.periods, temperature=0.1).learn(features * weights)
    expected = leave_out_match(weighted, features * weights, 2)
    model.map.trainable(weights=True, start=weights)
    model.map.freeze()
    found = leave_out_match(model, features, 2)
    assert torch.equal(found.index, expected.index)
    torch.testing.assert_close(found.score, expected.score, rtol=0, atol=1e-9)


def test_what_leaving_out_does_not_fit_is_refused():
    features = torch.rand(40, 3)
    model = template_model(periods=Fixed(layer(4, 0, 40, 0, 1, 2))).learn(features)
    for given, width in ((features[:39], 0), (features, -1)):
        with refused(f"leave-out got width {width}", "expected width >= 0 and (40, 3)"):
            leave_out_match(model, given, width)
    model.trained = Training(10, None)
    with refused("trained templates", "an untrained map"):
        leave_out_match(model, features)
