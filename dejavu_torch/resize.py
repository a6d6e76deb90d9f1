"""The one way in which frames are resized, by every room: what is described, stored and drawn is the same."""

from __future__ import annotations

from torch import Tensor


def resize_frames(frames: Tensor, size: tuple[int, int] | None) -> Tensor:
    """Frames of another size, antialiased: a Gaussian blur, then bilinear interpolation (by kornia).

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
    height, width = size
    from kornia.geometry.transform import resize  # loading kornia takes a third of a second

    resized: Tensor = resize(frames, (height, width), antialias=True)
    return resized
