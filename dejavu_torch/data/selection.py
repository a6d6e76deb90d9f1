"""Some frames of a traverse, by their numbers."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from dejavu_torch.types import Traverse


class Selection(Traverse):
    """The frames of a traverse with these numbers; names, times and places follow.

    Args:
        frame: (n,) int64, never decreasing, or a range.

    Convention: frames count from 0 again. A traverse that does not seek is read through once.

    Example:
        >>> from dejavu_torch.data.arrays import ArrayTraverse
        >>> some = Selection(ArrayTraverse(torch.arange(9.0)[:, None]), torch.tensor([1, 2, 6]))
        >>> torch.cat(list(some.batches(64))).flatten()
        tensor([1., 2., 6.])
    """

    skips = True  # whether a gap is not read, if the traverse seeks

    def __init__(self, traverse: Traverse, frame: Tensor | range) -> None:
        self.traverse, self.frame = traverse, frame
        self.name, self.length = traverse.name, len(frame)
        self.seeks, self.sized = traverse.seeks, traverse.sized
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
            yield from picked(self.traverse.select(run, size), run, frame, size)

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


def picked(batches: Iterator[Tensor], span: range, frame: Tensor, size: int) -> Iterator[Tensor]:
    """The frames with these numbers, never decreasing, out of batches of the frames of a span."""
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
    """Increasing whole numbers as runs without gaps.

    Example:
        >>> runs(torch.tensor([1, 2, 3, 7]))
        [range(1, 4), range(7, 8)]
    """
    last = torch.cat([numbers.diff() != 1, numbers.new_ones(min(1, len(numbers)), dtype=torch.bool)])
    first = last.roll(1)  # after the last of one run the next begins
    return [range(a, b + 1) for a, b in zip(numbers[first].tolist(), numbers[last].tolist(), strict=True)]
