"""Arrays of frames or of precomputed features as traverses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.data.files import read_text, reading
from dejavu_torch.data.folder import ROUNDING, numbers_increase
from dejavu_torch.data.maker import read_maker
from dejavu_torch.text import printable
from dejavu_torch.types import InputError, Traverse, expect

UNNAMED = "the array"
EXPECTED = (
    "frames (N,H,W), (N,H,W,3) or (N,3,H,W) uint8, tensors also (N,C,H,W) float in [0, 1], or features (N,D) "
    "float"
)
CHANNELS = (1, 3)  # of uint8 frames


class ArrayTraverse(Traverse):
    """The frames or features of an array or tensor; a memory-mapped file is read only as needed.

    Args:
        values: uint8 frames (N,H,W), (N,H,W,3) or (N,3,H,W), colours last where both fit; float frames
            (N,C,H,W) in [0, 1], read as float32; or float features (N,D).
        name: for messages.

    Raises:
        InputError: another shape or type, or no frames; while reading a file, NaN or float frames outside
            [0, 1].
    """

    path: Path | None = None  # of the file that holds exactly these values

    def __init__(self, values: Tensor | np.ndarray, name: str = UNNAMED) -> None:
        shape = tuple(values.shape)
        kind = str(values.dtype).removeprefix("torch.") if isinstance(values, Tensor) else values.dtype.name
        colours = [len(shape) == 4 and shape[axis] in CHANNELS for axis in (1, 3)]
        pixels = kind == "uint8" and (len(shape) == 3 or any(colours))
        floats = kind in ("float16", "bfloat16", "float32", "float64") and len(shape) in (2, 4)
        colours_last = floats and colours == [False, True]
        packed = "; bits that are packed: np.unpackbits(x, axis=1).astype(np.float32)"
        expected = EXPECTED + packed * (kind == "uint8" and len(shape) == 2)
        expect((pixels or floats) and not colours_last, expected, f"{name} is {shape} {kind}")
        expect(0 not in shape, EXPECTED, f"{name} is {shape}, which is empty")
        self.name = name
        self.values = values

    def __len__(self) -> int:
        return len(self.values)

    def read(self, frames: range | list[int]) -> Tensor:
        part = self._slice(frames)
        if part.dtype == torch.uint8:
            part = part[..., None] if part.ndim == 3 else part
            return (part.permute(0, 3, 1, 2) if part.shape[3] in CHANNELS else part).float() / 255
        # features may need their double precision, frames do not
        batch = part if part.dtype == torch.float64 and part.ndim == 2 else part.float()
        if batch.ndim == 4 and isinstance(self.values, np.memmap):  # tensors are not checked
            low, high = batch.flatten(1).aminmax(dim=1)
            bad = ~((low >= -ROUNDING) & (high <= 1 + ROUNDING))  # also True for NaN
            if bad.any():
                at = int(bad.nonzero()[0])
                finite = (low[at] - high[at]).isfinite()
                seen = f"values from {low[at]:.4g} to {high[at]:.4g}" if finite else "NaN or infinite values"
                raise InputError(f"{self.name}: frame {frames[at]} has {seen}; expected 0 to 1")
            batch.clamp_(0, 1)
        return batch

    def _slice(self, frames: range | list[int]) -> Tensor:
        """The values of frames, in their stored type."""
        some = slice(frames.start, frames.stop, frames.step) if isinstance(frames, range) else frames
        part = self.values[some]
        if isinstance(part, Tensor):
            return part
        return torch.from_numpy(np.array(part, dtype=part.dtype.newbyteorder("=")))  # a writable copy

    def __reduce__(self) -> str | tuple[object, ...]:
        # a file is pickled as its path: the other process opens it
        return super().__reduce__() if self.path is None else (read_array, (self.path,))


def read_array(path: Path) -> ArrayTraverse:
    """An `.npy` file of frames or features, memory-mapped.

    Features (N,D) take the names of their images from `X.txt` next to `X.npy`, one per line, and what made
    them from the entry "maker" of `X.json`, if these exist.

    Raises:
        InputError: not a complete .npy file, an array of another shape or type, or a wrong number of names.
    """
    with reading(path, "is not a complete .npy array", EXPECTED):
        values = np.lib.format.open_memmap(path, mode="r")
        traverse = ArrayTraverse(values, printable(path))
    traverse.path, traverse.maker = path, read_maker(path) if values.ndim == 2 else ""
    text = path.with_suffix(".txt")
    if values.ndim == 2 and text.exists():
        expected = f"{len(values)} names, one line for each row of {path}, or no such file"
        names = [line.strip() for line in read_text(text, expected).splitlines() if line.strip()]
        swapped = len(names) == values.shape[1]
        seen = (
            f"{text} has {len(names)} names"
            + ", as many as the array has columns (save its transpose)" * swapped
        )
        expect(len(names) == len(values), expected, seen)
        traverse.names, traverse.ordered = names, numbers_increase(names)
    return traverse
