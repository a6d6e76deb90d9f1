"""Footage over a ground that repeats, at known speeds: what the tests of resampling share."""

from __future__ import annotations

import torch
from helpers import Fixed
from torch.nn.functional import interpolate

from dejavu_torch import FrequencyLayer, GroundOdometry
from dejavu_torch.motion.phase_correlation import phase_shifts

SIDE, STEP, CYCLE = 48, 6, 60  # pixels
WHOLE = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))  # the camera looks straight down


def positions(*speeds):
    """Pixels of ground at each frame, from (pixels per frame, frames)."""
    steps = [speed for speed, frames in speeds for _ in range(frames)]
    return torch.tensor([0, *steps]).cumsum(0)


# both come 603 pixels far; each stands for a while, at another place
REFERENCE = positions((4, 60), (0, 25), (9, 40), (3, 1))
QUERY = positions((8, 45), (0, 10), (5, 48), (3, 1))


def footage(where, noise=0.0):
    """(N,1,48,48) frames over a ground that repeats every 60 pixels and differs a little everywhere."""
    random = torch.Generator().manual_seed(0)
    cycle = torch.rand(1, 1, CYCLE // 4, SIDE // 4, generator=random).repeat(1, 1, 12, 1)
    coarse = 0.5 * cycle + 0.5 * torch.rand(cycle.shape, generator=random)
    ground = interpolate(coarse, scale_factor=4, mode="bicubic")[0, 0]
    last = len(ground) - SIDE  # forward: the ground comes nearer, down the frame
    frames = torch.stack([ground[last - p : last - p + SIDE] for p in where.tolist()])[:, None]
    return (frames + noise * torch.randn(frames.shape, generator=random)).clamp(0, 1)


def camera(**settings):
    return GroundOdometry(WHOLE, (SIDE, SIDE), **{"step": float(STEP), **settings})


def everything(places):
    """A layer that stores every place."""
    return Fixed(FrequencyLayer(places, places, 0, places, tuple(range(900))))


def shift_between(first, second):
    """The likeliest shift of each pair of patches, (B,1,h,w) twice -> shift (B,), confidence (B,)."""
    shifts, confidences = phase_shifts(first, second)
    best = confidences.argmax(1, keepdim=True)
    return shifts.gather(1, best)[:, 0], confidences.gather(1, best)[:, 0]
