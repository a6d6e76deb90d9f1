"""The one way to resize frames: what is described, stored and drawn is the same."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from dejavu_torch.memory import without_autocast
from dejavu_torch.types import InputError

Size = tuple[int, int]  # height and width, pixels
MOST_PIXELS = 2**26  # of a frame, since files and options can ask for any number
STRETCHED = 1.05  # ratio of aspect ratios above which frames count as stretched


def check_size(size: Size, least: int, what: str) -> Size:
    """(height, width) as a tuple, refused below `least` pixels each; the message begins with `what`."""
    if len(size) != 2 or min(size) < least or math.prod(size) > MOST_PIXELS:
        expected = f"(height, width) in pixels, at least {least} each, at most {MOST_PIXELS} in all"
        raise InputError(f"{what}={tuple(size)}; expected {expected}")
    return int(size[0]), int(size[1])  # a map file holds a list


def resize_frames(frames: Tensor, size: Size | None) -> Tensor:
    """Frames (B,C,H,W) resized to (height, width), bilinear and antialiased; None keeps their size."""
    if size is None or tuple(frames.shape[-2:]) == tuple(size):
        return frames
    return _interpolated(frames, (size[0], size[1]))


@without_autocast
def _interpolated(frames: Tensor, size: Size) -> Tensor:
    half = frames.dtype in (torch.float16, torch.bfloat16)
    exact = frames.float() if half else frames  # a CPU has no antialiasing in less
    resized: Tensor = interpolate(exact, size, mode="bilinear", antialias=True)
    return resized.to(frames.dtype)


def is_stretched(own: Size, size: Size) -> bool:
    """Whether resizing from `own` (height, width) to `size` changes the aspect ratio by over 5 %."""
    ratio = own[0] * size[1] / (own[1] * size[0])
    return not 1 / STRETCHED < ratio < STRETCHED


def turned_hint(own: tuple[int, ...], shape: tuple[int, ...]) -> str:
    """What to try with frames (C,H,W) whose sides have the ratio of others' exchanged sides; else ""."""
    (high, wide), size = own[1:], (shape[1], shape[2])
    turned = is_stretched((high, wide), size) and not is_stretched((wide, high), size)
    return ". If they are turned: ?turn=90 or 270; if height and width are exchanged: transpose" * turned


def reduced_size(own: Size, longest: int | None, least: Size | None = None) -> Size:
    """The size (height, width) to reduce frames to, with at most `longest` pixels on the longer side.

    Args:
        own: their size. longest: None keeps it. least: minimum of each side, such as a network's input.

    Example:
        >>> reduced_size((540, 960), 160), reduced_size((540, 960), 160, (224, 224))
        ((90, 160), (224, 398))
    """
    if longest is None:
        return own
    height, width = least or (0, 0)
    scale = max(longest / max(own), height / own[0], width / own[1])
    return own if scale >= 1 else (max(1, round(scale * own[0])), max(1, round(scale * own[1])))
