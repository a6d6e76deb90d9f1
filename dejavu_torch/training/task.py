"""Training the whole method end to end: backbone, templates, weights and temperature."""

from __future__ import annotations

import copy
import math
import os
import time
from fractions import Fraction
from typing import Any, Literal, cast

import pytorch_lightning as pl
import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from dejavu_torch.database.compressed import CompressedMap
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.extract import features_of
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.model import DejaVu
from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.recognition.scores import Reduction, combine_layers, log_posterior
from dejavu_torch.recognition.select import best_match
from dejavu_torch.training.datamodule import RouteData
from dejavu_torch.training.frames import Batch, as_frames
from dejavu_torch.training.freeze import freeze as freeze_part
from dejavu_torch.training.freeze import start_from
from dejavu_torch.training.metrics import PlaceRecognition
from dejavu_torch.training.objective import Objective
from dejavu_torch.training.optimizer import adamw, replace, rise_and_fall
from dejavu_torch.types import InputError, Training


class PlaceRecognitionTask(pl.LightningModule):
    """A `DejaVu` model that is trained: its features are made to repeat with the periods of its layers.

    The map's templates start as the phase means of the untrained features (eq. 1) and are parameters from
    then on. Periods are exact numbers and never get a gradient: they are imposed, or found anew in the
    features every few epochs.

    Args:
        backbone: nn.Module (B,C,H,W) -> (B,D); None is `SmallCNN` with its defaults.
        periods: gives the layers; None is `ImposedPeriods` with its defaults.
        preprocess, metric, reduction: as in `DejaVu`.
        temperature: T of `log_posterior` at the start, in units of the scores; it is learnt.
        train_templates: False leaves the templates phase means, taken anew at every refresh and at the end.
        feature_weights: learn what a difference in each feature counts, at least 0.
        start: a map file of the same backbone, whose weights to start from.
        freeze: parameters of the backbone whose names begin with one of these stay as they are, and
            so do the running statistics below; "" is all of it.
        batch_norm: "train" lets BatchNorm follow the batches, which holds frames from all over the
            route; "frozen" keeps its running statistics, as fine-tuning on few or correlated frames needs.
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
        if not lr > 0 or weight_decay < 0 or refresh < 0 or not 0 < temperature < math.inf:
            raise InputError(
                f"lr is {lr}, temperature {temperature}, weight_decay {weight_decay}, refresh {refresh}; "
                "expected the first two above 0, the others 0 or more"
            )
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
        self.refresh = refresh
        self.losses = Objective() if losses is None else losses
        self.lr, self.weight_decay = lr, weight_decay
        self.metric: PlaceRecognition | None = None
        self.seconds = 0.0
        self._began: float | None = None

    @property
    def data(self) -> RouteData:
        """The data module that the trainer runs with."""
        data = getattr(self.trainer, "datamodule", None)
        if not isinstance(data, RouteData):
            raise InputError(f"the trainer's data module is {type(data).__name__}; expected RouteData")
        return data

    def setup(self, stage: str) -> None:
        """The first map: layers of the untrained features, templates from their phase means."""
        self.metric = PlaceRecognition(self.data.tolerance)
        self.dejavu.velocity = self.data.velocity
        if not self.dejavu.map.places:
            self.relearn()

    def relearn(self) -> None:
        """Layers and templates anew from the present features of the reference (section III-A)."""
        weights = self.dejavu.map.weights
        self.dejavu.learn_features(self._reference_features(), self.data.reference)
        self.dejavu.learnt_from = tuple(self.data.sets["reference"].values.shape[1:])  # after data.resize
        self.dejavu.map.trainable(self.train_templates, self.feature_weights, weights)
        if not self.dejavu.map.plan:
            raise InputError(
                f"nothing repeats in the features of {self.data.reference.name}; expected imposed periods"
            )

    def _reference_features(self) -> Tensor:
        """(N,D), as in training at its start, where running statistics are still to be gathered."""
        values, at_once = self.data.sets["reference"].values, self.dejavu.batch_size
        modes = [(module, module.training) for module in self.modules()]
        self.train(not self.dejavu.map.places)
        order = torch.randperm(len(values)) if self.training else torch.arange(len(values))
        count = min(-(-len(order) // at_once), len(order) // 2)  # none of a single frame
        try:
            with torch.no_grad():
                batches = (as_frames(values[batch]) for batch in order.tensor_split(count))
                parts = [self._features(batch.to(self.device)) for batch in batches]
        finally:
            for module, training in modes:
                module.training = training
        features = torch.cat(parts)[order.argsort()]
        if not features.isfinite().all():
            raise InputError(
                f"{type(self.dejavu.features).__name__} makes NaN or infinite features of "
                f"{self.data.reference.name}; expected finite numbers"
            )
        return features

    def _features(self, frames: Tensor) -> Tensor:
        return features_of(frames, self.dejavu.pipeline, "the batch")

    def forward(self, frames: Tensor) -> Tensor:
        """Scores of all places, the very ones that the exported map gives. (B,C,H,W) or (B,D) -> (B,N)."""
        return self._scores(self._distances(self._features(frames)))

    def _distances(self, features: Tensor) -> list[Tensor]:
        return self.dejavu.matcher.distances(features, self.dejavu.map)

    def _scores(self, distances: list[Tensor]) -> Tensor:
        matcher, route = self.dejavu.matcher, self.dejavu.map
        scores = combine_layers(distances, route.plan, route.places, matcher.metric, matcher.reduction)
        return log_posterior(scores, self.log_temperature.exp())

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The weighted sum of the losses of a batch."""
        features = self._features(batch.frames)
        distances = self._distances(features)
        temperature = self.log_temperature.exp()
        total, parts, left_out = self.losses(
            features,
            distances,
            self._scores(distances),
            batch.truth.right,
            self.dejavu.map,
            self.dejavu.matcher,
            temperature,
            self.data.tolerance,
        )
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

    def on_train_batch_end(self, *_: Any) -> None:
        """No weight below 0, which a map refuses."""
        if self.feature_weights:
            self.dejavu.map.weights.data.clamp_(min=0)

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
            return
        before = self.dejavu.map
        self.relearn()
        replace(cast(Optimizer, self.optimizers(use_pl_optimizer=False)), before, self.dejavu.map)

    def configure_optimizers(self) -> Any:
        """AdamW; the learning rate rises, then falls along a cosine to 0 at the last step."""
        total = float(self.trainer.estimated_stepping_batches)
        if not math.isfinite(total):
            raise InputError("the training has no end; expected trainer.max_steps or trainer.max_epochs")
        optimizer = adamw(self.parameters(), self.lr, self.weight_decay)
        schedule = {"scheduler": rise_and_fall(optimizer, int(total)), "interval": "step"}
        return {"optimizer": optimizer, "lr_scheduler": schedule}

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Localize a batch."""
        assert self.metric is not None  # setup made it
        self.metric.update(best_match(self(batch.frames)), batch.truth)

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        """Localize a batch."""
        self.validation_step(batch, batch_idx)

    def on_validation_epoch_end(self) -> None:
        """Log what `judge` says."""
        self._tell("val")

    def on_test_epoch_end(self) -> None:
        """Log what `judge` says."""
        self._tell("test")

    def _tell(self, stage: str) -> None:
        assert self.metric is not None
        figures = cast(dict[str, Tensor], self.metric.compute())
        self.metric.reset()
        self.log_dict({f"{stage}/{name}": value.float() for name, value in figures.items()})

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the clock."""
        checkpoint["seconds"] = self._elapsed()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of another plan; take over its layers where they were found anew since."""
        self.seconds = float(checkpoint.get("seconds", 0.0))
        prefix, route, weights = "dejavu.map.", self.dejavu.map, checkpoint["state_dict"]
        state = {n.removeprefix(prefix): t for n, t in weights.items() if n.startswith(prefix)}
        plan = ("size", "layers", "feature_ptr", "feature_index")
        if all(name in state and torch.equal(state[name].cpu(), getattr(route, name).cpu()) for name in plan):
            return
        if not self.refresh or "size" not in state or not torch.equal(state["size"].cpu(), route.size.cpu()):
            raise InputError(
                f"the checkpoint holds {_layers(state)}; this run has {_layers(route.state_dict())}: "
                "expected a checkpoint of the same route and periods"
            )
        self.dejavu.map = CompressedMap().to(route.size.device)
        self.dejavu.map.load_state_dict(state)
        self.dejavu.map.trainable(self.train_templates, self.feature_weights)

    def deployed(self) -> DejaVu:
        """The trained model by itself, whose `save` writes the map file."""
        if not self.train_templates:
            self.relearn()
        model = copy.deepcopy(self.dejavu).eval()
        model.map.settle()
        model.matcher.temperature = float(self.log_temperature.detach().exp())
        seed = os.environ.get("PL_GLOBAL_SEED")  # where seed_everything keeps it
        steps = self.trainer.global_step
        model.trained = Training(steps, self._elapsed(), None if seed is None else int(seed))
        return model


def _layers(state: dict[str, Tensor]) -> str:
    if "layers" not in state or "size" not in state:
        return "no map"
    places, features = state["size"].tolist()
    layers = [f"{p} in {Fraction(a, b)}" for a, b, p, *_ in state["layers"].tolist()]
    return f"{places} places, {features} features and layers of {', '.join(layers)} frames"
