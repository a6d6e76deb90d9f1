"""The stages of a training: a descriptor that tells places apart, and a code that repeats with periods."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from dejavu_torch.features.embedding import Embedding, to_length
from dejavu_torch.features.extract import features_of, in_mode
from dejavu_torch.maps.distance import phase_distances
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.text import one_line
from dejavu_torch.training.datamodule import Batch, as_frames
from dejavu_torch.training.losses import (
    STEP,
    Losses,
    Objective,
    bands_of,
    coded_proxies,
    phase_chance,
    place_chance,
    place_cross_entropy,
)
from dejavu_torch.training.processes import noise_like, own_part, own_random
from dejavu_torch.types import InputError

ROUNDS = 10  # views of each training frame, for whitening and code
NUMBERS = 2**27  # of all views at most, but for one of each frame: half a gigabyte
BATCH = 128  # views of a step: they cost little
TEMPERATURE = 0.1  # of cosine distances, at the start
WIDE = 1e6  # step of a map without lines, beside descriptors of about 1
NOISE = 0.5  # on descriptors in training, beside components of about 1

log = logging.getLogger("dejavu_torch")
Task = Any  # a `PlaceRecognitionTask`, whose file imports this one


class Views(NamedTuple):
    """descriptors: (n,K) of augmented training frames. positives: (n,R) int64, the places that they show."""

    descriptors: Tensor
    positives: Tensor


class Stage(nn.Module):
    """One part of a training, with an optimizer of its own.

    Args:
        share: of the steps of the whole training; the last stage takes the steps that are left.
    """

    def __init__(self, share: float = 0.0) -> None:
        super().__init__()
        self.share = share

    def begin(self, task: Task) -> None:
        """Make what the stage works with; called again where a training is resumed in it."""

    def end(self, task: Task) -> None:
        """Leave what the next stage needs."""

    def trained(self, task: Task) -> list[nn.Parameter]:
        """The parameters that the stage trains."""
        return []

    def losses(self, task: Task, batch: Batch) -> Losses:
        """The losses of a batch."""
        raise NotImplementedError

    def chance(self, task: Task) -> dict[str, float]:
        """The least that each loss can be without a look at the frames, of those that tell places apart."""
        return {}


class DescriptorStage(Stage):
    """The descriptor learns to tell stretches of the route apart.

    Place cross-entropy over the cosine distances of the descriptor to one proxy for each stretch, as long as
    the tolerance, and shorter at the end of a route. Where it is the last stage, the map is made of the
    descriptor in closed form.
    """

    every: Tensor
    stretch: Tensor

    def __init__(self, share: float = 0.0) -> None:
        super().__init__(share)
        self.proxies = nn.Parameter(torch.zeros(0, 0))
        self.log_temperature = nn.Parameter(torch.tensor(math.log(TEMPERATURE)))
        self.register_buffer("every", torch.tensor(1))  # places of a stretch
        # of each place, as `RouteData.apart` numbers them; between two routes one behind the last
        self.register_buffer("stretch", torch.zeros(0, dtype=torch.int64), persistent=False)

    def begin(self, task: Task) -> None:
        if not _trainable(network_of(task.dejavu.features)):
            raise InputError(
                f"nothing of {type(task.dejavu.features).__name__} can be trained; expected a network with "
                "parameters that are not frozen, or `dejavu learn`, which trains nothing"
            )
        reference = task.data.sets["reference"]
        every = int(self.every) if len(self.proxies) else max(1, task.data.tolerance)
        begins = [place % every == 0 for length in task.data.lengths for place in range(length)]
        stretches = torch.tensor(begins).cumsum(0) - 1
        count = sum(begins)
        numbers = task.data.apart(torch.arange(len(reference)))
        between = torch.full((int(numbers[-1]) + 1,), count)
        self.stretch = between.scatter(0, numbers, stretches).to(task.device)
        if not len(self.proxies):
            self.every.fill_(every)
            with torch.no_grad(), in_mode(task.dejavu.features, False):
                one = described(task, reference.values[:1], descriptor_of(task))
            self.make(count, one.shape[1], task)
            if task.made:
                check_map(task, len(reference), one.shape[1])
        elif len(self.proxies) != count:
            raise InputError(
                f"the descriptor was learned on {len(self.proxies)} stretches of {every} frames, "
                f"{task.data.route_name} has {count}; expected the route that it was learned on"
            )

    def make(self, stretches: int, dimension: int, task: Task) -> None:
        """Proxies to start from."""
        self.proxies = nn.Parameter(torch.randn(stretches, dimension).to(task.device))

    def end(self, task: Task) -> None:
        self.proxies = nn.Parameter(self.proxies.detach()[:0])  # no later checkpoint needs them

    def trained(self, task: Task) -> list[nn.Parameter]:
        return [*_trainable(network_of(task.dejavu.features)), *self.parameters()]

    def losses(self, task: Task, batch: Batch) -> Losses:
        return self.losses_to(self.proxies, task, batch)

    def chance(self, task: Task) -> dict[str, float]:
        return {"descriptor": place_chance(sum(task.data.lengths), task.data.tolerance)}

    def losses_to(self, proxies: Tensor, task: Task, batch: Batch) -> Losses:
        """The losses of a batch, to proxies (W,K)."""
        with own_random(task.global_step):
            frames = task.data.augmented(batch.frames, task.data.clip)
            descriptors = to_length(descriptor_of(task)(frames).float())
        noisy = descriptors + NOISE * noise_like(descriptors)
        distances = phase_distances(noisy, proxies, "cosine")
        distances = nn.functional.pad(distances, (0, 1), value=math.inf)  # between two routes
        scores, temperature = distances.index_select(1, self.stretch), self.log_temperature.exp()
        places = task.data.apart(batch.truth.positives)
        found = place_cross_entropy(scores, places, task.data.tolerance, temperature)
        return Losses(found.loss, {"descriptor": found.loss}, found.left_out)

    def _load_from_state_dict(self, state: dict[str, Tensor], prefix: str, *args: object) -> None:
        for name in self._parameters.keys() & {"proxies", "log_widths"}:
            given = state.get(prefix + name)
            if given is not None:  # however many there are
                setattr(self, name, nn.Parameter(torch.empty_like(given, device=self.proxies.device)))
        super()._load_from_state_dict(state, prefix, *args)


class RateStage(DescriptorStage):
    """A descriptor that tells stretches apart and is made of few frequencies, since their bits count.

    `proxies` are the lines of their spectra, see `coded_proxies`.

    Args:
        rate: what a bit per place counts beside the cross-entropy in nats; it rises to that over the steps,
            so that places are learned first.
    """

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.rate = rate
        self.log_step = nn.Parameter(torch.tensor(math.log(STEP)))
        self.log_widths = nn.Parameter(torch.zeros(0))  # of one dimension, which weight decay leaves alone

    def make(self, stretches: int, dimension: int, task: Task) -> None:
        super().make(stretches, dimension, task)
        bands = int(bands_of(stretches, getattr(task.dejavu.mapper, "transform", "dft")).max()) + 1
        self.log_widths = nn.Parameter(torch.zeros(bands * dimension, device=task.device))

    def losses(self, task: Task, batch: Batch) -> Losses:
        coded = coded_proxies(
            self.proxies, self.log_step, self.log_widths, getattr(task.dejavu.mapper, "transform", "dft")
        )
        place = self.losses_to(coded.proxies, task, batch)
        per_place = coded.bits / len(task.data.sets["reference"])
        progress = (task.global_step - task.began) / max(1, task.stop() - task.began)
        total = place.total + self.rate * progress * per_place
        return Losses(total, place.parts | {"bits": per_place}, place.left_out)


class CodeStage(Stage):
    """Features learn to repeat with the periods of the map's layers, together with its templates.

    A descriptor is first whitened by what the augmentation and a second traverse change in it, and then kept:
    views of all training frames are described once, and the code is learned from them. Any other backbone is
    trained as a whole, on augmented frames.
    """

    def begin(self, task: Task) -> None:
        if has_descriptor(task.dejavu.features):
            task.frozen.add("network")
            task.dejavu.features.network.eval()
            room = NUMBERS // len(task.dejavu.features.coder.mean)
            views = zip(*views_of(task, ROUNDS, room), strict=True)
            task.views = Views(*(torch.cat(part) for part in views))
            if whitens(task.dejavu.features):
                shown = place_descriptors(task)[task.views.positives[:, 0]]
                task.dejavu.features.coder.whiten(task.views.descriptors, shown)
        if not task.dejavu.map.places:
            task.relearn()

    def trained(self, task: Task) -> list[nn.Parameter]:
        features = task.dejavu.features
        learns = features.coder if has_descriptor(features) else features
        return [task.log_temperature, *_trainable(learns), *task.route.parameters()]

    def losses(self, task: Task, batch: Batch) -> Losses:
        descriptors, positives = task.views or (None, batch.truth.positives)
        if descriptors is not None:
            drawn = own_part(torch.randint(len(descriptors), (BATCH,))).to(descriptors.device)
            descriptors, positives = descriptors[drawn], positives[drawn]
        with own_random(task.global_step):
            if descriptors is None:
                frames = task.data.augmented(batch.frames, task.data.clip)
                features = features_of(frames, task.dejavu.describe, "the batch")
            else:
                features = task.dejavu.features.code(descriptors)
        distances = task.route.distances(features)
        temperature, tolerance = task.log_temperature.exp(), task.data.tolerance
        scores, objective = task.scores(distances), cast(Objective, task.losses)
        return objective(distances, scores, positives, task.route, temperature, tolerance)

    def chance(self, task: Task) -> dict[str, float]:
        place = {"place": place_chance(task.route.places, task.data.tolerance)}
        return place | ({"phase": phase_chance(task.route.plan)} if task.losses.phase else {})


def stages_of(backbone: nn.Module, descriptor: float, made: bool = False, rate: float = 0.0) -> list[Stage]:
    """The stages that a backbone needs; what is whitened or has nothing to train has the last only."""
    if made:
        return [RateStage(rate)] if rate else [DescriptorStage()]
    if whitens(backbone) and _trainable(network_of(backbone)):
        return [DescriptorStage(descriptor), CodeStage()]
    return [CodeStage()]


def has_descriptor(backbone: Any) -> bool:
    """Whether a backbone is an `Embedding` whose code is learned from a whitened descriptor."""
    return isinstance(backbone, Embedding) and backbone.coder is not None


def whitens(backbone: Any) -> bool:
    """Whether the descriptor of a backbone is still to be whitened."""
    return has_descriptor(backbone) and not bool(backbone.coder.whitened)


def network_of(backbone: Any) -> Any:
    """What makes the descriptor: the backbone, or its network where a code comes behind it."""
    return backbone.network if has_descriptor(backbone) else backbone


def descriptor_of(task: Task) -> Any:
    """Describes frames: (B,C,H,W) -> (B,K)."""
    if not has_descriptor(task.dejavu.features):
        return task.dejavu.describe
    return lambda frames: task.dejavu.features.describe(task.dejavu.preprocess(frames))


def _trainable(module: nn.Module) -> list[nn.Parameter]:
    return [parameter for parameter in module.parameters() if parameter.requires_grad]


@torch.no_grad()
def views_of(task: Task, rounds: int, most: int) -> Iterator[Views]:
    """Batches of augmented training frames of known places, at most `most` in all behind the first round."""
    data, describe = task.data, descriptor_of(task)
    loader = data.training_batches()
    rounds = min(rounds, most // len(loader.dataset)) if data.augmentation.acts else 1
    with in_mode(task.dejavu.features, False):
        for _ in range(max(1, rounds)):
            for batch in loader:
                known = batch.truth.positives[:, 0] >= 0
                if known.any():
                    frames = data.augmented(batch.frames.to(task.device), data.clip)[known]
                    views = features_of(frames, describe, "the batch").float()
                    yield Views(views, batch.truth.positives[known].to(task.device))


def check_map(task: Task, places: int, dimension: int) -> None:
    """Refuse ahead of the training a map of too few bytes; those that nobody asked for give way."""
    whitening, mapper = task.dejavu.whitening, task.dejavu.mapper
    numbers = dimension if whitening is None else whitening.kept(places, dimension, True)
    descriptors = torch.randn(places, numbers, generator=torch.Generator().manual_seed(0))
    wanted, gives_way = getattr(mapper, "route_bytes_per_place", None), task.gives_way
    task.gives_way = False  # it is settled
    try:
        mapper(descriptors)
        return
    except InputError:
        if not gives_way or wanted is None:
            raise
    empty = SpectralMapper(None, step=WIDE, chunk=mapper.chunk)(descriptors)
    more = min(wanted + empty.summary().route_bytes / places, 4 * numbers)
    mapper.route_bytes_per_place = math.ceil(100 * more) / 100
    mapper(descriptors)
    log.warning(
        "%d places need more than --model.mapper.route_bytes_per_place %g: %g is used",
        *(places, wanted, mapper.route_bytes_per_place),
    )


def place_descriptors(task: Task) -> Tensor:
    """Descriptors of the stored reference frames, (N,K), of a network that is trained no more: made once."""
    if task.places is None:
        with in_mode(task.dejavu.features, False):
            task.places = stored_features(task, descriptor_of(task))
    return cast(Tensor, task.places)


def make_map(task: Task) -> None:
    """Learn the whitening and the map of the present descriptors, with no random number of the training."""
    model, whitening = task.dejavu, task.dejavu.whitening
    with torch.random.fork_rng(), torch.no_grad(), in_mode(model, False):
        features = stored_features(task, model.describe)
        if task.gives_way:
            check_map(task, *features.shape)
        if whitening is not None:
            torch.manual_seed(whitening.seed)
            views = views_of(task, whitening.copies(*features.shape), whitening.most_views)
            pairs = ((view, places[:, 0]) for view, places in views)
            whitening.learn(features, None if whitening.views == 0 else pairs)
        alone = task.data.reference if len(task.data.routes) == 1 else None
        model.learn_features(model.whitened(features), alone)


@torch.no_grad()
def stored_features(
    task: Task, describe: Callable[[Tensor], Tensor], shuffled: bool = False, places: Tensor | None = None
) -> Tensor:
    """Features of the stored reference frames, (N,D), or codes of their descriptors; NaN is refused. Batches
    are drawn from all over the route where running statistics are gathered from them."""

    def make(index: Tensor) -> Tensor:
        if places is None:
            return described(task, frames[index.tolist()].frames, describe)
        with torch.autocast(task.device.type, enabled=False):
            return describe(places[index.to(places.device)])

    frames = task.data.sets["reference"]
    count = len(frames)
    order = torch.randperm(count) if shuffled else torch.arange(count)
    batches = min(-(-count // task.dejavu.batch_size), count // 2)  # none of a single frame
    features = torch.cat([make(batch) for batch in order.tensor_split(batches)])
    features = features[order.argsort().to(features.device)]
    if not features.isfinite().all():
        name, maker = task.data.route_name, type(task.dejavu.features).__name__
        raise InputError(f"{maker} makes NaN or infinite features of {name}; expected finite numbers")
    return features


def described(task: Task, values: Tensor, describe: Callable[[Tensor], Tensor]) -> Tensor:
    """Features of stored frames, in 32 bits; a backbone that does not take them is refused."""
    try:
        with torch.autocast(task.device.type, enabled=False):
            return features_of(as_frames(values).to(task.device), describe, "the batch")
    except RuntimeError as error:
        problem, maker = one_line(error)[:200], type(task.dejavu.features).__name__
        raise InputError(f"{maker} does not take frames {tuple(values.shape[1:])}: {problem}") from error
