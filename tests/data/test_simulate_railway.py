"""The railways: what repeats and where, how the train moves, and what two traverses share."""

from __future__ import annotations

import random
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import all_of, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from dejavu_torch.data.ground_truth import position_truth
from dejavu_torch.data.simulate import SIMULATORS
from dejavu_torch.data.simulate.outdoor import Outdoor
from dejavu_torch.data.simulate.route import SimulatedRoute, option
from dejavu_torch.data.simulate.sheets import Painter, Thing, View
from dejavu_torch.data.simulate.train import FPS, reference_place, ride
from dejavu_torch.data.simulate.underground import Underground
from dejavu_torch.data.source import open_source
from dejavu_torch.motion.odometry import GroundOdometry

KINDS = [Outdoor, Underground]
both = pytest.mark.parametrize("kind", KINDS)


@cache
def ride_of(kind, traverse=0):
    """A whole ride on the railway of seed 0, built once."""
    return kind(traverse=traverse)


@pytest.fixture(scope="module", autouse=True)
def forget():
    yield
    ride_of.cache_clear()


def frames_at(train, index):
    """These frames, read one at a time as a batch of one would."""
    return torch.cat([train._frames(part) for part in index.split(32)])


@both
def test_frames_depend_on_the_arguments_alone(kind):
    route = 200.0 if kind is Outdoor else 2000.0  # less to paint, and room for the stations
    brief = type("Brief", (kind,), {"route": route})
    first = all_of(brief(traverse=1, frames=4))
    assert first.shape == (4, 3, 64, 128)
    torch.manual_seed(5)
    random.seed(5)
    before = torch.get_rng_state(), random.getstate()
    again = brief(traverse=1, frames=5)  # a cut route is the beginning of the whole
    assert torch.equal(all_of(again, 2)[:4], first)
    assert torch.equal(again[2:4], first[2:])
    assert torch.equal(torch.get_rng_state(), before[0])
    assert random.getstate() == before[1]
    assert not torch.allclose(all_of(brief(seed=2, traverse=1, frames=4)), first, atol=0.1)
    assert not torch.allclose(all_of(brief(traverse=0, frames=4)), first, atol=0.1)


def test_a_ride_keeps_to_its_plan():
    distance = ride(1000.0, 10.0, [(400, 500, 5.0)], [(700, 4.0)])
    assert distance[0] == 0
    assert (distance == 700).sum() in (100, 101)  # 4 s
    within = distance[(distance > 410) & (distance < 490)]
    assert torch.allclose(within.diff(), torch.tensor(5.0 / FPS, dtype=torch.float64))
    cruise = distance[(distance > 100) & (distance < 300)]
    assert torch.allclose(cruise.diff(), torch.tensor(10.0 / FPS, dtype=torch.float64))
    t = torch.arange(len(distance)).double()[100:240] / FPS
    assert torch.allclose(distance[100:240], 0.9 * t**2 / 2, atol=0.05)  # 0.9 m/s^2


@given(
    steps=st.lists(st.sampled_from([0.0, 0.0, 0.25, 1.0]), min_size=1, max_size=20),
    queries=st.lists(st.integers(0, 80), min_size=1, max_size=20),
)
@settings(max_examples=60, deadline=None)
def test_a_reference_place_by_hand(steps, queries):
    reference = [0.0]
    for step in steps:
        reference.append(reference[-1] + step)
    asked = [min(q / 4 + 0.125 * (q % 2), reference[-1]) for q in queries]
    expected = []
    for d in asked:
        if d in reference:
            expected.append(float(reference.index(d)))
        else:
            after = next(i for i, r in enumerate(reference) if r > d)
            low, high = reference[after - 1], reference[after]
            expected.append(after - 1 + (d - low) / (high - low))
    if reference[-1] > 0:
        tensors = (torch.tensor(values, dtype=torch.float64) for values in (reference, asked))
        assert reference_place(*tensors).tolist() == pytest.approx(expected)


@both
def test_a_place_is_the_reference_frame_at_the_same_distance(kind):
    reference, other = ride_of(kind), ride_of(kind, 1)
    assert torch.equal(reference.places, torch.arange(len(reference)).double())
    low = reference.distance[other.places.floor().long()]
    high = reference.distance[other.places.ceil().long()]
    assert (low <= other.distance + 1e-9).all()
    within = other.distance <= reference.distance[-1]  # the route ends within the last frame's step
    assert (other.distance <= high + 1e-9)[within].all()
    assert (other.places[~within] == len(reference) - 1).all()
    found = position_truth(reference.places, other.places)[:, 0]
    assert (found >= 0).all()
    assert (reference.distance[found] - other.distance).abs().max() < reference.distance.diff().max()
    assert abs(len(reference) - len(other)) > 20


def brightness(train, metres, rows, columns):
    """These pixels of a 64 x 128 frame with the camera still at each of these distances, (n,R*C)."""
    view = View(64, 128)
    keep = (rows[:, None] * 128 + columns).flatten()
    view.up, view.right, view.shape = view.up[keep], view.right[keep], (len(rows), len(columns))
    painter = Painter(view, train._painter.sheets, train._painter.light, torch.zeros(3, len(keep)))
    parts = [
        painter.draw(part, torch.zeros(len(part)), torch.zeros(len(part), 2).double())
        for part in metres.double().split(512)
    ]
    return torch.cat(parts).mean(1).flatten(1)


def likeness(signal, lags):
    """Autocorrelation at these lags."""
    signal = signal - F.avg_pool1d(signal[None, None], 301, 1, 150, count_include_pad=False)[0, 0]
    return torch.stack([torch.corrcoef(torch.stack([signal[lag:], signal[:-lag]]))[0, 1] for lag in lags])


@pytest.mark.parametrize(("kind", "period"), [(Outdoor, 0.6), (Underground, 0.75)])
def test_sleepers_repeat_with_their_period(kind, period):
    train, step = ride_of(kind), 0.025
    assert ("sleeper", period) in [(s.name, s.period) for s in train.structures]
    between = torch.tensor([62]), torch.tensor([64])  # the rails
    signal = brightness(train, 100 + step * torch.arange(1000), *between)[:, 0]
    alike = likeness(signal, range(8, 40))  # short of twice the period
    assert abs((8 + int(alike.argmax())) * step - period) <= step
    assert alike.max() > 0.3


@pytest.mark.parametrize("traverse", [0, 1])
@both
def test_the_ground_moves_as_the_train_does(kind, traverse):
    train, start, stop = ride_of(kind, traverse), 700, 750
    frames = frames_at(train, torch.arange(start, stop))
    shift, confidence = GroundOdometry(train.corners, (32, 32))(frames)
    metres = float(shift.sum()) * train.ground_span / 31
    assert metres == pytest.approx(float(train.distance[stop - 1] - train.distance[start]), rel=0.06)
    assert confidence.median() > 0.6


FRAMES = torch.tensor([0, 1000, 3000])
# seed 0: number of structures and sum of their starts; of traverses 0 and 1 the length, and mean colours of
# three frames
FROZEN = {
    Outdoor: (
        *(17, 14857.81, 4195),
        [[0.4598, 0.5018, 0.4562], [0.5577, 0.5868, 0.5819], [0.4890, 0.5203, 0.4655]],
        4443,
        [[0.4106, 0.4102, 0.3440], [0.4351, 0.4355, 0.3680], [0.4059, 0.4035, 0.3385]],
    ),
    Underground: (
        *(56, 104637.07, 5313),
        [[0.4048, 0.3911, 0.3690], [0.3429, 0.3320, 0.3167], [0.3777, 0.3635, 0.3432]],
        6158,
        [[0.2450, 0.2122, 0.1765], [0.2307, 0.1827, 0.1455], [0.2668, 0.2198, 0.1842]],
    ),
}


@both
def test_the_routes_stay_as_they_are(kind):
    """Results are measured on these very routes: a change here makes earlier and later figures incomparable.

    If it fails, undo what changed the frames. The numbers above change only where all results are redone.
    """
    count, starts, *rides = FROZEN[kind]
    structures = ride_of(kind).structures
    assert len(structures) == count
    assert sum(structure.start for structure in structures) == pytest.approx(starts, abs=0.01)
    for traverse in (0, 1):
        length, colour = rides[2 * traverse : 2 * traverse + 2]
        train = ride_of(kind, traverse)
        assert len(train) == length
        seen = train._frames(FRAMES).mean((2, 3))
        assert torch.allclose(seen, torch.tensor(colour), rtol=0, atol=1e-3)


@given(
    gap=st.floats(0.5, 40),
    length=st.floats(0.05, 3),
    depth=st.floats(0, 0.5),
    slope=st.floats(1, 20),
    half=st.floats(0.05, 5),
    count=st.integers(1, 6),
)
@settings(max_examples=60, deadline=None)
def test_cover_is_the_hidden_part_of_an_interval(gap, length, depth, slope, half, count):
    at = 10 + gap * torch.arange(count).double()
    thing = Thing("any", 0, 1, "ffffff", at, length, depth)
    s = torch.linspace(0, 60, 25)
    seen = thing.cover(s, torch.full_like(s, half), torch.full_like(s, slope))
    fine = (s[:, None] + half * torch.linspace(-1, 1, 4001)).numpy()
    behind = fine[..., None] - at.numpy()
    extent = min(length + depth * slope, gap if count > 1 else np.inf)
    hidden = ((behind >= 0) & (behind <= extent)).any(-1).mean(-1)
    assert np.abs(seen.numpy() - hidden).max() < 0.01


def has(given, *expected):
    """What the simulator itself refuses, with what it says."""
    return given, [f"has {given}; expected", *expected]


@both
@pytest.mark.parametrize(
    ("query", "words"),
    [
        has("seed=-1", "seed >= 0, a whole number"),
        has("traverse=10", "0 <= traverse <= 9, a whole number"),
        has("width=1025", "16 <= width <= 1024"),
        has("speed=nan", "<= speed <="),
        has("shake=inf", "<= shake <="),
        ("height=16&width=1024", ["has height=16 and width=1024", "a width of 0.5 to 4 times the height"]),
        ("speed=fast", ["speed is 'fast'", "expected float"]),
        ("colour=red", ["unknown 'colour'", "seed, traverse, frames, height, width, speed, noise, shake"]),
    ],
)
def test_an_impossible_address_is_refused(kind, query, words):
    with refused(f"sim:{kind.kind}", *words):
        open_source(f"sim:{kind.kind}?{query}")


@both
def test_more_frames_than_the_route_are_refused_with_their_number(kind):
    address, length = f"sim:{kind.kind}?traverse=1", ride_of(kind, 1).length
    assert len(open_source(f"{address}&frames={length}")) == length
    with refused(f"has frames={length + 1}; expected at most the {length} of its route"):
        open_source(f"{address}&frames={length + 1}")


def test_what_is_no_whole_number_is_refused():
    for value in (40.5, float("nan"), "40", None):
        with refused(f"sim:outdoor has frames={value}; expected", "a whole number"):
            Outdoor(frames=value)  # type: ignore[arg-type]
    with refused("0 frames", "at least 1"):
        next(Outdoor(frames=3).batches(0))


def test_a_new_route_is_one_subclass():
    @dataclass(eq=False)
    class Corridor(SimulatedRoute):
        seed: int = option(0, 0)
        traverse: int = option(0, 0)
        frames: int = option(8, 1)
        grey: float = option(0.5, 0, 1)
        kind = "corridor"

        def __post_init__(self):
            super().__post_init__()
            self.length, self.places = self.frames, torch.arange(self.frames).double()

        def _frames(self, at):
            return torch.full((len(at), 3, 2, 2), self.grey)

    route = Corridor(frames=5, grey=1)
    assert route.name == "sim:corridor?seed=0&traverse=0&frames=5&grey=1.0"
    assert [len(part) for part in route.batches(2)] == [2, 2, 1]
    with refused("sim:corridor has grey=2", "0 <= grey <= 1"):
        Corridor(grey=2)
    assert list(SIMULATORS) == ["aerial", "outdoor", "underground"]
