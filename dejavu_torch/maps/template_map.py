"""The paper's kind of map: layers of phase templates, and their scores (section III, eq. 3, eq. 4)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from functools import reduce
from itertools import accumulate, groupby, pairwise
from operator import attrgetter
from typing import Literal

import torch
from torch import Tensor, nn

from dejavu_torch.maps.distance import Metric, phase_distances
from dejavu_torch.maps.place_map import Mapper, PlaceMap, one_of, require
from dejavu_torch.maps.summary import ChunkSummary, MapSummary
from dejavu_torch.maps.templates import PhaseTemplates, check_plan
from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.text import settings_of
from dejavu_torch.types import Facts, FrequencyLayer, InputError, Plan, check_shape, expect

Reduction = Literal["mean", "sum"]
MAX_PLACES = 2**26  # in all layers, since a file of a few bytes can claim any number


def segments(plan: Plan, places: int) -> Iterator[tuple[int, int, tuple[int, ...]]]:
    """Places [start, stop) that the same layers cover, and the indices of these layers, L of eq. 4."""
    cuts = sorted({0, places, *(layer.start for layer in plan), *(layer.stop for layer in plan)})
    for start, stop in pairwise(cuts):
        yield start, stop, tuple(j for j, layer in enumerate(plan) if layer.start <= start < layer.stop)


def weight_per_feature(metric: Metric, features: int) -> float:
    """How a layer's distance grows with its features: linearly for l1, by the root for l2, not for cosine."""
    return {"l1": features, "l2": math.sqrt(features), "cosine": 1.0}[metric]


def log_posterior(scores: Tensor, temperature: float | Tensor) -> Tensor:
    """Negative log posterior of each place in nats, -log softmax(-S / T): (..., N) -> (..., N).

    Lower is better. Scores of different queries become comparable: a shift of S at all places cancels.
    +inf stays +inf.

    Example:
        >>> log_posterior(torch.tensor([[0.0, 0.0, torch.inf]]), 0.1).tolist()
        [[0.6931471824645996, 0.6931471824645996, inf]]
    """
    uncovered = scores.isinf()
    reachable = ~uncovered.all(-1, keepdim=True)
    # +inf / T would have a gradient of NaN
    logits = (-scores.masked_fill(uncovered, 0) / temperature).masked_fill(uncovered & reachable, -math.inf)
    return -logits.log_softmax(-1).masked_fill(uncovered, -math.inf)


class TemplateMap(PlaceMap):
    """A route in sum(P x F) template numbers instead of N x D, and the L1 matcher of section III-B.

    Buffers, the tensors of a file:
        layers: (L,5) int64, period numerator, period denominator, phases, start, stop.
        feature_ptr, feature_index: (L+1,) int64, the start of each layer's features in (sum F,) int32.
        templates: (sum P x F,) float, row-major (P,F) blocks in the order of the layers.
        weights: (D,) float, the factor of each feature's difference in eq. 3; (0,) for 1.

    Args:
        plan, templates: the layers, and a tensor (P,F) for each, from `PhaseTemplates`.
        places, dimension: N, and D features per frame.
        metric: distance of eq. 3, see `phase_distances`.
        reduction: "sum" is eq. 4 as printed; "mean" divides it by the features in the sum (l2: their roots,
            cosine: the layers), to compare places of any coverage.
        temperature: T, makes scores the `log_posterior`; None leaves S unchanged.
        weights: see above; None for 1.

    Shape: scores: query features (Q,D) -> (Q,N), lower is better, uncovered +inf.

    Convention: L in eq. 4 is the set of layers whose chunk contains i. Templates are means of `weighted`
        features: |w H - w mu| = w |H - mu|. Gradients reach the queries and the templates.

    Raises:
        InputError: unknown or inconsistent arguments; scores: features of another dimension.

    Example:
        >>> plan = (FrequencyLayer(2, 2, 0, 3, (0,)),)
        >>> route = TemplateMap(plan, [torch.tensor([[1.0], [5.0]])], places=4, dimension=1)
        >>> route.scores(torch.tensor([[2.0]]))
        tensor([[1., 3., 1., inf]])
    """

    kind = "templates"

    layers: Tensor
    feature_ptr: Tensor
    feature_index: Tensor
    templates: Tensor
    weights: Tensor
    lap_phases: Tensor  # for each layer, the phases of its first places, until they repeat

    def __init__(
        self,
        plan: Plan = (),
        templates: Sequence[Tensor] = (),
        places: int = 0,
        dimension: int = 0,
        metric: Metric = "l1",
        reduction: Reduction = "mean",
        temperature: float | None = None,
        weights: Tensor | None = None,
    ) -> None:
        super().__init__(places, dimension)
        self.metric: Metric = one_of(metric, Metric, "metric")
        self.reduction: Reduction = one_of(reduction, Reduction, "reduction")
        self.temperature = temperature
        for layer, block in zip(plan, templates, strict=True):
            shape = layer.phases, len(layer.features)
            expect(block.shape == shape, f"(P,F) = {shape}", f"templates of a layer are {tuple(block.shape)}")
        rows = [(*layer.period.as_integer_ratio(), layer.phases, layer.start, layer.stop) for layer in plan]
        index = [feature for layer in plan for feature in layer.features]
        pointer = [0, *accumulate(len(layer.features) for layer in plan)]
        numbers = torch.cat([block.flatten() for block in templates]) if plan else torch.zeros(0).float()
        self.register_buffer("layers", torch.tensor(rows, dtype=torch.int64).reshape(-1, 5))
        self.register_buffer("feature_ptr", torch.tensor(pointer))
        self.register_buffer("feature_index", torch.tensor(index, dtype=torch.int32))
        self.register_buffer("templates", numbers)
        self.register_buffer("weights", (torch.zeros(0) if weights is None else weights).float())
        self.register_buffer("lap_phases", torch.zeros(0, dtype=torch.int64), persistent=False)
        self.to(numbers.device)
        self.check()
        self.loaded()

    def loaded(self) -> None:
        """Derive the plan, its segments and the phases of each layer from the buffers."""
        index = self.feature_index.split(self.feature_ptr.diff().tolist())
        self.plan: Plan = tuple(
            FrequencyLayer(Fraction(a, b), phases, start, stop, tuple(features.tolist()))
            for (a, b, phases, start, stop), features in zip(self.layers.tolist(), index, strict=True)
        )
        check_plan(self.plan, self.places, self.dimension)
        covered = sum(layer.stop - layer.start for layer in self.plan)
        seen = f"a map of {self.places} places, {covered} in all layers"
        expect(max(self.places, covered) <= MAX_PLACES, f"at most {MAX_PLACES}", seen)
        # the numerator of the period is the number of places after which phases repeat
        self.laps = [min(layer.period.numerator, layer.stop - layer.start) for layer in self.plan]
        pairs = zip(self.plan, self.laps, strict=True)
        phases = [layer.phase(torch.arange(layer.start, layer.start + lap)) for layer, lap in pairs]
        self.lap_phases = torch.cat([torch.zeros(0, dtype=torch.int64), *phases]).to(self.layers.device)
        self.segments = tuple(segments(self.plan, self.places))

    def check(self) -> None:
        numbers = int((self.layers[:, 2] * self.feature_ptr.diff()).sum())
        for name, lengths in (("templates", [numbers]), ("weights", [self.dimension, 0])):
            seen, expected = getattr(self, name), " or ".join(f"({n},)" for n in lengths)
            require(len(seen) in lengths, f"{name} {tuple(seen.shape)}; expected {expected}")
            require(bool(seen.isfinite().all()), f"{name} that are not finite floats")
        T = self.temperature
        fits = T is None or (isinstance(T, (int, float)) and 0 < T < math.inf)
        require(fits, f"the temperature is {T!r}; expected a number above 0")
        super().check()

    def settings(self) -> Facts:
        return {"metric": self.metric, "reduction": self.reduction}

    def get_extra_state(self) -> Facts:
        return super().get_extra_state() | {"temperature": self.temperature}

    def set_extra_state(self, state: Facts) -> None:
        super().set_extra_state(state)
        self.temperature = state.get("temperature")

    def blocks(self) -> list[Tensor]:
        """Templates of each layer, (P,F) views of the flat buffer."""
        parts = self.templates.split([layer.phases * len(layer.features) for layer in self.plan])
        return [part.view(layer.phases, -1) for part, layer in zip(parts, self.plan, strict=True)]

    def layer_features(self) -> list[Tensor]:
        """Feature indices of each layer, (F,) int32."""
        return list(self.feature_index.split([len(layer.features) for layer in self.plan]))

    def weighted(self, features: Tensor) -> Tensor:
        """Features times `weights`, for templates and for queries: (n,D) -> (n,D)."""
        return features * self.weights if len(self.weights) else features

    def distances(self, queries: Tensor, layers: Sequence[int] | None = None) -> list[Tensor]:
        """Eq. 3 for every layer, or for some by their indices in the plan: (Q,D) -> L tensors (Q,P)."""
        self.check_queries(queries)
        queries, features, blocks = self.weighted(queries), self.layer_features(), self.blocks()
        return [
            phase_distances(queries.index_select(1, features[j]), blocks[j], self.metric)
            for j in (range(len(blocks)) if layers is None else layers)
        ]

    def divisor(self, layers: Sequence[int]) -> float:
        """The number by which S divides the sum of the distances of these layers."""
        if self.reduction == "sum":
            return 1.0
        return sum(weight_per_feature(self.metric, len(self.plan[j].features)) for j in layers)

    def combine(self, distances: Sequence[Tensor]) -> Tensor:
        """S of all places (eq. 4), +inf if uncovered: L tensors (Q,P) -> (Q,N)."""
        laps, parts = self.lap_phases.split(self.laps), []
        for start, stop, layers in self.segments:
            if layers:
                count, plan = stop - start, self.plan
                rows = (_at_places(distances[j], laps[j], start - plan[j].start, count) for j in layers)
                parts.append(reduce(torch.add, rows) / self.divisor(layers))
            else:
                parts.append(torch.full_like(distances[0][:, :1], math.inf).expand(-1, stop - start))
        return torch.cat(parts, 1) if parts else distances[0][:, :0]

    def scores(self, queries: Tensor) -> Tensor:
        """S(i) of all places (eq. 3, eq. 4): (Q,D) -> (Q,N)."""
        distances = self.distances(queries)
        if distances:
            scores = self.combine(distances)
        else:
            dtype = torch.promote_types(queries.dtype, torch.float32)
            scores = queries.new_full((queries.shape[0], self.places), math.inf, dtype=dtype)
        return scores if self.temperature is None else log_posterior(scores, self.temperature)

    @property
    def block_places(self) -> int:
        return self.places * max([1, *(len(layers) for _, _, layers in self.segments)])

    def trainable(self, templates: bool = True, weights: bool = False, start: Tensor | None = None) -> None:
        """Turn the templates, the weights, or both, into parameters, until `freeze`; `start`: (D,) initial
        weights if the map has none, None or (0,) for 1."""
        self.freeze()
        if weights and not len(self.weights):
            initial = self.templates.new_ones(self.dimension)
            if start is not None and len(start):
                check_shape(start, str(len(initial)), "the weights start as")
                initial = start.detach().clone()
            self.templates, self.weights = self._times(initial), initial
        for name, wanted in (("templates", templates), ("weights", weights)):
            if wanted:
                setattr(self, name, nn.Parameter(getattr(self, name).detach().clone()))

    def freeze(self) -> None:
        """Turn parameters into buffers; negative weights change sign, since |w H - mu| = |-w H + mu|."""
        for name, parameter in list(self.named_parameters()):
            delattr(self, name)
            self.register_buffer(name, parameter.detach().clone())
        if (self.weights < 0).any():
            self.templates = self._times(torch.where(self.weights < 0, -1, 1))
            self.weights = self.weights.abs()
        self.check()

    def _times(self, factors: Tensor) -> Tensor:
        """The flat templates, each feature times its factor (D,)."""
        pairs = zip(self.blocks(), self.layer_features(), strict=True)
        return torch.cat([self.templates[:0], *((block * factors[f]).flatten() for block, f in pairs)])

    def summary(self) -> MapSummary:
        span = attrgetter("start", "stop")
        chunks = tuple(
            ChunkSummary(*where, *zip(*((layer.period, len(layer.features)) for layer in group), strict=True))
            for where, group in groupby(sorted(self.plan, key=span), span)
        )
        covered = sum(stop - start for start, stop, layers in self.segments if layers)
        parts = {"templates": self.templates, "weights": self.weights, "positions": self.positions}
        route = {name: tensor.nbytes for name, tensor in parts.items() if len(tensor)}
        route["layers"] = self.layers.nbytes + self.feature_ptr.nbytes + self.feature_index.nbytes
        phases = sum(layer.phases for layer in self.plan)
        return MapSummary(self.kind, self.places, covered, phases, len(self.templates), chunks, route, {})

    def extra_repr(self) -> str:
        sizes = f"places={self.places}, dimension={self.dimension}, layers={len(self.plan)}"
        return f"{sizes}, template_numbers={self.templates.numel()}, metric={self.metric!r}"


def _at_places(distances: Tensor, lap: Tensor, first: int, count: int) -> Tensor:
    """Distances of a layer at `count` of its places, whose phases repeat after a lap: (Q,P) -> (Q,count)."""
    first %= len(lap)
    if first + count <= len(lap):
        return distances.index_select(1, lap[first : first + count])
    lap = lap.roll(-first) if first else lap
    return distances.index_select(1, lap).repeat(1, -(-count // len(lap)))[:, :count]


class TemplateMapper(Mapper):
    """The paper's mapper (section III-A): layers of features that repeat, and a template for each phase.

    Args:
        periods: finds the layers, without gradient; None is `SpectrogramAnalysis` with its defaults.
        metric, reduction, temperature: of the maps, see `TemplateMap`.
        trainable: whether templates are nn.Parameters, to fine-tune, instead of buffers.

    Shape: features (N,D) -> TemplateMap of N places; if nothing repeats, all places score +inf.

    Raises:
        InputError: see `TemplateMap` and `periods`.

    Example:
        >>> wave = torch.arange(64)[:, None] % torch.tensor([8.0, 9.0])  # two features that repeat
        >>> TemplateMapper(SpectrogramAnalysis(window=64, strongest=1))(wave).scores(wave[20:21]).argmin()
        tensor(20)
    """

    kind = TemplateMap.kind

    def __init__(
        self,
        periods: PeriodFinder | None = None,
        metric: Metric = "l1",
        reduction: Reduction = "mean",
        temperature: float | None = None,
        trainable: bool = False,
    ) -> None:
        super().__init__()
        expect(isinstance(periods, PeriodFinder | None), "a PeriodFinder", periods=type(periods))
        self.trainable = trainable
        self.periods: PeriodFinder | None = SpectrogramAnalysis() if periods is None else periods
        self.metric, self.reduction, self.temperature = metric, reduction, temperature
        self.templates = PhaseTemplates()
        self.empty()  # checks the settings

    def forward(self, features: Tensor) -> TemplateMap:
        if self.periods is None:  # from a map file
            raise InputError("the map's period finder is not of this package; learn anew by a mapper with it")
        plan = self.periods.plan(features)
        return self._map(plan, self.templates(features, plan), *features.shape).to(features.device)

    def empty(self) -> TemplateMap:
        return self._map((), (), 0, 0)

    def _map(self, plan: Plan, templates: Sequence[Tensor], places: int, dimension: int) -> TemplateMap:
        settings = self.metric, self.reduction, self.temperature
        route = TemplateMap(plan, templates, places, dimension, *settings)
        if self.trainable:
            route.trainable()
        return route

    def extra_repr(self) -> str:
        return settings_of(self, "periods", "trainable")
