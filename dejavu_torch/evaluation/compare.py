"""Learn, localize and evaluate, with baselines and null controls."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.arrays import UNNAMED
from dejavu_torch.data.coordinates import Near
from dejavu_torch.data.ground_truth import (
    Truth,
    check_ground_truth,
    check_unit,
    ground_truth_in_places,
    of_loops,
    widened,
)
from dejavu_torch.data.source import Source, as_traverse
from dejavu_torch.data.traverse import fitted, kept
from dejavu_torch.data.turning import Turned, facing_north
from dejavu_torch.evaluation.baselines import Baseline, baselines_of, matched
from dejavu_torch.evaluation.contenders import COLOURS, Contender, contend, models_beside
from dejavu_torch.evaluation.evaluate import RANKS
from dejavu_torch.evaluation.facts import facts_of, match_facts, metric_facts, peak_memory
from dejavu_torch.evaluation.localization import NOTHING, Localization
from dejavu_torch.evaluation.pictures import draw_compared, draw_pictures
from dejavu_torch.evaluation.plots import Pictures
from dejavu_torch.evaluation.rejection import draw_reliability, reach_of
from dejavu_torch.evaluation.report import Report, as_html
from dejavu_torch.evaluation.storage import coded_at_sizes, noise_over_map
from dejavu_torch.features.descriptor import is_ready
from dejavu_torch.features.views import LabelledFrames
from dejavu_torch.growth import calibrate_if_possible
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu, check_apart, check_loops_along, check_queries, features_per_frame
from dejavu_torch.motion.resampling import ground_truth_of, resampled, source_of
from dejavu_torch.places.layout import Layout, Reach
from dejavu_torch.recognition.calibration import TOLERANCE
from dejavu_torch.recognition.centring import centred, set_apart
from dejavu_torch.recognition.localizer import Matching
from dejavu_torch.recognition.scorer import Scorer
from dejavu_torch.recognition.select import check_candidates
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.types import InputError, Match, SequenceModel, Together, Traverse, expect

log = logging.getLogger("dejavu_torch")

SAMPLED = 256  # reference frames that a given map is checked with
NEAR = 10  # places within which the map should find them, at least
# by the dimensions of a layout: scores up to which ordered queries are also filtered and smoothed by default,
# and whether sequences, which follow the numbers of places, are compared
MOST, FOLLOWS = {1: 2**25, 2: 2**23}, {1: True, 2: False}
DRIVEN = ("uncompressed", "null")  # contenders that are also matched as a whole drive

Seconds = dict[str, float]  # that each stage took
OtherModels = Mapping[str, tuple[str, DejaVu]]  # their names and models, by their keys in report.json
Contenders = Mapping[str, tuple[str, int, Scorer]]  # their names, bytes and scores, likewise


class Comparison(NamedTuple):
    """The report, pictures and run of a comparison, of which a notebook shows the scores and two pictures.

    candidates: the best places of each query for its answer, no two within the tolerance.
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
    query: Source | None,
    truth: Truth | None = None,
    model: DejaVu | None = None,
    *,
    tolerance: int = 5,
    leave_out: int | None = None,
    seed: int = 0,
    interpolate: bool = False,
    second: LabelledFrames | None = None,
    others: OtherModels | None = None,
    contenders: Contenders | None = None,
    sequence: SequenceModel | Literal["auto"] | None = "auto",
    centre: bool | None = None,
    top: int = 1,
    calibration: LabelledFrames | Traverse | Literal["none"] | None = None,
    distractors: Sequence[Traverse] = (),
    storage_curve: bool = False,
    ordered: bool | None = None,
    loops: int | None = None,
    headings: int = 1,
    drives: Literal["few", "all"] = "few",
    on_found: Callable[[Comparison], object] | None = None,
    progress: bool = False,
) -> Comparison:
    """Learn the reference, localize the queries on it, and compare with other ways to store the route.

    Args:
        reference: the traverse to learn. query: a second traverse of the route; None with `loops`.
        truth: see `find_ground_truth`. Without any, there are matches and pictures, but no scores and no
            baselines.
        model: settings; None is DejaVu with its defaults. A map that it already has is evaluated as it is; it
            must be of this reference. The model is on the CPU afterwards.
        tolerance: places within which a match is right, inclusive; in an area, the distance of the middles of
            windows, in the unit of its coordinates.
        leave_out: also query the reference with itself, see `leave_out_match`; a diagnostic.
        seed: for shuffling the null control.
        interpolate: see `find_ground_truth`.
        second: see `DejaVu.learn`; another traverse than the query.
        others: further models that learn the same reference, by their keys in report.json, with their names
            in tables. They need a ground truth, and none of them resamples.
        contenders: further ways to store the route, by their keys in report.json: a name for tables, bytes,
            and a `Scorer` of the same queries, or with `headings` of all their turned copies. They need a
            ground truth.
        sequence: how the answers are found, see `DejaVu.localize`; within how many places, says `reach_of`.
            With a filter or a `SequenceMatcher` the scores at top level are those of its answers, else of
            single queries.
        centre: whether the single queries and those of a smoother are centred, see `centred`; None does it
            for at least 50 queries that are in order.
        top: candidates of each query.
        calibration: see `DejaVu.calibrate`; another traverse than the query. None calibrates a newly learned
            map with changed frames of the reference, "none" does not. For another reach than 5 this is done
            again, for the report only.
        distractors: routes that are not on the map, to see how many of their frames are accepted.
        storage_curve: also code a spectral map at several sizes, see `coded_at_sizes`:
            the report gets `storage` and its picture. Needs a ground truth.
        ordered: whether the queries are consecutive. If so, the report also has the scores of a filter and
            of a smoother, see `drives`. None: as their source says.
        loops: also the query is the reference: find where it comes back to places of this many places before,
            see `DejaVu.loops`. The baselines are asked for the same.
        headings: on the map of an area, see `DejaVu.localize`; of all contenders.
        drives: contenders that are also matched as a whole drive: the map, its float and the control, or all.
        on_found: called with the map's own answers, before they are compared with anything.
        progress: show progress bars on a terminal.

    Raises:
        InputError: bad input to any of the stages, or a map of another number of places.
    """
    model, itself = DejaVu() if model is None else model, loops is not None
    has_map, seconds = model.map.places > 0, dict.fromkeys(("describe", "learn", "localize"), 0.0)
    _check_settings(model, truth, interpolate, tolerance, top, leave_out)
    if loops is not None:
        expect(headings == 1, "one of them", f"loops {loops} and headings {headings}")
        alone = query is None and leave_out is None and not (distractors or storage_curve or top != 1)
        _check_loops(loops, alone, sequence)
        reference, centre = as_traverse(reference), False  # the mean is that of the map
        check_loops_along(reference.layout)
    elif query is None:
        raise InputError("there is no query; expected a second visit, or loops within the reference")
    query = reference if query is None else query
    _check_storage(model, storage_curve, headings)
    reference, query, off = _prepared(model, reference, query, distractors, seconds, progress, loops)
    check_candidates(top, tolerance, len(reference))
    layout = reference.layout
    north = facing_north(query, layout, headings)  # pictures show images, not their copies
    query = north if headings == 1 else query
    truth, near, (tolerance, within, radius) = _reach(truth, query, layout, tolerance)
    in_order = source_of(query).ordered if ordered is None else ordered
    smoother, causal = _ways(sequence, in_order and len(query) > 1)
    if causal is not None:
        causal.check(None, len(reference))
    # without a given truth, each place would be its own answer
    known = None if itself and truth is None else ground_truth_of(truth, reference, query, interpolate)
    expect(known is not None or not storage_curve, "a truth", "there is none to judge a storage curve by")
    _check_contenders(contenders or {}, known is not None, len(query) * headings, len(reference))
    if known is not None and near is None and within > tolerance:
        known = widened(known, layout, within)

    rivals = () if known is None else (reference, query)  # of HOG, for its baseline
    with model.descriptor.setting_aside(*rivals):
        with timed(seconds, "describe" if has_map else "learn"):
            places = _learned(model, reference, second, tolerance, progress)
            if calibration != "none" and not (calibration is None and has_map):
                calibrate_if_possible(model, reference, calibration, progress=progress)
        if known is not None:
            known = ground_truth_in_places(known, model.map.place_of)
            known = of_loops(known, torch.arange(len(query)), loops) if loops is not None else known
        reach = reach_of(within, known, near is not None or radius > 0)
        smoother = smoother and smoother.having(within=reach)
        causal = causal and causal.having(within=reach)
        with _calibrated(model, reach, reference, calibration, progress):
            with timed(seconds, "localize"):
                # without truth they have no scores
                beside = in_order and known is not None and not itself and headings == 1
                sizes = (len(query), model.map.places, reach)
                also, alike = _beside(causal, beside, ordered is not None, *sizes, layout)
                centring = in_order and model.centres(len(query)) if centre is None else centre
                matching = Matching(causal, also, apart=loops, copies=headings)
                run = _described(model, reference, query, places, centring, tolerance, matching, progress)
                run = run._replace(radius=radius)
                run, found = _localized(run, smoother is not None, top, progress)
                run, candidates = _smoothed(run, found, smoother, alike, progress)
            off_map = _match_distractors(model, off, smoother or causal, centring, headings, progress)

        model.cpu()
        run = run._replace(
            truth=known, reference_features=places.cpu(), query_features=run.query_features.cpu()
        )
        ours = run.contend("this map", run.judged.renumbered(model.map.table.scored), model)
        facts = {
            **facts_of(run, seconds),
            **match_facts(run, found, truth, interpolate, off_map),
            "centred": centring,
            **({"headings": headings} if headings > 1 else {}),
            **metric_facts(run, truth),
            **({"second": second.placed_facts()} if second is not None and second.placed else {}),
        }
        pictures = draw_pictures(run, {"map": ours}) | draw_reliability(run.scored, known, tolerance)
        if on_found is not None:
            on_found(Comparison(Report(ours, {}, facts), pictures, run, candidates))
        given = {key: Baseline(name, one, size) for key, (name, size, one) in (contenders or {}).items()}
        compared = _other_contenders(run, given, others or {}, leave_out, drives == "all", seed, progress)
    coded = model.map if ours.scores is not None and isinstance(model.map, SpectralMap) else None
    storage = coded_at_sizes(run, seed=seed, progress=progress) if storage_curve and coded else None
    pictures = pictures | draw_compared(run, {"map": ours, **compared}, storage)
    facts = facts | peak_memory()
    facts |= {name: dict(picture.numbers) for name, picture in pictures.items() if picture.numbers}
    if coded is not None and len(coded.chunks) == 1:
        facts["noise_over_map"] = noise_over_map(coded, run.reference_features, seed)
    return Comparison(Report(ours, compared, facts), pictures, run, candidates)


def _reach(
    truth: Truth | None, query: Traverse, layout: Layout, tolerance: int
) -> tuple[Truth | None, Near | None, Reach]:
    """The truth, over an area by coordinates if none is given; the same if it is by distance; and within
    which answers are right."""
    if truth is None and query.coordinates is not None:
        truth = layout.truth(tolerance)
    parsed = None if truth is None else check_ground_truth(truth)
    near = parsed if isinstance(parsed, Near) else None
    if near is not None:
        check_unit(near, layout)
    return truth, near, layout.reach(tolerance, None if near is None else near.radius)


def _check_settings(
    model: DejaVu, truth: Truth | None, interpolate: bool, tolerance: int, top: int, leave_out: int | None
) -> None:
    """Refuse settings that exclude each other, before anything is read."""
    if leave_out is not None:
        seen = f"leave_out is {leave_out}"
        if leave_out < 0:
            raise InputError(f"{seen}; expected at least 0")
        if not isinstance(model.mapper, TemplateMapper):
            expected = "expected a TemplateMapper, as with --config local_maxima"
            raise InputError(f"{seen}, which needs a template map; {expected}")
        if model.map.places and model.trained is not None:
            raise InputError(f"{seen} and the templates are trained; expected means of frames")
    if tolerance < 0:
        raise InputError(f"tolerance is {tolerance}; expected at least 0")
    if truth is not None:
        check_ground_truth(truth, interpolate)
    check_candidates(top, tolerance)


def _check_contenders(contenders: Contenders, judged: bool, queries: int, places: int) -> None:
    """Refuse scores of others than these queries and places, and what would stand for an own entry."""
    expect(judged or not contenders, "a truth", "there is none to judge contenders by")
    for key, (_, _, scorer) in contenders.items():
        expect(key not in COLOURS, "a key that is not taken", f"the contender {key!r}")
        seen = f"the contender {key!r} scores {len(scorer)} queries at {scorer.layout.places} places"
        right = (len(scorer), scorer.layout.places) == (queries, places)
        expect(right, f"{queries} queries at {places} places", seen)


def _check_storage(model: DejaVu, storage_curve: bool, headings: int) -> None:
    """Refuse a storage curve of what is not coded at several sizes."""
    if storage_curve:
        expect(headings == 1, "one of them", f"a storage curve and headings {headings}")
        coded = isinstance(model.map if model.map.places else model.mapper, SpectralMap | SpectralMapper)
        expect(coded, "a SpectralMapper", "a storage curve of templates")


def _check_loops(loops: int, alone: bool, sequence: object) -> None:
    """Refuse what a drive by itself has no use for."""
    if not alone:
        expected = "without query, distractors, storage_curve, leave_out and top"
        raise InputError(f"loops: {loops}; expected the reference alone, {expected}")
    if sequence is not None and not isinstance(sequence, str | PlaceSmoother):
        raise InputError(f"loops: {loops} and {sequence}; expected a smoother, or None")


def _ways(
    sequence: SequenceModel | Literal["auto"] | None, drive: bool
) -> tuple[PlaceSmoother | None, SequenceModel | None]:
    """The smoother, or else the other sequence model that answers; "auto" is a smoother for a drive."""
    if isinstance(sequence, str):
        sequence = PlaceSmoother() if drive else None
    return (sequence, None) if isinstance(sequence, PlaceSmoother) else (None, sequence)


@contextmanager
def _calibrated(
    model: DejaVu,
    reach: int,
    reference: Traverse,
    views: LabelledFrames | Traverse | Literal["none"] | None,
    progress: bool,
) -> Iterator[None]:
    """Within the block a calibrated model is calibrated for a reach, if there is what to do it by."""
    held = model.calibration
    try:
        if held is not None and reach != TOLERANCE:
            model.calibration = None
            if not isinstance(views, str | Traverse):  # a visit says how sure it is within 5
                calibrate_if_possible(model, reference, views, progress=progress, reach=reach)
            if model.calibration is None:
                model.calibration = held
                line = "the map gives probabilities of being within %d places; here one is right within %d"
                log.warning(line, TOLERANCE, reach)
        yield
    finally:
        model.calibration = held


def _beside(
    causal: SequenceModel | None,
    wanted: bool,
    asked: bool,
    queries: int,
    places: int,
    within: int,
    layout: Layout,
) -> tuple[dict[Together, SequenceModel], PlaceSmoother | None]:
    """The sequence models and the smoother that are compared, if they are `wanted`: on few scores, or, if the
    user has `asked` for them, on any number."""
    most = math.inf if asked else MOST[layout.dimensions]
    beside = wanted and queries * places <= most
    also = models_beside(causal, beside, queries, places, within)
    also = {way: one for way, one in also.items() if way == "filter" or FOLLOWS[layout.dimensions]}
    return also, PlaceSmoother(within=within) if beside and queries > 1 else None


def _prepared(
    model: DejaVu,
    reference: Source,
    query: Source,
    off: Sequence[Traverse],
    seconds: Seconds,
    progress: bool,
    loops: int | None = None,
) -> tuple[Traverse, Traverse, list[Traverse]]:
    """The reference, the query and routes off the map, at the map's size and at even steps."""
    itself, has_map = reference is query, model.map.places > 0
    reference, query = as_traverse(reference), as_traverse(query)
    if loops is None and (itself or (reference.name == query.name != UNNAMED)):
        line = "%s is matched with itself, each frame with its own copy; expected a second visit"
        log.warning(line, query.name)
    reference = model.at_map_size(reference, model.frame_shape if has_map else None)
    query = model.at_map_size(query, reference.frame_shape)
    for other in off:
        if is_ready(reference) and not is_ready(other):
            raise InputError(f"{other.name} has frames; expected ready features, as of {reference.name}")
    off = [other if is_ready(other) else fitted(other, reference.frame_shape) for other in off]
    features = model.descriptor.check_sizes(reference, query, *off)
    reference, query = (one if source_of(one) is not one else kept(one) for one in (reference, query))
    even = partial(resampled, odometry=model.velocity, batch_size=model.batch_size, progress=progress)
    with timed(seconds, "describe" if has_map else "learn"):
        reference = even(reference, step=model.step if has_map else None)
    step = getattr(reference, "step", None)
    with timed(seconds, "localize"):
        query = reference if loops is not None else even(query, step=step)
    if loops is not None:
        check_apart(loops, len(reference))
    if has_map:
        check_places(model, len(reference), reference.name)
        expected = "that of the map; answers of a grown map are scored by `dejavu evaluate --map`"
        own = model.map.layout.same(reference.layout)
        expect(own, expected, f"{reference.name} is another area")
        check_queries(model, reference.frame_shape, features, reference.name)
    return reference, query, [even(other, step=step) for other in off]


def _learned(
    model: DejaVu, reference: Traverse, second: LabelledFrames | None, tolerance: int, progress: bool
) -> Tensor:
    """The descriptors (N,K) of the reference, which the model learns unless it has its map."""
    if model.map.places:
        places = model.descriptor.all_of(reference, progress)
        _check_given_map(model, places, reference.name, tolerance)
        return places
    places = model.descriptor.learn(reference, second, progress, isinstance(model.mapper, SpectralMapper))
    model.learn_features(places, reference, second)
    return places


def _described(
    model: DejaVu,
    reference: Traverse,
    query: Traverse,
    places: Tensor,
    centring: bool,
    tolerance: int,
    matching: Matching,
    progress: bool,
) -> Localization:
    """The run with the descriptors of its queries, and no answers yet."""
    check_queries(model, query.frame_shape, features_per_frame(model), query.name)
    run = Localization(model, reference, query, places, places, NOTHING, None, tolerance, matching)
    if query is not reference:
        run = run._replace(query_features=run.described_by(model, progress))
    queries = run.query_features
    if centring and not isinstance(run.asked, Turned):
        run = run._replace(query_features=centred(model.map, queries), causal_features=queries)
    return run


def _localized(run: Localization, drive: bool, top: int, progress: bool) -> tuple[Localization, Match]:
    """The run, and the best places of each query as far as recall@N or `top` needs."""
    model = run.model
    if run.sequence is not None:
        run.sequence.check(len(run.query), model.map.places)
    ranks = max(top, min(max(RANKS), model.map.places))

    def match(queries: Tensor, how: Matching) -> Match:
        # whose acceptance is not asked for beside a drive
        platt = model.calibration and model.calibration.of(how.sequence)
        own = Matching(how.sequence, platt=platt) if drive else model.matching(how.sequence)
        own = own._replace(also=how.also, k=ranks, radius=run.tolerance, apart=how.apart, copies=how.copies)
        return model.localize_descriptors(queries, own, progress=progress)

    found = _by_both(run, match)
    best = found.map(lambda column: column[:, 0])
    return run._replace(match=best, judged=best), found


def _by_both(run: Localization, match: Callable[[Tensor, Matching], Match]) -> Match:
    """The matches of the queries, with those of sequences and filters of the uncentred ones."""
    causal, matching = run.causal_features, run.matching
    if causal is None or not (matching.also or matching.sequence):
        return match(run.query_features, matching)
    found = match(causal, matching)
    if matching.sequence is not None:
        return found
    return replace(match(run.query_features, matching._replace(also={})), sequences=found.sequences)


def _smoothed(
    run: Localization,
    found: Match,
    smoother: PlaceSmoother | None,
    beside: PlaceSmoother | None,
    progress: bool,
) -> tuple[Localization, Match]:
    """The run with the answers of a whole drive, and the best places of each query for its answer.

    Args:
        found: the places by single queries. smoother: if it answers. beside: if it is only compared.
    """
    whole, model, apart = smoother or beside, run.model, run.matching.apart
    if whole is None:
        return run, found
    own = model.matching(whole) if apart is None else model.loop_matching(apart, whole)
    own = own._replace(k=found.index.shape[1], radius=run.tolerance)
    own = own._replace(copies=run.matching.copies)
    drive = model.localize_descriptors(run.query_features, own, progress=progress)
    best = drive.map(lambda column: column[:, 0])
    assert drive.smoother is not None
    if apart is None:
        judged = replace(run.judged, sequences={**run.judged.sequences, "smoother": best})
        beside = beside and beside.having(removed=drive.smoother.removed)
        run = run._replace(judged=judged, beside=beside)
    if smoother is None:
        return run, found
    return run._replace(match=best), drive


def _other_contenders(
    run: Localization,
    given: Mapping[str, Baseline],
    others: OtherModels,
    leave_out: int | None,
    drives: bool,
    seed: int,
    progress: bool,
) -> dict[str, Contender]:
    """The baselines, null controls, given ones and further models, scored; `drives`: all of them as whole
    drives too."""
    table, judged = run.model.map.table, run.truth is not None
    itself = table.scored(torch.arange(table.places))[:, None]  # of the places as queries

    def further() -> Iterator[tuple[str, Baseline]]:
        if judged or leave_out is not None:
            yield from baselines_of(run, seed, leave_out, progress)
        yield from given.items()
        for key, (name, other) in others.items() if judged else ():
            other.learn(run.reference, progress)
            queries, size = run.described_by(other, progress), other.summary()
            match = other.localize_descriptors(queries, run.matching, progress=progress)
            if run.beside is not None and drives:
                drive = other.localize_descriptors(queries, other.matching(run.beside), progress=progress)
                match = replace(match, sequences={**match.sequences, "smoother": drive})
            yield key, Baseline(name, None, size.map_bytes, None, size.fixed_bytes, match)

    contenders = {}
    found = matched(further(), run.matching, run.beside, None if drives else DRIVEN, progress)
    for key, (one, match) in found.items():
        truth = itself if key == "leave_out" else run.truth
        known = match.renumbered(table.scored), truth, run.tolerance
        contenders[key] = contend(one.name, *known, one.bytes, one.k, one.fixed)
    return contenders


def check_places(model: DejaVu, places: int, name: str) -> None:
    """Refuse a reference whose number of places differs from the map's."""
    if places != model.map.places:
        seen = f"{name} has {places} places, the map has {model.map.places}"
        raise InputError(f"{seen}; expected the reference that the map was made of")


def _check_given_map(model: DejaVu, places: Tensor, name: str, tolerance: int) -> None:
    """Warn if the map finds few of the descriptors (N,K) that it was made of."""
    sample = torch.arange(0, len(places), max(1, len(places) // SAMPLED))
    found = model.localize_descriptors(places[sample]).index.clamp(min=0)
    distance = model.map.layout.distance(found, sample)
    near = int((distance <= max(tolerance, NEAR)).sum())
    if near < 0.5 * len(sample) and model.map.summary().covered:
        expected = "expected the reference that the map was made of"
        log.warning("the map finds %d of %d frames of %s; %s", near, len(sample), name, expected)


def _match_distractors(
    model: DejaVu,
    distractors: Sequence[Traverse],
    sequence: SequenceModel | None,
    centring: bool,
    headings: int,
    progress: bool,
) -> dict[str, Tensor]:
    """The probability of the match of each frame of other routes, (n,) by name."""
    whole = sequence if isinstance(sequence, PlaceSmoother) else None
    if distractors and not (whole or model.matching(sequence).platt):
        log.warning("the map is not calibrated, so no frame of other routes has a probability")
        return {}
    probabilities = {}
    for other in distractors:
        asked = facing_north(other, model.map.layout, headings)
        queries = model.descriptor.all_of(asked, progress)
        matching = model.matching(sequence)._replace(copies=headings)
        if isinstance(asked, Turned):
            queries = set_apart(model.map, queries)
        elif centring and (sequence is None or whole):
            queries = centred(model.map, queries)
        match = model.localize_descriptors(queries, matching)
        assert match.probability is not None
        probabilities[other.name] = match.probability
    return probabilities


@contextmanager
def timed(seconds: Seconds, name: str) -> Iterator[None]:
    """Add the seconds that a block takes to `seconds[name]`."""
    began = time.perf_counter()
    yield
    seconds[name] += time.perf_counter() - began
