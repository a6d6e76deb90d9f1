"""Arrays of frames, or of ready-made features, as traverses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.data.frame_range import IndexedTraverse
from dejavu_torch.types import InputError, Traverse

UNNAMED = "the array"
EXPECTED = (
    "frames (N,H,W) or (N,H,W,3) uint8, tensors also (N,C,H,W) float in [0, 1], or features (N,D) float"
)


class ArrayTraverse(IndexedTraverse):
    """The frames or features of an array or tensor; of a memory-mapped file only what is used is read.

    Args:
        values: uint8 frames (N,H,W) or (N,H,W,3), float frames (N,C,H,W) in [0, 1], or float
            features (N,D).
        name: what to call it in messages.

    Raises:
        InputError: another shape or type, or no frames.
    """

    def __init__(self, values: Tensor | np.ndarray, name: str = UNNAMED) -> None:
        shape, kind = tuple(values.shape), str(values.dtype).removeprefix("torch.")
        pixels = kind == "uint8" and (len(shape) == 3 or (len(shape) == 4 and shape[3] in (1, 3)))
        floats = kind in ("float16", "bfloat16", "float32", "float64") and len(shape) in (2, 4)
        if not (pixels or floats):
            raise InputError(f"{name} is {shape} {kind}; expected {EXPECTED}")
        if 0 in shape:
            raise InputError(f"{name} is {shape}, which holds nothing; expected {EXPECTED}")
        self.name = name
        self.length = shape[0]
        self.values = values

    def read(self, frames: range) -> Tensor:
        part = self.values[frames.start : frames.stop : frames.step]
        batch = part if isinstance(part, Tensor) else torch.from_numpy(np.array(part))
        if batch.dtype == torch.uint8:
            batch = batch[..., None] if batch.ndim == 3 else batch
            return batch.permute(0, 3, 1, 2).float() / 255
        return batch if batch.dtype == torch.float64 else batch.float()


def read_array(path: Path) -> ArrayTraverse:
    """An `.npy` file of frames or features, memory-mapped.

    Raises:
        InputError: not a whole .npy file, or an array of another shape or type.
    """
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
        if not isinstance(values, np.ndarray):
            raise ValueError("several arrays in one file")
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path} is no whole .npy array; expected {EXPECTED}") from error
    return ArrayTraverse(values, str(path))


def as_traverse(source: Traverse | Tensor) -> Traverse:
    """A tensor or array of frames or features as a traverse; a traverse as it is.

    Raises:
        InputError: anything else, such as the address of a source.
    """
    if isinstance(source, Traverse):
        return source
    if not isinstance(source, Tensor | np.ndarray):
        raise InputError(
            f"got a {type(source).__name__}; expected a Traverse, such as open_source gives, or a tensor"
        )
    return ArrayTraverse(source)
