"""`benchmarks spread` and `tests.processors`: what is run, and what is made of it."""

from __future__ import annotations

import ast
import json

import pytest
from command_line import benchmark, benchmark_fails

from benchmarks import spread
from benchmarks.measure import done_once
from tests.processors import chosen, compares_figures


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


def test_commands_run_in_the_environment_of_a_processor(tmp_path):
    environment = spread.environment_of("oldest", 2)
    assert environment["ATEN_CPU_CAPABILITY"] == "default"
    assert environment["OMP_NUM_THREADS"] == "2"
    said = done_once(["nothing"], tmp_path, tmp_path / "report.json", environment)
    assert said is not None
    assert "'nothing' is no command" in said
    assert "this" in spread.imitable()


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("assert a == approx(b)", True),
        ("assert share > 0.9", True),
        ("torch.testing.assert_close(a, b)", True),
        ("assert count == 3", False),
        ("assert scale == 2.0", False),
    ],
)
def test_tests_that_compare_figures_are_known(body, expected):
    (test,) = ast.parse(f"def test_it():\n    {body}").body
    assert isinstance(test, ast.FunctionDef)
    assert compares_figures(test) is expected


def test_goldens_and_figures_of_readme_are_among_them():
    names = {path.name for path, _ in chosen()}
    assert {"test_golden.py", "test_readme_figures.py", "test_real_routes.py", "test_hog.py"} <= names
