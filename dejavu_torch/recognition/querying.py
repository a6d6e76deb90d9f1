"""How queries are matched, in words or by objects: the options that commands and functions share."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

from typing_extensions import Self

from dejavu_torch.data.turning import facing_north
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.odometry import Moved
from dejavu_torch.recognition.scorer import BestHeading, Earlier, Scorer
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.recognition.views import ALONE, Views
from dejavu_torch.text import refuse_with
from dejavu_torch.types import InputError, SequenceModel, Traverse, expect

PYTHON = {"option": False}  # metadata of a field that is no option of a command
WAYS = "drive, filter, single or sequence:T with a whole number T of at least 1"


@dataclass(frozen=True)
class Sequences:
    """How consecutive queries are matched together.

    Args:
        match: drive (each query with all others; default if in order), filter (with those before), sequence:T
            (T queries at constant speed) or single; scores of the first two are at least -log(probability)
        speeds: speeds of a sequence in places per query, such as '[.8,1,1.25]'; 1 if not given
        shifts: views of images, for a camera that points to the side of where it did: auto (of use for the
            first 100 in order, or known to the map), none, or a list in shares of the width
        fov: horizontal field of view in degrees, for `Match.shift_degrees`
    """

    match: str | SequenceModel | None = None
    speeds: list[float] | None = None
    sequence: int | None = None  # also spelt --match sequence:T
    filter: bool = False  # also spelt --match filter
    shifts: Literal["auto", "none"] | list[float] = "auto"
    fov: float | None = field(default=None, metadata=PYTHON)

    @property
    def way(self) -> str | None:
        """The way of matching, in the words of --match; None if none is given."""
        length = self.sequence
        if self.filter:
            refuse_with("--filter", match=self.match, sequence=length != 1 and length)
            return "filter"
        if length is not None:
            refuse_with(f"--sequence {length}", match=self.match)
            return f"sequence:{length}"
        if isinstance(self.match, SequenceModel):
            return self.match.answers + f":{self.match.length}" * (self.match.answers == "sequence")
        return self.match

    def matcher(
        self, within: int = 5, threshold: float | None = None, ordered: bool | None = None
    ) -> SequenceModel | Literal["auto"] | None:
        """The model that matches queries together; None for single queries.

        Args:
            within, threshold: of filter and smoother; None keeps the model's own threshold.
            ordered: whether queries are in order, which decides if no way is given; else "auto".
        """
        if isinstance(self.match, SequenceModel):
            return self.match
        way, length = self.way, None
        if way is not None and way.startswith("sequence:"):
            with suppress(ValueError):
                length = float(way.removeprefix("sequence:"))
            expect(length is not None and length % 1 == 0, WAYS, f"--match {way}")
        elif way not in (None, "drive", "filter", "single"):
            raise InputError(f"--match {way}; expected {WAYS}")
        fits = self.speeds is None or length not in (None, 1)
        expect(fits, "--match sequence:T with them", f"--speeds {self.speeds} without a sequence")
        if length is not None:
            matcher = SequenceMatcher(int(length), (1.0,) if self.speeds is None else self.speeds)
            return None if matcher.length == 1 else matcher
        if way in ("drive", "filter") or (way is None and ordered):
            return (PlaceFilter if way == "filter" else PlaceSmoother)(within=within, threshold=threshold)
        return "auto" if way is None and ordered is None else None

    def by(self, matcher: SequenceModel | Literal["auto"] | None) -> Self:
        """The same with a model in place of words."""
        match = None if matcher == "auto" else "single" if matcher is None else matcher
        return replace(self, match=match, speeds=None, sequence=None, filter=False)


@dataclass(frozen=True)
class Drives(Sequences):
    """How consecutive queries are matched together.

    Args:
        moved: odometry: csv with a column moved, in places, or moved_m; or coordinates, the source's own
        metres_per_place: of the map: a number, or its reference
    """

    moved: str | Path | Moved | None = None
    metres_per_place: str | float | None = None


@dataclass(frozen=True)
class Querying(Drives):
    """How queries are matched.

    Args:
        ordered: queries are in order, as in a video; needed for a .npy of frames
        unordered: in no order: match each by itself
        centre: mean removes what all queries share but the map does not; default for 50 or more in order
        top: places per query, no two within the tolerance (localize: 5), each in a row with its rank; only
            the first has a probability
        loops: find where a drive returns to its own places, on a map learned from it; ignore this many frames
            before each frame, and all after it
        headings: tried per image on the map of an area, evenly over 360 degrees, such as 24, which takes 24
            times as long
        views: what `shifts` have come to, see `DejaVu.looking`.
    """

    ordered: bool = False
    unordered: bool = False
    centre: Literal["mean", "none"] | None = None
    top: int | None = None
    loops: int | None = None
    headings: int = 1
    views: Views = field(default=ALONE, metadata=PYTHON)

    def order(self, matcher: SequenceModel | Literal["auto"] | None) -> bool | None:
        """Whether queries, matched so, are in order; None leaves it to their source."""
        together = isinstance(matcher, SequenceModel)
        whole = isinstance(matcher, SequenceModel) and matcher.whole
        if self.unordered:
            refuse_with("--unordered", ordered=self.ordered, match=together and "drive, filter or sequence:T")
        if self.centre == "mean" and together and not whole:
            raise InputError("--centre mean with a filter or a sequence; expected --match drive or single")
        return True if self.ordered or whole else False if self.unordered else None

    @property
    def ranks(self) -> int:
        """Places per query."""
        return 1 if self.top is None else self.top

    @property
    def wrappers(self) -> tuple[Callable[[Scorer], Scorer], ...]:
        """Of the scores, from inside out: the best heading or view, only earlier places for loops."""
        copies: list[Callable[[Scorer], Scorer]] = [self.views] if self.views != ALONE else []
        copies += [partial(BestHeading, copies=self.headings)] if self.headings > 1 else []
        return (*copies, *([partial(Earlier, apart=self.loops)] if self.loops is not None else []))

    @property
    def copies(self) -> int:
        """Of each query that are described."""
        return self.headings * len(self.views.shifts)

    def copies_of(self, traverse: Traverse, layout: Layout) -> Traverse:
        """All copies of queries, see `facing_north` and `Moved`."""
        return self.views.of(facing_north(traverse, layout, self.headings))

    def centres(self, default: bool) -> bool:
        """Whether single queries and those of a drive are centred."""
        return default if self.centre is None else self.centre == "mean"

    def check_loops(self, **others: object) -> None:
        """Refuse loops with a way of matching that they have not, and with other options."""
        if self.loops is not None:
            together = self.way not in (None, "drive", "single") and self.way
            own = {"centre": self.centre, "top": self.top, "headings": self.headings != 1 and self.headings}
            refuse_with(f"--loops {self.loops}", match=together, moved=self.moved, **own, **others)


SEQUENCES = Sequences()
DRIVES = Drives()
QUERYING = Querying()  # by the whole drive if queries are in order, else each by itself
