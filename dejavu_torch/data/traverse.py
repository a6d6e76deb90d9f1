"""Parts of a traverse, frames of another size, several traverses as one, and any user's frames as one."""

from __future__ import annotations

import logging
import math
from bisect import bisect_right
from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from itertools import accumulate, groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.data.files import LARGEST
from dejavu_torch.data.maker import check_maker
from dejavu_torch.resize import is_stretched, resize_frames
from dejavu_torch.types import Coordinates, InputError, Traverse, expect

log = logging.getLogger("dejavu_torch")


KEPT_BYTES = 2**27  # bytes of the frames that are kept of a traverse
PARTS = "rows=first:stop, columns=first:stop"  # of the picture of an area
KEPT_FRAMES = 10_000  # longer traverses are read in parts, and again


class Part(Traverse):
    """The frames of a traverse with these numbers, which may repeat, renumbered from 0.

    Args:
        frame: (n,) int64, or a range.
    """

    def __init__(self, traverse: Traverse, frame: Tensor | range) -> None:
        self.traverse, self.frame, self.name = traverse, frame, traverse.name
        self.sized, self.ordered = traverse.sized, traverse.ordered
        self.maker, self.turn = traverse.maker, traverse.turn
        if isinstance(frame, range):
            self.beyond = len(range(frame.start, len(traverse) + traverse.beyond, frame.step)) - len(frame)
        self.times, self.places, self.headings = (
            None if values is None else values[torch.as_tensor(frame)]
            for values in (traverse.times, traverse.places, traverse.headings)
        )
        for name in ("coordinates", "odometer"):
            if (known := getattr(traverse, name)) is not None:
                setattr(self, name, known._replace(values=known.values[torch.as_tensor(frame)]))
        if isinstance(frame, range) and frame == range(len(traverse)):
            self.layout = traverse.layout
        if traverse.cut is not None and isinstance(frame, range):
            image, cuts = traverse.cut
            self.cut = image, cuts[frame.start : frame.stop : frame.step]

    def __len__(self) -> int:
        return len(self.frame)

    def read(self, frames: range | list[int]) -> Tensor:
        if isinstance(self.frame, range):
            return self.traverse[[self.frame[i] for i in frames]]
        numbers = self.frame[torch.as_tensor(frames)].tolist()
        if len({*numbers}) == len(numbers):
            return self.traverse[numbers]
        distinct, index = torch.tensor(numbers).unique(return_inverse=True)  # each is read once
        return self.traverse[distinct][index]

    @cached_property
    def names(self) -> Sequence[str]:  # type: ignore[override]
        names = self.traverse.names
        return [names[int(i)] for i in self.frame] if names else ()

    @cached_property
    def frame_shape(self) -> tuple[int, ...]:
        return self.traverse.frame_shape

    @property
    def deep(self) -> bool:
        return self.traverse.deep


def frame_range(traverse: Traverse, start: int = 0, stop: int = 0, step: int = 1) -> Part:
    """Every step-th of the frames [start, stop) of a traverse; a stop of 0 is its end.

    Raises:
        InputError: start, stop or step out of range, or an area.

    Example:
        >>> from dejavu_torch.data.arrays import ArrayTraverse
        >>> frame_range(ArrayTraverse(torch.arange(6.0)[:, None]), start=1, stop=6, step=2)[:].flatten()
        tensor([1., 3., 5.])
    """
    asked = f"{traverse.name}: start={start}, stop={stop}, step={step}"
    traverse.layout.expect_route(f"{PARTS} or stride=..., as it is an area", asked)
    length = len(traverse)
    if start < 0 or step < 1 or not (stop == 0 or start < stop) or max(start + 1, stop) > length:
        expected = "a step of at least 1" if step < 1 else f"a part of its {length} frames"
        raise InputError(f"{asked}; expected {expected}")
    part = Part(traverse, range(start, stop or length, min(step, LARGEST)))
    part.name = f"{traverse.name}[{start}:{stop or ''}{f':{step}' if step > 1 else ''}]"
    return part


class Chain(Traverse):
    """Several traverses with frames of one shape, concatenated: parts of one route.

    Convention: frame names start with the name of their traverse: `morning/0001.png`. `places` is None, as
        each traverse has its own numbering.
    """

    def __init__(self, traverses: Sequence[Traverse]) -> None:
        self.traverses = list(traverses)
        expect(self.traverses, "at least one", "a chain of no traverses")
        first = self.traverses[0]
        for other in self.traverses:
            if other.frame_shape != first.frame_shape:
                seen, expected = (" x ".join(map(str, traverse.frame_shape)) for traverse in (other, first))
                raise InputError(f"{other.name} has frames of {seen}; expected {expected} like {first.name}")
        self.name = " + ".join(traverse.name for traverse in self.traverses)
        self.sized = any(traverse.sized for traverse in self.traverses)
        self.ordered = all(traverse.ordered for traverse in self.traverses)
        for other in self.traverses:
            check_maker(first.maker, first.name, other)
        self.maker = first.maker if all(traverse.maker for traverse in self.traverses) else ""
        self.starts = list(accumulate(map(len, self.traverses), initial=0))
        for name in ("times", "headings"):
            each = [getattr(traverse, name) for traverse in self.traverses]
            if any(values is not None for values in each):
                nan = [torch.full((len(one),), torch.nan, dtype=torch.float64) for one in self.traverses]
                setattr(
                    self, name, torch.cat([b if a is None else a for a, b in zip(each, nan, strict=True)])
                )
        known = [traverse.coordinates for traverse in self.traverses if traverse.coordinates is not None]
        kinds = {(one[1:], one.values.shape[1]) for one in known}
        if len(known) == len(self.traverses) and len(kinds) == 1:
            self.coordinates = Coordinates(torch.cat([one.values for one in known]), *known[0][1:])

    def __len__(self) -> int:
        return self.starts[-1]

    def read(self, frames: range | list[int]) -> Tensor:
        owners = groupby(frames, lambda i: bisect_right(self.starts, i, hi=len(self.traverses)) - 1)
        parts = [self.traverses[k][[i - self.starts[k] for i in group]] for k, group in owners]
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    @cached_property
    def frame_shape(self) -> tuple[int, ...]:
        return self.traverses[0].frame_shape

    @property
    def deep(self) -> bool:
        return any(traverse.deep for traverse in self.traverses)

    @cached_property
    def names(self) -> Sequence[str]:  # type: ignore[override]
        each = ((Path(member.name).name, member.names or [""] * len(member)) for member in self.traverses)
        names = [name and f"{folder}/{name}" for folder, listed in each for name in listed]
        return names if any(names) else ()


def chained(traverses: Sequence[Traverse]) -> Traverse:
    """Several traverses as one route; a single one unchanged."""
    return traverses[0] if len(traverses) == 1 else Chain(traverses)


def parts_of(traverse: Traverse) -> list[Traverse]:
    """The traverses of a chain; [traverse] of any other."""
    return traverse.traverses if isinstance(traverse, Chain) else [traverse]


class Cropped(Part):
    """Frames without their outermost pixels, and with those that a mask hides black.

    Args:
        crop: (top, bottom, left, right), pixels to remove. mask: (1,H,W), 0 hides; resized to the frames.

    Raises:
        InputError: no frames, nothing left of them, or a crop of an area.
    """

    def __init__(
        self, traverse: Traverse, crop: Sequence[int] = (0, 0, 0, 0), mask: Tensor | None = None
    ) -> None:
        super().__init__(traverse, range(len(traverse)))
        shape, (top, bottom, left, right) = traverse.frame_shape, crop
        fits = len(shape) == 3 and min(crop) >= 0 and top + bottom < shape[1] and left + right < shape[2]
        seen = f"{traverse.name}: crop={','.join(map(str, crop))} of {' x '.join(map(str, shape))}"
        expect(fits, "frames, of which some pixels are left", seen)
        if any(crop):
            traverse.layout.expect_route(f"{PARTS} and window=..., as it is an area", seen)
        self.box = slice(top, shape[1] - bottom), slice(left, shape[2] - right)
        size = shape[1], shape[2]
        self.mask = None if mask is None else (resize_frames(mask[None], size) >= 0.5).float()

    def read(self, frames: range | list[int]) -> Tensor:
        seen = super().read(frames)
        return (seen if self.mask is None else seen * self.mask)[..., self.box[0], self.box[1]]

    @cached_property
    def frame_shape(self) -> tuple[int, ...]:
        return tuple(self.read(range(1)).shape[1:])


class Whole(Part):
    """Frames of which those that cannot be read are black, so that one damaged file does not stop the others;
    `damaged` has the numbers of these so far, and why. Frames of 0 find nothing, see `Descriptor`."""

    def __init__(self, traverse: Traverse, damaged: dict[int, str] | None = None) -> None:
        super().__init__(traverse, range(len(traverse)))
        self.damaged: dict[int, str] = {} if damaged is None else damaged

    def decoded_at(self, height: int, width: int) -> Whole:
        return Whole(at_size(self.traverse, (height, width)), self.damaged)

    def read(self, frames: range | list[int]) -> Tensor:
        if self.damaged.keys().isdisjoint(frames):
            with suppress(InputError):
                return super().read(frames)
        return torch.stack([self._one(i) for i in frames])

    def _one(self, i: int) -> Tensor:
        if i not in self.damaged:
            try:
                return self.traverse[i]
            except InputError as error:
                self.damaged[i] = str(error)
        return torch.zeros(self.frame_shape)

    @cached_property
    def frame_shape(self) -> tuple[int, ...]:
        for i in range(len(self)):
            try:
                return tuple(self.traverse[i].shape)
            except InputError as error:
                self.damaged[i] = str(error)
        raise InputError(f"none of the {len(self)} frames of {self.name} can be read: {self.damaged[0]}")


class Kept(Part):
    """Frames that are read once: the first ones are held, up to `KEPT_BYTES` bytes."""

    def __init__(self, traverse: Traverse) -> None:
        super().__init__(traverse, range(len(traverse)))
        held = min(len(self), KEPT_BYTES // (4 * math.prod(self.frame_shape)))
        # of which a system gives only what is written to
        self.values = torch.empty(held, *self.frame_shape, dtype=torch.float32)
        self.known = torch.zeros(len(self), dtype=torch.bool)

    def __getattr__(self, name: str) -> Any:
        """What only this kind of traverse has, such as the metres of a simulated one."""
        if name == "traverse":  # of a copy that is being made
            raise AttributeError(name)
        return getattr(self.traverse, name)

    def read(self, frames: range | list[int]) -> Tensor:
        numbers = torch.as_tensor(frames)
        known = self.known[numbers]
        if known.all():
            return self.values[numbers]
        read = super().read(numbers[~known].tolist())
        holds = numbers[~known] < len(self.values)
        new = numbers[~known][holds]
        self.values[new], self.known[new] = read[holds], True
        if not known.any():
            return read
        mixed = read.new_empty(len(numbers), *self.frame_shape)
        mixed[known], mixed[~known] = self.values[numbers[known]], read
        return mixed


def kept(traverse: Traverse) -> Traverse:
    """The traverse, with its frames held once they are read; a long one, or ready features, unchanged."""
    if len(traverse.frame_shape) != 3 or len(traverse) > KEPT_FRAMES:
        return traverse
    return Kept(traverse)


class Fitted(Part):
    """Frames converted to another shape (C,H,W): resized, turned grey, or the grey channel repeated."""

    def __init__(self, traverse: Traverse, shape: tuple[int, ...]) -> None:
        if len(traverse.frame_shape) != 3 or len(shape) != 3:
            raise InputError(f"{traverse.name} and the map differ in kind; expected frames, not features")
        super().__init__(traverse, range(len(traverse)))
        self.shape, self.sized = shape, True

    def read(self, frames: range | list[int]) -> Tensor:
        parts, at_once = [], self.traverse.at_once(len(frames))  # these may be larger
        for start in range(0, len(frames), at_once):
            parts.append(as_shape(super().read(frames[start : start + at_once]), self.shape))
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    @cached_property
    def frame_shape(self) -> tuple[int, ...]:
        return self.shape


def as_shape(frames: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Frames (B,C,H,W) as ones of this shape: resized, turned grey, or the grey channel repeated."""
    channels, height, width = shape
    frames = resize_frames(frames, (height, width))
    if frames.shape[1] == 3 and channels == 1:
        from kornia.color import rgb_to_grayscale  # slow to import

        frames = rgb_to_grayscale(frames)
    return frames.expand(-1, channels, -1, -1)


def fitted(traverse: Traverse, shape: tuple[int, ...]) -> Traverse:
    """The traverse with frames of this shape (C,H,W)."""
    return traverse if tuple(traverse.frame_shape) == tuple(shape) else Fitted(traverse, shape)


def at_size(traverse: Traverse, size: tuple[int, int]) -> Traverse:
    """The frames of a traverse at another size (height, width); images and videos are decoded at it."""
    if isinstance(traverse, Chain):
        each = [at_size(member, size) for member in traverse.traverses]
        return traverse.changed(traverses=each, sized=True)
    if type(traverse) is Part:
        return traverse.changed(traverse=at_size(traverse.traverse, size), sized=True)
    if (decoded := getattr(traverse, "decoded_at", None)) is not None:
        return decoded(*size)  # type: ignore[no-any-return]
    return Fitted(traverse, (traverse.frame_shape[0], *size))


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


class Frames(Traverse):
    """A list of frames, or any dataset with `__len__` and `__getitem__`, such as those of torchvision.

    Args:
        dataset: its items are frames (C,H,W) or features (D,) as tensors or arrays, (H,W) or (H,W,3) uint8
            arrays, or PIL images; of a pair such as (image, label), the first. A line tells what was
            converted.

    Shape: frames (n,C,H,W) float32, or features (n,D).

    Raises:
        InputError: no items; while reading, an item of another kind or shape than the first.
    """

    def __init__(self, dataset: Any, name: str = "the dataset") -> None:
        self.dataset, self.name = dataset, name
        expect(len(dataset), "at least one frame", f"{name} is empty")
        first = self._item(0)
        self.shape, how = tuple(first.shape), []
        if isinstance(dataset[0], tuple | list):
            how.append("of each pair the first part is taken")
        if hasattr(_first_of(dataset[0]), "convert"):
            how.append("PIL images are converted to floats in [0, 1]")
        if how:
            log.warning("%s: %s", name, ", ".join(how))

    def __len__(self) -> int:
        return len(self.dataset)

    def read(self, frames: range | list[int]) -> Tensor:
        return torch.stack([self._item(i) for i in frames])

    def _item(self, i: int) -> Tensor:
        item = _first_of(self.dataset[i])
        if hasattr(item, "convert"):  # a PIL image
            item = np.asarray(item if item.mode in ("L", "RGB") else item.convert("RGB"))
        item = torch.from_numpy(item.copy()) if isinstance(item, np.ndarray) else item
        expected = getattr(self, "shape", None)
        if isinstance(item, Tensor) and item.dtype == torch.uint8 and item.ndim in (2, 3):
            item = item[None] if item.ndim == 2 else item if len(item) in (1, 3) else item.permute(2, 0, 1)
            item = item.float() / 255
        elif isinstance(item, Tensor) and item.is_floating_point() and item.ndim in (1, 3):
            item = item.float() if item.ndim == 3 else item
        else:
            kind = f"{tuple(item.shape)} {item.dtype}" if isinstance(item, Tensor) else type(item).__name__
            raise InputError(
                f"item {i} of {self.name} is {kind}; expected a frame (C,H,W), features (D,) or an image"
            )
        seen = f"item {i} of {self.name} has shape {tuple(item.shape)}"
        expect(expected in (None, tuple(item.shape)), f"{expected} as item 0", seen)
        return item


def _first_of(item: object) -> Any:
    return item[0] if isinstance(item, tuple | list) and item else item


def runs(numbers: Tensor) -> list[range]:
    """Increasing whole numbers as contiguous ranges: 1, 2, 3, 7 as 1 to 3 and 7."""
    last = torch.cat([numbers.diff() != 1, numbers.new_ones(min(1, len(numbers)), dtype=torch.bool)])
    first = last.roll(1)  # a run starts after the end of the previous one
    return [range(a, b + 1) for a, b in zip(numbers[first].tolist(), numbers[last].tolist(), strict=True)]
