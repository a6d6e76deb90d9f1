"""Losses: closed forms, literal loops, gradients also where a place is uncovered; their weighted sum."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
import reference
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import PhaseTemplates, TemplateMap
from dejavu_torch.maps.template_map import log_posterior
from dejavu_torch.training.losses import Objective, phase_cross_entropy, place_cross_entropy
from dejavu_torch.types import FrequencyLayer

INF = math.inf
PLAN = (
    FrequencyLayer(Fraction(4), 4, 0, 12, (0, 2)),
    FrequencyLayer(Fraction(5, 2), 3, 6, 20, (0, 1, 3)),
)


def normal(*shape, grad=False):
    return torch.randn(shape, dtype=torch.float64, requires_grad=grad)


def close(a, b, atol=1e-12):
    torch.testing.assert_close(a, torch.as_tensor(b, dtype=a.dtype), rtol=0, atol=atol)


# ------------------------------------------------------------------------ places


def share(row, right, temperature):
    """-log of what the softmax of -row / T gives to the right ones."""
    weights = [math.exp(-value / temperature) for value in row]
    return -math.log(sum(weights[i] for i in right) / sum(weights))


@given(
    st.integers(1, 9).flatmap(
        lambda n: st.lists(
            st.tuples(
                st.lists(st.one_of(st.floats(0, 3), st.just(INF)), min_size=n, max_size=n),
                st.lists(st.integers(-1, n - 1), min_size=3, max_size=3),
            ),
            min_size=1,
            max_size=5,
        )
    ),
    st.integers(0, 10),
)
def test_the_place_loss_is_the_literal_one(rows, tolerance):
    losses = []
    for row, places in rows:
        right = [i for i in range(len(row)) if any(p >= 0 and abs(i - p) <= tolerance for p in places)]
        if any(row[i] < INF for i in right):
            losses.append(share(row, right, 0.7))
    scores = torch.tensor([row for row, _ in rows], dtype=torch.float64, requires_grad=True)
    loss, left_out = place_cross_entropy(scores, torch.tensor([p for _, p in rows]), tolerance, 0.7)
    assert left_out == len(rows) - len(losses)
    close(loss.detach(), sum(losses) / max(1, len(losses)), 1e-10)
    (gradient,) = torch.autograd.grad(loss, scores)
    assert gradient.isfinite().all()
    assert (gradient[scores.isposinf()] == 0).all()


def test_gradients_of_the_place_loss_reach_scores_and_temperature():
    scores, temperature = normal(3, 8, grad=True), torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    places, gap = torch.tensor([[1, 6], [4, -1], [-1, -1]]), torch.arange(8) == 2

    def loss(scores, temperature):
        return place_cross_entropy(scores.masked_fill(gap, INF), places, 1, temperature).loss

    assert torch.autograd.gradcheck(loss, (scores, temperature))


def test_half_scores_are_summed_in_single_precision():
    scores = torch.rand(4, 3000).half()
    loss = place_cross_entropy(scores, torch.arange(4)[:, None], 0, 0.01).loss
    assert loss.dtype == torch.float32
    close(loss, place_cross_entropy(scores.double(), torch.arange(4)[:, None], 0, 0.01).loss.float(), 1e-3)


def test_the_place_loss_builds_nothing_of_queries_times_places_times_answers(largest_tensor):
    with largest_tensor() as seen:
        place_cross_entropy(torch.rand(16, 500), torch.randint(0, 500, (16, 40)), 5, 0.1)
    assert seen.numel <= 16 * 501


def test_phase_loss_is_the_literal_one():
    distances = [normal(4, layer.phases).abs() for layer in PLAN]
    places = torch.tensor([[2, 9, 15], [7, 11, -1], [19, -1, -1], [-1, -1, -1]])
    losses = []
    for block, layer in zip(distances, PLAN, strict=True):
        for row, right in zip(block.tolist(), places.tolist(), strict=True):
            phases = {reference.phase(i, layer) for i in right if layer.start <= i < layer.stop}
            losses += [share(row, list(phases), 0.3)] if phases else []
    assert len(losses) == 5
    close(phase_cross_entropy(distances, PLAN, places, 0.3), sum(losses) / 5)


def test_gradients_of_the_phase_loss_and_none_where_nothing_is_covered():
    temperature = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    distances = [normal(3, layer.phases, grad=True) for layer in PLAN]
    places = torch.tensor([[2, 9], [15, -1], [-1, -1]])
    assert torch.autograd.gradcheck(
        lambda t, *d: phase_cross_entropy(d, PLAN, places, t), (temperature, *distances)
    )
    loss = phase_cross_entropy(distances, PLAN, torch.full((3, 1), 25), temperature)
    assert loss.item() == 0
    assert all((g == 0).all() for g in torch.autograd.grad(loss, [temperature, *distances]))


# ------------------------------------------------------------------- weighted sum

T = torch.tensor(0.5)


def route_of(reduction="mean"):
    """A route of 30 places with a layer of 3 phases and one of 5, and features of its frames."""
    plan = (FrequencyLayer(6, 3, 0, 30, (0, 1)), FrequencyLayer(5, 5, 0, 30, (2,)))
    features = torch.randn(30, 3)
    return TemplateMap(plan, PhaseTemplates()(features, plan), 30, 3, reduction=reduction), features


def losses(route, features, places, objective):
    distances = route.distances(features)
    return objective(distances, log_posterior(route.combine(distances), T), places, route, T, 1)


def test_the_total_is_the_weighted_sum_of_the_parts():
    route, features = route_of()
    places = torch.arange(30)[:, None]
    places[4] = -1
    total, parts, left_out = losses(route, features, places, Objective(place=0.5, phase=2.0))
    assert list(parts) == ["place", "phase"]
    torch.testing.assert_close(total, 0.5 * parts["place"] + 2 * parts["phase"])
    assert left_out == 1
    torch.testing.assert_close(parts["place"], place_cross_entropy(route(features), places, 1, T).loss)
    total, parts, _ = losses(route, features, places, Objective(phase=0.0))
    assert list(parts) == ["place"]
    assert torch.equal(total, parts["place"])
    total, parts, _ = losses(route, features, places, Objective(place=0.0))
    assert torch.equal(total, parts["phase"])
    assert parts["place"] > 0  # it is shown all the same


@pytest.mark.parametrize(("reduction", "per"), [("mean", (2, 1)), ("sum", (1, 1))])
def test_phases_are_in_the_units_of_the_scores(reduction, per):
    route, features = route_of(reduction)
    places = torch.arange(30)[:, None]
    distances = [one / count for one, count in zip(route.distances(features), per, strict=True)]
    expected = phase_cross_entropy(distances, route.plan, places, T)
    torch.testing.assert_close(losses(route, features, places, Objective()).parts["phase"], expected)


# --------------------------------------------------------------------- bad input

SCORES, PLACES = torch.rand(3, 9), torch.zeros(3, 2, dtype=torch.int64)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: place_cross_entropy(SCORES, PLACES[:2], 1, 1.0), ["(3, 9)", "(2, 2)", "(Q,R) int64"]),
        (lambda: place_cross_entropy(SCORES, PLACES.float(), 1, 1.0), ["torch.float32", "int64"]),
        (lambda: place_cross_entropy(SCORES, PLACES + 9, 1, 1.0), ["[9, 9, 9]", "0..8"]),
        (lambda: place_cross_entropy(SCORES, PLACES - 2, 1, 1.0), ["[-2, -2, -2]", "0..8"]),
        (lambda: place_cross_entropy(SCORES, PLACES, -1, 1.0), ["tolerance is -1", "at least 0"]),
        (lambda: place_cross_entropy(SCORES, PLACES, 1, 0.0), ["temperature is 0.0", "above 0"]),
        (lambda: place_cross_entropy(SCORES, PLACES, 1, torch.tensor(math.nan)), ["temperature is nan"]),
        (lambda: phase_cross_entropy([], (), PLACES, 1.0), ["distances are []", "at least one"]),
        (lambda: phase_cross_entropy([SCORES], PLAN, PLACES, 1.0), ["[(3, 9)]", "[(3, 4), (3, 3)]"]),
        (lambda: phase_cross_entropy([SCORES[:, :4], SCORES[:, :3]], PLAN, PLACES, -1.0), ["is -1.0"]),
        (lambda: Objective(place=-1.0), ["place=-1.0", "0 or more"]),
        (lambda: Objective(phase=math.nan), ["phase=nan", "0 or more"]),
        (lambda: Objective(phase=math.inf), ["phase=inf"]),
        (lambda: Objective(0.0, 0.0), ["one above 0"]),
    ],
)
def test_bad_input_is_refused(call, words):
    with refused(*words):
        call()
