"""Training features that repeat with the periods of a template map, together with its templates."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Literal, cast

import torch
from torch import Tensor, nn

from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.embedding import Coder
from dejavu_torch.features.extract import features_of, in_mode
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.maps.template_map import TemplateMap, TemplateMapper, log_posterior
from dejavu_torch.maps.weights import in_bits
from dejavu_torch.model import DejaVu
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.training.datamodule import Batch
from dejavu_torch.training.losses import (
    Losses,
    NothingLearned,
    Objective,
    phase_chance,
    place_chance,
)
from dejavu_torch.training.task import RouteTask, check_preprocess, coded, trainable
from dejavu_torch.types import InputError, expect

log = logging.getLogger("dejavu_torch")

TEMPERATURE = 0.03  # of `log_posterior` at the start
ROUNDS = 10  # views of each training frame, for whitening and code
MAX_VALUES = 2**27  # of all views, beyond one view of each frame: half a gigabyte
BATCH = 128  # views per step


class TemplateTask(RouteTask):
    """Trains features to repeat with the periods of a map's layers, and its templates.

    The templates start as the phase means of the untrained features (eq. 1). Periods get no gradient: they
    are imposed, or found once in the untrained features.

    An `Embedding` with a hidden layer learns its code alone: its network is fixed, as a pretrained one or
    that of a `DescriptorTask` by `start`. Its descriptor is first whitened by the changes under augmentation
    and in a second traverse; views of all training frames are described once, and the code is learned from
    these.

    Args:
        backbone: nn.Module (B,C,H,W) -> (B,D); None is `SmallCNN()`.
        mapper: None is `TemplateMapper(ImposedPeriods())`. The trained temperature starts at the mapper's, or
            at 0.03 if that is None.
        losses: the weights of the losses.
        preprocess, start, freeze, batch_norm, lr, weight_decay, batch_size, weight_bits: see
            `DescriptorTask`.

    Raises:
        InputError: as of `RouteTask`; a mapper of another kind; several routes; nothing that repeats.
    """

    made = False

    def __init__(
        self,
        backbone: nn.Module | None = None,
        mapper: TemplateMapper | None = None,
        preprocess: Preprocess | None = None,
        start: str | None = None,
        freeze: list[str] | None = None,
        batch_norm: Literal["train", "frozen"] = "train",
        losses: Objective | None = None,
        lr: float = 3e-3,
        weight_decay: float = 0.05,
        batch_size: int = 64,
        weight_bits: Literal[8, 32] = 8,
    ) -> None:
        backbone = SmallCNN() if backbone is None else backbone
        mapper = TemplateMapper(ImposedPeriods()) if mapper is None else mapper
        if not isinstance(mapper, TemplateMapper):
            seen = f"the mapper is a {type(mapper).__name__}"
            raise InputError(f"{seen}; expected a TemplateMapper, or --model DescriptorTask")
        check_preprocess(preprocess)
        model = DejaVu(backbone, "none", mapper, batch_size=batch_size, preprocess=preprocess)
        super().__init__(model, start, freeze, batch_norm, lr, weight_decay, weight_bits)
        self.log_temperature = nn.Parameter(torch.tensor(math.log(mapper.temperature or TEMPERATURE)))
        self.objective = Objective() if losses is None else losses
        if embedding := coded(backbone):
            embedding.network.requires_grad_(False)
            self.frozen.add("network")
        # to learn a code from: descriptors of augmented frames, (n,K), and their places, (n,R)
        self.views: tuple[Tensor, Tensor] | None = None
        self._descriptors: Tensor | None = None  # of the reference, by a network that is fixed

    @property
    def route(self) -> TemplateMap:
        """The template map in training."""
        return cast(TemplateMap, self.dejavu.map)

    def prepare(self) -> None:
        data, model = self.data, self.dejavu
        if data.sets["reference"].values.ndim == 2 and list(model.features.parameters()):
            log.warning("the source holds ready features: the backbone is not used")
            model.features, self.frozen = HOG(), set()  # has no weights to store
        if embedding := coded(self.features):
            coder = cast(Coder, embedding.coder)
            if not (coder.whitened or data.augmentation.acts or data.sources["second"] is not None):
                seen = "data.augmentation changes nothing, so the whitening has nothing to learn from"
                raise InputError(f"{seen}; expected an augmentation, or data.second")
            embedding.network.eval()
            views = self.views_of(ROUNDS, MAX_VALUES // len(coder.mean))
            descriptors, positives = map(torch.cat, zip(*views, strict=True))
            self.views, self._descriptors = (descriptors, positives), None
            if not coder.whitened:
                coder.whiten(descriptors, self.descriptors()[positives[:, 0]])
        if not self.map.places:
            self.relearn()

    def describe(self, frames: Tensor) -> Tensor:
        """Features of frames, without a code: (B,C,H,W) -> (B,K)."""
        embedding = coded(self.features)
        if embedding is None:
            return super().describe(frames)
        return embedding.describe(self.dejavu.preprocess(frames))

    def descriptors(self) -> Tensor:
        """Descriptors of the reference, (N,K), by a network that is fixed; computed once."""
        if self._descriptors is None:
            with in_mode(self.features, False):
                self._descriptors = self.of_reference(self.described)
        return self._descriptors

    def trained(self) -> list[nn.Parameter]:
        return [self.log_temperature, *trainable(self.features), *self.route.parameters()]

    def chance(self) -> dict[str, float]:
        place = {"place": place_chance(self.route.places, self.data.tolerance)}
        return place | ({"phase": phase_chance(self.route.plan)} if self.objective.phase else {})

    def losses(self, batch: Batch) -> Losses:
        embedding = coded(self.features)
        if embedding is None or self.views is None:
            positives = batch.truth.positives
            frames = self.data.augmented(batch.frames, self.data.clip)
            features = features_of(frames, self.describe, "the batch")
        else:
            drawn = torch.randint(len(self.views[0]), (BATCH,)).to(self.views[0].device)
            descriptors, positives = (part[drawn] for part in self.views)
            features = embedding.code(descriptors)
        distances = self.route.distances(features)
        temperature, tolerance = self.log_temperature.exp(), self.data.tolerance
        return self.objective(
            distances, self.scores(distances), positives, self.route, temperature, tolerance
        )

    def on_train_batch_end(self, *batch: object) -> None:
        try:
            super().on_train_batch_end(*batch)
        except NothingLearned as error:
            cure = "BatchNorm1d(D, affine=False) at the end of the backbone, or a DescriptorTask"
            seen = f"{error}; templates need features of equal scale"
            raise NothingLearned(f"{seen}: expected {cure}") from error

    def scores(self, distances: Sequence[Tensor]) -> Tensor:
        """Eq. 4 of the map with the trained temperature: L tensors (B,P) -> (B,N)."""
        return log_posterior(self.route.combine(distances), self.log_temperature.exp())

    def forward(self, frames: Tensor) -> Tensor:
        """Scores of all places, equal to those of the exported map. (B,C,H,W) or (B,D) -> (B,N)."""
        with in_bits(self.features, self.weight_bits):
            features = features_of(frames, self.dejavu.descriptor.describe, "the batch")
        return self.scores(self.route.distances(features))

    def relearn(self) -> None:
        embedding = coded(self.features)
        with in_mode(self, True):  # to collect running statistics
            if embedding is None:
                features = self.of_reference(self.described, shuffled=True)
            else:
                features = self.of_reference(embedding.code, self.descriptors(), shuffled=True)
            self.dejavu.learn_features(features, self.data.reference)
        name = self.data.reference.name
        expect(self.route.plan, "imposed periods", f"nothing repeats in the features of {name}")
        self.route.trainable(True)
        self.map.train(self.training)
        if self.data.resize is not None:
            self.dejavu.frame_shape = tuple(self.data.sets["reference"].values.shape[1:])

    def deployed(self) -> DejaVu:
        model = super().deployed()
        route, mapper = cast(TemplateMap, model.map), cast(TemplateMapper, model.mapper)
        route.freeze()
        route.temperature = mapper.temperature = float(self.log_temperature.detach().exp())
        mapper.trainable = False
        return model
