"""The mean of a drive's queries, which is its own light, in place of the map's."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import SpectralMap

PRIOR = 50  # queries that the map's own mean counts as; fewer queries are not centred by default


def centred(place_map: PlaceMap, queries: Tensor) -> Tensor:
    """Queries without what all of them have and the map has not: q - sum(q - m) / (Q + 50).

    m is the mean descriptor of the map. For a map by cosine the results have norm 1. Queries of maps that are
    not spectral, and so have no mean, stay as they are.

    Shape: (Q,K) -> (Q,K).

    Source: standardisation per condition (Schubert, Neubert and Protzel, 2020); the prior is ours.
    """
    if not isinstance(place_map, SpectralMap) or not len(queries):
        return queries
    mean = place_map.mean.to(queries)
    moved = queries - (queries - mean).sum(0) / (len(queries) + PRIOR)
    return F.normalize(moved, dim=1) if place_map.metric == "cosine" else moved
