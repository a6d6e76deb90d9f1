"""Maps that grow, as a user of the commands meets them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from command_line import fails, frames, run

from dejavu_torch import DejaVu

ROUTE = "sim:aerial?frames=128"
FIRST, NEXT = "sim:aerial?frames=128&stop=64", "sim:aerial?frames=128&start=64"
CHUNKS = ("--mapper.chunk", "32", "--whitening.views", "2")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map in chunks of the first half of a route, and maps that cannot grow."""
    folder = tmp_path_factory.mktemp("growth")
    run("learn", FIRST, "--map", folder / "first.safetensors", *CHUNKS)
    np.save(folder / "a.npy", frames(40, seed=1))
    np.save(folder / "d.npy", np.random.default_rng(0).normal(size=(96, 8)).astype(np.float32))
    np.save(folder / "wide.npy", np.random.default_rng(0).normal(size=(9, 5)).astype(np.float32))
    none = ("--calibration", "none", "--whitening", "none")
    for name, options in {
        "whole": none,
        "templates": ("--config", "local_maxima", "--calibration", "none"),
        "f": (*none, "--mapper.chunk", "32"),
    }.items():
        run("learn", folder / "d.npy", "--map", folder / f"{name}.safetensors", *options)
    return folder


def matches(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_map_grows_in_its_own_file_or_in_another(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, other, own = (
        folder / "first.safetensors",
        tmp_path / "other.safetensors",
        tmp_path / "own.safetensors",
    )
    own.write_bytes(first.read_bytes())
    before = first.read_bytes()
    capsys.readouterr()
    run("learn", NEXT, "--append", first, "--map", other)
    told = capsys.readouterr().out
    assert f"64 places behind the 64 of {first}; written to {other}" in told
    assert "128 of 128 places covered" in told
    assert first.read_bytes() == before
    run("learn", NEXT, "--append", own)
    assert own.read_bytes() == other.read_bytes()
    model = DejaVu.load(own)
    assert model.map.places == 128
    assert model.calibration is not None
    assert model.calibration != DejaVu.load(first).calibration
    run("localize", own, f"{ROUTE}&traverse=1", "--out", tmp_path / "m.csv", "--precision", "0.5")
    found = matches(tmp_path / "m.csv")
    near = [abs(int(row["query"]) - int(row["place"])) <= 5 for row in found]
    assert sum(near[:64]) > 40
    assert sum(near[64:]) > 40


def test_calibration_of_the_new_places(folder: Path, tmp_path: Path) -> None:
    first, out = folder / "first.safetensors", tmp_path / "m.safetensors"
    run("learn", NEXT, "--append", first, "--map", out, "--calibration", "none")
    assert DejaVu.load(out).calibration is None
    another = ("--calibration", f"{NEXT}&traverse=1", "--precision", "0.9")
    run("learn", NEXT, "--append", first, "--map", out, *another)
    model = DejaVu.load(out)
    assert (model.calibration is not None, model.precision) == (True, 0.9)
    run("learn", NEXT, "--append", first, "--map", out, "--threshold", "0.25")
    assert DejaVu.load(out).threshold == 0.25


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("d.npy --append whole.safetensors", ["whole.safetensors: ", "whole route", "--mapper.chunk 1024"]),
        ("d.npy --append templates.safetensors", ["templates.safetensors", "'templates'", "'spectral'"]),
        ("d.npy --append absent.safetensors", ["absent.safetensors"]),
        ("d.npy --append a.npy", ["a.npy", "no map file"]),
        ("wide.npy --append f.safetensors", ["wide.npy", "5 features", "expected 8"]),
        ("a.npy --append f.safetensors", ["a.npy holds frames", "ready features"]),
        ("a.npy --append first.safetensors", ["a.npy has frames of 1 x 32 x 32", "expected 3 x "]),
        ("d.npy --append f.safetensors --whitening none", ["--whitening", "--append"]),
        ("d.npy --append f.safetensors --whitening first.safetensors", ["--whitening", "--append"]),
        ("d.npy --append f.safetensors --mapper.chunk 16", ["--mapper", "--append"]),
        ("d.npy --append f.safetensors --descriptor first.safetensors", ["--descriptor", "--append"]),
        ("d.npy --append f.safetensors --second a.npy", ["--second", "--append"]),
        ("d.npy --append f.safetensors --preprocess.channel R", ["--preprocess", "--append"]),
        ("d.npy --append f.safetensors --velocity", ["--velocity", "--append"]),
        ("d.npy --append f.safetensors --seed 4", ["--seed", "--append"]),
        ("d.npy --append f.safetensors --config paper", ["--config", "--append"]),
        ("d.npy --append f.safetensors --features.cell 4", ["f.safetensors", "cell"]),
        ("d.npy --append f.safetensors --precision .9", ["--precision 0.9", "--calibration SOURCE"]),
        ("d.npy --append f.safetensors --map m.npy", ["--map m.npy", "m.safetensors"]),
        ("--append f.safetensors", ["required: source"]),
        ("d.npy", ["required: --map"]),
        ("", ["required: source, --map"]),
    ],
)  # fmt: skip
def test_what_is_refused_leaves_the_map(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: str,
    said: list[str],
) -> None:
    monkeypatch.chdir(folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    error = fails(capsys, "learn", *words.split())
    assert [one for one in said if one not in error] == [], error
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
