"""Phase masks and phase-mean templates (section III-A, eq. 1 and eq. 2)."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import torch
from torch import Tensor, nn

from dejavu_torch.types import FrequencyLayer, InputError

MASK_NUMBERS = 2**22  # of a mask that is held at a time


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
        frames: how many, counted from 0, or (n,) int64 the frames themselves.
        period: tau, frames; whole or rational.
        phases: P; None is the paper's case, one phase per frame of a whole period.
        start, stop: the chunk [start, stop); a stop of None has no end. M is 0 outside.

    Shape: -> (P,n), 1 where frame i of the chunk has phase k, else 0.

    Convention: phases count 0..P-1 from absolute frame 0, so with phases = period
        M(i, tau, k) = 1 where mod(i - k, tau) = 0.

    Raises:
        InputError: a fractional period without `phases`, or a chunk that ends behind a number of frames.

    Example:
        >>> phase_mask(5, 2)
        tensor([[1., 0., 1., 0., 1.],
                [0., 1., 0., 1., 0.]])
    """
    period = Fraction(period)
    if phases is None and period.denominator != 1:
        raise InputError(f"phase_mask got period {period} and no phases; expected phases for a fraction")
    index = torch.arange(frames) if isinstance(frames, int) else frames
    if isinstance(frames, int) and stop is not None and stop > frames:
        raise InputError(f"phase_mask got the chunk [{start}, {stop}); expected it inside {frames} frames")
    last = max(start, int(index.max()) if len(index) else 0) + 1
    layer = FrequencyLayer(
        period, period.numerator if phases is None else phases, start, last if stop is None else stop, (0,)
    )
    mask = torch.zeros(layer.phases, len(index), dtype=dtype, device=index.device)
    inside = ((index >= layer.start) & (index < layer.stop)).to(mask.dtype)
    return mask.scatter_(0, layer.phase(index)[None], inside[None])


class PhaseTemplates(nn.Module):
    """Templates of all layers of a plan: mu(H, tau, k) for each layer, feature and phase (eq. 1).

    Shape: features (N,D), plan of L layers -> tuple of L tensors (P,F).

    Convention: the mean runs over the layer's own chunk only. A phase that no frame of the chunk has gets 0;
        no place of the chunk has that phase, so nothing reads it. Gradients reach the features; the plan is
        exact numbers and gets none.

    Raises:
        InputError: a layer that reaches beyond the N frames or the D features.

    Example:
        >>> plan = (FrequencyLayer(Fraction(2), 2, 0, 4, (0,)),)
        >>> PhaseTemplates()(torch.tensor([[1.0], [5.0], [3.0], [7.0]]), plan)[0].tolist()
        [[2.0], [6.0]]
    """

    def forward(self, features: Tensor, plan: Sequence[FrequencyLayer]) -> tuple[Tensor, ...]:
        if features.ndim != 2:
            raise InputError(f"the features are {tuple(features.shape)}; expected (N,D)")
        frames, dimension = features.shape
        for layer in plan:
            if layer.stop > frames or layer.features[-1] >= dimension:
                raise InputError(
                    f"a layer covers [{layer.start}, {layer.stop}) and feature {layer.features[-1]}; "
                    f"expected it inside {frames} frames of {dimension} features"
                )
        return tuple(_means(features, layer) for layer in plan)


def _means(features: Tensor, layer: FrequencyLayer) -> Tensor:
    """Eq. 1 for one layer, a stretch of its chunk at a time: (N,D) -> (P,F)."""
    chosen = torch.tensor(layer.features, device=features.device)
    total = features.new_zeros(layer.phases, len(layer.features))
    count = features.new_zeros(layer.phases, 1)
    for frames in torch.arange(layer.start, layer.stop, device=features.device).split(
        max(1, MASK_NUMBERS // layer.phases)
    ):
        mask = phase_mask(frames, layer.period, layer.phases, dtype=features.dtype)
        total = total + mask @ features[frames[0] : frames[-1] + 1].index_select(1, chosen)
        count = count + mask.sum(1, keepdim=True)
    return total / count.clamp(min=1)
