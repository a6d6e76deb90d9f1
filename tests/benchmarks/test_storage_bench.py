"""`python -m benchmarks storage`: which contenders, what is scored, what is written, and what is refused."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
import torch
from command_line import benchmark, benchmark_fails, run

from benchmarks import storage
from benchmarks.measure import PROCESS, Contender, new_row
from benchmarks.plots import plot_frontiers
from benchmarks.storage import (
    KEYS,
    bench_storage,
    bytes_for,
    contenders_of,
    described,
    equal_areas,
    front,
    judged,
    skipped_lines,
    storage_tables,
    stores_of,
    whitenings,
)
from dejavu_torch import DejaVu
from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.maps.spectral import SpectralMapper

PLACES, NUMBERS = 300, 24


def series(seed):
    """Smooth numbers, the same for all seeds, and noise of this one."""
    profile, noise = (torch.Generator().manual_seed(one) for one in (7, seed))
    walk = torch.randn(PLACES, NUMBERS, generator=profile).cumsum(0)
    return walk + torch.randn(PLACES, NUMBERS, generator=noise)


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pair")
    for name, seed in (("a", 0), ("b", 1)):
        np.save(folder / f"{name}.npy", series(seed).numpy())
    return str(folder / "a.npy"), str(folder / "b.npy")


@pytest.fixture(scope="module")
def rows(pair):
    return list(bench_storage(pair))


@pytest.fixture(scope="module")
def route():
    """The pair in memory, and another route for codebooks and a whitening."""
    reference, query, other = (ArrayTraverse(series(seed)) for seed in (0, 1, 5))
    return described("pair", reference, query, other=other)


def row_of(route, name):
    return judged(route, next(one for one in contenders_of(route) if one.name == name))


def test_all_families_are_there_and_what_is_skipped_says_why(rows):
    pytest.importorskip("faiss")
    ran = {row["family"] for row in rows if row["skipped"] is None}
    stores = {"dejavu", "null", "frames", "interpolated", "PCA", "binary", "PQ, own codebooks"}
    assert ran == stores | {"dejavu, other whitenings", "RaBitQ", "EDEN", "OPQ, own codebooks"}
    assert [row["contender"] for row in rows[:3]] == ["dejavu 0.25", "dejavu 0.5", "dejavu 1"]
    assert {row["answer"] for row in rows} == {"one"}
    assert len({row["contender"] for row in rows}) == len(rows)
    reasons = {row["skipped"] for row in rows if row["family"] in storage.CODES}
    assert reasons == {"no other route to train codebooks on; expected --codebooks SOURCE"}
    video = [row["skipped"] or "" for row in rows if row["family"] == "video"]
    assert all("ready features" in reason for reason in video)
    assert any("--codebooks" in line for line in skipped_lines(rows))


def test_all_bytes_are_counted_fixed_and_growing_apart(rows):
    found = {row["contender"]: row for row in rows}
    whole, ours = found["whole database, float"], found["dejavu 5"]
    columns = NUMBERS + 1  # ready features: a constant number behind them
    assert whole["route_bytes"] == PLACES * columns * 4
    assert whole["fixed_bytes"] == ours["fixed_bytes"]
    assert whole["fixed_bytes"] >= NUMBERS * NUMBERS // 2  # the whitening, 4 bits a number
    assert whole["bytes"] == whole["route_bytes"] + whole["fixed_bytes"]
    assert ours["route_bytes_per_place"] == pytest.approx(5, rel=0.02)
    pca = found["PCA, 4 numbers of every frame, int8"]
    assert pca["route_bytes"] == 4 * PLACES
    assert pca["fixed_bytes"] > whole["fixed_bytes"]
    between = found["PCA, 4 numbers of every 10th frame, int8, interpolated"]
    assert between["route_bytes"] == 4 * (PLACES // 10 + 1)  # the last one too
    assert found["signs of every frame"]["route_bytes"] == PLACES * 4  # of 25 bits


def test_codebooks_count_where_they_are_of_the_route(route):
    pytest.importorskip("faiss")
    names = [f"{key} of every 3rd frame, interpolated" for key in ("PQ4x8np", "OPQ4,PQ4x8np")]
    names = [names[0], *(f"{name}, own codebooks" for name in names)]
    free, own, rotated = (row_of(route, name)["route_bytes"] - 101 * 4 for name in names)
    assert (free, own, rotated) == (0, 256 * 28, 256 * 28 + 28 * 28)  # 25 numbers, padded
    large = row_of(route, "RQ8x8 of every frame, own codebooks")["skipped"]
    assert f"{8 * 256 * 25 / PLACES:.0f} bytes a place" in large
    turned = row_of(route, "RR25,RaBitQ of every 8th frame, interpolated")
    assert turned["route_bytes"] == 39 * (4 + 4)  # a bit a number, and the factor that decoding reads


def test_more_bytes_recognise_more_and_the_whole_database_most(rows):
    found = {row["contender"]: row for row in rows}
    areas = [found[name]["auc"] for name in ("dejavu 0.5", "dejavu 2.5", "whole database, float")]
    assert areas == pytest.approx(sorted(areas))  # but for rounding
    assert areas[0] < areas[-1]
    row = found["dejavu 1"]
    assert row["auc"] > found["null 1"]["auc"]
    assert list(row["sequences"]) == ["1", "5", "11", "21"]
    assert row["sequences"]["1"] == {"auc": row["auc"], "recall_at_1": row["recall_at_1"]}
    model = DejaVu(mapper=SpectralMapper(1.0)).learn(series(0))
    right = (model.localize(series(1)).index - torch.arange(PLACES)).abs() <= 5
    assert row["recall_at_1"] == pytest.approx(float(right.float().mean()), abs=0.01)


def test_other_whitenings_take_other_fixed_bytes(route, rows):
    names = (*storage.WHITENINGS, "of another route")
    others = {name: row_of(route, f"dejavu 5, whitening {name}") for name in names}
    sizes = {name: row["fixed_bytes"] for name, row in others.items()}
    assert sizes["16 bits"] > sizes["8 bits"]
    assert route.fixed == sizes["of another route"]
    for row in others.values():
        assert row["skipped"] or row["route_bytes_per_place"] == pytest.approx(5, rel=0.02)
    assert "numbers" in (others["64 numbers"]["skipped"] or "")  # of 24
    shown = whitenings([*rows, others["of another route"]])  # of another case than the rows
    expected = ["the default", "16 bits", "8 bits"]
    assert [[name for name, _, _ in some] for some in shown.values()] == [expected]
    (table,) = [table for table in storage_tables(rows) if "fixed kB" in table]
    assert [line.partition("  ")[0] for line in table.splitlines()[-3:]] == expected
    axes = storage.pictured(rows)[0].axes
    assert axes[1].texts[-1].get_text() == f"16 bits, {sizes['16 bits'] / 1000:.0f} kB"


def test_a_whitening_that_is_given_describes_all(pair, tmp_path, monkeypatch, capsys):
    run("learn", pair[1], "--map", tmp_path / "map.safetensors")
    whitened = []

    def first(route):
        whitened.append(route.places)
        return list(stores_of(route))[1:2]  # a quarter of a byte is too few for 300 places

    monkeypatch.setattr(storage, "stores_of", first)
    benchmark("storage", *pair, "--whitening", tmp_path / "map.safetensors", "--out", tmp_path / "out")
    model = DejaVu.load(tmp_path / "map.safetensors")
    assert torch.equal(whitened[0], model.descriptor.whitened(series(0)))
    written = json.loads((tmp_path / "out" / "bench.json").read_text())["rows"]
    assert [row["family"] for row in written] == ["dejavu", "the paper"]
    DejaVu(whitening="none").learn(series(0)).save(tmp_path / "raw.safetensors")
    words = ("--whitening", tmp_path / "raw.safetensors", "--out", tmp_path / "o")
    assert "without whitening" in benchmark_fails(capsys, "storage", *pair, *words)


def test_the_paper_beside_them(route):
    period = torch.arange(1024)[:, None] % torch.tensor([16, 32])
    wave = (period < torch.tensor([8, 16])).float() + 0.01 * torch.rand(1024, 2)
    row = row_of(described("wave", ArrayTraverse(wave), ArrayTraverse(wave + 0.01)), "the paper")
    assert row["skipped"] is None
    assert row["route_bytes"] > 0
    assert "1024" in row_of(route, "the paper")["skipped"]


def test_what_cannot_be_stored_is_a_row(route, monkeypatch):
    def missing():
        import av

        av.CodecContext.create("libx999", "w")

    assert "libx999" in judged(route, Contender("x999", missing))["skipped"]
    short = described("short", *(ArrayTraverse(series(seed)[:40]) for seed in (0, 1)))
    assert "route_bytes_per_place is 0.5; expected more than" in row_of(short, "dejavu 0.5")["skipped"]
    assert "principal components" in row_of(short, "PCA, 32 numbers of every frame, int8")["skipped"]
    name = "PQ4x8np of every 2nd frame, interpolated, own codebooks"
    if not row_of(route, name)["skipped"]:
        assert "bytes a place; tried up to 32" in row_of(short, name)["skipped"]
    monkeypatch.setitem(sys.modules, "faiss", None)
    assert "faiss" in row_of(route, name)["skipped"]
    assert (row_of(route, "whole database, float")["peak_bytes"] is not None) == PROCESS.exists()


def of(size, auc, family="other"):
    sequences = {"1": {"auc": auc, "recall_at_1": auc}}
    facts = {"seconds": 1.0, "auc": auc, "route_bytes_per_place": size, "sequences": sequences}
    return new_row("case", f"{family} {size}", KEYS, family=family, **facts)


def test_a_front_is_what_nothing_smaller_reaches():
    points = front([of(4, 0.6), of(1, 0.2), of(2, 0.6), of(3, 0.5), of(8, 0.9), of(2, 0.4)])
    assert points == [(1, 0.2), (2, 0.6), (8, 0.9)]
    areas = (0.6, 0.75, 0.1, 0.95)
    assert [bytes_for(area, points) for area in areas] == pytest.approx([2, 4, 1, None])
    assert bytes_for(0.5, []) is None


def test_equal_areas():
    (entry,) = equal_areas([of(1, 0.75, "dejavu"), of(2, 0.6, "null"), of(8, 0.9, "null"), of(3, 0.7)])
    assert (entry["T"], entry["auc"], entry["route_bytes_per_place"]) == (1, 0.75, 1)
    assert entry["bytes_per_place"] == {"null": pytest.approx(4), "other": None}
    assert entry["null_over_ours"] == pytest.approx(4)


def test_what_is_missed_is_set_beside_the_best_rival():
    rows = [of(size, auc, "dejavu") for size, auc in ((1, 0.5), (3.2, 0.9), (5, 0.9999))]
    rivals = [of(1, 0.75), of(1.62, 0.8, "more"), of(5, 0.6)]
    rivals += [of(1, 0.99, other) for other in ("null", storage.GIVEN, storage.PAPER)]
    ratios = (0.5 / 0.25, 0.5 / 0.2, 0.1 / 0.2, 0.002 / 0.2)
    assert storage.missed([*rows, *rivals]) == {"case": pytest.approx(np.prod(ratios) ** 0.25)}
    assert storage.missed(rivals) == {"case": pytest.approx((1 / (0.25 * 0.2**3)) ** 0.25)}


def test_the_tables():
    rows = [of(1, 0.5, "dejavu"), of(3.2, 0.75, "dejavu"), of(1.01, 0.4), of(10, 0.8), of(2, 0.99, "more")]
    skipped = [new_row("case", name, KEYS, family="none", skipped="absent") for name in "abc"]
    best, equal = storage_tables([*rows, *skipped], at=3.2)
    assert best.startswith("case: AUC\n")
    best, _, rest = best.rpartition("(1 - AUC) of dejavu")
    assert f"{storage.missed(rows)['case']:.2f}" in rest
    assert best.split()[-16:] == [
        *("dejavu", "0.500", "0.500", "0.750", "0.750", "0.750"),
        *("other", "0.400", "0.400", "0.400", "0.400", "0.800"),
        *("more", "0.990", "0.990", "0.990"),
    ]
    other = f"{bytes_for(0.75, front(rows[2:4])):.2f}"
    shown = [line.split()[:2] for line in equal.splitlines()]
    assert shown[-4:] == [["AUC", "0.750"], ["dejavu", "3.20"], ["other", other], ["more", "<2.00"]]
    _, equal = storage_tables([of(1, 0.9, "dejavu"), of(1.6, 0.99, "dejavu"), of(2, 0.8)])
    shown = [line.split()[:2] for line in equal.splitlines()]
    assert shown[-3:] == [["AUC", "0.950"], ["dejavu", f"{1.6 ** (5 / 9):.2f}"], ["other", "never"]]
    assert skipped_lines(skipped) == ["case: skipped a and 2 more: absent"]
    assert skipped_lines(skipped[:1]) == ["case: skipped a: absent"]


def test_rows_are_written_as_they_finish_the_map_that_is_given_among_them(pair, tmp_path, monkeypatch):
    seen, out, path = [], tmp_path / "out", tmp_path / "map.safetensors"
    given = "dejavu, map"

    def some(*arguments):
        names = ("dejavu 5", "dejavu 10", "null 5", given)
        return [one for one in contenders_of(*arguments) if one.name in names]

    def watched(*arguments):
        seen.append(len(json.loads((out / "bench.json").read_text())["rows"]) if out.exists() else 0)
        return judged(*arguments)

    monkeypatch.setattr(storage, "contenders_of", some)
    monkeypatch.setattr(storage, "judged", watched)
    run("learn", pair[0], "--map", path, "--mapper.route_bytes_per_place", "5")
    benchmark("storage", *pair, "--map", path, "--out", out)
    assert seen == [0, 1, 2, 3]
    written = json.loads((out / "bench.json").read_text())
    assert {entry["T"] for entry in written["equal_auc"]} == {1, 5, 11, 21}
    assert min(row["ratio_to_ours"] for row in written["rows"] if row["family"] == "dejavu") == 1
    assert sorted(path.name for path in out.iterdir()) == ["bench.json", "bench.png"]
    rows = {row["contender"]: row for row in written["rows"]}
    assert rows[given]["auc"] == pytest.approx(rows["dejavu 5"]["auc"], abs=0.02)
    assert rows[given]["route_bytes"] == pytest.approx(rows["dejavu 5"]["route_bytes"], rel=0.03)


def test_a_line_for_each_family_and_ours_the_thickest():
    fronts = {"dejavu": [(0.5, 0.6), (2.0, 0.9999)], "null": [(1.0, 0.0)], "of a user": [(1.0, 0.5)]}
    figure, axes = plot_frontiers({"one": fronts, "two": {"dejavu": [(1.0, 0.5)]}})
    assert [axis.get_title("left") for axis in axes] == ["one", "two"]
    assert all(axis.get_xscale() == "log" for axis in axes)
    widths = {line.get_label(): line.get_linewidth() for line in axes[0].lines}
    assert max(widths, key=lambda name: widths[name]) == "dejavu"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == list(fronts)


def test_built_in_routes():
    routes = storage.routes_of((), (64, 300), None, False)
    names = ["sim:aerial, 64 places", "sim:aerial, 300 places", "sim:outdoor", "sim:underground"]
    assert [name.startswith(known) for (name, *_), known in zip(routes, names, strict=True)] == [True] * 4
    for route, said in zip(routes[0][1:], ("seed=0&traverse=0", "seed=0&traverse=1", "seed=1"), strict=True):
        assert route is not None
        assert said in route.name


def test_a_truth_and_a_tolerance_that_are_given(pair, tmp_path, monkeypatch):
    monkeypatch.setattr(storage, "contenders_of", lambda route, *_: list(stores_of(route))[:8])
    places = np.load(pair[0])
    np.save(tmp_path / "later.npy", places[100:])
    (tmp_path / "truth.csv").write_text("".join(f"{i},{i + 97}\n" for i in range(200)))
    found = {}
    for tolerance in (2, 3):
        words = ("--truth", tmp_path / "truth.csv", "--tolerance", tolerance, "--out", tmp_path / "out")
        benchmark("storage", pair[0], tmp_path / "later.npy", *words)
        written = json.loads((tmp_path / "out" / "bench.json").read_text())
        assert written["tolerance"] == tolerance
        found[tolerance] = written["rows"][-2]["recall_at_1"]
    assert found[2] < 0.5 < found[3]


REFUSALS = {
    "storage A B --tolerance -1": ["--tolerance -1", "at least 0"],
    "storage --truth 0": ["--truth", "0 sources", "expected 2"],
    "storage A": ["1 sources", "pairs"],
    "storage --map OF_SHORT": ["0 sources", "one pair"],
    "storage A B --map OF_SHORT OF_SHORT": ["short.safetensors", "different names"],
    "storage A B --places 64 300": ["--places", "sim:aerial"],
    "storage --places 1": ["--places 1", "at least 2"],
    "storage --codebooks A": ["--codebooks", "pairs"],
    "storage A nowhere": ["nowhere", "expected"],
    "storage A B A B": ["given twice"],
    "storage A B --drives data": ["--drives", "no other option"],
    "drives data --routes moon": ["'moon' is no route", "'city 1'"],
    "storage A B --map OF_SHORT": ["300 places", "200", "the reference"],
    "storage A B --map OF_NARROW": ["24", "9"],
    "storage A B --whitening OF_NARROW": ["a.npy gives 24", "9 features"],
    "storage A SHORT": ["300 frames", "200", "as many"],
    "storage A NARROW": ["24 features", "9"],
    "matcher sim:aerial": ["unrecognized"],
    "memory --places 7": ["7", "64"],
    "memory --device cuda": ["unrecognized"],
    "scale --places 7": ["7", "500"],
    "scale --device tpu": ["tpu"],
    "train sim:aerial": ["1 sources", "REFERENCE QUERY"],
    "train --steps 0": ["0 steps"],
    "train --seeds -1": ["seeds [-1]", "from 0"],
    "nothing": ["'nothing' is no benchmark", "matcher, storage"],
}


@pytest.mark.parametrize("line", REFUSALS)
def test_what_is_refused(line, pair, tmp_path, capsys):
    np.save(tmp_path / "short.npy", series(1)[:200].numpy())
    np.save(tmp_path / "narrow.npy", series(1)[:, :9].numpy())
    known = {"A": pair[0], "B": pair[1]}
    for name in ("SHORT", "NARROW"):
        known[name], known[f"OF_{name}"] = (
            tmp_path / f"{name.lower()}.{ending}" for ending in ("npy", "safetensors")
        )
        if f"OF_{name}" in line:
            run("learn", known[name], "--map", known[f"OF_{name}"])
    words = [known.get(word, word) for word in line.split()]
    error = benchmark_fails(capsys, *words, "--out", tmp_path / "out")
    assert [word for word in REFUSALS[line] if word not in error] == [], error
    assert not (tmp_path / "out").exists()


def test_pairs_of_other_lengths_that_know_their_places(monkeypatch):
    monkeypatch.setattr(storage, "contenders_of", lambda *_: [])
    pair = [f"sim:aerial?frames=60&stop={stop}&traverse={stop % 2}" for stop in (60, 51)]
    assert list(bench_storage(pair)) == []
