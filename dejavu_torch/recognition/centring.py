"""The mean of a drive's queries, which is its own light, in place of the map's."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.recognition.evidence import run_lengths, unchanged

PRIOR = 50  # queries that the map's own mean counts as; fewer queries are not centred by default


def centred(place_map: PlaceMap, queries: Tensor) -> Tensor:
    """Queries without what all of them have and the map has not: q - sum w (q - m) / (sum w + 50).

    m is the mean descriptor of the map; w is 1 over the length of the stop that a query belongs to. For a map
    by cosine the results have norm 1. Queries of maps that are not spectral, and so have no mean, stay as
    they are.

    Shape: (Q,K) -> (Q,K).

    Source: standardisation per condition (Schubert, Neubert and Protzel, 2020); the prior is ours.
    """
    if not isinstance(place_map, SpectralMap) or not len(queries):
        return queries
    weight = 1 / run_lengths(unchanged(queries)).to(queries)
    shift = weight @ (queries - place_map.mean.to(queries))
    return _without(place_map, queries, shift / (weight.sum() + PRIOR))


def running(
    place_map: PlaceMap, queries: Tensor, before: Tensor | None = None
) -> tuple[Tensor, Tensor | None]:
    """As `centred`, for consecutive batches: each query by the mean of those up to it.

    Shape: (B,K), the state (K+1,) or None before the first query -> (B,K), the next state: the sum of q - m,
        and the number of queries.
    """
    if not isinstance(place_map, SpectralMap) or not len(queries):
        return queries, before
    sums = F.pad(queries - place_map.mean.to(queries), (0, 1), value=1.0).cumsum(0)
    sums = sums if before is None else sums + before
    return _without(place_map, queries, sums[:, :-1] / (sums[:, -1:] + PRIOR)), sums[-1]


def _without(place_map: SpectralMap, queries: Tensor, mean: Tensor) -> Tensor:
    moved = queries - mean
    return F.normalize(moved, dim=1) if place_map.metric == "cosine" else moved
