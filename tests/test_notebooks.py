"""The cells of every notebook run, one after another, on routes and trainings that are short."""

from __future__ import annotations

import json
import logging
import tempfile
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
SHORTER = {
    "a_frame_a_sequence_a_filter": {"-(-100 // len(stretches))": "1"},
    "learning_frequencies": {"%matplotlib inline": ""},
    "magnetometer": {"(0.25, 0.5, 1, 2.5, 5)": "(2.5,)"},
    "sound": {"(0.25, 0.5, 1, 2.5, 5)": "(2.5,)"},
    "the_paper_in_ten_cells": {},
    "what_is_worth_storing": {},
}


@pytest.mark.parametrize("name", SHORTER)
def test_its_cells_run(name, tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(NOTEBOOKS)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.delenv("DEJAVU_FULL", raising=False)
    monkeypatch.setenv("OMP_WAIT_POLICY", "passive")  # and what else a notebook sets is taken back
    caplog.set_level(logging.ERROR, "pytorch_lightning")
    cells = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    for long, short in SHORTER[name].items():
        assert long in code
        code = code.replace(long, short)
    space = {"__name__": "__main__"}
    with plt.rc_context(), warnings.catch_warnings():
        exec(compile(code, f"{name}.ipynb", "exec"), space)
    plt.close("all")


def test_no_notebook_is_left_out():
    assert set(SHORTER) == {path.stem for path in NOTEBOOKS.glob("*.ipynb")}
