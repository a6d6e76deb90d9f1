"""`dejavu evaluate`, the truths of `compare`, and options ahead of the features, as a user meets them."""

from __future__ import annotations

import os
import shutil

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


@pytest.fixture(scope="module")
def compared(pair, tmp_path_factory):
    """The report of both, with the truth."""
    folder = tmp_path_factory.mktemp("compared") / "report"
    run("compare", *pair, "--truth", "4", "--out", folder)
    return folder


@pytest.mark.slow
def test_evaluate_agrees_with_compare_whatever_the_form_of_the_truth(pair, matches, compared, tmp_path):
    rows = [f"{query},{query + 4}" for query in range(84)]
    (tmp_path / "all.csv").write_text("query,place\n" + "\n".join(rows))
    (tmp_path / "some.csv").write_text("\n".join([rows[0], rows[37], rows[83]]))
    hard = np.zeros((96, 84), dtype=bool)
    hard[np.arange(84) + 4, np.arange(84)] = True
    np.savez(tmp_path / "truth.npz", GThard=hard)
    known = "--map", compared / "map.safetensors"
    run("compare", *pair, *known, "--truth", tmp_path / "truth.npz", "--out", tmp_path / "c3")
    expected = report_of(compared)
    some = [tmp_path / "some.csv", "--interpolate"]
    forms = (["4"], [tmp_path / "all.csv"], some, [tmp_path / "truth.npz"])
    for number, form in enumerate(forms):
        run("evaluate", matches, "--truth", *form, "--out", tmp_path / f"e{number}")
    keys = "auc", "auc_reported", "recall_at_1", "recall_at_100_precision", "queries", "accepted"
    for folder in ("e0", "e1", "e2", "e3", "c3"):
        report = report_of(tmp_path / folder)
        assert [report[key] for key in keys] == pytest.approx([expected[key] for key in keys], abs=1e-6)


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


def test_a_report_leaves_the_images_alone_and_no_picture_of_an_earlier_one(pair, compared, tmp_path, capsys):
    folder = tmp_path / "images"
    folder.mkdir()
    for i, image in enumerate(frames(16)):
        Image.fromarray(image).save(folder / f"{i}.png")
    assert "expected another" in fails(capsys, "compare", f"{folder}?step=1", folder, "--out", folder)
    assert len(list(folder.iterdir())) == 16
    shutil.copytree(compared, tmp_path / "out")
    assert (tmp_path / "out" / "pr.png").exists()
    run("compare", *pair, "--out", tmp_path / "out")
    assert not (tmp_path / "out" / "pr.png").exists()
    assert (tmp_path / "out" / "coverage.png").exists()


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


def test_what_pillow_logs_is_no_line(tmp_path, capsys, caplog):
    (tmp_path / "images").mkdir()
    path = tmp_path / "images" / "a.tif"
    Image.new("RGB", (5, 4)).save(path)
    whole = bytearray(path.read_bytes())
    entry = whole.index((277).to_bytes(2, "little") + (3).to_bytes(2, "little"))  # samples per pixel
    whole[entry + 8] = 200
    path.write_bytes(whole)
    assert "a.tif" in fails(capsys, "learn", tmp_path / "images", "--map", tmp_path / "map.safetensors")
    assert caplog.text == ""


def test_numbers_of_any_size_are_evaluated(tmp_path):
    far = 2**53 - 1
    (tmp_path / "m.csv").write_text(f"query,place,score\n0,{far},0.5\n{far},3,0.7\n")
    (tmp_path / "t.csv").write_text(f"0,{far}\n{far},5\n")
    for tolerance, right in ((1, 0.5), (2**53, 1)):
        words = "--truth", tmp_path / "t.csv", "--tolerance", tolerance
        run("evaluate", tmp_path / "m.csv", *words, "--out", tmp_path / "out")
        assert report_of(tmp_path / "out")["recall_at_1"] == right
