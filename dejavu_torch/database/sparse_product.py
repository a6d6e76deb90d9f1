"""Queries times the coefficients of a spectral map by a loop that numba compiles, where there is numba."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.database.coefficients import Coefficients
from dejavu_torch.database.l1 import numbers_of

WORTH_COMPILING = 2**16  # coefficients: of fewer torch takes less than a millisecond

log = logging.getLogger("dejavu_torch")


def _sums(query: Any, counts: Any, feature: Any, level: Any, where: Any, factor: Any, out: Any) -> None:
    """Compiled, never run as it stands."""
    for q in range(len(query)):
        start = 0
        for line in range(len(counts)):
            total = np.float32(0)
            stop = start + counts[line]
            for k in range(start, stop):
                total += query[q, feature[k]] * np.float32(level[k])
            out[q, where[line]] = total * factor[line]
            start = stop


@cache
def _compiled() -> Callable[..., None] | None:
    reason: Exception
    for keep in (True, False):  # nowhere to keep what is compiled is no reason not to compile
        try:
            import numba

            compiler = numba.njit(
                cache=keep, nogil=True, error_model="numpy", fastmath={"reassoc", "nsz", "contract"}
            )
            kernel: Callable[..., None] = compiler(_sums)
            if kernel is _sums:
                raise RuntimeError("NUMBA_DISABLE_JIT is set")
            few, numbers = np.zeros(1, np.uint8), np.zeros((1, 1), np.float32)
            kernel(numbers, few, few, np.zeros(0, np.int8), np.zeros(1, np.int64), numbers[0], numbers)
            return kernel
        except Exception as error:  # a broken compiler must not break what works without one
            reason = error
    log.info("products with a spectral map by torch, not by numba: %s", " ".join(str(reason).split()))
    return None


def compiled_sums(
    queries: Tensor, coefficients: Coefficients, where: Tensor, factor: Tensor, size: int
) -> Tensor | None:
    """Of each line the sum of its coefficients, each times the query's feature; None where torch has to.

    Torch keeps: gradients and what else follows or traces operations, other devices and dtypes, and all
    without numba.

    Args:
        where: (W,) int64, in which of `size` numbers the sum of a line goes; the others are 0.
        factor: (W,) of each line.

    Shape: (Q,K) -> (Q,size).
    """
    if coefficients.level.shape[0] < WORTH_COMPILING:
        return None
    own = [numbers_of(tensor) for tensor in (queries, factor)]
    kernel = None if any(one is None for one in own) else _compiled()
    if kernel is None or where.device.type != "cpu":
        return None
    out = np.zeros((queries.shape[0], size), np.float32)
    query, factors = own
    kernel(query, *(part.numpy() for part in coefficients), where.numpy(), factors, out)
    return torch.from_numpy(out)
