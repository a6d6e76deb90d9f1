"""Backbone and matcher as one module that torch.export takes."""

from __future__ import annotations

import math
from itertools import accumulate

import torch
from torch import Tensor, nn

from dejavu_torch.database.compressed import CompressedMap
from dejavu_torch.database.distance import phase_distances
from dejavu_torch.database.scores import Matcher, log_posterior, segments, weight_per_feature
from dejavu_torch.types import InputError


class Localizer(nn.Module):
    """Frames to the scores of all places, S(i) of eq. 4, with the map inside.

    All that follows from the plan is worked out once, here: which distances each place adds up, and what
    their sum is divided by. What remains is a fixed run of tensor operations, so that
    `torch.export.export(module, (frames,), dynamic_shapes={"frames": {0: torch.export.Dim("batch")}})`
    takes it, with a batch of any size.

    Args:
        pipeline: frames (B,C,H,W) -> features (B,D), such as `DejaVu.pipeline`; as it is exported, so it
            stays, so call `eval()` first.
        route: the map, of at least one layer.
        matcher: its metric, reduction and temperature.

    Shape: frames (B,C,H,W) -> scores (B,N) float32 (float64 stays float64), lower is better, uncovered +inf.

    Convention: of the columns [distances of all layers, 0, +inf] a place adds up those that `terms` names.
        The scores are those of `DejaVu.forward`, whose checks of the frames look at the data and are
        therefore left out. The map is shared, not copied. The batch can be of any size where
        the pipeline allows; HOG cuts large batches, and takes `Dim("batch", max=...)` as export suggests.

    Raises:
        InputError: a map without layers, or features of another dimension than the map's.

    Example:
        >>> from dejavu_torch.types import FrequencyLayer
        >>> route = CompressedMap((FrequencyLayer(2, 2, 0, 3, (0,)),), (torch.tensor([[1.0], [5.0]]),), 4, 1)
        >>> Localizer(nn.Flatten(), route, Matcher())(torch.full((1, 1, 1, 1), 2.0))
        tensor([[1., 3., 1., inf]])
    """

    terms: Tensor
    weight: Tensor

    def __init__(self, pipeline: nn.Module, route: CompressedMap, matcher: Matcher) -> None:
        super().__init__()
        if not route.plan:
            raise InputError(f"the map of {route.places} places has no layers; expected at least one")
        self.pipeline = pipeline
        self.metric = matcher.metric
        self.temperature = matcher.temperature
        self.route = route
        self.dimension = route.dimension
        phases = [layer.phases for layer in route.plan]
        self.features = [len(layer.features) for layer in route.plan]
        self.sizes = [block.numel() for block in route.blocks()]
        *first, nothing = accumulate(phases, initial=0)  # columns of all distances, then 0 and +inf
        parts = segments(route.plan, route.places)
        terms = torch.full((max(len(part.layers) for part in parts), route.places), nothing)
        weight = torch.ones(route.places, dtype=torch.promote_types(route.templates.dtype, torch.float32))
        for start, stop, members in parts:
            frames = torch.arange(start, stop)
            for k, j in enumerate(members):
                terms[k, start:stop] = first[j] + route.plan[j].phase(frames)
            if not members:
                terms[0, start:stop] = nothing + 1
            elif matcher.reduction == "mean":
                counts = (weight_per_feature(matcher.metric, self.features[j]) for j in members)
                weight[start:stop] = sum(counts)
        device = route.templates.device
        self.register_buffer("terms", terms.to(device))
        self.register_buffer("weight", weight.to(device))

    def forward(self, frames: Tensor) -> Tensor:
        features: Tensor = self.pipeline(frames)
        if features.ndim != 2 or features.shape[1] != self.dimension:
            raise InputError(
                f"the features are {tuple(features.shape)}; the map expects (B, {self.dimension})"
            )
        values = self.route.weighted(features).index_select(1, self.route.feature_index)
        blocks = self.route.templates.split(self.sizes)
        distances = [
            phase_distances(value, block.view(-1, value.shape[1]), self.metric)
            for value, block in zip(values.split(self.features, 1), blocks, strict=True)
        ]
        nothing = torch.zeros_like(distances[0][:, :1])
        table = torch.cat([*distances, nothing, nothing + math.inf], 1)
        total = table.index_select(1, self.terms[0])
        for columns in self.terms[1:].unbind():
            total = total + table.index_select(1, columns)
        scores = total / self.weight.to(total.dtype)
        return scores if self.temperature is None else log_posterior(scores, self.temperature)
