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
    moved = queries - weight @ (queries - place_map.mean.to(queries)) / (weight.sum() + PRIOR)
    return F.normalize(moved, dim=1) if place_map.metric == "cosine" else moved
