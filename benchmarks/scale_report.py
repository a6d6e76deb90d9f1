"""What `benchmarks scale` reports: rows, how they grow with the number of places, tables and pictures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.scale_contenders import GIVEN, OURS
from dejavu_torch.data.simulate.aerial import LONGEST

FITTED = 3  # sizes at least
RECALL = "recall@1"  # the panel of it
GROWING = ("bytes_per_place", "route_bytes", "seconds", "seconds_one", "peak_bytes", "learn_rate")


class ScaleRow(NamedTuple):
    """What one contender takes at one size; None where it is not known.

    places: N. seconds: of a query of a batch of `BATCH`; seconds_one: of a query by itself, the median; both
    on one thread, from the descriptor to the place. seconds_load: from the file to the first answer.
    peak_bytes: most memory while localizing beyond that of the programs, learn_peak_bytes while learning,
    each in a process of its own. bytes: of the file. route_bytes: of ours all that grows with the route, mean
    and tables with it; of an index its codes and links alone, without identifiers and codebooks. step: of the
    lines of a map that is not learned to a budget. learn_rate: descriptors a second; ours codes chunks in
    one thread, whatever `threads`, those that an index is trained and filled by. ratio_to_ours: seconds over
    those of our fastest. difference: largest to the places of the scan, of templates. device: that
    localized. bandwidth_share: of a copy's, by the bytes that a scan goes through once for each batch;
    peak_bytes are those of the device.
    """

    case: str
    contender: str
    places: int
    seconds: float | None = None
    seconds_one: float | None = None
    peak_bytes: int | None = None
    learn_peak_bytes: int | None = None
    bytes: int | None = None
    route_bytes: int | None = None
    bytes_per_place: float | None = None
    learn_rate: float | None = None
    recall_at_1: float | None = None
    auc: float | None = None
    queries: int | None = None
    threads: int | None = None
    ratio_to_ours: float | None = None
    skipped: str | None = None
    seconds_load: float | None = None
    step: float | None = None
    difference: float | None = None
    device: str | None = None
    bandwidth_share: float | None = None

    @property
    def kind(self) -> str:
        """Of the case, without its size."""
        return self.case.partition("=")[0]


def grown(rows: Iterable[ScaleRow], kind: str, key: str) -> dict[str, list[tuple[int, float]]]:
    """Of each contender a figure over N, where it tells of growth.

    Bytes that are given tell nothing. Nor does the one size at which ground that repeats ends with a whole
    cycle, beside those at which it does not.
    """
    found: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        value = getattr(row, key)
        given = key in ("bytes_per_place", "route_bytes") and row.contender in GIVEN
        whole = row.kind == "repeat" and row.places == LONGEST["repeat"]
        if row.kind == kind and value is not None and not given and not whole:
            found.setdefault(row.contender, []).append((row.places, value))
    return found


def exponents(rows: Sequence[ScaleRow]) -> dict[str, dict[str, dict[str, float]]]:
    """How each figure of each contender grows with N, by kind of case: the slope of a line in logarithms.

    Convention: a line is fitted to 3 sizes or more, of what `grown` tells.

    Example:
        >>> rows = [ScaleRow(f"places={n}", "dejavu", n, seconds=1e-6 * n**0.5) for n in (100, 400, 1600)]
        >>> round(exponents(rows)["places"]["dejavu"]["seconds"], 3)
        0.5
    """
    found: dict[str, dict[str, dict[str, float]]] = {}
    for kind in dict.fromkeys(row.kind for row in rows):
        for key in GROWING:
            for name, points in grown(rows, kind, key).items():
                above = [point for point in points if point[1] > 0]  # 0 has no logarithm
                if len(above) >= FITTED:
                    x, y = np.log(np.array(above, dtype=float)).T
                    found.setdefault(kind, {}).setdefault(name, {})[key] = float(np.polyfit(x, y, 1)[0])
    return found


def with_ratios(rows: Sequence[ScaleRow]) -> list[ScaleRow]:
    """The rows with their seconds over those of our fastest of the case."""
    fastest: dict[str, float] = {}
    for row in rows:
        if row.contender.startswith(OURS) and row.seconds:
            fastest[row.case] = min(row.seconds, fastest.get(row.case, math.inf))
    return [
        row._replace(ratio_to_ours=row.seconds / fastest[row.case])
        if row.seconds and row.case in fastest
        else row
        for row in rows
    ]


def pictured(rows: Sequence[ScaleRow]) -> dict[str, dict[str, list[tuple[float, float]]]]:
    """What is drawn over the number of places: heading -> contender -> points."""
    panels = {
        RECALL: ("places", "recall_at_1", 1.0),
        "milliseconds of a query in a batch": ("places", "seconds", 1e3),
        "MB while localizing": ("places", "peak_bytes", 1e-6),
        "route bytes of ground that repeats": ("repeat", "route_bytes", 1.0),
    }
    found = {
        heading: {
            name: [(float(places), unit * value) for places, value in points]
            for name, points in grown(rows, kind, key).items()
        }
        for heading, (kind, key, unit) in panels.items()
    }
    return {heading: lines for heading, lines in found.items() if lines}


def scale_tables(rows: Sequence[ScaleRow]) -> Iterator[tuple[str, list[list[str]]]]:
    """A table of each case, and one of the exponents: a heading and rows of text.

    Example:
        >>> next(scale_tables([ScaleRow("places=100", "dejavu", 100, bytes_per_place=1.0)]))[1][1][:2]
        ['dejavu', '1']
    """

    def text(value: float | None, form: str, unit: float = 1.0) -> str:
        return "" if value is None else format(value * unit, form)

    head = ["", "B/place", "recall@1", "AUC", "ms one", "ms of 256", "bandwidth", "s load"]
    head += ["peak MB", "learn MB", "learned/s", ""]
    for case in dict.fromkeys(row.case for row in rows):
        yield (
            case,
            [head]
            + [
                [
                    row.contender,
                    text(row.bytes_per_place, ".3g"),
                    text(row.recall_at_1, ".3f"),
                    text(row.auc, ".3f"),
                    text(row.seconds_one, ".3g", 1e3),
                    text(row.seconds, ".3g", 1e3),
                    text(row.bandwidth_share, ".1%"),
                    text(row.seconds_load, ".3g"),
                    text(row.peak_bytes, ".0f", 1e-6),
                    text(row.learn_peak_bytes, ".0f", 1e-6),
                    text(row.learn_rate, ".0f"),
                    f"skipped: {row.skipped}" if row.skipped else "",
                ]
                for row in rows
                if row.case == case
            ],
        )
    for kind, fitted in exponents(rows).items():
        yield (
            f"{kind}=N: exponents of N",
            [["", *GROWING]]
            + [[name, *(text(one.get(key), ".2f") for key in GROWING)] for name, one in fitted.items()],
        )
