"""The interfaces of maps and of mappers, which make them from descriptors."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import ClassVar, TypeVar, get_args

import torch
from torch import Tensor, nn
from typing_extensions import Self

from dejavu_torch.maps.digest import BYTES
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.places.frame_table import FrameTable, Route
from dejavu_torch.places.layout import ROUTE, Layout
from dejavu_torch.places.positions import count_places
from dejavu_torch.places.states import Link
from dejavu_torch.text import one_line
from dejavu_torch.types import Facts, InputError, check_shape, expect

log = logging.getLogger("dejavu_torch")

L = TypeVar("L")

ScoreBlocks = Iterator[tuple[int, Tensor]]  # the first place of each block, and its scores (Q,n)
EXTRA = "_extra_state"  # torch's key for the result of `get_extra_state`


def require(fits: bool, seen: str) -> None:
    """Refuse a map whose buffers are inconsistent; the message says what was seen and what was expected."""
    if not fits:
        raise InputError(f"the map does not fit together: {seen}")


def one_of(value: L, kind: object, name: str) -> L:
    """A value that a Literal names, else an InputError; `name`: of the value in the message."""
    expect(value in get_args(kind), str(kind).removeprefix("typing."), f"{name} is {value!r:.60}")
    return value


class PlaceMap(nn.Module, ABC):
    """A route that scores queries. A new kind of map subclasses it; a `Mapper` makes it from descriptors.

    Attributes:
        kind: name of the kind, stored with the map.
        places, dimension: N, and D features per frame.
        positions: (F,) float32, even steps of each reference frame from the first place of its route, if
            resampled (section IV-B); (0,) if place i is reference frame i.
        visits: (V,2) int32, runs of places and the number of visits that they average; (0,2) if all are 1.
        digest: (n,9) uint8, of the descriptors of some places, see `digests_of`; (0,9) if unknown. digested:
            (n,) int64, these places.
        layout: where the places lie, stored with the map: along a route, several, or over an area. area: the
            same, None along routes. routes: of a merged map, in order, else (). Places and frames are
            numbered through all of them.

    Shape: queries (Q,D) -> scores (Q,N), lower is better, +inf for a place that nothing covers.

    Convention: everything that changes a score is in `state_dict`, settings included; a state of another kind
        or of other settings is refused. Buffers get the shapes of the loaded state.
    """

    kind: ClassVar[str]
    kept: ClassVar[tuple[str, ...]] = ("positions",)  # tensors that are always of the type of a file
    optional: ClassVar[Mapping[str, tuple[int, ...]]] = {"visits": (0, 2)}  # that files may lack
    _layout: Layout = ROUTE
    positions: Tensor
    visits: Tensor
    digest: Tensor

    def __init__(self, places: int = 0, dimension: int = 0) -> None:
        super().__init__()
        self.places, self.dimension = places, dimension
        self.register_buffer("positions", torch.zeros(0).float())
        self.register_buffer("visits", torch.zeros(0, 2, dtype=torch.int32), persistent=False)
        self.register_buffer("digest", torch.zeros(0, BYTES, dtype=torch.uint8), persistent=False)
        self.digested = torch.zeros(0, dtype=torch.int64)

    @abstractmethod
    def scores(self, queries: Tensor) -> Tensor:
        """Scores of all places, differentiable."""

    @abstractmethod
    def settings(self) -> Facts:
        """Settings that a loaded state must have too, such as the metric, as JSON values."""

    @abstractmethod
    def summary(self) -> MapSummary:
        """Capacity of the map, and its bytes by part."""

    def know(self, descriptors: Tensor) -> None:
        """Keep the digest of the descriptors (N,K) of all places, if this kind of map does."""

    def loaded(self) -> None:
        """Called after a state was loaded, to derive attributes from the buffers."""

    def forward(self, queries: Tensor) -> Tensor:
        return self.scores(queries)

    def _apply(self, *args: object, **kwargs: object) -> Self:
        """As in nn.Module, but what `double()` and the like would change for files keeps its type."""
        before: dict[str, Tensor] = {name: getattr(self, name) for name in self.kept}
        super()._apply(*args, **kwargs)  # type: ignore[no-untyped-call]
        for name, old in before.items():
            if old.dtype != (now := getattr(self, name)).dtype:
                setattr(self, name, old.to(now.device))
        return self

    def check_queries(self, queries: Tensor) -> None:
        """Refuse queries that are not (Q,D)."""
        check_shape(queries, f"Q {self.dimension}", "the map got queries")

    def score_blocks(self, queries: Tensor) -> ScoreBlocks:
        """The columns of `scores`, block by block."""
        yield 0, self.scores(queries)

    def scores_at(self, queries: Tensor, places: Tensor) -> Tensor:
        """The columns of `scores` at some places of each query, (Q,K), (Q,M) -> (Q,M)."""
        return self.scores(queries).gather(1, places)

    @property
    def block_places(self) -> int:
        """About how many numbers the largest block of `score_blocks` needs per query."""
        return self.places

    @property
    def mean(self) -> Tensor:
        """The mean descriptor of all places, (K,); 0 if it is not known."""
        return torch.zeros(self.dimension, device=self.device)

    @property
    def fidelity(self) -> float | None:
        """The share of descriptors of length 1, about the mean of their route, that the map keeps; None of
        maps that do not keep descriptors."""
        return None

    @property
    def layout(self) -> Layout:
        return self._layout.reaching(self.places)

    @layout.setter
    def layout(self, layout: Layout) -> None:
        self._layout = layout

    def laid_out(self, layout: Layout) -> Self:
        """Let its places lie so; returns itself."""
        self.layout = layout
        return self

    @property
    def area(self) -> Layout | None:
        return self.layout.area

    @property
    def routes(self) -> tuple[Route, ...]:
        return self.table.routes

    @property
    def table(self) -> FrameTable:
        """The frame and route of each place."""
        return FrameTable(self.layout, self.positions)

    @property
    def route_starts(self) -> tuple[int, ...]:
        """The first place of each route, or of each part of one."""
        return self.layout.starts

    @property
    def connections(self) -> tuple[Link, ...]:
        """Steps from one route to another, or from a part of a route to the next, see `PlaceSmoother`."""
        return self.layout.joins

    def frame_of(self, places: Tensor) -> Tensor:
        """The reference frame of each place, see `FrameTable`."""
        return self.table.frame_of(places)

    def place_of(self, frames: Tensor) -> Tensor:
        """The place nearest to each reference frame, see `FrameTable`."""
        return self.table.place_of(frames)

    @property
    def device(self) -> torch.device:
        """Where the buffers are."""
        return self.positions.device

    @property
    def visit_counts(self) -> Tensor:
        """(N,) int64, number of visits that each place averages; 0 if no frame shows it."""
        if not len(self.visits):
            return torch.ones(self.places, dtype=torch.int64, device=self.device)
        runs, counts = self.visits.long().unbind(1)
        return counts.repeat_interleave(runs)

    def count_visits(self, counts: Tensor) -> None:
        """Set the number of visits that each place averages, (N,) int64."""
        values, runs = counts.unique_consecutive(return_counts=True)
        self.visits = torch.stack([runs, values], 1).int()[: 0 if (values == 1).all() else None]

    @torch.no_grad()
    def take_parameters(self, before: PlaceMap) -> None:
        """Let the parameters be those of the map before, for an optimiser, with the new values; that map
        keeps a copy of its own."""
        for name, new in dict(self.named_parameters(recurse=False)).items():
            old = getattr(before, name, None)
            if not isinstance(old, nn.Parameter) or not old.numel():
                continue
            if (old.shape, old.dtype, old.device) == (new.shape, new.dtype, new.device):
                setattr(before, name, nn.Parameter(old.clone()))
                old.grad = None
                setattr(self, name, old.copy_(new))
            else:
                log.warning("the %s of the map are new parameters: an optimiser has to be made anew", name)

    def check(self) -> None:
        """`require` that the buffers are consistent; a subclass checks its own first."""
        if len(self.visits):
            seen = int(self.visits[:, 0].sum())
            require(seen == self.places, f"visits of {seen} places; expected {self.places}")
        if len(self.positions):
            seen = count_places(self.table.steps)
            require(seen == self.places, f"positions of {seen} places; expected {self.places}")

    def get_extra_state(self) -> Facts:
        """The state besides the tensors."""
        own = {"kind": self.kind, "places": self.places, "dimension": self.dimension, **self.settings()}
        return own | self.layout.stored()

    def set_extra_state(self, state: Facts) -> None:
        """Restore the result of `get_extra_state`; another kind or other settings are an InputError."""
        for name, value in {"kind": self.kind, **self.settings()}.items():
            expect(state.get(name) == value, repr(value), f"the map's {name} is {state.get(name)!r}")
        self.places, self.dimension = state["places"], state["dimension"]
        self.layout = Layout.restored(state, self.places)

    def _load_from_state_dict(self, state_dict: Facts, prefix: str, *args: object) -> None:
        if not any(name.startswith(prefix) for name in state_dict):  # the state of other parts of a model
            super()._load_from_state_dict(state_dict, prefix, *args)
            return
        before = self.__dict__ | {"_buffers": {**self._buffers}, "_parameters": {**self._parameters}}
        try:
            if prefix + EXTRA in state_dict:  # before any tensor changes
                self.set_extra_state(state_dict[prefix + EXTRA])
            for name, tensor in [*self.named_buffers(recurse=False), *self.named_parameters(recurse=False)]:
                trained = isinstance(tensor, nn.Parameter)  # keeps its shape unless it is empty
                if prefix + name in state_dict and not (trained and tensor.numel()):
                    new = torch.empty_like(state_dict[prefix + name], device=tensor.device)
                    setattr(self, name, nn.Parameter(new) if trained else new)
            super()._load_from_state_dict(state_dict, prefix, *args)
            self.check()
            self.loaded()
        except Exception as error:  # a refused state leaves the map as it was
            self.__dict__.clear()
            self.__dict__.update(before)
            if isinstance(error, InputError | MemoryError):
                raise
            raise InputError(f"the map does not fit together: {one_line(error)}") from error

    def packed(self) -> dict[str, Tensor]:
        """The tensors of a file: the state's, without visits if every place has one."""
        omitted = {EXTRA} if len(self.visits) else {EXTRA, "visits"}
        return {name: value for name, value in self.state_dict().items() if name not in omitted}

    def load_packed(self, tensors: dict[str, Tensor], extra: Facts) -> None:
        """Load the results of `packed` and `get_extra_state`; other tensors are an InputError."""
        names = self.state_dict().keys() - {EXTRA}
        fits, seen = names - {*self.optional} <= tensors.keys() <= names, ", ".join(sorted(tensors))
        expect(fits, ", ".join(sorted(names)), f"it holds {seen or 'nothing'} of a map")
        default = {
            name: getattr(self, name).new_zeros(shape)
            for name, shape in self.optional.items()
            if name in names
        }
        self.load_state_dict({**default, **tensors, EXTRA: extra})


class Mapper(nn.Module, ABC):
    """Makes a map of N places from descriptors (N,D). Subclass it, and `PlaceMap`, for another kind of map.

    Attributes:
        kind: see `PlaceMap`.
        whitens: whether it expects whitened descriptors by default.
    """

    kind: ClassVar[str]
    whitens: ClassVar[bool] = False

    @abstractmethod
    def forward(self, features: Tensor) -> PlaceMap:
        """Learn a map of N places from their features (N,D)."""

    @abstractmethod
    def empty(self) -> PlaceMap:
        """A map without places, which can load any map of this mapper."""
