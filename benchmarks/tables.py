"""Write the tables of docs and of benchmarks/results: `python -m benchmarks.tables [NAME=bench.json ...]`.

They come from json files in benchmarks/results, where a given file, also a report.json, is first stored as
NAME.json. Tables are between `<!-- table: NAME -->` and `<!-- end of table -->`, in README as well.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import groupby, product
from pathlib import Path
from statistics import mean, median
from typing import Any

from benchmarks.alike import CAPPED, CHECKED, PRECISIONS, SINGLE, UNCAPPED
from benchmarks.areas import NAMES as AREA_WAYS
from benchmarks.cross import WAYS as ANSWERED
from benchmarks.cross import summary
from benchmarks.files import NAMES as FILES
from benchmarks.headings import NAMES as HEADING_WAYS
from benchmarks.measure import Row, programs
from benchmarks.order import gains
from benchmarks.provenance import BETWEEN, FAST, NETWORK, OWN, PART, VISIT
from benchmarks.results import FOOTAGE, kept, rounded
from benchmarks.storage import SHOWN, best, by, families, missed
from benchmarks.storage_drives import drive_table
from benchmarks.teaching import COPIES, PLACED, REFINED, TOLD
from benchmarks.terrain import NAMES as TERRAIN_WAYS
from benchmarks.views import POINTED, POINTED_WITHIN, WAYS
from dejavu_torch.evaluation.baselines import every
from dejavu_torch.evaluation.contenders import LENGTHS
from dejavu_torch.recognition.calibration import POWER
from dejavu_torch.recognition.provenance import STEADY

FOLDER, DOCS = Path(__file__).parent / "results", Path(__file__).parents[1] / "docs"
README = DOCS.parent / "README.md"
MARKED = re.compile(r"(<!-- table: ([\w ,:]+) -->\n).*?(<!-- end of table -->)", re.DOTALL)
LOST = ("routes", "storage city", "storage road2", "made drives", "trainings")  # what `losses` reads
JUMPS = "stretches of 5 to 40"
CODES = {  # rows of codes of the same kind
    **{"dejavu": ("dejavu",), "null": ("null",), "dejavu, trained": ("dejavu, given maps",)},
    **{"every k-th frame": ("interpolated",), "PCA": ("PCA",), "signs": ("binary",)},
    **{"PQ, OPQ": ("PQ", "OPQ")},
    **{"RQ, LSQ, PRQ": ("RQ", "LSQ", "PRQ"), "TurboQuant": ("TurboQuant",)},
    **{"RaBitQ, EDEN": ("RaBitQ", "EDEN"), "video": ("video",)},
}


def stored(bench: dict[str, Any]) -> dict[str, Any]:
    """A bench.json without unknown values and what no table shows; a report.json becomes one of a row."""
    if "rows" not in bench:
        bench = {"rows": [kept(bench)], **programs()}
    left_out = ("equal_auc", "exponents", "seconds", "ratio_to_ours", "missed_over_best")
    rows = [{k: v for k, v in row.items() if v is not None and k not in left_out} for row in bench["rows"]]
    for row in rows:
        if "family" in row:  # of a store: the curve suffices
            recall = () if row.get("answer") == "drive" else ("recall_at_1",)
            for name in ("sequences", "bytes", "route_bytes", "peak_bytes", *recall):
                row.pop(name, None)
    facts = {name: of for name, of in bench.items() if name not in ("rows", *left_out)}
    return facts | {"rows": rounded(rows)}


def file_of(name: str) -> Path:
    return FOLDER / f"{name.replace(' ', '_')}.json"


def read(name: str) -> dict[str, Any]:
    bench: dict[str, Any] = json.loads(file_of(name).read_text(encoding="utf-8"))
    return bench


def reports(way: str) -> dict[str, Row]:
    """The rows of `benchmarks results` for a way, by footage."""
    return {row["case"]: row for row in read("routes")["rows"] if row["contender"] == way}


def markdown(rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]]) + "\n"


def area(auc: float | None) -> str:
    return "" if auc is None else f"{auc:.3f}"


def size(each: float) -> str:
    return f"{each:.1f}" if each < 10 else f"{each:.0f}"


def by_seeds(
    found: dict[str, Row], figures: Callable[[Row], Sequence[float | None]]
) -> Iterable[tuple[str, list[float | None]]]:
    """The figures of each footage, or their means over the seeds of a simulated route."""
    groups: dict[str, list[Row]] = {}
    for name in FOOTAGE:
        if name in found:
            groups.setdefault(name.partition(", seed")[0], []).append(found[name])
    for name, rows in groups.items():
        columns = zip(*map(figures, rows), strict=True)
        means = [
            None if None in column else mean(one for one in column if one is not None) for column in columns
        ]
        yield f"`{name}`" if name.startswith("sim:") else name, means


def routes() -> str:
    """The default map of each route with its null and the baselines."""
    head = ["AUC", "**map**", "null", "float", "HOG", "every k-th", "recall@1", "of HOG", "bytes", "fixed kB"]

    def figures(row: Row) -> list[float | None]:
        rivals = [row[name]["auc"] for name in ("null", "uncompressed", "hog", "hog_stride_coarsest")]
        recalls = [row["recall_at_1"], row["hog"]["recall_at_1"]]
        return [row["auc"], *rivals, *recalls, row["route_bytes_per_place"], row["fixed_bytes"] / 1000]

    forms: list[Callable[[Any], str]] = [*[area] * 7, size, "{:.0f}".format]
    rows = [
        [name, *(form(one) for form, one in zip(forms, means, strict=True))]
        for name, means in by_seeds(reports("default"), figures)
    ]
    return markdown([head, *rows])


def leaderboard() -> str:
    """The share of queries found by one image and by the whole drive."""
    known = reports("drive")  # of queries that `--ordered` says to be in order
    ways = {
        "**map**": "",
        "in 1 B": "one_byte",
        "product quantiser, every k-th": "product_quantiser",
        "float": "uncompressed",
        "HOG": "hog",
        "shuffled": "null",
    }

    def figures(row: Row) -> list[float | None]:
        found: list[float | None] = []
        for key in ways.values():
            one, told = ((of.get(key, {}) if key else of) for of in (row, known.get(row["case"], {})))
            drives = [of["sequences"]["smoother"]["recall_at_1"] for of in (one, told) if of.get("sequences")]
            found += [one.get("recall_at_1"), *(drives or [None])[:1]]
        return [*found, row["route_bytes_per_place"]]

    def shown(one: float | None, drive: float | None) -> str:
        return " / ".join(f"{100 * share:.0f}" for share in (one, drive) if share is not None)

    rows = []
    for name, means in by_seeds(reports("default"), figures):
        pairs = zip(means[:-1:2], means[1::2], strict=True)
        rows.append([name, *(shown(*pair) for pair in pairs), size(means[-1] or 0)])
    return markdown([["route", *ways, "bytes"], *rows])


def sure() -> str:
    """The share of queries that one image finds while 99 % of what is accepted is right."""
    ways = ("", "one_byte", "product_quantiser", "uncompressed", "hog", "null")
    names = ("**map**", "in 1 B", "product quantiser, every k-th", "float", "HOG", "shuffled")

    def figures(row: Row) -> list[float | None]:
        own = ((row.get(way, {}) if way else row) for way in ways)
        return [one.get("recall_at_99_precision") for one in own]

    rows = [
        [name, *(f"{100 * share:.0f}" for share in means if share is not None)]
        for name, means in by_seeds(reports("default"), figures)
        if None not in means
    ]
    return markdown([["route", *names], *rows])


def demo() -> str:
    """What `dejavu demo --drives all` finds."""
    (report,) = read("demo")["rows"]
    stride = every(report["product_quantiser"]["k"], "frame")
    names = {
        "": "**this map**",
        "one_byte": "this map in 1 byte per frame",
        "product_quantiser": f"its descriptors, {stride}, product quantiser",
        "stride": "its descriptors, every 10th frame, int8",
        "uncompressed": "its descriptors, every frame, float",
        "hog": "HOG, every frame",
        "null": "control: shuffled frames, as many bytes",
    }
    table = [["stored", "one image", "at 99 % precision", "whole drive", "bytes per frame"]]
    for key, name in names.items():
        of = report[key] if key else report
        shares = of["recall_at_1"], of["recall_at_99_precision"], of["sequences"]["smoother"]["recall_at_1"]
        shares = tuple(round(one * report["with_answer"]) / report["with_answer"] for one in shares)
        each = of.get("route_bytes", report["route_bytes"]) / report["frames"]
        form = f"{each:.1f}" if each < 100 else f"{each:,.0f}".replace(",", " ")
        table.append([name, *(f"{100 * share:.1f} %" for share in shares), form])
    return markdown(table)


def front() -> str:
    """What one image finds on the road of the demo by bytes per place, the range of the seeds in per cent."""
    shown = {0.25: "¼ byte per place", 0.5: "½", 1.0: "1", 2.0: "2", 4.0: "4"}
    ways = {"map": "**this map**", "product_quantiser": "product quantiser, codebooks free"}
    ways |= {"product_quantiser_free": "the same, codebooks of another route"}
    known = {(row["contender"], row["bytes_per_place"]): row for row in read("front")["rows"]}
    table = [["one image", *shown.values()]]
    for key, what in (("one_image", "found"), ("at_99_precision", "at 99 % precision")):
        for way, name in ways.items():
            spans = (known[way, each][f"{key}_span"] for each in shown)
            table.append(
                [f"{name}: {what}", *(f"{100 * low:.1f} to {100 * high:.1f}" for low, high in spans)]
            )
    return markdown(table)


def sizes() -> str:
    """What a file weighs, all counted."""
    table = [["places", *(f"{name}: kB" for name in FILES.values())]]
    for places, rows in groupby(read("files")["rows"], lambda row: row["places"]):
        own = {row["contender"]: row for row in rows}
        kilobytes = (f"{own[name]['bytes'] / 1e3:,.0f}".replace(",", " ") for name in FILES)
        what = {"road": "", "simulated": ", simulated", "made": ", made descriptors"}[own["map"]["route"]]
        table.append([f"{places:,}".replace(",", " ") + what, *kilobytes])
    return markdown(table)


def order() -> str:
    """What each order of single answers gains over that of their scores."""
    table = [["order, gain over the score", "AUC", "worst route", "recall at 99 % precision", "worst route"]]
    for row in gains(read("order")["rows"]):
        keys = ("auc", "worst_auc", "recall_at_99_precision", "worst_recall_at_99_precision")
        table.append([f"{row['case']}: {row['contender']}", *(f"{row[key]:+.3f}" for key in keys)])
    return markdown(table)


def ordered() -> str:
    """The routes by score, and by the confidence."""
    table = [["AUC / recall at 99 % precision", "half", "by score", "by confidence"]]
    for case, rows in groupby(read("order")["rows"], lambda row: row["case"]):
        own = {row["contender"]: row for row in rows}
        pair = [own[name] for name in ("score", f"score / elsewhere^{POWER:g}")]
        cells = (f"{area(row['auc'])} / {area(row['recall_at_99_precision'])}" for row in pair)
        table.append([f"`{case}`" if case.startswith("sim:") else case, pair[0]["half"], *cells])
    return markdown(table)


def views() -> str:
    """One image and the whole drive, as they are and by views, by how far the second camera points aside."""
    columns = ("one image", "by views", "worst", "whole drive", "by views", "worst", "shift, median error")
    table = [["mean AUC", "routes", *columns]]
    cases: list[tuple[str, str, float | None]] = [("as filmed", "default", None)]
    cases += [("as filmed, half a byte", "half a byte", None)]
    cases += [(f"cut, {100 * shift:+.0f} % of the width aside", "default", shift) for shift in POINTED]
    for name, rate, shift in cases:
        rows = [row for row in read("views")["rows"] if row["rate"] == rate and row.get("auc") is not None]
        if shift is None:
            some = [row for row in rows if row.get("shift") is None]
        else:
            cut = [row for row in rows if row.get("shift") is not None]
            some = [row for row in cut if abs(row["shift"] - shift) < POINTED_WITHIN]
        own = [[*pair] for _, pair in groupby(some, lambda row: row["case"])]
        cells = [str(len(own))]
        for key in ("auc_one", "auc"):
            each = [[{row["contender"]: row for row in pair}[way][key] for way in WAYS] for pair in own]
            cells += [area(mean(column)) for column in zip(*each, strict=True)]
            cells.append(f"{min(views - alone for alone, views in each):+.3f}")
        errors = [row["shift_error"] for row in some if row.get("shift_error") is not None and shift]
        table.append([name, *cells, f"{100 * median(errors):.1f} %" if errors else ""])
    return markdown(table)


def view_settings() -> str:
    """One image by confidence, by other steps between views and other constants of penalties: means over
    every second route, of which one would choose, and over the others; and the processor time of a query."""
    rows, cases = read("view_settings")["rows"], (("as filmed", False), ("cut", True))
    halves = [[*dict.fromkeys(row["case"] for row in rows)][first::2] for first in (0, 1)]
    table = [["mean AUC", *(f"{name}, {half}" for name, _ in cases for half in ("half", "other half")), "ms"]]
    for setting in dict.fromkeys(row["contender"] for row in rows):
        cells, own = [], [row for row in rows if row["contender"] == setting]
        for (_, cut), half in product(cases, halves):
            some = [row for row in own if row["case"] in half and ("shift" in row) == cut]
            cells.append(area(mean(row["auc_one"] for row in some)))
        steps = setting.startswith("steps")
        table.append([setting, *cells, f"{mean(row['ms'] for row in own):.1f}" if steps else ""])
    return markdown(table)


def view_loops() -> str:
    """Loops of a drive that is both visits, as they are and by views: shares of the second visit's frames."""
    keys = {"right": "right", "taken": "right and accepted", "wrong": "wrong and accepted"}
    table = [["loops", "routes", *(cell for name in keys.values() for cell in (name, "by views"))]]
    for name, shift in (("as filmed", 0.0), *((f"cut, {100 * one:+.0f} %", one) for one in POINTED[1:])):
        rows = [row for row in read("view_loops")["rows"] if ("shift" in row) == bool(shift)]
        rows = [row for row in rows if abs(row.get("shift", 0.0) - shift) < POINTED_WITHIN]
        ways = [[row for row in rows if row["contender"] == way] for way in WAYS]
        figures = (mean(row[key] for row in own) for key in keys for own in ways)
        table.append([name, str(len(ways[0])), *map(area, figures)])
    return markdown(table)


def losses() -> str:
    """Where something else finds as much as the map or more, and where what it accepts is wrong."""
    known = reports("default")
    trained, drives = (by("case", coded(name)) for name in ("trainings", "made drives"))
    (elsewhere,) = known["road, first half"]["rejection"]["off_map"].values()

    def recalls(case: str, rival: str) -> list[float | None]:
        return [of["recall_at_1"] for of in (known[case], known[case][rival])]

    def stored_in(size: float, name: str) -> list[float | None]:
        rows = families(coded(name))
        return [best(some, size) for some in (rows["dejavu"], [*rows["PQ"], *rows["OPQ"]])]

    def jumping(case: str) -> list[float | None]:
        (row,) = (row for row in drives[case] if row["contender"] == JUMPS)
        return [row["auc"], row["auc_one"]]

    def training(case: str) -> list[float | None]:
        rows = by("contender", trained[case])
        return [mean(row["auc"] for row in rows[f"{way} default"]) for way in ("trained", "untrained")]

    elsewhere_accepted = [elsewhere["accepted"]["0.9"], 0.0]
    table = [
        ("city 3, recall@1", recalls("city 3", "null"), "its frames shuffled"),
        ("railway, second half, recall@1", recalls("railway, second half", "uncompressed"), "float"),
        ("city 1, AUC in 1 B", stored_in(1, "storage city"), "product quantiser"),
        ("road, second half, AUC in 5 B", stored_in(5, "storage road2"), "product quantiser"),
        (f"floors, {JUMPS} frames in random order, AUC", jumping("floors"), "each image by itself"),
        ("city 1, features trained on it, AUC", training("city 1"), "untrained"),
        ("corridor, the same", training("corridor"), "untrained"),
        ("road, first half, frames of the other half accepted at .9", elsewhere_accepted, "accepting none"),
    ]
    return markdown(
        [["where", "this map", "better", "by"], *([a, *map(area, pair), b] for a, pair, b in table)]
    )


def descriptors() -> str:
    """The AUC of maps by descriptor."""
    ways = {"default": "HOG, `Distilled`", "HOG and pixels": "HOG, pixels", "HOG": "HOG alone"}
    columns = [
        dict(by_seeds(reports(way), lambda row: [row["auc"], row["uncompressed"]["auc"]])) for way in ways
    ]
    head = ["AUC of map, of its descriptors in float", *ways.values()]
    return markdown(
        [head, *([name, *(", ".join(map(area, column[name])) for column in columns)] for name in columns[0])]
    )


def sequences() -> str:
    """The AUC of sequences and of a filter, for the map, its null, and HOG of all frames."""
    keys = [*map(str, LENGTHS), "filter"]
    table = [["AUC of map, null, HOG", *(f"T = {key}" if key.isdigit() else key for key in keys)]]
    for name, row in (*reports("sequence").items(), *reports("visits").items()):
        each = [of["sequences"] for of in (row, row["null"], row["hog"])]
        cells = [", ".join(area(of[key]["auc"]) for of in each if key in of) for key in keys]
        seen = ", whitened by both visits to the first" if row["contender"] == "visits" else ""
        table.append([name + seen, *cells])
    return markdown(table)


def rejection(way: str = "default") -> str:
    """Precision requested and reached, right answers accepted, and frames of other places accepted."""
    table: list[list[str]] = []
    for name, row in reports(way).items():
        found = row.get("rejection", {}).get("precision")
        if not found:
            continue
        asked = [f"{one['asked']:g}" for one in found]
        distractors = [one["accepted"] for one in row["rejection"].get("off_map", {}).values()]
        if not table:
            table.append(["precision reached, right answers accepted, others accepted", *asked])
        cells = [[area(one["precision"]), area(one["kept"])] for one in found]
        cells = [
            [*cell, *(area(of[key]) for of in distractors)] for cell, key in zip(cells, asked, strict=True)
        ]
        table.append([name, *map(", ".join, cells)])
    return markdown(table)


def filtered() -> str:
    return rejection("filter")


def drives() -> str:
    """The AUC of one image, of a filter and of the whole drive, for the map, its null, and HOG."""
    ways = {"one image": None, "as it drives": "filter", "whole drive": "smoother"}
    table = [["AUC of map, null, HOG", *ways, "error", "p >= .9, right of these"]]
    for name, row in reports("drive").items():
        each = [row, row["null"], row["hog"]]
        cells = [
            ", ".join(area(of["auc"] if key is None else of["sequences"][key]["auc"]) for of in each)
            for key in ways.values()
        ]
        sure = {one["asked"]: one["precision"] for one in row["rejection"]["precision"]}
        error = area(row["drive"].get("auc_error")) if row["answers"] == "drive" else "no drive"
        table.append([name, *cells, error, area(sure[0.9])])
    return markdown(table)


def driven() -> str:
    return rejection("drive")


def coded(name: str) -> list[Row]:
    """The rows of stores, as they were before `stored`."""
    rows = read(name)["rows"]
    return [
        row | {"skipped": row.get("skipped"), "sequences": {"1": {"auc": row.get("auc")}}} for row in rows
    ]


def storage_drives() -> str:
    """The best AUC of each kind of store by bytes: by one image, a window, the whole drive."""
    return markdown(drive_table(coded("storage drives")))


def made_drives() -> str:
    """Drives made of real ones: a row for each over all routes, then the AUC of each on each route."""
    rows = by("contender", [row | {"skipped": row.get("skipped")} for row in read("made drives")["rows"]])
    cases = list(dict.fromkeys(row["case"] for own in rows.values() for row in own))
    head = ["drive", "routes", "taken for one", "one image", "not centred", "whole drive"]
    means = [[*head, "largest loss", "p > .5", "p > .9", "accepted right", "calibration error"]]
    areas = [["AUC of one image, whole drive", *cases]]

    def mean_of(own: Sequence[Row], key: str) -> str:
        return area(mean(some) if (some := [row[key] for row in own if key in row]) else None)

    for name, own in rows.items():
        known = {row["case"]: row for row in own if "auc" in row}
        loss, where = max(
            ((row["auc_one"] - row["auc"], case) for case, row in known.items()), default=(0, "")
        )
        cells = [name, str(len(own)), str(sum(row["is_drive"] for row in own))]
        cells += [mean_of(own, key) for key in ("auc_one", "auc_uncentred", "auc")]
        cells.append(f"{loss:.3f}, {where}" if loss > 0.0005 else "")
        shares = ("above_half", "above_nine_tenths", "accepted_right", "calibration_error")
        means.append([*cells, *(mean_of(own, key) for key in shares)])
        if known:
            pairs = (known.get(case) for case in cases)
            areas.append([name, *("" if row is None else shown_pair(row) for row in pairs)])
    return f"{markdown(means)}\n{markdown(areas)}"


def cross() -> str:
    """What is taken for a drive of each map, and the largest shares accepted of drives over other ground."""
    return markdown(summary([row | {"skipped": row.get("skipped")} for row in read("cross")["rows"]]))


def left(name: str = "ends") -> str:
    """Drives that leave the map, stand still, or see it otherwise: the mean and the worst route."""
    rows = [row | {"skipped": row.get("skipped")} for row in read(name)["rows"]]
    kinds = by("contender", [row for row in rows if "taken" in row])
    head = [f"{way}: {what}" for way in ANSWERED for what in ("off", "on", "wrong")]
    table = [["drive", "routes", *head]]
    for kind, own in kinds.items():
        cells = [kind, str(len(own))]
        for way in ANSWERED:
            for key, worst in ((f"{way}_off_0.5", max), (f"{way}_on_0.5", min), (f"{way}_on_wrong", max)):
                known = [row[key] for row in own if row.get(key) is not None]
                cells.append(f"{area(mean(known))} {area(worst(known))}" if known else "")
        table.append(cells)
    waits = by("contender", [row for row in rows if "loops_in_wait" in row])
    loops = [["loops within", "routes", "accepted"]]
    for kind, own in waits.items():
        loops.append([kind, str(len(own)), str(sum(row["loops_in_wait"] for row in own))])
    return f"{markdown(table)}\n{markdown(loops)}" if waits else markdown(table)


def constants() -> str:
    """What other values of the constants of evidence and fit do to whole drives."""
    table = [["constant", "AUC", "most lost", "on", "calibration error", "another route, p > .5"]]
    for row in read("chosen")["rows"]:
        lost = f"{row['lost']:.3f}" if row["lost"] > 0.0005 else ""
        figures = (row["auc"], row["calibration_error"], row["elsewhere"])
        auc, error, other = (f"{figure:.3f}" for figure in figures)
        table.append([row["contender"], auc, lost, row["lost_by"] if lost else "", error, other])
    return markdown(table)


def odometry() -> str:
    """AUC of whole drives and filters by odometry."""
    names = ("without", "noise", "too long", "null")
    table = [["AUC of drive / filter", *names]]
    for case, rows in by("case", read("odometry")["rows"]).items():
        own = {row["contender"]: row for row in rows}
        table.append([case, *(f"{own[name]['drive']:.3f} / {own[name]['filter']:.3f}" for name in names)])
    return markdown(table)


def own_copies() -> str:
    """Mean AUC of drives with the usual setting, that which is best on copies of the map's frames, and on the
    drives themselves."""
    cases = by("case", read("own_copies")["rows"])
    names = [row["contender"] for row in next(iter(cases.values()))]
    table = [["AUC (setting)", *names]]
    for case, rows in cases.items():
        table.append([case, *(f"{row['auc']:.3f} ({row['setting']})" for row in rows)])
    means = (mean(own[i]["auc"] for own in cases.values()) for i in range(len(names)))
    return markdown([*table, ["mean", *(f"{one:.3f}" for one in means)]])


def large_drives() -> str:
    """Time and memory of drives on large maps, and what they find."""
    table = [["queries, places, B per place", "one image", "whole drive", "at all places", "s", "MB"]]
    for row in read("large drives")["rows"]:
        shares = (area(row.get(key)) if key in row else "" for key in ("recall_one", "recall", "recall_all"))
        size = f"{row['queries']:,}, {row['places']:,}, {row['room']:g}"
        alone = "recall_all" not in row  # else another smoother has used the memory before
        memory = f"{row['drive_bytes'] / 1e6:.0f}" if alone else ""
        table.append([size, *shares, f"{row['drive_seconds']:.0f}", memory])
    return markdown(table)


def taught() -> str:
    """What another drive finds on maps that learned from a drive."""
    rows: dict[str, list[Row]] = {}
    for row in read("taught drives")["rows"]:
        rows.setdefault(row["case"], []).append(row)
    table = [["learned from, then asked", COPIES, PLACED, REFINED, TOLD, "placed", "right"]]
    for case, own in rows.items():
        ways = {row["contender"]: row for row in own}
        pairs = [
            "" if row is None else f"{area(row['auc'])} / {area(row['auc_by_confidence'])}"
            for row in (ways.get(way) for way in (COPIES, PLACED, REFINED, TOLD))
        ]
        placed = ways[PLACED]
        right = area(placed["right"]) if placed.get("right") is not None else ""
        table.append([case, *pairs, f"{placed['placed']} of {placed['of']}", right])
    return markdown(table)


def visits() -> str:
    """What another drive finds after more and more drives."""
    rows = read("visits")["rows"]
    most = range(1 + max(row["drives"] for row in rows))
    table = [["asked", "the map", *(f"after {count}" for count in most), "bytes"]]
    for (case, way), own in groupby(rows, lambda row: (row["case"], row["contender"])):
        found = [*own]
        cells = [area(row["auc"]) for row in found] + [""] * (len(most) - len(found))
        table.append([case, way, *cells, f"{found[0]['map_bytes']:,} → {found[-1]['map_bytes']:,}"])
    return markdown(table)


def areas() -> str:
    """Recall@1 of one image on an area by ways to store it, over their bytes."""
    found: dict[str, dict[float, str]] = {}
    for row in read("areas")["rows"]:
        whole = "".join(f"/{row[key]:.3f}" for key in ("flight_on_the_way", "flight", "survey") if key in row)
        found.setdefault(row["contender"], {})[row["bytes_per_place"]] = f"{row['recall_at_1']:.3f}{whole}"
    sizes = sorted({each for own in found.values() for each in own})
    table = [["bytes per window", *(f"{each:g}" for each in sizes)]]
    table += [[name, *(found[key].get(each, "") for each in sizes)] for key, name in AREA_WAYS.items()]
    return markdown(table)


def headings() -> str:
    """What is found of images of any heading, by the way they are turned."""
    shown = {"recall_at_1": "found", "accepted": "accepted", "accepted_wrong": "accepted although wrong"}
    table = [["images", *shown.values(), "ms per image"]]
    for row in read("headings")["rows"]:
        shares = (f"{row[key]:.3f}" for key in shown)
        table.append([HEADING_WAYS[row["contender"]], *shares, f"{row['ms']:.1f}"])
    return markdown(table)


def terrain(name: str = "terrain") -> str:
    """Time, bytes and what is found on a large area, by bytes per place."""
    found: dict[str, dict[float, Row]] = {}
    for row in read(name)["rows"]:
        found.setdefault(row.get("contender", "map"), {})[round(row["bytes_per_place"], 2)] = row
    sizes = sorted({each for own in found.values() for each in own})
    table = [["found within 1/2/5 m, by bytes per window", *(f"{each:g}" for each in sizes)]]
    for contender, of in found.items():
        for way, kind in (("one image", ""), ("a flight of 60 images", "flight_")):
            cells = []
            for each in sizes:
                row = of.get(each, {})
                keys = [f"{kind}recall_{metres}m" for metres in (1, 2, 5)]
                cells.append("/".join(f"{row[key]:.3f}" for key in keys if key in row))
            table.append([f"{TERRAIN_WAYS[contender]}: {way}", *cells])
    rows = [found["map"].get(each, {}) for each in sizes]
    told = (("learned in, s", "learn_seconds", 1), ("map file, MB", "bytes", 1e6), ("one query, ms", "ms", 1))
    for title, key, scale in told:
        table.append([title, *(f"{row[key] / scale:.3g}" if key in row else "" for row in rows)])
    return markdown(table)


def features(name: str = "features") -> str:
    """The mean AUC over seeds with further features: of one image, of the null, of the whole drive."""
    found: dict[str, dict[str, list[Row]]] = {}
    for row in read(name)["rows"]:
        found.setdefault(row["case"], {}).setdefault(row["contender"], []).append(row)
    ways = [*next(iter(found.values()))]
    kinds = {"one image": "auc_one", "null": "null", "whole drive": "auc"}
    table = [["AUC", *(f"{way}: {kind}" for way in ways for kind in kinds), "lowest and highest gain"]]
    for case, own in found.items():
        cells = [area(mean(row[key] for row in own[way])) for way in ways for key in kinds.values()]
        first, *_, last = own.values()
        gains = [b["auc_one"] - a["auc_one"] for a, b in zip(first, last, strict=True)]
        table.append([case, *cells, f"{min(gains):+.3f}, {max(gains):+.3f}"])
    return markdown(table)


def look_alikes() -> str:
    """What is accepted where places look alike, and without the limits of the map's look-alikes."""
    table = [["right of accepted at a precision of", *(f"{one:g}" for one in PRECISIONS)]]
    for case, own in by_case(lambda row: not row["case"].startswith("loops: ")).items():
        known, without = (own[way] for way in (CAPPED, UNCAPPED))
        pairs = zip(known, without, strict=True)
        table.append([case, *(one + f" ({other})" * (one != other) for one, other in pairs)])
    return markdown(table)


def loops() -> str:
    """Accepted loops of laps, and of drives that have none."""
    asked = [f"{one:g}" for one in PRECISIONS]
    table = [["right of accepted loops", *(f"{way}, {one}" for way in (SINGLE, CHECKED) for one in asked)]]
    for case, own in by_case(lambda row: row["case"].startswith("loops: ")).items():
        cells = [own[way] if len(own[way]) > 1 else [*own[way], "", ""] for way in (SINGLE, CHECKED)]
        table.append([case.removeprefix("loops: "), *cells[0], *cells[1]])
    return markdown(table)


def provenance() -> str:
    """Signs beyond two queries of second visits and of a map's own drive; what is told is bold."""
    found: dict[str, dict[str, Row]] = {}
    for row in read("provenance")["rows"]:
        if row.get("places") is not None:
            found.setdefault(row["case"], {})[row["contender"]] = row
    ways = VISIT, FAST, PART, BETWEEN
    table = [["", *ways, f"{OWN}: share of equal ones"]]
    for case, own in found.items():
        bold = ["**" * bool(own[way]["told"]) for way in ways]
        shares = [f"{own[way]['beyond']:.2f}, {own[way]['both']:.2f}" for way in ways]
        cells = [f"{star}{share}{star}" for share, star in zip(shares, bold, strict=True)]
        name = f"{case}, chosen on" if own[VISIT]["chosen"] else case
        table.append([name, *cells, f"{own[OWN]['same']:.2f}"])
    known = [row for row in read("provenance")["rows"] if row.get("correlation") is not None]
    foreign = [row["correlation"] for row in known if row["contender"].startswith(NETWORK)]
    steady = [row for row in known if row["steady"] >= STEADY]
    visits = [row["correlation"] for row in steady if row["contender"].startswith(VISIT)]
    said = f"{len(visits)} second visits {min(visits):.2f} at least"
    said += "".join(f", of {len(foreign)} pairs of networks {max(foreign):.2f} at most" for _ in foreign[:1])
    return f"{markdown(table)}\nCorrelation of means of ready descriptors: of {said}.\n"


def by_case(wanted: Callable[[Row], bool]) -> dict[str, dict[str, list[str]]]:
    """Right of accepted answers by precision, of each way in a case of `benchmarks alike`."""
    found: dict[str, dict[str, list[str]]] = {}
    for row in filter(wanted, read("alike")["rows"]):
        text = f"{row['right']} of {row['judged']}"
        text += f", {row['accepted'] - row['judged']} more" if row["accepted"] > row["judged"] else ""
        found.setdefault(row["case"], {}).setdefault(row["contender"], []).append(text)
    return found


def shown_pair(row: Row) -> str:
    """The areas of one image and of the whole drive; with a star, if that was answered by single images."""
    pair = [area(row[key]).removeprefix("0") for key in ("auc_one", "auc")]
    return " ".join(pair) + "*" * (not row["is_drive"])


def storage(name: str) -> str:
    """The best AUC of each kind of code on a route, by bytes."""
    rows = coded(f"storage {name}")
    table = [["AUC, route bytes per place", *(f"{budget:g}" for budget in SHOWN)]]
    known = families(rows)
    for kind, codes in CODES.items():
        some = [row for code in codes for row in known.get(code, ())]
        if some:
            table.append(
                [f"**{kind}**" if kind == "dejavu" else kind, *(area(best(some, one)) for one in SHOWN)]
            )
    ratio = next(iter(missed(rows).values()))
    errors = f"{100 * abs(1 - ratio):.0f} % {'fewer' if ratio < 1 else 'more'} errors"
    return (
        f"{markdown(table)}\nThe map makes {errors} than the best other code, on average over 1 to 5 bytes.\n"
    )


def trainings() -> str:
    """The mean AUC over seeds of untrained and trained maps and the nulls of these, by size."""
    sizes = ("1 B", "5 B", "default")
    table = [["AUC of untrained, **trained**, its null", "HOG", *sizes, "trained, lowest to highest"]]
    found: dict[str, dict[str, list[float]]] = {}
    for row in read("trainings")["rows"]:
        if "auc" in row:
            found.setdefault(row["case"], {}).setdefault(row["contender"], []).append(row["auc"])
    for case, own in found.items():
        cells = []
        for each in sizes:
            kinds = [own.get(f"{kind} {each}") for kind in ("untrained", "trained", "trained, null")]
            figures = [area(mean(some)) if some else "" for some in kinds]
            cells.append("{}, **{}**, {}".format(*figures))
        spread = ", ".join(
            f"{area(min(some))}-{area(max(some))}" for each in sizes if (some := own.get(f"trained {each}"))
        )
        table.append([case, area(own["HOG of all frames"][0]), *cells, spread])
    return markdown(table)


TABLES: dict[str, Callable[[], str]] = {
    **{"leaderboard": leaderboard, "sure": sure, "losses": losses, "routes": routes},
    **{"demo": demo, "front": front, "files": sizes, "order": order, "ordered": ordered},
    **{"views": views, "view_settings": view_settings, "view_loops": view_loops},
    **{"descriptors": descriptors, "sequences": sequences},
    **{"rejection": rejection, "filtered": filtered, "drives": drives, "driven": driven},
    **{"trainings": trainings, "made drives": made_drives, "storage drives": storage_drives},
    **{"cross": cross, "ends": left, "ends before": partial(left, "ends before"), "chosen": constants},
    **{"own_copies": own_copies, "odometry": odometry},
    **{
        "areas": areas,
        "headings": headings,
        "terrain": terrain,
        "terrain_400": partial(terrain, "terrain_400"),
        "large drives": large_drives,
        "taught drives": taught,
        "visits": visits,
    },
    **{name: partial(features, name) for name in ("features", "cells", "copies")},
    **{"alike": lambda: f"{look_alikes()}\n{loops()}", "provenance": provenance},
    **{f"storage {name}": partial(storage, name) for name in ("aerial", "road1", "road2", "city", "railway")},
}


def made(name: str) -> str:
    """A table, and what it was measured with."""
    if name == "losses":
        return f"{losses()}\n*{', '.join(file_of(source).name for source in LOST)}.*\n"
    source = name if file_of(name).exists() else "order" if name == "ordered" else "routes"
    facts = read(source)
    said = ", ".join(str(facts[key]) for key in ("commit", "date", "machine") if key in facts)
    if older := sorted({row["commit"] for row in facts["rows"] if "commit" in row}):
        said += f"; some rows of {', '.join(older)}"
    return f"{TABLES[name]()}\n*{file_of(source).name}: {said}.*\n"


def filled(page: str) -> str:
    """A page with its tables written again."""
    return MARKED.sub(lambda found: f"{found[1]}\n{made(found[2])}\n{found[3]}", page)


def main(given: Sequence[str]) -> None:
    for name, _, path in (word.partition("=") for word in given):
        bench = stored(json.loads(Path(path).read_text(encoding="utf-8")))
        rows = ",\n".join(json.dumps(row) for row in bench.pop("rows"))  # a line each
        file_of(name).write_text(f'{json.dumps(bench)[:-1]}, "rows": [\n{rows}\n]}}\n', encoding="utf-8")
    for page in (README, *DOCS.rglob("*.md"), *FOLDER.glob("*.md")):
        page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
