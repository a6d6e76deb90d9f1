"""The whole method as one module; reads like section III of the paper."""

from __future__ import annotations

import copy
import inspect
import logging
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_type_hints

import torch
from torch import Tensor, nn
from torch.nn.parameter import is_lazy

from dejavu_torch.data.arrays import ArrayTraverse, as_traverse
from dejavu_torch.data.fitted import at_size
from dejavu_torch.data.ground_truth import ground_truth_in_places
from dejavu_torch.data.names import decode_names, encode_names, names_of
from dejavu_torch.data.positions import place_of
from dejavu_torch.data.selection import Selection, runs
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.features.extract import (
    check_alone,
    check_queries,
    feature_batches,
    features_of,
    warn_of_bright,
)
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.memory import IN_MEMORY, concatenate
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.views import LEAST, STRETCH, AugmentedTraverse, Stretches, Views
from dejavu_torch.features.whitening import STRENGTHS, WIDEST, Whitening
from dejavu_torch.maps.mapfile import HEADER, checksums, digests, map_size, read_map, write_map
from dejavu_torch.maps.merged import MergedMapper
from dejavu_torch.maps.place_map import Mapper, PlaceMap
from dejavu_torch.maps.recipe import Recipe, Registry, build, difference, recipe_of, with_parts
from dejavu_torch.maps.schema import checked, checked_fields
from dejavu_torch.maps.spectral import SpectralMap, SpectralMapper
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.maps.weights import BITS, is_rounded, packed, round_weights, unpacked
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.motion.resampling import ResampledTraverse, ground_truth_of, resampled
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.recognition.calibration import Calibration, Trial, calibrated
from dejavu_torch.recognition.candidates import Candidates, check_candidates
from dejavu_torch.recognition.matching import Found, Matching, joined
from dejavu_torch.recognition.search import SCORES_AT_ONCE, Search, Searcher, check_scanned, check_search
from dejavu_torch.recognition.select import HIGHEST, PROBABLE, Acceptance
from dejavu_torch.resize import is_stretched, reduced_size, resize_frames
from dejavu_torch.streaming import sample as streaming
from dejavu_torch.streaming.coder import ChunkCoder, Made, code_here, in_one_thread, with_visits
from dejavu_torch.streaming.sample import sample_of
from dejavu_torch.streaming.work import Fit, WorkFolder, all_chunks
from dejavu_torch.text import one_line
from dejavu_torch.types import (
    BATCH_NUMBERS,
    FRAME_NUMBERS,
    InputError,
    Match,
    SequenceModel,
    Training,
    Traverse,
)
from dejavu_torch.version import __version__

log = logging.getLogger("dejavu_torch")

TRIAL_SCORES = 2**22  # of the queries of a trial at all places
CALIBRATION_SCORES = 2**30  # of all frames that a map is calibrated by, at all places
LONGEST_TRIAL = 512  # queries that a filter follows, to be calibrated by
ROWS = 4096  # descriptors on the device at a time
FEW_DESCRIPTORS = IN_MEMORY // 4  # bytes
OFF = 0.02  # of the bytes per place asked for: worth a word
MANY_FEATURES = 50_000  # per frame: worth a word

NO_MAP = "a descriptor without a map; expected a map, as `dejavu learn SOURCE --descriptor FILE` makes of it"

# the classes that a map file may name; any other has to be given by the caller
CLASSES: tuple[type[nn.Module], ...] = (
    Preprocess,
    HOG,
    PatchPixels,
    SmallCNN,
    Embedding,
    Whitening,
    SpectrogramAnalysis,
    ImposedPeriods,
    TemplateMapper,
    SpectralMapper,
    MergedMapper,
    GroundOdometry,
)
REGISTRY: Registry = {cls.__name__: cls for cls in CLASSES}
KINDS = [cls.kind for cls in CLASSES if issubclass(cls, Mapper)]
PARTS: dict[str, type[nn.Module]] = {
    "preprocess": Preprocess,
    "features": nn.Module,
    "whitening": Whitening,
    "mapper": Mapper,
    "velocity": GroundOdometry,
}


class DejaVu(nn.Module):
    """Learn a compressed map of a route from what repeats along it, and find places on it (section III).

    Args:
        features: any nn.Module (B,C,H,W) -> (B,D); None is HOG with its defaults.
        whitening: makes few numbers of the features, learned anew with each map unless it is `fixed`; "none"
            keeps the features, though of ready ones of over 256 numbers a SpectralMapper gets the principal
            components, as of `Whitening(views=0)`; None is Whitening ahead of a SpectralMapper, "none" ahead
            of templates.
        mapper: makes the map from the descriptors of a traverse; None is SpectralMapper with its defaults.
        threshold: accept a match when its score is below; infinity accepts every finite score.
        precision: accept a match instead where it is at least as probably right, above 0 and below 1; of a
            map that is calibrated, see `calibrate`. Without either, a calibrated map accepts from .5 on, and
            any other every finite score, see `acceptance`.
        batch_size: frames in memory at a time.
        preprocess: size, colour and contrast of the frames ahead of the features; None is Preprocess with its
            defaults, which reduces the longer side to 160 pixels and changes nothing else.
        velocity: measures how the ground moves: places and queries are even steps along it (section IV-B);
            None takes the frames as they are.
        weight_bits: of each weight of the features in the file; 8 rounds them in place, with a scale for each
            output channel.

    Shape: forward: frames (Q,C,H,W) or features (Q,D) -> scores (Q,N), lower is better.

    Convention: a match counts places; `map.frame_of` gives the reference frame that a place shows. `forward`
        is a fixed run of tensor operations without host synchronisation: it goes through `torch.export` with
        a dynamic batch and through `torch.compile(fullgraph=True)`.

    Example:
        >>> wave = torch.arange(64)[:, None] % torch.tensor([8.0, 9.0])  # two features that repeat
        >>> model = DejaVu(mapper=TemplateMapper(SpectrogramAnalysis(window=64, strongest=1))).learn(wave)
        >>> model.localize(wave[20:22]).index
        tensor([20, 21])
        >>> DejaVu().learn(wave).localize(wave[20:22]).index  # the spectral map
        tensor([20, 21])
    """

    def __init__(
        self,
        features: nn.Module | None = None,
        whitening: Whitening | Literal["none"] | None = None,
        mapper: Mapper | None = None,
        threshold: float | None = None,
        batch_size: int = 64,
        preprocess: Preprocess | None = None,
        velocity: GroundOdometry | None = None,
        precision: float | None = None,
        weight_bits: Literal[8, 32] = 32,
    ) -> None:
        super().__init__()
        if whitening not in (None, "none") and not isinstance(whitening, Whitening):
            raise InputError(f"the whitening is {whitening!r}; expected a Whitening, 'none' or None")
        if mapper is not None and not isinstance(mapper, Mapper):
            raise InputError(
                f"the mapper is a {type(mapper).__name__}; expected a Mapper such as TemplateMapper"
            )
        if not isinstance(batch_size, int) or batch_size < 1:
            raise InputError(f"batch_size is {batch_size}; expected a whole number of at least 1")
        if threshold is not None and not threshold > -math.inf:
            raise InputError(f"the threshold is {threshold}; expected a number, or None")
        if weight_bits not in BITS:
            raise InputError(f"weight_bits is {weight_bits!r}; expected one of {', '.join(map(str, BITS))}")
        check_precision(precision)
        if precision is not None and threshold is not None:
            raise InputError(f"a threshold, {threshold}, and a precision, {precision}; expected one of them")
        self.preprocess = Preprocess() if preprocess is None else preprocess
        self.features = HOG() if features is None else features
        for module in self.features.modules():  # no file can be loaded into expanded ones
            for name, buffer in module.named_buffers(recurse=False):
                if not is_lazy(buffer):
                    setattr(module, name, buffer.contiguous())
        if weight_bits == 8 and not round_weights(self.features):
            raise InputError(
                f"weight_bits is 8, but {type(self.features).__name__} has no float32 weights of 2 or more "
                "dimensions (of lazy layers: yet); expected 32"
            )
        self.weight_bits = weight_bits
        self.mapper = SpectralMapper() if mapper is None else mapper
        if whitening is None and self.mapper.whitens:
            whitening = Whitening()
        self.whitening = whitening if isinstance(whitening, Whitening) else None
        self.threshold = None if threshold is None else float(min(threshold, HIGHEST))
        self.precision = precision
        self.batch_size = batch_size
        self.velocity = velocity
        self.map: PlaceMap = self.mapper.empty()
        self.step: float | None = None  # pixels of ground from one place of the map to the next
        self.frame_shape: tuple[int, ...] | None = None  # of the reference, or (D,) of ready features
        self.frame_names: list[str] = []  # of the reference's frames; empty where they have none
        self.trained: Training | None = None
        self.calibration: Calibration | None = None
        self._searcher: Searcher | None = None
        self._reduces = False  # whether `_reduce` has set the whitening
        self._told: set[tuple[str, str]] = set()  # lines that are said once

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_searcher": None}  # which can hold more than the map, and is soon made again

    def settings(self) -> dict[str, Any]:
        """The constructor's arguments as they are now: `DejaVu(**model.settings())` has no map."""
        own = {name: getattr(self, name) for name in inspect.signature(DejaVu).parameters}
        return own | {"whitening": self.whitening or "none"}

    def learn(
        self,
        traverse: Traverse | Tensor,
        progress: bool = False,
        second: Views | None = None,
        work: WorkFolder | None = None,
        make: Callable[..., Made] = code_here,
        visits: Views | None = None,
    ) -> DejaVu:
        """Section III-A: features, what repeats in them, and the map.

        Args:
            traverse: the reference, a Traverse or a tensor: frames (N,C,H,W) or features (N,D).
            second: see `describe_reference`; `views` makes it.
            progress: show a progress bar on a terminal, elsewhere a line a minute, on stderr.
            work: keeps the finished chunks of a long route, so that learning goes on from there after a
                kill; it is the caller's to remove.
            make: what makes the chunks of a long route: `code_here`, or a cluster.
            visits: see `growth.learn_mean`.

        Returns:
            self, in eval mode, with the map in `self.map`. A route in which nothing repeats gives a template
            map without layers, on which every place scores +inf. Features beyond `concatenate`'s share of
            the memory spill to a temporary file; descriptors stay in it, (N,K) and a few temporary copies.

        Convention: of a route of over `SAMPLE` frames a spectral map with an integer chunk learns whitening,
            mean and step from a sample of them, see `sample_of`, and its chunks are made one by one. Memory
            holds a chunk, the sample and the map, whatever the number of frames.

        Raises:
            InputError: no frames, too few, NaN, or mixed sizes; features that depend on other frames.
        """
        traverse = self.resample(as_traverse(traverse), progress=progress)
        text = "learning" if progress else None
        before = None if self.whitening is None else self.whitening.state_dict()
        try:
            frames = 0 if self._chunked is None else traverse.count()
            if frames > streaming.SAMPLE:
                return self._learn_chunks(traverse, frames, second, text, work, make, visits)
            if work is not None:
                work.check_unused()
            descriptors = self.describe_reference(traverse, second, text)
            if visits is None:
                return self.learn_features(descriptors, traverse)
            counts = 1 + shown_by(visits, len(descriptors))
            self.learn_features(self._averaged(descriptors, visits, progress), traverse)
            self.map.count_visits(counts)
            return self
        except InputError:  # the map that there was is of its own whitening
            if self.whitening is not None and before is not None:
                self.whitening.load_state_dict(before)
            raise

    @property
    def _chunked(self) -> SpectralMapper | None:
        """The mapper, where it codes chunk by chunk."""
        mapper = self.mapper
        return mapper if isinstance(mapper, SpectralMapper) and mapper.chunk != "route" else None

    def _learn_chunks(
        self,
        traverse: Traverse,
        frames: int,
        second: Views | None,
        progress: str | None,
        work: WorkFolder | None,
        make: Callable[..., Made],
        visits: Views | None,
    ) -> DejaVu:
        """As `learn`, of a route of over `SAMPLE` frames."""
        mapper = self._chunked
        assert mapper is not None
        size = int(mapper.chunk)
        counts = visits and 1 + shown_by(visits, frames)
        names, positions = self._beside(traverse, frames)
        taken = positions.nbytes
        if work is not None:
            sampled = runs(sample_of(frames, size).frame)
            states = [traverse.state(run.start, run.stop) for run in sampled]
            key = self.run_key(traverse, frames, states, visits)
            work.open(key | digests(second=_state_of(second)))
        self._reduce(traverse)
        visits = visits and self.read_once(visits, progress)
        with in_one_thread():
            fit = self._fit(traverse, frames, second, taken, progress, work, visits)
        coder = self.chunk_coder(frames, mapper, fit.mean, fit.step, visits)
        chunks = all_chunks(coder, traverse, work, make, progress)
        settings = mapper.metric, mapper.transform, size, mapper.resolution
        route = SpectralMap.of_chunks(chunks, fit.mean, *settings).to(self.map.positions.device)
        route.needed = fit.needed
        if counts is not None:
            route.count_visits(counts)
        self._say_reached(route, taken, mapper.beside(taken, _is_ready(traverse)))
        return self._take(route, traverse, names, positions)

    def _fit(
        self,
        traverse: Traverse,
        frames: int,
        second: Views | None,
        taken: int,
        progress: str | None,
        work: WorkFolder | None,
        visits: Views | None,
    ) -> Fit:
        """Learn the whitening from a sample of a long route; mean and step of its chunks."""
        found = None if work is None else work.fit()
        if found is not None:
            if self.whitening is not None:
                self.whitening.load_state_dict(found[1])
            return found[0]
        mapper = self._chunked
        assert mapper is not None
        size = int(mapper.chunk)
        sample = sample_of(frames, size)
        part = Selection(traverse, sample.frame)
        descriptors = self.describe_reference(part, second and sample.views(second), progress and "sampling")
        if visits is not None and len((shown := sample.shown(visits)).places):
            descriptors = self._averaged(descriptors, shown)
        # what the file holds once counts for the sample by its share alone
        share, once = len(descriptors) / frames, 2 * descriptors.shape[1]
        other = copy.copy(mapper.beside(round(share * taken - (1 - share) * once), _is_ready(traverse)))
        other.chunk = sample.stretch
        with torch.no_grad():
            route = other(descriptors)
        fit = Fit(route.mean, float(route.steps[0]), route.needed)
        if work is not None:
            work.keep_fit(fit, {} if self.whitening is None else self.whitening.state_dict())
        return fit

    def chunk_coder(
        self,
        frames: int,
        settings: SpectralMap | SpectralMapper,
        mean: Tensor,
        step: float,
        visits: Views | None = None,
    ) -> ChunkCoder:
        """What makes coded chunks of so many frames, described as this model does."""
        module, whitening = self.pipeline, self.whitening
        size, transform, resolution = int(settings.chunk), settings.transform, settings.resolution
        sizes = self._at_once, frames, size
        return ChunkCoder(module, whitening, *sizes, mean, step, transform, resolution, visits)

    def read_once(self, visits: Views, progress: str | None = None) -> Views:
        """Visits that can be read anywhere: as they are, or the features of all, which may lie in a file."""
        if visits.traverse.seeks:
            return visits
        features = concatenate(self._features(visits.traverse, progress and "averaging"))
        return Views(ArrayTraverse(features.cpu(), visits.traverse.name), visits.places)

    def _averaged(self, descriptors: Tensor, visits: Views, progress: bool = False) -> Tensor:
        """Descriptors (N,K) of places that were visited once, averaged with those of further visits."""
        seen = self.describe_visits(visits, descriptors.shape[1], progress)
        return with_visits(descriptors.float(), torch.ones(len(descriptors)), *seen)

    def describe_visits(self, visits: Views, dimension: int, progress: bool = False) -> tuple[Tensor, Tensor]:
        """Descriptors (n,K) of the frames that show a place, and these places (n,).

        Raises:
            InputError: descriptors of another dimension or number, or that are not finite.
        """
        name = visits.traverse.name
        rows = self.extract_all(visits.traverse, "averaging" if progress else None)
        if rows.shape != (len(visits.places), dimension):
            seen = f"{name} gives descriptors {tuple(rows.shape)} of {len(visits.places)} places"
            raise InputError(f"{seen}; expected one of {dimension} numbers for each")
        if not bool(rows.isfinite().all()):
            raise InputError(f"{name} gives NaN or infinite descriptors; expected finite numbers")
        shown = visits.places.to(rows.device) >= 0
        return rows[shown], visits.places[shown.to(visits.places.device)]

    def run_key(
        self,
        traverse: Traverse,
        frames: int,
        states: list[str] | None = None,
        visits: Views | None = None,
    ) -> dict[str, str]:
        """What the chunks of a traverse are made of, as digests: see `WorkFolder`.

        Args:
            states: of the frames that the whitening is learned from.
            visits: that are averaged in.
        """
        parts = {name: getattr(self, name) for name in PARTS}
        header = {name: part and recipe_of(part, REGISTRY)._asdict() for name, part in parts.items()}
        header["code"] = sorted(filter(None, map(_code_of, {type(one) for one in self.modules()})))
        weights = self._weights("features")
        if self.whitening is not None and (self.whitening.fixed or states is None):
            weights |= self._weights("whitening")
        header |= {"batch_size": self._at_once, "sample": streaming.SAMPLE}
        header |= {"version": __version__, "torch": torch.__version__}
        sums = checksums(weights, header)
        sources = digests(source=[traverse.identity(), frames, states], visits=_state_of(visits))
        return sources | {"settings": sums.pop(HEADER), **sums}

    def _say_reached(self, route: SpectralMap, taken: int, mapper: Mapper) -> None:
        """What a long route takes, where the sample told wrongly."""
        wanted, places = getattr(mapper, "budget", None), route.places
        summary = route.summary()
        if wanted is None or summary.route_bytes - summary.route["lines"] >= wanted * places:
            return
        reached = (summary.route_bytes + (taken if 2 * taken <= wanted * places else 0)) / places
        if abs(reached / wanted - 1) > OFF:
            log.warning(
                "route_bytes_per_place is %g, and the route takes %.3g: its step is of %d of its %d places",
                *(wanted, reached, streaming.SAMPLE, places),
            )

    def describe_reference(
        self, traverse: Traverse, second: Views | None = None, progress: str | None = None
    ) -> Tensor:
        """Descriptors of the reference, the whitening learned from it: what `learn_features` makes a map of.

        Args:
            second: another traverse of the same places, from which whitening learns, in place of augmented
                copies, what changes between two visits.
            progress: text of a progress bar on a terminal, elsewhere of a line a minute; None shows nothing.

        Shape: -> (N,K).

        Convention: for a spectral map, a whitening of features beyond `concatenate`'s share of the memory is
            learned from a sample of them, see `sample_of`, and descriptors beyond a quarter of it lie in a
            temporary file; whitened ones as float16, which is finer than any step of these.

        Raises:
            InputError: as `learn`, or a second traverse that no whitening learns from.
        """
        if second is not None:
            self._require_learning_whitening(second.traverse.name)
        self._reduce(traverse)
        whitening = self.whitening
        spectral = isinstance(self.mapper, SpectralMapper)
        if whitening is not None and not whitening.fixed and spectral and self._has_many_features(traverse):
            sample = sample_of(traverse.count(), streaming.SAMPLE)
            part = Selection(traverse, sample.frame)
            self.describe_reference(part, second and sample.views(second), progress and "sampling")
            return concatenate(self.extract(traverse, progress), FEW_DESCRIPTORS, half=True)
        if whitening is None or whitening.fixed:
            batches = self.extract(traverse, progress, self._look_at(traverse))
            few = FEW_DESCRIPTORS if spectral else IN_MEMORY
            return concatenate(batches, few, half=spectral and whitening is not None)
        device = self.map.positions.device
        features = concatenate(self._features(traverse, progress, self._look_at(traverse)))
        if len(features) < 2 and not _is_ready(traverse):
            raise InputError(f"{traverse.name} has 1 frame; expected at least 2, as of a traverse")
        looks = "" if second is None else f"by {second.traverse.name}"
        if second is None and not _is_ready(traverse) and whitening.views != 0:
            augmented = AugmentedTraverse(
                traverse,
                len(features),
                whitening.copies(*features.shape),
                whitening.most_views,
                whitening.strengths,
                whitening.seed,
            )
            second, looks = augmented.views, augmented.looks
        if second is None:
            whitening.learn(features)
        else:
            batches = self._features(second.traverse, progress and f"learning what changes: {looks}")
            whitening.learn(features, _labelled(batches, second.places.to(device)))
        whitening.to(device)
        return concatenate(self.whitened(part.to(device)) for part in features.split(ROWS))

    def _reduce(self, traverse: Traverse) -> None:
        """Ready features too wide for a spectral map become principal components without whitening, too."""
        spectral = isinstance(self.mapper, SpectralMapper)
        wide = spectral and _is_ready(traverse) and traverse.frame_shape[0] > WIDEST
        if wide and self.whitening is None:
            self.whitening, self._reduces = Whitening(views=0).to(self.map.positions.device), True
        elif self._reduces and not wide:  # of a route that was learned before
            self.whitening, self._reduces = None, False

    def _warn_of_bright(self, frames: Tensor, name: str) -> None:
        """Once for each name, see `warn_of_bright`."""
        if (name, "bright") not in self._told and warn_of_bright(frames, name):
            self._told.add((name, "bright"))

    def _look_at(self, traverse: Traverse) -> Callable[[Tensor, Tensor], None]:
        """What the first batch of a reference is checked by."""

        def look(frames: Tensor, features: Tensor) -> None:
            self._warn_of_bright(frames, traverse.name)
            check_alone(self.pipeline, frames, features, traverse.name)

        return look

    def _has_many_features(self, traverse: Traverse) -> bool:
        """Whether the features of a traverse are too many to be held, so that a sample has to do."""
        if traverse.length is not None and traverse.length <= streaming.SAMPLE:
            return False
        one = next(self._features(Selection(traverse, torch.zeros(1, dtype=torch.int64))))
        frames = traverse.count()
        return frames > streaming.SAMPLE and frames * one.nbytes > IN_MEMORY

    def views(self, reference: Traverse, second: Traverse, truth: str | None = None) -> Views:
        """Another traverse of the reference's places, for `learn`; resampled where the reference is.

        Args:
            reference: as `resample` gives it.
            truth: which frames of the reference it shows, see `find_ground_truth`; None, of one that is as
                long: frame i is place i. Of several for one frame the first counts; frames that show none are
                left out.

        Raises:
            InputError: no whitening that could learn from it, or as of `places_shown`.
        """
        self._require_learning_whitening(second.name)
        return self.places_shown(reference, second, truth)

    def places_shown(self, reference: Traverse, second: Traverse, truth: str | None = None) -> Views:
        """As `views`, for `calibrate`.

        Raises:
            InputError: nothing says which places it shows, or it shows none.
        """
        shape = self.fit(reference, self.frame_shape if self.map.places else None).frame_shape
        second = self.resample(second, getattr(reference, "step", None), shape=shape)
        frames, shown = reference.count(), second.count()
        found = ground_truth_of(truth, reference, second, frames, shown, aligned=True)
        if found is None:
            steps = " at even steps" if isinstance(reference, ResampledTraverse) else ""
            raise InputError(
                f"{second.name} has {shown} frames and {reference.name} {frames}{steps}; expected as "
                "many, frame i being place i, or a truth that says which places it shows"
            )
        if isinstance(reference, ResampledTraverse):
            found = ground_truth_in_places(found, partial(place_of, reference.positions))
        places = found.positives[:, 0]
        if not (places >= 0).any():
            raise InputError(f"no frame of {second.name} shows a place of {reference.name}; expected some")
        return Views(second, places)

    def take_whitening(self, other: DejaVu) -> None:
        """Describe as another model does: its whitening as it is, and what is ahead of it.

        Raises:
            InputError: the other has no whitening.
        """
        if other.whitening is None or not other.whitening.learned:
            raise InputError("its map was learned without whitening; expected one that was learned with it")
        self.preprocess, self.features, self.whitening = other.preprocess, other.features, other.whitening
        self.weight_bits = other.weight_bits
        self.whitening.fixed = True

    def take_descriptor(self, other: DejaVu) -> None:
        """Make features as another model does, such as one trained on many routes; whitening is learned anew.

        Example:
            >>> base = DejaVu(features=HOG(cell=16))
            >>> model = DejaVu(mapper=SpectralMapper(2.5))
            >>> model.take_descriptor(base)
            >>> model.features.cell
            16
        """
        self.preprocess, self.features = other.preprocess, other.features
        self.weight_bits = other.weight_bits

    def without_map(self) -> DejaVu:
        """What makes the descriptors, by itself: it serves any route, at its own steps."""
        return DejaVu(**(self.settings() | {"velocity": None})).train(self.training)

    def _require_learning_whitening(self, name: str) -> None:
        if self.whitening is None or self.whitening.fixed:
            seen = "there is no whitening" if self.whitening is None else "the whitening is another map's"
            raise InputError(f"{seen} to learn from {name}; expected one that is learned")

    def resample(
        self,
        traverse: Traverse,
        step: float | None = None,
        progress: bool = False,
        shape: tuple[int, ...] | None = None,
    ) -> Traverse:
        """A traverse as the model takes it: `fit`, then `resampled` by the model's `velocity`.

        Args:
            step, shape: of queries those of the map, `self.step` and `self.frame_shape`; None of a reference.
        """
        return resampled(self.fit(traverse, shape), self.velocity, self.batch_size, step, progress)

    def fit(self, traverse: Traverse, shape: tuple[int, ...] | None = None) -> Traverse:
        """Frames at the size of the map's, or of `preprocess.size`; images and videos are decoded at it.

        Args:
            shape: (C,H,W) of the map's frames, or of the reference's. Frames of another aspect ratio, by over
                5 %, stay as they are. None is a reference: the longer side of its frames is reduced to
                `preprocess.size`, but no further than the features' own `resize`, or a block of HOG, and not
                at all where the source asks for a size, such as `clip.mp4?width=320`.

        Returns:
            The traverse itself where its frames, or ready features, have that size.
        """
        own = traverse.frame_shape
        if len(own) != 3 or isinstance(traverse, ResampledTraverse):
            return traverse
        height, width = own[1:]
        if shape is None:
            longest = None if traverse.sized else self.preprocess.size
            size, why = reduced_size((height, width), longest, self._least), "see preprocess.size"
        else:
            size, why = _size_like((height, width), shape), "the size of the map's frames"
        if size == (height, width):
            return traverse
        line = f"frames of {height} x {width} pixels are brought to {size[0]} x {size[1]}, {why}"
        if (traverse.name, line) not in self._told:
            log.warning("%s: %s", traverse.name, line)
            self._told.add((traverse.name, line))
        return at_size(traverse, size)

    def fit_frames(self, frames: Tensor) -> Tensor:
        """As `fit`, of a batch of queries: frames (B,C,H,W) at the size of the map's."""
        if frames.ndim != 4 or self.frame_shape is None:
            return frames
        return resize_frames(frames, _size_like((frames.shape[2], frames.shape[3]), self.frame_shape))

    def learn_features(self, features: Tensor, traverse: Traverse | None = None) -> DejaVu:
        """As `learn`, from descriptors that are there already. It ends in eval mode.

        Args:
            features: (N,K) float, whitened where the model whitens.
            traverse: what they come from, where known: the map then knows what frames to expect, and,
                where they were resampled, which frame each place shows.
        """
        shape = () if traverse is None else traverse.frame_shape
        if len(shape) == 3 and features.shape[1] > MANY_FEATURES:
            log.warning(
                "each frame gives %d features; smaller frames make a smaller and faster map",
                features.shape[1],
            )
        names, positions = self._beside(traverse, len(features))
        mapper = self.mapper.beside(positions.nbytes, _is_ready(traverse))
        with torch.no_grad():
            route: PlaceMap = mapper(features).to(positions.device)  # spilled ones are on the CPU
        if route.places != len(features) or route.dimension != features.shape[1]:
            raise InputError(
                f"{type(self.mapper).__name__} made a map of {route.places} places of {route.dimension} "
                f"features from features {tuple(features.shape)}; expected as many"
            )
        return self._take(route, traverse, names, positions)

    def _beside(self, traverse: Traverse | None, places: int) -> tuple[list[str], Tensor]:
        """What a file holds beside the map of a traverse: names of its frames, and their positions."""
        positions = self.map.positions.new_zeros(0)
        if isinstance(traverse, ResampledTraverse):
            positions = traverse.positions.to(positions.device)
            return names_of(traverse.traverse, len(positions)), positions
        return [] if traverse is None else names_of(traverse, places), positions

    def _take(
        self, route: PlaceMap, traverse: Traverse | None, names: list[str], positions: Tensor
    ) -> DejaVu:
        """The map that was learned of a traverse, with what `_beside` gave."""
        shape = () if traverse is None else traverse.frame_shape
        if len(shape) == 1 and (self.preprocess.channel or self.preprocess.contrast):
            log.warning("these are ready features: channel and contrast are left as they are")
        if len(positions):
            route.positions = positions
            route.check()
        step = traverse.step if isinstance(traverse, ResampledTraverse) else None
        self.map, self.step, self.frame_names, self._searcher = route, step, names, None
        self.frame_shape, self.trained, self.calibration = shape or None, None, None
        return self.eval()

    def calibrate(
        self,
        reference: Traverse | Tensor | None,
        views: Views | None = None,
        places: Tensor | None = None,
    ) -> DejaVu:
        """Find out how probably answers are right that stand out so much; `Match.probability` then tells it.

        Args:
            reference: the traverse that the map was learned from. Every 10th stretch of 20 of its frames is
                looked up in changed light and view: `Augmentation` of 1.5 times the strengths of the
                whitening, which has seen the plain ones.
            views: frames of another traverse of the same places instead, which tell of its own changes, or
                other `Stretches` of the reference;
                those that show no place are left out, and of very many all but evenly spaced stretches.
            places: (n,) int64, which place each frame of the reference shows, -1 for none, as where it was
                appended to other places; None is frame i at place i.

        Returns:
            self, with `self.calibration`.

        Raises:
            InputError: no map, ready features, whose changes cannot be drawn, or no right answer.

        Example:
            >>> from dejavu_torch import open_source
            >>> route = open_source("sim:aerial?frames=200")
            >>> model = DejaVu(precision=0.99).learn(route).calibrate(route)
            >>> match = model.localize(open_source("sim:aerial?frames=200&traverse=1"))
            >>> bool((match.accepted == (match.probability >= 0.99)).all())
            True
        """
        self._require_map()
        if views is None:
            if reference is None:
                raise InputError("neither a reference nor views to calibrate by; expected one of them")
            reference = self.fit(as_traverse(reference), self.frame_shape or ())
            strengths = STRENGTHS if self.whitening is None else self.whitening.strengths
            places = torch.arange(self.map.places) if places is None else places
            stretches = Stretches(reference, len(places), strengths, places=self.map.places)
            views = Views(stretches, places[stretches.places])
        another = not isinstance(views.traverse, Stretches)
        if isinstance(views.traverse, Stretches):
            length = views.traverse.stretch
        else:
            length = max(STRETCH, min(LONGEST_TRIAL, TRIAL_SCORES // self.map.places))
        name = views.traverse.name
        if len(views.places) and int(views.places.max()) >= self.map.places:
            shown = f"{name} shows place {int(views.places.max())}"
            raise InputError(f"{shown}; expected one of the map's {self.map.places}")
        if another:
            views = _stretches_of(views, length, max(LEAST, CALIBRATION_SCORES // self.map.places))
        descriptors = self.extract_all(views.traverse)
        if len(descriptors) != len(views.places):
            seen = f"{name} has {len(descriptors)} frames and {len(views.places)} places"
            raise InputError(f"{seen}; expected as many")
        parts = zip(descriptors.split(length), views.places.split(length), strict=True)
        try:
            self.calibration = calibrated(self.map, (Trial(*part) for part in parts), another)
        except InputError as error:
            raise InputError(f"calibrating by {name}: {error}") from error
        return self

    def calibrate_if_possible(
        self, reference: Traverse, views: Views | None = None, places: Tensor | None = None
    ) -> None:
        """As `calibrate`; without views a map stays as it is that is calibrated, or cannot be by its own
        reference."""
        if views is not None:
            self.calibrate(reference, views)
        elif self.calibration is None and len(reference.frame_shape) == 3 and self.map.summary().covered:
            try:
                self.calibrate(reference, places=places)
            except InputError as error:
                log.warning("the map is not calibrated: %s", error)

    def describe(self, frames: Tensor) -> Tensor:
        """Features of frames: preprocess, then features. (B,C,H,W) -> (B,D)"""
        features: Tensor = self.features(self.preprocess(frames))
        return features

    def whitened(self, features: Tensor) -> Tensor:
        """Descriptors of features, (B,D) -> (B,K); the features themselves without whitening."""
        return features if self.whitening is None else self.whitening(features)

    def forward(self, queries: Tensor) -> Tensor:
        """Section III-B: scores of all places, differentiable (eq. 3, eq. 4)."""
        self._require_map()
        queries = self.fit_frames(queries) if isinstance(queries, Tensor) else queries
        features = features_of(queries, self.describe, "the query")
        self.check_queries(tuple(queries.shape[1:]), features.shape[1], "the query")
        return self.map.scores(self.whitened(features))

    def localize(
        self,
        queries: Traverse | Tensor,
        progress: str | None = None,
        sequence: SequenceModel | None = None,
        search: Search = "auto",
    ) -> Match:
        """Section III-C: the best place of each query and whether it is accepted (eq. 5, eq. 6).

        Args:
            queries: a Traverse or a tensor: frames (Q,C,H,W) or features (Q,D).
            progress: text of a progress bar on a terminal; None is no bar.
            sequence: scores consecutive queries together, as `SequenceMatcher` and `PlaceFilter` do; None
                takes each by itself.
            search: how the best place of a single query is searched for, see `Searcher`.

        Shape: -> Match of (Q,) on the CPU.

        Convention: on a map of even steps the queries are resampled likewise first, see `resample`.

        Raises:
            InputError: no map, no frames, NaN, or features of another dimension than the map's.
        """
        matches = self.matches(queries, progress, sequence, search)
        return Match.joined(matches)

    def localize_descriptors(
        self,
        descriptors: Tensor,
        sequence: SequenceModel | None = None,
        order: Tensor | None = None,
        search: Search = "auto",
    ) -> Match:
        """As `localize`, of descriptors (Q,K) as the map's own are: whitened where the model whitens.

        Args:
            order: (N,) which frame each place of a shuffled map is; the match then counts frames.
        """
        found = self.found(descriptors, self.matching(sequence, search), order)
        return found.match(self.acceptance(sequence))

    def found(self, descriptors: Tensor, matching: Matching, order: Tensor | None = None) -> Found:
        """All that a matching finds, of descriptors and in an order as of `localize_descriptors`."""
        self._require_map()
        return joined(self._found([descriptors], matching, order))

    def matches(
        self,
        queries: Traverse | Tensor,
        progress: str | None = None,
        sequence: SequenceModel | None = None,
        search: Search = "auto",
    ) -> Iterator[Match]:
        """As `localize`, one batch of queries at a time: memory does not grow with the queries."""
        self._require_map()
        if sequence is not None:
            check_scanned(search)
        check_search(search, self.map)
        yield from self.matches_of(self._checked(queries, progress, sequence), sequence, search=search)

    def matches_of(
        self,
        descriptors: Iterable[Tensor],
        sequence: SequenceModel | None = None,
        look: Callable[[Tensor], None] | None = None,
        search: Search = "auto",
    ) -> Iterator[Match]:
        """As `matches`, of batches of descriptors (B,K); each is asked for when its match is.

        Args:
            look: is given the scores (B,N) of each batch, as for a picture.
        """
        self._require_map()
        self.check_precision(sequence)
        rule, matching = self.acceptance(sequence), self.matching(sequence, search)
        for part in self._found(descriptors, matching._replace(look=look)):
            yield part.match(rule)

    def candidates(
        self,
        queries: Traverse | Tensor,
        k: int,
        apart: int = 5,
        sequence: SequenceModel | None = None,
        search: Search = "auto",
    ) -> Candidates:
        """The k best places of each query, no two of them near each other; the first is `localize`'s.

        Args:
            queries, sequence, search: as of `localize`.
            k: how many, from 1 to the number of places.
            apart: places, at least 0: any two candidates of a query differ by more.

        Shape: -> Candidates of (Q,k) on the CPU.

        Raises:
            InputError: as `localize`, or k or apart out of range.

        Example:
            >>> wave = torch.arange(64)[:, None] % torch.tensor([8.0, 9.0])
            >>> DejaVu().learn(wave).candidates(wave[20:22], k=3).index[:, 0]
            tensor([20, 21])
        """
        return joined(self.candidate_batches(queries, k, apart, sequence=sequence, search=search)).candidates

    def candidate_batches(
        self,
        queries: Traverse | Tensor,
        k: int,
        apart: int = 5,
        progress: str | None = None,
        sequence: SequenceModel | None = None,
        search: Search = "auto",
    ) -> Iterator[Found]:
        """As `candidates`, one batch of queries at a time: memory does not grow with the queries.

        On a calibrated map with the probability of the first candidate of each.
        """
        self._require_map()
        check_candidates(k, apart, self.map.places)
        if sequence is not None:
            check_scanned(search)
        check_search(search, self.map)
        matching = self.matching(sequence, search)._replace(ranks=k, apart=apart)
        yield from self._found(self._checked(queries, progress, sequence), matching)

    def _checked(
        self, queries: Traverse | Tensor, progress: str | None, sequence: SequenceModel | None
    ) -> Iterator[Tensor]:
        """Descriptors of queries that fit the map, in batches; resampled as the map's places are."""
        queries = self.fit(as_traverse(queries), self.frame_shape or ())
        if sequence is not None:
            sequence.check(queries.length, self.map.places)
        if self.step is not None:
            queries = self.resample(queries, self.step, progress is not None, self.frame_shape)
        shape = queries.frame_shape

        def look(frames: Tensor, features: Tensor) -> None:
            self.check_queries(shape, features.shape[1], queries.name)
            self._warn_of_bright(frames, queries.name)

        for features in self._features(queries, progress, look):
            yield self.whitened(features)

    def matching(self, sequence: SequenceModel | None, search: Search = "auto") -> Matching:
        """A way to match queries, with probabilities where the map is calibrated for it."""
        calibration = self.calibration
        platt = None if calibration is None else calibration.of(sequence)
        return Matching(sequence, platt=platt, search=search)

    def check_precision(self, sequence: SequenceModel | None) -> None:
        """Refuse a precision that nothing tells of.

        Raises:
            InputError: the map is not calibrated, or not for this way of matching.
        """
        if self.precision is None or self.matching(sequence).platt is not None:
            return
        if self.calibration is None:
            seen = "the map is not calibrated"
        else:
            seen = "the map is calibrated for single queries and for a filter that always searches"
        raise InputError(f"the precision is {self.precision}, but {seen}; expected a threshold in its place")

    def threshold_of(self, sequence: SequenceModel | None) -> float | None:
        """What the score of a query, or of a sequence, has to be below; None where nobody said."""
        return self.threshold if sequence is None else sequence.threshold_of(self.threshold)

    def acceptance(self, sequence: SequenceModel | None = None) -> Acceptance:
        """Which answers are accepted, of single queries or of a sequence (convention 4).

        By the threshold or precision that was given, or that the map's file has. Else, on a map that is
        calibrated for this way of matching, where the probability is at least .5. Else what a filter by
        itself takes for more likely than not, and of other ways every finite score.
        """
        threshold = self.threshold_of(sequence)
        if threshold is not None:
            return Acceptance(threshold)
        if self.precision is not None:
            return Acceptance(precision=self.precision)
        if self.matching(sequence).platt is not None:
            return Acceptance(precision=PROBABLE, given=False)
        return Acceptance(None if sequence is None else sequence.likely, given=False)

    def _found(
        self, batches: Iterable[Tensor], matching: Matching, order: Tensor | None = None
    ) -> Iterator[Found]:
        """What a matching finds of batches of descriptors, as many queries at a time as memory allows.

        Args:
            order: as of `localize_descriptors`.
        """
        if matching.sequence is not None:
            matching.sequence.check(None, self.map.places)
        at_once = max(1, SCORES_AT_ONCE // max(1, self.map.places))
        device = self.map.positions.device  # many descriptors lie in a file
        if matching.searches and order is None:  # no score of most other places is needed
            searcher = self.searcher(matching.search)
            parts = (part for descriptors in batches for part in descriptors.split(ROWS))
            return (matching.search_for(part.to(device), searcher) for part in parts)
        check_scanned(matching.search)
        parts = (part.to(device) for descriptors in batches for part in descriptors.split(at_once))
        sequence = matching.sequence
        alone = not matching.lengths and matching.platt is None and order is None
        if sequence is not None and alone:  # not all scores may be needed
            best = sequence.best(parts, self.map) if matching.ranks == 1 and matching.look is None else None
            if best is not None:
                return (
                    Found(Candidates(place[:, None].cpu(), score[:, None].cpu())) for score, place in best
                )
            return matching._replace(sequence=None).stream(self.map.sequences(parts, sequence))
        scores: Iterator[Tensor] = map(self.map.scores, parts)
        if order is not None:
            place = order.argsort()
            scores = (part[:, place.to(part.device)] for part in scores)
        return matching.stream(scores)

    def searcher(self, method: Search = "auto") -> Searcher:
        """What finds the best places on the map; kept, with what it made of the map, until that changes.

        Its `told` says how the queries so far were searched for.
        """
        if self._searcher is None or not self._searcher.fits(self.map, method):
            self._searcher = Searcher(self.map, method)
        return self._searcher

    def search_by(self, searcher: Searcher) -> None:
        """Find best places by a searcher of the map that is made already, such as one of a cluster."""
        self._searcher = searcher

    def extract(
        self,
        traverse: Traverse,
        progress: str | None = None,
        look: Callable[[Tensor, Tensor], None] | None = None,
    ) -> Iterator[Tensor]:
        """Descriptors of a traverse in batches (B,K), without gradients; `look` as of `feature_batches`."""
        return map(self.whitened, self._features(traverse, progress, look))

    def _features(
        self,
        traverse: Traverse,
        progress: str | None = None,
        look: Callable[[Tensor, Tensor], None] | None = None,
    ) -> Iterator[Tensor]:
        """What whitening takes: features of a traverse in batches (B,D), without gradients."""
        device = self.map.positions.device
        return feature_batches(traverse, self.pipeline, self._at_once, device, progress, look)

    @property
    def _resize(self) -> tuple[int, int] | None:
        """The size (height, width) that the features resize frames to, where one of this package's does."""
        return getattr(self.features, "resize", None) if type(self.features) in CLASSES else None

    @property
    def _least(self) -> tuple[int, int] | None:
        """The least size that features can be made of, where that is known."""
        if self._resize is None and type(self.features) is HOG:
            return (self.features.cell * self.features.block,) * 2
        return self._resize

    @property
    def _at_once(self) -> int:
        """Frames of a batch: fewer than asked for where they are brought to a large size."""
        pixels = math.prod(self._resize or (1,))
        return max(1, min(self.batch_size, BATCH_NUMBERS // (3 * pixels)))

    def extract_all(self, traverse: Traverse, progress: str | None = None) -> Tensor:
        """Descriptors of a whole traverse, (N,K); many of them lie in a temporary file, see `concatenate`."""
        return concatenate(self.extract(traverse, progress))

    @property
    def pipeline(self) -> nn.Sequential:
        """What makes features of frames: preprocess, then features."""
        return nn.Sequential(self.preprocess, self.features)

    def check_queries(self, shape: tuple[int, ...], dimension: int, name: str) -> None:
        """Refuse queries that do not fit the map, and warn of frames of another size that do.

        Args:
            shape: of one query, (C,H,W) or (D,). dimension: D, how many features it gives.
            name: of the queries, for the message.
        """
        resized = getattr(self.features, "resize", None) is not None
        whitening = self.whitening
        own = len(whitening.projection) if whitening is not None else self.map.dimension
        check_queries(shape, dimension, self.frame_shape, own, resized, name)

    def frame_name(self, frame: int) -> str:
        """The name of a reference frame, such as its file's; empty where it has none."""
        return self.frame_names[frame] if self.frame_names else ""

    def save(self, path: str | Path) -> None:
        """Write the map, with the feature module's weights, as one safetensors file.

        Convention: a descriptor that was trained without a map is written as well, see `take_descriptor`.

        Raises:
            InputError: nothing learnt yet, weights that were changed since they were rounded, or the file
                cannot be written.
        """
        if self.trained is None:
            self._require_map()
        self._check_rounded()
        if callable(getattr(self.mapper, "metric", None)):
            raise InputError("a map with a callable metric cannot be saved; expected a metric by name")
        tensors, header = self._file()
        checked(header, Header, "the model")  # what is written can be read
        checked(header["map"], self.map.state, "the map")
        write_map(Path(path), tensors, header)

    @classmethod
    def load(cls, path: str | Path, features: nn.Module | None = None) -> DejaVu:
        """Read a map file; the model is in eval mode.

        Args:
            features: the module that made the map's features, needed where it is not one of this
                package; its weights come from the file.

        Raises:
            InputError: missing, truncated, foreign or newer file, or other features than the map's.
        """
        with opened(Path(path)) as (tensors, header):
            parts, weights = _build_parts(header, features, tensors), unpacked(tensors, "features.")
            settings = {name: getattr(header, name) for name in ("threshold", "precision", "batch_size")}
            model = cls(**parts, **settings)
            for name in ("frame_shape", "step", "trained", "calibration"):
                setattr(model, name, getattr(header, name))
            own = {name: weights.pop(name) for name in tensors if name.startswith("map.")}
            if own or header.map.get("places") != 0:
                _load_map(model.map, own, header)
            else:
                checked(header.map, model.map.state, "its map")
                model.map.set_extra_state(header.map)
            check_types(weights, model.features)
            loaded = model.load_state_dict(weights, strict=False)
            missing = [name for name in loaded.missing_keys if name.startswith(("features.", "whitening."))]
            if missing or loaded.unexpected_keys:
                raise InputError(f"it does not fit: missing {missing}, not expected {loaded.unexpected_keys}")
            model.weight_bits = 8 if len(weights) + len(own) < len(tensors) else 32
            model._check_rounded()
            if header.names is not None:
                model.frame_names = decode_names(header.names, len(model.map.positions) or model.map.places)
            model.check()
        return model.eval()

    def check(self) -> None:
        """Refuse parts of a model that do not fit together.

        Raises:
            InputError: naming them.
        """
        positions, step, shape = self.map.positions, self.step, self.frame_shape
        resampled = self.velocity is not None and step is not None and step > 0
        if (len(positions) > 0) != resampled or (step is not None) != resampled:
            raise InputError(f"it has step {step} and {len(positions)} frame positions")
        whitening = self.whitening
        other = self.map.places and whitening is not None and whitening.dimension != self.map.dimension
        if whitening is not None and whitening.learned and other:
            raise InputError(
                f"its whitening makes {whitening.dimension} numbers; expected the map's {self.map.dimension}"
            )
        if shape is not None and (
            len(shape) not in (1, 3) or min(shape) < 1 or math.prod(shape) > FRAME_NUMBERS
        ):
            raise InputError(f"its frames are {shape}; expected (C,H,W) or (D,)")

    def _check_rounded(self) -> None:
        if self.weight_bits == 8 and not is_rounded(self.features):
            raise InputError(
                f"weights of {type(self.features).__name__} are not rounded to 8 bits; expected all of them, "
                "and none changed since: a DejaVu that is made of them with weight_bits=8"
            )

    def _file(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        parts = {name: getattr(self, name) for name in PARTS}
        header = {name: part and recipe_of(part, REGISTRY)._asdict() for name, part in parts.items()}
        header |= {name: getattr(self, name) for name in ("threshold", "precision", "batch_size")}
        header |= self.get_extra_state()
        header["map"] = self.map.get_extra_state()
        packed = self.map.packed() if self.map.places else {}
        tensors = {f"map.{name}": tensor for name, tensor in packed.items()}
        return tensors | self._weights("features") | self._weights("whitening"), header

    def _weights(self, part: str) -> dict[str, Tensor]:
        module = getattr(self, part)
        weights = {} if module is None else module.state_dict()
        if part == "features" and self.weight_bits == 8:
            weights = packed(module)
        return {f"{part}.{name}": tensor for name, tensor in weights.items() if isinstance(tensor, Tensor)}

    def summary(self) -> MapSummary:
        """What the map can tell apart, and the bytes of its file by part."""
        tensors, header = self._file()
        fixed = {
            name: sum(tensor.nbytes for tensor in self._weights(part).values())
            for name, part in (("backbone", "features"), ("whitening", "whitening"))
        }
        fixed["names"] = len(encode_names(self.frame_names)) if self.frame_names else 0
        summary = self.map.summary()
        rest = map_size(tensors, header) - summary.route_bytes - sum(fixed.values())
        return summary.with_parts(fixed=fixed | {"header": rest})

    def get_extra_state(self) -> dict[str, Any]:
        """What the state_dict holds beside the tensors and the map's own state."""
        trained = self.trained and self.trained._asdict()
        names = encode_names(self.frame_names) if self.frame_names else None
        calibration = self.calibration and {
            name: platt and platt._asdict() for name, platt in self.calibration._asdict().items()
        }
        return {
            "frame_shape": self.frame_shape,
            "step": self.step,
            "trained": trained,
            "names": names,
            "calibration": calibration,
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take over what `get_extra_state` gave.

        Raises:
            InputError: a state of other entries, or of other types.
        """
        told = checked_fields(state, STATE_TYPES, "the model's state")
        for name in ("frame_shape", "step", "trained", "calibration"):
            setattr(self, name, told[name])
        self.frame_names = [] if told["names"] is None else decode_names(told["names"])

    def _require_map(self) -> None:
        if not self.map.places and self.trained is not None:
            raise InputError(
                "this is a descriptor without a map; expected learn(...) of a route with it first"
            )
        if not self.map.places:
            raise InputError("there is no map yet; expected learn(...) or load(...) first")


def check_sizes(model: DejaVu, reference: Traverse, query: Traverse) -> int:
    """How many features a frame gives; refuse, before the long work, traverses that do not give as many."""
    device = model.map.positions.device
    counts = [
        next(feature_batches(traverse, model.pipeline, 1, device)).shape[1] for traverse in (reference, query)
    ]
    if counts[0] != counts[1]:
        seen = " and ".join(
            f"{traverse.name} gives {count} features a frame of {' x '.join(map(str, traverse.frame_shape))}"
            for traverse, count in zip((reference, query), counts, strict=True)
        )
        raise InputError(f"{seen}; expected as many, as frames of one size give")
    return counts[0]


def _size_like(own: tuple[int, int], shape: tuple[int, ...]) -> tuple[int, int]:
    """The size of frames of a shape (C,H,W), for frames of one aspect ratio with it; else their own."""
    same = len(shape) == 3 and not is_stretched(own, (shape[1], shape[2]))
    return (shape[1], shape[2]) if same else own


def check_precision(precision: float | None) -> None:
    """Refuse a precision that no answers can be asked for.

    Raises:
        InputError: not above 0 and below 1.
    """
    if precision is not None and not 0 < precision < 1:
        raise InputError(f"the precision is {precision}; expected a share above 0 and below 1, such as .99")


def _is_ready(traverse: Traverse | None) -> bool:
    """Whether a traverse is known to hold ready features, not frames."""
    return traverse is not None and len(traverse.frame_shape) == 1


def _stretches_of(views: Views, length: int, most: int) -> Views:
    """Evenly spaced stretches of views, as long as that and about `most` frames in all; all if there are no
    more."""
    count = len(views.places) // length
    wanted = max(1, most // length)
    if count <= wanted:
        return views
    starts = torch.arange(wanted) * (count - 1) // max(1, wanted - 1) * length
    frame = (starts[:, None] + torch.arange(length)).flatten()
    return Views(Selection(views.traverse, frame), views.places[frame.to(views.places.device)])


def _labelled(batches: Iterator[Tensor], places: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Batches of descriptors, each with the places (B,) that they show; those that show none left out."""
    done = 0
    for batch in batches:
        shown = places[done : done + len(batch)]
        yield batch[shown >= 0], shown[shown >= 0]
        done += len(batch)


def _code_of(cls: type[nn.Module]) -> str:
    """The source of a class of the user's own; "" where there is none, or where a version tells of it."""
    if cls.__module__.partition(".")[0] in ("dejavu_torch", "torch"):
        return ""
    try:
        return inspect.getsource(cls)
    except (OSError, TypeError):
        return ""


def shown_by(visits: Views, places: int) -> Tensor:
    """How many frames of visits show each of so many places, (N,).

    Raises:
        InputError: they show a place beyond these.
    """
    shown = visits.places[visits.places >= 0].cpu()
    if len(shown) and int(shown.max()) >= places:
        seen = f"{visits.traverse.name} shows place {int(shown.max())}"
        raise InputError(f"{seen}; expected one of {places}")
    return shown.bincount(minlength=places)


def _state_of(views: Views | None) -> list[Any] | None:
    """What tells views from others, as JSON takes it."""
    if views is None:
        return None
    traverse, places = views
    return [traverse.identity(), traverse.state(0, len(places)), places.tolist()]


class Header(NamedTuple):
    """What the header of a map file says: the arguments of DejaVu, each part as a recipe, and its state.

    map: the state of the map, by whose `kind` it is checked further; see `PlaceMap.state`.
    """

    preprocess: Recipe
    features: Recipe
    whitening: Recipe | None
    mapper: Recipe
    velocity: Recipe | None
    threshold: float | None
    precision: float | None
    batch_size: int
    frame_shape: tuple[int, ...] | None
    step: float | None
    trained: Training | None
    names: str | None
    calibration: Calibration | None
    map: dict[str, Any]


HEADER_TYPES = get_type_hints(Header)
STATE = ("frame_shape", "step", "trained", "names", "calibration")
STATE_TYPES = {name: HEADER_TYPES[name] for name in STATE}


@contextmanager
def opened(path: Path) -> Iterator[tuple[dict[str, Tensor], Header]]:
    """Tensors and header of a map file; what is refused of them within the block names the file.

    Raises:
        InputError: as `DejaVu.load`.
    """
    tensors, values = read_map(path)
    try:
        header = checked(values, Header, "its header")
        if header.map.get("kind") not in KINDS:
            known = ", ".join(KINDS)
            raise InputError(f"a map of kind {header.map.get('kind')!r:.40}; this version knows {known}")
        yield tensors, header
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (RuntimeError, RecursionError) as error:  # what torch does not fit in, or nested without end
        problem = one_line(error)
        raise InputError(f"{path} does not fit its modules: {problem}") from error


def read_place_map(path: Path) -> PlaceMap:
    """The map of a file alone, without what made its features.

    Raises:
        InputError: as `DejaVu.load`.
    """
    with opened(path) as (tensors, header):
        mapper = _build(header, "mapper", None)
        assert isinstance(mapper, Mapper)
        if header.map.get("places") == 0:
            raise InputError(NO_MAP)
        route = mapper.empty()
        own = {name: tensor for name, tensor in tensors.items() if name.startswith("map.")}
        _load_map(route, own, header)
    return route


def _load_map(route: PlaceMap, tensors: dict[str, Tensor], header: Header) -> None:
    """Fill a map with what a file holds of it."""
    checked(header.map, route.state, "its map")
    route.load_packed({name.removeprefix("map."): tensor for name, tensor in tensors.items()}, header.map)


def _check_weights(header: Header, tensors: dict[str, Tensor], given: nn.Module | None) -> None:
    """Refuse, before they are made, features of other sizes than the file's weights.

    A network that is given is there already.
    """
    if given is not None:
        return
    with torch.device("meta"):
        probe = _build(header, "features", None)
    assert probe is not None
    for name, own in probe.state_dict().items():
        stored = tensors.get(f"features.{name}")
        if isinstance(own, Tensor) and (stored is None or stored.shape != own.shape):
            seen = "missing" if stored is None else tuple(stored.shape)
            raise InputError(f"it does not fit: features.{name} is {seen}; expected {tuple(own.shape)}")


def check_types(tensors: dict[str, Tensor], features: nn.Module) -> None:
    """Refuse whole numbers for weights that are none, such as those of 8 bits without their scales."""
    for name, own in features.state_dict().items():
        stored = tensors.get(f"features.{name}")
        is_float = isinstance(own, Tensor) and own.dtype.is_floating_point
        if is_float and stored is not None and not stored.dtype.is_floating_point:
            kind = str(stored.dtype).removeprefix("torch.")
            raise InputError(f"it does not fit: features.{name} is of {kind}; expected float numbers")


def _build_parts(header: Header, features: nn.Module | None, tensors: dict[str, Tensor]) -> dict[str, Any]:
    """The modules that a map's header names, by the names of `PARTS`.

    Args:
        features: the module that made the map's features, needed where it is not one of this package.
        tensors: of the file, which hold its weights.

    Raises:
        InputError: modules that cannot be built, or other features than the map's.
    """
    if features is not None:
        own = recipe_of(features, REGISTRY)
        if own not in with_parts(header.features):
            raise InputError(f"it was learned with {difference(header.features, own)}")
    _check_weights(header, tensors, features)
    parts = {name: _build(header, name, features) for name in PARTS}
    return parts | {"whitening": parts["whitening"] or "none"}


def _build(header: Header, name: str, features: nn.Module | None) -> nn.Module | None:
    recipe: Recipe | None = getattr(header, name)
    if recipe is None:
        return None
    # only learning needs what found the periods: without one of this package the mapper has none
    if name == "mapper" and "periods" in recipe.init_args:
        periods = recipe.init_args["periods"]
        if periods is None or checked(periods, Recipe, "its periods").class_path not in REGISTRY:
            plain = recipe._replace(init_args=recipe.init_args | {"periods": None})
            mapper = build(plain, TemplateMapper, REGISTRY)
            mapper.periods = None
            return mapper
    return build(recipe, PARTS[name], REGISTRY, features)
