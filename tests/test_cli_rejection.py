"""Probabilities in the commands: --precision, --calibration, --distractors."""

from __future__ import annotations

import numpy as np
import pytest
from command_line import fails, report_of, run

from dejavu_torch import DejaVu

ROUTE, AGAIN, THIRD = (f"sim:aerial?frames=64&traverse={traverse}" for traverse in range(3))
SEA = "sim:outdoor?frames=50"


def test_compare_reports_what_is_accepted_on_and_off_the_map(tmp_path):
    out = tmp_path / "out"
    others = f"[{SEA},{SEA}&seed=3]"
    words = ("--precision", ".9", "--calibration", THIRD, "--distractors", others)
    run("compare", ROUTE, AGAIN, *words, "--out", out)
    report = report_of(out)
    facts = report["rejection"]
    assert facts["expected_calibration_error"] < 0.2
    assert [one["frames"] for one in facts["off_map"].values()] == [50, 50]
    asked = {one["asked"]: one for one in facts["precision"]}
    assert report["accepted_right"] == pytest.approx(asked[0.9]["kept"] * report["recall_at_1"] * 64)
    assert (out / "reliability.png").exists()
    run("evaluate", out / "matches.csv", "--truth", "0", "--out", tmp_path / "file")
    of_file = report_of(tmp_path / "file")["rejection"]
    assert of_file["precision"] == facts["precision"]
    run("compare", ROUTE, AGAIN, "--map", out / "map.safetensors", "--out", tmp_path / "again")
    strict = ("--filter", "--threshold", "1e-9")  # in place of the map's precision
    run("compare", ROUTE, AGAIN, "--map", out / "map.safetensors", *strict, "--out", tmp_path / "none")
    assert report_of(tmp_path / "none")["accepted"] == 0
    again = report_of(tmp_path / "again")
    assert (again["accepted"], again["accepted_right"]) == (report["accepted"], report["accepted_right"])


def test_no_calibration_where_none_is_wanted_or_can_be(tmp_path, capsys):
    path = tmp_path / "map.safetensors"
    run("learn", ROUTE, "--map", path, "--calibration", "none")
    assert DejaVu.load(path).calibration is None
    single = "--match", "single"
    run("compare", ROUTE, AGAIN, "--calibration", "none", *single, "--out", tmp_path / "out")
    assert "rejection" not in report_of(tmp_path / "out")
    error = fails(capsys, "localize", path, AGAIN, *single, "--precision", ".9", "--out", tmp_path / "m.csv")
    assert "the map is not calibrated" in error
    run("localize", path, AGAIN, "--precision", ".9", "--out", tmp_path / "m.csv")  # by the whole drive
    np.save(tmp_path / "features.npy", np.random.default_rng(0).random((64, 8), np.float32))
    error = fails(
        capsys, "learn", tmp_path / "features.npy", "--map", tmp_path / "n.safetensors", "--precision", ".9"
    )
    assert "no frames to calibrate by" in error
    assert not (tmp_path / "n.safetensors").exists()


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("localize m a --out c --sequence 5 --precision .9", ("--match sequence:5", "--precision 0.9")),
        ("localize m a --out c --threshold 1 --precision .9", ("--threshold 1", "--precision 0.9")),
        ("localize m a --out c --match sequence:1.5", ("--match sequence:1.5", "drive, filter, single")),
        ("localize m a --out c --match smooth", ("--match smooth", "drive, filter, single")),
        ("localize m a --out c --match drive --filter", ("--filter", "--match drive")),
        ("localize m a --out c --match drive --unordered", ("--unordered", "--match")),
        ("compare a b --out c --match filter --centre mean", ("--centre mean", "--match drive")),
        ("localize m a --out c --speeds [2]", ("--speeds [2.0]", "--match sequence:T")),
        ("compare a b --out c --filter --speeds [2]", ("--speeds [2.0]", "--match sequence:T")),
        ("live m a --speeds [2]", ("--speeds [2.0]", "--match sequence:T")),
        ("live m a --sequence 5 --filter", ("--sequence 5", "--filter")),
        (
            "compare a b --out c --sequence 5 --distractors sim:outdoor",
            ("--match sequence:5", "--distractors"),
        ),
    ],
)
def test_options_that_exclude_each_other_are_told_before_anything_is_read(capsys, line, told):
    error = fails(capsys, *line.split())
    assert [one for one in told if one not in error] == [], error
    assert "not there" not in error


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--calibration", AGAIN), "itself; expected another visit"),
        (("--calibration", ROUTE), "itself; expected another visit"),
        (("--second", AGAIN), "itself; expected another visit"),
        (("--distractors", AGAIN), "itself; expected another visit"),
        (("--calibration_truth", "0"), "--calibration SOURCE"),
        (
            ("--match", "single", "--precision", ".9", "--calibration", "none"),
            "a precision, 0.9, and --calibration none",
        ),
        (
            ("--match", "single", "--distractors", THIRD, "--calibration", "none"),
            "expected --calibration SOURCE",
        ),
    ],
)
def test_traverses_that_do_not_serve(tmp_path, capsys, words, told):
    assert told in fails(capsys, "compare", ROUTE, AGAIN, "--out", tmp_path / "out", *words)
    assert not (tmp_path / "out").exists()
