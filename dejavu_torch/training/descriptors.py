"""Training a descriptor that distinguishes places, for any map that is made of it in closed form."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from itertools import accumulate
from typing import Literal

import torch
from torch import Tensor, nn

from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.embedding import to_length
from dejavu_torch.features.extract import features_of, in_mode
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.joined import groups_of
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.whitening import INDEPENDENT, MOST_VIEWS, STRENGTHS, Whitening
from dejavu_torch.maps.distance import phase_distances
from dejavu_torch.maps.place_map import Mapper
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.spectrum import Transform
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.maps.weights import in_bits
from dejavu_torch.model import DejaVu
from dejavu_torch.training.datamodule import Batch, StoredFrames
from dejavu_torch.training.losses import (
    STEP,
    Losses,
    bands_of,
    coded_proxies,
    place_chance,
    place_cross_entropy,
)
from dejavu_torch.training.task import (
    MAP,
    WHITENING,
    RouteTask,
    check_preprocess,
    coded,
    trainable,
)
from dejavu_torch.types import InputError, expect

log = logging.getLogger("dejavu_torch")

SPARSE = 3  # frames; shorter segments leave little to average
MIN_CORRELATION = 0.1  # of neighbouring frames
SAMPLED = 400  # frames in which `similar_span` measures correlations
TEMPERATURE = 0.1  # of cosine distances, at the start
NOISE = 0.5  # added to descriptors in training, whose components are about 1


class DescriptorTask(RouteTask):
    """Trains a descriptor to distinguish segments of one or several routes. Of one route the map is made from
    it in closed form, which needs no training.

    The loss is the place cross-entropy over the cosine distances of the descriptor to one proxy per segment.
    Segments are as long as the tolerance, or the `similar_span` if that is shorter; an answer is right within
    as many places. With a `rate`, the proxies are made of the quantised lines of their spectra, whose bits
    are in the loss, see `coded_proxies`: the descriptor follows few frequencies, and a spectral map takes few
    bytes.

    Args:
        backbone: nn.Module (B,C,H,W) -> (B,D); None is `SmallCNN()`. The code of an `Embedding` is left out.
        mapper: makes the map; None is `SpectralMapper()`.
        whitening: of the descriptor. It learns from views under the training's augmentation and of the second
            traverse; its `strengths` are not used. None and "none" are as in `DejaVu`, but with a `rate` None
            is "none", since whitening would mix the features.
        preprocess, start, freeze, batch_norm, lr, weight_decay, weight_bits: see `RouteTask` and `DejaVu`.
        rate: weight of a bit per place relative to the cross-entropy in nats; it rises from 0 over the steps,
            so that places are learned first.
        batch_size: frames in memory at a time when features are computed without gradients.

    Raises:
        InputError: as of `RouteTask`; a mapper of templates; a budget that cannot be met.
    """

    derived = (MAP, WHITENING)
    segment: Tensor

    def __init__(
        self,
        backbone: nn.Module | None = None,
        mapper: SpectralMapper | Mapper | None = None,
        whitening: Whitening | Literal["none"] | None = None,
        preprocess: Preprocess | None = None,
        start: str | None = None,
        freeze: list[str] | None = None,
        batch_norm: Literal["train", "frozen"] = "train",
        rate: float = 0.0,
        lr: float = 3e-3,
        weight_decay: float = 0.05,
        batch_size: int = 64,
        weight_bits: Literal[8, 32] = 8,
    ) -> None:
        backbone = SmallCNN() if backbone is None else backbone
        mapper = SpectralMapper() if mapper is None else mapper
        strengths = whitening.strengths if isinstance(whitening, Whitening) else STRENGTHS
        fits = not isinstance(mapper, TemplateMapper)
        expect(fits, "another one, or --model TemplateTask to train templates", mapper=type(mapper))
        expect(0 <= rate < math.inf, "0 or more, such as 1", rate=rate)
        expect(strengths == STRENGTHS, "those of data.augmentation alone", f"whitening.strengths {strengths}")
        check_preprocess(preprocess)
        if embedding := coded(backbone):
            backbone = embedding.without_code()
        whitening = "none" if whitening is None and rate else whitening
        model = DejaVu(backbone, whitening, mapper, batch_size=batch_size, preprocess=preprocess)
        super().__init__(model, start, freeze, batch_norm, lr, weight_decay, weight_bits)
        self.rate, self.every = rate, 1
        self.transform: Transform = getattr(mapper, "transform", "dft")
        self.proxies = nn.Parameter(torch.zeros(0, 0))  # of segments, or the lines of their spectra
        self.log_temperature = nn.Parameter(torch.tensor(math.log(TEMPERATURE)))
        if rate:
            self.log_step = nn.Parameter(torch.tensor(math.log(STEP)))
            self.log_widths = nn.Parameter(torch.zeros(0))  # one-dimensional, so without weight decay
        # of each place, as numbered by `RouteData.apart`; the gaps between routes get one after the last
        self.register_buffer("segment", torch.zeros(0, dtype=torch.int64), persistent=False)

    def prepare(self) -> None:
        data, name = self.data, self.data.route_name
        frames = data.sets["reference"]
        expect(frames.values.ndim != 2, "frames, or `dejavu learn`", f"{name} holds ready features")
        seen = f"{type(self.features).__name__} has nothing to train"
        expect(trainable(self.features), "parameters that are not frozen, or `dejavu learn`", seen)
        seen = (
            f"model.rate is {self.rate}, for the bits of one map, and there are {len(data.references)} routes"
        )
        expect(not self.rate or len(data.references) <= 1, "model.rate 0, or one route", seen)
        seen = "data.augmentation changes nothing, so the whitening has nothing to learn from"
        fits = self.dejavu.whitening is None or data.augmentation.acts or data.sources["second"] is not None
        expect(fits, "an augmentation, data.second, or model.whitening none", seen)
        self.every = every = similar_span(frames, data.lengths, data.tolerance)
        if every < SPARSE <= data.tolerance:
            log.warning(
                "frames of %s stay similar for %d, fewer than data.tolerance %d, so training uses %d; "
                "unless bytes are few, the untrained map of `dejavu learn` is likely better",
                *(name, every, data.tolerance, every),
            )
        begins = torch.cat([torch.arange(length) % every == 0 for length in data.lengths])
        count, numbers = int(begins.sum()), data.apart(torch.arange(len(begins)))
        between = torch.full((int(numbers[-1]) + 1,), count)
        self.segment = between.scatter(0, numbers, begins.cumsum(0) - 1).to(self.device)
        if len(self.proxies) == count:
            return
        with torch.no_grad(), in_mode(self.features, False):
            dimension = self.described(frames[[0]].frames).shape[1]
        self.proxies = nn.Parameter(torch.randn(count, dimension).to(self.device))
        if self.rate:
            bands = int(bands_of(count, self.transform).max()) + 1
            self.log_widths = nn.Parameter(torch.zeros(bands * dimension, device=self.device))
        self._check_budget(len(begins), dimension)

    def _check_budget(self, places: int, dimension: int) -> None:
        """Refuse a map of too few bytes before the training."""
        whitening = self.dejavu.whitening
        kept = dimension if whitening is None else whitening.kept(places, dimension, True)
        descriptors = torch.randn(places, kept, generator=torch.Generator().manual_seed(0))
        self.dejavu.mapper(descriptors + (whitening is None))  # a mean needs bytes

    def trained(self) -> list[nn.Parameter]:
        own = [self.proxies, self.log_temperature]
        return [*trainable(self.features), *own, *([self.log_step, self.log_widths] if self.rate else [])]

    @property
    def tolerance(self) -> int:
        """Places within which an answer is right during training."""
        return min(self.data.tolerance, self.every)

    def chance(self) -> dict[str, float]:
        return {"descriptor": place_chance(sum(self.data.lengths), self.tolerance)}

    def losses(self, batch: Batch) -> Losses:
        if not self.rate:
            return self._losses_to(self.proxies, batch)
        lines = coded_proxies(self.proxies, self.log_step, self.log_widths, self.transform)
        place = self._losses_to(lines.proxies, batch)
        per_place = lines.bits / len(self.data.sets["reference"])
        progress = self.global_step / int(self.trainer.estimated_stepping_batches)
        total = place.total + self.rate * progress * per_place
        return Losses(total, place.parts | {"bits": per_place}, place.left_out)

    def _losses_to(self, proxies: Tensor, batch: Batch) -> Losses:
        """The losses of a batch, for proxies (W,K)."""
        frames = self.data.augmented(batch.frames, self.data.clip)
        descriptors = to_length(features_of(frames, self.describe, "the batch").float())
        noise = torch.randn(descriptors.shape, dtype=descriptors.dtype)  # the same on every device
        distances = phase_distances(descriptors + NOISE * noise.to(descriptors), proxies, "cosine")
        distances = nn.functional.pad(distances, (0, 1), value=math.inf)  # for the gaps between routes
        scores, temperature = distances.index_select(1, self.segment), self.log_temperature.exp()
        places = self.data.apart(batch.truth.positives)
        found = place_cross_entropy(scores, places, self.tolerance, temperature)
        return Losses(found.loss, {"descriptor": found.loss}, found.left_out)

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Drop the map of the previous features."""
        if self.map.places:
            self.dejavu.map = self.dejavu.mapper.empty().to(self.device)

    def forward(self, frames: Tensor) -> Tensor:
        """Scores of all places, equal to those of the exported map. (B,C,H,W) -> (B,N)."""
        with in_bits(self.features, self.weight_bits):
            features = features_of(frames, self.dejavu.descriptor.describe, "the batch")
        return self.map.scores(self.dejavu.descriptor.whitened(features))

    @torch.no_grad()
    def relearn(self) -> None:
        """In closed form from the rounded network, without using up random numbers of the training."""
        model, whitening = self.dejavu, self.dejavu.whitening
        alone = self.data.reference if len(self.data.references) == 1 else None
        with in_bits(self.features, self.weight_bits), torch.random.fork_rng(), in_mode(model, False):
            features = self.of_reference(self.described)
            if whitening is not None:
                torch.manual_seed(whitening.seed)
                views = self.views_of(whitening.copies(*features.shape), MOST_VIEWS)
                pairs = ((view, places[:, 0]) for view, places in views)
                shown = None if whitening.views == 0 else pairs
                whitening.learn(features, shown, groups_of(self.features), INDEPENDENT * len(features))
            model.learn_features(model.descriptor.whitened(features), alone)
        self.map.train(self.training)
        if self.data.resize is not None and alone is not None:
            model.frame_shape = tuple(self.data.sets["reference"].values.shape[1:])

    def deployed(self) -> DejaVu:
        model = super().deployed()
        if len(self.data.references) == 1:
            return model
        trained, bits = model.trained, model.weight_bits
        model = DejaVu(**(model.settings() | {"velocity": None})).eval()  # the descriptor of all routes
        model.trained, model.weight_bits = trained, bits
        return model


@torch.no_grad()
def similar_span(frames: StoredFrames, lengths: Sequence[int], longest: int) -> int:
    """The longest distance, in frames, at which HOG features correlate at least half as much as those of
    neighbouring frames, from 1 to `longest`; `longest` if HOG cannot be computed or never changes.

    Camera noise lowers all correlations equally, so their ratio measures changes along the route. It is a
    ratio of medians over the route, on which a stop has no effect.

    Args:
        lengths: frames of each route, in the order of the frames.
    """
    if longest < 2:
        return 1
    found, samples = [], max(2, SAMPLED // ((longest + 1) * len(lengths)))
    for start, length in zip(accumulate([0, *lengths]), lengths, strict=False):
        begins = start + torch.linspace(0, length - longest - 1, samples).long().unique()
        index = (begins[:, None] + torch.arange(longest + 1)).tolist()
        try:
            hog = torch.stack([HOG()(frames[part].frames) for part in index])
        except InputError:
            return longest
        if bool((hog != hog[0, 0]).any()):
            units = nn.functional.normalize(hog - hog.mean((0, 1)), dim=2)
            products = units @ units.mT
            found.append(torch.stack([products.diagonal(lag, 1, 2).mean(1) for lag in range(1, longest + 1)]))
    if not found:
        return longest
    correlation = torch.cat(found, 1).median(1).values
    threshold = max(float(correlation[0]), MIN_CORRELATION) / 2
    return next((lag for lag, one in enumerate(correlation.tolist()[1:], 1) if one < threshold), longest)
