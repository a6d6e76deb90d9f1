"""The spectrogram of each feature over time, and the periods found in it (section III-A)."""

from __future__ import annotations

import logging
import math
from fractions import Fraction
from typing import Any, Literal, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.text import settings_of
from dejavu_torch.types import FrequencyLayer, InputError, Plan, expect

torchaudio: Any
try:  # its compiled library fails to load with another build of torch
    import torchaudio.functional  # type: ignore[no-redef]
except (ImportError, OSError, RuntimeError):
    torchaudio = None
BACKEND = "torchaudio" if torchaudio else "torch.stft"  # of the spectrogram

log = logging.getLogger("dejavu_torch")

NUMBERS_AT_ONCE = 2**22  # values of a chunk, so that memory does not grow with the number of features
HANN_PEAK = 2 / 3  # share of its power that a pure wave has in its own bin under a Hann window

Bin = TypeVar("Bin", int, Tensor)


class Spectrum(NamedTuple):
    """Power (n // 2 + 1, D) of each feature in a chunk [start, stop) of n places; bin k is period n / k."""

    start: int
    stop: int
    power: Tensor


def chunk_power(chunk: Tensor) -> Tensor:
    """Power of the Hann spectrum of one chunk, at least float32: (n,D) -> (n // 2 + 1, D)."""
    chunk = chunk.to(torch.promote_types(chunk.dtype, torch.float32))
    centred = chunk - chunk.mean(0)
    # rounding leaves a constant feature some power, in which noise would choose a period: set it to zero
    constant = centred.abs().amax(0) <= 8 * torch.finfo(chunk.dtype).eps * chunk.abs().amax(0)
    waves = centred.masked_fill(constant, 0.0).T
    n, window = len(chunk), torch.hann_window(len(chunk), dtype=chunk.dtype, device=chunk.device)
    power: Tensor
    if torchaudio:
        power = torchaudio.functional.spectrogram(waves, 0, window, n, n, n, 2.0, False, center=False)
    else:
        power = torch.stft(waves, n, n, window=window, center=False, return_complex=True).abs().square()
    return power[..., 0].T


def strongest_bins(power: Tensor, count: int, last: int, peaks: Literal["bins", "local"]) -> Tensor:
    """The `count` strongest bins of each feature among bins 2..last with power, strongest first.

    Args:
        peaks: "bins" ranks all bins, "local" only local maxima, so that leakage adds no second period.

    Shape: (K,D) -> (count,D) int64, -1 if a feature has fewer such bins; among equal bins the lower one wins.
    """
    candidates = torch.zeros_like(power, dtype=torch.bool)
    candidates[2 : last + 1] = power[2 : last + 1] > 0
    if peaks == "local":
        edge = power.new_full((1, power.shape[1]), -math.inf)
        candidates &= (power > torch.cat([edge, power[:-1]])) & (power >= torch.cat([power[1:], edge]))
    ranked = power.masked_fill(~candidates, -math.inf)
    order = ranked.argsort(dim=0, descending=True, stable=True)[:count]
    found = order.masked_fill(~candidates.gather(0, order), -1)
    return nn.functional.pad(found, (0, 0, 0, count - len(found)), value=-1)


def bin_period(length: int, k: Bin) -> Bin:
    """Period of bin k of a spectrum over `length` places, to the nearest place: length / k, halves up.

    Example:
        >>> bin_period(1024, 11), bin_period(1024, 6)  # the paper's two periods
        (93, 171)
    """
    return (2 * length + k) // (2 * k)


def layers_of(bins: Tensor, start: int, stop: int) -> list[FrequencyLayer]:
    """Layers of a chunk [start, stop), one per `bin_period` of the strongest bins (count,D), -1 for none."""
    rank, feature = (bins > 0).nonzero(as_tuple=True)
    period = bin_period(stop - start, bins[rank, feature])
    return [
        FrequencyLayer(Fraction(tau), tau, start, stop, tuple(feature[period == tau].unique().tolist()))
        for tau in period.unique().tolist()
    ]


def noise_share(bins: int, features: int, false_alarm: float) -> float:
    """The share of its power that white noise exceeds in one bin of any feature with this probability.

    Fisher's test, P(largest of K shares > g) <= K (1 - g)^(K - 1), with Bonferroni's bound over D features.

    Source: R. A. Fisher, Tests of significance in harmonic analysis, Proc. R. Soc. A 125 (1929).

    Example:
        >>> round(noise_share(512, 1764, 1e-3), 3)
        0.04
    """
    return float(1 - (false_alarm / (bins * features)) ** (1 / max(bins - 1, 1)))


class SpectrogramAnalysis(PeriodFinder):
    """Finds periods in the spectrogram of each feature (section III-A).

    Args:
        window: places per chunk and spectrum. hop: places between the starts of chunks; None is `window`.
        min_period: shortest period, in places; the longest is half the window, above mean and drift.
        strongest: number of frequencies that a feature keeps.
        peaks: "local" ranks local maxima of the spectrum, "bins" all its bins (the paper).
        false_alarm: probability that white noise gives a chunk layers (`noise_share`); smooth footage passes
            whether or not it repeats. None: every chunk gets layers (the paper).
        short: for a route shorter than the window: "shrink" the window with a warning, or "refuse".

    Shape: features (N,D) -> tuple of G spectra, one per chunk.

    Convention: Hann window, not centred. Places after the last whole window are a shorter chunk, or dropped
        if fewer than 2 * min_period. Constant features have no power. Chunks too short to pass are logged.

    Raises:
        InputError: an argument out of range; features that are not floats (N,D), or in `plan` not finite; a
            route too short.

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
        got = "spectrogram got"
        expect(min_period >= 2, "min_period >= 2", f"{got} {window=}, {min_period=}")
        expect(window >= 2 * min_period, "window >= 2 * min_period", f"{got} {window=}, {min_period=}")
        expect(strongest >= 1, "strongest >= 1", f"{got} {strongest=}")
        expect(hop is None or 1 <= hop <= window, f"1..{window} (the window)", f"{got} {hop=}")
        expect(peaks in ("local", "bins"), "'local' or 'bins'", f"{got} {peaks=}")
        expect(short in ("shrink", "refuse"), "'shrink' or 'refuse'", f"{got} {short=}")
        expect(
            false_alarm is None or 0 < false_alarm < 1, "None or a number in (0, 1)", f"{got} {false_alarm=}"
        )
        self.window, self.hop, self.min_period, self.strongest = window, hop, min_period, strongest
        self.peaks, self.false_alarm, self.short = peaks, false_alarm, short
        self._logged: set[str] = set()

    def chunks(self, places: int) -> list[tuple[int, int]]:
        """The chunks [start, stop) of a route."""
        shortest, seen = 2 * self.min_period, f"the route has {places} place{'s' * (places != 1)}"
        expect(places >= shortest, f"at least {shortest}, two periods of {self.min_period}", seen)
        cure = "the window, or a shorter window, or --mapper.periods.short shrink"
        expect(places >= self.window or self.short != "refuse", f"at least {self.window}, {cure}", seen)
        window = min(self.window, places)
        hop = min(self.hop or window, window)
        chunks = [(start, start + window) for start in range(0, places - window + 1, hop)]
        rest = chunks[-1][0] + hop
        if chunks[-1][1] < places and places - rest >= shortest:
            chunks.append((rest, places))
        return chunks

    def forward(self, features: Tensor) -> tuple[Spectrum, ...]:
        return tuple(Spectrum(a, b, chunk_power(features[a:b])) for a, b in self._chunks_of(features))

    @torch.no_grad()
    def plan(self, features: Tensor) -> Plan:
        """See `PeriodFinder`; by chunk and then by period."""
        layers: list[FrequencyLayer] = []
        chunks, alarm = self._chunks_of(features), self.false_alarm
        if len(features) < self.window:
            self._warn_once(f"window shrunk from {self.window} to {len(features)} places, the whole route")
        for start, stop in chunks:
            parts = features[start:stop].split(max(1, NUMBERS_AT_ONCE // (stop - start)), 1)
            bins, share = (torch.cat(found, -1) for found in zip(*map(self._strongest, parts), strict=True))
            least = 0.0 if alarm is None else noise_share((stop - start) // 2, len(share), alarm)
            if least > HANN_PEAK:
                seen = f"places {start}-{stop - 1}: too few to distinguish a period from noise"
                self._warn_once(f"{seen}; no layers here")
            if alarm is None or (share > least).any():
                layers += layers_of(bins, start, stop)
        return tuple(layers)

    def _chunks_of(self, features: Tensor) -> list[tuple[int, int]]:
        known = isinstance(features, Tensor)
        if known and features.ndim == 2 and features.is_floating_point():
            return self.chunks(len(features))
        seen = f"{tuple(features.shape)} {features.dtype}" if known else f"a {type(features).__name__}"
        raise InputError(f"spectrogram got {seen}; expected a float tensor (N,D)")

    def _strongest(self, chunk: Tensor) -> tuple[Tensor, Tensor]:
        """The strongest bins of each feature (count,D), and the largest share of its power in one (D,)."""
        expect(chunk.isfinite().all(), "finite numbers", "spectrogram got features that are not finite")
        power, last = chunk_power(chunk), len(chunk) // self.min_period
        bins = strongest_bins(power, min(self.strongest, len(power)), last, self.peaks)
        share = power.gather(0, bins.clamp(min=0)) / power[1:].sum(0)
        return bins, share.where(bins > 0, 0.0).amax(0)

    def _warn_once(self, message: str) -> None:
        if message not in self._logged:
            log.warning(message)
            self._logged.add(message)

    extra_repr = settings_of
