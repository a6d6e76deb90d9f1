"""The whole method as one module; reads like section III of the paper."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from dejavu_torch.data.arrays import as_traverse
from dejavu_torch.database.compressed import CompressedMap
from dejavu_torch.database.distance import Metric
from dejavu_torch.database.mapfile import build_parts, map_size, part_recipes, read_map, write_map
from dejavu_torch.database.phase import PhaseTemplates
from dejavu_torch.database.scores import Matcher, Reduction
from dejavu_torch.database.summary import MapSummary, summarise
from dejavu_torch.features.extract import check_frames, feature_batches, features_of, frame_shape
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.memory import concatenate
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.motion.resampling import ResampledTraverse
from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.recognition.select import best_match
from dejavu_torch.types import InputError, Match, Training, Traverse

log = logging.getLogger("dejavu_torch")

SCORES_AT_ONCE = 2**24  # numbers of Q x N held at a time
SETTINGS = ("metric", "reduction", "threshold", "batch_size", "temperature")
MANY_FEATURES = 50_000  # per frame: worth a word


class DejaVu(nn.Module):
    """Learn a compressed map of a route from what repeats along it, and find places on it (section III).

    Args:
        features: any nn.Module (B,C,H,W) -> (B,D); None is HOG with its defaults.
        periods: finds the layers; None is SpectrogramAnalysis with its defaults.
        metric: distance of eq. 3, see `phase_distances`.
        reduction: how layers combine in eq. 4, see `combine_layers`.
        threshold: accept a match when its score is below; None accepts every finite score.
        batch_size: frames in memory at a time.
        preprocess: colour and contrast of the frames ahead of the features; None changes nothing.
        velocity: makes places and queries even steps along the ground (section IV-B), see `evenly`;
            None takes the frames as they come.
        temperature: scores are then those of `log_posterior`; None leaves S as it is.

    Shape: forward: frames (Q,C,H,W) or features (Q,D) -> scores (Q,N), lower is better.

    Example:
        >>> wave = torch.arange(64)[:, None] % torch.tensor([8.0, 9.0])  # two features that repeat
        >>> model = DejaVu(periods=SpectrogramAnalysis(window=64, strongest=1)).learn(wave)
        >>> model.localize(wave[20:22]).index
        tensor([20, 21])
    """

    def __init__(
        self,
        features: nn.Module | None = None,
        periods: PeriodFinder | None = None,
        metric: Metric = "l1",
        reduction: Reduction = "mean",
        threshold: float | None = None,
        batch_size: int = 64,
        preprocess: Preprocess | None = None,
        velocity: GroundOdometry | None = None,
        temperature: float | None = None,
    ) -> None:
        super().__init__()
        if batch_size < 1:
            raise InputError(f"batch_size is {batch_size}; expected at least 1")
        if threshold is not None and math.isnan(threshold):
            raise InputError("the threshold is NaN; expected a number")
        self.preprocess = Preprocess() if preprocess is None else preprocess
        self.features = HOG() if features is None else features
        self.periods = SpectrogramAnalysis() if periods is None else periods
        self.templates = PhaseTemplates()
        self.matcher = Matcher(metric, reduction, temperature)
        self.threshold = threshold
        self.batch_size = batch_size
        self.velocity = velocity
        self.map = CompressedMap()
        self.step: float | None = None  # pixels of ground from one place of the map to the next
        self.learnt_from: tuple[int, ...] | None = None  # a frame's (C,H,W), or (D,) of ready features
        self.trained: Training | None = None

    def learn(self, traverse: Traverse | Tensor, progress: bool = False) -> DejaVu:
        """Section III-A: features, their periods, layers, and the templates of eq. 1.

        Args:
            traverse: the reference, a Traverse or a tensor: frames (N,C,H,W) or features (N,D).
            progress: show a progress bar on a terminal.

        Returns:
            self, with the map in `self.map`. A route in which nothing repeats gives a map without
            layers, on which every place scores +inf. Memory does not grow with the frames: features
            beyond `concatenate`'s share of it spill to a temporary file.

        Raises:
            InputError: no frames, too few, NaN, or mixed sizes.
        """
        traverse = self.evenly(as_traverse(traverse), progress=progress)
        return self.learn_features(self.extract_all(traverse, "learning" if progress else None), traverse)

    def evenly(self, traverse: Traverse, step: float | None = None, progress: bool = False) -> Traverse:
        """A traverse at even steps along the ground, where `velocity` is set; else as it is.

        Args:
            traverse: frames, in order; one that is evenly spaced already stays as it is.
            step: pixels of ground; None is `velocity`'s own. Queries need the map's, `self.step`; of them a
                single frame, and ready features, stay as they are.

        Raises:
            InputError: as `ResampledTraverse`.
        """
        if self.velocity is None or isinstance(traverse, ResampledTraverse):
            return traverse
        if step is not None and (traverse.length == 1 or len(frame_shape(traverse)) == 1):
            return traverse
        return ResampledTraverse(traverse, self.velocity, self.batch_size, step, progress)

    def learn_features(self, features: Tensor, traverse: Traverse | None = None) -> DejaVu:
        """As `learn`, from features that are there already.

        Args:
            features: (N,D) float.
            traverse: what they come from, where known: the map then knows what frames to expect, and,
                where they are evenly spaced, which frame each place shows.
        """
        shape = () if traverse is None else frame_shape(traverse)
        if len(shape) == 3 and features.shape[1] > MANY_FEATURES:
            log.warning(
                "each frame gives %d features; smaller frames make a smaller and faster map, as ?width=160 "
                "behind a folder or video does",
                features.shape[1],
            )
        if len(shape) == 1 and (self.preprocess.channel or self.preprocess.contrast):
            log.warning("these are ready features: channel and contrast are left as they are")
        plan = self.periods.plan(features)
        with torch.no_grad():
            templates = self.templates(features, plan)
        self.step, way = None, None
        if isinstance(traverse, ResampledTraverse):
            self.step, way = traverse.step, traverse.way
        places, dimension = features.shape
        self.map = CompressedMap(plan, templates, places, dimension, way).to(features.device)
        self.learnt_from, self.trained = shape or None, None
        return self

    def forward(self, queries: Tensor) -> Tensor:
        """Section III-B: scores of all places, differentiable (eq. 3, eq. 4)."""
        self._require_map()
        features = features_of(queries, self.pipeline, "the query")
        self.check_queries(tuple(queries.shape[1:]), features.shape[1], "the query")
        scores: Tensor = self.matcher(features, self.map)
        return scores

    def localize(self, queries: Traverse | Tensor, progress: bool = False) -> Match:
        """Section III-C: the best place of each query and whether it is accepted (eq. 5, eq. 6).

        Args:
            queries: a Traverse or a tensor: frames (Q,C,H,W) or features (Q,D).

        Shape: -> Match of (Q,) on the CPU.

        Convention: on a map of even steps the queries are spaced as evenly first, see `evenly`.

        Raises:
            InputError: no map, no frames, NaN, or features of another dimension than the map's.
        """
        matches = list(self.matches(queries, progress))
        return Match(*(torch.cat(column) for column in zip(*matches, strict=True)))

    def matches(self, queries: Traverse | Tensor, progress: bool = False) -> Iterator[Match]:
        """As `localize`, one batch of queries at a time: memory does not grow with the queries."""
        self._require_map()
        at_once = max(1, SCORES_AT_ONCE // max(1, self.map.places))
        queries = as_traverse(queries)
        if self.step is not None:
            queries = self.evenly(queries, self.step, progress)
        shape = frame_shape(queries)
        for i, features in enumerate(self.extract(queries, "localizing" if progress else None)):
            if i == 0:
                self.check_queries(shape, features.shape[1], queries.name)
            for part in features.split(at_once):
                with torch.no_grad():
                    match = best_match(self.matcher(part, self.map), self.threshold)
                yield Match(*(column.cpu() for column in match))

    def extract(self, traverse: Traverse, progress: str | None = None) -> Iterator[Tensor]:
        """Features of a traverse in batches (B,D), without gradients."""
        return feature_batches(traverse, self.pipeline, self.batch_size, self.map.size.device, progress)

    def extract_all(self, traverse: Traverse, progress: str | None = None) -> Tensor:
        """Features of a whole traverse, (N,D); many of them lie in a temporary file, see `concatenate`."""
        return concatenate(self.extract(traverse, progress))

    @property
    def pipeline(self) -> nn.Sequential:
        """What makes features of frames: preprocess, then features."""
        return nn.Sequential(self.preprocess, self.features)

    def save(self, path: str | Path) -> None:
        """Write the map, with the feature module's weights, as one safetensors file.

        Raises:
            InputError: nothing learnt yet, or the file cannot be written.
        """
        self._require_map()
        if callable(self.matcher.metric):
            raise InputError("a map with a callable metric cannot be saved; expected a metric by name")
        write_map(Path(path), *self._file())

    @classmethod
    def load(cls, path: str | Path, features: nn.Module | None = None) -> DejaVu:
        """Read a map file; the model is in eval mode.

        Args:
            features: the module that made the map's features, needed where it is not one of this
                package; its weights come from the file.

        Raises:
            InputError: missing, truncated, foreign or newer file, or other features than the map's.
        """
        tensors, header = read_map(Path(path))
        try:
            parts = build_parts(header, features)
            model = cls(**parts, **{name: header[name] for name in SETTINGS})
            model.set_extra_state(header)
            loaded = model.load_state_dict(tensors, strict=False)
            not_kept = ("periods.", "_extra_state")
            missing = [name for name in loaded.missing_keys if not name.startswith(not_kept)]
            if missing or loaded.unexpected_keys:
                raise InputError(f"it does not fit: missing {missing}, not expected {loaded.unexpected_keys}")
            spaced = model.velocity is not None and isinstance(model.step, float) and model.step > 0
            if (len(model.map.way) > 0) != spaced or (model.step is not None) != spaced:
                raise InputError(f"it has step {model.step!r} and a way of {len(model.map.way)} frames")
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        except (AttributeError, KeyError, RuntimeError, TypeError) as error:
            what = "fit its modules" if isinstance(error, RuntimeError) else "hold what a map holds"
            raise InputError(f"{path} does not {what}: {' '.join(str(error).split())}") from error
        return model.eval()

    @property
    def map_bytes(self) -> int:
        """Size of the map file: all that `localize` needs beyond the installed package."""
        return map_size(*self._file())

    @property
    def backbone_bytes(self) -> int:
        """The part of `map_bytes` that is weights of the feature module."""
        return sum(t.nbytes for t in self.features.state_dict().values() if isinstance(t, Tensor))

    @property
    def certificate(self) -> MapSummary:
        """What the map can tell apart and what it costs."""
        return summarise(self.map.plan, self.map.places, self.map_bytes)

    def _file(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        metric = self.matcher.metric
        header = part_recipes(self) | self.get_extra_state()
        header |= {name: getattr(self.matcher, name) for name in ("reduction", "temperature")}
        header |= {"threshold": self.threshold, "batch_size": self.batch_size}
        header["metric"] = metric if isinstance(metric, str) else getattr(metric, "__name__", "callable")
        # what found the periods is not needed any more
        tensors = {f"map.{name}": t for name, t in self.map.state_dict().items()}
        weights = {f"features.{n}": t for n, t in self.features.state_dict().items() if isinstance(t, Tensor)}
        return tensors | weights, header

    def check_queries(self, shape: tuple[int, ...], dimension: int, name: str) -> None:
        """Refuse queries that do not fit the map, and tell of frames of another size that do.

        Args:
            shape: of one query, (C,H,W) or (D,). dimension: D, how many features it gives.
            name: of the queries, for the message.
        """
        resized = getattr(self.features, "resize", None) is not None
        check_frames(shape, dimension, self.learnt_from, self.map.dimension, resized, name)

    def get_extra_state(self) -> dict[str, Any]:
        """What the state_dict holds beside the tensors."""
        trained = self.trained and self.trained._asdict()
        return {"learnt_from": self.learnt_from, "step": self.step, "trained": trained}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take over what `get_extra_state` gave."""
        shape, trained = state["learnt_from"], state.get("trained")
        self.learnt_from, self.step = shape and tuple(shape), state.get("step")
        self.trained = trained and Training(**trained)

    def _require_map(self) -> None:
        if not self.map.places:
            raise InputError("there is no map yet; expected learn(...) or load(...) first")
