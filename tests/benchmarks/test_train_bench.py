"""`python -m benchmarks train`, a few steps of a small network."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import pytest
from command_line import benchmark
from helpers import refused

from benchmarks import train as train_speed
from benchmarks.measure import Row
from benchmarks.train import Rung, bench_train, ladder, train_table
from dejavu_torch import open_source
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.features.cnn import SmallCNN

ROUTE, AGAIN = "sim:aerial?frames=64", "sim:aerial?frames=64&traverse=1"


def small() -> SmallCNN:
    return SmallCNN(dimension=12, resize=(16, 16), widths=(4, 8), squeeze=4, cell=0)


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    rungs = [Rung("plain", small, Augmentation), Rung("other", small, lambda: Augmentation(noise=0.0))]
    return bench_train(open_source(ROUTE), open_source(AGAIN), steps=3, seeds=(0, 1), rungs=rungs)


def test_every_way_is_trained_with_every_seed(rows: list[Row]) -> None:
    assert [(row["contender"], row["seed"]) for row in rows] == [
        ("plain", 0),
        ("plain", 1),
        ("other", 0),
        ("other", 1),
    ]
    for row in rows:
        assert row["seconds"] > 0
        assert row["auc"].keys() == row["recall_at_1"].keys() == {"2.4", "1"}
        assert all(0 <= value <= 1 for value in row["auc"].values())
    assert rows[0]["auc"] != rows[1]["auc"]
    header, *lines = train_table(rows)
    assert [line[0] for line in lines] == ["plain", "other"]
    assert {len(line) for line in (header, *lines)} == {5}
    assert {line[4] for line in lines} == {"-"}  # too few bytes for so short a route


def test_each_rung_of_the_ladder_changes_one_thing() -> None:
    rungs = ladder()
    for before, after in pairwise(rungs):
        networks, days = (
            [str(make()) for make in pair]
            for pair in ((before.backbone, after.backbone), (before.augmentation, after.augmentation))
        )
        types = [type(rung.augmentation()) for rung in (before, after)]
        changed = [
            networks[0] != networks[1],
            days[0] != days[1] or types[0] != types[1],
            before.precision != after.precision,
            before.lr != after.lr,
            before.rate != after.rate,
        ]
        assert sum(changed) == 1


def test_the_command_writes_them(
    rows: list[Row], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(train_speed, "bench_train", lambda *_, **__: rows)
    benchmark("train", ROUTE, AGAIN, "--out", tmp_path / "bench", "--steps", "3", "--seeds", "0", "1")
    assert "AUC at 1 B" in capsys.readouterr().out
    written = json.loads((tmp_path / "bench" / "bench.json").read_text())["rows"]
    assert [row["seed"] for row in written] == [0, 1, 0, 1]
    assert (tmp_path / "bench" / "bench.png").is_file()


def test_what_cannot_be_trained_is_refused(tmp_path: Path) -> None:
    route, again = open_source(ROUTE), open_source(AGAIN)
    with refused("0 steps"):
        bench_train(route, again, steps=0)
    with refused("seeds []"):
        bench_train(route, again, seeds=())
    with refused("seeds [-1]", "from 0"):
        bench_train(route, again, seeds=(-1,))
    with refused("1 sources", "REFERENCE QUERY"):
        train_speed.run_train(tmp_path, [ROUTE])
