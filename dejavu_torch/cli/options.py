"""Options that several commands share: each field is an option, and `Args:` has its help."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from torch import nn

from dejavu_torch import growth
from dejavu_torch.cli.device import device_of
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation.options import (
    UNREAD,
    Learning,
    Reference,
    Reporting,
    check_no_truth,
    open_another,
    several,
)
from dejavu_torch.features.descriptor import default_features
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.model import DejaVu, check_precision
from dejavu_torch.model_file import NO_MAP, recipe_of
from dejavu_torch.recognition.coarse import searcher
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.querying import Drives, Querying
from dejavu_torch.recognition.search import Search, check_search
from dejavu_torch.text import refuse_with
from dejavu_torch.types import InputError, SequenceModel, Traverse, expect


@dataclass(frozen=True)
class LiveSequences(Drives):
    """How frames are matched.

    Args:
        match: filter (each frame with those before it; default), sequence:T (with the T - 1 before it, at
            constant speed) or single
        lag: delay the filter's answers by this many frames, and use these frames for them
        learns: let the filter learn the camera's moves and the sharpness of scores from the drive
        centre: mean subtracts the mean of the frames so far from each frame
        fov: horizontal field of view of the camera in degrees: tell by how many of them it points further
            right than at learning
    """

    lag: int = 0
    learns: bool = False
    centre: Literal["mean", "none"] = "none"
    fov: float | None = None

    @property
    def way(self) -> str | None:
        return super().way or "filter"

    def matcher(
        self, within: int = 5, threshold: float | None = None, ordered: bool | None = None
    ) -> SequenceModel | Literal["auto"] | None:
        matcher = super().matcher(within, threshold, ordered)
        if self.way == "filter":
            return PlaceFilter(within=within, threshold=threshold, lag=self.lag, learns=self.learns)
        seen = f"--lag {self.lag}" if self.lag else "--learns"
        expect(not self.lag and not self.learns, "--match filter with it", f"{seen} with --match {self.way}")
        return matcher


@dataclass(frozen=True)
class LocalQuerying(Querying):
    """How queries are matched.

    Args:
        fov: horizontal field of view of the camera in degrees: tell by how many of them it points further
            right than at learning
    """

    fov: float | None = None


@dataclass(frozen=True)
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


@dataclass(frozen=True)
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


@dataclass(frozen=True)
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
            if value and isinstance(sequence, SequenceModel) and sequence.answers == "sequence":
                seen = f"--match sequence:{sequence.length} and {name} {value}"
                why = "a sequence has no probabilities"
                raise InputError(f"{seen}: {why}; expected one of the two options")

    def of(self, model: DejaVu) -> None:
        """Set what a model accepts, if one of the two is given."""
        if self.threshold is not None or self.precision is not None:
            model.threshold, model.precision = self.threshold, self.precision


@dataclass(frozen=True)
class LearningOptions(Learning):
    """How a map is learned.

    Args:
        descriptor: file to take the features from: a map, or a descriptor of `dejavu train`
        device: cpu, cuda or cuda:1
    """

    descriptor: Path | None = None
    device: str = "cpu"

    @property
    def files(self) -> list[str | Path | None]:
        """What these options read."""
        given = [*several(self.second), *map(str, several(self.second_truth))]
        return [*given, self.descriptor, self.calibration, self.calibration_truth]

    def with_views(
        self, model: DejaVu, reference: Reference, query: Traverse | None = None
    ) -> tuple[Reference, Learning]:
        """As `opened`; what was placed is printed."""
        reference, opened = self.opened(model, reference, query)
        for line in [] if opened.views is None else opened.views.placed_lines():
            print(line)
        return reference, opened


@dataclass(frozen=True)
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

    def check(self, sources: Iterable[str], calibration: object) -> None:
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


@dataclass(frozen=True)
class Judging:
    """How answers are evaluated.

    Args:
        truth: offset (place = query + offset), csv of query,place[,place...], json with a list per query, npz
            with GThard, or by image names utm:25, degrees:25 or metres:25
        tolerance: count an answer as right if it is at most this many frames off
    """

    truth: str | None = None
    tolerance: int = 5


@dataclass(frozen=True)
class EvaluationOptions(Reporting, Judging):
    """How answers are evaluated, and what else a report has."""
