"""The spectral map: the strongest lines of every feature's spectrum along the route, and nothing else."""

from __future__ import annotations

import bisect
import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from functools import cache
from itertools import pairwise
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from dejavu_torch.maps.codec import ESCAPE, Stream, check_claim, decode, encode, to_int8
from dejavu_torch.maps.frame_table import Route
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectrum import Transform, from_slots, period_of, slots
from dejavu_torch.maps.summary import ChunkSummary, MapSummary
from dejavu_torch.types import InputError

SpectralMetric = Literal["cosine", "l2"]
MIN_NORM = 1e-6  # of the map's RMS norm: a shorter descriptor has no direction
STRONGEST = 10  # periods that a summary names
LARGEST = 2**31 - 1  # places of a map, and its coefficients: what int32 holds
BLOCK = 2**19  # numbers computed at a time: they stay in the processor's cache
LONG = 2**22  # numbers of a long chunk that are computed at a time
TOGETHER = 16  # queries at least that are multiplied with lines at a time
COPIES = 4  # numbers held for a place and a query: line, transform, score, is it best
COUNTING = (torch.uint8, torch.int16, torch.int32)
FILE = {  # dtype and dimensions of the tensors of a file
    "lengths": (torch.int64, 1),
    "steps": (torch.float32, 1),
    "stream_table": (torch.int64, 2),
    "streams": (torch.uint8, 1),
    "escapes": (torch.int32, 1),
    "means": (torch.bfloat16, 2),
    "visits": (torch.int32, 2),
}
CHUNK_BYTES = 8 + 4 + 8 + 8  # of a chunk's length, step, stream length and checksum in the file


class Chunk(NamedTuple):
    """All that a file holds of some places.

    places: W. step: of their lines. stream: the coded levels. escapes: (E,) int32, the levels beyond int8.
    energy, error: squares of all lines and of what the levels miss, summed; 0 where that is not known.
    """

    places: int
    step: float
    stream: Stream
    escapes: Tensor
    energy: float = 0.0
    error: float = 0.0


class RouteState(NamedTuple):
    """A route of a merged map in the header of a file: its name, chunks, and frames of the reference."""

    name: str
    chunks: int
    frames: int


class SpectralState(NamedTuple):
    """The header of a map file for a spectral map; see its arguments. routes: of a merged map, else ()."""

    kind: Literal["spectral"]
    places: int
    dimension: int
    metric: SpectralMetric
    transform: Transform
    chunk: int
    resolution: float
    routes: tuple[RouteState, ...]


class Lines(NamedTuple):
    """Coefficients other than 0: the number of the line, the feature, and the value; (L,) each."""

    line: Tensor
    feature: Tensor
    value: Tensor


class SpectralMap(PlaceMap):
    """A list of coded chunks: the quantised spectrum of descriptors along time, scored without decoding it.

    A phase mean repeated along a chunk (eq. 1) is the descriptor's projection onto the harmonics of 1 / tau;
    this map keeps whichever lines of the spectrum are worth their bytes: transform coding with one step for
    all lines, which is reverse water-filling (Cover and Thomas, section 10.3.3).

    Buffers, the tensors of a file; the streams are coded when `state_dict` or `coded` asks for them:
        lengths: (G,) int64, places of each chunk. steps: (G,) float32, of each chunk.
        streams, stream_table, escapes: coded levels; bytes and checksum of each chunk; levels beyond int8.
        means: (R,K) bfloat16, of the descriptors of each route: the lines code the difference.
        positions, visits: see `PlaceMap`.
    Buffers that follow from these:
        counts, feature, level: coefficients of each of N lines; of each of L coefficients the feature,
            ascending within a line, and the value in steps; in the smallest types that hold them.
        norms: (N,) float32, of the descriptors that the map holds.

    Attributes:
        chunks: the places [start, stop) of each. needed: bytes per place that would hold half the variance
            of a route of which this map holds under a tenth, None otherwise and for a loaded map.
            energy, error: squares of all lines and of what is not held; 0 for a loaded map.

    Args:
        means: as above; None makes a map that can load any state.
        step: of chunks to come, where there are none yet.
        metric: "cosine": 1 - the cosine of the angle between query and coded descriptor. "l2": the square
            of their distance.
        transform: of the lines, see `spectrum`. chunk: places of a chunk. resolution: see `SpectralMapper`.

    Shape: scores: descriptors (Q,K) -> (Q,N), lower is better.

    Convention: a place whose coded descriptor has next to no length (`MIN_NORM`) has cosine 0 with every
        query, and no gradient; so has a query of length 0. Gradients reach the queries.

    Raises:
        InputError: an unknown metric or transform, buffers that do not fit together; scores: descriptors of
            another dimension.
    """

    kind = "spectral"
    state = SpectralState

    lengths: Tensor
    steps: Tensor
    stream_table: Tensor
    streams: Tensor
    escapes: Tensor
    means: Tensor
    counts: Tensor
    feature: Tensor
    level: Tensor
    norms: Tensor
    needed: float | None = None
    energy: float = 0.0
    error: float = 0.0

    def __init__(
        self,
        means: Tensor | None = None,
        metric: SpectralMetric = "cosine",
        transform: Transform = "dft",
        chunk: int = 10_000,
        resolution: float = 0.0,
        step: float | None = None,
    ) -> None:
        super().__init__(0, 0 if means is None else means.shape[1])
        check_settings(metric, transform, chunk, resolution)
        self.metric, self.transform, self.chunk, self.resolution = metric, transform, chunk, resolution
        for name, (dtype, ndim) in FILE.items():
            self.register_buffer(name, torch.zeros([0, 2][:ndim], dtype=dtype))
        if means is not None:
            self.means = means
        for name in ("counts", "feature", "level", "norms"):
            self.register_buffer(name, None, persistent=False)
        self._routes: tuple[RouteState, ...] = ()
        self._step = step
        self._clear()

    def _clear(self) -> None:
        """Forget the decoded chunks."""
        device = self.means.device
        self.counts = torch.zeros(0, dtype=_type_for(self.dimension), device=device)
        self.feature = torch.zeros(0, dtype=_type_for(self.dimension - 1), device=device)
        self.level = torch.zeros(0, dtype=torch.int8, device=device)
        self.norms = torch.zeros(0, device=device)
        self.chunks: list[tuple[int, int]] = []
        self._bounds = [0]  # in the coefficients, of the chunks
        self.places = 0
        self.min_norm = 0.0

    def extend(self, chunks: Iterable[Chunk]) -> None:
        """Add the places of coded chunks; the others stay as they are, to the bit.

        Raises:
            InputError: a stream that is altered, or more places than a map has.
        """
        chunks = [*chunks]
        if not chunks:
            return
        check_sizes(self.places + sum(chunk.places for chunk in chunks))
        self._encode()
        decoded = [self._decoded(chunk) for chunk in chunks]
        self._add(decoded, [chunk.places for chunk in chunks], [chunk.step for chunk in chunks])
        self._add_streams([chunk.stream for chunk in chunks], [chunk.escapes for chunk in chunks])
        self._check_norms()
        known = all(chunk.energy for chunk in chunks) and (self.energy > 0 or len(chunks) == len(self.chunks))
        self.energy = self.energy + sum(chunk.energy for chunk in chunks) if known else 0.0
        self.error = self.error + sum(chunk.error for chunk in chunks) if known else 0.0

    @property
    def held(self) -> float | None:
        """The share of the variance that the lines hold; None where that is not known."""
        return 1 - self.error / self.energy if self.energy else None

    def extend_levels(self, levels: Tensor, escapes: Tensor) -> None:
        """Add a chunk of the map's step by its levels (W,K) int8 and escapes (E,) int32; they are coded when
        that is asked for.

        Raises:
            InputError: escapes that do not fit.
        """
        self._add([_nonzero(levels, escapes)], [len(levels)], [self.step])
        self._check_norms()

    def _add(
        self, parts: Sequence[tuple[Tensor, Tensor, Tensor]], places: list[int], steps: list[float]
    ) -> None:
        check_sizes(self.places + sum(places), len(self.level) + sum(len(level) for *_, level in parts))
        device, first = self.means.device, len(self.chunks)
        columns = zip((self.counts, self.feature, self.level), *parts, strict=True)
        self.counts, self.feature, self.level = (torch.cat([c.to(device) for c in one]) for one in columns)
        for count, (_, _, level) in zip(places, parts, strict=True):
            self.chunks.append((self.places, self.places + count))
            self._bounds.append(self._bounds[-1] + len(level))
            self.places += count
        known = len(self.lengths) - first  # those of a file that is being read are there already
        self.lengths = torch.cat([self.lengths, self.lengths.new_tensor(places[known:])])
        self.steps = torch.cat([self.steps, self.steps.new_tensor(steps[known:])])
        if len(self.visits) and not known:
            self.count_visits(
                torch.cat([self.visit_counts[: self.places], self.lengths.new_ones(sum(places))])
            )
        norms = [  # chunk by chunk: however a map is put together, they are the same to the bit
            torch.stack([part.square_().sum(0) for part in self._features(g)]).sum(0).sqrt_()
            for g in range(first, len(self.chunks))
        ]
        self.norms = torch.cat([self.norms, *norms])

    def _check_norms(self) -> None:
        if not self.norms.isfinite().all():
            raise InputError("the map does not fit together: its descriptors are not finite")
        self.min_norm = (
            MIN_NORM * float(torch.linalg.vector_norm(self.norms)) / math.sqrt(max(1, self.places))
        )

    def _decoded(self, chunk: Chunk) -> tuple[Tensor, Tensor, Tensor]:
        check_claim(chunk.places, self.dimension)
        return _nonzero(decode(chunk.stream, chunk.places, self.dimension), chunk.escapes)

    def _encode(self) -> None:
        """Bring the streams up to date with the coefficients."""
        first = len(self.stream_table)
        if first < len(self.chunks):
            streams, escapes = zip(*map(self._coded_levels, range(first, len(self.chunks))), strict=True)
            self._add_streams(streams, escapes)

    def _coded_levels(self, chunk: int) -> tuple[Stream, Tensor]:
        line, feature, _ = self.lines(chunk)
        small, escapes = to_int8(self.level[self._inside(chunk)].to(torch.int32))
        levels = small.new_zeros(self._length(chunk), self.dimension)
        return encode(levels.index_put((line, feature), small)), escapes

    def _add_streams(self, streams: Sequence[Stream], escapes: Sequence[Tensor]) -> None:
        table = self.stream_table.new_tensor([[len(one.bytes), one.checksum] for one in streams])
        self.stream_table = torch.cat([self.stream_table, table])
        self.streams = torch.cat([self.streams, *(one.bytes.to(self.streams.device) for one in streams)])
        self.escapes = torch.cat([self.escapes, *(one.to(self.escapes) for one in escapes)])

    def coded(self) -> list[Chunk]:
        """The chunks as a file holds them: what `extend` takes."""
        self._encode()
        sizes = self.stream_table[:, 0].tolist()
        streams = map(Stream, self.streams.cpu().split(sizes), self.stream_table[:, 1].tolist())
        large = (self.level.to(torch.int32).abs() > 127).cumsum(0)
        ends = [0, *(int(large[end - 1]) if end else 0 for end in self._bounds[1:])]
        escapes = [self.escapes[start:stop].cpu() for start, stop in pairwise(ends)]
        parts = zip(self.lengths.tolist(), self.steps.tolist(), streams, escapes, strict=True)
        return [Chunk(*part) for part in parts]

    def of_chunks(self, chunks: Iterable[Chunk]) -> SpectralMap:
        """A map of other chunks with the mean and settings of this one, on its device."""
        made = SpectralMap(self.means, **self.settings()).to(self.means.device).train(self.training)
        made.extend(chunks)
        return made

    @classmethod
    def merged(cls, parts: Sequence[SpectralMap], names: Sequence[str]) -> SpectralMap:
        """The map of several routes: the places of all, each route with its own mean and steps.

        Raises:
            InputError: parts of other dimensions, metrics or transforms, or names that are alike.
        """
        for what in ("dimension", "metric", "transform"):
            seen = [getattr(part, what) for part in parts]
            other = next((i for i, one in enumerate(seen) if one != seen[0]), None)
            if other is not None:
                problem = f"{what} of {names[other]}: {seen[other]}; expected {seen[0]}, as of {names[0]}"
                raise InputError(f"the map does not fit together: {problem}")
        route = cls(torch.cat([part.means for part in parts]), **parts[0].settings())
        route.to(route.means.device)
        route._routes = tuple(
            RouteState(name, len(part.chunks), len(part.positions) or part.places)
            for name, part in zip(names, parts, strict=True)
        )
        route.extend(chunk for part in parts for chunk in part.coded())
        route.positions = torch.cat([part.positions for part in parts])
        route.count_visits(torch.cat([part.visit_counts for part in parts]))
        route.check()
        return route

    @property
    def routes(self) -> tuple[Route, ...]:  # type: ignore[override]
        """See `PlaceMap`."""
        ends = [0, *torch.tensor([one.chunks for one in self._routes]).cumsum(0).tolist()]
        return tuple(
            Route(one.name, sum(self.lengths[first:last].tolist()), one.frames)
            for one, (first, last) in zip(self._routes, pairwise(ends), strict=True)
        )

    def part(self, name: str) -> SpectralMap:
        """The map of one route by itself.

        Raises:
            InputError: there is no such route.
        """
        names = [one.name for one in self._routes]
        if name not in names:
            raise InputError(f"there is no route {name!r}; expected one of {', '.join(names)}")
        r = names.index(name)
        first = sum(one.chunks for one in self._routes[:r])
        made = self.between(first, first + self._routes[r].chunks)
        start, frame = self.chunks[first][0], sum(one.frames for one in self._routes[:r])
        made._routes = ()
        made.positions = self.positions[frame : frame + self._routes[r].frames]
        made.count_visits(self.visit_counts[start : start + made.places])
        made._check_norms()
        return made

    def between(self, first: int, last: int) -> SpectralMap:
        """The chunks [first, last) as a map, whose places score as in this one."""
        ends = [0, *torch.tensor([one.chunks for one in self._routes]).cumsum(0).tolist()]
        kept = {
            r: min(stop, last) - max(start, first)
            for r, (start, stop) in enumerate(pairwise(ends))
            if start < last and stop > first
        }
        made = SpectralMap(self.means[[*kept] or [0]], **self.settings())
        made._routes = tuple(RouteState(self._routes[r].name, count, 0) for r, count in kept.items())
        made.extend(self.coded()[first:last])
        made.min_norm = self.min_norm
        return made

    @property
    def step(self) -> float:
        """Of the last chunk, and of those to come."""
        if not len(self.steps) and self._step is None:
            raise InputError("there is no map yet; expected one with a step")
        return float(self.steps[-1]) if len(self.steps) else float(self._step or 0)

    def lines(self, chunk: int) -> Lines:
        """The coefficients of a chunk, by line and feature."""
        some, (start, stop) = self._inside(chunk), self.chunks[chunk]
        level = self.level[some]
        return Lines(
            _rows(self.counts[start:stop], len(level)), self.feature[some].long(), level * self.steps[chunk]
        )

    @property
    def levels(self) -> Tensor:
        """(N,K), rows [start, stop) the lines of that chunk, in steps, zeros too: as large as the route."""
        line = _rows(self.counts, len(self.level))
        levels = self.level.new_zeros(self.places, self.dimension)
        return levels.index_put((line, self.feature.long()), self.level)

    def _inside(self, chunk: int) -> slice:
        return slice(self._bounds[chunk], self._bounds[chunk + 1])

    def decode(self, chunk: int) -> Tensor:
        """The descriptors of a chunk as the map holds them, (W,K) float32."""
        return torch.cat([*self._features(chunk)]).T

    def _features(self, chunk: int) -> Iterator[Tensor]:
        """The coded descriptors of a chunk, some of their features at a time: (F,W) each."""
        start, stop = self.chunks[chunk]
        units = torch.eye(self.dimension, device=self.means.device)
        for some in units.split(max(1, LONG // (stop - start))):
            yield self.products(some, range(chunk, chunk + 1))

    def inverse_norms(self, start: int = 0, stop: int | None = None) -> Tensor:
        """1 / norm of the places [start, stop), 0 of those that have next to none."""
        norms = self.norms[start:stop]
        return torch.where(norms > self.min_norm, 1 / norms, 0)

    def products(self, queries: Tensor, chunks: range) -> Tensor:
        """Inner products with all descriptors of equally long chunks, decoding none: (Q,K) -> (Q,W G).

        The inverse transform is linear, so the product with every descriptor is the inverse transform of the
        product with every line: O(lines + W log W) for a query instead of O(W K).
        """
        first, last = self.chunks[chunks.start][0], self.chunks[chunks.stop - 1][1]
        count, length = len(chunks), (last - first) // len(chunks)
        where, factor = slots(length, self.transform, queries.dtype, queries.device)
        counts = self.counts[first:last].view(count, length)
        rows = counts.new_zeros(count, len(factor)).index_copy(1, where, counts).flatten()
        some = slice(self._bounds[chunks.start], self._bounds[chunks.stop])
        lines = sparse_products(queries, rows, self.feature[some], self.level[some]).unflatten(
            1, (count, len(factor))
        )
        lines = lines * (self.steps[chunks.start : chunks.stop, None].to(factor) * factor)
        means = queries @ self.means.to(queries).T  # (Q,R)
        if self._routes:
            means = means[:, self._route_of_chunk[chunks.start : chunks.stop]]
        lines[..., 0] += means * (math.sqrt(length) * factor[0])
        return from_slots(lines, length, self.transform).flatten(1)

    @property
    def _route_of_chunk(self) -> Tensor:
        counts = torch.tensor([one.chunks for one in self._routes], device=self.means.device)
        return torch.arange(len(counts), device=counts.device).repeat_interleave(counts)

    def _runs(self, chunks: range, rows: int) -> Iterator[range]:
        """Consecutive chunks of equal length, as many as have `BLOCK` numbers in so many rows."""
        start = chunks.start
        while start < chunks.stop:
            length, stop = self._length(start), start + 1
            most = max(1, BLOCK // (rows * length))
            while stop < min(chunks.stop, start + most) and self._length(stop) == length:
                stop += 1
            yield range(start, stop)
            start = stop

    def _length(self, chunk: int) -> int:
        start, stop = self.chunks[chunk]
        return stop - start

    def scores(self, queries: Tensor) -> Tensor:
        """Scores of all places: (Q,K) -> (Q,N)."""
        return self.scores_between(queries, 0, self.places)

    def scores_between(self, queries: Tensor, start: int, stop: int) -> Tensor:
        """See `PlaceMap`: from the chunks that hold these places."""
        return torch.cat([scores for _, scores in self.score_blocks(queries, start, stop)], 1)

    def score_blocks(
        self, queries: Tensor, start: int = 0, stop: int | None = None
    ) -> Iterator[tuple[int, Tensor]]:
        """See `PlaceMap`: of consecutive chunks, as many as the processor's cache has room for."""
        stop = self.places if stop is None else stop
        if queries.ndim != 2 or queries.shape[1] != self.dimension:
            raise InputError(
                f"the query descriptors are {tuple(queries.shape)}; the map expects (Q, {self.dimension})"
            )
        queries = queries.to(torch.promote_types(queries.dtype, torch.float32))
        length: Tensor = torch.linalg.vector_norm(queries, dim=1, keepdim=True)
        if self.metric == "cosine":
            queries = queries / torch.where(length > 0, length, 1)
        chunks, rows = range(len(self.chunks)), self.dimension
        if (start, stop) != (0, self.places):  # torch.compile does not follow bisect
            first = bisect.bisect_right(self.chunks, start, key=lambda chunk: chunk[1])
            chunks = range(first, bisect.bisect_left(self.chunks, stop, key=lambda chunk: chunk[0]))
        if not torch.compiler.is_compiling():  # a program has the same blocks for any number of queries
            rows = max(1, queries.shape[0] + len(self.level) // max(1, self.places))
        for run in self._runs(chunks, rows):
            begin, end = self.chunks[run.start][0], self.chunks[run.stop - 1][1]
            with torch.autocast(queries.device.type, enabled=False):
                some = [queries]
                if not torch.compiler.is_compiling():  # what is held for the others stays in the cache
                    some = [*queries.split(max(TOGETHER, BLOCK // (end - begin)))]
                products = torch.cat([self.products(part, run) for part in some])
                if self.metric == "cosine":
                    inverse = self.inverse_norms(begin, end).to(queries)
                    scores = torch.addcmul(queries.new_ones(()), products, inverse, value=-1)
                else:
                    square = self.norms[begin:end].to(queries).square()
                    scores = (square - 2 * products + length.square()).clamp(min=0)
            low, high = max(start, begin), min(stop, end)
            yield low, scores[:, low - begin : high - begin]

    @property
    def block_places(self) -> int:
        """See `PlaceMap`."""
        return max(
            COPIES * max(map(self._length, range(len(self.chunks))), default=1),
            BLOCK // max(1, self.dimension),
        )

    def settings(self) -> dict[str, Any]:
        """See `PlaceMap`: what a map is made with."""
        return {name: getattr(self, name) for name in ("metric", "transform", "chunk", "resolution")}

    def get_extra_state(self) -> dict[str, Any]:
        """See `PlaceMap`."""
        return {**super().get_extra_state(), "routes": [one._asdict() for one in self._routes]}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """See `PlaceMap`."""
        super().set_extra_state(state)
        routes = state.get("routes", ())
        try:
            self._routes = tuple(RouteState(**one) for one in routes)
        except TypeError as error:
            seen = f"the map's routes are {routes!r:.60}"
            raise InputError(f"{seen}; expected name, chunks and frames of each") from error

    def _save_to_state_dict(self, *args: Any) -> None:
        self._encode()
        super()._save_to_state_dict(*args)

    def disagreement(self) -> str:
        """See `PlaceMap`."""
        for name, (dtype, ndim) in FILE.items():
            tensor = getattr(self, name)
            if tensor.dtype != dtype or tensor.ndim != ndim:
                return f"{name} {tuple(tensor.shape)} {tensor.dtype}; expected {dtype} of {ndim} dimensions"
        lengths, routes = self.lengths.tolist(), self._routes
        if min(lengths, default=1) < 1 or sum(lengths) != self.places:
            return f"chunks of {lengths!s:.100} places; expected {self.places} in all"
        if len(self.steps) != len(lengths) or not bool(((self.steps > 0) & self.steps.isfinite()).all()):
            return f"steps {self.steps.tolist()!s:.100}; expected {len(lengths)} finite numbers above 0"
        shape = (max(1, len(routes)), self.dimension)
        if self.places and (self.means.shape != shape or not self.means.isfinite().all()):
            return f"means {tuple(self.means.shape)}; expected {shape} finite numbers"
        names, chunks, frames = zip(*routes, strict=True) if routes else ((), (), ())
        if len({*names}) != len(names) or not all(names):
            return f"names {', '.join(names)}; expected another one for each of {len(names)} routes"
        if routes and (sum(chunks) != len(lengths) or min(chunks) < 1):
            return f"routes of {[*chunks]!s:.100} chunks; expected {len(lengths)} in all"
        if routes and sum(frames) != self.table.frames:
            return f"routes of {[*frames]!s:.100} frames; expected {self.table.frames} in all"
        return ""

    def loaded(self) -> None:
        """Decode the chunks of a file."""
        lengths, steps, table = (one.tolist() for one in (self.lengths, self.steps, self.stream_table))
        problem = self.disagreement()
        if not problem and tuple(self.stream_table.shape) != (len(lengths), 2):
            shape = tuple(self.stream_table.shape)
            problem = f"a stream table {shape} for {len(lengths)} chunks; expected a row each"
        sizes = [] if problem else [size for size, _ in table]
        if not problem and (min(sizes, default=0) < 0 or sum(sizes) != len(self.streams)):
            problem = f"the coded lines are {len(self.streams)} bytes; the table claims {sizes!s:.100}"
        if problem:
            raise InputError(f"the map does not fit together: {problem}")
        check_sizes(self.places)
        streams, escapes = self.streams.cpu().split(sizes), self.escapes.cpu()
        self._clear()
        used, parts = 0, []
        for places, (_, checksum), stream in zip(lengths, table, streams, strict=True):
            check_claim(places, self.dimension)
            levels = decode(Stream(stream, checksum), places, self.dimension)
            marks = int((levels == ESCAPE).sum())
            parts.append(_nonzero(levels, escapes[used : used + marks]))
            used += marks
        if used != len(escapes):
            raise InputError(f"the map does not fit together: {len(escapes)} escapes; expected {used}")
        self._add(parts, lengths, steps)
        self._check_norms()

    def summary(self) -> MapSummary:
        """See `MapSummary`; the parts are those of the route."""
        chunks = []
        for g, (start, stop) in enumerate(self.chunks):
            line, _, value = self.lines(g)
            energy = value.new_zeros(stop - start).index_add(0, line, value.square())
            chunks.append(ChunkSummary(start, stop, self._periods(energy), (), Fraction(0), ()))
        packed = self.packed() if self.places else {}
        names = {"streams": "lines", "means": "mean", "positions": "positions", "visits": "visits"}
        route = {own: packed[name].nbytes for name, own in names.items() if name in packed}
        route = {name: size for name, size in route.items() if size}
        route["chunks"] = sum(tensor.nbytes for name, tensor in packed.items() if name not in names)
        covered = int((self.norms > self.min_norm).sum())
        return MapSummary(self.kind, self.places, covered, 0, 0, tuple(chunks), route, {}, len(self.level))

    def _periods(self, energy: Tensor) -> tuple[Fraction, ...]:
        """The periods of the strongest lines, sorted; cosine and sine of one frequency count together."""
        if self.transform == "dft" and len(energy) > 2:  # the line of W / 2 cycles has no sine
            pairs = torch.cat([energy[1:], energy.new_zeros(1 - len(energy) % 2)]).view(-1, 2)
            energy = torch.cat([energy[:1], pairs.sum(1).repeat_interleave(2)[: len(energy) - 1]])
            energy[2::2] = 0
        lines = energy[1:].argsort(descending=True)[:STRONGEST] + 1
        kept = lines[energy[lines] > 0].tolist()
        return tuple(sorted(period_of(line, len(energy), self.transform) for line in kept))

    def extra_repr(self) -> str:
        return (
            f"places={self.places}, dimension={self.dimension}, lines={len(self.level)}, "
            f"chunks={len(self.chunks)}, metric={self.metric!r}, transform={self.transform!r}"
        )


def sparse_products(queries: Tensor, counts: Tensor, feature: Tensor, level: Tensor) -> Tensor:
    """Products of queries with rows that are mostly 0.

    Args:
        counts: (S,) of each row, how many numbers are not 0. feature, level: (L,) of these, column and value.

    Shape: (Q,K) -> (Q,S).

    Convention: on a CPU with MKL by a CSR product, made for the call, since it neither compiles nor exports;
        elsewhere, and of tensors that are traced, by `scatter_add`. No autocast.
    """
    plain = type(queries) is Tensor and queries.device.type == "cpu"
    if plain and not torch.compiler.is_compiling() and _has_csr():
        crow = torch.nn.functional.pad(counts.cumsum(0, dtype=torch.int32), (1, 0))
        shape = (len(counts), queries.shape[1])
        rows = torch.sparse_csr_tensor(crow, feature.int(), level.to(queries), shape, check_invariants=False)
        with torch.autocast("cpu", enabled=False):
            products: Tensor = rows @ queries.T
        return products.T.contiguous()
    terms = queries.index_select(1, feature.int()) * level.to(queries)
    row = _rows(counts, level.shape[0])
    # shape[0], since len() would fix the number of queries in an exported program
    return queries.new_zeros(queries.shape[0], counts.shape[0]).scatter_add(1, row.expand(terms.shape), terms)


@cache
def _has_csr() -> bool:
    """Whether torch multiplies CSR tensors by MKL; its warning that they are in beta is shown once, here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.eye(2).to_sparse_csr()
    return bool(torch.backends.mkl.is_available())


def _rows(counts: Tensor, total: int) -> Tensor:
    """The row of each of so many numbers, (L,) int64; `total` is known, and need not be read off a device."""
    rows = torch.arange(counts.shape[0], device=counts.device)
    return rows.repeat_interleave(counts.int(), output_size=total)


def _nonzero(levels: Tensor, escapes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """counts (W,), feature (L,) and level (L,) of levels (W,K) int8 with marks where escapes (E,) belong.

    Raises:
        InputError: other escapes than there are marks.
    """
    width, parts = levels.shape[1], []
    for rows in levels.split(max(1, BLOCK // width)):
        there = rows != 0
        counts = there.sum(1).to(_type_for(width))
        parts.append((counts, there.nonzero()[:, 1].to(_type_for(width - 1)), rows[there]))
    counts, feature, level = (torch.cat(column) for column in zip(*parts, strict=True))
    marks = level == ESCAPE
    if int(marks.sum()) != len(escapes) or bool((escapes.abs() <= 127).any()):
        raise InputError(
            f"{len(escapes)} escapes; expected {int(marks.sum())}, of levels that a byte does not hold"
        )
    if len(escapes):
        large = torch.int16 if int(escapes.abs().max()) < 2**15 else torch.int32
        level = level.to(large).masked_scatter(marks, escapes.to(large))
    return counts, feature, level


def _type_for(number: int) -> torch.dtype:
    return COUNTING[0] if number < 2**8 else COUNTING[1] if number < 2**15 else COUNTING[2]


def check_sizes(places: int, coefficients: int = 0) -> None:
    """Refuse more than int32 holds.

    Raises:
        InputError: naming the numbers.
    """
    if max(places, coefficients) > LARGEST:
        raise InputError(
            f"the map has {places} places and {coefficients} coefficients; expected at most {LARGEST} of "
            "each: make several maps"
        )


def check_settings(metric: str, transform: str, chunk: int, resolution: float) -> None:
    """Refuse settings that no spectral map has.

    Raises:
        InputError: naming the setting.
    """
    if metric not in get_args(SpectralMetric):
        raise InputError(f"metric {metric!r} is none of a spectral map; expected 'cosine' or 'l2'")
    if transform not in get_args(Transform):
        raise InputError(f"transform {transform!r} is unknown; expected 'dft' or 'dct'")
    if not isinstance(chunk, int) or isinstance(chunk, bool) or chunk < 2:
        raise InputError(
            f"chunk is {chunk!r}; expected a number of places, at least 2, such as 10000; one larger than "
            "the route makes one chunk"
        )
    if not 0 <= resolution < math.inf:
        raise InputError(f"resolution is {resolution}; expected a number of places, 0 or more")
