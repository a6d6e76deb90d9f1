"""How far a training is: one bar in steps with the time left; without a terminal a line now and then."""

from __future__ import annotations

import sys
import time
from typing import Any

import pytorch_lightning as pl
from pytorch_lightning.callbacks import ProgressBar
from tqdm import tqdm

LINES, APART = 10, 60.0  # lines of a training without a terminal, and seconds between two at most


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
            self.bar = tqdm(
                desc="training", total=self.total, initial=self.began, unit=" steps", file=sys.stderr
            )

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        """Tell where it is time to."""
        step, now = trainer.global_step, time.monotonic()
        if self.bar is not None:
            self.bar.update(step - self.bar.n)
            if now - self.told_at > 1:
                self.told_at = now
                self.bar.set_postfix_str(f"loss {self._loss(trainer):.3g}", refresh=False)
            return
        due = (step - self.told) * LINES >= self.total or now - self.told_at >= APART
        if self.shown and (due or step == self.total) and step > self.told:
            self.told, self.told_at = step, now
            left = (now - self.since) * (self.total - step) / (step - self.began)
            told = f"step {step} of {self.total}, loss {self._loss(trainer):.3g}"
            tqdm.write(f"dejavu: training: {told}, {tqdm.format_interval(left)} left", file=sys.stderr)

    def _loss(self, trainer: pl.Trainer) -> float:
        return float(trainer.callback_metrics.get("train/loss", float("nan")))

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Leave the bar as it stands."""
        if self.bar is not None:
            self.bar.close()
            self.bar = None
