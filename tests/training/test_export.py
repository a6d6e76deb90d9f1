"""The map that a training leaves: which step it is of, and what is warned of."""

from __future__ import annotations

from pathlib import Path

import torch
from pytorch_lightning import Callback
from pytorch_lightning.callbacks import ModelCheckpoint
from small_training import data_of, last, new_task, trainer, warned

from dejavu_torch import DejaVu


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
