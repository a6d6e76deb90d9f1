"""The one way in which frames are resized, by every room: what is described, stored and drawn is the same."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import interpolate


def resize_frames(frames: Tensor, size: tuple[int, int] | None) -> Tensor:
    """Frames of another size, antialiased: bilinear, over areas where they shrink.

    Args:
        size: (height, width) in pixels; None, and the size that the frames have, change nothing.

    Shape: (B,C,H,W) -> (B,C,height,width).

    Example:
        >>> import torch
        >>> resize_frames(torch.rand(2, 3, 48, 64), (24, 32)).shape
        torch.Size([2, 3, 24, 32])
    """
    if size is None or tuple(frames.shape[-2:]) == tuple(size):
        return frames
    return interpolate(frames, (size[0], size[1]), mode="bilinear", antialias=True)
