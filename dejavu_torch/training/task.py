"""Training the whole method end to end: backbone, templates, weights and temperature."""

from __future__ import annotations

import copy
import logging
import math
import os
import time
from typing import Any, Literal, cast

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from dejavu_torch.database.template_map import CompressedMap, Reduction, combine_layers, log_posterior
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.extract import features_of
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.model import DejaVu
from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.training.checkpoint import check_trained, stored_map
from dejavu_torch.training.descriptor import DescriptorStage, start_over
from dejavu_torch.training.frames import Batch
from dejavu_torch.training.freeze import freeze as freeze_part
from dejavu_torch.training.freeze import start_from
from dejavu_torch.training.judged import Judged
from dejavu_torch.training.metrics import PlaceRecognition
from dejavu_torch.training.objective import Objective
from dejavu_torch.training.optimizer import adamw_of, replace
from dejavu_torch.training.reference import in_mode, reference_features
from dejavu_torch.types import InputError, Training

log = logging.getLogger("dejavu_torch")


class PlaceRecognitionTask(Judged):
    """A `DejaVu` model that is trained: its features are made to repeat with the periods of its layers.

    The map's templates start as the phase means of the untrained features (eq. 1) and are parameters from
    then on. Periods are exact numbers and never get a gradient: they are imposed, or found anew in the
    features every few epochs.

    Args:
        backbone: nn.Module (B,C,H,W) -> (B,D); None is `SmallCNN` with its defaults.
        periods: gives the layers; None is `ImposedPeriods` with its defaults.
        preprocess, metric, reduction: as in `DejaVu`.
        temperature: T of `log_posterior` at the start, in units of the scores; it is learnt.
        train_templates: False leaves the templates phase means, taken anew every epoch and at the end.
        feature_weights: learn what a difference in each feature counts, at least 0.
        descriptor: share of the steps in which the network of an `Embedding` with a hidden layer learns its
            descriptor (`DescriptorStage`), ahead of the code.
        start: a map file of the same backbone, whose weights to start from.
        freeze: parameters of the backbone whose names begin with one of these stay as they are, and
            so do the running statistics below; "" is all of it.
        batch_norm: "train" lets BatchNorm follow the batches, which hold frames from all over the route;
            "frozen" keeps its running statistics, as pretrained networks and few frames want.
        refresh: epochs after which the layers are asked for anew, and templates start over from the
            phase means; 0 never.
        losses: which losses count, and how much.
        lr: highest learning rate of AdamW; it rises over the first tenth of the steps and falls to 0.
        weight_decay: of weights that are multiplied with something, not of biases, templates and the like.
        batch_size: frames in memory at a time where features are made without gradients.

    Raises:
        InputError: settings out of range; a backbone that gives no (B,D); a loss that is not finite; a
            checkpoint of other layers.
    """

    def __init__(
        self,
        backbone: nn.Module | None = None,
        periods: PeriodFinder | None = None,
        preprocess: Preprocess | None = None,
        metric: str = "l1",
        reduction: Reduction = "mean",
        temperature: float = 0.03,
        train_templates: bool = True,
        feature_weights: bool = False,
        descriptor: float = 0.4,
        start: str | None = None,
        freeze: list[str] | None = None,
        batch_norm: Literal["train", "frozen"] = "train",
        refresh: int = 0,
        losses: Objective | None = None,
        lr: float = 3e-3,
        weight_decay: float = 0.05,
        batch_size: int = 64,
    ) -> None:
        super().__init__()
        if not lr > 0 or not weight_decay >= 0 or refresh < 0 or not 0 < temperature < math.inf:
            raise InputError(
                f"lr is {lr}, temperature {temperature}, weight_decay {weight_decay}, refresh {refresh}; "
                "expected the first two above 0, the others 0 or more"
            )
        if not 0 <= descriptor < 1:
            raise InputError(f"descriptor is {descriptor}; expected a share of the steps, from 0 to below 1")
        backbone = SmallCNN() if backbone is None else backbone
        periods = ImposedPeriods() if periods is None else periods
        self.dejavu = DejaVu(
            backbone, periods, metric, reduction, batch_size=batch_size, preprocess=preprocess
        )
        if start is not None:
            start_from(backbone, start)
        self.log_temperature = nn.Parameter(torch.tensor(math.log(temperature)))
        self.train_templates, self.feature_weights = train_templates, feature_weights
        self.frozen = [module.eval() for module in freeze_part(backbone, freeze or [], batch_norm)]
        self.descriptor, self.share, self._first = DescriptorStage(backbone), descriptor, 0
        self.refresh = refresh
        self.losses = Objective() if losses is None else losses
        if self.losses.support and not train_templates:
            raise InputError("the support loss is of trained templates; expected train_templates")
        self.lr, self.weight_decay = lr, weight_decay
        self.seconds = 0.0
        self._began: float | None = None

    def setup(self, stage: str) -> None:
        """Get ready for a route; the first map is made later, where no checkpoint brings one."""
        self.metric = PlaceRecognition(self.data.tolerance)
        self.dejavu.velocity = self.data.velocity
        self._check_route(self.dejavu.map.places)
        if self.data.sets["reference"].values.ndim == 2 and list(self.dejavu.features.parameters()):
            log.warning("these are ready features: the backbone is left out")
            self.dejavu.features = HOG()  # has nothing to store
            self.descriptor = DescriptorStage(self.dejavu.features)
        self.data.augmenting = True
        self.descriptor.prepare(len(self.data.sets["reference"]), self.data.tolerance)

    def _check_route(self, places: int) -> None:
        """Refuse a map of another route than the data's."""
        reference = self.data.sets["reference"]
        if places not in (0, len(reference)):
            raise InputError(
                f"the map is of {places} places, {self.data.reference.name} has {len(reference)}; expected "
                "the route that it was made of"
            )

    def relearn(self) -> None:
        """Layers and templates anew from the present features of the reference (section III-A)."""
        weights, values = self.dejavu.map.weights, self.data.sets["reference"].values
        self.dejavu.learn_features(self._reference_features(), self.data.reference)
        self.dejavu.learnt_from = tuple(values.shape[1:])  # after data.resize
        if not self.dejavu.map.plan:
            raise InputError(
                f"nothing repeats in the features of {self.data.reference.name}; expected imposed periods"
            )
        self.dejavu.map.trainable(self.train_templates, self.feature_weights, weights)

    def retake_means(self) -> None:
        """Templates that are not trained become the phase means of the present features (eq. 1)."""
        route = self.dejavu.map
        if not self.train_templates:
            with torch.no_grad():
                templates = self.dejavu.templates(route.weighted(self._reference_features()), route.plan)
                route.templates = torch.cat([block.flatten() for block in templates])

    def retake_map(self) -> None:
        """What is judged are the templates of these features."""
        if not self.dejavu.map.places:
            self.relearn()
        self.retake_means()

    def _reference_features(self) -> Tensor:
        """(N,D), as in training at its start, where running statistics are still to be gathered."""
        values, first = self.data.sets["reference"].values, not self.dejavu.map.places
        with in_mode(self, first):
            pipeline, at_once, name = self.dejavu.pipeline, self.dejavu.batch_size, self.data.reference.name
            return reference_features(pipeline, values, at_once, self.device, name, shuffled=first)

    def forward(self, frames: Tensor) -> Tensor:
        """Scores of all places, the very ones that the exported map gives. (B,C,H,W) or (B,D) -> (B,N)."""
        return self._scores(self._distances(features_of(frames, self.dejavu.pipeline, "the batch")))

    def _distances(self, features: Tensor) -> list[Tensor]:
        return self.dejavu.matcher.distances(features, self.dejavu.map)

    def _scores(self, distances: list[Tensor]) -> Tensor:
        matcher, route = self.dejavu.matcher, self.dejavu.map
        scores = combine_layers(distances, route.plan, route.places, matcher.metric, matcher.reduction)
        return log_posterior(scores, self.log_temperature.exp())

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The weighted sum of the losses of a batch."""
        right, tolerance, route = batch.truth.positives, self.data.tolerance, self.dejavu.map
        if self.descriptor.learning:
            frames = self.dejavu.preprocess(batch.frames)
            total, parts, left_out = self.descriptor.losses(frames, right, tolerance, route.places)
        else:
            if self.descriptor.settled is None:
                features = features_of(batch.frames, self.dejavu.pipeline, "the batch")
            else:
                features, right = self.descriptor.draw()
            distances = self._distances(features)
            given = (right, route, self.dejavu.matcher, self.log_temperature.exp(), tolerance)
            total, parts, left_out = self.losses(features, distances, self._scores(distances), *given)
        if not total.isfinite():
            seen = ", ".join(f"{name} {float(part.detach()):g}" for name, part in parts.items())
            raise InputError(
                f"the loss is {float(total.detach())} at step {self.global_step} ({seen}); expected a finite "
                "number: try a lower lr, or 32-bit precision"
            )
        self.log_dict({f"train/{name}": part.detach() for name, part in parts.items()})
        self.log("train/left_out", float(left_out), reduce_fx="sum", on_step=False, on_epoch=True)
        self.log("train/loss", total.detach(), prog_bar=True)
        return total

    def train(self, mode: bool = True) -> PlaceRecognitionTask:
        """As nn.Module's, but what is frozen keeps its running statistics."""
        super().train(mode)
        for module in self.frozen:
            module.eval()
        return self

    def on_fit_start(self) -> None:
        """The clock of what `Training` tells."""
        self._began = time.perf_counter()

    def on_train_end(self) -> None:
        """Stop the clock."""
        self.seconds, self._began = self._elapsed(), None

    def _elapsed(self) -> float:
        return self.seconds + (0.0 if self._began is None else time.perf_counter() - self._began)

    def on_train_epoch_start(self) -> None:
        """Ask for the layers anew where it is time to."""
        if not self.refresh or not self.current_epoch or self.current_epoch % self.refresh:
            return self.retake_means()
        self._ask_anew(self.dejavu.map)

    def _ask_anew(self, before: CompressedMap) -> None:
        self.relearn()
        replace(cast(Optimizer, self.optimizers(use_pl_optimizer=False)), before, self.dejavu.map)

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Where the descriptor's share of the steps is over, it is settled, and a code asked for."""
        over, before = self.global_step >= self._first, self.dejavu.map
        if self.descriptor.learning:
            start_over(self.trainer, over)
            if over:
                self._settle()
                self._ask_anew(before)
        elif self.descriptor.settled is not None and self.descriptor.views is None:  # a resumed run
            self.descriptor.look(self.dejavu.preprocess, self.data, self.dejavu.batch_size)

    def _settle(self) -> None:
        """The descriptor as it is from now on; the code's map is still to be made."""
        self.frozen += self.descriptor.settle(self.global_step)
        self.descriptor.look(self.dejavu.preprocess, self.data, self.dejavu.batch_size)
        self.train(self.training)
        self.dejavu.map = CompressedMap().to(self.device)  # whose first features gather statistics anew

    def configure_optimizers(self) -> Any:
        """For the parameters that there are once the first map is made."""
        stage, steps = self.descriptor, float(self.trainer.estimated_stepping_batches)
        if stage.present and not stage.learning and stage.settled is None:
            self._settle()
        if not self.dejavu.map.places:
            self.relearn()
        if math.isfinite(steps):
            self._first = (
                min(round(self.share * steps), int(steps) - 1) if stage.learning else stage.settled or 0
            )
        return adamw_of(self.parameters(), self.lr, self.weight_decay, steps, self._first, stage.held)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the clock, and what is trained."""
        stage = self.descriptor.stored()
        checkpoint |= {"seconds": self._elapsed(), "trained": self._trained(), "descriptor": stage}

    def _trained(self) -> list[str]:
        held = {id(parameter) for parameter in self.descriptor.held}
        return sorted(name for name, p in self.named_parameters() if p.requires_grad or id(p) in held)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take over the checkpoint's layers; refuse those of another route, or others than imposed."""
        route = stored_map(checkpoint, self.dejavu.periods)
        if self._trainer is not None:
            self._check_route(route.places)
        self.dejavu.map = route.to(self.device)
        self.dejavu.map.trainable(self.train_templates, self.feature_weights)
        if "descriptor" in checkpoint:
            self.frozen += self.descriptor.restore(checkpoint["descriptor"], checkpoint["state_dict"])
        check_trained(checkpoint, self._trained())
        self.seconds = float(checkpoint.get("seconds", 0.0))

    def deployed(self) -> DejaVu:
        """The trained model by itself, whose `save` writes the map file."""
        self.retake_means()
        if self.descriptor.lacking:
            log.warning("the map is of a step ahead of the code, of the descriptor's")
        model = copy.deepcopy(self.dejavu).eval()
        model.map.settle()
        model.matcher.temperature = float(self.log_temperature.detach().exp())
        seed = os.environ.get("PL_GLOBAL_SEED")  # where seed_everything keeps it
        model.trained = Training(self.trainer.global_step, self._elapsed(), int(seed) if seed else None)
        return model
