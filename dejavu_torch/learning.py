"""How a map is learned: fitted on a sample of the route, then extended chunk by chunk (section III-A)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple, NoReturn

import torch
from torch import Tensor, nn

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.selection import Selection
from dejavu_torch.features.extract import check_alone, feature_batches, warn_of_bright
from dejavu_torch.features.memory import IN_MEMORY, concatenate
from dejavu_torch.features.views import LEAST, STRETCH, AugmentedTraverse, Stretches, Views
from dejavu_torch.features.whitening import STRENGTHS, Whitening
from dejavu_torch.maps.file import part_of, read_map, write_map
from dejavu_torch.maps.place_map import Mapper, PlaceMap
from dejavu_torch.maps.spectral import SpectralMapper, code_chunk
from dejavu_torch.maps.spectral_map import Chunk, SpectralMap
from dejavu_torch.maps.spectrum import Transform
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.recognition.calibration import Calibration, calibrated
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")

SAMPLE = 10_000  # frames that a route is fitted on; a route that has no more is its own sample
STRETCHES = 4  # of a sample, at least
ROWS = 4096  # descriptors on the device at a time
FEW = IN_MEMORY // 4  # bytes of descriptors kept in memory
OFF = 0.02  # of the bytes per place asked for: worth a word
LONGEST_SEGMENT = 512  # queries that a filter follows, to be calibrated by
SEGMENT_SCORES = 2**22  # of the queries of a segment at all places
CALIBRATION_SCORES = 2**30  # of all frames that a map is calibrated by, at all places
SAVED = 60  # seconds from one writing of a partial map to the next


class Describer(NamedTuple):
    """How a model describes frames: all that a process needs for it.

    pipeline: (B,C,H,W) -> (B,D), preprocess and features. whitening: (B,D) -> (B,K), None for none.
    batch_size: frames at a time. device: of the model. bright: traverses whose frames were said to be bright.
    """

    pipeline: nn.Module
    whitening: Whitening | None
    batch_size: int
    device: torch.device
    bright: set[str]

    def features(
        self,
        traverse: Traverse,
        progress: str | None = None,
        on_first: Callable[[Tensor, Tensor], None] | None = None,
    ) -> Iterator[Tensor]:
        """Features of a traverse in batches (B,D), without gradients; see `feature_batches`."""
        return feature_batches(traverse, self.pipeline, self.batch_size, self.device, progress, on_first)

    def descriptors(
        self,
        traverse: Traverse,
        progress: str | None = None,
        on_first: Callable[[Tensor, Tensor], None] | None = None,
    ) -> Iterator[Tensor]:
        """Descriptors of a traverse in batches (B,K), without gradients."""
        return map(self.whitened, self.features(traverse, progress, on_first))

    def whitened(self, features: Tensor) -> Tensor:
        """Descriptors of features, (B,D) -> (B,K); the features themselves without whitening."""
        return features if self.whitening is None else self.whitening(features)

    def require_learning(self, name: str) -> None:
        """Refuse a second traverse that no whitening learns from.

        Raises:
            InputError: naming it.
        """
        if self.whitening is None or self.whitening.fixed:
            seen = "there is no whitening" if self.whitening is None else "the whitening is another map's"
            raise InputError(f"{seen} to learn from {name}; expected one that is learned")

    def warn_of_bright(self, frames: Tensor, name: str) -> None:
        """Once for each traverse, see `warn_of_bright`."""
        if name not in self.bright and warn_of_bright(frames, name):
            self.bright.add(name)

    def reference(
        self,
        traverse: Traverse,
        second: Views | None = None,
        progress: str | None = None,
        spectral: bool = True,
    ) -> Tensor:
        """Descriptors (N,K) of a reference, from which the whitening is learned first, if it is.

        Args:
            second: as of `DejaVu.learn`. spectral: whether a spectral map is made of them: features beyond
                `concatenate`'s share of the memory then whiten by a sample, and many descriptors lie in a
                temporary file, whitened ones as float16, which is finer than any step.
        """

        if second is not None:
            self.require_learning(second.traverse.name)

        def check_first(frames: Tensor, features: Tensor) -> None:
            self.warn_of_bright(frames, traverse.name)
            check_alone(self.pipeline, frames, features, traverse.name)

        def stored(descriptors: Iterator[Tensor]) -> Tensor:
            if spectral:
                return concatenate(descriptors, FEW, half=self.whitening is not None)
            return concatenate(descriptors)

        if self.whitening is None or self.whitening.fixed:
            return stored(self.descriptors(traverse, progress, check_first))
        if spectral and self._has_many_features(traverse):
            sample = Sample.of(traverse.count(), SAMPLE)
            own = second and sample.views(second)
            self.reference(Selection(traverse, sample.frame), own, progress and "sampling")
            return stored(self.descriptors(traverse, progress))
        features = concatenate(self.features(traverse, progress, check_first))
        self._learn_whitening(features, traverse, second, progress)
        return concatenate(self.whitened(part.to(self.device)) for part in features.split(ROWS))

    def _learn_whitening(
        self, features: Tensor, traverse: Traverse, second: Views | None, progress: str | None
    ) -> None:
        whitening = self.whitening
        assert whitening is not None
        if len(features) < 2 and not is_ready(traverse):
            raise InputError(f"{traverse.name} has 1 frame; expected at least 2, as of a traverse")
        looks = "" if second is None else f"by {second.traverse.name}"
        if second is None and not is_ready(traverse) and whitening.views != 0:
            copies = whitening.copies(*features.shape)
            settings = copies, whitening.most_views, whitening.strengths, whitening.seed
            augmented = AugmentedTraverse(traverse, len(features), *settings)
            second, looks = augmented.views, augmented.looks
        if second is None:
            whitening.learn(features)
        else:
            batches = self.features(second.traverse, progress and f"learning what changes: {looks}")
            whitening.learn(features, _with_places(batches, second.places.to(self.device)))
        whitening.to(self.device)

    def _has_many_features(self, traverse: Traverse) -> bool:
        """Whether the features of a traverse are too many to be held, so that a sample has to do."""
        if traverse.length is not None and traverse.length <= SAMPLE:
            return False
        one = next(self.features(Selection(traverse, torch.zeros(1, dtype=torch.int64))))
        frames = traverse.count()
        return frames > SAMPLE and frames * one.nbytes > IN_MEMORY

    def visits(self, views: Views, dimension: int, progress: str | None = None) -> tuple[Tensor, Tensor]:
        """Descriptors (n,K) of the frames that show a place, and these places (n,).

        Raises:
            InputError: descriptors of another dimension or number, or that are not finite.
        """
        name = views.traverse.name
        rows = concatenate(self.descriptors(views.traverse, progress and "averaging"))
        if rows.shape != (len(views.places), dimension):
            seen = f"{name} gives descriptors {tuple(rows.shape)} of {len(views.places)} places"
            raise InputError(f"{seen}; expected one of {dimension} numbers for each")
        if not bool(rows.isfinite().all()):
            raise InputError(f"{name} gives NaN or infinite descriptors; expected finite numbers")
        shown = views.places.to(rows.device) >= 0
        return rows[shown], views.places[shown.to(views.places.device)]

    def read_anywhere(self, views: Views, progress: str | None = None) -> Views:
        """Views that can be read anywhere: as they are, or the features of all, which may lie in a file."""
        if views.traverse.seeks:
            return views
        features = concatenate(self.features(views.traverse, progress and "averaging"))
        return Views(ArrayTraverse(features.cpu(), views.traverse.name), views.places)

    def check_sizes(self, reference: Traverse, query: Traverse) -> int:
        """How many features a frame gives; refuse, before the long work, traverses that do not give as many.

        Raises:
            InputError: naming both.
        """
        one = self._replace(batch_size=1)
        counts = [next(one.features(traverse)).shape[1] for traverse in (reference, query)]
        if counts[0] != counts[1]:
            seen = " and ".join(
                f"{traverse.name} gives {count} features a frame of "
                f"{' x '.join(map(str, traverse.frame_shape))}"
                for traverse, count in zip((reference, query), counts, strict=True)
            )
            raise InputError(f"{seen}; expected as many, as frames of one size give")
        return counts[0]


class Sample(NamedTuple):
    """Evenly spaced stretches of a route; whole chunks of it, where these are short enough.

    frame: (n,) int64, the frames. stretch: how many each stretch has.
    """

    frame: Tensor
    stretch: int

    @classmethod
    def of(cls, frames: int, chunk: int) -> Sample:
        """The sample of a route of over `SAMPLE` frames, coded in chunks of so many.

        Example:
            >>> sample = Sample.of(100_000, chunk=1000)
            >>> len(sample.frame), sample.frame[::1000].tolist()
            (10000, [0, 11000, 22000, 33000, 44000, 55000, 66000, 77000, 88000, 99000])
        """
        stretch = min(chunk, SAMPLE // STRETCHES)
        count, last = SAMPLE // stretch, frames // stretch - 1
        starts = torch.arange(count) * last // (count - 1) * stretch
        return cls((starts[:, None] + torch.arange(stretch)).flatten(), stretch)

    def shown(self, views: Views) -> Views:
        """What another traverse shows of the sample, with places that count in it."""
        places = views.places.cpu()
        at = torch.searchsorted(self.frame, places).clamp(max=len(self.frame) - 1)
        shown = (self.frame[at] == places).nonzero().flatten()
        return Views(Selection(views.traverse, shown), at[shown])

    def views(self, second: Views) -> Views:
        """As `shown`, to learn from.

        Raises:
            InputError: it shows nothing of the sample.
        """
        found = self.shown(second)
        if not len(found.places):
            seen = f"{second.traverse.name} shows none of the {len(self.frame)} frames that are learned from"
            raise InputError(f"{seen}, in stretches of {self.stretch} all along the route; expected some")
        return found


class ChunkCoder(NamedTuple):
    """All that makes coded chunks from frames, once whitening, mean and step are known.

    describer: of the model. frames: N, of the route. chunk: places of a chunk.
    mean, step, transform, resolution: as of `code_chunk`.
    visits: frames of another traverse, averaged with those of the places that they show, if not None; read a
        chunk's frames at a time, so that it has to be one that `seeks`.

    Convention: batches begin where a chunk does, so that what precedes a chunk changes nothing in it.
        Matrix products round differently by the number of threads: work `in_one_thread`.
    """

    describer: Describer
    frames: int
    chunk: int
    mean: Tensor
    step: float
    transform: Transform
    resolution: float
    visits: Views | None = None

    @classmethod
    def like(
        cls, route: SpectralMap, describer: Describer, frames: int, visits: Views | None = None
    ) -> ChunkCoder:
        """For so many frames of a map's route, or of places to append to it."""
        coding = route.chunk, route.means[-1], route.step, route.transform, route.resolution
        return cls(describer, frames, *coding, visits)

    @property
    def total(self) -> int:
        """Chunks of the route."""
        return -(-self.frames // self.chunk)

    def span(self, chunks: range) -> tuple[int, int]:
        """The frames [start, stop) of consecutive chunks."""
        return chunks.start * self.chunk, min(chunks.stop * self.chunk, self.frames)

    @torch.no_grad()
    def chunks(self, traverse: Traverse, wanted: range, progress: str | None = None) -> Iterator[Chunk]:
        """The chunks of these numbers, one after another, holding no more than one.

        Args:
            progress: see `feature_batches`.

        Raises:
            InputError: frames that cannot be read, or as of `feature_batches` and `code_chunk`.
        """
        part = _ByChunks(traverse, *self.span(wanted), self.chunk)
        held: list[Tensor] = []
        done = 0
        for rows in self.describer.descriptors(part, progress):
            held.append(rows)
            done += len(rows)
            if done % self.chunk == 0 or done == part.length:
                rows = torch.cat(held)
                rows = self._averaged(rows, part.start + done - len(rows))
                yield code_chunk(rows, self.mean, self.step, self.transform, self.resolution)
                held = []
        if done < part.length:
            seen = f"{traverse.name} ended at frame {part.start + done}"
            raise InputError(f"{seen}; expected {self.frames} frames, as it had before")

    def _averaged(self, rows: Tensor, start: int) -> Tensor:
        """Descriptors (n,K) of the places from `start` on, averaged with those of the visits."""
        if self.visits is None:
            return rows
        traverse, places = self.visits.traverse, self.visits.places.cpu() - start
        frames = ((places >= 0) & (places < len(rows))).nonzero()[:, 0]
        if not len(frames):
            return rows
        seen = torch.cat([*self.describer.descriptors(Selection(traverse, frames))])
        if len(seen) != len(frames):
            problem = f"{traverse.name} has fewer than the {int(frames[-1]) + 1} frames"
            raise InputError(f"{problem} that it is to show places with; expected these")
        return with_visits(rows, torch.ones(len(rows)), seen, places[frames])


class _ByChunks(Traverse):
    """The frames [start, stop) of a traverse, in batches none of which spans two chunks.

    Batches are as large as they may be, so that their borders do not depend on how the traverse is read.
    """

    length: int

    def __init__(self, traverse: Traverse, start: int, stop: int, chunk: int) -> None:
        self.traverse, self.name, self.start, self.chunk = traverse, traverse.name, start, chunk
        self.length = stop - start
        self.frame = getattr(traverse, "frame", range(stop))[start:stop]  # of the source, for messages

    def batches(self, size: int) -> Iterator[Tensor]:
        held: list[Tensor] = []
        done, wanted = 0, min(size, self.chunk, self.length)
        span = range(self.start, self.start + self.length)
        # what cannot be read is then read with no chunk but its own
        step = self.chunk if self.traverse.seeks else self.length
        parts = (self.traverse.select(span[i : i + step], size) for i in range(0, self.length, step))
        for batch in chain.from_iterable(parts):
            while len(batch):
                part, batch = batch[:wanted], batch[wanted:]
                held.append(part)
                wanted -= len(part)
                done += len(part)
                if not wanted:
                    yield held[0] if len(held) == 1 else torch.cat(held)
                    held, wanted = [], min(size, self.chunk - done % self.chunk, self.length - done)
        if held:  # the traverse ended early
            yield torch.cat(held)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        return self.traverse.frame_shape


#: the chunks of a traverse in order, from this number on: here, or by the workers of a cluster
Code = Callable[[ChunkCoder, Traverse, int, str | None], Iterator[Chunk]]


def code_here(
    coder: ChunkCoder, traverse: Traverse, first: int, progress: str | None = None
) -> Iterator[Chunk]:
    """The chunks of a traverse from number `first` on, made in this process."""
    with in_one_thread():
        yield from coder.chunks(traverse, range(first, coder.total), progress)


@contextmanager
def in_one_thread() -> Iterator[None]:
    """In the block torch computes in one thread, so that the number of cores changes no bit of a product."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class Checkpoint:
    """The partial map of a long run in a file, from which the same command goes on after a kill.

    Args:
        path: of the map; the partial one is `FILE.part` beside it.
        key: digests of all that the chunks are made of, by what it is. Of the source only the files of
            finished chunks have to be as they were: one that cannot be read may be replaced.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.with_name(f"{path.name}.part")
        self.key: Mapping[str, str] = {}
        self.written, self.kept = monotonic(), 0
        self.opened = False

    def open(
        self, key: Mapping[str, str], traverse: Traverse
    ) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
        """What the run of this key has finished of a traverse, tensors and state; None if nothing.

        Raises:
            InputError: the file is of a run with another key, or of none, or finished frames were changed.
        """
        self.key, self.opened, found = key, True, None
        if self.path.exists():
            try:
                tensors, header = read_map(self.path)
                known, state = header["run"], header["state"]
            except (InputError, KeyError) as error:
                seen = f"{self.path} is no partial map"
                raise InputError(f"{seen}; expected none to be there") from error
            if known != key:
                other = [name for name in {**key, **known} if key.get(name) != known.get(name)]
                self._refuse(f": its {', '.join(other)} {'differs' if len(other) == 1 else 'differ'}")
            if state["seen"] != traverse.state(0, state["map"]["places"]):
                self._refuse(": frames of its source were changed")
            found = tensors, state
        return found

    def check_unused(self) -> None:
        """Refuse a run without checkpoints where there is the partial map of another.

        Raises:
            InputError: naming the file.
        """
        if self.path.exists():
            self._refuse()

    @property
    def due(self) -> bool:
        """Whether the partial map was last written over `SAVED` seconds ago."""
        return monotonic() - self.written > SAVED

    def save(self, route: SpectralMap, whitening: Whitening | None, traverse: Traverse) -> None:
        """Write the partial map of a traverse, if it has places.

        Raises:
            InputError: the system refuses it; what was there before stays.
        """
        if not route.places:
            return
        tensors = {f"map.{name}": tensor for name, tensor in route.packed().items()}
        if whitening is not None:
            tensors |= {f"whitening.{name}": tensor for name, tensor in whitening.state_dict().items()}
        extra = {name: getattr(route, name) for name in ("needed", "energy", "error")}
        extra["seen"] = traverse.state(0, route.places)
        write_map(
            self.path, tensors, {"run": dict(self.key), "state": {"map": route.get_extra_state(), **extra}}
        )
        self.written, self.kept = monotonic(), route.places

    def remove(self) -> None:
        """Remove the file, if it is of this run."""
        if self.opened:
            self.path.unlink(missing_ok=True)

    def _refuse(self, why: str = "") -> NoReturn:
        seen = f"{self.path} has finished chunks of another run{why}"
        raise InputError(f"{seen}; expected the command that began it, or the file removed")


def learn_map(
    describer: Describer,
    mapper: Mapper,
    traverse: Traverse,
    second: Views | None = None,
    visits: Views | None = None,
    progress: str | None = None,
    run: tuple[Checkpoint, Callable[[], Mapping[str, str]]] | None = None,
    code: Code = code_here,
) -> PlaceMap:
    """The map of a traverse, and the describer's whitening for it.

    A route of up to `SAMPLE` frames, or of one chunk, is described as a whole, and its map is made from that.
    Of a longer one a sample is described and fitted, and then each chunk described, coded and added, so that
    memory holds a chunk, the sample and the map.

    Args:
        second, visits, code: see `DejaVu.learn`.
        run: where a long run keeps its partial map, and what makes its key.
    """
    overhead = positions_of(traverse).nbytes
    mapper = mapper.with_overhead(overhead, is_ready(traverse))
    if isinstance(mapper, SpectralMapper):
        frames = traverse.count()
        if frames > max(SAMPLE, mapper.chunk):
            counts = visits and observation_counts(visits, frames)
            found = run[0].open(run[1](), traverse) if run else None
            visits = visits and describer.read_anywhere(visits, progress)
            with in_one_thread():
                route = _resumed(describer, mapper, found) or _fitted(
                    describer, mapper, traverse, frames, second, visits, progress, overhead
                )
            coder = ChunkCoder.like(route, describer, frames, visits)
            extend(route, coder, traverse, progress, run and run[0], code)
            if counts is not None:
                route.count_visits(1 + counts)
            _tell_reached(route, mapper)
            return route
    if run is not None:
        run[0].check_unused()
    descriptors = describer.reference(traverse, second, progress, isinstance(mapper, SpectralMapper))
    if visits is None:
        return learn_descriptors(mapper, descriptors)
    counts = observation_counts(visits, len(descriptors))
    seen = describer.visits(visits, descriptors.shape[1], progress)
    means = with_visits(descriptors.float(), torch.ones(len(descriptors)), *seen)
    whole = learn_descriptors(mapper, means)
    whole.count_visits(1 + counts)
    return whole


@torch.no_grad()
def learn_descriptors(mapper: Mapper, descriptors: Tensor) -> PlaceMap:
    """The map that a mapper makes from descriptors (N,K).

    Raises:
        InputError: a map of other sizes.
    """
    route: PlaceMap = mapper(descriptors)
    if route.places != len(descriptors) or route.dimension != descriptors.shape[1]:
        raise InputError(
            f"{type(mapper).__name__} made a map of {route.places} places of {route.dimension} "
            f"features from features {tuple(descriptors.shape)}; expected as many"
        )
    return route


def _resumed(
    describer: Describer, mapper: SpectralMapper, found: tuple[dict[str, Tensor], dict[str, Any]] | None
) -> SpectralMap | None:
    if found is None:
        return None
    tensors, state = found
    if describer.whitening is not None:
        describer.whitening.load_state_dict(part_of(tensors, "whitening"))
    route = mapper.empty().to(describer.device)
    route.load_packed(part_of(tensors, "map"), state["map"])
    route.needed, route.energy, route.error = state["needed"], state["energy"], state["error"]
    return route


def _fitted(
    describer: Describer,
    mapper: SpectralMapper,
    traverse: Traverse,
    frames: int,
    second: Views | None,
    visits: Views | None,
    progress: str | None,
    overhead: int,
) -> SpectralMap:
    """Whitening, mean and step of a long route, from a sample of it: a map without places."""
    sample = Sample.of(frames, mapper.chunk)
    own = second and sample.views(second)
    descriptors = describer.reference(Selection(traverse, sample.frame), own, progress and "sampling")
    if visits is not None and len((shown := sample.shown(visits)).places):
        seen = describer.visits(shown, descriptors.shape[1])
        descriptors = with_visits(descriptors.float(), torch.ones(len(descriptors)), *seen)
    # what the file holds once counts for the sample by its share alone
    share, once = len(descriptors) / frames, 2 * descriptors.shape[1]
    counted = round(share * overhead - (1 - share) * once)
    route = mapper.with_overhead(counted, mapper.ready).fit(descriptors, sample.stretch)
    return route.to(describer.device)


def extend(
    route: SpectralMap,
    coder: ChunkCoder,
    traverse: Traverse,
    progress: str | None = None,
    checkpoint: Checkpoint | None = None,
    code: Code = code_here,
) -> None:
    """Extend a map by the chunks of a traverse that it does not have yet, with a partial file each minute.

    Raises:
        InputError: frames that cannot be read, or a full disk; what is finished is kept.
    """
    if len(route.chunks) == coder.total:  # as after a kill at the end
        return
    held: list[Chunk] = []

    def add() -> None:
        if not held:
            return
        route.extend(held)
        held.clear()
        if checkpoint is not None:
            checkpoint.save(route, coder.describer.whitening, traverse)

    try:
        for chunk in code(coder, traverse, len(route.chunks), progress):
            held.append(chunk)
            # short chunks together, since the map grows by copies
            if sum(one.places for one in held) >= SAMPLE or (checkpoint is not None and checkpoint.due):
                add()
        add()
    except BaseException as error:  # also if the user interrupts it
        if checkpoint is not None:
            with suppress(InputError):  # as on a full disk
                add()
        if checkpoint is None or not checkpoint.kept or not isinstance(error, InputError):
            raise
        kept = f"{checkpoint.kept} of {coder.frames} places are kept in {checkpoint.path} for the next run"
        raise InputError(f"{error}; {kept}") from error


def _tell_reached(route: SpectralMap, mapper: SpectralMapper) -> None:
    """The bytes of a long route and what it holds, where the sample promised other bytes."""
    wanted, places = mapper.budget, route.places
    summary = route.summary()
    if wanted is None or summary.route_bytes - summary.route["lines"] >= wanted * places:
        return
    overhead = mapper.overhead if 2 * mapper.overhead <= wanted * places else 0
    reached = (summary.route_bytes + overhead) / places
    if abs(reached / wanted - 1) > OFF:
        log.warning(
            "route_bytes_per_place is %g, and the route takes %.3g, for %.0f %% of its variance: its step is "
            "of %d of its %d places",
            *(wanted, reached, 100 * (route.held or 0), SAMPLE, places),
        )


def with_visits(means: Tensor, counts: Tensor, rows: Tensor, places: Tensor) -> Tensor:
    """Means (N,K) of so many visits (N,) each, and of further ones (n,K) to places (n,) as well."""
    before = counts.to(means)[:, None]
    more = places.bincount(minlength=len(means)).to(means)[:, None]
    sums = (means * before).index_add(0, places.to(means.device), rows.to(means))
    return torch.where(more > 0, sums / (before + more), means)


def observation_counts(visits: Views, places: int) -> Tensor:
    """How many frames of visits show each of so many places, (N,).

    Raises:
        InputError: they show a place beyond these.
    """
    shown = visits.places[visits.places >= 0].cpu()
    if len(shown) and int(shown.max()) >= places:
        seen = f"{visits.traverse.name} shows place {int(shown.max())}"
        raise InputError(f"{seen}; expected one of {places}")
    return shown.bincount(minlength=places)


def is_ready(traverse: Traverse | None) -> bool:
    """Whether a traverse is known to hold ready features, not frames."""
    return traverse is not None and len(traverse.frame_shape) == 1


def positions_of(traverse: Traverse | None) -> Tensor:
    """(F,) how many even steps each frame of a resampled traverse lies from the first place; else (0,)."""
    return traverse.positions if isinstance(traverse, ResampledTraverse) else torch.zeros(0)


def _with_places(batches: Iterator[Tensor], places: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Batches of features, each with the places (B,) that they show; those that show none left out."""
    done = 0
    for batch in batches:
        shown = places[done : done + len(batch)]
        yield batch[shown >= 0], shown[shown >= 0]
        done += len(batch)


def calibration_of(
    describer: Describer,
    route: PlaceMap,
    reference: Traverse | None,
    views: Views | None = None,
    places: Tensor | None = None,
) -> Calibration:
    """How probably answers of a map are right, by how much they stand out; see `DejaVu.calibrate`."""
    if views is None:
        if reference is None:
            raise InputError("neither a reference nor views to calibrate by; expected one of them")
        whitening = describer.whitening
        strengths = STRENGTHS if whitening is None else whitening.strengths
        places = torch.arange(route.places) if places is None else places
        stretches = Stretches(reference, len(places), strengths, places=route.places)
        views = Views(stretches, places[stretches.places])
    name, another = views.traverse.name, not isinstance(views.traverse, Stretches)
    if isinstance(views.traverse, Stretches):
        length = views.traverse.stretch
    else:
        length = max(STRETCH, min(LONGEST_SEGMENT, SEGMENT_SCORES // route.places))
    if len(views.places) and int(views.places.max()) >= route.places:
        shown = f"{name} shows place {int(views.places.max())}"
        raise InputError(f"{shown}; expected one of the map's {route.places}")
    if another:
        views = _segments_of(views, length, max(LEAST, CALIBRATION_SCORES // route.places))
    descriptors = concatenate(describer.descriptors(views.traverse))
    if len(descriptors) != len(views.places):
        seen = f"{name} has {len(descriptors)} frames and {len(views.places)} places"
        raise InputError(f"{seen}; expected as many")
    parts = zip(descriptors.split(length), views.places.split(length), strict=True)
    try:
        return calibrated(route, parts, another)
    except InputError as error:
        raise InputError(f"calibrating by {name}: {error}") from error


def _segments_of(views: Views, length: int, most: int) -> Views:
    """Evenly spaced segments of views, of that length and about `most` frames in all; all if there are no
    more."""
    count, wanted = len(views.places) // length, max(1, most // length)
    if count <= wanted:
        return views
    starts = torch.arange(wanted) * (count - 1) // max(1, wanted - 1) * length
    frame = (starts[:, None] + torch.arange(length)).flatten()
    return Views(Selection(views.traverse, frame), views.places[frame.to(views.places.device)])
