"""Learn, localize and evaluate, beside the baselines and the null controls."""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.arrays import UNNAMED, as_traverse
from dejavu_torch.data.fitted import Fitted
from dejavu_torch.data.ground_truth import (
    GroundTruth,
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
from dejavu_torch.evaluation.localization import Localization
from dejavu_torch.evaluation.pictures import draw_pictures
from dejavu_torch.evaluation.plots import Picture
from dejavu_torch.evaluation.rejection import draw_reliability, rejection_facts
from dejavu_torch.evaluation.report import Report, as_html
from dejavu_torch.evaluation.score_plots import Stored
from dejavu_torch.evaluation.storage import coded_at_sizes, noise_over_map
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.views import Views
from dejavu_torch.growth import calibrate_if_possible
from dejavu_torch.maps.distance import l1_backend
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
    """A comparison's figures and pictures, and their run; a notebook shows the scores and two pictures.

    The run's traverses are resampled where the model asks for it; its match and truth count places.
    candidates: of each query the best places, no two within the tolerance.
    """

    report: Report
    pictures: Mapping[str, Picture]
    run: Localization
    candidates: Match

    def __repr__(self) -> str:
        return f"{self.run!r}\n{self.report!r}\npictures: {', '.join(self.pictures)}"

    def _repr_html_(self) -> str:
        return as_html(self.report, self.pictures)


class _Options(NamedTuple):
    """What `compare` was asked, as its arguments."""

    truth: str | None
    tolerance: int
    leave_out: int | None
    seed: int
    interpolate: bool
    sequence: SequenceModel | None
    top: int
    progress: bool

    def text(self, what: str) -> str | None:
        """Of a progress bar."""
        return what if self.progress else None


class _Pair(NamedTuple):
    """The traverses as they are learned and localized.

    truth: None before both lengths are known. feature_shape: of the query, None before features are computed.
    """

    reference: Traverse
    query: Traverse
    truth: GroundTruth | None
    feature_shape: Any


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
    storage_curve: bool = False,
    progress: bool = False,
) -> Comparison:
    """Learn the reference, find the queries on it, and evaluate that beside what else could be stored.

    Args:
        reference: the traverse to learn. query: a second traverse of the route.
        truth: see `find_ground_truth`. Without one, and where the sources have none, there are matches and
            pictures, but neither scores nor baselines.
        model: settings; None is DejaVu with its defaults. A model with a map keeps it and is evaluated as it
            is: the map has to be of this reference. The model is on the CPU afterwards, where baselines, null
            and pictures are computed.
        tolerance: places within which a match is right, inclusive.
        leave_out: also query the reference with itself, without the frames within this many of the query in
            any mean; a diagnostic.
        seed: of the shuffle of the null control.
        interpolate: see `find_ground_truth`.
        second: see `DejaVu.describe_reference`; another traverse than the query.
        others: further models that learn the same reference, by their keys in report.json, with their names
            in tables. They need a ground truth, and none of them resamples.
        sequence: matches consecutive queries together, on the map and on all that it is compared with.
        top: candidates of each query.
        calibration: see `DejaVu.calibrate`; another traverse than the query. None calibrates a map that is
            learned by changed frames of the reference, "none" does not.
        distractors: routes that are not on the map: how many of their frames are accepted.
        storage_curve: also code a spectral map at several sizes, see `coded_at_sizes`:
            the report gets `storage` and its picture. Needs a ground truth.
        progress: show progress bars on a terminal.

    Raises:
        InputError: bad input of any of the stages, or a map of another number of places.
    """
    model = DejaVu() if model is None else model
    options = _Options(truth, tolerance, leave_out, seed, interpolate, sequence, top, progress)
    seconds: dict[str, float] = defaultdict(float)
    work = "describe" if model.map.places else "learn"
    pair = _read(model, reference, query, options, seconds, work)
    with timed(seconds, work):
        places = _learn(model, pair.reference, second, calibration, options)
    with timed(seconds, "localize"):
        queries, candidates, matching = _match(model, pair, options)
    off_map = _match_distractors(model, distractors, sequence)
    run = _judge(model, pair, places, queries, candidates, matching, options)
    contenders = _baselines(run, others or {}, options)
    scored = contenders["map"].scores is not None and isinstance(model.map, SpectralMap)
    curve = coded_at_sizes(run, seed=seed, progress=progress) if storage_curve and scored else None
    return _report(run, contenders, candidates, off_map, curve, seconds, options)


def _read(
    model: DejaVu,
    reference: Traverse | Tensor,
    query: Traverse | Tensor,
    options: _Options,
    seconds: dict[str, float],
    work: str,
) -> _Pair:
    """Both traverses, resampled where the model asks for it; what does not fit is refused here."""
    itself, has_map = reference is query, model.map.places > 0
    reference, query = as_traverse(reference), as_traverse(query)
    _check_options(model, options)
    reference = model.fit(reference, model.frame_shape if has_map else None)
    query = model.fit(query, reference.frame_shape)
    feature_shape = model.describer.check_sizes(reference, query)
    with timed(seconds, work):
        reference = model.resample(reference, model.step if has_map else None, options.progress)
    with timed(seconds, "localize"):
        query = model.resample(query, getattr(reference, "step", None), options.progress)
    check_candidates(options.top, options.tolerance, reference.length)
    if options.sequence is not None and reference.length is not None:
        options.sequence.check(None, reference.length)
    if itself or (reference.name == query.name != UNNAMED):
        log.warning(
            "%s is matched with itself, every frame with its own; evaluate on a second traverse", query.name
        )
    known = None
    if reference.length is not None and query.length is not None:
        known = ground_truth_of(options.truth, reference, query, interpolate=options.interpolate)
    return _Pair(reference, query, known, feature_shape)


def _check_options(model: DejaVu, options: _Options) -> None:
    truth, tolerance, leave_out = options[:3]
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
        check_ground_truth(truth, options.interpolate)
    check_candidates(options.top, tolerance)


def _learn(
    model: DejaVu,
    reference: Traverse,
    second: Views | None,
    calibration: Views | Literal["none"] | None,
    options: _Options,
) -> Tensor:
    """Descriptors of the reference (N,K), of which the map is learned, or with which it is checked."""
    text = options.text("describing the reference")
    has_map = model.map.places > 0
    if not has_map:
        places = model.describe_reference(reference, second, text)
        model.learn_features(places, reference)
    else:
        if reference.length is not None:
            _check_places(model, reference.length, reference.name)
        places = model.extract_all(reference, text)
        _check_places(model, len(places), reference.name)
        sample = torch.arange(0, len(places), max(1, len(places) // SAMPLED))
        away = (model.localize_descriptors(places[sample]).index - sample).abs()
        found = int((away <= max(options.tolerance, NEAR)).sum())
        if found < 0.5 * len(sample) and model.map.summary().covered:
            log.warning(
                "the map finds %d of %d frames of %s; expected the reference that it was made of",
                *(found, len(sample), reference.name),
            )
    if isinstance(calibration, Views) or (calibration is None and not has_map):
        calibrate_if_possible(model, reference, calibration)
    return places


def _check_places(model: DejaVu, places: int, name: str) -> None:
    if places != model.map.places:
        raise InputError(
            f"{name} gives {places} places, the map holds {model.map.places}; "
            "expected the reference that it was made of"
        )


def _match(model: DejaVu, pair: _Pair, options: _Options) -> tuple[Tensor, Match, Matching]:
    """Descriptors of the queries (Q,K), their candidates on the map, and how all others are matched."""
    sequence, query = options.sequence, pair.query
    rule = model.matching(sequence)
    model.check_queries(query.frame_shape, pair.feature_shape, query.name)
    queries = model.extract_all(query, options.text("describing the query"))
    if sequence is not None:
        sequence.check(len(queries), model.map.places)
    ranks = max(options.top, min(max(RANKS), model.map.places))
    matching = Matching(sequence, lengths_beside(sequence, len(queries), model.map.places))
    rule = rule._replace(lengths=matching.lengths, k=ranks, radius=options.tolerance)
    return queries, model.localize_descriptors(queries, rule), matching


def _match_distractors(
    model: DejaVu, distractors: Sequence[Traverse], sequence: SequenceModel | None
) -> dict[str, Tensor]:
    """By name, the probability of what is found for each frame of other routes, (n,)."""
    if distractors and not model.matching(sequence).platt:
        log.warning("the map is not calibrated: nothing tells what of other routes would be accepted")
        return {}
    found = {}
    for one in distractors:
        descriptors = model.extract_all(Fitted(one, model.frame_shape or ()))
        probability = model.localize_descriptors(descriptors, sequence).probability
        assert probability is not None
        found[one.name] = probability
    return found


def _judge(
    model: DejaVu,
    pair: _Pair,
    places: Tensor,
    queries: Tensor,
    candidates: Match,
    matching: Matching,
    options: _Options,
) -> Localization:
    """The run: all of it on the CPU, its ground truth in places."""
    model.cpu()
    places, queries, known = places.cpu(), queries.cpu(), pair.truth
    if pair.reference.length is None or pair.query.length is None:
        lengths = len(places), len(queries)
        known = ground_truth_of(
            options.truth, pair.reference, pair.query, *lengths, interpolate=options.interpolate
        )
    if known is not None:
        known = ground_truth_in_places(known, model.map.place_of)
    match = candidates.map(lambda column: column[:, 0])
    traverses = pair.reference, pair.query
    return Localization(model, *traverses, places, queries, match, known, options.tolerance, matching)


def _baselines(
    run: Localization, others: Mapping[str, tuple[str, DejaVu]], options: _Options
) -> dict[str, Contender]:
    """The map and what it is compared with, by their keys in report.json; the map's own is `map`."""
    model, tolerance, progress = run.model, run.tolerance, options.progress
    contenders = {"map": _contend(run, "this map", run.match, model)}
    if run.truth is None and options.leave_out is None:  # nothing that the others find could be scored
        return contenders
    features = run.reference_features, run.query_features
    baselines = baselines_of(
        model, *features, tolerance, options.seed, options.leave_out, progress, run.matching
    )
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
        contenders[key] = contend(name, answers, truth, tolerance, bytes, k, fixed)
    for key, (name, other) in others.items() if run.truth is not None else ():
        other.learn(run.reference)
        found = other.localize_descriptors(other.extract_all(run.query), run.matching)
        contenders[key] = _contend(run, name, found, other)
    return contenders


def _contend(run: Localization, name: str, found: Match, model: DejaVu) -> Contender:
    """What a model found of the run's places."""
    found, summary = found.renumbered(run.model.map.table.scored), model.summary()
    return contend(name, found, run.truth, run.tolerance, bytes=summary.map_bytes, fixed=summary.fixed_bytes)


def _is_plain_hog(model: DejaVu) -> bool:
    """Whether the uncompressed baseline is HOG with its defaults, by L1."""
    pairs = (model.preprocess, Preprocess()), (model.features, HOG())
    same = all(recipe_of(own) == recipe_of(plain) for own, plain in pairs)
    return same and model.whitening is None and getattr(model.map, "metric", "l1") == "l1"


def _report(
    run: Localization,
    contenders: dict[str, Contender],
    candidates: Match,
    off_map: Mapping[str, Tensor],
    storage: Mapping[str, Sequence[Stored]] | None,
    seconds: Mapping[str, float],
    options: _Options,
) -> Comparison:
    """Figures and pictures of all that was found."""
    route, known, tolerance = run.model.map, run.truth, run.tolerance
    pictures = draw_pictures(run, contenders, storage)
    pictures |= draw_reliability(run.scored, known, tolerance)
    carried = all(source_of(one).place is not None for one in (run.reference, run.query))
    described = describe_ground_truth(options.truth, options.interpolate, carried)
    shown = run.match._replace(index=route.frame_of(run.match.index))
    offset = offset_of(options.truth, carried)
    facts = {
        **_map_facts(run.model.summary(), run.reference_features),
        **_run_facts(run, seconds),
        **evaluation_facts(run.scored, known, tolerance, route.positions, described),
        **own_facts(shown, run.query_frames, tolerance, known is not None, offset),
        **candidate_facts(route.table.scored(candidates.index), known, tolerance),
        **rejection_facts(run.scored, known, tolerance, off_map),
        **{name: dict(picture.numbers) for name, picture in pictures.items() if picture.numbers},
    }
    scored = contenders["map"].scores is not None
    if scored and isinstance(route, SpectralMap) and len(route.chunks) == 1:
        facts["noise_over_map"] = noise_over_map(route, run.reference_features, options.seed)
    return Comparison(Report(contenders.pop("map"), contenders, facts), pictures, run, candidates)


@contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Add the seconds of a block to those under a name."""
    began = time.perf_counter()
    yield
    seconds[name] += time.perf_counter() - began


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
