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


def test_convention_8_figures_stand_beside_their_null_and_fair_baselines(report):
    assert report["auc"] > max(report[name]["auc"] for name in ("hog", "null", "stride"))
    # keyframes get the bytes of the route, and every 10th descriptor more of them
    assert report["interpolated"]["route_bytes"] <= report["route_bytes"] < report["stride"]["route_bytes"]
    assert report["interpolated"]["route_bytes"] > 0.9 * report["route_bytes"]


def test_order_saves_bytes_and_most_of_all_where_they_are_few(report):
    map, null, interpolated = (report["storage"][name] for name in ("map", "null", "interpolated"))
    assert len(map) == len(null) == 5
    assert map[0]["auc"] > 0.9
    assert max(null[0]["auc"], interpolated[0]["auc"]) < 0.6


def test_fixed_bytes_are_what_readme_tells(report):
    (told_of,) = {int(one) for one in re.findall(r"here (\d+) kB", README.read_text())}
    assert report["fixed_bytes"] / 1000 == pytest.approx(told_of, rel=0.02)


def test_it_ends_with_commands_to_try(demo, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = (demo / "printed.txt").read_text().splitlines()[-2:]
    commands = [shlex.split(line.partition(": dejavu ")[2]) for line in lines]
    assert [words[0] for words in commands] == ["localize", "compare"]
    main(commands[0])
    found, shown = (list(csv.DictReader((one / "matches.csv").open())) for one in (tmp_path, demo))
    # of batches of other sizes
    for row, other in zip(found, shown, strict=True):
        assert float(row.pop("score")) == pytest.approx(float(other.pop("score")), abs=1e-4)
        assert float(row.pop("probability")) == pytest.approx(float(other.pop("probability")), abs=1e-4)
        assert row == other


def told():
    """The rows of README's table: shares found by one image and by the whole drive, bytes per frame."""
    cells = r"^\| (.*?) \| ([\d.]+) % \| ([\d.]+) % \| ([\d. ]+) \|$"
    rows = re.findall(cells, README.read_text(), re.MULTILINE)
    return {name.strip("*"): [float(one.replace(" ", "")) for one in found] for name, *found in rows}


def test_readme_tells_what_the_demo_measures(report):
    keys = {"this map": "", "one_byte": "", "stride": "", "product_quantiser": "", "hog": "", "null": ""}
    entries = [report, *(report[key] for key in [*keys][1:])]
    assert len(told()) == len(entries)
    for (name, cells), entry in zip(told().items(), entries, strict=True):  # another machine rounds otherwise
        shares = entry["recall_at_1"], entry["sequences"]["smoother"]["recall_at_1"]
        assert cells[:2] == pytest.approx([100 * share for share in shares], abs=2), name
        route = entry.get("route_bytes", report["route_bytes"]) / report["frames"]
        assert cells[2] == pytest.approx(route, rel=0.02)


def test_readme_tells_what_the_picture_shows():
    rows = json.loads((README.parent / "benchmarks/results/front.json").read_text())["rows"]
    text = " ".join(README.read_text().split())
    share = {(row["contender"], row["bytes_per_place"]): row for row in rows}
    one = [share[way]["one_image"] for way in (("map", 1.0), ("product_quantiser", 1))]
    told_of = [f"{100 * found:.0f} %" for found in one]
    assert f"finds {told_of[0]} of the second flight's frames, a product quantiser {told_of[1]}" in text
    assert f"then finds {100 * share['map', 0.5]['whole_drive']:.0f} %" in text


def test_a_map_of_templates_has_its_pictures_and_its_periods(tmp_path):
    main(["demo", "--simulated", "--config", "local_maxima", "--out", str(tmp_path)])
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["auc"] < report["stride_coarsest"]["auc"]  # as README says of such maps
    assert {path.stem for path in tmp_path.glob("*.png")} >= OF_TEMPLATES
    assert all({93, 171} <= set(chunk["periods"]) for chunk in report["chunks"])

    # its null keeps the map's layers, and shows what storing alone does; the other finds few periods, or none
    assert report["null"]["recall_at_1"] <= 0.4 * report["recall_at_1"]
    assert 0 < report["null_same_plan"]["auc"] < report["auc"]
