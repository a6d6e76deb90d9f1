"""Every figure of README is one of a kept file in benchmarks/results, and says what that says."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
README = (ROOT / "README.md").read_text()
# tables are held against their files by tests/benchmarks/test_results.py
TABLE = re.compile(r"<!-- table: .*?<!-- end of table -->", re.DOTALL)
PROSE = " ".join(re.sub(r"^```.*?^```$", "", TABLE.sub("", README), flags=re.M | re.S).split())
# numbers that no measurement gave: what is asked for, sizes of input, versions, names and years
GIVEN = {"99", "5", "3.11", "2017", "1.5", "10"}


def rows(name):
    return json.loads((RESULTS / f"{name}.json").read_text())["rows"]


def shares(way, size, figure="one_image"):
    """The range over three seeds, in per cent."""
    (row,) = (r for r in rows("front") if (r["contender"], r["bytes_per_place"]) == (way, size))
    low, high = (f"{100 * share:.1f}" for share in row[f"{figure}_span"])
    return f"{low} %" if low == high else f"{low} to {high} %"


def told():
    """The sentences of README that have figures, as the kept files tell them."""
    searched = {r["contender"]: r for r in rows("scale") if r["places"] == 10**6}
    ours, other = (searched[name] for name in ("dejavu 4 B", "faiss IVF-PQ, 16 B"))
    megabytes = [f"{one['peak_bytes'] / 1e6:.0f} MB" for one in (ours, other)]
    times = [f"{1e3 * one['seconds_one']:.1f} ms" for one in (ours, other)]
    batch = [f"{1e3 * one['seconds_threads']:.1f} ms" for one in (ours, other)]
    codebooks = {row["codebook_bytes"] for row in rows("files") if row["contender"] == "product_quantiser"}
    return [
        f"at one byte per place one image finds {shares('map', 1.0)} of the second",
        f"half a byte per place then finds {shares('map', 0.5, 'whole_drive')}",
        f"its codebooks, {max(codebooks) / 1e3:.0f} kB, cost nothing here",
        f"Searching 10^6 places of 4 bytes takes {megabytes[0]} of memory and {times[0]} for a query, "
        f"{batch[0]} in a batch",
        f"IVF-PQ of faiss with 16 bytes per place {megabytes[1]}, {times[1]} and {batch[1]}",
    ]


def test_the_first_screen_is_level_ahead_and_behind_where_it_says_so():
    share = {(r["contender"], r["bytes_per_place"]): r for r in rows("front")}
    ours, free, other = "map", "product_quantiser", "product_quantiser_free"
    found, sure = "one_image", "at_99_precision"
    for size in (1.0, 2.0, 4.0):
        assert abs(share[ours, size][found] - share[free, size][found]) < 0.005  # level
    for size in (0.25, 0.5):
        assert share[free, size][found] > share[ours, size][found]
        assert share[free, size][sure] > share[ours, size][sure]
    for size in (2.0, 4.0, 8.0):
        assert share[ours, size][sure] > share[free, size][sure]
    assert all(share[ours, size][found] > share[other, size][found] for size in (0.25, 0.5, 1.0, 2.0, 4.0))


@pytest.mark.parametrize("number", range(len(told())))
def test_a_sentence_says_what_was_measured(number):
    assert told()[number] in PROSE


def test_no_other_figure_is_told():
    rest = PROSE
    for sentence in told():
        rest = rest.replace(sentence, "")
    rest = re.sub(r"`[^`]*`|\]\([^)]*\)|<!--.*?-->", "", rest)
    assert set(re.findall(r"(?<![\w/])\.?\d+(?:\.\d+)?(?!\w)", rest)) <= GIVEN
