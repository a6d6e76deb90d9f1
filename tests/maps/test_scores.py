"""Scores of all places (eq. 4): against literal loops, in closed form, and within their memory."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import pairwise

import pytest
import reference
import torch
from helpers import Fixed, refused, scored, template_model
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch import FrequencyLayer, PhaseTemplates, TemplateMap, best_match
from dejavu_torch.features.extract import READY
from dejavu_torch.maps.template_map import log_posterior, segments
from dejavu_torch.periods.support import common_period

METRICS = ["l1", "l2", "cosine"]


def whole(period, stop, features=(0,), start=0):
    """The paper's case: as many phases as frames in a period."""
    return FrequencyLayer(Fraction(period), period, start, stop, features)


def make(values, plan):
    return TemplateMap(plan, PhaseTemplates()(values, plan), *values.shape)


MIXED = (
    whole(4, 20, (0, 2)),
    FrequencyLayer(Fraction(5, 2), 3, 5, 25, (0, 1)),
    whole(7, 50, (1, 2, 3), start=30),
)


# ------------------------------------------------------------------ the letter


@pytest.mark.parametrize("reduction", ["sum", "mean"])
@given(route=reference.routes(), seed=st.integers(0, 2**16))
def test_scores_equal_reference(reduction, route, seed):
    values, plan = route
    generator = torch.Generator().manual_seed(seed)
    queries = torch.randn(3, values.shape[1], generator=generator, dtype=torch.float64)
    queries[0] = values[seed % len(values)]
    mus = [reference.templates(values.tolist(), layer) for layer in plan]
    expected = [reference.scores(row, len(values), plan, mus, reduction) for row in queries.tolist()]
    scores = scored(queries, make(values, plan), reduction=reduction)  # type: ignore[arg-type]
    torch.testing.assert_close(scores, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-12)


@given(route=reference.routes())
def test_the_place_found_is_the_references(route):
    """Whole-number templates, so that ties are ties in both."""
    values, plan = route
    mus = [torch.randint(-3, 4, (x.phases, len(x.features))).double() for x in plan]
    found = TemplateMap(plan, mus, *values.shape)
    queries = torch.randint(-3, 4, (5, values.shape[1])).double()
    scores = scored(queries, found, reduction="sum")
    match = best_match(scores, threshold=4.0)
    lists = [mu.tolist() for mu in mus]
    rows = [reference.scores(row, len(values), plan, lists) for row in queries.tolist()]
    assert scores.tolist() == rows
    assert match.index.tolist() == [reference.best(row) for row in rows]
    assert match.accepted.tolist() == [reference.accepted(row, 4.0) for row in rows]


# ----------------------------------------------------------------- closed form


@pytest.mark.parametrize("reduction", ["sum", "mean"])
@pytest.mark.parametrize("periods", [(4, 6), (3, 5), (5,), (4, 6, 9), (Fraction(7, 2), 6)])
def test_score_is_0_exactly_at_the_common_period(periods, reduction):
    """A perfectly periodic traverse of dyadic values: S(i) = 0 exactly at i = q mod lcm."""
    common = int(common_period(periods))
    frames = 3 * common
    plan, columns = [], []
    for j, period in enumerate(map(Fraction, periods)):
        phases = int(period * period.denominator)  # a phase holds one frame of each common turn
        plan.append(FrequencyLayer(period, phases, 0, frames, (2 * j, 2 * j + 1)))
        cycle = torch.stack([torch.arange(phases) / 8, torch.randperm(phases) / 4], 1).double()
        columns.append(cycle[plan[-1].place_phases])
    values = torch.cat(columns, 1)
    scores = scored(values, make(values, tuple(plan)), reduction=reduction)  # type: ignore[arg-type]
    i, q = torch.arange(frames), torch.arange(frames)[:, None]
    assert torch.equal(scores == 0, (i - q) % common == 0)
    irrational = values * math.pi
    scores = scored(irrational, make(irrational, tuple(plan)), reduction=reduction)  # type: ignore[arg-type]
    assert torch.equal(scores <= 1e-12, (i - q) % common == 0)


# ---------------------------------------------------------- coverage, reduction


def test_convention_1_h_is_the_querys_and_l_the_covering_layers():
    values = torch.tensor([[0.0], [1.0], [2.0], [3.0]])
    plan = (whole(1, 2), whole(1, 4, start=1))  # templates 0.5 and 2
    scores = scored(torch.tensor([[10.0]]), make(values, plan), reduction="sum")
    assert scores.tolist() == [[9.5, 9.5 + 8, 8, 8]]


def test_convention_2_uncovered_places_score_inf():
    for metric in METRICS:
        for reduction in ("sum", "mean"):
            values = torch.rand(60, 4)
            scores = scored(values[:5], make(values, MIXED), metric, reduction)  # type: ignore[arg-type]
            uncovered = torch.zeros(60, dtype=torch.bool)
            uncovered[25:30] = uncovered[50:] = True
            assert torch.equal(scores.isposinf(), uncovered.expand(5, 60))
            assert scores[:, ~uncovered].isfinite().all()


def test_convention_2_a_plan_without_layers_covers_nothing():
    scores = scored(torch.rand(3, 4), TemplateMap((), (), 20, 4))
    assert scores.shape == (3, 20)
    assert scores.isposinf().all()
    assert best_match(scores).index.tolist() == [-1, -1, -1]


def test_convention_3_sum_is_the_letter_and_the_default_is_comparable():
    """Two chunks with 80 and 8 features: the printed sum sends no query of the first to the first."""
    values = torch.zeros(40, 88)
    values[:20, :80] = torch.rand(20, 80).round()
    values[20:, 80:] = 1 + torch.rand(20, 8).round()
    plan = (whole(20, 20, tuple(range(80))), whole(20, 40, tuple(range(80, 88)), start=20))
    route = make(values, plan)
    queries = values + 0.3 * (torch.rand_like(values).round() - 0.5).sign()
    own_chunk = torch.arange(40) < 20
    by_sum = best_match(scored(queries, route, reduction="sum")).index
    by_mean = best_match(scored(queries, route)).index
    assert ((by_sum < 20) & own_chunk).sum() == 0
    assert ((by_mean < 20) == own_chunk).all()
    assert by_mean[:20].tolist() == list(range(20))


def test_convention_3_mean_is_the_sum_over_its_number_of_features():
    values = torch.rand(50, 4)
    route = make(values, MIXED)
    ratio = scored(values, route, reduction="sum") / scored(values, route)
    torch.testing.assert_close(ratio[:, :5], torch.full((50, 5), 2.0))
    torch.testing.assert_close(ratio[:, 5:20], torch.full((50, 15), 4.0))
    torch.testing.assert_close(ratio[:, 30:], torch.full((50, 20), 3.0))


def test_mean_does_not_grow_with_the_number_of_features():
    """A feature written down nine times is still one feature's worth of distance."""
    for metric in METRICS:
        values = torch.rand(20, 3)
        once = make(values, (whole(5, 20, (0, 1, 2)),))
        often = make(values.repeat(1, 9), (whole(5, 20, tuple(range(27))),))
        torch.testing.assert_close(scored(values.repeat(1, 9), often, metric), scored(values, once, metric))


@given(route=reference.routes())
def test_segments_cut_the_route_where_coverage_changes(route):
    values, plan = route
    parts = list(segments(plan, len(values)))
    assert parts[0][0] == 0
    assert parts[-1][1] == len(values)
    assert all(a[1] == b[0] for a, b in pairwise(parts))
    for start, stop, members in parts:
        for i in range(start, stop):
            assert members == tuple(j for j, layer in enumerate(plan) if layer.start <= i < layer.stop)


# ------------------------------------------------- gradients, batches, precision


@pytest.mark.parametrize(
    ("metric", "reduction", "temperature"),
    [("l1", "mean", None), ("l2", "sum", None), ("cosine", "mean", None), ("l1", "mean", 0.5)],
)
def test_gradients_are_right_towards_queries_and_reference(metric, reduction, temperature):
    plan = (whole(3, 8, (0, 2)), FrequencyLayer(Fraction(5, 2), 2, 4, 10, (0, 1)))
    queries = torch.randn(2, 3, dtype=torch.float64, requires_grad=True)
    values = torch.randn(10, 3, dtype=torch.float64, requires_grad=True)

    def covered(queries, values):
        return scored(queries, make(values, plan), metric, reduction, temperature)

    assert torch.autograd.gradcheck(covered, (queries, values))


def test_convention_10_scores_are_float32_whatever_the_autocast():
    values = torch.rand(50, 4)
    route = make(values, MIXED)
    plain = scored(values, route)
    with torch.autocast("cpu", torch.bfloat16):
        cast = scored(values, route)
        low = scored(values.bfloat16(), route)
    half = scored(values, route.half())
    assert cast.dtype == low.dtype == half.dtype == torch.float32
    assert torch.equal(cast, plain)
    torch.testing.assert_close(half, plain, rtol=0, atol=1e-3)


def test_convention_10_also_on_a_map_without_layers():
    scores = scored(torch.rand(3, 4).bfloat16(), TemplateMap((), (), 20, 4))
    assert scores.dtype == torch.float32


@pytest.mark.parametrize("metric", METRICS)
def test_convention_10_nothing_of_queries_times_phases_times_features_is_built(metric, largest_tensor):
    queries, phases, features, places = 40, 50, 60, 300
    route = make(torch.rand(places, features), (whole(phases, places, tuple(range(features))),))
    with largest_tensor() as seen:
        scored(torch.rand(queries, features), route, metric)
    assert seen.numel <= queries * places < queries * phases * features


def test_convention_10_memory_does_not_grow_with_the_queries(largest_tensor):
    values = torch.rand(500, 8)
    layer = whole(50, 500, tuple(range(8)))
    model = template_model(periods=Fixed(layer)).learn(values)

    def largest(queries):
        with largest_tensor() as seen:
            assert model.localize(torch.rand(queries, 8)).index.shape == (queries,)
        return seen.numel

    # the queries themselves and their matches, Q x 8 and Q, are smaller than one batch of scores
    assert largest(5 * READY) == largest(READY) == READY * 500


@pytest.mark.parametrize(
    ("make_scores", "words"),
    [
        (lambda route: route.scores(torch.rand(3, 5)), ["queries (3, 5)", "expected (Q, 4)"]),
        (lambda route: route.scores(torch.rand(4)), ["queries (4,)", "expected (Q, 4)"]),
        (
            lambda _: TemplateMap(metric="manhattan"),
            ["metric is 'manhattan'; expected Literal['l1', 'l2', 'cosine']"],
        ),
        (lambda _: TemplateMap(reduction="max"), ["reduction is 'max'", "'mean', 'sum'"]),
        (lambda _: TemplateMap(temperature=0.0), ["temperature is 0.0; expected a number above 0"]),
        (lambda _: TemplateMap(temperature=math.nan), ["temperature is nan; expected a number above 0"]),
    ],
)
def test_what_makes_no_scores_is_refused(make_scores, words):
    with refused(*words):
        make_scores(make(torch.rand(50, 4), MIXED))


# ------------------------------------------------------------------ temperature


def literal_posterior(row, temperature):
    likely = [math.exp(-score / temperature) for score in row]
    return [-math.log(one / sum(likely)) if one else math.inf for one in likely]


@given(
    rows=st.lists(
        st.lists(st.floats(0, 20) | st.just(math.inf), min_size=4, max_size=4), min_size=1, max_size=3
    ),
    temperature=st.floats(0.1, 5),
)
def test_log_posterior_equals_the_loops(rows, temperature):
    found = log_posterior(torch.tensor(rows, dtype=torch.float64), temperature)
    none = [math.inf] * 4
    expected = [none if row == none else literal_posterior(row, temperature) for row in rows]
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64), rtol=1e-9, atol=1e-12)


def test_log_posterior_in_closed_form():
    """Two places D apart: log(1 + exp(-D / T)) and that of -D; n equal ones: log n."""
    low, high = log_posterior(torch.tensor([[1.0, 1.5]], dtype=torch.float64), 0.25)[0].tolist()
    assert (low, high) == (pytest.approx(math.log1p(math.exp(-2))), pytest.approx(math.log1p(math.exp(2))))
    far = log_posterior(torch.tensor([[3000.0, 3001.0, math.inf]]), 1e-3)
    assert far.tolist() == [[0.0, pytest.approx(1000.0), math.inf]]


def test_a_temperature_leaves_the_order_of_places():
    values, queries = torch.rand(60, 4, dtype=torch.float64), torch.rand(7, 4, dtype=torch.float64)
    plain, scores = (scored(queries, make(values, MIXED), temperature=t) for t in (None, 0.2))
    torch.testing.assert_close(scores, log_posterior(plain, 0.2))
    assert torch.equal(scores.argsort(dim=1, stable=True), plain.argsort(dim=1, stable=True))
    torch.testing.assert_close((-scores).exp().sum(1), torch.ones(7, dtype=torch.float64))


def test_convention_2_a_temperature_leaves_uncovered_places_at_inf():
    values = torch.rand(60, 4)
    plain, scores = (scored(values[:5], make(values, MIXED), temperature=t) for t in (None, 0.1))
    assert plain.isposinf().any()
    assert torch.equal(scores.isposinf(), plain.isposinf())
    nowhere = scored(torch.rand(3, 4), TemplateMap((), (), 20, 4), temperature=0.1)
    assert nowhere.isposinf().all()
    assert best_match(log_posterior(torch.full((2, 3), math.inf), 0.1)).index.tolist() == [-1, -1]


def test_gradients_of_log_posterior_are_right_towards_scores_and_temperature():
    scores = torch.rand(3, 5, dtype=torch.float64, requires_grad=True)
    temperature = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    closed = torch.tensor([[0, 1, 0, 0, 1], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1]], dtype=torch.bool)

    def reachable(scores, temperature):
        return log_posterior(scores.masked_fill(closed, math.inf), temperature)[~closed]

    assert torch.autograd.gradcheck(reachable, (scores, temperature))


def test_places_at_inf_leave_gradients_finite():
    inf = math.inf
    scores = torch.tensor([[1.0, inf, 2.0], [inf, inf, inf], [0.0, 0.0, 0.0]], requires_grad=True)
    temperature = torch.tensor(0.1, requires_grad=True)
    (-log_posterior(scores, temperature)).exp().square().sum().backward()
    assert scores.grad is not None
    assert temperature.grad is not None
    assert temperature.grad.isfinite()
    assert scores.grad[0, 0].isfinite()
    assert scores.grad[0, 0] != 0
    assert scores.grad[0, 1] == 0
    assert scores.grad[1].tolist() == [0, 0, 0]
