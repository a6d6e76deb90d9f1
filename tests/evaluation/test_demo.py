"""The main job, `dejavu demo`, on the first places of its route: the report and its pictures."""

from __future__ import annotations

import json
import re
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from dejavu_torch import DejaVu
from dejavu_torch.cli import commands, main
from dejavu_torch.data.source import open_source

FRAMES = 1024
PICTURES = ("pairs", "coverage", "scores", "pr", "auc", "storage", "spectrum", "components", "reliability")
OF_TEMPLATES = {"chunks", "spectrogram", "templates", "features", "activations"}


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(commands, "open_source", lambda source: open_source(f"{source}&frames={FRAMES}"))
        with (out / "printed.txt").open("w") as printed, redirect_stdout(printed):
            main(["demo", "--out", str(out)])
    return out


@pytest.fixture(scope="module")
def report(demo: Path) -> dict[str, Any]:
    return json.loads((demo / "report.json").read_text())


def test_map_bytes_is_the_size_of_the_file(demo: Path, report: dict[str, Any]) -> None:
    path = demo / "map.safetensors"
    assert report["map_bytes"] == path.stat().st_size
    assert report["bytes_per_place"] == pytest.approx(path.stat().st_size / FRAMES)
    model = DejaVu.load(path)
    assert report["lines"] == model.summary().lines
    # the budget, within 2 % and not above
    assert 4.9 <= report["route_bytes_per_place"] == report["route_bytes"] / FRAMES <= 5
    assert report["map_bytes"] == report["route_bytes"] + report["fixed_bytes"] <= 300_000


def test_pictures_show_something(demo: Path) -> None:
    for name in PICTURES:
        with Image.open(demo / f"{name}.png") as image:
            assert min(image.size) > 300
            assert len(image.convert("RGB").resize((100, 100)).getcolors(10_000)) > 20


def test_page_is_self_contained(demo: Path) -> None:
    page = (demo / "index.html").read_text()
    assert not OF_TEMPLATES & {path.stem for path in demo.glob("*.png")}
    assert page.count("data:image/png;base64,") == len(PICTURES)
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    assert "right within 5 frames" in page
    assert "null: shuffled frames, as many bytes" in page
    assert "<pre>dejavu demo --out" in page
    assert "dejavu_torch" in page


def test_matches_agree_with_the_report(demo: Path, report: dict[str, Any]) -> None:
    rows = [line.split(",") for line in (demo / "matches.csv").read_text().splitlines()[1:]]
    right = sum(abs(int(place) - int(query)) <= 5 for query, place, *_ in rows)
    assert right / len(rows) == pytest.approx(report["recall_at_1"])
