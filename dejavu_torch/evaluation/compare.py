"""Learn, localize and evaluate, with baselines and null controls."""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.arrays import UNNAMED
from dejavu_torch.data.ground_truth import (
    Truth,
    as_ground_truth,
    check_ground_truth,
    describe_ground_truth,
    ground_truth_in_places,
    offset_of,
)
from dejavu_torch.data.source import Source, as_traverse
from dejavu_torch.data.traverse import fitted
from dejavu_torch.evaluation.answers import own_facts
from dejavu_torch.evaluation.baselines import Baseline, baselines_of
from dejavu_torch.evaluation.contenders import Contender, contend, models_beside
from dejavu_torch.evaluation.evaluate import RANKS, evaluation_facts
from dejavu_torch.evaluation.localization import Localization
from dejavu_torch.evaluation.pictures import draw_pictures
from dejavu_torch.evaluation.plots import Pictures
from dejavu_torch.evaluation.rejection import draw_reliability
from dejavu_torch.evaluation.report import Report, as_html
from dejavu_torch.evaluation.storage import coded_at_sizes, noise_over_map
from dejavu_torch.features.descriptor import is_ready
from dejavu_torch.features.views import Views
from dejavu_torch.growth import calibrate_if_possible
from dejavu_torch.maps.distance import l1_backend
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu, check_queries
from dejavu_torch.motion.resampling import ResampledTraverse, ground_truth_of, source_of
from dejavu_torch.periods.spectrogram import BACKEND
from dejavu_torch.recognition.filter import PlaceFilter
from dejavu_torch.recognition.localizer import Matching
from dejavu_torch.recognition.select import check_candidates
from dejavu_torch.recognition.sequence import SequenceMatcher
from dejavu_torch.types import InputError, Match, SequenceModel, Traverse

log = logging.getLogger("dejavu_torch")

SAMPLED = 256  # reference frames that a given map is checked with
NEAR = 10  # places within which it should find them, at least
MAX_FILTERED = 2**25  # scores up to which ordered queries are also filtered by default

OtherModels = Mapping[str, tuple[str, DejaVu]]  # their names and models, by their keys in report.json


class Comparison(NamedTuple):
    """The report, pictures and run of a comparison, of which a notebook shows the scores and two pictures.

    candidates: the best places of each query, no two within the tolerance.
    """

    report: Report
    pictures: Pictures
    run: Localization
    candidates: Match

    def __repr__(self) -> str:
        return f"{self.run!r}\n{self.report!r}\npictures: {', '.join(self.pictures)}"

    def _repr_html_(self) -> str:
        return as_html(self.report, self.pictures)


def compare(
    reference: Source,
    query: Source,
    truth: Truth | None = None,
    model: DejaVu | None = None,
    *,
    tolerance: int = 5,
    leave_out: int | None = None,
    seed: int = 0,
    interpolate: bool = False,
    second: Views | None = None,
    others: OtherModels | None = None,
    sequence: SequenceModel | None = None,
    top: int = 1,
    calibration: Views | Literal["none"] | None = None,
    distractors: Sequence[Traverse] = (),
    storage_curve: bool = False,
    ordered: bool | None = None,
    progress: bool = False,
) -> Comparison:
    """Learn the reference, localize the queries on it, and compare with other ways to store the route.

    Args:
        reference: the traverse to learn. query: a second traverse of the route.
        truth: see `find_ground_truth`. Without any, there are matches and pictures, but no scores and no
            baselines.
        model: settings; None is DejaVu with its defaults. A map that it already has is evaluated as it is; it
            must be of this reference. The model is on the CPU afterwards.
        tolerance: places within which a match is right, inclusive.
        leave_out: also query the reference with itself, see `leave_out_match`; a diagnostic.
        seed: for shuffling the null control.
        interpolate: see `find_ground_truth`.
        second: see `DejaVu.learn`; another traverse than the query.
        others: further models that learn the same reference, by their keys in report.json, with their names
            in tables. They need a ground truth, and none of them resamples.
        sequence: matches consecutive queries together, on the map and on all baselines.
        top: candidates of each query.
        calibration: see `DejaVu.calibrate`; another traverse than the query. None calibrates a newly learned
            map with changed frames of the reference, "none" does not.
        distractors: routes that are not on the map, to see how many of their frames are accepted.
        storage_curve: also code a spectral map at several sizes, see `coded_at_sizes`:
            the report gets `storage` and its picture. Needs a ground truth.
        ordered: whether the queries are consecutive. If so, the report also has the scores of a filter.
            None: as their source says.
        progress: show progress bars on a terminal.

    Raises:
        InputError: bad input to any of the stages, or a map of another number of places.
    """
    model = DejaVu() if model is None else model
    has_map, itself = model.map.places > 0, reference is query
    reference, query = as_traverse(reference), as_traverse(query)
    _check_leave_out(model, leave_out)
    if tolerance < 0:
        raise InputError(f"tolerance is {tolerance}; expected at least 0")
    if truth is not None:
        check_ground_truth(truth, interpolate)
    check_candidates(top, tolerance)
    reference = model.at_map_size(reference, model.frame_shape if has_map else None)
    query = model.at_map_size(query, reference.frame_shape)
    for one in distractors:
        if is_ready(reference) and not is_ready(one):
            raise InputError(f"{one.name} has frames; expected ready features, as of {reference.name}")
    off = [one if is_ready(one) else fitted(one, reference.frame_shape) for one in distractors]
    feature_shape = model.descriptor.check_sizes(reference, query, *off)

    seconds: dict[str, float] = defaultdict(float)
    with timed(seconds, "describe" if has_map else "learn"):
        reference = model.resample(reference, model.step if has_map else None, progress)
    with timed(seconds, "localize"):
        step = getattr(reference, "step", None)
        query = model.resample(query, step, progress)
    off = [model.resample(one, step, progress, reference.frame_shape) for one in off]
    check_candidates(top, tolerance, len(reference))
    if sequence is not None:
        sequence.check(None, len(reference))
    if itself or (reference.name == query.name != UNNAMED):
        log.warning(
            "%s is matched with itself, each frame with its own copy; expected a second traverse", query.name
        )
    # early, so that a bad truth is refused before the long work
    known = ground_truth_of(truth, reference, query, interpolate=interpolate)

    with timed(seconds, "describe" if has_map else "learn"):
        if has_map:
            check_places(model, len(reference), reference.name)
            check_queries(model, reference.frame_shape, feature_shape, reference.name)
            places = model.descriptor.all_of(reference, progress)
            _check_given_map(model, places, reference.name, tolerance)
        else:
            spectral = isinstance(model.mapper, SpectralMapper)
            places = model.descriptor.learn(reference, second, progress, spectral)
            model.learn_features(places, reference)
        if isinstance(calibration, Views) or (calibration is None and not has_map):
            calibrate_if_possible(model, reference, calibration, progress=progress)

    with timed(seconds, "localize"):
        rule = model.matching(sequence)
        check_queries(model, query.frame_shape, feature_shape, query.name)
        queries = model.descriptor.all_of(query, progress)
        if sequence is not None:
            sequence.check(len(queries), model.map.places)
        if ordered is None:
            ordered = source_of(query).ordered and len(queries) * model.map.places <= MAX_FILTERED
        ordered = ordered and known is not None  # without truth it has no scores
        models = models_beside(sequence, ordered, len(queries), model.map.places, tolerance)
        matching = Matching(sequence, models)
        ranks = max(top, min(max(RANKS), model.map.places))
        rule = rule._replace(beside=models, k=ranks, radius=tolerance)
        candidates = model.localize_descriptors(queries, rule, progress=progress)
    off_map = _match_distractors(model, off, sequence, progress)

    model.cpu()
    if known is not None:
        known = ground_truth_in_places(known, model.map.place_of)
    match = candidates.map(lambda column: column[:, 0])
    run = Localization(
        model, reference, query, places.cpu(), queries.cpu(), match, known, tolerance, matching
    )
    ours = _contend(run, "this map", match, model)
    contenders = _other_contenders(run, others or {}, leave_out, seed, progress)
    route, scored = model.map, ours.scores is not None and isinstance(model.map, SpectralMap)
    storage = coded_at_sizes(run, seed=seed, progress=progress) if storage_curve and scored else None
    pictures = draw_pictures(run, {"map": ours, **contenders}, storage)
    pictures |= draw_reliability(run.scored, known, tolerance)
    carried = all(source_of(one).places is not None for one in (reference, query))
    described = describe_ground_truth(truth, interpolate, carried)
    shown, ranked = match._replace(index=route.frame_of(match.index)), route.table.scored(candidates.index)
    facts = {
        **_map_facts(model.summary(), run.reference_features),
        **_run_facts(run, seconds),
        **evaluation_facts(run.scored, ranked, known, tolerance, route.positions, described, off_map),
        **own_facts(shown, run.query_frames, tolerance, known is not None, offset_of(truth, carried)),
        **{name: dict(picture.numbers) for name, picture in pictures.items() if picture.numbers},
    }
    if scored and isinstance(route, SpectralMap) and len(route.chunks) == 1:
        facts["noise_over_map"] = noise_over_map(route, run.reference_features, seed)
    return Comparison(Report(ours, contenders, facts), pictures, run, candidates)


def _other_contenders(
    run: Localization, others: OtherModels, leave_out: int | None, seed: int, progress: bool
) -> dict[str, Contender]:
    """The baselines, null controls and further models, scored."""
    known, contenders = run.truth is not None, {}
    if known or leave_out is not None:
        baselines = baselines_of(run, seed, leave_out, progress)
        contenders = {key: _score_baseline(run, key, baseline) for key, baseline in baselines.items()}
    for key, (name, other) in others.items() if known else ():
        other.learn(run.reference, progress)
        queries = other.descriptor.all_of(run.query, progress)
        found = other.localize_descriptors(queries, run.matching, progress=progress)
        contenders[key] = _contend(run, name, found, other)
    return contenders


def _check_leave_out(model: DejaVu, leave_out: int | None) -> None:
    """Refuse early what `leave_out_match` refuses later."""
    if leave_out is None:
        return
    if leave_out < 0:
        raise InputError(f"leave_out is {leave_out}; expected at least 0")
    if not isinstance(model.mapper, TemplateMapper):
        seen = f"leave_out is {leave_out}, which needs a template map"
        raise InputError(f"{seen}; expected a TemplateMapper, as with --config local_maxima")
    if model.map.places and model.trained is not None:
        raise InputError(f"leave_out is {leave_out} and the templates are trained; expected means of frames")


def check_places(model: DejaVu, places: int, name: str) -> None:
    """Refuse a reference whose number of places differs from the map's."""
    if places != model.map.places:
        seen = f"{name} has {places} places, the map has {model.map.places}"
        raise InputError(f"{seen}; expected the reference that the map was made of")


def _check_given_map(model: DejaVu, places: Tensor, name: str, tolerance: int) -> None:
    """Check that the map was made of these descriptors (N,K): refuse another number, warn of a bad fit."""
    check_places(model, len(places), name)
    sample = torch.arange(0, len(places), max(1, len(places) // SAMPLED))
    distance = (model.localize_descriptors(places[sample]).index - sample).abs()
    found = int((distance <= max(tolerance, NEAR)).sum())
    if found < 0.5 * len(sample) and model.map.summary().covered:
        expected = "expected the reference that the map was made of"
        log.warning("the map finds %d of %d frames of %s; %s", found, len(sample), name, expected)


def _match_distractors(
    model: DejaVu, distractors: Sequence[Traverse], sequence: SequenceModel | None, progress: bool
) -> dict[str, Tensor]:
    """The probability of the match of each frame of other routes, (n,) by name."""
    if distractors and not model.matching(sequence).platt:
        log.warning("the map is not calibrated, so no frame of other routes has a probability")
        return {}
    found = {}
    for one in distractors:
        probability = model.localize_descriptors(model.descriptor.all_of(one, progress), sequence).probability
        assert probability is not None
        found[one.name] = probability
    return found


def _contend(run: Localization, name: str, found: Match, model: DejaVu) -> Contender:
    """The matches of a model as a contender."""
    found, summary = found.renumbered(run.model.map.table.scored), model.summary()
    return contend(name, found, run.truth, run.tolerance, bytes=summary.map_bytes, fixed=summary.fixed_bytes)


def _score_baseline(run: Localization, key: str, baseline: Baseline) -> Contender:
    """A baseline as a contender, scored in the same way as the map."""
    name, found, bytes, k, fixed = baseline
    route, truth = run.model.map, run.truth
    if key == "leave_out":  # its queries are the places themselves
        own = route.frame_of(torch.arange(route.places))[:, None]
        truth = ground_truth_in_places(as_ground_truth(own), route.place_of)
    return contend(name, found.renumbered(route.table.scored), truth, run.tolerance, bytes, k, fixed)


@contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Add the seconds that a block takes to `seconds[name]`."""
    began = time.perf_counter()
    yield
    seconds[name] += time.perf_counter() - began


def _map_facts(summary: MapSummary, features: Tensor) -> dict[str, Any]:
    """The entries of report.json about the map, whose places have these features (N,D)."""
    chunks: list[dict[str, Any]] = [
        chunk._asdict() | {"periods": [plain_number(period) for period in chunk.periods]}
        for chunk in summary.chunks
    ]
    names = ("kind", "map_bytes", "fixed_bytes", "route_bytes", "bytes_per_place", "lines")
    return {
        **{name: getattr(summary, name) for name in (*names, "templates", "template_numbers")},
        "frames": len(features),
        "backbone_bytes": summary.fixed.get("backbone", 0),
        "route_bytes_per_place": summary.route_bytes / len(features),
        "full_bytes": features.nbytes,
        "periods": sorted({period for chunk in chunks for period in chunk["periods"]}),
        "chunks": chunks,
    }


def _run_facts(run: Localization, seconds: Mapping[str, float]) -> dict[str, Any]:
    """The entries of report.json about the run; no seconds to learn if the map is given."""
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
    """An exact period as a JSON number."""
    value = float(period)  # type: ignore[arg-type]
    return int(value) if value.is_integer() else value
