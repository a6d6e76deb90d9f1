"""The painted road: what repeats, what does not, and what two flights share."""

from __future__ import annotations

import math
import random

import pytest
import torch
import torch.nn.functional as F
from helpers import all_of, refused

from dejavu_torch.data.simulate.aerial import (
    CHEVRON_PERIOD,
    DASH_PERIOD,
    HEIGHT,
    TILES,
    VIEW,
    AerialRoad,
    road_markings,
)

FRAMES = 600


def looks(frames):
    """Grey frames at a quarter of the size, each with mean 0 and norm 1, (N,D)."""
    grey = F.avg_pool2d(frames.mean(1, keepdim=True), 4).flatten(1)
    return F.normalize(grey - grey.mean(1, keepdim=True), dim=1)


@pytest.fixture(scope="module")
def flights():
    first, second = (AerialRoad(seed=3, traverse=t, frames=FRAMES) for t in (0, 1))
    return all_of(first), all_of(second)


def test_frames_depend_on_the_arguments_alone():
    before = torch.get_rng_state(), random.getstate()
    road = AerialRoad(seed=5, traverse=1, frames=70)
    whole = all_of(road, 70)
    assert whole.shape == (70, 3, 64, 64)
    for batch in (7, 64):
        assert torch.equal(all_of(AerialRoad(seed=5, traverse=1, frames=70), batch), whole)
    assert torch.equal(road[60:80], whole[60:])
    for other in (AerialRoad(seed=2, traverse=1, frames=70), AerialRoad(seed=5, traverse=2, frames=70)):
        assert not torch.allclose(all_of(other), whole, atol=0.1)
    assert torch.equal(torch.get_rng_state(), before[0])
    assert random.getstate() == before[1]


@pytest.mark.parametrize("scale", [1, 2])
def test_markings_repeat_exactly_and_no_sooner(scale):
    for mask, period in zip(road_markings(800, scale), (DASH_PERIOD, CHEVRON_PERIOD), strict=True):
        assert mask.shape == (HEIGHT * scale, 800 * scale)
        assert mask.max() == 1
        assert mask.min() == 0
        same = [lag for lag in range(1, 400) if torch.equal(mask[:, lag * scale :], mask[:, : -lag * scale])]
        assert same == list(range(period, 400, period))
    assert (DASH_PERIOD, CHEVRON_PERIOD) == (93, 171)


def test_two_flights_see_the_same_route(flights):
    first, second = (looks(frames) for frames in flights)
    same = (first * second).sum(1)
    shuffled = (first * second.roll(FRAMES // 3, 0)).sum(1)
    assert same.mean() > shuffled.mean() + 0.3
    found = (second @ first.T).argmax(1)
    assert ((found - torch.arange(FRAMES)).abs() <= 3).float().mean() > 0.6


@pytest.fixture(scope="module")
def repeating():
    """As it is drawn without what differs from flight to flight; the light that is left is a factor."""
    return AerialRoad(ground="repeat", frames=math.lcm(*TILES), noise=0, drift=0, yaw=0)


@pytest.mark.parametrize("start", [0, 700, 990])  # the last one sees where a tile begins anew
def test_each_half_of_repeating_ground_comes_again_after_its_tile(repeating, start):
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


def test_repeating_ground_has_more_frames_than_ground_that_does_not():
    road = AerialRoad(ground="repeat", frames=math.lcm(*TILES), traverse=1)
    assert road.name == f"sim:aerial?seed=0&traverse=1&frames={math.lcm(*TILES)}&ground=repeat"
    assert road.read(range(len(road) - 1, len(road))).shape == (1, 3, VIEW, VIEW)
    with refused(f"frames={math.lcm(*TILES)}", "frames <= 131072", "ground=repeat"):
        AerialRoad(frames=math.lcm(*TILES))
    with refused("frames=", f"1 <= frames <= {math.lcm(*TILES)}"):
        AerialRoad(ground="repeat", frames=math.lcm(*TILES) + 1)
