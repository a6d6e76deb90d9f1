"""Training the whole method end to end: the backbone, and with it the map, or what the map is made of."""

from __future__ import annotations

import copy
import logging
import math
import os
from collections.abc import Sequence
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
from dejavu_torch.features.extract import features_of, in_mode
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.whitening import STRENGTHS, Whitening
from dejavu_torch.maps.place_map import Mapper, PlaceMap
from dejavu_torch.maps.template_map import TemplateMap, TemplateMapper, log_posterior
from dejavu_torch.maps.weights import BITS, in_bits, round_weights, unpacked
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import check_types, opened
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.recognition.select import best_match
from dejavu_torch.training.checkpoint import EXPECTED, CheckpointFiles, read_checkpoint, taking_over
from dejavu_torch.training.datamodule import FEW, Batch, RouteData, as_frames
from dejavu_torch.training.losses import LastLosses, Objective
from dejavu_torch.training.metrics import PlaceRecognition
from dejavu_torch.training.processes import average_gradients, averaged, share
from dejavu_torch.training.stages import (
    CodeStage,
    RateStage,
    Stage,
    Views,
    has_descriptor,
    make_map,
    place_descriptors,
    stages_of,
    stored_features,
    whitens,
)
from dejavu_torch.types import InputError, Training

log = logging.getLogger("dejavu_torch")

TEMPERATURE = 0.03  # of `log_posterior` at the start
DESCRIPTOR = 0.4  # of the steps of a training whose descriptor gets a code
MAP = "dejavu.map."  # ahead of the names of the map's tensors in a checkpoint
WHITENING = "dejavu.whitening."


class PlaceRecognitionTask(pl.LightningModule):
    """A `DejaVu` model in training: its features learn to repeat with the periods of its layers.

    The templates of the map start as the phase means of the untrained features (eq. 1) and then are
    parameters. Periods never get a gradient: they are imposed, or found anew every few epochs. Of an
    `Embedding` with a hidden layer the descriptor is trained first, then its code, see `stages_of`.

    Any other map, such as a spectral one, is not trained: all steps train the descriptor, without the code of
    an `Embedding`, and the map is made of it in closed form.

    Args:
        backbone: nn.Module (B,C,H,W) -> (B,D); None is `SmallCNN()`.
        mapper: makes the map; its temperature is where that of templates starts, 0.03 if it is None. None is
            `TemplateMapper(ImposedPeriods())`.
        whitening: of the descriptor, if the map is made of it. It learns from views under the training's
            augmentation and of the second traverse; its `strengths` are not used. None and "none" are as in
            `DejaVu`, but None is "none" with a `rate`: whitening would mix the features.
        preprocess: as in `DejaVu`.
        feature_weights: learn a weight of each feature, at least 0; of templates, as the next and
            `refresh` and `losses`.
        descriptor: share of the steps in which an `Embedding` with a hidden layer learns its descriptor.
        start: a map file of the same backbone, whose weights to start from.
        freeze: beginnings of names of parameters that stay as they are, with their running statistics; "" is
            all of the backbone.
        batch_norm: "train" lets BatchNorm follow the batches; "frozen" keeps its running statistics, as
            pretrained networks and few frames want.
        refresh: epochs after which layers are found anew and templates restart as phase means; 0 never.
        losses: which losses count, and how much.
        rate: weight of a bit per place of the map beside the cross-entropy of the place, in nats; of maps
            made of the descriptor, which then consists of few frequencies, see `coded_proxies`.
        lr: highest learning rate of AdamW; it rises over the first tenth of a stage's steps and falls to 0.
        weight_decay: of weights that are multiplied with something, not of biases, templates and the like.
        batch_size: frames in memory at a time if features are made without gradients.
        weight_bits: of each weight of the backbone in the map file, 8 or 32, as of `DejaVu`. Training and
            checkpoints have 32; a map that is made of a descriptor, validation and test see rounded ones.

    Convention: `EarlyStopping`, a `ModelCheckpoint` with `monitor`, and validation begin with the last stage:
        figures of two stages do not compare.

    Raises:
        InputError: settings out of range; a backbone that gives no (B,D); a loss that is not finite; a
            checkpoint of other settings.
        NothingLearned: an InputError; the mean loss of 100 steps after the rise of the learning rate, or of
            the last 100 of a stage, is that of a guess.
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
        super().__init__()
        given = {
            "lr": (lr, lr > 0, "a number above 0"),
            "weight_decay": (weight_decay, weight_decay >= 0, "0 or more"),
            "refresh": (refresh, refresh >= 0, "0 or more"),
            "rate": (rate, 0 <= rate < math.inf, "0 or more, such as 1"),
            "descriptor": (descriptor, 0 <= descriptor < 1, "a share of the steps, from 0 to below 1"),
            "weight_bits": (weight_bits, weight_bits in BITS, f"one of {', '.join(map(str, BITS))}"),
        }
        for name, (value, fits, expected) in given.items():
            if not fits:
                raise InputError(f"{name} is {value!r}; expected {expected}")
        backbone = SmallCNN() if backbone is None else backbone
        mapper = TemplateMapper(ImposedPeriods()) if mapper is None else mapper
        self.made = not isinstance(mapper, TemplateMapper)
        idle = {"whitening": isinstance(whitening, Whitening), "rate": rate > 0}
        if self.made:
            idle = {"feature_weights": feature_weights, "descriptor": descriptor != DESCRIPTOR}
            idle |= {"refresh": refresh > 0, "losses": losses is not None}
        for name in (name for name, is_given in idle.items() if is_given):
            raise InputError(
                f"{name} is given, which does nothing for the map of a {type(mapper).__name__}; expected "
                "another mapper, or none of it"
            )
        if isinstance(whitening, Whitening) and whitening.strengths != STRENGTHS:
            raise InputError(
                "whitening.strengths is given, which does nothing in a training; expected the strengths of "
                "data.augmentation"
            )
        if self.made and isinstance(backbone, Embedding) and has_descriptor(backbone):
            backbone = backbone.without_code()
        whitening = "none" if whitening is None and rate else whitening
        self.dejavu = DejaVu(backbone, whitening, mapper, batch_size=batch_size, preprocess=preprocess)
        if start is not None:
            start_from(backbone, start)
        self.frozen = freeze_parts(backbone, freeze or [], batch_norm)
        self.train()
        temperature = mapper.temperature if isinstance(mapper, TemplateMapper) else None
        self.log_temperature = nn.Parameter(torch.tensor(math.log(temperature or TEMPERATURE)))
        self.feature_weights, self.refresh = feature_weights, refresh
        self.losses = Objective() if losses is None else losses
        self.lr, self.weight_decay, self.weight_bits = lr, weight_decay, weight_bits
        self.gives_way = False  # whether bytes per place that a short route cannot meet are raised
        self.stages = nn.ModuleList(stages_of(backbone, descriptor, self.made, rate))
        self.index, self.began = 0, 0  # the stage, and the step at which it began
        self.last = LastLosses()  # of the stage
        self.views: Views | None = None  # what the code of a whitened descriptor is learned from
        self.places: Tensor | None = None  # its descriptors of the reference
        self.metric: PlaceRecognition | None = None  # `setup` makes it
        self.steps = 0  # of the training that a checkpoint comes from
        self.resumed = False  # whether a checkpoint is being taken over
        self.held_before: list[int] | None = None  # stretches, of the training that a checkpoint comes from
        self.routes: list[Any] | None = None  # of a checkpoint that is not compared with the data's yet
        self._callbacks: list[pl.Callback] = []

    @property
    def data(self) -> RouteData:
        """The data module that the trainer runs with."""
        data = getattr(self._trainer, "datamodule", None)
        if not isinstance(data, RouteData):
            raise InputError(f"the trainer's data module is {type(data).__name__}; expected RouteData")
        return data

    @property
    def map(self) -> PlaceMap:
        """The map of the present features; empty where it is still to be made."""
        return self.dejavu.map

    @property
    def route(self) -> TemplateMap:
        """The map in training."""
        return cast(TemplateMap, self.dejavu.map)

    @property
    def stage(self) -> Stage:
        """The stage that runs."""
        return cast(Stage, self.stages[self.index])

    @property
    def in_last_stage(self) -> bool:
        """Whether this is the stage that trains the map, or what it is made of."""
        return self.index == len(self.stages) - 1

    @property
    def frame_size(self) -> tuple[int, int] | None:
        """(height, width) to which the backbone resizes frames, so that they may be stored in it; None if it
        does not, or a contrast is evened before, at the frames' own size."""
        return None if self.dejavu.preprocess.contrast else getattr(self.dejavu.features, "resize", None)

    @property
    def held(self) -> list[int]:
        """The first places of the stretches that no step has seen, nor one of the checkpoint's training."""
        before = self.held_before
        return [start for start in self.data.held if before is None or start in before]

    def setup(self, stage: str) -> None:
        """Get ready for a route; the first map is made later, where no checkpoint brings one.

        Convention: checkpoints are `CheckpointFiles`, unless the trainer was given another plugin for them.
        """
        if type(self.trainer.strategy.checkpoint_io) is TorchCheckpointIO:
            self.trainer.strategy.checkpoint_io = CheckpointFiles()
        values = self.data.sets["reference"].values
        if isinstance(self.dejavu.features, SmallCNN) and values.ndim == 4:
            self.dejavu.features.follow(self.dejavu.preprocess(as_frames(values[:1])).shape[1])
        share(self, self.trainer)
        self.metric = PlaceRecognition(self.data.tolerance)
        self.dejavu.velocity = self.data.velocity
        self._check_route(self.dejavu.map.places)
        self._check_routes()
        if stage == "fit" and sum(self.data.lengths) < FEW:
            self._say_few()
        if values.ndim == 2 and self.made:
            raise InputError(
                f"{self.data.reference.name} holds ready features, and the map of a "
                f"{type(self.dejavu.mapper).__name__} is not trained; expected frames, or `dejavu learn`"
            )
        if isinstance(self.stage, RateStage) and len(self.data.routes) > 1:
            raise InputError(
                f"model.rate is {self.stage.rate} and there are {len(self.data.routes)} routes: its bits are "
                "those of the map of one route; expected model.rate 0, or one route"
            )
        still = not self.data.augmentation.acts and self.data.sources["second"] is None
        whitened = self.dejavu.whitening is not None if self.made else whitens(self.dejavu.features)
        if still and whitened:
            raise InputError(
                "data.augmentation changes nothing and there is no data.second: nothing shows the whitening "
                f"what two visits differ in; expected one of them{', or model.whitening none' * self.made}"
            )
        if values.ndim == 2 and list(self.dejavu.features.parameters()):
            log.warning("these are ready features: the backbone is left out")
            self.dejavu.features, self.frozen = HOG(), set()  # has nothing to store
            self.stages, self.index = nn.ModuleList([CodeStage()]), 0
        # a further training describes its own frames
        self.began, self.views, self.places = 0, None, None
        self.last = LastLosses()

    def _say_few(self) -> None:
        source = self.data.sources["source"]
        alone = self.data.sources["validation"] is None and len(self.data.routes) == 1
        name = source if isinstance(source, (str, Path)) else self.data.route_name
        log.warning(
            "%s has %d frames, below %d: the untrained map that `dejavu learn` makes is likely better%s",
            *(name, sum(self.data.lengths), FEW),
            ", and the trained map is not calibrated without data.validation" * alone,
        )

    # the map

    def relearn(self) -> None:
        """The map anew from the present features of the reference (section III-A)."""
        if self.made:
            with in_bits(self.dejavu.features, self.weight_bits):
                make_map(self)
        else:
            first, weights = not self.route.places, self.route.weights
            with in_mode(self, first):  # the first are made in training mode: running statistics are gathered
                coded = has_descriptor(self.dejavu.features)
                code: Any = self.dejavu.features.code if coded else self.dejavu.describe
                features = stored_features(self, code, first, place_descriptors(self) if coded else None)
                self.dejavu.learn_features(features, self.data.reference)
            if not self.route.plan:
                name = self.data.reference.name
                raise InputError(f"nothing repeats in the features of {name}; expected imposed periods")
            self.route.trainable(True, self.feature_weights, weights)
        self.dejavu.map.train(self.training)
        if self.data.resize is not None and len(self.data.routes) == 1:
            self.dejavu.frame_shape = tuple(self.data.sets["reference"].values.shape[1:])

    def forward(self, frames: Tensor) -> Tensor:
        """Scores of all places, the very ones that the exported map gives. (B,C,H,W) or (B,D) -> (B,N)."""
        with in_bits(self.dejavu.features, self.weight_bits):
            features = features_of(frames, self.dejavu.describe, "the batch")
        if self.made:
            return self.map.scores(self.dejavu.whitened(features))
        return self.scores(self.route.distances(features))

    def scores(self, distances: Sequence[Tensor]) -> Tensor:
        """Eq. 4 of the map with the temperature that is trained: L tensors (B,P) -> (B,N)."""
        return log_posterior(self.route.combine(distances), self.log_temperature.exp())

    def deployed(self) -> DejaVu:
        """The trained model by itself, whose `save` writes the map file.

        Raises:
            InputError: a training that has not reached its last stage.
        """
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
        seed = os.environ.get("PL_GLOBAL_SEED")  # where seed_everything keeps it
        model.trained = Training(steps or self.steps, int(seed) if seed else None)
        return model

    def require_map(self) -> None:
        """Refuse a training that is in a stage without a map."""
        if not self.in_last_stage:
            raise InputError(
                f"the training is in stage {self.index + 1} of {len(self.stages)}, "
                f"{type(self.stage).__name__}, which has no map yet; expected one in its last stage"
            )

    # training

    def configure_optimizers(self) -> Any:
        """Begin the stage, or the next where it has no steps: AdamW of its parameters, whose learning rate
        rises over the first tenth of its steps, then falls along a cosine to 0. Only what is multiplied with
        something decays: matrices and kernels."""
        steps = float(self.trainer.estimated_stepping_batches)
        if not math.isfinite(steps):
            raise InputError("the training has no end; expected trainer.max_steps or trainer.max_epochs")
        if self.stop() <= self.began and not self.in_last_stage:
            self._advance(self.began)
        self.stage.begin(self)
        trained, count = self.stage.trained(self), self.stop() - self.began
        groups = [
            {"params": [p for p in trained if p.ndim > 1], "weight_decay": self.weight_decay},
            {"params": [p for p in trained if p.ndim < 2], "weight_decay": 0.0},
        ]
        optimizer, rise = AdamW([group for group in groups if group["params"]], lr=self.lr), warm_up(count)

        def height(step: int) -> float:
            if step < rise:
                return (step + 1) / rise
            return 0.5 + 0.5 * math.cos(math.pi * min(1.0, (step - rise) / max(1, count - rise)))

        schedule = {"scheduler": LambdaLR(optimizer, height), "interval": "step"}
        return {"optimizer": optimizer, "lr_scheduler": schedule}

    def stop(self) -> int:
        """The step that ends the stage."""
        steps = int(self.trainer.estimated_stepping_batches)
        return steps if self.in_last_stage else min(self.began + round(self.stage.share * steps), steps - 1)

    def _advance(self, step: int) -> None:
        self.last.check(self.stage.chance(self))
        self.last = LastLosses()
        self.stage.end(self)
        self.zero_grad()
        self.index, self.began = self.index + 1, step

    def on_fit_start(self) -> None:
        """Callbacks that watch a figure wait for the last stage."""
        self._callbacks = self.trainer.callbacks  # type: ignore[attr-defined]
        if not self.in_last_stage:
            self.trainer.callbacks = [  # type: ignore[attr-defined]
                callback for callback in self._callbacks if getattr(callback, "monitor", None) is None
            ]

    def on_train_start(self) -> None:
        """Refuse a checkpoint whose loops are at another step than its weights."""
        if self.resumed and self.global_step != self.steps:
            raise InputError(
                f"the checkpoint is of step {self.steps}, its loops are at {self.global_step}; {EXPECTED}"
            )

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Drop a map of the features before; begin the next stage if the steps of this one are over."""
        if self.made and self.map.places:
            self.dejavu.load_state_dict(self._unmade(), strict=False)
        if not self.in_last_stage and self.global_step >= self.stop():
            self._advance(self.global_step)
            self.trainer.strategy.setup_optimizers(self.trainer)
            if self.in_last_stage:
                self.trainer.callbacks = self._callbacks

    def on_train_epoch_start(self) -> None:
        """Find the layers anew where it is time to."""
        due = self.refresh and self.current_epoch and self.current_epoch % self.refresh == 0
        if due and self.in_last_stage:
            before = self.route
            self.relearn()
            optimizer, new = self.trainer.optimizers[0], dict(self.route.named_parameters())
            for name, old in before.named_parameters():  # nothing is remembered of it
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
            raise InputError(
                f"the loss is {float(figures[0])} at step {self.global_step} ({seen}); expected a finite "
                "number: try a lower lr, or 32-bit precision"
            )
        if self.global_step - self.began >= warm_up(self.stop() - self.began):
            self.last.add(parts)
        self.log_dict({f"train/{name}": part for name, part in parts.items()})
        several = self.trainer.world_size > 1
        self.log("train/left_out", left_out, on_step=False, on_epoch=True, reduce_fx="sum", sync_dist=several)
        self.log("train/loss", figures[0], prog_bar=True)
        return total

    def on_train_batch_end(self, *_: Any) -> None:
        """Give up a training that learns nothing, as soon as that can be told."""
        self.resumed = False  # its optimizer's state has made a step
        if not self.last.learned:
            self.last.check(self.stage.chance(self))

    def on_train_end(self) -> None:
        """The same at the end."""
        self.last.check(self.stage.chance(self))

    def on_after_backward(self) -> None:
        """The gradients of all processes, ahead of their scaling and clipping."""
        average_gradients(self.trainer.optimizers, self.dejavu.features)

    def train(self, mode: bool = True) -> PlaceRecognitionTask:
        """As nn.Module's, but what is frozen keeps its running statistics."""
        super().train(mode)
        for name in self.frozen:
            self.dejavu.features.get_submodule(name).eval()
        return self

    def teardown(self, stage: str) -> None:
        """Give the trainer back its callbacks."""
        if self._callbacks:
            self.trainer.callbacks, self._callbacks = self._callbacks, []  # type: ignore[attr-defined]

    # validation and test

    def on_validation_epoch_start(self) -> None:
        """A map of the present features, where there is none yet."""
        self.resumed = False
        if self.trainer.state.fn != "fit":
            self.require_map()
        if self.in_last_stage and not self.map.places:
            with torch.inference_mode(False):  # its parameters may be trained later
                self.relearn()

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Localize a batch, in the number type of the exported map whatever the training's."""
        if self.in_last_stage:
            assert self.metric is not None  # setup made it
            frames = batch.frames if self.trainer.testing else self.data.validated(batch)
            with torch.autocast(self.device.type, enabled=False):
                match = best_match(self(frames))
            index = self.data.apart(self.map.table.scored(match.index))
            truth = batch.truth._replace(positives=self.data.apart(batch.truth.positives))
            self.metric.update(match._replace(index=index), truth)

    def on_validation_epoch_end(self) -> None:
        """Log what `evaluate` says; the reference itself, under augmentation, is no validation traverse."""
        if self.in_last_stage:
            assert self.metric is not None
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
        Nothing is imported that the file names, as by Lightning's own, and `weights_only` is always true.

        Raises:
            InputError: a damaged checkpoint, or one of other settings.
        """
        task = cls(**settings)
        load_weights(task, checkpoint_path)
        return task

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the stage, and what is trained; a map that is made is made anew."""
        stages = [type(stage).__name__ for stage in self.stages]
        checkpoint |= {"stages": stages, "stage": self.index, "began": self.began, "trained": self._trained()}
        checkpoint |= {"routes": self._routes(), "held": self.held}
        if self.made:
            checkpoint["state_dict"] |= {f"dejavu.{name}": value for name, value in self._unmade().items()}

    def _unmade(self) -> dict[str, Any]:
        """The state of a model that has learned no map and no whitening."""
        whitening = None if self.dejavu.whitening is None else Whitening()
        return DejaVu(nn.Identity(), whitening or "none", self.dejavu.mapper).state_dict()

    def _trained(self) -> list[str]:
        trained = {id(parameter) for parameter in self.stage.trained(self)}
        return sorted(name for name, parameter in self.named_parameters() if id(parameter) in trained)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse what is not of these settings and this route; layers that were found are taken over."""
        stages = [type(stage).__name__ for stage in self.stages]
        if checkpoint.get("stages") != stages:
            seen = checkpoint.get("stages", "no training")
            raise InputError(f"the checkpoint is of {seen}; expected one of the stages {stages}")
        own = {name for name, _ in self.named_parameters()}  # buffers of a backbone may hold what they like
        for name, value in checkpoint["state_dict"].items():
            checked = name in own or name.startswith((MAP, WHITENING))
            if checked and isinstance(value, Tensor) and not value.isfinite().all():
                raise InputError(
                    f"{name} of the checkpoint has NaN or infinite numbers; expected finite ones"
                )
        if self._trainer is not None:
            self.resumed = True
            if self.trainer.state.fn != "fit":
                checkpoint.pop("loops", None)  # nothing goes on
        for key, kind in (("routes", list), ("held", int)):
            value = checkpoint.get(key, [])
            if not isinstance(value, list) or not all(isinstance(one, kind) for one in value):
                raise InputError(
                    f"{key} of the checkpoint is {str(value)[:40]}; expected a list, as `fit` writes"
                )
        self.routes, self.held_before = checkpoint.get("routes", []), checkpoint.get("held", [])
        self._check_routes()
        if not self.made:
            self._take_templates(checkpoint["state_dict"])
        self.index, self.began = checkpoint["stage"], checkpoint["began"]
        self.steps = checkpoint["global_step"]
        other = sorted(set(self._trained()) ^ set(checkpoint["trained"]))
        if other:
            raise InputError(
                f"{', '.join(other[:3])}: trained in the checkpoint or in this run, not in both; expected a "
                "checkpoint of the same settings"
            )

    def _take_templates(self, state: dict[str, Any]) -> None:
        mapper = cast(TemplateMapper, self.dejavu.mapper)
        route, periods = mapper.empty(), mapper.periods
        route.load_state_dict({n.removeprefix(MAP): t for n, t in state.items() if n.startswith(MAP)})
        self._check_route(route.places)
        if route.places and isinstance(periods, ImposedPeriods):
            imposed = periods.plan(torch.zeros(1, 1).expand(route.places, route.dimension))
            if imposed != route.plan:
                held, wanted = (
                    ", ".join(f"{layer.phases} in {layer.period}" for layer in plan) or "no"
                    for plan in (route.plan, imposed)
                )
                raise InputError(
                    f"the checkpoint holds layers of {held} frames, this run imposes {wanted}; expected a "
                    "checkpoint of the same periods"
                )
        route.trainable(True, self.feature_weights)
        self.dejavu.map = route.to(self.device)

    def _routes(self) -> list[Any]:
        """Names and lengths of several routes; nothing of one, which may be read from elsewhere."""
        named = [[route.name, n] for route, n in zip(self.data.routes, self.data.lengths, strict=True)]
        return named if len(named) > 1 else []

    def _check_routes(self) -> None:
        """Refuse a checkpoint of another list of routes than the data's."""
        if self._trainer is None or self.routes is None:
            return
        if self.routes != self._routes():
            seen = ", ".join(f"{name}" for name, _ in self.routes) or "one route"
            raise InputError(
                f"the checkpoint was trained on {seen:.300}, the data is {self.data.route_name}; expected "
                "the same routes in the same order"
            )
        self.routes = None

    def _check_route(self, places: int) -> None:
        """Refuse a map of another route than the data's."""
        count = 0 if self._trainer is None else len(self.data.sets["reference"])
        if places and count and places != count:
            raise InputError(
                f"the map is of {places} places, {self.data.reference.name} has {count}; expected the route "
                "that it was made of"
            )


def load_weights(task: PlaceRecognitionTask, path: str | Path) -> None:
    """Give a task what a checkpoint of it holds."""
    checkpoint = read_checkpoint(path)
    with taking_over(path):
        task.on_load_checkpoint(checkpoint)
        task.load_state_dict(checkpoint["state_dict"])
    task.resumed = False


def start_from(backbone: nn.Module, path: str | Path) -> None:
    """Give a backbone the weights of a map file, without the code of a whitened descriptor, of its route."""
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
        raise InputError(
            f"{path} holds weights of {header['features']._asdict()}; expected those of the same "
            f"{type(backbone).__name__}"
        ) from error


def freeze_parts(
    backbone: nn.Module, prefixes: Sequence[str], batch_norm: Literal["train", "frozen"]
) -> set[str]:
    """Take the gradient from parameters; return the names of modules whose running statistics stay."""
    for prefix in prefixes:
        chosen = [p for name, p in backbone.named_parameters() if name.startswith(prefix)]
        if not chosen:
            known = sorted({name.partition(".")[0] for name, _ in backbone.named_parameters()})
            raise InputError(
                f"freeze names {prefix!r}, which no parameter of {type(backbone).__name__} begins with; "
                f"expected one of {', '.join(known) or 'none, it has none'}"
            )
        for parameter in chosen:
            parameter.requires_grad_(False)
    return {
        name
        for name, module in backbone.named_modules()
        if getattr(module, "running_mean", None) is not None  # follows the batches without any gradient
        and (batch_norm == "frozen" or any(f"{name}.".startswith(prefix) for prefix in prefixes))
    }


def warm_up(steps: int) -> int:
    """Steps of a stage of so many in which the learning rate rises."""
    return max(1, round(steps / 10))
