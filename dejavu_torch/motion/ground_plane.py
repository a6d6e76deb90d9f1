"""Bird's-eye view of the ground in front of a camera (section IV-B)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from dejavu_torch.memory import check_room
from dejavu_torch.types import InputError, expect

Corners = Sequence[Sequence[float]]
TRAPEZIUM: Corners = ((0.32, 0.72), (0.68, 0.72), (0.95, 0.98), (0.05, 0.98))
FLAT = (0.25 / 255) ** 2  # variance of pixels below which a patch has no texture


def check_corners(corners: Corners) -> None:
    """Refuse anything but a convex quadrilateral inside the frame, clockwise from far left."""
    order = "far left, far right, near right, near left"
    pairs = len(corners) == 4 and all(len(corner) == 2 for corner in corners)
    if not pairs or not all(isinstance(side, (int, float)) for corner in corners for side in corner):
        seen = f"the ground has {len(corners)} corners, {corners!s:.100}"
        raise InputError(f"{seen}; expected four (x, y): {order}")
    text = "ground corners " + " ".join(f"({x:g}, {y:g})" for x, y in corners)
    points = torch.tensor(corners, dtype=torch.float64)
    expect(((points >= 0) & (points <= 1)).all(), "fractions of it, 0 to 1", f"{text} lie outside the frame")
    edges = points.roll(-1, 0) - points
    expect((torch.stack([edges, edges.roll(-1, 0)], 1).det() > 1e-6).all(), order, f"{text} are not convex")


def ground_patch(frames: Tensor, corners: Corners = TRAPEZIUM, size: tuple[int, int] = (96, 96)) -> Tensor:
    """The ground in grey bird's-eye view: frames (B,C,H,W), grey or RGB -> (B,1,rows,columns), far end first.

    Args:
        corners: (x, y) of a region of ground, see `GroundOdometry`; (0, 0) is the frame's top left pixel.
        size: (rows, columns) of the patch in pixels.

    Raises:
        InputError: not (B,C,H,W) float with 1 or 3 channels, or frames below 2 x 2.
    """
    if frames.ndim != 4 or frames.shape[1] not in (1, 3) or not frames.is_floating_point():
        seen = f"frames {tuple(frames.shape)} {frames.dtype}"
        raise InputError(f"{seen}; expected (B,C,H,W) float, grey or RGB: features do not show the ground")
    (count, _, height, width), (rows, columns) = frames.shape, size
    expect(min(height, width) >= 2, "at least 2 x 2", f"frames of {height} x {width} pixels")
    # two sampling grids and the patches
    check_room(32.0 * count * rows * columns, f"the ground in {count} x {rows} x {columns} pixels")
    from kornia.color import rgb_to_grayscale  # slow to import
    from kornia.geometry.transform import get_perspective_transform, warp_perspective

    grey = frames if frames.shape[1] == 1 else rgb_to_grayscale(frames)
    # blurred, as the far rows are sampled coarsely
    grey = conv2d(pad(grey, (0, 0, 1, 1), mode="replicate"), grey.new_tensor([1, 2, 1]).view(1, 1, 3, 1) / 4)
    unit = grey.new_tensor([[[0, 0], [1, 0], [1, 1], [0, 1]]])
    region = grey.new_tensor([corners]) * grey.new_tensor([width - 1, height - 1])
    # the inverse would fail if the frame's first pixel lies on the patch's horizon
    from_patch = get_perspective_transform(unit * grey.new_tensor([columns - 1, rows - 1]), region)
    patch: Tensor = warp_perspective(grey, torch.linalg.inv(from_patch).expand(count, 3, 3), (rows, columns))
    return patch
