"""Learn, localize, evaluate, and set it beside the baselines and the null controls."""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.arrays import UNNAMED, as_traverse
from dejavu_torch.data.fitted import Fitted
from dejavu_torch.data.ground_truth import (
    as_ground_truth,
    check_ground_truth,
    describe_ground_truth,
    ground_truth_in_places,
    offset_of,
)
from dejavu_torch.evaluation.answers import own_facts
from dejavu_torch.evaluation.baselines import baselines_of, hog_baselines, seqslam_baseline
from dejavu_torch.evaluation.contenders import Contender, contend, lengths_beside
from dejavu_torch.evaluation.evaluate import RANKS, candidate_facts, evaluation_facts
from dejavu_torch.evaluation.pictures import Localization, draw_pictures
from dejavu_torch.evaluation.plots import Picture
from dejavu_torch.evaluation.rejection import draw_reliability, rejection_facts
from dejavu_torch.evaluation.report import Report, as_html
from dejavu_torch.evaluation.score_plots import Stored
from dejavu_torch.evaluation.storage import noise_over_map, storage_curve
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.views import Views
from dejavu_torch.growth import calibrate_if_possible
from dejavu_torch.maps.distance import l1_backend
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import recipe_of
from dejavu_torch.motion.resampling import ResampledTraverse, ground_truth_of, source_of
from dejavu_torch.periods.spectrogram import BACKEND
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.localizer import Matching
from dejavu_torch.recognition.select import check_candidates
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import InputError, Match, SequenceModel, Traverse

log = logging.getLogger("dejavu_torch")

SAMPLED = 256  # reference frames that a given map is tried on
NEAR = 10  # places within which it should find them, at least


class Comparison(NamedTuple):
    """A comparison's figures and pictures, and the run they are of.

    The run's traverses are as they were learned and localized, resampled where the model asks for it; its
    match and truth count places. candidates: of each query the best places, no two within the tolerance, as
    many as were wanted or as a score takes. A notebook shows the table of scores and two pictures.
    """

    report: Report
    pictures: Mapping[str, Picture]
    run: Localization
    candidates: Match

    def __repr__(self) -> str:
        return f"{self.run!r}\n{self.report!r}\npictures: {', '.join(self.pictures)}"

    def _repr_html_(self) -> str:
        return as_html(self.report, self.pictures)


def compare(
    reference: Traverse | Tensor,
    query: Traverse | Tensor,
    truth: str | None = None,
    model: DejaVu | None = None,
    *,
    tolerance: int = 5,
    leave_out: int | None = None,
    seed: int = 0,
    interpolate: bool = False,
    second: Views | None = None,
    others: Mapping[str, tuple[str, DejaVu]] | None = None,
    sequence: SequenceModel | None = None,
    top: int = 1,
    calibration: Views | Literal["none"] | None = None,
    distractors: Sequence[Traverse] = (),
    progress: bool = False,
) -> Comparison:
    """Learn the reference, find the queries on it, and evaluate that beside what else could be stored.

    Args:
        reference: the traverse to learn. query: a second traverse of the route.
        truth: see `find_ground_truth`; where neither it nor the sources themselves tell the right places,
            there are matches and pictures, but neither scores nor baselines.
        model: settings; None is DejaVu with its defaults. A model that has a map keeps it and is
            evaluated as it is: the map has to be of this very reference. It learns and localizes on the
            device that it is on, and is on the CPU afterwards, where all the rest is computed.
        tolerance: places within which one is right, inclusive.
        leave_out: also query the reference with itself, leaving out this many frames to each side of
            the query from every mean; a diagnostic.
        seed: of the shuffle of the null control.
        interpolate: see `find_ground_truth`.
        second: see `DejaVu.describe_reference`; another traverse than the query.
        others: further models that learn the same reference, by their keys in report.json, with their names
            in tables. They are scored by their matches, so only where there is a truth; none of them
            resamples.
        sequence: scores consecutive queries together, on the map and on all that it is set beside.
        top: how many candidates of each query are wanted.
        calibration: see `DejaVu.calibrate`; another traverse than the query. None calibrates a map that is
            learned by changed frames of the reference, "none" does not.
        distractors: routes that are not on the map: how many of their frames are accepted.
        progress: show progress bars on a terminal.

    Raises:
        InputError: bad input of any of the stages, or a map of another number of places.
    """
    model = DejaVu() if model is None else model
    itself = reference is query
    reference, query = as_traverse(reference), as_traverse(query)
    _check_arguments(model, truth, tolerance, leave_out, interpolate)
    check_candidates(top, tolerance)
    has_map = model.map.places > 0
    reference = model.fit(reference, model.frame_shape if has_map else None)
    query = model.fit(query, reference.frame_shape)
    features = model.describer.check_sizes(reference, query)
    seconds: dict[str, float] = defaultdict(float)
    work = "describe" if has_map else "learn"
    with timed(seconds, work):
        reference = model.resample(reference, model.step if has_map else None, progress)
    with timed(seconds, "localize"):
        query = model.resample(query, getattr(reference, "step", None), progress)
    check_candidates(top, tolerance, reference.length)  # before the long work
    if sequence is not None and reference.length is not None:
        sequence.check(None, reference.length)
    find_truth = partial(ground_truth_of, truth, reference, query, interpolate=interpolate)
    lengths_known = reference.length is not None and query.length is not None
    known = find_truth() if lengths_known else None  # one that does not fit is refused before the long work
    if itself or (reference.name == query.name != UNNAMED):
        log.warning(
            "%s is matched with itself, every frame with its own; evaluate on a second traverse", query.name
        )
    with timed(seconds, work):
        places = _described(model, reference, second, tolerance, progress)
        if isinstance(calibration, Views) or (calibration is None and not has_map):
            calibrate_if_possible(model, reference, calibration)
        model.matching(sequence)
    with timed(seconds, "localize"):
        model.check_queries(query.frame_shape, features, query.name)
        queries = model.extract_all(query, "describing the query" if progress else None)
        if sequence is not None:
            sequence.check(len(queries), model.map.places)
        ranks = max(top, min(max(RANKS), model.map.places))
        matching = Matching(sequence, lengths_beside(sequence, len(queries), model.map.places))
        wanted = model.matching(sequence)._replace(lengths=matching.lengths, k=ranks, radius=tolerance)
        candidates = model.localize_descriptors(queries, wanted)
    match = candidates.map(lambda column: column[:, 0])
    off_map = {one.name: _probability(model, one, sequence) for one in distractors if wanted.platt}
    if distractors and not off_map:
        log.warning("the map is not calibrated: nothing tells what of other routes would be accepted")
    model.cpu()  # baselines, null and pictures take their numbers one by one
    places, queries = places.cpu(), queries.cpu()
    if not lengths_known:
        known = find_truth(len(places), len(queries))
    if known is not None:
        known = ground_truth_in_places(known, model.map.place_of)
    run = Localization(model, reference, query, places, queries, match, known, tolerance, matching)
    contenders = _contenders(run, match, seed, leave_out, progress)
    for key, (name, other) in (others or {}).items():
        if known is not None:
            contenders[key] = _learned_beside(run, name, other)
    scored = contenders["map"].scores is not None
    storage, noise = _at_other_sizes(run, seed, progress) if scored else (None, {})
    pictures = draw_pictures(run, contenders, storage)
    pictures |= draw_reliability(run.scored, known, tolerance)
    carried = all(source_of(one).place is not None for one in (reference, query))
    facts = {
        **_map_facts(model.summary(), places),
        **_run_facts(run, seconds),
        **noise,
        **evaluation_facts(
            of_shown_frames(match, model.map),
            known,
            tolerance,
            model.map.positions,
            describe_ground_truth(truth, interpolate, carried),
        ),
        **own_facts(
            match._replace(index=model.map.frame_of(match.index)),
            run.query_frames,
            tolerance,
            known is not None,
            offset_of(truth, carried),
        ),
        **candidate_facts(model.map.table.scored(candidates.index), known, tolerance),
        **rejection_facts(run.scored, known, tolerance, off_map),
        **{name: dict(picture.numbers) for name, picture in pictures.items() if picture.numbers},
    }
    return Comparison(Report(contenders.pop("map"), contenders, facts), pictures, run, candidates)


def _described(
    model: DejaVu, reference: Traverse, second: Views | None, tolerance: int, progress: bool
) -> Tensor:
    """Descriptors of the reference (N,K), whose map is checked where there is one, and learned otherwise."""
    text = "describing the reference" if progress else None
    if not model.map.places:
        places = model.describe_reference(reference, second, text)
        model.learn_features(places, reference)
        return places
    if reference.length is not None:
        _check_places(model.map, reference.name, reference.length)
    places = model.extract_all(reference, text)
    _check_map(model, places, reference.name, tolerance)
    return places


def _probability(model: DejaVu, traverse: Traverse, sequence: SequenceModel | None) -> Tensor:
    """Of what is found for frames that are not on the map, (n,)."""
    frames = Fitted(traverse, model.frame_shape or ())
    found = model.localize_descriptors(model.extract_all(frames), sequence).probability
    assert found is not None
    return found


@contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Add the seconds of a block to what is under a name."""
    began = time.perf_counter()
    yield
    seconds[name] += time.perf_counter() - began


def _check_arguments(
    model: DejaVu, truth: str | None, tolerance: int, leave_out: int | None, interpolate: bool
) -> None:
    for name, value in (("tolerance", tolerance), ("leave_out", leave_out)):
        if value is not None and value < 0:
            raise InputError(f"{name} is {value}; expected at least 0")
    if leave_out is not None and not isinstance(model.mapper, TemplateMapper):
        raise InputError(
            f"leave_out is {leave_out}, but it is of template maps: expected a TemplateMapper, "
            "as of --config local_maxima"
        )
    if leave_out is not None and model.map.places and model.trained is not None:
        raise InputError(
            f"leave_out is {leave_out}, but trained templates are no means of frames to leave out"
        )
    if truth is not None:
        check_ground_truth(truth, interpolate)


def _check_map(model: DejaVu, features: Tensor, name: str, tolerance: int) -> None:
    """Refuse a map of another number of places, and warn of one that does not find its own reference."""
    _check_places(model.map, name, len(features))
    sample = torch.arange(0, len(features), max(1, len(features) // SAMPLED))
    found = (model.localize_descriptors(features[sample]).index - sample).abs() <= max(tolerance, NEAR)
    if found.float().mean() < 0.5 and model.map.summary().covered:
        log.warning(
            "the map finds %d of %d frames of %s; expected the reference that it was made of",
            *(int(found.sum()), len(sample), name),
        )


def _check_places(route: PlaceMap, name: str, places: int) -> None:
    if places != route.places:
        raise InputError(
            f"{name} gives {places} places, the map holds {route.places}; "
            "expected the reference that it was made of"
        )


def of_shown_frames(match: Match, route: PlaceMap) -> Match:
    """Each match at the place of the frame it reports, as a ground truth in frames counts (convention 11)."""
    return match._replace(index=route.table.scored(match.index))


def _contenders(
    run: Localization, found: Match, seed: int, leave_out: int | None, progress: bool
) -> dict[str, Contender]:
    """The map and what it is set beside, by their keys in report.json; the map's own is `map`.

    Args:
        found: on the map.
    """
    model, tolerance = run.model, run.tolerance
    contenders = {"map": _contend(run, "this map", found, model)}
    if run.truth is None and leave_out is None:  # nothing that the others find could be scored
        return contenders
    features = run.reference_features, run.query_features
    baselines = baselines_of(model, *features, tolerance, seed, leave_out, progress, run.matching)
    traverses, size = (run.reference, run.query), model.batch_size
    if not _is_plain_hog(model):
        baselines |= hog_baselines(*traverses, size, tolerance, progress, run.matching)
    if run.sequence is not None:
        baselines |= seqslam_baseline(*traverses, size, progress, run.matching)
    for key, (name, answers, bytes, k, fixed) in baselines.items():
        truth, answers = run.truth, answers.renumbered(model.map.table.scored)
        if key == "leave_out":  # its queries are the places themselves
            own = model.map.frame_of(torch.arange(model.map.places))[:, None]
            truth = ground_truth_in_places(as_ground_truth(own), model.map.place_of)
        contenders[key] = contend(name, answers, truth, tolerance, bytes, k, fixed, answers.sequences)
    return contenders


def _contend(run: Localization, name: str, found: Match, model: DejaVu) -> Contender:
    """What a model found of the run's places."""
    found, summary = found.renumbered(run.model.map.table.scored), model.summary()
    sizes = {"bytes": summary.map_bytes, "fixed": summary.fixed_bytes}
    return contend(name, found, run.truth, run.tolerance, **sizes, sequences=found.sequences)


def _learned_beside(run: Localization, name: str, other: DejaVu) -> Contender:
    """Another model that learns the run's reference."""
    found = other.learn(run.reference).localize_descriptors(other.extract_all(run.query), run.matching)
    return _contend(run, name, found, other)


def _at_other_sizes(
    run: Localization, seed: int, progress: bool
) -> tuple[dict[str, list[Stored]] | None, dict[str, float]]:
    """The storage curve of a spectral map, and what report.json holds of its smoothness."""
    route = run.model.map
    if not isinstance(route, SpectralMap):
        return None, {}
    storage = storage_curve(run, seed=seed, progress=progress)
    whole = len(route.chunks) == 1
    return storage, {"noise_over_map": noise_over_map(route, run.reference_features, seed)} if whole else {}


def _is_plain_hog(model: DejaVu) -> bool:
    """Whether the uncompressed baseline is HOG with its defaults, by L1."""
    pairs = (model.preprocess, Preprocess()), (model.features, HOG())
    same = all(recipe_of(own) == recipe_of(plain) for own, plain in pairs)
    return same and model.whitening is None and getattr(model.map, "metric", "l1") == "l1"


def _map_facts(summary: MapSummary, features: Tensor) -> dict[str, Any]:
    """What report.json holds of the map, whose places have these features (N,D)."""
    return {
        "frames": len(features),
        "kind": summary.kind,
        "map_bytes": summary.map_bytes,
        "backbone_bytes": summary.fixed.get("backbone", 0),
        "fixed_bytes": summary.fixed_bytes,
        "route_bytes": summary.route_bytes,
        "bytes_per_place": summary.bytes_per_place,
        "route_bytes_per_place": summary.route_bytes / len(features),
        "full_bytes": features.numel() * features.element_size(),
        "templates": summary.templates,
        "template_numbers": summary.template_numbers,
        "lines": summary.lines,
        "periods": sorted({plain_number(period) for chunk in summary.chunks for period in chunk.periods}),
        "chunks": [
            {
                "start": chunk.start,
                "stop": chunk.stop,
                "periods": [plain_number(period) for period in chunk.periods],
                "features": list(chunk.features),
            }
            for chunk in summary.chunks
        ],
    }


def _run_facts(run: Localization, seconds: Mapping[str, float]) -> dict[str, Any]:
    """What report.json holds of the run beside its scores; nothing is learned where the map is given."""
    model, reference, query = run.model, run.reference, run.query
    rule = model.acceptance(run.sequence)
    facts = {
        "seconds_learn": seconds["learn"],
        "seconds_localize": seconds["localize"],
        "l1_backend": l1_backend(),
        "spectrogram_backend": BACKEND,
        "threshold": rule.threshold,
        "least_probability": rule.precision,
        "sequence": run.sequence.length if isinstance(run.sequence, SequenceMatcher) else 1,
        "speeds": list(run.sequence.speeds) if isinstance(run.sequence, SequenceMatcher) else None,
        "filter": isinstance(run.sequence, PlaceFilter),
        "trained": model.trained and model.trained._asdict(),
        "reference": reference.name,
        "query": query.name,
    }
    if isinstance(reference, ResampledTraverse):
        facts["resampling"] = {
            "step": reference.step,
            "reference_frames": len(reference.positions),
            "query_frames": len(query.positions) if isinstance(query, ResampledTraverse) else None,
        }
    return facts


def plain_number(period: object) -> int | float:
    """An exact period as a number of JSON."""
    value = float(period)  # type: ignore[arg-type]
    return int(value) if value.is_integer() else value
