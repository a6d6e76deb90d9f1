"""Distance of a query to every phase of a layer (section III-B, eq. 3)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from dejavu_torch.maps.l1 import compiled_l1
from dejavu_torch.types import InputError

Metric = Literal["l1", "l2", "cosine"]


def _l1(query: Tensor, templates: Tensor) -> Tensor:
    distances = compiled_l1(query, templates)
    return torch.cdist(query, templates, p=1.0) if distances is None else distances


def _l2(query: Tensor, templates: Tensor) -> Tensor:
    # the matrix-product form loses the small distances that decide a match
    return torch.cdist(query, templates, p=2.0, compute_mode="donot_use_mm_for_euclid_dist")


def _cosine(query: Tensor, templates: Tensor) -> Tensor:
    unit = torch.nn.functional.normalize
    return 1 - unit(query, dim=-1) @ unit(templates, dim=-1).T


METRICS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"l1": _l1, "l2": _l2, "cosine": _cosine}


def check_metric(metric: Metric) -> None:
    """Refuse an unknown metric by an InputError."""
    if metric not in [*METRICS]:
        raise InputError(f"metric {metric!r} is unknown; expected {', '.join(METRICS)}")


def phase_distances(query: Tensor, templates: Tensor, metric: Metric = "l1") -> Tensor:
    """Distance of each query to the template of each phase: eq. 3 for all k at once.

    Args:
        query: H, the *query's* values of the layer's features.
        templates: mu(H, tau, k).
        metric: "l1" (the paper: sum over features of |H - mu|), "l2" (Euclidean) or "cosine"
            (1 - cosine similarity).

    Shape: (Q,F), (P,F) -> (Q,P).

    Convention: computed in float32 at least, whatever the autocast, without a tensor Q x P x F. "l1" without
        gradients on the CPU runs in a compiled loop where numba is installed, see `l1_backend`.

    Raises:
        InputError: tensors that are not (Q,F) and (P,F), or an unknown metric.

    Example:
        >>> phase_distances(torch.tensor([[1.0, 2.0]]), torch.tensor([[1.0, 2.0], [0.0, 4.0]]))
        tensor([[0., 3.]])
    """
    check_metric(metric)
    if query.ndim != 2 or templates.ndim != 2 or query.shape[1] != templates.shape[1]:
        raise InputError(
            f"phase_distances got {tuple(query.shape)} and {tuple(templates.shape)}; expected (Q,F) and (P,F)"
        )
    dtype = torch.promote_types(torch.promote_types(query.dtype, templates.dtype), torch.float32)
    with torch.autocast(query.device.type, enabled=False):
        return METRICS[metric](query.to(dtype), templates.to(dtype))
