"""Distance of a query to every phase of a layer (section III-B, eq. 3); L1 by a loop compiled by numba."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from dejavu_torch.maps.compiling import Floats, compiled, floats_of
from dejavu_torch.types import InputError, check_shape, expect

Metric = Literal["l1", "l2", "cosine"]

WORTH_COMPILING = 2**14  # P x F above which the loop is faster than torch even for one query
QUERIES_AT_ONCE = 64  # they stay in the cache while templates are read
TASK = 2**23  # terms |a - b| per task of a thread, about half a millisecond


def phase_distances(query: Tensor, templates: Tensor, metric: Metric = "l1") -> Tensor:
    """Distance of each query to the template of each phase: eq. 3 for all k at once.

    Args:
        query: H, the *query's* values of the layer's features. templates: mu(H, tau, k).
        metric: "l1" (the paper: sum over features of |H - mu|), "l2" (Euclidean) or "cosine" (1 - cosine).

    Shape: (Q,F), (P,F) -> (Q,P).

    Convention: at least float32, under any autocast, without a tensor Q x P x F. On the CPU "l1" without
        gradients runs in a compiled loop if numba is installed.

    Raises:
        InputError: tensors that are not (Q,F) and (P,F), or an unknown metric.

    Example:
        >>> phase_distances(torch.tensor([[1.0, 2.0]]), torch.tensor([[1.0, 2.0], [0.0, 4.0]]))
        tensor([[0., 3.]])
    """
    expect(metric in get_args(Metric), ", ".join(get_args(Metric)), f"metric {metric!r} is unknown")
    check_shape(templates, "P F", "phase_distances got templates")
    # compared as they are, since a traced size has no number
    if query.ndim != 2 or query.shape[1] != templates.shape[1]:
        seen = f"phase_distances got queries {tuple(query.shape)}"
        raise InputError(f"{seen}; expected (Q, {templates.shape[1]})")
    dtype = torch.promote_types(torch.promote_types(query.dtype, templates.dtype), torch.float32)
    query, templates = query.to(dtype), templates.to(dtype)
    with torch.autocast(query.device.type, enabled=False):
        if metric == "cosine":
            return 1 - normalize(query, dim=-1) @ normalize(templates, dim=-1).T
        if metric == "l1" and (distances := compiled_l1(query, templates)) is not None:
            return distances
        # the matrix-product form of l2 loses the small distances that decide a match
        p, mode = 1.0 if metric == "l1" else 2.0, "donot_use_mm_for_euclid_dist"
        return torch.cdist(query, templates, p, compute_mode=mode)


def compiled_l1(query: Tensor, templates: Tensor) -> Tensor | None:
    """L1 distances by the compiled loop: (Q,F), (P,F) -> (Q,P); None if torch has to compute them.

    That is for gradients, tracing, vmap, other devices and dtypes, few templates, and without numba.

    Convention: all pairs are summed in the same order: distances of a query do not depend on its batch, and
        equal templates have equal distances, bit for bit.
    """
    if templates.numel() < WORTH_COMPILING:
        return None
    a, b = floats_of(query), floats_of(templates)
    if a is None or b is None or (kernel := _compiled()) is None:
        return None
    out = np.empty((len(a), len(b)), np.float32)
    rows = max(1, min(QUERIES_AT_ONCE, len(a)))
    width = 4 * max(1, TASK // (4 * rows * a.shape[1]))
    tasks = [
        (a[q : q + rows], b[p : p + width], out[q : q + rows, p : p + width])
        for q in range(0, len(a), rows)
        for p in range(0, len(b), width)
    ]
    threads = min(torch.get_num_threads(), out.size * a.shape[1] // TASK)
    if threads < 2:
        for task in tasks:
            kernel(*task)
    else:  # new threads, safe with forks and calls from several threads
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda task: kernel(*task), tasks))
    return torch.from_numpy(out)


@cache
def _compiled() -> Callable[[Floats, Floats, Floats], None] | None:
    signature = "void(float32[:,::1], float32[:,::1], float32[:,:])"
    fastmath = {"reassoc", "nsz", "contract"}  # not "nnan" and "ninf", which lose NaN and infinity
    return compiled(_distances, signature, "L1 distances by torch", fastmath=fastmath)


def _distances(query: Floats, templates: Floats, out: Floats) -> None:
    """Four templates at a time; the last block repeats its last one, so that all sums have the same order."""
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


def l1_backend() -> Literal["numba", "torch"]:
    """The library for large L1 distances on the CPU without gradients; the first call compiles the loop."""
    return "torch" if _compiled() is None else "numba"
