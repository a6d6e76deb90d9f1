"""The whole method as one module: learn a map of a route, and find places on it (section III)."""

from __future__ import annotations

import copy
import inspect
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast

import torch
from torch import Tensor, nn
from torch.nn.parameter import is_lazy

from dejavu_torch import learning, model_file
from dejavu_torch.data.maker import check_maker
from dejavu_torch.data.moving import unmoved
from dejavu_torch.data.source import Source, as_traverse
from dejavu_torch.data.traverse import Part, at_size, parts_of, resize_like, size_like
from dejavu_torch.data.turning import is_turned
from dejavu_torch.features.descriptor import Descriptor, OnFirst, own_size
from dejavu_torch.features.extract import features_of
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.probe import probe_of
from dejavu_torch.features.views import AugmentedFrames, LabelledFrames
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.maps.digest import PLACES, digests_of
from dejavu_torch.maps.place_map import Mapper, PlaceMap
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectral_map import SpectralMap
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.maps.weights import BITS, round_weights
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.motion.resampling import ResampledTraverse, resampled, source_of
from dejavu_torch.places.layout import ROUTE, Layout
from dejavu_torch.recognition.calibration import confidence
from dejavu_torch.recognition.centring import PRIOR, centred, set_apart
from dejavu_torch.recognition.coarse import searcher
from dejavu_torch.recognition.drive import FEWER
from dejavu_torch.recognition.large import is_large
from dejavu_torch.recognition.localizer import SINGLE, Localizer, Matching, answer
from dejavu_torch.recognition.odometry import Moved, moves_of
from dejavu_torch.recognition.provenance import Provenance
from dejavu_torch.recognition.querying import QUERYING, Drives, Querying, Sequences
from dejavu_torch.recognition.scorer import Earlier, OfMap, Scorer
from dejavu_torch.recognition.search import Scan, Search, Searcher, check_search
from dejavu_torch.recognition.select import HIGHEST, PROBABLE, Acceptance, check_candidates
from dejavu_torch.recognition.smoother import PlaceSmoother
from dejavu_torch.recognition.views import ALONE, FIRST, LEAST, Views, best_pairs
from dejavu_torch.resize import reduced_size, turned_hint
from dejavu_torch.types import Facts, InputError, Match, Odometer, SequenceModel, Traverse, expect

if TYPE_CHECKING:
    from dejavu_torch.recognition.calibration import Calibration
    from dejavu_torch.types import Training

log = logging.getLogger("dejavu_torch")

MANY_FEATURES = 50_000  # per frame: more are warned of
DESCRIBES = ("preprocess", "features", "whitening", "batch_size", "weight_bits")  # of the descriptor
REMOVED = 0.5  # of each place's mean score where lengths count: without it only inner products would remain
Way = TypeVar("Way", bound=SequenceModel)
STATE = [field.name for field in fields(model_file.ModelState)]


class DejaVu(nn.Module):
    """Learn a compressed map of a route, by default a spectral map, and find places on it (section III).

    Args:
        features: any nn.Module (B,C,H,W) -> (B,D), given frames in the type of its weights; by default HOG
            and the built-in 65 kB network `Distilled`, or HOG alone if unwhitened.
        whitening: reduces features to few dimensions, learned with each map unless it is `fixed`; None is
            Whitening for a SpectralMapper and "none" for templates. "none" keeps the features, except that a
            SpectralMapper reduces precomputed features of over 256 dimensions to principal components.
        mapper: makes the map from the descriptors of a route; None is SpectralMapper with its defaults.
        threshold: accept a match if its score is below this; infinity accepts every finite score.
        precision: accept an answer if it is right with at least this probability, such as .99; the map has
            to be calibrated. See `acceptance` for the default.
        batch_size: frames in memory at a time.
        preprocess: size, colour and contrast of the frames; None is Preprocess with its defaults, which
            reduces the longer side to 160 pixels, but no side below what the features need.
        velocity: measures the motion of the ground, so that places and queries are even steps along it
            (section IV-B); None uses the frames as they are.
        weight_bits: bits of each weight of the features in the file; 8 rounds the weights in place, with a
            scale for each output channel.

    Shape: forward: frames (Q,C,H,W) or features (Q,D) -> scores (Q,N), lower is better.

    Attributes:
        descriptor: makes descriptors of frames: preprocess, features and whitening, which are attributes of
            the model too.
        map: the `PlaceMap`, empty before `learn`.
        state: what else is known of the route, whose fields are attributes of the model too; see
            `ModelState`.

    Convention: `Match.index` is a place; `map.frame_of` gives the reference frame of a place. `forward` is a
        fixed sequence of tensor operations without host synchronisation: it supports `torch.export` with a
        dynamic batch and `torch.compile(fullgraph=True)`.

    Example:
        >>> import torch
        >>> from dejavu_torch import SpectrogramAnalysis, TemplateMapper
        >>> wave = torch.arange(64)[:, None] % torch.tensor([8.0, 9.0])  # two features that repeat
        >>> model = DejaVu(mapper=TemplateMapper(SpectrogramAnalysis(window=64, strongest=1))).learn(wave)
        >>> model.localize(wave[20:22]).index
        tensor([20, 21])
        >>> DejaVu().learn(wave).localize(wave[20:22]).index  # the spectral map
        tensor([20, 21])
    """

    preprocess: Preprocess
    features: nn.Module
    whitening: Whitening | None
    batch_size: int
    weight_bits: int
    frame_shape: tuple[int, ...] | None
    step: float | None
    trained: Training | None
    frame_names: list[str]
    calibration: Calibration | None
    views: Views | None
    provenance: Provenance
    probe: tuple[float, ...] | None

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
        expect(mapper is None or isinstance(mapper, Mapper), "a Mapper or None", mapper=type(mapper))
        expect(isinstance(batch_size, int) and batch_size > 0, "an integer above 0", batch_size=batch_size)
        expect(threshold is None or threshold > -math.inf, "a number, or None", threshold=threshold)
        expect(weight_bits in BITS, f"one of {', '.join(map(str, BITS))}", weight_bits=weight_bits)
        check_precision(precision)
        expect(None in (precision, threshold), "one of them", threshold=threshold, precision=precision)
        self.mapper = SpectralMapper() if mapper is None else mapper
        if whitening is None and self.mapper.whitens:
            whitening = Whitening()
        whitening = whitening if isinstance(whitening, Whitening) else None
        self.descriptor = Descriptor(preprocess, features, whitening, batch_size, weight_bits)
        for module in self.features.modules():  # a file cannot be loaded into expanded buffers
            for name, buffer in module.named_buffers(recurse=False):
                if not is_lazy(buffer):
                    setattr(module, name, buffer.contiguous())
        if weight_bits == 8 and not round_weights(self.features):
            seen = f"weight_bits is 8, but {type(self.features).__name__} has no float32 weights of 2 or more"
            raise InputError(f"{seen} dimensions (lazy layers: not yet); expected 32")
        self.threshold = None if threshold is None else float(min(threshold, HIGHEST))
        self.precision = precision
        self.velocity = velocity
        self.map: PlaceMap = self.mapper.empty()
        self.state = model_file.ModelState()
        self.make_searcher: Callable[[PlaceMap], Searcher] = searcher  # of each map, for single queries
        self.searcher: Searcher | None = None  # of this map; None is made at the first search

    def __getattr__(self, name: str) -> Any:
        known = self.__dict__  # not all of it while a model is made
        if name in DESCRIBES and "descriptor" in known.get("_modules", ()):
            return getattr(self.descriptor, name)
        return getattr(self.state, name) if name in STATE and "state" in known else super().__getattr__(name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name in DESCRIBES:
            setattr(self.descriptor, name, value)
        elif name in STATE:
            setattr(self.state, name, value)
        else:
            super().__setattr__(name, value)

    def __repr__(self) -> str:
        """One line: places, map, and from which features come how many dimensions."""
        members = self.features.members if isinstance(self.features, Joined) else [self.features]
        known = ",".join(type(member).__name__ for member in members)
        known = "ready features" if len(self.frame_shape or ()) == 1 else known
        if not self.map.places:
            return f"{type(self).__name__}(no map yet, {known})"
        kind, size = self.map.kind.rstrip("s"), self.summary().map_bytes / 1e3
        told = f"{self.map.places} places, {kind} map of {size:.0f} kB, {known} -> {self.map.dimension}"
        return f"{type(self).__name__}({told})"

    def settings(self) -> Facts:
        """The constructor's arguments now: `DejaVu(**model.settings())` is the same model without a map.

        A whitening that is learned with each map is a copy, so that another model can learn; all other parts,
        such as the features, are this model's own.
        """
        settings = {name: getattr(self, name) for name in inspect.signature(DejaVu).parameters}
        whitening = None if self.descriptor.reduces else self.whitening
        if whitening is not None and not whitening.fixed:
            whitening = copy.deepcopy(whitening)
        return settings | {"whitening": whitening or "none"}

    def learn(
        self,
        traverse: Source,
        progress: bool = False,
        second: LabelledFrames | None = None,
        checkpoint: learning.Checkpoint | None = None,
        map_tasks: learning.MapTasks = map,
        visits: LabelledFrames | None = None,
    ) -> DejaVu:
        """Section III-A: features, what repeats in them, and the map.

        Args:
            traverse: the reference: a Traverse, what `open_source` opens, an array or tensor of frames or
                features (see `ArrayTraverse`), or a list or dataset of frames (see `Frames`).
            second: another traverse of the same places, from which whitening learns what changes between
                visits, instead of from augmented copies, or besides; see `growth.second_traverse`.
            progress: show a progress bar on a terminal, elsewhere a line per minute, on stderr.
            checkpoint: keeps the partial map of a long route, so that learning can resume after a kill; the
                caller removes it.
            map_tasks: encodes the chunks of a long route, as `map` in this process, or on a cluster.
            visits: see `growth.learn_mean`.

        Returns:
            self, in eval mode, with the map in `self.map`. If nothing repeats along the route, a template map
            has no layers, and every place scores +inf. Trainable templates stay the same parameters, for an
            optimiser, if they have the former shapes.

        Convention: the descriptors (N,K) and a few copies of them are in memory. On a route longer than
            `SAMPLE` frames and one chunk, a spectral map learns whitening, mean and step from a sample, see
            `Sample`, and only a chunk, the sample and the map are in memory.

        Raises:
            InputError: no frames, too few, NaN, or mixed sizes; features that depend on other frames. The
                model stays unchanged.
        """
        traverse = self.resample(as_traverse(traverse), progress=progress)
        descriptor, mapper, counts = self.descriptor, self.mapper, None
        if visits is not None:
            descriptor.check_sizes(traverse, visits.traverse)
            counts = learning.observation_counts(visits, len(traverse))
        with descriptor.unchanged_by_errors():
            descriptor.adapt(traverse)
            if isinstance(mapper, SpectralMapper) and learning.is_long(traverse, mapper.chunk):
                descriptor.reduce_if_wide(traverse)  # for a partial map with its whitening
                place_map = mapper.empty().to(descriptor.device)
                key = checkpoint and model_file.run_key(self, traverse, second, visits)
                if not (checkpoint and key and checkpoint.open(key, place_map, descriptor)):
                    place_map = learning.fit(mapper, descriptor, traverse, second, visits, progress)
                else:
                    descriptor.adapt(traverse, resumed=True)
                    place_map.laid_out(traverse.layout)
                settings = visits, progress, checkpoint, map_tasks
                learning.append_places(place_map, descriptor, traverse, 0, *settings)
                learned: PlaceMap = place_map
            else:
                if checkpoint is not None:
                    checkpoint.check_unused()
                rows = own = descriptor.learn(traverse, second, progress, isinstance(mapper, SpectralMapper))
                if visits is not None:
                    rows = learning.averaged(descriptor, own, visits, progress)
                learned = learning.learn_descriptors(mapper, rows, traverse.layout)
                learned.know(own)
            if counts is not None:
                learned.count_visits(learned.visit_counts + counts.to(learned.device))
            learning.count_drives(learned, second)
        self.replace_map(learned, _state_of(self, learned, traverse))
        for views in filter(None, (visits, second)):
            self.taught_by(*views[:2])
        return self if second is None else self.look_at(second.traverse)

    def learn_features(
        self,
        features: Tensor,
        traverse: Traverse | None = None,
        second: LabelledFrames | None = None,
        layout: Layout = ROUTE,
    ) -> DejaVu:
        """As `learn`, from ready descriptors.

        Args:
            features: (N,K) float, whitened if the model whitens.
            traverse: their source, if known: it tells the map which frames to expect, and the frame of each
                resampled place.
            second: what the whitening has learned from; the map tells how many drives taught it.
            layout: where the places lie, such as in rows and columns; without a traverse, which knows it.
        """
        layout = layout.reaching(len(features)) if traverse is None else traverse.layout
        learned = learning.learn_descriptors(self.mapper, features, layout)
        learning.count_drives(learned, second)
        self.replace_map(learned, _state_of(self, learned, traverse))
        return self if second is None else self.taught_by(*second[:2]).look_at(second.traverse)

    def resample(
        self,
        traverse: Traverse,
        step: float | None = None,
        progress: bool = False,
        shape: tuple[int, ...] | None = None,
    ) -> Traverse:
        """A traverse as the model learns or localizes it: `at_map_size`, then `resampled` by `velocity`. For
        queries, `step` and `shape` are `self.step` and `self.frame_shape`; for a reference, None."""
        return resampled(self.at_map_size(traverse, shape), self.velocity, self.batch_size, step, progress)

    def at_map_size(self, traverse: Traverse, shape: tuple[int, ...] | None = None) -> Traverse:
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
        if (traverse.name, line) not in self.descriptor.warned:
            log.warning("%s: %s", traverse.name, line)
            self.descriptor.warned.add((traverse.name, line))
        return at_size(traverse, size)

    def replace_map(self, place_map: PlaceMap, state: model_file.ModelState | None = None) -> DejaVu:
        """Set another map, without calibration; returns self in eval mode.

        Args:
            state: what is known of its route; None: as of the present map.
        """
        if state is not None:
            place_map = place_map.to(self.map.device)  # many descriptors are in a file, on the CPU
            place_map.take_parameters(self.map)
            self.state = state
        self.map, self.searcher, self.calibration = place_map, None, None
        return self.eval()

    def calibrate(
        self,
        reference: Source | None,
        views: LabelledFrames | None = None,
        places: Tensor | None = None,
        progress: bool = False,
        reach: int = 5,
    ) -> DejaVu:
        """Learn the probability that an answer is right from its confidence, for `Match.probability`.

        Args:
            reference: the traverse that the map was learned from. Every 10th segment of 20 frames is
                localized in changed light and view: `Augmentation` with 1.5 times the whitening's strengths.
            views: instead, frames of another traverse of the same places, or other segments of the reference.
                Frames without a place are ignored, and very many frames are sampled.
            places: (n,) int64, the place of each frame of the reference, -1 for none; None is place i for
                frame i.
            progress: see `learn`. reach: places within which an answer is right, inclusive.

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
        require_map(self)
        route = None
        if reference is not None and views is None:
            route = self.at_map_size(as_traverse(reference), self.frame_shape or ())
        known = route, views, places, progress, reach
        self.calibration = learning.calibration_of(self.descriptor, self.map, *known)
        return self if views is None else self.taught_by(*views[:2]).look_at(views.traverse)

    def forward(self, queries: Tensor) -> Tensor:
        """Section III-B: scores of all places, differentiable (eq. 3, eq. 4)."""
        require_map(self)
        if isinstance(queries, Tensor):
            queries = resize_like(queries, self.state.frame_shape)
        features = features_of(queries, self.descriptor.describe, "the query")
        check_queries(self, tuple(queries.shape[1:]), features.shape[1], "the query")
        return self.map.scores(self.descriptor.whitened(features))

    def localize(
        self,
        queries: Source,
        progress: bool = False,
        sequence: SequenceModel | Literal["auto"] | None = "auto",
        search: Search | None = None,
        centre: bool | None = None,
        headings: int = 1,
        shifts: Literal["auto", "none"] | Sequence[float] = "auto",
        moved: str | Path | Moved | None = None,
    ) -> Match:
        """Section III-C: the best place of each query and whether it is accepted (eq. 5, eq. 6).

        Args:
            queries: as in `learn`. They are resampled like the map's frames, see `resample`.
            progress: see `learn`.
            sequence: matches consecutive queries together: a `PlaceSmoother`, which is fitted to them, a
                `PlaceFilter` or a `SequenceMatcher`. None matches each query by itself. "auto" is a smoother
                if the queries are known to be in order, as those of a video are, else None.
            centre: remove what the descriptors of all queries have and the map's have not, see `centred`;
                None does it for a smoother and at least 50 queries, not for single ones.
            search: for single queries: "scan" and "exact" score all places; "auto", "coarse" and None take
                `self.searcher`, by default one that compares all places of a spectral map in 8 bits, or
                samples of a long one, and scores the best.
            headings: H, on the map of an area: turns each image evenly over 360 degrees and finds the best of
                the H copies, whose heading `Match.heading` has. Describing and search take H times as long.
                With 1, images are turned by their own `Traverse.headings`, if these are known. What
                turned images have in common is removed, see `set_apart`.
            shifts: views of each image, moved sideways, of which the best answers, for a camera that points
                a little further right or left than at learning; see `Querying`. `Match.shift` says how far.
            moved: (Q,), by how many places the camera moved to each query from the one before it, as odometry
                tells, at least 0, the first does not count; or these and their standard deviation, or an
                `Odometer`, or what `--moved` takes. For a smoother or a filter along a route.

        Shape: -> Match of (Q,) on the CPU.

        Raises:
            InputError: no map, no frames, NaN, or features of another dimension than the map's.
        """
        querying = replace(_querying(sequence, centre, headings, shifts), moved=moved)
        parts = [*self.matches(queries, querying, progress, search)]
        return Match.joined(parts)

    def localize_descriptors(
        self,
        descriptors: Tensor,
        matching: Matching | SequenceModel | None = None,
        wrapped: Callable[[Scorer], Scorer] | None = None,
        progress: bool = False,
    ) -> Match:
        """As `localize`, for descriptors (Q,K), whitened if the model whitens.

        Args:
            matching: a Matching, or a sequence; None matches each query by itself. progress: see `learn`.
            wrapped: changes the scores before they are matched, such as `partial(Reordered, order=order)` of
                a shuffled map, whose match then counts frames.
        """
        matching = matching if isinstance(matching, Matching) else self.matching(matching)
        scorer = self.scorer(descriptors, matching)
        return answer(scorer if wrapped is None else wrapped(scorer), matching, progress)

    def scorer(self, descriptors: Tensor, matching: Matching = SINGLE) -> Scorer:
        """The scores of descriptors (Q,K) at the places of the map, to be matched so."""
        return OfMap(self.map, descriptors, self._searcher(matching))

    def loops(
        self,
        traverse: Source,
        apart: int = 50,
        drive: bool = True,
        progress: bool = False,
        shifts: Literal["auto", "none"] | Sequence[float] = "auto",
    ) -> Match:
        """Where a drive comes back to places that it has passed before: the best earlier place of each frame.

        Args:
            traverse: what the map was learned from. apart: frames before a frame that are no answers, nor
                those after it: each pair counts once.
            drive: the frames are in order, and the whole drive has to agree. shifts: see `localize`.

        Shape: -> Match of (N,) on the CPU; index -1 for the first frames.

        Raises:
            InputError: another traverse than the map's, or `apart` out of range.
        """
        querying = _querying(PlaceSmoother() if drive else None, None, 1, shifts)
        return Match.joined(self.matches(traverse, replace(querying, loops=apart), progress))

    def loop_matching(self, apart: int, smoother: SequenceModel | None) -> Matching:
        """How `loops` matches. Answers are accepted as of single queries, or if a drive finds them likely."""
        single = self.matching(None)
        drive = single if smoother is None else self.matching(smoother)
        acceptance = single.acceptance if single.acceptance.given else drive.acceptance
        wrappers = Querying(loops=apart).wrappers
        return single._replace(sequence=drive.sequence, wrappers=wrappers, acceptance=acceptance)

    def localizer(self, matching: Matching) -> Localizer:
        """A matcher of descriptors, for consecutive batches of queries."""
        return Localizer(self.map, matching, self._searcher(matching))

    def _searcher(self, matching: Matching) -> Searcher | None:
        """What finds the best places; None if all scores are needed. Refuses ways that do not fit."""
        require_map(self)
        check_search(matching.search)
        if matching.sequence is not None:
            matching.sequence.over(self.map.layout)
            matching.sequence.check(None, self.map.places)
        single = matching.sequence is None and matching.callback is None
        if not single or matching.search not in ("auto", "coarse"):
            return None
        searcher = self.searcher
        if searcher is None or (isinstance(searcher, Scan) and not searcher.fits(self.map)):
            self.searcher = searcher = self.make_searcher(self.map)
        return searcher

    def matches(
        self,
        queries: Source,
        querying: Querying = QUERYING,
        progress: bool = False,
        search: Search | None = None,
        apart: int = 5,
        heard: Callable[[Tensor], object] = id,
    ) -> Iterator[Match]:
        """As `localize`, with `top` as `candidates`, or as `loops`: one batch of queries at a time, in
        constant memory, or after the descriptors of all with a smoother, centred queries, headings, or views
        that single images in order have to show. `heard` gets the descriptors of the queries as they are."""
        require_map(self)
        if querying.top is not None:
            check_candidates(querying.top, apart, self.map.places)
        querying.check_loops()
        sequence, headings, queries = querying.matcher(), querying.headings, as_traverse(queries)
        ordered = querying.order(sequence)
        if sequence == "auto":
            sequence = querying.matcher(ordered=queries.ordered if ordered is None else ordered)
        assert not isinstance(sequence, str)
        loops = querying.loops
        if loops is not None:
            check_loops_along(self.map.layout)
        queries = self.at_map_size(queries, self.frame_shape or ())
        check_maker(self.provenance.maker, "the map", queries)
        matching = self.matching(sequence, search) if loops is None else self.loop_matching(loops, sequence)
        self._searcher(matching)  # refuses what does not fit
        if sequence is not None:
            sequence.check(len(queries), self.map.places)
        if self.step is not None:
            queries = self.resample(queries, self.step, progress, self.frame_shape)
        if loops is not None:
            seen = f"{queries.name} has {len(queries)} places, the map {self.map.places}"
            expect(len(queries) == self.map.places, "the traverse that the map was learned from", seen)
            check_apart(loops, len(queries))
        ordered = queries.ordered or sequence is not None if ordered is None else ordered
        moved = None if loops is not None else self.moved(queries, querying, sequence)
        matching = matching._replace(moved=moved, ordered=bool(ordered))
        whole = sequence is not None and sequence.whole
        centres = loops is None and querying.centres(whole and self.centres(len(queries)))
        centres &= whole or sequence is None
        querying = self.looking(queries, querying, ordered, centres)
        matching = matching._replace(k=querying.top, radius=apart, wrappers=querying.wrappers)
        copies = querying.copies_of(queries, self.map.layout)
        shape, name, turned = queries.frame_shape, queries.name, is_turned(copies)

        def on_first(frames: Tensor, features: Tensor) -> None:
            check_queries(self, shape, features.shape[1], name)
            self.descriptor.warn_of_bright(frames, name)

        learns = querying.views.learns and sequence is None  # of single images: from those after them, too
        together = whole or loops is not None or headings > 1 or learns
        if not (together or (querying.centres(False) and not turned)):
            localizer = self.localizer(matching.as_it_drives())
            batches, done = self.descriptor.batches(copies, progress, "localizing", on_first), 0
            for rows in batches:
                heard(rows[-done % querying.copies :: querying.copies])
                done += len(rows)
                match = localizer(set_apart(self.map, rows) if turned else rows)
                yield match
            return
        descriptors = self.described(queries, querying, centres, progress, on_first, heard)
        yield answer(self.scorer(descriptors, matching), matching, progress)

    def moved(self, queries: Traverse, asked: Drives, sequence: SequenceModel | None) -> Odometer | None:
        """What an odometer reads at queries that are matched so, see `moves_of`; one that nobody asked for is
        left out with a warning where it is of no use."""
        try:
            moved = moves_of(queries, asked.moved, asked.metres_per_place)
            if moved is None:
                return None
            seen = "places moved, and single images or a sequence of constant speed"
            if sequence is None or sequence.answers not in ("drive", "filter"):
                raise InputError(f"{seen}; expected a drive or a filter")
            expect(self.step is None, "a map of frames as they are", "places moved, and a map of even steps")
            self.map.layout.expect_route("a route", "places moved, and the map of an area")
            seen = f"places moved, and {len(queries)} queries on {self.map.places} places"
            expect(not sequence.whole or not is_large(len(queries), self.map.places), FEWER, seen)
            seen = "metres moved, and a filter"
            expect(sequence.whole or not moved.metres, "--metres_per_place, or a drive", seen)
            return moved
        except InputError as error:
            if asked.moved is not None or asked.metres_per_place is not None:
                raise
            log.warning("%s: its column moved is not used: %s", queries.name, error)
            return None

    def described(
        self,
        queries: Traverse,
        querying: Querying = QUERYING,
        centre: bool = False,
        progress: bool = False,
        on_first: OnFirst | None = None,
        heard: Callable[[Tensor], object] = id,
    ) -> Tensor:
        """Descriptors of all copies of queries, which lie as the map's frames: of turned ones by `set_apart`,
        of others `centred`, if so. `heard` gets those of the queries as they are."""
        copies = querying.copies_of(queries, self.map.layout)
        rows = self.descriptor.all_of(copies, progress, on_first)
        heard(rows[:: querying.copies])
        if is_turned(copies):
            return set_apart(self.map, rows)
        return centred(self.map, rows, querying.copies) if centre else rows

    def views_at_first(self, querying: Sequences, images: bool, learns: bool) -> Views:
        """The views of queries before these have shown which are of use.

        Args:
            images: the queries are no ready features. learns: they will show it.

        Raises:
            InputError: shifts of ready features, of an area or on a template map, or out of range.
        """
        asked, known = querying.shifts, self.state.views
        images = images and self.map.layout.ahead and self.map.fidelity is not None
        if not isinstance(asked, str):
            expect(images, "images, on the spectral map of a route", f"shifts {asked}")
            return Views.given(asked, learns, querying.fov)
        if asked == "none" or not (images and self.descriptor.moves) or known == ALONE:
            expected = "images, on the spectral map of a route, of a camera that looks ahead"
            expect(querying.fov is None, expected, fov=querying.fov)
            return ALONE
        return replace((known or ALONE).among(), learns=learns, fov=querying.fov)

    def looking(self, queries: Traverse, querying: Querying, ordered: bool, centre: bool = False) -> Querying:
        """How queries are matched, with the views that are compared; errors as of `views_at_first`.

        Args:
            queries: as they are, described as the map's frames. ordered: one drive. centre: see `localize`.
        """
        images, learns = len(queries.frame_shape) == 3, ordered and len(queries) >= LEAST
        views = self.views_at_first(querying, images and querying.headings == 1, learns)
        loops = querying.loops
        given = querying.fov is not None or not isinstance(querying.shifts, str)
        if views == ALONE or (given and loops is None):
            return replace(querying, views=views)
        shown = self._shown(queries, views, centre, loops) if learns else views
        views = views if loops is None else shown  # which knows which queries have come back
        useful = given or {*views.known[0], *shown.known[0]} != {*ALONE.shifts}
        return replace(querying, views=views if useful else ALONE)

    def _shown(self, drive: Traverse, views: Views, centre: bool, loops: int | None = None) -> Views:
        """The views with the penalties that the first queries of a drive tell, or, of its loops, those that
        surely have come back."""
        first, count, copies = 0, min(FIRST, len(drive)), len(views.shifts)
        if loops is not None:
            place_map = cast(SpectralMap, self.map)  # which has seen the drive
            rows = torch.cat([place_map.decode(chunk) for chunk in range(len(place_map.chunks))])
            alone = Earlier(self.scorer(rows), loops)
            sure = confidence(best_pairs(alone, 1, len(drive))).nan_to_num(0, -1e3, -1e3)
            first = int(sure.unfold(0, count, 1).mean(1).argmax())
        some = Part(drive, range(first, first + count))
        scorer = self.scorer(self.described(some, Querying(views=views), centre))
        return views.learned(scorer if loops is None else Earlier(scorer, loops, first, copies))

    def shown_by(self, drive: Traverse) -> Views:
        """The views that a drive shows to be of use; `ALONE` if none is, or it is too short to tell."""
        views = self.views_at_first(QUERYING, len(drive.frame_shape) == 3, True)
        if views == ALONE or len(drive) < LEAST:
            return ALONE
        shown = self._shown(drive, views, self.centres(len(drive)))
        return shown if shown.known[0] != ALONE.shifts else ALONE

    @torch.no_grad()
    def taught_by(self, visit: Traverse | AugmentedFrames, places: Tensor | None = None) -> DejaVu:
        """Keep digests of some frames of another visit, so that it is known if it is asked; not of drives
        that show no place, of the `places` (Q,) of its frames."""
        if hasattr(visit, "layout") and len(self.map.digest):  # copies of frames lie nowhere
            each = parts_of(unmoved(cast(Traverse, visit)))
            shown = (torch.zeros(sum(map(len, each))) if places is None else places).split([*map(len, each)])
            for one, known in zip(each, shown, strict=True):
                some = Part(one, range(0, len(one), -(-len(one) // PLACES)))
                if (known >= 0).any() and self.descriptor.fits(self.map.dimension, some):
                    digests = digests_of(self.descriptor.all_of(some), follow=False)
                    self.provenance = self.provenance.taught_by(Path(one.name).name, digests)
        return self

    def look_at(self, visit: Traverse | AugmentedFrames) -> DejaVu:
        """Let single images be compared with the views that another visit, in order, shows to be of use."""
        drive = hasattr(visit, "layout") and self.views is None  # copies of frames lie nowhere
        if drive and self.descriptor.fits(self.map.dimension, visit):
            shown = self.shown_by(unmoved(cast(Traverse, visit)))
            self.views = None if shown == ALONE else shown.with_unmoved
        return self

    def centres(self, queries: int) -> bool:
        """Whether so many consecutive queries are centred by default."""
        return queries >= PRIOR and not self.descriptor.keeps_lengths

    def candidates(
        self,
        queries: Source,
        k: int,
        apart: int = 5,
        sequence: SequenceModel | Literal["auto"] | None = "auto",
        search: Search | None = None,
        centre: bool | None = None,
        headings: int = 1,
    ) -> Match:
        """The k best places of each query; the first is that of `localize`.

        Args:
            queries, sequence, search, centre, headings: see `localize`; views of images by default.
            k: from 1 to the number of places.
            apart: suppression radius in places, at least 0: any two candidates of a query differ by more.

        Shape: -> Match of (Q,k) on the CPU.

        Raises:
            InputError: as `localize`, or k or apart out of range.

        Example:
            >>> import torch
            >>> wave = torch.arange(64)[:, None] % torch.tensor([8.0, 9.0])
            >>> DejaVu().learn(wave).candidates(wave[20:22], k=3).index[:, 0]
            tensor([20, 21])
        """
        querying = replace(_querying(sequence, centre, headings), top=k)
        return Match.joined(self.matches(queries, querying, False, search, apart))

    def matching(self, sequence: SequenceModel | None = None, search: Search | None = None) -> Matching:
        """How queries are matched, with probabilities if the map is calibrated for it. Raises InputError if a
        precision lacks this calibration."""
        smooths = sequence is not None and sequence.whole  # its probabilities are its own
        platt = self.calibration and self.calibration.of(None if smooths else sequence)
        if self.precision is not None and platt is None and not smooths:
            only = "calibrated for single queries and for a filter only"
            seen = f"the precision is {self.precision}, but the map is "
            raise InputError(f"{seen}{only if self.calibration else 'not calibrated'}; expected a threshold")
        sequence = sequence and self.adapted(sequence)
        accepts, single = self.acceptance(sequence), self.calibration and self.calibration.single
        return Matching(sequence, acceptance=accepts, platt=platt, single=single, search=search or "auto")

    def adapted(self, way: Way) -> Way:
        """A way of matching as the scores of these descriptors need it."""
        return way.having(removed=REMOVED if self.descriptor.keeps_lengths else 1.0)

    def acceptance(self, sequence: SequenceModel | None = None) -> Acceptance:
        """Which answers are accepted, for single queries or for a sequence (convention 4).

        In this order: by the threshold or precision of the user or of the map's file; with a probability of
        at least .5, by a smoother, or if the map is calibrated for this way of matching; with a filter's own
        probability above .5; every finite score. A threshold of the model or its file is a distance, which
        holds for no filter and no smoother: these have thresholds of their own.
        """
        threshold = self.threshold if sequence is None else sequence.threshold_of(self.threshold)
        if threshold is not None or self.precision is not None:
            return Acceptance(threshold, None if threshold is not None else self.precision)
        known = self.calibration is not None and self.calibration.of(sequence) is not None
        if known or (sequence is not None and sequence.whole):
            return Acceptance(precision=PROBABLE, given=False)
        return Acceptance(None if sequence is None else sequence.likely, given=False)

    def save(self, path: str | Path) -> None:
        """Write the map, or a trained descriptor without a map, and the weights of the features as one
        safetensors file.

        Raises:
            InputError: nothing learned yet, weights that changed after they were rounded, or a file that
                cannot be written.
        """
        if self.trained is None:
            require_map(self)
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

    def get_extra_state(self) -> Facts:
        """The state apart from tensors and the map's own state."""
        return model_file.state_to_json(self.state)

    def set_extra_state(self, state: Facts) -> None:
        """Restore the result of `get_extra_state`; InputError if it lacks an entry."""
        try:
            self.state = model_file.state_from_json(state)
        except KeyError as error:
            raise InputError(f"the model's state has no {error}; expected one of this version") from error
        self.searcher = None  # of the map before


def _querying(
    sequence: SequenceModel | Literal["auto"] | None,
    centre: bool | None,
    headings: int,
    shifts: Literal["auto", "none"] | Sequence[float] = "auto",
) -> Querying:
    """The options of `localize` as one object."""
    mean: Literal["mean", "none"] | None = None if centre is None else "mean" if centre else "none"
    shifts = shifts if shifts in ("auto", "none") else [*shifts]
    return Querying(centre=mean, headings=headings, shifts=shifts).by(sequence)


def _state_of(model: DejaVu, place_map: PlaceMap, traverse: Traverse | None) -> model_file.ModelState:
    """What is known of the route of a map learned from a traverse, whose positions the map gets."""
    if traverse is None:
        return model_file.ModelState()
    shape, positions = traverse.frame_shape, learning.positions_of(traverse)
    if len(shape) == 3 and place_map.dimension > MANY_FEATURES:
        line = "each frame gives %d features; smaller frames make a smaller and faster map"
        log.warning(line, place_map.dimension)
    if len(shape) == 1 and (model.preprocess.channel or model.preprocess.contrast):
        log.warning("these are ready features: channel and contrast have no effect")
    if isinstance(place_map, SpectralMap) and place_map.layout.on_ground and len(shape) == 3:
        learning.turn_windows(place_map, model.descriptor, traverse)
    if len(positions):
        place_map.positions = positions.to(place_map.device)
        place_map.check()
    along = len(shape) == 3 and learning.looks_along(place_map, model.descriptor, traverse)
    step = traverse.step if isinstance(traverse, ResampledTraverse) else None
    names, views = [*source_of(traverse).names], ALONE if along else None
    known = Provenance.of(traverse), probe_of(model.descriptor, shape)
    return model_file.ModelState(shape, step, None, names, None, views, *known)


def require_map(model: DejaVu, purpose: str = "") -> None:
    """Refuse a model without a map; `purpose` is for the message, such as " to append to"."""
    if not model.map.places:
        expect(model.trained is not None, "learn(...) or load(...) first", f"there is no map yet{purpose}")
        seen = f"this is a descriptor without a map{purpose}"
        raise InputError(f"{seen}; expected learn(...) with it first")


def features_per_frame(model: DejaVu) -> int:
    """D, the number of features per frame that the map was learned from."""
    whitening = model.descriptor.whitening
    return sum(whitening.sizes) if whitening is not None and whitening.learned else model.map.dimension


def check_loops_along(layout: Layout) -> None:
    """Refuse loops over an area, whose numbers of places say nothing of when they were passed."""
    layout.expect_route("a route", "loops on the map of an area")


def check_apart(apart: int, places: int) -> None:
    """Refuse loops closer than a place, or none."""
    expect(1 <= apart < places, f"a number of places from 1 to {places - 1}", f"loops: {apart}")


def check_queries(model: DejaVu, shape: tuple[int, ...], dimension: int, name: str) -> None:
    """Refuse queries that do not fit the map, and warn if their frames have another size.

    Args:
        shape: of one query, (C,H,W) or (D,). dimension: D, its features. name: for the message.
    """
    reference, expected = model.state.frame_shape, features_per_frame(model)
    if len(shape) == 1 and dimension != expected:
        learned = f", as frames of {' x '.join(map(str, reference or ()))} give"
        seen = f"{name} gives {dimension} features; the map expects {expected}"
        raise InputError(f"{seen}{learned * (len(reference or ()) == 3)}")
    if reference is None or len(shape) != 3:
        return
    seen = f"{name} has frames, but the map was learned from ready features"
    expect(len(reference) != 1, f"features (Q, {expected})", seen)
    own, other = (" x ".join(map(str, size)) for size in (shape, reference))
    seen, hint = f"{name}: frames of {own} give {dimension} features", turned_hint(shape, reference)
    expect(dimension == expected, f"{expected}, as frames of {other} give{hint}", seen)
    if shape[1:] != reference[1:] and getattr(model.descriptor.features, "resize", None) is None:
        log.warning("%s has frames of %s, the map was learned from %s", name, own, other)


def check_precision(precision: float | None) -> None:
    """Refuse a precision outside (0, 1)."""
    expect(precision is None or 0 < precision < 1, "a share above 0 and below 1", precision=precision)
