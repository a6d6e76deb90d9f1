"""The goldens of tests/golden: thirteen small runs, simulated frames, and the options of every command.

`python -m tests.golden` writes them anew, see CONTRIBUTING.md.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from golden import frames, options, runs

REAL = {"corridor"}  # runs on real data


@pytest.fixture(scope="module", params=list(runs.RUNS))
def ran(request, tmp_path_factory):
    """The name of a run, and the folder of its report."""
    name = request.param
    data = request.getfixturevalue("data_dir") if name in REAL else None
    out = tmp_path_factory.mktemp("golden") / name
    runs.run(name, out, data)
    return name, out


def test_report_is_the_golden_one(ran):
    name, out = ran
    report, golden = runs.report_of(out), runs.golden_report(name)
    assert set(runs.keys(report)) == set(runs.keys(golden))
    found = list(runs.differences(report, golden, golden["queries"], rounded=name in runs.ROUNDED))
    assert not found, "\n".join(found)
    if "map_bytes" in golden:
        size = (out / "map.safetensors").stat().st_size
        assert size == report["map_bytes"] <= runs.MORE * golden["map_bytes"]


def test_matches_are_those_of_the_golden_run(ran):
    name, out = ran
    seen, golden = runs.read_matches(out / "matches.csv"), runs.golden_matches(name)
    assert [row.keys() for row in seen] == [row.keys() for row in golden]
    for column in ("query", "query_name", "rank"):
        assert [row.get(column) for row in seen] == [row.get(column) for row in golden]
    first = [row.get("rank", "1") == "1" for row in golden]
    for column in ("place", "accepted", "place_name"):
        same = [one[column] == other[column] for one, other in zip(seen, golden, strict=True)]
        least = 0.9 if name in runs.ROUNDED else runs.SAME
        assert np.mean(same) >= least, f"{column} differs"
        assert np.mean(np.array(same)[first]) >= least, f"{column} differs"
    for column in ("score", "probability"):
        told = [one.get(column, "") != "" for one in golden]
        assert [one.get(column, "") != "" for one in seen] == told
        values = [[float(row.get(column) or "0") for row in rows] for rows in (seen, golden)]
        # where another place of the same score is best, that of the next candidate is another
        same = [one["place"] == other["place"] for one, other in zip(seen, golden, strict=True)]
        close = {"rtol": runs.SCORE, "atol": 0.3 if name in runs.ROUNDED else runs.SCORE}
        np.testing.assert_allclose(*(np.array(one)[same] for one in values), **close)


@pytest.mark.parametrize("route", frames.ROUTES)
def test_simulated_frames_are_the_same(route):
    assert frames.differs(route, frames.golden()[route]) == ""


def test_commands_have_the_options():
    seen, golden = options.read(), json.loads(options.FILE.read_text())
    found = [
        f"{words} {name}: {seen.get(words, {}).get(name)}; golden {golden.get(words, {}).get(name)}"
        for words in {**golden, **seen}
        for name in {**golden.get(words, {}), **seen.get(words, {})}
        if seen.get(words, {}).get(name) != golden.get(words, {}).get(name)
    ]
    assert not found, "\n".join(found)
