"""What a user would store instead: all the frames, or every k-th."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from tqdm import tqdm

from dejavu_torch.database.distance import Metric, phase_distances
from dejavu_torch.recognition.select import best_match
from dejavu_torch.types import Match

DISTANCES_AT_ONCE = 2**22


def nearest_frames(
    reference: Tensor,
    query: Tensor,
    strides: Sequence[int] = (1,),
    metric: Metric = "l1",
    progress: bool = False,
) -> list[Match]:
    """Nearest stored frame of each query, where every k-th reference frame is stored.

    Args:
        reference: (N,D) features. query: (Q,D) features.
        strides: each k; 1 stores all frames. All are found in one pass over the distances.
        progress: show a progress bar on a terminal.

    Returns:
        For each k a Match of (Q,), index in reference frames.
    """
    rows = max(1, DISTANCES_AT_ONCE // len(reference))
    parts: list[list[Match]] = [[] for _ in strides]
    with torch.no_grad():
        batches = query.split(rows)
        for batch in tqdm(batches, "baselines", disable=None if progress else True, leave=False):
            distances = phase_distances(batch, reference, metric)
            for found, k in zip(parts, strides, strict=True):
                match = best_match(distances[:, ::k])
                match = match._replace(index=torch.where(match.index >= 0, match.index * k, -1))
                found.append(Match(*(column.cpu() for column in match)))
    return [Match(*(torch.cat(column) for column in zip(*found, strict=True))) for found in parts]


def stride_bytes(frames: int, dimension: int, itemsize: int, k: int) -> int:
    """Bytes of every k-th of `frames` frames."""
    return -(-frames // k) * dimension * itemsize


def fair_stride(frames: int, dimension: int, itemsize: int, map_bytes: int, tolerance: int) -> int:
    """The largest k, at most twice the tolerance, whose frames take at least the map's bytes.

    Example:
        >>> fair_stride(frames=1000, dimension=10, itemsize=4, map_bytes=8000, tolerance=5)
        5
    """
    fair = [
        k
        for k in range(1, max(1, 2 * tolerance) + 1)
        if stride_bytes(frames, dimension, itemsize, k) >= map_bytes
    ]
    return max(fair, default=1)
