"""The main job, `dejavu demo`, on the first places of its route: the report and its pictures."""

from __future__ import annotations

from contextlib import redirect_stdout

import pytest
from PIL import Image

from dejavu_torch.cli import main, reports
from dejavu_torch.data.source import open_source
from dejavu_torch.evaluation import reproduce
from dejavu_torch.evaluation.reproduce import paper_model

FRAMES = 256
PICTURES = ("pairs", "coverage", "scores", "pr", "storage", "sequences", "reliability")


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    paper = paper_model()
    paper.mapper.periods.window = FRAMES  # type: ignore[union-attr]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reproduce, "paper_model", lambda: paper)
        patch.setattr(reports, "open_source", lambda source: open_source(f"{source}&frames={FRAMES}"))
        with (out / "printed.txt").open("w") as printed, redirect_stdout(printed):
            main(["demo", "--out", str(out)])
    return out


def test_pictures_show_something(demo):
    for name in PICTURES:
        with Image.open(demo / f"{name}.png") as image:
            assert min(image.size) > 300
            assert len(image.convert("RGB").resize((100, 100)).getcolors(10_000)) > 20
