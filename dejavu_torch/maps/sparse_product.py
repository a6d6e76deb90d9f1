"""Queries times the coefficients of a spectral map by a loop that numba compiles, where there is numba."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.maps.coefficients import Coefficients
from dejavu_torch.maps.compiling import compiled
from dejavu_torch.maps.l1 import numbers_of

WORTH_COMPILING = 2**16  # coefficients of a map: of fewer torch takes less than a millisecond

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
def _compiled(*kinds: Any) -> Callable[..., None] | None:
    """For coefficients of these dtypes: a map has those that its levels need."""
    numbers = ", ".join(f"{kind}[::1]" for kind in kinds)
    try:
        return compiled(
            _sums,
            f"void(float32[:,::1], {numbers}, int64[::1], float32[::1], float32[:,::1])",
            fastmath={"reassoc", "nsz", "contract"},
        )
    except Exception as error:  # a broken compiler must not break what works without one
        log.info("products with a spectral map by torch, not by numba: %s", " ".join(str(error).split()))
        return None


def compiled_sums(
    queries: Tensor, coefficients: Coefficients, where: Tensor, factor: Tensor, size: int
) -> Tensor | None:
    """Of each line the sum of its coefficients, each times the query's feature; None where torch has to.

    Torch keeps: gradients and what else follows or traces operations, other devices and dtypes, and all
    without numba. The two add up in different orders: a map goes by one of them, see `WORTH_COMPILING`.

    Args:
        where: (W,) int64, in which of `size` numbers the sum of a line goes; the others are 0.
        factor: (W,) of each line.

    Shape: (Q,K) -> (Q,size).
    """
    query, factors = (numbers_of(tensor) for tensor in (queries, factor))
    if query is None or factors is None or where.device.type != "cpu":
        return None
    own = [part.contiguous().numpy() for part in coefficients]
    kernel = _compiled(*(part.dtype for part in own))
    if kernel is None:
        return None
    out = np.zeros((queries.shape[0], size), np.float32)
    kernel(query, *own, where.numpy(), factors, out)
    return torch.from_numpy(out)
