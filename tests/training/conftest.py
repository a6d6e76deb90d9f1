"""A folder in which `dejavu train` has run."""

from __future__ import annotations

import numpy as np
import pytest
from small_training import CONFIG, MINE, footage, train

from dejavu_torch import DejaVu
from dejavu_torch.training.task import RouteTask


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """A folder with traverses, a config, a user's module, and a training."""
    folder = tmp_path_factory.mktemp("train")
    for name, frames in {"one": footage(), "two": footage(0.1)}.items():
        np.save(folder / f"{name}.npy", frames.numpy())
    (folder / "train.yaml").write_text(CONFIG)
    (folder / "mine.py").write_text(MINE)
    (folder / "a_file").write_text("not a folder")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        train("fit")
    return folder


@pytest.fixture(autouse=True)
def _without_calibration(request, monkeypatch):
    """Of many small trainings, of which it takes a third; those of the command are calibrated."""
    if request.path.stem != "test_train_command":
        monkeypatch.setattr(DejaVu, "calibrate", lambda self, *_, **__: self)


@pytest.fixture(autouse=True)
def _without_a_word_on_short_routes(request, monkeypatch):
    """As all of these are; test_held_out.py is about it."""
    if request.path.stem != "test_held_out":
        monkeypatch.setattr(RouteTask, "_say_few", lambda _: None)


@pytest.fixture
def folder(made, monkeypatch):
    monkeypatch.chdir(made)
    monkeypatch.syspath_prepend(str(made))
    return made
