"""The one way in which frames are resized, by every room: what is described, stored and drawn is the same."""

from __future__ import annotations

import math

from torch import Tensor
from torch.nn.functional import interpolate

from dejavu_torch.types import InputError

MOST_PIXELS = 2**26  # of a frame: a number in a file or an option can be any


def check_size(size: tuple[int, int], least: int, what: str) -> None:
    """Refuse what is no size in pixels, (height, width).

    Args:
        least: pixels of each side. what: the message begins with, up to the =.

    Raises:
        InputError: not two numbers, one below the least, or more than 2^26 pixels.
    """
    if len(size) != 2 or min(size) < least or math.prod(size) > MOST_PIXELS:
        raise InputError(
            f"{what}={tuple(size)}; expected (height, width) in pixels, at least {least} each "
            f"and {MOST_PIXELS} in all"
        )


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
