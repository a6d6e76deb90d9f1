"""The real flights that come with the package."""

from __future__ import annotations

import torch
from helpers import refused

from dejavu_torch import open_source


def test_two_flights_show_the_same_places_with_their_own_truth():
    first, second = open_source("demo:road"), open_source("demo:road?traverse=1")
    assert (len(first), len(second)) == (2697, 2697)
    assert (first.frame_shape, first.ordered) == ((3, 96, 96), True)
    assert first.places is not None
    assert torch.equal(first.places, torch.arange(2697).double())
    one, other = first[100:101], second[100:101]
    elsewhere = second[1500:1501]
    assert not torch.equal(one, other)
    # of the same place, in other light
    plain = [frame.mean(1).flatten() - frame.mean() for frame in (one, other, elsewhere)]
    near, far = (torch.cosine_similarity(plain[0], two, dim=0) for two in plain[1:])
    assert near > far + 0.2
    part = open_source("demo:road?traverse=1&start=100&step=10&stop=200")
    assert part.places is not None
    assert part.places.tolist() == list(range(100, 200, 10))


def test_what_is_no_flight():
    with refused("there is no demo 'rail'", "expected area, road"):
        open_source("demo:rail")
    with refused("traverse=2", "expected 0 to 1"):
        open_source("demo:road?traverse=2")
    with refused("unknown 'seed'"):
        open_source("demo:road?seed=1")
