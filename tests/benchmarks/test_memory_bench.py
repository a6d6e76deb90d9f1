"""`python -m benchmarks memory`: what is measured, in processes of their own, and what is written."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import benchmark, benchmark_fails
from helpers import refused

from benchmarks import memory as footprint
from benchmarks.memory import (
    CONTENDERS,
    TOLERANCE,
    Drive,
    Task,
    bench_memory,
    gathered,
    localize,
    measured,
    paint_drives,
    shown_by,
)

LINUX = Path("/proc/self/statm").exists()


@pytest.fixture(scope="module", autouse=True)
def _short_pieces() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(footprint, "PIECE", 300)  # frames, which take seconds to paint
        yield


class Stub:
    """In the place of `measured`: every process writes its file, and the second contender dies."""

    def __init__(self) -> None:
        self.tasks: list[Task] = []
        self.files: list[int] = []

    def __call__(self, task: Task, folder: Path) -> dict[str, Any]:
        self.tasks.append(task)
        self.files.append(len(list(folder.glob("*-*"))))
        if task.contender == "dejavu templates":
            return {"skipped": "ended by signal 9"}
        if not task.queries:
            task.file(folder).write_bytes(b"kept")
        seconds = {"dejavu": 2.0, "HOG, float32": 3.0}.get(task.contender, 1.0)
        return {"seconds": seconds, "peak_bytes": 1_000_000 * task.places, "bytes": 4}


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> Stub:
    stub = Stub()
    monkeypatch.setattr(footprint, "measured", stub)
    return stub


def test_every_contender_learns_each_size_and_localizes_on_the_middle_one(stub: Stub) -> None:
    rows = list(bench_memory([300, 100, 200], queries=[5]))
    assert [row["case"] for row in rows[:2]] == ["programs loaded", "learn 100 frames"]
    cases = dict.fromkeys(row["case"] for row in rows[1:])
    assert list(cases) == [
        "learn 100 frames",
        "learn 200 frames",
        "learn 300 frames",
        "localize 5 queries, 200 places",
    ]
    assert [row["contender"] for row in rows[1:]] == list(CONTENDERS) * len(cases)
    assert [(row["case"], row["contender"]) for row in rows] == [
        (task.case, task.contender) for task in stub.tasks
    ]
    assert max(stub.files) < len(CONTENDERS)  # files that nothing reads any more do not pile up


def test_what_fails_is_a_row_and_the_others_go_on(stub: Stub, tmp_path: Path) -> None:
    benchmark("memory", "--places", "64", "--out", tmp_path)
    written = json.loads((tmp_path / "bench.json").read_text())["rows"]
    rows = {(row["case"], row["contender"]): row for row in written}
    assert rows["learn 64 frames", "dejavu templates"]["skipped"] == "ended by signal 9"
    assert rows["learn 64 frames", "HOG, float32"]["ratio_to_ours"] == 1.5
    assert rows["localize 10000 queries, 64 places", "dejavu"]["peak_bytes"] == 64_000_000
    assert (tmp_path / "bench.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bench.json", "bench.png"]


def test_bad_sizes_are_refused_ahead_of_the_work(
    stub: Stub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    error = benchmark_fails(capsys, "memory", "--places", "7", "--out", tmp_path / "out")
    assert "7" in error
    assert "64" in error
    with refused("1 query"):
        list(bench_memory([64], queries=[0]))
    error = benchmark_fails(capsys, "memory", "sim:aerial", "--out", tmp_path / "out")
    assert "unrecognized" in error
    assert stub.tasks == list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drives")
    paint_drives(folder, 200)
    return folder


def test_a_frame_is_a_window_of_the_drive(drives: Path) -> None:
    image = np.load(drives / "places.npy")
    drive = Drive(image, torch.tensor([3, 150, 0]))
    (batch,) = drive.batches(8)
    assert batch.shape == (3, 3, 64, 64)
    seen = torch.from_numpy(image[:, 150:214]).permute(2, 0, 1) / 255
    assert torch.equal(batch[1], seen)


def test_queries_lie_along_the_route_and_begin_again() -> None:
    assert shown_by(4, 12).tolist() == [0, 3, 6, 9]
    assert shown_by(5, 2).tolist() == [0, 1, 0, 1, 0]


def test_batches_are_gathered_in_order(drives: Path) -> None:
    drive = Drive(np.load(drives / "places.npy"), torch.arange(70))
    whole = gathered((batch.mean((1, 2, 3)) for batch in drive.batches(32)), drive)
    assert torch.equal(whole, torch.cat([batch.mean((1, 2, 3)) for batch in drive.batches(70)]))


def test_places_are_learned_and_found(drives: Path) -> None:
    name = "HOG, float32"
    learned, found = (footprint.measure(Task(name, 200, queries, 1), drives) for queries in (0, 50))
    assert learned["bytes"] == found["bytes"] == Task(name, 200, 0, 1).file(drives).stat().st_size
    assert found["recall_at_1"] > 0.9
    assert not list(drives.glob("*.trial"))
    if LINUX:  # (200, 1764) floats, and a batch of frames and more
        assert 200 * 1764 * 4 < learned["peak_bytes"] < 100e6


@pytest.mark.parametrize("name", CONTENDERS)
def test_every_contender_finds_the_places(name: str, drives: Path, tmp_path: Path) -> None:
    if name.startswith("faiss"):
        pytest.importorskip("faiss")
    route, queries = (np.load(drives / f"{which}.npy") for which in ("places", "queries"))
    shown = shown_by(50, 200)
    CONTENDERS[name].learn(Drive(route, torch.arange(200)), tmp_path / "route")
    found = localize(CONTENDERS[name], tmp_path / "route", Drive(queries, shown))
    assert ((found - shown).abs() <= TOLERANCE).double().mean() > 0.9


def test_why_a_process_failed_that_does_not_import_from_the_current_folder(
    drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "kornia.py").write_text("raise SystemExit('the wrong module')")
    monkeypatch.chdir(tmp_path)
    facts = measured(Task("HOG, float32", 150, 10, 1), drives)  # nothing learned so many
    assert list(facts) == ["skipped"]
    assert "150" in facts["skipped"]
