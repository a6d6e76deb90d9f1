"""The shift between two patches of ground by phase correlation (section IV-B)."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from dejavu_torch.motion.ground_plane import FLAT

MAX_SHIFT = 0.42  # as a fraction of the patch
SWAY = 3  # pixels to either side
PEAKS = 4  # coarse maxima to refine
MIN_CONFIDENCE = 0.4  # unrelated patches reach 0.15 to 0.25, the same ground at least 0.6
BAND = 0.1  # cycles/pixel: the finest detail of the interpolated far rows does not move


def phase_shifts(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Candidates for the shift of the ground along the rows from one patch to the next, for each pair.

    Phase correlation with each frequency weighted by its coherence over the columns, which suppresses noise
    and motion blur. Each peak at half resolution is refined by windows that move with the ground.

    Shape: patches (B,1,h,w), (B,1,h,w) of any brightness gain and offset, at least 32 x 32 ->
        shift (B,K) in pixels, rows of the patch; confidence (B,K) in [0, 1].

    Convention: shift > 0 is forward: row r of the first is row r + shift of the second. |shift| is at most
        about 0.42 h, sway at most 3 columns. The confidence is the mean coherence: 1 for identical patches,
        mostly 0.6 to 1 for the same ground, 0.15 to 0.25 for unrelated ground (patches of 96 x 96), 0 for
        patches that are flat or not finite.
    """
    count, _, height, _ = first.shape
    reach = int(MAX_SHIFT * (height // 2))  # coarse: all integer lags at half resolution
    lags = torch.arange(-reach, reach + 1).to(first)
    one, other = (avg_pool2d(patch, 2)[:, 0] for patch in (first, second))
    score = _coherence(one, other, first.new_zeros(count), lags, SWAY // 2 + 1, 2 * BAND)
    padded = pad(score, (1, 1), value=-1)
    peak = (score >= padded[:, :-2]) & (score > padded[:, 2:])
    shift = 2 * lags[score.masked_fill(~peak, -1).topk(PEAKS).indices].flatten()
    # fine: the neighbourhood of each peak
    one, other = (patch[:, 0].repeat_interleave(PEAKS, 0) for patch in (first, second))
    for span, step in ((4.0, 0.5), (1.0, 0.25)):
        lags = torch.arange(-span, span + step / 2, step, dtype=torch.float32).to(first)
        score = _coherence(one, other, shift, lags, SWAY, BAND)
        best, at = score.max(1)
        shift = shift + lags[at] + step * _vertex(score, at)
    return shift.view(count, PEAKS), best.view(count, PEAKS).nan_to_num(0).clamp(0, 1)


def _coherence(first: Tensor, second: Tensor, guess: Tensor, lags: Tensor, sway: int, band: float) -> Tensor:
    """Mean coherence (B,T) at the shifts guess (B,) + lags (T,), maximal over sways of up to `sway` columns;
    band: standard deviation of a Gaussian low-pass, cycles/pixel."""
    height, width = first.shape[1:]
    row = torch.arange(height).to(first)
    common = (height - guess.abs())[:, None]  # rows visible in both
    start = (-guess).clamp(min=0)[:, None]
    spectra = []
    for patch, moved in ((first, 0.0), (second, guess[:, None])):  # the window moves with the ground
        at = (row - start - moved + 0.5) / common
        window = torch.where((at > 0) & (at < 1), (math.pi * at).sin(), 0.0)[..., None]
        mean = (patch * window).sum(1, keepdim=True) / window.sum(1, keepdim=True)
        # without frequency 0: rails look the same in every row
        spectra.append(torch.fft.rfft((patch - mean) * window, dim=1)[:, 1:])
    frequency = torch.arange(1, height // 2 + 1).to(first) / height
    low_pass = (-0.5 * (frequency / band) ** 2).exp()
    turns = (2 * math.pi * (frequency[:, None] * by) for by in (guess, lags))
    back, wave = (torch.polar(torch.ones_like(turn), turn) for turn in turns)
    columns = width - 2 * sway
    floor = FLAT * common * columns
    middle = spectra[0][..., sway : sway + columns]
    power = middle.abs().square().sum(2) + floor
    scores = []
    for side in range(2 * sway + 1):
        other = spectra[1][..., side : side + columns]
        norm = (power * (other.abs().square().sum(2) + floor)).sqrt()
        coherence = (middle.conj() * other).sum(2) / norm * back.T
        weight = coherence.abs() * low_pass
        scores.append(((coherence * weight) @ wave).real / weight.sum(1, keepdim=True).clamp(min=1e-9))
    return torch.stack(scores).amax(0)


def _vertex(score: Tensor, at: Tensor) -> Tensor:
    """Offset, in samples, of the vertex of a parabola through the best sample and its neighbours."""
    inside = at.clamp(1, score.shape[1] - 2)
    left, mid, right = (score.gather(1, (inside + k)[:, None])[:, 0] for k in (-1, 0, 1))
    curve = (2 * mid - left - right).clamp(min=1e-9)
    return torch.where(inside == at, (0.5 * (right - left) / curve).clamp(-1, 1), 0.0)


def viterbi_path(shifts: Tensor, confidences: Tensor, height: int) -> Tensor:
    """The candidate of the shifts (n,K) to choose for each of n consecutive pairs: (n,) int64, on the CPU.

    Periodic ground, such as sleepers, is ambiguous. The path maximises the sum of confidences minus changes
    of the shift, in patch heights (`height`, pixels).
    """
    shifts, confidences = shifts.double().cpu(), confidences.double().cpu()
    change = (shifts[1:, :, None] - shifts[:-1, None]).abs() / height
    best, origins = confidences[:1].sum(0), []
    for cost, gain in zip(change, confidences[1:], strict=True):
        total, origin = (best - cost).max(1)
        best = total + gain
        origins.append(origin)
    path = [best.argmax()]
    for origin in reversed(origins):
        path.append(origin[path[-1]])
    return torch.stack(path[::-1])
