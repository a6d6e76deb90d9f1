"""A network up to one of its layers: what comes after it is neither computed nor kept."""

from __future__ import annotations

import copy
from collections import OrderedDict
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_forward_hook, register_module_forward_pre_hook

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
    """A copy of a network that `run` ends at a layer, the name of a submodule; the first of its runs counts.

    Modules that have not run when the layer is done are left out of the copy, unless it gives something else
    without them on `frames`. The names of the others stay.
    """
    name, names = type(network).__name__, [one for one, _ in network.named_modules() if one]
    if layer not in names:
        some = [one for one in names if one.count(".") < 2]
        known = ", ".join([*some[:SHOWN], ".."][: len(some)]) or "none, it has none"
        raise InputError(f"{name} has no layer {layer!r:.80}; expected one such as {known}")
    try:
        ended = copy.deepcopy(network)
    except RuntimeError as error:
        raise InputError(f"{name} cannot be copied to end at {layer}: {error}") from error
    last = ended.get_submodule(layer)
    last.register_forward_hook(_end)
    begun: set[nn.Module] = set()
    done: set[nn.Module] = set()
    with (
        register_module_forward_pre_hook(lambda module, *_: begun.add(module)),
        register_module_forward_hook(lambda module, *_: done.add(module)),  # called ahead of `_end`
    ):
        expected = _tried(ended, frames)
    if last not in begun:
        raise InputError(f"{name} does not run its layer {layer} as a module; expected another layer")
    smaller = copy.deepcopy(ended)
    _leave_out(ended, smaller, begun, done)
    try:
        pairs = zip(_tried(smaller, frames), expected, strict=True)
        # a map's network is first made without numbers
        same = all(a.shape == b.shape and (a.is_meta or torch.allclose(a, b, 1e-4, 1e-5)) for a, b in pairs)
    except Exception:  # a network may look at any of its parts
        same = False
    return smaller if same else ended


def _end(layer: nn.Module, given: Any, output: object) -> None:
    raise Reached(output)


def _tried(network: nn.Module, frames: Tensor) -> list[Tensor]:
    with torch.no_grad(), in_mode(network, False):
        return tensors_in(run(network, frames))


def _leave_out(whole: nn.Module, smaller: nn.Module, begun: set[nn.Module], done: set[nn.Module]) -> None:
    """Replace by nothing, in a copy of a module, the parts with weights that have not begun."""
    for name, part in whole.named_children():
        if part in done:  # it may use parts without running them
            continue
        if not begun.isdisjoint(part.modules()):
            _leave_out(part, smaller.get_submodule(name), begun, done)
        elif part.state_dict():
            setattr(smaller, name, nn.Identity())


def members_of(made: object) -> list[object]:
    """The members of a tuple, list or dict; anything else is the only one."""
    if isinstance(made, dict):
        return [*made.values()]
    return [*made] if isinstance(made, (tuple, list)) else [made]


def tensors_in(made: object) -> list[Tensor]:
    """The tensors in what a network made, in order."""
    if isinstance(made, (tuple, list, dict)):
        return [tensor for member in members_of(made) for tensor in tensors_in(member)]
    return [made] if isinstance(made, Tensor) else []
