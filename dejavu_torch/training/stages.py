"""The stages of a training: a descriptor that distinguishes places, and a code that repeats with periods."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from itertools import accumulate
from typing import cast

import torch
from torch import Tensor, nn

from dejavu_torch.features.embedding import Coder, Embedding, to_length
from dejavu_torch.features.extract import features_of, in_mode
from dejavu_torch.features.hog import HOG
from dejavu_torch.maps.distance import phase_distances
from dejavu_torch.maps.spectrum import Transform
from dejavu_torch.training.datamodule import Batch, StoredFrames
from dejavu_torch.training.losses import (
    STEP,
    Losses,
    bands_of,
    coded_proxies,
    phase_chance,
    place_chance,
    place_cross_entropy,
)
from dejavu_torch.training.processes import noise_like, own_part, own_random
from dejavu_torch.training.trainee import Trainee, coded
from dejavu_torch.types import InputError

log = logging.getLogger("dejavu_torch")

ROUNDS = 10  # views of each training frame, for whitening and code
MAX_VALUES = 2**27  # of all views, beyond one view of each frame: half a gigabyte
SPARSE = 3  # frames; shorter segments leave little to average
MIN_CORRELATION = 0.1  # of neighbouring frames
SAMPLED = 400  # frames in which `similar_span` measures correlations
BATCH = 128  # views per step
TEMPERATURE = 0.1  # of cosine distances, at the start
NOISE = 0.5  # added to descriptors in training, whose components are about 1


class DescriptorStage(nn.Module):
    """Trains the descriptor to distinguish segments of the route.

    The loss is the place cross-entropy over the cosine distances of the descriptor to one proxy per segment.
    Segments are as long as the tolerance, or the `similar_span` if that is shorter; an answer is right within
    as many places. If this is the last stage, the map is made from the descriptor in closed form.

    Args:
        share: of the steps of the whole training; the last stage gets the remaining steps.
    """

    every: Tensor
    segment: Tensor

    def __init__(self, share: float = 0.0) -> None:
        super().__init__()
        self.share = share
        self.proxies = nn.Parameter(torch.zeros(0, 0))
        self.log_temperature = nn.Parameter(torch.tensor(math.log(TEMPERATURE)))
        self.register_buffer("every", torch.tensor(1))  # places of a segment
        # of each place, as numbered by `RouteData.apart`; the gaps between routes get one after the last
        self.register_buffer("segment", torch.zeros(0, dtype=torch.int64), persistent=False)

    def begin(self, task: Trainee) -> None:
        """Create the parameters of the stage; called again if a training is resumed in it."""
        if not _trainable(task.network):
            seen = f"{type(task.features).__name__} has nothing to train"
            raise InputError(f"{seen}; expected parameters that are not frozen, or `dejavu learn`")
        data, known = task.data, len(self.proxies)
        frames, every = data.sets["reference"], int(self.every)
        if not known:
            every = similar_span(frames, data.lengths, data.tolerance)
        begins = torch.cat([torch.arange(length) % every == 0 for length in data.lengths])
        count = int(begins.sum())
        numbers = data.apart(torch.arange(len(begins)))
        between = torch.full((int(numbers[-1]) + 1,), count)
        self.segment = between.scatter(0, numbers, begins.cumsum(0) - 1).to(task.device)
        if not known:
            if every < SPARSE <= data.tolerance:
                log.warning(
                    "frames of %s stay similar for %d, fewer than data.tolerance %d, so training uses %d; "
                    "unless bytes are few, the untrained map of `dejavu learn` is likely better",
                    *(data.route_name, every, data.tolerance, every),
                )
            self.every.fill_(every)
            with torch.no_grad(), in_mode(task.features, False):
                dimension = task.described(frames[[0]].frames).shape[1]
            self.make(count, dimension, task)
            if task.made:
                task.check_budget(len(begins), dimension)
        elif known != count:
            seen = f"the descriptor was learned on {known} segments of {every} frames"
            raise InputError(f"{seen}, {data.route_name} has {count}; expected the route it was learned on")

    def make(self, segments: int, dimension: int, task: Trainee) -> None:
        """Create random proxies."""
        self.proxies = nn.Parameter(torch.randn(segments, dimension).to(task.device))

    def end(self) -> None:
        """Drop the proxies, which no later stage needs."""
        self.proxies = nn.Parameter(self.proxies.detach()[:0])

    def trained(self, task: Trainee) -> list[nn.Parameter]:
        """The parameters that the stage trains, with its own optimizer."""
        return [*_trainable(task.network), *self.parameters()]

    def losses(self, task: Trainee, batch: Batch) -> Losses:
        """The losses of a batch."""
        return self.losses_to(self.proxies, task, batch)

    def chance(self, task: Trainee) -> dict[str, float]:
        """The minimum of each loss for answers that ignore the frames."""
        return {"descriptor": place_chance(sum(task.data.lengths), self.tolerance(task))}

    def tolerance(self, task: Trainee) -> int:
        """Places within which an answer is right during training."""
        return min(task.data.tolerance, int(self.every))

    def losses_to(self, proxies: Tensor, task: Trainee, batch: Batch) -> Losses:
        """The losses of a batch, for proxies (W,K)."""
        with own_random(task.global_step):
            frames = task.data.augmented(batch.frames, task.data.clip)
            descriptors = to_length(task.describe(frames).float())
        noisy = descriptors + NOISE * noise_like(descriptors)
        distances = phase_distances(noisy, proxies, "cosine")
        distances = nn.functional.pad(distances, (0, 1), value=math.inf)  # for the gaps between routes
        scores, temperature = distances.index_select(1, self.segment), self.log_temperature.exp()
        places = task.data.apart(batch.truth.positives)
        found = place_cross_entropy(scores, places, self.tolerance(task), temperature)
        return Losses(found.loss, {"descriptor": found.loss}, found.left_out)

    def _load_from_state_dict(self, state: dict[str, Tensor], prefix: str, *args: object) -> None:
        for name in self._parameters.keys() & {"proxies", "log_widths"}:
            given = state.get(prefix + name)
            if given is not None:  # of any shape
                setattr(self, name, nn.Parameter(torch.empty_like(given, device=self.proxies.device)))
        super()._load_from_state_dict(state, prefix, *args)


class RateStage(DescriptorStage):
    """Trains a descriptor that distinguishes segments with few frequencies, since their bits are in the loss.

    `proxies` are the lines of their spectra, see `coded_proxies`.

    Args:
        rate: weight of a bit per place relative to the cross-entropy in nats; it rises from 0 over the steps,
            so that places are learned first.
    """

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.rate = rate
        self.transform: Transform = "dft"  # `begin` sets that of the map
        self.log_step = nn.Parameter(torch.tensor(math.log(STEP)))
        self.log_widths = nn.Parameter(torch.zeros(0))  # one-dimensional, so without weight decay

    def begin(self, task: Trainee) -> None:
        self.transform = getattr(task.dejavu.mapper, "transform", "dft")
        super().begin(task)

    def make(self, segments: int, dimension: int, task: Trainee) -> None:
        super().make(segments, dimension, task)
        bands = int(bands_of(segments, self.transform).max()) + 1
        self.log_widths = nn.Parameter(torch.zeros(bands * dimension, device=task.device))

    def losses(self, task: Trainee, batch: Batch) -> Losses:
        coded = coded_proxies(self.proxies, self.log_step, self.log_widths, self.transform)
        place = self.losses_to(coded.proxies, task, batch)
        per_place = coded.bits / len(task.data.sets["reference"])
        progress = task.global_step / int(task.trainer.estimated_stepping_batches)  # it is the only stage
        total = place.total + self.rate * progress * per_place
        return Losses(total, place.parts | {"bits": per_place}, place.left_out)


class CodeStage(nn.Module):
    """The last stage: trains features to repeat with the periods of the map's layers, and its templates.

    A descriptor is first whitened, by the changes under augmentation and in a second traverse, then fixed:
    views of all training frames are described once, and the code is learned from these. Any other backbone
    is trained as a whole on augmented frames.
    """

    def begin(self, task: Trainee) -> None:
        if embedding := coded(task.features):
            task.frozen.add("network")
            embedding.network.eval()
            coder = cast(Coder, embedding.coder)
            views = task.views_of(ROUNDS, MAX_VALUES // len(coder.mean))
            descriptors, positives = map(torch.cat, zip(*views, strict=True))
            task.views = descriptors, positives
            if not coder.whitened:
                coder.whiten(descriptors, task.descriptors()[positives[:, 0]])
        if not task.map.places:
            task.relearn()

    def trained(self, task: Trainee) -> list[nn.Parameter]:
        embedding = coded(task.features)
        learns = task.features if embedding is None else embedding.linear
        return [task.log_temperature, *_trainable(learns), *task.route.parameters()]

    def losses(self, task: Trainee, batch: Batch) -> Losses:
        embedding = coded(task.features)
        if embedding is None or task.views is None:
            positives = batch.truth.positives
            with own_random(task.global_step):
                frames = task.data.augmented(batch.frames, task.data.clip)
                features = features_of(frames, task.describe, "the batch")
        else:
            drawn = own_part(torch.randint(len(task.views[0]), (BATCH,))).to(task.views[0].device)
            descriptors, positives = (part[drawn] for part in task.views)
            with own_random(task.global_step):
                features = embedding.code(descriptors)
        distances = task.route.distances(features)
        temperature, tolerance = task.log_temperature.exp(), task.data.tolerance
        return task.losses(distances, task.scores(distances), positives, task.route, temperature, tolerance)

    def chance(self, task: Trainee) -> dict[str, float]:
        place = {"place": place_chance(task.route.places, task.data.tolerance)}
        return place | ({"phase": phase_chance(task.route.plan)} if task.losses.phase else {})


Stage = DescriptorStage | CodeStage


def stages_of(backbone: nn.Module, descriptor: float, made: bool, rate: float) -> list[Stage]:
    """The stages that a backbone needs; one that is whitened or has nothing to train needs only the last."""
    if made:
        return [RateStage(rate)] if rate else [DescriptorStage()]
    if (embedding := unwhitened(backbone)) and _trainable(embedding.network):
        return [DescriptorStage(descriptor), CodeStage()]
    return [CodeStage()]


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


def unwhitened(features: nn.Module) -> Embedding | None:
    """The features if they are an `Embedding` whose descriptor is not whitened yet."""
    embedding = coded(features)
    return None if embedding is None or cast(Coder, embedding.coder).whitened else embedding


def _trainable(module: nn.Module) -> list[nn.Parameter]:
    return [parameter for parameter in module.parameters() if parameter.requires_grad]
