"""The whole method as one module; reads like section III of the paper."""

from __future__ import annotations

import copy
import inspect
import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn.parameter import is_lazy

from dejavu_torch import learning, model_file
from dejavu_torch.data.fitted import at_size, resize_like, size_like
from dejavu_torch.data.names import names_of
from dejavu_torch.data.source import Source, as_traverse
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.extract import Pipeline, as_weights, features_of
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.views import Views
from dejavu_torch.features.whitening import WIDEST, Whitening
from dejavu_torch.maps.file import checked_fields
from dejavu_torch.maps.place_map import Mapper, PlaceMap
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.maps.weights import BITS, round_weights
from dejavu_torch.memory import concatenate
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.motion.resampling import ResampledTraverse, resampled, source_of
from dejavu_torch.recognition.calibration import Calibration
from dejavu_torch.recognition.coarse import CoarseSearch, coarse_search
from dejavu_torch.recognition.localizer import Localizer, Matching
from dejavu_torch.recognition.sample_file import check_searches, kept_search
from dejavu_torch.recognition.search import SCORES_AT_ONCE, Find, Search, check_search
from dejavu_torch.recognition.select import HIGHEST, PROBABLE, Acceptance, check_candidates
from dejavu_torch.resize import reduced_size
from dejavu_torch.text import with_progress
from dejavu_torch.types import BATCH_NUMBERS, InputError, Match, SequenceModel, Training, Traverse

log = logging.getLogger("dejavu_torch")

MANY_FEATURES = 50_000  # per frame: more are warned of


class DejaVu(nn.Module):
    """Learn a compressed map of a route from what repeats along it, and find places on it (section III).

    Args:
        features: any nn.Module (B,C,H,W) -> (B,D), given frames in the type of its weights; None is HOG with
            `Distilled`, HOG alone if unwhitened.
        whitening: reduces features to few dimensions, learned with each map unless it is `fixed`; None is
            Whitening for a SpectralMapper and "none" for templates. "none" keeps the features, except that a
            SpectralMapper reduces ready features of over 256 dimensions to principal components.
        mapper: makes the map from the descriptors of a traverse; None is SpectralMapper with its defaults.
        threshold: accept a match if its score is below; infinity accepts every finite score.
        precision: instead, accept a match if its probability is at least this, in (0, 1); the map has to be
            calibrated. See `acceptance` for the default.
        batch_size: frames in memory at a time.
        preprocess: size, colour and contrast of the frames; None is Preprocess with its defaults, which
            reduces the longer side to 160 pixels and changes nothing else.
        velocity: measures the motion of the ground, so that places and queries are even steps along it
            (section IV-B); None uses the frames as they are.
        weight_bits: bits of each weight of the features in the file; 8 rounds the weights in place, with a
            scale for each output channel.

    Shape: forward: frames (Q,C,H,W) or features (Q,D) -> scores (Q,N), lower is better.

    Convention: a match counts places; `map.frame_of` gives the reference frame of a place. `forward` is a
        fixed sequence of tensor operations without host synchronisation: it supports `torch.export` with a
        dynamic batch and `torch.compile(fullgraph=True)`.

    Example:
        >>> from dejavu_torch import SpectrogramAnalysis, TemplateMapper
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
            raise InputError(f"the mapper is a {type(mapper).__name__}; expected a Mapper or None")
        if not isinstance(batch_size, int) or batch_size < 1:
            raise InputError(f"batch_size is {batch_size}; expected a whole number of at least 1")
        if threshold is not None and not threshold > -math.inf:
            raise InputError(f"the threshold is {threshold}; expected a number, or None")
        if weight_bits not in BITS:
            raise InputError(f"weight_bits is {weight_bits!r}; expected one of {', '.join(map(str, BITS))}")
        check_precision(precision)
        if precision is not None and threshold is not None:
            raise InputError(f"threshold is {threshold} and precision is {precision}; expected one of them")
        self.preprocess = Preprocess() if preprocess is None else preprocess
        self.mapper = SpectralMapper() if mapper is None else mapper
        whitens = (whitening is None and self.mapper.whitens) or isinstance(whitening, Whitening)
        self.features = default_features(whitens) if features is None else features
        for module in self.features.modules():  # a file cannot be loaded into expanded buffers
            for name, buffer in module.named_buffers(recurse=False):
                if not is_lazy(buffer):
                    setattr(module, name, buffer.contiguous())
        if weight_bits == 8 and not round_weights(self.features):
            seen = f"weight_bits is 8, but {type(self.features).__name__} has no float32 weights of 2 or more"
            raise InputError(f"{seen} dimensions (lazy layers: not yet); expected 32")
        self.weight_bits = weight_bits
        if whitening is None and whitens:
            whitening = Whitening()
        self.whitening = whitening if isinstance(whitening, Whitening) else None
        self._whitens = self.whitening is not None  # if not, wide features are whitened nevertheless
        self.threshold = None if threshold is None else float(min(threshold, HIGHEST))
        self.precision = precision
        self.batch_size = batch_size
        self.velocity = velocity
        self.map: PlaceMap = self.mapper.empty()
        self.step: float | None = None  # pixels of ground from one place of the map to the next
        self.frame_shape: tuple[int, ...] | None = None  # of the reference, or (D,) of ready features
        self.frame_names: list[str] = []  # of the reference; empty if it has none
        self.trained: Training | None = None
        self.calibration: Calibration | None = None
        self.search: Search = "auto"  # for single queries, see `localize`
        self.search_memory: int | None = None  # bytes of the samples, see `coarse.plan`
        self.search_file: Path | str | None = None  # keeps the samples for other processes
        self.find: Find | None = None  # replaces the search, such as by a cluster
        self._coarse: tuple[tuple[Any, ...], CoarseSearch | None] = (), None  # a search and its key
        self._warned: set[tuple[str, str]] = set()  # (traverse, line) of warnings that were logged

    def settings(self) -> dict[str, Any]:
        """The constructor's arguments now: `DejaVu(**model.settings())` is the same model without a map.

        A whitening that is learned with each map is a copy, so that another model can learn; all other parts,
        such as the features, are this model's own.
        """
        own = {name: getattr(self, name) for name in inspect.signature(DejaVu).parameters}
        whitening = self.whitening
        if whitening is not None and not whitening.fixed:
            whitening = copy.deepcopy(whitening)
        return own | {"whitening": whitening or "none"}

    def learn(
        self,
        traverse: Source,
        progress: bool = False,
        second: Views | None = None,
        checkpoint: learning.Checkpoint | None = None,
        code: learning.Code = learning.ChunkCoder.chunks,
        visits: Views | None = None,
    ) -> DejaVu:
        """Section III-A: features, what repeats in them, and the map.

        Args:
            traverse: the reference: a Traverse, what `open_source` opens, or an array or tensor of frames or
                features, see `ArrayTraverse`.
            second: another traverse of the same places, from which whitening learns what changes between
                visits, instead of from augmented copies; see `growth.second_traverse`.
            progress: show a progress bar on a terminal, elsewhere a line per minute, on stderr.
            checkpoint: keeps the partial map of a long route, so that learning can resume after a kill; the
                caller removes it.
            code: codes the chunks of a long route: in this process, or on a cluster.
            visits: see `growth.learn_mean`.

        Returns:
            self, in eval mode, with the map in `self.map`. If nothing repeats along the route, a template map
            has no layers, and every place scores +inf. Trainable templates stay the same parameters, for an
            optimiser, if they have the former shapes.

        Convention: the descriptors (N,K) and a few copies of them are in memory. On a route longer than
            `SAMPLE` frames and one chunk, a spectral map learns whitening, mean and step from a sample, see
            `learning.Sample`, and only a chunk, the sample and the map are in memory.

        Raises:
            InputError: no frames, too few, NaN, or mixed sizes; features that depend on other frames. The
                model stays unchanged.
        """
        traverse = self.resample(as_traverse(traverse), progress=progress)
        describer, label = self._describer_of(traverse), "learning" if progress else None
        mapper = self.mapper.with_overhead(learning.positions_of(traverse).nbytes)
        route: PlaceMap
        counts: Tensor | None = None
        if visits is not None:
            describer.check_sizes(traverse, visits.traverse)
            counts = learning.observation_counts(visits, traverse.count())
        if isinstance(mapper, SpectralMapper) and learning.is_long(traverse, mapper.chunk):
            route = mapper.empty().to(describer.device)
            resumed = checkpoint is not None and checkpoint.open(
                model_file.run_key(self, traverse, second, visits), traverse, route, describer.whitening
            )
            if not resumed:
                route = learning.fit(mapper, describer, traverse, second, visits, label)
            learning.append_places(route, describer, traverse, 0, visits, label, checkpoint, code)
            learning.log_reached(route, mapper)
        else:
            if checkpoint is not None:
                checkpoint.check_unused()
            rows = describer.reference(traverse, second, label, isinstance(mapper, SpectralMapper))
            if visits is not None:
                rows = describer.averaged(rows, visits, label)
            route = learning.learn_descriptors(mapper, rows)
        if counts is not None:
            route.count_visits(1 + counts)
        self._keep_whitening(describer.whitening)
        return self._keep_map(route, traverse)

    def learn_features(self, features: Tensor, traverse: Traverse | None = None) -> DejaVu:
        """As `learn`, from ready descriptors.

        Args:
            features: (N,K) float, whitened if the model whitens.
            traverse: their source, if known: it tells the map which frames to expect, and the frame of each
                resampled place.
        """
        mapper = self.mapper.with_overhead(learning.positions_of(traverse).nbytes)
        return self._keep_map(learning.learn_descriptors(mapper, features), traverse)

    def describe_reference(
        self, traverse: Traverse, second: Views | None = None, progress: bool = False
    ) -> Tensor:
        """Descriptors (N,K) of the reference for `learn_features`; the whitening is learned from it.

        Args:
            second, progress: see `learn`; InputError if no whitening learns from the second.
        """
        describer, label = self._describer_of(traverse), "learning" if progress else None
        rows = describer.reference(traverse, second, label, isinstance(self.mapper, SpectralMapper))
        self._keep_whitening(describer.whitening)
        return rows

    @property
    def describer(self) -> learning.Describer:
        """Describes frames with the model's present settings."""
        pixels = math.prod(own_size(self.features) or (1,))  # larger frames, smaller batches
        batch = max(1, min(self.batch_size, BATCH_NUMBERS // (3 * pixels)))
        pipeline = Pipeline(self.preprocess, self.features)
        return learning.Describer(pipeline, self.whitening, batch, self.map.positions.device, self._warned)

    def _describer_of(self, traverse: Traverse) -> learning.Describer:
        """As `describer`, for learning from a traverse: with a copy of a whitening that is not fixed, or with
        principal components of ready features that are too wide for a spectral map."""
        whitening = self.whitening if self._whitens else None
        if whitening is not None and not whitening.fixed:
            whitening = copy.deepcopy(whitening)
        wide = learning.is_ready(traverse) and traverse.frame_shape[0] > WIDEST
        if whitening is None and wide and isinstance(self.mapper, SpectralMapper):
            whitening = Whitening(views=0).to(self.map.positions.device)
        return self.describer._replace(whitening=whitening)

    def _keep_whitening(self, learned: Whitening | None) -> None:
        if self._whitens and self.whitening is not None and learned is not None:
            self.whitening.load_state_dict(learned.state_dict())  # the caller may hold the module too
        else:
            self.whitening = learned

    def take_whitening(self, other: DejaVu) -> None:
        """Use the preprocess, features and whitening of another model; the whitening becomes fixed. Raises
        InputError if there is none."""
        if other.whitening is None or not other.whitening.learned:
            raise InputError("its map was learned without whitening; expected one learned with whitening")
        self.take_descriptor(other)
        self.whitening, self._whitens = other.whitening, True
        self.whitening.fixed = True

    def take_descriptor(self, other: DejaVu) -> None:
        """Use the preprocess and features of another model, such as one trained on many routes, but not its
        whitening.

        Example:
            >>> base = DejaVu(features=HOG(cell=16))
            >>> model = DejaVu(mapper=SpectralMapper(2.5))
            >>> model.take_descriptor(base)
            >>> model.features.cell
            16
        """
        self.preprocess, self.features = other.preprocess, other.features
        self.weight_bits = other.weight_bits

    def resample(
        self,
        traverse: Traverse,
        step: float | None = None,
        progress: bool = False,
        shape: tuple[int, ...] | None = None,
    ) -> Traverse:
        """A traverse as the model learns or localizes it: `fit`, then `resampled` by `velocity`. For queries,
        `step` and `shape` are `self.step` and `self.frame_shape`; for a reference, None."""
        return resampled(self.fit(traverse, shape), self.velocity, self.batch_size, step, progress)

    def fit(self, traverse: Traverse, shape: tuple[int, ...] | None = None) -> Traverse:
        """Frames at the size of the map's, or at `preprocess.size`; images and videos are decoded at it.

        Args:
            shape: (C,H,W) of the map's or the reference's frames; frames whose aspect ratio differs by over
                5 % stay unchanged. None is a reference: the longer side is reduced to `preprocess.size`, but
                not below the features' own `resize` or a block of HOG, and not if the source specifies a
                size, such as `clip.mp4?width=320`.

        Returns:
            The traverse itself if it has that size, or ready features.
        """
        own = traverse.frame_shape[1:]
        if len(own) != 2 or isinstance(traverse, ResampledTraverse):
            return traverse
        if shape is None:
            longest = None if traverse.sized else self.preprocess.size
            size, why = reduced_size(own, longest, own_size(self.features, block=True)), "see preprocess.size"
        else:
            size, why = size_like(own, shape), "the size of the map's frames"
        if size == own:
            return traverse
        line = f"frames of {own[0]} x {own[1]} pixels are resized to {size[0]} x {size[1]}, {why}"
        if (traverse.name, line) not in self._warned:
            log.warning("%s: %s", traverse.name, line)
            self._warned.add((traverse.name, line))
        return at_size(traverse, size)

    def _keep_map(self, route: PlaceMap, traverse: Traverse | None) -> DejaVu:
        """Keep the map learned from a traverse; returns self in eval mode."""
        shape = () if traverse is None else traverse.frame_shape
        if len(shape) == 3 and route.dimension > MANY_FEATURES:
            line = "each frame gives %d features; smaller frames make a smaller and faster map"
            log.warning(line, route.dimension)
        if len(shape) == 1 and (self.preprocess.channel or self.preprocess.contrast):
            log.warning("these are ready features: channel and contrast have no effect")
        device, positions = self.map.positions.device, learning.positions_of(traverse)
        route = route.to(device)  # many descriptors are in a file, on the CPU
        if len(positions):
            route.positions = positions.to(device)
            route.check()
        self.step = traverse.step if isinstance(traverse, ResampledTraverse) else None
        frames = len(positions) or route.places
        self.frame_names = [] if traverse is None else names_of(source_of(traverse), frames)
        self.frame_shape, self.trained = shape or None, None
        self._hand_on(route)
        return self.replace_map(route)

    @torch.no_grad()
    def _hand_on(self, route: PlaceMap) -> None:
        """Let the parameters of a new map be those of the present one, for an optimiser, with the new values;
        the present map keeps a copy of its own."""
        for name, new in dict(route.named_parameters(recurse=False)).items():
            own = getattr(self.map, name, None)
            if not isinstance(own, nn.Parameter) or not own.numel():
                continue
            if (own.shape, own.dtype, own.device) == (new.shape, new.dtype, new.device):
                setattr(self.map, name, nn.Parameter(own.clone()))
                own.grad = None
                setattr(route, name, own.copy_(new))
            else:
                log.warning("the %s of the map are new parameters: an optimiser has to be made anew", name)

    def replace_map(self, route: PlaceMap) -> DejaVu:
        """Set another map of the same frames, without calibration; returns self in eval mode."""
        self.map, self.find, self.calibration = route, None, None
        return self.eval()

    def calibrate(
        self,
        reference: Source | None,
        views: Views | None = None,
        places: Tensor | None = None,
        progress: bool = False,
    ) -> DejaVu:
        """Learn the probability that an answer is right from its confidence, for `Match.probability`.

        Args:
            reference: the traverse that the map was learned from. Every 10th segment of 20 frames is
                localized in changed light and view: `Augmentation` with 1.5 times the whitening's strengths.
            views: instead, frames of another traverse of the same places, or other segments of the reference.
                Frames without a place are ignored, and very many frames are sampled.
            places: (n,) int64, the place of each frame of the reference, -1 for none; None is place i for
                frame i.
            progress: see `learn`.

        Returns:
            self, with `self.calibration`.

        Raises:
            InputError: no map, ready features, which cannot be augmented, or no right answer.

        Example:
            >>> from dejavu_torch import open_source
            >>> route = open_source("sim:aerial?frames=80")
            >>> model = DejaVu(precision=0.99).learn(route).calibrate(route)
            >>> match = model.localize(open_source("sim:aerial?frames=80&traverse=1"))
            >>> bool((match.accepted == (match.probability >= 0.99)).all())
            True
        """
        self.require_map()
        own = None
        if reference is not None and views is None:
            own = self.fit(as_traverse(reference), self.frame_shape or ())
        label = "calibrating" if progress else None
        self.calibration = learning.calibration_of(self.describer, self.map, own, views, places, label)
        return self

    def describe(self, frames: Tensor) -> Tensor:
        """Preprocess, then features: (B,C,H,W) -> (B,D)."""
        features: Tensor = self.features(as_weights(self.preprocess(frames), self.features))
        return features

    def whitened(self, features: Tensor) -> Tensor:
        """Features (B,D) -> descriptors (B,K); without whitening they are the same."""
        return self.describer.whitened(features)

    def forward(self, queries: Tensor) -> Tensor:
        """Section III-B: scores of all places, differentiable (eq. 3, eq. 4)."""
        self.require_map()
        if isinstance(queries, Tensor):
            queries = resize_like(queries, self.frame_shape)
        features = features_of(queries, self.describe, "the query")
        self.check_queries(tuple(queries.shape[1:]), features.shape[1], "the query")
        return self.map.scores(self.whitened(features))

    def localize(
        self,
        queries: Source,
        progress: bool = False,
        sequence: SequenceModel | None = None,
        search: Search | None = None,
    ) -> Match:
        """Section III-C: the best place of each query and whether it is accepted (eq. 5, eq. 6).

        Args:
            queries: as in `learn`. They are resampled like the map's frames, see `resample`.
            progress: see `learn`.
            sequence: scores consecutive queries together, such as a `SequenceMatcher` or a `PlaceFilter`;
                None matches each query by itself.
            search: for single queries: "coarse" scores the places near the best samples of a long spectral
                map, "exact" also excludes all others by bounds, "scan" scores all places, "auto" is coarse if
                that is faster. None is `self.search`.

        Shape: -> Match of (Q,) on the CPU.

        Raises:
            InputError: no map, no frames, NaN, or features of another dimension than the map's; a
                `self.search_file` of another map, or for a search without samples.
        """
        return Match.joined(self.matches(queries, progress, sequence, search))

    def localize_descriptors(
        self,
        descriptors: Tensor,
        matching: Matching | SequenceModel | None = None,
        order: Tensor | None = None,
        progress: bool = False,
    ) -> Match:
        """As `localize`, for descriptors (Q,K), whitened if the model whitens.

        Args:
            matching: a Matching, or the sequence of `localize`. progress: see `learn`.
            order: (N,) the frame of each place of a shuffled map; the match then counts frames.
        """
        matching = matching if isinstance(matching, Matching) else self.matching(matching)
        localizer, label = self.localizer(matching), "localizing" if progress else None
        if order is None:
            return localizer(descriptors, label)
        matcher, place = Localizer(None, matching), order.argsort()
        parts = descriptors.split(max(1, SCORES_AT_ONCE // self.map.places))
        scores = (self.map.scores(part.to(self.map.positions.device)) for part in with_progress(parts, label))
        with torch.no_grad():
            return Match.joined(matcher.match(part[:, place.to(part.device)]) for part in scores)

    def localizer(self, matching: Matching) -> Localizer:
        """A matcher of descriptors, for consecutive batches of queries."""
        self.require_map()
        check_search(matching.search)
        sequence, coarse = matching.sequence, None
        if sequence is not None:
            sequence.check(None, self.map.places)
        if self.search_file is not None:
            check_searches(self.search_file, matching, self.find is not None)
        searches = getattr(sequence, "search_every", 1) > 1 if sequence else matching.callback is None
        if searches and self.find is None and matching.search != "scan":
            coarse = self._coarse_search(matching.search == "exact")
        if coarse is None:
            return Localizer(self.map, matching, self.find)
        return Localizer(self.map, matching, coarse, coarse.approximate)

    def _coarse_search(self, exact: bool) -> CoarseSearch | None:
        """The coarse search of the present map, made on first use; None if the map has to be scanned."""
        norms = getattr(self.map, "norms", None)  # identifies the map
        known, found = self._coarse
        file, how = self.search_file, (self.search_memory, exact)
        if not known or known[0] is not norms or known[1:] != (file, *how):
            found = coarse_search(self.map, *how) if file is None else kept_search(Path(file), self.map, *how)
            self._coarse = (norms, file, *how), found
        return found

    def matches(
        self,
        queries: Source,
        progress: bool = False,
        sequence: SequenceModel | None = None,
        search: Search | None = None,
        k: int | None = None,
        apart: int = 5,
    ) -> Iterator[Match]:
        """As `localize`, or with k as `candidates`, one batch of queries at a time, in constant memory."""
        self.require_map()
        if k is not None:
            check_candidates(k, apart, self.map.places)
        localizer = self.localizer(self.matching(sequence, search)._replace(k=k, radius=apart))
        queries = self.fit(as_traverse(queries), self.frame_shape or ())
        if sequence is not None:
            sequence.check(queries.length, self.map.places)
        if self.step is not None:
            queries = self.resample(queries, self.step, progress, self.frame_shape)
        shape, name = queries.frame_shape, queries.name

        def on_first(frames: Tensor, features: Tensor) -> None:
            self.check_queries(shape, features.shape[1], name)
            self.describer.warn_of_bright(frames, name)

        label = "localizing" if progress else None
        yield from map(localizer, self.describer.descriptors(queries, label, on_first))

    def candidates(
        self,
        queries: Source,
        k: int,
        apart: int = 5,
        sequence: SequenceModel | None = None,
        search: Search | None = None,
    ) -> Match:
        """The k best places of each query; the first is that of `localize`.

        Args:
            queries, sequence, search: see `localize`.
            k: from 1 to the number of places.
            apart: suppression radius in places, at least 0: any two candidates of a query differ by more.

        Shape: -> Match of (Q,k) on the CPU.

        Raises:
            InputError: as `localize`, or k or apart out of range.

        Example:
            >>> wave = torch.arange(64)[:, None] % torch.tensor([8.0, 9.0])
            >>> DejaVu().learn(wave).candidates(wave[20:22], k=3).index[:, 0]
            tensor([20, 21])
        """
        return Match.joined(self.matches(queries, False, sequence, search, k, apart))

    def matching(self, sequence: SequenceModel | None = None, search: Search | None = None) -> Matching:
        """How queries are matched, with probabilities if the map is calibrated for it. Raises InputError if a
        precision lacks this calibration."""
        platt = self.calibration and self.calibration.of(sequence)
        if self.precision is not None and platt is None:
            only = "calibrated for single queries and for a filter with search_every 1 only"
            seen = f"the precision is {self.precision}, but the map is "
            raise InputError(f"{seen}{only if self.calibration else 'not calibrated'}; expected a threshold")
        accepts = self.acceptance(sequence)
        return Matching(sequence, acceptance=accepts, platt=platt, search=search or self.search)

    def acceptance(self, sequence: SequenceModel | None = None) -> Acceptance:
        """Which answers are accepted, for single queries or for a sequence (convention 4).

        In this order: by the threshold or precision of the user or of the map's file; with a probability of
        at least .5, if the map is calibrated for this way of matching; with a filter's own probability above
        .5; every finite score.
        """
        threshold = self.threshold if sequence is None else sequence.threshold_of(self.threshold)
        if threshold is not None or self.precision is not None:
            return Acceptance(threshold, None if threshold is not None else self.precision)
        if self.calibration is not None and self.calibration.of(sequence) is not None:
            return Acceptance(precision=PROBABLE, given=False)
        return Acceptance(None if sequence is None else sequence.likely, given=False)

    def extract_all(self, traverse: Traverse, progress: bool = False) -> Tensor:
        """Descriptors (N,K) of a whole traverse; many are kept in a temporary file, see `concatenate`."""
        label = f"describing {traverse.name}" if progress else None
        return concatenate(self.describer.descriptors(traverse, label))

    @property
    def features_per_frame(self) -> int:
        """D, the number of features per frame that the map was learned from."""
        learned = self.whitening is not None and self.whitening.learned
        return sum(self.whitening.sizes) if learned and self.whitening else self.map.dimension

    def check_queries(self, shape: tuple[int, ...], dimension: int, name: str) -> None:
        """Refuse queries that do not fit the map, and warn if their frames have another size.

        Args:
            shape: of one query, (C,H,W) or (D,). dimension: D, its features. name: for the message.
        """
        reference, expected = self.frame_shape, self.features_per_frame
        if len(shape) == 1 and dimension != expected:
            learned = f", as frames of {' x '.join(map(str, reference or ()))} give"
            seen = f"{name} gives {dimension} features; the map expects {expected}"
            raise InputError(f"{seen}{learned * (len(reference or ()) == 3)}")
        if reference is None or len(shape) != 3:
            return
        if len(reference) == 1:
            seen = f"{name} has frames, but the map was learned from ready features"
            raise InputError(f"{seen}; expected features (Q, {expected})")
        own, other = (" x ".join(map(str, one)) for one in (shape, reference))
        if dimension != expected:
            seen = f"{name}: frames of {own} give {dimension} features"
            raise InputError(f"{seen}; the map expects {expected}, as frames of {other} give")
        if shape[1:] != reference[1:] and getattr(self.features, "resize", None) is None:
            log.warning("%s has frames of %s, the map was learned from %s", name, own, other)

    def frame_name(self, frame: int) -> str:
        """The name of a reference frame, such as its file name; empty if it has none."""
        return self.frame_names[frame] if self.frame_names else ""

    def save(self, path: str | Path) -> None:
        """Write the map, or a trained descriptor without a map, and the weights of the features as one
        safetensors file.

        Raises:
            InputError: nothing learned yet, weights that changed after they were rounded, or a file that
                cannot be written.
        """
        if self.trained is None:
            self.require_map()
        model_file.write_model(Path(path), self)

    @classmethod
    def load(cls, path: str | Path, features: nn.Module | None = None) -> DejaVu:
        """Read a map file; the model is in eval mode.

        Args:
            features: the module that made the map's features, needed if it is not of this package; its
                weights are read from the file.

        Raises:
            InputError: a missing, truncated, foreign or newer file, or other features than the map's.
        """
        return model_file.read_model(cls, Path(path), features).eval()

    def summary(self) -> MapSummary:
        """The resolution of the map, and the bytes of its file by part."""
        return model_file.summary_of(self)

    def get_extra_state(self) -> dict[str, Any]:
        """The state apart from tensors and the map's own state."""
        return model_file.model_state(self)

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore the result of `get_extra_state`; InputError if its entries or types differ."""
        model_file.set_state(self, checked_fields(state, model_file.STATE, "the model's state"))

    def require_map(self, purpose: str = "") -> None:
        """Refuse a model without a map; `purpose` is for the message, such as " to append to"."""
        if not self.map.places:
            if self.trained is None:
                raise InputError(f"there is no map yet{purpose}; expected learn(...) or load(...) first")
            seen = f"this is a descriptor without a map{purpose}"
            raise InputError(f"{seen}; expected learn(...) with it first")


def default_features(whitens: bool = True) -> nn.Module:
    """HOG and the package's network side by side; without whitening HOG alone, as in the paper."""
    return Joined([HOG(), Distilled()]) if whitens else HOG()


def own_size(features: nn.Module, block: bool = False) -> tuple[int, int] | None:
    """The size (height, width) to which features of this package resize frames, the largest of joined ones;
    None if they do not. With `block`, also the size of a block of HOG."""
    if isinstance(features, Joined):
        sizes = [one for one in (own_size(member, block) for member in features.members) if one is not None]
        return (max(height for height, _ in sizes), max(width for _, width in sizes)) if sizes else None
    known = type(features) in model_file.CLASSES
    size: tuple[int, int] | None = getattr(features, "resize", None) if known else None
    if size is None and block and type(features) is HOG:
        size = (features.cell * features.block,) * 2
    return size


def check_precision(precision: float | None) -> None:
    """Refuse a precision outside (0, 1)."""
    if precision is not None and not 0 < precision < 1:
        raise InputError(f"the precision is {precision}; expected a share above 0 and below 1, such as .99")
