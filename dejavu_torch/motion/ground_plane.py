"""The ground in front of a camera as seen from above (section IV-B)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from dejavu_torch.memory import check_room
from dejavu_torch.types import InputError

Corners = Sequence[Sequence[float]]
TRAPEZIUM: Corners = ((0.32, 0.72), (0.68, 0.72), (0.95, 0.98), (0.05, 0.98))
FLAT = (0.25 / 255) ** 2  # variance of the pixels below which a patch shows nothing


def check_corners(corners: Corners) -> None:
    """Refuse what is not a convex quadrilateral inside the frame, in clockwise order from far left."""
    pairs = len(corners) == 4 and all(len(corner) == 2 for corner in corners)
    if not pairs or not all(isinstance(side, (int, float)) for corner in corners for side in corner):
        raise InputError(
            f"the ground has {len(corners)} corners, {corners!s:.100}; "
            "expected four of (x, y): far left, far right, near right, near left"
        )
    text = "ground corners " + " ".join(f"({x:g}, {y:g})" for x, y in corners)
    points = torch.tensor(corners, dtype=torch.float64)
    if not ((points >= 0) & (points <= 1)).all():
        raise InputError(f"{text} lie outside the frame; expected fractions of it, 0 to 1")
    edges = points.roll(-1, 0) - points
    if not (torch.stack([edges, edges.roll(-1, 0)], 1).det() > 1e-6).all():
        raise InputError(f"{text} are not convex; expected far left, far right, near right, near left")


def ground_patch(frames: Tensor, corners: Corners = TRAPEZIUM, size: tuple[int, int] = (96, 96)) -> Tensor:
    """The ground in front of the camera as seen from above, in grey: frames (B,C,H,W), grey or RGB ->
    (B,1,rows,columns), row 0 at the far end.

    Args:
        corners: (x, y) of a region of ground, see `GroundOdometry`; (0, 0) is the top left pixel of the
            frame, (1, 1) the bottom right one.
        size: (rows, columns) of the patch in pixels.

    Raises:
        InputError: not (B,C,H,W) float with 1 or 3 channels, or frames below 2 x 2.
    """
    if frames.ndim != 4 or frames.shape[1] not in (1, 3) or not frames.is_floating_point():
        raise InputError(
            f"frames {tuple(frames.shape)} {frames.dtype}; "
            "expected frames (B,C,H,W), float, grey or RGB: ready features show no ground"
        )
    (count, _, height, width), (rows, columns) = frames.shape, size
    if min(height, width) < 2:
        raise InputError(f"frames of {height} x {width} pixels; expected at least 2 x 2")
    # the grid in two forms and the patches
    check_room(32.0 * count * rows * columns, f"the ground in {count} x {rows} x {columns} pixels")
    from kornia.color import rgb_to_grayscale  # loading kornia takes a third of a second
    from kornia.geometry.transform import get_perspective_transform, warp_perspective

    grey = frames if frames.shape[1] == 1 else rgb_to_grayscale(frames)
    # the far rows are sampled coarsely
    grey = conv2d(pad(grey, (0, 0, 1, 1), mode="replicate"), grey.new_tensor([1, 2, 1]).view(1, 1, 3, 1) / 4)
    unit = grey.new_tensor([[[0, 0], [1, 0], [1, 1], [0, 1]]])
    region = torch.tensor([corners]).to(grey) * grey.new_tensor([width - 1, height - 1])
    # the other direction fails if the frame's first pixel lies on the patch's horizon
    from_patch = get_perspective_transform(unit * grey.new_tensor([columns - 1, rows - 1]), region)
    patch: Tensor = warp_perspective(grey, torch.linalg.inv(from_patch).expand(count, 3, 3), (rows, columns))
    return patch
