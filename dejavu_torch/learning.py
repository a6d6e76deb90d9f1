"""How a map is learned: fitted on a sample of the route, then extended chunk by chunk (section III-A)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from itertools import chain, islice
from pathlib import Path
from time import monotonic
from typing import NamedTuple, NoReturn

import torch
from torch import Tensor, nn

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.data.frame_range import Selection
from dejavu_torch.features.extract import check_alone, feature_batches, warn_of_bright
from dejavu_torch.features.joined import groups_of
from dejavu_torch.features.views import (
    LEAST,
    STRETCH,
    AugmentedTraverse,
    Views,
    augmented_route,
    augmented_segments,
)
from dejavu_torch.features.whitening import STRENGTHS, Whitening
from dejavu_torch.maps.file import part_of, read_map, write_map
from dejavu_torch.maps.place_map import Mapper, PlaceMap
from dejavu_torch.maps.spectral import SpectralMapper, code_chunk
from dejavu_torch.maps.spectral_map import Chunk, SpectralMap
from dejavu_torch.memory import IN_MEMORY, concatenate
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.recognition.calibration import Calibration, calibrated
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")

SAMPLE = 10_000  # frames that a route is fitted on; a route that has no more is its own sample
STRETCHES = 4  # of a sample, at least
ROWS = 4096  # descriptors on the device at a time
FEW = IN_MEMORY // 4  # bytes of descriptors kept in memory
OFF = 0.02  # deviation from the bytes per place, or the share, asked for that is logged
LONGEST_SEGMENT = 512  # queries that a filter follows in a calibration
SEGMENT_SCORES = 2**22  # of the queries of a segment at all places
CALIBRATION_SCORES = 2**30  # of all frames of a calibration at all places
SAVED = 60  # seconds from one writing of a partial map to the next

OnFirst = Callable[[Tensor, Tensor], None]  # of the first batch of frames, and its features


class Describer(NamedTuple):
    """How a model describes frames: all that a process needs for it.

    pipeline: (B,C,H,W) -> (B,D), preprocess and features. whitening: (B,D) -> (B,K), None for none.
    batch_size: frames at a time. device: of the model. warned: (traverse, line) that were logged already.
    """

    pipeline: nn.Module
    whitening: Whitening | None
    batch_size: int
    device: torch.device
    warned: set[tuple[str, str]]

    def features(
        self, traverse: Traverse, progress: str | None = None, on_first: OnFirst | None = None
    ) -> Iterator[Tensor]:
        """Features of a traverse in batches (B,D), without gradients; see `feature_batches`."""
        return feature_batches(traverse, self.pipeline, self.batch_size, self.device, progress, on_first)

    def descriptors(
        self, traverse: Traverse, progress: str | None = None, on_first: OnFirst | None = None
    ) -> Iterator[Tensor]:
        """Descriptors of a traverse in batches (B,K), without gradients."""
        return map(self.whitened, self.features(traverse, progress, on_first))

    def whitened(self, features: Tensor) -> Tensor:
        """Features (B,D) -> descriptors (B,K)."""
        return features if self.whitening is None else self.whitening(features)

    def require_learning(self, name: str) -> None:
        """Refuse a second traverse, by its name, that no whitening learns from."""
        if self.whitening is None or self.whitening.fixed:
            seen = "there is no whitening" if self.whitening is None else "the whitening is another map's"
            raise InputError(f"{seen} to learn from {name}; expected one that is learned")

    def warn_of_bright(self, frames: Tensor, name: str) -> None:
        """Once for each traverse, see `warn_of_bright`."""
        if (name, "bright") not in self.warned and warn_of_bright(frames, name):
            self.warned.add((name, "bright"))

    def reference(
        self,
        traverse: Traverse,
        second: Views | None = None,
        progress: str | None = None,
        spectral: bool = True,
    ) -> Tensor:
        """Descriptors (N,K) of a reference; the whitening is learned from it first, unless it is fixed.

        Args:
            second: see `DejaVu.learn`. spectral: for a spectral map whitening learns from a sample if the
                features exceed the memory, and many descriptors lie in a temporary file, as float16 if they
                are whitened, which is finer than any step.
        """
        learns = self.whitening is not None and not self.whitening.fixed
        if second is not None:
            self.require_learning(second.traverse.name)

        def check_first(frames: Tensor, features: Tensor) -> None:
            self.warn_of_bright(frames, traverse.name)
            check_alone(self.pipeline, frames, features, traverse.name)

        if learns and spectral and self._exceeds_memory(traverse):
            sample = Sample.of(traverse.count(), SAMPLE)
            own = second and sample.views(second)
            self.reference(Selection(traverse, sample.frame), own, progress and "sampling")
        elif learns:
            features = concatenate(self.features(traverse, progress, check_first))
            self._learn_whitening(features, traverse, second, progress)
            return concatenate(self.whitened(part.to(self.device)) for part in features.split(ROWS))
        batches = self.descriptors(traverse, progress, check_first)
        return concatenate(batches, FEW, self.whitening is not None) if spectral else concatenate(batches)

    def _exceeds_memory(self, traverse: Traverse) -> bool:
        """Whether the float32 features of a traverse of over `SAMPLE` frames are too many to keep."""
        frames = traverse.count()
        return frames > SAMPLE and 4 * frames * self.count_features(traverse) > IN_MEMORY

    def _learn_whitening(
        self, features: Tensor, traverse: Traverse, second: Views | None, progress: str | None
    ) -> None:
        whitening = self.whitening
        assert whitening is not None
        if len(features) < 2:
            raise InputError(f"{traverse.name} has 1 frame; expected at least 2, as of a traverse")
        looks = "" if second is None else f"by {second.traverse.name}"
        if second is None and not is_ready(traverse) and whitening.views != 0:
            copies = whitening.copies(*features.shape)
            settings = copies, whitening.most_views, whitening.strengths, whitening.seed
            second, looks = augmented_route(traverse, len(features), *settings)
        groups = (None, None) if is_ready(traverse) else groups_of(self.pipeline)
        if second is None:
            whitening.learn(features, None, *groups)
        else:
            batches = self.features(second.traverse, progress and f"learning what changes: {looks}")
            whitening.learn(features, _with_places(batches, second.places.to(self.device)), *groups)
        whitening.to(self.device)

    def visits(self, views: Views, progress: str | None = None) -> tuple[Tensor, Tensor]:
        """Descriptors (n,K) of the frames that show a place, and these places (n,)."""
        rows = concatenate(self.descriptors(views.traverse, progress and "averaging"))
        if len(rows) != len(views.places):
            seen = (
                f"{views.traverse.name} gives descriptors {tuple(rows.shape)} of {len(views.places)} places"
            )
            raise InputError(f"{seen}; expected one for each")
        shown = views.places.to(rows.device) >= 0
        return rows[shown], views.places[shown.to(views.places.device)]

    def averaged(self, rows: Tensor, visits: Views, progress: str | None = None) -> Tensor:
        """Descriptors (N,K) of places, averaged with those of visits to them."""
        if not len(visits.places):
            return rows
        return with_visits(rows.float(), torch.ones(len(rows)), *self.visits(visits, progress))

    def seekable(self, views: Views, progress: str | None = None) -> Views:
        """Views of a traverse that seeks: as they are, or the features of all, which may lie in a file."""
        if views.traverse.seeks:
            return views
        features = concatenate(self.features(views.traverse, progress and "averaging"))
        return Views(ArrayTraverse(features.cpu(), views.traverse.name), views.places)

    def check_sizes(self, reference: Traverse, query: Traverse) -> int:
        """How many features a frame gives; refuse, before the long work, traverses that do not give as many.

        Raises:
            InputError: naming both.
        """
        counts = [self.count_features(traverse) for traverse in (reference, query)]
        if counts[0] != counts[1]:
            seen = " and ".join(
                f"{traverse.name} gives {count} features a frame of "
                f"{' x '.join(map(str, traverse.frame_shape))}"
                for traverse, count in zip((reference, query), counts, strict=True)
            )
            raise InputError(f"{seen}; expected as many, as frames of one size give")
        return counts[0]

    def count_features(self, traverse: Traverse) -> int:
        """D, of the first frame."""
        return next(self._replace(batch_size=1).features(traverse)).shape[1]


class Sample(NamedTuple):
    """Evenly spaced stretches of a route; whole chunks of it, if these are short enough.

    frame: (n,) int64, the frames. stretch: frames of each stretch.
    """

    frame: Tensor
    stretch: int

    @classmethod
    def of(cls, frames: int, chunk: int) -> Sample:
        """The sample of a route of over `SAMPLE` frames that is coded in chunks of `chunk`.

        Example:
            >>> sample = Sample.of(100_000, chunk=1000)
            >>> len(sample.frame), sample.frame[::1000].tolist()
            (10000, [0, 11000, 22000, 33000, 44000, 55000, 66000, 77000, 88000, 99000])
        """
        stretch = min(chunk, SAMPLE // STRETCHES)
        count, last = SAMPLE // stretch, frames // stretch - 1
        starts = torch.arange(count) * last // (count - 1) * stretch
        return cls((starts[:, None] + torch.arange(stretch)).flatten(), stretch)

    def views(self, second: Views) -> Views:
        """What a second traverse shows of the sample; one that shows nothing of it is refused."""
        found = shown_of(second, self.frame)
        if not len(found.places):
            seen = f"{second.traverse.name} shows none of the {len(self.frame)} frames that are learned from"
            raise InputError(f"{seen}, in stretches of {self.stretch} all along the route; expected some")
        return found


def shown_of(views: Views, frames: Tensor) -> Views:
    """What a traverse shows of some frames of a route (n,), increasing, with places that count in these."""
    places = views.places.cpu()
    at = torch.searchsorted(frames, places).clamp(max=len(frames) - 1)
    shown = (frames[at] == places).nonzero().flatten()
    return Views(Selection(views.traverse, shown), at[shown])


class ChunkCoder(NamedTuple):
    """Codes chunks of frames, once whitening, mean and step are known: here, in a process, on a machine.

    describer: of the model. frames: N, of the route. chunk: places of a chunk. code: descriptors (W,K) of a
    chunk -> Chunk. visits: frames of a traverse that `seeks`, averaged with those of the places that they
    show; None averages nothing.

    Convention: no batch spans two chunks, so that what precedes a chunk changes nothing in it. Matrix
        products round differently by the number of threads: the work is done `in_one_thread`.
    """

    describer: Describer
    frames: int
    chunk: int
    code: Callable[[Tensor], Chunk]
    visits: Views | None = None

    @classmethod
    def like(
        cls, route: SpectralMap, describer: Describer, frames: int, visits: Views | None = None
    ) -> ChunkCoder:
        """For so many frames of a map's route, or of places to append to it."""
        settings = {"transform": route.transform, "resolution": route.resolution}
        code = partial(code_chunk, mean=route.means[-1], step=route.step, **settings)  # type: ignore[arg-type]
        return cls(describer, frames, route.chunk, code, visits)

    @property
    def total(self) -> int:
        """Chunks of the route."""
        return -(-self.frames // self.chunk)

    def span(self, chunks: range) -> tuple[int, int]:
        """The frames [start, stop) of consecutive chunks."""
        return chunks.start * self.chunk, min(chunks.stop * self.chunk, self.frames)

    @torch.no_grad()
    def chunks(self, traverse: Traverse, wanted: range, progress: str | None = None) -> Iterator[Chunk]:
        """The chunks of these numbers in order; memory holds one.

        Raises:
            InputError: frames that cannot be read, or as `feature_batches` and `code_chunk`.
        """
        start, stop = self.span(wanted)
        part = _ByChunks(traverse, start, stop, self.chunk)
        held: list[Tensor] = []
        done = start
        with in_one_thread():
            for rows in self.describer.descriptors(part, progress):
                held.append(rows)
                done += len(rows)
                if done % self.chunk == 0 or done == stop:
                    rows, held = torch.cat(held), []
                    if self.visits is not None:
                        shown = shown_of(self.visits, torch.arange(done - len(rows), done))
                        rows = self.describer.averaged(rows, shown)
                    yield self.code(rows)
        if done < stop:
            seen = f"{traverse.name} ended at frame {done}"
            raise InputError(f"{seen}; expected {self.frames} frames, as it had before")


class _ByChunks(Traverse):
    """The frames [start, stop) of a traverse, in batches as large as may be that do not span two chunks."""

    length: int

    def __init__(self, traverse: Traverse, start: int, stop: int, chunk: int) -> None:
        self.traverse, self.name, self.start, self.chunk = traverse, traverse.name, start, chunk
        self.length = stop - start
        self.frame = getattr(traverse, "frame", range(stop))[start:stop]  # of the source, for messages

    def batches(self, size: int) -> Iterator[Tensor]:
        span = range(self.start, self.start + self.length)
        # frames that cannot be read are then read with no chunk but their own
        step = self.chunk if self.traverse.seeks else self.length
        parts = (self.traverse.select(span[i : i + step], size) for i in range(0, self.length, step))
        frames, done = chain.from_iterable(chain.from_iterable(parts)), 0
        while done < self.length:
            wanted = min(size, self.chunk - done % self.chunk, self.length - done)
            batch = [*islice(frames, wanted)]
            if not batch:  # the traverse ended early
                return
            yield torch.stack(batch)
            done += len(batch)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        return self.traverse.frame_shape


#: the chunks of a traverse with these numbers, in order: here, or by the workers of a cluster
Code = Callable[[ChunkCoder, Traverse, range, str | None], Iterator[Chunk]]


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
    """The partial map of a long run, `FILE.part`, from which the same command continues after a kill.

    Args:
        path: of the map.

    Convention: a run is the same if digests of everything that makes the chunks are. Of the source only the
        files of finished chunks must be unchanged: one that cannot be read may be replaced.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.with_name(f"{path.name}.part")
        self.key: Mapping[str, str] = {}
        self.written, self.kept = monotonic(), 0
        self.opened = False

    def open(
        self, key: Mapping[str, str], traverse: Traverse, route: SpectralMap, whitening: Whitening | None
    ) -> bool:
        """Load what the run of this key has finished of a traverse; False if nothing.

        Args:
            route: the map before the traverse, and `whitening`, to load into.

        Raises:
            InputError: the file is of a run with another key, or of none, or finished frames were changed.
        """
        self.key, self.opened = key, True
        if not self.path.exists():
            return False
        try:
            tensors, header = read_map(self.path)
            known, state = header["run"], header["state"]
        except (InputError, KeyError) as error:
            raise InputError(f"{self.path} is no partial map; expected none to be there") from error
        if known != key:
            other = [name for name in {**key, **known} if key.get(name) != known.get(name)]
            self._refuse(f": its {', '.join(other)} {'differs' if len(other) == 1 else 'differ'}")
        if state["seen"] != traverse.state(0, state["map"]["places"] - route.places):
            self._refuse(": frames of its source were changed")
        if whitening is not None:
            whitening.load_state_dict(part_of(tensors, "whitening"))
        route.load_packed(part_of(tensors, "map"), state["map"])
        route.needed, route.energy, route.error = state["needed"], state["energy"], state["error"]
        return True

    def check_unused(self) -> None:
        """Refuse a run without checkpoints if there is the partial map of another."""
        if self.path.exists():
            self._refuse()

    @property
    def due(self) -> bool:
        """Whether the partial map was last written over `SAVED` seconds ago."""
        return monotonic() - self.written > SAVED

    def save(self, route: SpectralMap, whitening: Whitening | None, traverse: Traverse, places: int) -> None:
        """Write the partial map, which holds so many places of a traverse.

        Raises:
            InputError: the system refuses it; what was there before stays.
        """
        tensors = {f"map.{name}": tensor for name, tensor in route.packed().items()}
        if whitening is not None:
            tensors |= {f"whitening.{name}": tensor for name, tensor in whitening.state_dict().items()}
        state = {name: getattr(route, name) for name in ("needed", "energy", "error")}
        state |= {"map": route.get_extra_state(), "seen": traverse.state(0, places)}
        write_map(self.path, tensors, {"run": dict(self.key), "state": state})
        self.written, self.kept = monotonic(), places

    def remove(self) -> None:
        """Remove the file, if it is of this run."""
        if self.opened:
            self.path.unlink(missing_ok=True)

    def _refuse(self, why: str = "") -> NoReturn:
        seen = f"{self.path} has finished chunks of another run{why}"
        raise InputError(f"{seen}; expected the command that began it, or the file removed")


def is_long(traverse: Traverse, chunk: int) -> bool:
    """Whether a route, coded in chunks of so many places, is learned from a sample and chunk by chunk."""
    return traverse.count() > max(SAMPLE, chunk)


@in_one_thread()
def fit(
    mapper: SpectralMapper,
    describer: Describer,
    traverse: Traverse,
    second: Views | None = None,
    visits: Views | None = None,
    progress: str | None = None,
) -> SpectralMap:
    """A map without places: whitening, mean and step of a traverse of over `SAMPLE` frames, by its sample."""
    frames = traverse.count()
    sample = Sample.of(frames, mapper.chunk)
    own = second and sample.views(second)
    rows = describer.reference(Selection(traverse, sample.frame), own, progress and "sampling")
    if visits is not None:
        rows = describer.averaged(rows, shown_of(visits, sample.frame))
    share = len(rows) / frames  # of what the file holds once, the sample pays its share alone
    fitted = mapper.with_overhead(round(share * mapper.overhead)).fit(rows, sample.stretch, share)
    return fitted.to(describer.device)


def append_places(
    route: SpectralMap,
    describer: Describer,
    traverse: Traverse,
    start: int = 0,
    visits: Views | None = None,
    progress: str | None = None,
    checkpoint: Checkpoint | None = None,
    code: Code = ChunkCoder.chunks,
) -> None:
    """Add the places of a traverse to a map, as coded chunks; the partial map is kept once a minute.

    Args:
        start: places of the map that precede the traverse; those behind them are there already, as after a
            kill, and are not made again.

    Raises:
        InputError: frames that cannot be read, or a full disk; what is finished is kept.
    """
    coder = ChunkCoder.like(
        route, describer, traverse.count(), visits and describer.seekable(visits, progress)
    )
    missing = range(-(-(route.places - start) // route.chunk), coder.total)
    held: list[Chunk] = []

    def add() -> None:
        if held:
            chunks, held[:] = [*held], []  # if this is interrupted, they are not added again
            route.extend(chunks)
            if checkpoint is not None:
                checkpoint.save(route, describer.whitening, traverse, route.places - start)

    try:
        for chunk in code(coder, traverse, missing, progress) if missing else ():
            held.append(chunk)
            # short chunks together, since the map grows by copies
            if sum(one.places for one in held) >= SAMPLE or (checkpoint is not None and checkpoint.due):
                add()
        add()
    except BaseException as error:  # also if the user interrupts it
        if checkpoint is None:
            raise
        with suppress(InputError):  # as on a full disk
            add()
        if not checkpoint.kept or not isinstance(error, InputError):
            raise
        kept = f"{checkpoint.kept} of {coder.frames} places are kept in {checkpoint.path} for the next run"
        raise InputError(f"{error}; {kept}") from error


@torch.no_grad()
def learn_descriptors(mapper: Mapper, descriptors: Tensor) -> PlaceMap:
    """The map that a mapper makes from descriptors (N,K); one of other sizes is refused."""
    route: PlaceMap = mapper(descriptors)
    if (route.places, route.dimension) != tuple(descriptors.shape):
        raise InputError(
            f"{type(mapper).__name__} made a map of {route.places} places of {route.dimension} "
            f"features from features {tuple(descriptors.shape)}; expected as many"
        )
    return route


def log_reached(route: SpectralMap, mapper: SpectralMapper) -> None:
    """The bytes of a long route, and the variance that it holds, if the sample promised others."""
    hold, held = mapper.share, route.held or 0
    more = mapper.hold is None and held > (hold or 0)  # as 5 bytes per place hold
    if hold is not None and not mapper.resolution and abs(held - hold) > OFF and not more:
        seen = "hold is %g, and the lines hold %.3g of the variance: their step is of %d of %d places"
        log.warning(seen, *(hold, held, SAMPLE, route.places))
    wanted, places, summary = mapper.route_bytes_per_place, route.places, route.summary()
    if wanted is None or summary.route_bytes - summary.route["lines"] >= wanted * places:
        return
    overhead = mapper.overhead if 2 * mapper.overhead <= wanted * places else 0
    reached = (summary.route_bytes + overhead) / places
    if abs(reached / wanted - 1) > OFF:
        log.warning(
            "route_bytes_per_place is %g, and the route takes %.3g, for %.0f %% of its variance: its step is "
            "of %d of its %d places",
            *(wanted, reached, 100 * held, SAMPLE, places),
        )


def with_visits(means: Tensor, counts: Tensor, rows: Tensor, places: Tensor) -> Tensor:
    """Means (N,K) of so many visits (N,) each, and of further ones (n,K) to places (n,) as well."""
    before = counts.to(means)[:, None]
    more = places.bincount(minlength=len(means)).to(means)[:, None]
    sums = (means * before).index_add(0, places.to(means.device), rows.to(means))
    return torch.where(more > 0, sums / (before + more), means)


def observation_counts(visits: Views, places: int) -> Tensor:
    """How many frames of visits show each of so many places, (N,); a place beyond these is refused."""
    shown = visits.places[visits.places >= 0].cpu()
    if len(shown) and int(shown.max()) >= places:
        seen = f"{visits.traverse.name} shows place {int(shown.max())}"
        raise InputError(f"{seen}; expected one of {places}")
    return shown.bincount(minlength=places)


def is_ready(traverse: Traverse | None) -> bool:
    """Whether a traverse holds ready features, not frames."""
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
    progress: str | None = None,
) -> Calibration:
    """How probably answers of a map are right, by their confidence; see `DejaVu.calibrate`."""
    if views is None:
        if reference is None:
            raise InputError("neither a reference nor views to calibrate by; expected one of them")
        strengths = STRENGTHS if describer.whitening is None else describer.whitening.strengths
        places = torch.arange(route.places) if places is None else places
        segments = augmented_segments(reference, len(places), strengths, route.places)
        views = Views(segments, places[segments.places])
    observation_counts(views, route.places)  # refuses places beyond the map's
    another = not isinstance(views.traverse, AugmentedTraverse)
    if isinstance(views.traverse, AugmentedTraverse):
        length = views.traverse.block
    else:
        length = max(STRETCH, min(LONGEST_SEGMENT, SEGMENT_SCORES // route.places))
        views = _segments_of(views, length, max(LEAST, CALIBRATION_SCORES // route.places))
    name, descriptors = views.traverse.name, concatenate(describer.descriptors(views.traverse, progress))
    if len(descriptors) != len(views.places):
        seen = f"{name} has {len(descriptors)} frames and {len(views.places)} places"
        raise InputError(f"{seen}; expected as many")
    parts = zip(descriptors.split(length), views.places.split(length), strict=True)
    try:
        return calibrated(route, parts, another)
    except InputError as error:
        raise InputError(f"calibrating by {name}: {error}") from error


def _segments_of(views: Views, length: int, most: int) -> Views:
    """Evenly spaced segments of views, about `most` frames in all."""
    count, wanted = len(views.places) // length, max(1, most // length)
    if count <= wanted:
        return views
    starts = torch.arange(wanted) * (count - 1) // max(1, wanted - 1) * length
    frame = (starts[:, None] + torch.arange(length)).flatten()
    return Views(Selection(views.traverse, frame), views.places[frame.to(views.places.device)])
