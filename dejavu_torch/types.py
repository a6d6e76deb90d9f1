"""The types that the folders of the package exchange, and their validation."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from dejavu_torch.text import printable

BATCH_NUMBERS = 2**26  # values in a batch of more than one frame: 256 MB
BATCH_SIZE = 64  # frames read at a time by default
FRAME_NUMBERS = 2**28  # values in one frame: 1 GB
LONGEST_MESSAGE = 2000  # characters

Together = int | Literal["filter"]  # T queries in a sequence, or all so far in a filter


class InputError(ValueError):
    """Bad input. The message is one printable line of limited length: what was seen and what was expected."""

    def __init__(self, message: object) -> None:
        text = printable(message)
        if len(text) > LONGEST_MESSAGE:
            text = f"{text[: LONGEST_MESSAGE // 2]} ... {text[-LONGEST_MESSAGE // 2 :]}"
        super().__init__(text)


class Traverse(ABC):
    """Frames along a route, in order, read in batches: never all of them in memory.

    It can be iterated any number of times, and yields the same values for any batch size.
    """

    name: str = "traverse"  # in messages: a path or a `sim:` address
    length: int | None = None  # number of frames N, None if it is only known after reading to the end
    place: Tensor | None = None  # (N,) float64, the true position of each frame in reference frames
    # how the frames were cut from one long image, and which of these cuts they are; equal: the same places
    cut: tuple[tuple[int, ...], range] | None = None
    seeks: bool = False  # whether `between` can skip earlier frames without reading them
    sized: bool = False  # whether the user asked for a frame size, as with `width=` of a video
    ordered: bool = False  # whether the frames are known to be consecutive, as in a video

    @abstractmethod
    def batches(self, size: int) -> Iterator[Tensor]:
        """Yield the frames in order, at most `size` at a time.

        Shape: each batch is (B,C,H,W) float32 in [0,1], or (B,D) float if the traverse holds features.
        """

    def between(self, start: int, stop: int) -> Iterator[Tensor]:
        """The frames [start, stop), as `batches` yields them; earlier frames may be read as well."""
        seen = 0
        for batch in self.batches(self.batch_size()):
            if seen >= stop:
                return
            part = batch[max(0, start - seen) : stop - seen]
            if len(part):
                yield part
            seen += len(batch)

    def select(self, frames: range, size: int) -> Iterator[Tensor]:
        """The frames of an increasing range, `size` at a time; the traverse may end first.

        Only the last batch is smaller: random numbers drawn per batch must not depend on how frames are read.
        """
        offset = 0  # of the next selected frame in the next part
        held: list[Tensor] = []
        for part in self.between(frames.start, frames.stop):
            held.append(part[offset :: frames.step])
            offset = (offset - len(part)) % frames.step
            if sum(map(len, held)) >= size:
                *whole, last = torch.cat(held).split(size)
                yield from whole
                held = [last]
        if any(map(len, held)):
            yield torch.cat(held)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """Shape of one frame: (C,H,W), or (D,) if the traverse holds features."""
        for batch in self.batches(1):
            return tuple(batch.shape[1:])
        raise InputError(f"{self.name} holds no frames; expected at least one")

    def frame_name(self, i: int) -> str:
        """Name of frame i in its source, such as a file name or the time in a video; "" if it has none."""
        return ""

    def frame_time(self, i: int) -> float:
        """When frame i was taken, in seconds; NaN if unknown."""
        return math.nan

    def identity(self) -> str:
        """Identifies the source and its options; no frame is read."""
        return f"{self.name} {self.length}"

    def state(self, start: int, stop: int) -> str:
        """Changes if the frames [start, stop) change, as far as file times and the like show it."""
        return ""

    def count(self) -> int:
        """Number of frames; reads all of them if the length is not known."""
        return sum(map(len, self.batches(self.batch_size()))) if self.length is None else self.length

    def batch_size(self, most: int = BATCH_SIZE) -> int:
        """How many frames to read at a time: `most`, or fewer if they are large; refuses too large ones."""
        shape = self.frame_shape
        values = math.prod(shape)
        if values > FRAME_NUMBERS:
            seen = f"{self.name} has frames of {' x '.join(map(str, shape))} numbers"
            raise InputError(f"{seen}; expected at most {FRAME_NUMBERS}, for images by ?width=640")
        return max(1, min(most, BATCH_NUMBERS // max(1, values)))


@dataclass(frozen=True)
class FrequencyLayer:
    """Features that repeat with one period inside one chunk of the route (section III-A).

    Args:
        period: tau, in places; any positive rational, for example 93 or Fraction(195, 2).
        phases: P, the number of templates per feature; in the paper, phases = period.
        start, stop: the chunk [start, stop) in places.
        features: indices of the features that repeat, increasing.

    Convention: phase(i) = floor((i mod period) * phases / period) counts from absolute place 0.
    """

    period: Fraction
    phases: int
    start: int
    stop: int
    features: tuple[int, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", Fraction(self.period))
        a, b = self.period.as_integer_ratio()
        seen = f"a layer has period {self.period} and {self.phases} phases"
        if a <= 0 or self.phases < 1:
            raise InputError(f"{seen}; expected period > 0, phases >= 1")
        if not 0 <= self.start < self.stop:
            raise InputError(f"a layer covers [{self.start}, {self.stop}); expected 0 <= start < stop")
        if max(self.stop * b, a * self.phases) >= 2**63:
            raise InputError(f"{seen} up to {self.stop}; expected numbers whose products are below 2^63")
        if not self.features or not all(i < j for i, j in pairwise((-1, *self.features))):
            raise InputError(f"layer features {self.features!s:.60}; expected 1 or more, increasing, >= 0")

    def phase(self, places: Tensor) -> Tensor:
        """Phase of each place, in exact integer arithmetic. (n,) int64 -> (n,) int64 in 0..P-1."""
        a, b = self.period.as_integer_ratio()
        return (places * b).remainder(a) * self.phases // a

    @property
    def place_phases(self) -> Tensor:
        """Phase of every place of the chunk, (stop - start,) int64."""
        return self.phase(torch.arange(self.start, self.stop))


Plan = tuple[FrequencyLayer, ...]


@dataclass(frozen=True, eq=False, repr=False)
class Match:
    """Where each query was found (eq. 5) and whether the answer is accepted (eq. 6).

    It unpacks to `index, score, accepted`. Its length, and what `match[i]` and slices select, are queries.

    Attributes:
        index: (Q,) int64, the place found, -1 if no place has a finite score; (Q,k) candidates, best first.
        score: float, lower is better, +inf without a place. accepted: bool, see `DejaVu.acceptance`.
        probability: float64, of being right, NaN for all but the first candidate; None without calibration.
        route: int64, the index in `map.routes` of the place's route, -1 without a place; None if the map is
            not merged.
        sequences: by T, matches (Q,) of the same scores in sequences or a filter, for reports; mostly empty.
    """

    index: Tensor
    score: Tensor
    accepted: Tensor
    probability: Tensor | None = None
    route: Tensor | None = None
    sequences: Mapping[Together, Match] = field(default_factory=dict)

    @property
    def columns(self) -> dict[str, Tensor]:
        """Those of the five columns that are known, by name."""
        return {name: column for name, column in vars(self).items() if isinstance(column, Tensor)}

    def __iter__(self) -> Iterator[Tensor]:
        return iter((self.index, self.score, self.accepted))

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, queries: Any) -> Match:
        sequences = {T: match[queries] for T, match in self.sequences.items()}
        return replace(self.map(lambda column: column[queries]), sequences=sequences)

    def __repr__(self) -> str:
        return f"Match({', '.join(f'{name}={column}' for name, column in self.columns.items())})"

    def map(self, change: Callable[[Tensor], Tensor]) -> Match:
        """The same change in every column, but not in `sequences`."""
        columns = {name: change(column) for name, column in self.columns.items()}
        return Match(**columns, sequences=self.sequences)

    def renumbered(self, place: Callable[[Tensor], Tensor]) -> Match:
        """The match with `place` applied to its places, in `sequences` too; it must keep -1."""
        sequences = {T: match.renumbered(place) for T, match in self.sequences.items()}
        return replace(self, index=place(self.index), sequences=sequences)

    @staticmethod
    def joined(parts: Iterable[Match]) -> Match:
        """Concatenate matches of consecutive queries."""
        parts = list(parts)
        columns = [part.columns for part in parts]
        names = [name for name in columns[0] if all(name in part for part in columns)]
        whole = {name: torch.cat([part[name] for part in columns]) for name in names}
        sequences = {T: Match.joined(part.sequences[T] for part in parts) for T in parts[0].sequences}
        return Match(**whole, sequences=sequences)


class Training(NamedTuple):
    """How a map was trained: steps of the optimiser, and the run's seed, None if none was set."""

    steps: int
    seed: int | None


class SequenceModel(nn.Module, ABC):
    """Combines the scores of consecutive queries: the `sequence` argument of `DejaVu.localize`.

    Convention: causal; each score is for the place of its own query. Memory does not grow with the queries.
    """

    likely: float | None = None  # a score below it is more likely right than wrong; None if scores do not say

    @abstractmethod
    def start(self, places: int, fixed: bool = False) -> Tensor:
        """The state before the first query; `fixed`: in its final shape, as an exported graph needs it."""

    @abstractmethod
    def step(
        self, scores: Tensor, state: Tensor, route_starts: Sequence[int] = (0,)
    ) -> tuple[Tensor, Tensor]:
        """Scores (B,N) of the next B queries, the state, and the first place of each route -> scores (B,N),
        the next state."""

    @abstractmethod
    def check(self, queries: int | None, places: int) -> None:
        """Refuse, or warn of, a number of places or (if known) of queries for which it makes no sense."""

    def threshold_of(self, threshold: float | None) -> float | None:
        """The acceptance threshold for its scores, given the one for single queries."""
        return threshold
