"""Frames and places of footage resampled by distance: one table, the position of each frame (section IV-B).

Convention 11: the position of a frame is how many even steps it lies from the first place, place p lies at
position p. Files count frames; phases, tolerances and scores count places.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dejavu_torch.types import InputError

MOST = 2**24  # places: from there on float32 holds no odd numbers
NEAR = 1e-4  # steps: a frame so near to a place has reached it


def shown_frames(positions: Tensor) -> Tensor:
    """The frame nearest to each place, of the two between which it is first reached.

    Shape: positions (F,) float -> (M,) int64, never decreasing; M places.

    Convention: standing, and going back and forth, add no places.

    Example:
        >>> shown_frames(torch.tensor([0.0, 0.6, 0.6, 2.0])).tolist()
        [0, 2, 3]
    """
    positions = positions.double()
    furthest = positions.cummax(0).values + NEAR
    places = torch.arange(count_places(positions), dtype=torch.float64, device=positions.device)
    high = torch.searchsorted(furthest, places).clamp(max=len(positions) - 1)
    low = (high - 1).clamp(min=0)
    # also after a reversal the frame before the first to reach a place lies short of it
    step = (positions[high] - positions[low]).clamp(min=1e-12)
    return torch.where((places - positions[low]) / step < 0.5, low, high)


def count_places(positions: Tensor) -> int:
    """How many places frames at such positions (F,) reach."""
    return int(float(positions.double().max()) + NEAR) + 1


def positions_behind(positions: Tensor, places: int) -> Tensor:
    """Positions (F,) of frames whose first place is behind so many others, float32.

    Convention: frames behind their own first place are moved to it: there are other places behind it now.
    """
    double = positions.double().clamp(min=0)
    total = places + count_places(double)
    if total > MOST:
        expected = f"at most {MOST}, which float32 can tell apart: make several maps, and merge them"
        raise InputError(f"{total} places at even steps, one behind the other; expected {expected}")
    moved = (double + places).float()
    # at many places float32 would round some up to the next place
    reached = (double + NEAR).floor() + places
    below = torch.nextafter((reached + 1 - NEAR).float(), torch.zeros_like(moved))
    return torch.where((moved.double() + NEAR).floor() > reached, below, moved)


def borders(positions: Tensor) -> Tensor:
    """The frame with which each place begins, and behind the last place the number of frames.

    Shape: (F,) -> (M + 1,) int64, not decreasing: place p is shown from frame borders[p] to borders[p + 1].

    Example:
        >>> borders(torch.tensor([0.0, 1.0, 1.0, 1.0, 2.0, 2.0])).tolist()
        [0, 1, 4, 6]
    """
    shown = shown_frames(positions)
    return torch.cat([shown, shown.new_tensor([len(positions)])])


def unit_of(positions: Tensor) -> str:
    """What tolerances and periods count: frames, or the places of a map with such a table; (0,) is none."""
    return "places at even steps" if len(positions) else "frames"


def look_up(table: Tensor, index: Tensor) -> Tensor:
    """Entries of a table by their index, int64 of any shape; -1 stays -1."""
    return torch.where(index >= 0, table.to(index.device)[index.clamp(min=0)], -1)


def place_of(positions: Tensor, frames: Tensor) -> Tensor:
    """The place nearest to each frame; -1 for one before the first place, and for -1. int64 of any shape."""
    nearest = positions.double().round().long().clamp(-1, count_places(positions) - 1)
    return look_up(nearest, frames)
