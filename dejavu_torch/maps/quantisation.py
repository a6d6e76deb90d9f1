"""The lines of a route in whole numbers of a step, and the step whose coded lines fit into a budget."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property

import torch
from torch import Tensor

from dejavu_torch.maps.codec import coded_bytes, to_int8
from dejavu_torch.maps.spectrum import Transform, spectrum
from dejavu_torch.memory import empty

ROUNDING = 0.35  # what is added before rounding down: a dead zone of 1.3 steps around 0
FINEST = 64  # steps in an RMS line at most: a finer step changes no score
HALVINGS = 14  # of the steps to choose from, which leaves 0.1 % of a step
BLOCK = 2**23  # numbers at a time
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


def dead_zone(lines: Tensor, lengths: list[int], resolution: float, transform: Transform) -> Tensor | None:
    """By how much the dead zone of each of (N,K) lines, of chunks of these lengths, is wider than line 0's.

    That of a line of period P is 1 + (resolution / P)^2 times as wide: it costs as many bits as a slow one,
    and tells nothing of where one is but within P places.

    Returns:
        (N,1), or None where all lines count alike.
    """
    if not resolution:
        return None
    # line r has r half cycles (DCT), or of pairs of a cosine and a sine as many cycles (DFT)
    halves = [torch.arange(n) if transform == "dct" else (torch.arange(n) + 1) // 2 * 2 for n in lengths]
    inverse = torch.cat([r / (2 * n) for r, n in zip(halves, lengths, strict=True)]).to(lines)
    return (1 + (resolution * inverse).square())[:, None]


class RouteLines:
    """The lines of a route, chunk by chunk: what is left to choose is their step.

    Of a long route no more than the lines, and the levels of a chunk, are held at once; lines beyond a share
    of the memory are in a temporary file.

    Args:
        lengths: places of each chunk, one after another. transform, resolution: see `spectrum`, `dead_zone`.
        mean: (K,) that is taken off; None is that of the route, in bfloat16 as a map stores it.

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
        self.rows = max(1, BLOCK // numbers)
        if mean is None:
            means = [part.float().mean(0).double() * len(part) for part in features.split(self.rows)]
            mean = (torch.stack(means).sum(0) / places).to(torch.bfloat16)
        self.mean = mean
        stops = torch.tensor(lengths).cumsum(0).tolist()
        self.chunks = list(zip([0, *stops[:-1]], stops, strict=True))
        self.lines = empty(places, numbers, features.device)
        for start, stop in self.chunks:
            for some in torch.arange(numbers).split(max(1, BLOCK // (stop - start))):
                columns = slice(int(some[0]), int(some[-1]) + 1)
                part = features[start:stop, columns].float() - mean[columns].float()
                self.lines[start:stop, columns] = spectrum(part.T, transform).T
        self.width = dead_zone(self.lines, [*lengths], resolution, transform)

    def levels(self, step: float, even: bool = False) -> Iterator[tuple[Tensor, Tensor]]:
        """Of each chunk, as `to_int8` gives them.

        Args:
            even: all lines have the same dead zone.
        """
        for start, stop in self.chunks:
            small, escapes = torch.empty_like(self.lines[start:stop], dtype=torch.int8), []
            for first in range(start, stop, self.rows):
                rows = slice(first, min(first + self.rows, stop))
                part, large = to_int8(quantise(self.lines[rows], step, self._widths(rows, even)))
                small[rows.start - start : rows.stop - start] = part
                escapes.append(large)
            yield small, torch.cat(escapes)

    def coded_bytes(self, step: float, even: bool = False) -> int:
        """What the lines take in such steps."""
        return sum(coded_bytes(small) + escapes.nbytes for small, escapes in self.levels(step, even))

    def held(self, step: float, even: bool = False) -> float:
        """The share of the variance that lines in such steps hold."""
        error = 0.0
        for first in range(0, len(self.lines), self.rows):
            rows = slice(first, first + self.rows)
            part = self.lines[rows]
            error += float((part - step * quantise(part, step, self._widths(rows, even))).square().sum())
        return 1 - error / self.energy

    def step_of(self, room: float) -> float:
        """The smallest step in which the lines take so many bytes, or fewer; of a long route, about it."""
        close = CLOSE if self.lines.numel() > BLOCK else 1.0
        return self._smallest_step(self.coded_bytes, room, close)

    def step_that_holds(self, share: float) -> float:
        """The smallest step in which even lines hold less than a share of the variance."""
        return self._smallest_step(lambda step: self.held(step, even=True), math.nextafter(share, 0))

    @cached_property
    def coarsest(self) -> float:
        """A step in which no line is left."""
        return 2 * max(float(part.abs().max()) for part in self.lines.split(self.rows))

    @cached_property
    def energy(self) -> float:
        """The sum of the squares of the lines."""
        return sum(float(part.square().sum()) for part in self.lines.split(self.rows))

    @cached_property
    def scale(self) -> float:
        """The RMS of the lines."""
        return rms(self.lines, self.rows)

    def _widths(self, rows: slice, even: bool) -> Tensor | None:
        return None if even or self.width is None else self.width[rows]

    def _smallest_step(self, value: Callable[[float], float], most: float, close: float = 1.0) -> float:
        """The smallest step whose value, which falls as the step grows, is at most so large: by bisection of
        its logarithm, until the value is within that and `close` times it."""
        finest, coarsest = self.scale / FINEST, self.coarsest
        if value(finest) <= most:
            return finest
        low, high = math.log(finest), math.log(coarsest)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            found = value(math.exp(middle))
            low, high = (low, middle) if found <= most else (middle, high)
            if close * most <= found < most:
                break
        return math.exp(high)


def rms(numbers: Tensor, rows: int) -> float:
    """The root of the mean square of (N,K) numbers, so many rows at a time."""
    squares = [float(part.float().square().mean()) * len(part) for part in numbers.split(rows)]
    return float(torch.tensor(sum(squares) / len(numbers)).sqrt())
