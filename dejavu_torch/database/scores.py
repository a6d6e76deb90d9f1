"""Scores of all places: the layers' distances combined (section III-B, eq. 3 and eq. 4)."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from dejavu_torch.database.compressed import CompressedMap
from dejavu_torch.database.distance import Metric, check_metric, phase_distances
from dejavu_torch.types import InputError, Plan

Reduction = Literal["mean", "sum"]


class Segment(NamedTuple):
    """Places [start, stop) that the same layers cover, by their positions in the plan."""

    start: int
    stop: int
    layers: tuple[int, ...]


def segments(plan: Plan, places: int) -> tuple[Segment, ...]:
    """Cut 0..places at every start and stop of a layer: within a segment L of eq. 4 is constant."""
    cuts = sorted({0, places, *(layer.start for layer in plan), *(layer.stop for layer in plan)})
    return tuple(
        Segment(a, b, tuple(j for j, layer in enumerate(plan) if layer.start <= a and b <= layer.stop))
        for a, b in pairwise(cuts)
    )


def weight_per_feature(metric: Metric, features: int) -> float:
    """What a layer's distance grows with: its features for l1, their root for l2, nothing for cosine."""
    return {"l2": math.sqrt(features), "cosine": 1.0}.get(metric if isinstance(metric, str) else "", features)


def combine_layers(
    distances: list[Tensor], plan: Plan, places: int, metric: Metric = "l1", reduction: Reduction = "mean"
) -> Tensor:
    """S(i) from the phase distances of each layer (eq. 4).

    Args:
        distances: for each layer (Q,P), as `phase_distances` gives them.
        metric: tells what a layer's distance grows with (a callable counts as a sum over features).
        reduction: "sum" is eq. 4 as printed. "mean" divides it by the number of features summed
            over (l2: their roots, cosine: the layers), so that places covered by many features and
            places covered by few are comparable.

    Shape: L tensors (Q,P) -> (Q,N), lower is better.

    Convention: L in eq. 4 is the set of layers whose chunk holds i. A place that no layer covers
        scores +inf.

    Raises:
        InputError: no layers.
    """
    if not distances:
        raise InputError("there are no layers to combine; expected at least one")
    parts = []
    for start, stop, members in segments(plan, places):
        if not members:
            parts.append(distances[0].new_full((len(distances[0]), stop - start), math.inf))
            continue
        frames = torch.arange(start, stop, device=distances[0].device)
        total = distances[0].new_zeros(len(distances[0]), stop - start)
        for j in members:
            total = total + distances[j].index_select(1, plan[j].phase(frames))
        if reduction == "mean":
            total = total / sum(weight_per_feature(metric, len(plan[j].features)) for j in members)
        parts.append(total)
    return torch.cat(parts, 1)


def log_posterior(scores: Tensor, temperature: float | Tensor) -> Tensor:
    """How unlikely each place is: -log softmax(-S / T) over places.

    It orders the places of a query as S does (but for rounding where T is large), and makes the scores of
    different queries comparable: S grows with all that a frame has in no template, this only with what fits
    other places as well.

    Args:
        scores: S, lower is better. temperature: T, in units of S.

    Shape: (Q,N) -> (Q,N), in nats, lower is better, at least 0.

    Convention: a place that scores +inf has no probability and stays +inf.

    Example:
        >>> log_posterior(torch.tensor([[0.0, 0.0, torch.inf]]), 0.1).tolist()
        [[0.6931471824645996, 0.6931471824645996, inf]]
    """
    closed = scores.isinf()
    reachable = ~closed.all(1, keepdim=True)
    # what is +inf must not meet T: its gradient would be NaN
    logits = (-scores.masked_fill(closed, 0) / temperature).masked_fill(closed & reachable, -math.inf)
    return -logits.log_softmax(1).masked_fill(closed, -math.inf)


class Matcher(nn.Module):
    """Scores of every place of a map for every query (section III-B).

    Args:
        metric: see `phase_distances`.
        reduction: see `combine_layers`; "sum" is the paper's letter.
        temperature: scores are those of `log_posterior`; None, the paper's letter, leaves S as it is.

    Shape: query features (Q,D), map of N places -> scores (Q,N), lower is better, uncovered +inf.

    Convention: gradients reach the query features and the map's templates.

    Raises:
        InputError: features of another dimension than the map's, an unknown metric or reduction, a
            temperature of 0 or less.
    """

    def __init__(
        self, metric: Metric = "l1", reduction: Reduction = "mean", temperature: float | None = None
    ) -> None:
        super().__init__()
        check_metric(metric)
        if reduction not in ("mean", "sum"):
            raise InputError(f"reduction {reduction!r} is unknown; expected 'mean' or 'sum'")
        if temperature is not None and not 0 < temperature < math.inf:
            raise InputError(f"the temperature is {temperature}; expected a number above 0")
        self.metric = metric
        self.reduction: Reduction = reduction
        self.temperature = temperature

    def distances(self, features: Tensor, route: CompressedMap) -> list[Tensor]:
        """Eq. 3 for every layer: (Q,D) -> L tensors (Q,P)."""
        if features.ndim != 2 or features.shape[1] != route.dimension:
            raise InputError(
                f"the query features are {tuple(features.shape)}; the map expects (Q, {route.dimension})"
            )
        features = route.weighted(features)
        return [
            phase_distances(features.index_select(1, index), block, self.metric)
            for index, block in zip(route.layer_features(), route.blocks(), strict=True)
        ]

    def forward(self, features: Tensor, route: CompressedMap) -> Tensor:
        distances = self.distances(features, route)
        if not distances:
            dtype = torch.promote_types(features.dtype, torch.float32)
            return features.new_full((len(features), route.places), math.inf, dtype=dtype)
        scores = combine_layers(distances, route.plan, route.places, self.metric, self.reduction)
        return scores if self.temperature is None else log_posterior(scores, self.temperature)

    def extra_repr(self) -> str:
        return f"metric={self.metric!r}, reduction={self.reduction!r}, temperature={self.temperature}"
