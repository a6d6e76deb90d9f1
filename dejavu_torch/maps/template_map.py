"""The paper's kind of map: layers of phase templates and the scores they give (section III, eq. 3, eq. 4)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from functools import reduce
from itertools import accumulate, pairwise
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from dejavu_torch.maps.distance import Metric, check_metric, metric_name, phase_distances
from dejavu_torch.maps.layer_search import LayerSearch
from dejavu_torch.maps.place_map import Mapper, PlaceMap
from dejavu_torch.maps.summary import MapSummary, summarise
from dejavu_torch.maps.templates import PhaseTemplates
from dejavu_torch.maps.trajectories import LayerSums
from dejavu_torch.memory import check_room
from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.types import FrequencyLayer, InputError, Plan, SequenceModel

Reduction = Literal["mean", "sum"]
TRAINABLE = ("templates", "weights")
MOST_PLACES = 2**26  # in all layers: no tensor of a file is as long as the route, a few bytes can claim any
PLACE_BYTES = 16  # that a place takes while a query is scored


class TemplateState(NamedTuple):
    """What the header of a map file says of a template map; see its arguments."""

    kind: Literal["templates"]
    places: int
    dimension: int
    metric: Literal["l1", "l2", "cosine"]
    reduction: Reduction
    temperature: float | None


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


def log_posterior(scores: Tensor, temperature: float | Tensor) -> Tensor:
    """How unlikely each place is: -log softmax(-S / T) over places.

    It orders the places of a query as S does (but for rounding where T is large), and makes the scores of
    different queries comparable: S grows with everything in a frame that no template has, this only with what
    fits other places as well.

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


class TemplateMap(PlaceMap):
    """A route in sum(P x F) template numbers instead of N x D, and the L1 matcher of section III-B.

    Buffers (compressed sparse rows; their size is the storage claim):
        layers: (L,5) int64, period numerator, period denominator, phases, start, stop.
        feature_ptr: (L+1,) int64, where each layer's features begin in `feature_index`.
        feature_index: (sum F,) int32.
        templates: (sum P x F,) float, row-major (P,F) blocks in the order of the layers.
        weights: (D,) float, what a difference in each feature counts in eq. 3; (0,) where all count alike.
        positions: see `PlaceMap`.

    Args:
        plan: the layers.
        templates: one (P,F) tensor per layer, as `PhaseTemplates` gives them; they may carry gradients.
        places: N, frames of the reference traverse.
        dimension: D, features per frame.
        metric: distance of eq. 3, see `phase_distances`.
        reduction: "sum" is eq. 4 as printed. "mean" divides it by the number of features summed over (l2:
            their roots, cosine: the layers), so that places covered by many features and places covered by
            few are comparable.
        temperature: scores are those of `log_posterior`; None, the paper's letter, leaves S as it is. It is
            part of the state, not of the settings.
        weights: see above; None where all features count alike.

    Shape: scores: query features (Q,D) -> (Q,N), lower is better, uncovered +inf.

    Convention: L in eq. 4 is the set of layers whose chunk holds i. Templates are of `weighted` features:
        |w H - w mu| = w |H - mu|. Gradients reach the queries and the templates.

    Raises:
        InputError: templates that do not fit the plan, an unknown metric or reduction, a temperature of 0 or
            less; scores: features of another dimension than the map's.

    Example:
        >>> plan = (FrequencyLayer(2, 2, 0, 3, (0,)),)
        >>> route = TemplateMap(plan, [torch.tensor([[1.0], [5.0]])], places=4, dimension=1)
        >>> route.scores(torch.tensor([[2.0]]))
        tensor([[1., 3., 1., inf]])
    """

    kind = "templates"
    state = TemplateState

    layers: Tensor
    feature_ptr: Tensor
    feature_index: Tensor
    templates: Tensor
    weights: Tensor
    lap_phases: Tensor

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
        check_metric(metric)
        if reduction not in ("mean", "sum"):
            raise InputError(f"reduction {reduction!r} is unknown; expected 'mean' or 'sum'")
        self.metric, self.reduction, self.temperature = metric, reduction, temperature
        for layer, block in zip(plan, templates, strict=True):
            if tuple(block.shape) != (layer.phases, len(layer.features)):
                raise InputError(
                    f"a layer of {layer.phases} phases and {len(layer.features)} features got templates "
                    f"{tuple(block.shape)}; expected ({layer.phases}, {len(layer.features)})"
                )
        rows = [(*layer.period.as_integer_ratio(), layer.phases, layer.start, layer.stop) for layer in plan]
        index = [feature for layer in plan for feature in layer.features]
        pointer = [0, *accumulate(len(layer.features) for layer in plan)]
        self.register_buffer("layers", torch.tensor(rows, dtype=torch.int64).reshape(-1, 5))
        self.register_buffer("feature_ptr", torch.tensor(pointer))
        self.register_buffer("feature_index", torch.tensor(index, dtype=torch.int32))
        self.register_buffer(
            "templates", torch.cat([b.flatten() for b in templates]) if plan else torch.zeros(0)
        )
        self.register_buffer("weights", torch.zeros(0) if weights is None else weights.float())
        self.register_buffer("lap_phases", torch.zeros(0, dtype=torch.int64), persistent=False)
        self.to(self.templates.device)
        self.loaded()
        self.check()

    @property
    def temperature(self) -> float | None:
        """T of `log_posterior`, in units of the scores, or None."""
        return self._temperature

    @temperature.setter
    def temperature(self, value: float | None) -> None:
        if value is not None and not 0 < value < math.inf:
            raise InputError(f"the temperature is {value}; expected a number above 0")
        self._temperature = value

    def loaded(self) -> None:
        """The plan, and the phases of each layer in the order of its places, from the buffers."""
        problem = self._buffer_disagreement()
        if problem:
            raise InputError(f"the map does not fit together: {problem}")
        pointer, index = self.feature_ptr.tolist(), self.feature_index.tolist()
        self.plan: Plan = tuple(
            FrequencyLayer(Fraction(a, b), phases, start, stop, tuple(index[pointer[j] : pointer[j + 1]]))
            for j, (a, b, phases, start, stop) in enumerate(self.layers.tolist())
        )
        outside = [
            layer for layer in self.plan if layer.stop > self.places or layer.features[-1] >= self.dimension
        ]
        if outside:
            raise InputError(
                f"the map does not fit together: a layer covers [{outside[0].start}, {outside[0].stop}) and "
                f"feature {outside[0].features[-1]}; expected it inside {self.places} places of "
                f"{self.dimension} features"
            )
        covered = sum(layer.stop - layer.start for layer in self.plan)
        if max(self.places, covered) > MOST_PLACES:
            raise InputError(
                f"a map of {self.places} places, {covered} in all layers; expected at most {MOST_PLACES}"
            )
        check_room(PLACE_BYTES * self.places, f"a map of {self.places} places")
        self.segments = segments(self.plan, self.places)
        # phases repeat after as many places as the period's numerator says
        self.laps = [min(layer.period.numerator, layer.stop - layer.start) for layer in self.plan]
        check_room(PLACE_BYTES * sum(self.laps), f"the phases of {len(self.plan)} layers")
        phases = [
            layer.phase(torch.arange(layer.start, layer.start + lap))
            for layer, lap in zip(self.plan, self.laps, strict=True)
        ]
        self.lap_phases = torch.cat(phases).to(self.layers.device) if phases else self.layers.new_zeros(0)
        self._search: LayerSearch | None = None

    def settings(self) -> dict[str, Any]:
        return {"metric": metric_name(self.metric), "reduction": self.reduction}

    def get_extra_state(self) -> dict[str, Any]:
        """What the state holds beside the tensors."""
        return super().get_extra_state() | {"temperature": self.temperature}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """See `PlaceMap`; the temperature is taken over."""
        super().set_extra_state(state)
        temperature = state.get("temperature")
        if temperature is not None and not isinstance(temperature, (int, float)):
            raise InputError(f"the map's temperature is {temperature!r}; expected a number above 0 or none")
        self.temperature = temperature

    def blocks(self) -> list[Tensor]:
        """Templates of each layer, (P,F) views of the flat buffer."""
        sizes = [layer.phases * len(layer.features) for layer in self.plan]
        parts = self.templates.split(sizes) if sizes else ()
        return [part.view(layer.phases, -1) for part, layer in zip(parts, self.plan, strict=True)]

    def layer_features(self) -> list[Tensor]:
        """Feature indices of each layer, (F,) int32."""
        return (
            list(self.feature_index.split([len(layer.features) for layer in self.plan])) if self.plan else []
        )

    def weighted(self, features: Tensor) -> Tensor:
        """Features as the templates are made of and compared with: times `weights`. (n,D) -> (n,D)."""
        return features * self.weights if len(self.weights) else features

    def distances(self, queries: Tensor, layers: Sequence[int] | None = None) -> list[Tensor]:
        """Eq. 3 for every layer, or for some by their positions in the plan: (Q,D) -> L tensors (Q,P)."""
        if queries.ndim != 2 or queries.shape[1] != self.dimension:
            raise InputError(
                f"the query features are {tuple(queries.shape)}; the map expects (Q, {self.dimension})"
            )
        queries, features, blocks = self.weighted(queries), self.layer_features(), self.blocks()
        return [
            phase_distances(queries.index_select(1, features[j]), blocks[j], self.metric)
            for j in (range(len(blocks)) if layers is None else layers)
        ]

    def along(
        self, distances: Tensor, layer: int, start: int, stop: int, lap: Tensor | None = None
    ) -> Tensor:
        """The distances of a layer to the places [start, stop) that it covers: (Q,P) -> (Q,stop - start).

        Args:
            layer: its position in the plan.
            lap: the column of the distances for each place until they repeat; None is the phase.
        """
        if lap is None:
            lap = self.lap_phases.split(self.laps)[layer]
        first, count = (start - self.plan[layer].start) % len(lap), stop - start
        if first + count <= len(lap):
            return distances.index_select(1, lap[first : first + count])
        lap = torch.cat([lap[first:], lap[:first]])
        return distances.index_select(1, lap).repeat(1, -(-count // len(lap)))[:, :count]

    def added(self, members: Sequence[int], distances: Sequence[Tensor]) -> Tensor:
        """S of places (eq. 4), from the distances that the layers which cover them have there.

        Args:
            members: the layers, by their positions in the plan.

        Shape: for each a tensor (Q,n) -> (Q,n).
        """
        total: Tensor = reduce(torch.add, distances)
        if self.reduction == "mean":
            total = total / sum(weight_per_feature(self.metric, len(self.plan[j].features)) for j in members)
        return total

    def combine(
        self,
        distances: Sequence[Tensor],
        segments: Sequence[Segment] | None = None,
        laps: Sequence[Tensor] | None = None,
    ) -> Tensor:
        """S(i) from the phase distances of each layer (eq. 4): L tensors (Q,P) -> (Q,N).

        Args:
            segments: of which places, in order; None is all of them.
            laps: of each layer, see `along`.

        Convention: a place that no layer covers scores +inf.

        Raises:
            InputError: no layers.
        """
        if not distances:
            raise InputError("there are no layers to combine; expected at least one")
        if laps is None:
            laps = self.lap_phases.split(self.laps)
        parts = []
        for start, stop, members in self.segments if segments is None else segments:
            if members:
                parts.append(
                    self.added(members, [self.along(distances[j], j, start, stop, laps[j]) for j in members])
                )
            else:
                parts.append(torch.full_like(distances[0][:, :1], math.inf).expand(-1, stop - start))
        return torch.cat(parts, 1)

    def scores(self, queries: Tensor) -> Tensor:
        """S(i) of all places (eq. 3, eq. 4): (Q,D) -> (Q,N)."""
        distances = self.distances(queries)
        if not distances:
            dtype = torch.promote_types(queries.dtype, torch.float32)
            return queries.new_full((queries.shape[0], self.places), math.inf, dtype=dtype)
        scores = self.combine(distances)
        return scores if self.temperature is None else log_posterior(scores, self.temperature)

    def scores_between(self, queries: Tensor, start: int, stop: int) -> Tensor:
        """See `PlaceMap`: from the layers that cover these places."""
        inside = [segment for segment in self.segments if segment.start < stop and segment.stop > start]
        members = sorted({j for segment in inside for j in segment.layers})
        if not members or self.temperature is not None:
            return super().scores_between(queries, start, stop)
        distances = self.distances(queries, members)
        rows = [distances[0]] * len(self.plan)  # no other row is looked up
        for j, row in zip(members, distances, strict=True):
            rows[j] = row
        return self.combine(rows, inside)[:, start - inside[0].start : stop - inside[0].start]

    @torch.no_grad()
    def lowest(self, queries: Tensor) -> tuple[Tensor, Tensor] | None:
        """See `PlaceMap`; by `LayerSearch` where that is less work than the scores of all places."""
        if self.temperature is not None:
            return None
        if self._search is None or self._search.device != self.layers.device:
            self._search = LayerSearch(self)
        search = self._search
        if not search.worth:
            return None
        found = [search.lowest(self.distances(part)) for part in queries.split(search.at_once)]
        scores, places = zip(*found, strict=True)
        return torch.cat(scores), torch.cat(places)

    def sequences(self, batches: Iterable[Tensor], sequence: SequenceModel) -> Iterator[Tensor]:
        """See `PlaceMap`; mean scores along trajectories come from `LayerSums` where that is less work."""
        sums = LayerSums(self, sequence) if sequence.shifts and self.temperature is None else None
        if sums is None or not sums.worth:
            yield from super().sequences(batches, sequence)
            return
        kept = len(sequence.shifts[0]) - 1
        rows = [block.new_zeros(0, len(block)) for block in self.blocks()]
        for queries in batches:
            ahead = len(rows[0])
            rows = [torch.cat(pair) for pair in zip(rows, self.distances(queries), strict=True)]
            yield sums.scores(rows, ahead)
            rows = [row[max(0, len(row) - kept) :] for row in rows]

    def trainable(self, templates: bool = True, weights: bool = False, start: Tensor | None = None) -> None:
        """Make parameters of the templates, of the weights, or of both, until `freeze`.

        Args:
            start: (D,) the weights to begin with where the map has none; None or (0,) is 1 for every feature.

        Raises:
            InputError: a start of another shape.
        """
        self.freeze()
        if weights and not len(self.weights):
            own = self.templates.new_ones(self.dimension)
            if start is not None and len(start):
                if start.shape != own.shape:
                    raise InputError(f"the weights start as {tuple(start.shape)}; expected ({len(own)},)")
                own = start.detach().clone()
            self.templates = self._times(own)  # they are of weighted features
            self.weights = own
        for name, wanted in zip(TRAINABLE, (templates, weights), strict=True):
            if wanted:
                value = getattr(self, name).detach().clone()
                delattr(self, name)
                self.register_parameter(name, nn.Parameter(value))

    def freeze(self) -> None:
        """Make buffers of what was trained.

        Convention: |w H - mu| is the same with both signs turned, so no weight is left below 0.
        """
        for name, parameter in list(self.named_parameters()):
            delattr(self, name)
            self.register_buffer(name, parameter.detach().clone())
        if (self.weights < 0).any():
            self.templates = self._times(torch.where(self.weights < 0, -1, 1))
            self.weights = self.weights.abs()
        self.check()

    def _times(self, factors: Tensor) -> Tensor:
        """The templates, those of each feature times its factor (D,)."""
        pairs = zip(self.blocks(), self.layer_features(), strict=True)
        scaled = [(block * factors[features]).flatten() for block, features in pairs]
        return torch.cat(scaled) if scaled else self.templates

    def summary(self) -> MapSummary:
        """See `MapSummary`; the parts are those of the route."""
        parts = {"templates": self.templates, "weights": self.weights, "positions": self.positions}
        route = {name: tensor.nbytes for name, tensor in parts.items() if len(tensor)}
        route["layers"] = self.layers.nbytes + self.feature_ptr.nbytes + self.feature_index.nbytes
        return summarise(self.plan, self.places, route)

    def _buffer_disagreement(self) -> str:
        """What is wrong with the buffers that the plan is made of."""
        shapes = {"layers": "(L,5)", "feature_ptr": "(L+1,)", "feature_index": "(F,)"}
        for name, shape in shapes.items():
            buffer = getattr(self, name)
            whole = buffer.dtype in (torch.int32, torch.int64)  # what selects features
            if buffer.ndim != 1 + (name == "layers") or not whole:
                return f"{name} {tuple(buffer.shape)} {buffer.dtype}; expected {shape} int32 or int64"
        if self.layers.shape[1] != 5:
            return f"layers {tuple(self.layers.shape)}; expected (L,5)"
        pointer = self.feature_ptr.tolist()
        if len(pointer) != len(self.layers) + 1 or pointer[0] != 0 or sorted(pointer) != pointer:
            return f"feature_ptr does not rise from 0 over {len(self.layers)} layers"
        if pointer[-1] != len(self.feature_index):
            return f"{len(self.feature_index)} feature indices; expected {pointer[-1]}"
        if bool((self.layers[:, 1] < 1).any()):
            return "a period with a denominator below 1"
        return ""

    def disagreement(self) -> str:
        numbers = sum(layer.phases * len(layer.features) for layer in self.plan)
        if self.templates.ndim != 1 or len(self.templates) != numbers:
            return f"templates {tuple(self.templates.shape)}; expected ({numbers},)"
        if not self.templates.is_floating_point() or not self.templates.isfinite().all():
            return "templates that are not finite floats"
        if tuple(self.weights.shape) not in ((0,), (self.dimension,)):
            return f"weights {tuple(self.weights.shape)}; expected ({self.dimension},) or none"
        if not self.weights.is_floating_point() or not self.weights.isfinite().all():
            return "weights that are not finite floats"
        return ""

    def extra_repr(self) -> str:
        return (
            f"places={self.places}, dimension={self.dimension}, layers={len(self.plan)}, "
            f"template_numbers={self.templates.numel()}, metric={metric_name(self.metric)!r}, "
            f"reduction={self.reduction!r}, temperature={self.temperature}"
        )


class TemplateMapper(Mapper):
    """The paper's mapper (section III-A): layers of what repeats, and a template for each of their phases.

    Args:
        periods: finds the layers; None is `SpectrogramAnalysis` with its defaults.
        metric, reduction, temperature: of the maps, see `TemplateMap`.
        trainable: make the templates nn.Parameters, to be fine-tuned, instead of buffers.

    Shape: features (N,D) -> TemplateMap of N places; one without layers, on which every place scores +inf,
        where nothing repeats.

    Convention: periods are exact numbers and get no gradient; the templates do, where gradients are enabled.

    Raises:
        InputError: see `TemplateMap`, and what `periods` refuses.

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
        if periods is not None and not isinstance(periods, PeriodFinder):
            raise InputError(
                f"periods is a {type(periods).__name__}; expected a PeriodFinder such as SpectrogramAnalysis"
            )
        self.trainable = trainable
        self.periods: PeriodFinder | None = SpectrogramAnalysis() if periods is None else periods
        self.metric, self.reduction, self.temperature = metric, reduction, temperature
        self.templates = PhaseTemplates()
        self.empty()  # refuses what a map would

    def forward(self, features: Tensor) -> TemplateMap:
        if self.periods is None:  # of a map file
            raise InputError(
                "what found the map's periods is not of this package; expected a mapper with it to learn anew"
            )
        plan = self.periods.plan(features)
        return self.map_of(plan, self.templates(features, plan), *features.shape).to(features.device)

    def map_of(self, plan: Plan, templates: Sequence[Tensor], places: int, dimension: int) -> TemplateMap:
        """A map of these layers and templates with the mapper's settings."""
        settings = self.metric, self.reduction, self.temperature
        route = TemplateMap(plan, templates, places, dimension, *settings)
        if self.trainable:
            route.trainable()
        return route

    def empty(self) -> TemplateMap:
        return self.map_of((), (), 0, 0)

    def extra_repr(self) -> str:
        metric, reduction = metric_name(self.metric), self.reduction
        return f"metric={metric!r}, reduction={reduction!r}, temperature={self.temperature}"
