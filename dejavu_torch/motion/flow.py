"""The shift between two patches of ground by optical flow, sparse or dense, of OpenCV (section IV-B)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.motion.ground_plane import FLOOR, check_pairs
from dejavu_torch.types import InputError

Array = np.ndarray[Any, Any]
Track = Callable[[Array, Array, float], tuple[Array, Array, Array]]

NEAR = 0.7  # pixels: what differs by less agrees
STARTS = (0, -1, 1, -2, 2, -3, 3)  # eighths of the patch, where the search begins
ENOUGH = 0.8  # of the points agree: no other start is tried
ALIKE = 0.25  # correlation of the surroundings of a pixel, 9 x 9, with those of where it went
BEYOND = (np.inf, np.inf)  # what left the patch does not come back
CONTRAST = 40.0  # grey levels that a standard deviation becomes: 3.2 of them fit on either side


def opencv() -> Any:
    """The module cv2, or InputError where it cannot be imported."""
    try:
        import cv2
    except ImportError as error:
        raise InputError(
            f"optical flow needs OpenCV ({' '.join(str(error).split())}); "
            "expected it to be there: pip install 'dejavu_torch[flow]'"
        ) from error
    return cv2


def check_method(method: str) -> None:
    """Refuse what is no optical flow, and the lack of OpenCV."""
    if method not in TRACKS:
        raise InputError(f"optical flow {method!r}; expected one of {', '.join(TRACKS)}")
    opencv()


def flow_shift(first: Tensor, second: Tensor, method: str) -> tuple[Tensor, Tensor]:
    """How far the ground moved along the rows from one patch to another, each pair by itself.

    The median displacement of the points that are followed from the first to the second and, back again,
    end where they started. The search begins at several shifts; the one most points agree on wins.

    Args:
        first, second: patches of ground, of any gain and offset of brightness.
        method: "lk" follows up to 200 corners (pyramidal Lucas-Kanade), "dis" every pixel around which the
            brightness changes along the rows (dense inverse search).

    Shape: (B,1,h,w), (B,1,h,w) -> shift (B,) in pixels, rows of the patch; confidence (B,) in [0, 1].

    Convention: shift > 0 is forward, as `shift_between`. The confidence is the share of the points, of those
        that the median displacement leaves inside the patch or of half of all where fewer are left, that came
        back to within 0.7 pixels of where they started and moved by the median, to 0.7 pixels along rows and
        columns; with "dis" the ground must also look alike there. On unrelated ground it is less than 0.1
        ("lk") or mostly less than 0.2 ("dis"), for a patch that is flat or not finite 0. The work is done on
        the CPU, pair by pair, without gradients.

    Limits: |shift| up to about 0.4 h by the several starts ("dis" misses some above 0.25 h, of low
        confidence); from one alone DIS follows 8 pixels of 96, Lucas-Kanade 12. "dis" is good to 0.1 pixels
        only. Smeared by 15 pixels and more, "lk" loses its points. Where the ground
        repeats, a wrong period can be as good as the right one. Lines along the way look as if they stood
        still: where lanes or rails stand out from the ground, as on a motorway, both lose to
        `shift_between`, and a wrong shift may be believed.

    Raises:
        InputError: patches that are not two equal (B,1,h,w), or smaller than 32 x 32; an unknown method;
            OpenCV is missing.

    Example:
        >>> ground = torch.rand(1, 1, 80, 64)
        >>> shift, confidence = flow_shift(ground[..., 10:74, :], ground[..., 3:67, :], "lk")
        >>> round(shift.item(), 1), confidence.item() > 0.9
        (7.0, True)
    """
    check_pairs(first, second)
    check_method(method)
    if not len(first):
        return first.new_zeros(0), first.new_zeros(0)
    track = TRACKS[method](opencv())
    pairs = zip(_pictures(first), _pictures(second), strict=True)
    result = torch.tensor([_best(track, one, other) for one, other in pairs]).to(first)
    return result[:, 0], result[:, 1]


def _pictures(patches: Tensor) -> list[Array | None]:
    """(h,w) uint8 each, whatever the exposure; None is flat or not finite."""
    grey = patches[:, 0].detach().double().cpu()
    variance = grey.var((1, 2), correction=0)
    even = (grey - grey.mean((1, 2), keepdim=True)) / variance.sqrt()[:, None, None]
    bytes_ = (CONTRAST * even + 128).nan_to_num().round().clamp(0, 255).byte().numpy()
    return [picture if v >= FLOOR else None for picture, v in zip(bytes_, variance.tolist(), strict=True)]


def _best(track: Track, first: Array | None, second: Array | None) -> tuple[float, float]:
    """Shift and confidence of the start from which most points agree."""
    best = (0.0, 0.0)
    if first is None or second is None:
        return best
    for eighths in STARTS:
        found = _agreed(*track(first, second, len(first) / 8 * eighths), first.shape)
        best = max(best, found, key=lambda pair: pair[1])
        if best[1] >= ENOUGH:
            break
    return best


def _agreed(points: Array, moved: Array, back: Array, shape: tuple[int, ...]) -> tuple[float, float]:
    """Median shift along the rows and the share of the points that agree.

    Shape: points (P,2) as (x, y), moved (P,2) pixels, back (P,) bool.
    """
    if not back.any():
        return 0.0, 0.0
    median = np.median(moved[back], 0)
    there = points + median
    inside = ((there >= 0) & (there <= (shape[1] - 1, shape[0] - 1))).all(1)
    agree = inside & back & (np.abs(moved - median) < NEAR).all(1)
    # a handful of points agrees by chance
    return float(median[1]), float(agree.sum() / max(inside.sum(), len(points) / 2, 8))


def _corners(cv2: Any) -> Track:
    """Lucas-Kanade on corners."""
    options = {"winSize": (15, 15), "maxLevel": 3, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}

    def track(first: Array, second: Array, start: float) -> tuple[Array, Array, Array]:
        points = cv2.goodFeaturesToTrack(first, 200, 0.01, 3)
        if points is None:
            return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool)
        guess = np.array([0, start], np.float32)
        there, seen, _ = cv2.calcOpticalFlowPyrLK(first, second, points, points + guess, **options)
        again, kept, _ = cv2.calcOpticalFlowPyrLK(second, first, there, there - guess, **options)
        back = (seen & kept)[:, 0].astype(bool) & (np.abs(again - points) < NEAR).all((1, 2))
        return points[:, 0], (there - points)[:, 0], back

    return track


def _pixels(cv2: Any) -> Track:
    """Dense inverse search."""
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    def track(first: Array, second: Array, start: float) -> tuple[Array, Array, Array]:
        y, x = np.indices(first.shape, dtype=np.float32)
        guess = np.zeros((*first.shape, 2), np.float32)
        guess[..., 1] = start
        there = search.calc(first, second, guess)
        at = x + there[..., 0], y + there[..., 1]
        again = cv2.remap(search.calc(second, first, -guess), *at, cv2.INTER_LINEAR, borderValue=BEYOND)
        back = (np.abs(there + again) < NEAR).all(2)
        # a dense flow is smooth whatever it is shown: it must lead to what looks alike, and where there is
        # no texture it only agrees with where it started
        now = cv2.remap(second, *at, cv2.INTER_LINEAR)
        alike = _correlation(cv2, first.astype(np.float32), now.astype(np.float32)) > ALIKE
        slope = _around(cv2, cv2.Sobel(first, cv2.CV_32F, 0, 1) ** 2)
        seen = slope >= 0.25 * slope.mean()
        return np.stack([x, y], 2)[seen], there[seen], (back & alike)[seen]

    return track


def _around(cv2: Any, values: Array) -> Array:
    mean: Array = cv2.boxFilter(values, -1, (9, 9))
    return mean


def _correlation(cv2: Any, first: Array, second: Array) -> Array:
    """Of the surroundings of each pixel. (h,w) float32, (h,w) float32 -> (h,w) in [-1, 1]."""
    one, other = _around(cv2, first), _around(cv2, second)
    both = _around(cv2, first * second) - one * other
    spread = (_around(cv2, first**2) - one**2) * (_around(cv2, second**2) - other**2)
    result: Array = both / np.sqrt(np.maximum(spread, 1))
    return result


TRACKS: dict[str, Callable[[Any], Track]] = {"lk": _corners, "dis": _pixels}
