"""`python -m benchmarks matcher`, and what all benchmarks share: contenders, what is compared and written."""

from __future__ import annotations

import json

import pytest
import torch
from command_line import benchmark as command

from benchmarks import matcher
from benchmarks.matcher import bench_matcher
from dejavu_torch.maps.distance import l1_backend

L1, HOG, SEQUENCE, FILTER = "l1 9 x 40 x 410", "hog 24 x 16", "sequence 9 x 5 x 5000", "filter 40 x 3000"
EXPORT = "single frames 3 x 24 x 16 on 200"


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """With more there are rows of ours with one as well."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def rows():
    """The rows of small cases."""
    sizes = {"images": [(24, 16)], "distances": [(9, 40, 410)], "sequences": [(9, 5, 5000)]}
    sizes |= {"filters": [(40, 3000)], "exports": [(3, 24, 16, 200)]}
    found = bench_matcher(frames=70, repeats=1, torch_compile=False, **sizes)
    return {(row["case"], row["contender"]): row for row in found}


def test_all_contenders_of_all_cases_give_what_we_give(rows):
    ways = ("dejavu", "dejavu (eager torch)", "torch.cdist", "torch.compile", "scipy cdist", "faiss")
    others = {HOG: ("dejavu", "scikit-image"), L1: ways, SEQUENCE: ("dejavu", "dejavu (a query at a time)")}
    others |= {FILTER: ("dejavu",), EXPORT: ("dejavu", "onnxruntime")}
    assert list(rows) == [(case, name) for case, names in others.items() for name in names]
    ran = {key: row for key, row in rows.items() if row["skipped"] is None}
    assert {(HOG, "scikit-image"), (L1, "scipy cdist"), (L1, "torch.cdist")} <= ran.keys()  # the test extra
    for (case, _), row in ran.items():
        assert row["difference"] < {HOG: 1e-6, FILTER: 0.05}.get(case, 1e-4)
        names = [name for of, name in ran if of == case and name.startswith("dejavu")]
        assert row["ratio_to_ours"] == row["seconds"] / min(rows[case, name]["seconds"] for name in names)
    assert rows[HOG, "dejavu"]["bytes"] == rows[HOG, "scikit-image"]["bytes"] == 70 * (2 * 1 * 4 * 9) * 4
    assert (rows[L1, "dejavu"]["bytes"], rows[L1, "scipy cdist"]["bytes"]) == (9 * 410 * 4, 9 * 410 * 8)
    assert rows[L1, "scipy cdist"]["threads"] == rows[HOG, "scikit-image"]["threads"] == 1
    assert rows[L1, "torch.compile"]["skipped"] == "RuntimeError: not asked for"
    assert rows[EXPORT, "dejavu"]["file_bytes"] is None
    assert rows[EXPORT, "onnxruntime"]["file_bytes"] > 200 * matcher.NUMBERS * 4


def test_what_is_written_and_printed(tmp_path, rows, monkeypatch, capsys):
    monkeypatch.setattr(matcher, "bench_matcher", rows.values)
    command("matcher", "--out", tmp_path / "new")
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["bench.json", "bench.png"]
    written = json.loads((tmp_path / "new" / "bench.json").read_text())
    assert written["rows"] == list(rows.values())
    assert (written["threads"], written["l1_backend"]) == (torch.get_num_threads(), l1_backend())
    assert written["versions"]["torch"].startswith(torch.__version__.split("+")[0])
    shown = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert f"{L1}: torch.compile skipped: RuntimeError: not asked for" in shown
    assert shown[-1].endswith(f"next: open {tmp_path / 'new' / 'bench.png'}")
