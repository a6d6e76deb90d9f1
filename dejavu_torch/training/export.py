"""What a training leaves: its last checkpoint, and the map file that every other command reads."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytorch_lightning as pl
from pytorch_lightning.callbacks import Callback, Checkpoint, ModelCheckpoint

from dejavu_torch.data.fitted import fitted
from dejavu_torch.data.ground_truth import GroundTruth, as_ground_truth
from dejavu_torch.evaluation.curves import Scores
from dejavu_torch.features.views import Views
from dejavu_torch.features.whitening import STRENGTHS
from dejavu_torch.growth import calibrate_if_possible
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.training.datamodule import FEW, RouteData
from dejavu_torch.training.task import PlaceRecognitionTask, load_weights
from dejavu_torch.training.worth import beside_untrained
from dejavu_torch.types import InputError, Traverse

DESCRIPTOR = "descriptor.safetensors"  # of several routes

log = logging.getLogger("dejavu_torch")


class MapExport(Callback):
    """Writes the map when training ends or is interrupted: of the best checkpoint where one is watched for,
    else of the last step.

    Of several routes it is their descriptor, without a map, in `descriptor.safetensors`.

    Where training has ended, `scores` are what the map is worth on the traverse to validate or to test on,
    else on stretches that training never saw, see `beside_untrained`; they are logged too.

    Args:
        name: of the map file, in the trainer's default_root_dir.
    """

    def __init__(self, name: str = "map.safetensors") -> None:
        self.name = name
        self.began: int | None = None
        self.written: tuple[Path, DejaVu] | None = None
        self.scores: dict[str, Scores] = {}

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Note the step that a checkpoint brought."""
        self.began, self.written, self.scores = trainer.global_step, None, {}

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Load the best weights, and write."""
        if not isinstance(pl_module, PlaceRecognitionTask) or not trainer.is_global_zero:
            return
        step = trainer.global_step
        if not step:
            log.warning("no step was taken: no map is written")
            return
        if self.began in (None, step):
            log.warning("nothing was trained: step %d is reached; max_steps counts from the start", step)
        best = best_checkpoint(trainer)
        if best is not None and not Path(best).is_file():
            log.warning("%s is gone: the map is of the last step", best)
        elif best is not None:
            load_weights(pl_module, best)
        data = pl_module.data
        self.write(pl_module, Path(trainer.default_root_dir), data)
        if self.written is None or not self.written[1].map.places:
            return
        unseen = data.unseen() or held_frames(self.written[1], data, pl_module.held)
        if unseen is None:
            return
        self.scores = beside_untrained(self.written[1], data.reference, *unseen, data.tolerance)
        figures = {f"unseen/auc of {name}": one.auc for name, one in self.scores.items()}
        for logger in trainer.loggers:
            logger.log_metrics({name.replace(" ", "_"): auc for name, auc in figures.items()}, step)

    def on_exception(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException
    ) -> None:
        """Write the map of the last step where the user interrupts."""
        interrupted = isinstance(exception, KeyboardInterrupt) and trainer.state.fn == "fit"
        if interrupted and trainer.global_step and self.written is None:
            assert isinstance(pl_module, PlaceRecognitionTask)
            self.write(pl_module, Path(trainer.default_root_dir))

    def write(self, task: PlaceRecognitionTask, folder: Path, data: RouteData | None = None) -> None:
        """Write the task's map, calibrated by what training has not seen of the data where it is given; a
        warning where it has none yet."""
        try:
            model = task.deployed()
        except InputError as error:
            log.warning("no map is written: %s", error)
            return
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / (self.name if model.map.places else DESCRIPTOR)
        model.save(path)  # whatever becomes of its calibration
        self.written = (path, model)
        if data is not None and model.map.places:
            calibrate(model, data, task.held)
            model.save(path)


def held_frames(
    model: DejaVu, data: RouteData, starts: list[int], shape: tuple[int, ...] | None = None
) -> tuple[Traverse, GroundTruth] | None:
    """The stretches that training never saw, changed, and their places; None where there are none.

    Args:
        starts: their first places. shape: (C,H,W) of the frames; None is that of the reference.
    """
    strengths = STRENGTHS if model.whitening is None else model.whitening.strengths
    found = data.held_frames(starts, strengths, shape)
    return None if found is None else (found, as_ground_truth(found.places[:, None]))


def calibrate(model: DejaVu, data: RouteData, starts: list[int]) -> None:
    """By the traverse to validate on, else by stretches that training never saw; else not at all.

    Args:
        starts: the first places of these stretches.
    """
    validated = data.sources["validation"] is not None
    unseen = data.unseen() if validated else held_frames(model, data, starts, model.frame_shape)
    if unseen is None:
        if data.held:
            told = "the map is not calibrated: the training has seen what data.held_out %g leaves out"
            log.warning(told, data.held_out)
        elif isinstance(model.mapper, TemplateMapper) and model.map.places >= FEW:
            log.warning("the map is not calibrated: of templates nothing is held out; data.validation would")
        return
    frames, truth = unseen
    if validated and len(frames.frame_shape) == 3:
        frames = fitted(frames, model.frame_shape or ())
    try:
        calibrate_if_possible(model, data.reference, Views(frames, truth.positives[:, 0]))
    except InputError as error:
        log.warning("the map is not calibrated: %s", error)


class LastCheckpoint(Checkpoint):
    """Keeps `checkpoints/last.ckpt` in the trainer's default_root_dir, also where a training is interrupted.

    Args:
        every: steps between two.
    """

    def __init__(self, every: int = 500) -> None:
        self.every = every
        self.saved = 0

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        """Save where it is time to."""
        if trainer.global_step % self.every == 0:
            self._save(trainer)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save the last step."""
        self._save(trainer)

    def on_exception(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException
    ) -> None:
        """Save the last step where the user interrupts."""
        if isinstance(exception, KeyboardInterrupt):
            self._save(trainer)

    def _save(self, trainer: pl.Trainer) -> None:
        if trainer.state.fn == "fit" and trainer.global_step not in (0, self.saved):
            trainer.save_checkpoint(Path(trainer.default_root_dir) / "checkpoints" / "last.ckpt")
            self.saved = trainer.global_step


def best_checkpoint(trainer: pl.Trainer) -> str | None:
    """The checkpoint that the watched figure was best at; None where none was watched."""
    for callback in trainer.checkpoint_callbacks:
        if isinstance(callback, ModelCheckpoint) and callback.monitor:
            if callback.best_model_path:
                return callback.best_model_path
            log.warning("%s was never measured: the map is of the last step", callback.monitor)
    return None
