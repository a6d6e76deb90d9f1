"""Network weights with 8 bits each and one scale per output channel, in a map file.

torch's own quantised tensors are deprecated, and torchao computes in integers; here only the file has them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn.parameter import is_lazy

BITS = (8, 32)
LARGEST = 127  # of the integers
HUGE = 1e38  # larger weights, which could round to infinity, keep 32 bits
SMALLEST_SCALE = torch.finfo(torch.bfloat16).smallest_normal  # scale; a channel below it is 0
SCALE = ".scale"  # appended to the name of a weight; torch allows no dot in the name of a tensor


def quantised(weight: Tensor) -> tuple[Tensor, Tensor]:
    """A float32 weight (O,...) as int8 (O,...) times bfloat16 scales (O,), to within half a scale.

    Convention: the largest integer of a channel is 127, unless all are 0. So the exact product has the same
        integers and scales: the rounding of a bfloat16, at most 1 in 257, moves 127 by less than a half.

    Example:
        >>> whole, scale = quantised(torch.tensor([[2.54, -1.0], [0.0, 0.0]]))
        >>> whole.tolist(), [round(float(one), 3) for one in scale]
        ([[127, -50], [0, 0]], [0.02, 0.0])
    """
    scale = (weight.abs().flatten(1).amax(1) / LARGEST).bfloat16()
    scale = scale.where(scale >= SMALLEST_SCALE, 0.0)
    steps = scale.where(scale > 0, torch.inf)
    return (weight / _broadcast(steps, weight)).round().to(torch.int8), scale


def _broadcast(scale: Tensor, weight: Tensor) -> Tensor:
    """Scales as float32, in a shape that broadcasts over weights."""
    return scale.float().view(-1, *[1] * (weight.ndim - 1))


def rounded(weight: Tensor) -> Tensor:
    """A weight after rounding to 8 bits."""
    whole, scale = quantised(weight.detach())
    return whole * _broadcast(scale, whole)


def fits(weight: Tensor) -> bool:
    """Whether a weight can have 8 bits: float32, of 2 or more dimensions, not empty, below 1e38."""
    if is_lazy(weight) or weight.dtype != torch.float32 or weight.ndim < 2 or not weight.numel():
        return False
    return bool(weight.detach().abs().max() < HUGE)


@torch.no_grad()
def round_weights(module: nn.Module) -> bool:
    """Round all parameters that fit into 8 bits in place, but no buffers; whether there are any."""
    weights = [*filter(fits, module.parameters())]
    for weight in weights:
        weight.copy_(rounded(weight))
    return bool(weights)


def is_rounded(module: nn.Module) -> bool:
    """Whether `round_weights` would change nothing."""
    return all(torch.equal(weight, rounded(weight)) for weight in filter(fits, module.parameters()))


@contextmanager
def in_bits(module: nn.Module, bits: int) -> Iterator[None]:
    """Within the block the module has weights of this many bits."""
    weights = [*filter(fits, module.parameters())] if bits == 8 else []
    originals = [weight.detach().clone() for weight in weights]
    if weights:
        round_weights(module)
    try:
        yield
    finally:
        for weight, original in zip(weights, originals, strict=True):
            weight.detach().copy_(original)


def packed(module: nn.Module) -> dict[str, Tensor]:
    """The tensors of a module's state, with integers and scales for each parameter that `fits`."""
    tensors = {name: value for name, value in module.state_dict().items() if isinstance(value, Tensor)}
    for name, weight in module.named_parameters(remove_duplicate=False):
        if fits(weight):
            tensors[name], tensors[name + SCALE] = quantised(weight.detach())
    return tensors


def unpacked(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors of a file; those of `quantised`, below a prefix, become weights."""
    plain = dict(tensors)
    for name, whole in tensors.items():
        if name.startswith(prefix) and name + SCALE in tensors:
            plain[name] = whole * _broadcast(plain.pop(name + SCALE), whole)
    return plain
