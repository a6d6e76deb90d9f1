"""`dejavu demo` run whole: what README tells of it."""

from __future__ import annotations

import csv
import json
import re
import shlex
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from dejavu_torch.cli import main

pytestmark = pytest.mark.figures
README = Path(__file__).parents[2] / "README.md"
OF_TEMPLATES = {"chunks", "spectrogram", "templates", "features", "activations"}


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    with (out / "printed.txt").open("w") as printed, redirect_stdout(printed):
        main(["demo", "--out", str(out)])
    return out


@pytest.fixture(scope="module")
def report(demo):
    return json.loads((demo / "report.json").read_text())


def test_the_imposed_periods_are_among_the_strongest(report):
    assert report["periods"] == sorted(set(report["periods"]))
    for period in (93, 171):
        assert min(abs(found - period) for found in report["periods"]) < 1


def test_convention_8_figures_stand_beside_their_null_and_fair_baselines(report):
    assert report["auc"] > max(report[name]["auc"] for name in ("hog", "null", "stride"))
    # keyframes get the bytes of the route, and every 10th descriptor more of them
    assert report["interpolated"]["route_bytes"] <= report["route_bytes"] < report["stride"]["route_bytes"]
    assert report["interpolated"]["route_bytes"] > 0.9 * report["route_bytes"]


def test_order_saves_bytes_and_most_of_all_where_they_are_few(report):
    map, null, interpolated = (report["storage"][name] for name in ("map", "null", "interpolated"))
    assert len(map) == len(null) == 5
    assert map[0]["auc"] > 0.95
    assert max(null[0]["auc"], interpolated[0]["auc"]) < 0.4
    for name, entry in (("the map in 1 byte", map[0]), ("null in 1 byte", null[0])):
        told_of = told()[name]
        assert told_of[:2] == pytest.approx([entry["auc"], entry["recall_at_1"]], abs=0.02)
        assert told_of[2] == pytest.approx(entry["route_bytes_per_place"], rel=0.01)


def test_repetition_saves_as_little_as_readme_tells(report):
    found = re.search(r"takes only (\d+) % more bytes", " ".join(README.read_text().split()))
    assert found is not None
    assert report["noise_over_map"] == pytest.approx(1 + int(found[1]) / 100, abs=0.015)


def test_fixed_bytes_are_what_readme_tells(report):
    for found in re.findall(r"(\d+) kB, nearly all|fixed (\d+) kB", README.read_text()):
        assert report["fixed_bytes"] / 1000 == pytest.approx(int(found[0] or found[1]), rel=0.02)


def test_it_ends_with_commands_to_try(demo, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = (demo / "printed.txt").read_text().splitlines()[-3:]
    commands = [shlex.split(line.partition("or try: dejavu ")[2]) for line in lines]
    assert [words[0] for words in commands] == ["localize", "compare", "compare"]
    main(commands[0])
    found, shown = (list(csv.DictReader((one / "matches.csv").open())) for one in (tmp_path, demo))
    # of batches of other sizes
    for row, other in zip(found, shown, strict=True):
        assert float(row.pop("score")) == pytest.approx(float(other.pop("score")), abs=1e-4)
        assert float(row.pop("probability")) == pytest.approx(float(other.pop("probability")), abs=1e-4)
        assert row == other


def told():
    """The rows of README's table: AUC, recall@1, and bytes of the route per place."""
    table = README.read_text().split("## Results")[1].split("The null codes")[0]
    rows = (line.replace("*", "").split("|") for line in table.splitlines() if re.search(r"\| \d+\.\d", line))
    return {cells[1].strip(): [float(cell) for cell in cells[2:5]] for cells in rows}


def test_readme_tells_what_the_demo_measures(report):
    named = {
        "this map": report,
        "its descriptors of all frames, float": report["uncompressed"],
        "HOG, all frames": report["hog"],
        "HOG, every 10th frame": report["hog_stride_coarsest"],
        "null: shuffled frames": report["null"],
    }
    assert {*told()} == {*named, "the map in 1 byte", "null in 1 byte"}
    for name, entry in named.items():  # another machine rounds otherwise
        assert told()[name][:2] == pytest.approx([entry["auc"], entry["recall_at_1"]], abs=0.02)
        route = entry.get("route_bytes", report["route_bytes"]) / 3072
        assert told()[name][2] == pytest.approx(route, rel=0.02)


def test_a_map_of_templates_has_its_pictures_and_its_periods(tmp_path):
    main(["demo", "--config", "local_maxima", "--out", str(tmp_path)])
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["auc"] < told()["HOG, every 10th frame"][0]  # as README says of such maps
    assert {path.stem for path in tmp_path.glob("*.png")} >= OF_TEMPLATES
    assert all({93, 171} <= set(chunk["periods"]) for chunk in report["chunks"])

    # its null keeps the map's layers, and shows what storing alone does; the other finds few periods, or none
    assert report["null"]["recall_at_1"] <= 0.4 * report["recall_at_1"]
    assert 0 < report["null_same_plan"]["auc"] < report["auc"]
