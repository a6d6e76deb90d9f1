"""The one place that imports torchaudio, and what replaces it if its wheel does not load.

torchaudio's compiled library refuses a torch of another build at import, so the import is tried, never
probed; `BACKEND` names the active one: "torchaudio" or "torch.stft".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn


class StftSpectrogram(nn.Module):
    """torchaudio.transforms.Spectrogram on torch.stft: same arguments, same persistent `window` buffer.

    Shape: (..., time) -> (..., n_fft // 2 + 1, frames), or (..., n_fft, frames) if not onesided.
    """

    window: Tensor

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
        length = n_fft if win_length is None else win_length
        self.register_buffer("window", window_fn(length, **(wkwargs or {})))
        self.pad, self.power, self.normalized = pad, power, normalized in (True, "window")
        self.options: dict[str, Any] = {
            "n_fft": n_fft,
            "win_length": length,
            "hop_length": length // 2 if hop_length is None else hop_length,
            "center": center,
            "pad_mode": pad_mode,
            "normalized": normalized == "frame_length",
            "onesided": onesided,
            "return_complex": True,
        }

    def forward(self, waveform: Tensor) -> Tensor:
        lead = waveform.shape[:-1]
        waves = nn.functional.pad(waveform, (self.pad, self.pad)).reshape(
            -1, waveform.shape[-1] + 2 * self.pad
        )
        spectrum = torch.stft(waves, window=self.window, **self.options)
        spectrum = spectrum.reshape(lead + spectrum.shape[-2:])
        if self.normalized:
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
