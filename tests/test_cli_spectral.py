"""Whitening and spectral maps as a user of the commands meets them."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import TEMPLATES, fails, frames, report_of, run
from processes import PACKAGE, python

from dejavu_torch import DejaVu, SequenceMatcher, SpectralMapper, open_source
from dejavu_torch.cli.commands import run_learn
from dejavu_torch.cli.parser import parse
from dejavu_torch.features import distilled, views
from dejavu_torch.maps.file import read_map
from dejavu_torch.recognition import coarse
from dejavu_torch.resize import resize_frames

ROUTE = "sim:aerial?frames=96"
SECOND = "sim:aerial?frames=96&traverse=1"
THIRD = "sim:aerial?frames=96&traverse=2"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A spectral map of the route, and frames and features in files."""
    folder = tmp_path_factory.mktemp("spectral")
    run("learn", ROUTE, "--map", folder / "m.safetensors")
    np.save(folder / "a.npy", frames(64, seed=1))
    np.save(folder / "b.npy", frames(64, seed=2))
    np.save(folder / "c.npy", frames(50, seed=3))
    return folder


def model_of(*words):
    model = parse("learn", run_learn, ["x", "--map", "y", *map(str, words)])["model"]
    assert isinstance(model, DejaVu)
    return model


def same_maps(first, second):
    (one, header), (other, other_header) = read_map(first), read_map(second)
    return header == other_header and all(torch.equal(one[name], other[name]) for name in one)


# what works


def test_searches_of_localize(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(coarse, "MIN_PLACES", 0)  # as a long map is searched
    monkeypatch.setattr(coarse, "DECODED", 0)
    path, out = tmp_path / "m.safetensors", tmp_path / "m.csv"
    run("learn", ROUTE, "--map", path, "--mapper.chunk", "32", "--features", "HOG")
    found = []
    for search in ("scan", "exact", "auto"):
        run("localize", path, SECOND, "--match", "single", "--search", search, "--out", out)
        found.append(places(out))
    assert found[0] == found[1]
    assert sum(a == b for a, b in zip(found[0], found[2], strict=True)) > 90
    assert "scan" in fails(capsys, "localize", path, SECOND, "--search", "ivf", "--out", out)
    for memory, words in (("0", "search_memory 0"), ("1e-4", "expected at least")):
        single = "--match", "single", "--search_memory", memory
        assert words in fails(capsys, "localize", path, SECOND, *single, "--out", out)
    run("info", path)
    assert "single queries: samples every" in capsys.readouterr().out


def places(path):
    with path.open() as file:
        return [row["place"] for row in csv.DictReader(file)]


def test_two_processes_write_the_same_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(distilled, "resize_frames", resize_frames)  # as it is there
    kinds = {"spectral": ("--whitening.views", "2"), "templates": TEMPLATES}
    words = {name: ["learn", ROUTE, *kind, "--map"] for name, kind in kinds.items()}
    there = [[*line, f"{tmp_path}/{name}.there.safetensors"] for name, line in words.items()]
    code = (
        "import json, sys, torch\n"
        "from dejavu_torch.cli import main; from dejavu_torch.features import views\n"
        f"torch.set_num_threads({torch.get_num_threads()})\nviews.FEWEST = {views.FEWEST}\n"  # as it is here
        "for line in json.load(sys.stdin): main(line)"
    )
    assert python(code, input=json.dumps(there), imports=PACKAGE).returncode == 0
    for name, line in words.items():
        run(*line, tmp_path / f"{name}.here.safetensors")
        here, other = (tmp_path / f"{name}.{where}.safetensors" for where in ("here", "there"))
        assert here.read_bytes() == other.read_bytes()


def test_learn_and_info_tell_what_the_map_holds(folder, capsys):
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
        assert "1764 + 1440 to 48 dimensions" in told
        assert "views=2" in told
        assert "less than half" not in told
    assert "route_bytes_per_place=None" in info


def test_a_seed_makes_the_copies_and_nothing_else_is_drawn(folder):
    paths = [folder / f"seed{i}.safetensors" for i in range(3)]
    run("learn", ROUTE, "--map", paths[0], "--seed", "3")
    run("learn", ROUTE, "--map", paths[1], "--seed", "3")
    run("learn", ROUTE, "--map", paths[2], "--seed", "4", "--whitening.seed", "3")
    assert same_maps(paths[0], paths[1])
    assert same_maps(paths[0], paths[2])
    assert not same_maps(paths[0], folder / "m.safetensors")


def test_options_of_parts_and_null_the_whitening_that_suits_the_mapper():
    model = model_of("--whitening.views", "2", "--mapper.route_bytes_per_place=null", "--mapper.step", "0.1")
    assert isinstance(model.mapper, SpectralMapper)
    assert model.whitening is not None
    assert (model.whitening.views, model.mapper.step) == (2, 0.1)
    assert model_of("--whitening=none").whitening is None
    assert model_of("--whitening", "null").whitening is not None
    assert model_of(*TEMPLATES, "--whitening", "null").whitening is None


def test_the_whitening_of_another_map_with_what_is_ahead_of_it(folder):
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


def test_whitening_learns_from_several_visits(folder):
    fourth = ROUTE + "&traverse=3"
    both = f"['{THIRD}','{fourth}']"
    given = {
        "both": (both,),
        "one": (THIRD,),
        "named": (both, "--second_truth", f"[null,'{folder}/fourth.csv']"),
    }
    (folder / "fourth.csv").write_text("\n".join(f"{i},{i}" for i in range(40)))
    for name, words in given.items():
        run("learn", ROUTE, "--map", folder / f"{name}.safetensors", "--second", *words)
    assert not same_maps(folder / "both.safetensors", folder / "one.safetensors")
    assert not same_maps(folder / "both.safetensors", folder / "named.safetensors")  # of the fourth 40 frames
    run("compare", ROUTE, SECOND, "--map", folder / "both.safetensors", "--out", folder / "of_both")
    assert report_of(folder / "of_both")["recall_at_1"] > 0.9


# what is refused


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--mapper.hold .9 --mapper.step .5", ("step is 0.5 and hold is 0.9; expected one of them",)),
        ("--mapper.periods.window 64", ("--mapper", "unrecognized", "periods.window")),
        ("--whitening m.safetensors", ("(64, 1764)", "(B, 3204)")),
        ("--whitening m.safetensors --whitening.views 2", ("--whitening.views", "no settings")),
        ("--whitening=m.safetensors --preprocess.patch 5", ("--preprocess.patch", "has its own")),
        ("--whitening m.safetensors --features.cell 16", ("learned with Joined; got HOG",)),
        ("--whitening m.safetensors --second b.npy", ("another map's",)),
        ("--second_truth 0", ("--second_truth 0", "--second SOURCE")),
        ("--second []", ("no traverses", "at least one")),
        ("--second [b.npy,./b.npy]", ("--second ./b.npy is b.npy itself",)),
        ("--second [b.npy,a.npy]", ("--second a.npy is a.npy itself",)),
        ("--second [b.npy,c.npy] --second_truth [0,0,0]", ("2 further traverses and 3 truths",)),
        ("--filter", ("unrecognized arguments: --filter",)),
    ],
)
def test_settings_that_do_not_fit(folder, words, told, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    error = fails(capsys, "learn", "a.npy", "--map", "new.safetensors", *words.split())
    assert [word for word in told if word not in error] == [], error
    assert not Path("new.safetensors").exists()


@pytest.fixture
def noisy(tmp_path):
    """Two traverses of which single frames are hard to find."""
    noise = np.random.default_rng(0)
    walk = noise.normal(size=(200, 8)).cumsum(0)
    for name in ("one", "two"):
        np.save(tmp_path / f"{name}.npy", (walk + 3 * noise.normal(size=(200, 8))).astype(np.float32))
    return tmp_path / "one.npy", tmp_path / "two.npy"


def assert_same_matches(one, other):
    """Equal but for rounding: a command that localizes alone multiplies other batches."""
    tables = [list(csv.DictReader(path.open(newline=""))) for path in (one, other)]
    scores = [[float(row.pop("score")) for row in table] for table in tables]
    assert tables[0] == tables[1]
    assert scores[0] == pytest.approx(scores[1], rel=1e-5)


def test_a_sequence_is_of_the_map_and_of_all_beside_it(noisy, tmp_path, capsys):
    one, two = noisy
    run("compare", one, two, "--truth", 0, "--tolerance", 1, "--sequence", 9, "--out", tmp_path / "9")
    report = report_of(tmp_path / "9")
    assert report["sequence"] == 9
    table = re.search(r"^AUC +T = 1 +T = 5 +T = 9 +T = 11 +T = 21\n(.*)$", capsys.readouterr().out, re.M)
    assert table is not None
    areas = [f"{scores['auc']:.3f}" for scores in report["sequences"].values()]
    assert table[1].split() == ["this", "map", *areas]
    assert (tmp_path / "9" / "sequences.png").exists()
    assert "together with the 8 before it" in (tmp_path / "9" / "index.html").read_text()
    for contender in (report, report["uncompressed"], report["interpolated"]):
        assert contender["auc"] > contender["sequences"]["1"]["auc"]

    matches = tmp_path / "matches.csv"
    known = tmp_path / "9" / "map.safetensors"
    run("localize", known, two, "--sequence", 9, "--out", matches)
    assert_same_matches(matches, tmp_path / "9" / "matches.csv")
    run("localize", known, two, "--sequence", 9, "--speeds", "[2]", "--out", matches)
    expected = DejaVu.load(known).localize(open_source(two), sequence=SequenceMatcher(9, (2.0,)))
    assert places(matches) == [str(place) for place in expected.index.tolist()]
