"""The spectral map: the strongest lines of every feature's spectrum along the route, and nothing else."""

from __future__ import annotations

import bisect
import copy
import functools
import logging
import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from dejavu_torch.maps.codec import (
    Stream,
    check_claim,
    decode,
    encode,
    to_int8,
)
from dejavu_torch.maps.coefficients import (
    Coefficients,
    check_sizes,
    coded_levels,
    coefficients_of,
    disagreement,
    joined,
    levels_of,
    lines_of,
    nonzero_of,
    with_escapes,
)
from dejavu_torch.maps.place_map import Mapper, PlaceMap
from dejavu_torch.maps.quantisation import RouteLines, dead_zone, quantise
from dejavu_torch.maps.sparse_product import WORTH_COMPILING, compiled_sums
from dejavu_torch.maps.spectrum import Slots, Transform, from_slots, period_of, slots, spectrum
from dejavu_torch.maps.summary import ChunkSummary, MapSummary
from dejavu_torch.types import InputError

log = logging.getLogger("dejavu_torch")

SpectralMetric = Literal["cosine", "l2"]
SILENT = 1e-6  # of the map's RMS norm: a place below it has no direction
STRONGEST = 10  # periods that a summary names
CHUNK_BYTES = 8 + 4 + 8 + 8  # of a chunk's length, step, stream length and checksum in the file
BLOCK = 2**19  # numbers made at a time: they stay in the processor's cache
LONG = 2**22  # numbers of a long chunk made at a time, which is gone through for each
ROWS = 2**14  # of descriptors, looked at together
COPIES = 4  # numbers held for a place of a long chunk and a query: line, transform, score, is it best
LITTLE = 0.1  # of the variance: a map that holds less says what it needs
ROUTE_BYTES = 5.0  # per place, where nothing is asked for
HELD = 0.85  # of the variance, where these are no measure
# measured, in multiplications of a matrix product:
LINE_COST = 150  # of a coded line in a query's sum
TRANSFORM_COST = 280  # of a place in a query's inverse transform
REBUILD_COST = 200  # of a number that is rebuilt for all queries at once


class CodedChunk(NamedTuple):
    """What a file holds of a chunk.

    places: W. step: of its lines. stream: of its levels. escapes: (E,) int32, those that int8 does not hold.
    """

    places: int
    step: float
    stream: Stream
    escapes: Tensor


def code_chunk(
    descriptors: Tensor, mean: Tensor, step: float, transform: Transform = "dft", resolution: float = 0.0
) -> CodedChunk:
    """The lines of one chunk, coded: what `SpectralMap.of_chunks` puts together, here or on any machine.

    Args:
        mean: (K,) of the route's descriptors. step: of the lines. transform, resolution: of the map.

    Shape: descriptors (W,K).

    Raises:
        InputError: descriptors that are not finite floats (W,K).
    """
    small, escapes = _chunk_levels(descriptors, mean, step, transform, resolution)
    return CodedChunk(len(descriptors), step, encode(small), escapes.cpu())


def _chunk_levels(
    descriptors: Tensor, mean: Tensor, step: float, transform: Transform, resolution: float
) -> tuple[Tensor, Tensor]:
    """The levels of one chunk, as `to_int8` gives them."""
    check_descriptors(descriptors, len(mean))
    lengths = [len(descriptors)]
    lines = _lines(descriptors - mean.float(), lengths, transform)
    return to_int8(quantise(lines, step, dead_zone(lines, lengths, resolution, transform)))


def _decoded(streams: Sequence[Stream], lengths: list[int], escapes: Tensor, columns: int) -> Coefficients:
    """The coefficients of chunks of these lengths, one decoded at a time.

    Raises:
        InputError: more places than the index type holds, or streams and escapes that are altered.
    """
    check_sizes(sum(lengths))
    check_claim(max(lengths), columns)
    # many small tensors, each made beside large ones that go, would leave the heap full of holes
    held = [bytearray() for _ in Coefficients._fields]
    for stream, length in zip(streams, lengths, strict=True):
        part = nonzero_of(decode(stream, length, columns))
        for buffer, column in zip(held, part, strict=True):
            buffer += column.numpy().data
        check_sizes(sum(lengths), len(held[-1]))
    types = (column.dtype for column in part)
    marked = [
        torch.frombuffer(buffer, dtype=dtype) if buffer else torch.empty(0, dtype=dtype)
        for buffer, dtype in zip(held, types, strict=True)
    ]
    return with_escapes(Coefficients(*marked), escapes)


def _streams_of(tensors: dict[str, Tensor]) -> list[Stream]:
    """Of the chunks of a file."""
    table = tensors["stream_table"]
    parts = tensors["streams"].split(table[:, 0].tolist())
    return [Stream(part, checksum) for part, checksum in zip(parts, table[:, 1].tolist(), strict=True)]


class Lines(NamedTuple):
    """Coefficients that are not 0: of which line, of which number of the descriptor, and how large; (L,)."""

    line: Tensor
    feature: Tensor
    value: Tensor


class SpectralState(NamedTuple):
    """What the header of a map file says of a spectral map; see its arguments."""

    kind: Literal["spectral"]
    places: int
    dimension: int
    metric: SpectralMetric
    transform: Transform
    chunk: int | Literal["route"]
    resolution: float


class SpectralMap(PlaceMap):
    """A route as the quantised spectrum of its descriptors along time, scored without decoding it.

    A phase mean repeated along a chunk (eq. 1) is the descriptor's projection onto the harmonics of 1 / tau;
    this map keeps whichever lines of the spectrum are worth their bytes: transform coding with one step for
    all lines, which is reverse water-filling (Cover and Thomas, section 10.3.3).

    Buffers:
        counts, feature, level: see `Coefficients`; of the lines of all chunks in turn, in steps.
        lengths: (G,) int64, places of each chunk, one behind the other.
        steps: (G,) float32, of each chunk.
        mean: (K,) bfloat16, of the route's descriptors: the lines are of what differs from it.
        norms: (N,) float32, of the rebuilt descriptors; not in the state.
        positions: see `PlaceMap`.

    Attributes:
        chunks: the places [start, stop) of each. bounds: (G+1) where the coefficients of each chunk begin.
        longest: places of the longest chunk. compiled: whether products are summed by a compiled loop, where
            there is one; a part of a map takes this, and `audible`, from the whole, for the same scores.
        needed: bytes per place that would hold half the variance of a route of which this map holds under a
            tenth; None where it holds more, or was loaded.

    Args:
        metric: "cosine": 1 - the cosine of the angle between query and rebuilt descriptor. "l2": the square
            of their distance.
        transform: of the lines, see `spectrum`.
        chunk: places of a chunk; "route" is one chunk, which cannot be extended.
        resolution: of the coding of further places, see `SpectralMapper`.

    Shape: scores: descriptors (Q,K) -> (Q,N), lower is better.

    Convention: a place whose rebuilt descriptor has next to no length (`SILENT`) has cosine 0 with every
        query, and no gradient; so has a query of length 0. Gradients reach the queries.

    Raises:
        InputError: an unknown metric or transform, buffers that do not fit together; scores: descriptors of
            another dimension.
    """

    kind = "spectral"
    state = SpectralState

    counts: Tensor
    feature: Tensor
    level: Tensor
    lengths: Tensor
    steps: Tensor
    mean: Tensor
    norms: Tensor
    needed: float | None = None

    def __init__(
        self,
        coefficients: Coefficients | None = None,
        lengths: Tensor | None = None,
        steps: Tensor | None = None,
        mean: Tensor | None = None,
        metric: SpectralMetric = "cosine",
        transform: Transform = "dft",
        chunk: int | Literal["route"] = "route",
        resolution: float = 0.0,
    ) -> None:
        given = (*(coefficients or (None, None, None)), lengths, steps, mean)
        super().__init__(*(0 if one is None else len(one) for one in (given[0], mean)))
        check_settings(metric, transform, chunk, resolution)
        self.metric, self.transform, self.chunk, self.resolution = metric, transform, chunk, resolution
        empty = {
            "counts": torch.zeros(0, dtype=torch.uint8),
            "feature": torch.zeros(0, dtype=torch.uint8),
            "level": torch.zeros(0, dtype=torch.int8),
            "lengths": torch.zeros(0, dtype=torch.int64),
            "steps": torch.zeros(0),
            "mean": torch.zeros(0, dtype=torch.bfloat16),
        }
        for (name, nothing), value in zip(empty.items(), given, strict=True):
            self.register_buffer(name, nothing if value is None else value)
        self.register_buffer("norms", torch.zeros(0), persistent=False)
        self.register_buffer("visits", self.visits)
        self.loaded()
        self.check()

    @classmethod
    def of_chunks(
        cls,
        chunks: Sequence[CodedChunk],
        mean: Tensor,
        metric: SpectralMetric = "cosine",
        transform: Transform = "dft",
        chunk: int | Literal["route"] = "route",
        resolution: float = 0.0,
    ) -> SpectralMap:
        """The map of chunks, one behind the other, as `code_chunk` makes them with these settings.

        Raises:
            InputError: no chunks, or a stream that is altered.

        Example:
            >>> wave = torch.sin(torch.arange(500.0)[:, None] * torch.tensor([0.1, 0.23, 0.37]))
            >>> mean = wave.mean(0).bfloat16()
            >>> parts = [code_chunk(part, mean, step=0.05) for part in wave.split(250)]
            >>> SpectralMap.of_chunks(parts, mean, chunk=250).scores(wave[20:21]).argmin()
            tensor(20)
        """
        if not chunks:
            raise InputError("there are no chunks; expected at least one")
        streams = [part.stream for part in chunks]
        lengths = [part.places for part in chunks]
        escapes = torch.cat([part.escapes for part in chunks])
        route = cls(
            _decoded(streams, lengths, escapes, len(mean)),
            torch.tensor(lengths),
            torch.tensor([part.step for part in chunks]),
            mean,
            metric,
            transform,
            chunk,
            resolution,
        )
        route._streams = [*streams]
        return route

    def coded(self) -> list[CodedChunk]:
        """The chunks as the file holds them: what `of_chunks` makes the same map of."""
        chunks = []
        for g, (length, step) in enumerate(zip(self.lengths.tolist(), self.steps.tolist(), strict=True)):
            stream, own = self._streams[g], self.coefficients(range(g, g + 1))
            if stream is None:
                stream = self._streams[g] = encode(coded_levels(own, self.dimension)[0])
            escapes = own.level[own.level.to(torch.int32).abs() > 127]
            chunks.append(CodedChunk(length, step, stream, escapes.to(torch.int32).cpu()))
        return chunks

    def coefficients(self, chunks: range) -> Coefficients:
        """Those of chunks one behind the other."""
        some = slice(self.bounds[chunks.start], self.bounds[chunks.stop])
        return Coefficients(self.counts[self._span(chunks)], self.feature[some], self.level[some])

    def lines(self, chunk: int) -> Lines:
        """The coefficients of a chunk, by line and feature."""
        counts, feature, level = self.coefficients(range(chunk, chunk + 1))
        value = level * self.steps[chunk]
        return Lines(lines_of(counts, len(level)).long(), feature.long(), value)

    @property
    def levels(self) -> Tensor:
        """(N,K), rows [start, stop) the lines of that chunk, in steps, zeros too: as large as the route."""
        return levels_of(Coefficients(self.counts, self.feature, self.level), self.dimension)

    def settings(self) -> dict[str, Any]:
        names = ("metric", "transform", "chunk", "resolution")
        return {name: getattr(self, name) for name in names}

    def loaded(self) -> None:
        """Where the coefficients of each chunk are, and the norms of the rebuilt descriptors."""
        problem = self.disagreement()
        if problem:
            raise InputError(f"the map does not fit together: {problem}")
        stops = self.lengths.cumsum(0).tolist()
        self.chunks: list[tuple[int, int]] = list(zip([0, *stops], stops, strict=False))
        self.longest: int = max(self.lengths.tolist(), default=0)
        sums = torch.cat([self.lengths.new_zeros(1), self.counts.cumsum(0, dtype=torch.int64)])
        self.compiled = len(self.level) >= WORTH_COMPILING
        self.bounds: list[int] = [0, *sums[self.lengths.cumsum(0)].tolist()]
        self._streams: list[Stream | None] = [None] * len(self.chunks)  # coded when they are asked for
        self.norms = self.steps.new_empty(self.places)
        for chunks in self.runs(range(len(self.chunks)), self.dimension):
            squares = (part.square_().sum(0) for _, part in self._series(chunks))
            self.norms[self._span(chunks)] = functools.reduce(torch.add, squares).sqrt_()
        if not self.norms.isfinite().all():
            raise InputError("the map does not fit together: its descriptors are not finite")
        rms = float(torch.linalg.vector_norm(self.norms)) / math.sqrt(max(1, self.places))
        self.audible = SILENT * rms
        self.silent = int((self.norms <= self.audible).sum())

    def per_norm(self, start: int = 0, stop: int | None = None) -> Tensor:
        """1 / norm of the places [start, stop), 0 of those that have next to none."""
        norms = self.norms[start:stop]
        return torch.where(norms > self.audible, 1 / norms, 0)

    def rebuilt(self, chunk: int) -> Tensor:
        """The descriptors of a chunk as the map holds them, (W,K) float32."""
        return torch.cat([part for _, part in self._series(range(chunk, chunk + 1))]).T

    def _span(self, chunks: range) -> slice:
        """Their places."""
        return slice(self.chunks[chunks.start][0], self.chunks[chunks.stop - 1][1])

    def _inside(self, start: int, stop: int) -> range:
        """The chunks that hold these places."""
        if (start, stop) == (0, self.places):  # torch.compile does not follow bisect
            return range(len(self.chunks))
        first = bisect.bisect_right(self.chunks, start, key=lambda chunk: chunk[1])
        return range(first, bisect.bisect_left(self.chunks, stop, key=lambda chunk: chunk[0]))

    def _length(self, chunk: int) -> int:
        start, stop = self.chunks[chunk]
        return stop - start

    def runs(self, chunks: range, rows: int) -> Iterator[range]:
        """Equally long chunks one behind the other, as many as have `BLOCK` numbers in so many rows."""
        start = chunks.start
        while start < chunks.stop:
            length = self.chunks[start][1] - self.chunks[start][0]
            most, stop = max(1, BLOCK // (rows * length)), start + 1
            while (
                stop < min(chunks.stop, start + most)
                and self.chunks[stop][1] - self.chunks[stop][0] == length
            ):
                stop += 1
            yield range(start, stop)
            start = stop

    def _slots(self, chunks: range) -> tuple[Tensor, Tensor, Slots]:
        """Where in (G,S) slots the lines of equally long chunks go, their factors there, and those of one."""
        one = slots(self.steps.new_empty(self._length(chunks.start)), self.transform)
        first = torch.arange(len(chunks), device=one.where.device)[:, None] * one.count
        factor = self.steps[chunks.start : chunks.stop, None] * one.factor
        return (first + one.where).flatten(), factor.flatten(), one

    def _series(self, chunks: range) -> Iterator[tuple[slice, Tensor]]:
        """The rebuilt descriptors of equally long chunks, some of their numbers at a time: (F,W G) each.

        All of them at a time unless the chunk is long.
        """
        length, (slot, factor, one) = self._length(chunks.start), self._slots(chunks)
        counts, feature, level = self.coefficients(chunks)
        line = lines_of(counts, level.shape[0])
        size, places = len(chunks) * one.count, len(chunks) * length
        mean = self.mean.to(factor) * (math.sqrt(length) * one.factor[0])  # of line 0
        step = self.dimension if self.dimension * length <= LONG else max(1, LONG // length)
        for start in range(0, self.dimension, step):
            stop = min(start + step, self.dimension)
            some = (line, feature, level)
            if step < self.dimension:
                inside = (feature >= start) & (feature <= stop - 1)  # a byte holds no 256
                some = (line[inside], feature[inside], level[inside])
            spot = (some[1].long() - start) * size + slot[some[0]]
            slotted = factor.new_zeros((stop - start) * size).scatter_(0, spot, some[2] * factor[some[0]])
            slotted = slotted.view(stop - start, len(chunks), one.count)
            slotted[..., 0] += mean[start:stop, None]
            yield slice(start, stop), from_slots(slotted, length, self.transform).reshape(-1, places)

    def products(self, queries: Tensor, chunks: range) -> Tensor:
        """Inner products with all descriptors of equally long chunks, decoding none: (Q,K) -> (Q,W G).

        The inverse transform is linear, so the product with every descriptor is the inverse transform of the
        product with every line: O(lines + W log W) for a query instead of O(W K).
        """
        length, (slot, factor, one) = self._length(chunks.start), self._slots(chunks)
        size = len(chunks) * one.count
        own = self.coefficients(chunks)
        lines = compiled_sums(queries, own, slot, factor, size) if self.compiled else None
        if lines is None:
            line = lines_of(own.counts, own.level.shape[0])
            terms = queries.index_select(1, own.feature.int()) * (own.level * factor[line]).to(queries)
            # shape[0], since len() would fix the number of queries in an exported program
            lines = queries.new_zeros(queries.shape[0], size)
            # of one query 30 times as fast as index_add
            lines = lines.scatter_add(1, slot[line].expand(terms.shape), terms)
        lines = lines.unflatten(1, (len(chunks), one.count))
        mean = queries @ self.mean.to(queries) * (math.sqrt(length) * one.factor[0].to(queries))
        lines[..., 0] += mean[:, None]
        return from_slots(lines, length, self.transform).flatten(1)

    def rebuilds(self, queries: int) -> bool:
        """Whether so many queries at once are scored by rebuilding a chunk and one matrix product.

        That is how `scores` chooses what is faster.
        """
        if self.longest * self.dimension > LONG:  # which is gone through many times
            return False
        in_frequency = LINE_COST * len(self.level) + TRANSFORM_COST * self.places
        return queries * in_frequency > (REBUILD_COST + queries) * self.places * self.dimension

    def scores(self, queries: Tensor) -> Tensor:
        """Scores of all places: (Q,K) -> (Q,N)."""
        return self.scores_between(queries, 0, self.places)

    def scores_between(self, queries: Tensor, start: int, stop: int) -> Tensor:
        """See `PlaceMap`: from the chunks that hold these places."""
        return torch.cat([scores for _, scores in self.score_blocks(queries, start, stop)], 1)

    def score_blocks(
        self, queries: Tensor, start: int = 0, stop: int | None = None, rebuild: bool | None = None
    ) -> Iterator[tuple[int, Tensor]]:
        """See `PlaceMap`: of runs of equally long chunks, as many as the processor's cache has room for.

        Args:
            rebuild: whether by descriptors that are rebuilt; None does what is faster, see `rebuilds`.
        """
        stop = self.places if stop is None else stop
        if queries.ndim != 2 or queries.shape[1] != self.dimension:
            raise InputError(
                f"the query descriptors are {tuple(queries.shape)}; the map expects (Q, {self.dimension})"
            )
        queries = queries.to(torch.promote_types(queries.dtype, torch.float32))
        length: Tensor = torch.linalg.vector_norm(queries, dim=1, keepdim=True)
        if self.metric == "cosine":
            queries = queries / torch.where(length > 0, length, 1)
        for chunks, rebuilt in self._ways(queries.shape[0], self._inside(start, stop), rebuild):
            span = self._span(chunks)
            with torch.autocast(queries.device.type, enabled=False):
                scores = self._scores(queries, chunks, rebuilt)
            if self.metric == "l2":
                scores = (scores + length.square()).clamp(min=0)
            low, high = max(start, span.start), min(stop, span.stop)
            yield low, scores[:, low - span.start : high - span.start]

    def _scores(self, queries: Tensor, chunks: range, rebuilt: bool) -> Tensor:
        """Of equally long chunks, (Q,W G); of cosine for queries of length 1, of l2 without their squares."""
        span = self._span(chunks)
        if rebuilt:
            return self._rebuilt_scores(queries, chunks)
        products = self.products(queries, chunks)
        if self.metric == "cosine":
            per_norm = self.per_norm(span.start, span.stop).to(queries)
            return torch.addcmul(queries.new_ones(()), products, per_norm, value=-1)
        return self.norms[span].to(queries).square() - 2 * products

    def product_blocks(self, queries: Tensor) -> Iterator[Tensor]:
        """Inner products with the descriptors of all places, by runs of equally long chunks: (Q,G,W) each."""
        for chunks, rebuilt in self._ways(queries.shape[0], range(len(self.chunks))):
            with torch.autocast(queries.device.type, enabled=False):
                if rebuilt:
                    parts = (queries[:, some] @ part.to(queries) for some, part in self._series(chunks))
                    products = functools.reduce(torch.add, parts)
                else:
                    products = self.products(queries, chunks)
            yield products.unflatten(1, (len(chunks), -1))

    @property
    def block_places(self) -> int:
        return max(COPIES * self.longest, BLOCK // max(1, self.dimension))

    def _ways(self, queries: int, chunks: range, rebuild: bool | None = None) -> Iterator[tuple[range, bool]]:
        """Runs of these chunks for so many queries, and whether they are rebuilt."""
        rows = self.dimension
        if torch.compiler.is_compiling():  # a program keeps one way, whatever the number of queries
            rebuild = False
        else:
            rebuild = self.rebuilds(queries) if rebuild is None else rebuild
            if not rebuild:
                rows = max(1, queries * (1 + len(self.level) // max(1, self.places)))
        for run in self.runs(chunks, max(1, rows)):
            yield run, rebuild

    def _rebuilt_scores(self, queries: Tensor, chunks: range) -> Tensor:
        """By rebuilding the descriptors, (Q,W G); of l2, but for the square of the query."""
        span, cosine = self._span(chunks), self.metric == "cosine"
        scores = queries.new_ones(1, 1) if cosine else self.norms[span].to(queries).square()[None]
        for some, part in self._series(chunks):
            if cosine:
                part *= self.per_norm(span.start, span.stop)  # a pass over (K,n), not over (Q,n)
            scores = torch.addmm(scores, queries[:, some], part.to(queries), alpha=-1 if cosine else -2)
        return scores

    def extend(self, features: Tensor) -> None:
        """Add the places of (n,K) descriptors in chunks of their own; the others stay as they are.

        Convention: the step is that of the last chunk. A last chunk that is short stays short.

        Raises:
            InputError: a map whose chunk is the route, or descriptors that do not fit.
        """
        if self.chunk == "route":
            raise InputError(
                "the map's chunk is the whole route, which cannot be extended; expected a map learned with a "
                "chunk of so many places"
            )
        if not self.places:
            raise InputError("there is no map yet; expected one to extend")
        check_descriptors(features, self.dimension)
        check_sizes(self.places + len(features))
        step, streams = float(self.steps[-1]), self._streams
        added = features.split(int(self.chunk))
        parts = [
            coefficients_of(*_chunk_levels(part, self.mean, step, self.transform, self.resolution))
            for part in added
        ]
        own = Coefficients(self.counts, self.feature, self.level)
        self.counts, self.feature, self.level = joined([own, *parts])
        self.lengths = torch.cat([self.lengths, self.lengths.new_tensor([len(part) for part in added])])
        self.steps = torch.cat([self.steps, self.steps[-1:].expand(len(added))])
        counts = torch.cat([self.visit_counts, self.lengths.new_ones(len(features))])
        self.places += len(features)
        self.count_visits(counts)
        self.loaded()
        self._streams[: len(streams)] = streams
        self.check()

    def packed(self) -> dict[str, Tensor]:
        """As `PlaceMap.packed`: the levels of each chunk compressed, with a table of the chunks."""
        chunks, tensors = self.coded(), super().packed()
        for name in Coefficients._fields:
            del tensors[name]
        streams = [part.stream for part in chunks]
        return tensors | {
            "escapes": torch.cat([part.escapes for part in chunks]),
            "streams": torch.cat([stream.bytes for stream in streams]),
            "stream_table": torch.tensor([[len(one.bytes), one.checksum] for one in streams]),
        }

    def load_packed(self, tensors: dict[str, Tensor], extra: dict[str, Any]) -> None:
        super().load_packed(tensors, extra)
        self._streams = [*_streams_of(tensors)]  # saved again, they are not coded anew

    def unpacked(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """As `PlaceMap.unpacked`: the levels decoded."""
        expected = {
            "lengths": (torch.int64, 1),
            "escapes": (torch.int32, 1),
            "stream_table": (torch.int64, 2),
            "streams": (torch.uint8, 1),
            "mean": (torch.bfloat16, 1),
        }
        for name, (dtype, ndim) in expected.items():
            tensor = tensors.get(name, torch.zeros(()))
            if tensor.dtype != dtype or tensor.ndim != ndim:
                seen = f"is {tuple(tensor.shape)} {tensor.dtype}" if name in tensors else "is missing"
                raise InputError(f"the map's {name} {seen}; expected {dtype} of {ndim} dimensions")
        state, lengths = dict(tensors), tensors["lengths"].tolist()
        table, streams, escapes = (state.pop(name) for name in ("stream_table", "streams", "escapes"))
        if tuple(table.shape) != (len(lengths), 2) or not len(lengths):
            raise InputError(
                f"a stream table {tuple(table.shape)} for {len(lengths)} chunks; expected a row each"
            )
        if min(lengths) < 1:
            raise InputError(f"a chunk of {min(lengths)} places; expected at least 1")
        sizes = table[:, 0].tolist()
        if min(sizes) < 0 or sum(sizes) != len(streams):
            raise InputError(f"the coded lines are {len(streams)} bytes; the table claims {sizes}"[:200])
        coefficients = _decoded(_streams_of(tensors), lengths, escapes, len(state["mean"]))
        return state | coefficients._asdict()

    def disagreement(self) -> str:
        for name, dtype in (("lengths", torch.int64), ("steps", torch.float32)):
            buffer = getattr(self, name)
            if buffer.dtype != dtype or buffer.ndim != 1:
                return f"{name} {tuple(buffer.shape)} {buffer.dtype}; expected {dtype} (G,)"
        own = Coefficients(self.counts, self.feature, self.level)
        problem = disagreement(own, self.dimension)
        if problem:
            return problem
        if len(self.counts) != self.places:
            return f"lines {tuple(self.counts.shape)}; expected ({self.places},)"
        if int(self.lengths.sum()) != self.places or bool((self.lengths < 1).any()):
            return f"chunks of {self.lengths.tolist()} places; expected {self.places} in all"
        if len(self.steps) != len(self.lengths) or not bool(((self.steps > 0) & self.steps.isfinite()).all()):
            return f"steps {self.steps.tolist()}; expected {len(self.lengths)} finite numbers above 0"
        if tuple(self.mean.shape) != (self.dimension,) or not self.mean.isfinite().all():
            return f"a mean {tuple(self.mean.shape)}; expected ({self.dimension},) finite numbers"
        return ""

    def summary(self) -> MapSummary:
        """See `MapSummary`; the parts are those of the route."""
        chunks = []
        for g, (start, stop) in enumerate(self.chunks):
            line, _, value = self.lines(g)
            energy = value.new_zeros(stop - start).index_add(0, line, value.square())
            chunks.append(ChunkSummary(start, stop, self._periods(energy), (), Fraction(0), ()))
        packed = self.packed() if self.places else {}
        names = {"streams": "lines", "mean": "mean", "positions": "positions", "visits": "visits"}
        route = {own: packed[name].nbytes for name, own in names.items() if name in packed}
        route = {name: size for name, size in route.items() if size}
        others = sum(tensor.nbytes for name, tensor in packed.items() if name not in names)
        heard, lines = self.places - self.silent, len(self.level)
        route["chunks"] = others
        return MapSummary(self.kind, self.places, heard, 0, 0, tuple(chunks), route, {}, lines)

    def mapper_of_equal_size(self) -> SpectralMapper:
        """Makes maps of other routes with these settings, that take as many bytes a place.

        All lines count alike: what is fast is noise in a smooth route, but not in one that is not.
        """
        size = (self.summary().route_bytes - self.positions.nbytes) / self.places
        return SpectralMapper(size, None, self.chunk, self.transform, self.metric)

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


class SpectralMapper(Mapper):
    """Codes descriptors along the route: the transform of each number over a chunk, in steps of one size.

    Args:
        route_bytes_per_place: what the map may take for each place, without what does not grow with the
            route; the step is chosen so that its coded lines fit. Positions of frames count, but come on top,
            and a line says so, where they would leave the lines less than half. None, with no step either, is
            5, and more where that holds less than .85 of the variance of ready features, which need not be
            smooth along the route, or where mean and chunks alone take it, as on a short route.
        step: the step itself, in units of the descriptor; then route_bytes_per_place has to be None.
        chunk: places of a chunk: "route" is one chunk, or a number of places; shorter chunks cost more bytes,
            and the map can be extended.
        transform, metric: of the maps, see `SpectralMap`.
        resolution: places; 0 codes all lines alike. The dead zone of a line of period P is
            1 + (resolution / P)^2 times as wide, so that what changes from frame to frame takes no bytes from
            what lasts. Of video of many frames for each place a user tells apart, where such changes are
            mostly noise, 8 makes a better map; where every frame is another place it makes a worse one.

    Shape: descriptors (N,K) -> SpectralMap of N places.

    Convention: the written route is within 2 % of the budget and not above it, unless steps so fine that they
        change no score take less.

    Raises:
        InputError: settings out of range; forward: fewer than two places, descriptors that are not finite or
            all alike, or a budget that cannot be met.

    Example:
        >>> wave = torch.sin(torch.arange(500.0)[:, None] * torch.tensor([0.1, 0.23, 0.37]))
        >>> SpectralMapper()(wave).scores(wave[20:21]).argmin()
        tensor(20)
    """

    kind = SpectralMap.kind
    whitens = True

    def __init__(
        self,
        route_bytes_per_place: float | None = None,
        step: float | None = None,
        chunk: int | Literal["route"] = "route",
        transform: Transform = "dft",
        metric: SpectralMetric = "cosine",
        resolution: float = 0.0,
    ) -> None:
        super().__init__()
        if route_bytes_per_place is not None and step is not None:
            raise InputError(
                f"route_bytes_per_place is {route_bytes_per_place} and step is {step}; expected one of them, "
                "the other None"
            )
        for name, value in (("route_bytes_per_place", route_bytes_per_place), ("step", step)):
            if value is not None and not 0 < value < math.inf:
                raise InputError(f"{name} is {value}; expected a number above 0")
        check_settings(metric, transform, chunk, resolution)
        self.route_bytes_per_place, self.step, self.chunk = route_bytes_per_place, step, chunk
        self.transform, self.metric, self.resolution = transform, metric, resolution
        self.taken, self.ready = 0, False  # see `beside`

    @property
    def budget(self) -> float | None:
        """Bytes per place; None where a step, or the variance that a map holds, decides."""
        own = self.route_bytes_per_place is not None or self.step is not None or self.ready
        return self.route_bytes_per_place if own else ROUTE_BYTES

    @torch.no_grad()
    def forward(self, features: Tensor) -> SpectralMap:
        check_descriptors(features)
        places = len(features)
        lengths = _lengths(places, self.chunk)
        lines = RouteLines(features, lengths, self.transform, self.resolution)
        if not lines.scale > 1e-6 * lines.rms:
            raise InputError(f"the {places} descriptors are all alike; expected a route that changes")
        overhead = lines.mean.nbytes + CHUNK_BYTES * len(lengths)
        overhead += self._within(places, overhead)
        step = self._step(lines, overhead)
        step = float(torch.tensor(step))  # as the file holds it
        needed = None
        if lines.held(step) < LITTLE:
            half = lines.coded_bytes(lines.step_that_holds(0.5), even=True)
            needed = (overhead + half) / places
        coefficients = joined([coefficients_of(*levels) for levels in lines.levels(step)])
        mean = lines.mean
        del lines  # as large as the descriptors
        route = SpectralMap(
            coefficients,
            torch.tensor(lengths, device=features.device),
            features.new_full((len(lengths),), step, dtype=torch.float32),
            mean,
            self.metric,
            self.transform,
            self.chunk,
            self.resolution,
        )
        route.needed = needed
        return route

    def extra_repr(self) -> str:
        names = ("route_bytes_per_place", "step", "chunk", "transform", "metric", "resolution")
        return ", ".join(f"{name}={getattr(self, name)!r}" for name in names)

    def empty(self) -> SpectralMap:
        return SpectralMap(
            metric=self.metric, transform=self.transform, chunk=self.chunk, resolution=self.resolution
        )

    def beside(self, taken: int, ready: bool = False) -> SpectralMapper:
        other = copy.copy(self)
        other.taken, other.ready = taken, ready
        return other

    def _within(self, places: int, overhead: int) -> int:
        """What is taken beside the map, where it counts: over half of the lines' room comes on top of it."""
        if self.budget is None or not self.taken:
            return 0
        if self.taken <= max(0, self.budget * places - overhead) / 2:
            return self.taken
        log.warning(
            "positions of frames take %.3g bytes per place, over half of what "
            "route_bytes_per_place=%g leaves for them and the lines: they come on top of it",
            self.taken / places,
            self.budget,
        )
        return 0

    def _step(self, lines: RouteLines, overhead: int) -> float:
        """The smallest step whose coded lines fit into the budget, to 2 %, or the mapper's own step."""
        if self.step is not None:
            return self.step
        places, numbers = lines.lines.shape
        given = self.route_bytes_per_place
        nothing = lines.coded_bytes(lines.steps[1])  # of no lines
        least = (overhead + nothing) / places
        most = math.floor(least) + 4 * numbers  # all numbers as floats
        if given is not None and not least < given <= most:
            works = math.ceil(least + min(5, 2 * numbers))
            raise InputError(
                f"route_bytes_per_place is {given:g}; expected more than {least:.3g}, which the mean, "
                f"chunks and positions take, such as {works}, and at most {most}, with all numbers as floats"
            )
        budget = ROUTE_BYTES if given is None else given
        short = budget <= least
        if short:
            log.warning(
                "mean and chunks of %d places take %.3g bytes for each, more than the default "
                "route_bytes_per_place of %g: they come on top of it",
                *(places, least, budget),
            )
        step = lines.step_of(max(nothing, budget * places - overhead * (not short)))
        return min(step, lines.step_that_holds(HELD)) if given is None and (self.ready or short) else step


def check_settings(metric: str, transform: str, chunk: int | str, resolution: float) -> None:
    """Refuse settings that no spectral map has."""
    if metric not in get_args(SpectralMetric):
        raise InputError(f"metric {metric!r} is none of a spectral map; expected 'cosine' or 'l2'")
    if transform not in get_args(Transform):
        raise InputError(f"transform {transform!r} is unknown; expected 'dft' or 'dct'")
    whole = isinstance(chunk, int) and not isinstance(chunk, bool) and chunk >= 2
    if chunk != "route" and not whole:
        raise InputError(f"chunk is {chunk!r}; expected 'route' or a number of places, at least 2")
    if not 0 <= resolution < math.inf:
        raise InputError(f"resolution is {resolution}; expected a number of places, 0 or more")


def check_descriptors(features: Tensor, dimension: int | None = None) -> None:
    """Refuse what is no route of descriptors."""
    expected = "K" if dimension is None else dimension
    few = dimension is None and features.ndim == 2 and len(features) < 2
    wrong = features.ndim != 2 or not features.numel() or dimension not in (None, features.shape[1])
    if few or wrong or not features.is_floating_point():
        least = 2 if dimension is None else 1
        raise InputError(
            f"the descriptors are {tuple(features.shape)} {features.dtype}; expected floats (N, {expected}), "
            f"N at least {least}"
        )
    if not all(bool(part.isfinite().all()) for part in features.split(ROWS)):
        raise InputError("the descriptors hold NaN or infinity; expected finite numbers")


def _lengths(places: int, chunk: int | str) -> list[int]:
    """Places of each chunk; the last one takes what is left."""
    size = places if chunk == "route" else int(chunk)
    return [min(size, places - start) for start in range(0, places, size)]


def _lines(series: Tensor, lengths: list[int], transform: Transform) -> Tensor:
    return torch.cat([spectrum(part.T, transform).T for part in series.split(lengths)])
