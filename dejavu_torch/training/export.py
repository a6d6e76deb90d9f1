"""From a training run to the map file that every other command reads."""

from __future__ import annotations

import logging
from pathlib import Path

import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import Callback, ModelCheckpoint

from dejavu_torch.training.task import PlaceRecognitionTask

log = logging.getLogger("dejavu_torch")


class MapExport(Callback):
    """Writes the map when training ends: of the best checkpoint where one was watched for, else as it ended.

    Args:
        name: of the file, in the trainer's default_root_dir.
    """

    def __init__(self, name: str = "map.safetensors") -> None:
        self.name = name

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Load the best weights, and write."""
        if not isinstance(pl_module, PlaceRecognitionTask) or not trainer.is_global_zero:
            return
        best = best_checkpoint(trainer)
        if best is not None:
            checkpoint = torch.load(best, map_location=pl_module.device, weights_only=True)
            seconds = pl_module.seconds  # of the whole run, not up to there
            pl_module.on_load_checkpoint(checkpoint)
            pl_module.load_state_dict(checkpoint["state_dict"])
            pl_module.seconds = seconds
        folder = Path(trainer.default_root_dir)
        folder.mkdir(parents=True, exist_ok=True)
        pl_module.deployed().save(folder / self.name)


def best_checkpoint(trainer: pl.Trainer) -> str | None:
    """The checkpoint that the watched figure was best at; None where none was watched."""
    for callback in trainer.checkpoint_callbacks:
        if isinstance(callback, ModelCheckpoint) and callback.monitor and callback.best_model_path:
            return callback.best_model_path
    return None
