"""What makes the answers doubtful: see `Doubt`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from dejavu_torch.evaluation.localization import Localization
from dejavu_torch.types import Doubt, Facts


def doubts_of(run: Localization) -> list[Doubt]:
    """What is doubtful about a run with its answers."""
    return []


def doubt_facts(doubts: Iterable[Doubt]) -> Facts:
    """The entry `doubts` of report.json."""
    return {"doubts": [doubt._asdict() for doubt in doubts]}


def doubt_lines(facts: Mapping[str, Any]) -> list[str]:
    """The doubts of report.json in words, a line each."""
    return [str(Doubt(**doubt)) for doubt in facts.get("doubts", ())]
