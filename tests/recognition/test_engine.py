"""The engine, held against an engine that is not ours, and its loops against torch."""

from __future__ import annotations

import importlib.util
from fractions import Fraction

import pytest
import torch
from helpers import refused
from hmmlearn.base import BaseHMM
from hypothesis import given
from hypothesis import strategies as st
from test_motion import matrix_of, motion_of, steps_of

from dejavu_torch.places.layout import Layout
from dejavu_torch.places.states import States
from dejavu_torch.recognition import loops
from dejavu_torch.recognition.engine import Block, Motion, Rates, normalised, sweep
from dejavu_torch.recognition.evidence import RankTable, Standardised
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.localizer import Matching, answer
from dejavu_torch.recognition.motion import AlongRoute
from dejavu_torch.recognition.scorer import OfRows
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.recognition.speeds import FREE, steady

NUMBA = importlib.util.find_spec("numba") is not None


class Given(BaseHMM):
    """Of which the log likelihoods of the states are the observations."""

    def _check(self):
        pass

    def _compute_log_likelihood(self, seen):
        return seen


@given(steps_of(), st.integers(1, 12), st.integers(1, 5), st.integers(0, 99))
def test_a_sweep_is_that_of_hmmlearn(steps, queries, size, seed):
    motion, matrix = motion_of(steps), matrix_of(steps)
    draw = torch.Generator().manual_seed(seed)
    log = 3 * torch.randn(queries, len(matrix), dtype=torch.float64, generator=draw)
    other = Given(n_components=len(matrix))
    other.startprob_, other.transmat_ = motion.anywhere().numpy(), matrix.numpy()
    total, expected = other.score_samples(log.numpy())
    still = torch.zeros(queries, dtype=torch.bool)
    blocks = [*sweep(motion, lambda first, last: log[first:last].exp(), queries, still, size)][::-1]
    found = torch.cat([block.posterior for block in blocks])
    torch.testing.assert_close(found, torch.from_numpy(expected), atol=1e-9, rtol=1e-7)
    assert float(sum(block.log.sum() for block in blocks)) == pytest.approx(total)


def single(steps, speeds=FREE):
    """The motion in single precision, and of two drives at once, of which the second moves more."""
    moves, *rest = (torch.tensor(one, dtype=torch.float32) for one in steps[1:5])
    other = torch.cat([moves[1:], moves[:1]])
    rates = Rates(torch.stack([moves, other]), *(one.expand(2) for one in rest))
    states = States(steps.places, steps.directions, tuple(steps.starts), tuple(steps.links), steps.turn)
    return AlongRoute(states, Rates(moves, *rest), speeds), AlongRoute(states, rates, speeds)


@pytest.mark.skipif(not NUMBA, reason="numba is not installed")
@given(steps_of(), st.integers(1, 6), st.integers(0, 99))
def test_loops_do_as_torch_does(steps, queries, seed):
    one, two = single(steps)
    draw = torch.Generator().manual_seed(seed)
    size = len(one.anywhere())
    likelihood = torch.rand(2, queries, size, generator=draw) + 1e-3
    still = torch.rand(2, queries, generator=draw) < 0.3
    starts = torch.rand(2, size, generator=draw), torch.rand(2, size, generator=draw)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loops, "WORTH_COMPILING", 1)
        for motion, start in ((one, starts[0]), (one, starts[0][0]), (two, starts[0])):
            expected = Motion.ahead(motion, start, likelihood, still)
            for own, other in zip(motion.ahead(start, likelihood, still), expected, strict=True):
                torch.testing.assert_close(own, other, atol=1e-5, rtol=1e-4)
        after, message = one.behind(starts[1], likelihood, still)
        literal, last = Motion.behind(one, starts[1], likelihood, still)
        torch.testing.assert_close(normalised(after), normalised(literal), atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(normalised(message), normalised(last), atol=1e-5, rtol=1e-4)
        block = Block(0, starts[0][:, None].expand_as(likelihood), likelihood, after, still.float(), one)
        pairs = block.before * likelihood, after
        z = 3 * torch.randn(2, queries, steps.places, generator=draw)
        scores = Standardised(z, still), z.sigmoid(), still.float()
        tables = RankTable(), RankTable()
        found, told = one.counts(*pairs), one.told(block, *scores, tables[0])
        patch.setattr(loops, "WORTH_COMPILING", 2**30)
        for own, other in zip(found, one.counts(*pairs), strict=True):
            torch.testing.assert_close(own, other, atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(told, one.told(block, *scores, tables[1]), atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(tables[0].counts, tables[1].counts, atol=1e-5, rtol=1e-4)


@pytest.mark.skipif(not NUMBA, reason="numba is not installed")
@given(steps_of(), st.sampled_from(["1", "1/2 3", "1/3 3/2 5"]), st.integers(0, 99))
def test_loops_keep_speeds_as_torch_does(steps, speeds, seed):
    one, two = single(steps, steady([*map(Fraction, speeds.split())]))
    draw = torch.Generator().manual_seed(seed)
    size = len(one.anywhere())
    likelihood, starts = torch.rand(2, 4, size, generator=draw) + 1e-3, torch.rand(2, size, generator=draw)
    still = torch.rand(2, 4, generator=draw) < 0.3
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loops, "WORTH_COMPILING", 1)
        for motion, start in ((one, starts), (one, starts[0]), (two, starts)):
            expected = Motion.ahead(motion, start, likelihood, still)
            for own, other in zip(motion.ahead(start, likelihood, still), expected, strict=True):
                torch.testing.assert_close(own, other, atol=1e-5, rtol=1e-4)
            after, message = motion.behind(starts, likelihood, still)
            literal, last = Motion.behind(motion, starts, likelihood, still)
            torch.testing.assert_close(normalised(after), normalised(literal), atol=1e-5, rtol=1e-4)
            torch.testing.assert_close(normalised(message), normalised(last), atol=1e-5, rtol=1e-4)


class Stairs(Motion):
    """Stays, or goes two places on, round a ring; the camera never leaves it."""

    def moved(self, belief):
        on = belief[..., :-1]
        return torch.cat([(on + on.roll(2, -1)) / 2, belief[..., -1:]], -1)

    def expected(self, message):
        on = message[..., :-1]
        return torch.cat([(on + on.roll(-2, -1)) / 2, message[..., -1:]], -1)


def test_a_smoother_moves_as_it_is_told():
    scores = torch.rand(9, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    smoother = PlaceSmoother(motion=Stairs).double()
    motion, other = smoother.steps(7, (0,), scores), Given(n_components=8)
    other.startprob_ = motion.anywhere().detach().numpy()
    other.transmat_ = motion.moved(torch.eye(8, dtype=torch.float64)).numpy()
    log = motion.wide(smoother.drive(scores).log_likelihood(torch.arange(9)), 0.0)
    total, expected = other.score_samples(log.numpy())
    torch.testing.assert_close(smoother.posterior(scores).detach(), torch.from_numpy(expected))
    assert float(smoother.log_evidence(scores)) == pytest.approx(total)
    with refused("the motion is a Stairs", "along a route"):
        smoother.path(scores)
    area = OfRows(scores.__getitem__, scores, Layout(1, 7))
    with refused("motion of one's own, and 9 queries on 7 places", "a route of fewer places"):
        answer(area, Matching(smoother))


def test_the_path_of_a_camera_that_never_turns_leaves_the_map():
    class OneWay(AlongRoute):
        directions = 1

    scores = torch.rand(30, 12, generator=torch.Generator().manual_seed(0))
    for motion in (AlongRoute, OneWay):
        assert (PlaceSmoother(leave=0.5, enter=0.0, separation=9.0, motion=motion).path(scores) == -1).all()


@pytest.mark.skipif(not NUMBA, reason="numba is not installed")
def test_no_loop_replaces_steps_of_ones_own(monkeypatch):
    class Slower(AlongRoute):
        def moved(self, belief):
            return (belief + super().moved(belief)) / 2

    class Alone(AlongRoute):
        def near(self, mass, radius):
            return 0 * mass

    monkeypatch.setattr(loops, "WORTH_COMPILING", 1)
    rates, ones = Rates(torch.tensor([0.2, 0.8]), *torch.tensor([0.01, 0.01, 0.1])), torch.ones(1, 11)
    table, motion = RankTable(), Alone(States(5, 2), rates)
    std = Standardised(torch.rand(1, 5), torch.ones(1, dtype=torch.bool))
    motion.told(Block(0, ones, ones, ones, ones[:, 0], motion), std, std.z, torch.ones(1), table)
    assert not table.counts.any()
    slower = Slower(States(5, 2), Rates(torch.tensor([0.2, 0.8]), *torch.tensor([0.01, 0.01, 0.1])))
    belief, still = torch.eye(11)[2], torch.zeros(1, dtype=torch.bool)
    before, *_ = slower.ahead(belief, torch.ones(1, 11), still)
    assert torch.allclose(before[0], slower.moved(belief))


def test_no_images_over_an_area_have_no_answers():
    none = torch.zeros(0, 4)
    assert (
        len(answer(OfRows(lambda _: torch.zeros(0, 12), none, Layout(3, 4)), Matching(PlaceSmoother()))) == 0
    )


def test_gradients_go_through_torch(monkeypatch):
    monkeypatch.setattr(loops, "WORTH_COMPILING", 1)
    moves = torch.tensor([0.2, 0.8], requires_grad=True)
    motion = AlongRoute(States(5, 2), Rates(moves, *torch.tensor([0.01, 0.01, 0.1])))
    seen = torch.rand(4, 11, generator=torch.Generator().manual_seed(0))
    still = torch.zeros(4, dtype=torch.bool)
    (block,) = sweep(motion, lambda *_: seen, 4, still, 4)
    block.log.sum().backward()
    assert bool((moves.grad != 0).all())


@pytest.mark.parametrize("leave", [0.0, 1e-12])
def test_a_camera_that_never_leaves_may_begin_off_the_map(leave):
    scores = torch.rand(60, 20, generator=torch.Generator().manual_seed(0))
    smoother = PlaceSmoother(leave=leave, separation=20.0)
    found, log = smoother.posterior(scores), smoother.log_evidence(scores)
    log.backward()
    assert bool(found.isfinite().all() and log.isfinite() and smoother.move_logits.grad.isfinite().all())


def test_nothing_is_below_zero_over_an_area():
    filter = PlaceFilter(leave=0.0, jump=0.0, enter=0.5, sharpness=6.0).over(Layout(20, 20))
    for seed in range(20):
        draw = torch.Generator().manual_seed(seed)
        found = filter.posterior(torch.rand(8, 400, generator=draw)).detach()
        assert float(found.min()) >= 0
        filter.posterior(torch.rand(1, 400, generator=draw), found[-1])
