"""The compressed map: buffers in, the same plan and templates out."""

from __future__ import annotations

from fractions import Fraction

import pytest
import reference
import torch
from hypothesis import given
from torch import Tensor, nn

from dejavu_torch import CompressedMap, FrequencyLayer, InputError, PhaseTemplates
from dejavu_torch.types import Plan

PLAN: Plan = (
    FrequencyLayer(Fraction(195, 2), 98, 0, 200, (0, 2)),
    FrequencyLayer(Fraction(7), 7, 100, 250, (1,)),
    FrequencyLayer(Fraction(115), 23, 100, 250, (0, 1, 3)),
)
PLACES, DIMENSION = 300, 4


def make(values: Tensor, plan: Plan) -> CompressedMap:
    return CompressedMap(plan, PhaseTemplates()(values, plan), *values.shape)


@pytest.fixture
def route() -> CompressedMap:
    return make(torch.rand(PLACES, DIMENSION), PLAN)


def test_buffers_are_flat_rows(route: CompressedMap) -> None:
    numbers = 98 * 2 + 7 * 1 + 23 * 3
    state = route.state_dict()
    assert {name: tuple(tensor.shape) for name, tensor in state.items()} == {
        "size": (2,),
        "layers": (3, 5),
        "feature_ptr": (4,),
        "feature_index": (6,),
        "templates": (numbers,),
        "way": (0,),
    }
    assert route.size.tolist() == [300, 4]
    assert route.layers.tolist() == [[195, 2, 98, 0, 200], [7, 1, 7, 100, 250], [115, 1, 23, 100, 250]]
    assert route.feature_ptr.tolist() == [0, 2, 3, 6]
    assert route.feature_index.tolist() == [0, 2, 1, 0, 1, 3]
    assert (route.feature_index.dtype, route.layers.dtype) == (torch.int32, torch.int64)
    assert list(route.parameters()) == []


def test_plan_and_templates_come_back(route: CompressedMap) -> None:
    values = torch.rand(PLACES, DIMENSION)
    templates = PhaseTemplates()(values, PLAN)
    route = CompressedMap(PLAN, templates, PLACES, DIMENSION)
    assert route.plan == PLAN
    assert (route.places, route.dimension) == (PLACES, DIMENSION)
    for block, index, mu, layer in zip(route.blocks(), route.layer_features(), templates, PLAN, strict=True):
        assert torch.equal(block, mu)
        assert tuple(index.tolist()) == layer.features


@given(reference.routes())
def test_state_dict_round_trip_into_an_empty_map(drawn: reference.Route) -> None:
    route, other = make(drawn.values, drawn.plan), CompressedMap()
    other.load_state_dict(route.state_dict())
    assert other.plan == route.plan == drawn.plan
    assert (other.places, other.dimension) == (route.places, route.dimension)
    for name, tensor in route.state_dict().items():
        assert torch.equal(getattr(other, name), tensor)
        assert getattr(other, name).dtype == tensor.dtype


def test_loading_replaces_what_was_there(route: CompressedMap) -> None:
    other = make(torch.rand(20, 1), (FrequencyLayer(Fraction(5), 5, 0, 20, (0,)),))
    assert other.plan  # read once before, so that a remembered plan would show
    other.load_state_dict(route.state_dict())
    assert other.plan == PLAN
    other.load_state_dict(CompressedMap().state_dict())
    assert (other.plan, other.places) == ((), 0)


def test_loading_as_a_part_of_a_module(route: CompressedMap) -> None:
    whole, empty = nn.ModuleDict({"map": route}), nn.ModuleDict({"map": CompressedMap()})
    empty.load_state_dict(whole.state_dict())
    assert empty["map"].plan == PLAN  # type: ignore[union-attr]


def test_a_loaded_map_does_not_share_memory(route: CompressedMap) -> None:
    state = route.state_dict()
    other = CompressedMap()
    other.load_state_dict(state)
    state["templates"].zero_()
    assert other.templates.count_nonzero() > 0


def test_missing_buffers_are_named(route: CompressedMap) -> None:
    state = route.state_dict()
    del state["templates"]
    with pytest.raises((RuntimeError, InputError), match="template"):
        CompressedMap().load_state_dict(state)


def test_to_float64_converts_templates_only(route: CompressedMap) -> None:
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
        route = CompressedMap(plan, [torch.ones(7, 1, dtype=dtype)], PLACES, DIMENSION)
        other = CompressedMap()
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
    route = CompressedMap()
    assert (route.plan, route.places, route.dimension, route.blocks(), route.layer_features()) == (
        (),
        0,
        0,
        [],
        [],
    )
    nowhere = CompressedMap((), (), 50, 3)
    assert (nowhere.places, nowhere.dimension, nowhere.plan) == (50, 3, ())


def test_convention_1_places_count_from_0_and_chunks_are_half_open() -> None:
    last = FrequencyLayer(Fraction(2), 2, 3, 5, (0,))
    assert CompressedMap((last,), [torch.zeros(2, 1)], 5, 1).places == 5
    with pytest.raises(InputError, match=r"covers \[3, 5\).*inside 4 places"):
        CompressedMap((last,), [torch.zeros(2, 1)], 4, 1)


@pytest.mark.parametrize("shape", [(98, 1), (2, 98), (196,)])
def test_templates_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"98 phases and 2 features got templates .*; expected \(98, 2\)"):
        CompressedMap(PLAN[:1], [torch.zeros(shape)], PLACES, DIMENSION)


def changed(tensor: Tensor, row: int, column: int, value: int) -> Tensor:
    tensor = tensor.clone()
    tensor[row, column] = value
    return tensor


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("size", lambda t: t[:1], r"size \(1,\)"),
        ("size", lambda t: t - torch.tensor([100, 0]), r"expected it inside 200 places"),
        (
            "size",
            lambda t: t - torch.tensor([0, 1]),
            r"feature 3; expected it inside 300 places of 3 features",
        ),
        ("layers", lambda t: t.flatten(), r"layers .*\(15,\)"),
        ("layers", lambda t: t[:, :4], r"layers .*\(3, 4\)"),
        ("layers", lambda t: t[:2], r"feature_ptr does not rise from 0 over 2 layers"),
        ("way", lambda t: torch.arange(299.0), r"a way of 299 steps; expected 300"),
        ("way", lambda t: torch.full((300,), torch.nan), r"way \(300,\) torch.float32; expected finite"),
        ("way", lambda t: torch.arange(300), r"way \(300,\) torch.int64; expected finite"),
        ("layers", lambda t: changed(t, 0, 0, -195), r"period -195/2"),
        ("layers", lambda t: changed(t, 0, 1, 0), r"denominator"),
        ("layers", lambda t: changed(t, 0, 2, 0), r"0 phases"),
        ("layers", lambda t: changed(t, 0, 2, 97), r"272.*expected \D*270"),
        ("layers", lambda t: changed(t, 0, 4, 301), r"covers \[0, 301\)"),
        ("layers", lambda t: changed(t, 0, 4, 0), r"covers \[0, 0\)"),
        ("feature_ptr", lambda t: t[:-1], r"feature_ptr does not rise"),
        ("feature_ptr", lambda t: t[[0, 2, 1, 3]], r"feature_ptr does not rise"),
        ("feature_ptr", lambda t: t + 1, r"feature_ptr does not rise"),
        ("feature_index", lambda t: t[:-1], r"5 feature indices; expected 6"),
        ("feature_index", lambda t: t.flip(0), r"feature indices must be"),
        ("feature_index", lambda t: t + 1, r"feature 4; expected it inside"),
        ("templates", lambda t: t[:-1], r"271.*expected \D*272"),
        ("templates", lambda t: t[None], r"templates .*\(1, 272\)"),
    ],
)
def test_buffers_that_do_not_fit_together_are_refused(
    route: CompressedMap, name: str, change: object, message: str
) -> None:
    state = route.state_dict()
    state[name] = change(state[name])  # type: ignore[operator]
    with pytest.raises(InputError, match=message) as error:
        CompressedMap().load_state_dict(state)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["size", "layers", "feature_ptr", "feature_index"])
def test_indices_that_are_no_whole_numbers_are_refused(route: CompressedMap, name: str) -> None:
    state = route.state_dict()
    state[name] = state[name].float()
    with pytest.raises(InputError):
        CompressedMap().load_state_dict(state)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_templates_that_are_not_finite_are_refused(route: CompressedMap, bad: float) -> None:
    state = route.state_dict()
    state["templates"][5] = bad
    with pytest.raises(InputError, match="not finite"):
        CompressedMap().load_state_dict(state)
