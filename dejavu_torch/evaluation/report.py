"""The report of a run: report.json, PNG pictures, an HTML page, and a table for the terminal."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import zip_longest
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple

from dejavu_torch.data.output import whole_folder
from dejavu_torch.evaluation.answers import describe_probable, next_steps
from dejavu_torch.evaluation.contenders import Contender, colour_of, distinct, sequences_as_json
from dejavu_torch.evaluation.doubts import contradiction, doubt_lines
from dejavu_torch.evaluation.plots import Picture, Pictures
from dejavu_torch.evaluation.prose import sentences, templates
from dejavu_torch.evaluation.rejection import rejection_table
from dejavu_torch.recognition.select import PROBABLE
from dejavu_torch.text import printable
from dejavu_torch.types import Facts, Together

PICTURES = (
    *("frames", "examples", "pairs", "coverage", "scores", "pr", "storage", "sequences"),
    *("ground", "velocity", "chunks"),
    *("spectrogram", "templates", "features", "activations", "autocorrelogram", "layers"),
    *("posterior", "reliability"),
)
FOLDED = {"sequences", "posterior", "spectrogram", "autocorrelogram", "layers", "chunks"}  # on the page
LATE = 0.1  # a curve that starts at a higher recall starts late
SHORT = ("map", "one_byte", "stride", "product_quantiser", "hog", "null")  # rows of a short table
FULL = 0.99  # share of a drive from which a control tells nothing
HEADING = 11  # letters in a line of a heading

_MAIN = {"auc": "AUC", "recall_at_1": "recall@1", "recall_at_99_precision": "R@99P"}
_WAYS: dict[Together, str] = {1: "AUC, one image", "filter": "as it drives", "smoother": "whole drive"}
_MORE = {
    "recall_at_100_precision": "R@100P",
    "precision_at_100_recall": "P@100R",
    "auc_reported": "AUC rep.",
    "recall_at_100_precision_reported": "R@100P rep.",
}


class Report(NamedTuple):
    """The content of report.json.

    ours: the scores at top level. contenders: the nested entries by key, such as `uncompressed`; may be
    empty. facts: the other top-level keys. `queries`, `tolerance`, `recall_definition`, `version` and `torch`
    are required; others, such as `frames` and `seconds_learn`, are optional on the page.
    """

    ours: Contender
    contenders: Mapping[str, Contender]
    facts: Mapping[str, Any]

    def as_json(self) -> Facts:
        """report.json as a mapping."""
        scores = self.ours._replace(bytes=None).as_json()
        nested = {key: contender.as_json() for key, contender in self.contenders.items()}
        return dict(self.facts) | scores | nested

    def shown(self) -> dict[str, Contender]:
        """The rows of a table by key: ours as `map`, and the distinct others."""
        return {"map": self.ours, **distinct(self.contenders)}

    def __repr__(self) -> str:
        """The first sentence of the summary, the main scores, and the other contenders."""
        rows = score_table(self._replace(contenders={}))
        scores = ", ".join(f"{name} {value}" for name, value in zip(*rows[:2], strict=True) if name)
        others = f"; compared with {', '.join(self.contenders)}" if self.contenders else ""
        first = summary(self).partition(". ")[0].rstrip(".")
        line = "" if scores else contradiction(self.facts, False)
        lines = [first, f"{scores}{others}", line, *doubt_lines(self.facts), "all of report.json: as_json()"]
        return "\n".join(filter(None, lines))


def score_table(report: Report, every: bool = False) -> list[list[str]]:
    """The scores as rows of text, the header first, with bytes if the number of frames is known."""
    if not any(one.scores for one in report.shown().values()):
        return []
    frames = report.facts.get("frames")
    ways = _ways(report)  # of which "auc" is named by the first
    columns = ways | {
        field: name for field, name in (_MAIN | (_MORE if every else {})).items() if field not in ways
    }
    sizes = [*(["bytes"] if every else []), "bytes per place", "route bytes per place"] if frames else []
    rows = [["", *columns.values(), *sizes]]
    for one in report.shown().values():
        known = (one.scores._asdict() if one.scores else {}) | {
            T: scores.auc for T, scores in one.by_length.items()
        }
        row = [one.name, *(f"{known[field]:.3f}" if field in known else "" for field in columns)]
        row[1] += "*" * is_late(one)
        if frames:
            size = ["", "", ""]
            if one.bytes and one.route_bytes is not None:
                size = [f"{one.bytes}", f"{one.bytes / frames:.1f}", f"{one.route_bytes / frames:.1f}"]
            row += size if every else size[1:]
        rows.append(row)
    return rows


def _ways(report: Report) -> dict[Together | str, str]:
    """The columns of the areas of single queries, a filter and a smoother; empty with only the first."""
    found = {T for one in report.shown().values() for T in one.by_length}
    ways: dict[Together | str, str] = {T: name for T, name in _WAYS.items() if T in found}
    single = report.facts.get("sequence", 1) == 1 and not report.facts.get("filter")
    if len(ways) < 2:
        return {}
    return {"auc": ways.pop(1), **ways} if single and 1 in ways else ways


def _in_bytes(route: float) -> str:
    """The name of the map coded at another size."""
    return f"the map in {route:.2g} route byte{'s' * (round(route, 1) != 1)} per place"


def found_lines(report: Report) -> list[str]:
    """What was found, and of what size; empty without ground truth."""
    facts, ours, frames = report.facts, report.ours, report.facts["frames"]
    if ours.scores is None:
        return []
    drive, count = ours.sequences.get("smoother"), facts["with_answer"]
    accepted, right = facts["accepted"], facts["accepted_right"]
    taken = [
        f"{what} {number} frames in {facts[seconds]:.1f} s ({1e3 * facts[seconds] / number:.1f} ms each)"
        for what, number, seconds in (
            ("learned", frames, "seconds_learn"),
            ("searched", facts["queries"], "seconds_localize"),
        )
        if facts[seconds]
    ]
    answered = drive if drive and facts["answers"] == "drive" else ours.scores
    unit = facts["unit"].rstrip("s")
    tolerance = f"{facts['tolerance']} {unit}{'s' * (facts['tolerance'] != 1)}"
    by_image = f" by the whole drive, {round(ours.scores.recall_at_1 * count)} by one image"
    size = f"{ours.fixed / 1e3:.0f} kB + {(ours.route_bytes or 0) / frames:.1f} bytes per {_one(facts)}"
    return [
        ", ".join(taken),
        f"FOUND {round(answered.recall_at_1 * count)} of {count} within {tolerance}"
        + by_image * (answered is not ours.scores),
        f"accepted and right {right}, accepted and wrong {accepted - right}, "
        f"not accepted {facts.get('judged', facts['queries']) - accepted}",
        f"map file: {size}",
    ]


def compared_lines(report: Report) -> list[str]:
    """A short table of the map beside other ways to store the route."""
    frames, drive = report.facts["frames"], report.ours.sequences.get("smoother")
    headings = ["one image", "at 99 % precision", *(["whole drive"] if drive else [])]
    rows = [["found by", *headings, f"bytes per {_one(report.facts)}"]]
    for key in SHORT:
        if (contender := report.shown().get(key)) is None or contender.scores is None:
            continue
        single, whole = contender.by_length.get(1, contender.scores), contender.sequences.get("smoother")
        shares = [single.recall_at_1, single.recall_at_99_precision, whole and whole.recall_at_1]
        cells = ["" if share is None else f"{share:.1%}" for share in shares[: len(headings)]]
        size = "" if contender.route_bytes is None else f"{contender.route_bytes / frames:.1f}"
        rows.append([contender.name, *cells, size])
    lines = text_table(rows).splitlines()
    control = report.contenders["null"].sequences.get("smoother") if "null" in report.contenders else None
    if drive and control and control.recall_at_1 >= FULL * drive.recall_at_1:
        lines.append("Matched as a whole drive, even the control is found: compare 'one image' and bytes.")
    return lines


def _one(facts: Mapping[str, Any]) -> str:
    """The word for a place."""
    return "window" if "area" in facts else str(facts["unit"]).rstrip("s")


def sequence_table(report: Report) -> list[list[str]]:
    """AUC by the number T of queries matched together, and of a filter; empty without sequences."""
    found = {one.name: sequences_as_json(one.by_length) for one in report.shown().values() if one.sequences}
    for size in report.facts.get("storage", {}).get("map", ()):
        if "sequences" in size:
            found[_in_bytes(size["route_bytes_per_place"])] = size["sequences"]
    keys = {key for one in found.values() for key in one} - {"filter", "smoother"}  # in the table of scores
    lengths = sorted(keys, key=int)
    rows = [["AUC", *(f"T = {key}" for key in lengths)]]
    for name, one in found.items():
        areas = (one.get(key) for key in lengths)
        rows.append([name, *("" if scores is None else f"{scores['auc']:.3f}" for scores in areas)])
    return rows if len(lengths) > 1 else []


def is_late(contender: Contender) -> bool:
    """Whether a curve starts so late that its area says little."""
    return (contender.starts or 0) > LATE


def text_table(rows: list[list[str]]) -> str:
    """Rows as aligned text, the first column to the left, the others to the right, with wrapped headings."""
    if not rows:
        return ""
    headings = [wrap(cell, HEADING, break_long_words=False)[::-1] for cell in rows[0]]
    lines = [*reversed([*zip_longest(*headings, fillvalue="")]), *rows[1:]]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join([line[0].ljust(widths[0]), *map(str.rjust, line[1:], widths[1:])]) for line in lines
    )


def summary(report: Report) -> str:
    """The counts, thresholds and times in a few sentences."""
    return _sentences(report, "summary")


def verdict(report: Report) -> str:
    """Whether it worked, in a sentence or two."""
    return _sentences(report, "verdict")


def steps(report: Report) -> list[str]:
    """What to do next, one sentence each."""
    return [step.strip() for step in _sentences(report, "next").split("¶") if step.strip()]


def _sentences(report: Report, part: str) -> str:
    facts, scores = report.facts, report.ours.scores
    counts = facts.get("probably_right")
    return sentences(
        "sentences.html.j2",
        part=part,
        facts=facts,
        ours=report.ours,
        scores=scores,
        baseline=report.contenders.get("uncompressed"),
        line=contradiction(facts, scores is not None),
        probable=describe_probable(counts, facts["queries"]) if counts else "",
        likely=counts[f"{PROBABLE:g}"] / max(1, facts["queries"]) if counts else None,
        steps=steps_after(facts),
        late=any(is_late(one) for one in report.shown().values()),
        late_recall=LATE,
    )


def steps_after(facts: Mapping[str, Any]) -> str:
    """What to try next if there are probabilities; else ""."""
    if "probably_right" not in facts:
        return ""
    together = bool(facts.get("filter") or facts.get("drive")) or facts.get("sequence", 1) > 1
    strict = facts.get("threshold") is not None or (facts.get("least_probability") or 0) > PROBABLE
    return "; ".join([*next_steps(together, strict), "--truth evaluates the answers"])


def as_html(report: Report, pictures: Pictures) -> str:
    """The table of scores and two pictures for a notebook, without references to other files."""
    shown = [name for name in ("pr", "coverage", "pairs") if name in pictures][:2]
    page = templates(page=True).get_template("report.html.j2").module
    table = page.table_of(score_table(report)) if report.ours.scores else ""  # type: ignore[attr-defined]
    style = 'style="width:25rem"'
    images = [f'<img src="{_embedded(as_png(pictures[name]))}" {style} alt="{name}"/>' for name in shown]
    text = html.escape(printable(summary(report)))
    return f"{table}<p>{text}</p>{''.join(images)}"


def report_folder(path: Path) -> AbstractContextManager[Path]:
    """`whole_folder` for a report, without figures and pictures of an earlier one; an InputError if not
    writable."""
    return whole_folder(path, ["report.json", *(f"{name}.png" for name in PICTURES)])


def write_report(
    folder: Path,
    report: Report,
    pictures: Pictures,
    title: str,
    command: str,
    plan: str | None = None,
    complete: bool = True,
) -> None:
    """Write report.json, unless it is not `complete`, a PNG for each picture, and index.html, which contains
    all of these."""
    facts, shown, embedded = report.facts, report.shown(), {}
    for name, picture in pictures.items():
        data = as_png(picture)
        (folder / f"{name}.png").write_bytes(data)
        embedded[name] = (picture, _embedded(data))
    first = next((name for name in ("examples", "pairs", "coverage") if name in embedded), "")
    coded = ["map" for size in facts.get("storage", {}).get("map", ()) if "sequences" in size]
    sequenced = [*(key for key, one in shown.items() if one.sequences), *coded]
    _write_page(
        folder,
        title=printable(title),
        verdict=verdict(report),
        doubts=doubt_lines(facts),
        summary=summary(report),
        steps=steps(report),
        first=embedded.pop(first, None),
        rows=score_table(report),
        colours=[colour_of(key) for key in shown],
        sequence_rows=sequence_table(report),
        sequence_colours=[colour_of(key) for key in sequenced],
        rejection_rows=rejection_table(facts.get("rejection", {})),
        every_row=score_table(report, every=True),
        contenders=report.contenders,
        facts=facts,
        pictures=[shown for name, shown in embedded.items() if name not in FOLDED],
        more_pictures=[shown for name, shown in embedded.items() if name in FOLDED],
        plan=plan,
        made_by=f"{printable(command)}\ndejavu_torch {facts['version']}, torch {facts['torch']}",
        pending=not complete,
    )
    if complete:
        text = json.dumps(report.as_json(), indent=1) + "\n"
        (folder / "report.json").write_text(text, encoding="utf-8")


def write_index(
    folder: Path,
    rows: list[list[str]],
    notes: Sequence[str],
    pages: Mapping[str, str],
    title: str,
    command: str,
) -> None:
    """Write the index.html of several reports, with one table, and links to their pages."""
    parts = {"title": printable(title), "notes": notes, "links": pages, "rows": rows}
    _write_page(folder, **parts, made_by=printable(command))


def as_png(picture: Picture) -> bytes:
    """The plot as the bytes of a PNG file."""
    buffer = io.BytesIO()
    picture.plot[0].savefig(buffer, format="png")
    return buffer.getvalue()


def _embedded(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def _write_page(folder: Path, **parts: Any) -> None:
    text = templates(page=True).get_template("report.html.j2").render(parts)
    # names may hold bytes that are not text
    (folder / "index.html").write_text(text, encoding="utf-8", errors="backslashreplace")
