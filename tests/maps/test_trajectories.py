"""Sequences on a template map: sums in its layers are the sums of its scores."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from unittest.mock import patch

import pytest
import torch
from helpers import Fixed, template_model
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch import FrequencyLayer, SequenceMatcher, TemplateMap
from dejavu_torch.maps.trajectories import LayerSums
from dejavu_torch.types import Plan

SPEEDS = st.lists(st.sampled_from([1.0, 0.0, 0.5, 2.0, -1.0, 1.3, -0.6]), min_size=1, max_size=3)
TORN: Plan = (  # two chunks with a gap behind each, and layers whose phases are no function of phases
    FrequencyLayer(Fraction(7), 7, 0, 230, (0, 2)),
    FrequencyLayer(Fraction(25, 2), 13, 90, 230, (1,)),
    FrequencyLayer(Fraction(11), 4, 245, 790, (0, 1, 2)),
    FrequencyLayer(Fraction(5, 3), 5, 245, 790, (2,)),
)


@st.composite
def plans(draw: Callable) -> tuple[Plan, int]:
    """Chunks with gaps between them, each with some layers, of which one may end anywhere."""
    plan, place = [], 0
    for _ in range(draw(st.integers(1, 3))):
        start = place + draw(st.sampled_from([0, 0, 1, 3, 20]))
        place = start + draw(st.one_of(st.integers(1, 20), st.integers(200, 400)))
        ends = [place, draw(st.integers(start + 1, place))]
        for _ in range(draw(st.integers(1, 2))):
            period = Fraction(draw(st.integers(1, 12)), draw(st.integers(1, 3)))
            phases = draw(st.sampled_from([period.numerator, math.ceil(period), 1, 3]))
            features = draw(st.sets(st.integers(0, 2), min_size=1))
            plan.append(
                FrequencyLayer(period, phases, start, draw(st.sampled_from(ends)), (*sorted(features),))
            )
    return tuple(plan), place + draw(st.sampled_from([0, 0, 2, 30]))


def make(plan: Plan, places: int, reduction: str = "mean", **settings: object) -> TemplateMap:
    blocks = [torch.rand(layer.phases, len(layer.features), dtype=torch.float64) for layer in plan]
    return TemplateMap(plan, blocks, places, 3, reduction=reduction, **settings)  # type: ignore[arg-type]


def same(found: Tensor, expected: Tensor) -> bool:
    finite = expected.isfinite()
    return torch.equal(found[~finite], expected[~finite]) and torch.allclose(found[finite], expected[finite])


def direct(route: TemplateMap, queries: Tensor, matcher: SequenceMatcher) -> Tensor:
    scores = matcher(route.scores(queries))
    assert isinstance(scores, Tensor)
    return scores


@given(
    plans(),
    st.integers(1, 9),
    SPEEDS,
    st.integers(1, 20),
    st.integers(1, 20),
    st.sampled_from(["mean", "sum"]),
)
def test_equals_the_sums_of_scores(
    drawn: tuple[Plan, int], length: int, speeds: list[float], count: int, size: int, reduction: str
) -> None:
    route, matcher = make(*drawn, reduction), SequenceMatcher(length, speeds)
    queries = torch.rand(count, 3, dtype=torch.float64)
    found = torch.cat(list(route.sequences(queries.split(size), matcher)))
    assert same(found, direct(route, queries, matcher))


@pytest.mark.parametrize("speeds", [[1.0], [0.0], [-1.0], [0.5, 1.3, 2.0], [0.6, -0.6]])
def test_places_between_cuts_take_the_layers(speeds: list[float]) -> None:
    """Only the scores of the others are looked at: of less than a quarter of the map."""
    route, matcher, queries = make(TORN, 800), SequenceMatcher(6, speeds), torch.rand(30, 3).double()
    expected = direct(route, queries, matcher)
    with patch.object(SequenceMatcher, "forward", autospec=True, side_effect=SequenceMatcher.forward) as seen:
        found = torch.cat(list(route.sequences(queries.split(7), matcher)))
    assert same(found, expected)
    assert len(seen.call_args_list) == 5
    assert all(call.args[1].shape[1] < 200 for call in seen.call_args_list)


@pytest.mark.parametrize(
    ("plan", "settings"),
    [
        (TORN, {"temperature": 0.1}),
        ((FrequencyLayer(Fraction(401, 2), 5, 0, 800, (0,)),), {}),  # a table of 401
        (tuple(FrequencyLayer(Fraction(1), 1, i, i + 20, (0,)) for i in range(0, 800, 20)), {}),
        ((), {}),
    ],
    ids=["a temperature", "a long table", "many cuts", "no layers"],
)
def test_what_is_no_shorter_takes_the_scores(plan: Plan, settings: dict[str, float]) -> None:
    route, queries = make(plan, 800, **settings), torch.rand(9, 3).double()
    with patch.object(LayerSums, "scores") as seen:
        found = torch.cat(list(route.sequences([queries], SequenceMatcher(4))))
    assert not seen.called
    assert same(found, direct(route, queries, SequenceMatcher(4)))


def test_a_distance_that_is_infinite_is_left_out() -> None:
    route, matcher, queries = make(TORN, 800), SequenceMatcher(5), torch.rand(20, 3).double()
    queries[8, 1] = 1e308  # its differences add up to more than there is
    queries[8, 0] = -1e308
    route.templates.mul_(0)
    queries[8] *= 1.7
    expected = direct(route, queries, matcher)
    assert route.scores(queries)[8].isinf().any()
    assert expected[9:12].isfinite().any()
    assert same(torch.cat(list(route.sequences(queries.split(6), matcher))), expected)


def test_gradients_are_those_of_the_scores() -> None:
    route, matcher = make(TORN, 800), SequenceMatcher(5, [1.0, 0.5])
    route.trainable(templates=True)
    queries = torch.rand(7, 3, dtype=torch.float64, requires_grad=True)
    gradients = []
    for scores in (
        torch.cat(list(route.sequences(queries.split(3), matcher))),
        direct(route, queries, matcher),
    ):
        weights = torch.linspace(-1, 1, scores.numel(), dtype=torch.float64).view_as(scores)
        total = (scores.masked_fill(scores.isinf(), 0) * weights).sum()
        gradients.append(torch.autograd.grad(total, (queries, route.templates)))
    for found, expected in zip(*gradients, strict=True):
        assert expected.count_nonzero() > 0
        assert torch.allclose(found, expected)


def test_localize_takes_the_layers_and_batches_do_not_matter() -> None:
    values = torch.rand(400, 4)
    layers = (FrequencyLayer(Fraction(tau), tau, 0, 400, (j,)) for j, tau in enumerate((13, 29, 31)))
    model, matcher = template_model(periods=Fixed(*layers)).learn(values), SequenceMatcher(9)
    queries = values[50:150] + 0.1 * torch.rand(100, 4)
    expected = matcher(model.map.scores(queries)).min(1)
    with patch.object(LayerSums, "scores", autospec=True, side_effect=LayerSums.scores) as seen:
        whole = model.localize(queries, sequence=matcher)
        model.batch_size = 7
        parts = model.localize(queries, sequence=matcher)
    assert seen.call_count == 2 + 15
    assert torch.equal(whole.index, expected.indices)
    assert torch.equal(whole.index, parts.index)
    torch.testing.assert_close(whole.score, expected.values)
    assert torch.equal(whole.score, parts.score)


def test_no_more_rows_than_a_sequence_are_kept(largest_tensor: type) -> None:
    route, matcher = make(TORN, 800), SequenceMatcher(6)
    with torch.no_grad(), largest_tensor() as seen:
        for _ in route.sequences((torch.rand(2, 3).double() for _ in range(50)), matcher):
            pass
    assert seen.numel <= 2 * 800
