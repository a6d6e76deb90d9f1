"""`benchmarks spread` and `tests.processors`: what is run, and what is made of it."""

from __future__ import annotations

import json

from command_line import benchmark, benchmark_fails

from benchmarks import spread


def test_every_processor_and_seed_is_run_and_compared(tmp_path, monkeypatch, capsys):
    seen = []

    def made(words, folder, report, environment):
        seed = words[words.index("--seed") + 1]
        seen.append((seed, environment["OMP_NUM_THREADS"]))
        folder.mkdir(parents=True, exist_ok=True)
        report.write_text(json.dumps({"auc": int(seed) / 10, "recall_at_1": 0.5, "fixed_bytes": 7}))
        (folder / "matches.csv").write_text(f"place\n4\n{seed}\n")

    monkeypatch.setattr(spread, "done_once", made)
    monkeypatch.setattr(spread, "imitable", lambda: ["this", "oldest"])
    given = ("spread", "a", "b", "--tolerance", "0", "--out", tmp_path / "out")
    benchmark(*given, "--seeds", "3")
    assert seen == [("0", "1"), ("0", "2")] * 2 + [("1", "1"), ("2", "1"), ("3", "1")]
    rows = json.loads((tmp_path / "out" / "bench.json").read_text())["rows"]
    assert [row["differ"] for row in rows] == [0, 0, 0, 0, 0.5, 0.5, 0.5]
    said = capsys.readouterr().out
    assert "by processor: auc 0.000, standard deviation 0.000" in said
    assert "by seed: auc 0.200, standard deviation 0.100" in said
    assert "1 seeds" in benchmark_fails(capsys, *given, "--seeds", "1")
    monkeypatch.setattr(spread, "done_once", lambda *_: "a is not there")
    assert "a is not there" in benchmark_fails(capsys, *given)
