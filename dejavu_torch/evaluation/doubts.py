"""What makes the answers doubtful: see `Doubt`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from dejavu_torch.data.coordinates import Near, coordinates_of
from dejavu_torch.data.ground_truth import Truth, check_ground_truth, describe_distant, scored_and_right
from dejavu_torch.evaluation.agreement import Ground, Judged, coarse, contradictions
from dejavu_torch.evaluation.answers import describe_line
from dejavu_torch.evaluation.localization import Localization
from dejavu_torch.evaluation.second_look import is_doubtful, second_look
from dejavu_torch.maps.digest import digests_of
from dejavu_torch.motion.resampling import source_of
from dejavu_torch.recognition.provenance import THEMSELVES
from dejavu_torch.recognition.select import PROBABLE
from dejavu_torch.types import Doubt, Facts, Match, Traverse

CONTRADICT = "the answers contradict the truth"
SOME, EQUAL = 20, 1e-4  # queries that are compared with all frames of the reference, and how near they are


def doubts_of(run: Localization, truth: Truth | None, facts: Mapping[str, Any]) -> list[Doubt]:
    """What is doubtful about a run with its answers, of which `facts` tell a line or shift."""
    if run.querying.loops is not None:
        return []
    asked = run.query_features if run.causal_features is None else run.causal_features
    asked, own = asked[:: run.querying.copies].cpu(), run.reference_features.cpu()
    digests = digests_of(asked, follow=False)
    known = run.model.provenance.doubts(run.model.map, digests, run.query)
    some = asked[torch.linspace(0, len(asked) - 1, min(SOME, len(asked))).round().long()]
    if not known and bool((torch.cdist(some, own, torch.inf).amin(1) <= EQUAL).all()):
        known = [Doubt("provenance", THEMSELVES)]  # of a map without a digest
    return [*_judged(run, truth, facts), *known, *_otherwise(run)]


def _otherwise(run: Localization) -> list[Doubt]:
    """How frames would be found of which few are."""
    match = run.match
    if match.probability is None:
        return []
    found = int((match.probability >= PROBABLE).sum())
    ordered = run.way is not None or source_of(run.query).ordered
    doubtful = is_doubtful(found, len(match), match.smoother)
    return second_look(run.model, run.query, ordered) if doubtful else []


def _judged(run: Localization, truth: Truth | None, facts: Mapping[str, Any]) -> list[Doubt]:
    """What makes its answers agree with the truth."""
    if run.truth is None:
        return []
    place_map = run.model.map
    match, alone = (one.renumbered(place_map.frame_of) for one in (run.match, run.judged))
    scored, right = scored_and_right(run.scored.index, run.truth, run.tolerance)
    places, tolerance = len(source_of(run.reference)), run.tolerance
    asked = Judged(match, run.query_frames, right, scored, tolerance, facts["truth"], places)
    if run.answers == "drive":
        asked = asked._replace(alone=alone.index)
    ground = ground_of(truth, source_of(run.reference), source_of(run.query), match, run.query_frames)
    return compared(asked, ground, facts)


def ground_of(
    truth: Truth | None, reference: Traverse | None, query: Traverse | None, match: Match, queries: Tensor
) -> Ground | None:
    """What a truth by coordinates compares, of answers and queries (Q,) in frames; None for another truth."""
    near = None if truth is None else check_ground_truth(truth)
    if not isinstance(near, Near) or reference is None or query is None:
        return None
    stored, own = coordinates_of([reference, query], near.kind)
    names, times = (reference.name, query.name), query.times
    second = None if times is None or len(times) < 2 else float(times[-1] - times[0]) / (len(times) - 1)
    apart = describe_distant(stored, own[queries], near, reference)
    return Ground(near, stored[match.index], own[queries], stored, own, names, second, apart)


def compared(asked: Judged, ground: Ground | None, facts: Mapping[str, Any]) -> list[Doubt]:
    """What makes answers agree with the truth; else the line or shift of most of them that `facts` tell, or
    that coordinates make none of them right."""
    doubts = contradictions(asked, ground)
    if not any(str(doubt).startswith(CONTRADICT) for doubt in doubts):
        if line := describe_line(facts, True):
            doubts.append(Doubt("line" if "line" in facts else "shift", line))
        elif ground is not None and not facts["with_answer"]:
            doubts.append(Doubt("nowhere", ground.apart))
    return doubts + ([] if ground is None else coarse(ground))


def doubt_facts(doubts: Iterable[Doubt]) -> Facts:
    """The entry `doubts` of report.json."""
    return {"doubts": [doubt._asdict() for doubt in doubts]}


def doubt_lines(facts: Mapping[str, Any]) -> list[str]:
    """The doubts of report.json in words, a line each."""
    return [str(Doubt(**doubt)) for doubt in facts.get("doubts", ())]


def contradiction(facts: Mapping[str, Any], scored: bool) -> str:
    """How answers contradict the truth, if they do; of answers that are not scored, the line of most."""
    lines = (line for line in doubt_lines(facts) if scored and line.startswith(CONTRADICT))
    return next(lines, "") or describe_line(facts, scored)
