"""The table of the paper's section V, its numbers beside ours, and what is told with it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from dejavu_torch.evaluation.plots import Picture
from dejavu_torch.evaluation.report import Report
from dejavu_torch.evaluation.score_plots import Length, plot_lengths


class Published(NamedTuple):
    """A row of the paper's section V; recall is TP / (TP + FN), None where it tells no number."""

    recall_at_100_precision_reported: float
    precision_at_100_recall: float | None
    auc_reported: float


PUBLISHED = {
    "aerial": Published(0.2064, 0.959, 0.9813),
    "outdoor": Published(0.4143, 0.9785, 0.991),
    "underground": Published(0.0032, None, 0.6998),
}
FOOTAGE = (
    "The paper's footage cannot be had: these routes are simulated after its description, so its numbers "
    "stand beside ours, not against them."
)


def route_lines(reports: Mapping[str, Report]) -> list[str]:
    """What each map holds and how long it took, a line a dataset."""
    lines = []
    for dataset, report in reports.items():
        facts = report.facts
        periods = facts["periods"]
        told = f"{len(periods)} periods from {periods[0]:g} to {periods[-1]:g}" if periods else "no periods"
        way = [share for share in facts.get("way_measured", {}).values() if share is not None]
        ground = f"; the way measured is {' and '.join(f'{share:.3f}' for share in way)} of the true one"
        lines.append(
            f"{dataset}: {facts['frames']} places, {facts['queries']} queries; {told} in "
            f"{len(facts['chunks'])} chunks, {facts['templates']} templates, {facts['map_bytes']} bytes; "
            f"learning took {facts['seconds_learn']:.0f} s, localizing {facts['seconds_localize']:.0f} s"
            + (ground if way else "")
        )
    return lines


def boundary_lines(reports: Mapping[str, Report]) -> list[str]:
    """What it costs that chunks do not end where structures do, a line a dataset that has structures."""
    lines = []
    for dataset, report in reports.items():
        told, all_ = report.facts.get("boundaries"), report.contenders
        if told:
            scores = [report.ours.scores, all_["comparable"].scores, all_["known_boundaries"].scores]
            printed, fixed, known = (_text(s and s.recall_at_1) for s in scores)
            effect = told["known_boundaries"]
            near, far = (_text(effect[f"recall_at_1_{where}"]) or "unknown" for where in ("near", "far"))
            lines.append(
                f"{dataset}: {told['cuts']} times something that repeats starts or stops. recall@1 is "
                f"{printed} as printed, {fixed} with scores that are comparable between chunks, and {known} "
                f"where chunks also end there: then {near} within {effect['near']} places of such an end "
                f"({effect['queries_near']} queries), {far} elsewhere ({effect['queries_far']})"
            )
    return lines


def section_five(reports: Mapping[str, Report]) -> list[list[str]]:
    """The table of section V, the paper's numbers beside ours, as rows of text, the header first."""
    rows = [["", "R@100P rep.", "P@100R", "AUC rep.", "AUC", "recall@1", "bytes per place"]]
    for dataset, report in reports.items():
        paper = Published(**report.facts["published"])
        rows.append(
            [f"{dataset}: the paper, its own footage", *(_text(value) for value in paper), "", "", ""]
        )
        own = report.ours._replace(name="a second traverse")
        ideal = [report.contenders[key] for key in ("ideal", "ideal_leave_out")]
        others = [c for key, c in report.contenders.items() if key not in ("ideal", "ideal_leave_out")]
        for contender in (*ideal, own, *others):
            s = contender.scores
            told = (
                [
                    s.recall_at_100_precision_reported,
                    s.precision_at_100_recall,
                    s.auc_reported,
                    s.auc,
                    s.recall_at_1,
                ]
                if s
                else [None] * 5
            )
            size = contender.bytes and f"{contender.bytes / report.facts['frames']:.0f}"
            rows.append([f"{dataset}: {contender.name}", *(_text(value) for value in told), size or ""])
    return rows


def lengths_picture(reports: Mapping[str, Report]) -> Picture:
    """Recall and bytes over the length of the chunks, a line a dataset."""
    rows = {
        name: [Length(**row) for row in report.facts["chunk_lengths"]] for name, report in reports.items()
    }
    return Picture(
        plot_lengths(rows),
        "how long should a chunk be?",
        "Recall on the second traverse, and bytes per place, of maps whose chunks have other lengths. The "
        "paper's is 1024 frames. Dotted: with the printed sum, which favours a last chunk that is shorter.",
    )


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"
