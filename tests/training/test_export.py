"""The map that a training leaves: which step it is of, and what is warned of."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
import torch
from pytorch_lightning import Callback
from pytorch_lightning.callbacks import EarlyStopping, ModelCheckpoint
from small_training import Stop, data_of, footage, last, new_task, trainer, warned

from dejavu_torch import DejaVu
from dejavu_torch.data.arrays import ArrayTraverse


class Wreck(Callback):
    """Spoils what was learned, from the second epoch on."""

    @torch.no_grad()
    def on_train_epoch_end(self, trainer, pl_module):
        if trainer.current_epoch:
            pl_module.route.templates.fill_(trainer.current_epoch)


def test_the_map_is_of_the_best_checkpoint_and_training_stops_early(tmp_path):
    best = ModelCheckpoint(tmp_path, monitor="val/auc", mode="max")
    every = ModelCheckpoint(tmp_path, save_last=True)
    stop = EarlyStopping("val/auc", mode="max", patience=2)
    task = new_task(lr=1e-4, weight_bits=32)
    running = trainer(tmp_path, every, best, stop, Wreck(), max_epochs=9, max_steps=-1)
    running.fit(task, data_of(batch_size=20, validation=ArrayTraverse(footage(0.02)), validation_truth="0"))
    assert 2 < running.current_epoch < 9
    state = torch.load(best.best_model_path, weights_only=True)["state_dict"]
    model = DejaVu.load(tmp_path / "map.safetensors")
    assert torch.equal(model.map.templates, state["dejavu.map.templates"])
    assert torch.equal(model.features.linear.weight, state["dejavu.descriptor.features.linear.weight"])
    last = torch.load(tmp_path / "last.ckpt", weights_only=True)["state_dict"]
    assert not torch.equal(model.map.templates, last["dejavu.map.templates"])
    assert model.trained is not None
    assert model.trained.steps == running.global_step


class Tidy(Callback):
    """Deletes the best checkpoint."""

    def on_train_end(self, trainer, pl_module):
        Path(trainer.checkpoint_callbacks[0].best_model_path).unlink()  # type: ignore[attr-defined]


def test_what_leaves_no_map_or_another_than_expected_warns(tmp_path, caplog):
    trainer(tmp_path, limit_train_batches=0).fit(new_task(), data_of())
    assert warned(caplog) == ["no training step was made: no map is written"]
    assert not (tmp_path / "map.safetensors").exists()
    caplog.clear()
    best, task = ModelCheckpoint(tmp_path, monitor="val/auc_augmented", mode="max"), new_task()
    trainer(tmp_path, best, Tidy(), last(tmp_path)).fit(task, data_of())
    assert warned(caplog) == [f"{best.best_model_path} is gone: the map is from the last step"]
    caplog.clear()
    trainer(tmp_path).fit(new_task(), data_of(), ckpt_path=tmp_path / "checkpoints" / "last.ckpt")
    (line,) = warned(caplog)
    assert line.startswith("nothing was trained: step 4 is already reached")
    assert torch.equal(DejaVu.load(tmp_path / "map.safetensors").map.templates, task.route.templates)


def test_an_interrupt_leaves_the_map_and_the_checkpoint_of_the_last_step(tmp_path):
    kept = last(tmp_path, save_on_exception=True)
    stop, handler = Stop(3, exception=KeyboardInterrupt()), signal.getsignal(signal.SIGINT)
    running = trainer(tmp_path, kept, stop, max_steps=9)
    try:
        with pytest.raises(SystemExit):
            running.fit(new_task(), data_of())
    finally:
        signal.signal(signal.SIGINT, handler)
    model = DejaVu.load(tmp_path / "map.safetensors")
    written = torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)
    assert torch.equal(written["state_dict"]["dejavu.map.templates"], model.map.templates)
    assert model.trained is not None
    assert model.trained.steps == written["global_step"] == 3
