"""At the end of a training: the map and its scores."""

from __future__ import annotations

import copy
import logging
import shlex
from pathlib import Path
from typing import Any, cast

import pytorch_lightning as pl
from pytorch_lightning.callbacks import Callback, ModelCheckpoint

from dejavu_torch.data.ground_truth import GroundTruth, as_ground_truth
from dejavu_torch.data.traverse import fitted
from dejavu_torch.evaluation.baselines import hog_baselines
from dejavu_torch.evaluation.contenders import contend
from dejavu_torch.evaluation.curves import Scores
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.views import AugmentedFrames, LabelledFrames, augmented_segments
from dejavu_torch.features.whitening import STRENGTHS
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.recognition.localizer import SINGLE
from dejavu_torch.training.datamodule import MIN_FRAMES, RouteData
from dejavu_torch.training.task import RouteTask, load_weights
from dejavu_torch.types import InputError, Match, Traverse

DESCRIPTOR = "descriptor.safetensors"  # of several routes
TRAINED, HOG, UNTRAINED = "the trained map", "HOG of all frames", "the untrained map"
CPU_FLAGS = Path("/proc/cpuinfo")
BF16_FLAGS = {"avx512_bf16", "amx_bf16", "bf16"}  # the last one on ARM

log = logging.getLogger("dejavu_torch")


class MapExport(Callback):
    """Writes the map when training ends or is interrupted, from the best checkpoint if one is monitored, else
    from the last step. For several routes it writes their descriptor to `descriptor.safetensors`.

    After training, `scores` are those of the map on the validation or query traverse, else on held-out
    segments, see `compare_with_untrained`; they are logged too.

    Args:
        name: of the map file, in the trainer's default_root_dir.
    """

    def __init__(self, name: str = "map.safetensors") -> None:
        self.name = name
        self.began: int | None = None
        self.written: tuple[Path, DejaVu] | None = None
        self.scores: dict[str, Scores] = {}

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Note the first step, which a checkpoint may set."""
        self.began, self.written, self.scores = trainer.global_step, None, {}

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Load the best weights and write the map."""
        if not isinstance(pl_module, RouteTask) or not trainer.is_global_zero:
            return
        step = trainer.global_step
        if not step:
            log.warning("no training step was made: no map is written")
            return
        if self.began in (None, step):
            log.warning("nothing was trained: step %d is already reached; max_steps counts from step 0", step)
        callbacks = (one for one in trainer.checkpoint_callbacks if isinstance(one, ModelCheckpoint))
        monitored = [one for one in callbacks if one.monitor]
        best = next((one.best_model_path for one in monitored if one.best_model_path), "")
        if best and Path(best).is_file():
            load_weights(pl_module, best)
        elif monitored:
            seen = f"{best} is gone" if best else f"{monitored[0].monitor} was never measured"
            log.warning("%s: the map is from the last step", seen)
        data = pl_module.data
        self.write(pl_module, Path(trainer.default_root_dir), data)
        if self.written is None or not self.written[1].map.places:
            return
        unseen = data.unseen() or held_frames(self.written[1], data, pl_module.held)
        if unseen is not None:
            self.scores = compare_with_untrained(self.written[1], data.reference, *unseen, data.tolerance)
            figures = {f"unseen/auc_of_{n.replace(' ', '_')}": one.auc for n, one in self.scores.items()}
            for logger in trainer.loggers:
                logger.log_metrics(figures, step)
            first = self.scores[TRAINED].auc if self.scores else 0.0
            if beaten := [name for name, one in self.scores.items() if one.auc > first]:
                source = data.sources["source"]
                anew = shlex.quote(str(source)) if isinstance(source, str | Path) else "SOURCE"
                text = "the trained map is worse than %s; `dejavu learn %s --map FILE` makes a map untrained"
                log.warning(text, " and ".join(beaten), anew)

    def on_exception(self, trainer: pl.Trainer, pl_module: Any, exception: BaseException) -> None:
        """Write the map of the last step if the user interrupts."""
        interrupted = isinstance(exception, KeyboardInterrupt) and trainer.state.fn == "fit"
        if interrupted and trainer.global_step and self.written is None:
            try:
                self.write(pl_module, Path(trainer.default_root_dir))
            except InputError as error:  # the checkpoint is still to be written
                log.warning("no map is written: %s", error)

    def write(self, task: RouteTask, folder: Path, data: RouteData | None = None) -> None:
        """Write the task's map, calibrated with unseen data if `data` is given."""
        model = task.deployed()
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / (self.name if model.map.places else DESCRIPTOR)
        model.save(path)  # before the calibration, which may fail
        self.written = (path, model)
        if data is not None and model.map.places:
            calibrate(model, data, task.held)
            model.save(path)


def held_frames(
    model: DejaVu, data: RouteData, starts: list[int], shape: tuple[int, ...] | None = None
) -> tuple[Traverse, GroundTruth] | None:
    """The held-out segments that begin at `starts`, augmented, in frames of `shape`, and their places."""
    if not starts:
        return None
    strengths = STRENGTHS if model.whitening is None else model.whitening.strengths
    reference = data.reference if shape is None else fitted(data.reference, shape)
    found = augmented_segments(reference, len(data.sets["reference"].values), strengths, starts=starts)
    return cast(Traverse, found), as_ground_truth(found.places[:, None])


def calibrate(model: DejaVu, data: RouteData, starts: list[int]) -> None:
    """Calibrate with the validation traverse, else with held-out segments; without either, warn."""
    validated = data.sources["validation"] is not None
    unseen = data.unseen() if validated else held_frames(model, data, starts, model.frame_shape)
    if unseen is not None:
        frames, truth = unseen
        frames = _of_shape(frames, model.frame_shape) if validated else frames
        try:
            model.calibrate(data.reference, LabelledFrames(frames, truth.positives[:, 0]))
        except InputError as error:
            log.warning("the map is not calibrated: %s", error)
    elif data.held:
        seen = "the map is not calibrated: the earlier training has seen the segments of data.held_out %g"
        log.warning(seen, data.held_out)
    elif isinstance(model.mapper, TemplateMapper) and model.map.places >= MIN_FRAMES:
        log.warning("the map is not calibrated: templates have no held-out segments; give data.validation")


def compare_with_untrained(
    model: DejaVu, reference: Traverse, query: Traverse, truth: GroundTruth, tolerance: int
) -> dict[str, Scores]:
    """Scores by name of a trained map, of HOG of all frames, and of an untrained map; empty without truth.

    The untrained map is that of `DejaVu()` with the model's own mapper (unless it makes templates), in as
    many route bytes. If it cannot be made of these frames, there is a warning. The traverses are resampled
    if the model is.
    """
    query = _of_shape(query, reference.frame_shape)
    found = {TRAINED: _match(model, query)}
    hog = hog_baselines(reference, query, model.batch_size, tolerance)
    found |= {HOG: hog["hog"].match()} if hog else {}
    mapper = None if isinstance(model.mapper, TemplateMapper) else copy.deepcopy(model.mapper)
    if isinstance(mapper, SpectralMapper) and mapper.route_bytes_per_place is None:
        # the same step would give other bytes for another descriptor
        mapper.route_bytes_per_place = model.map.summary().route_bytes / model.map.places
        mapper.step = mapper.hold = None
    try:
        preprocess = Preprocess(size=model.preprocess.size)
        untrained = DejaVu(mapper=mapper, batch_size=model.batch_size, preprocess=preprocess)
        reference = untrained.at_map_size(reference)
        untrained.learn(reference)
        found[UNTRAINED] = _match(untrained, _of_shape(query, reference.frame_shape))
    except InputError as error:
        log.warning("no untrained map to compare with: %s", error)
    scores = {name: contend(name, match, truth, tolerance).scores for name, match in found.items()}
    return {name: one for name, one in scores.items() if one is not None}


def _of_shape(query: Traverse, shape: tuple[int, ...] | None) -> Traverse:
    if isinstance(query, AugmentedFrames):
        return cast(Traverse, query.fitted(shape or ()))
    return fitted(query, shape or ()) if len(query.frame_shape) == 3 else query


def _match(model: DejaVu, query: Traverse) -> Match:
    descriptors = model.descriptor.all_of(_of_shape(query, model.frame_shape))
    return model.localize_descriptors(descriptors, SINGLE).renumbered(model.map.table.scored)


def has_bf16() -> bool:
    """Whether the processor has bfloat16 instructions, without which it is slow; False except on Linux."""
    text = CPU_FLAGS.read_text(encoding="utf-8", errors="replace") if CPU_FLAGS.is_file() else ""
    lines = (line for line in text.splitlines() if line.lower().startswith(("flags", "features")))
    return bool(BF16_FLAGS & set(next(lines, "").split()))
