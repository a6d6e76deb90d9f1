"""A model in training: its descriptors of the route's frames, and their map."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import pytorch_lightning as pl
import torch
from torch import Tensor, nn

from dejavu_torch.features.embedding import Embedding
from dejavu_torch.features.extract import features_of, in_mode
from dejavu_torch.features.joined import groups_of
from dejavu_torch.features.whitening import INDEPENDENT, MOST_VIEWS
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.template_map import TemplateMap, log_posterior
from dejavu_torch.maps.weights import in_bits
from dejavu_torch.model import DejaVu
from dejavu_torch.text import one_line
from dejavu_torch.training.datamodule import RouteData, StoredFrames
from dejavu_torch.training.losses import Objective
from dejavu_torch.types import InputError

WIDE = 1e6  # step of a map without lines, for descriptors of about 1

log = logging.getLogger("dejavu_torch")


class Trainee(pl.LightningModule):
    """A `DejaVu` model and the route that it is trained on. The templates of its map are trained; any other
    map is made from the descriptors in closed form (`made`)."""

    log_temperature: nn.Parameter
    losses: Objective
    frozen: set[str]  # modules of the features that keep their running statistics
    gives_way = False  # whether to raise bytes per place that a short route cannot meet

    def __init__(self, dejavu: DejaVu, made: bool, feature_weights: bool, weight_bits: int) -> None:
        super().__init__()
        self.dejavu, self.made = dejavu, made
        self.feature_weights, self.weight_bits = feature_weights, weight_bits
        self._descriptors: Tensor | None = None  # of the reference, once they are fixed
        # to learn a code from: descriptors of augmented frames, (n,K), and their places, (n,R)
        self.views: tuple[Tensor, Tensor] | None = None

    @property
    def data(self) -> RouteData:
        """The trainer's data module."""
        data = getattr(self._trainer, "datamodule", None)
        if not isinstance(data, RouteData):
            raise InputError(f"the trainer's data module is {type(data).__name__}; expected RouteData")
        return data

    @property
    def map(self) -> PlaceMap:
        """The map of the current features; empty until it is made."""
        return self.dejavu.map

    @property
    def route(self) -> TemplateMap:
        """The template map in training."""
        return cast(TemplateMap, self.dejavu.map)

    @property
    def features(self) -> nn.Module:
        """The features in training."""
        return self.dejavu.features

    @property
    def network(self) -> nn.Module:
        """The module that makes the descriptor: the features, or their network if a code follows."""
        embedding = coded(self.features)
        return self.features if embedding is None else embedding.network

    def describe(self, frames: Tensor) -> Tensor:
        """Descriptors of frames, without a code: (B,C,H,W) -> (B,K)."""
        embedding = coded(self.features)
        if embedding is None:
            return self.dejavu.descriptor.describe_all(frames)
        return embedding.describe(self.dejavu.preprocess(frames))

    def scores(self, distances: Sequence[Tensor]) -> Tensor:
        """Eq. 4 of the map with the trained temperature: L tensors (B,P) -> (B,N)."""
        return log_posterior(self.route.combine(distances), self.log_temperature.exp())

    # the reference, described

    def descriptors(self) -> Tensor:
        """Descriptors of the reference, (N,K), by a network that is fixed by now; computed once."""
        if self._descriptors is None:
            with in_mode(self.features, False):
                self._descriptors = self.of_reference(self.described)
        return self._descriptors

    @torch.no_grad()
    def of_reference(
        self, make: Callable[[Tensor], Tensor], given: Tensor | None = None, shuffled: bool = False
    ) -> Tensor:
        """`make` applied to batches of the stored frames, or of the rows of `given`, (N,D); NaN is refused.
        Shuffled batches come from all over the route, for running statistics."""
        frames = self.data.sets["reference"]
        count = len(frames)
        order = torch.randperm(count) if shuffled else torch.arange(count)
        made = []
        for batch in order.tensor_split(min(-(-count // self.dejavu.batch_size), count // 2)):
            values = frames[batch.tolist()].frames if given is None else given[batch.to(given.device)]
            with torch.autocast(self.device.type, enabled=False):
                made.append(make(values))
        features = torch.cat(made)
        features = features[order.argsort().to(features.device)]
        if not features.isfinite().all():
            seen = f"{type(self.features).__name__} gives NaN or infinite features for {self.data.route_name}"
            raise InputError(f"{seen}; expected finite numbers")
        return features

    def described(self, frames: Tensor) -> Tensor:
        """Descriptors of stored frames; a backbone that fails on them is refused."""
        try:
            return features_of(frames.to(self.device), self.describe, "the batch")
        except RuntimeError as error:
            seen = f"{type(self.features).__name__} does not accept frames {tuple(frames.shape[1:])}"
            raise InputError(f"{seen}: {one_line(error)[:200]}") from error

    @torch.no_grad()
    def views_of(self, rounds: int, limit: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Batches of descriptors of augmented training frames, (B,K), and their known places, (B,R); after
        the first round at most `limit` in all."""
        loader = self.data.training_batches()
        frames = len(cast(StoredFrames, loader.dataset))
        rounds = min(rounds, limit // frames) if self.data.augmentation.acts else 1
        with in_mode(self.features, False):
            for _ in range(max(1, rounds)):
                for batch in loader:
                    known = batch.truth.positives[:, 0] >= 0
                    if known.any():
                        augmented = self.data.augmented(batch.frames.to(self.device), self.data.clip)
                        views = features_of(augmented[known], self.describe, "the batch").float()
                        yield views, batch.truth.positives[known].to(self.device)

    # the map

    def relearn(self) -> None:
        """Make the map from the current features of the reference (section III-A)."""
        if self.made:
            self._make_map()
        else:
            self._learn_templates()
        self.map.train(self.training)
        if self.data.resize is not None and len(self.data.routes) == 1:
            self.dejavu.frame_shape = tuple(self.data.sets["reference"].values.shape[1:])

    def _learn_templates(self) -> None:
        first, weights = not self.route.places, self.route.weights
        embedding = coded(self.features)
        with in_mode(self, first):  # the first in training mode, to collect running statistics
            if embedding is None:
                features = self.of_reference(self.described, shuffled=first)
            else:
                features = self.of_reference(embedding.code, self.descriptors(), shuffled=first)
            self.dejavu.learn_features(features, self.data.reference)
        if not self.route.plan:
            name = self.data.reference.name
            raise InputError(f"nothing repeats in the features of {name}; expected imposed periods")
        self.route.trainable(True, self.feature_weights, weights)

    @torch.no_grad()
    def _make_map(self) -> None:
        """In closed form from the rounded network, without using up random numbers of the training."""
        model, whitening = self.dejavu, self.dejavu.whitening
        with in_bits(self.features, self.weight_bits), torch.random.fork_rng(), in_mode(model, False):
            features = self.of_reference(self.described)
            if self.gives_way:
                self.check_budget(*features.shape)
            if whitening is not None:
                torch.manual_seed(whitening.seed)
                views = self.views_of(whitening.copies(*features.shape), MOST_VIEWS)
                pairs = ((view, places[:, 0]) for view, places in views)
                shown = None if whitening.views == 0 else pairs
                whitening.learn(features, shown, groups_of(self.features), INDEPENDENT * len(features))
            alone = self.data.reference if len(self.data.routes) == 1 else None
            model.learn_features(model.descriptor.whitened(features), alone)

    def check_budget(self, places: int, dimension: int) -> None:
        """Refuse a map of too few bytes; if the user did not choose them, raise them instead."""
        mapper: Any = self.dejavu.mapper
        whitening = self.dejavu.whitening
        kept = dimension if whitening is None else whitening.kept(places, dimension, True)
        descriptors = torch.randn(places, kept, generator=torch.Generator().manual_seed(0))
        if whitening is None:
            descriptors += 1  # a mean, which needs bytes
        wanted = getattr(mapper, "route_bytes_per_place", None)
        gives_way, self.gives_way = self.gives_way, False  # only once
        try:
            mapper(descriptors)
        except InputError:
            if not gives_way or wanted is None:
                raise
            empty = SpectralMapper(None, step=WIDE, chunk=mapper.chunk)(descriptors)
            more = min(wanted + empty.summary().route_bytes / places, 4 * kept)
            mapper.route_bytes_per_place = math.ceil(100 * more) / 100
            mapper(descriptors)
            log.warning(
                "%d places need more than --model.mapper.route_bytes_per_place %g: %g is used",
                *(places, wanted, mapper.route_bytes_per_place),
            )


def coded(features: nn.Module) -> Embedding | None:
    """The features if they are an `Embedding` whose code is learned from a whitened descriptor."""
    return features if isinstance(features, Embedding) and features.coder is not None else None
