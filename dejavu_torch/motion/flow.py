"""The shift between two patches of ground by OpenCV's optical flow (section IV-B)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.motion.ground_plane import FLAT
from dejavu_torch.types import InputError

Array = np.ndarray
Tracker = Callable[[Array, Array, float], tuple[Array, Array, Array]]

TOLERANCE = 0.7  # pixels within which displacements agree
STARTS = (0, -1, 1, -2, 2, -3, 3)  # initial shifts, in eighths of the patch
SUFFICIENT_CONFIDENCE = 0.8  # stops the search over initial shifts
CONTRAST = 40.0  # grey levels per standard deviation of the patch


def flow_shift(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """The shift of the ground between two patches, as in `phase_shifts`: shift (B,), confidence (B,).

    The shift is the median displacement of points that return to their start when tracked forward and back.
    It tracks up to 200 corners (pyramidal Lucas-Kanade). The confidence is the share of points that agree
    with the median, 0 for a patch that is flat or not finite.

    Limits: |shift| up to about 0.4 h. Lines along the way appear static: on a motorway it is worse than
        `phase_shifts`.
    """
    track = _tracker()
    shifts = [_shift(track, *pair) for pair in zip(_to_uint8(first), _to_uint8(second), strict=True)]
    shift, confidence = first.new_tensor(shifts).view(-1, 2).T
    return shift, confidence


def _tracker() -> Tracker:
    """The function `track(first, second, start)`, which follows points between two images."""
    try:
        import cv2
    except ImportError as error:
        seen = f"optical flow needs OpenCV, which cannot be imported ({error})"
        raise InputError(f"{seen}; expected pip install 'dejavu_torch[flow]'") from error
    return partial(_track_corners, cv2)


def _to_uint8(patches: Tensor) -> Array:
    """(B,1,h,w) -> (B,h,w) uint8 of equal contrast; 0 for flat patches."""
    grey = patches[:, 0].detach().double().cpu()
    centred = grey - grey.mean((1, 2), keepdim=True)
    variance = centred.square().mean((1, 2), keepdim=True)
    levels = (CONTRAST * centred / variance.sqrt() + 128).round().clamp(0, 255)
    images: Array = torch.where(variance >= FLAT, levels, 0).byte().numpy()
    return images


def _shift(track: Tracker, first: Array, second: Array) -> tuple[float, float]:
    """Shift and confidence from the initial shift with the most agreeing points."""
    best = (0.0, 0.0)
    for eighths in STARTS:
        points, moved, returned = track(first, second, len(first) / 8 * eighths)
        if not returned.any():
            continue
        median = np.median(moved[returned], 0)
        target = points + median
        inside = ((target >= 0) & (target <= (first.shape[1] - 1, first.shape[0] - 1))).all(1)
        agree = inside & returned & (np.abs(moved - median) < TOLERANCE).all(1)
        confidence = float(agree.sum() / max(inside.sum(), len(points) / 2, 8))  # few agree by chance
        best = max(best, (float(median[1]), confidence), key=lambda pair: pair[1])
        if confidence >= SUFFICIENT_CONFIDENCE:
            break
    return best


def _track_corners(cv2: ModuleType, first: Array, second: Array, start: float) -> tuple[Array, Array, Array]:
    """Points (P,2) as (x, y), their displacements (P,2), and whether tracking back returns to them (P,)."""
    points = cv2.goodFeaturesToTrack(first, 200, 0.01, 3)
    if points is None:
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool)
    flags, guess = cv2.OPTFLOW_USE_INITIAL_FLOW, np.array([0, start], np.float32)
    track = partial(cv2.calcOpticalFlowPyrLK, winSize=(15, 15), maxLevel=3, flags=flags)
    moved, found, _ = track(first, second, points, points + guess)
    back, kept, _ = track(second, first, moved, moved - guess)
    returned = (found & kept)[:, 0].astype(bool) & (np.abs(back - points) < TOLERANCE).all((1, 2))
    return points[:, 0], (moved - points)[:, 0], returned
