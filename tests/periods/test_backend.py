"""The guarded import of torchaudio, and the spectrogram without it."""

from __future__ import annotations

import importlib.util
import multiprocessing
import runpy
import shutil
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from unittest import mock

import pytest
import torch

from dejavu_torch.periods import spectrogram


def loaded_with(torchaudio):
    """The names of the module, made anew with the torchaudio of a folder."""
    with mock.patch.dict(sys.modules), mock.patch.object(sys, "path", [str(torchaudio), *sys.path]):
        for name in [name for name in sys.modules if name.split(".")[0] == "torchaudio"]:
            del sys.modules[name]
        return runpy.run_path(spectrogram.__file__)


def compare_with(torchaudio):
    theirs = loaded_with(torchaudio)
    assert theirs["BACKEND"] == "torchaudio"
    spectrogram.torchaudio = None
    for dtype in (torch.float32, torch.float64):
        for places in (8, 9, 300, 1024):
            chunk = torch.randn(places, 5, dtype=dtype)
            chunk[:, 2] = 0.1
            power = theirs["chunk_power"](chunk)
            assert power.shape == (places // 2 + 1, 5)
            assert torch.equal(power, spectrogram.chunk_power(chunk))


@pytest.mark.filterwarnings("ignore")
def test_fallback_equals_torchaudio(tmp_path):
    """Against a copy of torchaudio without its compiled library, which may refuse this torch; in a process of
    its own, as its classes would stay, and commands import the modules of all classes."""
    spec = importlib.util.find_spec("torchaudio")
    if spec is None or spec.origin is None:
        pytest.skip("torchaudio is not installed")
    left_out = shutil.ignore_patterns("*.so", "__pycache__")
    shutil.copytree(Path(spec.origin).parent, tmp_path / "torchaudio", ignore=left_out)
    with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool:
        pool.submit(compare_with, tmp_path).result()


@pytest.mark.parametrize("error", [ImportError, OSError, RuntimeError])
def test_a_torchaudio_that_does_not_load_is_replaced(error, tmp_path):
    (tmp_path / "torchaudio.py").write_text(f"raise {error.__name__}('no such library')")
    assert loaded_with(tmp_path)["BACKEND"] == "torch.stft"


def test_other_errors_are_not_hidden(tmp_path):
    (tmp_path / "torchaudio.py").write_text("raise KeyError('a bug')")
    with pytest.raises(KeyError):
        loaded_with(tmp_path)
