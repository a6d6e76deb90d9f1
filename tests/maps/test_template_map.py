"""The compressed map: buffers in, the same plan and templates out."""

from __future__ import annotations

from fractions import Fraction

import pytest
import reference
import torch
from helpers import refused, scored
from hypothesis import given
from hypothesis import strategies as st
from test_scores import make

from dejavu_torch import FrequencyLayer, InputError, TemplateMap

PLAN = (
    FrequencyLayer(Fraction(195, 2), 98, 0, 200, (0, 2)),
    FrequencyLayer(Fraction(7), 7, 100, 250, (1,)),
    FrequencyLayer(Fraction(115), 23, 100, 250, (0, 1, 3)),
)
PLACES, DIMENSION = 300, 4


@pytest.fixture
def route():
    return make(torch.rand(PLACES, DIMENSION), PLAN)


@given(reference.routes())
def test_state_dict_round_trip_into_an_empty_map(drawn):
    route, other = make(drawn.values, drawn.plan), TemplateMap()
    other.load_state_dict(route.state_dict())
    assert other.plan == route.plan == drawn.plan
    assert (other.places, other.dimension) == (route.places, route.dimension)
    state = route.state_dict()
    assert state.pop("_extra_state") == other.state_dict()["_extra_state"]
    for name, tensor in state.items():
        assert torch.equal(getattr(other, name), tensor)
        assert getattr(other, name).dtype == tensor.dtype


def test_convention_1_places_count_from_0_and_chunks_are_half_open():
    last = FrequencyLayer(Fraction(2), 2, 3, 5, (0,))
    assert TemplateMap((last,), [torch.zeros(2, 1)], 5, 1).places == 5
    with pytest.raises(InputError, match=r"covers \[3, 5\).*inside 4 places"):
        TemplateMap((last,), [torch.zeros(2, 1)], 4, 1)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("_extra_state", lambda s: {**s, "places": 200}, "expected it inside 200 places"),
        ("_extra_state", lambda s: {**s, "dimension": 3}, "expected it inside 300 places of 3 features"),
        ("_extra_state", lambda s: {**s, "kind": "spectral"}, "kind is 'spectral'; expected 'templates'"),
        ("_extra_state", lambda s: {**s, "metric": "l2"}, "metric is 'l2'; expected 'l1'"),
        ("_extra_state", lambda s: {**s, "temperature": "warm"}, "temperature is 'warm'"),
        ("layers", lambda t: t * torch.tensor([-1, 1, 1, 1, 1]), "period -195/2"),
        ("layers", lambda t: t + torch.tensor([0, 0, 1, 0, 0]), "templates (272,); expected (278,)"),
        ("layers", lambda t: t + torch.tensor([0, 0, 0, 0, 101]), "covers [0, 301)"),
        ("layers", lambda t: t * torch.tensor([1, 1, 1, 1, 0]), "covers [0, 0)"),
        ("positions", lambda t: torch.arange(299.0), "positions of 299 places; expected 300"),
        ("feature_index", lambda t: t.flip(0), "layer features (3, 1); expected 1 or more, increasing"),
        ("feature_index", lambda t: t + 1, "feature 4; expected it inside"),
        ("templates", lambda t: t * torch.nan, "templates that are not finite"),
        ("weights", lambda t: torch.ones(3), "weights (3,); expected (4,) or (0,)"),
    ],
)
def test_buffers_that_do_not_fit_together_are_refused(route, name, change, message):
    state = route.state_dict()
    state[name] = change(state[name])
    with refused(message):
        TemplateMap().load_state_dict(state)


def test_templates_of_another_shape_are_refused():
    with refused("templates of a layer are (2, 98)", "(P,F) = (98, 2)"):
        TemplateMap(PLAN[:1], [torch.zeros(2, 98)], PLACES, DIMENSION)


# weights, and training

WEIGHTS = torch.tensor([0.5, -1.5, 0.0, 2.0])


def scores(route, metric="l1"):
    queries = torch.rand(5, DIMENSION, generator=torch.Generator().manual_seed(1))
    return scored(queries, route, metric)


def parameters(route):
    return {name for name, _ in route.named_parameters()}


@given(drawn=reference.routes(), seed=st.integers(0, 2**16))
def test_weights_and_templates_scale_alike(drawn, seed):
    """The map of weighted features, given weighted queries, is the map with weights."""
    generator = torch.Generator().manual_seed(seed)
    weights = torch.rand(drawn.values.shape[1], generator=generator)
    queries = torch.randn(3, len(weights), generator=generator, dtype=torch.float64)
    route = make(drawn.values, drawn.plan)
    route.trainable(weights=True, start=weights)
    expected = scored(queries * weights, make(drawn.values * weights, drawn.plan))
    torch.testing.assert_close(scored(queries, route), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("templates", "weights"), [(True, False), (False, True), (True, True)])
def test_training_is_asked_for_and_frozen_without_a_change_of_scores(route, templates, weights):
    before = scores(route)
    route.trainable(templates, weights)
    assert parameters(route) == {n for n, on in (("templates", templates), ("weights", weights)) if on}
    assert torch.equal(scores(route), before)
    route.freeze()
    assert parameters(route) == set()
    assert torch.equal(scores(route), before)
    assert route.weights.tolist() == [1.0] * DIMENSION * weights


@pytest.mark.parametrize("metric", ["l1", "l2", "cosine"])
def test_trained_weights_freeze_to_none_below_0(route, metric):
    route.trainable(weights=True)
    with torch.no_grad():
        route.weights.copy_(WEIGHTS)
        route.templates.add_(torch.randn_like(route.templates))
    before = scores(route, metric)
    route.freeze()
    assert torch.equal(route.weights, WEIGHTS.abs())
    torch.testing.assert_close(scores(route, metric), before, rtol=0, atol=1e-6)


def test_training_goes_on_from_weights(route):
    """The templates, made of plain features, become those of weighted ones; once only."""
    plain = [block.clone() for block in route.blocks()]
    route.trainable(weights=True, start=WEIGHTS)
    assert torch.equal(route.weights, WEIGHTS)
    for block, old, layer in zip(route.blocks(), plain, PLAN, strict=True):
        assert torch.equal(block, old * WEIGHTS[list(layer.features)])
    before = scores(route)
    route.trainable(weights=True, start=torch.ones(DIMENSION))
    assert torch.equal(route.weights, WEIGHTS.abs())
    torch.testing.assert_close(scores(route), before, rtol=0, atol=1e-6)


def test_weights_that_are_none_are_refused(route):
    with refused("weights start as (4, 1)", "expected (4,)"):
        route.trainable(weights=True, start=torch.ones(4, 1))
    route.trainable(weights=True)
    with torch.no_grad():
        route.weights[1] = torch.nan
    with refused("weights that are not finite"):
        route.freeze()


def test_a_state_goes_into_an_empty_map_and_into_one_that_trains(route):
    """As a checkpoint does; weights may be below 0 on the way."""
    route.trainable(weights=True, start=WEIGHTS)
    empty, other = TemplateMap(), make(torch.rand(PLACES, DIMENSION), PLAN)
    other.trainable(weights=True)
    parameter = other.weights
    for one in (empty, other):
        one.load_state_dict(route.state_dict())
        assert torch.equal(scores(one), scores(route))
    assert other.weights is parameter
    assert parameters(other) == {"templates", "weights"}
    with pytest.raises((RuntimeError, InputError), match="templates"):  # of other layers
        other.load_state_dict(make(torch.rand(20, 1), (FrequencyLayer(5, 5, 0, 20, (0,)),)).state_dict())
