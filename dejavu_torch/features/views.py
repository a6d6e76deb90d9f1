"""Augmented views of the places of a route, for whitening and calibration."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import accumulate
from typing import NamedTuple, cast

import torch
from torch import Tensor

from dejavu_torch.data.traverse import Part, as_shape
from dejavu_torch.features.augmentation import LARGEST, Augmentation
from dejavu_torch.features.preprocess import spread
from dejavu_torch.places.layout import Layout
from dejavu_torch.types import Facts, InputError, Traverse, expect

SAMPLE = 10_000  # frames that a longer route is fitted on
OF_AREA, LARGE = 2**14, 2**15  # windows likewise, of an area of more than so many
TILES = 4  # of an area that the step is chosen in
MIN_SEGMENTS = 4  # of a sample
FRAMES_AT_ONCE = 64  # frames augmented together
SEGMENT, EVERY = 20, 10  # frames of a segment; every 10th segment is used
STRONGER = 1.5  # factor on the strengths for whitening, which has seen the frames themselves
FEWEST, MOST = 600, 1200  # frames of all segments together
MAX_COPIES = 2  # frames of all segments, relative to the frames of a short route
FITTED = 200  # frames that a line is fitted to
FEWEST_FRAMES, SCORES = 240, 2**27  # frames of a long route at least; their scores at all places at most


class Sample(NamedTuple):
    """Evenly spaced segments of a route: whole chunks, if these are short enough."""

    frame: Tensor  # (n,) int64
    segment: int  # frames of each segment
    sizes: list[tuple[int, int]]  # rows and columns of each; of a route one column

    @classmethod
    def of(cls, layout: Layout, chunk: int) -> Sample:
        """The sample of a route longer than `SAMPLE`, coded in chunks of `chunk` places, or of an area.

        Example:
            >>> sample = Sample.of(Layout(100_000), chunk=1000)
            >>> len(sample.frame), sample.frame[::1000].tolist()
            (10000, [0, 11000, 22000, 33000, 44000, 55000, 66000, 77000, 88000, 99000])
        """
        ways: dict[int, Callable[[Layout, int], Sample]] = {1: cls.of_route, 2: cls.of_area}
        return ways[layout.dimensions](layout, chunk)

    @classmethod
    def of_route(cls, layout: Layout, chunk: int) -> Sample:
        """Evenly spaced segments of a route."""
        frames = layout.places
        segment = min(chunk, SAMPLE // MIN_SEGMENTS)
        count = SAMPLE // segment
        return cls(evenly_spaced(frames, segment, count), segment, [(segment, 1)] * count)

    @classmethod
    def of_area(cls, area: Layout, chunk: int = 0) -> Sample:
        """Evenly spaced blocks of an area: of few large ones more is learned than of many."""
        size = OF_AREA // MIN_SEGMENTS
        side = round(size**0.5)
        tall = min(area.rows, max(side, size // min(area.columns, side)))
        wide = min(area.columns, size // tall)
        down, across = area.rows // tall, area.columns // wide
        drawn = torch.linspace(0, down * across - 1, min(down * across, MIN_SEGMENTS)).round().long()
        tops = torch.linspace(0, area.rows - tall, down).round().long()  # from border to border
        lefts = torch.linspace(0, area.columns - wide, across).round().long()
        corner = torch.stack([tops[drawn // across], lefts[drawn % across]], 1)
        inside = torch.cartesian_prod(torch.arange(tall), torch.arange(wide)).view(-1, 2)
        places = area.place_at(corner[:, None] + inside).flatten()
        return cls(places, tall * wide, [(tall, wide)] * len(drawn))

    @classmethod
    def of_chunks(cls, layout: Layout, sample: Sample) -> Sample:
        """What the step is chosen in: the sample itself of a route; of an area whole tiles, since blocks are
        coded in more bytes."""
        ways: dict[int, Callable[[Layout], Sample]] = {1: lambda _: sample, 2: cls.of_tiles}
        return ways[layout.dimensions](layout)

    @classmethod
    def of_tiles(cls, area: Layout) -> Sample:
        """Whole tiles of an area."""
        starts = [*accumulate((rows * columns for rows, columns in area.tiles), initial=0)]
        drawn = torch.linspace(0, len(starts) - 2, min(TILES, len(starts) - 1)).round().long().tolist()
        places = torch.cat([torch.arange(starts[i], starts[i + 1]) for i in drawn])
        return cls(places, starts[1], [area.tiles[i] for i in drawn])

    def views(self, second: LabelledFrames) -> LabelledFrames:
        """The views of the sample in a second traverse; InputError if there are none."""
        views = views_of(second, self.frame)
        if not len(views.places) and views.placed is None:
            seen = f"{second.traverse.name} shows none of the {len(self.frame)} frames that are learned from"
            raise InputError(f"{seen}, in segments of {self.segment} along the route; expected some")
        return views


class Placed(NamedTuple):
    """How a smoother placed the frames of drives, see `teaching.place_drives`.

    drive: (n,) int64, the drive of each frame. names: of the drives that it placed, by number; the places of
    others were known. probability: of a placed frame, at least. rounds: of placing.
    """

    drive: Tensor
    names: Mapping[int, str]
    probability: float
    rounds: int


class LabelledFrames(NamedTuple):
    """Frames, and (n,) int64 the place of the reference that each shows, -1 for a frame to skip. Whitening
    learns from frames with `placed` and augmented copies, from others alone."""

    traverse: Traverse
    places: Tensor
    placed: Placed | None = None

    def renumbered(self, number: Tensor) -> LabelledFrames:
        """The same frames, with a new number (N,) int64 of each place, -1 for places to skip."""
        places = torch.where(self.places >= 0, number.to(self.places.device)[self.places], -1)
        return self._replace(places=places)

    def placed_lines(self, others: str = "{} left out") -> Iterator[str]:
        """What is said of each drive that a smoother has placed, and of the number of its other frames."""
        drive, names, *_ = self.placed or (self.places, {})
        for i, name in names.items():
            places = self.places[drive == i]
            count = int((places >= 0).sum())
            left = others.format(len(places) - count)
            left = f", at {line_of(places)}; {left}" if count else "; nothing is learned from it"
            yield f"{count} of {len(places)} frames of {name} placed{left}"

    @property
    def drives(self) -> int:
        """How many drives teach, of those that a smoother placed."""
        drive, names, *_ = self.placed or (self.places, {})
        return sum(bool((self.places[drive == i] >= 0).any()) for i in names)

    def placed_facts(self) -> Facts | None:
        """The entry `second` of report.json; None if no smoother placed the frames."""
        if self.placed is None:
            return None
        own = self.places[torch.isin(self.placed.drive, torch.tensor([*self.placed.names]))]
        found = {"placed": int((own >= 0).sum()), "of": len(own)}
        return {**found, "probability": self.placed.probability, "rounds": self.placed.rounds}


def line_of(places: Tensor) -> str:
    """The line that most frames lie on, by medians of slopes (of Theil and Sen) and of offsets.

    Shape: places (n,) of frames, -1 for frames without one; at least two have one.

    Example:
        >>> line_of(torch.tensor([40, -1, 42, 9, 44]))
        'place = 1.00 frame + 40'
    """
    frame = (places >= 0).nonzero()[:, 0]
    some = frame[torch.linspace(0, len(frame) - 1, min(len(frame), FITTED)).long()]
    one, two = torch.combinations(some).T
    slope = round(float(((places[two] - places[one]) / (two - one)).median()), 2)
    offset = round(float((places[frame] - slope * frame).median()))
    return f"place = {slope:.2f} frame {'-' if offset < 0 else '+'} {abs(offset)}"


def evenly_spaced(frames: int, length: int, count: int) -> Tensor:
    """The frames (count * length,) of evenly spaced segments, from the first whole one to the last."""
    starts = torch.arange(count) * (frames // length - 1) // max(1, count - 1) * length
    return (starts[:, None] + torch.arange(length)).flatten()


def views_of(views: LabelledFrames, frames: Tensor) -> LabelledFrames:
    """The views of some frames (n,) of a route, increasing; their places are indices into these frames."""
    places = views.places.cpu()
    at = torch.searchsorted(frames, places).clamp(max=len(frames) - 1)
    shown = (frames[at] == places).nonzero().flatten()
    placed = views.placed and views.placed._replace(drive=views.placed.drive[shown])
    return LabelledFrames(Part(views.traverse, shown), at[shown], placed)


class AugmentedFrames:
    """Augmented copies of frames, the same for any batch size: each block of frames `copies` times. They are
    drawn in order, so that this is no `Traverse`, but stands for one where frames are read once.

    Args:
        traverse: frames (B,C,H,W). runs: the frames, increasing. block: most frames augmented together.
        copies: of each frame. strengths: arguments of `Augmentation`. factor: to multiply them by. span:
            values that stand for 0 and 1 while frames are changed, see `Preprocess`.

    Raises:
        InputError: ready features, or strengths that `Augmentation` refuses.
    """

    def __init__(
        self,
        traverse: Traverse,
        runs: Sequence[range],
        block: int,
        copies: int,
        strengths: Facts,
        seed: int = 0,
        factor: float = 1.0,
        span: tuple[float, float] = (0.0, 1.0),
    ) -> None:
        expect(len(traverse.frame_shape) == 3, "frames to augment", f"{traverse.name} holds ready features")
        try:
            self.augmentation = Augmentation(**strengths).stronger(factor)
        except TypeError as error:
            names = ", ".join(LARGEST)
            raise InputError(f"the strengths of whitening are {strengths}; expected {names}") from error
        self.traverse, self.runs, self.block, self.copies, self.seed = traverse, runs, block, copies, seed
        self.span = span
        blocks = (part for run in runs for part in torch.tensor(run).split(block))
        self.places = torch.cat([part.repeat(copies) for part in blocks])
        self.name = f"augmented copies of {traverse.name}"
        self.frame_shape: tuple[int, ...] = traverse.frame_shape

    def __len__(self) -> int:
        return len(self.places)

    def batches(self, size: int, device: torch.device | str = "cpu") -> Iterator[Tensor]:
        """All copies, at most `size` at a time, made on a device of random numbers of the CPU."""
        generator = torch.Generator().manual_seed(self.seed)
        size = self.traverse.at_once(size)
        for block in (run[i : i + self.block] for run in self.runs for i in range(0, len(run), self.block)):
            frames, (low, high) = spread(self.traverse[block].to(device), self.span), self.span
            for _ in range(self.copies):
                copies: Tensor = self.augmentation.train()(frames, generator)
                copies = copies if self.span == (0, 1) else low + (high - low) * copies
                yield from (as_shape(part, self.frame_shape) for part in copies.split(size))

    def fitted(self, shape: tuple[int, ...]) -> AugmentedFrames:
        """The same copies converted to another shape (C,H,W), see `as_shape`."""
        other = copy.copy(self)
        other.frame_shape = shape
        return other


def augmented_route(
    traverse: Traverse,
    frames: int,
    copies: int,
    most: int,
    strengths: Facts,
    seed: int = 0,
    span: tuple[float, float] = (0.0, 1.0),
) -> tuple[LabelledFrames, str]:
    """At most `most` augmented copies of N `frames`, evenly drawn, and a phrase for the log about them."""
    shown = range(0, frames, max(1, -(-frames * copies // most)))
    views = AugmentedFrames(
        traverse, [shown], traverse.at_once(FRAMES_AT_ONCE), copies, strengths, seed, span=span
    )
    each = "each frame" if shown.step == 1 else f"{len(shown)} of the frames"
    return LabelledFrames(cast(Traverse, views), views.places), f"{copies} look{'s' * (copies > 1)} at {each}"


def augmented_segments(
    traverse: Traverse,
    frames: int,
    strengths: Facts,
    places: int | None = None,
    starts: Sequence[int] | None = None,
    span: tuple[float, float] = (0.0, 1.0),
) -> AugmentedFrames:
    """Augmented segments of a traverse, as another visit may show them, to calibrate a map.

    Every 10th segment of 20 frames, or of fewer in a short traverse. Short traverses are used several times,
    long ones in part: 1200 frames of 10^5, down to 240 of more.

    Args:
        frames: N, of the traverse. strengths: of `Augmentation`; changes are 1.5 times as strong.
        places: of the map to search; None is N.
        starts: of segments of 20 frames, increasing, instead of every 10th segment.
    """
    length = min(SEGMENT, max(1, frames // EVERY)) if starts is None else SEGMENT
    starts = range(0, frames - length + 1, EVERY * length) if starts is None else starts
    most = min(MOST, max(FEWEST_FRAMES, SCORES // (places or frames)))
    runs = [range(start, start + length) for start in starts[:: max(1, -(-len(starts) * length // most))]]
    copies = max(1, -(-min(FEWEST, MAX_COPIES * frames, most) // (len(runs) * length)))
    return AugmentedFrames(traverse, runs, length, copies, strengths, factor=STRONGER, span=span)
