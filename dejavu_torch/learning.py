"""Learning a map: fit on a sample of the route, then extend chunk by chunk (section III-A)."""

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
from dejavu_torch.features.whitening import INDEPENDENT, MOST_VIEWS, STRENGTHS, Whitening
from dejavu_torch.maps.file import part_of, read_map, write_map
from dejavu_torch.maps.place_map import Mapper, PlaceMap
from dejavu_torch.maps.spectral import SpectralMapper, code_chunk
from dejavu_torch.maps.spectral_map import Chunk, SpectralMap
from dejavu_torch.memory import IN_MEMORY, concatenate
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.recognition.calibration import Calibration, calibrated
from dejavu_torch.types import InputError, Traverse

log = logging.getLogger("dejavu_torch")

SAMPLE = 10_000  # frames that a longer route is fitted on
MIN_SEGMENTS = 4  # of a sample
ROWS = 4096  # descriptors on the device at a time
DESCRIPTOR_MEMORY = IN_MEMORY // 4  # bytes of descriptors kept in memory
MAX_SEGMENT = 512  # consecutive queries in a calibration
SEGMENT_SCORES = 2**22  # maximum, queries of a segment x places
CALIBRATION_SCORES = 2**30  # maximum, frames of a calibration x places
SAVE_INTERVAL = 60  # seconds between two versions of a partial map

OnFirst = Callable[[Tensor, Tensor], None]  # receives the first batch of frames and its features


class Describer(NamedTuple):
    """Describes frames; all that a worker process needs for it."""

    pipeline: nn.Module  # (B,C,H,W) -> (B,D), preprocess and features
    whitening: Whitening | None  # (B,D) -> (B,K)
    batch_size: int
    device: torch.device
    warned: set[tuple[str, str]]  # (traverse, line) of warnings that were logged

    def features(
        self, traverse: Traverse, label: str | None = None, on_first: OnFirst | None = None
    ) -> Iterator[Tensor]:
        """Batches (B,D) of features, without gradients; see `feature_batches`."""
        return feature_batches(traverse, self.pipeline, self.batch_size, self.device, label, on_first)

    def descriptors(
        self, traverse: Traverse, label: str | None = None, on_first: OnFirst | None = None
    ) -> Iterator[Tensor]:
        """Batches (B,K) of descriptors, without gradients."""
        return map(self.whitened, self.features(traverse, label, on_first))

    def whitened(self, features: Tensor) -> Tensor:
        """Features (B,D) -> descriptors (B,K)."""
        return features if self.whitening is None else self.whitening(features)

    def require_learning(self, name: str) -> None:
        """Refuse a second traverse of this name if no whitening learns from it."""
        if self.whitening is None or self.whitening.fixed:
            seen = "there is no whitening" if self.whitening is None else "the whitening is another map's"
            raise InputError(f"{seen} to learn from {name}; expected a whitening that is learned")

    def warn_of_bright(self, frames: Tensor, name: str) -> None:
        """`warn_of_bright`, once for each traverse."""
        if (name, "bright") not in self.warned and warn_of_bright(frames, name):
            self.warned.add((name, "bright"))

    def reference(
        self,
        traverse: Traverse,
        second: Views | None = None,
        label: str | None = None,
        spectral: bool = True,
    ) -> Tensor:
        """Descriptors (N,K) of a reference; the whitening is learned from it first, unless it is fixed.

        Args:
            second: see `DejaVu.learn`.
            spectral: for a spectral map, whitening learns from a sample if the features exceed the memory,
                and many descriptors are kept in a temporary file, as float16 if they are whitened, which is
                finer than any step.
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
            self.reference(Selection(traverse, sample.frame), own, label and "sampling")
        elif learns:
            features = concatenate(self.features(traverse, label, check_first))
            self._learn_whitening(features, traverse, second, label)
            return concatenate(self.whitened(part.to(self.device)) for part in features.split(ROWS))
        storage = (DESCRIPTOR_MEMORY, self.whitening is not None) if spectral else ()
        return concatenate(self.descriptors(traverse, label, check_first), *storage)

    def _exceeds_memory(self, traverse: Traverse) -> bool:
        """Whether the float32 features of a traverse longer than `SAMPLE` exceed the memory."""
        frames = traverse.count()
        return frames > SAMPLE and 4 * frames * self.count_features(traverse) > IN_MEMORY

    def _learn_whitening(
        self, features: Tensor, traverse: Traverse, second: Views | None, label: str | None
    ) -> None:
        whitening = self.whitening
        assert whitening is not None
        if len(features) < 2:
            raise InputError(f"{traverse.name} has 1 frame; expected at least 2")
        source = "" if second is None else f"by {second.traverse.name}"
        if second is None and not is_ready(traverse) and whitening.views != 0:
            copies = whitening.copies(*features.shape)
            settings = copies, MOST_VIEWS, whitening.strengths, whitening.seed
            second, source = augmented_route(traverse, len(features), *settings)
        groups = None if is_ready(traverse) else groups_of(self.pipeline)
        if second is None:
            whitening.learn(features, None, groups)
        else:
            samples = INDEPENDENT * len(features) if isinstance(second.traverse, AugmentedTraverse) else None
            batches = self.features(second.traverse, label and f"learning what changes: {source}")
            shown = _with_places(batches, second.places.to(self.device))
            whitening.learn(features, shown, groups, samples)
        whitening.to(self.device)

    def visits(self, views: Views, label: str | None = None) -> tuple[Tensor, Tensor]:
        """Descriptors (n,K) of the frames with a known place, and these places (n,)."""
        rows = concatenate(self.descriptors(views.traverse, label and "averaging"))
        if len(rows) != len(views.places):
            seen = f"{views.traverse.name} gives {len(rows)} descriptors for {len(views.places)} places"
            raise InputError(f"{seen}; expected one for each")
        known = views.places.to(rows.device) >= 0
        return rows[known], views.places[known.to(views.places.device)]

    def averaged(self, rows: Tensor, visits: Views, label: str | None = None) -> Tensor:
        """Descriptors (N,K) of places, averaged with those of visits to them."""
        if not len(visits.places):
            return rows
        return with_visits(rows.float(), torch.ones(len(rows)).float(), *self.visits(visits, label))

    def seekable(self, views: Views, label: str | None = None) -> Views:
        """Views whose traverse `seeks`: the same, or their features, kept in a file if they are many."""
        if views.traverse.seeks:
            return views
        features = concatenate(self.features(views.traverse, label and "averaging"))
        return Views(ArrayTraverse(features.cpu(), views.traverse.name), views.places)

    def check_sizes(self, reference: Traverse, *queries: Traverse) -> int:
        """The number of features per frame; refuses queries in which it differs before any long work."""
        counts = [self.count_features(traverse) for traverse in (reference, *queries)]
        for query, count in zip(queries, counts[1:], strict=True):
            if count != counts[0]:
                seen = " and ".join(
                    f"{traverse.name} gives {own} features per frame of "
                    f"{' x '.join(map(str, traverse.frame_shape))}"
                    for traverse, own in ((reference, counts[0]), (query, count))
                )
                raise InputError(f"{seen}; expected the same number, from frames of the same size")
        return counts[0]

    def count_features(self, traverse: Traverse) -> int:
        """D, from the first frame."""
        return next(self._replace(batch_size=1).features(traverse)).shape[1]


class Sample(NamedTuple):
    """Evenly spaced segments of a route: whole chunks, if these are short enough."""

    frame: Tensor  # (n,) int64
    segment: int  # frames of each segment

    @classmethod
    def of(cls, frames: int, chunk: int) -> Sample:
        """The sample of a route longer than `SAMPLE`, coded in chunks of `chunk` places.

        Example:
            >>> sample = Sample.of(100_000, chunk=1000)
            >>> len(sample.frame), sample.frame[::1000].tolist()
            (10000, [0, 11000, 22000, 33000, 44000, 55000, 66000, 77000, 88000, 99000])
        """
        segment = min(chunk, SAMPLE // MIN_SEGMENTS)
        return cls(evenly_spaced(frames, segment, SAMPLE // segment), segment)

    def views(self, second: Views) -> Views:
        """The views of the sample in a second traverse; InputError if there are none."""
        views = views_of(second, self.frame)
        if not len(views.places):
            seen = f"{second.traverse.name} shows none of the {len(self.frame)} frames that are learned from"
            raise InputError(f"{seen}, in segments of {self.segment} along the route; expected some")
        return views


def evenly_spaced(frames: int, length: int, count: int) -> Tensor:
    """The frames (count * length,) of evenly spaced segments, from the first whole one to the last."""
    starts = torch.arange(count) * (frames // length - 1) // max(1, count - 1) * length
    return (starts[:, None] + torch.arange(length)).flatten()


def views_of(views: Views, frames: Tensor) -> Views:
    """The views of some frames (n,) of a route, increasing; their places are indices into these frames."""
    places = views.places.cpu()
    at = torch.searchsorted(frames, places).clamp(max=len(frames) - 1)
    shown = (frames[at] == places).nonzero().flatten()
    return Views(Selection(views.traverse, shown), at[shown])


class ChunkCoder(NamedTuple):
    """Codes chunks with known whitening, mean and step, in this process or elsewhere.

    Convention: the bytes of a chunk do not depend on where it is coded. No batch spans two chunks, and
        the work is done `in_one_thread`, as the rounding of matrix products depends on the threads.
    """

    describer: Describer
    frames: int  # N, of the route
    chunk: int  # places of a chunk
    code: Callable[[Tensor], Chunk]  # descriptors (W,K) of a chunk -> Chunk
    visits: Views | None = None  # frames of a traverse that `seeks`, to average with those of their places

    @classmethod
    def like(
        cls, route: SpectralMap, describer: Describer, frames: int, visits: Views | None = None
    ) -> ChunkCoder:
        """A coder for the frames of a map's route, or for frames to append to it."""
        settings = {"transform": route.transform, "resolution": route.resolution}
        code = partial(code_chunk, mean=route.means[-1], step=route.step, **settings)  # type: ignore[arg-type]
        return cls(describer, frames, route.chunk, code, visits)

    @property
    def total(self) -> int:
        """Chunks of the route."""
        return -(-self.frames // self.chunk)

    def span(self, chunks: range) -> tuple[int, int]:
        """The frames [start, stop) of a range of chunks."""
        return chunks.start * self.chunk, min(chunks.stop * self.chunk, self.frames)

    @torch.no_grad()
    def chunks(self, traverse: Traverse, wanted: range, label: str | None = None) -> Iterator[Chunk]:
        """Code a range of chunks, one at a time; InputError as from `feature_batches` and `code_chunk`."""
        part = _ByChunks(traverse, *self.span(wanted), self.chunk)
        batches = self.describer.descriptors(part, label)
        for start in wanted:
            with in_one_thread():  # not while the caller has the chunk
                chunk = self._next(batches, *self.span(range(start, start + 1)), traverse.name)
            yield chunk

    def _next(self, batches: Iterator[Tensor], start: int, stop: int, name: str) -> Chunk:
        """Code the frames [start, stop), of which `batches` has the descriptors next."""
        held, done = [], start
        while done < stop:
            if (rows := next(batches, None)) is None:
                raise InputError(f"{name} ended at frame {done}; expected its {self.frames} frames")
            held.append(rows)
            done += len(rows)
        rows = torch.cat(held)
        if self.visits is not None:
            rows = self.describer.averaged(rows, views_of(self.visits, torch.arange(start, stop)))
        return self.code(rows)


class _ByChunks(Traverse):
    """The frames [start, stop) of a traverse, in batches that do not span two chunks."""

    length: int

    def __init__(self, traverse: Traverse, start: int, stop: int, chunk: int) -> None:
        self.traverse, self.name, self.start, self.chunk = traverse, traverse.name, start, chunk
        self.length = stop - start
        self.frame = getattr(traverse, "frame", range(stop))[start:stop]  # of the source, for messages

    def batches(self, size: int) -> Iterator[Tensor]:
        span = range(self.start, self.start + self.length)
        # an unreadable frame then stops only its own chunk
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


#: codes a range of a traverse's chunks, in order: in this process, or on a cluster
Code = Callable[[ChunkCoder, Traverse, range, str | None], Iterator[Chunk]]


@contextmanager
def in_one_thread() -> Iterator[None]:
    """Makes torch compute in one thread, so that products do not depend on the number of cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class Checkpoint:
    """The partial map of a long run, `FILE.part`, with which the same command resumes after a kill.

    Args:
        path: of the map.

    Convention: two runs are the same if the digests of everything that affects the chunks are equal. Only the
        source files of finished chunks have to be unchanged: an unreadable file may be replaced.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.with_name(f"{path.name}.part")
        self.key: Mapping[str, str] = {}
        self.written, self.kept = monotonic(), 0
        self.opened = False

    def open(
        self, key: Mapping[str, str], traverse: Traverse, route: SpectralMap, whitening: Whitening | None
    ) -> bool:
        """Load the finished part of the run with this key; False if there is none.

        Args:
            route, whitening: to load into; `route` has the places that precede the traverse.

        Raises:
            InputError: not a partial map, one of another run, or finished frames that were changed.
        """
        self.key, self.opened = key, True
        if not self.path.exists():
            return False
        try:
            tensors, header = read_map(self.path)
            known, state = header["run"], header["state"]
        except (InputError, KeyError) as error:
            raise InputError(f"{self.path} is not a partial map; expected no file there") from error
        if known != key:
            other = [name for name in {**key, **known} if key.get(name) != known.get(name)]
            self._refuse(f": its {', '.join(other)} {'differs' if len(other) == 1 else 'differ'}")
        if state["seen"] != traverse.state(0, state["map"]["places"] - route.places):
            self._refuse(": frames of its source were changed")
        if whitening is not None:
            whitening.load_state_dict(part_of(tensors, "whitening"))
        route.load_packed(part_of(tensors, "map"), state["map"])
        return True

    def check_unused(self) -> None:
        """Refuse the partial map of another run, before a run without checkpoints."""
        if self.path.exists():
            self._refuse()

    @property
    def due(self) -> bool:
        """Whether the partial map was last written over `SAVE_INTERVAL` seconds ago."""
        return monotonic() - self.written > SAVE_INTERVAL

    def save(self, route: SpectralMap, whitening: Whitening | None, traverse: Traverse, places: int) -> None:
        """Write the partial map, with the first `places` places of a traverse. InputError if this fails; an
        earlier file then stays."""
        tensors = {f"map.{name}": tensor for name, tensor in route.packed().items()}
        if whitening is not None:
            tensors |= {f"whitening.{name}": tensor for name, tensor in whitening.state_dict().items()}
        state = {"map": route.get_extra_state(), "seen": traverse.state(0, places)}
        write_map(self.path, tensors, {"run": dict(self.key), "state": state})
        self.written, self.kept = monotonic(), places

    def remove(self) -> None:
        """Remove the file, if it is of this run."""
        if self.opened:
            self.path.unlink(missing_ok=True)

    def _refuse(self, why: str = "") -> NoReturn:
        seen = f"{self.path} has finished chunks of another run{why}"
        raise InputError(f"{seen}; expected the command that started it, or the file removed")


def is_long(traverse: Traverse, chunk: int) -> bool:
    """Whether a route with chunks of this many places is learned from a sample, chunk by chunk."""
    return traverse.count() > max(SAMPLE, chunk)


@in_one_thread()
def fit(
    mapper: SpectralMapper,
    describer: Describer,
    traverse: Traverse,
    second: Views | None = None,
    visits: Views | None = None,
    label: str | None = None,
) -> SpectralMap:
    """A map without places, but with whitening, mean and step from the sample of a long traverse."""
    frames = traverse.count()
    sample = Sample.of(frames, mapper.chunk)
    own = second and sample.views(second)
    rows = describer.reference(Selection(traverse, sample.frame), own, label and "sampling")
    if visits is not None:
        rows = describer.averaged(rows, views_of(visits, sample.frame))
    # the sample is charged its share of the fixed bytes
    return mapper.fit(rows, sample.segment, len(rows) / frames).to(describer.device)


def append_places(
    route: SpectralMap,
    describer: Describer,
    traverse: Traverse,
    start: int = 0,
    visits: Views | None = None,
    label: str | None = None,
    checkpoint: Checkpoint | None = None,
    code: Code = ChunkCoder.chunks,
) -> None:
    """Append the places of a traverse to a map, as coded chunks; the partial map is saved once a minute.

    Args:
        start: places of the map that precede the traverse. Places after these are finished, as after a kill,
            and are not coded again.

    Raises:
        InputError: frames that cannot be read, or a full disk; finished chunks are kept.
    """
    coder = ChunkCoder.like(route, describer, traverse.count(), visits and describer.seekable(visits, label))
    missing = range(-(-(route.places - start) // route.chunk), coder.total)
    held: list[Chunk] = []

    def add() -> None:
        if held:
            chunks, held[:] = [*held], []  # an interruption must not add them twice
            route.extend(chunks)
            if checkpoint is not None:
                checkpoint.save(route, describer.whitening, traverse, route.places - start)

    try:
        for chunk in code(coder, traverse, missing, label) if missing else ():
            held.append(chunk)
            # several chunks at a time, since each extension copies the map
            if sum(one.places for one in held) >= SAMPLE or (checkpoint is not None and checkpoint.due):
                add()
        add()
    except BaseException as error:  # includes an interruption by the user
        if checkpoint is None:
            raise
        with suppress(InputError):  # a full disk
            add()
        if not checkpoint.kept or not isinstance(error, InputError):
            raise
        kept = f"{checkpoint.kept} of {coder.frames} places are kept in {checkpoint.path} for the next run"
        raise InputError(f"{error}; {kept}") from error


@torch.no_grad()
def learn_descriptors(mapper: Mapper, descriptors: Tensor) -> PlaceMap:
    """The map of descriptors (N,K); a map of other sizes is refused."""
    route: PlaceMap = mapper(descriptors)
    if (route.places, route.dimension) != tuple(descriptors.shape):
        seen = f"{type(mapper).__name__} made a map of {route.places} places and {route.dimension} features"
        raise InputError(f"{seen} from features {tuple(descriptors.shape)}; expected the same numbers")
    return route


def with_visits(means: Tensor, counts: Tensor, rows: Tensor, places: Tensor) -> Tensor:
    """Means (N,K) of `counts` (N,) visits each, updated with further descriptors (n,K) of places (n,)."""
    before = counts.to(means)[:, None]
    more = places.bincount(minlength=len(means)).to(means)[:, None]
    sums = (means * before).index_add(0, places.to(means.device), rows.to(means))
    return torch.where(more > 0, sums / (before + more), means)


def observation_counts(visits: Views, places: int) -> Tensor:
    """The number of frames that show each of N places, (N,); a place beyond them is refused."""
    shown = visits.places[visits.places >= 0].cpu()
    if len(shown) and int(shown.max()) >= places:
        raise InputError(f"{visits.traverse.name} shows place {int(shown.max())}; expected one of {places}")
    return shown.bincount(minlength=places)


def is_ready(traverse: Traverse | None) -> bool:
    """Whether a traverse holds ready features, not frames."""
    return traverse is not None and len(traverse.frame_shape) == 1


def positions_of(traverse: Traverse | None) -> Tensor:
    """(F,) even steps from the first place to each frame of a resampled traverse; otherwise (0,)."""
    return traverse.positions if isinstance(traverse, ResampledTraverse) else torch.zeros(0).float()


def _with_places(batches: Iterator[Tensor], places: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Batches of features with their places (B,), without frames that show none."""
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
    label: str | None = None,
) -> Calibration:
    """See `DejaVu.calibrate`."""
    if views is None:
        if reference is None:
            raise InputError("no reference and no views to calibrate by; expected one of them")
        strengths = STRENGTHS if describer.whitening is None else describer.whitening.strengths
        places = torch.arange(route.places) if places is None else places
        segments = augmented_segments(reference, len(places), strengths, route.places)
        views = Views(segments, places[segments.places])
    observation_counts(views, route.places)  # refuses places beyond the map's
    another = not isinstance(views.traverse, AugmentedTraverse)
    if isinstance(views.traverse, AugmentedTraverse):
        length = views.traverse.block
    else:
        length = max(STRETCH, min(MAX_SEGMENT, SEGMENT_SCORES // route.places))
        views = _segments_of(views, length, max(LEAST, CALIBRATION_SCORES // route.places))
    name, descriptors = views.traverse.name, concatenate(describer.descriptors(views.traverse, label))
    if len(descriptors) != len(views.places):
        seen = f"{name} has {len(descriptors)} frames and {len(views.places)} places"
        raise InputError(f"{seen}; expected the same number")
    parts = zip(descriptors.split(length), views.places.split(length), strict=True)
    try:
        return calibrated(route, parts, another)
    except InputError as error:
        raise InputError(f"calibrating by {name}: {error}") from error


def _segments_of(views: Views, length: int, frames: int) -> Views:
    """Evenly spaced segments of views, with about `frames` frames in total."""
    count, wanted = len(views.places) // length, max(1, frames // length)
    if count <= wanted:
        return views
    frame = evenly_spaced(len(views.places), length, wanted)
    return Views(Selection(views.traverse, frame), views.places[frame.to(views.places.device)])
