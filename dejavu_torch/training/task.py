"""Training the whole method: the backbone together with a template map, or the descriptors of another map."""

from __future__ import annotations

import copy
import logging
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import pytorch_lightning as pl
import torch
from lightning_fabric.plugins.io.torch_io import TorchCheckpointIO
from torch import Tensor, nn
from torch.optim import AdamW
from torch.optim.lr_scheduler import LambdaLR

from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.features.extract import features_of
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.whitening import STRENGTHS, Whitening
from dejavu_torch.maps.place_map import Mapper
from dejavu_torch.maps.template_map import TemplateMap, TemplateMapper
from dejavu_torch.maps.weights import BITS, in_bits, round_weights, unpacked
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import check_types, opened
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.recognition.select import best_match
from dejavu_torch.training.checkpoint import EXPECTED, CheckpointFiles, read_checkpoint, taking_over
from dejavu_torch.training.datamodule import MIN_FRAMES, Batch
from dejavu_torch.training.losses import LastLosses, NothingLearned, Objective
from dejavu_torch.training.metrics import PlaceRecognition
from dejavu_torch.training.processes import average_gradients, averaged, share
from dejavu_torch.training.stages import CodeStage, DescriptorStage, RateStage, Stage, stages_of, unwhitened
from dejavu_torch.training.trainee import Trainee, coded
from dejavu_torch.types import InputError, Training

log = logging.getLogger("dejavu_torch")

TEMPERATURE = 0.03  # of `log_posterior` at the start
DESCRIPTOR = 0.4  # share of the steps for a descriptor that gets a code
MAP, WHITENING = "dejavu.map.", "dejavu.whitening."  # prefixes of tensor names in a checkpoint


class PlaceRecognitionTask(Trainee):
    """A `DejaVu` model in training, whose features learn to repeat with the periods of its layers.

    The templates of the map start as the phase means of the untrained features (eq. 1) and are trained.
    Periods get no gradient: they are imposed, or found again every few epochs. For an `Embedding` with a
    hidden layer the descriptor is trained first, then its code, see `stages_of`.

    Any other map, such as a spectral one, is not trained: all steps train the descriptor, without the code of
    an `Embedding`, and the map is made from it in closed form.

    Args:
        backbone: nn.Module (B,C,H,W) -> (B,D); None is `SmallCNN()`.
        mapper: makes the map; None is `TemplateMapper(ImposedPeriods())`. The trained temperature starts at
            the mapper's, or at 0.03 if that is None.
        whitening: of the descriptor, for maps made from it. It learns from views under the training's
            augmentation and of the second traverse; its `strengths` are not used. None and "none" are as in
            `DejaVu`, but with a `rate` None is "none", since whitening would mix the features.
        preprocess: as in `DejaVu`.
        feature_weights: learn a weight of at least 0 for each feature; for template maps only, as are
            `descriptor`, `refresh` and `losses`.
        descriptor: share of the steps in which an `Embedding` with a hidden layer learns its descriptor.
        start: a map file of the same backbone with the weights to start from.
        freeze: prefixes of names of parameters that are not trained and keep their running statistics; "" is
            the whole backbone.
        batch_norm: "train" lets BatchNorm follow the batches; "frozen" keeps its running statistics, which
            is better for pretrained networks and few frames.
        refresh: epochs after which layers are found again and templates restart as phase means; 0 never.
        losses: the weights of the losses.
        rate: weight of a bit per place of the map relative to the cross-entropy of the place, in nats. For
            maps made from the descriptor, which then has few frequencies, see `coded_proxies`.
        lr: highest learning rate of AdamW; it rises over the first tenth of a stage's steps and falls to 0.
        weight_decay: of matrices and kernels only, not of biases or templates.
        batch_size: frames in memory at a time when features are computed without gradients.
        weight_bits: of each weight of the backbone in the map file, 8 or 32, as in `DejaVu`. Training and
            checkpoints use 32; maps made from a descriptor, validation and test use the rounded weights.

    Convention: `EarlyStopping`, a `ModelCheckpoint` with `monitor`, and validation begin with the last stage,
        since figures of two stages are not comparable.

    Raises:
        InputError: settings out of range; a backbone that does not give (B,D); a loss that is not finite; a
            checkpoint with other settings.
        NothingLearned: an InputError; the mean loss over 100 steps after the rise of the learning rate, or
            over the last 100 of a stage, is at chance.
    """

    def __init__(
        self,
        backbone: nn.Module | None = None,
        mapper: Mapper | None = None,
        whitening: Whitening | Literal["none"] | None = None,
        preprocess: Preprocess | None = None,
        feature_weights: bool = False,
        descriptor: float = DESCRIPTOR,
        start: str | None = None,
        freeze: list[str] | None = None,
        batch_norm: Literal["train", "frozen"] = "train",
        refresh: int = 0,
        losses: Objective | None = None,
        rate: float = 0.0,
        lr: float = 3e-3,
        weight_decay: float = 0.05,
        batch_size: int = 64,
        weight_bits: Literal[8, 32] = 8,
    ) -> None:
        backbone = SmallCNN() if backbone is None else backbone
        mapper = TemplateMapper(ImposedPeriods()) if mapper is None else mapper
        made = not isinstance(mapper, TemplateMapper)
        learned = isinstance(whitening, Whitening)
        strengths = whitening.strengths if isinstance(whitening, Whitening) else STRENGTHS
        none = f"none, since it has no effect on the map of a {type(mapper).__name__}"
        for name, value, fits, expected in (
            ("lr", lr, lr > 0, "a number above 0"),
            ("weight_decay", weight_decay, weight_decay >= 0, "0 or more"),
            ("refresh", refresh, refresh >= 0, "0 or more"),
            ("rate", rate, 0 <= rate < math.inf, "0 or more, such as 1"),
            ("descriptor", descriptor, 0 <= descriptor < 1, "a share of the steps, from 0 to below 1"),
            ("weight_bits", weight_bits, weight_bits in BITS, f"one of {', '.join(map(str, BITS))}"),
            ("whitening", whitening, made or not learned, none),
            ("rate", rate, made or not rate, none),
            ("feature_weights", feature_weights, not (made and feature_weights), none),
            ("descriptor", descriptor, not made or descriptor == DESCRIPTOR, none),
            ("refresh", refresh, not (made and refresh), none),
            ("losses", losses, not made or losses is None, none),
            ("whitening.strengths", strengths, strengths == STRENGTHS, "those of data.augmentation alone"),
        ):
            if not fits:
                raise InputError(f"{name} is {value!r}; expected {expected}")
        if made and (embedding := coded(backbone)):
            backbone = embedding.without_code()
        whitening = "none" if whitening is None and rate else whitening
        if preprocess is not None and preprocess.range is not None:
            seen = f"preprocess.range {preprocess.range} in training, which keeps frames as 8 bits"
            raise InputError(f"{seen}; expected frames that use the values from 0 to 1")
        model = DejaVu(backbone, whitening, mapper, batch_size=batch_size, preprocess=preprocess)
        super().__init__(model, made, feature_weights, weight_bits)
        if start is not None:
            start_from(backbone, start)
        self.frozen = freeze_parts(backbone, freeze or [], batch_norm)
        self.train()
        self.log_temperature = nn.Parameter(
            torch.tensor(math.log(getattr(mapper, "temperature", None) or TEMPERATURE))
        )
        self.losses = Objective() if losses is None else losses
        self.refresh, self.lr, self.weight_decay = refresh, lr, weight_decay
        self.stages = nn.ModuleList(stages_of(backbone, descriptor, made, rate))
        self.index, self.began = 0, 0  # the stage, and its first step
        self.last = LastLosses()  # of the stage
        self.metric = PlaceRecognition(0)  # `setup` sets the tolerance
        # from a checkpoint
        self.steps = 0
        self.resumed = False  # until the first step or validation
        self.held_before: list[int] | None = None  # its held-out segments
        self.routes: list[Any] | None = None  # until they are compared with the data's
        self._callbacks: list[pl.Callback] = []

    @property
    def stage(self) -> Stage:
        """The current stage."""
        return cast(Stage, self.stages[self.index])

    @property
    def in_last_stage(self) -> bool:
        """Whether this stage trains the map, or the descriptors from which it is made."""
        return self.index == len(self.stages) - 1

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
        """Prepare for a route, with `CheckpointFiles` unless the trainer has another plugin for checkpoints.
        The first map is made later, unless it comes from a checkpoint."""
        if type(self.trainer.strategy.checkpoint_io) is TorchCheckpointIO:
            self.trainer.strategy.checkpoint_io = CheckpointFiles()
        data, model, frames = self.data, self.dejavu, self.data.sets["reference"]
        ready = frames.values.ndim == 2
        if isinstance(model.features, SmallCNN) and not ready:
            model.features.follow(model.preprocess(frames[[0]].frames).shape[1])
        share(self, self.trainer)
        self.metric = PlaceRecognition(data.tolerance)
        model.velocity = data.velocity
        self._check_routes()
        if stage == "fit" and sum(data.lengths) < MIN_FRAMES:
            self._say_few()
        if ready and self.made:
            kind = type(model.mapper).__name__
            seen = f"{data.reference.name} holds ready features, but the map of a {kind} is not trained"
            raise InputError(f"{seen}; expected frames, or `dejavu learn`")
        if isinstance(self.stage, RateStage) and len(data.routes) > 1:
            seen = f"model.rate is {self.stage.rate}, for the bits of one map, and there are "
            raise InputError(f"{seen}{len(data.routes)} routes; expected model.rate 0, or one route")
        whitened = model.whitening if self.made else unwhitened(model.features)
        if whitened is not None and not data.augmentation.acts and data.sources["second"] is None:
            seen = "data.augmentation changes nothing, so the whitening has nothing to learn from"
            other = ", or model.whitening none" * self.made
            raise InputError(f"{seen}; expected an augmentation, or data.second{other}")
        if ready and list(model.features.parameters()):
            log.warning("the source holds ready features: the backbone is not used")
            model.features, self.frozen = HOG(), set()  # has no weights to store
            self.stages, self.index = nn.ModuleList([CodeStage()]), 0
        # another training computes these again
        self.began, self.views, self._descriptors, self.last = 0, None, None, LastLosses()

    def _say_few(self) -> None:
        data = self.data
        source = data.sources["source"]
        alone = data.sources["validation"] is None and len(data.routes) == 1
        log.warning(
            "%s has %d frames, fewer than %d: the untrained map of `dejavu learn` is likely better%s",
            *(source if isinstance(source, (str, Path)) else data.route_name, sum(data.lengths), MIN_FRAMES),
            ", and the trained map is not calibrated without data.validation" * alone,
        )

    def forward(self, frames: Tensor) -> Tensor:
        """Scores of all places, equal to those of the exported map. (B,C,H,W) or (B,D) -> (B,N)."""
        with in_bits(self.features, self.weight_bits):
            features = features_of(frames, self.dejavu.descriptor.describe, "the batch")
        if self.made:
            return self.map.scores(self.dejavu.descriptor.whitened(features))
        return self.scores(self.route.distances(features))

    def deployed(self) -> DejaVu:
        """The trained model, whose `save` writes the map file; an InputError before the last stage."""
        self.require_map()
        if self.made and not self.map.places:
            self.relearn()
        model = copy.deepcopy(self.dejavu).eval()
        if self.weight_bits == 8 and round_weights(model.features):
            model.weight_bits = 8
        if self.made and len(self.data.routes) > 1:
            model = DejaVu(**(model.settings() | {"velocity": None})).train(model.training)
        if not self.made:
            route, mapper = cast(TemplateMap, model.map), cast(TemplateMapper, model.mapper)
            route.freeze()
            route.temperature = mapper.temperature = float(self.log_temperature.detach().exp())
            mapper.trainable = False
        steps = 0 if self._trainer is None else self.trainer.global_step
        seed = os.environ.get("PL_GLOBAL_SEED")  # set by seed_everything
        model.trained = Training(steps or self.steps, int(seed) if seed else None)
        return model

    def require_map(self) -> None:
        """Refuse a stage without a map."""
        if not self.in_last_stage:
            stage = f"stage {self.index + 1} of {len(self.stages)}, {type(self.stage).__name__}"
            raise InputError(f"the training is in {stage}, which has no map yet; expected the last stage")

    # training

    def configure_optimizers(self) -> Any:
        """Begin the stage, or the next one if it has no steps: AdamW, with a learning rate that rises over
        the first tenth of the steps, then falls along a cosine to 0. Only matrices and kernels decay."""
        if not math.isfinite(float(self.trainer.estimated_stepping_batches)):
            raise InputError("the training has no end; expected trainer.max_steps or trainer.max_epochs")
        if self.stop() <= self.began and not self.in_last_stage:
            self._advance(self.began)
        self.stage.begin(self)
        trained, count, rise = self.stage.trained(self), self.stop() - self.began, self._rise()
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

    def stop(self) -> int:
        """The step at which the stage ends."""
        steps = int(self.trainer.estimated_stepping_batches)
        if self.in_last_stage:
            return steps
        return min(self.began + round(cast(DescriptorStage, self.stage).share * steps), steps - 1)

    def _rise(self) -> int:
        """Number of steps in which the learning rate rises."""
        return max(1, round((self.stop() - self.began) / 10))

    def _advance(self, step: int) -> None:
        self._check_learned()
        cast(DescriptorStage, self.stage).end()
        self.zero_grad()
        self.index, self.began, self.last = self.index + 1, step, LastLosses()

    def _check_learned(self) -> None:
        """Refuse a training that learned nothing."""
        try:
            self.last.check(self.stage.chance(self))
        except NothingLearned as error:
            if self.made:
                raise
            cure = "BatchNorm1d(D, affine=False) at the end of the backbone, or a SpectralMapper"
            seen = f"{error}; templates need features of equal scale"
            raise NothingLearned(f"{seen}: expected {cure}") from error

    on_train_end = _check_learned

    def on_fit_start(self) -> None:
        """Remove callbacks that monitor a figure until the last stage."""
        self._callbacks = self.trainer.callbacks  # type: ignore[attr-defined]
        if not self.in_last_stage:
            others = [one for one in self._callbacks if getattr(one, "monitor", None) is None]
            self.trainer.callbacks = others  # type: ignore[attr-defined]

    def teardown(self, stage: str) -> None:
        """Restore the callbacks of the trainer."""
        if self._callbacks:
            self.trainer.callbacks, self._callbacks = self._callbacks, []  # type: ignore[attr-defined]

    def on_train_start(self) -> None:
        """Refuse a checkpoint whose loops are at another step than its weights."""
        if self.resumed and self.global_step != self.steps:
            seen = f"the checkpoint is of step {self.steps}, but its loops are at {self.global_step}"
            raise InputError(f"{seen}; {EXPECTED}")

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Drop the map of the previous features; begin the next stage after the last step of this one."""
        if self.made and self.map.places:
            self.dejavu.load_state_dict(self._unmade(), strict=False)
        if not self.in_last_stage and self.global_step >= self.stop():
            self._advance(self.global_step)
            self.trainer.strategy.setup_optimizers(self.trainer)
            if self.in_last_stage:
                self.trainer.callbacks = self._callbacks

    def on_train_epoch_start(self) -> None:
        """Find the layers again every `refresh` epochs."""
        due = self.refresh and self.current_epoch and self.current_epoch % self.refresh == 0
        if due and self.in_last_stage:
            before = self.route
            self.relearn()
            optimizer, new = self.trainer.optimizers[0], dict(self.route.named_parameters())
            for name, old in before.named_parameters():  # replaced, without optimizer state
                for group in optimizer.param_groups:
                    group["params"] = [new[name] if one is old else one for one in group["params"]]
                optimizer.state.pop(old, None)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The weighted sum of the losses of a batch."""
        total, parts, left_out = self.stage.losses(self, batch)
        figures = averaged(torch.stack([total, *parts.values()]).detach())
        parts = dict(zip(parts, figures[1:], strict=True))
        if not figures[0].isfinite():
            seen = ", ".join(f"{name} {float(part):g}" for name, part in parts.items())
            seen = f"the loss is {float(figures[0])} at step {self.global_step} ({seen})"
            raise InputError(f"{seen}; expected a finite number: try a lower lr, or 32-bit precision")
        if self.global_step - self.began >= self._rise():
            self.last.append(parts)
        self.log_dict({f"train/{name}": part for name, part in parts.items()})
        several = self.trainer.world_size > 1
        self.log("train/left_out", left_out, on_step=False, on_epoch=True, reduce_fx="sum", sync_dist=several)
        self.log("train/loss", figures[0], prog_bar=True)
        return total

    def on_train_batch_end(self, *_: Any) -> None:
        """Stop a training that learns nothing, as soon as that is known."""
        self.resumed = False  # the optimizer accepted the checkpoint's state
        if not self.last.learned:
            self._check_learned()

    def on_after_backward(self) -> None:
        """Average the gradients of all processes, before scaling and clipping."""
        average_gradients(self.trainer.optimizers, self.features)

    def train(self, mode: bool = True) -> PlaceRecognitionTask:
        """As in nn.Module, but frozen modules keep their running statistics."""
        super().train(mode)
        for name in self.frozen:
            self.features.get_submodule(name).eval()
        return self

    # validation and test

    def on_validation_epoch_start(self) -> None:
        """Make the map of the current features, if there is none yet."""
        self.resumed = False
        if self.trainer.state.fn != "fit":
            self.require_map()
        if self.in_last_stage and not self.map.places:
            with torch.inference_mode(False):  # since its parameters may be trained later
                self.relearn()

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Localize a batch, in the precision of the exported map."""
        if self.in_last_stage:
            frames = batch.frames if self.trainer.testing else self.data.validated(batch)
            with torch.autocast(self.device.type, enabled=False):
                match = best_match(self(frames))
            index = self.data.apart(self.map.table.scored(match.index))
            truth = batch.truth._replace(positives=self.data.apart(batch.truth.positives))
            self.metric.update(replace(match, index=index), truth)

    def on_validation_epoch_end(self) -> None:
        """Log the scores of `evaluate`; those on the augmented reference get a suffix."""
        if self.in_last_stage:
            figures = self.metric.compute()
            self.metric.reset()
            stage = "test" if self.trainer.testing else "val"
            suffix = "" if self.trainer.testing or "validation" in self.data.sets else "_augmented"
            named = {f"{stage}/{name}{suffix}": value.float() for name, value in figures.items()}
            self.log_dict(named, sync_dist=self.trainer.world_size > 1)

    on_test_epoch_start, test_step = on_validation_epoch_start, validation_step
    on_test_epoch_end = on_validation_epoch_end

    # checkpoints

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]
        cls, checkpoint_path: str | Path, *, weights_only: bool = True, **settings: Any
    ) -> PlaceRecognitionTask:
        """A task with the weights of a checkpoint and the constructor's `settings`, as in the training.
        Unlike Lightning's method, it imports no class named in the file; `weights_only` is always true."""
        task = cls(**settings)
        load_weights(task, checkpoint_path)
        return task

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the stage, the trained parameters and the routes; a map in closed form is not stored."""
        checkpoint |= {"stages": self._stages(), "stage": self.index, "began": self.began}
        checkpoint |= {"trained": self._trained(), "routes": self._routes(), "held": self.held}
        if self.made:
            checkpoint["state_dict"] |= {f"dejavu.{name}": value for name, value in self._unmade().items()}

    def _unmade(self) -> dict[str, Any]:
        """The state of a model without a map and without a learned whitening."""
        whitening = None if self.dejavu.whitening is None else Whitening()
        return DejaVu(nn.Identity(), whitening or "none", self.dejavu.mapper).state_dict()

    def _stages(self) -> list[str]:
        return [type(stage).__name__ for stage in self.stages]

    def _trained(self) -> list[str]:
        trained = {id(parameter) for parameter in self.stage.trained(self)}
        return sorted(name for name, parameter in self.named_parameters() if id(parameter) in trained)

    def _routes(self) -> list[Any]:
        """Names and lengths of several routes; empty for one, whose path may change."""
        named = [[route.name, n] for route, n in zip(self.data.routes, self.data.lengths, strict=True)]
        return named if len(named) > 1 else []

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of other settings or another route; take over its layers."""
        if checkpoint["stages"] != self._stages():
            seen = f"the checkpoint is of the stages {checkpoint['stages']}"
            raise InputError(f"{seen}; expected one of {self._stages()}")
        own = {name for name, _ in self.named_parameters()}  # buffers of a backbone may hold any value
        for name, value in checkpoint["state_dict"].items():
            checked = name in own or name.startswith((MAP, WHITENING))
            if checked and isinstance(value, Tensor) and not value.isfinite().all():
                raise InputError(f"{name} of the checkpoint has NaN or infinity; expected finite numbers")
        if self._trainer is not None:
            self.resumed = True
            if self.trainer.state.fn != "fit":
                checkpoint.pop("loops", None)  # no training continues
        self.routes, self.held_before = checkpoint["routes"], checkpoint["held"]
        if not self.made:
            self._take_templates(checkpoint["state_dict"])
        self._check_routes()
        self.index, self.began = checkpoint["stage"], checkpoint["began"]
        self.steps = checkpoint["global_step"]
        if other := sorted(set(self._trained()) ^ set(checkpoint["trained"])):
            seen = f"{', '.join(other[:3])}: trained in either the checkpoint or this run, but not in both"
            raise InputError(f"{seen}; expected a checkpoint of the same settings")

    def _take_templates(self, state: dict[str, Any]) -> None:
        mapper = cast(TemplateMapper, self.dejavu.mapper)
        route, periods = mapper.empty(), mapper.periods
        route.load_state_dict({n.removeprefix(MAP): t for n, t in state.items() if n.startswith(MAP)})
        if route.places and isinstance(periods, ImposedPeriods):
            imposed = periods.plan(torch.zeros(1, 1).expand(route.places, route.dimension))
            if imposed != route.plan:
                held, wanted = (
                    ", ".join(f"{layer.phases} in {layer.period}" for layer in plan) or "no"
                    for plan in (route.plan, imposed)
                )
                seen = f"the checkpoint has layers of {held} frames, but this run imposes {wanted}"
                raise InputError(f"{seen}; expected the same periods")
        route.trainable(True, self.feature_weights)
        self.dejavu.map = route.to(self.device)

    def _check_routes(self) -> None:
        """Refuse a map or a checkpoint of other routes than the data's, if there are data."""
        if self._trainer is None:
            return
        places, count = self.map.places, len(self.data.sets["reference"])
        if places not in (0, count):
            seen = f"the map has {places} places, {self.data.reference.name} has {count}"
            raise InputError(f"{seen}; expected the route that the map was made of")
        if self.routes not in (None, self._routes()):
            seen = f"the checkpoint was trained on {self.routes or 'one route'!s:.300}"
            expected = "expected the same routes in the same order"
            raise InputError(f"{seen}, the data is {self.data.route_name}; {expected}")
        self.routes = None


def load_weights(task: PlaceRecognitionTask, path: str | Path) -> None:
    """Load a checkpoint into its task."""
    checkpoint = read_checkpoint(path)
    with taking_over(path):
        task.on_load_checkpoint(checkpoint)
        task.load_state_dict(checkpoint["state_dict"])
    task.resumed = False


def start_from(backbone: nn.Module, path: str | Path) -> None:
    """Load the weights of a map file into a backbone, except the code of a whitened descriptor."""
    prefix = "features."
    with opened(Path(path)) as (tensors, header):
        stored = unpacked(tensors, prefix)
        check_types(stored, backbone)
    weights = {name.removeprefix(prefix): t for name, t in stored.items() if name.startswith(prefix)}
    own = backbone.state_dict()
    code = ("linear.layers.", "standardise.") if weights.get("linear.whitened", False) else ()
    bare = any(all(name.startswith("network.") for name in one) for one in (weights, own))
    if bare and isinstance(backbone, Embedding):
        code = ("linear.", "standardise.")
    weights = {name: t for name, t in weights.items() if not name.startswith(code)}
    weights |= {name: t for name, t in own.items() if name.startswith(code)}
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
        if not chosen:
            known = ", ".join(sorted({name.partition(".")[0] for name in named}))
            seen = f"freeze has {prefix!r}, but no parameter of {type(backbone).__name__} begins with it"
            raise InputError(f"{seen}; expected one of {known or 'none, it has none'}")
        for parameter in chosen:
            parameter.requires_grad_(False)
    return {
        name
        for name, module in backbone.named_modules()
        if getattr(module, "running_mean", None) is not None  # follows the batches without any gradient
        and (batch_norm == "frozen" or any(f"{name}.".startswith(prefix) for prefix in prefixes))
    }
