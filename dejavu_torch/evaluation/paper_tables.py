"""The table of the paper's section V with its figures and ours, and the notes below it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:  # the command line needs the names of the datasets without matplotlib
    from dejavu_torch.evaluation.report import Report


class Published(NamedTuple):
    """A row of the paper's section V; recall is TP / (TP + FN). None: not in the paper."""

    recall_at_100_precision_reported: float
    precision_at_100_recall: float | None
    auc_reported: float


PUBLISHED = {
    "aerial": Published(0.2064, 0.959, 0.9813),
    "outdoor": Published(0.4143, 0.9785, 0.991),
    "underground": Published(0.0032, None, 0.6998),
}
COLUMNS = {
    "recall_at_100_precision_reported": "R@100P rep.",
    "precision_at_100_recall": "P@100R",
    "auc_reported": "AUC rep.",
    "auc": "AUC",
    "recall_at_1": "recall@1",
}
IDEAL = ("ideal", "ideal_leave_out")
FOOTAGE = (
    "The paper's footage is not available. These routes are simulated from its description; its figures are "
    "shown for comparison only."
)


def section_five(reports: Mapping[str, Report]) -> list[list[str]]:
    """The table of section V with the paper's figures and ours, as rows of text, the header first."""
    rows = [["", *COLUMNS.values(), "bytes per place"]]
    for dataset, report in reports.items():
        paper = [_text(report.facts["published"].get(field)) for field in COLUMNS]
        rows.append([f"{dataset}: the paper, its own footage", *paper, ""])
        own = report.ours._replace(name="a second visit")
        others = [one for key, one in report.contenders.items() if key not in IDEAL]
        for one in (*(report.contenders[key] for key in IDEAL), own, *others):
            scores = [_text(getattr(one.scores, field, None)) for field in COLUMNS]
            size = f"{one.bytes / report.facts['frames']:.0f}" if one.bytes else ""
            rows.append([f"{dataset}: {one.name}", *scores, size])
    return rows


def route_lines(reports: Mapping[str, Report]) -> list[str]:
    """The content of each map and the time it took, a line for each dataset."""
    lines = []
    for dataset, report in reports.items():
        facts = report.facts
        periods = facts["periods"]
        found = f"{len(periods)} periods from {periods[0]:g} to {periods[-1]:g}" if periods else "no periods"
        line = (
            f"{dataset}: {facts['frames']} places, {facts['queries']} queries; {found} in "
            f"{len(facts['chunks'])} chunks, {facts['templates']} templates, {facts['map_bytes']} bytes; "
            f"learning took {facts['seconds_learn']:.0f} s, localizing {facts['seconds_localize']:.0f} s"
        )
        shares = [f"{share:.3f}" for share in facts.get("measured_distance", {}).values() if share]
        if shares:
            line += f"; the measured distance along the ground is {' and '.join(shares)} of the true one"
        lines.append(line)
    return lines


def boundary_lines(reports: Mapping[str, Report]) -> list[str]:
    """The cost of chunks that do not end where structures end, a line for each dataset with structures."""
    lines = []
    for dataset, report in reports.items():
        boundaries = report.facts.get("boundaries")
        if not boundaries:
            continue
        maps = report.ours, report.contenders["comparable"], report.contenders["known_boundaries"]
        printed, fixed, known = (_text(one.scores.recall_at_1 if one.scores else None) for one in maps)
        effect = boundaries["known_boundaries"]
        near, far = (_text(effect[f"recall_at_1_{where}"]) or "unknown" for where in ("near", "far"))
        lines.append(
            f"{dataset}: repeating structures start or stop at {boundaries['cuts']} places. recall@1 is "
            f"{printed} as printed, {fixed} with scores that are comparable between chunks, and {known} "
            f"if chunks also end there: {near} within {effect['near']} places of an end "
            f"({effect['queries_near']} queries), {far} elsewhere ({effect['queries_far']})"
        )
    return lines


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"
