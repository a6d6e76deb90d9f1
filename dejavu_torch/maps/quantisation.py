"""Quantisation of the lines of a route, and the step that fits a budget."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import accumulate, pairwise

import torch
from torch import Tensor

from dejavu_torch.maps.codec import coded_bytes
from dejavu_torch.maps.spectrum import Transform, frequencies, lines_of
from dejavu_torch.memory import empty

ROUNDING = 0.35  # added before rounding down: a dead zone of 1.3 steps around 0
FINEST = 64  # steps per RMS line: a finer step changes no score
HALVINGS = 14  # of the range of steps, to 0.1 % of a step
NUMBERS_AT_ONCE = 2**23  # numbers at a time
SMALL = 0.05  # share of the mean square of descriptors, below which the mean is cheaper as line 0
CLOSE = 0.995  # of the budget: ends the search of a step for more than NUMBERS_AT_ONCE numbers


@torch.no_grad()
def quantise(lines: Tensor, step: Tensor | float, width: Tensor | None = None) -> Tensor:
    """Lines as integer multiples of the step, 0 below 1 - `ROUNDING` of it. Same shape, float; no gradient.

    Args:
        width: factor on this dead zone for each line, at least 1; see `dead_zone`.
    """
    # in place: the lines of a long route are large
    levels = lines.abs().div_(step).add_(ROUNDING).floor_().copysign_(lines)
    return levels if width is None else levels * (lines.abs() >= (1 - ROUNDING) * step * width)


def dead_zone(
    lines: Tensor, sizes: Sequence[tuple[int, int]], resolution: float, transform: Transform
) -> Tensor | None:
    """Factor on the dead zone of each of (N,K) lines in chunks of these rows and columns: 1 +
    (resolution / P)^2 for a line of period P, (N,1); None if that is 1 for all."""
    if not resolution:
        return None
    squares = [frequencies(rows, columns, transform).square().sum(1) for rows, columns in sizes]
    return (1 + resolution**2 * torch.cat(squares).to(lines))[:, None]


class RouteLines:
    """The lines of a route, chunk by chunk; those of a long route are in a temporary file.

    Args:
        sizes: rows and columns of each chunk; a route has one column. transform, resolution: see `spectrum`,
            `dead_zone`.
        mean: (K,) to subtract; None is the route's in bfloat16, or 0 if it is small and cheaper as line 0.

    Shape: features (N,K), float of any kind.
    """

    def __init__(
        self,
        features: Tensor,
        sizes: Sequence[tuple[int, int]],
        transform: Transform,
        resolution: float = 0.0,
        mean: Tensor | None = None,
    ) -> None:
        places, dimension = features.shape
        self.mean_energy = 0.0  # of a mean among the lines
        self.rows = max(1, NUMBERS_AT_ONCE // dimension)
        if mean is None:
            sums, power = features.new_zeros(dimension, dtype=torch.float64), 0.0
            for part in features.split(self.rows):
                sums += part.float().mean(0).double() * len(part)
                power += float(part.float().square().sum()) / places
            mean, square = (sums / places).to(torch.bfloat16), float((sums / places).square().sum())
            if square < SMALL * power:
                mean, self.mean_energy = torch.zeros_like(mean), places * square
        self.mean = mean
        self.chunks = [*pairwise(accumulate((rows * columns for rows, columns in sizes), initial=0))]
        self.lines = empty(places, dimension, features.device)
        for (start, stop), (_, width) in zip(self.chunks, sizes, strict=True):
            for some in torch.arange(dimension).split(max(1, NUMBERS_AT_ONCE // (stop - start))):
                columns = slice(int(some[0]), int(some[-1]) + 1)
                part = features[start:stop, columns].float() - mean[columns].float()
                self.lines[start:stop, columns] = lines_of(part.T, width, transform).T
        self.width = dead_zone(self.lines, sizes, resolution, transform)

    @property
    def mean_bytes(self) -> int:
        return self.mean.nbytes if bool(self.mean.any()) else 0

    def even(self) -> RouteLines:
        """The same lines, all with the dead zone of line 0."""
        lines = copy.copy(self)
        lines.width = None
        return lines

    def levels(self, step: float) -> Iterator[Tensor]:
        """The levels of each chunk, int8, or int32 if necessary."""
        for start, stop in self.chunks:
            parts = (part for _, part in self._quantised(start, stop, step))
            yield torch.cat([one.to(torch.int8 if one.abs().max() <= 127 else torch.int32) for one in parts])

    def coded_bytes(self, step: float) -> int:
        return sum(map(coded_bytes, self.levels(step)))

    def error(self, step: float) -> float:
        """The sum of squared quantisation errors with this step."""
        parts = self._quantised(0, len(self.lines), step)
        return sum(float((lines - step * levels).square().sum()) for lines, levels in parts)

    def step_of(self, room: float) -> float:
        """The smallest step with which the lines fit into `room` bytes; approximate for a long route."""
        return self._bisect(self.coded_bytes, room, CLOSE if self.lines.numel() > NUMBERS_AT_ONCE else 1.0)[1]

    def step_that_holds(self, share: float) -> float:
        """The largest step with which the lines hold a share of the variance, or the finest step."""
        return self._bisect(self.held, math.nextafter(share, 0))[0]

    def held(self, step: float) -> float:
        """The share of the variance that the lines hold with this step."""
        return 1 - self.error(step) / self.energy

    @cached_property
    def coarsest(self) -> float:
        """A step with which all levels are 0."""
        return 2 * max(float(part.abs().max()) for part in self.lines.split(self.rows))

    @cached_property
    def energy(self) -> float:
        """The sum of squares of the lines, without the mean's."""
        return sum(float(part.square().sum()) for part in self.lines.split(self.rows)) - self.mean_energy

    @property
    def scale(self) -> float:
        """The RMS of the lines."""
        return math.sqrt(self.energy / self.lines.numel())

    def _quantised(self, start: int, stop: int, step: float) -> Iterator[tuple[Tensor, Tensor]]:
        """The lines [start, stop), some at a time, and their levels."""
        for first in range(start, stop, self.rows):
            rows = slice(first, min(first + self.rows, stop))
            width = None if self.width is None else self.width[rows]
            yield self.lines[rows], quantise(self.lines[rows], step, width)

    def _bisect(self, value: Callable[[float], float], most: float, near: float = 1.0) -> tuple[float, float]:
        """The largest step with a value above `most`, or the finest, and the smallest with another value, by
        bisection of their logarithm; values decrease."""
        finest = self.scale / FINEST
        low, high = math.log(finest), math.log(self.coarsest)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            found = value(math.exp(middle))
            low, high = (low, middle) if found <= most else (middle, high)
            if near * most <= found < most:
                break
        if low == math.log(finest):
            return finest, finest if value(finest) <= most else math.exp(high)
        return math.exp(low), math.exp(high)
