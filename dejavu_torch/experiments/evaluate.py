"""Evaluate the matches in a file, whatever method found them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

import dejavu_torch
from dejavu_torch.data.ground_truth import (
    check_ground_truth,
    describe_ground_truth,
    find_ground_truth,
    ground_truth_in_places,
)
from dejavu_torch.data.positions import unit_of
from dejavu_torch.evaluation.contenders import Contender, contend
from dejavu_torch.evaluation.curves import (
    RECALL_DEFINITION,
    count_queries,
    curve_of,
    threshold_of_full_precision,
)
from dejavu_torch.evaluation.match_plots import plot_coverage
from dejavu_torch.evaluation.matches import read_matches
from dejavu_torch.evaluation.plots import Picture
from dejavu_torch.evaluation.report import Report
from dejavu_torch.evaluation.score_plots import plot_curves
from dejavu_torch.model import read_place_map
from dejavu_torch.types import GroundTruth, InputError, Match, Traverse


class Evaluation(NamedTuple):
    """An evaluation's figures, what they are of, and its pictures; `queries` (Q,) is the frame of each."""

    report: Report
    queries: Tensor
    match: Match
    truth: GroundTruth
    pictures: Mapping[str, Picture]


def evaluate_file(
    matches: Path,
    truth: str | None,
    tolerance: int = 5,
    interpolate: bool = False,
    reference: Traverse | None = None,
    query: Traverse | None = None,
    map: Path | None = None,
) -> Evaluation:
    """Scores and pictures of the matches in a csv.

    Args:
        matches: see `read_matches`.
        truth: see `find_ground_truth`; None needs both traverses.
        tolerance: frames within which a report is right, inclusive; places where the map's are resampled.
        interpolate: see `find_ground_truth`.
        reference, query: the traverses, where the ground truth lies in them; a reference also says how many
            frames there are: without it, an offset gives every query a right answer.
        map: file of a map of the reference. It says how many frames there are as well; where its places are
            resampled by distance, matches and ground truth are turned from frames into places.

    Raises:
        InputError: matches, ground truth or map that cannot be read, do not fit each other, or leave no query
            to score.
    """
    if tolerance < 0:
        raise InputError(f"the tolerance is {tolerance}; expected at least 0")
    if truth is not None:
        check_ground_truth(truth, interpolate)
    place_map = None if map is None else read_place_map(map)
    positions = torch.zeros(0) if place_map is None else place_map.positions
    resampled, unit = len(positions) > 0, unit_of(positions)
    frames = places = None if reference is None else reference.length
    if place_map is not None:
        places = place_map.places
        frames = len(positions) if resampled else places
    queries, match = read_matches(matches)
    if frames is not None and int(match.index.max()) >= frames:
        raise InputError(f"{matches} reports place {int(match.index.max())}; expected one below {frames}")
    known = find_ground_truth(truth, reference, query, frames, queries, interpolate, resampled)
    if known is None:
        raise InputError("there is no ground truth; expected one, or traverses that carry their positions")
    if place_map is not None:
        known = ground_truth_in_places(known, place_map.place_of)
        match = match._replace(index=place_map.place_of(match.index))
    counts = count_queries(match, known, tolerance)
    facts = counts | {
        "accepted_precision": counts["accepted_right"] / counts["accepted"] if counts["accepted"] else None,
        "tolerance": tolerance,
        "unit": unit,
        "recall_definition": RECALL_DEFINITION,
        "matches": str(matches),
        "places": places,
        "truth": describe_ground_truth(truth, interpolate, positions=True),
        "threshold_of_full_precision": threshold_of_full_precision(curve_of(match, known, tolerance)),
        "version": dejavu_torch.__version__,
        "torch": torch.__version__,
    }
    ours = contend(matches.name, match, known, tolerance)
    seen = places or 1 + max(int(table.max()) for table in (match.index, known.positives))
    borders = torch.arange(seen + 1) if place_map is None else place_map.borders
    pictures = _pictures(ours, queries, match, known, tolerance, borders, unit)
    return Evaluation(Report(ours, {}, facts), queries, match, known, pictures)


def _pictures(
    ours: Contender,
    queries: Tensor,
    match: Match,
    truth: GroundTruth,
    tolerance: int,
    borders: Tensor,
    unit: str,
) -> dict[str, Picture]:
    return {
        "pr": Picture(
            plot_curves({"map": ours}, f"right within {tolerance} {unit}"),
            "precision and recall",
            "How many of the reported places are right, against how many of the queries are answered right, "
            "as the threshold rises.",
        ),
        "coverage": Picture(
            plot_coverage(match, truth, tolerance, borders, queries, unit),
            "places reported",
            "Where along the route each query was found. In its right place it is green, in a wrong one red.",
        ),
    }
