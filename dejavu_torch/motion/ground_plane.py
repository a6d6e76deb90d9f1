"""The ground in front of a camera as seen from above (section IV-B)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from dejavu_torch.memory import check_room
from dejavu_torch.types import InputError

Corners = Sequence[Sequence[float]]
TRAPEZIUM: Corners = ((0.32, 0.72), (0.68, 0.72), (0.95, 0.98), (0.05, 0.98))
FLOOR = (0.25 / 255) ** 2  # variance of a pixel: below it a patch is flat


def check_corners(corners: Corners) -> None:
    """Refuse what is no convex quadrilateral inside the frame, in clockwise order from far left."""
    if len(corners) != 4 or any(len(corner) != 2 for corner in corners):
        raise InputError(
            f"the ground has {len(corners)} corners; "
            "expected four of (x, y): far left, far right, near right, near left"
        )
    text = " ".join(f"({x:g}, {y:g})" for x, y in corners)
    if not all(0 <= value <= 1 for corner in corners for value in corner):
        raise InputError(f"ground corners {text} lie outside the frame; expected fractions of it, 0 to 1")
    points = torch.tensor(corners, dtype=torch.float64)
    (ax, ay), (bx, by) = (points.roll(-1, 0) - points).T, (points.roll(-2, 0) - points.roll(-1, 0)).T
    if not (ax * by - ay * bx > 1e-6).all():
        raise InputError(
            f"ground corners {text} are not convex; expected far left, far right, near right, near left"
        )


def check_size(size: tuple[int, int], least: int) -> None:
    """Refuse a patch too small to see motion in."""
    if len(size) != 2 or min(size) < least:
        raise InputError(
            f"a patch of {tuple(size)} pixels; expected (rows, columns) of at least {least} each"
        )


def check_pairs(first: Tensor, second: Tensor) -> None:
    """Refuse what are no pairs of patches, (B,1,h,w) each, of at least 32 x 32 pixels."""
    if first.shape != second.shape or first.ndim != 4 or first.shape[1] != 1:
        raise InputError(
            f"patches {tuple(first.shape)} and {tuple(second.shape)}; expected two of the same (B,1,h,w)"
        )
    check_size((first.shape[2], first.shape[3]), 32)


def region_length(corners: Corners, height: int, width: int) -> float:
    """From the middle of the region's far edge to that of its near one, in pixels of a frame."""
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners
    return math.hypot((cx + dx - ax - bx) / 2 * (width - 1), (cy + dy - ay - by) / 2 * (height - 1))


def ground_patch(frames: Tensor, corners: Corners = TRAPEZIUM, size: tuple[int, int] = (96, 96)) -> Tensor:
    """The ground in front of the camera as seen from above, grey.

    Args:
        frames: RGB or grey.
        corners: (x, y) of a region of ground in fractions of the frame's width and height, (0, 0) its top
            left pixel and (1, 1) its bottom right one: far left, far right, near right, near left. Its
            two sides should be parallel on the ground, such as the two rails: only then is a row of the
            patch everywhere the same length of ground.
        size: (rows, columns) of the patch in pixels.

    Shape: (B,C,H,W) -> (B,1,rows,columns); row 0 is the far end.

    Convention: rows of the frame are smoothed by (1, 2, 1) / 4, since the far rows are sampled coarsely.
        Where the patch has over twice the rows that the region has in the frame, slow motion is
        underestimated: a smaller patch then measures better.

    Raises:
        InputError: not (B,C,H,W) float, neither 1 nor 3 channels, a patch without pixels, or corners that
            are not four, not inside the frame, not convex or in another order.

    Example:
        >>> ground_patch(torch.rand(2, 3, 120, 160), size=(96, 64)).shape
        torch.Size([2, 1, 96, 64])
    """
    check_corners(corners)
    check_size(size, 2)
    height, width = size
    if frames.ndim != 4 or frames.shape[1] not in (1, 3) or not frames.is_floating_point():
        raise InputError(
            f"frames {tuple(frames.shape)} {frames.dtype}; expected float frames (B,C,H,W), grey or RGB"
        )
    if min(frames.shape[-2:]) < 2:
        raise InputError(f"frames of {frames.shape[-2]} x {frames.shape[-1]} pixels; expected at least 2 x 2")
    # the positions in the frame, as they are and as they are made, and the patches
    check_room(
        32.0 * len(frames) * height * width, f"the ground in {len(frames)} x {height} x {width} pixels"
    )
    from kornia.color import rgb_to_grayscale  # loading kornia takes a third of a second
    from kornia.geometry.transform import get_perspective_transform, warp_perspective

    grey = frames if frames.shape[1] == 1 else rgb_to_grayscale(frames)
    grey = conv2d(pad(grey, (0, 0, 1, 1), mode="replicate"), grey.new_tensor([1, 2, 1]).view(1, 1, 3, 1) / 4)
    scale = grey.new_tensor([grey.shape[-1] - 1, grey.shape[-2] - 1])
    seen = torch.tensor(corners).to(grey) * scale
    right, bottom = width - 1.0, height - 1.0
    above = grey.new_tensor([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]])
    # the other way round it fails where the frame's first pixel lies on the patch's horizon
    matrix = torch.linalg.inv(get_perspective_transform(above[None], seen[None]))
    patch: Tensor = warp_perspective(grey, matrix.expand(len(grey), 3, 3), (height, width))
    return patch
