"""Part of a traverse, and traverses whose frames can be read in any order."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator

from torch import Tensor

from dejavu_torch.data.files import LARGEST
from dejavu_torch.data.selection import Selection
from dejavu_torch.types import InputError, Traverse


class IndexedTraverse(Traverse):
    """A traverse of known length that reads only the frames asked for; a subclass says how, in `read`."""

    length: int
    seeks = True

    @abstractmethod
    def read(self, frames: range) -> Tensor:
        """The frames of a range, which is not empty, as one batch."""

    def batches(self, size: int) -> Iterator[Tensor]:
        yield from self.select(range(self.length), size)

    def between(self, start: int, stop: int) -> Iterator[Tensor]:
        yield from self.select(range(start, stop), self.batch_size())

    def select(self, frames: range, size: int) -> Iterator[Tensor]:
        if size < 1:
            raise InputError(f"a batch holds {size} frames; expected at least 1")
        there = range(frames.start, min(frames.stop, self.length), frames.step)
        for first in range(0, len(there), size):
            yield self.read(there[first : first + size])


class FrameRange(Selection):
    """The frames [start, stop) of a traverse, every step-th of them; names and positions follow.

    Args:
        traverse: any traverse.
        start: the first frame, from 0. stop: the end, which is left out; 0 is that of the traverse.
        step: how many frames to go on from one to the next.

    Convention: frames count from 0 again; `place` and `cut` keep their values.

    Raises:
        InputError: start, stop or step out of range; while reading, a traverse of unknown length that has
            no such frames.

    Example:
        >>> import torch
        >>> from dejavu_torch.data.arrays import ArrayTraverse
        >>> part = FrameRange(ArrayTraverse(torch.arange(6.0)[:, None]), start=1, stop=6, step=2)
        >>> part.length, next(part.batches(64)).flatten()
        (3, tensor([1., 3., 5.]))
    """

    frame: range

    def __init__(self, traverse: Traverse, start: int = 0, stop: int = 0, step: int = 1) -> None:
        length = traverse.length
        stops = stop == 0 or start < stop
        beyond = max(start, stop) > LARGEST or (length is not None and max(start + 1, stop) > length)
        if start < 0 or step < 1 or not stops or beyond:
            given = (("start", start, 0), ("stop", stop, 0), ("step", step, 1))
            told = ", ".join(f"{name}={value}" for name, value, default in given if value != default)
            part = f"a part of its {'' if length is None else f'{length} '}frames"
            expected = "a step of at least 1" if step < 1 else part
            raise InputError(f"{traverse.name}: {told}; expected {expected}")
        end = stop or length or LARGEST
        # a longer step takes one frame as well
        super().__init__(traverse, range(start, end, min(step, max(1, end - start))))
        self.name = f"{traverse.name}[{start}:{stop or ''}{f':{step}' if step > 1 else ''}]"
        if length is None:
            self.length = None
        if traverse.cut is not None:
            self.cut = traverse.cut[0], traverse.cut[1][start : stop or None : self.frame.step]
        self._least = len(self.frame) if stop else 1

    def batches(self, size: int) -> Iterator[Tensor]:
        count = 0
        for batch in super().batches(size):
            count += len(batch)
            yield batch
        if count < self._least:
            raise InputError(f"{self.name} holds {count} frames; expected {self._least} or more")

    def identity(self) -> str:
        return f"{self.frame} of {self.traverse.identity()}"
