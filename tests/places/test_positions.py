"""Frames and places of resampled footage: one table, read both ways."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from dejavu_torch.places.positions import NEAR, borders, place_of, shown_frames

WAYS = st.lists(st.floats(-1.5, 2.5, width=32), min_size=1, max_size=25).map(
    lambda steps: torch.tensor([0.0, *steps]).cumsum(0)
)


@given(WAYS)
def test_each_place_is_taken_where_it_is_first_reached(positions):
    shown, exact = shown_frames(positions), positions.double()
    assert len(shown) == int(exact.max() + NEAR) + 1
    for place, frame in enumerate(shown.tolist()):
        high = int((exact + NEAR >= place - 1e-9).nonzero()[0])
        low = max(high - 1, 0)
        assert frame in (low, high)
        away = (exact - place).abs()
        assert away[frame] <= min(away[low], away[high]) + NEAR + 1e-9
    assert (shown.diff() >= 0).all()


@given(WAYS)
def test_a_frame_belongs_to_the_place_nearest_to_it(positions):
    places = len(shown_frames(positions))
    nearest = place_of(positions, torch.arange(len(positions)))
    for place, position in zip(nearest.tolist(), positions.tolist(), strict=True):
        if place < 0:
            assert position < 0
        else:
            assert abs(position - place) <= min(abs(position - other) for other in range(places)) + 1e-6


def test_convention_11_standing_and_going_back_add_no_places():
    positions = torch.tensor([0.0, 1, 2, 2, 2, 1, 0, 1, 2, 3])
    assert shown_frames(positions).tolist() == [0, 1, 2, 9]
    assert place_of(positions, torch.arange(10)).tolist() == [0, 1, 2, 2, 2, 1, 0, 1, 2, 3]
    assert borders(positions).tolist() == [0, 1, 2, 9, 10]
    assert place_of(positions, torch.tensor([[8, -1]])).tolist() == [[2, -1]]
