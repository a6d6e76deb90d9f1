"""A run's figures as report.json, PNG pictures and one page a person can read."""

from __future__ import annotations

import base64
import csv
import html
import io
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from dejavu_torch.data.files import whole_file
from dejavu_torch.evaluation.curves import Scores
from dejavu_torch.evaluation.plots import Plot
from dejavu_torch.types import Match


class Contender(NamedTuple):
    """Scores of one way to store the route, and what it stores; k where it stores every k-th frame."""

    name: str
    scores: Scores | None
    bytes: int | None = None
    k: int | None = None

    def as_json(self) -> dict[str, Any]:
        """The nested entry of report.json."""
        scores = self.scores._asdict() if self.scores else dict.fromkeys(Scores._fields)
        extra = {"bytes": self.bytes, "k": self.k}
        return scores | {name: value for name, value in extra.items() if value is not None}


class Report(NamedTuple):
    """Everything report.json holds.

    ours: the map's scores, which stand at top level. contenders: entries by key, such as
    `uncompressed`. facts: the other top-level keys, such as `frames` and `map_bytes`.
    """

    ours: Contender
    contenders: Mapping[str, Contender]
    facts: Mapping[str, Any]

    def as_json(self) -> dict[str, Any]:
        """report.json as a mapping."""
        scores = self.ours._replace(bytes=None).as_json()
        nested = {key: contender.as_json() for key, contender in self.contenders.items()}
        return dict(self.facts) | scores | nested


def write_report(
    folder: Path, report: Report, pictures: Mapping[str, Plot], title: str, command: str, plan: str
) -> None:
    """Write report.json, one PNG for each picture, and index.html with all of it inside.

    Args:
        pictures: file name without ending -> (figure, axes).
        plan: the plan and certificate in lines.
    """
    images = {}
    for name, (figure, _) in pictures.items():
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
        images[name] = buffer.getvalue()
        with whole_file(folder / f"{name}.png") as temporary:
            temporary.write_bytes(images[name])
    with whole_file(folder / "index.html") as temporary:
        temporary.write_text(_page(report, images, title, command, plan), encoding="utf-8")
    with whole_file(folder / "report.json") as temporary:
        temporary.write_text(json.dumps(report.as_json(), indent=1) + "\n", encoding="utf-8")


def write_matches(path: Path, matches: Iterable[Match]) -> tuple[int, int]:
    """Write query,place,score,accepted for matches that come in parts; (queries, accepted) written."""
    total = accepted = 0
    with whole_file(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["query", "place", "score", "accepted"])
        for match in matches:
            rows = zip(match.index.tolist(), match.score.tolist(), match.accepted.tolist(), strict=True)
            for place, score, good in rows:
                writer.writerow([total, place, f"{score:.9g}", int(good)])
                total += 1
                accepted += good
    return total, accepted


_COLUMNS = {
    "auc": "AUC",
    "recall_at_1": "recall@1",
    "recall_at_100_precision": "R@100P",
    "precision_at_100_recall": "P@100R",
    "auc_reported": "AUC rep.",
    "recall_at_100_precision_reported": "R@100P rep.",
}


def score_table(report: Report) -> list[list[str]]:
    """The scores as rows of text, the header first."""
    places = max(1, report.facts["frames"])
    rows = [["", *_COLUMNS.values(), "bytes", "per place"]]
    for contender in (report.ours, *report.contenders.values()):
        s = contender.scores
        size = [f"{contender.bytes}", f"{contender.bytes / places:.1f}"] if contender.bytes else ["", ""]
        figures = [getattr(s, field) for field in _COLUMNS] if s else []
        rows.append(
            [
                contender.name,
                *(f"{value:.3f}" for value in figures),
                *[""] * (len(_COLUMNS) - len(figures)),
                *size,
            ]
        )
    return rows


def text_table(rows: list[list[str]]) -> str:
    """Rows as aligned text: the first column to the left, the others to the right."""
    widths = [max(len(row[j]) for row in rows) for j in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            cell.ljust(w) if j == 0 else cell.rjust(w)
            for j, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )


_HEADINGS = {
    "pr": "precision and recall",
    "coverage": "places reported",
    "chunks": "periods found along the route",
    "activations": "two layers and their fusion",
}

_NOTE = """
R@100P: recall at 100 % precision; P@100R: precision when every query reports; rep.: the second definition of
recall. A curve starts at its first threshold: matches that all have one score enclose no area. Null controls
learn from the reference in shuffled order, where nothing repeats. The first seeks the periods anew, and
reports nothing where no frequency passes the test for noise. The second keeps this map's layers: what it
recognises comes from how much the map stores, not from periods.
"""

_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:64rem;margin:2rem auto;padding:0 1rem;color:#222}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem}
div.wide{overflow-x:auto}table{border-collapse:collapse;font-variant-numeric:tabular-nums}
td,th{padding:.25rem .5rem;font-size:.9rem;text-align:right;border-bottom:1px solid #ddd;white-space:nowrap}
td:first-child,th:first-child{text-align:left}tr.ours{background:#eaf2fb;font-weight:600}
img{max-width:100%;height:auto}pre{background:#f6f6f6;padding:.7rem;white-space:pre-wrap;font-size:.85rem}
p.note{color:#555;font-size:.9rem}
"""


def _page(report: Report, images: Mapping[str, bytes], title: str, command: str, plan: str) -> str:
    head, *rows = score_table(report)
    facts = report.facts
    table = _row("th", head) + "".join(
        _row("td", row, " class=ours" if j == 0 else "") for j, row in enumerate(rows)
    )
    pictures = "".join(
        f'<h2>{_HEADINGS.get(name, name)}</h2><img alt="{_HEADINGS.get(name, name)}" '
        f'src="data:image/png;base64,{base64.b64encode(data).decode()}">'
        for name, data in images.items()
    )
    right = f"right within {facts['tolerance']} frames."
    scored = right if report.ours.scores else "no truth was given, so nothing is scored."
    return f"""<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width,initial-scale=1"><title>{html.escape(title)}</title>
<style>{_STYLE}</style><h1>{html.escape(title)}</h1>
<p>{facts["queries"]} queries on {facts["frames"]} places; {scored}
Learning took {facts["seconds_learn"]:.1f} s, localizing {facts["seconds_localize"]:.1f} s.</p>
<div class="wide"><table>{table}</table></div>
<p class="note">recall = {html.escape(facts["recall_definition"])}. {_NOTE}</p>
<h2>the map</h2><pre>{html.escape(plan)}</pre>
{pictures}
<h2>made by</h2><pre>{html.escape(command)}
dejavu_torch {html.escape(str(facts["version"]))}, torch {html.escape(str(facts["torch"]))}</pre></html>
"""


def _row(tag: str, cells: list[str], attributes: str = "") -> str:
    return f"<tr{attributes}>{''.join(f'<{tag}>{html.escape(cell)}</{tag}>' for cell in cells)}</tr>"
