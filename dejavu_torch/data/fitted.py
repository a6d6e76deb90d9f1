"""Frames of a traverse resized, while decoding if the reader supports it."""

from __future__ import annotations

import copy
from collections.abc import Iterator

from torch import Tensor

from dejavu_torch.data.files import LARGEST
from dejavu_torch.data.folder import ImageFolder
from dejavu_torch.data.frame_range import Chain, FrameRange, Selection
from dejavu_torch.data.video import Video
from dejavu_torch.resize import is_stretched, resize_frames
from dejavu_torch.types import InputError, Traverse


class Fitted(Selection):
    """Frames converted to another shape (C,H,W): resized, turned grey, or the grey channel repeated."""

    def __init__(self, traverse: Traverse, shape: tuple[int, ...]) -> None:
        if len(traverse.frame_shape) != 3 or len(shape) != 3:
            raise InputError(f"{traverse.name} and the map differ in kind; expected frames, not features")
        super().__init__(traverse, range(LARGEST if traverse.length is None else traverse.length))
        self.shape, self.sized = shape, True
        self.length, self.place, self.cut = traverse.length, traverse.place, traverse.cut

    def _read(self, frame: Tensor | range, size: int) -> Iterator[Tensor]:
        return map(self._fit, super()._read(frame, self.traverse.batch_size(size)))

    def _fit(self, batch: Tensor) -> Tensor:
        channels, height, width = self.shape
        frames = resize_frames(batch, (height, width))
        if frames.shape[1] == channels:
            return frames
        if frames.shape[1] == 3:
            from kornia.color import rgb_to_grayscale  # slow to import

            frames = rgb_to_grayscale(frames)
        return frames.expand(-1, channels, -1, -1)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        return self.shape

    def identity(self) -> str:
        return f"{self.traverse.identity()} {' x '.join(map(str, self.shape))}"


def fitted(traverse: Traverse, shape: tuple[int, ...]) -> Traverse:
    """The traverse with frames of this shape (C,H,W)."""
    return traverse if tuple(traverse.frame_shape) == tuple(shape) else Fitted(traverse, shape)


def at_size(traverse: Traverse, size: tuple[int, int]) -> Traverse:
    """The frames of a traverse at another size (height, width); images and videos are decoded at it."""
    other = copy.copy(traverse)
    other.sized = True
    if isinstance(other, ImageFolder):
        other.same_aspect, other._first = True, None  # the user did not ask for this size
    if isinstance(other, (Video, ImageFolder)):
        other.height, other.width = size
    elif isinstance(other, Chain):
        other.traverses = [at_size(one, size) for one in other.traverses]
    elif isinstance(other, FrameRange):
        other.traverse = at_size(other.traverse, size)
    else:
        return Fitted(traverse, (traverse.frame_shape[0], *size))
    return other


def size_like(own: tuple[int, ...], shape: tuple[int, ...]) -> tuple[int, int]:
    """(H,W) of a shape (C,H,W) if frames of size `own` have the same aspect ratio, else `own`."""
    height, width = own
    same = len(shape) == 3 and not is_stretched((height, width), (shape[1], shape[2]))
    return (shape[1], shape[2]) if same else (height, width)


def resize_like(frames: Tensor, shape: tuple[int, ...] | None) -> Tensor:
    """Frames (B,C,H,W) resized by `size_like`; features unchanged."""
    if frames.ndim != 4 or shape is None:
        return frames
    return resize_frames(frames, size_like(frames.shape[2:], shape))
