"""Judge matches that lie in a file, whatever method found them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

import dejavu_torch
from dejavu_torch.data.truth import Shown, unit_of
from dejavu_torch.data.truthfile import check_truth_text, describe_truth, find_truth
from dejavu_torch.database.compressed import CompressedMap
from dejavu_torch.database.mapfile import read_compressed
from dejavu_torch.evaluation.contenders import contend
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
from dejavu_torch.types import GroundTruth, InputError, Match, Traverse


class Evaluation(NamedTuple):
    """An evaluation's figures, what was judged, and its pictures; `queries` (Q,) is the number of each."""

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
        truth: see `find_truth`; None needs both traverses.
        tolerance: frames within which a place is right, inclusive.
        interpolate: see `read_truth`.
        reference, query: the traverses, where the truth lies in them; a reference also tells how many
            places there are: without it, an offset gives every query a right place.
        map: file of the map that was matched. It too tells how many places there are, and where they are
            evenly spaced, the frame of each, for a truth that counts frames.

    Raises:
        InputError: matches or truth that cannot be read, do not fit each other, or leave nothing to judge.
    """
    if tolerance < 0:
        raise InputError(f"the tolerance is {tolerance}; expected at least 0")
    if truth is not None:
        check_truth_text(truth, interpolate)
    queries, match, query_frame, place_frame = read_matches(matches)
    places = None if reference is None or query_frame is not None else reference.length
    shown = None if query_frame is None else Shown(query_frame)
    if map is not None:
        stored = read_compressed(map)
        places = stored.places
        _check_map(stored, map, matches, match, place_frame)
        if query_frame is not None:
            # --as_is; at a constant speed even steps may be frames as well
            varies = not torch.equal(stored.frame, torch.arange(stored.places))
            as_came = varies and torch.equal(query_frame, queries)
            frames = None if query is None else query.length
            shown = Shown(None if as_came else query_frame, stored.frame, stored.place_of, frames)
    if places is not None and int(match.index.max()) >= places:
        raise InputError(f"{matches} reports place {int(match.index.max())}; expected one below {places}")
    known = find_truth(truth, reference, query, places, queries, interpolate, shown)
    if known is None:
        raise InputError("there is no truth; expected one, or two traverses that carry their positions")
    counts = count_queries(match, known, tolerance)
    curve = curve_of(match, known, tolerance)
    facts = counts | {
        "accepted_precision": counts["accepted_right"] / counts["accepted"] if counts["accepted"] else None,
        "tolerance": tolerance,
        "unit": unit_of(shown),
        "recall_definition": RECALL_DEFINITION,
        "matches": str(matches),
        "places": places,
        "truth": describe_truth(truth, interpolate, positions=True, spaced=shown is not None),
        "threshold_of_full_precision": threshold_of_full_precision(curve),
        "version": dejavu_torch.__version__,
        "torch": torch.__version__,
    }
    ours = contend(matches.name, match, known, tolerance)
    seen = 1 + max(int(table.max()) for table in (match.index, known.positives))
    pictures = {
        "pr": Picture(
            plot_curves({"map": ours}, f"right within {tolerance} places"),
            "precision and recall",
            "How many of the reported places are right, against how many of the queries are answered right, "
            "as the threshold rises.",
        ),
        "coverage": Picture(
            plot_coverage(match, known, tolerance, seen if places is None else places, queries),
            "places reported",
            "Where along the route each query was put. In its right place it is green, in a wrong one red.",
        ),
    }
    return Evaluation(Report(ours, {}, facts), queries, match, known, pictures)


def _check_map(
    stored: CompressedMap, map: Path, matches: Path, match: Match, place_frame: Tensor | None
) -> None:
    """Refuse a map that is not the one that was matched."""
    expected = "expected the map that was matched"
    if len(stored.frame) and place_frame is None:
        raise InputError(f"{matches} has no place_frame, the places of {map} are evenly spaced; {expected}")
    if place_frame is not None and not len(stored.frame):
        raise InputError(f"{matches} has place_frame, the places of {map} are frames; {expected}")
    if place_frame is None:
        return
    told = (match.index >= 0) & (match.index < stored.places)
    if not torch.equal(stored.frame[match.index[told]], place_frame[told]):
        raise InputError(f"{matches} and {map} tell other frames of the same places; {expected}")
