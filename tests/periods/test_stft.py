"""The guarded import of torchaudio and what stands in for it."""

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

from dejavu_torch.periods import stft
from dejavu_torch.periods.stft import StftSpectrogram

REPOSITORY = Path(__file__).parents[2]

PARITY = """
import itertools, torch
from torchaudio.transforms import Spectrogram
from dejavu_torch.periods.stft import BACKEND, StftSpectrogram

assert BACKEND == "torchaudio", BACKEND
torch.manual_seed(0)
wave = torch.randn(2, 3, 300)
for n_fft, win, hop, pad, power, normalized, center, onesided in itertools.product(
    (64, 100), (None, 50), (None, 17), (0, 8), (None, 1.0, 2.0),
    (False, True, "window", "frame_length"), (False, True), (False, True),
):
    arguments = dict(n_fft=n_fft, win_length=win, hop_length=hop, pad=pad, power=power,
                     normalized=normalized, center=center, onesided=onesided)
    theirs, ours = Spectrogram(**arguments), StftSpectrogram(**arguments)
    assert torch.equal(theirs(wave), ours(wave)), arguments
    assert list(theirs.state_dict()) == list(ours.state_dict()), arguments
    ours.load_state_dict(theirs.state_dict())
hamming = dict(n_fft=64, window_fn=torch.hamming_window, wkwargs={"periodic": False}, pad_mode="constant")
assert torch.equal(Spectrogram(**hamming)(wave), StftSpectrogram(**hamming)(wave))
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
    spec = importlib.util.spec_from_file_location("stft_again", stft.__file__)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("error", [ImportError("gone"), OSError("no such library"), RuntimeError("CUDA 13")])
def test_a_torchaudio_that_does_not_load_is_replaced(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    module = load_again(monkeypatch, error)
    assert module.BACKEND == "torch.stft"
    assert module.Spectrogram is module.StftSpectrogram


def test_other_errors_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(KeyError):
        load_again(monkeypatch, KeyError("a bug"))


def test_which_one_is_active_is_visible() -> None:
    assert stft.BACKEND in ("torchaudio", "torch.stft")
    assert (stft.BACKEND == "torch.stft") == (stft.Spectrogram is StftSpectrogram)


@pytest.mark.parametrize("cls", [StftSpectrogram, stft.Spectrogram], ids=["fallback", "active"])
def test_the_window_is_state(cls: type[torch.nn.Module]) -> None:
    module, other = cls(n_fft=32), cls(n_fft=32, window_fn=torch.ones)
    assert list(module.state_dict()) == ["window"]
    wave = torch.randn(1, 100)
    assert not torch.allclose(module(wave), other(wave))
    other.load_state_dict(module.state_dict())
    assert torch.equal(module(wave), other(wave))


def test_leading_dimensions_stay() -> None:
    module = StftSpectrogram(n_fft=16, hop_length=16, center=False)
    wave = torch.randn(2, 3, 40)
    power = module(wave)
    assert power.shape == (2, 3, 9, 2)
    torch.testing.assert_close(power[1, 2], module(wave[1, 2]))
    assert StftSpectrogram(n_fft=16, hop_length=16, center=False, onesided=False)(wave).shape[2] == 16


def test_fallback_gradients() -> None:
    module = StftSpectrogram(n_fft=8, hop_length=4, center=False).double()
    wave = torch.randn(2, 16, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(module, wave)
