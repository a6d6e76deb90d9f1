"""The position of each frame of footage resampled by distance (section IV-B).

Convention 11: the position of a frame is its distance from the first place in steps; place p has position p.
Files count frames; phases, tolerances and scores count places.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dejavu_torch.text import expect

MAX_PLACES = 2**24  # a float32 holds every whole number up to here
NEAR = 1e-4  # steps: a frame this close to a place has reached it


def shown_frames(positions: Tensor) -> Tensor:
    """The frame nearest to each place, of the two frames between which it is first reached.

    Shape: positions (F,) float -> (M,) int64, never decreasing; M places.

    Convention: stops and reversals add no places.

    Example:
        >>> shown_frames(torch.tensor([0.0, 0.6, 0.6, 2.0])).tolist()
        [0, 2, 3]
    """
    positions = positions.double()
    furthest = positions.cummax(0).values + NEAR
    places = torch.arange(count_places(positions), dtype=torch.float64, device=positions.device)
    high = torch.searchsorted(furthest, places).clamp(max=len(positions) - 1)
    low = (high - 1).clamp(min=0)
    # even after a reversal, the frame before the first to reach a place has not reached it
    step = (positions[high] - positions[low]).clamp(min=1e-12)
    return torch.where((places - positions[low]) / step < 0.5, low, high)


def count_places(positions: Tensor) -> int:
    """The number of places that frames at positions (F,) reach."""
    return int(float(positions.double().max()) + NEAR) + 1


def positions_behind(positions: Tensor, places: int) -> Tensor:
    """Positions (F,) moved by a number of places to be appended after them, float32.

    Convention: negative positions become 0 first, or they would lie in the places before.
    """
    double = positions.double().clamp(min=0)
    total = places + count_places(double)
    expected = f"at most {MAX_PLACES}, as float32 cannot number more: learn several maps and merge them"
    expect(total <= MAX_PLACES, expected, f"{total} places at even steps on one route")
    moved = (double + places).float()
    reached = (double + NEAR).floor() + places  # float32 may round large positions up to the next place
    below = torch.nextafter((reached + 1 - NEAR).float(), torch.zeros_like(moved))
    return torch.where((moved.double() + NEAR).floor() > reached, below, moved)


def borders(positions: Tensor) -> Tensor:
    """The first frame of each place, followed by the number of frames.

    Shape: (F,) -> (M + 1,) int64, not decreasing: place p is shown from frame borders[p] to borders[p + 1].

    Example:
        >>> borders(torch.tensor([0.0, 1.0, 1.0, 1.0, 2.0, 2.0])).tolist()
        [0, 1, 4, 6]
    """
    shown = shown_frames(positions)
    return torch.cat([shown, shown.new_tensor([len(positions)])])


def unit_of(positions: Tensor) -> str:
    """The unit of tolerances and periods: frames, or places if the map has positions, (F,) not (0,)."""
    return "places at even steps" if len(positions) else "frames"


def look_up(table: Tensor, index: Tensor) -> Tensor:
    """table[index] for int64 of any shape; -1 stays -1."""
    return torch.where(index >= 0, table.to(index.device)[index.clamp(min=0)], -1)


def place_of(positions: Tensor, frames: Tensor) -> Tensor:
    """The place nearest to each frame, int64 of any shape; -1 before the first place, and for -1."""
    nearest = positions.double().round().long().clamp(-1, count_places(positions) - 1)
    return look_up(nearest, frames)
