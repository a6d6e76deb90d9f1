"""What a model in training is worth: validation and test."""

from __future__ import annotations

from typing import cast

import pytorch_lightning as pl
import torch
from torch import Tensor

from dejavu_torch.recognition.select import best_match
from dejavu_torch.training.datamodule import RouteData
from dejavu_torch.training.frames import Batch
from dejavu_torch.training.metrics import PlaceRecognition
from dejavu_torch.types import InputError


class Judged(pl.LightningModule):
    """Localizes the frames of its data module, and logs what `evaluate` says."""

    def __init__(self) -> None:
        super().__init__()
        self.metric: PlaceRecognition | None = None  # `setup` makes it

    @property
    def data(self) -> RouteData:
        """The data module that the trainer runs with."""
        data = getattr(self.trainer, "datamodule", None)
        if not isinstance(data, RouteData):
            raise InputError(f"the trainer's data module is {type(data).__name__}; expected RouteData")
        return data

    def retake_map(self) -> None:
        """Make what is judged ready; nothing here."""

    def on_validation_epoch_start(self) -> None:
        """A map of the present features."""
        self.retake_map()

    def on_test_epoch_start(self) -> None:
        """As for a validation."""
        self.on_validation_epoch_start()

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Localize a batch, in the number type of the exported map whatever the training's."""
        assert self.metric is not None  # setup made it
        with torch.autocast(self.device.type, enabled=False):
            self.metric.update(best_match(self(batch.frames)), batch.truth)

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        """Localize a batch."""
        self.validation_step(batch, batch_idx)

    def on_validation_epoch_end(self) -> None:
        """Log what `evaluate` says."""
        assert self.metric is not None
        figures = cast(dict[str, Tensor], self.metric.compute())
        self.metric.reset()
        stage = "test" if self.trainer.testing else "val"
        self.log_dict({f"{stage}/{name}": value.float() for name, value in figures.items()})

    def on_test_epoch_end(self) -> None:
        """As for a validation."""
        self.on_validation_epoch_end()
