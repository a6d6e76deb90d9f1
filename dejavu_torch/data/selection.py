"""Some frames of a traverse."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from dejavu_torch.types import Traverse


class Selection(Traverse):
    """The frames of a traverse with these numbers.

    Args:
        frame: (n,) int64, increasing.

    Convention: frames count from 0 again. A traverse that cannot begin anywhere is read through once.

    Example:
        >>> from dejavu_torch.data.arrays import ArrayTraverse
        >>> some = Selection(ArrayTraverse(torch.arange(9.0)[:, None]), torch.tensor([1, 2, 6]))
        >>> torch.cat(list(some.batches(64))).flatten()
        tensor([1., 2., 6.])
    """

    length: int

    def __init__(self, traverse: Traverse, frame: Tensor) -> None:
        self.traverse, self.frame = traverse, frame
        self.name, self.length = traverse.name, len(frame)

    def batches(self, size: int) -> Iterator[Tensor]:
        if not self.length:
            return
        if not self.traverse.seeks:
            yield from self._of(range(int(self.frame[0]), int(self.frame[-1]) + 1), self.frame, size)
            return
        for run in runs(self.frame):
            yield from self._of(run, torch.tensor(run), size)

    def _of(self, span: range, frame: Tensor, size: int) -> Iterator[Tensor]:
        first = span.start
        for batch in self.traverse.select(span, size):
            wanted = frame[(frame >= first) & (frame < first + len(batch))]
            if len(wanted):
                yield batch[wanted - first]
            first += len(batch)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        return self.traverse.frame_shape


def runs(numbers: Tensor) -> list[range]:
    """Increasing whole numbers as runs without gaps.

    Example:
        >>> runs(torch.tensor([1, 2, 3, 7]))
        [range(1, 4), range(7, 8)]
    """
    last = torch.cat([numbers.diff() != 1, numbers.new_ones(min(1, len(numbers)), dtype=torch.bool)])
    first = last.roll(1)  # behind the last of one run begins the next
    return [range(a, b + 1) for a, b in zip(numbers[first].tolist(), numbers[last].tolist(), strict=True)]
