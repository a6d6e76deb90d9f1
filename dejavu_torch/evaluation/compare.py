"""Learn, localize and evaluate, beside the baselines and the null controls."""

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
from dejavu_torch.evaluation.baselines import Baseline, baselines_of
from dejavu_torch.evaluation.contenders import Contender, contend, models_beside
from dejavu_torch.evaluation.evaluate import RANKS, evaluation_facts
from dejavu_torch.evaluation.localization import Localization
from dejavu_torch.evaluation.pictures import draw_pictures
from dejavu_torch.evaluation.plots import Picture
from dejavu_torch.evaluation.rejection import draw_reliability
from dejavu_torch.evaluation.report import Report, as_html
from dejavu_torch.evaluation.storage import coded_at_sizes, noise_over_map
from dejavu_torch.features.views import Views
from dejavu_torch.growth import calibrate_if_possible
from dejavu_torch.maps.distance import l1_backend
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
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
UNASKED = 2**25  # scores of queries in order that are filtered without having been asked for


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
    ordered: bool | None = None,
    progress: bool = False,
) -> Comparison:
    """Learn the reference, find the queries on it, and evaluate that beside what else could be stored.

    Args:
        reference: the traverse to learn. query: a second traverse of the route.
        truth: see `find_ground_truth`. Without one, and where the sources have none, there are matches and
            pictures, but neither scores nor baselines.
        model: settings; None is DejaVu with its defaults. A map that it has is kept and evaluated as it is:
            it has to be of this reference. The model is on the CPU afterwards.
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
        ordered: whether the queries follow one another along the route: then a filter over them is set beside
            single queries, on the map and on all else. None is what their source tells.
        progress: show progress bars on a terminal.

    Raises:
        InputError: bad input of any of the stages, or a map of another number of places.
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
    reference = model.fit(reference, model.frame_shape if has_map else None)
    query = model.fit(query, reference.frame_shape)
    feature_shape = model.describer.check_sizes(reference, query)

    seconds: dict[str, float] = defaultdict(float)
    with timed(seconds, "describe" if has_map else "learn"):
        reference = model.resample(reference, model.step if has_map else None, progress)
    with timed(seconds, "localize"):
        query = model.resample(query, getattr(reference, "step", None), progress)
    check_candidates(top, tolerance, reference.length)
    if sequence is not None and reference.length is not None:
        sequence.check(None, reference.length)
    if itself or (reference.name == query.name != UNNAMED):
        log.warning(
            "%s is matched with itself, every frame with its own; evaluate on a second traverse", query.name
        )
    find_truth = partial(ground_truth_of, truth, reference, query, interpolate=interpolate)
    counted = reference.length is not None and query.length is not None
    known = find_truth() if counted else None  # refused early

    text = "describing the reference" if progress else None
    with timed(seconds, "describe" if has_map else "learn"):
        if has_map:
            if reference.length is not None:
                check_places(model, reference.length, reference.name)
            model.check_queries(reference.frame_shape, feature_shape, reference.name)
            places = model.extract_all(reference, text)
            _check_given_map(model, places, reference.name, tolerance)
        else:
            places = model.describe_reference(reference, second, text)
            model.learn_features(places, reference)
        if isinstance(calibration, Views) or (calibration is None and not has_map):
            calibrate_if_possible(model, reference, calibration, progress=progress)

    with timed(seconds, "localize"):
        rule = model.matching(sequence)
        model.check_queries(query.frame_shape, feature_shape, query.name)
        queries = model.extract_all(query, "describing the query" if progress else None)
        if sequence is not None:
            sequence.check(len(queries), model.map.places)
        if ordered is None:
            ordered = source_of(query).ordered and len(queries) * model.map.places <= UNASKED
        ordered = ordered and (known is not None or not counted)  # else nothing shows it
        ways = models_beside(sequence, ordered, len(queries), model.map.places, tolerance)
        matching = Matching(sequence, ways)
        ranks = max(top, min(max(RANKS), model.map.places))
        rule = rule._replace(beside=ways, k=ranks, radius=tolerance)
        candidates = model.localize_descriptors(queries, rule, progress="localizing" if progress else None)
    off_map = _match_distractors(model, distractors, sequence, progress)

    model.cpu()
    known = known if counted else find_truth(len(places), len(queries))
    if known is not None:
        known = ground_truth_in_places(known, model.map.place_of)
    match = candidates.map(lambda column: column[:, 0])
    run = Localization(
        model, reference, query, places.cpu(), queries.cpu(), match, known, tolerance, matching
    )
    ours = _contend(run, "this map", match, model)
    contenders = _set_beside(run, others or {}, leave_out, seed, progress)
    route, scored = model.map, ours.scores is not None and isinstance(model.map, SpectralMap)
    storage = coded_at_sizes(run, seed=seed, progress=progress) if storage_curve and scored else None
    pictures = draw_pictures(run, {"map": ours, **contenders}, storage)
    pictures |= draw_reliability(run.scored, known, tolerance)
    carried = all(source_of(one).place is not None for one in (reference, query))
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


def _set_beside(
    run: Localization,
    others: Mapping[str, tuple[str, DejaVu]],
    leave_out: int | None,
    seed: int,
    progress: bool,
) -> dict[str, Contender]:
    """What else could be stored, and what further models find of the same reference."""
    known, contenders = run.truth is not None, {}
    if known or leave_out is not None:
        baselines = baselines_of(run, seed, leave_out, progress)
        contenders = {key: _beside(run, key, baseline) for key, baseline in baselines.items()}
    for key, (name, other) in others.items() if known else ():
        other.learn(run.reference, progress)
        queries = other.extract_all(run.query, f"describing the query for {name}" if progress else None)
        text = f"localizing with {name}" if progress else None
        found = other.localize_descriptors(queries, run.matching, progress=text)
        contenders[key] = _contend(run, name, found, other)
    return contenders


def _check_leave_out(model: DejaVu, leave_out: int | None) -> None:
    """Refuse what `leave_out_match` would, before the long work."""
    if leave_out is None:
        return
    if leave_out < 0:
        raise InputError(f"leave_out is {leave_out}; expected at least 0")
    if not isinstance(model.mapper, TemplateMapper):
        raise InputError(
            f"leave_out is {leave_out}, but it is of template maps: expected a TemplateMapper, "
            "as of --config local_maxima"
        )
    if model.map.places and model.trained is not None:
        raise InputError(
            f"leave_out is {leave_out}, but trained templates are no means of frames to leave out"
        )


def check_places(model: DejaVu, places: int, name: str) -> None:
    """Refuse a reference of another number of places than the map's."""
    if places != model.map.places:
        raise InputError(
            f"{name} gives {places} places, the map holds {model.map.places}; "
            "expected the reference that it was made of"
        )


def _check_given_map(model: DejaVu, places: Tensor, name: str, tolerance: int) -> None:
    """Whether the map is of these descriptors (N,K): refuse another number, and warn of another route."""
    check_places(model, len(places), name)
    sample = torch.arange(0, len(places), max(1, len(places) // SAMPLED))
    away = (model.localize_descriptors(places[sample]).index - sample).abs()
    found = int((away <= max(tolerance, NEAR)).sum())
    if found < 0.5 * len(sample) and model.map.summary().covered:
        log.warning(
            "the map finds %d of %d frames of %s; expected the reference that it was made of",
            *(found, len(sample), name),
        )


def _match_distractors(
    model: DejaVu, distractors: Sequence[Traverse], sequence: SequenceModel | None, progress: bool
) -> dict[str, Tensor]:
    """By name, the probability of what is found for each frame of other routes, (n,)."""
    if distractors and not model.matching(sequence).platt:
        log.warning("the map is not calibrated: nothing tells what of other routes would be accepted")
        return {}
    found = {}
    for one in distractors:
        text = f"describing {one.name}" if progress else None
        descriptors = model.extract_all(Fitted(one, model.frame_shape or ()), text)
        probability = model.localize_descriptors(descriptors, sequence).probability
        assert probability is not None
        found[one.name] = probability
    return found


def _contend(run: Localization, name: str, found: Match, model: DejaVu) -> Contender:
    """What a model found of the run's places."""
    found, summary = found.renumbered(run.model.map.table.scored), model.summary()
    return contend(name, found, run.truth, run.tolerance, bytes=summary.map_bytes, fixed=summary.fixed_bytes)


def _beside(run: Localization, key: str, baseline: Baseline) -> Contender:
    """A baseline by its key in report.json, scored as the map is."""
    name, found, bytes, k, fixed = baseline
    route, truth = run.model.map, run.truth
    if key == "leave_out":  # its queries are the places themselves
        own = route.frame_of(torch.arange(route.places))[:, None]
        truth = ground_truth_in_places(as_ground_truth(own), route.place_of)
    return contend(name, found.renumbered(route.table.scored), truth, run.tolerance, bytes, k, fixed)


@contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Add the seconds of a block to those under a name."""
    began = time.perf_counter()
    yield
    seconds[name] += time.perf_counter() - began


def _map_facts(summary: MapSummary, features: Tensor) -> dict[str, Any]:
    """What report.json holds of the map, whose places have these features (N,D)."""
    chunks: list[dict[str, Any]] = [
        {
            "start": chunk.start,
            "stop": chunk.stop,
            "periods": [plain_number(period) for period in chunk.periods],
            "features": list(chunk.features),
        }
        for chunk in summary.chunks
    ]
    return {
        "frames": len(features),
        "kind": summary.kind,
        "map_bytes": summary.map_bytes,
        "backbone_bytes": summary.fixed.get("backbone", 0),
        "fixed_bytes": summary.fixed_bytes,
        "route_bytes": summary.route_bytes,
        "bytes_per_place": summary.bytes_per_place,
        "route_bytes_per_place": summary.route_bytes / len(features),
        "full_bytes": features.nbytes,
        "templates": summary.templates,
        "template_numbers": summary.template_numbers,
        "lines": summary.lines,
        "periods": sorted({period for chunk in chunks for period in chunk["periods"]}),
        "chunks": chunks,
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
