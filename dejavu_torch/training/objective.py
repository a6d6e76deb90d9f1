"""Which losses count, and how much."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import torch
from torch import Tensor

from dejavu_torch.database.template_map import CompressedMap, Matcher, weight_per_feature
from dejavu_torch.training.losses import (
    aliased_pairs,
    decorrelation_loss,
    periodicity_loss,
    phase_cross_entropy,
    place_cross_entropy,
    support_loss,
)
from dejavu_torch.types import InputError

PAIRS = 4096  # of places, that a step looks at for aliases


class Losses(NamedTuple):
    """total: the weighted sum, a scalar. parts: each loss by name. left_out: frames without covered place."""

    total: Tensor
    parts: dict[str, Tensor]
    left_out: int


@dataclass(frozen=True)
class Objective:
    """A weighted sum of the losses of `training.losses`.

    Args:
        place, phase, periodicity, decorrelation, support: how much each counts; 0 leaves it out.
        candidates: periods for the periodicity loss, in frames; None takes those of the layers.
        margin: of the support loss, in units of a feature.

    Raises:
        InputError: a weight below 0, none above 0, or a margin that is not.
    """

    place: float = 1.0
    phase: float = 1.0
    periodicity: float = 0.0
    decorrelation: float = 0.0
    support: float = 0.0
    candidates: list[float] | None = None
    margin: float = 0.5

    def __post_init__(self) -> None:
        weights = list(self.weights.values())
        fit = all(0 <= weight < math.inf for weight in weights) and any(weights) and self.margin > 0
        if not fit or not all(2 <= period < math.inf for period in self.candidates or ()):
            raise InputError(
                f"the losses count {self.weights}, margin {self.margin}, candidates {self.candidates}; "
                "expected 0 or more, one of them above 0, a margin above 0, and periods of at least 2"
            )

    @property
    def weights(self) -> dict[str, float]:
        """How much each loss counts, by name."""
        return {
            name: getattr(self, name)
            for name in ("place", "phase", "periodicity", "decorrelation", "support")
        }

    def __call__(
        self,
        features: Tensor,
        distances: Sequence[Tensor],
        scores: Tensor,
        right: Tensor,
        route: CompressedMap,
        matcher: Matcher,
        temperature: Tensor,
        tolerance: int,
    ) -> Losses:
        """The losses of a batch.

        Args:
            distances: eq. 3 of each layer. scores: `log_posterior` of eq. 4. right: places, -1 as padding.

        Shape: (B,D), L tensors (B,P), (B,N), (B,R).
        """
        found = place_cross_entropy(scores, right, tolerance, 1.0)  # the scores know their temperature
        parts = {"place": found.loss}
        if self.phase:
            if matcher.reduction == "mean":  # in the same units as the scores
                distances = [
                    distance / weight_per_feature(matcher.metric, len(layer.features))
                    for distance, layer in zip(distances, route.plan, strict=True)
                ]
            parts["phase"] = phase_cross_entropy(distances, route.plan, right, temperature)
        if self.periodicity:
            known = right[:, 0] >= 0
            tried = [Fraction(period).limit_denominator(1000) for period in self.candidates or ()]
            periods = tried or [layer.period for layer in route.plan]
            phases = None if tried else [layer.phases for layer in route.plan]
            frames = right[known, 0]
            parts["periodicity"] = periodicity_loss(features[known], frames, periods, phases=phases)
        if self.decorrelation:
            groups = [features.index_select(1, index) for index in route.layer_features()]
            parts["decorrelation"] = decorrelation_loss(groups)
        if self.support:
            pairs = aliased_pairs(route.places, PAIRS, tolerance).to(features.device)
            parts["support"] = support_loss(route.blocks(), route.plan, pairs, self.margin)
        total = torch.stack([self.weights[name] * part for name, part in parts.items() if self.weights[name]])
        return Losses(total.sum(), parts, found.left_out)
