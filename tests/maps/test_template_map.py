"""The compressed map: buffers in, the same plan and templates out."""

from __future__ import annotations

from fractions import Fraction

import pytest
import reference
import torch
from helpers import refused, scored
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

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


def test_buffers_are_flat_rows(route: TemplateMap) -> None:
    numbers = 98 * 2 + 7 * 1 + 23 * 3
    state = route.state_dict()
    extra = state.pop("_extra_state")
    assert extra == {
        "kind": "templates",
        "places": 300,
        "dimension": 4,
        "metric": "l1",
        "reduction": "mean",
        "temperature": None,
    }
    assert {name: tuple(tensor.shape) for name, tensor in state.items()} == {
        "layers": (3, 5),
        "feature_ptr": (4,),
        "feature_index": (6,),
        "templates": (numbers,),
        "positions": (0,),
        "weights": (0,),
    }
    assert route.layers.tolist() == [[195, 2, 98, 0, 200], [7, 1, 7, 100, 250], [115, 1, 23, 100, 250]]
    assert route.feature_ptr.tolist() == [0, 2, 3, 6]
    assert route.feature_index.tolist() == [0, 2, 1, 0, 1, 3]
    assert (route.feature_index.dtype, route.layers.dtype) == (torch.int32, torch.int64)
    assert list(route.parameters()) == []


def test_plan_and_templates_come_back(route: TemplateMap) -> None:
    values = torch.rand(PLACES, DIMENSION)
    templates = PhaseTemplates()(values, PLAN)
    route = TemplateMap(PLAN, templates, PLACES, DIMENSION)
    assert route.plan == PLAN
    assert (route.places, route.dimension) == (PLACES, DIMENSION)
    for block, index, mu, layer in zip(route.blocks(), route.layer_features(), templates, PLAN, strict=True):
        assert torch.equal(block, mu)
        assert tuple(index.tolist()) == layer.features


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


def test_loading_replaces_what_was_there(route: TemplateMap) -> None:
    other = make(torch.rand(20, 1), (FrequencyLayer(Fraction(5), 5, 0, 20, (0,)),))
    assert other.plan  # read once before, so that a remembered plan would show
    other.load_state_dict(route.state_dict())
    assert other.plan == PLAN
    other.load_state_dict(TemplateMap().state_dict())
    assert (other.plan, other.places) == ((), 0)


def test_loading_as_a_part_of_a_module(route: TemplateMap) -> None:
    whole, empty = nn.ModuleDict({"map": route}), nn.ModuleDict({"map": TemplateMap()})
    empty.load_state_dict(whole.state_dict())
    assert empty["map"].plan == PLAN  # type: ignore[union-attr]


def test_a_loaded_map_does_not_share_memory(route: TemplateMap) -> None:
    state = route.state_dict()
    other = TemplateMap()
    other.load_state_dict(state)
    state["templates"].zero_()
    assert other.templates.count_nonzero() > 0


def test_missing_buffers_are_named(route: TemplateMap) -> None:
    state = route.state_dict()
    del state["templates"]
    with pytest.raises((RuntimeError, InputError), match="template"):
        TemplateMap().load_state_dict(state)


def test_to_float64_converts_templates_only(route: TemplateMap) -> None:
    before = route.templates.clone()
    route.to(torch.float64)
    assert route.templates.dtype == torch.float64
    assert route.feature_index.dtype == torch.int32
    torch.testing.assert_close(route.templates, before.double())
    assert route.plan == PLAN
    assert all(block.dtype == torch.float64 for block in route.blocks())


def test_templates_keep_their_type() -> None:
    plan = PLAN[1:2]
    for dtype in (torch.float16, torch.float32, torch.float64):
        route = TemplateMap(plan, [torch.ones(7, 1, dtype=dtype)], PLACES, DIMENSION)
        other = TemplateMap()
        other.load_state_dict(route.state_dict())
        assert other.templates.dtype == route.templates.dtype == dtype


def test_templates_carry_gradients() -> None:
    values = torch.rand(PLACES, DIMENSION, requires_grad=True)
    route = make(values, PLAN)
    sum(block.sum() for block in route.blocks()).backward()  # type: ignore[union-attr]
    assert values.grad is not None
    # the templates of a feature sum to one over each phase's frames: 98 + 23 phases, 7 + 23, 98, 23
    torch.testing.assert_close(values.grad.sum(0), torch.tensor([121.0, 30.0, 98.0, 23.0]))


def test_an_empty_map() -> None:
    route = TemplateMap()
    assert (route.plan, route.places, route.dimension, route.blocks(), route.layer_features()) == (
        (),
        0,
        0,
        [],
        [],
    )
    nowhere = TemplateMap((), (), 50, 3)
    assert (nowhere.places, nowhere.dimension, nowhere.plan) == (50, 3, ())


def test_convention_1_places_count_from_0_and_chunks_are_half_open() -> None:
    last = FrequencyLayer(Fraction(2), 2, 3, 5, (0,))
    assert TemplateMap((last,), [torch.zeros(2, 1)], 5, 1).places == 5
    with pytest.raises(InputError, match=r"covers \[3, 5\).*inside 4 places"):
        TemplateMap((last,), [torch.zeros(2, 1)], 4, 1)


def test_templates_of_another_shape_are_refused() -> None:
    for shape in ((98, 1), (2, 98), (196,)):
        with pytest.raises(
            InputError, match=r"98 phases and 2 features got templates .*; expected \(98, 2\)"
        ):
            TemplateMap(PLAN[:1], [torch.zeros(shape)], PLACES, DIMENSION)


def changed(tensor: Tensor, row: int, column: int, value: int) -> Tensor:
    tensor = tensor.clone()
    tensor[row, column] = value
    return tensor


def test_buffers_that_do_not_fit_together_are_refused(route: TemplateMap) -> None:
    for name, change, message in (
        ("_extra_state", lambda s: {**s, "places": -1}, r"-1 places of 4 features; expected whole numbers"),
        ("_extra_state", lambda s: {**s, "places": 3e9}, r"3000000000.0 places"),
        ("_extra_state", lambda s: {**s, "places": 200}, r"expected it inside 200 places"),
        (
            "_extra_state",
            lambda s: {**s, "dimension": 3},
            r"feature 3; expected it inside 300 places of 3 fea",
        ),
        ("_extra_state", lambda s: {**s, "kind": "spectral"}, r"kind is 'spectral'; expected 'templates'"),
        ("_extra_state", lambda s: {**s, "metric": "l2"}, r"metric is 'l2'; expected 'l1'"),
        ("_extra_state", lambda s: {**s, "reduction": "sum"}, r"reduction is 'sum'; expected 'mean'"),
        ("_extra_state", lambda s: {**s, "temperature": "warm"}, r"temperature is 'warm'"),
        ("_extra_state", lambda s: [], r"state is a list"),
        ("layers", lambda t: t.flatten(), r"layers .*\(15,\)"),
        ("layers", lambda t: t[:, :4], r"layers .*\(3, 4\)"),
        ("layers", lambda t: t[:2], r"feature_ptr \(4,\) .*expected \(3,\)"),
        ("positions", lambda t: torch.arange(299.0), r"positions of 299 places; expected 300"),
        (
            "positions",
            lambda t: torch.full((300,), torch.nan),
            r"positions \(300,\) torch.float32; expected finite",
        ),
        ("positions", lambda t: torch.arange(300), r"positions \(300,\) torch.int64; expected finite"),
        ("layers", lambda t: changed(t, 0, 0, -195), r"period -195/2"),
        ("layers", lambda t: changed(t, 0, 1, 0), r"denominator"),
        ("layers", lambda t: changed(t, 0, 2, 0), r"templates .*272.*expected \D*76"),
        ("layers", lambda t: changed(t, 0, 2, 97), r"272.*expected \D*270"),
        ("layers", lambda t: changed(t, 0, 4, 301), r"covers \[0, 301\)"),
        ("layers", lambda t: changed(t, 0, 4, 0), r"covers \[0, 0\)"),
        ("feature_ptr", lambda t: t[:-1], r"feature_ptr \(3,\) .*expected \(4,\)"),
        ("feature_ptr", lambda t: t[[0, 2, 1, 3]], r"feature_ptr does not rise"),
        ("feature_ptr", lambda t: t + 1, r"feature_ptr does not rise"),
        ("feature_index", lambda t: t[:-1], r"does not rise from 0 to 5"),
        ("feature_index", lambda t: t.flip(0), r"feature indices must be"),
        ("feature_index", lambda t: t + 1, r"feature 4; expected it inside"),
        ("templates", lambda t: t[:-1], r"271.*expected \D*272"),
        ("templates", lambda t: t[None], r"templates .*\(1, 272\)"),
        ("weights", lambda t: torch.ones(3), r"weights \(3,\); expected \(4,\) or \(0,\)"),
        ("weights", lambda t: torch.ones(4, 1), r"weights \(4, 1\); expected \(4,\) or \(0,\)"),
        ("weights", lambda t: torch.tensor([1, 1, 1, torch.nan]), r"weights that are not finite"),
        ("weights", lambda t: torch.tensor([1, 1, 1, torch.inf]), r"weights that are not finite"),
        ("weights", lambda t: torch.ones(4, dtype=torch.int64), r"weights that are not finite floats"),
    ):
        state = route.state_dict()
        state[name] = change(state[name])  # type: ignore[operator]
        with pytest.raises(InputError, match=message) as error:
            TemplateMap().load_state_dict(state)
        assert "\n" not in str(error.value)


def test_indices_that_are_no_whole_numbers_are_refused(route: TemplateMap) -> None:
    for name in ("layers", "feature_ptr", "feature_index"):
        state = route.state_dict()
        state[name] = state[name].float()
        with pytest.raises(InputError):
            TemplateMap().load_state_dict(state)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_templates_that_are_not_finite_are_refused(route: TemplateMap, bad: float) -> None:
    state = route.state_dict()
    state["templates"][5] = bad
    with pytest.raises(InputError, match="not finite"):
        TemplateMap().load_state_dict(state)


# weights, and training

WEIGHTS = torch.tensor([0.5, -1.5, 0.0, 2.0])


def scores(route: TemplateMap, metric: str = "l1") -> Tensor:
    queries = torch.rand(5, DIMENSION, generator=torch.Generator().manual_seed(1))
    return scored(queries, route, metric)


def same(one: Tensor, other: Tensor) -> None:
    torch.testing.assert_close(one, other, rtol=0, atol=1e-6)


def parameters(route: TemplateMap) -> set[str]:
    return {name for name, _ in route.named_parameters()}


def test_a_weight_says_what_a_difference_in_its_feature_counts() -> None:
    plan = (FrequencyLayer(Fraction(2), 2, 0, 4, (0, 1)),)
    weights = torch.tensor([3.0, 0.5])
    values = torch.tensor([[1.0, 8.0], [5.0, 2.0], [1.0, 8.0], [5.0, 2.0]])
    blocks = PhaseTemplates()(values * weights, plan)
    route = TemplateMap(plan, blocks, 4, 2, weights=weights)
    query = torch.tensor([[2.0, 2.0]])
    assert route.weighted(query).tolist() == [[6.0, 1.0]]
    distances = [3 * 1 + 0.5 * 6, 3 * 3 + 0.5 * 0]
    assert scored(query, route, reduction="sum").tolist() == [2 * distances]


def test_without_weights_features_stay_as_they_are(route: TemplateMap) -> None:
    features = torch.rand(3, DIMENSION)
    assert torch.equal(route.weighted(features), features)


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


def test_freezing_twice_changes_nothing(route: TemplateMap) -> None:
    route.trainable(weights=True, start=WEIGHTS)
    route.freeze()
    before = route.templates.clone()
    route.freeze()
    assert torch.equal(route.templates, before)


def test_gradients_reach_templates_and_weights(route: TemplateMap) -> None:
    route.trainable(weights=True)
    found = scores(route)
    found[found.isfinite()].sum().backward()
    for name, parameter in route.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all()
        assert parameter.grad.abs().max() > 0


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


def test_the_start_is_copied_and_an_empty_one_is_none(route: TemplateMap) -> None:
    start = torch.ones(DIMENSION)
    route.trainable(weights=True, start=start)
    start.zero_()
    assert route.weights.tolist() == [1.0] * DIMENSION
    other = make(torch.rand(PLACES, DIMENSION), PLAN)
    other.trainable(weights=True, start=torch.zeros(0))
    assert other.weights.tolist() == [1.0] * DIMENSION


def test_weights_can_be_trained_after_the_templates(route: TemplateMap) -> None:
    before = scores(route)
    route.trainable()
    route.trainable(templates=False, weights=True)
    assert parameters(route) == {"weights"}
    assert torch.equal(scores(route), before)


def test_a_start_of_another_shape_is_refused(route: TemplateMap) -> None:
    for shape in ((3,), (5,), (4, 1)):
        with refused(f"weights start as {shape}", "expected (4,)"):
            route.trainable(weights=True, start=torch.ones(shape))


def test_training_that_ended_in_nan_is_not_frozen(route: TemplateMap) -> None:
    route.trainable(weights=True)
    with torch.no_grad():
        route.weights[1] = torch.nan
    with refused("weights that are not finite"):
        route.freeze()


def test_a_map_without_layers_can_be_trained_and_frozen() -> None:
    route = TemplateMap((), (), 20, DIMENSION)
    route.trainable(weights=True, start=WEIGHTS)
    route.freeze()
    assert route.weights.tolist() == WEIGHTS.abs().tolist()
    assert scores(route).isposinf().all()


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


def test_double_weights_follow_the_templates(route: TemplateMap) -> None:
    route.double().trainable(weights=True)
    assert route.weights.dtype == torch.float64
