"""Options that several commands share, with their checks: each field is an option, `Args:` its help."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from torch import nn

from dejavu_torch import growth
from dejavu_torch.cli.device import device_of
from dejavu_torch.data.frame_range import parts_of
from dejavu_torch.data.source import open_source
from dejavu_torch.features.views import Views
from dejavu_torch.model import DejaVu, check_precision, default_features
from dejavu_torch.model_file import NO_MAP, recipe_of
from dejavu_torch.motion.resampling import source_of
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.search import Search, check_search
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import InputError, SequenceModel, Traverse

NO_CALIBRATION = "none"
UNREAD = (None, NO_CALIBRATION)  # of --calibration: no source
Reference = TypeVar("Reference", Traverse, Traverse | None)


@dataclass
class Sequences:
    """How consecutive queries are matched together.

    Args:
        sequence: queries that are matched together, one place after another
        speeds: of a sequence, places a query, such as '[.8,1,1.25]'; 1 if not given
        filter: the most probable place given all queries so far; scores and --threshold are -log of its
            probability
        moves: of the filter, probabilities of moving by 0, 1, 2, .. places; '[.2,.6,.2]' if not given
    """

    sequence: int = 1
    speeds: list[float] | None = None
    filter: bool = False
    moves: list[float] | None = None

    def matcher(self, within: int, threshold: float | None) -> SequenceModel | None:
        """The filter, or a sum over so many queries; None for single queries.

        Args:
            within, threshold: of the filter, which keeps its own threshold if that is None.
        """
        settings = {"moves": self.moves, "search_every": getattr(self, "search_every", None)}
        given: dict[str, Any] = {name: value for name, value in settings.items() if value is not None}
        if self.filter:
            if self.sequence > 1:
                raise InputError(f"--sequence {self.sequence} and --filter; expected one or the other")
            chosen = PlaceFilter(within=within, **given)
            chosen.threshold = chosen.threshold if threshold is None else threshold
            return chosen
        for name, value in given.items():
            raise InputError(f"--{name} {value} without --filter; expected both")
        if self.speeds is not None and self.sequence == 1:
            raise InputError(f"--speeds {self.speeds} without --sequence; expected --sequence T with them")
        matcher = SequenceMatcher(self.sequence, (1.0,) if self.speeds is None else self.speeds)
        return None if self.sequence == 1 else matcher


@dataclass
class Searches(Sequences):
    """As above, for what need not search all places for each query.

    Args:
        search_every: of the filter, queries from one search of all places to the next; in between only those
            near the last place are scored; 1 if not given
    """

    search_every: int | None = None


@dataclass
class LiveSearches(Searches):
    """The filter, unless queries are matched another way.

    Args:
        sequence: frames that are matched together in place of the filter; 1 takes each by itself
    """

    sequence: int | None = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        self.filter = self.filter or self.sequence is None
        self.sequence = 1 if self.sequence is None else self.sequence


@dataclass
class Searching:
    """How single queries are searched for.

    Args:
        search: coarse scores the places near the best samples of a long spectral map, exact rules out all
            others, scan scores all; auto is the faster of coarse and scan
        search_memory: MB for these samples; 100, of over 10^6 places 100 bytes each, if not given
    """

    search: Search = "auto"
    search_memory: float | None = None

    def of(self, model: DejaVu) -> None:
        """How a model searches from now on."""
        memory = self.search_memory
        if memory is not None and not memory > 0:
            raise InputError(f"--search_memory {memory:g}; expected a number above 0, in MB")
        check_search(self.search)
        model.search, model.search_memory = self.search, None if memory is None else int(1e6 * memory)


@dataclass
class KeptSearching(Searching):
    """How single queries find places on a map that is opened again and again.

    Args:
        search_file: file of the samples of a coarse or exact search, written if it does not exist, else read;
            a file made from another map, or with another --search or --search_memory, is refused. A filter
            needs --search_every above 1 with it: else it scores all places
    """

    search_file: Path | None = None

    def of(self, model: DejaVu) -> None:
        super().of(model)
        model.search_file = self.search_file


@dataclass
class Loading:
    """How a map is loaded.

    Args:
        as_is: take the frames as they are, though the map's are resampled
        device: what computes: cpu, cuda, cuda:1 or mps
        features: class of the map's features, if not ours
    """

    as_is: bool = False
    device: str = "cpu"
    features: nn.Module | None = None

    def model(self, path: Path) -> DejaVu:
        """The model of a map file, on the device."""
        model = load_map(path, self.features).to(device_of(self.device))
        model.velocity = None if self.as_is else model.velocity
        return model


def named_features(model: DejaVu) -> nn.Module | None:
    """The features of a model, for a file to be read with; None if they are default ones, for its own."""
    default = default_features(model.whitening is not None)
    return None if recipe_of(model.features) == recipe_of(default) else model.features


def load_map(path: Path, features: nn.Module | None = None) -> DejaVu:
    """As `DejaVu.load`; a descriptor is refused, which finds nothing by itself."""
    model = DejaVu.load(path, features)
    if not model.map.places:
        raise InputError(f"{path} is {NO_MAP.replace('FILE', str(path))}")
    return model


@dataclass
class Acceptance:
    """Which matches are accepted.

    Args:
        threshold: accept a match whose score is below; .inf accepts all
        precision: accept instead what is at least as probably right, such as .99. Without either, and none in
            the map, .5 on a calibrated map, else all
    """

    threshold: float | None = None
    precision: float | None = None

    def check(self, sequence: SequenceModel | None, distractors: object = None) -> None:
        """Refuse at once what does not go with a precision, or with what else needs probabilities."""
        if self.threshold is not None and self.precision is not None:
            seen = f"--threshold {self.threshold:g} and --precision {self.precision:g}"
            raise InputError(f"{seen}; expected one of them")
        check_precision(self.precision)
        if isinstance(sequence, PlaceFilter):
            together = f"--search_every {sequence.search_every}" if sequence.search_every > 1 else ""
        else:
            together = f"--sequence {sequence.length}" if isinstance(sequence, SequenceMatcher) else ""
        for name, value in (("--precision", self.precision), ("--distractors", distractors)):
            if together and value:
                why = "probabilities are of single queries and of a filter that searches all places each time"
                raise InputError(f"{together} and {name} {value}: {why}; expected one of the two options")

    def of(self, model: DejaVu) -> None:
        """What a model accepts from now on, if one of the two is given."""
        if self.threshold is not None or self.precision is not None:
            model.threshold, model.precision = self.threshold, self.precision


@dataclass
class Learning:
    """What a map is learned with beside its route.

    Args:
        seed: of the whitening, if it has none of its own, and of the null control
        second: another visit, or several, '[A,B]', from which to learn what changes
        second_truth: places it shows, as --truth; one for all, or '[A,B]'
        descriptor: file whose features are taken, as `dejavu train` makes, or a map
        calibration: a further traverse, which tells how probably answers are right, or none; changed frames
            of the route if not given
        calibration_truth: places that it shows, likewise
        device: what learns: cpu, cuda or cuda:1
    """

    seed: int = 0
    second: list[str] | str | None = None
    second_truth: list[str | int | None] | str | None = None
    descriptor: Path | None = None
    calibration: str | None = None
    calibration_truth: str | None = None
    device: str = "cpu"

    @property
    def files(self) -> list[Any]:
        """What is read."""
        given = [*several(self.second), *map(str, several(self.second_truth))]
        return [*given, self.descriptor, self.calibration, self.calibration_truth]

    def seed_whitening(self, model: DejaVu) -> None:
        """The command's seed for a whitening that is to be learned and has none of its own."""
        if model.whitening is not None and not model.whitening.fixed and not model.map.places:
            model.whitening.seed = model.whitening.seed or self.seed

    def with_second(
        self, model: DejaVu, reference: Traverse, query: Traverse | None = None
    ) -> tuple[Traverse, Views | None]:
        """The reference, and the further traverses that whitening learns from."""
        if self.second is None:
            check_no_truth("second", self.second_truth)
            return reference, None
        traverses: list[Traverse] = []
        for source in several(self.second):
            others = query, *parts_of(source_of(reference)), *traverses
            traverses.append(open_another("second", source, others))
        reference = model.resample(reference, progress=True, shape=model.frame_shape)
        truths = [None if one is None else str(one) for one in several(self.second_truth)]
        return reference, growth.second_traverse(model, reference, traverses, truths or None)

    def with_calibration(
        self, model: DejaVu, reference: Reference, query: Traverse | None = None
    ) -> tuple[Reference, Views | None]:
        """The reference, if there is one, and the traverse that its map, or the model's, is calibrated by."""
        source, truth = self.calibration, self.calibration_truth
        if source is None or source == NO_CALIBRATION:
            check_no_truth("calibration", truth)
            return reference, None
        others: list[Traverse | None] = [query]
        others += [] if reference is None else parts_of(source_of(reference))
        others += [open_source(one) for one in several(self.second)]
        traverse = open_another("calibration", source, others)
        if reference is not None:
            reference = model.resample(reference, model.step, True, model.frame_shape)
            traverse = model.fit(traverse, reference.frame_shape)
            model.describer.check_sizes(reference, traverse)
        return reference, growth.associate(model, reference, traverse, truth)

    def check_precision(self, model: DejaVu, traverse: Traverse) -> None:
        """Refuse a precision, given or the map's, that nothing is there to calibrate for."""
        why = ""
        if self.calibration == NO_CALIBRATION:
            why = "--calibration none"
        elif self.calibration is None and len(traverse.frame_shape) != 3:
            why = f"{traverse.name}, which has no frames to calibrate by"
        if model.precision is not None and why:
            expected = "expected --calibration SOURCE, or --threshold in place of the precision"
            raise InputError(f"a precision, {model.precision}, and {why}; {expected}")


@dataclass
class Growth:
    """What a map is grown by.

    Args:
        append: map file behind whose places those of the source come; it is written again unless --map names
            another file
        average: a further traverse of the source's places, averaged in before they are coded; without a
            source of those of --append, which are decoded, averaged and coded again at the same step
        average_truth: which places it shows, as --truth of `dejavu compare`
    """

    append: Path | None = None
    average: str | None = None
    average_truth: str | None = None

    def model(self, given: DejaVu) -> DejaVu:
        """That of --append, with the features and the acceptance of the given one; or that one."""
        if self.append is None:
            return given
        model = load_map(self.append, named_features(given))
        Acceptance(given.threshold, given.precision).of(model)
        return model

    def check(self, sources: Iterable[str], calibration: str | None) -> None:
        """Refuse to average a traverse with itself, or to calibrate by what a map has been averaged with."""
        if self.average is None:
            check_no_truth("average", self.average_truth)
            return
        traverse = open_another("average", self.average, [open_source(one) for one in sources])
        if calibration not in UNREAD:
            open_another("calibration", str(calibration), [traverse])

    def visits(self, model: DejaVu, reference: Traverse | None) -> Views:
        """The further traverse, and which places it shows, of the reference or of the map."""
        return growth.associate(model, reference, open_source(str(self.average)), self.average_truth)


@dataclass
class Judging:
    """How answers are judged, and what else a report of them has.

    Args:
        truth: offset (place = query + offset), csv of query,place[,place...], json of a list per query, npz
            with GThard, or utm:25 by image names
        tolerance: right within so many places, inclusive
        interpolate: fill in a csv that lists some queries only
        leave_out: of templates, a diagnostic: the reference on itself, without so many frames each side
        top: write so many places of each query, no two within the tolerance
        distractors: another route, or several, '[A,B]': what is accepted there
        storage_curve: also evaluate maps of other sizes, which takes as long as all the rest
        ordered: queries are in order, as those of videos are: a filter stands beside single ones
        unordered: they are not
    """

    truth: str | None = None
    tolerance: int = 5
    interpolate: bool = False
    leave_out: int | None = None
    top: int | None = None
    distractors: list[str] | str | None = None
    storage_curve: bool = False
    ordered: bool = False
    unordered: bool = False

    def in_order(self, together: bool) -> bool | None:
        """Whether queries, matched together or not, are in order; None if their source is to tell."""
        if self.unordered and (self.ordered or together):
            other = "--ordered" if self.ordered else "queries that are matched together"
            raise InputError(f"--unordered and {other}; expected one of them, or none")
        return self.ordered if self.ordered or self.unordered else None

    def off_map(self, traverses: Collection[Traverse]) -> list[Traverse]:
        """The distractors, none of which may be one of the traverses."""
        return [open_another("distractors", one, traverses) for one in several(self.distractors)]


def check_no_truth(option: str, truth: object) -> None:
    """Refuse a truth of a traverse that is not given."""
    if truth is not None:
        raise InputError(f"--{option}_truth {truth} is of no traverse; expected --{option} SOURCE with it")


def several(given: Any) -> list[Any]:
    """What an option names that takes one or several."""
    return [] if given is None else [*given] if isinstance(given, list) else [given]


def open_another(option: str, source: str, others: Iterable[Traverse | None]) -> Traverse:
    """The traverse of an option, none of those that are read already, however its path is written."""
    traverse = open_source(source)
    for other in others:
        if other is not None and Path(other.name).resolve() == Path(traverse.name).resolve():
            raise InputError(f"--{option} {source} is {other.name} itself; expected another traverse")
    return traverse
