"""`python -m benchmarks matcher`, and what all benchmarks share: contenders, what is compared and written."""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path

import pytest
import torch
from command_line import benchmark as command
from drawn import render, texts
from matplotlib.colors import to_rgb
from processes import python

from benchmarks import matcher
from benchmarks.matcher import COLUMNS, bench_matcher
from benchmarks.measure import Contender, benchmark, new_row, table
from benchmarks.plots import plot_growth, plot_ratios
from benchmarks.scale_contenders import CONTENDERS
from benchmarks.template_search import OURS, SCAN, bench_templates, random_map
from dejavu_torch.evaluation.contenders import COLOURS
from dejavu_torch.evaluation.plots import GREY
from dejavu_torch.maps.distance import l1_backend

L1, HOG, SEQUENCE, FILTER = "l1 9 x 40 x 410", "hog 24 x 16", "sequence 9 x 5 x 5000", "filter 40 x 3000"
EXPORT = "single frames 3 x 24 x 16 on 200"


def small(*only):
    """The rows of small cases, of these kinds alone if any are named."""
    sizes = {"images": [(24, 16)], "distances": [(9, 40, 410)], "sequences": [(9, 5, 5000)]}
    sizes |= {"filters": [(40, 3000)], "exports": [(3, 24, 16, 200)]}
    sizes = {name: size if not only or name in only else [] for name, size in sizes.items()}
    return list(bench_matcher(frames=70, repeats=1, torch_compile=False, **sizes))  # type: ignore[arg-type]


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """With more there are rows of ours with one as well."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def rows():
    return {(row["case"], row["contender"]): row for row in small()}


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


@pytest.mark.parametrize(
    ("module", "part", "contender"),
    [("faiss", "distances", "faiss"), ("onnxruntime", "exports", "onnxruntime")],
)
def test_a_program_that_is_not_installed_is_a_row_that_says_so(module, part, contender, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    found = {row["contender"]: row for row in small(part)}
    assert module in found[contender]["skipped"]
    assert found[contender] | {"skipped": None} == new_row(found["dejavu"]["case"], contender)
    assert found["dejavu"]["seconds"] is not None


def test_a_slow_contender_does_a_part(monkeypatch):
    monkeypatch.setattr(matcher, "AT_MOST", 0)
    ours, theirs = small("images")
    assert (ours["measured_rows"], theirs["measured_rows"]) == (None, 1)
    assert theirs["bytes"] == ours["bytes"]
    assert theirs["difference"] < 1e-6


def counted(name, value, log, threads=1, pause=0.0):
    """Gives `value`, and remembers who ran in which order."""

    def run():
        log.append(name)
        return value

    def ready():
        log.append(f"{name} ready")
        time.sleep(pause)
        return run

    return Contender(name, ready, threads)


def test_contenders_take_turns_after_the_warm_up():
    log = []
    ours = counted("dejavu", torch.zeros(4), log, pause=0.2)
    first, second = benchmark("case", [ours, counted("b", torch.tensor([0.0, 0.5]), log, 2)], 3)
    runs = 1 if first["peak_bytes"] is None else 2
    assert log == ["dejavu ready", *["dejavu"] * runs, "b ready", *["b"] * runs, *["dejavu", "b"] * 3]
    assert first["seconds"] < 0.2 <= first["seconds_first"]  # getting ready counts in the first run only
    assert (first["difference"], second["difference"]) == (0.0, 0.5)
    assert (second["measured_rows"], second["bytes"], second["threads"]) == (2, 16, 2)


def test_an_error_of_ours_is_raised_and_one_of_theirs_is_a_row():
    def broken():
        raise ZeroDivisionError("of\nno use")

    fine = counted("dejavu", torch.zeros(2), [])
    rows = benchmark("case", [fine, Contender("other", broken)], 1)
    assert rows[1] == new_row("case", "other", skipped="ZeroDivisionError: of no use")
    with pytest.raises(ZeroDivisionError):
        benchmark("case", [Contender("dejavu", broken), fine], 1)


def test_peak_memory_sees_what_is_freed_again():
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
    assert 60 * 2**20 < int(python(code).stdout) < 200 * 2**20


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


def test_the_table():
    ours = new_row("l1", "dejavu", seconds=0.5, ratio_to_ours=1.0, threads=2, bytes=2_000_000, difference=0.0)
    slow = new_row("l1", "slow", seconds=0.25, measured_rows=7)
    shown = [" ".join(line.split()) for line in table([ours, slow], COLUMNS).splitlines()]
    assert shown[-2:] == ["l1: dejavu 0.500 1.0 2 2.0 0.0e+00", "l1: slow 0.250 7 measured"]


def test_a_bar_for_each_contender_in_its_colour():
    figure, axes = plot_ratios({"one": {"dejavu (numba)": 1.0, "other": 2.5}, "two": {"uncompressed": 1.0}})
    render(figure)
    assert [axis.get_title("left") for axis in axes] == ["one", "two"]
    assert [[bar.get_width() for bar in axis.patches] for axis in axes] == [[1.0, 2.5], [1.0]]
    assert [text.get_text() for text in axes[0].texts] == ["dejavu (numba)", "other", "1.0", "2.5"]
    colours = [bar.get_facecolor()[:3] for axis in axes for bar in axis.patches]
    expected = [COLOURS["map"], GREY, COLOURS["uncompressed"]]
    assert colours == [pytest.approx(to_rgb(colour)) for colour in expected]


def test_every_contender_that_grows_has_a_style_of_its_own():
    shares = {name: [(1e4, 1.0), (1e5, 0.0)] for name in CONTENDERS}
    figure, axes = plot_growth({"recall@1": shares, "ms": {"dejavu 1 B": [(1e4, 1.0)]}}, ["recall@1"])
    render(figure)
    styles = {(line.get_color(), line.get_marker(), line.get_linestyle()) for line in axes[0].lines}
    assert len(styles) == len(CONTENDERS)
    assert set(CONTENDERS) <= set(texts(figure))
    assert [axis.get_yscale() for axis in axes] == ["linear", "log"]


def test_template_search_times_both_ways_to_the_same_places():
    rows = list(bench_templates((5000, 40_000), queries=2, repeats=1))
    assert [(row["case"], row["contender"]) for row in rows] == [
        (f"templates={places}", name) for places in (5000, 40_000) for name in (OURS, SCAN)
    ]
    for row, phases in zip(rows, (143, 143, 401, 401), strict=True):  # of 71 + 72 and 200 + 201
        assert (row["difference"], row["skipped"], row["threads"]) == (0, None, 1)
        assert 0 < row["seconds"] < 1
        assert 0 <= row["file_bytes"] - 4 * 64 * phases < 1000  # float32, and a few bytes of the layers


@pytest.mark.parametrize("places", [4, 6, 1000, 10**7])
def test_the_periods_are_the_least_that_tell_the_places_apart(places):
    short, long = (
        layer.period.numerator for layer in random_map(places, torch.Generator().manual_seed(0)).plan
    )
    assert (math.gcd(short, long), long) == (1, short + 1)
    assert short * long >= places > (short - 1) * short
