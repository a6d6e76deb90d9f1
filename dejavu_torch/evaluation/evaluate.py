"""Evaluate the matches in a file, from any method."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.coordinates import Near
from dejavu_torch.data.ground_truth import (
    GroundTruth,
    Nowhere,
    check_ground_truth,
    check_unit,
    counted,
    describe_ground_truth,
    find_ground_truth,
    ground_truth_in_places,
    is_right,
    of_loops,
    offset_of,
    scored_and_right,
)
from dejavu_torch.data.traverse import Part
from dejavu_torch.evaluation import curves
from dejavu_torch.evaluation.agreement import Judged
from dejavu_torch.evaluation.answers import answer_facts, shift_facts
from dejavu_torch.evaluation.contenders import contend
from dejavu_torch.evaluation.doubts import compared, doubt_facts, ground_of
from dejavu_torch.evaluation.match_plots import draw_coverage
from dejavu_torch.evaluation.matches import ELSEWHERE, read_matches
from dejavu_torch.evaluation.options import REACH
from dejavu_torch.evaluation.plots import Pictures
from dejavu_torch.evaluation.rejection import draw_reliability, reach_of, rejection_facts
from dejavu_torch.evaluation.report import Report
from dejavu_torch.evaluation.score_plots import draw_curves
from dejavu_torch.maps.digest import digests_of
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import read_place_map
from dejavu_torch.places.layout import ROUTE, Layout
from dejavu_torch.places.positions import unit_of
from dejavu_torch.recognition.calibration import TOLERANCE
from dejavu_torch.recognition.evidence import passed_of
from dejavu_torch.text import plain_number, printable
from dejavu_torch.types import Coordinates, Doubt, Facts, InputError, Match, Traverse, expect
from dejavu_torch.version import __version__

RANKS = (5, 10)  # the N of recall@N
DESCRIBED = 64  # places by whose queries these are compared with a map, at most
TOLD = 10  # least number of right and of wrong answers whose scores are compared

log = logging.getLogger("dejavu_torch")


class Evaluation(NamedTuple):
    """A report with the matches and truth that it scores, and pictures; `queries` (Q,) are their frames."""

    report: Report
    queries: Tensor
    match: Match
    truth: GroundTruth
    pictures: Pictures


@dataclass(frozen=True)
class Asked:
    """What matches were found in.

    Args:
        reference, query: the traverses, if they carry the ground truth. Without a reference or a map the
            number of frames is unknown, and an offset gives every query a right answer.
        map: file of a map of the reference. If its places are resampled by distance, matches and ground
            truth are translated from frames to places.
        route: for matches on a merged map, the route of the truth and the reference: answers on other routes
            are wrong.
    """

    reference: Traverse | None = None
    query: Traverse | None = None
    map: Path | None = None
    route: str | None = None

    def places(self) -> tuple[PlaceMap | None, Traverse | None, Layout]:
        """The map, if there is one, the reference, which of an area is that of the map, and the layout."""
        place_map, reference = None if self.map is None else self._map(self.map), self.reference
        layout = ROUTE if place_map is None else place_map.layout
        if layout.on_ground and reference is None:
            windows = ArrayTraverse(torch.zeros(layout.places, 1), str(self.map))
            coordinates = layout.coordinates(torch.arange(layout.places))
            reference = windows.changed(
                coordinates=Coordinates(coordinates, frame=layout.frame), _layout=layout
            )
        if reference is not None and layout.on_ground:
            own = reference.layout.same(layout)
            expect(own, "that of the map, or no reference", f"{reference.name} is not the area of {self.map}")
        return place_map, reference, layout if reference is None else reference.layout

    def doubts(self, place_map: PlaceMap | None, queries: Tensor, found: Tensor) -> list[Doubt]:
        """Whether queries (Q,), with places (Q,), are independent of the map, by some that show places with a
        digest, and those beside them; nothing without their source, or if the map cannot describe them."""
        model = self._model
        if model is None or self.query is None or place_map is None or model.step is not None:
            return []
        with suppress(InputError):
            count = len(self.query)
            off = (found - place_map.digested[:, None]).abs()
            shown = off.argmin(1)[off.amin(1) <= 1] if off.numel() else found[:0]
            shown = queries[shown[:: -(-len(shown) // DESCRIBED) or 1]]
            frames = (shown[:, None] + torch.arange(-1, 2)).clamp(0, count - 1).unique()
            some = Part(model.at_map_size(self.query, model.frame_shape or ()), frames)
            rows = model.descriptor.all_of(some) if len(frames) else torch.zeros(0, model.map.dimension)
            digests = digests_of(rows, follow=False)
            return model.provenance.doubts(place_map, digests, self.query)
        return []

    @cached_property
    def _model(self) -> DejaVu | None:
        """With the map, if there are queries that it can describe."""
        with suppress(InputError):
            return None if self.map is None or self.query is None else DejaVu.load(self.map)
        return None

    def _map(self, map: Path) -> PlaceMap:
        model = self._model
        place_map = model.map if model is not None and model.map.places else read_place_map(map)
        if self.route is None:
            place_map.layout.expect_one("--route with the one of the truth", str(map))
        if place_map.layout.count == 1 or not isinstance(place_map, SpectralMap):
            return place_map
        return place_map.part(str(self.route))


ANYWHERE = Asked()


def evaluate_file(
    matches: Path,
    truth: str | None,
    tolerance: int = 5,
    asked: Asked = ANYWHERE,
    interpolate: bool = False,
    recall_values: Sequence[int] = (),
    higher_is_better: bool = False,
    loops: int | None = None,
) -> Evaluation:
    """Scores and pictures of the matches in a csv.

    Args:
        matches: see `read_matches`.
        truth: see `find_ground_truth`; None needs both traverses.
        tolerance: frames within which an answer is right, inclusive; places if the map is resampled.
        asked: what the matches were found in, as far as it is known.
        interpolate: see `find_ground_truth`.
        recall_values: see `recall_over_all`; each at most the ranks of a query.
        higher_is_better: the scores are similarities.
        loops: see `DejaVu.loops`; only places this many frames before a query can be right.

    Raises:
        InputError: matches, ground truth or map that cannot be read, do not fit each other, or leave no query
            to score.
    """
    expect(tolerance >= 0, "at least 0", f"the tolerance is {tolerance}")
    parsed = None if truth is None else check_ground_truth(truth, interpolate)
    place_map, reference, layout = asked.places()
    near = _near(parsed, layout, tolerance)
    tolerance, query, route = layout.reach(tolerance).tolerance, asked.query, asked.route
    positions = torch.zeros(0, dtype=torch.float32) if place_map is None else place_map.positions
    resampled, places = len(positions) > 0, None if reference is None else len(reference)
    places = places if place_map is None else place_map.places
    frames = len(positions) if resampled else places
    queries, match, candidates = read_matches(matches, route, resampled, higher_is_better)
    highest = int(candidates.max())
    expect(frames is None or highest < frames, f"one below {frames}", f"{matches} reports place {highest}")
    try:
        known = find_ground_truth(truth, reference, query, frames, queries, interpolate, resampled)
    except Nowhere as error:  # the answers may tell why
        known = error.truth
    if known is None:
        raise InputError("there is no ground truth; expected one, or sources with coordinates")
    carried = all(traverse is not None and traverse.places is not None for traverse in (reference, query))
    alone = answer_facts(match, queries, tolerance, True, offset_of(truth, carried))
    elsewhere = candidates == ELSEWHERE
    if place_map is not None:
        known, candidates = ground_truth_in_places(known, place_map.place_of), place_map.place_of(candidates)
    if loops is not None:
        at = queries if place_map is None else place_map.place_of(queries)
        known = of_loops(known, at, loops, None if resampled else passed_of(reference))
    here = replace(match, index=candidates[:, 0].masked_fill(elsewhere[:, 0], -1))
    if route is not None:  # number places on other routes beyond every place of this one and its truth
        highest = max(int(table.max()) for table in (candidates, known.positives) if table.numel())
        candidates = candidates.masked_fill(elsewhere, max(places or 0, 1 + highest) + tolerance)
    match = replace(match, index=candidates[:, 0])
    reach = reach_of(tolerance, known, near is not None)
    if match.probability is not None and reach != TOLERANCE:
        log.warning(f"`localize` writes {REACH}", TOLERANCE, reach)
    described = describe_ground_truth(truth, interpolate, carried)
    facts = evaluation_facts(match, candidates, known, tolerance, positions, described) | alone
    if near is not None and layout.units:
        facts |= {"tolerance": plain_number(near.radius), "unit": layout.units}
    doubts: list[Doubt] = []
    if loops is None:
        found = here if place_map is None else here.renumbered(place_map.frame_of)
        ground = ground_of(truth, reference, query, found, queries)
        facts |= {} if ground is None else shift_facts(ground.near, here, ground.found, ground.asked)
        judged, right = scored_and_right(match.index, known, tolerance)
        one = Judged(found, queries, right, judged, tolerance, described, frames)
        doubts = compared(one, ground, facts) + asked.doubts(place_map, queries, here.index)
    facts |= doubt_facts(doubts)
    accepted = facts["accepted"]
    facts["accepted_precision"] = facts["accepted_right"] / accepted if accepted else None
    facts |= {"matches": str(matches), "places": places}
    if recall_values:
        facts["recall_values"] = curves.recall_over_all(candidates, known, tolerance, recall_values)
    if route is not None:
        facts |= {"route": route, "elsewhere": int(elsewhere[:, 0].sum())}
    ours = contend(printable(matches.name), match, known, tolerance)
    if not higher_is_better and _look_similar(match, known, tolerance):
        log.warning("right answers have higher scores than wrong ones; for similarities: --higher_is_better")
    seen = places or 1 + max(int(table.max()) for table in (here.index, known.positives))
    borders = torch.tensor([seen]) if place_map is None else place_map.table.borders
    pictures = draw_curves({"map": ours}, f"{facts['tolerance']} {facts['unit']}")
    pictures |= draw_coverage(here, known, tolerance, borders, queries, facts["unit"])
    pictures |= draw_reliability(match, known, tolerance)
    return Evaluation(Report(ours, {}, facts), queries, match, known, pictures)


def _near(parsed: object, layout: Layout, tolerance: int) -> Near | None:
    """The distance within which answers are right, if the truth tells one; over an area it has to."""
    if isinstance(parsed, Near):
        check_unit(parsed, layout)
        return parsed
    if tolerance:  # numbers of places tell no distance over an area
        expected = "--tolerance 0, or the distance in the truth, such as --truth pixels:10"
        layout.expect_route(expected, f"the places are those of an area, the tolerance is {tolerance} places")
    return None


def _look_similar(match: Match, truth: GroundTruth, tolerance: int) -> bool:
    """Whether scores may be similarities: most right answers have higher ones than most wrong ones."""
    known, right = counted(match.index, truth, tolerance), is_right(match.index, truth.positives, tolerance)
    finite = match.score.isfinite() & known
    good, bad = match.score[finite & right], match.score[finite & ~right]
    return min(len(good), len(bad)) >= TOLD and bool(good.median() > bad.median())


def evaluation_facts(
    match: Match,
    candidates: Tensor,
    truth: GroundTruth | None,
    tolerance: int,
    positions: Tensor,
    described: str,
    off_map: Mapping[str, Tensor] = MappingProxyType({}),
) -> Facts:
    """The entries of every report.json besides the scores.

    Args:
        candidates: (Q,K), best first, in the places of the ground truth.
        truth: None if unknown. described: the same in words.
        positions: of the map's places, empty if places are frames; see `PlaceMap`.
        off_map: see `rejection_facts`.
    """
    facts: Facts = {
        "queries": len(match.index),
        "accepted": int(match.accepted.sum()),
        "tolerance": tolerance,
        "unit": unit_of(positions),
        "recall_definition": curves.RECALL_DEFINITION,
        "version": __version__,
        "torch": torch.__version__,
    }
    for first in RANKS:
        recall = None if truth is None else curves.recall_at(candidates, truth, tolerance, first)
        facts[f"recall_at_{first}"] = recall
    if truth is not None:
        facts |= curves.count_queries(match, truth, tolerance) | {"truth": described}
        curve = curves.curve_of(match, truth, tolerance)
        facts["threshold_of_full_precision"] = curves.threshold_of_full_precision(curve)
    return facts | rejection_facts(match, truth, tolerance, off_map)
