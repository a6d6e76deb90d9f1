"""Weights of a network in 8 bits each, with one scale for every output channel.

torch.quantize_per_channel did this, but torch gives its quantised tensors up, deprecated in 2.13. torchao is
a dependency for networks that compute in whole numbers; here only the file holds them.
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
HUGE = 1e38  # weights from here on stay in 32 bits: they could round to infinity
LEAST = torch.finfo(torch.bfloat16).smallest_normal  # of a scale: a channel of less is 0
SCALE = ".scale"  # behind the name of a weight; torch lets no other tensor have that name


def quantised(weight: Tensor) -> tuple[Tensor, Tensor]:
    """Whole numbers and scales whose product is a weight, to within half a scale.

    Args:
        weight: float32, finite, below 1e38.

    Shape: (O,...) -> int8 (O,...), bfloat16 (O,).

    Convention: the largest number of a channel is 127, unless all are 0. So the product, which is exact,
        gives the same numbers and scales again: the 8 bits of a bfloat16 are off by at most 1 in 257, which
        moves 127 steps by less than half a step.

    Example:
        >>> whole, scale = quantised(torch.tensor([[2.54, -1.0], [0.0, 0.0]]))
        >>> whole.tolist(), [round(float(one), 3) for one in scale]
        ([[127, -50], [0, 0]], [0.02, 0.0])
    """
    scale = (weight.abs().flatten(1).amax(1) / LARGEST).bfloat16()
    scale = scale.where(scale >= LEAST, 0.0)
    steps = _over(scale, weight)
    return (weight / steps.where(steps > 0, torch.inf)).round().to(torch.int8), scale


def _over(scale: Tensor, weight: Tensor) -> Tensor:
    """Scales of channels, float32, beside their weights."""
    return scale.float().view(-1, *[1] * (weight.ndim - 1))


def fits(weight: Tensor) -> bool:
    """Whether a weight can be in 8 bits: float32, of 2 or more dimensions, finite, and not empty.

    What has fewer dimensions is little, and what is 16 bits wide, or a mask of infinities, stays as it is.
    """
    if is_lazy(weight) or weight.dtype != torch.float32 or weight.ndim < 2 or not weight.numel():
        return False
    return bool(weight.detach().abs().max() < HUGE)


def rounded(weight: Tensor) -> Tensor:
    """What 8 bits give back of a weight."""
    whole, scale = quantised(weight.detach())
    return whole * _over(scale, whole)


@torch.no_grad()
def round_weights(module: nn.Module) -> bool:
    """Round all parameters that fit to 8 bits, in place; whether there are any.

    Buffers, such as the running statistics of BatchNorm, stay as they are.
    """
    weights = [weight for weight in module.parameters() if fits(weight)]
    for weight in weights:
        weight.copy_(rounded(weight))
    return bool(weights)


def is_rounded(module: nn.Module) -> bool:
    """Whether `round_weights` would change nothing."""
    return all(torch.equal(weight, rounded(weight)) for weight in module.parameters() if fits(weight))


@contextmanager
def in_bits(module: nn.Module, bits: int) -> Iterator[None]:
    """The module with weights of so many bits; afterwards they are what they were."""
    kept = [(weight, weight.detach().clone()) for weight in module.parameters() if bits == 8 and fits(weight)]
    if kept:
        round_weights(module)
    try:
        yield
    finally:
        with torch.no_grad():
            for weight, before in kept:
                weight.copy_(before)


def packed(module: nn.Module) -> dict[str, Tensor]:
    """The tensors of a module's state, each parameter that fits as whole numbers, its scales beside it."""
    found: dict[str, Tensor] = {}
    weights = {name for name, _ in module.named_parameters(remove_duplicate=False)}
    for name, tensor in module.state_dict().items():
        if name in weights and fits(tensor):
            found[name], found[name + SCALE] = quantised(tensor)
        elif isinstance(tensor, Tensor):
            found[name] = tensor
    return found


def unpacked(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors of a file, the whole numbers and scales below a prefix as the weights that they are.

    Raises:
        InputError: such as `quantised` does not make.
    """
    found = dict(tensors)
    for name, scale in tensors.items():
        of = name.removesuffix(SCALE)
        if name.startswith(prefix) and of != name and of in tensors:
            found[of] = _restored(tensors[of], scale, of)
            del found[name]
    return found


def _restored(whole: Tensor, scale: Tensor, name: str) -> Tensor:
    alike = whole.dtype == torch.int8 and whole.ndim > 1 and scale.shape == whole.shape[:1]
    if alike and scale.dtype == torch.bfloat16:
        weight = whole * _over(scale, whole)
        if fits(weight):
            again = quantised(weight)
            if torch.equal(again[0], whole) and torch.equal(again[1], scale):
                return weight
    seen = " and ".join(f"{one.dtype} {tuple(one.shape)}".removeprefix("torch.") for one in (whole, scale))
    raise InputError(
        f"{name} and its scale are {seen}; expected int8 (O,...) and bfloat16 (O,), finite, the largest of "
        f"each channel {LARGEST}, or all of it 0"
    )
