"""The report of `benchmarks scale`: rows, their growth with the number of places, tables and pictures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from benchmarks.measure import Column, Row, new_row, table
from benchmarks.scale_contenders import GIVEN
from dejavu_torch.data.simulate.aerial import LONGEST

FITTED = 3  # fewest sizes to fit
RECALL, MEMORY = "recall@1", "MB while localizing"  # names of panels
KEYS = (
    *("places", "seconds", "seconds_one", "peak_bytes", "learn_peak_bytes", "bytes", "route_bytes"),
    *("bytes_per_place", "learn_rate", "recall_at_1", "auc", "queries", "threads", "ratio_to_ours"),
    *("seconds_threads", "seconds_one_threads", "skipped", "seconds_load", "step", "difference"),
    *("device", "bandwidth_share"),
)
COLUMNS: dict[str, Column] = {
    "B/place": ("bytes_per_place", ".3g"),
    "recall@1": ("recall_at_1", ".3f"),
    "AUC": ("auc", ".3f"),
    "ms one": ("seconds_one", ".3g", 1e-3),
    "ms of 256": ("seconds", ".3g", 1e-3),
    "one, threads": ("seconds_one_threads", ".3g", 1e-3),
    "256, threads": ("seconds_threads", ".3g", 1e-3),
    "bandwidth": ("bandwidth_share", ".1%"),
    "s load": ("seconds_load", ".3g"),
    "peak MB": ("peak_bytes", ".0f", 1e6),
    "learn MB": ("learn_peak_bytes", ".0f", 1e6),
    "learned/s": ("learn_rate", ".0f"),
}
GROWING = ("bytes_per_place", "route_bytes", "seconds", "seconds_one", "peak_bytes", "learn_rate")
PANELS = {
    RECALL: ("places", "recall_at_1", 1.0),
    "milliseconds of a query in a batch": ("places", "seconds", 1e3),
    MEMORY: ("places", "peak_bytes", 1e-6),
    "route bytes of ground that repeats": ("repeat", "route_bytes", 1.0),
}


def scale_row(case: str, contender: str, places: int, **facts: Any) -> Row:
    """The figures of one contender at one size; None if unknown.

    places: N. seconds: per query in a batch of `BATCH`; seconds_one: of a single query, the median; both on
    one thread, from the descriptor to the place; seconds_threads and seconds_one_threads: on all threads.
    seconds_load: from the file to the first answer. peak_bytes: most memory while localizing, without that of
    the programs, on the device; learn_peak_bytes: while learning, each in its own process. bytes: of the
    file. route_bytes: for a map all that grows with the route, with mean and tables; for an index only its
    codes and links, without identifiers and codebooks. step: of a map that is not learned to a budget.
    learn_rate: descriptors per second; a map codes chunks in one thread, an index uses `threads`.
    ratio_to_ours: seconds over those of our fastest. difference: for templates, largest one to the places of
    the scan. device: used to localize. bandwidth_share: bytes that a scan reads per batch, over those that a
    copy moves in the same time.
    """
    return new_row(case, contender, KEYS, **{"places": places} | facts)


def kind_of(row: Row) -> str:
    """The case of a row, without its size."""
    return str(row["case"].partition("=")[0])


def grown(rows: Iterable[Row], kind: str, key: str) -> dict[str, list[tuple[int, float]]]:
    """A figure of each contender over N, if it shows growth.

    Bytes that are set do not, nor does the one size at which repeating ground ends with a whole cycle.
    """
    found: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        name, value = row["contender"], row[key]
        given = key in ("bytes_per_place", "route_bytes") and name in GIVEN
        whole = kind == "repeat" and row["places"] == LONGEST["repeat"]
        if kind_of(row) == kind and value is not None and not given and not whole:
            found.setdefault(name, []).append((row["places"], value))
    return found


def exponents(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """The exponent of N in each figure of each contender, by kind of case: the slope of a line in logarithms.

    Convention: the line is fitted to at least 3 sizes of `grown`.
    """
    found: dict[str, dict[str, dict[str, float]]] = {}
    for kind in dict.fromkeys(map(kind_of, rows)):
        for key in GROWING:
            for name, points in grown(rows, kind, key).items():
                above = [point for point in points if point[1] > 0]  # 0 has no logarithm
                if len(above) >= FITTED:
                    x, y = np.log(np.array(above, dtype=float)).T
                    found.setdefault(kind, {}).setdefault(name, {})[key] = float(np.polyfit(x, y, 1)[0])
    return found


def pictured(rows: Sequence[Row]) -> dict[str, dict[str, list[tuple[float, float]]]]:
    """The lines to draw over the number of places: heading -> contender -> points."""
    found = {}
    for heading, (kind, key, unit) in PANELS.items():
        lines = grown(rows, kind, key).items()
        found[heading] = {name: [(float(n), unit * value) for n, value in points] for name, points in lines}
    return {heading: lines for heading, lines in found.items() if lines}


def scale_tables(rows: Sequence[Row]) -> list[str]:
    """A table for each case under its heading, and one of the exponents."""
    found = []
    for case in dict.fromkeys(row["case"] for row in rows):
        found.append(
            f"{case}\n{table([row for row in rows if row['case'] == case], COLUMNS, '{contender}')}\n"
        )
    for kind, fitted in exponents(rows).items():
        lines = [new_row(kind, name, GROWING, **one) for name, one in fitted.items()]
        figures = table(lines, {key: (key, ".2f") for key in GROWING}, "{contender}")
        found.append(f"{kind}=N: exponents of N\n{figures}\n")
    return found
