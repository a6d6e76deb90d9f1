"""Batches of frames and their right places, from any traverse."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np
import torch
from pytorch_lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from dejavu_torch.data.files import LARGEST
from dejavu_torch.data.ground_truth import GroundTruth, as_ground_truth, ground_truth_in_places
from dejavu_torch.data.source import as_traverse, routes_of
from dejavu_torch.data.traverse import runs as runs_of
from dejavu_torch.features.augmentation import Augmentation
from dejavu_torch.features.views import SEGMENT
from dejavu_torch.growth import associate
from dejavu_torch.memory import check_room, concatenate, free_memory
from dejavu_torch.model import DejaVu
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.motion.resampling import ResampledTraverse, ground_truth_of, resampled
from dejavu_torch.places.positions import place_of
from dejavu_torch.resize import resize_frames
from dejavu_torch.types import InputError, Traverse, expect

log = logging.getLogger("dejavu_torch")

Given: TypeAlias = str | Any  # a path, on the command line; or what `as_traverse` takes, or several
READ_BATCH = 64  # frames
MIN_FRAMES = 300  # with fewer, a trained network is usually worse than an untrained map
MIN_SEGMENTS = 2  # that are held out


class Batch(NamedTuple):
    """frames: (B,C,H,W) or features (B,D). truth: their right places; a row of -1 if unknown."""

    frames: Tensor
    truth: GroundTruth


class StoredFrames(Dataset[Batch]):
    """Frames (n,C,H,W) uint8, possibly in temporary files (see `concatenate`), or features (n,D) float, of
    one or several traverses, with their right places."""

    def __init__(self, parts: list[Tensor], truth: GroundTruth) -> None:
        self.parts = parts
        self.truth = truth._replace(positives=truth.positives.masked_fill(~truth.judged[:, None], -1))

    @property
    def values(self) -> Tensor:
        """Frames or features of the first traverse."""
        return self.parts[0]

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    def __getitem__(self, index: list[int]) -> Batch:
        frames, first = torch.tensor(index), 0
        chosen = self.values.new_empty(len(frames), *self.values.shape[1:])
        for part in self.parts:  # not joined, as they may lie in files
            here = ((frames >= first) & (frames < first + len(part))).nonzero()[:, 0]
            chosen[here.to(chosen.device)] = part[(frames[here] - first).to(part.device)]
            first += len(part)
        return Batch(as_frames(chosen), GroundTruth(*(part[index] for part in self.truth)))

    def move(self, device: torch.device) -> None:
        """Keep them on the device that trains, if they take at most half of what it has free."""
        free = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else free_memory()
        if device.type != "cpu" and 2 * sum(part.nbytes for part in self.parts) <= free:
            self.parts = [part.to(device) for part in self.parts]


class InOrder(DistributedSampler[list[int]]):  # a class that Lightning does not replace
    """All frames once, in batches; each process gets a contiguous part, without repeated frames."""

    def __init__(self, count: int, batch_size: int, process: int = 0, processes: int = 1) -> None:
        super().__init__(cast(Any, range(count)), processes, process, shuffle=False)
        own = torch.arange(count).tensor_split(processes)[process]
        self.batches = [part.tolist() for part in own.split(batch_size)]

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[list[int]]:
        return iter(self.batches)


class Clips(DistributedSampler[list[int]]):
    """Each frame about once per epoch, in clips of consecutive frames in random order. No clip crosses from
    one run to the next; each process gets its part of a batch."""

    def __init__(
        self, runs: list[range], batch_size: int, clip: int, process: int = 0, processes: int = 1
    ) -> None:
        super().__init__(cast(Any, range(sum(map(len, runs)))), processes, process)
        self.runs, self.clip = runs, clip
        # the same in all processes, whose other random numbers differ
        self.generator = torch.Generator().manual_seed(torch.initial_seed() % 2**63)
        self.began = self.generator.get_state()  # before the latest epoch was drawn
        self.passed = 0  # batches of it that a training had seen when it stopped
        self.total = sum(len(run) // clip for run in runs)
        self.clips = min(batch_size // clip, self.total) // processes  # of a process's part of a batch
        seen = f"there are {self.total} clips of {clip} frames and {processes} processes"
        expect(self.clips, "one for each", seen)

    def __len__(self) -> int:
        return self.total // (self.clips * self.num_replicas)

    def resume(self, began: Tensor, seen: int) -> None:
        """Go on after so many batches of an epoch, or with the next one."""
        self.generator.set_state(began.cpu())
        if seen >= len(self):
            list(self)
        self.passed = seen % len(self)

    def __iter__(self) -> Iterator[list[int]]:
        self.began, passed, self.passed, starts = self.generator.get_state(), self.passed, 0, []
        for run in self.runs:
            offset = int(torch.randint(len(run) % self.clip + 1, (), generator=self.generator))
            starts.append(run.start + offset + torch.arange(len(run) // self.clip) * self.clip)
        order = torch.cat(starts)[torch.randperm(self.total, generator=self.generator)]
        frames = order[:, None] + torch.arange(self.clip)
        batches = frames.split(self.clips * self.num_replicas)[: len(self)]  # complete ones only
        return iter([batch.split(self.clips)[self.rank].flatten().tolist() for batch in batches[passed:]])


class RouteData(LightningDataModule):
    """A reference traverse to train on, and optional others to train on, validate and test with.

    Args:
        source: the reference, whose frames are the places of the map: a source of `open_source`, a Traverse,
            or a tensor of frames or features (see `ArrayTraverse`). A list of several routes, or a folder
            that contains only folders, trains one descriptor for all routes: their places are numbered one
            route after the other, and no clip or tolerance crosses from one to the next.
        second: another traverse of the same route to train on: its frames are positives of the places they
            show. For several routes, a list of the same length, with None for routes without.
        validation: a traverse to validate on during training. None: the reference under a fixed augmentation;
            its figures show what is learned, not the accuracy on another traverse.
        query: the traverse that `test` localizes. `fit` evaluates the final map on it if there is no
            validation.
        second_truth, validation_truth, truth: the places of these three, as --truth of `dejavu compare`. For
            a second traverse of unknown places None means where a smoother places it, on a map of HOG.
        tolerance: places within which one is right, inclusive.
        batch_size: frames of a batch.
        clip: consecutive frames in a batch, which get the same augmentation; 1 draws each frame by itself.
        resize: (height, width) in pixels of the stored frames. None is the size to which the backbone resizes
            them if it is smaller or several routes differ in size, else their own size.
        augmentation: of the training frames; None is `Augmentation` with its defaults.
        velocity: makes places and queries even steps along the ground, as in `DejaVu`.
        held_out: share of the reference's frames that training never sees, in evenly spaced segments of 20,
            on which `MapExport` calibrates and evaluates the final map; at most 0.5, 0 is none. There are no
            segments for templates, routes of fewer than 300 frames, several routes, ready features, or with
            a validation.

    Convention: frames are stored as bytes; beyond `concatenate`'s share of memory they lie in a file.

    Raises:
        InputError: no traverse, one that cannot be read, no longer than the tolerance, without known places,
            or with frames of another size than the reference's; several routes with a validation or a query.

    Example:
        >>> data = RouteData([torch.rand(20, 3, 8, 8), torch.rand(30, 3, 8, 8)], tolerance=2)
        >>> data.setup("fit")
        >>> data.lengths, data.apart(torch.tensor([19, 20]))
        ([20, 30], tensor([19, 22]))
    """

    def __init__(
        self,
        source: Given,
        second: Given = None,
        second_truth: Given = None,
        validation: Given = None,
        validation_truth: str | None = None,
        query: Given = None,
        truth: str | None = None,
        tolerance: int = 5,
        batch_size: int = 64,
        clip: int = 1,
        resize: tuple[int, int] | None = None,
        augmentation: Augmentation | None = None,
        velocity: GroundOdometry | None = None,
        held_out: float = 0.05,
    ) -> None:
        super().__init__()
        expect(0 <= held_out <= 0.5, "a share of the frames, from 0 to 0.5", held_out=held_out)
        if tolerance < 0 or clip < 1 or not 2 <= batch_size < LARGEST or batch_size % clip:
            seen = f"tolerance is {tolerance}, batch_size {batch_size}, clip {clip}"
            raise InputError(f"{seen}; expected 0 or more, and batches of at least 2 frames in whole clips")
        if resize is not None and (len(resize) != 2 or min(resize) < 1):
            raise InputError(f"resize is {resize}; expected (height, width), at least 1 pixel each")
        given = routes_of(source) if isinstance(source, (str, Path)) else source
        self.listed = {"source": [*given] if isinstance(given, (list, tuple)) else [given]}
        expect(self.listed["source"], "at least one traverse", "source is an empty list")
        for name, other in (("second", second), ("validation", validation), ("query", query)):
            self.listed[name] = self._one_each(name, other)
        self.truths = {
            "second": self._one_each("second_truth", second_truth),
            "validation": self._one_each("validation_truth", validation_truth),
            "query": self._one_each("truth", truth),
        }
        for name, one in ((name, one) for name, every in self.listed.items() for one in every):
            fits = isinstance(one, (str, Path, Traverse, Tensor, np.ndarray))
            if not fits and (one is not None or name == "source"):
                expected = "a path, a Traverse, or a tensor or array of frames or features"
                raise InputError(f"{name} is of type {type(one).__name__}; expected {expected}")
        paths = [str(one) for one in self.listed["source"] if isinstance(one, (str, Path))]
        for one in (one for one in paths if paths.count(one) > 1):
            raise InputError(f"{one} is given twice; expected each route once, other traverses as second")
        # without the list if there is one route
        self.sources = {
            name: given if len(given) > 1 and any(one is not None for one in given) else given[0]
            for name, given in self.listed.items()
        }
        self.tolerance, self.batch_size, self.clip = tolerance, batch_size, clip
        self.resize = None if resize is None else (int(resize[0]), int(resize[1]))
        self.augmentation = Augmentation() if augmentation is None else augmentation
        self.seen = 0  # batches of the epoch that a training has seen
        self._clips: Clips | None = None
        self._stopped: dict[str, Any] | None = None  # of the checkpoint that is resumed
        self.velocity, self.held_out = velocity, held_out
        self.references: list[Traverse] = []  # at even steps if `velocity` is given
        self.sets: dict[str, StoredFrames] = {}
        self._smaller: tuple[int, int] | None = None  # size of the stored frames, if smaller than their own

    def _one_each(self, name: str, given: object) -> list[Any]:
        """The given value for each of the routes."""
        count = len(self.listed["source"])
        each = list(given) if isinstance(given, (list, tuple)) else [given] * (count if given is None else 1)
        if count > 1 and name in ("validation", "query") and any(one is not None for one in each):
            seen = f"{name} is given, but there are {count} routes, for which no map is made"
            raise InputError(f"{seen}; expected none, and `dejavu compare A B --descriptor FILE` for a route")
        seen = f"{name} lists {len(each)}, and there are {count} routes"
        expect(len(each) == count, "one for each route, null for routes without", seen)
        return each

    @property
    def reference(self) -> Traverse:
        """The route, or the first of several."""
        return self.references[0]

    @property
    def route_name(self) -> str:
        """The name of the routes, for messages."""
        return self.reference.name + f" and {len(self.references) - 1} more" * (len(self.references) > 1)

    @property
    def lengths(self) -> list[int]:
        """Places of each route."""
        return [len(part) for part in self.sets["reference"].parts]

    def apart(self, places: Tensor) -> Tensor:
        """Places renumbered with a gap of the tolerance between routes; -1 stays -1."""
        starts = torch.tensor(self.lengths, device=places.device).cumsum(0)[:-1]
        return places + self.tolerance * torch.bucketize(places, starts, right=True)

    @property
    def held(self) -> list[int]:
        """The first places of the held-out segments, which training never sees."""
        frames = self.sets["reference"].values
        # not for templates: unseen places would not be found
        one_map = len(self.references) == 1 and frames.ndim == 4 and self._of_task("made", True)
        enough = len(frames) >= MIN_FRAMES and self.sources["validation"] is None
        if not (one_map and self.held_out and enough):
            return []
        count = max(MIN_SEGMENTS, round(self.held_out * len(frames) / SEGMENT))
        return [(2 * i + 1) * len(frames) // (2 * count) - SEGMENT // 2 for i in range(count)]

    def _of_task(self, name: str, default: object = None) -> Any:
        """An attribute of the task in training; the default without one."""
        return default if self.trainer is None else getattr(self.trainer.lightning_module, name, default)

    def setup(self, stage: str) -> None:
        """Read the reference and the other traverses that the stage needs."""
        if len(self.listed["source"]) > 1 and not self._of_task("made", True):
            seen = f"there are {len(self.listed['source'])} routes, but templates can be trained on one only"
            raise InputError(f"{seen}; expected one, or model.mapper SpectralMapper, to train a descriptor")
        smaller = self._of_task("frame_size") if self.resize is None else self.resize
        if smaller != self._smaller:
            self.sets.clear()
            self._smaller = smaller
        if "reference" not in self.sets:
            opened = [self._open(source) for source in self.listed["source"]]
            self.references = [resampled(route, self.velocity, self.batch_size) for route in opened]
            parts = [self._stored(route) for route in self.references]
            places = torch.arange(sum(map(len, parts)))
            self.sets["reference"] = StoredFrames(parts, as_ground_truth(places[:, None]))
        if self._of_task("made"):
            self._read("second")  # every stage makes the map, whose whitening needs it
        needed = {"fit": ("second", "validation"), "validate": ("validation",), "test": ("query",)}
        for name in needed.get(stage, ()):
            self._read(name)
        if stage == "fit":
            self.unseen()  # so that its errors come before the training
        expect(stage != "test" or "query" in self.sets, "data.query, a second traverse", "nothing to test on")

    @property
    def _size(self) -> tuple[int, int] | None:
        """(height, width) of stored frames; None is their own size."""
        shape = self.reference.frame_shape
        for route in self.references[1:]:
            other = route.frame_shape
            if len(other) != len(shape) or other[0] != shape[0] or (other != shape and not self._smaller):
                raise _shape_error(route.name, other, shape)
            if other != shape:
                return self._smaller
        shrinks = self._smaller and len(shape) == 3 and math.prod(self._smaller) < math.prod(shape[1:])
        return self._smaller if shrinks or self.resize is not None else None

    def unseen(self) -> tuple[Traverse, GroundTruth] | None:
        """The validation traverse, else the query traverse, and its places; None without either."""
        for name in ("validation", "query"):
            if self.sources[name] is not None:
                self._read(name)
                return self._opened(name), self.sets[name].truth
        return None

    def _open(self, source: Given, shape: tuple[int, ...] | None = None) -> Traverse:
        """A traverse, at the size of `DejaVu.at_map_size` of the task's model unless `resize` is given."""
        traverse = as_traverse(source)
        model = self._of_task("dejavu")
        return traverse if model is None or self.resize is not None else model.at_map_size(traverse, shape)

    def _opened(self, name: str, i: int = 0) -> Traverse:
        """Another traverse of route i, resampled with the steps of the route."""
        route = self.references[i]
        step = route.step if isinstance(route, ResampledTraverse) else None
        traverse = self._open(self.listed[name][i], route.frame_shape)
        return resampled(traverse, self.velocity, self.batch_size, step)

    def _stored(self, traverse: Traverse) -> Tensor:
        """The frames of a traverse, see `store`; one so short that every answer is right is refused."""
        values = store(traverse, self._size)
        if len(values) <= max(1, self.tolerance):
            seen = f"{traverse.name} has {len(values)} frame{'s' * (len(values) != 1)}"
            raise InputError(f"{seen} and the tolerance is {self.tolerance}; expected a longer route")
        return values

    def _read(self, name: str) -> None:
        """Read another traverse of each route, in the order of the routes, if given and not read yet."""
        given = [i for i, source in enumerate(self.listed[name]) if source is not None]
        if not given or name in self.sets:
            return
        parts, truths = zip(*(self._read_one(name, i) for i in given), strict=True)
        truth = truths[0]
        if len(self.references) > 1:
            known = [one.positives.masked_fill(~one.judged[:, None], -1) for one in truths]
            starts = [sum(self.lengths[:i]) for i in given]
            truth = _concatenated([p.where(p < 0, p + start) for p, start in zip(known, starts, strict=True)])
        self.sets[name] = StoredFrames([*parts], truth)

    def _read_one(self, name: str, i: int) -> tuple[Tensor, GroundTruth]:
        """Another traverse of route i, and the places of that route that it shows."""
        route, reference = self.references[i], self.sets["reference"].parts[i]
        traverse = self._opened(name, i)
        values = self._stored(traverse)
        if values.shape[1:] != reference.shape[1:]:
            raise _shape_error(traverse.name, tuple(values.shape[1:]), tuple(reference.shape[1:]))
        option = "data.truth" if name == "query" else f"data.{name}_truth"
        known = ground_truth_of(self.truths[name][i], route, traverse, counters=name != "second")
        if known is None and name == "second" and len(route.frame_shape) == 3:
            views = associate(DejaVu(), route, traverse, option=option)
            log.warning(*views.placed_lines())
            return values, as_ground_truth(views.places)
        if known is None:
            seen = f"no truth for {traverse.name}: {len(values)} frames, {len(reference)} places"
            raise InputError(f"{seen}; expected {option}, such as 0 if frame i is place i")
        if isinstance(route, ResampledTraverse):
            known = ground_truth_in_places(known, partial(place_of, route.positions))
        return values, known

    def train_dataloader(self) -> DataLoader[Batch]:
        """Stored frames of the reference and of the second traverse; this process's part."""
        if self.trainer is not None:
            for one in self.sets.values():
                one.move(self.trainer.strategy.root_device)
        loader = self.training_batches(*self._processes)
        self._clips = cast(Clips, loader.sampler)
        if self._stopped is not None:
            self._clips.resume(self._stopped["clips"], self._stopped["seen"])
        return loader

    def state_dict(self) -> dict[str, Any]:
        """Where a training stops: its random numbers, and the batches of the epoch that it has seen."""
        if self._clips is None:
            return {}
        return {"random": torch.get_rng_state(), "clips": self._clips.began, "seen": self.seen}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Let the next training go on from there; an older checkpoint says nothing."""
        self._stopped = state_dict or None

    def go_on(self) -> None:
        """Set the random numbers of a training that is resumed."""
        if self._stopped is not None:
            torch.set_rng_state(self._stopped["random"].cpu())
            self._stopped = None

    @property
    def _processes(self) -> tuple[int, int]:
        """The number of this process in the training, and how many there are."""
        return (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)

    def training_batches(self, process: int = 0, processes: int = 1) -> DataLoader[Batch]:
        """Batches of the training; of each, the part of one of so many processes."""
        sets = [self.sets[name] for name in ("reference", "second") if name in self.sets]
        parts = [part for one in sets for part in one.parts]
        frames = StoredFrames(parts, _concatenated([one.truth.positives for one in sets]))
        held = torch.tensor(self.held, dtype=torch.int64)[:, None] + torch.arange(SEGMENT)
        kept = ~torch.isin(frames.truth.positives, held).any(1)
        each = torch.arange(len(frames)).split([len(part) for part in parts])
        runs = [run for part in each for run in runs_of(part[kept[part]])]
        longest = max(map(len, runs))
        seen = f"clip is {self.clip} and the longest segment to train on has {longest} frames"
        expect(longest >= self.clip, "a shorter clip", f"{seen} (data.held_out is {self.held_out:g})")
        batch_size = self.batch_size * self._processes[1]
        return _loader(frames, Clips(runs, batch_size, self.clip, process, processes))

    def val_dataloader(self) -> DataLoader[Batch]:
        """The validation traverse, or the reference."""
        return self._in_order("validation" if "validation" in self.sets else "reference")

    def test_dataloader(self) -> DataLoader[Batch]:
        """The query traverse."""
        return self._in_order("query")

    def _in_order(self, name: str) -> DataLoader[Batch]:
        frames = self.sets[name]
        return _loader(frames, InOrder(len(frames), self.batch_size, *self._processes))

    def augmented(self, frames: Tensor, clip: int) -> Tensor:
        """Augmented frames (B,C,H,W), clip after clip; features (B,D) unchanged."""
        if frames.ndim != 4 or not self.augmentation.acts:
            return frames
        self.augmentation.train()
        with torch.autocast(frames.device.type, enabled=False):
            augmented: Tensor = self.augmentation(frames.unflatten(0, (-1, clip)))
        return augmented.flatten(0, 1)

    def validated(self, batch: Batch) -> Tensor:
        """The frames of a validation batch; the reference itself gets the same augmentation each time."""
        if "validation" in self.sets:
            return batch.frames
        with torch.random.fork_rng():
            torch.manual_seed(int(batch.truth.positives[0, 0]))
            return self.augmented(batch.frames, 1)


def store(traverse: Traverse, resize: tuple[int, int] | None = None) -> Tensor:
    """All frames of a traverse as bytes, (N,C,H,W) uint8; ready features unchanged, (N,D)."""
    shape: tuple[int, ...] = ()

    def rows() -> Iterator[Tensor]:
        nonlocal shape
        for batch in traverse.batches(READ_BATCH):
            if batch.ndim == 4 and resize is not None:
                needed = 4 * len(batch) * batch.shape[1] * math.prod(resize)
                check_room(needed, f"{traverse.name} in frames of {resize[0]} x {resize[1]}")
                batch = resize_frames(batch, resize)
            seen = f"{traverse.name} holds frames of {shape} and of {tuple(batch.shape[1:])}"
            expect(not shape or tuple(batch.shape[1:]) == shape, "one size, as with data.resize", seen)
            shape = tuple(batch.shape[1:])
            expect(batch.isfinite().all(), "finite numbers", f"{traverse.name} holds NaN or infinite values")
            yield (batch if batch.ndim == 2 else (batch * 255).round().clamp(0, 255).byte().flatten(1)).cpu()

    values = concatenate(rows(), len(traverse))
    return values.view(len(values), *shape)


def as_frames(values: Tensor) -> Tensor:
    """Bytes as frames in [0, 1]; features unchanged."""
    return values.float() / 255 if values.dtype == torch.uint8 else values


def _concatenated(positives: list[Tensor]) -> GroundTruth:
    """The truth of several traverses, one after the other."""
    width = max(part.shape[1] for part in positives)
    pad = torch.nn.functional.pad
    return as_ground_truth(torch.cat([pad(part, (0, width - part.shape[1]), value=-1) for part in positives]))


def _shape_error(name: str, shape: tuple[int, ...], reference: tuple[int, ...]) -> InputError:
    seen = f"{name} has frames of {shape}, the reference of {reference}"
    return InputError(f"{seen}; expected the same channels and one size, as with data.resize")


def _loader(frames: StoredFrames, batches: Iterable[list[int]]) -> DataLoader[Batch]:
    # the sampler yields batches of indices, so that many frames are read at a time; the generator keeps a
    # validation from using up random numbers of the training
    return DataLoader(frames, sampler=batches, batch_size=None, generator=torch.Generator())
