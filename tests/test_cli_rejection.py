"""Probabilities in the commands: --precision, --calibration, --distractors."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from command_line import fails, report_of, run

from dejavu_torch import DejaVu
from dejavu_torch.features.views import FEWEST
from dejavu_torch.features.whitening import VIEWS, VIEWS_PER_COMPONENT

ROUTE, AGAIN, THIRD, SEA = (
    f"sim:{name}"
    for name in (
        "aerial?frames=64",
        "aerial?frames=64&traverse=1",
        "aerial?frames=64&traverse=2",
        "outdoor?frames=50",
    )
)


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("learned") / "map.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        # as many copies of frames as outside of tests, for the probabilities of a filter
        patch.setattr("dejavu_torch.features.whitening.VIEWS", VIEWS)
        patch.setattr("dejavu_torch.features.whitening.VIEWS_PER_COMPONENT", VIEWS_PER_COMPONENT)
        patch.setattr("dejavu_torch.features.views.FEWEST", FEWEST)
        run("learn", ROUTE, "--map", path)
    return path


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_learned_map_tells_probabilities_and_accepts_by_them(learned: Path, tmp_path: Path) -> None:
    for sequence in ((), ("--filter",)):
        run("localize", learned, AGAIN, "--precision", ".9", "--out", tmp_path / "m.csv", *sequence)
        found = rows(tmp_path / "m.csv")
        assert [row["accepted"] == "1" for row in found] == [
            float(row["probability"]) >= 0.9 for row in found
        ]
        assert any(row["accepted"] == "1" for row in found)


def test_a_precision_is_kept_in_the_map_until_another_or_a_threshold_is_given(tmp_path: Path) -> None:
    path, out = tmp_path / "map.safetensors", tmp_path / "m.csv"
    run("learn", ROUTE, "--map", path, "--precision", ".95")
    accepted = []
    for words in ((), ("--precision", ".95"), ("--precision", ".5"), ("--threshold", "9")):
        run("localize", path, AGAIN, "--out", out, *words)
        accepted.append(sum(row["accepted"] == "1" for row in rows(out)))
    assert accepted[0] == accepted[1] <= accepted[2] <= accepted[3] == 64


def test_compare_reports_what_is_accepted_on_and_off_the_map(tmp_path: Path) -> None:
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
    for key in ("expected_calibration_error", "auc"):
        assert of_file[key] == pytest.approx(facts[key], abs=1e-5)
    assert of_file["precision"] == facts["precision"]
    assert (tmp_path / "file" / "reliability.png").exists()
    run("compare", ROUTE, AGAIN, "--map", out / "map.safetensors", "--out", tmp_path / "again")
    strict = ("--filter", "--threshold", "1e-9")  # in place of the map's precision
    run("compare", ROUTE, AGAIN, "--map", out / "map.safetensors", *strict, "--out", tmp_path / "none")
    assert report_of(tmp_path / "none")["accepted"] == 0
    again = report_of(tmp_path / "again")
    assert (again["accepted"], again["accepted_right"]) == (report["accepted"], report["accepted_right"])


def test_no_calibration_where_none_is_wanted_or_can_be(
    learned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "map.safetensors"
    run("learn", ROUTE, "--map", path, "--calibration", "none")
    assert DejaVu.load(path).calibration is None
    run("compare", ROUTE, AGAIN, "--calibration", "none", "--out", tmp_path / "out")
    assert "rejection" not in report_of(tmp_path / "out")
    error = fails(capsys, "localize", path, AGAIN, "--precision", ".9", "--out", tmp_path / "m.csv")
    assert "the map is not calibrated" in error
    np.save(tmp_path / "features.npy", np.random.default_rng(0).random((64, 8), np.float32))
    error = fails(
        capsys, "learn", tmp_path / "features.npy", "--map", tmp_path / "n.safetensors", "--precision", ".9"
    )
    assert "no frames to calibrate by" in error
    assert not (tmp_path / "n.safetensors").exists()


@pytest.mark.parametrize(
    ("words", "told", "commands"),
    [
        ("--sequence 5 --precision .9", ("--sequence 5", "--precision 0.9"), "localize live compare"),
        ("--sequence 5 --filter", ("--sequence 5", "--filter"), "localize live compare"),
        ("--threshold 1 --precision .9", ("--threshold 1", "--precision 0.9"), "localize live compare"),
        ("--sequence 5 --distractors sim:outdoor", ("--sequence 5", "--distractors sim:outdoor"), "compare"),
        (
            "--filter --search_every 9 --precision .9",
            ("--search_every 9", "--precision 0.9"),
            "localize live",
        ),
        ("--search_every 9", ("--search_every 9", "--filter"), "localize"),
        ("--precision 1", ("precision is 1", "below 1"), "localize"),
        ("--moves [1]", ("--moves [1.0]", "--filter"), "localize"),
        ("--speeds [2]", ("--speeds [2.0]", "--sequence"), "localize"),
    ],
)
def test_options_that_exclude_each_other_are_told_before_anything_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str, told: tuple[str, ...], commands: str
) -> None:
    out = ("--out", tmp_path / "out")
    read = {
        "localize": ("nowhere.safetensors", "nowhere", *out),
        "live": ("nowhere.safetensors", "nowhere"),
        "compare": ("nowhere", "nowhere", *out),
    }
    for command in commands.split():
        error = fails(capsys, command, *read[command], *words.split())
        assert [one for one in told if one not in error] == [], error
        assert "nowhere" not in error


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--calibration", AGAIN), ("itself", "another traverse")),
        (("--calibration", ROUTE), ("itself", "another traverse")),
        (("--calibration", THIRD, "--calibration_truth", "60"), ("none of",)),
        (("--calibration_truth", "0"), ("--calibration SOURCE",)),
        (("--calibration", "nowhere"), ("nowhere is not there",)),
        (("--distractors", AGAIN), ("one of the traverses", "another route")),
        (("--precision", ".9", "--calibration", "none"), ("--precision 0.9", "calibrated map")),
    ],
)
def test_traverses_that_do_not_serve(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], told: tuple[str, ...]
) -> None:
    error = fails(capsys, "compare", ROUTE, AGAIN, "--out", tmp_path / "out", *words)
    assert [word for word in told if word not in error] == [], error
    assert not (tmp_path / "out").exists()


def test_frames_of_another_size_are_told_ahead_of_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    np.save(tmp_path / "small.npy", np.zeros((64, 32, 24), np.uint8))
    monkeypatch.setattr(DejaVu, "learn", None)
    words = ("--map", tmp_path / "map.safetensors", "--calibration", tmp_path / "small.npy")
    error = fails(capsys, "learn", ROUTE, *words)
    assert "small.npy gives" in error
    assert "one size" in error
