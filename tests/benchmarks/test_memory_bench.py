"""`python -m benchmarks memory`: what is measured, in processes of their own, and what is written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import benchmark

from benchmarks import memory
from benchmarks.memory import CONTENDERS, TOLERANCE, Drive, kept, localize, paint_drives, shown_by

HOG = "HOG, float32"


@pytest.fixture(scope="module", autouse=True)
def _short_pieces():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(memory, "PIECE", 300)  # frames, which take seconds to paint
        yield


def test_what_is_measured_and_written_also_where_a_process_dies(tmp_path, monkeypatch):
    files = []

    def stub(module, arguments):
        name, places, queries, _, folder = arguments
        files.append(len(list(Path(folder).glob("*-*"))))
        if name == "dejavu templates":
            return {"skipped": "ended by signal 9"}
        if not queries:
            kept(Path(folder), name, places).write_bytes(b"kept")
        seconds = {"dejavu": 2.0, HOG: 3.0}.get(name, 1.0)
        return {"seconds": seconds, "peak_bytes": 1_000_000 * places, "bytes": 4}

    monkeypatch.setattr(memory, "in_process", stub)
    benchmark("memory", "--places", "300", "100", "200", "--out", tmp_path)
    written = json.loads((tmp_path / "bench.json").read_text())["rows"]
    assert [row["case"] for row in written[:2]] == ["programs loaded", "learn 100 frames"]
    cases = [f"learn {n} frames" for n in (100, 200, 300)]
    cases += [f"localize {n} queries, 200 places" for n in (100, 10_000)]
    assert [(row["case"], row["contender"]) for row in written[1:]] == [
        (case, name) for case in cases for name in CONTENDERS
    ]
    rows = {(row["case"], row["contender"]): row for row in written}
    assert rows[cases[0], "dejavu templates"]["skipped"] == "ended by signal 9"
    assert rows[cases[0], HOG]["ratio_to_ours"] == 1.5
    assert rows[cases[-1], "dejavu"]["peak_bytes"] == 200_000_000
    assert max(files) < len(CONTENDERS)  # files that nothing reads any more do not pile up
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bench.json", "bench.png"]


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drives")
    paint_drives(folder, 200)
    return folder


def test_places_are_learned_and_found(drives):
    learned, found = (memory.measure(HOG, 200, queries, 1, drives) for queries in (0, 50))
    assert learned["bytes"] == found["bytes"] == kept(drives, HOG, 200).stat().st_size
    assert found["recall_at_1"] > 0.9
    assert not list(drives.glob("*.trial"))
    if Path("/proc/self/statm").exists():  # (200, 1764) floats, and a batch of frames and more
        assert 200 * 1764 * 4 < learned["peak_bytes"] < 100e6


@pytest.mark.parametrize("name", CONTENDERS)
def test_every_contender_finds_the_places(name, drives, tmp_path):
    if name.startswith("faiss"):
        pytest.importorskip("faiss")
    route, queries = (np.load(drives / f"{which}.npy") for which in ("places", "queries"))
    shown = shown_by(50, 200)
    CONTENDERS[name].learn(Drive(route, torch.arange(200)), tmp_path / "route")
    found = localize(CONTENDERS[name], tmp_path / "route", Drive(queries, shown))
    assert ((found - shown).abs() <= TOLERANCE).double().mean() > 0.9
