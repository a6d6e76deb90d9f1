"""Probabilities of places driven along with the queries, and of being off the map."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from reference import Chained, Steps

from dejavu_torch import DejaVu, PlaceFilter, SequenceMatcher
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.calibration import Platt, Track
from dejavu_torch.recognition.engine import sweep
from dejavu_torch.recognition.filter import moments_of, near_scores
from dejavu_torch.recognition.localizer import Localizer, Matching
from dejavu_torch.recognition.online import Learned, Nearness
from dejavu_torch.types import Match, SequenceModel


@torch.no_grad()
def literal(filter_, scores):
    """Each transition from one state to another; the last state is off the map."""
    places, keeps = len(scores[0]), filter_.steady
    moves = filter_.move_logits.softmax(0).tolist()
    _, jump, leave = filter_.rate_logits.softmax(0).tolist()
    enter, sharpness = float(filter_.enter_logit.sigmoid()), float(filter_.log_sharpness.exp())
    ways = {"turn": filter_.turn, "directions": 2 if filter_.back else 1, "back": filter_.back}
    steps = Steps(places, moves, jump, leave, enter, **ways)
    if keeps.speeds:
        speeds = [(speed.numerator, speed.denominator) for speed in keeps.speeds]
        steps = Chained(steps, speeds, keeps.shares.tolist(), chosen.SLIP, keeps.first.tolist())
    matrix, belief, found = steps.transitions(), steps.start(), []
    states = range(len(belief))
    for t, row in enumerate(scores):
        if t:
            belief = [sum(belief[i] * matrix[i][j] for i in states) for j in states]
        known = [score for score in row if math.isfinite(score)]
        mean = sum(known) / len(known) if known else 0.0
        spread = math.sqrt(sum((score - mean) ** 2 for score in known) / len(known)) if known else 0.0
        if spread > 0:
            off = float(filter_.off_map)  # at a place that nothing covers, too
            z = [(mean - score) / spread if math.isfinite(score) else off for score in row]
            wide = [*z, *z[::-1]] if filter_.back else z
            z = [*wide * (len(states) // len(wide)), off]
            joint = [b * math.exp(sharpness * one) for b, one in zip(belief, z, strict=True)]
            if sum(joint) > 0:
                belief = [one / sum(joint) for one in joint]
        found.append([0.0] * places + [belief[-1]])
        for state in states[:-1]:
            found[-1][place_of(state, filter_, places)] += belief[state]
    return found


def place_of(state, filter_, places):
    """The place of a state on the map."""
    there = state % (2 * places if filter_.back else places)
    return there if there < places else 2 * places - 1 - there


SCORE = st.one_of(st.integers(0, 9).map(float), st.just(math.inf))
TABLE = st.integers(3, 7).flatmap(
    lambda n: st.lists(st.lists(SCORE, min_size=n, max_size=n), min_size=1, max_size=9)
)
FILTER = st.builds(
    PlaceFilter,
    st.sampled_from([(1.0,), (0.1, 0.8, 0.1), (0.0, 1.0), (0.5, 0.25, 0.25)]),
    jump=st.sampled_from([0.0, 0.01, 0.3]),
    leave=st.sampled_from([0.0, 0.02, 0.5]),
    enter=st.sampled_from([0.0, 0.1, 1.0]),
    sharpness=st.sampled_from([0.3, 1.0, 2.0]),
    off_map=st.sampled_from([-1.0, 0.0, 1.5]),
    turn=st.sampled_from([0.0, 0.1]),
    back=st.sampled_from([0.0, 0.2, 0.5]),
    speeds=st.sampled_from([(), (1,), (0.5, 2)]),
)


@given(TABLE, FILTER)
def test_equals_a_literal_loop(rows, filter_):
    filter_ = filter_.double()
    found = filter_.posterior(torch.tensor(rows, dtype=torch.float64))
    assert torch.allclose(found, torch.tensor(literal(filter_, rows), dtype=torch.float64), atol=1e-9)
    assert torch.allclose(found.sum(1), torch.ones(len(rows), dtype=torch.float64))


@given(TABLE, FILTER, st.integers(1, 4), st.integers(0, 3), st.booleans())
def test_batches_do_not_matter(rows, filter_, size, lag, learns):
    scores, filter_.lag, filter_.learns = torch.tensor(rows), lag, learns
    state, found = filter_.start(scores.shape[1]), []
    for part in scores.split(size):
        answers, state = filter_.step(part, state)
        found += [*answers]
    assert len(found) == max(0, len(scores) - lag)
    last, state = filter_.finish(state)
    assert torch.allclose(torch.stack([*found, *last]), filter_(scores), rtol=1e-4)
    assert len(filter_.finish(state)[0]) == 0


def forward_backward(filter_, scores, empty=()):
    """Posteriors given all queries, those of `empty` saying nothing."""
    filled = scores.clone()
    filled[[*empty]] = 0.0
    seen = filter_.likelihoods(filled, moments_of(filled))
    motion, still = filter_.motion(filled), torch.zeros(len(scores), dtype=torch.bool)
    likelihood = motion.wide(seen[:, :-1], seen[:, -1:])
    (block,) = sweep(motion, lambda *_: likelihood, len(scores), still, len(scores))
    return motion.folded(block.posterior)


@torch.no_grad()
@pytest.mark.parametrize("lag", [39, 100])
def test_with_a_lag_of_all_queries_it_is_a_smoother(lag):
    scores = standing_out(30, [*range(2, 22)] * 2).double()
    filter_ = PlaceFilter(lag=lag).double()
    torch.testing.assert_close(filter_.posterior(scores), forward_backward(filter_, scores))
    left_out = 7, 8, 30  # no answers, but moves
    state, found = filter_.start(30), []
    for t, row in enumerate(scores.split(1)):
        if t in left_out:
            state = filter_.skipped(state, 1)
        else:
            answers, state = filter_.step(row, state)
            found += [*answers]
    expected = forward_backward(filter_, scores, left_out)[[t for t in range(40) if t not in left_out], :-1]
    torch.testing.assert_close(
        torch.stack([*found, *filter_.finish(state)[0]]), near_scores(expected, scores[3:], 5)
    )


def test_a_lagged_answer_has_the_probability_and_score_of_its_own_query():
    scores, filter_ = standing_out(30, [*range(2, 22)]), PlaceFilter(lag=4)
    localizer = Localizer(Watched(30), Matching(filter_, k=2, platt=Platt(1.0, 0.0)))
    found = Match.joined([*map(localizer, scores.split(3)), localizer.finish()])
    expected = filter_(scores).detach()
    assert torch.equal(found.index[:, 0], expected.argmin(1))
    probability = Platt(1.0, 0.0).probability(Track()(expected, scores))
    torch.testing.assert_close(found.probability[:, 0], probability, rtol=1e-4, atol=1e-6)


@torch.no_grad()
def test_an_answer_knows_of_the_lag_and_no_more():
    scores = standing_out(30, [*range(2, 22)]).double()
    lagged = PlaceFilter(lag=4).double()
    for t in (0, 7, 15, 19):
        known = scores[: t + 5]
        torch.testing.assert_close(lagged.posterior(scores)[t], forward_backward(lagged, known)[t])


@torch.no_grad()
def test_what_is_learned_are_the_moves_and_how_far_right_places_stand_out():
    shown = [t // 3 for t in range(150)]
    scores = standing_out(60, shown)
    learning, fixed = PlaceFilter(learns=True), PlaceFilter()
    torch.testing.assert_close(learning.posterior(scores)[0], fixed.posterior(scores)[0])

    def learned(scores):
        state = learning.step(scores, learning.start(60))[1]
        sums = state.learned
        assert sums is not None
        return (
            sums.moves_after(torch.tensor([0.2, 0.6, 0.2])).tolist(),
            *map(float, sums.likelihood(torch.tensor(1.0), torch.tensor(1.25))),
        )

    moves, sharpness, _ = learned(scores)
    assert moves[0] > 0.4
    alike = torch.cat([row.expand(10, -1) for row in standing_out(60, [*range(30)]).split(1)])
    assert learned(alike)[1] < 0.8 * sharpness  # ten queries in a row say what one does
    flat = torch.zeros(100, 60)
    assert learned(flat)[1:] == (1.0, 1.25)


@pytest.mark.parametrize("alike", [1, 25])
def test_sharpness_is_the_mean_at_right_places_by_the_correlation_time(alike):
    """Queries of which so many in a row are the same, each surely at its best place."""
    rows = torch.randn(5000 // alike, 400, generator=torch.Generator().manual_seed(0))
    rows = ((rows - rows.mean(1, keepdim=True)) / rows.std(1, keepdim=True, correction=0)).repeat_interleave(
        alike, 0
    )
    sums = Learned(torch.zeros(400), torch.zeros(400), torch.zeros(4), torch.zeros(3))
    for row in rows:
        place = (row == row.max()).float()
        sums = sums.after(row, torch.tensor(True), place, torch.tensor([0.0, 1, 0]))
    mu = (100 * 2.5 + float(rows.amax(1).sum())) / 5100  # with the prior of 100 queries
    tau = (100 * 2.5 + 5000 * alike) / 5100
    sharpness, off_map = sums.likelihood(torch.tensor(1.0), torch.tensor(1.25))
    assert float(off_map) == pytest.approx(mu / 2, rel=1e-3)
    assert float(sharpness) == pytest.approx(math.sqrt(mu / tau), rel=0.05)
    assert sums.moves_after(torch.tensor([0.2, 0.6, 0.2])).tolist() == pytest.approx(
        [10 / 5050, 5030 / 5050, 10 / 5050]
    )


def test_gradients_reach_the_scores_and_every_parameter():
    scores = torch.rand(4, 6, dtype=torch.float64, requires_grad=True)
    filter_ = PlaceFilter().double()
    assert torch.autograd.gradcheck(filter_, (scores,))
    names, values = zip(*filter_.named_parameters(), strict=True)

    def run(*values):
        given_ = dict(zip(names, values, strict=True))
        return torch.func.functional_call(filter_, given_, (scores.detach(),))

    assert torch.autograd.gradcheck(run, values)
    gradients = torch.autograd.grad(run(*values).sum(), values)
    assert all(bool((gradient != 0).all()) for gradient in gradients)


def test_the_score_is_the_probability_of_a_place_and_its_neighbours():
    scores = torch.rand(3, 9, dtype=torch.float64)
    posterior = PlaceFilter().posterior(scores)[:, :-1]
    assert torch.allclose((-PlaceFilter(within=0)(scores)).exp(), posterior)
    near = (-PlaceFilter(within=2)(scores)).exp()
    assert torch.allclose(near[:, 4], (posterior[:, 2:7] * torch.tensor([1, 2, 3, 2, 1]) / 3).sum(1))
    assert torch.allclose(near[:, 0], (posterior[:, :3] * torch.tensor([3, 2, 1]) / 3).sum(1))


def standing_out(places, shown, seed=0):
    """Scores of queries that show a place each, or -1 where they show none."""
    scores = torch.randn(len(shown), places, generator=torch.Generator().manual_seed(seed))
    for t, place in enumerate(shown):
        if place >= 0:
            scores[t, place] -= 2.5
    return scores


def test_a_route_at_any_speed_is_found():
    """Standing, then twice as fast as the reference: no sum at one speed finds it."""
    shown = [20] * 30 + list(range(20, 140, 2))
    scores, truth = standing_out(200, shown), torch.tensor(shown)
    near = {
        name: float(((model(scores).argmin(1) - truth).abs() <= 2).float().mean())
        for name, model in {"sum": SequenceMatcher(21), "filter": PlaceFilter()}.items()
    }
    assert near["filter"] > 0.8
    assert near["sum"] < 0.5


def test_off_the_map_is_noticed_and_left():
    shown = [*range(50, 100), *[-1] * 60, *range(10, 60)]
    off = PlaceFilter().posterior(standing_out(200, shown))[:, -1]
    assert off[30:50].max() < 0.5
    assert off[80:110].min() > 0.5
    assert off[140:].max() < 0.5


def test_the_model_localizes_with_it_and_accepts_what_is_likely():
    route = torch.randn(80, 32, generator=torch.Generator().manual_seed(3))
    model = DejaVu(whitening="none", threshold=1e-9).learn(route)
    found = model.localize(route[10:50], sequence=PlaceFilter())
    assert torch.equal(found.index, torch.arange(10, 50))
    assert torch.equal(found.accepted, found.score < math.log(2))
    assert found.accepted[1:].all()
    assert model.localize(route[10:50], sequence=PlaceFilter(threshold=math.inf)).accepted.all()
    assert not found.score.requires_grad
    model.batch_size = 7
    again = model.localize(route[10:50], sequence=PlaceFilter())
    assert torch.allclose(again.score, found.score, rtol=1e-3)


def test_gradients_are_finite_where_something_is_impossible():
    for impossible in ("jump", "leave", "enter"):
        filter_ = PlaceFilter(**{impossible: 0.0}, sharpness=2.2)  # type: ignore[arg-type]
        scores = standing_out(400, [0, 150, 300, -1, 20]).requires_grad_()
        filter_(scores).sum().backward()
        gradients = [scores.grad, *(one.grad for one in filter_.parameters())]
        assert all(one is not None and bool(one.isfinite().all()) for one in gradients)


def test_no_graph_grows_from_batch_to_batch():
    scores = standing_out(50, [*range(40)])
    assert not followed(PlaceFilter(), scores, Watched(50), 4).requires_grad


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: PlaceFilter(moves=()), ["moves are []", "add up to 1"]),
        (lambda: PlaceFilter(moves=(0.5, 0.6)), ["moves are [0.5, 0.6]", "add up to 1"]),
        (lambda: PlaceFilter(moves=(math.nan, 1)), ["moves are [nan, 1.0]"]),
        (lambda: PlaceFilter(jump=0.7, leave=0.5), ["jump 0.7, leave 0.5", "at most 1"]),
        (lambda: PlaceFilter(jump=math.nan), ["jump nan"]),
        (lambda: PlaceFilter(sharpness=0), ["sharpness 0", "above 0"]),
        (lambda: PlaceFilter(off_map=math.inf), ["off_map inf"]),
        (lambda: PlaceFilter(within=-1), ["within is -1", "at least 0"]),
        (lambda: PlaceFilter()(torch.rand(4)), ["(4,)", "(Q,N)"]),
        (lambda: PlaceFilter()(torch.zeros(3, 4, dtype=torch.int64)), ["torch.int64", "floats"]),
        (lambda: PlaceFilter()(torch.rand(2, 4), torch.rand(6)), ["posterior (6,)", "(5,)"]),
        (lambda: PlaceFilter()(torch.rand(2, 4), torch.ones(5)), ["adds up to 5", "to 1"]),
        (lambda: PlaceFilter(within=2.5), ["within is 2.5", "whole"]),  # type: ignore[arg-type]
        (lambda: PlaceFilter(threshold=math.nan), ["threshold is NaN"]),
        (lambda: PlaceFilter().check(10, 2), ["up to 2 places on a map of 2"]),
        (lambda: PlaceFilter(lag=-1), ["lag is -1", "at least 0"]),
        (lambda: PlaceFilter(lag=2).check(10, 20), ["a lag of 2", "PlaceSmoother"]),
        (lambda: PlaceFilter().step(torch.rand(2, 4), PlaceFilter().start(3)), ["(4,)", "(5,)"]),
        (lambda: PlaceFilter().step(torch.rand(2, 4), torch.zeros(5)), ["a Tensor", "`start`"]),
        (lambda: PlaceFilter().over(Layout(10))(torch.rand(5, 12)), ["(5, 12)", "the map's 10 places"]),
        (lambda: PlaceFilter().over(Layout(3, 4))(torch.rand(5, 11)), ["(5, 11)", "the map's 12 places"]),
    ],
)
def test_bad_input_is_refused(make, told):
    with refused(*told):
        make()


class Watched(PlaceMap):
    """A route on which a query is the row of scores itself."""

    kind = "watched"
    settings = summary = lambda self: {}  # type: ignore[assignment]

    def __init__(self, places: int) -> None:
        super().__init__(places, places)

    def scores(self, queries):
        return queries


def followed(model, scores, route, size=33):
    """The scores that places are found by."""
    rows = []
    localizer = Localizer(route, Matching(model, callback=rows.append))
    for part in scores.split(size):
        localizer(part)
    return torch.cat(rows)


def test_convention_2_a_place_that_nothing_covers_is_not_reported_by_a_filter():
    scores = standing_out(300, [*range(20, 80)])
    scores[:, 200:220] = math.inf
    found = followed(PlaceFilter(), scores, Watched(300), 7)
    assert torch.equal(found.isinf(), scores.isinf())
    closed = torch.full((5, 30), math.inf)
    assert Localizer(Watched(30), Matching(PlaceFilter()))(closed).index.tolist() == [-1] * 5


@pytest.mark.parametrize("model", [PlaceFilter(), SequenceMatcher(3), None])
def test_an_empty_batch_changes_nothing(model):
    scores = standing_out(50, [*range(12)])
    localizer = Localizer(Watched(50), Matching(model))
    found = Match.joined(map(localizer, (scores[:5], scores[:0], scores[5:])))
    whole = Localizer(Watched(50), Matching(model))(scores)
    assert torch.equal(found.index, whole.index)
    assert torch.allclose(found.score, whole.score, rtol=1e-4)


MODELS = {
    "eleven": SequenceMatcher(11),
    "speeds": SequenceMatcher(5, (1, 0.75, 2.5)),
    "backwards": SequenceMatcher(7, (-1, 0)),
    "filter": PlaceFilter(),
    "learning filter": PlaceFilter(learns=True),
    "filter with a nearness": PlaceFilter().having(nearness=Nearness(0.2, 0.1, 64)),
    "filter alone": PlaceFilter(within=0, moves=(0.5, 0.0, 0.25, 0.25), jump=0.05, off_map=2.0),
}


def with_gaps():
    """Scores of queries that pass places 3, 4, .., some of which are not covered."""
    scores = torch.rand(30, 25)
    scores[torch.arange(30), (torch.arange(30) + 3) % 25] -= 0.5
    scores[:, 7:9], scores[4], scores[20, ::2] = math.inf, math.inf, math.inf
    return scores


class Step(torch.nn.Module):
    def __init__(self, model: SequenceModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, scores, state):
        found, state = self.model.step(scores, self.model.unpacked(state))
        return found, self.model.packed(state)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_steps_are_the_batch_and_are_exported(model):
    scores, state = with_gaps(), model.packed(model.start(25, fixed=True))
    run = torch.export.export(Step(model).eval(), (scores[:1], state)).module()
    with torch.no_grad():
        together, last = model.step(scores, model.start(25))
        for row, expected in zip(scores.split(1), together.split(1), strict=True):
            found, state = run(row, state)
            torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(state, model.packed(last), rtol=1e-5, atol=1e-5)
