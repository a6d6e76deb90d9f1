"""The one place that imports torchaudio, and what stands in where its wheel does not load.

torchaudio's compiled library refuses a torch of another build at import time. The import is tried,
never probed; `BACKEND` tells which one is active: "torchaudio" or "torch.stft".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn


class StftSpectrogram(nn.Module):
    """torchaudio.transforms.Spectrogram on torch.stft: same arguments, same persistent `window` buffer.

    Args: as torchaudio.transforms.Spectrogram; power=None returns the complex spectrum.

    Shape: (..., time) -> (..., n_fft // 2 + 1, frames), or (..., n_fft, frames) where not onesided.
    """

    def __init__(
        self,
        n_fft: int = 400,
        win_length: int | None = None,
        hop_length: int | None = None,
        pad: int = 0,
        window_fn: Callable[..., Tensor] = torch.hann_window,
        power: float | None = 2.0,
        normalized: bool | str = False,
        wkwargs: dict[str, Any] | None = None,
        center: bool = True,
        pad_mode: str = "reflect",
        onesided: bool = True,
    ) -> None:
        super().__init__()
        self.n_fft = n_fft
        self.win_length = win_length if win_length is not None else n_fft
        self.hop_length = hop_length if hop_length is not None else self.win_length // 2
        self.register_buffer("window", window_fn(self.win_length, **(wkwargs or {})))
        self.pad = pad
        self.power = power
        self.normalized = normalized
        self.center = center
        self.pad_mode = pad_mode
        self.onesided = onesided

    window: Tensor

    def forward(self, waveform: Tensor) -> Tensor:
        if self.pad > 0:
            waveform = nn.functional.pad(waveform, (self.pad, self.pad))
        lead = waveform.shape[:-1]
        spectrum = torch.stft(
            waveform.reshape(-1, waveform.shape[-1]),
            n_fft=self.n_fft,
            hop_length=self.hop_length,
            win_length=self.win_length,
            window=self.window,
            center=self.center,
            pad_mode=self.pad_mode,
            normalized=self.normalized == "frame_length",
            onesided=self.onesided,
            return_complex=True,
        )
        spectrum = spectrum.reshape(lead + spectrum.shape[-2:])
        if self.normalized is True or self.normalized == "window":
            spectrum = spectrum / self.window.square().sum().sqrt()
        if self.power is None:
            return spectrum
        return spectrum.abs() if self.power == 1 else spectrum.abs().pow(self.power)


Spectrogram: Callable[..., nn.Module]
try:
    from torchaudio.transforms import Spectrogram  # type: ignore[no-redef]

    BACKEND = "torchaudio"
except (ImportError, OSError, RuntimeError):
    Spectrogram = StftSpectrogram
    BACKEND = "torch.stft"
