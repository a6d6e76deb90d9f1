"""The mean of a drive's queries, which is its own light, in place of the map's."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.recognition.evidence import run_lengths, unchanged
from dejavu_torch.types import InputError

SHRINKAGE = 0.25  # least share of the second moment of turned images that a multiple of identity replaces
PRIOR = 50  # queries that the map's own mean counts as; fewer queries are not centred by default


def centred(place_map: PlaceMap, queries: Tensor, copies: int = 1) -> Tensor:
    """Queries without what all of them have and the map has not: q - sum w (q - m) / (sum w + 50).

    m is the mean descriptor of the map; w is 1 over the length of the stop that a query belongs to. For a map
    by cosine the results have norm 1. Queries of 0, as of blank frames, stay 0 and do not count. Those of
    maps that are not spectral, and so have no mean, stay as they are. Of several `copies` of each query, the
    first counts.

    Shape: (Q,K) -> (Q,K).

    Source: standardisation per condition (Schubert, Neubert and Protzel, 2020); the prior is ours.
    """
    if not isinstance(place_map, SpectralMap) or not len(queries):
        return queries
    own = queries[::copies]
    weight = own.any(1) / run_lengths(unchanged(own)).to(queries)
    shift = weight @ (own - place_map.mean.to(queries))
    return _without(place_map.metric, queries, shift / (weight.sum() + PRIOR))


def learn_turned(place_map: SpectralMap, rows: Tensor) -> None:
    """Let the map of an area know turned images by descriptors (n,K), of which those of 0 do not count: their
    second moment about the map's mean, as its inverse in 8 bits. A share of it, K / (K + n) but at least
    0.25, is replaced by a multiple of the identity."""
    moved = rows[rows.any(1)].double().cpu() - place_map.mean.double().cpu()
    moment, (count, size) = moved.T @ moved / max(1, len(moved)), moved.shape
    even = torch.eye(size).to(moment) * moment.diagonal().mean().clamp(min=1e-30)
    inverse = moment.lerp(even, max(SHRINKAGE, size / (count + size))).inverse()
    place_map.turned = (127 * inverse / inverse.abs().max()).round().to(place_map.device, torch.int8)


def set_apart(place_map: PlaceMap, queries: Tensor) -> Tensor:
    """Queries of turned images without what these have in common: (q - m) / C, scaled to length 1, where m is
    the map's mean and C as in `learn_turned`; as they are if the map does not know C. Queries of 0 stay 0.

    Their corners are reflected, and a place that looks a little like that is similar to all of them.

    Shape: (Q,K) -> (Q,K).
    """
    if not isinstance(place_map, SpectralMap) or not len(place_map.turned):
        return queries
    moved = (queries - place_map.mean.to(queries)) * queries.any(1, keepdim=True).to(queries)
    return F.normalize(moved @ place_map.turned.to(queries), dim=1)


class RunningMean(nn.Module):
    """As `centred`, for consecutive batches: each query by the mean of those up to it.

    Shape: queries (B,K), the state (K+1,) before them -> (B,K), the next state: the sum of q - m, and the
        number of queries. The first state is 0. Of several `copies` of each query, the first counts.
    """

    mean: Tensor

    def __init__(self, place_map: SpectralMap) -> None:
        super().__init__()
        self.metric = place_map.metric
        self.register_buffer("mean", place_map.mean)

    def forward(self, queries: Tensor, state: Tensor, copies: int = 1) -> tuple[Tensor, Tensor]:
        mean, own = self.mean.to(queries), queries[::copies]
        shows = own.any(1, keepdim=True).to(queries)
        sums = state + (F.pad(own - mean, (0, 1), value=1.0) * shows).cumsum(0)
        each = (sums[:, :-1] / (sums[:, -1:] + PRIOR)).repeat_interleave(copies, 0)
        return _without(self.metric, queries, each), sums[-1]


def running_mean(place_map: PlaceMap) -> RunningMean:
    """The running mean of a map's queries, or an InputError."""
    if not isinstance(place_map, SpectralMap):
        seen = f"a {type(place_map).__name__} has no mean"
        raise InputError(f"{seen}; expected a SpectralMap to centre queries")
    return RunningMean(place_map)


def _without(metric: str, queries: Tensor, mean: Tensor) -> Tensor:
    moved = (queries - mean) * queries.any(1, keepdim=True).to(queries)
    return F.normalize(moved, dim=1) if metric == "cosine" else moved
