"""Losses of places, phases and bits (float32 at least, 0 without any target), and their values by chance."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.maps.quantisation import quantise
from dejavu_torch.maps.spectrum import Transform, from_spectrum
from dejavu_torch.maps.template_map import TemplateMap, weight_per_feature
from dejavu_torch.types import InputError, Plan, check_shape, expect

STEP = 0.5  # of the lines' RMS, at the start
PER_OCTAVE = 2  # frequency bands with a width each
MIN_ENERGY = 1e-24  # of the lines' mean square: the root of 0 has no gradient
LAST, BELOW = 100, 0.98  # steps; a loss below this share of chance, or of the loss before, is lower


class PlaceLoss(NamedTuple):
    """loss: scalar. left_out: number of queries without a covered right place, which the mean excludes."""

    loss: Tensor
    left_out: int


class Losses(NamedTuple):
    """total: the weighted sum, a scalar. parts: each loss by name. left_out: see `PlaceLoss`."""

    total: Tensor
    parts: dict[str, Tensor]
    left_out: int


def place_cross_entropy(
    scores: Tensor, places: Tensor, tolerance: int, temperature: Tensor | float
) -> PlaceLoss:
    """Mean over queries of -log sum_{i right} p_i, where p = softmax(-S / T) over all places (S of eq. 4).

    Args:
        scores: S, lower is better, +inf at places that no layer covers (p = 0).
        places: the right places of each query, -1 as padding.
        tolerance: places within this distance of a right one, inclusive, are also right.
        temperature: T > 0, in units of the scores; may carry gradients.

    Shape: (Q,N), (Q,R) int64 -> PlaceLoss.

    Raises:
        InputError: shapes that do not fit, places outside the N, a tolerance < 0 or temperature <= 0.

    Example:
        >>> scores = torch.tensor([[0.0, 0.0, 0.0, torch.inf]])
        >>> place_cross_entropy(scores, torch.tensor([[0]]), 1, 0.5)  # two of three equal places are right
        PlaceLoss(loss=tensor(0.4055), left_out=0)
    """
    _check_places(places, scores)
    queries, n = scores.shape
    outside = places[(places < -1) | (places >= n)].tolist()
    seen = f"the tolerance is {tolerance} and places outside the route are {outside[:3]}"
    expect(tolerance >= 0 and not outside, f"at least 0, and places in 0..{n - 1} or -1", seen)
    # +1 at the start of each range of right places, -1 after its end: avoids Q x N x R
    known = (places >= 0).int()
    steps = known.new_zeros(queries, n + 1)
    steps.scatter_add_(1, (places - tolerance).clamp(min=0), known)
    steps.scatter_add_(1, (places + tolerance + 1).clamp(max=n), -known)
    surprise = _surprise(scores, steps.cumsum(1)[:, :n] > 0, temperature)
    return PlaceLoss(_mean(surprise), queries - len(surprise))


def _check_places(places: Tensor, scores: Tensor) -> None:
    if scores.ndim != 2 or places.ndim != 2 or len(places) != len(scores) or places.dtype != torch.int64:
        seen = f"scores {tuple(scores.shape)} and places {tuple(places.shape)} {places.dtype}"
        raise InputError(f"the loss got {seen}; expected (Q,N) and (Q,R) int64")


def _surprise(scores: Tensor, right: Tensor, temperature: Tensor | float) -> Tensor:
    """-log of the probability of the right columns, for rows with any. (Q,K), (Q,K) bool -> (rows,)."""
    smallest = torch.as_tensor(temperature).min().item()
    expect(smallest > 0, "a number above 0", temperature=smallest)
    covered = ~scores.isposinf()
    right = right & covered
    kept = right.any(1)
    # +inf is replaced before the division: inf times a gradient of 0 is NaN
    scores = scores.to(torch.promote_types(scores.dtype, torch.float32)).masked_fill(~covered, 0)
    logits = (-scores / temperature).masked_fill(~covered, -math.inf)[kept]
    return logits.logsumexp(1) - logits.masked_fill(~right[kept], -math.inf).logsumexp(1)


def phase_cross_entropy(
    distances: Sequence[Tensor], plan: Plan, places: Tensor, temperature: Tensor | float
) -> Tensor:
    """Mean over layers and queries of -log sum_{k right} p_k, p = softmax(-d / T) over the layer's phases.

    Args:
        distances: d of each layer, from `phase_distances`.
        places, temperature: see `place_cross_entropy`; T in units of the distances.

    Shape: L tensors (Q,P), (Q,R) int64 -> scalar.

    Convention: a query has one term for each layer that covers a right place of it, all with equal weight.

    Raises:
        InputError: no layers, shapes that do not fit the plan, a temperature <= 0.

    Example:
        >>> from dejavu_torch.types import FrequencyLayer
        >>> plan = (FrequencyLayer(2, 2, 0, 10, (0,)),)
        >>> phase_cross_entropy([torch.tensor([[3.0, 3.0]])], plan, torch.tensor([[5]]), 1.0)
        tensor(0.6931)
    """
    shapes, expected = [tuple(d.shape) for d in distances], [(len(places), layer.phases) for layer in plan]
    expect(shapes and shapes == expected, f"at least one, {expected}", f"the distances are {shapes}")
    surprise = []
    for block, layer in zip(distances, plan, strict=True):
        _check_places(places, block)
        covered = (places >= layer.start) & (places < layer.stop)
        hits = torch.zeros(block.shape, dtype=torch.int32, device=block.device)
        hits.scatter_add_(1, layer.phase(places), covered.int())
        surprise.append(_surprise(block, hits > 0, temperature))
    return _mean(torch.cat(surprise))


def _mean(values: Tensor) -> Tensor:
    """0 without any, with gradients of 0."""
    return values.sum() / max(1, len(values))


def laplace_bits(levels: Tensor, widths: Tensor) -> Tensor:
    """Bits of each level under a Laplace distribution around 0: -log2 of its mass within half a step.

    Args:
        levels: in steps; with noise they are not whole numbers.
        widths: b of the densities exp(-|x| / b) / 2b, in steps, above 0; broadcast with the levels.

    Shape: (...), (...) -> (...).

    Convention: finite, with finite gradients, for any level.

    Source: Ballé, Laparra and Simoncelli, End-to-end optimized image compression, ICLR 2017.

    Example:
        >>> laplace_bits(torch.tensor([0.0, 1.0]), torch.tensor(1.0))
        tensor([1.3457, 2.3831])
    """
    size, rate = levels.abs(), 1 / widths
    tail = (size.clamp(min=0.5) - 0.5) * rate - torch.log(-torch.expm1(-rate)) + math.log(2)
    inner = size.clamp(max=0.5)
    outside = 0.5 * (torch.exp((inner - 0.5) * rate) + torch.exp(-(inner + 0.5) * rate))
    return torch.where(size < 0.5, -torch.log1p(-outside), tail) / math.log(2)


@dataclass(frozen=True)
class Objective:
    """A weighted sum of the two losses.

    Args:
        place, phase: the weights; 0 omits a loss.

    Raises:
        InputError: a weight below 0, or none above 0.
    """

    place: float = 1.0
    phase: float = 1.0

    def __post_init__(self) -> None:
        if not (min(self.place, self.phase) >= 0 and 0 < self.place + self.phase < math.inf):
            seen = f"the weights of the losses are place={self.place}, phase={self.phase}"
            raise InputError(f"{seen}; expected 0 or more, at least one above 0")

    def __call__(
        self,
        distances: Sequence[Tensor],
        scores: Tensor,
        places: Tensor,
        route: TemplateMap,
        temperature: Tensor,
        tolerance: int,
    ) -> Losses:
        """The losses of distances by eq. 3, (B,P) of each layer, and scores by `log_posterior`, (B,N)."""
        found = place_cross_entropy(scores, places, tolerance, 1.0)  # the scores include the temperature
        parts, total = {"place": found.loss}, self.place * found.loss
        if self.phase:
            if route.reduction == "mean":  # to the units of the scores
                distances = [
                    distance / weight_per_feature(route.metric, len(layer.features))
                    for distance, layer in zip(distances, route.plan, strict=True)
                ]
            parts["phase"] = phase_cross_entropy(distances, route.plan, places, temperature)
            total = total + self.phase * parts["phase"]
        return Losses(total, parts, found.left_out)


class Coded(NamedTuple):
    """proxies: (W,K), of any length. bits: scalar, of all their lines."""

    proxies: Tensor
    bits: Tensor


def bands_of(lines: int, transform: Transform = "dft") -> Tensor:
    """The frequency band of each line of a spectrum, half an octave wide; band 0 is the mean only.

    Shape: -> (lines,) int64.

    Example:
        >>> bands_of(9)
        tensor([0, 3, 3, 5, 5, 6, 6, 7, 7])
    """
    line = torch.arange(lines)
    half_cycles = line if transform == "dct" else (line + 1) // 2 * 2
    return ((half_cycles.clamp(min=1).double().log2() * PER_OCTAVE).long() + 1) * (half_cycles > 0)


def coded_proxies(
    lines: Tensor, log_step: Tensor, log_widths: Tensor, transform: Transform = "dft", noise: bool = True
) -> Coded:
    """Decode a proxy for each segment of a route from the quantised lines of their spectra along the route.

    A network whose descriptors follow the proxies learns features of few frequencies, which a `SpectralMap`
    codes in few bytes.

    Args:
        lines: of any RMS, see `spectrum`; W segments, at least 2.
        log_step: log of the quantisation step, relative to the RMS.
        log_widths: log of the widths of the Laplace distribution of the levels, in steps, for each band
            (`bands_of`) and feature, in this order.
        transform: of the lines.
        noise: compute the bits of levels with uniform noise instead of the rounding error.

    Shape: (W,K), scalar, (bands * K,) -> Coded.

    Convention: rounding is that of the map (`quantise`), with a straight-through gradient.

    Source: Ballé, Laparra and Simoncelli, ICLR 2017, for the bits; Minnen and Singh, ICIP 2020, for noise in
        the bits and rounding in the decoded values.

    Raises:
        InputError: shapes that do not fit.

    Example:
        >>> lines, widths = torch.randn(40, 8), torch.zeros(8 * (bands_of(40).max() + 1))
        >>> coded = coded_proxies(lines, torch.tensor(-0.7), widths)
        >>> coded.proxies.shape, bool(coded.bits > 0)
        (torch.Size([40, 8]), True)
    """
    check_shape(lines, "W>=2 K>=1", "the lines are")
    band = bands_of(len(lines), transform).to(lines.device)
    expected = (int(band.max()) + 1) * lines.shape[1]
    check_shape(log_widths, str(expected), "the widths are")
    scaled = lines / lines.square().mean().clamp(min=MIN_ENERGY).sqrt() / log_step.exp()
    levels = scaled + (quantise(scaled.detach(), 1.0) - scaled).detach()
    noisy = scaled + torch.rand(scaled.shape, dtype=scaled.dtype).to(scaled) - 0.5 if noise else scaled
    widths = log_widths.exp().unflatten(0, (-1, lines.shape[1]))[band]
    return Coded(from_spectrum(levels.T, transform).T, laplace_bits(noisy, widths).sum())


class NothingLearned(InputError):
    """The losses of a training have stayed at chance."""


def place_chance(places: int, tolerance: int) -> float:
    """The minimum of `place_cross_entropy` with the same answer to all queries, log(N / (2 tolerance + 1)).

    Example:
        >>> round(place_chance(2697, 5), 2)
        5.5
    """
    return max(0.0, math.log(places / (2 * tolerance + 1)))


def phase_chance(plan: Plan) -> float:
    """The same minimum of `phase_cross_entropy`: the mean entropy of a layer's phases along the route."""
    entropies = []
    for layer in plan:
        share = torch.bincount(layer.phase(torch.arange(layer.start, layer.stop))).double()
        share = share[share > 0] / share.sum()
        entropies.append(float(-(share * share.log()).sum()))
    return sum(entropies) / len(entropies)


class LastLosses(deque[Mapping[str, Tensor]]):
    """The losses, by name, of the last `LAST` steps of a stage after its warm-up."""

    def __init__(self) -> None:
        super().__init__(maxlen=LAST)
        self.learned = False

    def check(self, chance: Mapping[str, float]) -> None:
        """Raise `NothingLearned` if, after `LAST` steps, no loss is below chance and none is falling."""
        if len(self) < LAST or not chance:
            return
        losses = {name: torch.stack([parts[name] for parts in self]) for name in chance}
        means = {name: float(one.mean()) for name, one in losses.items()}
        halves = [one.view(2, -1).mean(1).tolist() for one in losses.values()]
        self.learned = any(means[name] <= BELOW * guess for name, guess in chance.items())
        falling = any(late < BELOW * early for early, late in halves)
        if not (self.learned or falling or min(chance.values()) == 0):
            seen = (f"the {name} loss is {means[name]:.3g} (chance {chance[name]:.3g})" for name in chance)
            raise NothingLearned(f"nothing is learned: over the last {LAST} steps {', '.join(seen)}")
