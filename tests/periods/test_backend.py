"""The guarded import of torchaudio, and the spectrogram without it."""

from __future__ import annotations

import builtins
import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

from dejavu_torch.periods import spectrogram

REPOSITORY = Path(__file__).parents[2]

PARITY = """
import torch
from dejavu_torch.periods import spectrogram

assert spectrogram.BACKEND == "torchaudio", spectrogram.BACKEND
torch.manual_seed(0)
for dtype in (torch.float32, torch.float64):
    for places in (8, 9, 300, 1024):
        chunk = torch.randn(places, 5, dtype=dtype)
        chunk[:, 2] = 0.1
        theirs = spectrogram.chunk_power(chunk)
        kept, spectrogram.torchaudio = spectrogram.torchaudio, None
        ours = spectrogram.chunk_power(chunk)
        spectrogram.torchaudio = kept
        assert torch.equal(theirs, ours), (dtype, places)
        assert theirs.shape == (places // 2 + 1, 5)
"""


@pytest.mark.slow
def test_fallback_equals_torchaudio(tmp_path: Path) -> None:
    """Against a copy of torchaudio without its compiled library, which may refuse this torch."""
    spec = importlib.util.find_spec("torchaudio")
    if spec is None or spec.origin is None:
        pytest.skip("torchaudio is not installed")
    shutil.copytree(
        Path(spec.origin).parent,
        tmp_path / "torchaudio",
        ignore=shutil.ignore_patterns("*.so", "__pycache__"),
    )
    path = os.pathsep.join([str(tmp_path), str(REPOSITORY)])
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", PARITY],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr


def load_again(monkeypatch: pytest.MonkeyPatch, error: Exception) -> ModuleType:
    """A second copy of the module, made while importing torchaudio raises `error`."""
    real = builtins.__import__

    def guarded(name: str, *args: object, **kwargs: object) -> ModuleType:
        if name.split(".")[0] == "torchaudio":
            raise error
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", guarded)
    spec = importlib.util.spec_from_file_location("spectrogram_again", spectrogram.__file__)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("error", [ImportError("gone"), OSError("no such library"), RuntimeError("CUDA 13")])
def test_a_torchaudio_that_does_not_load_is_replaced(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    module = load_again(monkeypatch, error)
    assert module.BACKEND == "torch.stft"
    assert ("torchaudio" if spectrogram.torchaudio else "torch.stft") == spectrogram.BACKEND
    chunk = torch.randn(20, 3)
    assert torch.equal(module.chunk_power(chunk), spectrogram.chunk_power(chunk))


def test_other_errors_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(KeyError):
        load_again(monkeypatch, KeyError("a bug"))
