"""Maps that grow, as a user of the commands meets them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from command_line import fails, frames, report_of, rows_of, run

from dejavu_torch import DejaVu

ROUTE = "sim:aerial?frames=128"
FIRST, NEXT = "sim:aerial?frames=128&stop=64", "sim:aerial?frames=128&start=64"
CHUNKS = ("--mapper.chunk", "32", "--whitening.views", "2")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A map in chunks of the first half of a route, and maps that cannot grow."""
    folder = tmp_path_factory.mktemp("growth")
    run("learn", FIRST, "--map", folder / "first.safetensors", *CHUNKS)
    np.save(folder / "a.npy", frames(40, seed=1))
    np.save(folder / "d.npy", np.random.default_rng(0).normal(size=(96, 8)).astype(np.float32))
    plain = ("--calibration", "none", "--whitening", "none", "--mapper.chunk", "32")
    run("learn", folder / "d.npy", "--map", folder / "f.safetensors", *plain)
    sure = DejaVu.load(folder / "f.safetensors")
    sure.precision = 0.9
    sure.save(folder / "sure.safetensors")
    return folder


def test_a_map_grows_in_its_own_file_or_in_another(folder, tmp_path, capsys):
    first = folder / "first.safetensors"
    other, own = tmp_path / "other.safetensors", tmp_path / "own.safetensors"
    own.write_bytes(first.read_bytes())
    before = first.read_bytes()
    capsys.readouterr()
    run("learn", NEXT, "--append", first, "--map", other)
    told = capsys.readouterr().out
    assert f"64 places appended to the 64 of {first}; written to {other}" in told
    assert "128 of 128 places covered" in told
    assert first.read_bytes() == before
    run("learn", NEXT, "--append", own)
    assert own.read_bytes() == other.read_bytes()
    model = DejaVu.load(own)
    assert model.map.places == 128
    assert model.calibration is not None
    assert model.calibration != DejaVu.load(first).calibration


# maps of several routes


@pytest.fixture(scope="module")
def merged(folder):
    """Two routes, described alike, in one map."""
    options = ("--whitening", folder / "first.safetensors", "--calibration", "none")
    run("learn", "sim:aerial?frames=96&seed=1", "--map", folder / "other.safetensors", *options)
    both = folder / "both.safetensors"
    run("merge", folder / "first.safetensors", folder / "other.safetensors", "--map", both)
    return both


def test_merged_routes_are_listed_and_matches_name_them(merged, tmp_path, capsys):
    capsys.readouterr()
    run("info", merged)
    told = capsys.readouterr().out
    model = DejaVu.load(merged)
    for name, first, last in (("first", 0, 63), ("other", 64, 159)):
        size = model.map.part(name).summary().route_bytes  # type: ignore[operator]
        assert f"route {name}: places {first}-{last}, {size} bytes" in told
    query = "sim:aerial?frames=96&seed=1&traverse=1"
    run("localize", merged, query, "--match", "single", "--out", tmp_path / "m.csv")
    assert "--route ROUTE" in capsys.readouterr().out
    rows = rows_of(tmp_path / "m.csv")
    columns = ["query", "place", "score", "accepted", "confidence", "stale", "route"]
    assert [*rows[0]] == [*columns, "query_name", "place_name"]
    right = [row["route"] == "other" and abs(int(row["query"]) - int(row["place"])) <= 5 for row in rows]
    assert sum(right) > 48
    other = "--truth=0", "--route", "other", "--out", tmp_path / "e"
    for table in ((), ("--map", merged)):
        run("evaluate", tmp_path / "m.csv", *other, *table)
        report = report_of(tmp_path / "e")
        assert report["accepted_right"] == sum(right)
        assert report["elsewhere"] == sum(row["route"] == "first" for row in rows)
        assert (report["route"], report["accepted"]) == ("other", 96)
    run("localize", merged, query, "--match", "single", "--out", tmp_path / "top.csv", "--top", "5")
    top = rows_of(tmp_path / "top.csv")
    assert [*top[0]][5:8] == ["stale", "rank", "route"]
    assert [row["route"] for row in top[::5]] == [row["route"] for row in rows]
    run("evaluate", tmp_path / "top.csv", *other)
    assert report_of(tmp_path / "e")["recall_at_5"] >= report["recall_at_1"]


def test_live_names_the_route(merged, capsys):
    capsys.readouterr()
    run("live", merged, "sim:aerial?frames=96&seed=1&traverse=1&start=90", "--sequence", "1")
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(lines) == 6
    known = {"first": 64, "other": 96}
    assert all(0 <= line["reference_frame"] < known[line["route"]] for line in lines)
    assert sum(line["route"] == "other" and line["reference_frame"] >= 84 for line in lines) >= 3


# further visits averaged in


def test_a_second_traverse_is_averaged_in_before_coding(folder, tmp_path, capsys):
    out = tmp_path / "m.safetensors"
    run("learn", ROUTE, "--average", f"{ROUTE}&traverse=1", "--map", out, *CHUNKS)
    assert "each place is the mean of" in capsys.readouterr().out
    model = DejaVu.load(out)
    counts = model.map.visit_counts
    assert (int(counts.sum()), len(counts)) == (256, 128)  # the sims carry their positions
    assert model.calibration is not None
    run("info", out)
    assert f"{counts.double().mean():.3g} visits" in capsys.readouterr().out
    run("learn", ROUTE, "--average", f"{ROUTE}&traverse=1", "--average_truth", "0", "--map", out, *CHUNKS)
    assert DejaVu.load(out).map.visits.tolist() == [[128, 2]]


def test_a_visit_is_averaged_into_a_map_that_is_there(folder, tmp_path, capsys):
    first, out = folder / "first.safetensors", tmp_path / "m.safetensors"
    before = first.read_bytes()
    visit = "--average", f"{FIRST}&traverse=1", "--average_truth", "0"
    run("learn", "--append", first, *visit, "--map", out)
    told = capsys.readouterr().out
    assert f"64 of the 64 places of {first}: averaged and coded again at the same step" in told
    assert "mean of 2 visits" in told
    model = DejaVu.load(out)
    assert (model.map.places, model.map.visits.tolist()) == (64, [[64, 2]])
    assert model.calibration is not None
    another = ("--calibration", f"{FIRST}&traverse=2", "--calibration_truth", "0", "--precision", ".9")
    run("learn", "--append", first, *visit, "--map", out, *another)
    assert DejaVu.load(out).precision == 0.9
    assert first.read_bytes() == before
    visit = "--average", f"{NEXT}&traverse=1", "--average_truth", "0"
    run("learn", NEXT, "--append", first, *visit, "--map", out)
    assert DejaVu.load(out).map.visits.tolist() == [[64, 1], [64, 2]]
    whole = tmp_path / "whole.safetensors"
    run("learn", folder / "d.npy", "--map", whole, "--calibration", "none", "--whitening", "none")
    run(
        "learn", "--append", whole, "--average", folder / "d.npy", "--average_truth", "0"
    )  # a map of one chunk can be averaged
    assert DejaVu.load(whole).map.visits.tolist() == [[96, 2]]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("learn d.npy --append f.safetensors --seed 4", ["--seed", "--append"]),
        ("learn d.npy --append f.safetensors --config=paper", ["--config", "--append"]),
        ("learn d.npy --append f.safetensors --features.cell 4", ["f.safetensors", "cell"]),
        ("learn d.npy --append f.safetensors --precision .9", ["a precision, 0.9", "--calibration SOURCE"]),
        ("learn d.npy --append sure.safetensors", ["a precision, 0.9", "d.npy", "--threshold"]),
        ("learn --append f.safetensors", ["no source"]),
        ("learn --map m.safetensors --average d.npy", ["no source"]),
        ("learn --append f.safetensors --average d.npy --map d.npy", ["--map d.npy"]),
        ("learn d.npy --map m.safetensors --average ./d.npy", ["--average ./d.npy is", "itself"]),
        ("learn d.npy --map m.safetensors --average e.npy --calibration ./e.npy", ["e.npy itself"]),
        ("learn d.npy d.npy --map m.safetensors --calibration ./d.npy", ["d.npy itself"]),
        ("learn d.npy --map m.safetensors --average_truth 0", ["--average SOURCE"]),
        ("merge first.safetensors ./first.safetensors --map m.safetensors", ["the same file"]),
        ("merge first.safetensors f.safetensors --map f.safetensors", ["f.safetensors is an input"]),
        ("compare a.npy a.npy --map both.safetensors --out e", ["both.safetensors has", "first, other"]),
        ("export both.safetensors --onnx both.onnx", ["routes first, other"]),
        (
            f"live both.safetensors {ROUTE} --page 0 --reference {ROUTE}",
            ["--reference", "first, other"],
        ),
        ("evaluate r.csv --truth 0 --out e --route first --map both.safetensors", ["r.csv, line 2"]),
    ],
)
def test_what_is_refused_leaves_all_files(folder, merged, capsys, monkeypatch, words, said):
    monkeypatch.chdir(folder)
    np.save(folder / "e.npy", np.load(folder / "d.npy"))
    (folder / "r.csv").write_text("query,place,score\n0,0,.1\n")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    error = fails(capsys, *words.split())
    assert [one for one in said if one not in error] == [], error
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
