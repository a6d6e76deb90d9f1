"""The spectral map: the strongest lines of every feature's spectrum along the route."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from functools import cache
from itertools import accumulate, pairwise
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from dejavu_torch.maps.codec import Stream, decode
from dejavu_torch.maps.digest import BYTES, PLACES, Digest, digests_of
from dejavu_torch.maps.place_map import PlaceMap, ScoreBlocks, one_of, require
from dejavu_torch.maps.spectrum import Transform, by_frequency, frequencies, from_lines, from_slots, slots
from dejavu_torch.maps.summary import ChunkSummary, MapSummary
from dejavu_torch.memory import is_readable
from dejavu_torch.places.layout import Layout
from dejavu_torch.places.states import Link
from dejavu_torch.types import Facts, InputError, expect

SpectralMetric = Literal["cosine", "l2"]
AGREE = 0.5  # of what differs between places, between two visits to one
MIN_NORM = 1e-6  # of the RMS norm in a chunk, or of the mean's norm: shorter descriptors count as 0
STRONGEST = 10  # periods in a summary
LARGEST = 2**31 - 1  # places of a map, or its coefficients, for int32
GATHERED = 2**12  # queries that are compared with a place each at a time
NUMBERS_AT_ONCE = 2**19  # numbers computed at a time, to stay in the processor's cache
LONG = 2**22  # numbers of a long chunk computed at a time
TOGETHER = 16  # queries multiplied with lines at a time, at least
COPIES = 4  # numbers per place and query: line, transform, score, comparison with the best
FILE = {  # dtype and dimensions of the tensors of a file
    "lengths": (torch.int64, 1),
    "steps": (torch.float32, 1),
    "stream_table": (torch.int64, 2),
    "streams": (torch.uint8, 1),
    "means": (torch.bfloat16, 2),
    "visits": (torch.int32, 2),
    "stage": (torch.int8, 2),
    "stage_scale": (torch.float32, 1),
    "drives": (torch.int32, 1),
    "links": (torch.int32, 2),
    "columns": (torch.int32, 1),
    "turned": (torch.int8, 2),
    "digest": (torch.uint8, 2),
}
LINK_SHARES = 1000  # the probability of a link is stored in thousandths
STAGE = ("stage", "stage_scale", "drives")
RARE = (*STAGE, "links", "columns", "turned", "digest")  # files of maps without them lack these
CHUNK_BYTES = 8 + 4 + 8 + 8  # a chunk's length, step, stream length and checksum in a file

NO_DIGEST = Digest(torch.zeros(0, dtype=torch.int64), torch.zeros(0, BYTES, dtype=torch.uint8))


class Chunk(NamedTuple):
    """Consecutive places as a file stores them; `unseen` are those whose descriptors are 0, from 0; `columns`
    of a tile of an area, row by row; `digest` of those of its places that have one."""

    places: int
    step: float
    stream: Stream
    unseen: tuple[int, ...] = ()
    columns: int = 1
    digest: Digest = NO_DIGEST


class Lines(NamedTuple):
    """Nonzero coefficients: the index of the line, the feature, and the value; (L,) each."""

    line: Tensor
    feature: Tensor
    value: Tensor


class SpectralMap(PlaceMap):
    """A list of coded chunks: the quantised spectrum of descriptors along time, scored without decoding it.

    A phase mean repeated along a chunk (eq. 1) is the descriptor's projection onto the harmonics of 1 / tau.
    This map keeps all lines that are worth their bytes: transform coding with one step for all lines, which
    is reverse water-filling (Cover and Thomas, section 10.3.3).

    Buffers, the tensors of a file:
        lengths: (G,) int64, places of each chunk. steps: (G,) float32, of each chunk.
        streams, stream_table: coded levels; bytes and checksum of each chunk.
        means: (R,K) bfloat16, subtracted from the descriptors of each route; small means are 0.
        stage, stage_scale: (K,K) int8 and (K,), a linear map P that drives have taught: queries and coded
            descriptors are compared after it, see `refined`. drives: (1,) int32, how many, and those that
            taught the whitening without being told where they are. Empty without.
        columns: (G,) int32, of the tiles of an area, see `lines_of`; empty for a route.
        turned: (K,K) int8, of turned images of an area, see `learn_turned`; empty if unknown.
        links: (L,3) int32, steps from a place of a route to one of another, and their probability in
            thousandths; see `connections`.
        digest: (n,9) uint8, of the descriptors as they were learned, before the stage, of the places
            that `layout.thinned` leaves; see `digests_of`. Empty in older files.
    Buffers derived from these:
        counts, feature, level: number of coefficients of each of N lines; for each of L coefficients its
            feature, ascending within a line, and its value in steps; in the smallest dtypes possible.
        norms: (N,) float32, of the coded descriptors, staged; tiny ones are 0 (`MIN_NORM`); infinite for
            places that no frame shows (0 visits), whose scores are +inf.

    Attributes:
        chunks: the places [start, stop) of each.

    Args:
        means: as above; None makes a map that can load any state.
        metric: "cosine": 1 - cosine of query and coded descriptor. "l2": their squared distance.
        transform: see `spectrum`. chunk, resolution: see `SpectralMapper`. step: of the first chunk.

    Shape: scores: descriptors (Q,K) -> (Q,N), lower is better.

    Convention: norm 0, of a place or a query, means cosine 0 and no gradient; a place whose descriptor was 0
        has 0 visits, by cosine. Gradients reach the queries.

    Raises:
        InputError: settings out of range, inconsistent buffers; scores: another dimension.
    """

    kind = "spectral"
    kept = ("positions", "steps", "means", "norms", "stage_scale")
    optional = {  # noqa: RUF012
        "visits": (0, 2),
        "stage": (0, 0),
        "stage_scale": (0,),
        "drives": (0,),
        "links": (0, 3),
        "columns": (0,),
        "turned": (0, 0),
        "digest": (0, BYTES),
    }

    lengths: Tensor
    steps: Tensor
    stream_table: Tensor
    streams: Tensor
    means: Tensor
    stage: Tensor
    stage_scale: Tensor
    drives: Tensor
    links: Tensor
    columns: Tensor
    turned: Tensor
    counts: Tensor
    feature: Tensor
    level: Tensor
    norms: Tensor

    def __init__(
        self,
        means: Tensor | None = None,
        metric: SpectralMetric = "cosine",
        transform: Transform = "dft",
        chunk: int = 10_000,
        resolution: float = 0.0,
        step: float = 0.0,
    ) -> None:
        expect(type(chunk) is int and chunk >= 2, "a number of places, at least 2, as 10000", chunk=chunk)
        expect(0 <= resolution < math.inf, "a number of places, 0 or more", resolution=resolution)
        super().__init__(0, 0 if means is None else means.shape[1])
        self.metric: SpectralMetric = one_of(metric, SpectralMetric, "metric")
        self.transform: Transform = one_of(transform, Transform, "transform")
        self.chunk, self.resolution = chunk, resolution
        self._step = step
        for name in ("counts", "feature", "level", "norms"):
            self.register_buffer(name, None, persistent=False)
        for name, (dtype, ndim) in FILE.items():
            self.register_buffer(name, torch.zeros(self.optional.get(name, (0, 2)[:ndim]), dtype=dtype))
        self._clear()
        if means is not None:
            self.means = means
            self.to(means.device)

    def _clear(self) -> None:
        """Remove all chunks and their decoded lines."""
        for name in ("lengths", "steps", "stream_table", "streams", "visits", "columns", "digest"):
            setattr(self, name, getattr(self, name)[:0])
        self.digested = NO_DIGEST.places
        self.counts = self.lengths.to(_dtype_for(self.dimension))
        self.feature = self.lengths.to(_dtype_for(self.dimension - 1))
        self.level, self.norms = self.lengths.to(torch.int8), self.lengths.float()
        self.chunks: list[tuple[int, int]] = []
        self._bounds = [0]  # of each chunk's coefficients
        self._widths: list[int] = []  # `columns`, 1 along a route
        self.places = 0

    def extend(self, chunks: Iterable[Chunk], levels: Iterable[Tensor] | None = None) -> None:
        """Add the places of coded chunks; the scores of the others do not change.

        Args:
            levels: (W,K) of each chunk, if they are known; else the streams are decoded.

        Raises:
            InputError: an altered stream, or too many places.
        """
        chunks = [*chunks]
        if not chunks:
            return
        places, device = [chunk.places for chunk in chunks], self.device
        if levels is None:
            with ThreadPoolExecutor(torch.get_num_threads()) as pool:
                parts = [*pool.map(lambda c: _nonzero(decode(c.stream, c.places, self.dimension)), chunks)]
        else:
            parts = [_nonzero(level) for level in levels]
        sizes = self.places + sum(places), self._bounds[-1] + sum(len(level) for *_, level in parts)
        seen = f"the map has {sizes[0]} places and {sizes[1]} coefficients"
        expect(max(sizes) <= LARGEST, f"at most {LARGEST} of each: make several maps", seen)

        def append(name: str, *more: Tensor) -> None:
            setattr(self, name, torch.cat([getattr(self, name), *(tensor.to(device) for tensor in more)]))

        for name, column in zip(("counts", "feature", "level"), zip(*parts, strict=True), strict=True):
            append(name, *column)
        self._widths += [chunk.columns for chunk in chunks]
        if max(self._widths) > 1:
            append("columns", self.columns.new_tensor(self._widths[len(self.columns) :]))
        append("lengths", torch.tensor(places))
        append("steps", self.steps.new_tensor([chunk.step for chunk in chunks]))
        append("stream_table", torch.tensor([[len(c.stream.bytes), c.stream.checksum] for c in chunks]))
        append("streams", *(chunk.stream.bytes for chunk in chunks))
        hides = self.metric == "cosine"  # a descriptor of 0 has no direction
        if len(self.visits) or (hides and any(chunk.unseen for chunk in chunks)):
            counts = self.lengths.new_ones(sum(places))
            for start, chunk in zip(accumulate(places, initial=0), chunks, strict=False):
                counts[[start + i for i in chunk.unseen if hides]] = 0
            self.count_visits(torch.cat([self.visit_counts, counts]))
        starts, own = accumulate(places, initial=self.places), Digest(self.digested, self.digest.cpu())
        more = [
            Digest(chunk.digest.places + start, chunk.digest.rows)
            for start, chunk in zip(starts, chunks, strict=False)
        ]
        for chunk, (*_, level) in zip(chunks, parts, strict=True):
            self.chunks.append((self.places, self.places + chunk.places))
            self._bounds.append(self._bounds[-1] + len(level))
            self.places += chunk.places
        norms = [*map(self._norms_of, range(len(self.chunks) - len(chunks), len(self.chunks)))]
        append("norms", *norms)
        if not all(bool(part.isfinite().all()) for part in norms):
            raise InputError("the map does not fit together: its descriptors are not finite")
        self._digest(Digest(*map(torch.cat, zip(own, *more, strict=True))))
        self._hide()

    def know(self, descriptors: Tensor) -> None:
        parts = [digests_of(descriptors[start:stop]) for start, stop in self.chunks]
        self._digest(Digest(torch.arange(self.places), torch.cat(parts)))

    def _digest(self, known: Digest) -> None:
        """Keep what is known of the places that have a digest."""
        places = self.layout.thinned(PLACES, self.places)
        self.digest = known.of(places).to(self.device)
        self.digested = places[: len(self.digest)]

    def count_visits(self, counts: Tensor) -> None:
        super().count_visits(counts)
        if len(counts) == len(self.norms):
            self._hide()

    def _hide(self) -> None:
        """Let no query find the places that no frame shows."""
        if (self.visits[:, 1:] == 0).any():
            self.norms = self.norms.masked_fill(self.visit_counts == 0, math.inf)

    def _norms_of(self, chunk: int) -> Tensor:
        mean = self.staged(self.means[self._routes_of(range(chunk, chunk + 1))].float())
        norms: Tensor
        if len(self.stage):
            norms = torch.linalg.vector_norm(self.staged(self.decode(chunk)), dim=1)
        else:
            norms = torch.stack([part.square_().sum(0) for part in self._features(chunk)]).sum(0).sqrt_()
        least = MIN_NORM * torch.maximum(norms.square().mean().sqrt(), torch.linalg.vector_norm(mean))
        return norms * ~(norms <= least)

    def _routes_of(self, chunks: range) -> Tensor:
        """The route of each chunk."""
        starts = torch.tensor([self.chunks[g][0] for g in chunks], dtype=torch.int64, device=self.device)
        return self.layout.route_of(starts)

    def coded(self) -> list[Chunk]:
        """The chunks as a file stores them, for `extend`."""
        sizes, checksums = self.stream_table.T.tolist()
        streams = map(Stream, self.streams.cpu().split(sizes), checksums)
        lengths = self.lengths.tolist()
        unseen = [
            tuple((counts == 0).nonzero()[:, 0].tolist()) for counts in self.visit_counts.split(lengths)
        ]
        known, ends = Digest(self.digested, self.digest.cpu()), [*accumulate(lengths, initial=0)]
        digest = [known.within(*each) for each in pairwise(ends)]
        return [*map(Chunk, lengths, self.steps.tolist(), streams, unseen, self._columns(), digest)]

    def _columns(self) -> list[int]:
        """The columns of each chunk, from the tensors of a file."""
        known: list[int] = self.columns.tolist()
        return known + [1] * (len(self.lengths) - len(known))

    def width_of(self, chunk: int) -> int:
        """The columns of a chunk, 1 of a route."""
        return self._widths[chunk]

    def size_of(self, chunk: int) -> tuple[int, int]:
        """Rows and columns of a chunk."""
        start, stop = self.chunks[chunk]
        columns = self.width_of(chunk)
        return (stop - start) // columns, columns

    def of_chunks(self, chunks: Iterable[Chunk]) -> SpectralMap:
        """A map of other chunks with this map's mean, settings and device."""
        place_map = self._without_places(self.means)
        place_map.extend(chunks)
        return place_map

    def _without_places(self, means: Tensor) -> SpectralMap:
        """A map without places, with this one's settings, stage and `turned`."""
        place_map = SpectralMap(means, **self.settings())
        for name in (*STAGE, "turned"):
            setattr(place_map, name, getattr(self, name))
        return place_map

    def staged(self, descriptors: Tensor) -> Tensor:
        """Descriptors (B,K) after the stage; themselves without one."""
        if not len(self.stage):
            return descriptors
        staged: Tensor = (descriptors @ self.stage.to(descriptors)) * self.stage_scale.to(descriptors)
        return staged

    def refined(self, projection: Tensor) -> SpectralMap:
        """A map of the same lines, whose descriptors are compared after a further stage, `projection` (K,K),
        behind the present one. Both become one, rounded to 8 bits."""
        both = projection
        if len(self.stage):
            both = self.staged(torch.eye(self.dimension).to(projection)) @ projection
        place_map = self._sharing()
        place_map.stage_scale = (both.abs().amax(0) / 127).float()
        place_map.stage = (both / place_map.stage_scale).round().to(torch.int8)
        place_map.drives = self.drives + 1 if len(self.drives) else self.drives.new_ones(1)
        place_map.norms = torch.cat([*map(place_map._norms_of, range(len(self.chunks)))])
        place_map._hide()
        place_map.check()
        return place_map

    def _sharing(self) -> SpectralMap:
        """A map that shares the lines, to be changed."""
        place_map = copy.copy(self)
        place_map._buffers = {**self._buffers}
        for name in ("chunks", "_bounds", "_widths"):
            setattr(place_map, name, [*getattr(self, name)])
        return place_map

    def with_route(self, name: str, route: SpectralMap, own: str) -> SpectralMap:
        """A map that has the places of another at the end, as a route of this name; `own`: what its own are
        called, if they are one route."""
        place_map, known = self._sharing(), [self.table.counted, route.table.counted]
        place_map.layout = Layout.merged(known, [self.layout.names(own), (name,)])
        place_map.means = torch.cat([self.means, route.means.to(self.means)])
        place_map.extend(route.coded())
        place_map.positions = torch.cat([self.positions, route.positions.to(self.positions)])
        place_map.check()
        return place_map

    def linked(self, links: Sequence[Link]) -> SpectralMap:
        """A map with these connections."""
        place_map = self._sharing()
        rows = [(one, two, round(LINK_SHARES * share)) for one, two, share in links]
        place_map.links = torch.tensor(rows, dtype=torch.int32, device=self.device).view(-1, 3)
        place_map.check()
        return place_map

    @property
    def known_links(self) -> tuple[Link, ...]:
        """Those that drives have taught."""
        return tuple((one, two, share / LINK_SHARES) for one, two, share in self.links.tolist())

    @property
    def connections(self) -> tuple[Link, ...]:
        return self.known_links + super().connections

    @classmethod
    def merged(cls, parts: Sequence[SpectralMap], names: Sequence[Sequence[str]]) -> SpectralMap:
        """The map of the routes of several, which get these names, each with its own mean and steps;
        `growth.merge` checks the maps."""
        place_map = parts[0]._without_places(torch.cat([part.means for part in parts]))
        place_map.layout = Layout.merged([part.table.counted for part in parts], names)
        known = [one for part in parts if len(part.turned) for one in [part.turned] * part.layout.count]
        if known:
            place_map.turned = torch.stack(known).float().mean(0).round().to(torch.int8)
        place_map.extend(chunk for part in parts for chunk in part.coded())
        place_map.positions = torch.cat([part.positions for part in parts])
        place_map.count_visits(torch.cat([part.visit_counts for part in parts]))
        place_map.check()
        return place_map

    def part(self, name: str) -> SpectralMap:
        """The map of one route alone; an InputError if there is no such route."""
        r, routes, coded = self.layout.number(name), self._routes_of(range(len(self.chunks))), self.coded()
        part = self._without_places(self.means[r : r + 1])
        part.layout, part.positions = self.table.only(r)
        part.extend(coded[g] for g in (routes == r).nonzero()[:, 0].tolist())
        part.count_visits(self.visit_counts[self.layout.places_in(r).to(self.device)])
        return part

    def between(self, first: int, last: int) -> SpectralMap:
        """A map of the chunks [first, last), with the same scores."""
        part = self._without_places(self.means[self._routes_of(range(first, last)).unique()])
        part.layout = self.layout.cut(self.chunks[first][0], self.chunks[last - 1][1])
        part.extend(self.coded()[first:last])
        return part

    @property
    def _sizes(self) -> list[int]:
        """The places of each route."""
        layout = self.layout
        return [max(1, layout.places_of(route)) for route in range(layout.count)]

    @property
    def mean(self) -> Tensor:
        """The mean descriptor of all places, (K,) float32."""
        weight = torch.tensor(self._sizes, dtype=torch.float32, device=self.device)
        return (weight / weight.sum()) @ self.means.float()

    @property
    def fidelity(self) -> float:
        """The share of descriptors of length 1, about the mean of their route, that the code keeps; 1 by
        other metrics. Visits agree by about `AGREE`, by which their mean is shorter."""
        if self.metric != "cosine" or not self.places:
            return 1.0
        sizes = torch.tensor(self._sizes).double()
        length = self.staged(self.means.float()).square().sum(1).double().cpu()
        common = float((length * sizes).sum() / sizes.sum()) if len(length) else 0.0
        known = self.norms[self.norms.isfinite()].double().square()
        visits = float(self.visit_counts.double().mean())
        whole = (1 - common) * (1 + (visits - 1) * AGREE) / visits
        return (float(known.mean()) - common) / max(whole, MIN_NORM) if len(known) else 1.0

    @property
    def step(self) -> float:
        """Of the last chunk, and of the next."""
        return float(self.steps[-1]) if len(self.steps) else self._step

    def step_of(self, route: int) -> float:
        """Of the last chunk of a route, and of its next."""
        own = (self._routes_of(range(len(self.chunks))) == route).nonzero()[:, 0]
        return float(self.steps[own[-1]]) if len(own) else self.step

    def lines(self, chunk: int) -> Lines:
        """The coefficients of a chunk, by line and feature."""
        some, (start, stop) = slice(*self._bounds[chunk : chunk + 2]), self.chunks[chunk]
        level = self.level[some]
        line = _rows(self.counts[start:stop], len(level))
        return Lines(line, self.feature[some].long(), level * self.steps[chunk])

    def decode(self, chunk: int) -> Tensor:
        """The coded descriptors of a chunk, (W,K) float32."""
        return torch.cat([*self._features(chunk)]).T

    def _features(self, chunk: int) -> Iterator[Tensor]:
        """The coded descriptors of a chunk, some of their features at a time: (F,W) each."""
        start, stop = self.chunks[chunk]
        units = torch.eye(self.dimension, dtype=torch.float32, device=self.device)
        for some in units.split(max(1, LONG // (stop - start))):
            yield self._all_products(some, range(chunk, chunk + 1))

    def samples(self, chunk: int, spacing: int) -> Tensor:
        """Low-passed descriptors (M,K) at even positions of a chunk, about every `spacing` places along rows
        and columns, from the first lines of each direction."""
        line, feature, value = self.lines(chunk)
        size, cells = self.size_of(chunk), by_frequency(*self.size_of(chunk), self.transform, line.device)
        counts, where = self._counts(chunk, spacing), (self.transform, value.dtype, value.device)
        at = cells[line] // size[1], cells[line] % size[1]
        tables = [slots(n, *where) for n in size]
        widths = [len(slots(count, *where)[1]) for count in counts]
        slot = [table[0][one] for table, one in zip(tables, at, strict=True)]
        kept = ((slot[0] < widths[0]) & (slot[1] < widths[1])).nonzero()[:, 0]
        row, column = (one[kept] for one in slot)
        low = value.new_zeros(self.dimension, *widths)
        low[feature[kept], row, column] = value[kept] * tables[0][1][row] * tables[1][1][column]
        mean = self.means[self._routes_of(range(chunk, chunk + 1))][0].to(low)
        low[:, 0, 0] += mean * (math.sqrt(math.prod(size)) * tables[0][1][0] * tables[1][1][0])
        for axis, (count, n) in enumerate(zip(counts, size, strict=True)):
            if self.transform == "dft" and count % 2 == 0 and count < n:  # half is aliased
                low.narrow(axis + 1, widths[axis] - 2, 2).zero_()
        across = from_slots(low, counts[1], self.transform).mT.contiguous()
        series = from_slots(across, counts[0], self.transform).mT.flatten(1).T
        return series * math.sqrt(math.prod(counts) / math.prod(size))

    def sampled(self, chunk: int, spacing: int) -> Tensor:
        """The places in a chunk nearest to the positions of `samples`, (M,) int64."""
        near = []
        for n, count in zip(self.size_of(chunk), self._counts(chunk, spacing), strict=True):
            half = 0.5 if self.transform == "dct" else 0.0  # DCT places are in the middle of a step
            at = (torch.arange(count, device=self.device) + half) * (n / count) - half
            near.append(at.round().long().clamp(max=n - 1))
        return (near[0][:, None] * self.width_of(chunk) + near[1]).flatten()

    def _counts(self, chunk: int, spacing: int) -> list[int]:
        """Samples of a chunk down its rows and across its columns."""
        return [-(-n // spacing) for n in self.size_of(chunk)]

    def products(self, queries: Tensor, chunks: range) -> Tensor:
        """Inner products of staged queries with all staged descriptors of G chunks of equal length W:
        (Q,K) -> (Q,W G).

        Inverse transforms of products with the lines: O(lines + W log W) per query, not O(W K). No autocast.
        """
        return self._all_products(self._to_stage(queries), chunks)

    def _to_stage(self, queries: Tensor) -> Tensor:
        """Queries of which inner products with the lines are those of staged descriptors."""
        if not len(self.stage):
            return queries
        return (queries * self.stage_scale.to(queries)) @ self.stage.to(queries).T

    def products_at(self, queries: Tensor, places: Tensor) -> Tensor:
        """As `products`, at some places of each query, -inf at those below 0: (Q,K), (Q,M) -> (Q,M)."""
        found = torch.full(places.shape, -math.inf, dtype=queries.dtype, device=places.device)
        starts = torch.tensor([start for start, _ in self.chunks], device=places.device)
        chunk = torch.bucketize(places, starts, right=True) - 1
        for g in chunk.unique().tolist():
            if g >= 0:
                query, column = (chunk == g).nonzero().T
                some, row = query.unique_consecutive(return_inverse=True)
                at = places[query, column] - self.chunks[g][0]
                if len(some) > self.dimension:  # fewer transforms
                    own, rows = self._to_stage(queries), self.decode(g).to(queries)
                    pairs = zip(query.split(GATHERED), at.split(GATHERED), strict=True)
                    each = [(own[some] * rows[near]).sum(1) for some, near in pairs]
                    found[query, column] = torch.cat(each)
                else:
                    found[query, column] = self.products(queries[some], range(g, g + 1))[row, at]
        return found

    def _all_products(self, queries: Tensor, chunks: range) -> Tensor:
        """As `products`, without the stage."""
        parts = [queries]
        if not torch.compiler.is_compiling():  # fewer queries at a time stay in the cache
            places = self.chunks[chunks.stop - 1][1] - self.chunks[chunks.start][0]
            parts = [*queries.split(max(TOGETHER, NUMBERS_AT_ONCE // places))]
        with torch.autocast(queries.device.type, enabled=False):
            products = [self._products(part, chunks) for part in parts]
        return products[0] if len(products) == 1 else torch.cat(products)

    def _products(self, queries: Tensor, chunks: range) -> Tensor:
        first, last = self.chunks[chunks.start][0], self.chunks[chunks.stop - 1][1]
        count, length = len(chunks), (last - first) // len(chunks)
        some = slice(self._bounds[chunks.start], self._bounds[chunks.stop])
        means = queries @ self.means.to(queries).T  # (Q,R)
        if len(self.means) > 1:
            means = means[:, self._routes_of(chunks)]
        if (columns := self.width_of(chunks.start)) > 1:
            lines = sparse_products(queries, self.counts[first:last], self.feature[some], self.level[some])
            lines = lines.unflatten(1, (count, length)) * self.steps[chunks.start : chunks.stop, None]
            lines[..., 0] += means * math.sqrt(length)
            return from_lines(lines, columns, self.transform).flatten(1)
        slot, factor = slots(length, self.transform, queries.dtype, queries.device)
        counts = self.counts[first:last].view(count, length)
        rows = counts.new_zeros(count, len(factor)).index_copy(1, slot, counts).flatten()
        lines = sparse_products(queries, rows, self.feature[some], self.level[some])
        lines = lines.unflatten(1, (count, len(factor)))
        lines = lines * (self.steps[chunks.start : chunks.stop, None].to(factor) * factor)
        lines[..., 0] += means * (math.sqrt(length) * factor[0])
        return from_slots(lines, length, self.transform).flatten(1)

    def _runs(self, rows: int) -> Iterator[range]:
        """Consecutive chunks of equal size, with at most `NUMBERS_AT_ONCE` numbers in this many rows."""
        first = 0
        while first < len(self.chunks):
            start, stop = self.chunks[first]
            most = min(len(self.chunks), first + max(1, NUMBERS_AT_ONCE // (rows * (stop - start))))
            end = first + 1
            size = self.size_of(first)
            while end < most and self.size_of(end) == size:
                end += 1
            yield range(first, end)
            first = end

    def scores(self, queries: Tensor) -> Tensor:
        return torch.cat([scores for _, scores in self.score_blocks(queries)], 1)

    def score_blocks(self, queries: Tensor) -> ScoreBlocks:
        """See `PlaceMap`: blocks of consecutive chunks that fit into the processor's cache."""
        queries, length = self._asked(queries)
        if not queries.shape[0]:  # of which MKL has no transform
            yield 0, queries.new_zeros(0, self.places)
            return
        rows = self.dimension
        if not torch.compiler.is_compiling():  # a compiled program has the same blocks for any Q
            rows = max(1, queries.shape[0] + len(self.level) // max(1, self.places))
        for run in self._runs(rows):
            start, stop = self.chunks[run.start][0], self.chunks[run.stop - 1][1]
            products = self.products(queries, run)
            yield start, scores_of(products, self.norms[start:stop], length, self.metric)

    def scores_at(self, queries: Tensor, places: Tensor) -> Tensor:
        queries, length = self._asked(queries)
        return scores_of(self.products_at(queries, places), self.norms[places], length, self.metric)

    def _asked(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Staged queries, by cosine of length 1, and their lengths (Q,1)."""
        self.check_queries(queries)
        queries = self.staged(queries.to(torch.promote_types(queries.dtype, torch.float32)))
        length: Tensor = torch.linalg.vector_norm(queries, dim=1, keepdim=True)
        return queries / torch.where(length > 0, length, 1) if self.metric == "cosine" else queries, length

    @property
    def block_places(self) -> int:
        longest = max((stop - start for start, stop in self.chunks), default=1)
        return max(COPIES * longest, NUMBERS_AT_ONCE // max(1, self.dimension))

    def settings(self) -> Facts:
        return {name: getattr(self, name) for name in ("metric", "transform", "chunk", "resolution")}

    def get_extra_state(self) -> Facts:
        state = super().get_extra_state()
        state.setdefault("routes", [])
        return state

    def check(self) -> None:
        lengths, means = self.lengths.tolist(), self.means
        fits = min(lengths, default=1) >= 1 and sum(lengths) == self.places
        require(fits, f"chunks of {lengths!s:.100} places; expected {self.places} in all")
        fits, seen = len(lengths) == len(self.steps) == len(self.stream_table), f"{len(self.steps)} steps"
        require(fits, f"{seen} and {len(self.stream_table)} streams; expected {len(lengths)} of each")
        sizes, size = self.stream_table[:, 0].tolist(), len(self.streams)
        fits = min(sizes, default=0) >= 0 and sum(sizes) == size
        require(fits, f"the coded lines are {size} bytes; the table claims {sizes!s:.100}")
        shape = self.layout.count, self.dimension
        fits = means.shape in (shape, (0, self.dimension)) and bool(means.isfinite().all())
        require(not self.places or fits, f"means {tuple(means.shape)}; expected {shape} finite numbers")
        widths, given = self._columns(), len(self.columns)
        fits = given in (0, len(lengths)) and all(map(_divides, widths, lengths))
        require(fits, f"tiles of {widths!s:.100} columns; expected divisors of {lengths!s:.100}")
        tiles = [(places // width, width) for places, width in zip(lengths, widths, strict=True)]
        layout, seen = self.layout, f"{self.layout.places} places of a layout"
        require(layout.places >= self.places, f"{seen}; expected {self.places}")
        layout.expect_tiles(tiles)
        require(bool(self.stage_scale.isfinite().all()), "a stage that is not finite")
        turned, square = tuple(self.turned.shape), 2 * (self.dimension,)
        require(turned in ((0, 0), square), f"turned images {turned}; expected {square}")
        digest, whole = tuple(self.digest.shape), (len(layout.thinned(PLACES, self.places)), BYTES)
        require(digest in ((0, BYTES), whole), f"a digest {digest}; expected {whole}")
        links, most = self.links, self.links.new_tensor([self.places - 1, self.places - 1, LINK_SHARES])
        row = f"rows of two places, and a number up to {LINK_SHARES}"
        fits = bool(((links >= 0) & (links <= most)).all())
        require(fits, f"links {links.tolist()!s:.100}; expected {row}")
        super().check()

    def loaded(self) -> None:
        """Decode the chunks of a file, and restore omitted means of 0."""
        self.digested = self.layout.thinned(PLACES, self.places)[: len(self.digest)]
        chunks, visits = self.coded(), self.visits
        if self.dimension and not len(self.means):
            self.means = self.means.new_zeros(self.layout.count, self.dimension)
        self._clear()
        self.extend(chunks)
        self.visits = visits
        self._hide()

    def packed(self) -> dict[str, Tensor]:
        """See `PlaceMap`; means that are all 0 are omitted."""
        packed = super().packed()
        packed = {name: value for name, value in packed.items() if len(value) or name not in RARE}
        return packed if bool(self.means.any()) else packed | {"means": self.means[:0]}

    def summary(self) -> MapSummary:
        chunks = [ChunkSummary(start, stop, self._periods(g)) for g, (start, stop) in enumerate(self.chunks)]
        packed = self.packed() if self.places else {}
        names = {"streams": "lines", "means": "mean", "positions": "positions", "visits": "visits"}
        stage = sum(packed.pop(name).nbytes for name in STAGE if name in packed)  # with the count of drives
        turned, digest = (packed.pop(name, self.turned[:0]).nbytes for name in ("turned", "digest"))
        route = {part: packed[name].nbytes for name, part in names.items() if name in packed}
        route = {name: size for name, size in route.items() if size}
        route["chunks"] = sum(tensor.nbytes for name, tensor in packed.items() if name not in names)
        covered = int(((self.norms > 0) & self.norms.isfinite()).sum())
        fixed = {"stage": stage, "turned": turned, "digest": digest}
        fixed = {part: size for part, size in fixed.items() if size}
        sizes = len(self.level), self.layout.extents
        return MapSummary(self.kind, self.places, covered, 0, 0, tuple(chunks), route, fixed, *sizes)

    def _periods(self, chunk: int) -> tuple[Fraction, ...]:
        """The periods of the strongest lines, sorted, with the cosine and sine of each frequency together; in
        an area, the distances from wave to wave."""
        line, _, value = self.lines(chunk)
        size = self.size_of(chunk)
        square = (2 * math.prod(size) * frequencies(*size, self.transform)).square().sum(1).round().long()
        found, kind = square.to(line.device).unique(return_inverse=True)
        energy = value.new_zeros(len(found)).index_add_(0, kind[line], value.square())
        strongest = energy[1:].argsort(descending=True, stable=True)[:STRONGEST] + 1
        kept = found[strongest[energy[strongest] > 0]].tolist()
        waves = (2 * math.prod(size) / math.sqrt(one) for one in kept)
        exact = size[1] == 1
        return tuple(
            sorted(
                Fraction(2 * size[0], math.isqrt(one)) if exact else Fraction(wave).limit_denominator(10)
                for one, wave in zip(kept, waves, strict=True)
            )
        )

    def extra_repr(self) -> str:
        return (
            f"places={self.places}, dimension={self.dimension}, lines={len(self.level)}, "
            f"chunks={len(self.chunks)}, metric={self.metric!r}, transform={self.transform!r}"
        )


def _divides(columns: int, places: int) -> bool:
    return columns >= 1 and places % columns == 0


def scores_of(products: Tensor, norms: Tensor, length: Tensor, metric: SpectralMetric) -> Tensor:
    """Scores of places from their inner products with queries, for "cosine" with queries of length 1 or 0.

    Shape: products (Q,N); norms of the places, (N,) or (Q,N); length of the queries (Q,1), for "l2" -> (Q,N).
    """
    if metric == "cosine":
        inverse = torch.where(norms > 0, 1 / norms, 0).to(products)
        unrelated = torch.where(norms.isinf(), norms, 1).to(products)
        return torch.addcmul(unrelated, products, inverse, value=-1)
    return (norms.to(products).square() - 2 * products + length.square()).clamp(min=0)


def sparse_products(queries: Tensor, counts: Tensor, feature: Tensor, level: Tensor) -> Tensor:
    """Products of queries with sparse rows: (Q,K) -> (Q,S).

    Args:
        counts: (S,) nonzero numbers of each row. feature, level: (L,) column and value of each of these.

    Convention: a CSR product on a CPU with MKL, whose matrix is made here since it neither compiles nor
        exports; elsewhere, and for traced tensors and those of torch.func, `scatter_add`. No autocast.
    """
    if is_readable(queries, counts, feature, level) and _has_csr():
        crow = torch.nn.functional.pad(counts.cumsum(0, dtype=torch.int32), (1, 0))
        shape = (len(counts), queries.shape[1])
        rows = torch.sparse_csr_tensor(crow, feature.int(), level.to(queries), shape, check_invariants=False)
        with torch.autocast("cpu", enabled=False):
            if len(queries) == 1:  # takes half the time of a matrix product
                return (rows @ queries[0])[None]
            products: Tensor = rows @ queries.T
        return products.T.contiguous()
    terms = queries.index_select(1, feature.int()) * level.to(queries)
    row = _rows(counts, level.shape[0])
    # shape[0], since len() would fix the number of queries in an exported program
    return queries.new_zeros(queries.shape[0], counts.shape[0]).scatter_add(1, row.expand(terms.shape), terms)


@cache
def _has_csr() -> bool:
    """Whether torch multiplies CSR tensors by MKL. What it warns of once, beta state and checks, is here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.sparse_csr_tensor([0, 1], [0], [1.0], (1, 1), check_invariants=False)
    return bool(torch.backends.mkl.is_available())


def _rows(counts: Tensor, total: int) -> Tensor:
    """The row of each number, (L,) int64; passing L as `total` avoids reading it from the device."""
    rows = torch.arange(counts.shape[0], device=counts.device)
    return rows.repeat_interleave(counts.int(), output_size=total)


def _nonzero(levels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """counts (W,), feature (L,) and level (L,) of levels (W,K)."""
    width, parts = levels.shape[1], []
    for rows in levels.split(max(1, NUMBERS_AT_ONCE // width)):
        nonzero = rows != 0
        counts = nonzero.sum(1).to(_dtype_for(width))
        parts.append((counts, nonzero.nonzero()[:, 1].to(_dtype_for(width - 1)), rows[nonzero]))
    counts, feature, level = (torch.cat(column) for column in zip(*parts, strict=True))
    if level.dtype != torch.int8:
        largest = int(level.abs().max()) if len(level) else 0
        level = level.to(torch.int8 if largest < 2**7 else torch.int16 if largest < 2**15 else torch.int32)
    return counts, feature, level


def _dtype_for(number: int) -> torch.dtype:
    return torch.uint8 if number < 2**8 else torch.int16 if number < 2**15 else torch.int32
