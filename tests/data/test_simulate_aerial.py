"""The painted road: what repeats, what does not, and what two flights share."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from helpers import all_of, refused
from torch import Tensor

from dejavu_torch.data.simulate.aerial import (
    CHEVRON_PERIOD,
    DASH_PERIOD,
    HEIGHT,
    MARGIN,
    TILES,
    VIEW,
    AerialRoad,
    paint_route,
    road_markings,
)

FRAMES = 600


def looks(frames: Tensor) -> Tensor:
    """Grey frames at a quarter of the size, each with mean 0 and norm 1, (N,D)."""
    grey = F.avg_pool2d(frames.mean(1, keepdim=True), 4).flatten(1)
    return F.normalize(grey - grey.mean(1, keepdim=True), dim=1)


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Many small operations: on a busy machine two threads mostly wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def flights() -> tuple[Tensor, Tensor]:
    first, second = (AerialRoad(seed=3, traverse=t, frames=FRAMES) for t in (0, 1))
    return all_of(first), all_of(second)


def test_a_road_describes_itself() -> None:
    road = AerialRoad(seed=2, traverse=1, frames=50)
    assert road.name == "sim:aerial?seed=2&traverse=1&frames=50"
    assert AerialRoad(frames=5, size=32).name == "sim:aerial?seed=0&traverse=0&frames=5&size=32"
    assert road.length == 50
    assert torch.equal(road.place, torch.arange(50, dtype=torch.float64))


def test_frames_have_the_promised_shape_and_range(flights: tuple[Tensor, Tensor]) -> None:
    for frames in flights:
        assert frames.shape == (FRAMES, 3, 64, 64)
        assert frames.dtype == torch.float32
        assert frames.min() >= 0
        assert frames.max() <= 1
        assert frames.std() > 0.1


@pytest.mark.parametrize("traverse", [0, 1])
def test_frames_do_not_depend_on_the_batch_size(traverse: int) -> None:
    road = AerialRoad(seed=5, traverse=traverse, frames=70)
    whole = all_of(road, 70)
    for batch in (1, 7, 64, 1000):
        parts = list(road.batches(batch))
        assert {len(part) for part in parts[:-1]} <= {batch}
        assert torch.equal(torch.cat(parts), whole)
    assert torch.equal(torch.cat(list(road.between(60, 80))), whole[60:])
    assert list(road.between(60, 60)) == []


def test_the_same_arguments_give_the_same_frames_and_others_do_not() -> None:
    first = all_of(AerialRoad(seed=1, traverse=1, frames=30))
    assert torch.equal(all_of(AerialRoad(seed=1, traverse=1, frames=30)), first)
    assert not torch.allclose(all_of(AerialRoad(seed=2, traverse=1, frames=30)), first, atol=0.1)
    assert not torch.allclose(all_of(AerialRoad(seed=1, traverse=2, frames=30)), first, atol=0.1)


def test_the_route_is_painted_from_the_seed_alone() -> None:
    image = paint_route(100, seed=4)
    assert image.shape == (3, HEIGHT, 100 + VIEW + 2 * MARGIN)
    assert image.min() >= 0
    assert image.max() <= 1
    assert torch.equal(paint_route(100, seed=4), image)
    assert not torch.allclose(paint_route(100, seed=5), image, atol=0.1)


@pytest.mark.parametrize("scale", [1, 2])
def test_markings_repeat_exactly_and_no_sooner(scale: int) -> None:
    for mask, period in zip(road_markings(800, scale), (DASH_PERIOD, CHEVRON_PERIOD), strict=True):
        assert mask.shape == (HEIGHT * scale, 800 * scale)
        assert mask.max() == 1
        assert mask.min() == 0
        same = [lag for lag in range(1, 400) if torch.equal(mask[:, lag * scale :], mask[:, : -lag * scale])]
        assert same == list(range(period, 400, period))
    assert (DASH_PERIOD, CHEVRON_PERIOD) == (93, 171)


def test_markings_stand_out_in_the_painted_image() -> None:
    image = paint_route(FRAMES, seed=6).mean(0)
    for mask in road_markings(image.shape[1]):
        rows = mask.amax(1) == 1
        marked, bare = (image[rows][here[rows]] for here in (mask == 1, mask == 0))
        assert marked.mean() > bare.mean() + 0.3


def test_the_camera_moves_one_column_per_frame() -> None:
    frames = all_of(AerialRoad(frames=40, noise=0, drift=0, yaw=0))
    assert torch.allclose(frames[1:, :, :, :-1], frames[:-1, :, :, 1:], atol=0.02)


@pytest.mark.parametrize(("period", "rows"), [(DASH_PERIOD, slice(22, 27)), (CHEVRON_PERIOD, slice(27, 35))])
def test_the_frames_show_both_periods(period: int, rows: slice, flights: tuple[Tensor, Tensor]) -> None:
    for frames in flights:
        lane = frames.mean(1)[:, rows].mean(1)
        lane = F.normalize(lane - lane.mean(1, keepdim=True), dim=1)
        lags = range(period - 40, period + 41)
        likeness = torch.stack([(lane[lag:] * lane[:-lag]).sum(1).median() for lag in lags])
        assert abs(lags[int(likeness.argmax())] - period) <= 1


def test_two_flights_see_the_same_route(flights: tuple[Tensor, Tensor]) -> None:
    first, second = (looks(frames) for frames in flights)
    same = (first * second).sum(1)
    shuffled = (first * second.roll(FRAMES // 3, 0)).sum(1)
    assert same.mean() > shuffled.mean() + 0.3
    found = (second @ first.T).argmax(1)
    assert ((found - torch.arange(FRAMES)).abs() <= 3).float().mean() > 0.6


def test_two_flights_have_light_and_vehicles_of_their_own(flights: tuple[Tensor, Tensor]) -> None:
    first, second = flights
    assert (first.mean((2, 3)) - second.mean((2, 3))).abs().mean() > 0.03
    still = [all_of(AerialRoad(seed=3, traverse=t, frames=FRAMES, noise=0, drift=0, yaw=0)) for t in (0, 1)]
    grey = [looks(frames).view(FRAMES, 16, 16)[:, 3:9] for frames in still]  # the road, whatever the light
    assert ((grey[0] - grey[1]).abs().amax((1, 2)) > 0.1).float().mean() > 0.2


def test_noise_has_the_promised_strength_and_differs_in_every_frame() -> None:
    noise = []
    for traverse in (0, 1):
        loud, quiet = (all_of(AerialRoad(traverse=traverse, frames=40, noise=n)) for n in (0.02, 0))
        noise.append(loud - quiet)
        assert noise[-1].std() == pytest.approx(0.02, rel=0.05)
    flat = F.normalize(torch.cat(noise).flatten(1), dim=1)
    assert (flat @ flat.T - torch.eye(80)).abs().max() < 0.1


def test_a_smaller_frame_shows_the_same_view() -> None:
    quiet = [all_of(AerialRoad(frames=10, size=size, noise=0)) for size in (64, 32, 128)]
    assert quiet[1].shape == (10, 3, 32, 32)
    assert quiet[2].shape == (10, 3, 128, 128)
    assert torch.allclose(F.avg_pool2d(quiet[0], 2), quiet[1], atol=0.02)
    assert (F.avg_pool2d(quiet[2], 2) - quiet[0]).abs().mean() < 0.02


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"frames": 0}, f"1 <= frames <= {math.lcm(*TILES)}, a whole number"),
        ({"frames": 40.5}, "a whole number"),
        ({"seed": -1}, "seed >= 0"),
        ({"size": 8}, "16 <= size <= 256"),
        ({"noise": -0.1}, "0 <= noise <= 1"),
        ({"noise": float("nan")}, "0 <= noise <= 1"),
        ({"drift": 20.0}, "0 <= drift <= 8"),
        ({"yaw": -2.0}, "0 <= yaw <= 5"),
        ({"ground": "sand"}, "once or repeat"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(arguments: dict[str, Any], expected: str) -> None:
    ((key, value),) = arguments.items()
    with refused(f"{key}={value}; expected", expected):
        AerialRoad(**arguments)


@pytest.fixture(scope="module")
def repeating() -> AerialRoad:
    """As it is drawn without what differs from flight to flight; the light that is left is a factor."""
    return AerialRoad(ground="repeat", frames=math.lcm(*TILES), noise=0, drift=0, yaw=0)


@pytest.mark.parametrize("start", [0, 700, 990])  # the last one sees where a tile begins anew
def test_each_half_of_repeating_ground_comes_again_after_its_tile(repeating: AerialRoad, start: int) -> None:
    upper, lower = slice(0, VIEW // 2), slice(VIEW // 2, VIEW)
    cycles = torch.tensor([0, 1, 7, 900])
    for period, same, other in zip(TILES, (upper, lower), (lower, upper), strict=True):
        first, *later = (
            repeating._frames(start + cycles * period)
            / repeating._gain[start + cycles * period, :, None, None]
        )
        for frame in later:
            assert torch.allclose(frame[:, same], first[:, same], atol=0.02)
            assert (frame[:, other] - first[:, other]).abs().max() > 0.2


def test_a_window_of_repeating_ground_slides_by_one_column_a_frame(repeating: AerialRoad) -> None:
    frames = repeating._frames(torch.arange(1000, 1004))
    assert torch.allclose(frames[3][..., :-3], frames[0][..., 3:], atol=0.02)


def test_the_road_between_the_tiles_is_the_same_everywhere(repeating: AerialRoad) -> None:
    band = repeating._frames(torch.arange(0, 10**6, 99_999))[..., 24:40, :]
    assert (band - band[..., :1]).abs().max() < 1e-4
    assert (band - band[:1]).abs().max() < 0.1  # the light


def test_repeating_ground_has_more_frames_than_ground_that_does_not() -> None:
    road = AerialRoad(ground="repeat", frames=math.lcm(*TILES), traverse=1)
    assert road.name == f"sim:aerial?seed=0&traverse=1&frames={math.lcm(*TILES)}&ground=repeat"
    assert road.read(range(road.length - 1, road.length)).shape == (1, 3, VIEW, VIEW)
    with refused(f"frames={math.lcm(*TILES)}", "frames <= 131072", "ground=repeat"):
        AerialRoad(frames=math.lcm(*TILES))
    with refused("frames=", f"1 <= frames <= {math.lcm(*TILES)}"):
        AerialRoad(ground="repeat", frames=math.lcm(*TILES) + 1)


def test_global_random_states_are_left_alone() -> None:
    before = torch.get_rng_state(), random.getstate()
    all_of(AerialRoad(frames=10, traverse=1))
    assert torch.equal(torch.get_rng_state(), before[0])
    assert random.getstate() == before[1]
