"""A device for machines without a GPU, which computes on the CPU but refuses what a GPU refuses.

Within `pretend()`, a tensor on `DEVICE` holds one of the CPU, on which its operations run. No tensor of the
CPU meets it but an index, a number without dimensions, and what is copied; only `cpu()` leads to numpy. Where
a GPU may differ, this device does: it draws other random numbers, gives eigenvectors other signs, takes the
last of equals in `topk`, and rounds products otherwise.
"""

from __future__ import annotations

from contextlib import contextmanager

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from dejavu_torch.periods import spectrogram

DEVICE = torch.device("lazy", 0)  # the one kind whose gradients need nothing but Python, and which nobody has
aten = torch.ops.aten
COPIES = {aten.copy_, aten._to_copy}
INDEXED = {aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_}
JOINS = {aten.cat, aten.stack}
PRODUCTS = {aten.mm, aten.bmm, aten.addmm, aten.baddbmm, aten.convolution}
ROUNDING = 2**-24
RANDOM = torch.Generator().manual_seed(1)


class There(Tensor):
    """A tensor on the device, which holds `here`."""

    here: Tensor

    @staticmethod
    def __new__(cls, here):
        layout = {"strides": here.stride(), "storage_offset": here.storage_offset(), "dtype": here.dtype}
        there = Tensor._make_wrapper_subclass(cls, here.shape, **layout, device=DEVICE)  # type: ignore
        there.here = here
        return there  # type: ignore

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        return computed(func, args, kwargs or {})

    def tolist(self):
        return self.cpu().tolist()

    def numpy(self, *_, **__):
        raise TypeError("can't convert lazy:0 device type tensor to numpy. Use Tensor.cpu() first")

    def __repr__(self, **_):
        return f"{self.cpu()!r} on {self.device}"

    def __format__(self, spec):
        return format(self.cpu(), spec)


class Pretend(TorchDispatchMode):
    """Makes tensors with `device=` as well."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        return computed(func, args, kwargs or {})


@contextmanager
def pretend():
    """Within it, the device is there."""

    def as_cpu(function):
        return lambda *kind, **given: function(
            *("cpu" if one == DEVICE.type else one for one in kind), **given
        )

    future, before = torch.__future__, torch.__future__.get_overwrite_module_params_on_conversion()
    with pytest.MonkeyPatch.context() as patch, Pretend():
        for name in ("autocast", "is_autocast_enabled"):  # which know some kinds of device only
            patch.setattr(torch, name, as_cpu(getattr(torch, name)))
        patch.setattr(spectrogram, "torchaudio", None)  # reshapes what stft transposed in place
        future.set_overwrite_module_params_on_conversion(True)  # as `data` of another tensor keeps its `here`
        torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor(.., device=) is then seen by the mode
        try:
            yield DEVICE
        finally:
            torch._C._set_only_lift_cpu_tensors(False)
            future.set_overwrite_module_params_on_conversion(before)


def computed(func, args, kwargs):
    """What an operation gives for tensors on the CPU, on the device, or both."""
    given = []

    def here(one):
        if isinstance(one, Tensor):
            given.append(one)
            return one.here if type(one) is There else one
        return type(one)(map(here, one)) if type(one) in (list, tuple) else one

    own, kwargs = here(args), {name: here(one) for name, one in kwargs.items()}
    held = {id(one.here): one for one in given if type(one) is There}
    kind, wanted = getattr(func, "overloadpacket", None), kwargs.get("device")
    if held:
        check(kind, args, given)
    if not (bool(held) if wanted is None else wanted.type == DEVICE.type):
        return func(*own, **kwargs)
    if wanted is not None:
        kwargs["device"] = torch.device("cpu")
    if torch.Tag.nondeterministic_seeded in func.tags:
        if kwargs.get("generator") is not None:
            raise RuntimeError(f"Expected a {DEVICE.type!r} device type for generator but found 'cpu'")
        common = torch.get_rng_state()
        torch.set_rng_state(RANDOM.get_state())
        out = func(*own, **kwargs)
        RANDOM.set_state(torch.get_rng_state())
        torch.set_rng_state(common)
    else:
        out = own_way(kind, func, own, kwargs)

    def there(one):
        if isinstance(one, Tensor):  # an operation in place gives the tensor that it got
            return held[id(one)] if id(one) in held else There(one)
        return type(one)(map(there, one)) if type(one) in (list, tuple) else one

    return there(out)


def check(kind, args, given):
    """Raise as CUDA does where tensors of two devices meet."""
    others = [one for one in given if not isinstance(one, There)]
    if kind in COPIES or not others:
        return
    if kind in INDEXED and isinstance(args[0], There):
        others = [one for one in args[2:3] if isinstance(one, Tensor) and not isinstance(one, There)]
    if kind in JOINS or any(one.ndim for one in others):
        seen = "Expected all tensors to be on the same device, but found at least two devices"
        raise RuntimeError(f"{seen}, {DEVICE} and cpu! (in {kind})")


def own_way(kind, func, args, kwargs):
    """What an operation gives, changed as another implementation may."""
    if kind is aten.topk:
        values, index = func(args[0].flip(-1 if len(args) < 3 else args[2]), *args[1:], **kwargs)
        return values, args[0].shape[-1 if len(args) < 3 else args[2]] - 1 - index
    out = func(*args, **kwargs)
    if kind is aten._linalg_eigh:
        values, vectors = out
        signs = 1 - 2 * (torch.arange(vectors.shape[-1]) % 2)
        return values, vectors * signs
    if kind in PRODUCTS:
        return out * (1 + ROUNDING * torch.arange(out.numel()).remainder(3).sub(1).to(out).view(out.shape))
    return out
