"""`dejavu evaluate`, the truths of `compare`, and options ahead of the features, as a user meets them."""

from __future__ import annotations

import numpy as np
from command_line import frames, report_of, run
from PIL import Image


def test_evaluate_writes_a_report_and_says_what_was_judged(tmp_path, capsys):
    matches, map = tmp_path / "matches.csv", tmp_path / "map.safetensors"
    np.save(tmp_path / "first.npy", frames(96, seed=1))
    np.save(tmp_path / "second.npy", frames(96, seed=2)[4:88])
    run("learn", tmp_path / "first.npy", "--map", map)
    run("localize", map, tmp_path / "second.npy", "--out", matches)
    capsys.readouterr()
    (tmp_path / "some.csv").write_text("query,place\n0,4\n50,54\n60,-1\n")
    run("evaluate", matches, "--truth", tmp_path / "some.csv", "--tolerance", "2", "--out", tmp_path / "out")
    out = capsys.readouterr().out
    assert "AUC" in out
    assert "right within 2 frames" in out
    assert "3 of the queries are in the truth" in out
    assert "2 of the queries have a right place" in out
    report = report_of(tmp_path / "out")
    assert "auc_by_confidence" in report  # by the column of the file
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


def test_options_that_do_nothing_for_ready_features_are_told(tmp_path, caplog):
    np.save(tmp_path / "features.npy", np.random.default_rng(0).normal(size=(64, 8)).astype(np.float32))
    arguments = (tmp_path / "features.npy", "--map", tmp_path / "map.safetensors")
    run("learn", *arguments)
    assert "ready features" not in caplog.text
    run("learn", *arguments, "--preprocess.channel", "R-B")
    assert "these are ready features: channel and contrast have no effect" in caplog.text


def test_a_longer_drive_than_the_map_has_places_is_evaluated(tmp_path):
    route, drive = "sim:aerial?frames=60&size=32", "sim:aerial?frames=90&size=32&traverse=1"
    run("learn", route, "--map", tmp_path / "m.safetensors")
    run("localize", tmp_path / "m.safetensors", drive, "--out", tmp_path / "m.csv")
    words = ("--truth", "0", "--map", tmp_path / "m.safetensors", "--out", tmp_path / "e")
    run("evaluate", tmp_path / "m.csv", *words)
    assert report_of(tmp_path / "e")["queries"] == 90
