"""A run's scores as report.json, PNG pictures, one page a person can read, and a table for the terminal."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple

import jinja2

from dejavu_torch.data.output import whole_folder
from dejavu_torch.evaluation.answers import next_steps, told_line, told_probable
from dejavu_torch.evaluation.contenders import Contender, colour_of, distinct, sequences_as_json
from dejavu_torch.evaluation.plots import Picture
from dejavu_torch.evaluation.rejection import rejection_table
from dejavu_torch.recognition.select import PROBABLE
from dejavu_torch.text import printable

PICTURES = (
    *("frames", "pairs", "coverage", "scores", "pr", "auc", "storage", "sequences"),
    *("ground", "velocity", "chunks"),
    *("spectrogram", "templates", "features", "activations", "autocorrelogram", "layers"),
    *("spectrum", "components", "posterior", "reliability"),
)
LATE = 0.1  # recall at which a curve starts late
HEADING = 11  # letters of a line of a heading

SPECTRAL = (
    "Of every number of the descriptor the map keeps the strongest lines of its spectrum along the route, in "
    "steps of one size, and nothing else."
)
_MAIN = {"auc": "AUC", "recall_at_1": "recall@1", "recall_at_100_precision": "R@100P"}
_MORE = {
    "precision_at_100_recall": "P@100R",
    "auc_reported": "AUC rep.",
    "recall_at_100_precision_reported": "R@100P rep.",
}
_LATE = (
    f"*: this curve starts at a recall above {LATE}, since many queries share the best score; nothing to the "
    "left of that counts as area"
)


class Report(NamedTuple):
    """Everything report.json holds.

    ours: the scores that are reported, which stand at top level. contenders: entries by key, such as
    `uncompressed`, that they stand beside; there may be none. facts: the other top-level keys, of which
    `queries`, `tolerance`, `recall_definition`, `version` and `torch` must be there; the page mentions
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

    def shown(self) -> dict[str, Contender]:
        """The rows of a table by key: ours as `map`, and the others that store something else each."""
        return {"map": self.ours, **distinct(self.contenders)}

    def __repr__(self) -> str:
        """What was scored, the main scores, and what else there is, in three lines."""
        rows = score_table(self._replace(contenders={}))
        scores = ", ".join(f"{name} {value}" for name, value in zip(*rows, strict=True) if name)
        beside = f"; beside it {', '.join(self.contenders)}" if self.contenders else ""
        first = summary(self).partition(". ")[0].rstrip(".")
        line = told_line(self.facts, bool(scores))
        return "\n".join(filter(None, [first, f"{scores}{beside}", line, "all of report.json: as_json()"]))


def score_table(report: Report, every: bool = False) -> list[list[str]]:
    """The scores as rows of text, the header first; no rows where nothing is scored.

    There are bytes only where the number of frames is known.

    Args:
        every: all scores, and the bytes in total, not only the columns that matter most.
    """
    if not any(one.scores for one in report.shown().values()):
        return []
    frames, columns = report.facts.get("frames"), _MAIN | (_MORE if every else {})
    sizes = [*(["bytes"] if every else []), "bytes per place", "route bytes per place"] if frames else []
    rows = [["", *columns.values(), *sizes]]
    for one in report.shown().values():
        row = [one.name, *(f"{getattr(one.scores, field):.3f}" if one.scores else "" for field in columns)]
        row[1] += "*" * is_late(one)
        if frames:
            size = ["", "", ""]
            if one.bytes and one.route_bytes is not None:
                size = [f"{one.bytes}", f"{one.bytes / frames:.1f}", f"{one.route_bytes / frames:.1f}"]
            row += size if every else size[1:]
        rows.append(row)
    return rows


def sequence_table(report: Report) -> list[list[str]]:
    """AUC over the number T of queries matched together, as rows of text, the header first.

    No rows where single queries are matched.
    """
    found = {one.name: sequences_as_json(one.sequences) for one in report.shown().values() if one.sequences}
    for size in report.facts.get("storage", {}).get("map", ()) if found else ():
        found[f"the map in {size['route_bytes_per_place']:.3g} route bytes per place"] = size["sequences"]
    lengths = sorted({int(length) for one in found.values() for length in one})
    rows = [["AUC", *(f"T = {length}" for length in lengths)]]
    for name, one in found.items():
        areas = (one.get(f"{length}") for length in lengths)
        rows.append([name, *("" if scores is None else f"{scores['auc']:.3f}" for scores in areas)])
    return rows if found else []


def is_late(contender: Contender) -> bool:
    """Whether a curve starts so late that its area says little."""
    return (contender.starts or 0) > LATE


def text_table(rows: list[list[str]]) -> str:
    """Rows as aligned text: the first column to the left, the others to the right.

    Long headings take several lines.
    """
    if not rows:
        return ""
    headings = [wrap(cell, HEADING, break_long_words=False) for cell in rows[0]]
    height = max(1, *(len(lines) for lines in headings))
    padded = [[""] * (height - len(lines)) + lines for lines in headings]
    rows = [*(list(line) for line in zip(*padded, strict=True)), *rows[1:]]
    widths = [max(len(row[j]) for row in rows) for j in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            cell.ljust(w) if j == 0 else cell.rjust(w)
            for j, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )


def headline(report: Report) -> str:
    """What was done and how good it is, in plain words."""
    facts, scores = report.facts, report.ours.scores
    text = f"{facts['queries']} queries were looked up"
    text += f" on a map of {facts['frames']} places" if "frames" in facts else ""
    line = told_line(facts, scores is not None)
    if scores is None:
        return f"{text}. {unscored(facts)} {sentence(line)}".strip()
    text = f"{sentence(line)} {text}".strip()
    answerable = facts.get("with_answer", facts["queries"])
    some = f" Of the {answerable} that have a right place," if answerable < facts["queries"] else ""
    text += f"{'.' if some else ':'}{some} {percent(scores.recall_at_1)} were found in their right place "
    text += "(recall@1). Sorted by score, the answers have an area under the precision-recall curve "
    text += f"(AUC) of {scores.auc:.3f}; 1 is perfect."
    baseline = report.contenders.get("uncompressed")
    if baseline and baseline.scores and baseline.bytes and report.ours.bytes and "frames" in facts:
        ours, full = (size / facts["frames"] for size in (report.ours.bytes, baseline.bytes))
        spectral = facts.get("kind") == "spectral"
        text += f" {SPECTRAL}" if spectral else ""
        text += f" The map takes {ours:.0f} bytes per place"
        if spectral and report.ours.route_bytes is not None:
            text += f", {report.ours.route_bytes / facts['frames']:.3g} of them for the route: the others do "
            text += "not grow with it"
        text += f". The {'descriptors' if spectral else 'features'} as they are would take {full:.0f} "
        text += f"and find {percent(baseline.scores.recall_at_1)}."
    return text


def unscored(facts: Mapping[str, Any]) -> str:
    """What can be said of answers where nothing tells which are right, and what to do next, in sentences."""
    steps = steps_after(facts)
    if not steps:
        return (
            "There is no ground truth, so nothing is scored: see the matches and the pictures, or give one, "
            "such as --truth 12 (place = query + 12) or --truth truth.csv (rows of query,place)."
        )
    return f"{sentence(told_probable(facts['probably_right'], facts['queries']))} Next: {steps}."


def steps_after(facts: Mapping[str, Any]) -> str:
    """What to try next where nothing is scored, but probabilities are known; else ""."""
    if "probably_right" not in facts:
        return ""
    together = bool(facts.get("filter")) or facts.get("sequence", 1) > 1
    strict = facts.get("threshold") is not None or (facts.get("least_probability") or 0) > PROBABLE
    return "; ".join([*next_steps(together, strict), "--truth scores the answers"])


def sentence(text: str) -> str:
    """Words as a sentence of their own; "" stays as it is."""
    return text[:1].upper() + text[1:] + "." * (text[-1:] not in ("", "?"))


def percent(share: float) -> str:
    """A share in words that stay on one line.

    Example:
        >>> percent(0.7988)
        '79.9\\xa0%'
    """
    return f"{100 * share:.1f}\xa0%"


def summary(report: Report) -> str:
    """What was scored, in a few sentences: those that the facts allow."""
    facts = report.facts
    places = f" on {facts['frames']} places" if "frames" in facts else ""
    right = f"right within {facts['tolerance']} {facts.get('unit', 'frames')}"
    right += f" of the truth ({facts['truth']})" if facts.get("truth") else ""
    if report.ours.scores is None:
        counts = facts.get("probably_right")
        right = told_probable(counts, facts["queries"]) if counts else "nothing is scored"
    lines = [f"{facts['queries']} queries{places}; {right}"]
    if "resampling" in facts:
        step, reference, query = (
            facts["resampling"][key] for key in ("step", "reference_frames", "query_frames")
        )
        both = f"of the reference and {query} of the query" if query else "of the reference"
        lines.append(f"{reference} frames {both} were resampled to even steps of {step:.4g} pixels of ground")
    if facts.get("sequence", 1) > 1:
        speeds = facts.get("speeds") or [1.0]
        at = "" if speeds == [1.0] else f" at {' or '.join(f'{speed:g}' for speed in speeds)} places a query"
        lines.append(f"Each was matched together with the {facts['sequence'] - 1} before it{at} (--sequence)")
    if facts.get("filter"):
        lines.append("Each was matched by a filter over all queries before it (--filter)")
    if facts.get("unknown"):
        lines.append(f"{facts['queries'] - facts['unknown']} of the queries are in the truth")
    if "with_answer" in facts:
        lines.append(f"{facts['with_answer']} of the queries have a right answer")
    if facts.get("recall_at_5") is not None:
        text = f"{percent(facts['recall_at_5'])} of them have a right place among their first 5 candidates"
        ten = facts.get("recall_at_10")
        lines.append(text if ten is None else f"{text}, {percent(ten)} among the first 10")
    if facts.get("ignored"):
        lines.append(f"{facts['ignored']} report a place that counts neither as right nor as wrong")
    if "accepted_right" in facts:
        accepted = f"{facts['accepted']} are accepted, {facts['accepted_right']} correctly"
        lines.append(f"Of {facts['judged']} scored {accepted}")
    if facts.get("threshold_of_full_precision") is not None:
        threshold = facts["threshold_of_full_precision"]
        lines.append(f"Here --threshold {threshold:.9g} would accept right places only")
    error = facts.get("rejection", {}).get("expected_calibration_error")
    if error is not None:
        full = facts["rejection"]["recall_at_100_precision"]
        lines.append(
            f"Probabilities differ from the share of right answers by {error:.3f} on average (expected "
            f"calibration error); in their order R@100P is {full:.3f}"
        )
    if any(is_late(one) for one in report.shown().values()):
        lines.append(_LATE)
    if "seconds_learn" in facts:
        learning = f"Learning took {facts['seconds_learn']:.1f} s, localizing"
        took = learning if facts["seconds_learn"] else "Localizing took"
        lines.append(f"{took} {facts['seconds_localize']:.1f} s")
    return ". ".join(lines) + "."


def as_html(report: Report, pictures: Mapping[str, Picture]) -> str:
    """The table of scores and two pictures, for a notebook; nothing in it lies in another file."""
    shown = [name for name in ("pr", "coverage", "pairs") if name in pictures][:2]
    rows = [[html.escape(printable(cell)) for cell in row] for row in score_table(report)]
    table = [f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows]
    images = [
        f'<img src="{_embedded(as_png(pictures[name]))}" style="width:25rem" alt="{name}"/>' for name in shown
    ]
    text = html.escape(printable(summary(report)))
    return f"<table>{''.join(table)}</table><p>{text}</p>{''.join(images)}"


def report_folder(path: Path) -> AbstractContextManager[Path]:
    """`whole_folder` for a report and what lies beside it; pictures of an earlier report are removed.

    Raises:
        InputError: the folder cannot be made or written in.
    """
    return whole_folder(path, [f"{name}.png" for name in PICTURES])


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
        folder: one that exists, as `report_folder` gives.
        pictures: by file name without ending, one of `PICTURES`.
        title: heading of the page. command: what made it.
        plan: the plan and summary of the map in lines; None where there is no map.
    """
    pngs = {name: as_png(picture) for name, picture in pictures.items()}
    for name, data in pngs.items():
        (folder / f"{name}.png").write_bytes(data)
    facts = report.facts
    _write_page(
        folder,
        title=printable(title),
        lead=headline(report),
        notes=[summary(report)],
        rows=score_table(report),
        sequence_rows=sequence_table(report),
        sequence_colours=[
            *(colour_of(key) for key, one in report.shown().items() if one.sequences),
            *(colour_of("map") for _ in facts.get("storage", {}).get("map", ())),
        ],
        rejection_rows=rejection_table(facts.get("rejection", {})),
        every_row=score_table(report, every=True),
        contenders=report.contenders,
        facts=facts,
        colours=[colour_of(one) for one in report.shown()],
        pictures=[(picture, _embedded(pngs[name])) for name, picture in pictures.items()],
        plan=plan,
        made_by=f"{printable(command)}\ndejavu_torch {facts['version']}, torch {facts['torch']}",
    )
    text = json.dumps(report.as_json(), indent=1) + "\n"
    (folder / "report.json").write_text(text, encoding="utf-8")


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
        folder: one that exists.
        rows: of the table, the header first. notes: what a reader should know of it, a line each.
        pages: what each link says -> where it leads.
    """
    _write_page(
        folder,
        title=printable(title),
        notes=notes,
        links=pages,
        rows=rows,
        pictures=[(picture, _embedded(as_png(picture)))],
        made_by=printable(command),
    )


def as_png(picture: Picture) -> bytes:
    """The plot as the bytes of a PNG file."""
    buffer = io.BytesIO()
    picture.plot[0].savefig(buffer, format="png")
    return buffer.getvalue()


def _embedded(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def _write_page(folder: Path, **parts: Any) -> None:
    loader = jinja2.PackageLoader("dejavu_torch", "evaluation")
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    text = environment.get_template("report.html.j2").render(parts)
    # names may hold what is no text
    (folder / "index.html").write_text(text, encoding="utf-8", errors="backslashreplace")
