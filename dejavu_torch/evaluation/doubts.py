"""What makes the answers doubtful: see `Doubt`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from dejavu_torch.evaluation.localization import Localization
from dejavu_torch.evaluation.second_look import is_doubtful, second_look
from dejavu_torch.motion.resampling import source_of
from dejavu_torch.recognition.select import PROBABLE
from dejavu_torch.types import Doubt, Facts


def doubts_of(run: Localization) -> list[Doubt]:
    """What is doubtful about a run with its answers."""
    match = run.match
    if run.querying.loops is not None or match.probability is None:
        return []
    found = int((match.probability >= PROBABLE).sum())
    ordered = run.way is not None or source_of(run.query).ordered
    doubtful = is_doubtful(found, len(match), match.smoother)
    return second_look(run.model, run.query, ordered) if doubtful else []


def doubt_facts(doubts: Iterable[Doubt]) -> Facts:
    """The entry `doubts` of report.json."""
    return {"doubts": [doubt._asdict() for doubt in doubts]}


def doubt_lines(facts: Mapping[str, Any]) -> list[str]:
    """The doubts of report.json in words, a line each."""
    return [str(Doubt(**doubt)) for doubt in facts.get("doubts", ())]
