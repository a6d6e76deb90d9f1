"""`python -m benchmarks`: the contenders, what is compared, and what is written."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from helpers import refused
from matplotlib.figure import Figure

from benchmarks import matcher as bench
from benchmarks.matcher import COLUMNS, bench_matcher, run_matcher
from benchmarks.measure import Contender, Row, Run, benchmark, new_row, table, write_bench
from benchmarks.plots import plot_ratios


def small(**options: object) -> list[Row]:
    sizes = {
        "frames": 70,
        "repeats": 1,
        "images": [(24, 16)],
        "distances": [(9, 40, 410)],
        "sequences": [(9, 5, 5000)],
        "filters": [(40, 3000)],
        "exports": [(3, 24, 16, 200)],
    }
    return bench_matcher(**{"torch_compile": False, **sizes, **options})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def rows() -> dict[tuple[str, str], Row]:
    return {(row["case"], row["contender"]): row for row in small()}


L1 = "l1 9 x 40 x 410"
HOG = "hog 24 x 16"
SEQUENCE = "sequence 9 x 5 x 5000"
FILTER = "filter 40 x 3000"
EXPORT = "single frames 3 x 24 x 16 on 200"


def test_all_contenders_of_all_cases(rows: dict[tuple[str, str], Row]) -> None:
    assert list(rows) == [
        (HOG, "dejavu"),
        (HOG, "scikit-image"),
        (L1, "dejavu"),
        (L1, "dejavu (eager torch)"),
        (L1, "torch.cdist"),
        (L1, "torch.compile"),
        (L1, "scipy cdist"),
        (L1, "faiss"),
        (SEQUENCE, "dejavu"),
        (SEQUENCE, "dejavu (a query at a time)"),
        (FILTER, "dejavu"),
        (FILTER, "dejavu (all places)"),
        (EXPORT, "dejavu"),
        (EXPORT, "onnxruntime"),
    ]


def test_an_exported_map_has_the_size_of_its_file(rows: dict[tuple[str, str], Row]) -> None:
    pytest.importorskip("onnxruntime")
    assert rows[EXPORT, "dejavu"]["file_bytes"] is None
    assert (rows[EXPORT, "onnxruntime"]["file_bytes"] or 0) > 200 * bench.NUMBERS * 4


def test_without_onnxruntime_the_row_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    ours, theirs = small(images=[], distances=[], sequences=[], filters=[])
    assert ours["seconds"] is not None
    assert theirs["skipped"] is not None
    assert "onnxruntime" in theirs["skipped"]
    assert theirs["file_bytes"] is None


def test_contenders_give_what_we_give(rows: dict[tuple[str, str], Row]) -> None:
    ran = {key: row for key, row in rows.items() if row["skipped"] is None}
    assert {(HOG, "scikit-image"), (L1, "scipy cdist"), (L1, "torch.cdist")} <= ran.keys()  # the test extra
    for (case, _), row in ran.items():
        assert row["difference"] is not None
        assert row["difference"] < {HOG: 1e-6, FILTER: 0.05}.get(case, 1e-4)


def test_a_size_is_that_of_the_result(rows: dict[tuple[str, str], Row]) -> None:
    assert rows[HOG, "dejavu"]["bytes"] == rows[HOG, "scikit-image"]["bytes"] == 70 * (2 * 1 * 4 * 9) * 4
    assert rows[L1, "dejavu"]["bytes"] == 9 * 410 * 4
    assert rows[L1, "scipy cdist"]["bytes"] == 9 * 410 * 8


def test_threads_are_reported(rows: dict[tuple[str, str], Row]) -> None:
    assert rows[L1, "dejavu"]["threads"] == torch.get_num_threads()
    assert rows[L1, "scipy cdist"]["threads"] == rows[HOG, "scikit-image"]["threads"] == 1


def test_the_ratio_is_to_our_fastest(rows: dict[tuple[str, str], Row]) -> None:
    for case in (HOG, L1, SEQUENCE, FILTER, EXPORT):
        seconds = {name: row["seconds"] for (of, name), row in rows.items() if of == case and row["seconds"]}
        ours = min(taken for name, taken in seconds.items() if name.startswith("dejavu"))
        for name, taken in seconds.items():
            assert rows[case, name]["ratio_to_ours"] == taken / ours


def test_a_program_that_is_not_installed_is_a_row_that_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "faiss", None)
    found = {row["contender"]: row for row in small(images=[], sequences=[], filters=[], exports=[])}
    assert found["faiss"]["skipped"] is not None
    assert "faiss" in found["faiss"]["skipped"]
    assert found["faiss"] | {"skipped": None} == new_row(L1, "faiss")
    assert found["torch.compile"]["skipped"] == "RuntimeError: not asked for"
    assert found["torch.cdist"]["skipped"] is None


def test_a_slow_contender_does_a_part(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "AT_MOST", 0)
    ours, theirs = small(distances=[], sequences=[], filters=[], exports=[])
    assert (ours["measured_rows"], theirs["measured_rows"]) == (None, 1)
    assert theirs["bytes"] == ours["bytes"]
    assert theirs["difference"] is not None
    assert theirs["difference"] < 1e-6
    assert theirs["seconds"] is not None
    assert theirs["seconds_first"] is not None


class Counted:
    """Gives `value`, and remembers who ran in which order."""

    def __init__(self, name: str, value: torch.Tensor, log: list[str], pause: float = 0.0) -> None:
        self.name, self.value, self.log, self.pause = name, value, log, pause

    def ready(self) -> Run:
        self.log.append(f"{self.name} ready")
        time.sleep(self.pause)
        return self.run

    def run(self) -> torch.Tensor:
        self.log.append(self.name)
        return self.value


def test_contenders_take_turns_after_the_warm_up() -> None:
    log: list[str] = []
    a = Counted("a", torch.zeros(4), log, pause=0.2)
    b = Counted("b", torch.tensor([0.0, 0.5]), log)
    first, second = benchmark("case", [Contender("dejavu", a.ready, 1), Contender("other", b.ready, 2)], 3)
    watched = 0 if first["peak_bytes"] is None else 1
    assert log == ["a ready", *["a"] * (1 + watched), "b ready", *["b"] * (1 + watched), *["a", "b"] * 3]
    assert first["seconds"] is not None
    assert first["seconds_first"] is not None
    assert first["seconds"] < 0.2 <= first["seconds_first"]  # getting ready counts in the first run only
    assert (first["difference"], second["difference"]) == (0.0, 0.5)
    assert (second["measured_rows"], second["bytes"], second["threads"]) == (2, 16, 2)


def test_an_error_of_ours_is_raised_and_one_of_theirs_is_a_row() -> None:
    def broken() -> Run:
        raise ZeroDivisionError("of\nno use")

    fine = Counted("a", torch.zeros(2), [])
    rows = benchmark("case", [Contender("dejavu", fine.ready, 1), Contender("other", broken, 1)], 1)
    assert rows[1] == new_row("case", "other", skipped="ZeroDivisionError: of no use")
    with pytest.raises(ZeroDivisionError):
        benchmark("case", [Contender("dejavu", broken, 1), Contender("other", fine.ready, 1)], 1)


def test_peak_memory_sees_what_is_freed_again() -> None:
    if not Path("/proc/self/statm").exists():
        pytest.skip("no /proc")

    # in a process of its own, where nothing else is freed meanwhile
    code = (
        "import time, torch; from benchmarks.measure import peak_memory\n"
        "def run():\n"
        "    large = torch.ones(16, 2**20)\n"  # 64 MiB
        "    time.sleep(0.1)\n"
        "    return large[0].clone()\n"
        "print(peak_memory(run))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 60 * 2**20 < int(done.stdout) < 200 * 2**20


def test_what_is_written(tmp_path: Path, rows: dict[tuple[str, str], Row]) -> None:
    write_bench(tmp_path, list(rows.values()), plot_ratios({"one": {"dejavu": 1.0}}))
    written = json.loads((tmp_path / "bench.json").read_text())
    assert written["rows"] == list(rows.values())
    assert written["threads"] == torch.get_num_threads()
    assert written["l1_backend"] in ("numba", "torch")
    assert written["versions"]["torch"].startswith(torch.__version__.split("+")[0])
    assert (tmp_path / "bench.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bench.json", "bench.png"]


def test_a_bar_for_each_contender() -> None:
    figure, axes = plot_ratios({"one": {"dejavu": 1.0, "other": 2.5}, "two": {"dejavu": 1.0}})
    assert isinstance(figure, Figure)
    assert [axis.get_title("left") for axis in axes] == ["one", "two"]
    assert [[bar.get_width() for bar in axis.patches] for axis in axes] == [[1.0, 2.5], [1.0]]
    assert [text.get_text() for text in axes[0].texts] == ["dejavu", "other", "1.0", "2.5"]


def test_the_table() -> None:
    done = {"seconds": 0.5, "seconds_first": 1.25, "ratio_to_ours": 1.0, "threads": 2, "difference": 0.0}
    rows = [
        new_row("l1", "dejavu", **done, peak_bytes=2_000_000, bytes=1_000_000),
        new_row("l1", "slow", **done, measured_rows=7, file_bytes=4_000_000),
        new_row("l1", "absent", skipped="ImportError: no module"),
    ]
    assert table(rows, COLUMNS)[1:] == [
        ["l1: dejavu", "0.500", "1.0", "1.25", "2", "2.0", "1.0", "", "0.0e+00", ""],
        ["l1: slow", "0.500", "1.0", "1.25", "2", "", "", "4.0", "0.0e+00", "7 measured"],
        ["l1: absent", "", "", "", "", "", "", "", "", "skipped: ImportError: no module"],
    ]


def test_a_run_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [new_row("l1", "dejavu", seconds=1.0, ratio_to_ours=1.0)]
    monkeypatch.setattr(bench, "bench_matcher", lambda: rows)
    assert run_matcher(tmp_path / "new") == rows
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["bench.json", "bench.png"]
    (tmp_path / "file").touch()
    with refused("file"):
        run_matcher(tmp_path / "file")


@pytest.mark.parametrize(
    "wrong", [{"frames": 0}, {"repeats": 0}, {"images": [(24, 0)]}, {"distances": [(1, 0, 1)]}]
)
def test_nothing_to_measure_is_refused(wrong: dict[str, object]) -> None:
    with refused("at least 1"):
        small(**wrong)
