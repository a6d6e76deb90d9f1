"""A network up to one of its layers: later layers are neither computed nor stored."""

from __future__ import annotations

import copy
from collections import OrderedDict

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_forward_hook, register_module_forward_pre_hook

from dejavu_torch.features.extract import in_mode
from dejavu_torch.types import InputError, expect

SHOWN = 12  # names of layers in a message


class Reached(Exception):
    """Ends a forward pass at a layer, whose output is the argument."""


def run(network: nn.Module, frames: Tensor) -> object:
    """The output of a network, or of the layer at which `up_to` ends it."""
    calls = _traced_calls()
    depth = len(calls)
    try:
        output: object = network(frames)
    except Reached as reached:
        output = reached.args[0]
        while len(calls) > depth:
            calls.popitem()
    return output


def _traced_calls() -> OrderedDict[str, object]:
    """The stack of module calls of torch.export, which its tracer does not unwind after an exception."""
    if torch.compiler.is_exporting() and not torch.compiler.is_dynamo_compiling():
        from torch.fx.experimental.proxy_tensor import get_proxy_mode

        calls = getattr(getattr(get_proxy_mode(), "tracer", None), "module_stack", None)
        if isinstance(calls, OrderedDict):
            return calls
    return OrderedDict()


def up_to(network: nn.Module, layer: str, frames: Tensor) -> nn.Module:
    """A copy of a network that `run` ends at a layer, the name of a submodule, the first time that it runs.

    The copy omits modules that have not started by then, unless that changes its output for `frames`.
    """
    name, names = type(network).__name__, [path for path, _ in network.named_modules() if path]
    some = [path for path in names if path.count(".") < 2]
    examples = ", ".join([*some[:SHOWN], ".."][: len(some)]) or "none, it has none"
    expect(layer in names, f"one such as {examples}", f"{name} has no layer {layer!r:.80}")
    try:
        ended = copy.deepcopy(network)
    except RuntimeError as error:
        raise InputError(f"{name} cannot be copied to end at {layer}: {error}") from error
    last = ended.get_submodule(layer)
    last.register_forward_hook(_end)
    started: set[nn.Module] = set()
    finished: set[nn.Module] = set()
    with (
        register_module_forward_pre_hook(lambda module, *_: started.add(module)),
        register_module_forward_hook(lambda module, *_: finished.add(module)),  # runs before `_end`
    ):
        expected = _outputs(ended, frames)
    expect(last in started, "another layer", f"{name} does not run its layer {layer} as a module")
    smaller = copy.deepcopy(ended)
    _omit(ended, smaller, started, finished)
    try:
        pairs = zip(_outputs(smaller, frames), expected, strict=True)
        # the network of a map file has meta tensors at first
        same = all(a.shape == b.shape and (a.is_meta or torch.allclose(a, b, 1e-4, 1e-5)) for a, b in pairs)
    except Exception:  # a network may access any of its parts
        same = False
    return smaller if same else ended


def _end(layer: nn.Module, inputs: object, output: object) -> None:
    raise Reached(output)


def _outputs(network: nn.Module, frames: Tensor) -> list[Tensor]:
    with torch.no_grad(), in_mode(network, False):
        return tensors_in(run(network, frames))


def _omit(whole: nn.Module, smaller: nn.Module, started: set[nn.Module], finished: set[nn.Module]) -> None:
    """Replace, in a copy of a module, the parts with weights that have not started by nn.Identity."""
    for name, part in whole.named_children():
        if part in finished:  # it may use parts without running them
            continue
        if not started.isdisjoint(part.modules()):
            _omit(part, smaller.get_submodule(name), started, finished)
        elif part.state_dict():
            setattr(smaller, name, nn.Identity())


def members_of(output: object) -> list[object]:
    """The members of a tuple, list or dict; anything else is its only member."""
    if isinstance(output, dict):
        return [*output.values()]
    return [*output] if isinstance(output, (tuple, list)) else [output]


def tensors_in(output: object) -> list[Tensor]:
    """The tensors in the output of a network, in order."""
    if isinstance(output, (tuple, list, dict)):
        return [tensor for member in members_of(output) for tensor in tensors_in(member)]
    return [output] if isinstance(output, Tensor) else []
