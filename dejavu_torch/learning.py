"""Learning a map: fit on a sample of the route, then append chunk by chunk (section III-A)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path
from time import monotonic
from typing import NoReturn, cast

import torch
from torch import Tensor

from dejavu_torch.data.moving import Moved
from dejavu_torch.data.traverse import Part
from dejavu_torch.data.turning import Turned
from dejavu_torch.features.descriptor import Descriptor
from dejavu_torch.features.shared import Blocks
from dejavu_torch.features.views import (
    FEWEST_FRAMES,
    LARGE,
    SAMPLE,
    SEGMENT,
    AugmentedFrames,
    LabelledFrames,
    Sample,
    augmented_segments,
    evenly_spaced,
    views_of,
)
from dejavu_torch.features.whitening import STRENGTHS
from dejavu_torch.maps.digest import Digest, digests_of
from dejavu_torch.maps.file import part_of, read_map, write_map
from dejavu_torch.maps.place_map import Mapper, PlaceMap
from dejavu_torch.maps.spectral import SpectralMapper, encode_chunk
from dejavu_torch.maps.spectral_map import Chunk, SpectralMap
from dejavu_torch.maps.spectrum import Transform
from dejavu_torch.memory import concatenate, in_one_thread
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.places.layout import Layout
from dejavu_torch.recognition.calibration import TOLERANCE, Calibration, calibrated, confidence
from dejavu_torch.recognition.centring import learn_turned
from dejavu_torch.recognition.provenance import check_independent
from dejavu_torch.recognition.scorer import OfMap
from dejavu_torch.recognition.views import SHIFTS, best_pairs
from dejavu_torch.text import progress_of
from dejavu_torch.types import Facts, InputError, Traverse, expect

MAX_SEGMENT = 512  # consecutive queries in a calibration
SEGMENT_SCORES = 2**22  # maximum, queries of a segment x places
OWN = 300  # frames of the reference whose look-alikes are asked for
CALIBRATION_SCORES = 2**30  # maximum, frames of a calibration x places
SAVE_INTERVAL = 60  # seconds between two versions of a partial map
MOVED, ELSEWHERE, HALF = 50, -0.6, 0.5  # images that are moved; confidence in a place, and share of them
TURNED, TURNS = 4000, 4  # windows of an area that are turned, at most, and each of them


# `map`, or what does the same elsewhere: encoded chunks in the order of the tasks, as they are ready
MapTasks = Callable[[Callable[[range], Chunk], list[range]], Iterator[Chunk]]


@dataclass(frozen=True)
class ChunkEncoder:
    """Encodes chunks of a traverse with a known whitening, mean and step: all that a process needs.

    Convention: the bytes do not depend on where and in which order chunks are encoded: no batch spans two,
        and the work is done `in_one_thread`, as the rounding of matrix products depends on the threads.
    """

    traverse: Traverse
    descriptor: Descriptor
    mean: Tensor  # (K,)
    step: float
    transform: Transform
    resolution: float
    visits: LabelledFrames | None = None  # frames of another traverse, to average with those of their places

    def __call__(self, frames: range) -> Chunk:
        """A chunk from these frames; InputError as from `feature_batches` and `encode_chunk`."""
        with torch.no_grad(), in_one_thread():
            rows = torch.cat(list(self.descriptor.batches(Part(self.traverse, frames), shared=True)))
            digest = Digest(torch.arange(len(rows)), digests_of(rows))
            if self.visits is not None:
                shown = views_of(self.visits, torch.arange(frames.start, frames.stop))
                rows = averaged(self.descriptor, rows, shown)
            columns = self.traverse.layout.columns_from(frames.start)
            chunk = encode_chunk(rows, self.mean, self.step, self.transform, self.resolution, columns)
            return chunk._replace(digest=digest)  # of the reference, not of means of visits


class Checkpoint:
    """The partial map of a long run, `FILE.part`, with which the same command resumes after a kill.

    Args:
        path: of the map.

    Convention: two runs are the same if they have the same sources (names, frames and their names), settings
        and weights. That a source was edited in between is not noticed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.with_name(f"{path.name}.part")
        self.key: Mapping[str, str] = {}
        self.written, self.kept = monotonic(), 0
        self.opened = False

    def open(self, key: Mapping[str, str], place_map: SpectralMap, descriptor: Descriptor) -> bool:
        """Load the finished part of the run with this key; False if there is none.

        Args:
            place_map, descriptor: to load into; the map has the places that precede the traverse.

        Raises:
            InputError: not a partial map, or one of another run.
        """
        self.key, self.opened = key, True
        if not self.path.exists():
            return False
        try:
            tensors, header = read_map(self.path)
            stored, state = header["run"], header["map"]
        except (InputError, KeyError) as error:
            raise InputError(f"{self.path} is not a partial map; expected no file there") from error
        if stored != key:
            other = [name for name in {**key, **stored} if key.get(name) != stored.get(name)]
            self._refuse(f": its {', '.join(other)} {'differs' if len(other) == 1 else 'differ'}")
        if descriptor.whitening is not None:
            descriptor.whitening.load_state_dict(part_of(tensors, "whitening"))
            descriptor.whitening.lengths = header.get("lengths")
        place_map.load_packed(part_of(tensors, "map"), state)
        return True

    def check_unused(self) -> None:
        """Refuse the partial map of another run, before a run without checkpoints."""
        if self.path.exists():
            self._refuse()

    @property
    def due(self) -> bool:
        """Whether the partial map was last written over `SAVE_INTERVAL` seconds ago."""
        return monotonic() - self.written > SAVE_INTERVAL

    def save(self, place_map: SpectralMap, descriptor: Descriptor, places: int) -> None:
        """Write the partial map, with the first `places` places of a traverse. InputError if this fails; an
        earlier file then stays."""
        tensors = {f"map.{name}": tensor for name, tensor in place_map.packed().items()}
        header: Facts = {"run": dict(self.key), "map": place_map.get_extra_state()}
        if descriptor.whitening is not None:
            learned = descriptor.whitening.state_dict()
            tensors |= {f"whitening.{name}": tensor for name, tensor in learned.items()}
            header["lengths"] = descriptor.whitening.lengths
        write_map(self.path, tensors, header)
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
    return len(traverse) > {1: max(SAMPLE, chunk), 2: LARGE}[traverse.layout.dimensions]


@in_one_thread()
def fit(
    mapper: SpectralMapper,
    descriptor: Descriptor,
    traverse: Traverse,
    second: LabelledFrames | None = None,
    visits: LabelledFrames | None = None,
    progress: bool = False,
) -> SpectralMap:
    """A map without places, but with whitening, mean and step from the sample of a long traverse."""
    sample = Sample.of(traverse.layout, mapper.chunk)
    views = second and sample.views(second)
    frames = Blocks(traverse, sample.frame, sample.sizes)
    rows = descriptor.learn(frames, views, progress, verb="sampling")
    coded = Sample.of_chunks(traverse.layout, sample)
    if coded is not sample:
        sample, frames = coded, Blocks(traverse, coded.frame, coded.sizes)
        rows = torch.cat([*descriptor.batches(frames, progress, "sampling", shared=True)])
    if visits is not None:
        rows = averaged(descriptor, rows, views_of(visits, sample.frame), progress)
    # the sample is charged its share of the fixed bytes
    place_map = mapper.fit(rows, sample.sizes, len(rows) / len(traverse)).to(descriptor.device)
    return place_map.laid_out(traverse.layout)


def append_places(
    place_map: SpectralMap,
    descriptor: Descriptor,
    traverse: Traverse,
    start: int = 0,
    visits: LabelledFrames | None = None,
    progress: bool = False,
    checkpoint: Checkpoint | None = None,
    map_tasks: MapTasks = map,
) -> None:
    """Append the places of a traverse to a map, chunk by chunk; the partial map is saved once a minute.

    Args:
        start: places of the map that precede the traverse. Places after these are finished, as after a kill,
            and are not encoded again.
        map_tasks: encodes the chunks, as `map` in this process or elsewhere.

    Raises:
        InputError: frames that cannot be read, or a full disk; finished chunks are kept.
    """
    frames, route = len(traverse), int(place_map.layout.route_of(torch.tensor(start)))
    coded = place_map.means[route], place_map.step_of(route), place_map.transform, place_map.resolution
    encode = ChunkEncoder(traverse, descriptor, *coded, visits)
    done = range(place_map.places - start)
    sizes = (rows * columns for rows, columns in traverse.layout.sizes(place_map.chunk))
    bounds = pairwise(accumulate(sizes, initial=0))
    tasks = [range(*each) for each in bounds if each[0] >= len(done)]
    held: list[Chunk] = []

    def add() -> None:
        if held:
            chunks, held[:] = [*held], []  # an interruption must not add them twice
            place_map.extend(chunks)
            if checkpoint is not None:
                checkpoint.save(place_map, descriptor, place_map.places - start)

    try:
        with progress_of("learning", frames - len(done), progress) as update:
            for chunk in map_tasks(encode, tasks) if tasks else ():
                held.append(chunk)
                update(chunk.places)
                due = checkpoint is not None and checkpoint.due
                if due or sum(chunk.places for chunk in held) >= SAMPLE:  # each extension copies the map
                    add()
        add()
    except BaseException as error:  # includes an interruption by the user
        if checkpoint is None:
            raise
        with suppress(InputError):  # a full disk
            add()
        if not checkpoint.kept or not isinstance(error, InputError):
            raise
        kept = f"{checkpoint.kept} of {frames} places are kept in {checkpoint.path} for the next run"
        raise InputError(f"{error}; {kept}") from error


def count_drives(place_map: PlaceMap, second: LabelledFrames | None) -> None:
    """Let a map know how many drives, whose places nobody told, have taught its whitening."""
    if second is not None and second.drives and isinstance(place_map, SpectralMap):
        place_map.drives = place_map.steps.new_tensor([second.drives]).int()


def turn_windows(place_map: SpectralMap, descriptor: Descriptor, traverse: Traverse) -> None:
    """Let the map of an area know turned images, by windows of it. Each is turned twice: by the heading of a
    camera, and by one that it may be compared with."""
    count = min(TURNED, TURNS * len(traverse))
    windows = Part(traverse, torch.arange(count) * len(traverse) // count)
    one, other = 360 * torch.rand(2, count, generator=torch.Generator().manual_seed(0))
    with in_one_thread():
        learn_turned(place_map, descriptor.all_of(Turned(Turned(windows, one), other)))


def looks_along(place_map: PlaceMap, descriptor: Descriptor, traverse: Traverse) -> bool:
    """Whether images that are moved sideways show other places of the route, as where a camera looks down and
    drives to its side: most of those that are moved farthest surely look like places elsewhere."""
    ahead = place_map.layout.ahead and descriptor.moves and place_map.fidelity is not None
    if not ahead or not descriptor.fits(place_map.dimension, traverse):
        return False
    count, shifts = min(MOVED, len(traverse)), (max(SHIFTS), min(SHIFTS))
    some = torch.linspace(0, len(traverse) - 1, count).round().long()
    with in_one_thread():
        rows = descriptor.all_of(Moved(Part(traverse, some), shifts))
    pairs = best_pairs(OfMap(place_map, rows), 2, count).map(lambda column: column.view(2 * count, -1))
    far = place_map.layout.distance(pairs.index[:, 0], some.repeat_interleave(2)) > TOLERANCE
    sure = confidence(pairs) > ELSEWHERE
    return float((far & sure).double().mean()) > HALF


@torch.no_grad()
def learn_descriptors(mapper: Mapper, descriptors: Tensor, layout: Layout) -> PlaceMap:
    """The map of descriptors (N,K), whose places lie so; a map of other sizes is refused."""
    if isinstance(mapper, SpectralMapper):
        place_map: PlaceMap = mapper(descriptors, layout)
    else:
        seen = f"{type(mapper).__name__}, and an area of {len(descriptors)} places"
        layout.expect_route("a SpectralMapper for an area", seen)
        place_map = mapper(descriptors).laid_out(layout)
    if (place_map.places, place_map.dimension) != tuple(descriptors.shape):
        seen = f"{place_map.places} places and {place_map.dimension} features"
        seen = f"{type(mapper).__name__} made a map of {seen}"
        raise InputError(f"{seen} from features {tuple(descriptors.shape)}; expected the same numbers")
    place_map.know(descriptors)
    return place_map


def descriptors_of(
    descriptor: Descriptor, views: LabelledFrames, progress: bool = False
) -> tuple[Tensor, Tensor]:
    """Descriptors (n,K) of the frames with a known place, and these places (n,)."""
    rows = concatenate(descriptor.batches(views.traverse, progress, "averaging"), len(views.traverse))
    known = views.places.to(rows.device) >= 0
    return rows[known], views.places[known.to(views.places.device)]


def averaged(descriptor: Descriptor, rows: Tensor, visits: LabelledFrames, progress: bool = False) -> Tensor:
    """Descriptors (N,K) of places, averaged with those of visits to them."""
    if not len(visits.places):
        return rows
    counts = torch.ones(len(rows)).float()
    return with_visits(rows.float(), counts, *descriptors_of(descriptor, visits, progress))


def with_visits(means: Tensor, counts: Tensor, rows: Tensor, places: Tensor) -> Tensor:
    """Means (N,K) of `counts` (N,) visits each, updated with further descriptors (n,K) of places (n,)."""
    before = counts.to(means)[:, None]
    more = places.bincount(minlength=len(means)).to(means)[:, None]
    sums = (means * before).index_add(0, places.to(means.device), rows.to(means))
    return torch.where(more > 0, sums / (before + more), means)


def observation_counts(visits: LabelledFrames, places: int) -> Tensor:
    """The number of frames that show each of N places, (N,); a place beyond them is refused, and frames whose
    places are not given."""
    name, frames = visits.traverse.name, len(visits.traverse)
    seen = f"{name} has {frames} frames and {len(visits.places)} places"
    expect(frames == len(visits.places), "the same number", seen)
    shown = visits.places[visits.places >= 0].cpu()
    if len(shown) and int(shown.max()) >= places:
        raise InputError(f"{name} shows place {int(shown.max())}; expected one of {places}")
    return shown.bincount(minlength=places)


def positions_of(traverse: Traverse | None) -> Tensor:
    """(F,) even steps from the first place to each frame of a resampled traverse; otherwise (0,)."""
    return traverse.positions if isinstance(traverse, ResampledTraverse) else torch.zeros(0).float()


def calibration_of(
    descriptor: Descriptor,
    place_map: PlaceMap,
    reference: Traverse | None,
    views: LabelledFrames | None = None,
    places: Tensor | None = None,
    progress: bool = False,
    reach: int = TOLERANCE,
) -> Calibration:
    """See `DejaVu.calibrate`."""
    places = torch.arange(place_map.places) if places is None else places
    if views is None:
        if reference is None:
            raise InputError("no reference and no views to calibrate by; expected one of them")
        strengths = STRENGTHS if descriptor.whitening is None else descriptor.whitening.strengths
        sizes = len(places), strengths, place_map.places
        segments = augmented_segments(reference, *sizes, span=descriptor.preprocess.span)
        views = LabelledFrames(cast(Traverse, segments), places[segments.places])
    observation_counts(views, place_map.places)  # refuses what does not fit
    counts = place_map.visit_counts.cpu()
    views = views.renumbered(torch.where(counts > 0, torch.arange(place_map.places), -1))
    another = not isinstance(views.traverse, AugmentedFrames)
    if isinstance(views.traverse, AugmentedFrames):
        length = views.traverse.block
    else:
        length = max(SEGMENT, min(MAX_SEGMENT, SEGMENT_SCORES // place_map.places))
        views = _segments_of(views, length, max(FEWEST_FRAMES, CALIBRATION_SCORES // place_map.places))
    name = views.traverse.name
    batches = descriptor.batches(views.traverse, progress, "calibrating")
    descriptors = concatenate(batches, len(views.traverse))
    if another:
        check_independent(place_map, views.traverse, descriptors)
    parts = zip(descriptors.split(length), views.places.split(length), strict=True)
    own = None
    if reference is not None and isinstance(place_map, SpectralMap):
        drawn = evenly_spaced(len(places), 1, min(OWN, len(places)))
        drawn = drawn[(places[drawn] >= 0) & (counts[places[drawn]] > 0)]
        rows = descriptor.batches(Part(reference, drawn), progress, "calibrating")
        own = (concatenate(rows, len(drawn)), places[drawn]) if len(drawn) else None
    try:
        return calibrated(place_map, parts, another, own, reach)
    except InputError as error:
        raise InputError(f"calibrating by {name}: {error}") from error


def _segments_of(views: LabelledFrames, length: int, frames: int) -> LabelledFrames:
    """Evenly spaced segments of views, with about `frames` frames in total."""
    count, wanted = len(views.places) // length, max(1, frames // length)
    if count <= wanted:
        return views
    frame = evenly_spaced(len(views.places), length, wanted)
    return LabelledFrames(Part(views.traverse, frame), views.places[frame.to(views.places.device)])
