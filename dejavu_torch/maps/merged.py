"""The map of several routes: the maps of each, one behind the other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate, tee
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn

from dejavu_torch.data.files import LARGEST
from dejavu_torch.maps.file import checked
from dejavu_torch.maps.place_map import EXTRA, Mapper, PlaceMap, Route
from dejavu_torch.maps.spectral import SpectralMap, SpectralState
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.types import InputError, SequenceModel


class MergedState(NamedTuple):
    """What the header of a map file says of a merged map: names of its routes, and the state of each map."""

    kind: Literal["merged"]
    places: int
    dimension: int
    names: tuple[str, ...]
    parts: tuple[dict[str, Any], ...]


class MergedMap(PlaceMap):
    """Maps of several routes as one: each scores as it does by itself, at its own mean, step and chunks.

    Args:
        parts: the map of each route, of one dimension and metric.
        names: of the routes, no two alike.

    Shape: scores: descriptors (Q,K) -> (Q,N) of the places of all routes, one behind the other.

    Convention: a sequence along trajectories, as of `SequenceMatcher`, does not run from one route into the
        next; a `PlaceFilter` can, where it moves past the last place of one.

    Raises:
        InputError: parts or names that do not fit together.

    Example:
        >>> from dejavu_torch import SpectralMapper
        >>> waves = torch.sin(torch.arange(400.0)[:, None] * torch.tensor([0.1, 0.23, 0.37])).split(200)
        >>> route = MergedMap([SpectralMapper()(wave) for wave in waves], ["out", "back"])
        >>> place = route.scores(waves[1][20:21]).argmin(1)
        >>> place, route.routes[route.route_of(place)].name, route.own_frame_of(place)
        (tensor([220]), 'back', tensor([20]))
    """

    kind = "merged"
    state = MergedState

    def __init__(self, parts: Sequence[SpectralMap] = (), names: Sequence[str] = ()) -> None:
        super().__init__()
        self.register_buffer("positions", torch.zeros(0), persistent=False)  # the parts have theirs
        self._take(list(parts), tuple(names))

    def _take(self, parts: list[SpectralMap], names: tuple[str, ...]) -> None:
        """Be the map of these, if they fit together."""
        problem = _disagreement(parts, names)
        if problem:
            raise InputError(f"the map does not fit together: {problem}")
        self.parts, self.names = nn.ModuleList(parts), names
        self.places = sum(part.places for part in parts)
        self.dimension = parts[0].dimension if parts else 0
        self.loaded()

    def loaded(self) -> None:
        self.routes = tuple(
            Route(name, part.places, len(part.positions) or part.places)
            for name, part in zip(self.names, self._parts, strict=True)
        )
        moved = [  # in double: of many routes float32 would lose places
            part.positions.double().clamp(min=0) + start
            for start, part in zip(self._starts, self._parts, strict=False)
            if len(part.positions)
        ]
        if moved:
            self.positions = torch.cat(moved)
        if self.parts:
            self.count_visits(torch.cat([part.visit_counts for part in self._parts]))

    @property
    def _parts(self) -> list[SpectralMap]:
        return list(self.parts)  # type: ignore[arg-type]

    @property
    def _starts(self) -> list[int]:
        """The first place of each part, and the number of places."""
        return list(accumulate((part.places for part in self._parts), initial=0))

    def part(self, name: str) -> SpectralMap:
        """The map of one route.

        Raises:
            InputError: there is no such route.
        """
        if name not in self.names:
            raise InputError(f"there is no route {name!r}; expected one of {', '.join(self.names)}")
        return self._parts[self.names.index(name)]

    def scores(self, queries: Tensor) -> Tensor:
        """Scores of all places: (Q,K) -> (Q,N)."""
        return self.scores_between(queries, 0, self.places)

    def scores_between(self, queries: Tensor, start: int, stop: int) -> Tensor:
        """See `PlaceMap`: from the parts that hold these places."""
        found = [scores for _, scores in self.score_blocks(queries, start, stop)]
        return torch.cat(found, 1) if found else queries.new_zeros(len(queries), 0)

    def score_blocks(
        self, queries: Tensor, start: int = 0, stop: int | None = None
    ) -> Iterator[tuple[int, Tensor]]:
        """See `PlaceMap`: the blocks of each part."""
        stop = self.places if stop is None else stop
        for first, part in zip(self._starts, self._parts, strict=False):
            if start < first + part.places and stop > first:
                own = max(0, start - first), min(part.places, stop - first)
                for begins, scores in part.score_blocks(queries, *own):
                    yield first + begins, scores

    @property
    def block_places(self) -> int:
        return max((part.block_places for part in self._parts), default=1)

    def sequences(self, batches: Iterable[Tensor], sequence: SequenceModel) -> Iterator[Tensor]:
        """See `PlaceMap`: along trajectories, route by route."""
        if not sequence.shifts:
            yield from super().sequences(batches, sequence)
            return
        each = zip(self._parts, tee(batches, len(self.parts)), strict=True)  # in step: a batch is held
        for found in zip(*(part.sequences(one, sequence) for part, one in each), strict=True):
            yield torch.cat(found, 1)

    def settings(self) -> dict[str, Any]:
        return {}

    def disagreement(self) -> str:
        return _disagreement(self._parts, self.names)

    def summary(self) -> MapSummary:
        """The summaries of the parts together."""
        parts = [part.summary() for part in self._parts]
        chunks = tuple(
            chunk._replace(start=chunk.start + first, stop=chunk.stop + first)
            for first, part in zip(self._starts, parts, strict=False)
            for chunk in part.chunks
        )
        names = dict.fromkeys(name for part in parts for name in part.route)
        route = {name: sum(part.route.get(name, 0) for part in parts) for name in names}
        covered, lines = (sum(getattr(part, name) for part in parts) for name in ("covered", "lines"))
        return MapSummary(self.kind, self.places, covered, 0, 0, chunks, route, {}, lines)

    def packed(self) -> dict[str, Tensor]:
        """As `PlaceMap.packed`, of each part under its number."""
        return {
            f"parts.{i}.{name}": tensor
            for i, part in enumerate(self._parts)
            for name, tensor in part.packed().items()
        }

    def load_packed(self, tensors: dict[str, Tensor], extra: dict[str, Any]) -> None:
        """See `PlaceMap`."""
        names, parts = _empty_parts(extra)
        taken: set[str] = set()
        for i, (part, state) in enumerate(zip(parts, extra["parts"], strict=True)):
            own = _below(tensors, f"parts.{i}.")
            part.load_packed(own, state)
            taken |= {f"parts.{i}.{name}" for name in own}
        if tensors.keys() - taken:
            raise InputError(f"it holds {', '.join(sorted(tensors.keys() - taken))} of no route")
        self._fill(parts, names, extra)

    def _fill(self, parts: list[SpectralMap], names: tuple[str, ...], extra: dict[str, Any]) -> None:
        sizes = sum(part.places for part in parts), parts[0].dimension if parts else 0
        if sizes != (extra["places"], extra["dimension"]):
            claimed = f"{extra['places']} places of {extra['dimension']} features"
            raise InputError(f"the map claims {claimed}; expected its parts' {sizes[0]} of {sizes[1]}")
        self._take([part.to(self.positions.device) for part in parts], names)

    def get_extra_state(self) -> dict[str, Any]:
        parts = [part.get_extra_state() for part in self._parts]
        return {**super().get_extra_state(), "names": list(self.names), "parts": parts}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        if state != self.get_extra_state():  # with its parts, by `_load_from_state_dict`
            raise InputError("the state of a merged map is of other routes; expected to load all of it")

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        if prefix + EXTRA in state_dict:  # the parts are made before torch fills them, and stay if it cannot
            extra = state_dict[prefix + EXTRA]
            names, parts = _empty_parts(extra)
            for i, part in enumerate(parts):
                part.load_state_dict(_below(state_dict, f"{prefix}parts.{i}."))
            self._fill(parts, names, extra)
        super()._load_from_state_dict(state_dict, prefix, *args)

    def extra_repr(self) -> str:
        return f"places={self.places}, dimension={self.dimension}, names={list(self.names)}"


class MergedMapper(Mapper):
    """Stands for the maps that a merged map was made of, in its file; it makes none itself.

    Raises:
        InputError: forward: whatever it is given.
    """

    kind = MergedMap.kind
    whitens = True

    def __init__(self) -> None:
        super().__init__()

    def forward(self, features: Tensor) -> MergedMap:
        raise InputError("a merged map is made of maps; expected to learn each route, and to merge them")

    def empty(self) -> MergedMap:
        return MergedMap()


def _empty_parts(extra: Any) -> tuple[tuple[str, ...], list[SpectralMap]]:
    """Names and maps without places, that can receive those of a merged map of this state."""
    state = checked(extra, MergedState, "the map's state")
    kinds = [checked(part, SpectralState, f"the map's part {i}") for i, part in enumerate(state.parts)]
    if max(state.places, state.dimension) >= LARGEST:
        raise InputError(f"the map has {state.places} places; expected fewer")
    return state.names, [
        SpectralMap(metric=one.metric, transform=one.transform, chunk=one.chunk, resolution=one.resolution)
        for one in kinds
    ]


def _below(state: dict[str, Any], prefix: str) -> dict[str, Any]:
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def _disagreement(parts: Sequence[SpectralMap], names: Sequence[str]) -> str:
    """What of several maps does not fit the others, in words; empty where all fit."""
    if len(names) != len(parts) or len({*names}) != len(names) or not all(names):
        return (
            f"names {', '.join(names) or 'of nothing'}; expected another one for each of {len(parts)} routes"
        )
    for what, seen in (
        ("metric", [part.metric for part in parts]),
        ("dimension", [part.dimension for part in parts]),
        ("even steps", [len(part.positions) > 0 for part in parts]),
    ):
        other = next((name for name, one in zip(names, seen, strict=True) if one != seen[0]), None)
        if other is not None:
            return f"{what} of {other}: {seen[names.index(other)]}; expected {seen[0]}, as of {names[0]}"
    return ""
