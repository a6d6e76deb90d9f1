"""The lines of a route in whole numbers of a step, and the step whose coded lines fit into a budget."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from dejavu_torch.maps.codec import coded_bytes, to_int8
from dejavu_torch.maps.spectrum import Transform, spectrum
from dejavu_torch.memory import empty

ROUNDING = 0.35  # what is added ahead of rounding down: a dead zone of 1.3 steps around 0
FINEST = 64  # steps in an RMS line at most: a finer step changes no score
HALVINGS = 14  # of the steps to choose from, which leaves 0.1 % of a step
AT_ONCE = 2**24  # numbers of a route that is gone through as a whole
BLOCK = 2**20  # numbers at a time of a longer one
COLUMNS = 2**23  # and where all of its places are needed
CLOSE = 0.995  # of a long route's budget: no finer step is looked for


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
        lengths: places of each chunk, one behind the other.
        transform, resolution: see `spectrum`, `dead_zone`.

    Shape: features (N,K), float of any kind.

    Convention: the mean that is taken off is (K,) bfloat16, as a map stores it.
    """

    def __init__(
        self, features: Tensor, lengths: Sequence[int], transform: Transform, resolution: float = 0.0
    ) -> None:
        self.whole = features.numel() <= AT_ONCE
        places, numbers = features.shape
        self.rows = places if self.whole else max(1, BLOCK // numbers)
        self.rms = _rms(features, self.rows)
        means = [part.float().mean(0).double() * len(part) for part in features.split(self.rows)]
        self.mean = (torch.stack(means).sum(0) / places).to(torch.bfloat16)
        stops = torch.tensor(lengths).cumsum(0).tolist()
        self.chunks = list(zip([0, *stops[:-1]], stops, strict=True))
        self.lines = empty(places, numbers, features.device)
        for start, stop in self.chunks:
            columns = numbers if self.whole else max(1, COLUMNS // (stop - start))
            for first in range(0, numbers, columns):
                some = slice(first, first + columns)
                part = features[start:stop, some].float() - self.mean[some].float()
                self.lines[start:stop, some] = spectrum(part.T, transform).T
        self.width = dead_zone(self.lines, [*lengths], resolution, transform)
        self.scale = _rms(self.lines, self.rows)
        #: the finest step that is worth trying, and one so coarse that no line is left
        self.steps = self.scale / FINEST, 2 * max(float(part.abs().max()) for part in self._blocks())

    def levels(self, step: float, even: bool = False) -> Iterator[tuple[Tensor, Tensor]]:
        """Of each chunk, as `to_int8` gives them.

        Args:
            even: all lines have the same dead zone.
        """
        for start, stop in self.chunks:
            small = torch.empty_like(self.lines[start:stop], dtype=torch.int8)
            escapes = []
            for first in range(start, stop, self.rows):
                rows = slice(first, min(first + self.rows, stop))
                width = None if even or self.width is None else self.width[rows]
                part, large = to_int8(quantise(self.lines[rows], step, width))
                small[rows.start - start : rows.stop - start] = part
                escapes.append(large)
            yield small, torch.cat(escapes)

    def coded_bytes(self, step: float, even: bool = False) -> int:
        """What the lines take in such steps."""
        return sum(coded_bytes(small) + escapes.nbytes for small, escapes in self.levels(step, even))

    def held(self, step: float, even: bool = False) -> float:
        """The share of the variance that lines in such steps hold."""
        widths = itertools.repeat(None) if even or self.width is None else self.width.split(self.rows)
        errors = [
            float((part - step * quantise(part, step, width)).square().sum())
            for part, width in zip(self._blocks(), widths, strict=False)
        ]
        return 1 - sum(errors) / sum(float(part.square().sum()) for part in self._blocks())

    def step_of(self, room: float) -> float:
        """The smallest step in which the lines take so many bytes, or fewer; of a long route, about it."""
        if self.whole:
            return _smallest_step(lambda step: self.coded_bytes(step) <= room, *self.steps)
        return _close_step(self.coded_bytes, room, *self.steps)

    def step_that_holds(self, share: float) -> float:
        """The smallest step in which even lines hold less than a share of the variance."""
        return _smallest_step(lambda step: self.held(step, even=True) < share, *self.steps)

    def _blocks(self) -> Sequence[Tensor]:
        blocks: Sequence[Tensor] = self.lines.split(self.rows)
        return blocks


def _rms(numbers: Tensor, rows: int) -> float:
    """So many rows at a time."""
    squares = [float(part.float().square().mean()) * len(part) for part in numbers.split(rows)]
    return float(torch.tensor(sum(squares) / len(numbers)).sqrt())


def _smallest_step(enough: Callable[[float], bool], finest: float, coarsest: float) -> float:
    """The smallest step that is coarse enough, by bisection of its logarithm."""
    if enough(finest):
        return finest
    low, high = math.log(finest), math.log(coarsest)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if enough(math.exp(middle)) else (middle, high)
    return math.exp(high)


def _close_step(cost: Callable[[float], int], room: float, finest: float, coarsest: float) -> float:
    """A step whose cost is within the room, and over `CLOSE` of it: false position of logarithms (Illinois).

    About 8 steps are tried where a bisection tries 15.
    """
    most, least = math.log(room), math.log(room * CLOSE)

    def above(log_step: float) -> float:
        return math.log(max(1, cost(math.exp(log_step)))) - (most + least) / 2

    low, high = math.log(finest), math.log(coarsest)
    over, under = above(low), above(high)
    if over <= (most - least) / 2:
        return finest
    middle, kept = (low + high) / 2, 0
    for _ in range(2 * HALVINGS):
        found = above(middle)
        if abs(found) <= (most - least) / 2:
            return math.exp(middle)
        if found > 0:
            low, over, under = middle, found, under / (1 + (kept > 0))
        else:
            high, under, over = middle, found, over / (1 + (kept < 0))
        kept = 1 if found > 0 else -1
        middle = (low * under - high * over) / (under - over)
    return math.exp(high)
