"""`dejavu evaluate`, the truths of `compare`, and options ahead of the features, as a user meets them."""

from __future__ import annotations

import os

import numpy as np
import pytest
from command_line import fails, frames, report_of, run
from PIL import Image


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Two traverses of one route: the second starts four frames later and ends eight frames earlier."""
    folder = tmp_path_factory.mktemp("pair")
    np.save(folder / "first.npy", frames(96, seed=1))
    np.save(folder / "second.npy", frames(96, seed=2)[4:88])
    return folder / "first.npy", folder / "second.npy"


@pytest.fixture(scope="module")
def matches(pair, tmp_path_factory):
    folder = tmp_path_factory.mktemp("matches")
    run("learn", pair[0], "--map", folder / "map.safetensors")
    run("localize", folder / "map.safetensors", pair[1], "--out", folder / "matches.csv")
    return folder / "matches.csv"


def test_evaluate_writes_a_report_and_says_what_was_judged(matches, tmp_path, capsys):
    (tmp_path / "some.csv").write_text("query,place\n0,4\n50,54\n60,-1\n")
    run("evaluate", matches, "--truth", tmp_path / "some.csv", "--tolerance", "2", "--out", tmp_path / "out")
    out = capsys.readouterr().out
    assert "AUC" in out
    assert "right within 2 frames" in out
    assert "3 of the queries are in the truth" in out
    assert "2 of the queries have a right place" in out
    report = report_of(tmp_path / "out")
    assert (report["queries"], report["judged"], report["unknown"], report["with_answer"]) == (84, 3, 81, 2)
    page = (tmp_path / "out" / "index.html").read_text()
    assert "<pre>dejavu evaluate" in page
    assert page.count("data:image/png;base64,") == 3
    assert {file.name for file in (tmp_path / "out").iterdir()} == {
        "report.json",
        "index.html",
        "pr.png",
        "coverage.png",
        "reliability.png",  # the map is calibrated
    }


def test_coordinates_in_image_names_are_a_truth(tmp_path):
    for name, seed, shift in (("first", 1, 0.0), ("second", 2, 3.0)):
        (tmp_path / name).mkdir()
        for i, image in enumerate(frames(64, seed)):
            path = tmp_path / name / f"@{500000 + 10 * i + shift:.2f}@{4000000:.2f}@{i:04d}@.jpg"
            Image.fromarray(image).save(path)
    both = (tmp_path / "first", tmp_path / "second")
    run("compare", *both, "--truth", "utm:4", "--tolerance", "0", "--out", tmp_path / "compare")
    matches = tmp_path / "compare" / "matches.csv"
    run("evaluate", matches, "--truth", "0", "--tolerance", "0", "--out", tmp_path / "zero")
    assert report_of(tmp_path / "zero")["truth"] == "place = query"
    assert report_of(tmp_path / "compare")["auc"] == report_of(tmp_path / "zero")["auc"]
    options = ("--truth", "utm:4", "--tolerance", "0", "--out", tmp_path / "evaluate")
    run("evaluate", matches, *options, "--reference", both[0], "--query", both[1])
    assert report_of(tmp_path / "evaluate")["auc"] == report_of(tmp_path / "zero")["auc"]


@pytest.mark.slow
def test_the_threshold_that_is_named_accepts_right_places_only(tmp_path, capsys):
    flights = ("sim:aerial?frames=96", "sim:aerial?frames=96&traverse=1")
    run("compare", *flights, "--out", tmp_path / "first")
    first = report_of(tmp_path / "first")
    assert f"--threshold {first['threshold_of_full_precision']:.9g}" in capsys.readouterr().out
    threshold = str(first["threshold_of_full_precision"])
    learned = ("--map", tmp_path / "first" / "map.safetensors")
    run("compare", *flights, *learned, "--threshold", threshold, "--out", tmp_path / "second")
    second = report_of(tmp_path / "second")
    assert 0 < second["accepted"] == second["accepted_right"]
    assert second["accepted"] == round(first["recall_at_100_precision"] * first["with_answer"])


def test_options_that_do_nothing_for_ready_features_are_told(tmp_path, caplog):
    np.save(tmp_path / "features.npy", np.random.default_rng(0).normal(size=(64, 8)).astype(np.float32))
    arguments = (tmp_path / "features.npy", "--map", tmp_path / "map.safetensors")
    run("learn", *arguments)
    assert "ready features" not in caplog.text
    run("learn", *arguments, "--preprocess.channel", "R-B")
    assert "these are ready features: channel and contrast have no effect" in caplog.text


@pytest.mark.parametrize("name", [b"a\nb", b"a\x1b[2Jb", b"\xff\xfe"])
def test_a_name_of_any_bytes_makes_one_line(tmp_path, name, capsys):
    folder = tmp_path / os.fsdecode(name)
    folder.mkdir()
    (folder / "1.png").write_bytes(b"no image")
    for source in (folder, folder / "missing.mp4", f"sim:{os.fsdecode(name)}"):
        error = fails(capsys, "learn", source, "--map", tmp_path / "map.safetensors")
        assert error.strip("\n").isprintable()


def test_numbers_of_any_size_are_evaluated(tmp_path):
    far = 2**53 - 1
    (tmp_path / "m.csv").write_text(f"query,place,score\n0,{far},0.5\n{far},3,0.7\n")
    (tmp_path / "t.csv").write_text(f"0,{far}\n{far},5\n")
    for tolerance, right in ((1, 0.5), (2**53, 1)):
        words = "--truth", tmp_path / "t.csv", "--tolerance", tolerance
        run("evaluate", tmp_path / "m.csv", *words, "--out", tmp_path / "out")
        assert report_of(tmp_path / "out")["recall_at_1"] == right
