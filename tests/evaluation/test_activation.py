from __future__ import annotations

from fractions import Fraction
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.data.ground_truth import GroundTruth, as_ground_truth
from dejavu_torch.evaluation.activation import activation_rates, in_phase
from dejavu_torch.types import FrequencyLayer


def layer(period, phases, start=0, stop=40):
    return FrequencyLayer(Fraction(period), phases, start, stop, (0,))


def rates(best, index, truth, tolerance, places):
    """Of a layer of period 10 in the chunk [0, 40), to which these phases are nearest, and of the fusion."""
    route = SimpleNamespace(plan=(layer(10, 10),), places=places, device="cpu")
    route.distances = lambda queries, _: [(queries - torch.arange(10)).abs()]
    return activation_rates(route, [0], torch.tensor(best)[:, None], torch.tensor(index), truth, tolerance)


def test_rates_in_closed_form():
    # of the places 3, 13, 27 inside and 41, 52 outside
    truth = as_ground_truth(torch.tensor([[3], [13], [27], [41], [52]]))
    best = [3, 4, 0, 0, 7]  # 0, 1 and 3 phases off inside; 1 and 5 off outside
    index = [3, 20, 26, 42, -1]  # right, wrong, right; right, nothing reported
    alone, fused = rates(best, index, truth, tolerance=1, places=60)
    assert alone == pytest.approx((2 / 3, 1 / 2, 3 / 10))
    assert fused == pytest.approx((2 / 3, 1 / 2, 3 / 60))
    # neither unknown queries nor those without an answer count
    right = torch.tensor([[3], [13], [-1]])
    truth = GroundTruth(right, torch.tensor([True, False, True]), right.new_zeros(3, 0))
    alone, fused = rates([8, 3, 3], [8, 3, 3], truth, 0, 40)
    assert alone[:2] == fused[:2] == (0.0, None)


@given(st.fractions(2, 60, max_denominator=7), st.integers(0, 500), st.integers(0, 9), st.data())
def test_the_phase_of_a_place_is_in_phase_with_it_and_shifts_go_around(period, place, tolerance, data):
    phases = data.draw(st.integers(1, int(period)))
    one = layer(period, phases)
    best = torch.arange(phases)
    found = in_phase(one, best, torch.full((phases, 1), place), tolerance)
    own = int(one.phase(torch.tensor(place)))
    off = [min((k - own) % phases, (own - k) % phases) * period / phases for k in range(phases)]
    assert found.tolist() == [frames <= tolerance for frames in off]
    assert not in_phase(one, best, torch.full((phases, 1), -1), tolerance).any()
