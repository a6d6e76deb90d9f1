"""A network up to one of its layers: what lies behind is neither computed nor kept."""

from __future__ import annotations

import copy
from collections import OrderedDict
from typing import Any

import torch
from torch import Tensor, nn

from dejavu_torch.features.extract import in_mode
from dejavu_torch.types import InputError

SHOWN = 12  # names of layers in a message


class Reached(Exception):
    """Ends a forward pass at a layer, whose output it carries."""


def run(network: nn.Module, frames: Tensor) -> object:
    """The output of a network, or of the layer that `up_to` ends it at."""
    calls = _traced_calls()
    begun = len(calls)
    try:
        output: object = network(frames)
    except Reached as reached:
        output = reached.args[0]
        while len(calls) > begun:
            calls.popitem()
    return output


def _traced_calls() -> OrderedDict[str, Any]:
    """The calls of modules that torch.export is in, which its tracer does not leave by an exception."""
    if torch.compiler.is_exporting() and not torch.compiler.is_dynamo_compiling():
        from torch.fx.experimental.proxy_tensor import get_proxy_mode

        calls = getattr(getattr(get_proxy_mode(), "tracer", None), "module_stack", None)
        if isinstance(calls, OrderedDict):
            return calls
    return OrderedDict()


def up_to(network: nn.Module, layer: str, frames: Tensor) -> nn.Module:
    """A copy of a network that `run` ends at a layer.

    Args:
        layer: name of a submodule, as `named_modules` has it; where it runs several times the first counts.
        frames: that the network is tried out with.

    Convention: modules that have not run when the layer is through are left out of the copy, unless it does
        not give the same without them. The names of the others stay.

    Raises:
        InputError: no such layer, or one that the network does not run.
    """
    modules = dict(network.named_modules())
    if not layer or layer not in modules:
        names = [name for name in modules if name and name.count(".") < 2]
        more = ", .." if len(names) > SHOWN else ""
        named = ", ".join(names[:: -(-len(names) // SHOWN) or 1]) or "none, it has none"
        raise InputError(
            f"{type(network).__name__} has no layer {layer!r:.80}; expected one such as {named}{more}"
        )
    try:
        ended = copy.deepcopy(network)
    except RuntimeError as error:
        raise InputError(f"{type(network).__name__} cannot be copied to end at {layer}: {error}") from error
    begun: set[nn.Module] = set()
    through: set[nn.Module] = set()
    watches = [
        watch
        for module in ended.modules()
        for watch in (
            module.register_forward_pre_hook(lambda module, *_: begun.add(module)),
            module.register_forward_hook(lambda module, *_: through.add(module)),
        )
    ]
    ended.get_submodule(layer).register_forward_hook(_end)
    try:
        with torch.no_grad(), in_mode(ended, False):
            ended(frames)
    except Reached as reached:
        expected = reached.args[0]
    else:
        raise InputError(
            f"{type(network).__name__} does not run its layer {layer} as a module; expected another layer"
        )
    finally:
        for watch in watches:
            watch.remove()
    smaller = copy.deepcopy(ended)
    _leave_out(ended, smaller, begun, through)
    try:
        with torch.no_grad(), in_mode(smaller, False):
            found = run(smaller, frames)
    except Exception:  # a network may look at any of its parts
        return ended
    return smaller if _same(found, expected) else ended


def _end(layer: nn.Module, given: Any, output: object) -> None:
    raise Reached(output)


def _leave_out(whole: nn.Module, smaller: nn.Module, begun: set[nn.Module], through: set[nn.Module]) -> None:
    """Replace by nothing, in a copy of a module, the parts with weights that have not begun."""
    for name, part in whole.named_children():
        if part in through:  # it may use parts without running them
            continue
        if not begun.isdisjoint(part.modules()):
            _leave_out(part, smaller.get_submodule(name), begun, through)
        elif part.state_dict():
            setattr(smaller, name, nn.Identity())


def _same(one: object, other: object) -> bool:
    if isinstance(one, Tensor) and isinstance(other, Tensor):
        # a map's network is first made without numbers
        return one.shape == other.shape and (one.is_meta or torch.allclose(one, other, rtol=1e-4, atol=1e-5))
    if isinstance(one, (list, tuple)) and isinstance(other, (list, tuple)):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    return False
