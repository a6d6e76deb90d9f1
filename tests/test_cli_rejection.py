"""Probabilities in the commands: --precision, --calibration, --distractors."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
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


def visit(folder, name, seed, laps=1):
    """A drive over 160 places a metre apart, which neighbours resemble; a source with its coordinates."""
    noise, drawn = torch.Generator().manual_seed(seed), torch.Generator().manual_seed(0)
    places = F.conv1d(torch.randn(24, 1, 184, generator=drawn), torch.hann_window(25)[None, None])[:, 0].T
    rows = F.normalize(places, dim=1).repeat(laps, 1)
    rows = F.normalize(rows + 0.2 * torch.randn(rows.shape, generator=noise), dim=1)
    np.save(folder / f"{name}.npy", rows.numpy())
    (folder / f"{name}.csv").write_text("x,y\n" + "\n".join(f"{i % 160},0" for i in range(len(rows))))
    return f"{folder / name}.npy?coordinates={folder / name}.csv"


@pytest.mark.parametrize("loops", [False, True], ids=["coordinates", "loops"])
def test_the_docs_commands_at_tolerance_0_accept_what_is_right(tmp_path, loops):
    first = visit(tmp_path, "morning", 1, laps=1 + loops)
    words = ("--loops", "50") if loops else (visit(tmp_path, "evening", 2),)
    words = (first, *words, "--truth", "metres:4", "--tolerance", "0", "--ordered", "--whitening", "none")
    run("compare", *words, "--out", tmp_path / "report")
    report = report_of(tmp_path / "report")
    assert report["with_answer"] == 160
    found = report["recall_at_1"] * 160
    assert found > 110
    assert 0.9 * found <= report["accepted_right"]
    assert 0.95 * report["accepted"] <= report["accepted_right"]


def test_a_reach_other_than_that_of_the_map(tmp_path, capsys, caplog):
    out = tmp_path / "near"
    run("compare", ROUTE, AGAIN, "--match", "single", "--out", out)
    run("compare", ROUTE, AGAIN, "--match", "single", "--tolerance", "1", "--out", tmp_path / "one")
    # what the files hold is for 5
    near, one = (DejaVu.load(folder / "map.safetensors").calibration for folder in (out, tmp_path / "one"))
    assert near == one
    near, one = (np.genfromtxt(f / "matches.csv", delimiter=",", names=True) for f in (out, tmp_path / "one"))
    assert (near["score"] == one["score"]).all()
    assert near["probability"].sum() > one["probability"].sum()
    capsys.readouterr()
    run("localize", out / "map.safetensors", AGAIN, "--out", tmp_path / "m.csv")
    assert "of being within 5 places" in capsys.readouterr().out
    random = np.random.default_rng(0)
    rows = random.random((64, 8), np.float32)
    for name in "abc":
        np.save(tmp_path / f"{name}.npy", rows + 0.1 * random.random((64, 8), np.float32))
    map = tmp_path / "d.safetensors"
    run("learn", tmp_path / "a.npy", "--map", map, "--calibration", tmp_path / "b.npy")
    for command in ("compare a.npy c.npy --map d.safetensors", "evaluate near/matches.csv"):
        words = [tmp_path / word if "." in word else word for word in command.split()]
        caplog.clear()
        run(*words, "--truth", "0", "--tolerance", "2", "--out", tmp_path / "out")
        assert "of being within 5 places" in caplog.text
        assert "right within 2" in caplog.text


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
