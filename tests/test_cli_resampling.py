"""Resampling by distance, as a user of the commands meets it."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import torch
from command_line import TEMPLATES, fails, report_of
from footage import QUERY, REFERENCE, SIDE, STEP, footage

from dejavu_torch import DejaVu
from dejavu_torch.cli import main

CORNERS = ["--velocity.corners", "[[0,0],[1,0],[1,1],[0,1]]", "--velocity.size", f"[{SIDE},{SIDE}]"]
STEPS = [*CORNERS, "--velocity.step", str(STEP)]
OPTIONS = [*STEPS, *TEMPLATES, "--mapper.periods.false_alarm", "null"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Footage of both traverses, their ground truth, a map and its matches."""
    folder = tmp_path_factory.mktemp("resampled")
    for name, where, noise in (("reference", REFERENCE, 0.0), ("query", QUERY, 0.02)):
        np.save(folder / f"{name}.npy", (255 * footage(where, noise)[:, 0]).byte().numpy())
    nearest = (REFERENCE - QUERY[:, None]).abs().argmin(1).tolist()
    rows = "".join(f"{q},{p}\n" for q, p in enumerate(nearest))
    (folder / "truth.csv").write_text("query,place\n" + rows)
    main(["learn", f"{folder}/reference.npy", "--map", f"{folder}/m.safetensors", *OPTIONS])
    localize(folder, "matches.csv")
    return folder


def localize(folder, name, *options):
    command = ["localize", f"{folder}/m.safetensors", f"{folder}/query.npy", "--out", f"{folder}/{name}"]
    main([*command, *options])
    return list(csv.DictReader((folder / name).open()))


def evaluate_file(folder, truth, out, *options):
    main(["evaluate", f"{folder}/matches.csv", "--truth", f"{folder}/{truth}", "--out", str(out), *options])
    return report_of(out)


def test_convention_11_matches_count_frames_of_the_sources(folder, capsys):
    rows = localize(folder, "again.csv")
    assert f"{len(QUERY)} frames resampled to 101 even steps of 6 pixels of ground" in capsys.readouterr().out
    main(["info", f"{folder}/m.safetensors"])
    told = capsys.readouterr().out
    assert "places are 6 pixels of ground apart" in told
    assert "GroundOdometry: corners=((0.0, 0.0)" in told
    assert list(rows[0])[:4] == ["query", "place", "score", "accepted"]
    assert len(rows) == 101
    queries, places = (torch.tensor([int(row[name]) for row in rows]) for name in ("query", "place"))
    assert (QUERY[queries] - STEP * torch.arange(101)).abs().max() <= 4
    assert ((REFERENCE[places] - QUERY[queries]).abs() <= 2 * STEP).sum() > 95


def test_compare_is_learn_localize_and_evaluate(folder, tmp_path):
    pair, truth = [f"{folder}/reference.npy", f"{folder}/query.npy"], ["--truth", f"{folder}/truth.csv"]
    main(["compare", *pair, *truth, "--out", f"{tmp_path}/c", *OPTIONS])
    report = report_of(tmp_path / "c")
    alone = evaluate_file(folder, "truth.csv", tmp_path / "e", "--map", f"{folder}/m.safetensors")
    for key in ("auc", "recall_at_1", "recall_at_100_precision", "judged", "accepted_right"):
        assert report[key] == pytest.approx(alone[key], rel=1e-6), key
    assert report["unit"] == alone["unit"]
    assert report["frames"] == report["queries"] == 101
    for picture in ("velocity", "ground"):
        assert (tmp_path / "c" / f"{picture}.png").is_file()
    assert (tmp_path / "c" / "matches.csv").read_text() == (folder / "matches.csv").read_text()
    assert "right within 5 places at even steps" in (tmp_path / "c" / "index.html").read_text()


def test_another_camera_and_frames_as_they_come(folder):
    # half of the ground fills the patch: it seems to move twice as fast
    rows = localize(folder, "half.csv", "--corners", "[[0,0.5],[1,0.5],[1,1],[0,1]]")
    assert len(rows) == pytest.approx(2 * 101, rel=0.05)
    rows = localize(folder, "as_is.csv", "--as_is")
    assert [int(row["query"]) for row in rows] == list(range(len(QUERY)))


def test_ground_that_cannot_be_is_refused(folder, tmp_path, capsys):
    outside = "[[0,0],[1,0],[1,1.5],[0,1]]"
    learn = "learn", folder / "reference.npy", "--map", tmp_path / "m.safetensors"
    assert "lie outside the frame" in fails(capsys, *learn, "--velocity.corners", outside)
    query = folder / "query.npy", "--out", tmp_path / "m.csv", "--corners"
    localized = "localize", folder / "m.safetensors", *query
    assert "lie outside the frame" in fails(capsys, *localized, outside)
    assert "--as_is measures no ground" in fails(capsys, *localized, outside, "--as_is")
    assert list(tmp_path.iterdir()) == []


def test_a_bare_velocity_is_understood(folder, tmp_path):
    command = ["learn", f"{folder}/reference.npy", "--map", f"{tmp_path}/m.safetensors", "--velocity"]
    main([*command, *OPTIONS])
    assert DejaVu.load(tmp_path / "m.safetensors").step == STEP


def test_a_second_visit_does_not_resample_the_reference_again(folder, tmp_path):
    truth = f"{folder}/truth.csv"
    words = ["compare", f"{folder}/reference.npy", f"{folder}/query.npy", *STEPS, "--features", "HOG"]
    words += ["--truth", truth, "--ordered", "--whitening.numbers", "16", "--match", "single"]
    main([*words, "--out", f"{tmp_path}/alone"])
    alone = report_of(tmp_path / "alone")
    np.save(tmp_path / "again.npy", (255 * footage(QUERY, 0.03)[:, 0]).byte().numpy())
    for name in ("second", "calibration"):
        more = [f"--{name}", f"{tmp_path}/again.npy", f"--{name}_truth", truth]
        main([*words, *more, "--out", f"{tmp_path}/{name}"])
        report = report_of(tmp_path / name)
        assert (report["frames"], report["queries"]) == (alone["frames"], alone["queries"])
        assert report["recall_at_1"] >= alone["recall_at_1"] - 0.05
