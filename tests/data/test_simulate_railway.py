"""The railways: what repeats and where, how the train moves, and what two traverses share."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import all_of, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dejavu_torch.data.ground_truth import position_truth
from dejavu_torch.data.simulate import SIMULATORS
from dejavu_torch.data.simulate.outdoor import Outdoor
from dejavu_torch.data.simulate.route import SimulatedRoute, option
from dejavu_torch.data.simulate.scenery import STATION, Structure
from dejavu_torch.data.simulate.sheets import Painter, Thing, View
from dejavu_torch.data.simulate.train import FPS, Railway, reference_place, ride
from dejavu_torch.data.simulate.underground import Underground
from dejavu_torch.data.source import open_source
from dejavu_torch.motion.odometry import GroundOdometry

KINDS = [Outdoor, Underground]
both = pytest.mark.parametrize("kind", KINDS)


@cache
def ride_of(kind: type[Railway], traverse: int = 0) -> Railway:
    """A whole ride on the railway of seed 0, built once."""
    return kind(traverse=traverse)


def filmed(kind: type[Railway], traverse: int = 0, **camera: float) -> Railway:
    """The same ride with another camera, past scenery that is built already."""
    train = kind(traverse=traverse, **camera)  # type: ignore[arg-type]
    train.__dict__["_world"] = ride_of(kind, traverse)._world
    return train


@pytest.fixture(scope="module", autouse=True)
def forget() -> Iterator[None]:
    yield
    ride_of.cache_clear()


def frames_at(train: Railway, index: Tensor) -> Tensor:
    """These frames, read one at a time as a batch of one would."""
    return torch.cat([train._frames(part) for part in index.split(32)])


def at_metres(train: Railway, metres: Tensor) -> Tensor:
    """The first frame at or after each distance."""
    index = torch.searchsorted(train.distance, metres.double()).clamp(max=train.length - 1)
    return frames_at(train, index)


def outlines(frames: Tensor) -> Tensor:
    """Strength of the edges, blurred, each frame with mean 0 and norm 1, (N,D)."""
    grey = F.avg_pool2d(frames.mean(1, keepdim=True), 2)
    edges = (grey[..., 1:, 1:] - grey[..., :-1, 1:]).abs() + (grey[..., 1:, 1:] - grey[..., 1:, :-1]).abs()
    flat = F.avg_pool2d(edges / edges.mean((1, 2, 3), keepdim=True), 3, 2).flatten(1)
    return F.normalize(flat - flat.mean(1, keepdim=True), dim=1)


@both
def test_frames_have_the_promised_shape_and_range(kind: type[Railway]) -> None:
    for traverse in (0, 1):
        frames = at_metres(ride_of(kind, traverse), torch.linspace(0, 1900, 4))
        assert frames.shape == (4, 3, 64, 128)
        assert frames.dtype == torch.float32
        assert frames.min() >= 0
        assert frames.max() <= 1
        assert frames.std() > 0.05


@both
@pytest.mark.parametrize("traverse", [0, 1])
def test_frames_do_not_depend_on_the_batch_size(kind: type[Railway], traverse: int) -> None:
    start = filmed(kind, traverse, frames=4)
    assert torch.equal(all_of(start, 3), all_of(start, 4))
    train, moving = ride_of(kind, traverse), torch.arange(1000, 1003)
    parts = torch.cat([train._frames(part) for part in moving.split(2)])
    assert torch.equal(parts, train._frames(moving))


@both
def test_frames_depend_on_the_arguments_alone(kind: type[Railway]) -> None:
    route = 200.0 if kind is Outdoor else 2000.0  # less to paint, and room for the stations
    brief: type[Railway] = type("Brief", (kind,), {"route": route})
    first = all_of(brief(traverse=1, frames=4))
    torch.manual_seed(5)
    random.seed(5)
    before = torch.get_rng_state(), random.getstate()
    assert torch.equal(all_of(brief(traverse=1, frames=4)), first)
    assert torch.equal(torch.get_rng_state(), before[0])
    assert random.getstate() == before[1]
    assert not torch.allclose(all_of(brief(seed=2, traverse=1, frames=4)), first, atol=0.1)
    reference, other = (next(ride_of(kind, traverse).batches(2)) for traverse in (0, 1))
    assert not torch.allclose(other, reference, atol=0.1)


@both
def test_a_cut_route_is_the_beginning_of_the_whole(kind: type[Railway]) -> None:
    for traverse in (0, 1):
        for frames in (1, 33):
            whole, part = ride_of(kind, traverse), filmed(kind, traverse, frames=frames)
            assert part.length == frames
            assert torch.equal(part.distance, whole.distance[:frames])
            assert torch.equal(part.place, whole.place[:frames])
            assert torch.equal(next(part.batches(2)), next(whole.batches(min(frames, 2))))


@both
def test_the_whole_route_has_a_workable_number_of_frames(kind: type[Railway]) -> None:
    for seed in range(3):
        for traverse in (0, 1):
            train = kind(seed=seed, traverse=traverse)
            assert 3000 < train.length < 8000
            assert train.distance[0] == 0
            assert 0 <= train.route - train.distance[-1] < 1


@both
def test_the_train_obeys_its_limits_and_stands_at_its_stops(kind: type[Railway]) -> None:
    for traverse in (0, 1):
        step = kind(seed=4, traverse=traverse).distance.diff()
        assert step.min() >= 0
        speed = step * FPS
        assert speed.max() < 40
        still = (step == 0).float()
        assert 2.0 * FPS < still.sum() < 12 * FPS
        assert (still.diff() == 1).sum() == 1 + traverse  # stops
        top = speed.max()
        assert ((speed - top).abs() < 1e-6).float().mean() > 0.15  # cruising
        assert ((speed > 0.4 * top) & (speed < 0.75 * top)).float().mean() > 0.03  # slow sections


def test_a_ride_keeps_to_its_plan() -> None:
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
def test_a_reference_place_by_hand(steps: list[float], queries: list[int]) -> None:
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
def test_a_place_is_the_reference_frame_at_the_same_distance(kind: type[Railway]) -> None:
    reference, other = ride_of(kind), ride_of(kind, 1)
    assert torch.equal(reference.place, torch.arange(reference.length).double())
    low = reference.distance[other.place.floor().long()]
    high = reference.distance[other.place.ceil().long()]
    assert (low <= other.distance + 1e-9).all()
    within = other.distance <= reference.distance[-1]  # the route ends within the last frame's step
    assert (other.distance <= high + 1e-9)[within].all()
    assert (other.place[~within] == reference.length - 1).all()
    found = position_truth(reference.place, other.place)[:, 0]
    assert (found >= 0).all()
    assert (reference.distance[found] - other.distance).abs().max() < reference.distance.diff().max()
    assert abs(reference.length - other.length) > 20


@both
def test_a_standing_train_sees_one_picture(kind: type[Railway]) -> None:
    train = filmed(kind, noise=0.0, shake=0.0)
    step = train.distance.diff()
    first = int((step == 0).nonzero()[5])
    stand, drive = (frames_at(train, torch.arange(n, n + 4)) for n in (first, first + 200))
    assert stand.diff(dim=0).abs().max() < 0.02  # the light drifts slowly
    assert drive.diff(dim=0).abs().max() > 0.1


def brightness(train: Railway, metres: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
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


def likeness(signal: Tensor, lags: range) -> Tensor:
    """Autocorrelation at these lags."""
    signal = signal - F.avg_pool1d(signal[None, None], 301, 1, 150, count_include_pad=False)[0, 0]
    return torch.stack([torch.corrcoef(torch.stack([signal[lag:], signal[:-lag]]))[0, 1] for lag in lags])


@pytest.mark.parametrize(("kind", "period"), [(Outdoor, 0.6), (Underground, 0.75)])
def test_sleepers_repeat_with_their_period(kind: type[Railway], period: float) -> None:
    train, step = ride_of(kind), 0.025
    assert ("sleeper", period) in [(s.name, s.period) for s in train.structures]
    between = torch.tensor([62]), torch.tensor([64])  # the rails
    signal = brightness(train, 100 + step * torch.arange(1000), *between)[:, 0]
    alike = likeness(signal, range(8, 40))  # short of twice the period
    assert abs((8 + int(alike.argmax())) * step - period) <= step
    assert alike.max() > 0.3


def test_lamps_repeat_with_their_period() -> None:
    train, step = ride_of(Underground), 0.25
    lamps = max((s for s in train.structures if s.name == "lamp"), key=lambda s: s.stop - s.start)
    assert lamps.stop - lamps.start > 200
    metres = lamps.start + step * torch.arange(int((lamps.stop - lamps.start - 30) / step))
    bright = brightness(train, metres, torch.arange(0, 12, 2), torch.arange(32, 96, 4)).amax(1)
    alike = likeness(bright, range(28, 90))
    assert abs((28 + int(alike.argmax())) * step - lamps.period) <= step


@both
def test_structures_start_and_stop_where_they_say(kind: type[Railway]) -> None:
    name, sheet = {Outdoor: ("fence post", "fence"), Underground: ("rib", "ceiling")}[kind]
    train = ride_of(kind)
    stretches = [s for s in train.structures if s.name == name]
    assert len({s.period for s in stretches}) > 1
    things = [t for t in train._world.sheets[sheet].things if t.length in (0.12, 0.35)]
    s = torch.arange(0, train.route, 0.05)
    half, slope = torch.full_like(s, 0.01), torch.zeros_like(s)
    seen = torch.stack([thing.cover(s, half, slope) for thing in things]).amax(0) > 0.5
    starts = s[1:][seen[1:] & ~seen[:-1]]
    expected = torch.cat([stretch.at for stretch in stretches])
    expected = expected[(expected > 0.1) & (expected < train.route - 0.1)].sort().values
    assert len(expected) > 30
    assert len(starts) == len(expected)
    assert (starts - expected).abs().max() < 0.1
    for stretch in stretches:
        assert stretch.at[0] == stretch.start
        assert stretch.stop - stretch.period - 1e-6 <= stretch.at[-1] < stretch.stop


@both
def test_stretches_do_not_fall_on_a_grid_of_1024_frames(kind: type[Railway]) -> None:
    train = ride_of(kind)
    edges = torch.tensor([s.start for s in train.structures if 10 < s.start < train.route])
    frames = torch.searchsorted(train.distance, edges.double())
    off = (frames.double() / 1024 - (frames.double() / 1024).round()).abs() * 1024
    assert len(edges) > 8
    assert (off > 30).float().mean() > 0.8


def test_stations_are_bright_and_their_structures_stay_within() -> None:
    train = ride_of(Underground)
    starts = torch.tensor(train._world.stations, dtype=torch.float64)
    light = at_metres(train, torch.cat([starts + 60, starts - 60])).mean((1, 2, 3))
    station, tunnel = light.chunk(2)  # stains and ribs make a tunnel darker here and there
    assert station.min() > tunnel.max()
    assert station.mean() > 1.25 * tunnel.mean()
    for structure in train.structures:
        inside = (structure.start >= starts) & (structure.stop <= starts + STATION + 0.01)
        if structure.name in ("station light", "column"):
            assert inside.any(), structure
        elif structure.name != "sleeper":
            apart = (structure.stop <= starts) | (structure.start >= starts + STATION - 0.01)
            assert apart.all(), structure


@both
def test_two_traverses_see_the_same_place_in_another_light(kind: type[Railway]) -> None:
    metres = torch.linspace(60, 1900, 14)
    first, second = (at_metres(ride_of(kind, t), metres) for t in (0, 1))
    assert (first.mean((2, 3)) - second.mean((2, 3))).abs().mean() > 0.03
    alike = outlines(first) @ outlines(second).T
    same = alike.diag()
    others = (alike.sum(1) - same) / (len(metres) - 1)
    assert (same > others).float().mean() > 0.9
    assert same.mean() > others.mean() + 0.1


@both
def test_visitors_are_met_by_one_traverse_only(kind: type[Railway]) -> None:
    worlds = [ride_of(kind, t)._world.sheets["people"].things for t in (0, 1)]
    ends = [[(thing.first, thing.last) for thing in things] for things in worlds]
    shared = [pair for pair in ends[0] if pair in ends[1]]
    assert 0 < len(shared) < len(ends[0])


@both
def test_noise_and_shake_do_as_they_say(kind: type[Railway]) -> None:
    quiet = all_of(filmed(kind, 1, frames=4, noise=0.0))
    loud = next(ride_of(kind, 1).batches(4))
    middle = (quiet > 0.2) & (quiet < 0.8)
    assert (loud - quiet)[middle].std() == pytest.approx(0.02, rel=0.05)
    steady = all_of(filmed(kind, 1, frames=4, noise=0.0, shake=0.0))
    assert (quiet - steady).abs().max() > 0.05


@both
@pytest.mark.parametrize(
    ("height", "width"), [(64, 128), (120, 160), (32, 16), (16, 64), (512, 256), (512, 1024)]
)
def test_the_ground_is_a_strip_beside_the_sleepers(kind: type[Railway], height: int, width: int) -> None:
    train, focal = kind(height=height, width=width), 0.55 * width
    met = []
    for x, y in train.corners:
        assert 0 <= x <= 1
        assert 0 <= y <= 1
        across, down = x * (width - 1) + 0.5 - width / 2, y * (height - 1) + 0.5 - 0.38 * height
        ahead = 2.6 * focal / down
        met.append((across * ahead / focal, ahead))
    near = met[2][1]
    assert 1.7 < near < 10.5
    assert train.ground_span == pytest.approx(12 - near)
    for corner, expected in zip(met, [(1.4, 12), (2.4, 12), (2.4, near), (1.4, near)], strict=True):
        assert corner == pytest.approx(expected)


@pytest.mark.parametrize("traverse", [0, 1])
@both
def test_the_ground_moves_as_the_train_does(kind: type[Railway], traverse: int) -> None:
    train, start, stop = ride_of(kind, traverse), 700, 750
    frames = frames_at(train, torch.arange(start, stop))
    shift, confidence = GroundOdometry(train.corners, (32, 32))(frames)
    metres = float(shift.sum()) * train.ground_span / 31
    assert metres == pytest.approx(float(train.distance[stop - 1] - train.distance[start]), rel=0.06)
    assert confidence.median() > 0.6


FRAMES = torch.tensor([0, 1000, 3000])
# seed 0: how many stretches of each structure, the sum of their starts; of traverses 0 and 1 the length, and
# the mean colour and the vertical detail of three frames
FROZEN = {
    Outdoor: (
        {"cable lid": 4, "fence post": 5, "mast": 4, "platform lamp": 3, "sleeper": 1},
        14857.81,
        4195,
        [[0.4598, 0.5018, 0.4562], [0.5577, 0.5868, 0.5819], [0.4890, 0.5203, 0.4655]],
        [0.04945, 0.04904, 0.03853],
        4443,
        [[0.4106, 0.4102, 0.3440], [0.4351, 0.4355, 0.3680], [0.4059, 0.4035, 0.3385]],
        [0.02545, 0.03158, 0.02589],
    ),
    Underground: (
        {
            "bracket": 10,
            "column": 4,
            "lamp": 8,
            "niche": 8,
            "panel": 10,
            "rib": 11,
            "sleeper": 1,
            "station light": 4,
        },
        104637.07,
        5313,
        [[0.4048, 0.3911, 0.3690], [0.3429, 0.3320, 0.3167], [0.3777, 0.3635, 0.3432]],
        [0.02837, 0.02192, 0.02638],
        6158,
        [[0.2450, 0.2122, 0.1765], [0.2307, 0.1827, 0.1455], [0.2668, 0.2198, 0.1842]],
        [0.01279, 0.01072, 0.01722],
    ),
}


@both
def test_the_routes_stay_as_they_are(kind: type[Railway]) -> None:
    """Results are measured on these very routes: a change here makes earlier and later figures incomparable.

    If it fails, undo what changed the frames. The numbers above change only where all results are redone.
    """
    count, starts, *rides = FROZEN[kind]
    structures = ride_of(kind).structures
    assert Counter(structure.name for structure in structures) == count
    assert sum(structure.start for structure in structures) == pytest.approx(starts, abs=0.01)
    for traverse in (0, 1):
        length, colour, detail = rides[3 * traverse : 3 * traverse + 3]
        train = ride_of(kind, traverse)
        assert train.length == length
        seen = train._frames(FRAMES).mean((2, 3))
        assert torch.allclose(seen, torch.tensor(colour), rtol=0, atol=1e-3)
        clean = filmed(kind, traverse, noise=0.0)._frames(FRAMES)
        steps = clean.diff(dim=2).abs().mean((1, 2, 3))
        assert torch.allclose(steps, torch.tensor(detail), rtol=0, atol=5e-5)


@given(
    gap=st.floats(0.5, 40),
    length=st.floats(0.05, 3),
    depth=st.floats(0, 0.5),
    slope=st.floats(1, 20),
    half=st.floats(0.05, 5),
    count=st.integers(1, 6),
)
@settings(max_examples=60, deadline=None)
def test_cover_is_the_hidden_part_of_an_interval(
    gap: float, length: float, depth: float, slope: float, half: float, count: int
) -> None:
    at = 10 + gap * torch.arange(count).double()
    thing = Thing("any", 0, 1, "ffffff", at, length, depth)
    s = torch.linspace(0, 60, 25)
    seen = thing.cover(s, torch.full_like(s, half), torch.full_like(s, slope))
    fine = (s[:, None] + half * torch.linspace(-1, 1, 4001)).numpy()
    behind = fine[..., None] - at.numpy()
    extent = min(length + depth * slope, gap if count > 1 else np.inf)
    hidden = ((behind >= 0) & (behind <= extent)).any(-1).mean(-1)
    assert np.abs(seen.numpy() - hidden).max() < 0.01


def test_a_structure_stands_from_its_start_and_short_of_its_stop() -> None:
    assert Structure("post", 2.5, 1.0, 8.5).at.tolist() == [1.0, 3.5, 6.0]
    assert Structure("post", 2.5, 1.0, 8.6).at.tolist() == [1.0, 3.5, 6.0, 8.5]
    assert Structure("post", 2.5, 1.0, 1.1).at.tolist() == [1.0]


def test_railways_open_by_name() -> None:
    train = open_source("sim:underground?seed=2&frames=7&height=32&width=40&speed=20")
    assert isinstance(train, Underground)
    assert train.name == "sim:underground?seed=2&traverse=0&frames=7&height=32&width=40&speed=20.0"
    assert repr(train) == repr(Underground(2, 0, 7, 32, 40, 20.0))
    assert repr(open_source(train.name)) == repr(train)
    assert Outdoor().name == "sim:outdoor?seed=0&traverse=0"
    assert open_source("sim:outdoor?frames=0").length == Outdoor().length
    assert open_source(f"sim:outdoor?seed={10**25}").length in range(3000, 8000)


def has(given: str, *expected: str) -> tuple[str, list[str]]:
    """What the simulator itself refuses, with what it says."""
    return given, [f"has {given}; expected", *expected]


@both
@pytest.mark.parametrize(
    ("query", "words"),
    [
        has("seed=-1", "seed >= 0, a whole number"),
        has("traverse=10", "0 <= traverse <= 9, a whole number"),
        has("height=15", "16 <= height <= 512, a whole number"),
        has("width=1025", "16 <= width <= 1024"),
        has("speed=4.9", "5 <= speed <= 40"),
        has("noise=1.1", "0 <= noise <= 1"),
        has("shake=3.1", "0 <= shake <= 3"),
        has("speed=nan", "<= speed <="),
        has("shake=inf", "<= shake <="),
        ("height=16&width=1024", ["has height=16 and width=1024", "a width of 0.5 to 4 times the height"]),
        ("height=257", ["has height=257 and width=128", "expected a width of 0.5 to 4"]),
        ("frames=1.5", ["frames is '1.5'", "expected int"]),
        ("seed", ["seed is ''", "expected int"]),
        ("speed=fast", ["speed is 'fast'", "expected float"]),
        ("colour=red", ["unknown 'colour'", "seed, traverse, frames, height, width, speed, noise, shake"]),
    ],
)
def test_an_impossible_address_is_refused(kind: type[Railway], query: str, words: list[str]) -> None:
    with refused(f"sim:{kind.kind}", *words):
        open_source(f"sim:{kind.kind}?{query}")


@both
@pytest.mark.parametrize("traverse", [0, 1])
def test_more_frames_than_the_route_are_refused_with_their_number(kind: type[Railway], traverse: int) -> None:
    address, length = f"sim:{kind.kind}?traverse={traverse}", ride_of(kind, traverse).length
    assert open_source(f"{address}&frames={length}").length == length
    with refused(f"has frames={length + 1}; expected at most the {length} of its route"):
        open_source(f"{address}&frames={length + 1}")


@both
@pytest.mark.parametrize("key", ["seed", "traverse", "frames", "height", "width"])
@pytest.mark.parametrize("value", [40.5, float("nan"), float("inf"), "40", None])
def test_what_is_no_whole_number_is_refused(kind: type[Railway], key: str, value: float) -> None:
    with refused(f"sim:{kind.kind} has {key}={value}; expected", "a whole number"):
        kind(**{key: value})  # type: ignore[arg-type]


def test_an_empty_batch_is_refused() -> None:
    with refused("0 frames", "at least 1"):
        next(Outdoor(frames=3).batches(0))


@both
def test_a_ride_can_begin_anywhere(kind: type[Railway]) -> None:
    train = ride_of(kind)
    assert torch.equal(torch.cat(list(train.between(700, 703))), frames_at(train, torch.arange(700, 703)))
    assert len(torch.cat(list(train.between(train.length - 2, train.length + 9)))) == 2
    assert list(train.between(700, 700)) == []


def test_a_new_route_is_one_subclass() -> None:
    @dataclass(eq=False)
    class Corridor(SimulatedRoute):
        seed: int = option(0, 0)
        traverse: int = option(0, 0)
        frames: int = option(8, 1)
        grey: float = option(0.5, 0, 1)
        kind = "corridor"

        def __post_init__(self) -> None:
            super().__post_init__()
            self.length, self.place = self.frames, torch.arange(self.frames).double()

        def _frames(self, at: Tensor) -> Tensor:
            return torch.full((len(at), 3, 2, 2), self.grey)

    route = Corridor(frames=5, grey=1)
    assert route.name == "sim:corridor?seed=0&traverse=0&frames=5&grey=1.0"
    assert [len(part) for part in route.batches(2)] == [2, 2, 1]
    with refused("sim:corridor has grey=2", "0 <= grey <= 1"):
        Corridor(grey=2)
    assert list(SIMULATORS) == ["aerial", "outdoor", "underground"]
