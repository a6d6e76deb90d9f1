"""`dejavu train`: Lightning's own command line over our task and data."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NoReturn

from lightning_fabric.utilities.exceptions import MisconfigurationException
from pytorch_lightning import Trainer
from pytorch_lightning.callbacks import Callback, ModelCheckpoint
from pytorch_lightning.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback

from dejavu_torch.cli.parser import Parser, UsageError, refusal
from dejavu_torch.data.files import make_output_folder
from dejavu_torch.database.summary import describe
from dejavu_torch.training.datamodule import RouteData
from dejavu_torch.training.export import MapExport
from dejavu_torch.training.task import PlaceRecognitionTask
from dejavu_torch.types import InputError

DEFAULTS = {
    "accelerator": "auto",
    "devices": 1,
    "gradient_clip_val": 5.0,
    "default_root_dir": "dejavu_train",
    "num_sanity_val_steps": 0,
    "log_every_n_steps": 10,
}

PARTS = {
    "model.backbone": "dejavu_torch.features.cnn.SmallCNN",
    "model.periods": "dejavu_torch.periods.imposed.ImposedPeriods",
    "model.preprocess": "dejavu_torch.Preprocess",
    "data.augmentation": "dejavu_torch.features.augmentation.Augmentation",
}
log = logging.getLogger("dejavu_torch")


class TrainParser(Parser, LightningArgumentParser):
    """Lightning's parser, whose errors are one line."""

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        head, required, names = message.partition("required: ")
        if required:
            needed = ["--" + name.partition(".")[2] for name in names.split(", ")]  # behind fit.
            raise UsageError(f"{head}{required}{', '.join(needed)}") from ex
        super().error(message, ex)


class TrainCLI(LightningCLI):
    """fit writes DIR/map.safetensors; validate and test judge a checkpoint."""

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        """Lightning's, without predict, which `dejavu localize` does."""
        every = LightningCLI.subcommands()
        return {name: every[name] for name in ("fit", "validate", "test")}

    def init_parser(self, **kwargs: Any) -> LightningArgumentParser:
        """A parser whose errors are one line."""
        parser = TrainParser(**kwargs)
        parser.add_argument(
            "-c", "--config", action="config", help="YAML file; its keys are the options below"
        )
        return parser

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Settings that Lightning refuses are told in one line."""
        try:
            return super().instantiate_trainer(**kwargs)
        except (ImportError, ValueError) as error:
            raise InputError(str(error)) from error

    def after_instantiate_classes(self) -> None:
        """All files of a run lie in one folder."""
        for callback in self.trainer.checkpoint_callbacks:
            if isinstance(callback, ModelCheckpoint) and callback.dirpath is None:
                callback.dirpath = str(self._checkpoints)

    def before_fit(self) -> None:
        """What cannot work is told before the work."""
        asked = self.config[self.subcommand]["trainer"]
        if asked["max_steps"] == -1 and asked["max_epochs"] in (None, -1) and not asked["fast_dev_run"]:
            raise InputError("the training has no end; expected trainer.max_steps or trainer.max_epochs")
        if 0 in (asked["max_steps"], asked["max_epochs"]):
            raise InputError("the training has no steps; expected trainer.max_steps above 0")
        if asked["overfit_batches"]:
            raise InputError("trainer.overfit_batches is not for clips; expected trainer.limit_train_batches")
        root = Path(self.trainer.default_root_dir)
        make_output_folder(root)
        if asked["fast_dev_run"]:  # leaves an earlier run as it is
            writers = (ModelCheckpoint, MapExport)
            self._callbacks[:] = [one for one in self._callbacks if not isinstance(one, writers)]
        elif (root / "map.safetensors").exists() and not self.config[self.subcommand].get("ckpt_path"):
            log.warning("%s holds an earlier run, which this one replaces", root)

    def after_fit(self) -> None:
        """Tell of the map."""
        for callback in self._callbacks:
            if isinstance(callback, MapExport) and callback.written is not None:
                path, certificate = callback.written
                print(f"{describe(certificate)}\nwritten to {path}; `dejavu compare --map` judges it")

    def instantiate_classes(self) -> None:
        """What a part's constructor refuses is told in one line."""
        try:
            super().instantiate_classes()
        except Exception as error:
            raise refusal(error) from error

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Parts that are our own unless another class is named, so that their options can be given alone."""
        parser.set_defaults({name: {"class_path": path} for name, path in PARTS.items()})

    @property
    def _callbacks(self) -> list[Callback]:
        found: list[Callback] = self.trainer.callbacks  # type: ignore[attr-defined]
        return found

    @property
    def _checkpoints(self) -> Path:
        return Path(self.trainer.default_root_dir) / "checkpoints"

    def before_validate(self) -> None:
        """See `_find_checkpoint`."""
        self._find_checkpoint()

    def before_test(self) -> None:
        """See `_find_checkpoint`."""
        self._find_checkpoint()

    def _find_checkpoint(self) -> None:
        """Without --ckpt_path the last checkpoint of the folder is judged, never untrained weights."""
        chosen = self.config[self.subcommand]
        if chosen.get("ckpt_path"):
            return
        last = self._checkpoints / "last.ckpt"
        if not last.is_file():
            raise InputError(
                f"there is no {last}; expected --ckpt_path, or the trainer.default_root_dir of a training"
            )
        self.config_init[self.subcommand]["ckpt_path"] = str(last)


def run_train(arguments: Sequence[str]) -> None:
    """Run `dejavu train ARGUMENTS`.

    Raises:
        InputError: what the command line, the config or the data get wrong.
    """
    for name in ("pytorch_lightning", "lightning_fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for told in (
        "args parameter is intended",
        "num_workers",
        "tensorboard",
        "training batches",
        "isinstance.treespec",
        "exists and is not empty",
        "not supported by the model summary",
        "in eval mode at the start of training",
    ):
        warnings.filterwarnings("ignore", f".*{told}.*")
    last = ModelCheckpoint(
        save_last=True, filename="{step}", enable_version_counter=False, save_on_train_epoch_end=True
    )
    try:
        TrainCLI(
            PlaceRecognitionTask,
            RouteData,
            args=list(arguments),
            parser_kwargs={"prog": "dejavu train", "description": "Train features that repeat, end to end."},
            seed_everything_default=0,
            trainer_defaults=DEFAULTS | {"callbacks": [last, MapExport()]},
            save_config_callback=SaveConfigCallback,
            save_config_kwargs={"overwrite": True},
        )
    except RuntimeError as error:
        told = " ".join(str(error).split())[:300]
        if "loading state_dict" in told:
            told = f"the checkpoint is of another model than the config's: {told}"
        elif "Early stopping conditioned" not in told:
            raise
        raise InputError(told) from error
    except KeyError as error:
        if "pytorch-lightning_version" not in str(error):
            raise
        raise InputError(
            "the checkpoint is none of a training; expected one that `dejavu train fit` wrote"
        ) from error
    except MisconfigurationException as error:
        raise InputError(str(error)) from error
    except UnpicklingError as error:
        raise InputError(
            "the checkpoint cannot be read; expected one that `dejavu train fit` wrote"
        ) from error
    except SystemExit as error:
        if isinstance(error.__context__, KeyboardInterrupt):  # Lightning would have it be a failure
            raise KeyboardInterrupt from error
        raise
