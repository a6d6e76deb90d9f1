"""What all feature modules share: the check of frames, work in parts, settings as text."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from dejavu_torch.types import InputError

VALUES_AT_ONCE = 2**19  # of frames, so that intermediate results stay in the cache


def check_frames(frames: Tensor, name: str) -> None:
    """Refuse all but a batch of float frames."""
    if not isinstance(frames, Tensor):
        raise InputError(f"{name} got a {type(frames).__name__}; expected a tensor of frames (B,C,H,W)")
    if frames.ndim != 4 or not frames.is_floating_point():
        raise InputError(
            f"{name} got {tuple(frames.shape)} {frames.dtype}; expected float frames (B,C,H,W) in [0, 1]"
        )


def in_parts(work: Callable[[Tensor], Tensor], frames: Tensor) -> Tensor:
    """`work` on at most VALUES_AT_ONCE values at a time, at least one frame."""
    if torch.compiler.is_compiling():  # the number of parts would fix the batch
        return work(frames)
    size = max(1, VALUES_AT_ONCE // max(1, math.prod(frames.shape[1:])))
    return torch.cat([work(part) for part in frames.split(size)])


def settings_of(module: nn.Module, *hidden: str) -> str:
    """The constructor's arguments, as `extra_repr` shows them."""
    names = [name for name in inspect.signature(type(module)).parameters if name not in hidden]
    return ", ".join(f"{name}={getattr(module, name)!r}" for name in names)
