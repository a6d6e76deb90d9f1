"""L1 distances on the CPU by a loop that numba compiles, where numba is installed."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import forward_ad
from torch.nn import Parameter
from torch.utils._python_dispatch import is_in_torch_dispatch_mode

from dejavu_torch.maps.compiling import compiled

log = logging.getLogger("dejavu_torch")

Floats = NDArray[np.float32]
Kernel = Callable[[Floats, Floats, Floats], None]

WORTH_COMPILING = 2**14  # P x F above which the loop is faster than torch even for one query
QUERIES_AT_ONCE = 64  # they stay in cache while the templates stream by
TASK = 2**23  # |a - b| for one thread at a time, about half a millisecond


def _distances(query: Floats, templates: Floats, out: Floats) -> None:
    """Four templates at a time, so that each number of a query is loaded once for all four; compiled only.

    The last block repeats the last template, so that every pair is summed in the same order.
    """
    last = len(templates) - 1
    for a in range(0, len(templates), 4):
        b, c, d = min(a + 1, last), min(a + 2, last), min(a + 3, last)
        for q in range(len(query)):
            in_a = in_b = in_c = in_d = np.float32(0)
            for f in range(query.shape[1]):
                value = query[q, f]
                in_a += abs(value - templates[a, f])
                in_b += abs(value - templates[b, f])
                in_c += abs(value - templates[c, f])
                in_d += abs(value - templates[d, f])
            out[q, a], out[q, b], out[q, c], out[q, d] = in_a, in_b, in_c, in_d


@cache
def _compiled() -> Kernel | None:
    signature = "void(float32[:,::1], float32[:,::1], float32[:,:])"
    try:  # sums in any order, but not "nnan" and "ninf": NaN and infinity have to arrive
        return compiled(_distances, signature, fastmath={"reassoc", "nsz", "contract"})
    except Exception as error:  # a broken compiler must not break what works without one
        log.info("L1 distances by torch, not by numba: %s", " ".join(str(error).split()))
        return None


def l1_backend() -> Literal["numba", "torch"]:
    """What computes large L1 distances on the CPU without gradients; the first call compiles the loop.

    Example:
        >>> l1_backend() in ("numba", "torch")
        True
    """
    return "torch" if _compiled() is None else "numba"


def compiled_l1(query: Tensor, templates: Tensor) -> Tensor | None:
    """Sum of |a - b| over features for every pair, or None if torch has to compute it.

    Torch does so for gradients and whatever else follows or traces operations (vmap, torch.compile, export),
    on other devices and dtypes, for few templates, and without numba.

    Shape: (Q,F), (P,F) -> (Q,P).

    Convention: a pair is summed in one order wherever it stands: a query alone has the distances, to the bit,
        that it has in a batch, and equal templates have equal distances.
    """
    if templates.numel() < WORTH_COMPILING:
        return None
    a, b = numbers_of(query), numbers_of(templates)
    if a is None or b is None or (kernel := _compiled()) is None:
        return None
    return torch.from_numpy(_in_threads(kernel, a, b))


def numbers_of(tensor: Tensor) -> Floats | None:
    """The numbers of a float32 tensor on the CPU, or None if its operations are followed or traced."""
    if (
        torch.compiler.is_compiling()
        or torch.jit.is_tracing()  # type: ignore[attr-defined, no-untyped-call]
        or is_in_torch_dispatch_mode()
        or type(tensor) not in (Tensor, Parameter)
        or (tensor.device.type, tensor.dtype) != ("cpu", torch.float32)
        or (tensor.requires_grad and torch.is_grad_enabled())
        or forward_ad.unpack_dual(tensor).tangent is not None
    ):
        return None
    try:
        numbers: Floats = tensor.detach().contiguous().numpy()
        return numbers
    except (RuntimeError, TypeError):  # tensors of vmap have no memory, sparse ones no rows
        return None


def _in_threads(kernel: Kernel, query: Floats, templates: Floats) -> Floats:
    """The kernel in new threads, so that a fork, or calls from several threads, do no harm."""
    out = np.empty((len(query), len(templates)), np.float32)
    rows = max(1, min(QUERIES_AT_ONCE, len(query)))
    width = 4 * max(1, TASK // (4 * rows * query.shape[1]))
    tasks = [
        (query[q : q + rows], templates[p : p + width], out[q : q + rows, p : p + width])
        for q in range(0, len(query), rows)
        for p in range(0, len(templates), width)
    ]
    threads = min(torch.get_num_threads(), out.size * query.shape[1] // TASK)
    if threads < 2:
        for task in tasks:
            kernel(*task)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda task: kernel(*task), tasks))
    return out
