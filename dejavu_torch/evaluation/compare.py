"""Learn, localize and evaluate, with baselines and null controls."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.coordinates import Near
from dejavu_torch.data.ground_truth import (
    GroundTruth,
    Nowhere,
    Truth,
    check_ground_truth,
    check_unit,
    ground_truth_in_places,
    of_loops,
    widened,
)
from dejavu_torch.data.source import Source, as_traverse
from dejavu_torch.data.traverse import fitted, kept
from dejavu_torch.data.turning import facing_north, is_turned
from dejavu_torch.evaluation.baselines import Baseline, baselines_of, matched
from dejavu_torch.evaluation.contenders import COLOURS, Contender, contend, models_beside
from dejavu_torch.evaluation.doubts import doubt_facts, doubts_of
from dejavu_torch.evaluation.evaluate import RANKS
from dejavu_torch.evaluation.facts import facts_of, match_facts, metric_facts, peak_memory, view_facts
from dejavu_torch.evaluation.localization import NOTHING, Localization
from dejavu_torch.evaluation.options import (
    LEARNING,
    NO_CALIBRATION,
    REPORTING,
    Learning,
    Reporting,
)
from dejavu_torch.evaluation.pictures import draw_compared, draw_pictures
from dejavu_torch.evaluation.plots import Pictures
from dejavu_torch.evaluation.rejection import draw_reliability, found_elsewhere, reach_of
from dejavu_torch.evaluation.report import Report, as_html
from dejavu_torch.evaluation.storage import coded_at_sizes, noise_over_map
from dejavu_torch.features.descriptor import is_ready
from dejavu_torch.growth import calibrate_if_possible
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.model import DejaVu, check_apart, check_loops_along, check_queries, features_per_frame
from dejavu_torch.motion.resampling import ground_truth_of, resampled, source_of
from dejavu_torch.places.layout import Reach
from dejavu_torch.recognition.centring import centred
from dejavu_torch.recognition.evidence import passed_of
from dejavu_torch.recognition.large import is_large
from dejavu_torch.recognition.localizer import Matching, answer
from dejavu_torch.recognition.odometry import moves_of
from dejavu_torch.recognition.querying import QUERYING, Querying
from dejavu_torch.recognition.scorer import Repeated, Scorer
from dejavu_torch.recognition.select import check_candidates
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.recognition.views import ALONE
from dejavu_torch.types import Facts, InputError, Match, SequenceModel, Traverse, expect

log = logging.getLogger("dejavu_torch")

SAMPLED = 256  # reference frames that a given map is checked with
NEAR = 10  # places within which the map should find them, at least
# by the dimensions of a layout: scores up to which ordered queries are also filtered and smoothed by default,
# and whether sequences, which follow the numbers of places, are compared
MOST, FOLLOWS = {1: 2**25, 2: 2**23}, {1: True, 2: False}
DRIVEN = ("uncompressed", "null")  # contenders that are also matched as a whole drive

Seconds = dict[str, float]  # that each stage took


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


class Plan(NamedTuple):
    """A comparison whose sources and settings fit each other.

    has_map: whether the model brings its map. off: routes off the map. truth: as given, or an area's own.
    known: the right frames, None if nothing tells them. near: whether they are told by a distance. way: that
    answers. ordered: whether queries are in order. given: whether the user said so.
    """

    model: DejaVu
    has_map: bool
    reference: Traverse
    query: Traverse
    off: list[Traverse]
    truth: Truth | None
    known: GroundTruth | None
    near: bool
    reach: Reach
    way: SequenceModel | None
    ordered: bool
    given: bool
    learning: Learning
    querying: Querying
    reporting: Reporting
    seconds: Seconds

    @property
    def centring(self) -> bool:
        """Whether single queries and those of a drive are centred, once there is a map; not those of loops,
        whose mean is that of the map."""
        default = self.ordered and self.model.centres(len(self.query))
        return self.querying.loops is None and self.querying.centres(default)

    def within(self, truth: GroundTruth | None) -> int:
        """Within how many places answers are right, for all probabilities, by a truth in places."""
        return reach_of(self.reach.within, truth, self.near or self.reach.radius > 0)

    def ways(self, run: Localization) -> tuple[Matching, PlaceSmoother | None, PlaceSmoother | None]:
        """How queries are matched without a whole drive: the way that answers, and those that are compared;
        the smoother of a drive that answers, and one that is only compared."""
        queries, places, reach = len(self.query), self.model.map.places, self.within(run.truth)
        way, dimensions = self.way and self.way.having(within=reach), self.reference.layout.dimensions
        whole = way if isinstance(way, PlaceSmoother) else None
        # compared are single headings of queries in order, on few scores unless the user has asked for them
        most = math.inf if self.given else MOST[dimensions]
        wanted = self.ordered and run.truth is not None and self.querying.loops is None
        beside = wanted and self.querying.headings == 1 and queries * places <= most
        also = models_beside(None if whole else way, beside, queries, places, reach)
        also = {key: one for key, one in also.items() if key == "filter" or FOLLOWS[dimensions]}
        matching = Matching(None if whole else way, also, wrappers=run.querying.wrappers)
        return matching, whole, PlaceSmoother(within=reach) if beside and queries > 1 else None


def compare(
    reference: Source,
    query: Source | None,
    truth: Truth | None = None,
    model: DejaVu | None = None,
    tolerance: int = 5,
    learning: Learning = LEARNING,
    querying: Querying = QUERYING,
    reporting: Reporting = REPORTING,
) -> Comparison:
    """Learn the reference, localize the queries on it, and compare with other ways to store the route.

    Args:
        reference: the traverse to learn. query: a second traverse of the route; None with `loops`, which are
            found on the reference, as the baselines' are.
        truth: see `find_ground_truth`. Without any, there are matches and pictures, but no scores and no
            baselines.
        model: settings; None is DejaVu with its defaults. A map that it already has is evaluated as it is; it
            must be of this reference. The model is on the CPU afterwards.
        tolerance: places within which a match is right, inclusive; in an area, the distance of the middles of
            windows, in the unit of its coordinates.
        learning: what the map learns from, and is calibrated by, beside the reference: other traverses than
            the query. Without any, a new map is calibrated with changed frames of the reference. For another
            reach than 5 this is done again, for the report only.
        querying: how all contenders are matched. With a filter or a sequence, the scores at top level are
            those of its answers, else of single queries. Of queries in order the report also has the scores
            of a filter and of a smoother.
        reporting: what the report has besides.

    Raises:
        InputError: bad input to any of the stages, or a map of another number of places.
    """
    model = DejaVu() if model is None else model
    plan = _planned(reference, query, truth, model, tolerance, learning, querying, reporting)
    with model.descriptor.setting_aside(*([] if plan.known is None else [plan.reference, plan.query])):
        run = _learned(plan)
        with plan.learning.calibrated(model, plan.reference, plan.within(run.truth), reporting.progress):
            run, ranked, candidates = _answered(plan, run)
            way = plan.way and plan.way.having(within=plan.within(run.truth))
            off_map = found_elsewhere(run, plan.off, way, plan.ordered, plan.centring, reporting.progress)
        model.cpu()
        found = _told(plan, run, ranked, off_map)._replace(candidates=candidates)
        if reporting.on_found is not None:
            reporting.on_found(found)
        contenders = _contenders(plan, found.run)
    ours, seed = found.report.ours, learning.seed
    coded = model.map if ours.scores is not None and isinstance(model.map, SpectralMap) else None
    storage = None
    if coded is not None and reporting.storage_curve:
        storage = coded_at_sizes(found.run, seed=seed, progress=reporting.progress)
    pictures = found.pictures | draw_compared(found.run, {"map": ours, **contenders}, storage)
    numbers = {name: dict(picture.numbers) for name, picture in pictures.items() if picture.numbers}
    facts: Facts = {**found.report.facts, **peak_memory(), **numbers}
    if coded is not None and len(coded.chunks) == 1:
        facts["noise_over_map"] = noise_over_map(coded, found.run.reference_features, seed)
    return found._replace(report=Report(ours, contenders, facts), pictures=pictures)


def _planned(
    reference: Source,
    query: Source | None,
    truth: Truth | None,
    model: DejaVu,
    tolerance: int,
    learning: Learning,
    querying: Querying,
    reporting: Reporting,
) -> Plan:
    """Open what is compared, at even steps, and refuse what does not fit, before anything is learned."""
    expect(tolerance >= 0, "at least 0", f"tolerance is {tolerance}")
    parsed = None if truth is None else check_ground_truth(truth, reporting.interpolate)
    check_candidates(querying.ranks, tolerance)
    reporting.check(model, querying)
    learning.seed_whitening(model)
    itself, headings = querying.loops is not None, querying.headings
    expect(query is not None or itself, "a second visit, or loops within the reference", "there is no query")
    expect(query is None or not itself, "the reference alone", f"--loops {querying.loops} and a query")
    way = querying.matcher(tolerance)
    ordered = querying.order(way)
    # descriptors are as wide as the map's, and both traverses as evenly stepped
    seconds = dict.fromkeys(("describe", "learn", "localize"), 0.0)
    has_map = model.map.places > 0
    first, same = as_traverse(reference), query is reference
    second = first if same else None if query is None else as_traverse(query)
    first, learning = learning.opened(model, first, second, reporting.progress)
    reference, query, off = _prepared(model, first, first if same else second, querying, reporting, seconds)
    check_candidates(querying.ranks, tolerance, len(reference))
    layout = reference.layout
    north = facing_north(query, layout, headings)  # pictures show images, not their copies
    query = north if headings == 1 else query
    if truth is None and query.coordinates is not None and (truth := layout.truth(tolerance)) is not None:
        parsed = check_ground_truth(truth)
    near = parsed if isinstance(parsed, Near) else None
    if near is not None:
        check_unit(near, layout)
    reach = layout.reach(tolerance, None if near is None else near.radius)
    in_order = source_of(query).ordered if ordered is None else ordered
    if way == "auto":
        way = querying.matcher(tolerance, ordered=in_order and len(query) > 1)
    assert not isinstance(way, str)
    if way is not None and not way.whole:
        way.check(None, len(reference))
    # without a given truth, each place would be its own answer
    known = None
    if truth is not None or not itself:
        try:
            known = ground_truth_of(truth, reference, query, reporting.interpolate)
        except Nowhere as error:  # the answers may tell why, see `doubts_of`
            known = error.truth
    reporting.check_contenders(COLOURS, known is not None, len(query) * headings, len(reference))
    if known is not None and near is None and reach.within > reach.tolerance:
        known = widened(known, layout, reach.within)
    told = truth, known, near is not None, reach, way, in_order, querying.ordered or querying.unordered
    return Plan(model, has_map, reference, query, off, *told, learning, querying, reporting, seconds)


def _prepared(
    model: DejaVu,
    reference: Traverse,
    query: Traverse | None,
    querying: Querying,
    reporting: Reporting,
    seconds: Seconds,
) -> tuple[Traverse, Traverse, list[Traverse]]:
    """The reference, the query and routes off the map, at the map's size and at even steps."""
    loops, has_map, progress = querying.loops, model.map.places > 0, reporting.progress
    if query is not None:
        moves_of(query, querying.moved, querying.metres_per_place)  # refuses what cannot be read
    if loops is not None:
        check_loops_along(reference.layout)
    off = reporting.off_map([reference] if query is None else [reference, query])
    query = reference if query is None else query
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


def _learned(plan: Plan) -> Localization:
    """The run with the map, which is learned and calibrated unless the model has it, and no answers yet."""
    model, reference, learning = plan.model, plan.reference, plan.learning
    progress, known, loops = plan.reporting.progress, plan.known, plan.querying.loops
    with timed(plan.seconds, "describe" if plan.has_map else "learn"):
        if plan.has_map:
            places = model.descriptor.all_of(reference, progress)
            _check_given_map(model, places, reference.name, plan.reach.tolerance)
        else:
            spectral = isinstance(model.mapper, SpectralMapper)
            places = model.descriptor.learn(reference, learning.views, progress, spectral)
            model.learn_features(places, reference, learning.views)
        if learning.visit is not None or not (plan.has_map or learning.calibration == NO_CALIBRATION):
            calibrate_if_possible(model, reference, learning.visit, progress=progress)
    if known is not None:
        known = ground_truth_in_places(known, model.map.place_of)
        known = (
            known
            if loops is None
            else of_loops(known, torch.arange(len(plan.query)), loops, passed_of(plan.query))
        )
    check_queries(model, plan.query.frame_shape, features_per_frame(model), plan.query.name)
    run = Localization(model, reference, plan.query, places, places, NOTHING, known, plan.reach.tolerance)
    return run._replace(querying=plan.querying, radius=plan.reach.radius)


def _answered(plan: Plan, run: Localization) -> tuple[Localization, Match, Match]:
    """The run with its answers, and the best places of each query, as far as recall@N needs, and, for its
    answer, as far as `top` needs."""
    model, progress, causal = plan.model, plan.reporting.progress, plan.way is not None and not plan.way.whole
    with timed(plan.seconds, "localize"):
        querying = model.looking(run.query, plan.querying, plan.ordered, plan.centring and not causal)
    run = run._replace(querying=querying)
    matching, whole, beside = plan.ways(run)
    moved = None if querying.loops is not None else model.moved(run.query, querying, plan.way)
    whole_moved = None if is_large(len(run.query), model.map.places) else moved
    matching, beside = matching._replace(moved=moved), beside and beside.changed(moved=whole_moved)
    ranks = max(querying.ranks, min(max(RANKS), model.map.places))

    def found(scorer: Scorer, own: Matching) -> Match:
        own = own._replace(k=ranks, radius=run.tolerance, wrappers=querying.wrappers, moved=matching.moved)
        return answer(scorer, own, progress)

    with timed(plan.seconds, "localize"):
        if run.query is not run.reference or querying.views != ALONE:
            run = run._replace(query_features=model.described(run.query, querying, False, progress))
        queries, way = run.query_features, matching.sequence
        if plan.centring and not is_turned(run.asked):
            run = run._replace(
                query_features=centred(model.map, queries, querying.copies), causal_features=queries
            )
        if way is not None:
            way.check(len(run.query), model.map.places)
        # beside a drive nobody asks which single images are accepted
        single = (
            model.matching(way)
            if whole is None
            else Matching(platt=model.calibration and model.calibration.single)
        )
        scorer = run.scorer_by(partial(model.scorer, matching=single))
        match = found(scorer, single._replace(also=matching.also))
        best = match.map(lambda column: column[:, 0])
        run = run._replace(matching=matching, beside=beside, match=best, judged=best)
        if (smoother := whole or beside) is None:
            return run, match, match
        loops = querying.loops
        own = model.matching(smoother) if loops is None else model.loop_matching(loops, smoother)
        drive = found(scorer, own)
        best = drive.map(lambda column: column[:, 0])
        if loops is None:
            judged = replace(run.judged, sequences={**run.judged.sequences, "smoother": best})
            run = run._replace(judged=judged, beside=beside and model.adapted(beside))
    return (run, match, match) if whole is None else (run._replace(match=best), match, drive)


def _told(plan: Plan, run: Localization, ranked: Match, off_map: dict[str, Tensor]) -> Comparison:
    """The map's own answers, before they are compared with anything."""
    model, truth, interpolate = plan.model, plan.truth, plan.reporting.interpolate
    run = run._replace(
        reference_features=run.reference_features.cpu(), query_features=run.query_features.cpu()
    )
    ours = run.contend("this map", run.judged.renumbered(model.map.table.scored), model)
    headings, views = plan.querying.headings, plan.learning.views
    facts: Facts = {
        **facts_of(run, plan.seconds),
        **match_facts(run, ranked, truth, interpolate, off_map),
        "centred": plan.centring,
        **({"headings": headings} if headings > 1 else {}),
        **view_facts(run),
        **metric_facts(run, truth),
        **({"second": views.placed_facts()} if views is not None and views.placed else {}),
    }
    facts |= doubt_facts(doubts_of(run, truth, facts))
    pictures = draw_pictures(run, {"map": ours}) | draw_reliability(run.scored, run.truth, run.tolerance)
    return Comparison(Report(ours, {}, facts), pictures, run, ranked)


def _contenders(plan: Plan, run: Localization) -> dict[str, Contender]:
    """The baselines, null controls, given contenders and further models, scored."""
    reporting, progress, judged = plan.reporting, plan.reporting.progress, run.truth is not None
    table = run.model.map.table
    itself = table.scored(torch.arange(table.places))[:, None]  # of the places as queries

    def further() -> Iterator[tuple[str, Baseline]]:
        if judged or reporting.leave_out is not None:
            yield from baselines_of(run, plan.learning.seed, reporting.leave_out, progress)
        for key, (name, bytes, given) in reporting.contenders.items():
            views = len(run.querying.views.shifts)
            yield key, Baseline(name, given if views == 1 else Repeated(given, views), bytes)
        for key, (name, other) in reporting.others.items() if judged else ():
            other.learn(run.reference, progress)
            described = other.described(run.query, run.querying, False, progress)
            scorer, size = other.scorer(described, run.matching), other.summary()
            match = answer(scorer, run.matching, progress)
            if run.beside is not None and reporting.drives == "all":
                drive = answer(scorer, Matching(other.adapted(run.beside)), progress)
                match = replace(match, sequences={**match.sequences, "smoother": drive})
            yield key, Baseline(name, None, size.map_bytes, None, size.fixed_bytes, match)

    contenders, driven = {}, None if reporting.drives == "all" else DRIVEN
    for key, (one, match) in matched(further(), run.matching, run.beside, driven, progress).items():
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


@contextmanager
def timed(seconds: Seconds, name: str) -> Iterator[None]:
    """Add the seconds that a block takes to `seconds[name]`."""
    began = time.perf_counter()
    yield
    seconds[name] += time.perf_counter() - began
