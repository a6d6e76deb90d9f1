"""`benchmarks chunks`: each length is a map of its own."""

import json

from command_line import benchmark

from benchmarks import chunks
from dejavu_torch.evaluation.paper_tables import PUBLISHED


def test_chunks_of_other_lengths_are_maps_of_their_own(tmp_path, monkeypatch):
    monkeypatch.setattr(chunks, "LENGTHS", (64, 128, 256))
    monkeypatch.setattr(chunks, "PUBLISHED", {"aerial": PUBLISHED["aerial"]})
    benchmark("chunks", "--frames", "140", "--out", tmp_path / "out")
    rows = json.loads((tmp_path / "out" / "bench.json").read_text())["rows"]
    assert [row["contender"] for row in rows] == ["chunks of 64", "chunks of 128"]  # 256 is longer
    assert rows[0]["bytes_per_place"] != rows[1]["bytes_per_place"]
    assert all(0 < row["recall_at_1"] <= 1 and 0 < row["auc"] <= 1 for row in rows)
