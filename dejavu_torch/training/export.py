"""From a training run to the map file that every other command reads."""

from __future__ import annotations

import logging
from pathlib import Path

import pytorch_lightning as pl
import torch
from pytorch_lightning.callbacks import Callback, ModelCheckpoint

from dejavu_torch.database.summary import MapSummary
from dejavu_torch.training.task import PlaceRecognitionTask

log = logging.getLogger("dejavu_torch")


class MapExport(Callback):
    """Writes the map when training ends: of the best checkpoint where one was watched for, else as it ended.

    Args:
        name: of the file, in the trainer's default_root_dir.
    """

    def __init__(self, name: str = "map.safetensors") -> None:
        self.name = name
        self.began: int | None = None
        self.written: tuple[Path, MapSummary] | None = None

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """The step that a checkpoint brought."""
        self.began = trainer.global_step

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Load the best weights, and write."""
        if not isinstance(pl_module, PlaceRecognitionTask) or not trainer.is_global_zero:
            return
        step = trainer.global_step
        if not step:
            log.warning("no step was taken: no map is written")
            return
        if self.began in (None, step):
            log.warning("nothing was trained: max_steps counts from the start, and step %d is reached", step)
        best = best_checkpoint(trainer)
        if best is not None and not Path(best).is_file():
            log.warning("%s is gone: the map is of the last step", best)
        elif best is not None:
            checkpoint = torch.load(best, map_location=pl_module.device, weights_only=True)
            seconds = pl_module.seconds  # of the whole run, not up to there
            pl_module.on_load_checkpoint(checkpoint)
            pl_module.load_state_dict(checkpoint["state_dict"])
            pl_module.seconds = seconds
        folder = Path(trainer.default_root_dir)
        folder.mkdir(parents=True, exist_ok=True)
        model = pl_module.deployed()
        model.save(folder / self.name)
        self.written = (folder / self.name, model.certificate)


def best_checkpoint(trainer: pl.Trainer) -> str | None:
    """The checkpoint that the watched figure was best at; None where none was watched."""
    for callback in trainer.checkpoint_callbacks:
        if isinstance(callback, ModelCheckpoint) and callback.monitor and not callback.best_model_path:
            log.warning("%s was never measured: the map is of the last step", callback.monitor)
        if isinstance(callback, ModelCheckpoint) and callback.monitor and callback.best_model_path:
            return callback.best_model_path
    return None
