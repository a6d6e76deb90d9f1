"""`dejavu train`: Lightning's command line for our tasks and data."""

from __future__ import annotations

import logging
import os
import shlex
import sys
import warnings
from collections.abc import Sequence
from functools import partialmethod
from pathlib import Path
from typing import Any, ClassVar

import torch
from jsonargparse import Namespace
from lightning_fabric.utilities.exceptions import MisconfigurationException
from lightning_fabric.utilities.rank_zero import _get_rank
from pytorch_lightning import Trainer
from pytorch_lightning.callbacks import Checkpoint, ModelCheckpoint, ProgressBar, TQDMProgressBar
from pytorch_lightning.cli import LightningArgumentParser, LightningCLI

from dejavu_torch.cli.commands import features_words, print_map, print_next
from dejavu_torch.cli.messages import refusal
from dejavu_torch.cli.networks import with_hub
from dejavu_torch.cli.parser import Parser, Preset
from dejavu_torch.cli.process import interrupts_raise
from dejavu_torch.data.output import check_output_folder, make_output_folder, remove_empty_folders
from dejavu_torch.evaluation.options import several
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.model import DejaVu
from dejavu_torch.text import one_line
from dejavu_torch.training.checkpoint import EXPECTED, LastCheckpoint, taking_over
from dejavu_torch.training.datamodule import RouteData
from dejavu_torch.training.descriptors import DescriptorTask
from dejavu_torch.training.export import DESCRIPTOR, MapExport, has_bf16
from dejavu_torch.training.task import RouteTask, load_weights
from dejavu_torch.training.templates import TemplateTask
from dejavu_torch.types import Facts, InputError, expect

TASKS = DescriptorTask, TemplateTask  # which --model names
BF16 = ("bf16-mixed", "bf16")
EVERY = 500  # steps between two checkpoints
TOLERANCE = 5  # default of `dejavu compare`
TRAINER = {
    "max_steps": 3000,
    "accelerator": "auto",
    "devices": 1,
    "gradient_clip_val": 5.0,
    "check_val_every_n_epoch": None,
    "default_root_dir": "dejavu_train",
    "num_sanity_val_steps": 0,
    "log_every_n_steps": 10,
}
# default classes, whose options can be given without the class
PARTS: dict[str, Facts] = {
    "model": {
        "class_path": f"{DescriptorTask.__module__}.{DescriptorTask.__name__}",
        "init_args": {"backbone": {"class_path": "dejavu_torch.features.cnn.SmallCNN"}},
    },
    "data.augmentation": {"class_path": "dejavu_torch.features.augmentation.Augmentation"},
}
QUIET = (  # warnings of Lightning that need no action
    "args parameter is intended|num_workers|tensorboard|training batches|isinstance.treespec|"
    "exists and is not empty|your dataloader is not resumable|not supported by the model summary|"
    "in eval mode at the start of training|The `srun` command"
)
log = logging.getLogger("dejavu_torch")


class MapTrainer(Trainer):
    """Lightning's trainer, which also writes the map of a checkpoint."""

    words: Sequence[str] = ()  # of the command line, for the next commands to print

    def export(
        self,
        model: RouteTask,
        datamodule: RouteData,
        ckpt_path: str | None = None,
        weights_only: bool | None = None,
    ) -> None:
        """Write the map of a checkpoint.

        Args:
            ckpt_path: the checkpoint; the last one in trainer.default_root_dir if not given.
            weights_only: accepted, since configs have it; no code of a checkpoint is ever run.
        """
        assert ckpt_path is not None  # TrainCLI found one
        self.strategy.connect(model)
        model.trainer, self.datamodule, datamodule.trainer = self, datamodule, self
        datamodule.setup("export")
        model.setup("export")
        load_weights(model, ckpt_path)
        if not model.made:
            log.warning("the map is not calibrated: for templates only `dejavu train fit` does that")
        folder, export = Path(self.default_root_dir), MapExport()
        make_output_folder(folder)
        export.write(model, folder, datamodule if model.made else None)
        print_written(export, datamodule, self.words)


class TrainParser(Parser, LightningArgumentParser):
    """Lightning's parser with errors of one line."""


class TrainCLI(LightningCLI):
    """fit writes DIR/map.safetensors, for several routes DIR/descriptor.safetensors; the others read a
    checkpoint."""

    parsers: ClassVar[dict[str, tuple[LightningArgumentParser, list[str]]]] = {}  # with their arguments

    def __init__(self, args: list[str], **settings: Any) -> None:
        self.words = args
        super().__init__(args=args, **settings)

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        """Lightning's, without predict, which is `dejavu localize`, and with export."""
        every = LightningCLI.subcommands() | {"export": {"model", "datamodule"}}
        return {name: every[name] for name in ("fit", "validate", "test", "export")}

    @staticmethod
    def init_parser(**kwargs: Any) -> LightningArgumentParser:
        """A parser with errors of one line."""
        parser = TrainParser(**kwargs)
        parser.add_argument("-c", "--config", action=Preset, help="preset or YAML file of the options below")
        return parser

    def _prepare_subcommand_parser(self, klass: type, subcommand: str, **kwargs: Any) -> Any:
        """The options of the given subcommand only, which is faster than all four; once in a process."""
        if {*self.words[:1]} & ({*self.subcommands()} - {subcommand}):
            return self.init_parser(**kwargs)
        if subcommand not in self.parsers:
            parser = super()._prepare_subcommand_parser(klass, subcommand, **kwargs)
            self.parsers[subcommand] = parser, self._subcommand_method_arguments[subcommand]
        parser, self._subcommand_method_arguments[subcommand] = self.parsers[subcommand]
        return parser

    @staticmethod
    def add_core_arguments_to_parser(parser: LightningArgumentParser) -> None:
        """Our options, before Lightning's."""
        parser.add_lightning_class_args(RouteTask, "model", subclass_mode=True)
        parser.add_lightning_class_args(RouteData, "data")
        parser.add_lightning_class_args(MapTrainer, "trainer")
        parser.set_defaults({f"trainer.{name}": value for name, value in TRAINER.items()} | PARTS)

    @classmethod
    def stage_parser(cls) -> LightningArgumentParser:
        """The options that all stages share."""
        parser = cls.init_parser()
        cls.add_core_arguments_to_parser(parser)
        parser.add_argument("--ckpt_path", type=Path, help="checkpoint to resume or to use")
        return parser

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Refuse what Lightning fails on later."""
        super().parse_arguments(parser, args)
        chosen = self.config[self.config["subcommand"]]
        for part in ("trainer", "model", "data"):
            expect(isinstance(chosen[part], Namespace), "KEY: VALUE", f"{part} is {chosen[part]!r:.40}")
        trainer, seed = chosen["trainer"], chosen["seed_everything"]
        grads, epochs = trainer["accumulate_grad_batches"], trainer["check_val_every_n_epoch"]
        interval, steps = trainer["val_check_interval"], "a number of at least 1, or -1 for no end"
        for name, value, fits, expected in (
            ("trainer.max_steps", trainer["max_steps"], trainer["max_steps"] is not None, steps),
            ("trainer.strategy", trainer["strategy"], trainer["strategy"] in ("auto", "ddp"), "auto or ddp"),
            ("trainer.val_check_interval", interval, interval != 0, "a number above 0"),
            ("trainer.overfit_batches", trainer["overfit_batches"], not trainer["overfit_batches"], "0"),
            ("trainer.accumulate_grad_batches", grads, grads >= 1, "at least 1"),
            ("trainer.check_val_every_n_epoch", epochs, epochs is None or epochs >= 1, "at least 1"),
            ("seed_everything", seed, seed is None or 0 <= seed < 2**32, "a number from 0 to 2^32 - 1"),
        ):
            expect(fits, expected, f"{name} is {value!s:.40}")
        if trainer["num_nodes"] != 1 and not {"MASTER_ADDR", "SLURM_JOB_ID"} & os.environ.keys():
            raise InputError(  # the machines would wait for each other forever
                f"trainer.num_nodes is {trainer['num_nodes']}, but no address of the first is set; expected "
                "MASTER_ADDR, MASTER_PORT and NODE_RANK in the environment, as torchrun and SLURM set them"
            )

    def _parse_ckpt_path(self) -> None:
        """Do nothing: Lightning would read settings from the checkpoint, and import the classes it names."""

    def before_instantiate_classes(self) -> None:
        """Use one device, and validate at the end by default."""
        trainer = self.config[self.subcommand]["trainer"]
        trainer["devices"] = 1 if trainer["devices"] == "auto" else trainer["devices"]
        if trainer["check_val_every_n_epoch"] is None and trainer["val_check_interval"] is None:
            trainer["val_check_interval"] = trainer["max_steps"] if trainer["max_steps"] > 0 else EVERY

    def instantiate_classes(self) -> None:
        """Report the errors of constructors in one line."""
        try:
            super().instantiate_classes()
        except Exception as error:
            raise refusal(error) from error

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """A trainer with our callbacks."""
        asked = self.config_init[self.subcommand]["trainer"]
        own, folder = several(asked["callbacks"]), str(Path(asked["default_root_dir"]) / "checkpoints")
        for callback in own:
            if isinstance(callback, ModelCheckpoint) and callback.dirpath is None:
                callback.dirpath = folder  # with all files of a run
        if self.subcommand == "fit" and not asked["fast_dev_run"]:  # a trial keeps an earlier run
            own.append(MapExport())
            if asked["enable_checkpointing"] is not False and not any(isinstance(c, Checkpoint) for c in own):
                own.append(LastCheckpoint(folder, save_last=True, save_top_k=0, every_n_train_steps=EVERY))
        bars = asked["enable_progress_bar"] in (None, True)
        if bars and not sys.stderr.isatty() and not any(isinstance(c, ProgressBar) for c in own):
            own.append(TQDMProgressBar(refresh_rate=EVERY))  # lines of a log
        accelerators = torch.cuda.is_available() or torch.backends.mps.is_available()
        on_cpu = asked["accelerator"] == "cpu" or (asked["accelerator"] == "auto" and not accelerators)
        if asked["precision"] in BF16 and on_cpu and not has_bf16():
            log.warning("this processor seems to lack bfloat16: float32 is used, which is faster")
            kwargs["precision"] = "32-true"
        trainer = super().instantiate_trainer(callbacks=own, **kwargs)
        trainer.words = self.words  # type: ignore[attr-defined]  # a MapTrainer
        return trainer

    def before_fit(self) -> None:
        """Refuse early what cannot work."""
        asked = self.config[self.subcommand]["trainer"]
        if asked["max_steps"] == -1 and asked["max_epochs"] in (None, -1) and not asked["fast_dev_run"]:
            raise InputError("the training has no end; expected trainer.max_steps or trainer.max_epochs")
        if 0 in (asked["max_steps"], asked["max_epochs"]):
            raise InputError("the training has no steps; expected trainer.max_steps above 0")
        root = Path(self.trainer.default_root_dir)
        check_output_folder(root)
        resumed = self.config_init[self.subcommand].get("ckpt_path") is not None
        if resumed:
            self.before_validate()
        if not asked["fast_dev_run"] and (root / self._written).exists() and not resumed:
            log.warning("%s holds an earlier run, which this one replaces", root)

    def fit(self, **arguments: object) -> None:
        """Train, and print what was written, even if the user interrupts."""
        root, failed = self.trainer.default_root_dir, False
        try:
            with interrupts_raise():
                self._run("fit", **arguments)
        except InputError:
            failed = True
            raise
        except OSError as error:
            failed = True
            raise InputError(f"the training in {root} has failed: {error.strerror or error}") from error
        finally:
            for callback in self.trainer.callbacks:  # type: ignore[attr-defined]
                if isinstance(callback, MapExport):
                    print_written(callback, self.datamodule, self.words)
            tried = self.config_init[self.subcommand]["trainer"]["fast_dev_run"]
            if tried and self.trainer.is_global_zero and self.trainer.global_step:
                steps = self.trainer.global_step
                print(f"fast_dev_run: {steps} steps and {steps} batches of validation; nothing was written")
            last = self._last_checkpoint() if self.trainer.is_global_zero else None
            if self.trainer.interrupted and last is not None and not failed:
                print_next("train", *self.words, "--ckpt_path", last, lead="to go on")

    def _run(self, stage: str, **arguments: object) -> None:
        """Run a stage; after a failure remove new folders with nothing but Lightning's config."""
        root = Path(self.trainer.default_root_dir)
        new = [folder for folder in (root, *root.parents) if not folder.exists()]
        try:
            with taking_over(arguments.get("ckpt_path"), lambda: self.model.resumed):
                getattr(self.trainer, stage)(**arguments)
        except Exception:
            files = [path for path in root.rglob("*") if path.is_file()] if new else []
            if [path.name for path in files] == ["config.yaml"]:
                files[0].unlink()
            if new:
                remove_empty_folders(new[-1])
            raise

    validate, test = partialmethod(_run, "validate"), partialmethod(_run, "test")

    def before_validate(self) -> None:
        """Without --ckpt_path use the last checkpoint of the folder, never untrained weights."""
        chosen, last = self.config_init[self.subcommand], self._last_checkpoint()
        if chosen.get("ckpt_path") not in (None, "", "last"):
            path = chosen["ckpt_path"]  # Lightning's words for a checkpoint have no meaning here
            if path in ("best", "hpc") or not Path(path).exists():
                raise InputError(f"{path} is not there; {EXPECTED}")
            return
        seen = f"there is no checkpoint in {Path(self.trainer.default_root_dir) / 'checkpoints'}"
        expect(last is not None, "--ckpt_path, or the trainer.default_root_dir of a training", seen)
        chosen["ckpt_path"] = str(last)

    before_test = before_export = before_validate

    def after_validate(self) -> None:
        """Print the name of the checkpoint and the next command."""
        if not self.trainer.is_global_zero:
            return
        checkpoint = self.config_init[self.subcommand]["ckpt_path"]
        written = Path(self.trainer.default_root_dir) / self._written
        print(f"figures of {checkpoint}{self._limited()}")
        if written.is_file():
            print_what_next(written, self.datamodule, self.model.dejavu, self.words)
        else:
            print_next("train", "export", *self.words[1:], "--ckpt_path", checkpoint)

    after_test = after_validate

    def _limited(self) -> str:
        """What part of the queries the figures are of, if not of all."""
        stage = "test" if self.subcommand == "test" else "val"
        limit = self.config_init[self.subcommand]["trainer"][f"limit_{stage}_batches"]
        whole = limit is None or (isinstance(limit, float) and limit == 1)
        return "" if whole else f", of a part of the queries (trainer.limit_{stage}_batches is {limit:g})"

    @property
    def _written(self) -> str:
        return DESCRIPTOR if len(self.datamodule.listed["source"]) > 1 else "map.safetensors"

    def _last_checkpoint(self) -> Path | None:
        found = Path(self.trainer.default_root_dir).glob("checkpoints/*.ckpt")
        return max(found, key=lambda path: path.stat().st_mtime, default=None)


def print_written(export: MapExport, data: RouteData, words: Sequence[str]) -> None:
    """Print what was written, its figures if they are known, and the next command."""
    if export.written is None:
        return
    path, model = export.written
    print_map(model)
    if export.scores:
        on = unseen_of(data) or "augmented frames of segments that training never saw"
        print(f"written to {path}; on {on}, within {data.tolerance}:")
        for name, one in export.scores.items():
            print(f"  {name:20} AUC {one.auc:.3f}, recall@1 {one.recall_at_1:.3f}")
    elif model.map.places:
        seen, another = "augmented copies of its own frames", "a second"
        if data.sources["second"]:
            seen, another = "augmented frames of both visits", "a third"
        print(f"written to {path}; trained on {seen}, so only {another} visit shows its accuracy:")
    else:
        print(f"written to {path}")
    print_what_next(path, data, model, words)


def unseen_of(data: RouteData) -> object:
    """The traverse to validate on, else the one to test on, else None."""
    return data.sources["validation"] or data.sources["query"]


def print_what_next(path: Path, data: RouteData, model: DejaVu, words: Sequence[str]) -> None:
    """Print the command that evaluates a map, or learns one with a descriptor.

    Args:
        words: of the command line, which name a backbone that no map may name.
    """
    option = "--model.backbone"
    if type(model.features) is Embedding:  # the map has its settings, except those of the network
        option += ".network"
    features = features_words(model, shlex.join(["train", *with_hub(words)]), option)
    if len(data.listed["source"]) > 1:
        print_next("learn", "ROUTE", "--descriptor", path, *features, "--map", "route.safetensors")
        return
    truth = data.truths["validation" if data.sources["validation"] is not None else "query"][0]
    judged: list[object] = [] if truth is None else ["--truth", truth]
    judged += ["--tolerance", data.tolerance] if data.tolerance != TOLERANCE else []
    pair = data.sources["source"], unseen_of(data) or "SECOND"
    print_next("compare", *pair, "--map", path, *features, *judged, "--out", "report")


def run_train(arguments: Sequence[str]) -> None:
    """Run `dejavu train ARGUMENTS`.

    Raises:
        InputError: a mistake in the command line, the config or the data.
    """
    for name in ("pytorch_lightning", "lightning_fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    if _get_rank():  # only the first process prints
        log.setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", f".*({QUIET})")
    try:
        TrainCLI(
            list(arguments),
            model_class=RouteTask,
            subclass_mode_model=True,
            datamodule_class=RouteData,
            trainer_class=MapTrainer,
            parser_kwargs={"prog": "dejavu train", "description": "Train features that repeat, end to end."},
            seed_everything_default=0,
            save_config_kwargs={"overwrite": True},
            load_from_checkpoint_support=False,  # which would write out the config for each part
        )
    except InputError:
        if _get_rank():  # the first process reports it
            raise SystemExit(2) from None
        raise
    except RuntimeError as error:
        if "Early stopping conditioned" not in str(error):
            raise
        raise InputError(one_line(error)[:300]) from error
    except MisconfigurationException as error:
        raise InputError(str(error)) from error
    except SystemExit as error:
        if isinstance(error.__context__, KeyboardInterrupt):  # Lightning exits as after a failure
            raise KeyboardInterrupt from error
        raise
