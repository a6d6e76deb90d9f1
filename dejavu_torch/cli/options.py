"""Options that several commands share: each field is an option, and `Args:` has its help."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

from torch import nn

from dejavu_torch import growth
from dejavu_torch.cli.device import device_of
from dejavu_torch.data.files import as_number
from dejavu_torch.data.source import open_source
from dejavu_torch.data.traverse import parts_of
from dejavu_torch.features.descriptor import default_features
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.model import DejaVu, check_precision
from dejavu_torch.model_file import NO_MAP, recipe_of
from dejavu_torch.motion.resampling import source_of
from dejavu_torch.recognition.coarse import searcher
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.search import Search, check_search
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.types import InputError, SequenceModel, Traverse, expect

NO_CALIBRATION = "none"
UNREAD = (None, NO_CALIBRATION)  # values of --calibration that name no source
Reference = TypeVar("Reference", Traverse, Traverse | None)


WAYS = "drive, filter, single or sequence:T with a whole number T of at least 1"


@dataclass
class Sequences:
    """How consecutive queries are matched together.

    Args:
        match: drive (each query with all others; default if in order), filter (with those before), sequence:T
            (T queries at constant speed) or single; scores of the first two are at least -log(probability)
        speeds: speeds of a sequence in places per query, such as '[.8,1,1.25]'; 1 if not given
    """

    match: str | None = None
    speeds: list[float] | None = None
    sequence: int | None = None  # also spelt --match sequence:T
    filter: bool = False  # also spelt --match filter

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
        return self.match

    def matcher(self, within: int, threshold: float | None) -> SequenceModel | Literal["auto"] | None:
        """The model that matches queries together; None for single queries, "auto" if no way is given.

        Args:
            within, threshold: of filter and smoother; None keeps the model's own threshold.
        """
        way, length = self.way, None
        if way is not None and way.startswith("sequence:"):
            length = as_number(way.removeprefix("sequence:"))
            expect(length is not None and length % 1 == 0, WAYS, f"--match {way}")
        elif way not in (None, "drive", "filter", "single"):
            raise InputError(f"--match {way}; expected {WAYS}")
        fits = self.speeds is None or length not in (None, 1)
        expect(fits, "--match sequence:T with them", f"--speeds {self.speeds} without a sequence")
        if length is not None:
            matcher = SequenceMatcher(int(length), (1.0,) if self.speeds is None else self.speeds)
            return None if length == 1 else matcher
        if way in ("drive", "filter"):
            return (PlaceSmoother if way == "drive" else PlaceFilter)(within=within, threshold=threshold)
        return "auto" if way is None else None

    def check_loops(self, loops: int, **others: object) -> None:
        """Refuse loops with a way of matching that they have not, and with other options."""
        together = self.way not in (None, "drive", "single") and self.way
        refuse_with(f"--loops {loops}", match=together, **others)


@dataclass
class LiveSequences(Sequences):
    """How frames are matched.

    Args:
        match: filter (each frame with those before it; default), sequence:T (with the T - 1 before it, at
            constant speed) or single
        lag: delay the filter's answers by this many frames, and use these frames for them
        learns: let the filter learn the camera's moves and the sharpness of scores from the drive
        centre: mean subtracts the mean of the frames so far from each frame
    """

    lag: int = 0
    learns: bool = False
    centre: Literal["mean", "none"] = "none"

    @property
    def way(self) -> str | None:
        return super().way or "filter"

    def matcher(self, within: int, threshold: float | None) -> SequenceModel | Literal["auto"] | None:
        matcher = super().matcher(within, threshold)
        if isinstance(matcher, PlaceFilter):
            return PlaceFilter(within=within, threshold=threshold, lag=self.lag, learns=self.learns)
        seen = f"--lag {self.lag}" if self.lag else "--learns"
        expect(not self.lag and not self.learns, "--match filter with it", f"{seen} with --match {self.way}")
        return matcher


@dataclass
class Ordering:
    """The order of the queries.

    Args:
        ordered: queries are in order, as in a video; needed for a .npy of frames
        unordered: queries are in no order: match each by itself
        centre: mean removes what all queries share but the map does not; default for 50 or more in order
    """

    ordered: bool = False
    unordered: bool = False
    centre: Literal["mean", "none"] | None = None

    def of(self, matcher: SequenceModel | Literal["auto"] | None) -> bool | None:
        """Whether queries, matched so, are in order; None leaves it to their source."""
        together = isinstance(matcher, SequenceModel)
        if self.unordered:
            refuse_with("--unordered", ordered=self.ordered, match=together and "drive, filter or sequence:T")
        if self.centre == "mean" and together and not isinstance(matcher, PlaceSmoother):
            raise InputError("--centre mean with a filter or a sequence; expected --match drive or single")
        ordered = self.ordered or isinstance(matcher, PlaceSmoother)
        return ordered if ordered or self.unordered else None

    @staticmethod
    def chosen(
        matcher: SequenceModel | Literal["auto"] | None, ordered: bool, within: int, threshold: float | None
    ) -> SequenceModel | None:
        """The given way of matching, else by the whole drive if queries are in order."""
        if matcher != "auto":
            return matcher
        return PlaceSmoother(within=within, threshold=threshold) if ordered else None

    def centring(self, model: DejaVu, ordered: bool, queries: int) -> bool:
        """Whether single queries and those of a smoother are centred."""
        return self.centre == "mean" if self.centre else ordered and model.centres(queries)


@dataclass
class Searching:
    """How places are searched for single queries.

    Args:
        search: auto and coarse compare 8-bit samples of a spectral map and score only the best places; exact
            and scan score all places
        search_memory: MB for these samples; by default 300, or 100 bytes per place above 3 x 10^6 places;
            on a GPU half of its free memory
    """

    search: Search = "auto"
    search_memory: float | None = None

    @property
    def bytes(self) -> int | None:
        """Of the samples."""
        return None if self.search_memory is None else int(1e6 * self.search_memory)

    def of(self, model: DejaVu) -> None:
        """Set how a model searches."""
        if self.search_memory is not None and not self.search_memory > 0:
            raise InputError(f"--search_memory {self.search_memory:g}; expected a number above 0, in MB")
        check_search(self.search)
        model.make_searcher = partial(searcher, method=self.search, memory=self.bytes)


@dataclass
class Loading:
    """How a map is loaded.

    Args:
        as_is: do not resample the frames, even if those of the map are resampled
        device: cpu, cuda, cuda:1 or mps
        features: class of the map's features, if it is not part of dejavu_torch
    """

    as_is: bool = False
    device: str = "cpu"
    features: nn.Module | None = None

    def model(self, path: Path, route: str | None = None) -> DejaVu:
        """The model of a map file, or of one route of it, on the device."""
        model = load_map(path, self.features).to(device_of(self.device))
        model = model if route is None else growth.only_route(model, route)
        model.velocity = None if self.as_is else model.velocity
        return model


def named_features(model: DejaVu) -> nn.Module | None:
    """The features to load a file with: those of a model, or None, the file's own, for the default ones."""
    default = default_features(model.whitening is not None)
    return None if recipe_of(model.features) == recipe_of(default) else model.features


def load_map(path: Path, features: nn.Module | None = None) -> DejaVu:
    """As `DejaVu.load`, but refuse a descriptor without a map."""
    model = DejaVu.load(path, features)
    if not model.map.places:
        raise InputError(f"{path} is {NO_MAP.replace('FILE', str(path))}")
    return model


@dataclass
class Acceptance:
    """Which matches are accepted.

    Args:
        threshold: accept matches with a score below this; .inf accepts all
        precision: accept matches that are right with at least this probability, such as .99. If neither
            this nor a threshold is set: .5 for a whole drive or on a calibrated map, else all
    """

    threshold: float | None = None
    precision: float | None = None

    def check(self, sequence: SequenceModel | str | None, distractors: object = None) -> None:
        """Refuse what excludes a precision or distractors, which both need probabilities."""
        if self.threshold is not None:
            refuse_with(f"--threshold {self.threshold:g}", precision=self.precision)
        check_precision(self.precision)
        for name, value in (("--precision", self.precision), ("--distractors", distractors)):
            if value and isinstance(sequence, SequenceMatcher):
                seen = f"--match sequence:{sequence.length} and {name} {value}"
                why = "a sequence has no probabilities"
                raise InputError(f"{seen}: {why}; expected one of the two options")

    def of(self, model: DejaVu) -> None:
        """Set what a model accepts, if one of the two is given."""
        if self.threshold is not None or self.precision is not None:
            model.threshold, model.precision = self.threshold, self.precision


@dataclass
class LearningOptions:
    """How a map is learned.

    Args:
        seed: seed of the whitening, unless it has its own, and of the null control
        second: another visit to the same route, to learn which changes to ignore, or several, '[A,B]'
        second_truth: ground truth of --second, in the formats of --truth; one for all, or '[A,B]'
        descriptor: file to take the features from: a map, or a descriptor of `dejavu train`
        calibration: another visit on which to calibrate probabilities, or none; by default augmented frames
            of the route
        calibration_truth: ground truth of --calibration, in the formats of --truth
        device: cpu, cuda or cuda:1
    """

    seed: int = 0
    second: list[str] | str | None = None
    second_truth: list[str | int | None] | str | None = None
    descriptor: Path | None = None
    calibration: str | None = None
    calibration_truth: str | None = None
    device: str = "cpu"

    @property
    def files(self) -> list[str | Path | None]:
        """What these options read."""
        given = [*several(self.second), *map(str, several(self.second_truth))]
        return [*given, self.descriptor, self.calibration, self.calibration_truth]

    def seed_whitening(self, model: DejaVu) -> None:
        """Give the seed to a whitening that will be learned and has none."""
        if model.whitening is not None and not model.whitening.fixed and not model.map.places:
            model.whitening.seed = model.whitening.seed or self.seed

    def with_views(
        self, model: DejaVu, reference: Reference, query: Traverse | None = None
    ) -> tuple[Reference, LabelledFrames | None, LabelledFrames | Traverse | None]:
        """The reference, if there is one, what its whitening learns from, and what calibrates its map, or the
        model's; all are opened and compared before one of them is measured."""
        named = None if self.calibration in UNREAD else self.calibration
        if self.second is None:
            check_no_truth("second", self.second_truth)
        if named is None:
            check_no_truth("calibration", self.calibration_truth)
        others: list[Traverse | None] = [query]
        others += [] if reference is None else parts_of(source_of(reference))
        seconds: list[Traverse] = []
        for source in several(self.second):
            seconds.append(open_another("second", source, [*others, *seconds]))
        other = None if named is None else open_another("calibration", named, [*others, *seconds])
        views = None
        if reference is not None and (self.second is not None or other is not None):
            reference = model.resample(reference, model.step, True, model.frame_shape)
            if self.second is not None:
                truths = [None if truth is None else str(truth) for truth in several(self.second_truth)]
                views = growth.second_traverse(model, reference, seconds, truths or None, True)
                for line in views.placed_lines():
                    print(line)
            if other is not None:
                other = model.at_map_size(other, reference.frame_shape)
                model.descriptor.check_sizes(reference, other)
        if other is None:
            return reference, views, None
        return reference, views, growth.visit_to_calibrate(model, reference, other, self.calibration_truth)

    def check_calibrated(
        self, model: DejaVu, traverse: Traverse, map: Path | None = None, distractors: object = None
    ) -> None:
        """Refuse a precision, given or the map's, and distractors, if the map is not calibrated."""
        why = ""
        if self.calibration in UNREAD and map is not None:
            why = "" if model.calibration is not None else f"{map}, which is not calibrated"
        elif self.calibration == NO_CALIBRATION:
            why = "--calibration none"
        elif self.calibration is None and len(traverse.frame_shape) != 3:
            why = f"{traverse.name}, which has no frames to calibrate by"
        for given, name in ((model.precision, "a precision,"), (distractors, "--distractors")):
            instead = ", or --threshold instead" if given is model.precision else ""
            expect(not why or not given, f"--calibration SOURCE{instead}", f"{name} {given}, and {why}")


@dataclass
class GrowthOptions:
    """How a map grows.

    Args:
        append: append the places of the source to this map file; it is overwritten unless --map names another
            file
        average: another visit, to average into the places of the source before they are coded; without a
            source, into those of --append, which are decoded, averaged and coded again with the same step
        average_truth: ground truth of --average, in the formats of --truth of `dejavu compare`
        route: the route of a merged map that --append makes longer
    """

    append: Path | None = None
    average: str | None = None
    average_truth: str | None = None
    route: str | None = None

    def model(self, given: DejaVu) -> DejaVu:
        """The model of --append with the features and acceptance of the given one, else the given one."""
        if self.append is None:
            return given
        model = load_map(self.append, named_features(given))
        Acceptance(given.threshold, given.precision).of(model)
        return model

    def check(self, sources: Iterable[str], calibration: str | None) -> None:
        """Refuse to average a traverse with itself, to calibrate by the averaged one, or a route alone."""
        expect(self.route is None or self.append, "--append with a merged map", f"--route {self.route}")
        if self.average is None:
            check_no_truth("average", self.average_truth)
            return
        traverse = open_another("average", self.average, [open_source(one) for one in sources])
        if calibration not in UNREAD:
            open_another("calibration", str(calibration), [traverse])

    def visits(self, model: DejaVu, reference: Traverse | None) -> LabelledFrames:
        """The traverse to average, and which places of the reference or the map it shows."""
        views = growth.associate(model, reference, open_source(str(self.average)), self.average_truth, True)
        for line in views.placed_lines():
            print(line)
        return views


@dataclass
class EvaluationOptions:
    """How answers are evaluated, and what else a report has.

    Args:
        truth: offset (place = query + offset), csv of query,place[,place...], json with a list per query, npz
            with GThard, or by image names utm:25, degrees:25 or metres:25
        tolerance: count an answer as right if it is at most this many frames off
        interpolate: interpolate a --truth that lists only some queries
        leave_out: template maps only: match the reference with itself, ignoring this many frames around each
            query
        top: write this many places per query, no two within the tolerance
        distractors: footage of other places, or several, '[A,B]': how much of it is wrongly accepted?
        storage_curve: also evaluate maps of other sizes; this doubles the time
        drives: matched as whole drives too: few contenders (float and control), or all
    """

    truth: str | None = None
    tolerance: int = 5
    interpolate: bool = False
    leave_out: int | None = None
    top: int | None = None
    distractors: list[str] | str | None = None
    storage_curve: bool = False
    drives: Literal["few", "all"] = "few"

    def off_map(self, traverses: Collection[Traverse]) -> list[Traverse]:
        """The distractors, none of which may be one of the traverses."""
        return [open_another("distractors", one, traverses) for one in several(self.distractors)]


def refuse_with(option: str, **others: object) -> None:
    """Refuse an option if one of the others, which exclude it, is given."""
    for name, value in others.items():
        other = f"--{name}" if value is True else f"--{name} {value}"
        expect(not value, "one of them", f"{option} and {other}")


def check_no_truth(option: str, truth: object) -> None:
    """Refuse the truth of a traverse that is not given."""
    expect(truth is None, f"--{option} SOURCE with it", f"--{option}_truth {truth} without --{option}")


def several(given: object) -> list[Any]:
    """The values of an option that takes one or several."""
    return [] if given is None else [*given] if isinstance(given, list) else [given]


def open_another(option: str, source: str, others: Iterable[Traverse | None]) -> Traverse:
    """Open the traverse of an option; refuse one of the others, however its path is written."""
    traverse = open_source(source)
    for other in others:
        if other is not None and Path(other.name).resolve() == Path(traverse.name).resolve():
            raise InputError(f"--{option} {source} is {other.name} itself; expected another visit")
    return traverse
