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

WORTH_COMPILING = 2**14  # P x F from which on even a single query is faster than with torch
QUERIES_AT_ONCE = 64  # they stay in cache while the templates stream by
TASK = 2**23  # |a - b| for one thread at a time, about half a millisecond


def _distances(query: Floats, templates: Floats, out: Floats) -> None:
    """Four templates at a time, so that a query's numbers are loaded once for all four.

    Compiled, never run as it stands. The last block repeats the last template instead of summing what
    is left in a loop of its own: every pair is summed in one order, wherever it stands.
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
def _compiled() -> Callable[[Floats, Floats, Floats], None] | None:
    try:
        return compiled(
            _distances,
            "void(float32[:,::1], float32[:,::1], float32[:,:])",
            # sums in any order, but not "nnan" and "ninf": NaN and infinity have to arrive
            fastmath={"reassoc", "nsz", "contract"},
        )
    except Exception as error:  # a broken compiler must not break what works without one
        log.info("L1 distances by torch, not by numba: %s", " ".join(str(error).split()))
        return None


def l1_backend() -> Literal["numba", "torch"]:
    """What computes large L1 distances on the CPU where no gradient is asked for.

    Convention: "numba" where it can be imported and compiles; the first call tries that.

    Example:
        >>> l1_backend() in ("numba", "torch")
        True
    """
    return "torch" if _compiled() is None else "numba"


def compiled_l1(query: Tensor, templates: Tensor) -> Tensor | None:
    """Sum of |a - b| over features for every pair, or None where this is left to torch.

    Torch keeps: gradients and what else follows or traces operations (vmap, torch.compile, export),
    other devices and dtypes, templates too few to be worth compiling for, and all without numba.

    Shape: (Q,F), (P,F) -> (Q,P).

    Convention: the number of queries has no say, and a pair is summed in one order wherever it stands:
        a query alone gets the bits it gets in a batch, and equal templates get equal distances.
    """
    if templates.numel() < WORTH_COMPILING:
        return None
    if query.ndim != 2 or templates.ndim != 2 or query.shape[1] != templates.shape[1]:
        return None  # torch says what is wrong
    a, b = numbers_of(query), numbers_of(templates)
    kernel = None if a is None or b is None else _compiled()
    if a is None or b is None or kernel is None:
        return None
    return torch.from_numpy(_in_threads(kernel, a, b, torch.get_num_threads()))


def numbers_of(tensor: Tensor) -> Floats | None:
    """The float32 numbers of a tensor on the CPU, or None where they are not all there is to it."""
    if torch.compiler.is_compiling():
        return None
    if torch.jit.is_tracing() or is_in_torch_dispatch_mode():  # type: ignore[attr-defined, no-untyped-call]
        return None
    if type(tensor) not in (Tensor, Parameter) or tensor.device.type != "cpu":
        return None
    if tensor.dtype != torch.float32 or (tensor.requires_grad and torch.is_grad_enabled()):
        return None
    if forward_ad.unpack_dual(tensor).tangent is not None:
        return None
    try:
        numbers: Floats = tensor.detach().contiguous().numpy()
        return numbers
    except (RuntimeError, TypeError):  # vmap and its kin have no memory, sparse tensors no rows
        return None


def _in_threads(kernel: Callable[..., None], query: Floats, templates: Floats, threads: int) -> Floats:
    """Threads of Python, made anew in every call: safe after fork and from several threads at once."""
    out = np.empty((len(query), len(templates)), np.float32)
    rows = max(1, min(QUERIES_AT_ONCE, len(query)))
    width = 4 * max(1, TASK // (4 * rows * query.shape[1]))
    tasks = [
        (query[q : q + rows], templates[p : p + width], out[q : q + rows, p : p + width])
        for q in range(0, len(query), rows)
        for p in range(0, len(templates), width)
    ]
    threads = min(threads, out.size * query.shape[1] // TASK)
    if threads < 2:
        for task in tasks:
            kernel(*task)
        return out
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(kernel, *task) for task in tasks]:
            done.result()
    return out
