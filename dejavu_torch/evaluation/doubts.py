"""What makes the answers doubtful: see `Doubt`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from dejavu_torch.evaluation.localization import Localization
from dejavu_torch.maps.digest import digests_of
from dejavu_torch.types import Doubt, Facts


def doubts_of(run: Localization) -> list[Doubt]:
    """What is doubtful about a run with its answers."""
    if run.querying.loops is not None:
        return []
    asked = run.query_features if run.causal_features is None else run.causal_features
    digests = digests_of(asked[:: run.querying.copies], follow=False)
    return run.model.provenance.doubts(run.model.map, digests, run.query)


def doubt_facts(doubts: Iterable[Doubt]) -> Facts:
    """The entry `doubts` of report.json."""
    return {"doubts": [doubt._asdict() for doubt in doubts]}


def doubt_lines(facts: Mapping[str, Any]) -> list[str]:
    """The doubts of report.json in words, a line each."""
    return [str(Doubt(**doubt)) for doubt in facts.get("doubts", ())]
