"""Phase masks and phase-mean templates (section III-A, eq. 1 and eq. 2)."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import torch
from torch import Tensor, nn

from dejavu_torch.memory import without_autocast
from dejavu_torch.types import FrequencyLayer, InputError, check_shape

MASK_NUMBERS = 2**22  # values of a mask that are held at a time


def phase_mask(
    frames: int | Tensor,
    period: Fraction | int,
    phases: int | None = None,
    start: int = 0,
    stop: int | None = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """The masks M(i, tau, k) of one period, all phases at once (eq. 2).

    Args:
        frames: their number, from 0, or (n,) int64 the frames themselves.
        period: tau, in frames; an integer or rational.
        phases: P; None is the paper's case, one phase per frame of an integer period.
        start, stop: the chunk [start, stop), outside of which M is 0; None has no end.

    Shape: -> (P,n), 1 if frame i of the chunk has phase k, else 0.

    Convention: phases count 0..P-1 from absolute frame 0; with P = tau, M is 1 if mod(i - k, tau) = 0.

    Raises:
        InputError: a fractional period without `phases`, or a chunk that ends after a number of frames.

    Example:
        >>> phase_mask(5, 2)
        tensor([[1., 0., 1., 0., 1.],
                [0., 1., 0., 1., 0.]])
    """
    period = Fraction(period)
    if phases is None and period.denominator != 1:
        raise InputError(f"phase_mask got period {period} and no phases; expected phases for a fraction")
    if isinstance(frames, int):
        if stop is not None and stop > frames:
            raise InputError(f"phase_mask got chunk [{start}, {stop}); expected it inside {frames} frames")
        frames = torch.arange(frames)
    inside = frames >= start if stop is None else (frames >= start) & (frames < stop)
    phases = period.numerator if phases is None else phases
    phase = FrequencyLayer(period, phases, start, start + 1 if stop is None else stop, (0,)).phase(frames)
    mask = torch.zeros(phases, len(frames), dtype=dtype, device=frames.device)
    return mask.scatter_(0, phase[None], inside.to(mask.dtype)[None])


class PhaseTemplates(nn.Module):
    """Templates of all layers of a plan: mu(H, tau, k) for each layer, feature and phase (eq. 1).

    Shape: features (N,D), plan of L layers -> tuple of L tensors (P,F).

    Convention: the mean is over the layer's own chunk, in the features' own type under any autocast. A phase
        without frames gets 0, which is never read. Gradients reach the features. A layer beyond the N frames
        or the D features is an InputError.

    Example:
        >>> plan = (FrequencyLayer(Fraction(2), 2, 0, 4, (0,)),)
        >>> PhaseTemplates()(torch.tensor([[1.0], [5.0], [3.0], [7.0]]), plan)[0].tolist()
        [[2.0], [6.0]]
    """

    def forward(self, features: Tensor, plan: Sequence[FrequencyLayer]) -> tuple[Tensor, ...]:
        check_shape(features, "N D", "the features are")
        check_plan(plan, *features.shape)
        return tuple(_means(features, layer) for layer in plan)


def check_plan(plan: Sequence[FrequencyLayer], places: int, dimension: int) -> None:
    """Refuse, by an InputError, a layer that reaches beyond the places or the features."""
    for layer in plan:
        if layer.stop > places or layer.features[-1] >= dimension:
            seen = f"a layer covers [{layer.start}, {layer.stop}) and feature {layer.features[-1]}"
            raise InputError(f"{seen}; expected it inside {places} places of {dimension} features")


@without_autocast
def _means(features: Tensor, layer: FrequencyLayer) -> Tensor:
    """Eq. 1 for one layer, some frames of its chunk at a time: (N,D) -> (P,F)."""
    chosen = torch.tensor(layer.features, device=features.device)
    total, count = features.new_zeros(layer.phases, len(chosen)), features.new_zeros(layer.phases, 1)
    at_once = max(1, MASK_NUMBERS // layer.phases)
    frames = torch.arange(layer.start, layer.stop, device=features.device).split(at_once)
    for some, values in zip(frames, features[layer.start : layer.stop].split(at_once), strict=True):
        mask = phase_mask(some, layer.period, layer.phases, dtype=features.dtype)
        total = total + mask @ values.index_select(1, chosen)
        count = count + mask.sum(1, keepdim=True)
    return total / count.clamp(min=1)
