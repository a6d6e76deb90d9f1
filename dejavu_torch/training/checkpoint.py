"""Checkpoints: written completely or not at all, and read as data, never as code."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from zipfile import ZipFile

import torch
from lightning_fabric.plugins.io.torch_io import TorchCheckpointIO
from pytorch_lightning import LightningModule, Trainer
from pytorch_lightning.callbacks import ModelCheckpoint

from dejavu_torch.data.files import check_regular
from dejavu_torch.data.output import make_output_folder, whole_file
from dejavu_torch.text import one_line
from dejavu_torch.types import Facts, InputError

EXPECTED = "expected a checkpoint that `dejavu train fit` wrote"
KEYS = {"epoch": int, "global_step": int, "state_dict": dict, "task": str, "routes": list, "held": list}


class CheckpointFiles(TorchCheckpointIO):
    """Lightning's plugin that writes and reads checkpoints. A full disk or a kill leaves the previous file in
    place, a damaged file is refused, and code in a file is never run: `weights_only` is always true."""

    def save_checkpoint(self, checkpoint: Facts, path: str | Path, storage_options: object = None) -> None:
        """Write a checkpoint; URLs are left to Lightning."""
        if storage_options is not None or "://" in str(path):
            super().save_checkpoint(checkpoint, path, storage_options)
            return
        make_output_folder(Path(path).parent)
        buffer = io.BytesIO()  # torch.save to a file does not report a full disk
        torch.save(checkpoint, buffer)
        with whole_file(Path(path)) as temporary:
            temporary.write_bytes(buffer.getbuffer())

    def load_checkpoint(
        self, path: str | Path, map_location: object = None, weights_only: bool | None = None
    ) -> Facts:
        """See `read_checkpoint`; the other arguments are ignored."""
        return read_checkpoint(path)


class LastCheckpoint(ModelCheckpoint):
    """`last.ckpt` in a folder: at intervals, at the end, and, unlike Lightning's, the only file after an
    exception too."""

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Save the last step of a training."""
        if trainer.state.fn == "fit" and trainer.global_step and not trainer.sanity_checking:
            trainer.save_checkpoint(Path(str(self.dirpath)) / "last.ckpt")


def read_checkpoint(path: str | Path) -> Facts:
    """The content of a checkpoint, on the CPU; a missing, damaged or foreign file is refused."""
    check_regular(Path(path), EXPECTED.removeprefix("expected "))
    try:
        with ZipFile(path) as archive:  # torch does not look at checksums
            if damaged := archive.testzip():
                raise InputError(f"{path} is damaged: {damaged} has a wrong checksum; {EXPECTED}")
        checkpoint: Facts = torch.load(path, map_location="cpu", weights_only=True)
        missing = [key for key, kind in KEYS.items() if not isinstance(checkpoint.get(key), kind)]
    except InputError:
        raise
    except Exception as error:  # zipfile and torch raise all kinds of exceptions on a bad file
        cause = "it holds more than tensors and plain data"
        cause = cause if isinstance(error, UnpicklingError) else cause_of(error)
        raise InputError(f"{path} cannot be read: {cause}; {EXPECTED}") from error
    if missing:
        raise InputError(f"{path} has no {missing[0]}; {EXPECTED}")
    return checkpoint


@contextmanager
def taking_over(path: object, still: Callable[[], bool] = lambda: True) -> Iterator[None]:
    """Turn any exception of the block, while `still()` is true, into an InputError about the checkpoint."""
    try:
        yield
    except (InputError, OSError):
        raise
    except Exception as error:
        if not still():
            raise
        raise InputError(
            f"the checkpoint {path} does not fit this training; {EXPECTED} ({cause_of(error)})"
        ) from error


def cause_of(error: Exception) -> str:
    """An exception in one short line."""
    return one_line(f"{type(error).__name__} {error}")[:300]
