"""The types that the folders of the package exchange, and their validation."""

from __future__ import annotations

import copy
import math
import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, NamedTuple, SupportsIndex, TypeAlias

import torch
from torch import Tensor, nn
from torch.utils.data import Dataset
from typing_extensions import Self

from dejavu_torch.places.layout import ROUTE, Layout
from dejavu_torch.text import InputError as InputError
from dejavu_torch.text import expect as expect
from dejavu_torch.text import printable

BATCH_NUMBERS = 2**26  # values in a batch of more than one frame: 256 MB
BATCH_SIZE = 64  # frames read at a time by default
FRAME_NUMBERS = 2**28  # values in one frame: 1 GB

State: TypeAlias = Any  # of a sequence model between queries: a tensor, or a named tuple of tensors
Facts: TypeAlias = dict[str, Any]  # what JSON holds, settings and other values of many types, by name
# T queries in a sequence, all so far in a filter, or all of the drive in a smoother
Together = int | Literal["filter", "smoother", "sequence"]


def check_shape(x: Tensor, dims: str, name: str) -> None:
    """Refuse a tensor of another shape than `dims`, such as "Q N>=1 16": any size, at least 1, and 16.

    Example:
        >>> check_shape(torch.zeros(5, 3), "Q N>=1", "the scores are")
    """
    if x.ndim != len(sizes := dims.split()) or not all(map(_fits, x.shape, sizes)):
        raise InputError(f"{name} {tuple(x.shape)}; expected ({', '.join(sizes)}{',' * (len(sizes) == 1)})")


def _fits(size: int, wanted: str) -> bool:
    word, _, least = wanted.partition(">=")
    return size >= int(least) if least else word.isalpha() or size == int(word)


class Traverse(Dataset[Tensor], ABC):
    """Frames along a route, indexed from 0: a sequence that is read as needed, never all of it in memory.

    `len(t)` is the number of frames. `t[i]` is one, (C,H,W) float32 in [0, 1], or (D,) of ready features;
    slices, ranges, lists and tensors of numbers, or a mask (N,), give several, (n,C,H,W). Negative numbers
    count from the end. `torch.utils.data.DataLoader(t)` works as it is, with worker processes too: files are
    opened in each process when they are first read.

    A subclass implements `__len__` and `read`, and may set:

    Attributes:
        name: shown in messages: a path or a `sim:` address.
        names: of the frames, such as file names or times in a video, "" for none; empty if all have none.
        times: (N,) float64, when each was taken, in seconds; None if unknown.
        places: (N,) float64, the true position of each in reference frames; None if unknown.
        coordinates: where each was taken, see `Coordinates`; None if unknown.
        odometer: what it reads at each, see `Odometer`; None if unknown.
        headings: (N,) float64, degrees clockwise from north to where the upper side of a camera that looks
            down points, NaN where that is unknown; None if all are.
        ordered: whether they are known to be consecutive, as in a video; see the filter and sequences.
        sized: whether the user asked for their size, as with `width=` of a video.
        deep: whether its images have more than 8 bits a pixel.
        layout: where its frames lie, if they become the places of a map: along a route, or over an area.
        beyond: frames that `stop=` left out after the last.
        maker: what made ready descriptors, as their file tells; "" if it does not.
        turn: by which its images are turned as they are read, as with `turn=90`; "" if they are not.
        cut: of windows of one long image, its size, the window's, and their range; equal: the same places.

    Raises:
        IndexError: a number beyond the frames. InputError: no frames, or frames that cannot be read.

    Example:
        >>> from dejavu_torch import open_source
        >>> traverse = open_source("sim:aerial?frames=40")
        >>> len(traverse), traverse[-1].shape, traverse[10:20:2].shape
        (40, torch.Size([3, 64, 64]), torch.Size([5, 3, 64, 64]))
    """

    name: str = "traverse"
    names: Sequence[str] = ()
    times: Tensor | None = None
    places: Tensor | None = None
    coordinates: Coordinates | None = None
    odometer: Odometer | None = None
    headings: Tensor | None = None
    ordered: bool = False
    sized: bool = False
    beyond: int = 0
    maker: str = ""
    turn: str = ""
    cut: tuple[tuple[int, ...], range] | None = None
    _layout: Layout = ROUTE

    @property
    def deep(self) -> bool:
        return False

    @property
    def layout(self) -> Layout:
        return self._layout.reaching(len(self))

    @layout.setter
    def layout(self, layout: Layout) -> None:
        self._layout = layout

    @property
    def area(self) -> Layout | None:
        """The layout of an area; None along a route."""
        return self.layout.area

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def read(self, frames: range | list[int]) -> Tensor:
        """The frames with these numbers, from 0 to N - 1, at least one, in any order: (n,C,H,W) or (n,D)."""

    def __getitem__(self, index: int | slice | range | Sequence[int] | Tensor) -> Tensor:
        if isinstance(index, slice):
            index = range(*index.indices(len(self)))
        if not isinstance(index, range):
            given = torch.as_tensor(index)
            if given.dtype == torch.bool:
                if given.shape != (len(self),):
                    raise IndexError(f"a mask {tuple(given.shape)} for the {len(self)} frames of {self.name}")
                given = given.nonzero()[:, 0]
            if given.ndim == 0:
                return self.read(self._existing(given[None].tolist()))[0]
            index = given.tolist()
        numbers = self._existing(index)
        return self.read(numbers) if len(numbers) else torch.zeros(0, *self.frame_shape)

    def __getitems__(self, indices: list[int]) -> list[Tensor]:
        """The frames of a batch of a DataLoader, read together."""
        return list(self[indices])

    def __repr__(self) -> str:
        try:
            return f"{printable(self.name)}: {len(self)} frames {tuple(self.frame_shape)}"
        except Exception:  # of files that are gone, or none; a debugger still shows it
            return f"{printable(self.name)}: no frames that can be read"

    def __iter__(self) -> Iterator[Tensor]:
        for batch in self.batches():
            yield from batch

    def _existing(self, index: Iterable[SupportsIndex]) -> range | list[int]:
        """Numbers from 0, as a range where they are one."""
        count = len(self)
        numbers = [operator.index(i) for i in index]  # refuses floats
        numbers = [i + count if -count <= i < 0 else i for i in numbers]
        for i in (i for i in numbers if not 0 <= i < count):
            raise IndexError(f"there is no frame {i} of {self.name}, which has {count}")
        return as_range(numbers)

    def batches(self, size: int = BATCH_SIZE) -> Iterator[Tensor]:
        """All frames in order, `size` at a time, or fewer if they are large."""
        at_once = self.at_once(size)
        for start in range(0, len(self), at_once):
            yield self.read(range(start, min(start + at_once, len(self))))

    @cached_property
    def frame_shape(self) -> tuple[int, ...]:
        """Shape of a frame: (C,H,W), or (D,) of ready features."""
        expect(len(self), "at least one", f"{self.name} holds no frames")
        return tuple(self.read(range(1)).shape[1:])

    def at_once(self, most: int = BATCH_SIZE) -> int:
        """How many frames to read at a time: `most`, or fewer if they are large; refuses too large ones."""
        expect(most >= 1, "at least 1", f"a batch holds {most} frames")
        values = math.prod(self.frame_shape)
        seen = f"{self.name} has frames of {' x '.join(map(str, self.frame_shape))} numbers"
        expect(values <= FRAME_NUMBERS, f"at most {FRAME_NUMBERS}, for images by ?width=640", seen)
        return max(1, min(most, BATCH_NUMBERS // max(1, values)))

    def changed(self, **attributes: object) -> Self:
        """A copy with other attributes."""
        other = copy.copy(self)
        other.__dict__.pop("frame_shape", None)
        other.__dict__.update(attributes)
        return other


def as_range(numbers: list[int]) -> range | list[int]:
    """Numbers as a range if they increase evenly, else as they are."""
    step = numbers[1] - numbers[0] if len(numbers) > 1 else 1
    if not numbers or step < 1:
        return numbers
    run = range(numbers[0], numbers[-1] + 1, step)
    return run if len(run) == len(numbers) and all(map(operator.eq, run, numbers)) else numbers


class Coordinates(NamedTuple):
    """Where frames were taken: (N,2) or (N,3) float64 in metres, or latitude and longitude in degrees (N,2);
    NaN where that is unknown. frame: what they count from, such as "EPSG:32632" of a map, or "pixels" of a
    picture; only those of one frame are compared. "" is any. height: the column that is the height, of 3."""

    values: Tensor
    degrees: bool = False
    frame: str = ""
    height: int = 2

    def upright(self) -> Tensor:
        """The values with the height last, of three."""
        ground = [column for column in range(3) if column != self.height]
        return self.values if self.values.shape[1] < 3 else self.values[:, [*ground, self.height]]


class Odometer(NamedTuple):
    """What an odometer reads at frames: (N,2) float64, the way so far, in places or metres, and its variance,
    NaN if that is unknown."""

    values: Tensor
    metres: bool = False

    def between(self, before: int | Tensor, after: int | Tensor) -> Tensor:
        """The way from frames to others, and its standard deviation: (n,2)."""
        way, variance = (self.values[after] - self.values[before]).round(decimals=9).unbind(-1)
        return torch.stack([way, variance.sqrt()], -1)

    @property
    def moves(self) -> Tensor:
        """As `between`, from each frame to the next; none to the first: (N,2)."""
        frames = torch.arange(len(self.values))
        return self.between((frames - 1).clamp(min=0), frames)

    def times(self, scale: float) -> Odometer:
        """In places, by those in one of the unit."""
        return Odometer(self.values * torch.tensor([scale, scale * scale], dtype=torch.float64))


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
        expect(a > 0 and self.phases >= 1, "period > 0, phases >= 1", seen)
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

    It unpacks to `index, score, accepted`. Its length, and what `match[i]` and slices select, are queries. It
    prints as one line, such as `Match(300 queries, 296 accepted, median probability 0.98)`.

    Attributes:
        index: (Q,) int64, the place found, -1 if no place has a finite score; (Q,k) candidates, best first.
        score: float, lower is better, +inf without a place. accepted: bool, see `DejaVu.acceptance`.
        probability: float64, of being right, NaN for all but the first candidate; None without calibration,
            but for a whole drive.
        route: int64, the index in `map.routes` of the place's route, -1 without a place; None if the map is
            not merged.
        confidence: float, at most 0: -score / other^.75, of the best place over 5 places away; NaN for all
            but the first candidate. None if it was not computed.
        heading: float, degrees from north, of the turned copy of the query that was found there, NaN without
            a place; None unless several headings were tried.
        shift: float, by how much the camera points further right than at learning, in shares of the width,
            NaN where nothing tells it; of the first candidate. None unless views of the queries are compared.
        shift_degrees: the same in degrees, if the camera's field of view is known.
        stale: int64, how many queries in a row, up to this one, repeat the picture of the one before them,
            bit by bit, as of a stream that has stalled: the camera may have moved on. None if the
            queries are in no order.
        speed: float, places a query at which a whole drive along a route goes at an answer, below 0 against
            their order; NaN where answers around it are no surer than .5.
        sequences: by T, matches (Q,) of the same queries in sequences, a filter or a smoother, for reports;
            mostly empty.
        smoother: of a whole drive, the `PlaceSmoother` as it was fitted to the queries, which tells whether
            they are a drive of the map; else None.
    """

    index: Tensor
    score: Tensor
    accepted: Tensor
    probability: Tensor | None = None
    route: Tensor | None = None
    confidence: Tensor | None = None
    heading: Tensor | None = None
    shift: Tensor | None = None
    shift_degrees: Tensor | None = None
    stale: Tensor | None = None
    speed: Tensor | None = None
    sequences: Mapping[Together, Match] = field(default_factory=dict)
    smoother: SequenceModel | None = None

    @property
    def columns(self) -> dict[str, Tensor]:
        """Those of the eleven columns that are known, by name."""
        return {name: column for name, column in vars(self).items() if isinstance(column, Tensor)}

    @property
    def is_drive(self) -> bool:
        """Whether the queries are a drive of the map, as a smoother finds; False without one."""
        return self.smoother is not None and self.smoother.is_drive

    def __iter__(self) -> Iterator[Tensor]:
        return iter((self.index, self.score, self.accepted))

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, queries: int | slice | Sequence[int] | Tensor) -> Match:
        sequences = {T: match[queries] for T, match in self.sequences.items()}
        return replace(self.map(lambda column: column[queries]), sequences=sequences)

    def __repr__(self) -> str:
        """One line; the columns themselves of a single answer, such as `match[3]`."""
        shape, first = self.index.shape, self
        if not shape:
            return f"Match({', '.join(f'{name}={column}' for name, column in self.columns.items())})"
        told = f"{' x '.join(map(str, shape))} quer{'y' if shape == (1,) else 'ies'}"
        if len(shape) == 2:
            told = f"{shape[0]} queries x {shape[1]} candidates"
            first = self.map(lambda column: column[:, :1])
        told += f", {int(first.accepted.sum())} accepted"
        if first.probability is not None and first.probability.numel():
            told += f", median probability {float(first.probability.nanmedian()):.2f}"
        return f"Match({told})"

    def map(self, change: Callable[[Tensor], Tensor]) -> Match:
        """The same change in every column, but not in `sequences`."""
        columns: dict[str, Any] = {name: change(column) for name, column in self.columns.items()}
        return replace(self, **columns)

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
        return Match(**whole, sequences=sequences, smoother=parts[0].smoother)


class Training(NamedTuple):
    """How a map was trained: steps of the optimiser, and the run's seed, None if none was set."""

    steps: int
    seed: int | None


class Doubt(NamedTuple):
    """Why answers, a truth or coordinates may mislead: what was seen, and the option that would mend it, if
    one does. An entry of `doubts` in report.json."""

    kind: str
    text: str
    option: str = ""

    def __str__(self) -> str:
        return f"{self.text}: {self.option}" if self.option else self.text


class SequenceModel(nn.Module, ABC):
    """Combines the scores of consecutive queries: the `sequence` argument of `DejaVu.localize`.

    Attributes:
        likely: a score below it is more likely right than wrong; None if scores do not say.
        answers: what reports call its answers: "sequence", "filter" or "drive". A map is calibrated for
            single queries and for a filter.
        whole: whether it needs all queries, as of a drive.
        is_drive: whether the queries that it was fitted to, if any, are a drive of the map.
        length, speeds: queries that it sums over, and places that pass from one to the next, if it has these.
        lag: queries by which its answers come later. counted: numbers at the front of a packed state that
            count queries. Parameters and buffers need other names than these seven.

    Convention: each score is for the place of its own query. All but those of a `whole` drive are causal, and
        their memory does not grow with the queries. Matching changes none: what it has to know beside its
        settings is a state, or a copy, see `changed`.
    """

    likely: float | None = None
    answers: Literal["sequence", "filter", "drive"] = "sequence"
    whole: bool = False
    is_drive: bool = True
    length: int = 1
    speeds: tuple[float, ...] = ()
    lag: int = 0
    counted: int = 0

    @abstractmethod
    def start(self, places: int, fixed: bool = False) -> State:
        """The state before the first query; `fixed`: in its final shape, as an exported graph needs it."""

    @abstractmethod
    def step(self, scores: Tensor, state: State, route_starts: Sequence[int] = (0,)) -> tuple[Tensor, State]:
        """Scores (B,N) of the next B queries, the state, and the first place of each route -> scores (B,N),
        the next state."""

    @abstractmethod
    def check(self, queries: int | None, places: int) -> None:
        """Refuse, or warn of, a number of places or (if known) of queries for which it makes no sense."""

    @property
    def key(self) -> Together:
        """By which its matches are among `Match.sequences`."""
        return "filter" if self.answers == "filter" else "sequence"

    def over(self, layout: Layout) -> Self:
        """The same for places that lie so; InputError if it makes no sense there."""
        expected = "single images (--match single), a PlaceFilter or a PlaceSmoother"
        layout.expect_route(expected, f"{type(self).__name__}, and the map of an area")
        return self

    def settled(self) -> Facts:
        """What it learned from the queries that it was fitted to, for a report."""
        return {}

    def changed(self, **attributes: object) -> Self:
        """A copy with other attributes, which shares all parameters and buffers but those that are given."""
        other = copy.copy(self)
        for kind in ("_parameters", "_buffers", "_modules"):
            other.__dict__[kind] = {**self.__dict__[kind]}
        for name, value in attributes.items():
            setattr(other, name, value)
        return other

    def having(self, **settings: object) -> Self:
        """A copy with those of these settings that it has, such as `within`, up to how many places away
        probabilities are added up."""
        return self.changed(**{name: value for name, value in settings.items() if name in self.__dict__})

    def packed(self, state: State) -> Tensor:
        """A state as one tensor, as in an exported graph."""
        tensor: Tensor = state
        return tensor

    def unpacked(self, state: Tensor) -> State:
        """The state that was packed."""
        return state

    def finish(self, state: State, route_starts: Sequence[int] = (0,)) -> tuple[Tensor, State]:
        """The answers that wait for later queries, at the end of all: -> scores (B,N), the next state."""
        return state.new_zeros(0, state.shape[-1]), state

    def waiting(self, state: State) -> Tensor:
        """Scores (R,N) of the queries that wait for their answers."""
        none: Tensor = state[:0]
        return none

    def skipped(self, state: State, queries: int, route_starts: Sequence[int] = (0,)) -> State:
        """The state after queries that are left out."""
        return state

    def threshold_of(self, threshold: float | None) -> float | None:
        """The acceptance threshold for its scores, given the one for single queries."""
        return threshold
