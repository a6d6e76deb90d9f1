"""Phase masks and phase-mean templates (section III-A, eq. 1 and eq. 2)."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import torch
from torch import Tensor, nn

from dejavu_torch.types import FrequencyLayer, InputError


def phase_mask(
    n: int,
    period: Fraction | int,
    phases: int | None = None,
    start: int = 0,
    stop: int | None = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """The masks M(i, tau, k) of one period, all phases at once (eq. 2).

    Args:
        n: number of frames.
        period: tau, frames; whole or rational.
        phases: P; None is the paper's case, one phase per frame of a whole period.
        start, stop: the chunk [start, stop); None is n. M is 0 outside.

    Shape: -> (P,n), 1 where frame i of the chunk has phase k, else 0.

    Convention: phases count 0..P-1 from absolute frame 0, so with phases = period
        M(i, tau, k) = 1 where mod(i - k, tau) = 0.

    Raises:
        InputError: a fractional period without `phases`, or a chunk outside the n frames.

    Example:
        >>> phase_mask(5, 2)
        tensor([[1., 0., 1., 0., 1.],
                [0., 1., 0., 1., 0.]])
    """
    period = Fraction(period)
    if phases is None and period.denominator != 1:
        raise InputError(f"phase_mask got period {period} and no phases; expected phases for a fraction")
    layer = FrequencyLayer(
        period, period.numerator if phases is None else phases, start, n if stop is None else stop, (0,)
    )
    if layer.stop > n:
        raise InputError(f"phase_mask got the chunk [{start}, {layer.stop}); expected it inside {n} frames")
    mask = torch.zeros(layer.phases, n, dtype=dtype)
    mask[layer.place_phases, torch.arange(layer.start, layer.stop)] = 1
    return mask


def phase_means(values: Tensor, phase: Tensor, phases: int) -> Tensor:
    """Mean of the frames of each phase: eq. 1 with the masks of eq. 2, summed without building them.

    Shape: values (n,F), phase (n,) int64 -> (P,F). A phase that no frame has gets 0; no place of
        the chunk has that phase, so nothing ever reads it.
    """
    total = values.new_zeros(phases, values.shape[1]).index_add(0, phase, values)
    count = values.new_zeros(phases).index_add(0, phase, torch.ones_like(values[:, 0]))
    return total / count.clamp(min=1)[:, None]


class PhaseTemplates(nn.Module):
    """Templates of all layers of a plan: mu(H, tau, k) for each layer, feature and phase (eq. 1).

    Shape: features (N,D), plan of L layers -> tuple of L tensors (P,F).

    Convention: the mean runs over the layer's own chunk only. Gradients reach the features; the
        plan is exact numbers and gets none.

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
        templates = []
        for layer in plan:
            if layer.stop > frames or layer.features[-1] >= dimension:
                raise InputError(
                    f"a layer covers [{layer.start}, {layer.stop}) and feature {layer.features[-1]}; "
                    f"expected it inside {frames} frames of {dimension} features"
                )
            chosen = torch.tensor(layer.features, device=features.device)
            values = features[layer.start : layer.stop].index_select(1, chosen)
            templates.append(phase_means(values, layer.place_phases.to(features.device), layer.phases))
        return tuple(templates)
