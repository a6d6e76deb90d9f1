"""What a map learns from, and what a report tells: the options that commands and `compare` share."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from typing_extensions import Self

from dejavu_torch import growth
from dejavu_torch.data.arrays import UNNAMED
from dejavu_torch.data.source import as_traverse
from dejavu_torch.data.traverse import parts_of
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.resampling import source_of
from dejavu_torch.recognition.calibration import TOLERANCE
from dejavu_torch.recognition.querying import PYTHON, Querying
from dejavu_torch.recognition.scorer import Scorer
from dejavu_torch.types import InputError, Traverse, expect

log = logging.getLogger("dejavu_torch")

NO_CALIBRATION = "none"
REACH = "probabilities of being within %d places; here one is right within %d"
UNREAD = (None, NO_CALIBRATION)  # values of --calibration that name no source

Reference = TypeVar("Reference", Traverse, Traverse | None)
OtherModels = Mapping[str, tuple[str, DejaVu]]  # their names and models, by their keys in report.json
Contenders = Mapping[str, tuple[str, int, Scorer]]  # their names, bytes and scores, likewise


@dataclass(frozen=True)
class Learning:
    """How a map is learned.

    Args:
        seed: seed of the whitening, unless it has its own, and of the null control
        second: another visit to the same route, to learn which changes to ignore, or several, '[A,B]'
        second_truth: ground truth of --second, in the formats of --truth; one for all, or '[A,B]'
        calibration: another visit on which to calibrate probabilities, or none; by default augmented frames
            of the route
        calibration_truth: ground truth of --calibration, in the formats of --truth
    """

    seed: int = 0
    second: list[str] | str | Traverse | LabelledFrames | None = None
    second_truth: list[str | int | None] | str | None = None
    calibration: str | LabelledFrames | Traverse | None = None
    calibration_truth: str | None = None

    @property
    def views(self) -> LabelledFrames | None:
        """What the whitening learns from, once it is `opened`."""
        return self.second if isinstance(self.second, LabelledFrames) else None

    @property
    def visit(self) -> LabelledFrames | Traverse | None:
        """What the map is calibrated by, once it is `opened`."""
        return None if isinstance(self.calibration, str) else self.calibration

    def seed_whitening(self, model: DejaVu) -> None:
        """Give the seed to a whitening that will be learned and has none."""
        if model.whitening is not None and not model.whitening.fixed and not model.map.places:
            model.whitening.seed = model.whitening.seed or self.seed

    def opened(
        self, model: DejaVu, reference: Reference, query: Traverse | None = None, progress: bool = True
    ) -> tuple[Reference, Self]:
        """The reference, if there is one, and the same with frames in place of sources; all are opened and
        compared before one of them is measured."""
        seconds = [] if self.views is not None else several(self.second)
        named = None if isinstance(self.calibration, LabelledFrames) else self.calibration
        if named == NO_CALIBRATION or (not isinstance(named, str) and self.calibration_truth is None):
            named = None
        if self.second is None:
            check_no_truth("second", self.second_truth)
        if named is None:
            check_no_truth("calibration", self.calibration_truth)
        others: list[Traverse | None] = [query]
        others += [] if reference is None else parts_of(source_of(reference))
        visits: list[Traverse] = []
        for source in seconds:
            visits.append(open_another("second", source, [*others, *visits]))
        other = None if named is None else open_another("calibration", named, [*others, *visits])
        opened = replace(self, second_truth=None, calibration_truth=None)
        placed = self.second is not None and self.views is None
        if reference is not None and (placed or other is not None):
            reference = model.resample(reference, model.step, progress, model.frame_shape)
            if placed:
                truths = [None if truth is None else str(truth) for truth in several(self.second_truth)]
                views = growth.second_traverse(model, reference, visits, truths or None, progress)
                opened = replace(opened, second=views)
            if other is not None:
                other = model.at_map_size(other, reference.frame_shape)
                model.descriptor.check_sizes(reference, other)
        if other is not None:
            visit = growth.visit_to_calibrate(model, reference, other, self.calibration_truth)
            opened = replace(opened, calibration=visit)
        return reference, opened

    @contextmanager
    def calibrated(self, model: DejaVu, reference: Traverse, reach: int, progress: bool) -> Iterator[None]:
        """Within the block a calibrated model is calibrated for a reach, if there is what to do it by."""
        held, visit = model.calibration, self.visit
        try:
            if held is not None and reach != TOLERANCE:
                model.calibration = None
                # a visit says how sure it is within 5
                if self.calibration != NO_CALIBRATION and not isinstance(visit, Traverse):
                    growth.calibrate_if_possible(model, reference, visit, progress=progress, reach=reach)
                if model.calibration is None:
                    model.calibration = held
                    log.warning(f"the map gives {REACH}", TOLERANCE, reach)
            yield
        finally:
            model.calibration = held

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


@dataclass(frozen=True)
class Reporting:
    """How answers are evaluated, and what else a report has.

    Args:
        interpolate: interpolate a --truth that lists only some queries
        leave_out: template maps only: match the reference with itself, ignoring this many frames around each
            query
        distractors: footage of other places, or several, '[A,B]': how much of it is wrongly accepted?
        storage_curve: also evaluate maps of other sizes; this doubles the time
        drives: matched as whole drives too: few contenders (float and control), or all
        others: further models that learn the same reference, by their keys in report.json, with their names
            in tables. They need a ground truth, and none of them resamples.
        contenders: further ways to store the route, by their keys in report.json: a name for tables, bytes,
            and a `Scorer` of the same queries, or with headings of all their turned copies. They need a
            ground truth.
        on_found: called with the `Comparison` of the map's own answers, before they are compared.
        progress: show progress bars on a terminal.
    """

    interpolate: bool = False
    leave_out: int | None = None
    distractors: list[str] | str | Sequence[Traverse] | None = None
    storage_curve: bool = False
    drives: Literal["few", "all"] = "few"
    others: OtherModels = field(default_factory=dict, metadata=PYTHON)
    contenders: Contenders = field(default_factory=dict, metadata=PYTHON)
    on_found: Callable[[Any], object] | None = field(default=None, metadata=PYTHON)
    progress: bool = field(default=False, metadata=PYTHON)

    def off_map(self, traverses: Collection[Traverse]) -> list[Traverse]:
        """The distractors, none of which may be one of the traverses."""
        given = several(self.distractors)
        return [open_another("distractors", one, traverses) if isinstance(one, str) else one for one in given]

    def check(self, model: DejaVu, querying: Querying) -> None:
        """Refuse settings that exclude each other, before anything is read."""
        self.check_loops(querying)
        if self.leave_out is not None:
            seen = f"leave_out is {self.leave_out}"
            expect(self.leave_out >= 0, "at least 0", seen)
            if not isinstance(model.mapper, TemplateMapper):
                expected = "expected a TemplateMapper, as with --config local_maxima"
                raise InputError(f"{seen}, which needs a template map; {expected}")
            trained = model.map.places and model.trained is not None
            expect(not trained, "means of frames", f"{seen} and the templates are trained")
        if self.storage_curve:
            coded = isinstance(model.map if model.map.places else model.mapper, SpectralMap | SpectralMapper)
            expect(coded, "a SpectralMapper", "a storage curve of templates")

    def check_loops(self, querying: Querying) -> None:
        """Refuse loops with what needs a query."""
        names = ("distractors", "storage_curve", "leave_out")
        querying.check_loops(**{name: getattr(self, name) for name in names})

    def check_contenders(self, taken: Collection[str], judged: bool, queries: int, places: int) -> None:
        """Refuse scores of others than these queries and places, and what would stand for an own entry."""
        expect(judged or not self.storage_curve, "a truth", "there is none to judge a storage curve by")
        expect(judged or not self.contenders, "a truth", "there is none to judge contenders by")
        for key, (_, _, scorer) in self.contenders.items():
            expect(key not in taken, "a key that is not taken", f"the contender {key!r}")
            seen = f"the contender {key!r} scores {len(scorer)} queries at {scorer.layout.places} places"
            right = (len(scorer), scorer.layout.places) == (queries, places)
            expect(right, f"{queries} queries at {places} places", seen)


LEARNING, REPORTING = Learning(), Reporting()


def check_no_truth(option: str, truth: object) -> None:
    """Refuse the truth of a traverse that is not given."""
    expect(truth is None, f"--{option} SOURCE with it", f"--{option}_truth {truth} without --{option}")


def several(given: object) -> list[Any]:
    """The values of an option that takes one or several."""
    listed = isinstance(given, list) or type(given) is tuple  # not one of names, as `LabelledFrames`
    return [] if given is None else [*given] if listed else [given]  # type: ignore[misc]


def open_another(option: str, source: str | Traverse, others: Iterable[Traverse | None]) -> Traverse:
    """Open the traverse of an option; refuse one of the others, however its path is written."""
    traverse = as_traverse(source)
    path = Path(traverse.name).resolve()
    for other in (one for one in others if one is not None):
        named = traverse.name != UNNAMED
        if other is traverse or (named and Path(other.name).resolve() == path):
            given = source if isinstance(source, str) else source.name
            raise InputError(f"--{option} {given} is {other.name} itself; expected another visit")
    return traverse
