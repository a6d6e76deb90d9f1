"""`dejavu demo` run whole: what README tells of it."""

from __future__ import annotations

import csv
import json
import shlex
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from dejavu_torch.cli import main

pytestmark = pytest.mark.figures
RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"
OF_TEMPLATES = {"chunks", "spectrogram", "templates", "features", "activations"}


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    with (out / "printed.txt").open("w") as printed, redirect_stdout(printed):
        main(["demo", "--drives", "all", "--out", str(out)])
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


def test_the_kept_report_is_what_the_demo_finds(report):
    """From which README's table comes; another machine rounds otherwise."""
    (told,) = json.loads((RESULTS / "demo.json").read_text())["rows"]
    assert report["fixed_bytes"] == pytest.approx(told["fixed_bytes"], rel=0.02)
    for key in ("", "one_byte", "stride", "product_quantiser", "uncompressed", "hog", "null"):
        found, kept = (of[key] if key else of for of in (report, told))
        assert found["recall_at_1"] == pytest.approx(kept["recall_at_1"], abs=0.01), key
        assert found["recall_at_99_precision"] == pytest.approx(kept["recall_at_99_precision"], abs=0.06), key
        smoothed = [of["sequences"]["smoother"]["recall_at_1"] for of in (found, kept)]
        assert smoothed[0] == pytest.approx(smoothed[1], abs=0.01), key
        if "route_bytes" in kept:
            assert found["route_bytes"] == pytest.approx(kept["route_bytes"], rel=0.02)


def test_a_map_of_templates_has_its_pictures_and_its_periods(tmp_path):
    main(["demo", "--simulated", "--config", "local_maxima", "--out", str(tmp_path)])
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["auc"] < report["stride_coarsest"]["auc"]  # as README says of such maps
    assert {path.stem for path in tmp_path.glob("*.png")} >= OF_TEMPLATES
    assert all({93, 171} <= set(chunk["periods"]) for chunk in report["chunks"])

    # its null keeps the map's layers, and shows what storing alone does; the other finds few periods, or none
    assert report["null"]["recall_at_1"] <= 0.4 * report["recall_at_1"]
    assert 0 < report["null_same_plan"]["auc"] < report["auc"]
