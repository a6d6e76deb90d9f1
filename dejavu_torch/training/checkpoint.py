"""Checkpoints: written completely or not at all, read as data and never as code, refused if damaged."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import ZIP_STORED, ZipFile

import torch
from lightning_fabric.plugins.io.torch_io import TorchCheckpointIO
from torch import Tensor

from dejavu_torch.data.files import LARGEST, check_regular
from dejavu_torch.data.output import make_output_folder, whole_file
from dejavu_torch.maps.place_map import EXTRA
from dejavu_torch.text import one_line
from dejavu_torch.types import InputError

EXPECTED = "expected a checkpoint that `dejavu train fit` wrote"
KEYS: dict[str, type] = {  # that every reader needs; the others are Lightning's
    **{"pytorch-lightning_version": str, "epoch": int, "global_step": int, "state_dict": dict},
    **{"stages": list, "stage": int, "began": int, "trained": list, "routes": list, "held": list},
}
MAX_PARTS = 10**6  # of nested containers


class CheckpointFiles(TorchCheckpointIO):
    """Lightning's plugin that writes and reads the checkpoints of a `PlaceRecognitionTask`.

    A full disk or a kill leaves the previous file in place. A damaged or foreign file is refused, and code in
    a file is never run: `weights_only` is always true.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None
    ) -> None:
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
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """See `read_checkpoint`; the other arguments are ignored."""
        return read_checkpoint(path)


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """The content of a checkpoint, on the CPU; a missing, damaged, oversized or foreign file is refused."""
    path = Path(path)
    size = check_regular(path, EXPECTED.removeprefix("expected "))
    try:
        _check_archive(path, size)
        checkpoint: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        _check_content(checkpoint, size)
    except InputError as error:
        raise InputError(f"{path} {error}; {EXPECTED}") from error
    except Exception as error:  # zipfile and torch raise all kinds of exceptions on a bad file
        cause = "it holds more than tensors and plain data"
        cause = cause if isinstance(error, UnpicklingError) else cause_of(error)
        raise InputError(f"{path} cannot be read: {cause}; {EXPECTED}") from error
    return checkpoint


def _check_archive(path: Path, size: int) -> None:
    """Refuse wrong checksums, which torch does not check, and content larger than the file."""
    with ZipFile(path) as archive:
        records = archive.infolist()
        packed = any(record.compress_type != ZIP_STORED for record in records)
        if packed or sum(record.file_size for record in records) > size:
            raise InputError("claims more bytes than it holds")
        if damaged := archive.testzip():
            raise InputError(f"is damaged: {damaged} has a wrong checksum")
        pickles = [archive.read(one) for one in records if one.filename.endswith("data.pkl")]
    if any(b"cbuiltins\nbytearray\n" in one for one in pickles):  # torch would allocate any size
        raise InputError("claims more bytes than it holds")


def _check_content(checkpoint: Any, size: int) -> None:
    """Refuse content that is no checkpoint of a training; `size` is that of the file in bytes."""
    if not isinstance(checkpoint, dict):
        raise InputError(f"is of type {type(checkpoint).__name__}")
    for key, kind in KEYS.items():
        value = checkpoint.get(key)
        whole = isinstance(value, kind) and not isinstance(value, bool)
        if not whole or (isinstance(value, int) and not 0 <= value < LARGEST):
            raise InputError(f"has {key} {str(value)[:40]}, not of type {kind.__name__} and in range")
    for name, value in checkpoint["state_dict"].items():
        if not isinstance(name, str) or not (isinstance(value, Tensor) or name.endswith(EXTRA)):
            raise InputError(f"has {str(name)[:80]!r} in its state_dict, which is not a tensor")
    for tensor in (leaf for leaf in _leaves(checkpoint) if isinstance(leaf, Tensor)):
        dense = tensor.layout == torch.strided and tensor.device.type == "cpu" and not tensor.is_quantized
        held = min(size, tensor.untyped_storage().nbytes()) if dense else 0
        if not dense or tensor.numel() * tensor.element_size() > held:
            raise InputError(f"has a tensor {tuple(tensor.shape)} that is larger than the file")


def _leaves(value: Any) -> Iterator[Any]:
    """The leaves of nested containers; too many parts, as of a cycle, are refused."""
    stack, count = [value], 0
    while stack:
        part, count = stack.pop(), count + 1
        if count > MAX_PARTS:
            raise InputError(f"has more than {MAX_PARTS} parts")
        if isinstance(part, dict | list | tuple | set):
            stack.extend(part.values() if isinstance(part, dict) else part)
        else:
            yield part


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
        problem = f"does not fit this training; {EXPECTED}"
        if "loading state_dict" in str(error):
            problem = "is of another model than the config's"
        raise InputError(f"the checkpoint {path} {problem} ({cause_of(error)})") from error


def cause_of(error: Exception) -> str:
    """An exception in one short line."""
    return one_line(f"{type(error).__name__} {error}")[:300]
