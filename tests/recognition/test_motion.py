"""One step of the camera, held against the matrix of all transitions."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from reference import Chained, Steps

from dejavu_torch.places.states import States
from dejavu_torch.recognition import chosen
from dejavu_torch.recognition.engine import Rates
from dejavu_torch.recognition.motion import AlongRoute, checked_rates
from dejavu_torch.recognition.speeds import FREE, Speeds, steady


@st.composite
def steps_of(draw):
    """Small maps of up to three routes, with links, which may part from and meet at one place."""
    places = draw(st.integers(1, 7))
    starts = (0, *sorted(draw(st.sets(st.integers(1, places - 1), max_size=2)) if places > 1 else ()))
    place, share = st.integers(0, places - 1), st.sampled_from([0.0, 0.25, 0.7, 1.0])
    links = draw(st.lists(st.tuples(place, place, share), max_size=3))
    return Steps(
        places,
        draw(st.sampled_from([(1.0,), (0.1, 0.8, 0.1), (0.0, 1.0), (0.5, 0.125, 0.125, 0.25)])),
        draw(st.sampled_from([0.0, 0.01, 0.3])),
        draw(st.sampled_from([0.0, 0.02, 0.5])),
        draw(st.sampled_from([0.01, 0.1, 1.0])),
        draw(st.sampled_from([0.0, 0.2, 1.0])),
        draw(st.sampled_from([1, 2])),
        starts,
        links,
    )


def motion_of(steps):
    speeds = FREE
    if isinstance(steps, Chained):
        known = tuple(Fraction(*one) for one in steps.speeds)
        columns = (torch.tensor(one, dtype=torch.float64) for one in (steps.shares, steps.first))
        steps, speeds = steps.steps, Speeds(known, *columns)
    rates = (torch.tensor(one, dtype=torch.float64) for one in steps[1:5])
    states = States(steps.places, steps.directions, tuple(steps.starts), tuple(steps.links), steps.turn)
    return AlongRoute(states, Rates(*rates), speeds)


@st.composite
def chained(draw):
    """Steps, mostly with steady speeds beside free moves."""
    speeds = draw(st.sampled_from([(), ((1, 1),), ((1, 2), (3, 1)), ((1, 3), (2, 3), (3, 2))]))
    steps, known = draw(steps_of()), steady([Fraction(*one) for one in speeds], usual=0.3)
    if not speeds:
        return steps
    return Chained(steps, speeds, known.shares.tolist(), chosen.SLIP, known.first.tolist())


def matrix_of(steps):
    return torch.tensor(steps.transitions(), dtype=torch.float64)


@given(chained())
def test_a_step_is_that_of_the_matrix_and_keeps_the_mass(steps):
    matrix, motion = matrix_of(steps), motion_of(steps)
    states = torch.eye(len(matrix), dtype=torch.float64)
    assert torch.allclose(motion.moved(states), matrix, atol=1e-12)
    assert torch.allclose(motion.expected(states), matrix.T, atol=1e-12)
    assert torch.allclose(matrix.sum(1), torch.ones(len(matrix), dtype=torch.float64))
    assert (motion.lost >= 0).all()


@given(chained(), st.integers(0, 99))
def test_leading_dimensions_are_steps_of_their_own(steps, seed):
    motion, generator = motion_of(steps), torch.Generator().manual_seed(seed)
    beliefs = torch.rand(2, 3, len(steps.start()), dtype=torch.float64, generator=generator)
    for step in (motion.moved, motion.expected):
        each = torch.stack([step(belief) for belief in beliefs.flatten(0, 1)]).view(beliefs.shape)
        assert torch.allclose(step(beliefs), each, atol=1e-12)


@pytest.mark.parametrize("directions", [1, 2])
@pytest.mark.parametrize("links", [(), ((4, 0, 1.0), (10, 5, 1.0))], ids=["routes", "circuits"])
def test_the_best_way_is_the_largest_term_of_the_matrix(directions, links):
    """Where no two ways lead from one place to another, as on circuits that are longer than a move."""
    steps = Steps(11, (0.5, 0.125, 0.125, 0.25), 0.01, 0.02, 0.1, 0.2, directions, (0, 5), links)
    for log in torch.randn(20, 11 * directions + 1, dtype=torch.float64) * 3:
        expected = (log[:, None] + matrix_of(steps).log()).amax(0)
        assert torch.allclose(motion_of(steps).best_moved(log), expected)


@given(steps_of(), st.integers(0, 99))
def test_counts_are_those_of_each_pair_of_states(steps, seed):
    generator = torch.Generator().manual_seed(seed)
    before, after = torch.rand(2, 4, len(steps.start()), dtype=torch.float64, generator=generator)
    kinds, stay = [], 1 - steps.jump - steps.leave
    for v, move in enumerate(steps.moves):
        alone = [float(v == one) for one in range(len(steps.moves))]
        kinds.append(stay * move * matrix_of(steps._replace(moves=alone, jump=0.0, leave=0.0)))
        kinds[-1][-1] = 0
    jump, leave, enter, absent = torch.zeros(4, *kinds[0].shape, dtype=torch.float64)
    jump[:-1, :-1], leave[:-1, -1] = steps.jump / (len(jump) - 1), steps.leave
    enter[-1, :-1], absent[-1, -1] = steps.enter / (len(jump) - 1), 1 - steps.enter
    each = torch.stack([*kinds, jump, leave, enter, absent])
    assert torch.allclose(each.sum(0), matrix_of(steps))
    joint = torch.stack([b[:, None] * each * a for b, a in zip(before, after, strict=True)]).sum((2, 3))
    expected = (joint / joint.sum(1, keepdim=True)).sum(0)
    counts = motion_of(steps).counts(before, after * 1e-3)
    assert torch.allclose(torch.cat([counts.moves, torch.stack(counts[1:])]), expected)


@given(chained(), st.integers(0, 99))
def test_changes_are_those_of_each_pair_of_states(steps, seed):
    generator = torch.Generator().manual_seed(seed)
    before, after = torch.rand(2, 4, len(steps.start()), dtype=torch.float64, generator=generator)
    motion, alone = motion_of(steps), {"jump": 0.0, "leave": 0.0, "enter": 0.0}
    free = (
        steps._replace(steps=steps.steps._replace(**alone)) if motion.chains > 1 else steps._replace(**alone)
    )
    moving, size = matrix_of(free), steps.places * steps.directions
    moving[-1] = 0
    base = steps.steps if motion.chains > 1 else steps
    moving = moving * (1 - base.jump - base.leave)
    total = torch.einsum("ti,ij,tj->t", before, matrix_of(steps), after)
    joint = before[:, :, None] * moving * after[:, None] / total[:, None, None]
    on = joint[:, :-1, :-1].unflatten(1, (-1, size)).unflatten(3, (-1, size)).sum((0, 2, 4))
    assert torch.allclose(motion.changes(before, after).sum(), joint.sum())
    gone = motion.changes(before, after) - on
    assert (gone > -1e-12).all()
    assert torch.allclose(gone.sum(1), joint[:, :-1, -1].unflatten(1, (-1, size)).sum((0, 2)))


def test_routes_end_and_a_circuit_does_not():
    """Two routes of 3 and 4 places; the second becomes a circuit."""
    steps = Steps(7, (0.0, 1.0), enter=0.5, starts=(0, 3))
    moved = motion_of(steps).moved(torch.eye(15, dtype=torch.float64)).argmax(1).tolist()
    off = 14
    assert moved == [1, 2, off, 4, 5, 6, off, 8, 9, 10, off, 12, 13, off, off]
    circuit = steps._replace(links=[(6, 3, 1.0)])
    moved = motion_of(circuit).moved(torch.eye(15, dtype=torch.float64)).argmax(1).tolist()
    assert moved == [1, 2, off, 4, 5, 6, 3, 8, 9, 10, 7, 12, 13, off, off]


def test_single_precision_loses_nobody_off_the_end_of_a_road():
    """With nobody leaving, rounding makes no mass negative, whose logarithm would be NaN."""
    moves = torch.tensor([0.2, 0.5, 0.2, 0.05, 0.02, 0.015, 0.015])
    none = torch.tensor(0.0)
    motion = AlongRoute(States(1000, 2), Rates(moves, none, none, none))
    assert (motion.lost[:, :-6] == 0).all()
    belief = torch.zeros(2001)
    belief[3:900] = 1 / 897
    assert motion.moved(belief)[-1] == 0
    assert not motion.best_moved(belief.log()).isnan().any()


@pytest.mark.parametrize(
    ("given_", "told"),
    [
        (((), 0.1, 0.1, 0.1), ["moves are []", "add up to 1"]),
        (((0.5, 0.4), 0.1, 0.1, 0.1), ["moves are [0.5, 0.4]", "add up to 1"]),
        (((1.5, -0.5), 0.1, 0.1, 0.1), ["moves are [1.5, -0.5]", "probabilities"]),
        (((1.0,), 0.6, 0.6, 0.1), ["jump 0.6, leave 0.6, enter 0.1", "at most 1"]),
        (((1.0,), 0.1, 0.1, math.nan), ["enter nan", "probabilities"]),
    ],
)
def test_rates_that_are_no_probabilities_are_refused(given_, told):
    with refused(*told):
        checked_rates(*given_)
