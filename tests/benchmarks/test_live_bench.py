"""`python -m benchmarks live`, on a short route."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import benchmark
from helpers import refused

from benchmarks import live as live_speed
from benchmarks.live import bench_live, live_table
from benchmarks.measure import Row

SMALL = {"places": 400, "frames": 40, "sizes": ((48, 64), (32, 48)), "camera": (96, 128), "numbers": 12}


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return bench_live(**SMALL)  # type: ignore[arg-type]


def test_every_frame_is_found_and_timed(rows: list[Row]) -> None:
    assert len(rows) == 2
    for row in rows:
        assert 0 < row["seconds"] <= row["seconds_p99"]
        assert row["recall_at_1"] > 0.8
        assert 0 <= row["dropped"] < row["frames"] == 40
        assert set(row["parts"]) == {"decoding", "features", "whitening", "scores", "filter"}
        assert sum(row["parts"].values()) > row["seconds"] / 10
    assert [len(line) for line in live_table(rows)] == [14, 14, 14]


def test_the_command_writes_them(
    rows: list[Row], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(live_speed, "bench_live", lambda *_, **__: rows)
    benchmark("live", "--out", tmp_path / "bench")
    assert "p99 ms" in capsys.readouterr().out
    written = json.loads((tmp_path / "bench" / "bench.json").read_text())["rows"]
    assert [row["contender"] for row in written] == ["dejavu", "dejavu"]
    assert (tmp_path / "bench" / "bench.png").is_file()


def test_too_few_places_are_refused() -> None:
    with refused("20 places"):
        bench_live(places=20, frames=40, numbers=12)
