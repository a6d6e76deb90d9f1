"""The main job, `dejavu demo`, on the first places of its route: the report and its pictures."""

from __future__ import annotations

import json
import re
from contextlib import redirect_stdout

import pytest
from PIL import Image

import dejavu_torch
from dejavu_torch.cli import main, reports
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation import reproduce
from dejavu_torch.evaluation.reproduce import paper_model
from dejavu_torch.types import InputError

FRAMES = 256
PICTURES = ("examples", "pairs", "coverage", "scores", "pr", "storage", "sequences", "reliability")


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    paper = paper_model()
    paper.mapper.periods.window = FRAMES  # type: ignore[union-attr]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reproduce, "paper_model", lambda: paper)
        patch.setattr(reports, "open_source", lambda source: open_source(f"{source}&stop={FRAMES}"))
        with (out / "printed.txt").open("w") as printed, redirect_stdout(printed):
            main(["demo", "--out", str(out)])
    return out


def test_it_prints_what_was_found_in_few_lines(demo):
    lines = (demo / "printed.txt").read_text().splitlines()
    assert len(lines) <= 18
    assert "real flights" in lines[0]
    ways = r"by the whole drive, \d+ by one image"
    assert re.fullmatch(rf"FOUND \d+ of {FRAMES} within 5 frames {ways}", lines[2])
    assert re.fullmatch(r"accepted and right \d+, accepted and wrong \d+, not accepted \d+", lines[3])
    assert lines[-3].endswith("index.html")
    report = json.loads((demo / "report.json").read_text())
    for key in ("one_byte", "product_quantiser", "hog", "null"):
        assert f"{100 * report[key]['recall_at_1']:.1f}%" in "\n".join(lines)
    for other in ("Whitening", "DejaVu("):  # settings are on the page
        assert other not in "\n".join(lines)


def test_the_own_result_is_there_before_it_is_compared(demo, tmp_path, monkeypatch):
    """Map, matches and page at FOUND, and no report.json, not even that of a run before."""
    out, seen = tmp_path / "out", {}
    out.mkdir()
    (out / "report.json").write_text("{}")

    def compared(*_):
        seen.update({file.name: file.read_bytes() for file in out.iterdir()})
        raise InputError("stopped while comparing")

    monkeypatch.setattr("dejavu_torch.evaluation.compare.baselines_of", compared)
    words = ["demo:road?stop=60", "demo:road?traverse=1&stop=60", "--bytes", "8", "--out", str(out)]
    with pytest.raises(SystemExit):
        main(["compare", *words])
    assert {"index.html", "map.safetensors", "matches.csv", "pairs.png", "pr.png"} <= seen.keys()
    assert "report.json" not in seen
    assert {file.name: file.read_bytes() for file in out.iterdir()} == seen
    assert dejavu_torch.DejaVu.load(out / "map.safetensors").map.places == 60


def test_pictures_show_something(demo):
    for name in PICTURES:
        with Image.open(demo / f"{name}.png") as image:
            assert min(image.size) > 300
            assert len(image.convert("RGB").resize((100, 100)).getcolors(10_000)) > 20
