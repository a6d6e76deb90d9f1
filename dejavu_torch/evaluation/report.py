"""A run's figures as report.json, PNG pictures and one page a person can read."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from dejavu_torch.data.files import whole_file
from dejavu_torch.evaluation.curves import Scores, curve_of, evaluate
from dejavu_torch.evaluation.plots import Picture
from dejavu_torch.types import GroundTruth, Match

PICTURES = (
    *("frames", "pr", "auc", "coverage", "chunks", "spectrogram", "templates", "features", "activations"),
    *("autocorrelogram", "layers", "velocity", "ground"),
)
LATE = 0.1  # recall at which a curve starts late


class Contender(NamedTuple):
    """Scores of one way to store the route, and what it stores.

    k: where it stores every k-th frame. starts: the recall at which its curve starts, which is that of
    all the queries that share the best score.
    """

    name: str
    scores: Scores | None
    bytes: int | None = None
    k: int | None = None
    starts: float | None = None

    def as_json(self) -> dict[str, Any]:
        """The nested entry of report.json."""
        scores = self.scores._asdict() if self.scores else dict.fromkeys(Scores._fields)
        extra = {"bytes": self.bytes, "k": self.k, "curve_starts_at_recall": self.starts}
        return scores | {name: value for name, value in extra.items() if value is not None}


def contend(
    name: str,
    match: Match,
    truth: Tensor | GroundTruth,
    tolerance: int,
    bytes: int | None = None,
    k: int | None = None,
) -> Contender:
    """Judge matches as one contender; see `evaluate`."""
    recall = curve_of(match, truth, tolerance).recall
    starts = float(recall[0]) if len(recall) else None
    return Contender(name, evaluate(match, truth, tolerance), bytes, k, starts)


class Report(NamedTuple):
    """Everything report.json holds.

    ours: the scores that are reported, which stand at top level. contenders: entries by key, such as
    `uncompressed`, that they stand beside; there may be none. facts: the other top-level keys, of which
    `queries`, `tolerance`, `recall_definition`, `version` and `torch` must be there; the page tells of
    others, such as `frames` and `seconds_learn`, only where they are.
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
    folder: Path,
    report: Report,
    pictures: Mapping[str, Picture],
    title: str,
    command: str,
    plan: str | None = None,
) -> None:
    """Write report.json, one PNG for each picture, and index.html with all of it inside.

    Args:
        pictures: by file name without ending.
        title: heading of the page. command: what made it.
        plan: the plan and certificate in lines; None where there is no map.
    """
    shown = []
    for name, picture in pictures.items():
        buffer = io.BytesIO()
        picture.plot[0].savefig(buffer, format="png")
        shown.append(_picture(picture, buffer.getvalue()))
        with whole_file(folder / f"{name}.png") as temporary:
            temporary.write_bytes(buffer.getvalue())
    for name in set(PICTURES) - set(pictures):  # of an earlier report
        (folder / f"{name}.png").unlink(missing_ok=True)
    with whole_file(folder / "index.html") as temporary:
        temporary.write_text(_page(report, "".join(shown), title, command, plan), encoding="utf-8")
    with whole_file(folder / "report.json") as temporary:
        temporary.write_text(json.dumps(report.as_json(), indent=1) + "\n", encoding="utf-8")


_COLUMNS = {
    "auc": "AUC",
    "recall_at_1": "recall@1",
    "recall_at_100_precision": "R@100P",
    "precision_at_100_recall": "P@100R",
    "auc_reported": "AUC rep.",
    "recall_at_100_precision_reported": "R@100P rep.",
}


def score_table(report: Report) -> list[list[str]]:
    """The scores as rows of text, the header first; bytes only where the number of frames is known."""
    frames = report.facts.get("frames")
    rows = [["", *_COLUMNS.values(), *(["bytes", "per place"] if frames else [])]]
    for contender in shown(report):
        s, size = contender.scores, contender.bytes
        row = [contender.name, *(f"{getattr(s, field):.3f}" if s else "" for field in _COLUMNS)]
        if (contender.starts or 0) > LATE:
            row[1] += "*"
        if frames:
            row += [f"{size}", f"{size / frames:.1f}"] if size else ["", ""]
        rows.append(row)
    return rows


def shown(report: Report) -> list[Contender]:
    """What a table lists: ours, and the others without those that store the same frames as one before."""
    kept: list[Contender] = []
    for contender in report.contenders.values():
        if contender.k is None or (contender.k, contender.bytes) not in [(o.k, o.bytes) for o in kept]:
            kept.append(contender)
    return [report.ours, *kept]


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


def summary(report: Report) -> str:
    """What was judged, in a few sentences: those that the facts can tell."""
    facts = report.facts
    places = f" on {facts['frames']} places" if "frames" in facts else ""
    right = f"right within {facts['tolerance']} {facts.get('unit', 'frames')}"
    right += f" of the truth ({facts['truth']})" if facts.get("truth") else ""
    scored = right if report.ours.scores else "no truth was given, so nothing is scored"
    told = [f"{facts['queries']} queries{places}; {scored}"]
    if "spacing" in facts:
        step, reference, query = (
            facts["spacing"][key] for key in ("step", "reference_frames", "query_frames")
        )
        both = f" and {query} of the query were" if query else " were"
        told.append(
            f"{reference} frames of the reference{both} brought to even steps of {step:.4g} pixels of ground"
        )
    if facts.get("unknown"):
        told.append(f"{facts['queries'] - facts['unknown']} of the queries are in the truth")
    if facts.get("ignored"):
        told.append(f"{facts['ignored']} report a place that counts neither as right nor as wrong")
    if "accepted_right" in facts:
        told.append(
            f"Of {facts['judged']} judged {facts['accepted']} are accepted, {facts['accepted_right']} rightly"
        )
    if facts.get("threshold_of_full_precision") is not None:
        told.append(
            f"Here --threshold {facts['threshold_of_full_precision']:.9g} would accept right places only"
        )
    if any((contender.starts or 0) > LATE for contender in shown(report)):
        told.append(
            f"*: this curve starts at a recall above {LATE}, since many queries share the best score; what "
            "lies before is no area"
        )
    if "seconds_learn" in facts:
        told.append(
            f"Learning took {facts['seconds_learn']:.1f} s, localizing {facts['seconds_localize']:.1f} s"
        )
    return ". ".join(told) + "."


def write_index(
    folder: Path,
    rows: list[list[str]],
    notes: Sequence[str],
    picture: Picture,
    pages: Mapping[str, str],
    title: str,
    command: str,
) -> None:
    """Write index.html over several reports, with one table and one picture, and links to their pages.

    Args:
        rows: of the table, the header first. notes: lines beneath it.
        pages: what each link says -> where it leads.
    """
    head, *body = rows
    table = _row("th", head) + "".join(_row("td", row) for row in body)
    buffer = io.BytesIO()
    picture.plot[0].savefig(buffer, format="png")
    links = "".join(
        f'<li><a href="{html.escape(to)}">{html.escape(what)}</a></li>' for what, to in pages.items()
    )
    text = f"""{_top(title)}<ul>{links}</ul>
<div class="wide"><table>{table}</table></div>
{"".join(f"<p>{html.escape(note)}</p>" for note in notes)}
<p class="note">{_NOTE}</p>
{_picture(picture, buffer.getvalue())}
<h2>made by</h2><pre>{html.escape(command)}</pre></html>
"""
    with whole_file(folder / "index.html") as temporary:
        temporary.write_text(text, encoding="utf-8")


_NOTE = """
R@100P: recall at 100 % precision; P@100R: precision when every query reports; rep.: the second definition of
recall, *_reported. A curve starts at its first threshold: matches that all have one score enclose no area.
"""

_NULL_NOTE = """
Null controls learn from the reference in shuffled order, where nothing repeats. The first seeks the periods
anew, and reports nothing where no frequency passes the test for noise. The second keeps this map's layers:
what it recognises comes from how much the map stores, not from periods.
"""

_TRAINED_NOTE = """
The null control keeps the trained backbone and makes templates of the reference in shuffled order, where
nothing repeats: what it recognises does not come from periods.
"""

_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:64rem;margin:2rem auto;padding:0 1rem;color:#222}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2rem}
div.wide{overflow-x:auto}table{border-collapse:collapse;font-variant-numeric:tabular-nums}
td,th{padding:.25rem .5rem;font-size:.9rem;text-align:right;border-bottom:1px solid #ddd;white-space:nowrap}
td:first-child,th:first-child{text-align:left;white-space:normal;min-width:8rem}tr.ours{background:#eaf2fb;font-weight:600}
img{max-width:100%;height:auto}pre{background:#f6f6f6;padding:.7rem;white-space:pre-wrap;font-size:.85rem}
p.note,figcaption{color:#555;font-size:.9rem}figure{margin:0}
"""


def _page(report: Report, pictures: str, title: str, command: str, plan: str | None) -> str:
    head, *rows = score_table(report)
    facts = report.facts
    table = _row("th", head) + "".join(
        _row("td", row, " class=ours" if j == 0 else "") for j, row in enumerate(rows)
    )
    note = _NOTE + (_NULL_NOTE if "null_same_plan" in report.contenders else "")
    note += _TRAINED_NOTE if facts.get("trained") else ""
    return f"""{_top(title)}<p>{html.escape(summary(report))}</p>
<div class="wide"><table>{table}</table></div>
<p class="note">recall = {html.escape(facts["recall_definition"])}. {note}</p>
{"" if plan is None else f"<h2>the map</h2><pre>{html.escape(plan)}</pre>"}
{pictures}
<h2>made by</h2><pre>{html.escape(command)}
dejavu_torch {html.escape(str(facts["version"]))}, torch {html.escape(str(facts["torch"]))}</pre></html>
"""


def _top(title: str) -> str:
    return f"""<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width,initial-scale=1"><title>{html.escape(title)}</title>
<style>{_STYLE}</style><h1>{html.escape(title)}</h1>
"""


def _picture(picture: Picture, png: bytes) -> str:
    heading = html.escape(picture.heading)
    data = base64.b64encode(png).decode()
    return (
        f'<h2>{heading}</h2><figure><img alt="{heading}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(picture.caption)}</figcaption></figure>"
    )


def _row(tag: str, cells: list[str], attributes: str = "") -> str:
    return f"<tr{attributes}>{''.join(f'<{tag}>{html.escape(cell)}</{tag}>' for cell in cells)}</tr>"
