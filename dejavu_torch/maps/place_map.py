"""What every kind of map offers, and what makes one from descriptors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from dejavu_torch.data.files import LARGEST
from dejavu_torch.data.positions import borders, count_places, look_up, place_of, shown_frames
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.types import InputError

EXTRA = "_extra_state"  # where torch keeps what `get_extra_state` gives


class Route(NamedTuple):
    """A route of a map that has several: its name, and how many places and frames."""

    name: str
    places: int
    frames: int


class PlaceMap(nn.Module, ABC):
    """A route in a form that scores: the seam between how a map is made and how places are found on it.

    A new kind of map subclasses it and implements `scores`, `settings`, `summary` and `disagreement`; a
    `Mapper` makes it from descriptors.

    Attributes:
        kind: a name of the kind, stored with the map.
        state: type of what `get_extra_state` gives, by which a file is checked: a NamedTuple of its entries.
        places: N, the number of places. dimension: D, features per frame. Plain ints.
        positions: (F,) float32, how many even steps each reference frame lies from the first place, where
            frames were resampled (section IV-B); (0,) where place i is reference frame i. Of a merged map
            float64.
        visits: (V,2) int32, runs of places and how many visits each of these is the mean of; (0,2) where all
            are of one.
        routes: of a merged map, in order; () for one route. Places and frames then count through all of them,
            and `route_of` and `own_frame_of` tell the route of a place and the frame of that route.

    Shape: queries (Q,D) -> scores (Q,N), lower is better, +inf where nothing covers a place.

    Convention: the state is whole: everything that changes a score is in `state_dict`, settings included,
        and a state of another kind or of other settings is refused. Loading takes the shapes of what is
        loaded, so an empty map of the same settings can receive any map.
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
        """As `scores_between`, a block of places behind the other: the first place and (Q,n) scores of each.

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

    def extend(self, features: Tensor) -> None:
        """Add the places of (n,D) features behind the last one.

        Raises:
            InputError: a kind of map that cannot grow.
        """
        raise InputError(f"a map of kind {self.kind!r} cannot be extended; expected to learn the route anew")

    def frame_of(self, places: Tensor) -> Tensor:
        """The reference frame that each place shows; -1, no place, stays -1. int64 of any shape."""
        return look_up(shown_frames(self.positions), places) if len(self.positions) else places

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

    def route_of(self, places: Tensor) -> Tensor:
        """The number of the route that each place is on; -1, no place, stays -1. int64 of any shape."""
        ends = torch.tensor([route.places for route in self.routes], device=places.device).cumsum(0)
        return torch.where(places >= 0, torch.searchsorted(ends, places.contiguous(), right=True), -1)

    def own_frame_of(self, places: Tensor) -> Tensor:
        """As `frame_of`, each frame counted on its own route. int64 of any shape."""
        counts = torch.tensor([0, *(route.frames for route in self.routes)], device=places.device)
        ahead = look_up(counts.cumsum(0), self.route_of(places))
        return torch.where(places >= 0, self.frame_of(places) - ahead, -1)

    def place_of(self, frames: Tensor) -> Tensor:
        """The place nearest to each reference frame; -1 for one behind the first place, and for -1.

        Shape: int64 of any shape.

        Raises:
            InputError: a frame that the reference does not have.
        """
        count = len(self.positions) or self.places
        if frames.numel() and int(frames.max()) >= count:
            raise InputError(
                f"frame {int(frames.max())} of the reference; expected frames from 0 to {count - 1}"
            )
        return place_of(self.positions, frames) if len(self.positions) else frames

    def scored(self, places: Tensor) -> Tensor:
        """Of the places that show one frame, the one nearest to it: what a ground truth in frames counts."""
        return self.place_of(self.frame_of(places))

    @property
    def borders(self) -> Tensor:
        """(N+1,) int64, the reference frame with which each place begins, and the number of frames."""
        return borders(self.positions) if len(self.positions) else torch.arange(self.places + 1)

    def check(self) -> None:
        """Refuse buffers that do not fit together.

        Raises:
            InputError: naming the first disagreement.
        """
        problem = self.disagreement()
        positions = self.positions
        if not problem and not (
            positions.ndim == 1 and positions.is_floating_point() and positions.isfinite().all()
        ):
            problem = f"positions {tuple(positions.shape)} {positions.dtype}; expected finite floats (F,)"
        visits = self.visits
        if not problem and (
            visits.shape[1:] != (2,) or visits.dtype != torch.int32 or bool((visits < 1).any())
        ):
            problem = f"visits {tuple(visits.shape)} {visits.dtype}; expected int32 (V,2) of at least 1"
        if not problem and len(visits) and int(visits[:, 0].sum()) != self.places:
            problem = f"visits of {int(visits[:, 0].sum())} places; expected {self.places}"
        if not problem and len(positions) and count_places(positions) != self.places:
            problem = f"positions of {count_places(positions)} places; expected {self.places}"
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
        before = self.get_extra_state(), dict(self._buffers), dict(self._parameters)
        try:
            if prefix + EXTRA in state_dict:  # before any tensor is touched
                self.set_extra_state(state_dict[prefix + EXTRA])
                if "visits" not in self._non_persistent_buffers_set:
                    state_dict.setdefault(f"{prefix}visits", self.visits[:0])
            self._take_shapes(state_dict, prefix)
            super()._load_from_state_dict(state_dict, prefix, *args)
            self.loaded()
            self.check()
        except InputError:  # a state that is refused leaves the map as it was
            extra, self._buffers, self._parameters = before
            self.set_extra_state(extra)
            self.loaded()
            raise

    def _take_shapes(self, state_dict: dict[str, Any], prefix: str) -> None:
        """Make room for what is loaded; a parameter that holds something keeps its shape."""
        for name, own in [*self.named_buffers(recurse=False), *self.named_parameters(recurse=False)]:
            trained = isinstance(own, nn.Parameter)
            if prefix + name in state_dict and not (trained and own.numel()):
                new = torch.empty_like(state_dict[prefix + name], device=own.device)
                setattr(self, name, nn.Parameter(new) if trained else new)

    def packed(self) -> dict[str, Tensor]:
        """The tensors that a file holds of the map; a kind that compresses them says how."""
        kept = {name: value for name, value in self.state_dict().items() if isinstance(value, Tensor)}
        return kept if len(self.visits) else {k: v for k, v in kept.items() if k != "visits"}

    def unpacked(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """The state's tensors, from what `packed` gave.

        Raises:
            InputError: tensors that do not fit together.
        """
        return tensors

    def load_packed(self, tensors: dict[str, Tensor], extra: dict[str, Any]) -> None:
        """Load what `packed` and `get_extra_state` gave.

        Raises:
            InputError: tensors or a state that do not fit.
        """
        state = {**self.unpacked(tensors), EXTRA: extra}
        missing = self.state_dict().keys() - state.keys() - {"visits"}
        if missing:
            raise InputError(f"it does not hold the map's {', '.join(sorted(missing))}")
        self.load_state_dict(state)

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

    def beside(self, taken: int, ready: bool = False) -> Mapper:
        """The mapper that leaves room for so many bytes, which a file holds of the places beside the map.

        Args:
            ready: whether the descriptors are of ready features, not of frames.

        A mapper without a budget is itself.
        """
        return self
