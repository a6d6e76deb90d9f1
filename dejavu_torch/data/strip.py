"""A window sliding along one long image, as in the paper's Aerial dataset (section IV-A)."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from dejavu_torch.data.files import as_number
from dejavu_torch.data.folder import read_image
from dejavu_torch.text import printable
from dejavu_torch.types import InputError, Traverse, expect


class SlidingWindow(Traverse):
    """Frame i is the window [i * step, i * step + width) of a strip.

    Args:
        strip: (C,H,W) float in [0, 1]; its name is for messages.
        width: of the window, pixels. step: pixels from one frame to the next.

    Raises:
        InputError: not (C,H,W), or a window that does not fit.

    Example:
        >>> traverse = SlidingWindow(torch.rand(1, 96, 200), width=96)
        >>> len(traverse), traverse[:64].shape
        (105, torch.Size([64, 1, 96, 96]))
    """

    ordered = True

    def __init__(self, strip: Tensor, width: int, step: int = 1, name: str = "the strip") -> None:
        if strip.ndim != 3 or not strip.is_floating_point():
            raise InputError(f"{name} is {tuple(strip.shape)} {strip.dtype}; expected float (C,H,W)")
        if not 1 <= width <= strip.shape[2] or step < 1:
            seen = f"{name} is {strip.shape[2]} pixels long, window {width}, step {step}"
            raise InputError(f"{seen}; expected a window of 1 to {strip.shape[2]}, and a step of at least 1")
        self.name = name
        self.windows = strip.unfold(2, width, step).permute(2, 0, 1, 3)  # (N,C,H,width), a view
        self.cut = (strip.shape[2], width, step), range(len(self.windows))

    def __len__(self) -> int:
        return len(self.windows)

    def read(self, frames: range | list[int]) -> Tensor:
        return self.windows[torch.as_tensor(frames)]


def read_strip(path: Path, width: int, rows: str = "", halve: int = 0, grey: bool = False) -> SlidingWindow:
    """A window sliding along a long image file.

    Args:
        width: of the window, pixels after halving.
        rows: "first:stop" of the rows to keep after halving; "" keeps all.
        halve: how many times to halve the image with a 2 x 2 box filter.
        grey: convert colours to luminance first.
    """
    strip = read_image(path)
    if grey and strip.shape[0] == 3:
        strip = (strip * strip.new_tensor([0.299, 0.587, 0.114])[:, None, None]).sum(0, keepdim=True)
    seen = f"{path} is {strip.shape[1]} x {strip.shape[2]} pixels, to be halved {halve} times"
    expect(halve >= 0 and min(strip.shape[1:]) >> halve > 0, "at least 0 times, leaving a pixel", seen)
    for _ in range(halve):
        strip = torch.nn.functional.avg_pool2d(strip, 2)
    if rows:
        first, stop = map(as_number, rows.partition(":")[::2])
        if first is None or stop is None or first % 1 or stop % 1 or not 0 <= first < stop <= strip.shape[1]:
            raise InputError(f"{path}: rows {rows}; expected first:stop inside 0:{strip.shape[1]}")
        strip = strip[:, int(first) : int(stop)]
    return SlidingWindow(strip, width, name=printable(path))
