"""What runs beside a training: progress, checkpoints, and at the end the map and what it is worth."""

from __future__ import annotations

import copy
import logging
import math
import sys
import time
from pathlib import Path
from typing import Any, cast

import pytorch_lightning as pl
from pytorch_lightning.callbacks import Callback, Checkpoint, ModelCheckpoint, ProgressBar
from tqdm import tqdm

from dejavu_torch.data.fitted import fitted
from dejavu_torch.data.ground_truth import GroundTruth, as_ground_truth
from dejavu_torch.evaluation.baselines import hog_baselines
from dejavu_torch.evaluation.contenders import contend
from dejavu_torch.evaluation.curves import Scores
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.views import Views, augmented_segments
from dejavu_torch.features.whitening import STRENGTHS
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.localizer import SINGLE
from dejavu_torch.training.datamodule import FEW, RouteData
from dejavu_torch.training.task import PlaceRecognitionTask, load_weights
from dejavu_torch.types import InputError, Match, Traverse

DESCRIPTOR = "descriptor.safetensors"  # of several routes
TRAINED, HOG, UNTRAINED = "the trained map", "HOG of all frames", "the untrained map"
LINES, APART = 10, 60.0  # lines of a training without a terminal, and seconds between two at most
CPU_FLAGS = Path("/proc/cpuinfo")
FAST = {"avx512_bf16", "amx_bf16", "bf16"}  # the last one of ARM

log = logging.getLogger("dejavu_torch")


class MapExport(Callback):
    """Writes the map when training ends or is interrupted: of the best checkpoint if one is watched for, else
    of the last step.

    Of several routes it is their descriptor, without a map, in `descriptor.safetensors`.

    When training has ended, `scores` are what the map is worth on the traverse to validate or to test on,
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
        watch = [
            one for one in trainer.checkpoint_callbacks if isinstance(one, ModelCheckpoint) and one.monitor
        ]
        best = next((one.best_model_path for one in watch if one.best_model_path), "")
        if best and Path(best).is_file():
            load_weights(pl_module, best)
        elif watch:
            seen = f"{best} is gone" if best else f"{watch[0].monitor} was never measured"
            log.warning("%s: the map is of the last step", seen)
        data = pl_module.data
        self.write(pl_module, Path(trainer.default_root_dir), data)
        if self.written is None or not self.written[1].map.places:
            return
        unseen = data.unseen() or held_frames(self.written[1], data, pl_module.held)
        if unseen is not None:
            self.scores = beside_untrained(self.written[1], data.reference, *unseen, data.tolerance)
            figures = {f"unseen/auc_of_{n.replace(' ', '_')}": one.auc for n, one in self.scores.items()}
            for logger in trainer.loggers:
                logger.log_metrics(figures, step)

    def on_exception(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException
    ) -> None:
        """Write the map of the last step if the user interrupts."""
        interrupted = isinstance(exception, KeyboardInterrupt) and trainer.state.fn == "fit"
        if interrupted and trainer.global_step and self.written is None:
            self.write(cast(PlaceRecognitionTask, pl_module), Path(trainer.default_root_dir))

    def write(self, task: PlaceRecognitionTask, folder: Path, data: RouteData | None = None) -> None:
        """Write the task's map, calibrated by what training has not seen of the data if it is given; a
        warning if there is none yet."""
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
    """The stretches that begin at `starts`, in frames of `shape`, as they may look on another visit, and
    their places; None without any."""
    if not starts:
        return None
    strengths = STRENGTHS if model.whitening is None else model.whitening.strengths
    reference = data.reference if shape is None else fitted(data.reference, shape)
    found = augmented_segments(reference, len(data.sets["reference"].values), strengths, starts=starts)
    return found, as_ground_truth(found.places[:, None])


def calibrate(model: DejaVu, data: RouteData, starts: list[int]) -> None:
    """By the traverse to validate on, else by stretches that training never saw; else not at all."""
    validated = data.sources["validation"] is not None
    unseen = data.unseen() if validated else held_frames(model, data, starts, model.frame_shape)
    if unseen is not None:
        frames, truth = unseen
        frames = _of_shape(frames, model.frame_shape) if validated else frames
        try:
            model.calibrate(data.reference, Views(frames, truth.positives[:, 0]))
        except InputError as error:
            log.warning("the map is not calibrated: %s", error)
    elif data.held:
        seen = "the map is not calibrated: the training has seen what data.held_out %g leaves out"
        log.warning(seen, data.held_out)
    elif isinstance(model.mapper, TemplateMapper) and model.map.places >= FEW:
        log.warning("the map is not calibrated: of templates nothing is held out; data.validation would")


class LastCheckpoint(Checkpoint):
    """Keeps `checkpoints/last.ckpt` in the trainer's default_root_dir, also if a training is interrupted.

    Args:
        every: steps between two.
    """

    def __init__(self, every: int = 500) -> None:
        self.every, self.saved = every, 0

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        """Save when it is time to."""
        if trainer.global_step % self.every == 0:
            self._save(trainer)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save the last step."""
        self._save(trainer)

    def on_exception(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException
    ) -> None:
        """Save the last step if the user interrupts."""
        if isinstance(exception, KeyboardInterrupt):
            self._save(trainer)

    def _save(self, trainer: pl.Trainer) -> None:
        if trainer.state.fn == "fit" and trainer.global_step not in (0, self.saved):
            trainer.save_checkpoint(Path(trainer.default_root_dir) / "checkpoints" / "last.ckpt")
            self.saved = trainer.global_step


def beside_untrained(
    model: DejaVu, reference: Traverse, query: Traverse, truth: GroundTruth, tolerance: int
) -> dict[str, Scores]:
    """Scores of a trained map, of HOG of all frames, and of the untrained map: that of `DejaVu()`, by the
    model's own mapper, unless it is of templates, in as many route bytes. What cannot be made of these frames
    is left out, with a warning.

    Args:
        model: with its map, on any device. reference, query: resampled where the model is.
        truth: the places of the queries. tolerance: places within which one is right.

    Returns:
        By name, the trained map first; nothing where no query has a known place.
    """
    query = _of_shape(query, reference.frame_shape)
    found = {TRAINED: _match(model, query)}
    hog = hog_baselines(reference, query, model.batch_size, tolerance)
    found |= {HOG: hog["hog"].found} if hog else {}
    mapper = None if isinstance(model.mapper, TemplateMapper) else copy.deepcopy(model.mapper)
    if isinstance(mapper, SpectralMapper) and mapper.route_bytes_per_place is None:
        # another descriptor takes other bytes
        mapper.route_bytes_per_place = model.map.summary().route_bytes / model.map.places
        mapper.step = mapper.hold = None
    try:
        preprocess = Preprocess(size=model.preprocess.size)
        untrained = DejaVu(mapper=mapper, batch_size=model.batch_size, preprocess=preprocess)
        reference = untrained.fit(reference)
        untrained.learn(reference)
        found[UNTRAINED] = _match(untrained, _of_shape(query, reference.frame_shape))
    except InputError as error:
        log.warning("no untrained map to compare with: %s", error)
    scores = {name: contend(name, match, truth, tolerance).scores for name, match in found.items()}
    return {name: one for name, one in scores.items() if one is not None}


def _of_shape(query: Traverse, shape: tuple[int, ...] | None) -> Traverse:
    return fitted(query, shape or ()) if len(query.frame_shape) == 3 else query


def _match(model: DejaVu, query: Traverse) -> Match:
    descriptors = model.extract_all(_of_shape(query, model.frame_shape))
    return model.localize_descriptors(descriptors, SINGLE).renumbered(model.map.table.scored)


class StepBar(ProgressBar):
    """Shows steps of all, the loss and the time left on stderr."""

    def __init__(self) -> None:
        super().__init__()
        self.shown = True
        self.bar: tqdm[Any] | None = None
        self.total = self.began = self.told = 0
        self.since = self.told_at = 0.0

    def disable(self) -> None:
        """See Lightning's, as is the next."""
        self.shown = False

    def enable(self) -> None:
        self.shown = True

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Begin at the step that a checkpoint brought."""
        self.total, self.began = int(trainer.estimated_stepping_batches), trainer.global_step
        self.told, self.since = self.began, time.monotonic()
        self.told_at = self.since
        if self.shown and sys.stderr.isatty():
            given = {"total": self.total, "initial": self.began, "unit": " steps", "file": sys.stderr}
            self.bar = tqdm(desc="training", **given)

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        """Tell when it is time to."""
        step, now = trainer.global_step, time.monotonic()
        if self.bar is not None:
            self.bar.update(step - self.bar.n)
            if now - self.told_at > 1:
                self.told_at = now
                self.bar.set_postfix_str(_loss(trainer), refresh=False)
            return
        due = (step - self.told) * LINES >= self.total or now - self.told_at >= APART
        if self.shown and (due or step == self.total) and step > self.told:
            self.told, self.told_at = step, now
            left = tqdm.format_interval((now - self.since) * (self.total - step) / (step - self.began))
            line = f"dejavu: training: step {step} of {self.total}, {_loss(trainer)}, {left} left"
            tqdm.write(line, file=sys.stderr)

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Leave the bar as it stands."""
        if self.bar is not None:
            self.bar.close()
            self.bar = None


def _loss(trainer: pl.Trainer) -> str:
    return f"loss {float(trainer.callback_metrics.get('train/loss', math.nan)):.3g}"


def has_bf16() -> bool:
    """Whether the processor multiplies numbers of 16 bits (bfloat16) itself; elsewhere they are slower.

    Known on Linux; False elsewhere.
    """
    text = CPU_FLAGS.read_text(encoding="utf-8", errors="replace") if CPU_FLAGS.is_file() else ""
    lines = (line for line in text.splitlines() if line.lower().startswith(("flags", "features")))
    return bool(FAST & set(next(lines, "").split()))
