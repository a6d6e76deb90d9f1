"""Weights of a network in 8 bits each, with one scale per output channel, in a map file.

torch's own quantised tensors are deprecated, and torchao computes in whole numbers; here only the file does.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn.parameter import is_lazy

from dejavu_torch.types import InputError

BITS = (8, 32)
LARGEST = 127  # of the whole numbers
HUGE = 1e38  # larger weights, which could round to infinity, keep 32 bits
LEAST = torch.finfo(torch.bfloat16).smallest_normal  # scale; a channel below it is 0
SCALE = ".scale"  # follows the name of a weight; torch allows no dot in the name of a tensor


def quantised(weight: Tensor) -> tuple[Tensor, Tensor]:
    """A float32 weight (O,...) as int8 (O,...) times bfloat16 scales (O,), to within half a scale.

    Convention: the largest number of a channel is 127, unless all are 0. So the product, which is exact,
        gives the same numbers and scales again: a bfloat16 is off by at most 1 in 257, which moves 127 steps
        by less than half a step.

    Example:
        >>> whole, scale = quantised(torch.tensor([[2.54, -1.0], [0.0, 0.0]]))
        >>> whole.tolist(), [round(float(one), 3) for one in scale]
        ([[127, -50], [0, 0]], [0.02, 0.0])
    """
    scale = (weight.abs().flatten(1).amax(1) / LARGEST).bfloat16()
    scale = scale.where(scale >= LEAST, 0.0)
    steps = scale.where(scale > 0, torch.inf)
    return (weight / _over(steps, weight)).round().to(torch.int8), scale


def _over(scale: Tensor, weight: Tensor) -> Tensor:
    """Scales as float32, shaped to broadcast over weights."""
    return scale.float().view(-1, *[1] * (weight.ndim - 1))


def rounded(weight: Tensor) -> Tensor:
    """A weight after rounding to 8 bits."""
    whole, scale = quantised(weight.detach())
    return whole * _over(scale, whole)


def fits(weight: Tensor) -> bool:
    """Whether a weight can be in 8 bits: float32, of 2 or more dimensions, not empty, below 1e38."""
    if is_lazy(weight) or weight.dtype != torch.float32 or weight.ndim < 2 or not weight.numel():
        return False
    return bool(weight.detach().abs().max() < HUGE)


@torch.no_grad()
def round_weights(module: nn.Module) -> bool:
    """Round in place all parameters that fit into 8 bits, but no buffers; whether there are any."""
    weights = [*filter(fits, module.parameters())]
    for weight in weights:
        weight.copy_(rounded(weight))
    return bool(weights)


def is_rounded(module: nn.Module) -> bool:
    """Whether `round_weights` would change nothing."""
    return all(torch.equal(weight, rounded(weight)) for weight in filter(fits, module.parameters()))


@contextmanager
def in_bits(module: nn.Module, bits: int) -> Iterator[None]:
    """Within the block the module has weights of so many bits."""
    weights = [*filter(fits, module.parameters())] if bits == 8 else []
    kept = [weight.detach().clone() for weight in weights]
    if weights:
        round_weights(module)
    try:
        yield
    finally:
        for weight, before in zip(weights, kept, strict=True):
            weight.detach().copy_(before)


def packed(module: nn.Module) -> dict[str, Tensor]:
    """The tensors of a module's state; each parameter that fits as whole numbers and scales."""
    found = {name: one for name, one in module.state_dict().items() if isinstance(one, Tensor)}
    for name, weight in module.named_parameters(remove_duplicate=False):
        if fits(weight):
            found[name], found[name + SCALE] = quantised(weight.detach())
    return found


def unpacked(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors of a file; below a prefix, products in place of whole numbers and scales that `quantised`
    returned; others are an InputError."""
    found = dict(tensors)
    for name, whole in tensors.items():
        if not name.startswith(prefix) or name + SCALE not in tensors:
            continue
        scale = found.pop(name + SCALE)
        types = whole.dtype, scale.dtype
        fitting = types == (torch.int8, torch.bfloat16) and scale.shape == whole.shape[:1]
        weight = whole * _over(scale, whole) if fitting else None
        if weight is None or not fits(weight) or not all(map(torch.equal, quantised(weight), (whole, scale))):
            raise InputError(
                f"{name} and its scale are {types[0]} {tuple(whole.shape)} and {types[1]} "
                f"{tuple(scale.shape)}; expected int8 (O,...) and bfloat16 (O,), finite, the largest of each "
                f"channel {LARGEST}, or all of it 0"
            )
        found[name] = weight
    return found
