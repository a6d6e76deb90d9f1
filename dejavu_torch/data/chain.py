"""Several traverses, one behind the other, as one."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import accumulate
from pathlib import Path

from torch import Tensor

from dejavu_torch.types import InputError, Traverse


class Chain(Traverse):
    """The frames of several traverses, one behind the other: parts of one route.

    Args:
        traverses: at least one; all of frames of one size, or of features of one dimension.

    Convention: a frame's name begins with that of its traverse: `morning/0001.png`. Where it truly was is
        not known, as the traverses count for themselves.

    Raises:
        InputError: frames of different sizes.

    Example:
        >>> import torch
        >>> from dejavu_torch.data.arrays import ArrayTraverse
        >>> parts = [ArrayTraverse(torch.zeros(3, 2)), ArrayTraverse(torch.ones(4, 2))]
        >>> torch.cat(list(Chain(parts).between(2, 5)))[:, 0]
        tensor([0., 1., 1.])
    """

    def __init__(self, traverses: Sequence[Traverse]) -> None:
        self.traverses = list(traverses)
        if not self.traverses:
            raise InputError("a chain of no traverses; expected at least one")
        first, *others = self.traverses
        shape = first.frame_shape
        for other in others:
            if other.frame_shape != shape:
                told = [" x ".join(map(str, one)) for one in (other.frame_shape, shape)]
                seen = f"{other.name} has frames of {told[0]}"
                raise InputError(f"{seen}; expected {told[1]} as {first.name}, which it follows")
        self.name = " + ".join(one.name for one in self.traverses)
        self.seeks = all(one.seeks for one in self.traverses)
        self.sized = any(one.sized for one in self.traverses)
        lengths = [one.length for one in self.traverses]
        if None not in lengths:
            self.length = sum(length or 0 for length in lengths)

    @cached_property
    def starts(self) -> list[int]:
        """The frame with which each begins, and the number of all frames."""
        return list(accumulate((one.count() for one in self.traverses), initial=0))

    def count(self) -> int:
        return self.starts[-1]

    def batches(self, size: int) -> Iterator[Tensor]:
        for traverse in self.traverses:
            yield from traverse.batches(size)

    def between(self, start: int, stop: int) -> Iterator[Tensor]:
        for traverse, first, last in self._within(start, stop):
            yield from traverse.between(first, last)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        return self.traverses[0].frame_shape

    def identity(self) -> str:
        return " + ".join(one.identity() for one in self.traverses)

    def state(self, start: int, stop: int) -> str:
        return " + ".join(traverse.state(first, last) for traverse, first, last in self._within(start, stop))

    def frame_name(self, i: int) -> str:
        traverse, i = self._at(i)
        name = traverse.frame_name(i)
        return name and f"{Path(traverse.name).name}/{name}"

    def frame_time(self, i: int) -> float:
        traverse, i = self._at(i)
        return traverse.frame_time(i)

    def _within(self, start: int, stop: int) -> Iterator[tuple[Traverse, int, int]]:
        """Which frames of which traverses the frames [start, stop) are."""
        for traverse, first, end in zip(self.traverses, self.starts, self.starts[1:], strict=False):
            if max(start, first) < min(stop, end):
                yield traverse, max(0, start - first), min(stop, end) - first

    def _at(self, i: int) -> tuple[Traverse, int]:
        """The traverse that frame i is of, and its number there."""
        which = bisect_right(self.starts, i, hi=len(self.traverses)) - 1
        return self.traverses[which], i - self.starts[which]


def chained(traverses: Sequence[Traverse]) -> Traverse:
    """Several traverses as one route; a single one as it is."""
    return traverses[0] if len(traverses) == 1 else Chain(traverses)


def parts_of(traverse: Traverse) -> list[Traverse]:
    """What a traverse was chained of; itself where it was not."""
    return traverse.traverses if isinstance(traverse, Chain) else [traverse]
