"""Traverses read in any order, parts of a traverse, and several joined to one."""

from __future__ import annotations

from abc import abstractmethod
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import accumulate
from pathlib import Path

import torch
from torch import Tensor

from dejavu_torch.data.files import LARGEST
from dejavu_torch.types import InputError, Traverse


class IndexedTraverse(Traverse):
    """A traverse of known length that reads only the requested frames; a subclass implements `read`."""

    length: int
    seeks = True

    @abstractmethod
    def read(self, frames: range) -> Tensor:
        """The frames of a non-empty range as one batch."""

    def batches(self, size: int) -> Iterator[Tensor]:
        yield from self.select(range(self.length), size)

    def between(self, start: int, stop: int) -> Iterator[Tensor]:
        yield from self.select(range(start, stop), self.batch_size())

    def select(self, frames: range, size: int) -> Iterator[Tensor]:
        if size < 1:
            raise InputError(f"a batch holds {size} frames; expected at least 1")
        existing = range(frames.start, min(frames.stop, self.length), frames.step)
        for first in range(0, len(existing), size):
            yield self.read(existing[first : first + size])


class Selection(Traverse):
    """The frames of a traverse with these numbers, with their names, times and places.

    Args:
        frame: (n,) int64, never decreasing, or a range.

    Convention: frames are renumbered from 0. A traverse that does not seek is read through once.
    """

    skips = True  # whether gaps are skipped if the traverse seeks

    def __init__(self, traverse: Traverse, frame: Tensor | range) -> None:
        self.traverse, self.frame = traverse, frame
        self.name, self.length = traverse.name, len(frame)
        self.seeks, self.sized, self.ordered = traverse.seeks, traverse.sized, traverse.ordered
        if traverse.place is not None:
            at = slice(frame.start, frame.stop, frame.step) if isinstance(frame, range) else frame
            self.place = traverse.place[at].contiguous()

    def batches(self, size: int) -> Iterator[Tensor]:
        return self._read(self.frame, size)

    def between(self, start: int, stop: int) -> Iterator[Tensor]:
        return self._read(self.frame[start:stop], self.batch_size())

    def _read(self, frame: Tensor | range, size: int) -> Iterator[Tensor]:
        if not len(frame):
            return
        if isinstance(frame, range):
            yield from self.traverse.select(frame, size)
            return
        whole = range(int(frame[0]), int(frame[-1]) + 1)
        for run in runs(frame) if self.skips and self.traverse.seeks else [whole]:
            yield from pick_frames(self.traverse.select(run, size), run, frame, size)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        return self.traverse.frame_shape

    def state(self, start: int, stop: int) -> str:
        part = self.frame[start:stop]
        return self.traverse.state(int(part[0]), int(part[-1]) + 1) if len(part) else ""

    def frame_name(self, i: int) -> str:
        return self.traverse.frame_name(int(self.frame[i]))

    def frame_time(self, i: int) -> float:
        return self.traverse.frame_time(int(self.frame[i]))


class FrameRange(Selection):
    """Every step-th of the frames [start, stop) of a traverse; a stop of 0 is its end.

    Raises:
        InputError: start, stop or step out of range; while reading, missing frames (unknown length).

    Example:
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
            frames = "frames" if length is None else f"{length} frames"
            expected = "a step of at least 1" if step < 1 else f"a part of its {frames}"
            raise InputError(f"{traverse.name}: start={start}, stop={stop}, step={step}; expected {expected}")
        end = stop or length or LARGEST
        super().__init__(traverse, range(start, end, min(step, max(1, end - start))))  # at least one frame
        self.name = f"{traverse.name}[{start}:{stop or ''}{f':{step}' if step > 1 else ''}]"
        self.length = None if length is None else self.length
        if traverse.cut is not None:
            self.cut = traverse.cut[0], traverse.cut[1][start : stop or None : self.frame.step]
        self._least = len(self.frame) if stop else 1

    def batches(self, size: int) -> Iterator[Tensor]:
        count = 0
        for batch in super().batches(size):
            count += len(batch)
            yield batch
        if count < self._least:
            raise InputError(f"{self.name} has {count} frames; expected {self._least} or more")

    def identity(self) -> str:
        return f"{self.frame} of {self.traverse.identity()}"


class Chain(Traverse):
    """Several traverses with frames of one shape, concatenated: parts of one route.

    Convention: frame names start with the name of their traverse: `morning/0001.png`. `place` is None, as
        each traverse has its own numbering.
    """

    def __init__(self, traverses: Sequence[Traverse]) -> None:
        self.traverses = list(traverses)
        if not self.traverses:
            raise InputError("a chain of no traverses; expected at least one")
        first = self.traverses[0]
        for other in self.traverses:
            if other.frame_shape != first.frame_shape:
                own, expected = (" x ".join(map(str, one.frame_shape)) for one in (other, first))
                raise InputError(f"{other.name} has frames of {own}; expected {expected} like {first.name}")
        self.name = " + ".join(one.name for one in self.traverses)
        self.seeks = all(one.seeks for one in self.traverses)
        self.sized = any(one.sized for one in self.traverses)
        self.ordered = all(one.ordered for one in self.traverses)
        lengths = [one.length for one in self.traverses]
        self.length = None if None in lengths else sum(length or 0 for length in lengths)

    @cached_property
    def starts(self) -> list[int]:
        """The first frame of each traverse, then the total number of frames."""
        return list(accumulate((one.count() for one in self.traverses), initial=0))

    def count(self) -> int:
        return self.starts[-1]

    def batches(self, size: int) -> Iterator[Tensor]:
        for traverse in self.traverses:
            yield from traverse.batches(size)

    def between(self, start: int, stop: int) -> Iterator[Tensor]:
        for traverse, first, last in self._overlaps(start, stop):
            yield from traverse.between(first, last)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        return self.traverses[0].frame_shape

    def identity(self) -> str:
        return " + ".join(one.identity() for one in self.traverses)

    def state(self, start: int, stop: int) -> str:
        return " + ".join(one.state(first, last) for one, first, last in self._overlaps(start, stop))

    def frame_name(self, i: int) -> str:
        traverse, i = self._at(i)
        name = traverse.frame_name(i)
        return name and f"{Path(traverse.name).name}/{name}"

    def frame_time(self, i: int) -> float:
        traverse, i = self._at(i)
        return traverse.frame_time(i)

    def _overlaps(self, start: int, stop: int) -> Iterator[tuple[Traverse, int, int]]:
        """Each traverse within the frames [start, stop), and its own frames [first, last) there."""
        for traverse, first, end in zip(self.traverses, self.starts, self.starts[1:], strict=False):
            if max(start, first) < min(stop, end):
                yield traverse, max(0, start - first), min(stop, end) - first

    def _at(self, i: int) -> tuple[Traverse, int]:
        """The traverse of frame i, and its number there."""
        which = bisect_right(self.starts, i, hi=len(self.traverses)) - 1
        return self.traverses[which], i - self.starts[which]


def chained(traverses: Sequence[Traverse]) -> Traverse:
    """Several traverses as one route; a single one unchanged."""
    return traverses[0] if len(traverses) == 1 else Chain(traverses)


def parts_of(traverse: Traverse) -> list[Traverse]:
    """The traverses of a chain; [traverse] of any other."""
    return traverse.traverses if isinstance(traverse, Chain) else [traverse]


def pick_frames(batches: Iterator[Tensor], span: range, frame: Tensor, size: int) -> Iterator[Tensor]:
    """The frames with these numbers (never decreasing) from the batches of a contiguous span of frames."""
    start, stop = torch.searchsorted(frame, torch.tensor([span.start, span.stop])).tolist()
    first, frame = span.start, frame[start:stop]
    for batch in batches:
        ready = int(torch.searchsorted(frame, first + len(batch)))
        for part in frame[:ready].split(size) if ready else ():
            yield batch[part - first]
        first, frame = first + len(batch), frame[ready:]
        if not len(frame):
            return


def runs(numbers: Tensor) -> list[range]:
    """Increasing whole numbers as contiguous ranges: 1, 2, 3, 7 as 1 to 3 and 7."""
    last = torch.cat([numbers.diff() != 1, numbers.new_ones(min(1, len(numbers)), dtype=torch.bool)])
    first = last.roll(1)  # a run starts after the end of the previous one
    return [range(a, b + 1) for a, b in zip(numbers[first].tolist(), numbers[last].tolist(), strict=True)]
