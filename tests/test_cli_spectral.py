"""Whitening and spectral maps as a user of the commands meets them."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import TEMPLATES, fails, frames, report_of, run
from footage import QUERY, REFERENCE, SIDE, STEP, footage
from helpers import refused

from dejavu_torch import DejaVu, SpectralMapper
from dejavu_torch.cli.commands import run_learn
from dejavu_torch.cli.parser import parse
from dejavu_torch.features import views
from dejavu_torch.maps.file import read_map
from dejavu_torch.maps.spectral_map import SpectralMap

ROUTE = "sim:aerial?frames=96"
SECOND = "sim:aerial?frames=96&traverse=1"
THIRD = "sim:aerial?frames=96&traverse=2"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A spectral map of the route, and frames and features in files."""
    folder = tmp_path_factory.mktemp("spectral")
    run("learn", ROUTE, "--map", folder / "m.safetensors")
    noise = np.random.default_rng(0)
    np.save(folder / "a.npy", frames(64, seed=1))
    np.save(folder / "b.npy", frames(64, seed=2))
    np.save(folder / "c.npy", frames(50, seed=3))
    np.save(folder / "noise.npy", noise.normal(size=(900, 100)).astype(np.float32))
    return folder


def model_of(*words: str | Path) -> DejaVu:
    model = parse("learn", run_learn, ["x", "--map", "y", *map(str, words)])["model"]
    assert isinstance(model, DejaVu)
    return model


def same_maps(first: Path, second: Path) -> bool:
    (one, header), (other, other_header) = read_map(first), read_map(second)
    return header == other_header and all(torch.equal(one[name], other[name]) for name in one)


# what works


def test_searches_of_localize(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = tmp_path / "m.safetensors", tmp_path / "m.csv"
    run("learn", ROUTE, "--map", path, "--mapper.chunk", "32", "--whitening.views", "2")
    found = []
    for search in ("auto", "scan"):
        run("localize", path, SECOND, "--search", search, "--out", out)
        found.append(places(out))
    assert found[0] == found[1]
    run("localize", path, SECOND, "--filter", "--out", out)
    always = places(out)
    run("localize", path, SECOND, "--filter", "--search_every", "8", "--out", out)
    assert sum(a == b for a, b in zip(places(out), always, strict=True)) > 90
    options = (("--search", "all"), ("--search", "ivf"), ("--search_every", "8"))
    for words, facts in zip(
        options, (("all",), ("ivf", "scan"), ("--search_every 8", "--filter")), strict=True
    ):
        error = fails(capsys, "localize", path, SECOND, *words, "--out", out)
        assert [fact for fact in facts if fact not in error] == []


def places(path: Path) -> list[str]:
    with path.open() as file:
        return [row["place"] for row in csv.DictReader(file)]


def test_two_processes_write_the_same_bytes(tmp_path: Path) -> None:
    kinds = {"spectral": ("--whitening.views", "2"), "templates": TEMPLATES}
    words = {name: ["learn", ROUTE, *kind, "--map"] for name, kind in kinds.items()}
    there = [[*line, f"{tmp_path}/{name}.there.safetensors"] for name, line in words.items()]
    code = (
        "import json, sys; from dejavu_torch.cli import main; from dejavu_torch.features import views\n"
        f"views.FEWEST = {views.FEWEST}\nfor line in json.load(sys.stdin): main(line)"  # as it is here
    )
    environment = os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())}
    python, told = [sys.executable, "-c", code], json.dumps(there).encode()
    subprocess.run(python, input=told, check=True, capture_output=True, env=environment)
    for name, line in words.items():
        run(*line, tmp_path / f"{name}.here.safetensors")
        here, other = (tmp_path / f"{name}.{where}.safetensors" for where in ("here", "there"))
        assert here.read_bytes() == other.read_bytes()


def test_learn_and_info_tell_what_the_map_holds(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "told.safetensors"
    run("learn", ROUTE, "--map", path, "--whitening.views", "2")
    learned = capsys.readouterr().out
    run("info", path)
    info = capsys.readouterr().out
    summary = DejaVu.load(path).summary()
    assert summary.map_bytes == path.stat().st_size
    per_place = summary.route_bytes / 96
    for told in (learned, info):
        assert f"{summary.map_bytes} bytes" in told
        assert f"{summary.route_bytes} of the route, {per_place:.2f} per place" in told
        assert f"{summary.fixed_bytes} fixed" in told
        assert f"whitening {summary.fixed['whitening']}" in told
        assert "1764 to 24 numbers" in told
        assert "views=2" in told
        assert "needs about" not in told
    assert "route_bytes_per_place=None" in info


def test_a_seed_makes_the_copies_and_nothing_else_is_drawn(folder: Path) -> None:
    paths = [folder / f"seed{i}.safetensors" for i in range(3)]
    run("learn", ROUTE, "--map", paths[0], "--seed", "3")
    run("learn", ROUTE, "--map", paths[1], "--seed", "3")
    run("learn", ROUTE, "--map", paths[2], "--seed", "4", "--whitening.seed", "3")
    assert same_maps(paths[0], paths[1])
    assert same_maps(paths[0], paths[2])
    assert not same_maps(paths[0], folder / "m.safetensors")


def test_options_of_parts() -> None:
    options = ["--whitening.views", "2", "--mapper.route_bytes_per_place", "2.5", "--mapper.chunk", "100"]
    model = model_of(*options)
    assert isinstance(model.mapper, SpectralMapper)
    assert model.whitening is not None
    assert (model.whitening.views, model.mapper.route_bytes_per_place, model.mapper.chunk) == (2, 2.5, 100)
    plain = model_of("--whitening", "dejavu_torch.Whitening", "--whitening.numbers", "64")
    assert plain.whitening is not None
    assert plain.whitening.numbers == 64
    stepped = model_of("--mapper.route_bytes_per_place", "null", "--mapper.step", "0.1")
    assert stepped.mapper.step == 0.1


def test_null_is_the_whitening_that_suits_the_mapper() -> None:
    assert model_of("--whitening=none").whitening is None
    assert model_of("--whitening", "null").whitening is not None
    assert model_of(*TEMPLATES, "--whitening", "null").whitening is None


def test_the_whitening_of_another_map_with_what_is_ahead_of_it(folder: Path) -> None:
    path, own = folder / "coarse.safetensors", folder / "own.safetensors"
    options = "--features.cell", "16", "--preprocess.contrast", "patch", "--whitening.numbers", "9"
    plain = "--calibration", "none"
    run("learn", ROUTE, "--map", path, *options, *plain)
    run("learn", THIRD, "--map", own, "--whitening", path, "--seed", "5", *plain)
    known, model = DejaVu.load(path), DejaVu.load(own)
    assert known.whitening is not None
    assert model.whitening is not None
    assert torch.equal(model.whitening.projection, known.whitening.projection)
    assert repr(model.whitening) == repr(known.whitening)
    assert (model.features.cell, model.preprocess.contrast) == (16, "patch")
    run("compare", ROUTE, SECOND, "--whitening", path, *plain, "--out", folder / "fixed")
    assert report_of(folder / "fixed")["recall_at_1"] > 0.8


def test_compare_learns_its_whitening_from_a_third_traverse(folder: Path) -> None:
    out = folder / "third"
    run("compare", ROUTE, SECOND, "--second", THIRD, "--seed", "1", "--out", out)
    run("learn", ROUTE, "--map", folder / "third.safetensors", "--second", THIRD, "--seed", "1")
    assert same_maps(out / "map.safetensors", folder / "third.safetensors")
    assert not same_maps(out / "map.safetensors", folder / "m.safetensors")
    assert report_of(out)["recall_at_1"] > 0.9
    assert report_of(out)["kind"] == "spectral"


def test_the_seed_of_compare_shuffles_the_null(folder: Path) -> None:
    pair = folder / "a.npy", folder / "b.npy", "--truth", "0", *TEMPLATES
    for seed in (0, 1):
        run("compare", *pair, "--seed", str(seed), "--out", folder / f"null{seed}")
    first, second = (report_of(folder / f"null{seed}") for seed in (0, 1))
    assert first["auc"] == second["auc"]
    assert first["null_same_plan"] != second["null_same_plan"]


def test_a_second_traverse_of_another_length_by_its_truth(folder: Path) -> None:
    (folder / "some.csv").write_text("query,place\n" + "".join(f"{q},{q + 8}\n" for q in range(20, 50)))
    for name, truth in (("offset", "8"), ("csv", folder / "some.csv")):
        path = folder / f"{name}.safetensors"
        second = "--second", folder / "c.npy", "--second_truth", truth
        run("learn", folder / "a.npy", "--map", path, *second)
        assert DejaVu.load(path).map.places == 64


def test_a_second_traverse_is_resampled_as_the_reference_is(tmp_path: Path) -> None:
    for name, where in (("reference", REFERENCE), ("second", QUERY)):
        np.save(tmp_path / f"{name}.npy", (255 * footage(where, 0.02)[:, 0]).byte().numpy())
    nearest = (REFERENCE - QUERY[:, None]).abs().argmin(1).tolist()
    rows = "".join(f"{q},{p}\n" for q, p in enumerate(nearest))
    (tmp_path / "truth.csv").write_text("query,place\n" + rows)
    corners = ["--velocity.corners", "[[0,0],[1,0],[1,1],[0,1]]", "--velocity.size", f"[{SIDE},{SIDE}]"]
    options = [*corners, "--velocity.step", str(STEP), "--second", tmp_path / "second.npy"]
    path = tmp_path / "m.safetensors"
    truth = "--second_truth", tmp_path / "truth.csv"
    run("learn", tmp_path / "reference.npy", "--map", path, *options, *truth)
    assert DejaVu.load(path).map.places == 101


def test_a_route_of_noise_says_what_it_needs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, options = folder / "noise.npy", ("--whitening", "none")
    budget = "--mapper.route_bytes_per_place", "1"
    run("learn", source, "--map", folder / "noise.safetensors", *options, *budget)
    (line,) = [told for told in capsys.readouterr().out.splitlines() if "needs about" in told]
    needed = line.removeprefix("this route needs about ").removesuffix(" bytes per place")
    assert 5 < float(needed) < 20
    run("compare", source, source, *options, *budget, "--out", folder / "noise")
    assert line in capsys.readouterr().out.splitlines()
    run("learn", source, "--map", folder / "n.safetensors", *options, *budget[:1], needed)
    assert "needs about" not in capsys.readouterr().out


# what is refused

OWNER = "has no such setting", "TemplateMapper has"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--mapper.route_bytes_per_place", "0.5"], ("route_bytes_per_place is 0.5", "the mean")),
        (["--mapper.route_bytes_per_place", "900"], ("route_bytes_per_place is 900", "at most 96")),
        (
            ["--mapper.step", "0.1", "--mapper.route_bytes_per_place", "5"],
            ("5.0", "step is 0.1", "one of them"),
        ),
        (["--whitening.numbers", "120"], ("numbers is 120", "rank 95")),
        (["--whitening.strengths.colour2", "0"], ("colour2", "expected colour, rotation")),
        (["--whitening", "dejavu_torch.HOG"], ("whitening", "dejavu_torch.HOG")),
        (["--whitening", "nowhere.safetensors"], ("nowhere.safetensors is not there",)),
        (["--mapper.periods.window", "64"], ("--mapper.periods: the chosen", *OWNER, "local_maxima")),
        (["--mapper.step=1", *TEMPLATES], ("--mapper.step: the chosen", "SpectralMapper has", "default")),
        (
            ["--mapper", "TemplateMapper", "--mapper.route_bytes_per_place", "2"],
            ("route_bytes_per_place: the chosen",),
        ),
        (["--second_truth", "0"], ("--second_truth 0", "--second")),
        (["--second", ROUTE], ("views", "a second traverse")),
        (["--second", SECOND, "--whitening", "none"], ("no whitening", "traverse=1")),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_settings_that_do_not_fit(
    options: list[str], words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "m.safetensors"
    source = "sim:aerial?frames=96"
    error = fails(capsys, "learn", source, "--map", path, *options)
    assert [word for word in words if word not in error] == [], error
    assert not path.exists()


def test_views_that_do_not_vary(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pairs = {"colour": [0, 0], "exposure": [0, 0], "shift": [0, 0]}
    numbers = dict.fromkeys(("rotation", "scale", "gamma", "illumination", "blur", "occlusion", "noise"), 0)
    strengths = f"--whitening.strengths={json.dumps(pairs | numbers)}"
    error = fails(capsys, "learn", ROUTE, "--map", tmp_path / "m.safetensors", strengths)
    assert "views differ from those of their places by 0 " in error


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.full((80, 20), 0.5, np.float32), ("80 descriptors", "all alike")),
        (np.full((80, 20), np.nan, np.float32), ("frame 0", "NaN")),
        (np.ones((1, 20), np.float32), ("(1, 20)", "at least 2")),
        (np.full((40, 32, 32), 90, np.uint8), ("40 descriptors", "all alike")),
        (frames(1), ("1", "at least 2")),
    ],
    ids=["constant", "nan", "one", "grey", "one frame"],
)
def test_what_is_no_route(
    values: np.ndarray, words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "a.npy", values)
    path = tmp_path / "m.safetensors"
    error = fails(capsys, "learn", tmp_path / "a.npy", "--map", path)
    assert [word for word in words if word not in error] == [], error


def test_a_second_traverse_that_does_not_fit(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    np.save("other.npy", frames(64, size=48)[:, :40])
    learn = "learn", "a.npy", "--map", "new.safetensors"
    error = fails(capsys, *learn, "--second", "c.npy")
    assert "c.npy has 50 frames and a.npy 64" in error
    assert "second_truth" in error
    assert "no query has a right answer" in fails(capsys, *learn, "--second", "c.npy", "--second_truth", "70")
    assert "720 features; expected 324" in fails(capsys, *learn, "--second", "other.npy")
    for same in ("b.npy", folder / "b.npy"):
        error = fails(capsys, "compare", "a.npy", "b.npy", "--second", same, "--out", "r")
        assert f"--second {same} is the query itself" in error
    assert not Path("r").exists()
    assert not Path("new.safetensors").exists()


def test_a_whitening_that_does_not_fit(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known, new = folder / "m.safetensors", folder / "new.safetensors"
    learn = "learn", folder / "a.npy", "--map", new
    error = fails(capsys, *learn, "--whitening", known)
    assert "(64, 324)" in error
    assert "(B, 1764)" in error
    assert "--whitening.views" in fails(capsys, *learn, "--whitening", known, "--whitening.views", "2")
    assert "--preprocess.patch" in fails(capsys, *learn, f"--whitening={known}", "--preprocess.patch", "5")
    assert "cell=16" in fails(capsys, *learn, "--whitening", known, "--features.cell", "16")
    assert "another map's" in fails(capsys, *learn, "--whitening", known, "--second", folder / "b.npy")
    plain = folder / "plain.safetensors"
    run("learn", folder / "a.npy", "--map", plain, *TEMPLATES)
    assert "without whitening" in fails(capsys, *learn, "--whitening", plain)
    assert not new.exists()


@pytest.mark.parametrize("damage", ["cut", "altered", "short", "whitening"])
def test_a_damaged_map_is_refused(
    damage: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.safetensors"
    whole = (folder / "m.safetensors").read_bytes()
    route = DejaVu.load(folder / "m.safetensors").map
    assert isinstance(route, SpectralMap)
    lines = route.packed()["streams"].numpy().tobytes()
    at = whole.index(lines)
    if damage == "cut":
        path.write_bytes(whole[:-50])
    elif damage == "altered":
        path.write_bytes(whole[: at + 9] + bytes([whole[at + 9] ^ 16]) + whole[at + 10 :])
    elif damage == "short":
        path.write_bytes(whole[:at] + bytes(len(lines)) + whole[at + len(lines) :])
    else:
        path.write_bytes(whole.replace(b"whitening.scale", b"whitening.skale"))
    error = fails(capsys, "localize", path, SECOND, "--out", tmp_path / "m.csv")
    assert str(path) in error
    with refused(str(path)):
        DejaVu.load(path)
    assert not (tmp_path / "m.csv").exists()


@pytest.fixture
def noisy(tmp_path: Path) -> tuple[Path, Path]:
    """Two traverses of which single frames are hard to find."""
    noise = np.random.default_rng(0)
    walk = noise.normal(size=(200, 8)).cumsum(0)
    for name in ("one", "two"):
        np.save(tmp_path / f"{name}.npy", (walk + 3 * noise.normal(size=(200, 8))).astype(np.float32))
    return tmp_path / "one.npy", tmp_path / "two.npy"


def assert_same_matches(one: Path, other: Path) -> None:
    """Equal but for rounding: a command that localizes alone multiplies other batches."""
    tables = [list(csv.DictReader(path.open(newline=""))) for path in (one, other)]
    scores = [[float(row.pop("score")) for row in table] for table in tables]
    assert tables[0] == tables[1]
    assert scores[0] == pytest.approx(scores[1], rel=1e-5)


def test_a_sequence_is_of_the_map_and_of_all_beside_it(
    noisy: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, two = noisy
    reports = {}
    for length in (1, 9):
        words = "--truth", 0, "--tolerance", 1, "--sequence", length
        run("compare", one, two, *words, "--out", tmp_path / f"{length}")
        reports[length] = report_of(tmp_path / f"{length}")
        assert reports[length]["sequence"] == length
        table = re.search(r"^AUC +T = 1 +T = 5 +T = 9 +T = 11 +T = 21\n(.*)$", capsys.readouterr().out, re.M)
        assert (table is not None) == (tmp_path / f"{length}" / "sequences.png").exists() == (length == 9)
        page = (tmp_path / f"{length}" / "index.html").read_text()
        assert ("together with the 8 before it" in page) == (length == 9)
    areas = [f"{scores['auc']:.3f}" for scores in reports[9]["sequences"].values()]
    assert table is not None
    assert table[1].split() == ["this", "map", *areas]
    for key in ("uncompressed", "interpolated", "stride"):
        assert reports[9][key]["auc"] > reports[1][key]["auc"]
    assert reports[9]["null"]["auc"] != reports[1]["null"]["auc"]
    assert reports[9]["auc"] > reports[1]["auc"]

    matches = tmp_path / "matches.csv"
    run("localize", tmp_path / "9" / "map.safetensors", two, "--sequence", 9, "--out", matches)
    assert_same_matches(matches, tmp_path / "9" / "matches.csv")


def test_a_filter_is_of_the_map_and_of_all_beside_it(
    noisy: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, two = noisy
    out = tmp_path / "out"
    run("compare", one, two, "--truth", 0, "--filter", "--out", out)
    report = report_of(out)
    assert (report["filter"], report["sequence"]) == (True, 1)
    assert report["auc"] > report["sequences"]["1"]["auc"]
    assert "a filter over all queries" in (out / "index.html").read_text()
    assert (out / "posterior.png").exists()
    for key in ("uncompressed", "null"):
        assert report[key]["auc"] != report[key]["sequences"]["1"]["auc"]

    matches, route = tmp_path / "matches.csv", out / "map.safetensors"
    run("localize", route, two, "--filter", "--out", matches)
    assert_same_matches(matches, out / "matches.csv")
    rows = list(csv.DictReader(matches.open(newline="")))
    assert {row["accepted"] for row in rows} == {"0", "1"}
    assert all((float(row["score"]) < math.log(2)) == (row["accepted"] == "1") for row in rows)
    assert report["threshold"] == pytest.approx(math.log(2))  # ready features are not calibrated
    assert report["least_probability"] is None
    run("compare", one, two, "--truth", 0, "--filter", "--threshold", 0.1, "--out", out)
    assert report_of(out)["threshold"] == 0.1
    assert DejaVu.load(route).threshold is None  # it is none of single queries
    run("localize", route, two, "--filter", "--threshold", 100, "--top", 2, "--out", matches)
    rows = list(csv.DictReader(matches.open(newline="")))
    assert len(rows) == 400
    assert {row["accepted"] for row in rows} == {"1"}
    capsys.readouterr()


def test_a_sequence_takes_the_best_of_several_speeds(noisy: tuple[Path, Path], tmp_path: Path) -> None:
    one, two = noisy
    half = tmp_path / "half.npy"
    np.save(half, np.load(two)[::2])
    run("learn", one, "--map", tmp_path / "m.safetensors")
    right = {}
    for speeds in ("[1]", "[2]", "[1,2]"):
        out = tmp_path / "matches.csv"
        words = ("--sequence", 9, "--speeds", speeds, "--out", out)
        run("localize", tmp_path / "m.safetensors", half, *words)
        found = [int(row["place"]) for row in csv.DictReader(out.open(newline=""))]
        right[speeds] = sum(abs(place - 2 * i) <= 1 for i, place in enumerate(found))
    assert right["[2]"] > right["[1,2]"] > right["[1]"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--sequence", "0"], ["a sequence of 0 queries"]),
        (["--sequence", str(2**53)], ["at most 65536"]),
        (["--filter", "--moves", "[1,1]"], ["moves are [1.0, 1.0]", "add up to 1"]),
        (["--filter", "--tolerance", "-1"], ["tolerance is -1"]),
        (["--sequence", "9", "--speeds", "[]"], ["speeds are []"]),
        (["--sequence", "9", "--speeds", "[1,500]"], ["9 queries at 500 places a query", "200 places"]),
        (["--sequence", "300"], ["300 queries", "200 places"]),
    ],
)
def test_bad_sequences_are_refused(
    words: list[str],
    told: list[str],
    noisy: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    error = fails(capsys, "compare", *noisy, *words, "--out", tmp_path / "out")
    assert all(text in error for text in told)
    assert not (tmp_path / "out").exists()
