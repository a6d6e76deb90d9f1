"""Scores of several ways to store descriptors, by the queries that ask."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition.scorer import OfMap, OfStored, Reordered, Scorer

Scoring = Callable[[Tensor], Scorer]  # of queries (Q,K)


def stored_by(frames: Tensor, layout: Layout, k: int = 1) -> Scoring:
    """Scores by stored frames, of which every k-th is stored."""
    return lambda queries: OfStored(frames, queries, k, "cosine", layout)


def in_order(place_map: PlaceMap, order: Tensor | None) -> Scoring:
    """Scores of a map whose places are those of `order`."""
    if order is None:
        return lambda queries: OfMap(place_map, queries)
    return lambda queries: Reordered(OfMap(place_map, queries), order)
