"""Checkpoints: written whole or not at all; read as data, never as code, and refused where damaged."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import ZIP_STORED, BadZipFile, ZipFile

import pytorch_lightning as pl
import torch
from lightning_fabric.plugins.io.torch_io import TorchCheckpointIO
from torch import Tensor

from dejavu_torch.data.files import check_regular
from dejavu_torch.data.output import make_output_folder, whole_file
from dejavu_torch.maps.file import checked_fields
from dejavu_torch.maps.place_map import EXTRA
from dejavu_torch.model_file import STATE
from dejavu_torch.text import one_line
from dejavu_torch.types import InputError

EXPECTED = "expected a checkpoint that `dejavu train fit` wrote"
KEYS: dict[str, type] = {  # what every reader needs; the rest is Lightning's, see `check_resumable`
    "pytorch-lightning_version": str,
    "epoch": int,
    "global_step": int,
    "state_dict": dict,
    "stages": list,
    "stage": int,
    "began": int,
    "trained": list,
}
FREE = ("params", "lr", "initial_lr", "weight_decay")  # of an optimizer: the checkpoint's are taken
MOST_PLAIN = 10**6  # numbers and texts beside a model's tensors
MOST = 2**53  # steps, epochs and the like
VERSION = re.compile(r"[2-9]\.\d+(\.\d+)?\S*")  # older ones kept other things


class CheckpointFiles(TorchCheckpointIO):
    """How Lightning writes and reads the checkpoints of a `PlaceRecognitionTask`, whatever asks it to.

    A full disk or a kill leaves the file that was there before. A damaged or foreign file is refused, and no
    code of a file is ever run: `weights_only` is always true.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None
    ) -> None:
        """See Lightning's; a URL is left to it."""
        if storage_options is not None or "://" in str(path):
            super().save_checkpoint(checkpoint, path, storage_options)
            return
        make_output_folder(Path(path).parent)
        buffer = io.BytesIO()  # torch tells of a full disk only where it does not write to it
        torch.save(checkpoint, buffer)
        with whole_file(Path(path)) as temporary:
            temporary.write_bytes(buffer.getbuffer())

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """See `read_checkpoint`; the arguments behind the path count for nothing."""
        return read_checkpoint(path)


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """The content of a checkpoint, on the CPU.

    Raises:
        InputError: no file, one that is damaged, claims more than it holds, or is of something else.
    """
    path = Path(path)
    size = check_regular(path, EXPECTED.removeprefix("expected "))
    try:
        with ZipFile(path) as archive:
            records = archive.infolist()
            packed = any(record.compress_type != ZIP_STORED for record in records)
            if packed or sum(record.file_size for record in records) > size:
                raise InputError(f"{path} claims more bytes than it holds; {EXPECTED}")
            damaged = archive.testzip()  # torch does not look at checksums
            if damaged is not None:
                raise InputError(f"{path} is damaged: {damaged} does not have its checksum; {EXPECTED}")
            pickled = [archive.read(one) for one in records if one.filename.endswith("data.pkl")]
        if any(b"cbuiltins\nbytearray\n" in one for one in pickled):  # of any size, which torch would make
            raise InputError(f"{path} claims more bytes than it holds; {EXPECTED}")
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except BadZipFile as error:
        raise InputError(f"the checkpoint cannot be read: {path} is none, or damaged; {EXPECTED}") from error
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}; {EXPECTED}") from error
    except Exception as error:  # whatever a file can make of zipfile and torch
        told = "it is of more than tensors and plain data"
        told = told if isinstance(error, UnpicklingError) else cause_of(error)
        raise InputError(f"the checkpoint cannot be read: {path}: {told}; {EXPECTED}") from error
    try:
        check_content(checkpoint, size)
    except InputError as error:
        raise InputError(f"{path} is no checkpoint of a training: {error}; {EXPECTED}") from error
    return dict(checkpoint)


def check_content(checkpoint: Any, size: int) -> None:
    """Refuse what is no checkpoint of a training.

    Args:
        size: of its file, in bytes.

    Raises:
        InputError: naming what is missing, of another type or out of range.
    """
    if not isinstance(checkpoint, dict):
        raise InputError(f"it is of type {type(checkpoint).__name__}")
    for key, kind in KEYS.items():
        if key not in checkpoint:
            raise InputError(f"it has no {key}")
        value = checkpoint[key]
        if not isinstance(value, kind) or isinstance(value, bool):
            raise InputError(f"{key} is of type {type(value).__name__}, not {kind.__name__}")
        if isinstance(value, int) and not 0 <= value < MOST:
            raise InputError(f"{key} is {value}")
    if not VERSION.fullmatch(checkpoint["pytorch-lightning_version"]):
        raise InputError("it is of another version of Lightning")
    for key in ("stages", "trained"):
        if not all(isinstance(name, str) for name in checkpoint[key]):
            raise InputError(f"{key} is no list of names")
    if checkpoint["stage"] >= len(checkpoint["stages"]):
        raise InputError(f"it is in stage {checkpoint['stage']} of {len(checkpoint['stages'])}")
    if checkpoint["began"] > checkpoint["global_step"]:
        raise InputError(f"its stage began at step {checkpoint['began']} of {checkpoint['global_step']}")
    for name, value in checkpoint["state_dict"].items():
        if not isinstance(name, str) or not (isinstance(value, Tensor) or name.endswith(EXTRA)):
            raise InputError(f"{str(name)[:80]!r} in its state_dict is no tensor")
        ours = name.startswith("dejavu.") and not name.startswith("dejavu.features.")
        if ours and name.endswith(EXTRA) and not is_plain(value):
            raise InputError(f"{name[:80]} is not of plain numbers and text")
        if name == f"dejavu.{EXTRA}":
            checked_fields(value, STATE, name)
    for tensor in tensors_in(checkpoint):
        dense = tensor.layout == torch.strided and tensor.device.type == "cpu" and not tensor.is_quantized
        held = min(size, tensor.untyped_storage().nbytes()) if dense else 0
        if not dense or tensor.numel() * tensor.element_size() > held:
            raise InputError(f"a tensor {tuple(tensor.shape)} has more numbers than the file")


def is_plain(value: Any) -> bool:
    """Whether a value is of finite numbers, texts, lists and dicts, and no more than a map's header holds."""
    left, count = [value], 0
    while left and count < MOST_PLAIN:
        one, count = left.pop(), count + 1
        if isinstance(one, dict) and all(isinstance(key, str) for key in one):
            left.extend(one.values())
        elif isinstance(one, (list, tuple)):
            left.extend(one)
        elif not (
            one is None or isinstance(one, (str, int)) or (isinstance(one, float) and math.isfinite(one))
        ):
            return False
    return not left


def tensors_in(value: Any) -> Iterator[Tensor]:
    """The tensors of nested containers, each container looked into once."""
    seen: set[int] = set()
    left = [value]
    while left:
        one = left.pop()
        if isinstance(one, Tensor):
            yield one
        elif isinstance(one, (dict, list, tuple, set)) and id(one) not in seen:
            seen.add(id(one))
            left.extend(one.values() if isinstance(one, dict) else one)


def check_resumable(checkpoint: dict[str, Any], trainer: pl.Trainer) -> None:
    """Refuse a checkpoint from which this training cannot go on.

    Args:
        trainer: with the optimizers of the stage that the checkpoint is in.

    Raises:
        InputError: naming what differs from the state that the trainer has itself.
    """
    loops = checkpoint.get("loops")
    given = checkpoint | {"loops": loops.get("fit_loop") if isinstance(loops, dict) else None}
    check_alike(given["loops"], trainer.fit_loop.state_dict(), "loops")
    steps = given["loops"]["epoch_loop.automatic_optimization.optim_progress"]["optimizer"]["step"]
    if steps["total"]["completed"] != checkpoint["global_step"]:
        raise InputError(
            f"the checkpoint is of step {checkpoint['global_step']}, its loops are at "
            f"{steps['total']['completed']}; {EXPECTED}"
        )
    schedules = [config.scheduler.state_dict() for config in trainer.lr_scheduler_configs]
    check_alike(given.get("lr_schedulers"), schedules, "lr_schedulers")
    states = given.get("optimizer_states")
    check_alike(states, [optimizer.state_dict() for optimizer in trainer.optimizers], "optimizer_states")
    for optimizer, state in zip(trainer.optimizers, states or [], strict=True):
        for group, mine in zip(state["param_groups"], optimizer.param_groups, strict=True):
            other = [name for name in group if name not in FREE and group[name] != mine[name]]
            if other:
                raise InputError(
                    f"the checkpoint cannot be resumed: {other[0]} of its optimizer is "
                    f"{str(group[other[0]])[:80]}, in this run {str(mine[other[0]])[:80]}"
                )
        if isinstance(optimizer, torch.optim.Adam):
            parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
            for index, moments in state["state"].items():
                known = type(index) is int and 0 <= index < len(parameters)
                like = parameters[index].detach() if known else torch.zeros(())
                own = {"step": torch.zeros(()), "exp_avg": like, "exp_avg_sq": like} if known else None
                check_alike(moments, own, f"the optimizer's state of parameter {index}")


def check_alike(given: Any, own: Any, where: str) -> None:
    """Refuse other keys, lengths, shapes or types than those of one's own, and numbers out of range.

    An empty dict of one's own is filled as the training goes, and takes any.
    """
    numbers = {type(given), type(own)} == {int, float}
    same = numbers or type(given) is type(own) or (isinstance(given, Tensor) and isinstance(own, Tensor))
    if same and isinstance(own, dict) and own:
        same = given.keys() == own.keys()
    elif same and isinstance(own, (list, tuple)):
        same = len(given) == len(own)
    elif same and isinstance(own, Tensor):
        lowest = -MOST if where.endswith("exp_avg") else 0
        same = given.shape == own.shape and given.is_floating_point()
        same = same and bool(((given >= lowest) & (given < MOST)).all())
    elif same and isinstance(own, (int, float)):
        same = 0 <= given < MOST
    if not same:
        raise InputError(f"the checkpoint cannot be resumed: {where} is not as in this run; {EXPECTED}")
    parts = own if isinstance(own, dict) else range(len(own)) if isinstance(own, (list, tuple)) else ()
    for part in parts:
        check_alike(given[part], own[part], f"{where}.{part}")


@contextmanager
def taking_over(path: object, still: Callable[[], bool] = lambda: True) -> Iterator[None]:
    """Whatever goes wrong in the block is the checkpoint's fault, and told in one line.

    Args:
        still: whether the checkpoint is still being taken over when something goes wrong.
    """
    try:
        yield
    except (InputError, OSError):
        raise
    except Exception as error:
        if not still():
            raise
        if "loading state_dict" in str(error):
            problem = f"it is of another model than the config's: {cause_of(error)}"
        else:
            problem = f"it does not fit this training ({cause_of(error)}); {EXPECTED}"
        raise InputError(f"the checkpoint {path} cannot be taken over: {problem}") from error


def cause_of(error: Exception) -> str:
    """An exception in one short line."""
    return one_line(f"{type(error).__name__} {error}")[:300]
