"""What `dejavu bench scale` reports: rows, how they grow with the number of places, tables and pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from dejavu_torch.experiments.scale_contenders import OURS

GROWING = ("bytes_per_place", "route_bytes", "seconds", "seconds_one", "peak_bytes", "learn_rate")


class ScaleRow(NamedTuple):
    """What one contender takes at one size; None where it is not known.

    places: N. seconds: of a query of a batch of `BATCH`; seconds_one: of a query by itself, the median; both
    on one thread, from the descriptor to the place. peak_bytes: most memory while localizing beyond that of
    the programs, learn_peak_bytes while learning, each in a process of its own. bytes: of the file.
    route_bytes: of ours all that grows with the route, mean and tables with it; of an index its codes and
    links alone, without identifiers and codebooks. learn_rate: descriptors a second. ratio_to_ours: seconds
    over those of our fastest. threads: that learned.
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


def exponents(rows: Sequence[ScaleRow]) -> dict[str, dict[str, dict[str, float]]]:
    """How each figure of each contender grows with N, by kind of case: the slope of a line in logarithms.

    Example:
        >>> rows = [ScaleRow(f"places={n}", "dejavu", n, seconds=1e-6 * n**0.5) for n in (100, 10_000)]
        >>> round(exponents(rows)["places"]["dejavu"]["seconds"], 3)
        0.5
    """
    found: dict[str, dict[str, dict[str, float]]] = {}
    kinds = {(row.case.partition("=")[0], row.contender): None for row in rows}
    for kind, name in kinds:
        own = [row for row in rows if row.contender == name and row.case.partition("=")[0] == kind]
        for key in GROWING:
            points = [(row.places, getattr(row, key)) for row in own if getattr(row, key)]
            if len(points) > 1:
                x, y = np.log(np.array(points, dtype=float)).T
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
        "recall@1": ("places", "recall_at_1", 1.0),
        "milliseconds of a query in a batch": ("places", "seconds", 1e3),
        "MB while localizing": ("places", "peak_bytes", 1e-6),
        "route bytes of ground that repeats": ("repeat", "route_bytes", 1.0),
    }
    found: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for heading, (kind, key, unit) in panels.items():
        for row in rows:
            value = getattr(row, key)
            if value and row.case.partition("=")[0] == kind:
                found.setdefault(heading, {}).setdefault(row.contender, []).append((row.places, unit * value))
    return found


def scale_tables(rows: Sequence[ScaleRow]) -> Iterator[tuple[str, list[list[str]]]]:
    """A table of each case, and one of the exponents: a heading and rows of text.

    Example:
        >>> next(scale_tables([ScaleRow("places=100", "dejavu", 100, bytes_per_place=1.0)]))[1][1][:2]
        ['dejavu', '1']
    """

    def text(value: float | None, form: str, unit: float = 1.0) -> str:
        return "" if value is None else format(value * unit, form)

    head = ["", "B/place", "recall@1", "AUC", "ms one", "ms of 256", "peak MB", "learn MB", "learned/s", ""]
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
                    text(row.peak_bytes, ".0f", 1e-6),
                    text(row.learn_peak_bytes, ".0f", 1e-6),
                    text(row.learn_rate, ".0f"),
                    f"skipped: {row.skipped}" if row.skipped else "",
                ]
                for row in rows
                if row.case == case
            ],
        )
    for kind, grown in exponents(rows).items():
        yield (
            f"{kind}=N: exponents of N",
            [["", *GROWING]]
            + [[name, *(text(one.get(key), ".2f") for key in GROWING)] for name, one in grown.items()],
        )
