"""A model in training on a route, under Lightning's trainer: what the two kinds of training share."""

from __future__ import annotations

import copy
import logging
import math
import os
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast

import pytorch_lightning as pl
import torch
from lightning_fabric.plugins.io.torch_io import TorchCheckpointIO
from pytorch_lightning.strategies import DDPStrategy
from torch import Tensor, nn
from torch.optim import AdamW
from torch.optim.lr_scheduler import LambdaLR

from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.features.extract import features_of, in_mode
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.maps.place_map import PlaceMap
from dejavu_torch.maps.weights import BITS, round_weights, unpacked
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import check_types, opened
from dejavu_torch.recognition.select import best_match
from dejavu_torch.text import one_line
from dejavu_torch.training.checkpoint import CheckpointFiles, read_checkpoint, taking_over
from dejavu_torch.training.datamodule import MIN_FRAMES, Batch, RouteData, StoredFrames
from dejavu_torch.training.losses import LastLosses, Losses
from dejavu_torch.training.metrics import PlaceRecognition
from dejavu_torch.types import Facts, InputError, Training, expect

log = logging.getLogger("dejavu_torch")

MAP, WHITENING = "dejavu.map.", "dejavu.descriptor.whitening."  # prefixes of tensor names in a checkpoint


class RouteTask(pl.LightningModule):
    """A `DejaVu` model and the route that it is trained on: `DescriptorTask` or `TemplateTask`.

    Args:
        start: a map file of the same backbone with the weights to start from.
        freeze: prefixes of names of parameters that are not trained and keep their running statistics; "" is
            the whole backbone.
        batch_norm: "train" lets BatchNorm follow the batches; "frozen" keeps its running statistics, which
            is better for pretrained networks and few frames.
        lr: highest learning rate of AdamW; it rises over the first tenth of the steps and falls to 0.
        weight_decay: of matrices and kernels only, not of biases or templates.
        weight_bits: of each weight of the backbone in the map file, 8 or 32, as in `DejaVu`. Training and
            checkpoints use 32; maps made from a descriptor, validation and test use the rounded weights.

    Raises:
        InputError: settings out of range; a backbone that does not give (B,D); a loss that is not finite; a
            checkpoint with other settings.
        NothingLearned: an InputError; the mean loss over 100 steps is at chance.
    """

    made = True  # whether the map is made from descriptors in closed form
    derived: tuple[str, ...] = ()  # prefixes of names that a checkpoint lacks

    def __init__(
        self,
        dejavu: DejaVu,
        start: str | None,
        freeze: list[str] | None,
        batch_norm: Literal["train", "frozen"],
        lr: float,
        weight_decay: float,
        weight_bits: Literal[8, 32],
    ) -> None:
        super().__init__()
        expect(lr > 0, "a number above 0", lr=lr)
        expect(weight_decay >= 0, "0 or more", weight_decay=weight_decay)
        expect(weight_bits in BITS, f"one of {', '.join(map(str, BITS))}", weight_bits=weight_bits)
        self.dejavu, self.lr, self.weight_decay, self.weight_bits = dejavu, lr, weight_decay, weight_bits
        if start is not None:
            start_from(dejavu.features, start)
        self.frozen = freeze_parts(dejavu.features, freeze or [], batch_norm)
        self.train()
        self.last, self.metric = LastLosses(), PlaceRecognition(0)  # `setup` sets the tolerance
        # from a checkpoint
        self.steps, self.resumed, self.held_before = 0, False, cast(list[int] | None, None)

    # what a kind of training has of its own

    @abstractmethod
    def prepare(self) -> None:
        """Create the parameters that depend on the route, unless there are some."""

    @abstractmethod
    def trained(self) -> list[nn.Parameter]:
        """The parameters that are trained."""

    @abstractmethod
    def losses(self, batch: Batch) -> Losses:
        """The losses of a batch."""

    @abstractmethod
    def chance(self) -> dict[str, float]:
        """The minimum of each loss for answers that ignore the frames."""

    @abstractmethod
    def relearn(self) -> None:
        """Make the map from the current features of the reference (section III-A)."""

    # the model and its route

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
    def features(self) -> nn.Module:
        """The features in training."""
        return self.dejavu.features

    @property
    def frame_size(self) -> tuple[int, int] | None:
        """(height, width) to which the backbone resizes frames, at which they can be stored; None if it does
        not, or if contrast normalisation needs the frames' own size."""
        return None if self.dejavu.preprocess.contrast else getattr(self.features, "resize", None)

    @property
    def held(self) -> list[int]:
        """The first places of the segments that neither this training nor that of a checkpoint has seen."""
        before = self.held_before
        return [start for start in self.data.held if before is None or start in before]

    def setup(self, stage: str) -> None:
        """Prepare for a route, with `CheckpointFiles` unless the trainer has a plugin for checkpoints."""
        strategy = self.trainer.strategy
        if type(strategy.checkpoint_io) is TorchCheckpointIO:
            strategy.checkpoint_io = CheckpointFiles()
        if isinstance(strategy, DDPStrategy):  # each process makes the same map, and none is sent
            strategy._ddp_kwargs["broadcast_buffers"] = False
        data, model = self.data, self.dejavu
        frames = data.sets["reference"]
        if isinstance(model.features, SmallCNN) and frames.values.ndim == 4:
            model.features.follow(model.preprocess(frames[[0]].frames).shape[1])
        self.to(strategy.root_device)
        self.metric = PlaceRecognition(data.tolerance)
        model.velocity = data.velocity
        if stage == "fit" and sum(data.lengths) < MIN_FRAMES:
            self._say_few()
        self._check_places()
        self.prepare()
        self.last = LastLosses()

    def _check_places(self) -> None:
        """Refuse the map of another route, which a checkpoint may hold."""
        places, count = self.map.places, len(self.data.sets["reference"])
        seen = f"the map has {places} places, {self.data.reference.name} has {count}"
        expect(places in (0, count), "the route that the map was made of", seen)

    def _say_few(self) -> None:
        data = self.data
        alone = data.sources["validation"] is None and len(data.references) == 1
        log.warning(
            "%s has %d frames, fewer than %d: the untrained map of `dejavu learn` is likely better%s",
            *(data.route_name, sum(data.lengths), MIN_FRAMES),
            ", and the trained map is not calibrated without data.validation" * alone,
        )

    def describe(self, frames: Tensor) -> Tensor:
        """Features of frames, (B,C,H,W) -> (B,K)."""
        return self.dejavu.descriptor.describe_all(frames)

    def described(self, frames: Tensor) -> Tensor:
        """Features of stored frames; a backbone that fails on them is refused."""
        try:
            return features_of(frames.to(self.device), self.describe, "the batch")
        except RuntimeError as error:
            seen = f"{type(self.features).__name__} does not accept frames {tuple(frames.shape[1:])}"
            raise InputError(f"{seen}: {one_line(error)[:200]}") from error

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
        seen = f"{type(self.features).__name__} gives NaN or infinite features for {self.data.route_name}"
        expect(features.isfinite().all(), "finite numbers", seen)
        return features

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

    def deployed(self) -> DejaVu:
        """The trained model, whose `save` writes the map file."""
        if self.made and not self.map.places:
            self.relearn()
        model = copy.deepcopy(self.dejavu).eval()
        if self.weight_bits == 8 and round_weights(model.features):
            model.weight_bits = 8
        steps = 0 if self._trainer is None else self.trainer.global_step
        seed = os.environ.get("PL_GLOBAL_SEED")  # set by seed_everything
        model.trained = Training(steps or self.steps, int(seed) if seed else None)
        return model

    # training

    def configure_optimizers(self) -> Any:
        """AdamW, with a learning rate that rises over the first tenth of the steps, then falls along a cosine
        to 0. Only matrices and kernels decay."""
        if not math.isfinite(float(self.trainer.estimated_stepping_batches)):
            raise InputError("the training has no end; expected trainer.max_steps or trainer.max_epochs")
        trained, count, rise = self.trained(), int(self.trainer.estimated_stepping_batches), self._rise()
        groups = [
            {"params": [p for p in trained if p.ndim > 1], "weight_decay": self.weight_decay},
            {"params": [p for p in trained if p.ndim < 2], "weight_decay": 0.0},
        ]
        optimizer = AdamW([group for group in groups if group["params"]], lr=self.lr)

        def height(step: int) -> float:
            if step < rise:
                return (step + 1) / rise
            return 0.5 + 0.5 * math.cos(math.pi * min(1.0, (step - rise) / max(1, count - rise)))

        schedule = {"scheduler": LambdaLR(optimizer, height), "interval": "step"}
        return {"optimizer": optimizer, "lr_scheduler": schedule}

    def _rise(self) -> int:
        """Number of steps in which the learning rate rises."""
        return max(1, round(int(self.trainer.estimated_stepping_batches) / 10))

    def on_train_start(self) -> None:
        """Let each process draw augmentation and noise of its own, from where a training stopped."""
        self._check_places()
        self.data.go_on()
        if self.trainer.world_size > 1:
            torch.manual_seed(torch.initial_seed() + self.global_rank + 1009 * self.global_step)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The weighted sum of the losses of a batch."""
        self.data.seen = batch_idx + 1
        total, parts, left_out = self.losses(batch)
        parts = {name: part.detach() for name, part in parts.items()}
        if not total.isfinite():
            seen = ", ".join(f"{name} {float(part):g}" for name, part in parts.items())
            seen = f"the loss is {float(total)} at step {self.global_step} ({seen})"
            raise InputError(f"{seen}; expected a finite number: try a lower lr, or 32-bit precision")
        if self.global_step >= self._rise() and not self.last.learned:  # all processes decide alike
            mean = partial(self.trainer.strategy.reduce, reduce_op="mean")
            self.last.append({name: mean(part) for name, part in parts.items()})
        several = self.trainer.world_size > 1
        self.log_dict({f"train/{name}": part for name, part in parts.items()}, sync_dist=several)
        self.log("train/left_out", left_out, on_step=False, on_epoch=True, reduce_fx="sum", sync_dist=several)
        self.log("train/loss", total.detach(), prog_bar=True, sync_dist=several)
        return total

    def on_train_batch_end(self, *_: object) -> None:
        """Stop a training that learns nothing, as soon as that is known."""
        self.resumed = False  # the optimizer accepted the checkpoint's state
        if not self.last.learned:
            self.last.check(self.chance())

    def train(self, mode: bool = True) -> RouteTask:
        """As in nn.Module, but frozen modules keep their running statistics."""
        super().train(mode)
        for name in self.frozen:
            self.features.get_submodule(name).eval()
        return self

    # validation and test

    def on_validation_epoch_start(self) -> None:
        """Make the map of the current features."""
        self.resumed = False
        self._check_places()
        if self.made:
            if self.trainer.world_size > 1:  # whose running statistics are their own until the next step
                self.features.load_state_dict(self.trainer.strategy.broadcast(self.features.state_dict()))
            with torch.inference_mode(False):  # since its parameters may be trained later
                self.relearn()

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Localize a batch, in the precision of the exported map."""
        frames = batch.frames if self.trainer.testing else self.data.validated(batch)
        with torch.autocast(self.device.type, enabled=False):
            match = best_match(self(frames))
        index = self.data.apart(self.map.table.scored(match.index))
        truth = batch.truth._replace(positives=self.data.apart(batch.truth.positives))
        self.metric.update(replace(match, index=index), truth)

    def on_validation_epoch_end(self) -> None:
        """Log the scores of `evaluate`; those on the augmented reference get a suffix."""
        figures = self.metric.compute()
        self.metric.reset()
        stage = "test" if self.trainer.testing else "val"
        suffix = "" if self.trainer.testing or "validation" in self.data.sets else "_augmented"
        named = {f"{stage}/{name}{suffix}": value.float() for name, value in figures.items()}
        self.log_dict(named, sync_dist=self.trainer.world_size > 1)

    on_test_epoch_start, test_step = on_validation_epoch_start, validation_step
    on_test_epoch_end = on_validation_epoch_end

    # checkpoints

    def on_save_checkpoint(self, checkpoint: Facts) -> None:
        """Add what was trained on; a map in closed form is not stored."""
        state = checkpoint["state_dict"]
        checkpoint["state_dict"] = {n: one for n, one in state.items() if not n.startswith(self.derived)}
        checkpoint |= {"task": type(self).__name__, "routes": self._routes(), "held": self.held}

    def _routes(self) -> Sequence[object]:
        """Names and lengths of several routes; empty for one, whose path may change."""
        named = [[route.name, n] for route, n in zip(self.data.references, self.data.lengths, strict=True)]
        return named if len(named) > 1 else []

    def on_load_checkpoint(self, checkpoint: Facts) -> None:
        """Refuse a checkpoint of another model or other routes."""
        seen = f"the checkpoint is of a {checkpoint['task']}"
        expect(checkpoint["task"] == type(self).__name__, f"one of a {type(self).__name__}", seen)
        if self._trainer is not None:
            self.resumed = True
            if checkpoint["routes"] != self._routes():
                seen = f"the checkpoint was trained on {checkpoint['routes'] or 'one route'!s:.300}"
                expected = "expected the same routes in the same order"
                raise InputError(f"{seen}, the data is {self.data.route_name}; {expected}")
        own, given = self.state_dict(), checkpoint["state_dict"]
        self.steps, self.held_before = checkpoint["global_step"], checkpoint["held"]
        given |= {name: one for name, one in own.items() if name.startswith(self.derived)}
        shapes, wanted = ({n: getattr(t, "shape", None) for n, t in s.items()} for s in (given, own))
        other = sorted(n for n in {**shapes, **wanted} if shapes.get(n, "") != wanted.get(n, ""))
        if other:
            raise InputError(f"the checkpoint is of another model than the config's: {', '.join(other[:3])}")


def load_weights(task: RouteTask, path: str | Path) -> None:
    """Load a checkpoint into its task, which is prepared for its route."""
    checkpoint = read_checkpoint(path)
    with taking_over(path):
        task.on_load_checkpoint(checkpoint)
        task.load_state_dict(checkpoint["state_dict"])
    task.resumed = False


def check_preprocess(preprocess: Preprocess | None) -> None:
    """Refuse a range, for which frames that are stored as bytes are too coarse."""
    if preprocess is not None and preprocess.range is not None:
        seen = f"preprocess.range {preprocess.range} in training, which keeps frames as 8 bits"
        raise InputError(f"{seen}; expected frames that use the values from 0 to 1")


def trainable(module: nn.Module) -> list[nn.Parameter]:
    """The parameters that are not frozen."""
    return [parameter for parameter in module.parameters() if parameter.requires_grad]


def coded(features: nn.Module) -> Embedding | None:
    """The features if they are an `Embedding` whose code is learned from a whitened descriptor."""
    return features if isinstance(features, Embedding) and features.coder is not None else None


def start_from(backbone: nn.Module, path: str | Path) -> None:
    """Load the weights of a map file into a backbone, or into the network of an `Embedding`."""
    prefix = "features."
    with opened(Path(path)) as (tensors, header):
        stored = unpacked(tensors, prefix)
        check_types(stored, backbone)
    weights = {name.removeprefix(prefix): t for name, t in stored.items() if name.startswith(prefix)}
    if isinstance(backbone, Embedding):
        own, prefix = backbone.state_dict(), "network."
        bare = not any(name.startswith(prefix) for name in weights)  # of the network itself
        weights = {f"{prefix}{name}": t for name, t in weights.items()} if bare else weights
        if bare or backbone.coder is not None:  # the rest is learned anew
            network = {name: t for name, t in weights.items() if name.startswith(prefix)}
            weights = {name: t for name, t in own.items() if not name.startswith(prefix)} | network
    try:
        backbone.load_state_dict(weights)
    except RuntimeError as error:
        seen = f"{path} holds weights of {header['features']._asdict()}"
        raise InputError(f"{seen}; expected those of the same {type(backbone).__name__}") from error


def freeze_parts(
    backbone: nn.Module, prefixes: Sequence[str], batch_norm: Literal["train", "frozen"]
) -> set[str]:
    """Freeze parameters; return the names of the modules that keep their running statistics."""
    named = dict(backbone.named_parameters())
    for prefix in prefixes:
        chosen = [p for name, p in named.items() if name.startswith(prefix)]
        known = ", ".join(sorted({name.partition(".")[0] for name in named}))
        seen = f"freeze has {prefix!r}, but no parameter of {type(backbone).__name__} begins with it"
        expect(chosen, f"one of {known or 'none, it has none'}", seen)
        for parameter in chosen:
            parameter.requires_grad_(False)
    return {
        name
        for name, module in backbone.named_modules()
        if getattr(module, "running_mean", None) is not None  # follows the batches without any gradient
        and (batch_norm == "frozen" or any(f"{name}.".startswith(prefix) for prefix in prefixes))
    }
