"""The spectrogram of each feature through time and the periods read off it (section III-A)."""

from __future__ import annotations

import logging
import math
from inspect import signature
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.periods.layers import layers_of
from dejavu_torch.periods.stft import Spectrogram
from dejavu_torch.types import FrequencyLayer, InputError, Plan

log = logging.getLogger("dejavu_torch")

NUMBERS_AT_ONCE = 2**22  # of a chunk's features, so that memory does not grow with their number
HANN_PEAK = 2 / 3  # share of its power that a pure wave holds in its own bin under a Hann window


class Spectrum(NamedTuple):
    """Power of every feature at every frequency of one chunk [start, stop), n = stop - start places.

    power: (n // 2 + 1, D); bin k is the frequency k / n per place, the period n / k places.
    """

    start: int
    stop: int
    power: Tensor


def strongest_bins(power: Tensor, count: int, last: int, peaks: Literal["bins", "local"]) -> Tensor:
    """The `count` strongest bins of each feature among bins 2..last, strongest first (section III-A).

    Args:
        peaks: "bins" ranks all bins by power; "local" ranks only local maxima, so that a peak and
            its own leakage into the next bin are not taken for two periods.

    Shape: (K,D) -> (count,D) int64, -1 if a feature has no more such bins.

    Convention: a bin without power is no candidate; of equal bins the lower one wins.
    """
    bins, features = power.shape
    candidates = torch.zeros_like(power, dtype=torch.bool)
    candidates[2 : last + 1] = power[2 : last + 1] > 0
    if peaks == "local":
        edge = power.new_full((1, features), -math.inf)
        candidates &= (power > torch.cat([edge, power[:-1]])) & (power >= torch.cat([power[1:], edge]))
    ranked = power.masked_fill(~candidates, -math.inf)
    order = ranked.argsort(dim=0, descending=True, stable=True)[:count]
    found = order.masked_fill(~candidates.gather(0, order), -1)
    return nn.functional.pad(found, (0, 0, 0, max(0, count - bins)), value=-1)


def noise_share(bins: int, features: int, false_alarm: float) -> float:
    """Share of its power that any of so many features of white noise holds in one bin, with this probability.

    Fisher's test for a hidden period, P(largest of K shares > g) <= K * (1 - g)**(K - 1), with Bonferroni's
    bound over the D features of a chunk.

    Source: R. A. Fisher, Tests of significance in harmonic analysis, Proc. R. Soc. A 125 (1929).

    Example:
        >>> round(noise_share(512, 1764, 1e-3), 3)
        0.04
    """
    return float(1 - (false_alarm / (bins * features)) ** (1 / max(bins - 1, 1)))


class SpectrogramAnalysis(PeriodFinder):
    """Which features repeat, where and how often, by the spectrogram of each (section III-A).

    Args:
        window: places per spectrum, which is also the length of a chunk.
        hop: places from one chunk to the next; None is `window`, chunks side by side.
        min_period: shortest period considered, in places. The longest is half the window (bin 2): bins 0
            and 1 hold the mean, slow drift, and their leakage through the Hann window.
        strongest: how many of its strongest frequencies a feature keeps.
        peaks: "local" ranks local maxima of the spectrum, "bins" ranks all its bins (the paper).
        false_alarm: a chunk gets layers only if some frequency holds a larger share of its feature's power
            than white noise would anywhere in the chunk with at most this probability (`noise_share`).
            Smooth footage passes, whether it repeats or not. None: every chunk gets layers (the paper).
        short: for a route shorter than the window: "shrink" the window to it and log that, or "refuse".

    Shape: features (N,D) -> tuple of G spectra, one for each chunk, each (n // 2 + 1, D).

    Convention: Hann window, not centred. The places after the last whole window are a shorter window of
        their own, left out if they are fewer than two of the shortest periods. A feature that does not
        vary inside a chunk has no power there. Features of equal `bin_period` share a layer. A chunk too
        short for any wave to pass `false_alarm` is logged.

    Raises:
        InputError: an argument out of range; features that are not float (N,D) or not finite, or fewer
            places than two of the shortest periods, or than the window if `short` is "refuse".

    Example:
        >>> wave = torch.sin(torch.arange(256) * 2 * torch.pi / 32)[:, None]
        >>> [(layer.period, layer.stop) for layer in SpectrogramAnalysis(256, strongest=1).plan(wave)]
        [(Fraction(32, 1), 256)]
    """

    def __init__(
        self,
        window: int = 1024,
        hop: int | None = None,
        min_period: int = 4,
        strongest: int = 2,
        peaks: Literal["local", "bins"] = "local",
        false_alarm: float | None = 1e-3,
        short: Literal["shrink", "refuse"] = "shrink",
    ) -> None:
        super().__init__()
        if min_period < 2 or window < 2 * min_period or strongest < 1:
            raise InputError(
                f"spectrogram got window={window}, min_period={min_period}, strongest={strongest}; "
                "expected min_period >= 2, window >= 2 * min_period, strongest >= 1"
            )
        if hop is not None and not 1 <= hop <= window:
            raise InputError(f"spectrogram got hop={hop}; expected 1..{window} (the window)")
        if peaks not in ("local", "bins") or short not in ("shrink", "refuse"):
            raise InputError(
                f"spectrogram got peaks={peaks!r}, short={short!r}; expected peaks 'local' or 'bins', "
                "short 'shrink' or 'refuse'"
            )
        if false_alarm is not None and not 0 < false_alarm < 1:
            raise InputError(
                f"spectrogram got false_alarm={false_alarm}; expected None or a number in (0, 1)"
            )
        self.window, self.hop, self.min_period, self.strongest = window, hop, min_period, strongest
        self.peaks, self.false_alarm, self.short = peaks, false_alarm, short
        self._logged: set[str] = set()

    def chunks(self, places: int) -> list[tuple[int, int]]:
        """The chunks [start, stop) that a route of so many places is cut into."""
        shortest = 2 * self.min_period
        if places < shortest:
            raise InputError(
                f"the route has {places} place{'s' * (places != 1)}; expected at least {shortest}, "
                f"two periods of {self.min_period}"
            )
        if places < self.window and self.short == "refuse":
            raise InputError(
                f"the route has {places} places; expected at least {self.window}, the window, "
                "or a shorter window, or one that shrinks (--mapper.periods.short shrink)"
            )
        window = min(self.window, places)
        hop = min(self.hop or window, window)
        chunks = [(start, start + window) for start in range(0, places - window + 1, hop)]
        rest = chunks[-1][0] + hop
        if chunks[-1][1] < places and places - rest >= shortest:
            chunks.append((rest, places))
        return chunks

    def forward(self, features: Tensor) -> tuple[Spectrum, ...]:
        check_features(features)
        chunks = self.chunks(len(features))
        return tuple(Spectrum(start, stop, chunk_power(features[start:stop])) for start, stop in chunks)

    @torch.no_grad()
    def plan(self, features: Tensor) -> Plan:
        """The layers of a route, where gradients stop.

        Shape: features (N,D) -> plan, ordered by chunk and then by period.
        """
        check_features(features)
        places = len(features)
        chunks = self.chunks(places)
        if places < self.window:
            self._warn_once(f"window shrunk from {self.window} to {places} places, the whole route")
        layers: list[FrequencyLayer] = []
        for start, stop in chunks:
            bins, share = self._strongest(features[start:stop])
            if self._exceeds_noise(share, start, stop):
                layers += layers_of(bins, start, stop)
        return tuple(layers)

    def _strongest(self, chunk: Tensor) -> tuple[Tensor, Tensor]:
        """The strongest bins of each feature (count,D), and the largest share of its power in one (D,)."""
        kept, shares = [], []
        for columns in chunk.split(max(1, NUMBERS_AT_ONCE // len(chunk)), 1):
            power = chunk_power(columns)
            bins = strongest_bins(
                power, min(self.strongest, len(power)), len(chunk) // self.min_period, self.peaks
            )
            share = power.gather(0, bins.clamp(min=0)) / power[1:].sum(0)
            kept.append(bins)
            shares.append(share.where(bins > 0, 0.0).amax(0))
        return torch.cat(kept, 1), torch.cat(shares)

    def _exceeds_noise(self, share: Tensor, start: int, stop: int) -> bool:
        """Whether any frequency of a chunk is stronger than noise that is new at every place."""
        if self.false_alarm is None:
            return True
        least = noise_share((stop - start) // 2, len(share), self.false_alarm)
        if least > HANN_PEAK:
            self._warn_once(f"places {start}-{stop - 1}: too few to tell a period from noise; no layers here")
        return bool((share > least).any())

    def _warn_once(self, message: str) -> None:
        if message not in self._logged:
            log.warning(message)
            self._logged.add(message)

    def extra_repr(self) -> str:
        return ", ".join(f"{name}={getattr(self, name)!r}" for name in signature(type(self)).parameters)


def check_features(features: Tensor) -> None:
    """Refuse what is not a float tensor (N,D)."""
    if not isinstance(features, Tensor):
        raise InputError(f"spectrogram got a {type(features).__name__}; expected a float tensor (N,D)")
    if features.ndim != 2 or not features.is_floating_point():
        raise InputError(
            f"spectrogram got {tuple(features.shape)} {features.dtype}; expected float features (N,D)"
        )


def chunk_power(chunk: Tensor) -> Tensor:
    """Power of the Hann spectrum of one chunk: (n,D) -> (n // 2 + 1, D)."""
    if not chunk.isfinite().all():
        raise InputError("spectrogram got features that are not finite; expected finite numbers")
    length = len(chunk)
    centred = chunk - chunk.mean(0)
    # rounding leaves a constant feature a trace of power: zero it, or noise would name its period
    constant = centred.abs().amax(0) <= 8 * torch.finfo(chunk.dtype).eps * chunk.abs().amax(0)
    transform = Spectrogram(
        n_fft=length, hop_length=length, center=False, power=2.0, wkwargs={"dtype": chunk.dtype}
    )
    power: Tensor = transform.to(chunk)(centred.masked_fill(constant, 0.0).T)[..., 0].T
    return power
