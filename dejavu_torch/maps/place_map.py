"""What every kind of map offers, and what makes one from descriptors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from dejavu_torch.data.files import LARGEST
from dejavu_torch.data.positions import count_places
from dejavu_torch.maps.frame_table import FrameTable, Route
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.types import InputError

EXTRA = "_extra_state"  # where torch keeps what `get_extra_state` gives
OPTIONAL = ("visits",)  # left out of a file if empty


class PlaceMap(nn.Module, ABC):
    """A route in a form that scores: the seam between how a map is made and how places are found on it.

    A new kind of map subclasses it and implements `scores`, `settings`, `summary` and `disagreement`; a
    `Mapper` makes it from descriptors.

    Attributes:
        kind: a name of the kind, stored with the map.
        state: type of what `get_extra_state` gives, by which a file is checked: a NamedTuple of its entries.
        places: N, the number of places. dimension: D, features per frame. Plain ints.
        positions: (F,) float32, how many even steps each reference frame lies from the first place of its
            route, where frames were resampled (section IV-B); (0,) where place i is reference frame i.
        visits: (V,2) int32, runs of places and how many visits each of these is the mean of; (0,2) where all
            are of one.
        routes: of a merged map, in order; () for one route. Places and frames then count through all of them.

    Shape: queries (Q,D) -> scores (Q,N), lower is better, +inf where nothing covers a place.

    Convention: the state is whole: everything that changes a score is in `state_dict`, settings included,
        and a state of another kind or of other settings is refused. Its tensors are those of a file. Loading
        takes the shapes of what is loaded, so an empty map of the same settings can receive any map.
    """

    kind: ClassVar[str]
    state: ClassVar[Any] = dict[str, Any]
    routes: tuple[Route, ...] = ()
    positions: Tensor
    visits: Tensor

    def __init__(self, places: int = 0, dimension: int = 0) -> None:
        super().__init__()
        self.places, self.dimension = places, dimension
        self.register_buffer("positions", torch.zeros(0))
        self.register_buffer("visits", torch.zeros(0, 2, dtype=torch.int32), persistent=False)

    @abstractmethod
    def scores(self, queries: Tensor) -> Tensor:
        """Scores of all places: (Q,D) -> (Q,N), lower is better, differentiable."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """What a state must share with the map that loads it, such as the metric, as JSON values."""

    @abstractmethod
    def summary(self) -> MapSummary:
        """What the map can tell apart, and its bytes by part."""

    @abstractmethod
    def disagreement(self) -> str:
        """The first buffer that does not fit the others, in words; empty where all fit."""

    def forward(self, queries: Tensor) -> Tensor:
        return self.scores(queries)

    def scores_between(self, queries: Tensor, start: int, stop: int) -> Tensor:
        """Scores of the places [start, stop) alone: (Q,D) -> (Q,stop - start).

        Convention: those of `scores`; a kind of map may not need all places for them.
        """
        return self.scores(queries)[:, start:stop]

    def score_blocks(
        self, queries: Tensor, start: int = 0, stop: int | None = None
    ) -> Iterator[tuple[int, Tensor]]:
        """As `scores_between`, one block of places after another: the first place and (Q,n) scores of each.

        Convention: a kind of map that needs no more memory for many places yields more than one.
        """
        yield start, self.scores_between(queries, start, self.places if stop is None else stop)

    @property
    def block_places(self) -> int:
        """Numbers that the largest block of `score_blocks` holds for a query, about: one for each place."""
        return self.places

    def lowest(self, queries: Tensor) -> tuple[Tensor, Tensor] | None:
        """The lowest score of each query and its place, where that takes less than the scores of all places.

        Shape: (Q,D) -> (Q,) and (Q,) int64, -1 where no place has a finite score; None where the map has no
            such way.

        Convention: what the minimum of `scores` is, the lowest place of equal scores; no gradient.
        """
        return None

    def extend(self, chunks: Iterable[Any]) -> None:
        """Add the places of coded chunks after the last one.

        Raises:
            InputError: a kind of map that cannot grow.
        """
        raise InputError(f"a map of kind {self.kind!r} cannot be extended; expected to learn the route anew")

    @property
    def table(self) -> FrameTable:
        """Which frames and routes the places show."""
        return FrameTable(self.places, self.positions, self.routes)

    def frame_of(self, places: Tensor) -> Tensor:
        """The reference frame that each place shows; -1, no place, stays -1. int64 of any shape."""
        return self.table.frame_of(places)

    def place_of(self, frames: Tensor) -> Tensor:
        """The place nearest to each reference frame, see `FrameTable`. int64 of any shape."""
        return self.table.place_of(frames)

    @property
    def visit_counts(self) -> Tensor:
        """(N,) int64, how many visits each place is the mean of."""
        if not len(self.visits):
            return torch.ones(self.places, dtype=torch.int64, device=self.visits.device)
        runs, counts = self.visits.long().unbind(1)
        return counts.repeat_interleave(runs)

    def count_visits(self, counts: Tensor) -> None:
        """Keep how many visits each place is the mean of, (N,) int64."""
        values, runs = counts.unique_consecutive(return_counts=True)
        once = bool((values == 1).all())
        self.visits = torch.stack([runs, values], 1).int()[: 0 if once else None]

    def check(self) -> None:
        """Refuse buffers that do not fit together.

        Raises:
            InputError: naming the first disagreement.
        """
        problem, positions, visits = self.disagreement(), self.positions, self.visits
        if not problem and not (
            positions.ndim == 1 and positions.is_floating_point() and positions.isfinite().all()
        ):
            problem = f"positions {tuple(positions.shape)} {positions.dtype}; expected finite floats (F,)"
        if not problem and (
            visits.shape[1:] != (2,) or visits.dtype != torch.int32 or bool((visits < 1).any())
        ):
            problem = f"visits {tuple(visits.shape)} {visits.dtype}; expected int32 (V,2) of at least 1"
        if not problem and len(visits) and int(visits[:, 0].sum()) != self.places:
            problem = f"visits of {int(visits[:, 0].sum())} places; expected {self.places}"
        if not problem and len(positions) and count_places(self.table.steps) != self.places:
            problem = f"positions of {count_places(self.table.steps)} places; expected {self.places}"
        if problem:
            raise InputError(f"the map does not fit together: {problem}")

    def get_extra_state(self) -> dict[str, Any]:
        """What the state holds beside the tensors."""
        return {"kind": self.kind, "places": self.places, "dimension": self.dimension, **self.settings()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take over what `get_extra_state` gave.

        Raises:
            InputError: a state of another kind, or of other settings.
        """
        own = {"kind": self.kind, **self.settings()}
        if not isinstance(state, dict):
            raise InputError(f"the map's state is a {type(state).__name__}; expected its kind and settings")
        for name, value in own.items():
            if state.get(name) != value:
                raise InputError(f"the map's {name} is {state.get(name)!r}; expected {value!r}")
        sizes = state.get("places"), state.get("dimension")
        if not all(type(size) is int and 0 <= size < LARGEST for size in sizes):
            raise InputError(
                f"the map has {sizes[0]!r} places of {sizes[1]!r} features; expected whole numbers"
            )
        self.places, self.dimension = state["places"], state["dimension"]

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        if not any(name.startswith(prefix) for name in state_dict):  # of other parts of a model
            super()._load_from_state_dict(state_dict, prefix, *args)
            return
        before = self.__dict__ | {name: dict(self.__dict__[name]) for name in ("_buffers", "_parameters")}
        try:
            if prefix + EXTRA in state_dict:  # before any tensor is touched
                self.set_extra_state(state_dict[prefix + EXTRA])
                for name in OPTIONAL:
                    if name in self._buffers and name not in self._non_persistent_buffers_set:
                        state_dict.setdefault(prefix + name, getattr(self, name)[:0])
            self._take_shapes(state_dict, prefix)
            super()._load_from_state_dict(state_dict, prefix, *args)
            self.loaded()
            self.check()
        except InputError:  # a state that is refused leaves the map as it was
            self.__dict__.clear()
            self.__dict__.update(before)
            raise

    def _take_shapes(self, state_dict: dict[str, Any], prefix: str) -> None:
        """Make room for what is loaded; a parameter that holds something keeps its shape."""
        for name, own in [*self.named_buffers(recurse=False), *self.named_parameters(recurse=False)]:
            trained = isinstance(own, nn.Parameter)
            if prefix + name in state_dict and not (trained and own.numel()):
                new = torch.empty_like(state_dict[prefix + name], device=own.device)
                setattr(self, name, nn.Parameter(new) if trained else new)

    def packed(self) -> dict[str, Tensor]:
        """The tensors of a file: those of the state, without optional ones that are empty."""
        return {
            name: value
            for name, value in self.state_dict().items()
            if isinstance(value, Tensor) and (len(value) or name not in OPTIONAL)
        }

    def load_packed(self, tensors: dict[str, Tensor], extra: dict[str, Any]) -> None:
        """Load what `packed` and `get_extra_state` gave.

        Raises:
            InputError: tensors or a state that do not fit.
        """
        own = self.state_dict().keys() - {EXTRA}
        missing, unknown = own - tensors.keys() - {*OPTIONAL}, tensors.keys() - own
        if missing or unknown:
            seen = f"it does not hold the map's {', '.join(sorted(missing))}"
            raise InputError(seen if missing else f"it holds {', '.join(sorted(unknown))}, which no map has")
        self.load_state_dict({**tensors, EXTRA: extra})

    def loaded(self) -> None:
        """Called when a state was loaded: work out what follows from the buffers."""


class Mapper(nn.Module, ABC):
    """Makes a map from descriptors. Subclass it, and `PlaceMap`, to bring another kind of map.

    Attributes:
        kind: of its maps, the name that they store.
        whitens: whether it expects descriptors that are whitened, unless it is told otherwise.

    Shape: features (N,D) float -> PlaceMap of N places.
    """

    kind: ClassVar[str]
    whitens: ClassVar[bool] = False

    @abstractmethod
    def forward(self, features: Tensor) -> PlaceMap:
        """Learn a map of N places from their features (N,D)."""

    @abstractmethod
    def empty(self) -> PlaceMap:
        """A map without places, which can load any map of this mapper."""

    def with_overhead(self, overhead: int, ready: bool = False) -> Mapper:
        """The mapper that leaves room for so many bytes, which a file holds of the places beside the map.

        Args:
            ready: whether the descriptors are of ready features, not of frames.

        A mapper without a budget is itself.
        """
        return self
