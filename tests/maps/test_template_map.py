"""The compressed map: buffers in, the same plan and templates out."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import pytest
import reference
import torch
from helpers import refused, scored
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch import FrequencyLayer, InputError, PhaseTemplates, TemplateMap
from dejavu_torch.types import Plan

PLAN: Plan = (
    FrequencyLayer(Fraction(195, 2), 98, 0, 200, (0, 2)),
    FrequencyLayer(Fraction(7), 7, 100, 250, (1,)),
    FrequencyLayer(Fraction(115), 23, 100, 250, (0, 1, 3)),
)
PLACES, DIMENSION = 300, 4


def make(values: Tensor, plan: Plan) -> TemplateMap:
    return TemplateMap(plan, PhaseTemplates()(values, plan), *values.shape)


@pytest.fixture
def route() -> TemplateMap:
    return make(torch.rand(PLACES, DIMENSION), PLAN)


@given(reference.routes())
def test_state_dict_round_trip_into_an_empty_map(drawn: reference.Route) -> None:
    route, other = make(drawn.values, drawn.plan), TemplateMap()
    other.load_state_dict(route.state_dict())
    assert other.plan == route.plan == drawn.plan
    assert (other.places, other.dimension) == (route.places, route.dimension)
    state = route.state_dict()
    assert state.pop("_extra_state") == other.state_dict()["_extra_state"]
    for name, tensor in state.items():
        assert torch.equal(getattr(other, name), tensor)
        assert getattr(other, name).dtype == tensor.dtype


def test_convention_1_places_count_from_0_and_chunks_are_half_open() -> None:
    last = FrequencyLayer(Fraction(2), 2, 3, 5, (0,))
    assert TemplateMap((last,), [torch.zeros(2, 1)], 5, 1).places == 5
    with pytest.raises(InputError, match=r"covers \[3, 5\).*inside 4 places"):
        TemplateMap((last,), [torch.zeros(2, 1)], 4, 1)


def changed(tensor: Tensor, row: int, column: int, value: int) -> Tensor:
    tensor = tensor.clone()
    tensor[row, column] = value
    return tensor


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("_extra_state", lambda s: {**s, "places": -1}, r"-1 places of 4 features; expected whole numbers"),
        ("_extra_state", lambda s: {**s, "places": 3e9}, r"3000000000.0 places"),
        ("_extra_state", lambda s: {**s, "places": 200}, r"expected it inside 200 places"),
        ("_extra_state", lambda s: {**s, "dimension": 3}, r"expected it inside 300 places of 3 features"),
        ("_extra_state", lambda s: {**s, "kind": "spectral"}, r"kind is 'spectral'; expected 'templates'"),
        ("_extra_state", lambda s: {**s, "metric": "l2"}, r"metric is 'l2'; expected 'l1'"),
        ("_extra_state", lambda s: {**s, "temperature": "warm"}, r"temperature is 'warm'"),
        ("_extra_state", lambda s: [], r"state is a list"),
        ("layers", lambda t: t.flatten(), r"layers .*\(15,\)"),
        ("layers", lambda t: t[:2], r"feature_ptr \(4,\) .*expected \(3,\)"),
        ("layers", lambda t: t.float(), r"layers .*float32; expected"),
        ("layers", lambda t: changed(t, 0, 0, -195), r"period -195/2"),
        ("layers", lambda t: changed(t, 0, 1, 0), r"denominator"),
        ("layers", lambda t: changed(t, 0, 2, 97), r"272.*expected \D*270"),
        ("layers", lambda t: changed(t, 0, 4, 301), r"covers \[0, 301\)"),
        ("layers", lambda t: changed(t, 0, 4, 0), r"covers \[0, 0\)"),
        ("positions", lambda t: torch.arange(299.0), r"positions of 299 places; expected 300"),
        ("positions", lambda t: torch.full((300,), torch.nan), r"positions .*float32; expected finite"),
        ("positions", lambda t: torch.arange(300), r"positions \(300,\) torch.int64; expected finite"),
        ("feature_ptr", lambda t: t[[0, 2, 1, 3]], r"feature_ptr does not rise"),
        ("feature_ptr", lambda t: t + 1, r"feature_ptr does not rise"),
        ("feature_index", lambda t: t[:-1], r"does not rise from 0 to 5"),
        ("feature_index", lambda t: t.flip(0), r"feature indices must be"),
        ("feature_index", lambda t: t + 1, r"feature 4; expected it inside"),
        ("templates", lambda t: t[:-1], r"271.*expected \D*272"),
        ("templates", lambda t: t[None], r"templates .*\(1, 272\)"),
        ("templates", lambda t: t * torch.nan, r"templates that are not finite"),
        ("weights", lambda t: torch.ones(3), r"weights \(3,\); expected \(4,\) or \(0,\)"),
        ("weights", lambda t: torch.tensor([1, 1, 1, torch.inf]), r"weights that are not finite"),
        ("weights", lambda t: torch.ones(4, dtype=torch.int64), r"weights that are not finite floats"),
    ],
)
def test_buffers_that_do_not_fit_together_are_refused(
    route: TemplateMap, name: str, change: Any, message: str
) -> None:
    state = route.state_dict()
    state[name] = change(state[name])
    with pytest.raises(InputError, match=message) as error:
        TemplateMap().load_state_dict(state)
    assert "\n" not in str(error.value)


def test_templates_of_another_shape_are_refused() -> None:
    with refused("98 phases and 2 features got templates (2, 98); expected (98, 2)"):
        TemplateMap(PLAN[:1], [torch.zeros(2, 98)], PLACES, DIMENSION)


# weights, and training

WEIGHTS = torch.tensor([0.5, -1.5, 0.0, 2.0])


def scores(route: TemplateMap, metric: str = "l1") -> Tensor:
    queries = torch.rand(5, DIMENSION, generator=torch.Generator().manual_seed(1))
    return scored(queries, route, metric)


def same(one: Tensor, other: Tensor) -> None:
    torch.testing.assert_close(one, other, rtol=0, atol=1e-6)


def parameters(route: TemplateMap) -> set[str]:
    return {name for name, _ in route.named_parameters()}


@given(drawn=reference.routes(), seed=st.integers(0, 2**16))
def test_weights_and_templates_scale_alike(drawn: reference.Route, seed: int) -> None:
    """The map of weighted features, given weighted queries, is the map with weights."""
    generator = torch.Generator().manual_seed(seed)
    weights = torch.rand(drawn.values.shape[1], generator=generator)
    queries = torch.randn(3, len(weights), generator=generator, dtype=torch.float64)
    route = make(drawn.values, drawn.plan)
    route.trainable(weights=True, start=weights)
    expected = scored(queries * weights, make(drawn.values * weights, drawn.plan))
    torch.testing.assert_close(scored(queries, route), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("weights", [False, True])
@pytest.mark.parametrize("templates", [False, True])
def test_training_is_asked_for_and_frozen_without_a_change_of_scores(
    route: TemplateMap, templates: bool, weights: bool
) -> None:
    before = scores(route)
    route.trainable(templates, weights)
    assert parameters(route) == {n for n, on in (("templates", templates), ("weights", weights)) if on}
    assert torch.equal(scores(route), before)
    route.freeze()
    assert parameters(route) == set()
    assert torch.equal(scores(route), before)
    assert route.weights.tolist() == [1.0] * DIMENSION * weights


@pytest.mark.parametrize("metric", ["l1", "l2", "cosine"])
def test_trained_weights_freeze_to_none_below_0(route: TemplateMap, metric: str) -> None:
    route.trainable(weights=True)
    with torch.no_grad():
        route.weights.copy_(WEIGHTS)
        route.templates.add_(torch.randn_like(route.templates))
    before = scores(route, metric)
    route.freeze()
    assert torch.equal(route.weights, WEIGHTS.abs())
    same(scores(route, metric), before)


def test_training_goes_on_from_weights(route: TemplateMap) -> None:
    """The templates, made of plain features, become those of weighted ones; once only."""
    plain = [block.clone() for block in route.blocks()]
    route.trainable(weights=True, start=WEIGHTS)
    assert torch.equal(route.weights, WEIGHTS)
    for block, old, layer in zip(route.blocks(), plain, PLAN, strict=True):
        assert torch.equal(block, old * WEIGHTS[list(layer.features)])
    before = scores(route)
    route.trainable(weights=True, start=torch.ones(DIMENSION))
    assert torch.equal(route.weights, WEIGHTS.abs())
    same(scores(route), before)


def test_a_start_of_another_shape_is_refused(route: TemplateMap) -> None:
    with refused("weights start as (4, 1)", "expected (4,)"):
        route.trainable(weights=True, start=torch.ones(4, 1))


def test_training_that_ended_in_nan_is_not_frozen(route: TemplateMap) -> None:
    route.trainable(weights=True)
    with torch.no_grad():
        route.weights[1] = torch.nan
    with refused("weights that are not finite"):
        route.freeze()


@pytest.mark.parametrize("frozen", [True, False])
def test_trained_weights_go_into_an_empty_map(route: TemplateMap, frozen: bool) -> None:
    route.trainable(weights=True, start=WEIGHTS)
    if frozen:
        route.freeze()
    other = TemplateMap()
    other.load_state_dict(route.state_dict())
    assert torch.equal(other.weights, route.weights)
    assert torch.equal(scores(other), scores(route))


def test_a_state_goes_into_a_map_that_trains(route: TemplateMap) -> None:
    """As a checkpoint does; weights may be below 0 on the way."""
    route.trainable(weights=True, start=WEIGHTS)
    other = make(torch.rand(PLACES, DIMENSION), PLAN)
    other.trainable(weights=True)
    parameter = other.weights
    other.load_state_dict(route.state_dict())
    assert other.weights is parameter
    assert parameters(other) == {"templates", "weights"}
    assert torch.equal(scores(other), scores(route))


def test_a_state_of_other_layers_does_not_go_into_a_map_that_trains(route: TemplateMap) -> None:
    route.trainable()
    other = make(torch.rand(20, 1), (FrequencyLayer(Fraction(5), 5, 0, 20, (0,)),))
    with pytest.raises((RuntimeError, InputError), match="templates"):
        route.load_state_dict(other.state_dict())
