"""The whole method as one module; reads like section III of the paper."""

from __future__ import annotations

import copy
import inspect
import logging
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn.parameter import is_lazy

from dejavu_torch.data.arrays import as_traverse
from dejavu_torch.data.fitted import at_size, resize_like, size_like
from dejavu_torch.data.names import names_of
from dejavu_torch.features.extract import check_queries, features_of
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.memory import concatenate
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.views import Views
from dejavu_torch.features.whitening import WIDEST, Whitening
from dejavu_torch.learning import (
    Checkpoint,
    Code,
    Describer,
    calibration_of,
    code_here,
    is_ready,
    learn_descriptors,
    learn_map,
    positions_of,
)
from dejavu_torch.maps.place_map import Mapper, PlaceMap
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.maps.weights import BITS, round_weights
from dejavu_torch.model_file import (
    CLASSES,
    model_state,
    read_model,
    run_key,
    summary_of,
    take_state,
    write_model,
)
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.motion.resampling import ResampledTraverse, resampled, source_of
from dejavu_torch.recognition.calibration import Calibration
from dejavu_torch.recognition.localizer import Localizer, Matching
from dejavu_torch.recognition.search import SCORES_AT_ONCE, Best, Search, check_search
from dejavu_torch.recognition.select import HIGHEST, PROBABLE, Acceptance, check_candidates
from dejavu_torch.resize import reduced_size
from dejavu_torch.types import (
    BATCH_NUMBERS,
    InputError,
    Match,
    SequenceModel,
    Training,
    Traverse,
)

log = logging.getLogger("dejavu_torch")

ROWS = 4096  # descriptors on the device at a time
MANY_FEATURES = 50_000  # per frame: worth a word


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
        self.find: Callable[[Tensor, int], Best] | None = (
            None  # finds places in place of `search`, as a cluster
        )
        self._reduces = False  # whether `_reduce` has set the whitening
        self._told: set[tuple[str, str]] = set()  # lines that are said once
        self._bright: set[str] = set()  # traverses that were said to be bright

    def settings(self) -> dict[str, Any]:
        """The constructor's arguments as they are now: `DejaVu(**model.settings())` has no map."""
        own = {name: getattr(self, name) for name in inspect.signature(DejaVu).parameters}
        return own | {"whitening": self.whitening or "none"}

    def learn(
        self,
        traverse: Traverse | Tensor,
        progress: bool = False,
        second: Views | None = None,
        checkpoint: Checkpoint | None = None,
        code: Code = code_here,
        visits: Views | None = None,
    ) -> DejaVu:
        """Section III-A: features, what repeats in them, and the map.

        Args:
            traverse: the reference, a Traverse or a tensor: frames (N,C,H,W) or features (N,D).
            second: another traverse of the same places, from which whitening learns, in place of augmented
                copies, what changes between two visits; `growth.second_traverse` makes it.
            progress: show a progress bar on a terminal, elsewhere a line a minute, on stderr.
            checkpoint: where a long route keeps its partial map, so that learning goes on from there after a
                kill; it is the caller's to remove.
            code: what makes the chunks of a long route: `code_here`, or a cluster.
            visits: see `growth.learn_mean`.

        Returns:
            self, in eval mode, with the map in `self.map`. A route in which nothing repeats gives a template
            map without layers, on which every place scores +inf. Features beyond `concatenate`'s share of
            the memory spill to a temporary file; descriptors stay in it, (N,K) and a few temporary copies.

        Convention: of a route of over `SAMPLE` frames, and over one chunk, a spectral map learns whitening,
            mean and step from a sample, see `learning.Sample`, and its chunks are made one by one. Memory
            holds a chunk, the sample and the map, whatever the number of frames.

        Raises:
            InputError: no frames, too few, NaN, or mixed sizes; features that depend on other frames.
        """
        traverse = self.resample(as_traverse(traverse), progress=progress)
        state = None if self.whitening is None else copy.deepcopy(self.whitening.state_dict())
        before = self.whitening, self._reduces
        self._reduce(traverse)
        run = None if checkpoint is None else (checkpoint, lambda: run_key(self, traverse, second, visits))
        text = "learning" if progress else None
        try:
            route = learn_map(self.describer, self.mapper, traverse, second, visits, text, run, code)
        except InputError:  # the map that there was has its own whitening
            self.whitening, self._reduces = before
            if self.whitening is not None and state is not None:
                self.whitening.load_state_dict(state)
            raise
        return self._take(route, traverse)

    def learn_features(self, features: Tensor, traverse: Traverse | None = None) -> DejaVu:
        """As `learn`, from descriptors that are there already. It ends in eval mode.

        Args:
            features: (N,K) float, whitened where the model whitens.
            traverse: what they come from, where known: the map then knows what frames to expect, and,
                where they were resampled, which frame each place shows.
        """
        overhead = positions_of(traverse).nbytes
        mapper = self.mapper.with_overhead(overhead, is_ready(traverse))
        return self._take(learn_descriptors(mapper, features), traverse)

    def describe_reference(
        self, traverse: Traverse, second: Views | None = None, progress: str | None = None
    ) -> Tensor:
        """Descriptors (N,K) of the reference, the whitening learned from it: what `learn_features` takes.

        Args:
            second: as of `learn`. progress: text of a progress bar on a terminal; None shows nothing.

        Raises:
            InputError: as `learn`, or a second traverse that no whitening learns from.
        """
        self._reduce(traverse)
        return self.describer.reference(traverse, second, progress, isinstance(self.mapper, SpectralMapper))

    @property
    def describer(self) -> Describer:
        """How the model describes frames now."""
        pixels = math.prod(own_size(self.features) or (1,))  # fewer frames at a time if these become large
        batch = max(1, min(self.batch_size, BATCH_NUMBERS // (3 * pixels)))
        pipeline = nn.Sequential(self.preprocess, self.features)
        return Describer(pipeline, self.whitening, batch, self.map.positions.device, self._bright)

    def _reduce(self, traverse: Traverse) -> None:
        """Ready features too wide for a spectral map become principal components without whitening, too."""
        ready = is_ready(traverse) and isinstance(self.mapper, SpectralMapper)
        wide = ready and traverse.frame_shape[0] > WIDEST
        if wide and self.whitening is None:
            self.whitening, self._reduces = Whitening(views=0).to(self.map.positions.device), True
        elif self._reduces and not wide:  # of a route that was learned before
            self.whitening, self._reduces = None, False

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
        own = traverse.frame_shape[1:]
        if len(own) != 2 or isinstance(traverse, ResampledTraverse):
            return traverse
        if shape is None:
            longest = None if traverse.sized else self.preprocess.size
            size, why = reduced_size(own, longest, least_size(self.features)), "see preprocess.size"
        else:
            size, why = size_like(own, shape), "the size of the map's frames"
        if size == own:
            return traverse
        line = f"frames of {own[0]} x {own[1]} pixels are brought to {size[0]} x {size[1]}, {why}"
        if (traverse.name, line) not in self._told:
            log.warning("%s: %s", traverse.name, line)
            self._told.add((traverse.name, line))
        return at_size(traverse, size)

    def _take(self, route: PlaceMap, traverse: Traverse | None) -> DejaVu:
        """The map that was learned from a traverse, in eval mode."""
        shape = () if traverse is None else traverse.frame_shape
        if len(shape) == 3 and route.dimension > MANY_FEATURES:
            log.warning(
                "each frame gives %d features; smaller frames make a smaller and faster map", route.dimension
            )
        if len(shape) == 1 and (self.preprocess.channel or self.preprocess.contrast):
            log.warning("these are ready features: channel and contrast are left as they are")
        device, positions = self.map.positions.device, positions_of(traverse)
        route = route.to(device)  # many descriptors lie in a file, on the CPU
        if len(positions):
            route.positions = positions.to(device)
            route.check()
        self.step = traverse.step if isinstance(traverse, ResampledTraverse) else None
        frames = len(positions) or route.places
        self.frame_names = [] if traverse is None else names_of(source_of(traverse), frames)
        self.map, self.find, self.frame_shape = route, None, shape or None
        self.trained = self.calibration = None
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
        own = None
        if reference is not None and views is None:
            own = self.fit(as_traverse(reference), self.frame_shape or ())
        self.calibration = calibration_of(self.describer, self.map, own, views, places)
        return self

    def describe(self, frames: Tensor) -> Tensor:
        """Features of frames: preprocess, then features. (B,C,H,W) -> (B,D)"""
        features: Tensor = self.features(self.preprocess(frames))
        return features

    def whitened(self, features: Tensor) -> Tensor:
        """Descriptors of features, (B,D) -> (B,K); the features themselves without whitening."""
        return self.describer.whitened(features)

    def forward(self, queries: Tensor) -> Tensor:
        """Section III-B: scores of all places, differentiable (eq. 3, eq. 4)."""
        self._require_map()
        if isinstance(queries, Tensor):
            queries = resize_like(queries, self.frame_shape)
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
            search: how the best place of a single query is searched for, see `recognition.search`.

        Shape: -> Match of (Q,) on the CPU.

        Convention: on a map of even steps the queries are resampled likewise first, see `resample`.

        Raises:
            InputError: no map, no frames, NaN, or features of another dimension than the map's.
        """
        return Match.joined(self.matches(queries, progress, sequence, search))

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
        return self.found(descriptors, self.matching(sequence, search), order)

    def found(self, descriptors: Tensor, matching: Matching, order: Tensor | None = None) -> Match:
        """What a matching finds, of descriptors and in an order as of `localize_descriptors`."""
        localizer = self.localizer(matching)
        if order is None:
            return localizer(descriptors)
        matcher, place = Localizer(None, matching), order.argsort()
        parts = descriptors.split(max(1, SCORES_AT_ONCE // self.map.places))
        scores = (self.map.scores(part.to(self.map.positions.device)) for part in parts)
        with torch.no_grad():
            return Match.joined(matcher.match(part[:, place.to(part.device)]) for part in scores)

    def localizer(self, matching: Matching) -> Localizer:
        """What matches descriptors on the map, a batch of consecutive queries after the other."""
        self._require_map()
        check_search(matching.search)
        if matching.sequence is not None:
            matching.sequence.check(None, self.map.places)
        return Localizer(self.map, matching, self.find)

    def matches(
        self,
        queries: Traverse | Tensor,
        progress: str | None = None,
        sequence: SequenceModel | None = None,
        search: Search = "auto",
        k: int | None = None,
        apart: int = 5,
    ) -> Iterator[Match]:
        """As `localize`, or with k as `candidates`, one batch of queries at a time: memory does not grow with
        the queries."""
        self._require_map()
        if k is not None:
            check_candidates(k, apart, self.map.places)
        localizer = self.localizer(self.matching(sequence, search)._replace(k=k, radius=apart))
        queries = self.fit(as_traverse(queries), self.frame_shape or ())
        if sequence is not None:
            sequence.check(queries.length, self.map.places)
        if self.step is not None:
            queries = self.resample(queries, self.step, progress is not None, self.frame_shape)
        shape, name = queries.frame_shape, queries.name

        def on_first(frames: Tensor, features: Tensor) -> None:
            self.check_queries(shape, features.shape[1], name)
            self.describer.warn_of_bright(frames, name)

        yield from map(localizer, self.describer.descriptors(queries, progress, on_first))

    def candidates(
        self,
        queries: Traverse | Tensor,
        k: int,
        apart: int = 5,
        sequence: SequenceModel | None = None,
        search: Search = "auto",
    ) -> Match:
        """The k best places of each query, no two of them near each other; the first is `localize`'s.

        Args:
            queries, sequence, search: as of `localize`.
            k: how many, from 1 to the number of places.
            apart: places, at least 0: any two candidates of a query differ by more.

        Shape: -> Match of (Q,k) on the CPU.

        Raises:
            InputError: as `localize`, or k or apart out of range.

        Example:
            >>> wave = torch.arange(64)[:, None] % torch.tensor([8.0, 9.0])
            >>> DejaVu().learn(wave).candidates(wave[20:22], k=3).index[:, 0]
            tensor([20, 21])
        """
        return Match.joined(self.matches(queries, None, sequence, search, k, apart))

    def matching(self, sequence: SequenceModel | None = None, search: Search = "auto") -> Matching:
        """A way to match queries, with probabilities if the map is calibrated for it.

        Raises:
            InputError: a precision, but the map is not calibrated, or not for this way of matching.
        """
        platt = self.calibration and self.calibration.of(sequence)
        if self.precision is not None and platt is None:
            seen = "the map is not calibrated"
            if self.calibration is not None:
                seen = "the map is calibrated for single queries and for a filter that always searches"
            problem = f"the precision is {self.precision}, but {seen}"
            raise InputError(f"{problem}; expected a threshold in its place")
        return Matching(sequence, rule=self.acceptance(sequence), platt=platt, search=search)

    def acceptance(self, sequence: SequenceModel | None = None) -> Acceptance:
        """Which answers are accepted, of single queries or of a sequence (convention 4).

        By the threshold or precision that was given, or that the map's file has. Else, on a map that is
        calibrated for this way of matching, where the probability is at least .5. Else what a filter by
        itself takes for more likely than not, and of other ways every finite score.
        """
        threshold = self.threshold if sequence is None else sequence.threshold_of(self.threshold)
        if threshold is not None or self.precision is not None:
            return Acceptance(threshold, None if threshold is not None else self.precision)
        if self.calibration is not None and self.calibration.of(sequence) is not None:
            return Acceptance(precision=PROBABLE, given=False)
        return Acceptance(None if sequence is None else sequence.likely, given=False)

    def extract_all(self, traverse: Traverse, progress: str | None = None) -> Tensor:
        """Descriptors of a whole traverse, (N,K); many of them lie in a temporary file, see `concatenate`."""
        return concatenate(self.describer.descriptors(traverse, progress))

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
        write_model(Path(path), self)

    @classmethod
    def load(cls, path: str | Path, features: nn.Module | None = None) -> DejaVu:
        """Read a map file; the model is in eval mode.

        Args:
            features: the module that made the map's features, needed where it is not one of this
                package; its weights come from the file.

        Raises:
            InputError: missing, truncated, foreign or newer file, or other features than the map's.
        """
        return read_model(cls, Path(path), features).eval()

    def summary(self) -> MapSummary:
        """What the map can tell apart, and the bytes of its file by part."""
        return summary_of(self)

    def get_extra_state(self) -> dict[str, Any]:
        """What the state_dict holds beside the tensors and the map's own state."""
        return model_state(self)

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take over what `get_extra_state` gave.

        Raises:
            InputError: a state of other entries, or of other types.
        """
        take_state(self, state)

    def _require_map(self) -> None:
        if not self.map.places and self.trained is not None:
            raise InputError(
                "this is a descriptor without a map; expected learn(...) of a route with it first"
            )
        if not self.map.places:
            raise InputError("there is no map yet; expected learn(...) or load(...) first")


def own_size(features: nn.Module) -> tuple[int, int] | None:
    """The size (height, width) that features resize frames to, if a class of this package does."""
    return getattr(features, "resize", None) if type(features) in CLASSES else None


def least_size(features: nn.Module) -> tuple[int, int] | None:
    """The least size that features can be made of, where that is known."""
    return (
        (features.cell * features.block,) * 2
        if type(features) is HOG and not features.resize
        else own_size(features)
    )


def check_precision(precision: float | None) -> None:
    """Refuse a precision that no answers can be asked for.

    Raises:
        InputError: not above 0 and below 1.
    """
    if precision is not None and not 0 < precision < 1:
        raise InputError(f"the precision is {precision}; expected a share above 0 and below 1, such as .99")
