"""The places of a drive given all of it, held against literal sums over all sequences of places."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import product

import pytest
import torch
from devices import pretend
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from reference import Chained, Steps, all_paths, forward_backward

from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.engine import normalised, sweep
from dejavu_torch.recognition.motion import AlongRoute
from dejavu_torch.recognition.smoother import PlaceSmoother, stretches, updated_rates
from dejavu_torch.recognition.speeds import FREE, steady

MOVES = (0.2, 0.5, 0.2, 0.1)


def noise(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def shown(places, path, seed=0, clear=2.5):
    """Scores of queries that show a place each, and its neighbours a little; -1 shows none."""
    scores, at = noise(len(path), places, seed=seed), torch.tensor(path)[:, None]
    near = (torch.arange(places) - at).abs()
    return scores - clear * torch.where(at < 0, 0, 0.5 ** near.float())


def evidence(smoother, scores):
    """What the scores say of the places, and which queries are in a stop."""
    drive = smoother.drive(scores)
    return drive.log_likelihood(torch.arange(len(scores))), drive.spacing.stopped


def folded(states, places):
    """Of all chains and both directions, the mass of the places, and of being off the map."""
    there, back = states[:, :-1].unflatten(1, (-1, 2, places)).sum(1).unbind(1)
    return torch.cat([there + back.flip(1), states[:, -1:]], 1)


def steps_of(smoother, places, starts=(0,)):
    with torch.no_grad():
        _, jump, leave = smoother.rate_logits.softmax(0).tolist()
        moves, enter = smoother.move_logits.softmax(0).tolist(), float(smoother.enter_logit.sigmoid())
    ends, links = (*starts[1:], places), smoother.links
    if smoother.loop:
        links += tuple((end - 1, start, 1.0) for start, end in zip(starts, ends, strict=True))
    steps = Steps(places, moves, jump, leave, enter, smoother.turn, 2, starts, links)
    speeds = [(speed.numerator, speed.denominator) for speed in smoother.steady.speeds]
    shares, first = smoother.steady.shares.tolist(), smoother.steady.first.tolist()
    return Chained(steps, speeds, shares, chosen.SLIP, first) if speeds else steps


SMOOTHER = st.builds(
    PlaceSmoother,
    st.sampled_from([(1.0,), (0.1, 0.8, 0.1), (0.0, 1.0), MOVES]),
    jump=st.sampled_from([0.0, 0.01, 0.3]),
    leave=st.sampled_from([0.0, 0.02, 0.5]),
    enter=st.sampled_from([0.0, 0.1, 1.0]),
    turn=st.sampled_from([0.0, 0.002, 0.5]),
    separation=st.sampled_from([0.3, 1.5, 4.0]),
    tempering=st.sampled_from([1.0, 6.0]),
    links=st.sampled_from([(), ((1, 0, 0.5),)]),
    loop=st.booleans(),
)
STEADY = st.sampled_from(["", "1", "1/2 3", "1/3 3/2"]).map(
    lambda speeds: steady([*map(Fraction, speeds.split())]) if speeds else FREE
)
SHAPE = st.tuples(st.integers(1, 9), st.integers(2, 6), st.integers(0, 99))


@given(SMOOTHER, STEADY, SHAPE, st.integers(1, 5), st.booleans())
def test_equals_a_literal_loop_in_blocks_of_any_size(smoother, steady, shape, size, two_routes):
    queries, places, seed = shape
    scores, starts = noise(queries, places, seed=seed).double(), (0, 1) if two_routes else (0,)
    smoother = smoother.double().changed(steady=steady)
    log, still = evidence(smoother, scores)
    steps = steps_of(smoother, places, starts)
    expected, total = forward_backward(steps, log.tolist(), still.tolist())
    states = torch.tensor(expected, dtype=torch.float64)
    found = smoother.posterior(scores, route_starts=starts)
    blocks = list(smoother.blocks(smoother.drive(scores), starts, size))
    assert smoother.log_evidence(scores, route_starts=starts).item() == pytest.approx(total, abs=1e-9)
    assert torch.allclose(found, folded(states, places), atol=1e-9)
    assert torch.allclose(found.sum(1), torch.ones(queries, dtype=torch.float64))
    assert [block.first for block in blocks] == [*range(0, queries, size)][::-1]
    assert torch.allclose(torch.cat([block.posterior for block in blocks[::-1]]), states, atol=1e-9)
    assert sum(block.log.sum().item() for block in blocks) == pytest.approx(total, abs=1e-9)


def stopped():
    """33 queries, 22 of them of a stop."""
    moving = noise(12, 2, seed=4)
    stop = moving[1:2].double() * (1 + 5e-5 * (torch.arange(21)[:, None] % 2 - 2))
    return torch.cat([moving[:2].double(), stop, moving[2:].double()])


def test_a_stop_moves_nowhere_and_counts_once():
    smoother, scores = PlaceSmoother(MOVES, 0.1, 0.1, 0.1, 0.3).double(), stopped()
    log, still = evidence(smoother, scores)
    assert still.tolist() == [False] * 2 + [True] * 21 + [False] * 10
    assert torch.allclose(log[1:23].sum(0), 22 * log[1], rtol=0.01)
    steps = steps_of(smoother, 2)
    expected, total = forward_backward(steps, log.tolist(), still.tolist())
    states = torch.tensor(expected, dtype=torch.float64)
    assert torch.allclose(smoother.posterior(scores), folded(states, 2))
    assert smoother.log_evidence(scores).item() == pytest.approx(total)
    assert torch.equal(smoother.path(scores)[1:23], smoother.path(scores)[1].expand(22))


@given(SMOOTHER, st.integers(0, 99))
def test_the_path_and_the_likelihood_are_those_of_all_sequences(smoother, seed):
    smoother.links, smoother.loop = (), False  # where two ways lead to a place, each is one of its own
    smoother, scores = smoother.double(), 3 * noise(4, 3, seed=seed).double()
    log, still = evidence(smoother, scores)
    values = all_paths(steps_of(smoother, 3), log.tolist(), still.tolist())
    ways = [(6,) if place < 0 else (place, 5 - place) for place in smoother.path(scores).tolist()]
    assert max(map(values.__getitem__, product(*ways))) == pytest.approx(max(values.values()))
    assert smoother.log_evidence(scores).item() == pytest.approx(math.log(sum(values.values())))


def test_the_path_stands_still_and_leaves_the_map():
    path = [*range(10, 40), *[40] * 40, *range(40, 60), *[-1] * 60, *range(20, 50)]
    scores = shown(80, path, clear=5.0)
    scores[31:70] = scores[30] + 1e-4 * noise(39, 80)
    smoother = PlaceSmoother().fit(scores)
    found = smoother.path(scores)
    truth = torch.tensor(path)
    assert smoother.is_drive
    assert ((found - truth).abs() <= 1).double().mean() > 0.95
    assert found[30:70].unique().numel() == 1
    assert (found[95:145] == -1).all()


class Likelihood(torch.nn.Module):
    def __init__(self, smoother: PlaceSmoother) -> None:
        super().__init__()
        self.smoother = smoother

    def forward(self, scores):
        return self.smoother.log_evidence(scores)


def test_gradients_reach_moves_and_rates_but_not_what_is_tempered():
    model, scores = Likelihood(PlaceSmoother(MOVES, 0.1, 0.1, 0.2)).double(), noise(6, 4).double()
    names, values = zip(*model.named_parameters(), strict=True)
    assert names == ("smoother.move_logits", "smoother.rate_logits", "smoother.enter_logit")

    def run(*values):
        return torch.func.functional_call(model, dict(zip(names, values, strict=True)), (scores,))

    assert torch.autograd.gradcheck(run, values)
    assert all(bool((one != 0).all()) for one in torch.autograd.grad(run(*values), values))
    fitted = PlaceSmoother(MOVES, within=1).double().fit(noise(6, 4, seed=1).double())
    assert torch.autograd.gradcheck(fitted, (scores.requires_grad_(),))


@pytest.mark.parametrize("none", [{"jump": 0.0}, {"leave": 0.0}, {"enter": 0.0}, {"jump": 0.0, "leave": 0.0}])
def test_what_cannot_happen_stays_finite_in_single_precision(none):
    """Queries that contradict each other by more than single precision holds."""
    scores = shown(60, [*range(20), *range(40, 60), *range(20, 40)], clear=20.0)
    smoother = PlaceSmoother((0.0, 1.0), separation=6.0, turn=0.0, **none)
    smoother.log_evidence(scores).backward()
    assert smoother.posterior(scores).isfinite().all()
    assert all(one.grad is not None and bool(one.grad.isfinite().all()) for one in smoother.parameters())


def test_climbing_the_likelihood_finds_the_moves_that_counting_finds():
    """With the same evidence, and the prior of five more steps of each kind of move."""
    scores = shown(15, [*range(0, 15, 2), *range(14, 0, -3), *range(8)], clear=3.0).double()
    smoother, prior = PlaceSmoother(MOVES, 0.02, 0.02, 0.05).double(), torch.full((4,), 5.0).double()
    drive, first = smoother.drive(scores), smoother.steps(15, (0,), scores)
    like = first.wide(drive.log_likelihood(torch.arange(len(scores))), 0.0).exp()
    with torch.no_grad():
        rates = first.rates
        for _ in range(100):
            motion = AlongRoute(first.states, rates)
            (block,) = sweep(motion, lambda *_: like, len(like), drive.spacing.stopped, len(like))
            belief, after = normalised(block.before * block.likelihood), block.likelihood * block.after
            rates = updated_rates(motion.counts(belief[:-1], after[1:]), prior)
        on_map = torch.stack([1 - rates.jump - rates.leave, rates.jump, rates.leave])
        smoother.rate_logits.copy_(on_map.log())
        smoother.enter_logit.copy_(rates.enter.logit())
    climber = torch.optim.LBFGS([smoother.move_logits], max_iter=100, tolerance_grad=1e-9)

    def loss():
        climber.zero_grad()
        value = -smoother.log_evidence(scores) - prior @ smoother.move_logits.log_softmax(0)
        value.backward()
        return value

    climber.step(loss)
    assert torch.allclose(smoother.move_logits.softmax(0), rates.moves, atol=1e-4)
    assert (rates.moves - torch.tensor(MOVES)).abs().max() > 0.05


DRIVES = {
    "on": range(20, 180),
    "reversed": range(180, 20, -1),
    "there and back": [*range(20, 120), *range(119, 20, -1)],
    "jumps": [*range(20, 60), *range(150, 190), *range(70, 110), *range(40)],
    "a stop": [*range(20, 80), *[80] * 200, *range(80, 150)],
    "slow": [20 + t // 3 for t in range(300)],
    "thrice the speed": range(0, 200, 3),
    "five times the speed": range(0, 400, 5),
    "partly off the map": [*range(20, 100), *[-1] * 80, *range(100, 160)],
}


@pytest.mark.parametrize("drive", DRIVES.values(), ids=DRIVES)
def test_drives_of_any_kind_are_found_where_single_queries_are_not(drive):
    truth, places = torch.tensor(drive), 400 if max(drive) > 199 else 200
    scores = shown(places, drive, clear=2.0)
    if drive is DRIVES["a stop"]:
        scores[60:260] = scores[60] + 0.001 * noise(200, places, seed=9)
    smoother = PlaceSmoother(within=2).fit(scores)
    on, found = truth >= 0, smoother.posterior(scores)
    right = ((smoother(scores).argmin(1) - truth).abs() <= 2)[on].double().mean()
    alone = ((scores.argmin(1) - truth).abs() <= 2)[on].double().mean()
    assert smoother.is_drive
    assert right > 0.99
    assert alone < 0.5
    assert found[on, -1].mean() < 0.1
    assert on.all() or found[~on, -1].mean() > 0.5


@pytest.mark.slow
def test_a_stop_is_one_of_the_queries_that_another_speed_has_to_explain():
    """80 queries that are alike, at four times the speed, and 400 of a stop."""
    scores, descriptors = shown(400, range(0, 320, 4), clear=3.5), noise(80, 16, seed=3)
    for t in range(1, 80):
        descriptors[t] = 0.8 * descriptors[t - 1] + 0.6 * descriptors[t]
    at = torch.tensor([*range(40), *[40] * 400, *range(40, 80)])
    seen = descriptors[at] + 1e-4 * noise(len(at), 16)
    moving, stopped = PlaceSmoother().fit(scores, descriptors), PlaceSmoother().fit(scores[at], seen)
    assert moving.is_drive
    assert stopped.is_drive
    assert stopped.tempering == pytest.approx(moving.tempering, rel=0.01)
    assert moving.tempering > 3
    nats = [one.settled()["nats_per_query"] for one in (stopped, moving)]
    assert nats[0] == pytest.approx(nats[1], rel=0.2)
    found = stopped(scores[at], seen).argmin(1)
    assert ((found - 4 * at).abs() <= 5).double().mean() > 0.99


@pytest.mark.parametrize("seed", range(3))
def test_another_route_is_no_drive(seed):
    scores = noise(200, 300, seed=seed)
    smoother = PlaceSmoother().fit(scores)
    assert not smoother.is_drive
    assert smoother.posterior(scores)[:, :-1].max() < 0.5
    assert (-smoother(scores)).exp().max() < 0.5


def test_circuits_links_and_routes_lead_where_they_say():
    laps = [t % 50 for t in range(30, 130)]
    scores = shown(50, laps, clear=2.5)
    once, round_ = PlaceSmoother(MOVES, jump=1e-6), PlaceSmoother(MOVES, jump=1e-6, loop=True)
    assert round_.log_evidence(scores) > once.log_evidence(scores) + 5
    assert round_.log_evidence(scores, route_starts=(0, 25)) < once.log_evidence(scores)
    crossing = [*range(20), *range(35, 50)]
    scores = shown(50, crossing, clear=2.5)
    linked = PlaceSmoother(MOVES, jump=1e-6, links=[(19, 35, 0.5)])
    assert linked.log_evidence(scores) > once.log_evidence(scores) + 5
    assert linked.log_evidence(scores.flip(0)) > once.log_evidence(scores.flip(0)) + 5
    assert once.log_evidence(scores, route_starts=(0, 10)) < once.log_evidence(scores)


def test_queries_that_say_nothing_are_as_without_them():
    """What lies between is filled in by the queries before and after: the same for all kinds of silence."""
    scores = shown(60, range(60))
    smoother = PlaceSmoother().fit(scores)
    mute = [torch.full((5, 60), one) for one in (0.25, math.inf, -math.inf, math.nan)]
    mute.append(scores[20:25].clone())
    mute[-1][:, 7] = math.nan
    found = [smoother.posterior(torch.cat([scores[:20], one, scores[25:]]), scores) for one in mute]
    drive = smoother.drive(scores)
    log = drive.log_likelihood(torch.arange(60))
    log[20:25] = 0
    expected, _ = forward_backward(steps_of(smoother, 60), log.tolist(), [False] * 60)
    for one in found:
        assert torch.allclose(one, folded(torch.tensor(expected), 60), atol=1e-4)
    assert found[0][20:25, :-1].argmax(1).tolist() == [*range(20, 25)]


def test_only_what_is_scored_is_answered():
    scores = shown(60, range(60))
    scores[:, 30:40], scores[7], scores[9, 3] = math.inf, math.inf, math.nan
    found = PlaceSmoother(within=1).fit(scores)(scores)
    assert torch.equal(found.isinf(), ~scores.isfinite())
    assert not found.isnan().any()
    closed = torch.full((5, 30), math.inf)
    assert PlaceSmoother().fit(closed)(closed).isinf().all()


def test_few_queries_and_places_are_answered():
    scores = shown(20, [7, 8], clear=9.0)
    for queries in (0, 1, 2):
        for smoother in (PlaceSmoother(within=0), PlaceSmoother(within=0).fit(scores[:queries])):
            assert smoother(scores[:queries]).shape == (queries, 20)
            assert smoother.posterior(scores[:queries]).sum(1).tolist() == pytest.approx([1] * queries)
            assert smoother.log_evidence(scores[:queries]).isfinite()
            assert len(smoother.path(scores[:queries])) == queries
            assert (queries < 2) or smoother(scores).isfinite().all()
        assert not smoother.is_drive
    assert PlaceSmoother(within=0)(scores[:1]).argmin() == 7
    alone = PlaceSmoother().fit(noise(30, 1))
    assert not alone.is_drive
    assert alone(noise(30, 1)).shape == (30, 1)


def test_leading_dimensions_are_drives_of_their_own():
    scores, smoother = noise(2, 3, 8, 9), PlaceSmoother(within=1)
    found = smoother(scores)
    assert torch.equal(found[1, 2], smoother(scores[1, 2]))
    assert found.shape == (2, 3, 8, 9)
    assert smoother(scores[:0]).shape == (0, 3, 8, 9)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_other_precisions_give_the_same_places(dtype):
    scores = shown(80, range(80), clear=3.0)
    found = PlaceSmoother(within=0).fit(scores)(scores)
    smoother = PlaceSmoother(within=0).to(dtype).fit(scores.to(dtype))
    other = smoother(scores.to(dtype))
    assert other.dtype == dtype
    assert torch.equal(other.argmin(1), found.argmin(1))
    assert smoother(scores).isfinite().all()


def test_a_device_gives_what_the_cpu_gives():
    scores = shown(8, [*range(5), *[5] * 22], clear=3.0).double()
    scores[5:] = scores[5] * (1 + 5e-5 * (torch.arange(22)[:, None] % 2))
    smoother = PlaceSmoother(MOVES).double().fit(scores)
    with pretend() as device:
        there = PlaceSmoother(MOVES).double().to(device).fit(scores.to(device))
        for one in (there, smoother):  # fitted there or here
            found, path = one(scores.to(device)), one.path(scores.to(device))
            assert found.device == device
            assert torch.allclose(found.cpu(), smoother(scores), rtol=1e-6)
            assert torch.equal(path.cpu(), smoother.path(scores))


def test_scores_may_be_made_as_they_are_asked_for():
    scores, descriptors = shown(50, range(50)), noise(50, 8)
    asked = []

    def rows(numbers):
        asked.extend(numbers.tolist())
        return scores[numbers]

    made, given_ = PlaceSmoother().fit(rows, descriptors), PlaceSmoother().fit(scores, descriptors)
    assert repr(made) == repr(given_)
    assert asked[1:] == [*range(50)]  # after a look at how many places there are
    blocks = made.blocks(made.drive(rows, descriptors), size=7)
    found = torch.cat([block.motion.folded(block.posterior) for block in blocks][::-1])
    assert torch.allclose(found, given_.posterior(scores, descriptors), atol=1e-6)
    assert made.log_likelihood == given_.log_likelihood
    again = repr(made.fit(rows, descriptors))
    assert again == repr(given_)


def test_a_fitted_copy_shares_no_parameter():
    smoother = PlaceSmoother()
    for queries in (0, 60):
        fitted = smoother.fit(shown(30, range(30))[:queries])
        fitted.double()
        assert {rate.dtype for rate in fitted.parameters()} == {torch.float64}
        assert {rate.dtype for rate in smoother.parameters()} == {torch.float32}


@given(st.integers(1, 5000), st.floats(1, 2000))
def test_stretches_are_spread_over_the_drive(queries, correlation):
    picked = stretches(queries, correlation)
    assert picked.numel() <= min(queries, 1000) < picked.numel() + 10
    assert picked[0, 0] == 0
    assert len(picked) == 1 or picked[-1, -1] == queries - 1
    assert (picked.diff(dim=1) == 1).all()
    assert (picked[1:, 0] > picked[:-1, -1]).all()


def test_queries_that_say_nothing_do_not_make_the_others_say_more():
    walk = noise(200, 12, seed=1).cumsum(0)
    scores = torch.cdist(walk[20:180], walk) + 50
    clean = PlaceSmoother().fit(scores)
    for silent in (math.nan, math.inf, 0.0):
        odd = scores.clone()
        odd[[0, 1, 50, 120]] = silent
        assert PlaceSmoother().fit(odd).correlation == pytest.approx(clean.correlation, rel=0.4)


def test_a_camera_that_never_leaves_the_map_has_a_place():
    smoother = PlaceSmoother(jump=0.0, leave=0.0, enter=0.0)
    scores = shown(30, range(30))
    assert (smoother.fit(scores)(scores).argmin(1) - torch.arange(30)).abs().max() <= 1


def test_rates_and_moves_are_the_priors_of_a_fit():
    scores = shown(90, range(80))
    plain = PlaceSmoother().fit(scores).settled()
    given = PlaceSmoother((0.5, 0.5), jump=0.1, enter=0.3).fit(scores).settled()
    assert given["jump"] > 20 * plain["jump"]
    assert given["enter"] > 10 * plain["enter"]
    assert len(given["moves"]) == 2


def test_the_module_says_what_it_has_settled_on():
    told = repr(PlaceSmoother((0.25, 0.75), jump=0.01, leave=0.02, enter=0.1, separation=2, tempering=3))
    assert "moves=[0.25, 0.75], nats_per_query=0, jumps=0, " in told
    assert "jump=0.01, leave=0.02, enter=0.1, separation=2, " in told
    assert "tempering=3, " in told


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: PlaceSmoother(moves=(0.5, 0.6)), ["moves are [0.5, 0.6]", "add up to 1"]),
        (lambda: PlaceSmoother(jump=0.7, leave=0.5), ["jump 0.7, leave 0.5", "at most 1"]),
        (lambda: PlaceSmoother(turn=-0.1), ["turn is -0.1", "probability"]),
        (lambda: PlaceSmoother(turn=math.nan), ["turn is nan"]),
        (lambda: PlaceSmoother(separation=0), ["separation 0, tempering 1", "above 0"]),
        (lambda: PlaceSmoother(tempering=0.5), ["tempering 0.5", "at least 1"]),
        (lambda: PlaceSmoother(tempering=math.inf), ["tempering inf", "finite"]),
        (lambda: PlaceSmoother(within=-1), ["within is -1", "at least 0"]),
        (lambda: PlaceSmoother(within=2.5), ["within is 2.5", "whole"]),  # type: ignore[arg-type]
        (lambda: PlaceSmoother(threshold=math.nan), ["threshold is NaN", "None"]),
        (lambda: PlaceSmoother()(torch.rand(4)), ["(4,)", "(Q,N)"]),
        (lambda: PlaceSmoother()(torch.rand(4, 0)), ["(4, 0)", "(Q,N)"]),
        (lambda: PlaceSmoother().fit(torch.zeros(3, 4).int()), ["torch.int32", "floats"]),
        (lambda: PlaceSmoother().path(torch.rand(2, 3, 4)), ["(2, 3, 4)", "(Q,N)"]),
        (lambda: PlaceSmoother().fit(torch.rand(3, 4), torch.rand(2, 5)), ["2 descriptors of 3 queries"]),
        (lambda: PlaceSmoother().posterior(torch.rand(3, 4), torch.rand(5, 2)), ["5 descriptors of 3"]),
        (lambda: PlaceSmoother().fit(torch.rand(3, 4), torch.full((3, 2), math.nan)), ["(3, 2)", "finite"]),
        (lambda: PlaceSmoother().fit(lambda some: torch.rand(len(some), 4)), ["without descriptors"]),
        (lambda: PlaceSmoother(links=[(0, 1)]), ["a link is (0, 1)", "a probability"]),  # type: ignore[list-item]
        (lambda: PlaceSmoother(links=[(0.5, 1, 1.0)]), ["(0.5, 1, 1.0)"]),  # type: ignore[list-item]
        (lambda: PlaceSmoother(links=[(0, 4, 0.5)])(torch.rand(3, 4)), ["(0, 4, 0.5) on 4 places"]),
        (lambda: PlaceSmoother(links=[(-1, 2, 0.5)])(torch.rand(3, 4)), ["(-1, 2, 0.5)", "two of these"]),
        (lambda: PlaceSmoother(links=[(0, 2, 1.5)])(torch.rand(3, 4)), ["(0, 2, 1.5)", "a probability"]),
        (lambda: PlaceSmoother().start(4), ["whole drive", "PlaceFilter"]),
        (lambda: PlaceSmoother().step(torch.rand(2, 4), torch.rand(5)), ["whole drive", "SequenceMatcher"]),
    ],
)
def test_bad_input_is_refused(make, told):
    with refused(*told):
        make()


def test_a_hole_is_passed_and_no_answer():
    """Places 20 to 39 have no scores: queries there are off the map, those behind are found at once."""
    scores = shown(80, range(80))
    scores[:, 20:40] = math.inf
    smoother = PlaceSmoother().fit(scores)
    posterior = smoother.posterior(scores)
    assert smoother.is_drive
    assert (posterior[:, :-1].argmax(1) - torch.arange(80)).abs().max() <= 3  # the camera goes on in it
    found = smoother(scores)
    assert found[:, 20:40].isinf().all()
    assert (-found[24:36].amin(1)).exp().max() < 0.5
    assert (-found[42:].amin(1)).exp().min() > 0.5
    with_few = scores.clone()
    with_few[5, 20:40] = 9.0  # one query that has them: they are no hole
    assert PlaceSmoother().fit(with_few).posterior(with_few)[30, 20:40].sum() < 0.1
