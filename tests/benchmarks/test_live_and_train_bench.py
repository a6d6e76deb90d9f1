"""`python -m benchmarks live` on a short route, and `train`, a few steps of a small network."""

from __future__ import annotations

import json

from command_line import benchmark

from benchmarks import live, train
from benchmarks.train import Rung
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.features.cnn import SmallCNN

ROUTE, AGAIN = "sim:aerial?frames=64", "sim:aerial?frames=64&traverse=1"


def test_every_frame_is_found_and_timed(tmp_path, monkeypatch, capsys):
    short = live.bench_live(400, 40, ((32, 48),), (96, 128), numbers=12)
    monkeypatch.setattr(live, "bench_live", lambda: short)
    benchmark("live", "--out", tmp_path)
    assert "filter" in capsys.readouterr().out
    rows = json.loads((tmp_path / "bench.json").read_text())["rows"]
    case = "96 x 128 on a map of 32 x 48"
    assert [(row["case"], row["contender"]) for row in rows] == [(case, "dejavu")]
    for row in rows:
        assert 0 < row["seconds"] <= row["seconds_p99"]
        assert row["recall_at_1"] > 0.8
        assert 0 <= row["dropped"] < row["frames"] == 40
        assert set(row["parts"]) == {"decoding", "features", "whitening", "search", "scores", "filter"}
        assert sum(row["parts"].values()) > row["seconds"] / 10
    assert (tmp_path / "bench.png").is_file()


def test_every_way_is_trained_with_every_seed(tmp_path, monkeypatch, capsys):
    def small():
        return SmallCNN(dimension=12, resize=(16, 16), widths=(4, 8), squeeze=4, cell=0)

    rungs = [Rung("plain", small, Augmentation), Rung("other", small, lambda: Augmentation(noise=0.0))]
    monkeypatch.setattr(train, "ladder", lambda: rungs)
    benchmark("train", ROUTE, AGAIN, "--out", tmp_path, "--steps", "3", "--seeds", "0", "1")
    rows = json.loads((tmp_path / "bench.json").read_text())["rows"]
    assert [(row["contender"], row["seed"]) for row in rows] == [
        (name, seed) for name in ("plain", "other") for seed in (0, 1)
    ]
    for row in rows:
        assert row["seconds"] > 0
        assert row["auc"].keys() == row["recall_at_1"].keys() == {"2.4", "1"}
        assert all(0 <= value <= 1 for value in row["auc"].values())
    assert rows[0]["auc"] != rows[1]["auc"]
    lines = capsys.readouterr().out.splitlines()
    shown = [line for line in lines if line.startswith(("plain", "other"))]
    assert len(shown) == 2
    assert all(line.endswith("-") for line in shown)  # too few bytes for so short a route
    assert (tmp_path / "bench.png").is_file()
