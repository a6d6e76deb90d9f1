"""The lines of a route in whole numbers of a step, and the step whose coded lines fit into a budget."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import accumulate, pairwise

import torch
from torch import Tensor

from dejavu_torch.maps.codec import coded_bytes
from dejavu_torch.maps.spectrum import Transform, half_cycles, spectrum
from dejavu_torch.memory import empty

ROUNDING = 0.35  # what is added before rounding down: a dead zone of 1.3 steps around 0
FINEST = 64  # steps in an RMS line at most: a finer step changes no score
HALVINGS = 14  # of the range of steps, which leaves 0.1 % of a step
BLOCK = 2**23  # numbers at a time
SMALL = 0.05  # of the mean square of descriptors: below it their mean is cheaper among the lines
CLOSE = 0.995  # of the budget of a route of more numbers: no finer step is looked for


@torch.no_grad()
def quantise(lines: Tensor, step: Tensor | float, width: Tensor | None = None) -> Tensor:
    """Whole numbers of steps, those below 1 - `ROUNDING` of a step 0. Same shape, float; no gradient.

    Args:
        width: by how much that dead zone is wider for each line, at least 1; see `dead_zone`.
    """
    # in place: the lines of a long route are large
    levels = lines.abs().div_(step).add_(ROUNDING).floor_().copysign_(lines)
    return levels if width is None else levels * (lines.abs() >= (1 - ROUNDING) * step * width)


def dead_zone(
    lines: Tensor, lengths: Sequence[int], resolution: float, transform: Transform
) -> Tensor | None:
    """By how much the dead zone of each of (N,K) lines, in chunks of these lengths, is wider than line 0's.

    Shape: -> (N,1), 1 + (resolution / P)^2 for a line of period P; None if that is 1 for all.
    """
    if not resolution:
        return None
    inverse = torch.cat([half_cycles(torch.arange(n), transform) / (2 * n) for n in lengths]).to(lines)
    return (1 + (resolution * inverse).square())[:, None]


class RouteLines:
    """The lines of a route, chunk by chunk; those beyond a share of the memory are in a temporary file.

    Args:
        lengths: places of each chunk. transform, resolution: see `spectrum`, `dead_zone`.
        mean: (K,) that is subtracted; None is that of the route, in bfloat16 as a map stores it, or 0 where
            it is so small that it is cheaper among the lines, as line 0.

    Shape: features (N,K), float of any kind.
    """

    def __init__(
        self,
        features: Tensor,
        lengths: Sequence[int],
        transform: Transform,
        resolution: float = 0.0,
        mean: Tensor | None = None,
    ) -> None:
        places, numbers = features.shape
        self.left = 0.0  # energy of a mean that is among the lines
        self.rows = max(1, BLOCK // numbers)
        if mean is None:
            sums, power = features.new_zeros(numbers, dtype=torch.float64), 0.0
            for part in features.split(self.rows):
                sums += part.float().mean(0).double() * len(part)
                power += float(part.float().square().sum()) / places
            mean, square = (sums / places).to(torch.bfloat16), float((sums / places).square().sum())
            if square < SMALL * power:
                mean, self.left = torch.zeros_like(mean), places * square
        self.mean = mean
        self.chunks = [*pairwise(accumulate(lengths, initial=0))]
        self.lines = empty(places, numbers, features.device)
        for start, stop in self.chunks:
            for some in torch.arange(numbers).split(max(1, BLOCK // (stop - start))):
                columns = slice(int(some[0]), int(some[-1]) + 1)
                part = features[start:stop, columns].float() - mean[columns].float()
                self.lines[start:stop, columns] = spectrum(part.T, transform).T
        self.width = dead_zone(self.lines, lengths, resolution, transform)

    @property
    def mean_bytes(self) -> int:
        """Of the mean in a file."""
        return self.mean.nbytes if bool(self.mean.any()) else 0

    def even(self) -> RouteLines:
        """The same lines, all with the dead zone of line 0."""
        lines = copy.copy(self)
        lines.width = None
        return lines

    def levels(self, step: float) -> Iterator[Tensor]:
        """The levels of each chunk, int8, or int32 if some need it."""
        for start, stop in self.chunks:
            parts = (part for _, part in self._quantised(start, stop, step))
            yield torch.cat(
                [part.to(torch.int8 if part.abs().max() <= 127 else torch.int32) for part in parts]
            )

    def coded_bytes(self, step: float) -> int:
        """Bytes of the lines in such steps."""
        return sum(map(coded_bytes, self.levels(step)))

    def error(self, step: float) -> float:
        """The sum of squares of what is missing of lines in such steps."""
        parts = self._quantised(0, len(self.lines), step)
        return sum(float((lines - step * levels).square().sum()) for lines, levels in parts)

    def step_of(self, room: float) -> float:
        """The smallest step in which the lines take so many bytes, or fewer; of a long route, about it."""
        return self._steps_around(self.coded_bytes, room, CLOSE if self.lines.numel() > BLOCK else 1.0)[1]

    def step_that_holds(self, share: float) -> float:
        """The largest step in which the lines hold a share of the variance, or the finest there is."""
        return self._steps_around(self.held, math.nextafter(share, 0))[0]

    def held(self, step: float) -> float:
        """The share of the variance that lines in such steps hold."""
        return 1 - self.error(step) / self.energy

    @cached_property
    def coarsest(self) -> float:
        """A step in which no line is left."""
        return 2 * max(float(part.abs().max()) for part in self.lines.split(self.rows))

    @cached_property
    def energy(self) -> float:
        """The sum of the squares of the lines, without those of a mean among them."""
        return sum(float(part.square().sum()) for part in self.lines.split(self.rows)) - self.left

    @property
    def scale(self) -> float:
        """The RMS of the lines."""
        return math.sqrt(self.energy / self.lines.numel())

    def _quantised(self, start: int, stop: int, step: float) -> Iterator[tuple[Tensor, Tensor]]:
        """The lines [start, stop) some at a time, and their levels."""
        for first in range(start, stop, self.rows):
            rows = slice(first, min(first + self.rows, stop))
            width = None if self.width is None else self.width[rows]
            yield self.lines[rows], quantise(self.lines[rows], step, width)

    def _steps_around(
        self, value: Callable[[float], float], most: float, close: float = 1.0
    ) -> tuple[float, float]:
        """The largest step whose falling value is above `most`, and the smallest whose is not, by bisection
        of their logarithm; the finest is both if no value is above."""
        finest = self.scale / FINEST
        low, high = math.log(finest), math.log(self.coarsest)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            found = value(math.exp(middle))
            low, high = (low, middle) if found <= most else (middle, high)
            if close * most <= found < most:
                break
        if low == math.log(finest):
            return finest, finest if value(finest) <= most else math.exp(high)
        return math.exp(low), math.exp(high)
