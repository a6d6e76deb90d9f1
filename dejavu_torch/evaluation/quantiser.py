"""A product quantiser (Jegou, Douze and Schmid, 2011): what many would store instead of a map."""

from __future__ import annotations

import torch
from torch import Tensor

CENTROIDS = 256  # of one byte
ROUNDS = 25
TRAINED = 256 * CENTROIDS  # descriptors that centroids are learned from, at most
DISTANCES_AT_ONCE = 2**22  # distances computed at a time


def product_quantised(
    descriptors: Tensor,
    parts: int,
    seed: int = 0,
    centroids: int = CENTROIDS,
    training: Tensor | None = None,
) -> tuple[Tensor, int]:
    """Descriptors as a product quantiser restores them: a code for each of several parts of their numbers.

    Args:
        descriptors: (N,K). parts: codes of a descriptor, at most K; with 256 centroids, bytes.
        centroids: of a part, at most. training: (n,K) that they are learned from; None is the descriptors.

    Returns:
        (N,K), and the bytes of all codebooks in float32.
    """
    draw, training = torch.Generator().manual_seed(seed), descriptors if training is None else training
    restored, size = torch.empty_like(descriptors), 0
    chosen = training[torch.randperm(len(training), generator=draw)[:TRAINED].to(training.device)]
    for numbers in torch.arange(descriptors.shape[1]).tensor_split(min(parts, descriptors.shape[1])):
        book = k_means(chosen[:, numbers], min(centroids, len(chosen)), draw)
        restored[:, numbers] = book[_nearest(descriptors[:, numbers], book)]
        size += 4 * book.numel()
    return restored, size


def k_means(points: Tensor, count: int, draw: torch.Generator) -> Tensor:
    """Centroids (C,K) of points (N,K) by Lloyd's algorithm, from random points (draw); one without points
    moves next to that of the most."""
    centroids = points[torch.randperm(len(points), generator=draw)[:count].to(points.device)].clone()
    for _ in range(ROUNDS):
        label = _nearest(points, centroids)
        sizes = label.bincount(minlength=count)
        sums = torch.zeros_like(centroids).index_add_(0, label, points)
        centroids = torch.where(sizes[:, None] > 0, sums / sizes.clamp(min=1)[:, None], centroids)
        empty = (sizes == 0).nonzero()[:, 0]
        if len(empty):
            fullest = sizes.topk(min(len(empty), count - len(empty))).indices
            shift = points.std(0) / 1024
            centroids[empty[: len(fullest)]] = centroids[fullest] + shift
            centroids[fullest] -= shift
    return centroids


def _nearest(points: Tensor, centroids: Tensor) -> Tensor:
    """The nearest centroid of each point, (N,) int64."""
    half = centroids.square().sum(1) / 2
    parts = points.split(max(1, DISTANCES_AT_ONCE // len(centroids)))
    return torch.cat([(half - part @ centroids.T).argmin(1) for part in parts])
