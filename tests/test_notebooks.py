"""The cells of every notebook run, one after another, on short routes, and stored outputs are clean."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
SHORTER = {
    "a_map_of_the_ground": {"metres=256": "metres=48"},
    "a_frame_a_drive_a_map_that_learns": {'width=64"': 'width=64&frames=800"'},
    "the_paper_in_ten_cells": {},
    "two_drives_of_your_own": {"step=4": "step=4&stop=500", "start=500": "start=100&stop=500"},
    "your_descriptors_and_a_product_quantiser": {'=0"': '=0&stop=300"', '=1"': '=1&stop=300"'},
}


def cells(name):
    every = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text())["cells"]
    return [cell for cell in every if cell["cell_type"] == "code"]


@pytest.mark.parametrize("name", SHORTER)
def test_its_cells_run(name, tmp_path, monkeypatch):
    monkeypatch.chdir(NOTEBOOKS)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    code = "\n".join("".join(cell["source"]) for cell in cells(name))
    for long, short in SHORTER[name].items():
        assert long in code
        code = code.replace(long, short)
    with plt.rc_context():
        exec(compile(code, f"{name}.ipynb", "exec"), {"__name__": "__main__"})
    plt.close("all")


@pytest.mark.parametrize("name", SHORTER)
def test_its_outputs_are_those_of_one_run_without_warnings_and_paths(name):
    assert [cell["execution_count"] for cell in cells(name)] == [*range(1, len(cells(name)) + 1)]
    outputs = [output for cell in cells(name) for output in cell["outputs"]]
    assert {output.get("name", "stdout") for output in outputs} == {"stdout"}
    assert "/tmp" not in json.dumps(outputs)


def test_no_notebook_is_left_out():
    assert set(SHORTER) == {path.stem for path in NOTEBOOKS.glob("*.ipynb")}
