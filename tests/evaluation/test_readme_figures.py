"""`dejavu demo` run whole: what README tells of it."""

from __future__ import annotations

import json
import re
import shlex
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from dejavu_torch import DejaVu
from dejavu_torch.cli import main

pytestmark = pytest.mark.figures
README = Path(__file__).parents[2] / "README.md"
OTHERS = ("uncompressed", "stride", "interpolated", "null", "hog", "hog_stride_coarsest", "paper")
OF_TEMPLATES = {"chunks", "spectrogram", "templates", "features", "activations"}


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demo")
    with (out / "printed.txt").open("w") as printed, redirect_stdout(printed):
        main(["demo", "--out", str(out)])
    return out


@pytest.fixture(scope="module")
def report(demo: Path) -> dict[str, Any]:
    return json.loads((demo / "report.json").read_text())


def test_the_imposed_periods_are_among_the_strongest(report: dict[str, Any]) -> None:
    assert report["periods"] == sorted(set(report["periods"]))
    for period in (93, 171):
        assert min(abs(found - period) for found in report["periods"]) < 1


def test_convention_8_figures_stand_beside_their_null_and_fair_baselines(report: dict[str, Any]) -> None:
    assert report["auc"] > max(report[name]["auc"] for name in ("hog", "null", "stride"))
    # keyframes get the bytes of the route, and every 10th descriptor more of them
    assert report["interpolated"]["route_bytes"] <= report["route_bytes"] < report["stride"]["route_bytes"]
    assert report["interpolated"]["route_bytes"] > 0.9 * report["route_bytes"]


def test_order_saves_bytes_and_most_of_all_where_they_are_few(report: dict[str, Any]) -> None:
    map, null, interpolated = (report["storage"][name] for name in ("map", "null", "interpolated"))
    assert len(map) == len(null) == 5
    assert map[0]["auc"] > 0.95
    assert max(null[0]["auc"], interpolated[0]["auc"]) < 0.3
    text = " ".join(README.read_text().split())
    found = re.search(r"takes (\d+) to (\d+) times the bytes", text)
    assert found is not None
    times = sorted(report["storage"]["null_over_map"])
    assert [times[0], times[-1]] == pytest.approx([int(found[1]), int(found[2])], abs=1)
    told = text.split("At 1.0 route bytes per place the map")[1].split(":")[0]
    figures = [float(figure) for figure in re.findall(r"\d\.\d+", told)]
    assert figures == pytest.approx([one[0]["auc"] for one in (map, null, interpolated)], abs=0.02)


def test_repetition_saves_as_little_as_readme_tells(report: dict[str, Any]) -> None:
    found = re.search(r"noise .* takes (\d\.\d+) times the map's bytes", " ".join(README.read_text().split()))
    assert found is not None
    assert report["noise_over_map"] == pytest.approx(float(found[1]), abs=0.015)


def test_it_ends_with_commands_to_try(demo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    lines = (demo / "printed.txt").read_text().splitlines()[-3:]
    commands = [shlex.split(line.partition("or try: dejavu ")[2]) for line in lines]
    assert [words[0] for words in commands] == ["localize", "compare", "compare"]
    main(commands[0])
    assert (tmp_path / "matches.csv").read_text() == (demo / "matches.csv").read_text()


def told() -> dict[str, list[float]]:
    """The rows of README's table: AUC, recall@1, recall at 100 % precision, and bytes where it has some.

    Of the map in other sizes, which lack the third, a test of the curve has the area.
    """
    table = README.read_text().split("## Results")[1].split("Route bytes grow")[0]
    return {
        cells[1].strip(): [float(cell) for cell in cells[2:7] if cell.strip()]
        for line in table.splitlines()
        if re.search(r"\| \d+\.\d", line) and "the map in" not in line and (cells := line.split("|"))
    }


def assert_told(figures: list[float], entry: dict[str, Any]) -> None:
    """Another machine rounds otherwise; recall at 100 % precision hangs on single frames."""
    assert figures[:2] == pytest.approx([entry["auc"], entry["recall_at_1"]], abs=0.02)
    assert figures[2] == pytest.approx(entry["recall_at_100_precision"], abs=0.1)


def test_readme_tells_what_the_demo_measures(report: dict[str, Any]) -> None:
    rows = [figures for name, figures in told().items() if "--config" not in name]
    for figures, entry in zip(rows, (report, *(report[name] for name in OTHERS)), strict=True):
        assert_told(figures, entry)
        if "route_bytes" in entry:
            size = entry.get("map_bytes", entry.get("bytes"))
            measured = [size / 3072, entry["route_bytes"] / 3072]
            assert figures[3:] == pytest.approx(measured, rel=0.02)


def test_maps_of_templates_are_what_readme_tells(tmp_path: Path) -> None:
    main(["demo", "--config", "local_maxima", "--out", str(tmp_path)])
    report = json.loads((tmp_path / "report.json").read_text())
    (figures,) = (figures for name, figures in told().items() if "--config local_maxima" in name)
    assert_told(figures, report)
    measured = [report["bytes_per_place"], report["route_bytes_per_place"]]
    assert figures[3:] == pytest.approx(measured, rel=0.02)
    assert {path.stem for path in tmp_path.glob("*.png")} >= OF_TEMPLATES

    assert report["periods"] == sorted(set(report["periods"]))
    assert all({93, 171} <= set(chunk["periods"]) for chunk in report["chunks"])
    assert all(len(chunk["features"]) == len(chunk["periods"]) for chunk in report["chunks"])
    model = DejaVu.load(tmp_path / "map.safetensors")
    assert report["template_numbers"] == model.map.templates.numel()
    assert report["templates"] == sum(layer.phases for layer in model.map.plan)

    # its null keeps the map's layers, and shows what storing alone does; the other finds few periods, or none
    assert report["null"]["recall_at_1"] <= 0.4 * report["recall_at_1"]
    assert 0 < report["null_same_plan"]["auc"] < report["auc"]
    k = report["stride"]["k"]
    size = report["full_bytes"] // 3072  # bytes of one frame
    assert report["map_bytes"] <= report["stride"]["bytes"] == -(-3072 // k) * size
    assert k == 10 or -(-3072 // (k + 1)) * size < report["map_bytes"]
