"""Steady speeds: which a drive keeps, and what they find that a random walk does not."""

from __future__ import annotations

from fractions import Fraction

import pytest
import torch
from helpers import refused
from test_smoother import noise, shown

from dejavu_torch import PlaceFilter, PlaceSmoother
from dejavu_torch.recognition.speeds import FREE, steady


def at_speed(speed, queries):
    return [int(Fraction(speed) * t) for t in range(queries)]


@pytest.mark.parametrize("speed", ["1/3", "1/2", "1", "3/2", "2", "3"])
def test_a_drive_keeps_its_speed(speed):
    path = at_speed(speed, 120)
    smoother = PlaceSmoother().fit(shown(400, path, clear=3.0), noise(120, 16))
    assert smoother.is_drive
    assert smoother.steady.speeds == (Fraction(speed),)
    assert smoother.settled()["speeds"] == [float(Fraction(speed))]


def test_a_drive_of_two_speeds_keeps_both():
    path = at_speed(1, 100)
    path += [path[-1] + 3 * t for t in range(1, 60)]
    smoother = PlaceSmoother().fit(shown(400, path, clear=3.0), noise(159, 16))
    assert smoother.steady.speeds == (Fraction(1), Fraction(3))


def test_what_is_no_drive_has_no_speed():
    scores = noise(100, 300)
    smoother = PlaceSmoother().fit(scores, noise(100, 16, seed=1))
    assert not smoother.is_drive
    assert smoother.steady is FREE
    assert smoother.fit(shown(300, at_speed(1, 90)), noise(90, 16)).forgetful().steady is FREE


@torch.no_grad()
def test_a_steady_speed_finds_what_a_random_walk_loses():
    """Scores that say little: a path of one speed through them stands out of those of any moves."""
    path = at_speed("1/2", 200)
    scores, right = shown(300, path, clear=1.2), torch.tensor(path)
    smoother = PlaceSmoother(within=3).fit(scores, noise(200, 16))
    free = smoother.changed(steady=FREE)

    def sure(model):
        posterior = model.posterior(scores, noise(200, 16))
        return float(posterior.gather(1, right[:, None]).mean())

    assert smoother.steady.speeds == (Fraction(1, 2),)
    assert sure(smoother) > sure(free) + 0.1


@torch.no_grad()
@pytest.mark.parametrize("way", ["there", "back"])
@pytest.mark.parametrize("speed", ["1/2", "1", "2", "3"])
def test_a_filter_follows_a_camera_at_any_speed_both_ways(way, speed):
    path = [20 + place for place in at_speed(speed, 80)]
    path = path if way == "there" else [320 - place for place in path]
    posterior = PlaceFilter().posterior(shown(340, path, clear=3.0))
    found = posterior[:, :-1].argmax(1)
    assert float(((found - torch.tensor(path)).abs() <= 3)[40:].double().mean()) > 0.9


@torch.no_grad()
def test_a_filter_of_one_direction_is_left_by_a_camera_that_travels_back():
    path = [*range(300, 100, -2)]
    scores = shown(340, path, clear=3.0)
    there = PlaceFilter(back=0.0).posterior(scores)[40:, :-1].argmax(1)
    both = PlaceFilter().posterior(scores)[40:, :-1].argmax(1)
    right = [float(((one - torch.tensor(path[40:])).abs() <= 3).double().mean()) for one in (there, both)]
    assert right[0] < right[1] - 0.3


@torch.no_grad()
def test_a_probability_of_each_place_goes_to_all_its_states_and_back():
    filter, places = PlaceFilter(), 30
    motion = filter.motion(torch.zeros(1, places))
    posterior = torch.rand(places + 1, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(motion.folded(motion.unfolded(posterior)), posterior)


def test_speeds_that_are_none_are_refused():
    for speeds in ([0], [-1.0], [0.001], [101], [float("nan")], [float("inf")]):
        with refused("the speeds are", "0.042 to 100"):
            PlaceFilter(speeds=speeds)
    with refused("1/13, 1/11, 1/7", "31 chains", "at most 24"):
        steady([Fraction(1, 7), Fraction(1, 11), Fraction(1, 13)])
    for turn, back in ((1.5, 0.1), (0.0, -0.1)):
        with refused(f"turn {turn}, back {back}", "probabilities"):
            PlaceFilter(turn=turn, back=back)
    assert steady([1.0, 1, 0.5]).speeds == (Fraction(1, 2), Fraction(1))
    assert steady([]) is FREE
