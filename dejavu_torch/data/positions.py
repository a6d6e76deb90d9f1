"""The table between reference frames and places at even steps (section IV-B)."""

from __future__ import annotations

import torch
from torch import Tensor

NEAR = 1e-4  # steps: what is so near to a place has reached it


def first_reached(positions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where each whole number of steps is first reached: between two frames, and at what share of the way.

    Args:
        positions: (F,) float64, steps from the first place of each frame.

    Shape: -> low, high (M,) int64 frames, share (M,) in [0, 1]; M places.
    """
    furthest = positions.cummax(0).values + NEAR
    goal = torch.arange(int(furthest[-1]) + 1, dtype=torch.float64, device=positions.device)
    high = torch.searchsorted(furthest, goal).clamp(max=len(positions) - 1)
    low = (high - 1).clamp(min=0)
    # also after a reversal the frame before the first to reach a distance lies short of it
    return (
        low,
        high,
        ((goal - positions[low]) / (positions[high] - positions[low]).clamp(min=1e-12)).clamp(0, 1),
    )


def shown_frames(positions: Tensor) -> Tensor:
    """The frame nearest to each place, where it is first reached: (F,) steps -> (M,) int64."""
    low, high, share = first_reached(positions.double())
    return torch.where(share < 0.5, low, high)


def nearest_places(positions: Tensor) -> Tensor:
    """The place nearest to each frame, -1 behind the first: (F,) steps -> (F,) int64."""
    last = int(float(positions.max()) + NEAR)
    return positions.double().round().long().clamp(-1, last)
