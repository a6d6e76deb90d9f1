"""`benchmarks results` and the tables made from it: what is run, what is kept, and where it stands."""

from __future__ import annotations

import json
import shlex
import subprocess

import pytest
from command_line import benchmark, run_here

from benchmarks import pictures, results, tables
from benchmarks.results import FOOTAGE, SEEDS, WAYS, Footage, runs
from dejavu_torch.cli.parser import command_parser
from dejavu_torch.cli.reports import run_compare


def test_every_command_is_understood_and_every_way_is_used():
    parser = command_parser("compare", run_compare)
    planned = list(runs(list(WAYS)))
    for run in planned:
        parser.parse_args([word.replace("{data}", "data") for word in run.words[1:]] + ["--out", "out"])
    assert {run.way for run in planned} == set(WAYS)
    assert {run.footage for run in planned if run.way == "default"} == set(FOOTAGE)


def test_kept_figures_name_no_folder_of_a_machine():
    for file in tables.FOLDER.glob("*.json"):
        assert '"/' not in file.read_text(encoding="utf-8"), file.name


def test_reports_are_kept_and_made_once(tmp_path, monkeypatch, capsys):
    flight = Footage("sim:aerial?frames=48", "sim:aerial?frames=48&traverse=1")
    broken = flight._replace(query="{data}/nowhere.mp4")
    monkeypatch.setattr(results, "FOOTAGE", {"flight": flight, "broken": broken})
    given = ("results", tmp_path, "--out", tmp_path / "out", "--ways", "HOG", "--jobs", "2")

    def refusing(command, **settings):
        refused = ["sh", "-c", "echo 'dejavu: nowhere.mp4 is not there'; exit 2"]  # sooner than a command
        return run_here(refused if any("nowhere" in word for word in command) else command, **settings)

    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "run", refusing)
        benchmark(*given)
    bench = json.loads((tmp_path / "out" / "bench.json").read_text())
    good, bad = bench["rows"]
    assert shlex.split(good["command"])[:3] == ["dejavu", "compare", "sim:aerial?frames=48"]
    assert 0 <= good["null"]["auc"] <= 1
    assert good["hog"]["auc"] == round(good["hog"]["auc"], 4)
    assert "nowhere.mp4" in bad["skipped"]
    assert str(tmp_path) not in bad["command"]
    assert bench["date"] > "2026"
    said = capsys.readouterr().out
    assert "broken, HOG: " in said
    assert "bench.json" in said
    benchmark(*given, "--footage", "flight")
    again = json.loads((tmp_path / "out" / "bench.json").read_text())["rows"]
    assert [row.get("commit") for row in again] == [None, bench["commit"]]  # of the row that is kept


def rows():
    def one(auc, **more):
        return {"auc": auc, "recall_at_1": auc, **more}

    curve = {name: [one(0.5, route_bytes_per_place=1.0)] for name in ("map", "null")}
    beside = {name: one(0.25) for name in ("null", "uncompressed", "hog", "hog_stride_coarsest")}
    known = {"route_bytes_per_place": 5.25, "fixed_bytes": 2000, "storage": curve, **beside}
    names = ["city 1", *(f"sim:aerial, seed {seed}" for seed in SEEDS)]
    areas = [0.5, 0.25, 0.75, 0.5]
    return [
        {"case": name, "contender": "default", **one(area), **known}
        for name, area in zip(names, areas, strict=True)
    ]


def test_tables_stand_where_they_are_marked_and_seeds_are_means(tmp_path, monkeypatch):
    (tmp_path / "results").mkdir()
    monkeypatch.setattr(tables, "FOLDER", tmp_path / "results")
    monkeypatch.setattr(tables, "DOCS", tmp_path)
    monkeypatch.setattr(tables, "README", tmp_path / "page.md")
    page = tmp_path / "page.md"
    page.write_text("A\n<!-- table: routes -->\nold\n<!-- end of table -->\nB\n")
    (tmp_path / "bench.json").write_text(json.dumps({"rows": rows(), "commit": "abc", "equal_auc": 1}))
    tables.main([f"routes={tmp_path / 'bench.json'}"])
    kept = json.loads((tmp_path / "results" / "routes.json").read_text())
    assert kept == {"commit": "abc", "rows": rows()}
    head, _, city, aerial = [line for line in page.read_text().splitlines() if line.startswith("|")]
    assert [cell.strip() for cell in city.split("|")][1:4] == ["city 1", "0.500", "0.250"]
    assert aerial.startswith("| `sim:aerial` | 0.500 | 0.250 |")
    assert aerial.endswith("| 5.2 | 2 |")
    assert head.count("|") == aerial.count("|")
    assert "old" not in page.read_text()
    before = page.read_text()
    tables.main([])
    assert page.read_text() == before


def test_the_pictures_of_results_are_of_what_is_kept():
    panels, city = pictures.recalls(), tables.reports("default")["city 1"]
    assert {*panels} == {name.partition(", seed")[0] for name in FOOTAGE} | {"road of the demo"}
    for way in ("map", "null"):
        assert [recall for _, recall in panels["city 1"][way]] == [
            row["recall_at_1"] for row in city["storage"][way]
        ]
    for way in ("uncompressed", "hog"):
        assert panels["city 1"][way] == [(0.0, city[way]["recall_at_1"])]
    assert len(panels["road of the demo"]["product_quantiser"]) == 6
    drawn = pictures.plot_recalls(panels)[1]
    assert [axis.get_title("left") for axis in drawn.flat[: len(panels)]] == [*panels]
    grown = pictures.growth()
    assert [len(lines) for lines in grown.values()] == [8, 8]
    assert [places for places, _ in grown["recall@1"]["dejavu 4 B"]] == [10**4, 10**5, 10**6]


PAGES = sorted([tables.README, *tables.DOCS.rglob("*.md"), *tables.FOLDER.glob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_tables_of_the_documentation_are_those_of_its_json(page):
    text = page.read_text()
    assert tables.filled(text) == text
