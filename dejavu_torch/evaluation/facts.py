"""The entries of report.json of a comparison."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from itertools import pairwise

import torch
from torch import Tensor

from dejavu_torch.data.coordinates import Near, coordinates_of
from dejavu_torch.data.ground_truth import Truth, check_ground_truth, describe_ground_truth, offset_of
from dejavu_torch.evaluation.answers import answer_facts, shift_facts
from dejavu_torch.evaluation.curves import auc_error
from dejavu_torch.evaluation.evaluate import evaluation_facts
from dejavu_torch.evaluation.localization import Localization
from dejavu_torch.maps.distance import l1_backend
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.motion.resampling import ResampledTraverse, source_of
from dejavu_torch.periods.spectrogram import BACKEND
from dejavu_torch.recognition.scorer import OfMap
from dejavu_torch.recognition.views import BestView
from dejavu_torch.text import plain_number
from dejavu_torch.types import Facts, Match

QUANTILES = 0.5, 0.9, 0.99  # of errors in metres
WINDOWS = 1, 2, 5  # or metres, within which answers are counted
LINES = {1: True, 2: False}  # whether answers that lie on a line are told, by the dimensions of a layout
STANDING, FAR = 0.01, 256  # of the distance between places drawn at random: a camera that stands still


def facts_of(run: Localization, seconds: Mapping[str, float]) -> Facts:
    """The entries about the map, the run and places where the camera stands."""
    return {
        **_map_facts(run.model.summary(), run.reference_features),
        **_run_facts(run, seconds),
        **_standing_facts(run),
    }


def _map_facts(summary: MapSummary, features: Tensor) -> Facts:
    """The entries of report.json about the map, whose places have these features (N,D)."""
    chunks = [chunk._asdict() | {"periods": [*map(plain_number, chunk.periods)]} for chunk in summary.chunks]
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


def _run_facts(run: Localization, seconds: Mapping[str, float]) -> Facts:
    """The entries of report.json about the run; no seconds to learn if the map is given."""
    model, reference, query = run.model, run.reference, run.query
    way, smoother = run.sequence, run.match.smoother
    acceptance = model.acceptance(run.way)
    facts = {
        "answers": run.answers,
        "seconds_learn": seconds["learn"],
        "seconds_localize": seconds["localize"],
        "l1_backend": l1_backend(),
        "spectrogram_backend": BACKEND,
        "threshold": acceptance.threshold,
        "least_probability": acceptance.precision,
        "sequence": 1 if way is None else way.length,
        "speeds": None if way is None or not way.speeds else [*way.speeds],
        "filter": way is not None and way.answers == "filter",
        "trained": model.trained and model.trained._asdict(),
        **({} if run.has_frames else {"ready": True}),
        "reference": reference.name,
        "query": query.name,
        **peak_memory(),
        **_gap_facts(run),
    }
    if smoother is not None:
        facts["drive"] = drive = smoother.settled() | {"speed": _median(run.match.speed)}
        if run.truth is not None:
            block = math.ceil(drive["correlation"])
            drive["auc_error"] = auc_error(run.scored, run.truth, run.tolerance, block)
    if run.querying.loops is not None:
        facts["loops"] = run.querying.loops
    if isinstance(reference, ResampledTraverse):
        facts["resampling"] = {
            "step": reference.step,
            "reference_frames": len(reference.positions),
            "query_frames": len(query.positions) if isinstance(query, ResampledTraverse) else None,
        }
    return facts


def match_facts(
    run: Localization, candidates: Match, truth: Truth | None, interpolate: bool, off: Mapping[str, Tensor]
) -> Facts:
    """The entries of report.json about the answers; `off`: see `rejection_facts`."""
    place_map, tolerance = run.model.map, run.tolerance
    carried = all(source_of(traverse).places is not None for traverse in (run.reference, run.query))
    words, offset = describe_ground_truth(truth, interpolate, carried), offset_of(truth, carried)
    ranked, shown = place_map.table.scored(candidates.index), run.match.renumbered(place_map.frame_of)
    facts = evaluation_facts(run.scored, ranked, run.truth, tolerance, place_map.positions, words, off)
    alone = answer_facts(shown, run.query_frames, tolerance, run.truth is not None, offset)
    if run.querying.loops is not None or not LINES[place_map.layout.dimensions]:
        alone.pop("line", None)  # a second lap lies on one
    if extent := place_map.layout.extent:
        radius, unit = run.reach
        alone |= extent | {"unit": unit, "tolerance": plain_number(radius), "truth": words}
    return facts | alone


def view_facts(run: Localization) -> Facts:
    """The entry `views` of report.json, if images were also compared moved sideways: by its shift the penalty
    of each view that answers, and the median shift of the answers."""
    causal = None if run.way is None or run.way.whole else run.causal_features
    features = run.query_features if causal is None else causal
    best = run.querying.views(OfMap(run.model.map, features))
    if not isinstance(best, BestView):
        return {}
    own = zip(best.kept.tolist(), best.penalties[0].tolist(), strict=True)
    penalties = {f"{best.shifts[copy]:g}": round(penalty, 4) for copy, penalty in own}
    return {"views": {"penalties": penalties, "shift": _median(run.match.shift)}}


def _median(column: Tensor | None) -> float | None:
    known = [] if column is None else column[~column.isnan()].sort().values.tolist()
    return known[len(known) // 2] if known else None


def metric_facts(run: Localization, truth: Truth | None) -> Facts:
    """The entry `error_metres` or `error_pixels` of report.json: quantiles of the distances between queries
    and the places reported for them, where the truth is by coordinates; and `shift`, see `shift_facts`. In an
    area also `recall_within`, the share of the queries with coordinates within 1, 2 and 5 metres, or
    windows."""
    parsed = None if truth is None else check_ground_truth(truth)
    if not isinstance(parsed, Near):
        return {}
    stored, asked = coordinates_of([source_of(run.reference), source_of(run.query)], parsed.kind)
    index = run.match.index
    asked, found = asked[run.query_frames], stored[run.model.map.frame_of(index)]
    distance = (asked - found).norm(dim=1)
    known = distance.isfinite() & (index >= 0)
    if run.truth is not None and run.querying.loops is not None:
        known &= (run.truth.positives >= 0).any(1)  # most places are no loop
    facts: Facts = {}
    for name, chosen in (("all", known), ("accepted", known & run.match.accepted)):
        if chosen.any():
            quantiles = distance[chosen].quantile(torch.tensor(QUANTILES, dtype=torch.float64)).tolist()
            facts[name] = {f"{share:g}": round(at, 3) for share, at in zip(QUANTILES, quantiles, strict=True)}
    shares: Facts = {}
    if radii := run.model.map.layout.radii(WINDOWS):
        asked_of, far = asked.isfinite().all(1), distance.masked_fill(~known, math.inf)
        near = {f"{radius:g}": float((far[asked_of] <= radius).double().mean()) for radius in radii}
        shares = {"recall_within": near} if asked_of.any() else {}
    if run.querying.loops is None:
        shares |= shift_facts(parsed, run.match, found, asked)
    return {f"error_{parsed.kind if parsed.kind == 'pixels' else 'metres'}": facts} | shares


def _gap_facts(run: Localization) -> Facts:
    """Of queries in order: the longest stretch without an accepted answer, in frames and, if known, seconds
    from the answer before to that after."""
    in_order = run.query.ordered or run.match.smoother is not None or run.sequence is not None
    if not in_order or run.querying.loops is not None:
        return {}
    ends, count = (run.match.accepted & (run.match.index >= 0)).nonzero()[:, 0].tolist(), len(run.match.index)
    gap, before, after = max((two - one - 1, one, two) for one, two in pairwise([-1, *ends, count]))
    facts: Facts = {"longest_gap": gap}
    times = source_of(run.query).times
    if gap and times is not None:
        known = times[run.query_frames[[max(0, before), min(count - 1, after)]]]
        facts["longest_gap_seconds"] = abs(float(known[1] - known[0]))
    return facts


def peak_memory() -> Facts:
    """The bytes that the process has held at most, where the system tells."""
    try:
        import resource
    except ImportError:  # Windows
        return {}
    unit = 1 if sys.platform == "darwin" else 1024
    return {"peak_memory": unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}


def _standing_facts(run: Localization) -> dict[str, int]:
    """The entry `standing` of report.json: places where the camera stands, if there are some."""
    if isinstance(run.reference, ResampledTraverse):
        return {}
    count = count_standing(run.reference_features)
    return {"standing": count} if count else {}


def count_standing(descriptors: Tensor) -> int:
    """How many of the places (N,K) look like the one before, as where the camera stands."""
    drawn = torch.linspace(0, len(descriptors) - 1, min(FAR, len(descriptors))).round().long()
    some = descriptors[drawn].float()
    far = float((some - some.flip(0)).square().sum(1).median())
    steps = descriptors.float().diff(dim=0).square().sum(1)
    return int((steps < STANDING * far).sum())
