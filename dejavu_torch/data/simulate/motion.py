"""How a train moves along its route: it speeds up, cruises, brakes, crawls and stops."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

FPS = 25.0
GRAIN = 0.125  # metres; the speed is planned on this grid


def ride(
    route: float,
    cruise: float,
    slow: tuple[tuple[float, float, float], ...],
    stops: tuple[tuple[float, float], ...],
    acceleration: float = 0.9,
) -> Tensor:
    """Where a train is at each frame, from one end of the route to the other.

    Args:
        route: metres. cruise: metres per second.
        slow: (start, stop, metres per second) of each slow section.
        stops: (place in metres, seconds) of each full stop, in order.
        acceleration: metres per second squared, the same for braking.

    Shape: -> (N,) float64 metres, never decreasing, FPS frames per second.
    """
    s = np.arange(round(route / GRAIN) + 1) * GRAIN
    square = np.full(len(s), cruise**2)  # square of the speed: it changes evenly along the track
    for start, stop, speed in slow:
        square[(s >= start) & (s <= stop)] = speed**2
    nodes = np.arange(len(s))
    halts = [round(place / GRAIN) for place, _ in stops]
    square[[0, *halts]] = 0
    gain = 2 * acceleration * GRAIN
    square = np.minimum.accumulate(square - gain * nodes) + gain * nodes
    square = np.minimum.accumulate((square - gain * nodes[::-1])[::-1])[::-1] + gain * nodes[::-1]
    speed = np.sqrt(square)
    taken = 2 * GRAIN / (speed[1:] + speed[:-1])
    clock = np.concatenate([[0.0], np.cumsum(taken)])
    for halt, (_, seconds) in reversed(list(zip(halts, stops, strict=True))):
        clock = np.concatenate([clock[: halt + 1], clock[halt:] + seconds])
        s = np.concatenate([s[: halt + 1], s[halt:]])
    return torch.from_numpy(np.interp(np.arange(0, clock[-1], 1 / FPS), clock, s))


def reference_place(reference: Tensor, distance: Tensor) -> Tensor:
    """The reference frame number at each distance, interpolated.

    Args:
        reference: (N,) metres of the reference frames, never decreasing. distance: (Q,) metres.

    Shape: -> (Q,) float64; where the reference stands still, the first frame of the stop.

    Example:
        >>> stands = torch.tensor([0.0, 1.0, 1.0, 1.0, 2.0])
        >>> reference_place(stands, torch.tensor([0.5, 1.0, 1.5])).tolist()
        [0.5, 1.0, 3.5]
    """
    after = torch.searchsorted(reference, distance.contiguous()).clamp(1, len(reference) - 1)
    low, high = reference[after - 1], reference[after]
    part = (distance - low) / (high - low)
    return torch.where(distance <= reference[0], 0.0, after - 1 + part.clamp(max=1)).double()
