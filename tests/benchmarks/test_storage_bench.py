"""`python -m benchmarks storage`: which contenders, what is scored, what is written, and what is refused."""

from __future__ import annotations

import json

import av
import numpy as np
import pytest
import torch
from command_line import benchmark, benchmark_fails, run
from helpers import all_of

from benchmarks import storage
from benchmarks.coded_video import CodedVideo
from benchmarks.measure import new_row
from benchmarks.storage import (
    KEYS,
    bytes_for,
    contenders_of,
    described,
    equal_areas,
    front,
    judged,
    skipped_lines,
)
from dejavu_torch import DejaVu, open_source
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
def bench(pair, tmp_path_factory):
    out = tmp_path_factory.mktemp("bench") / "out"
    benchmark("storage", *pair, "--out", out)
    assert sorted(path.name for path in out.iterdir()) == ["bench.json", "bench.png"]
    return json.loads((out / "bench.json").read_text())


@pytest.fixture(scope="module")
def rows(bench):
    return bench["rows"]


@pytest.fixture(scope="module")
def route():
    """The pair in memory, and another route for codebooks and a whitening."""
    reference, query, other = (ArrayTraverse(series(seed)) for seed in (0, 1, 5))
    return described("pair", reference, query, other=other)


def row_of(route, name):
    return judged(route, next(one for one in contenders_of(route) if one.name == name))


def test_all_families_are_there_and_what_is_skipped_says_why(bench, rows):
    pytest.importorskip("faiss")
    assert {entry["T"] for entry in bench["equal_auc"]} == {1, 5, 11, 21}
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


@pytest.mark.skipif("libx264" not in av.codecs_available, reason="no libx264")
def test_fewer_bytes_of_a_video_give_back_less():
    traverse = open_source("sim:aerial?frames=40")
    fine, coarse, third = (CodedVideo(traverse, "libx264", *of) for of in ((10, 1), (45, 1), (10, 3)))
    assert fine.bytes > 2 * coarse.bytes > 0
    assert third.bytes < fine.bytes
    frames = all_of(traverse)
    errors = [float((all_of(coded) - frames).square().mean()) for coded in (fine, coarse)]
    still = float((frames[torch.randperm(40)] - frames).square().mean())
    assert errors[0] < min(errors[1], still / 4)  # and in their order
    last = (all_of(third)[-1] - frames).square().mean((1, 2, 3))
    assert (len(third), int(last.argmin())) == (14, 39)


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
    "drives data --routes moon": ["'moon' is unknown", "'city 1'"],
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
    "scale --contenders grep": ["contenders are ['grep']", "faiss flat"],
    "results data --ways all": ["expected one of 'default'"],
    "results data --jobs 0": ["0 jobs"],
    "results data --footage moon": ["no footage"],
    "trainings data --options=--foo'": ["No closing quotation"],
    "trainings data --routes roads": ["expected one of 'road, first half'"],
    "trainings data --jobs 0": ["at least one"],
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
