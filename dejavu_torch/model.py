"""The whole method as one module; reads like section III of the paper."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from dejavu_torch.data.arrays import ArrayTraverse
from dejavu_torch.database.certificate import Certificate, certify
from dejavu_torch.database.compressed import CompressedMap
from dejavu_torch.database.mapfile import Recipe, build, map_size, read_map, recipe_of, write_map
from dejavu_torch.database.phase import PhaseTemplates
from dejavu_torch.features.extract import feature_batches, features_of, frame_shape
from dejavu_torch.features.gather import gather
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.recognition.distance import Metric
from dejavu_torch.recognition.scores import Matcher, Reduction
from dejavu_torch.recognition.select import best_match
from dejavu_torch.types import InputError, Match, Traverse

log = logging.getLogger("dejavu_torch")

SCORES_AT_ONCE = 2**24  # numbers of Q x N held at a time
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
        self.matcher = Matcher(metric, reduction)
        self.threshold = threshold
        self.batch_size = batch_size
        self.map = CompressedMap()
        self.learnt_from: tuple[int, ...] | None = None  # a frame's (C,H,W), or (D,) of ready features

    def learn(self, traverse: Traverse | Tensor, progress: bool = False) -> DejaVu:
        """Section III-A: features, their periods, layers, and the templates of eq. 1.

        Args:
            traverse: the reference, a Traverse or a tensor: frames (N,C,H,W) or features (N,D).
            progress: show a progress bar on a terminal.

        Returns:
            self, with the map in `self.map`. A route in which nothing repeats gives a map without
            layers, on which every place scores +inf. Memory does not grow with the frames: features
            beyond `gather`'s share of it spill to a temporary file.

        Raises:
            InputError: no frames, too few, NaN, or mixed sizes.
        """
        traverse = as_traverse(traverse)
        features = self.extract_all(traverse, "learning" if progress else None)
        return self.learn_features(features, frame_shape(traverse))

    def learn_features(self, features: Tensor, learnt_from: tuple[int, ...] | None = None) -> DejaVu:
        """As `learn`, from features that are there already.

        Args:
            features: (N,D) float.
            learnt_from: shape of the frames that `self.features` made them from, (C,H,W); (D,) where
                they were made elsewhere, so that the map refuses frames; None where unknown.
        """
        if len(learnt_from or ()) == 3 and features.shape[1] > MANY_FEATURES:
            log.warning(
                "each frame gives %d features; smaller frames make a smaller and faster map, as ?width=160 "
                "behind a folder or video does",
                features.shape[1],
            )
        if len(learnt_from or ()) == 1 and (self.preprocess.channel or self.preprocess.contrast):
            log.warning("these are ready features: channel and contrast are left as they are")
        plan = self.periods.plan(features)
        with torch.no_grad():
            templates = self.templates(features, plan)
        self.map = CompressedMap(plan, templates, *features.shape).to(features.device)
        self.learnt_from = learnt_from
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
        """Features of a whole traverse, (N,D); many of them lie in a temporary file, see `gather`."""
        return gather(self.extract(traverse, progress))

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
        """Read a map file.

        Args:
            features: the module that made the map's features, needed where it is not one of this
                package; its weights come from the file.

        Raises:
            InputError: missing, truncated, foreign or newer file, or other features than the map's.
        """
        tensors, header = read_map(Path(path))
        try:
            made_by, found_by = Recipe(**header["features"]), Recipe(**header["periods"])
            if features is None:
                features = build(made_by, nn.Module)
            elif recipe_of(features) != made_by:
                raise InputError(f"it was learnt with {made_by}; got {recipe_of(features)}")
            # only learning needs what found the periods: one from elsewhere need not be built
            ours = found_by.class_path.startswith("dejavu_torch.")
            periods = build(found_by, PeriodFinder) if ours else None  # type: ignore[type-abstract]
            preprocess = build(Recipe(**header["preprocess"]), Preprocess)
            settings = {name: header[name] for name in ("metric", "reduction", "threshold", "batch_size")}
            model = cls(features, periods, **settings, preprocess=preprocess)
            model.learnt_from = header["learnt_from"] and tuple(header["learnt_from"])
            loaded = model.load_state_dict(tensors, strict=False)
            not_kept = ("periods.", "_extra_state")
            missing = [name for name in loaded.missing_keys if not name.startswith(not_kept)]
            if missing or loaded.unexpected_keys:
                raise InputError(f"it does not fit: missing {missing}, not expected {loaded.unexpected_keys}")
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        except (AttributeError, KeyError, RuntimeError, TypeError) as error:
            what = "fit its modules" if isinstance(error, RuntimeError) else "hold what a map holds"
            raise InputError(f"{path} does not {what}: {' '.join(str(error).split())}") from error
        return model

    @property
    def map_bytes(self) -> int:
        """Size of the map file: all that `localize` needs beyond the installed package."""
        return map_size(*self._file())

    @property
    def backbone_bytes(self) -> int:
        """The part of `map_bytes` that is weights of the feature module."""
        weights = [t for t in self.features.state_dict().values() if isinstance(t, Tensor)]
        return sum(t.numel() * t.element_size() for t in weights)

    @property
    def certificate(self) -> Certificate:
        """What the map can tell apart and what it costs."""
        return certify(self.map.plan, self.map.places, self.map_bytes)

    def _file(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        metric = self.matcher.metric
        header = {
            "preprocess": recipe_of(self.preprocess)._asdict(),
            "features": recipe_of(self.features)._asdict(),
            "periods": recipe_of(self.periods)._asdict(),
            "metric": metric if isinstance(metric, str) else getattr(metric, "__name__", "callable"),
            "reduction": self.matcher.reduction,
            "threshold": self.threshold,
            "batch_size": self.batch_size,
            "learnt_from": self.learnt_from,
        }
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
        if self.learnt_from is None or len(shape) != 3:
            return
        if len(self.learnt_from) == 1:
            raise InputError(
                f"{name} holds frames, but the map was learnt from ready features; "
                f"expected features (Q, {self.map.dimension})"
            )
        if dimension != self.map.dimension:
            raise InputError(
                f"{name}: frames of {_by(shape)} give {dimension} features; the map expects "
                f"{self.map.dimension}, as frames of {_by(self.learnt_from)} give, into which ?width= and "
                "?height= turn folders and videos"
            )
        if shape[1:] != self.learnt_from[1:] and getattr(self.features, "resize", None) is None:
            log.warning(
                "%s has frames of %s, the map was learnt from %s", name, _by(shape), _by(self.learnt_from)
            )

    def get_extra_state(self) -> dict[str, Any]:
        """What the state_dict holds beside the tensors."""
        return {"learnt_from": self.learnt_from}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take over what `get_extra_state` gave."""
        self.learnt_from = state["learnt_from"]

    def _require_map(self) -> None:
        if not self.map.places:
            raise InputError("there is no map yet; expected learn(...) or load(...) first")


def as_traverse(source: Traverse | Tensor) -> Traverse:
    """A tensor of frames or features as a traverse; a traverse as it is."""
    return source if isinstance(source, Traverse) else ArrayTraverse(source)


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))
