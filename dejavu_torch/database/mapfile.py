"""One safetensors file for a map: tensors, and JSON that says what they are. No pickle, no code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from dejavu_torch.data.files import whole_file
from dejavu_torch.types import InputError

FORMAT = 6
NAME = "dejavu_torch-map"
EXPECTED = "a map file, as DejaVu.save writes"


def metadata_of(header: dict[str, Any]) -> dict[str, str]:
    """The file's metadata: the format and its version, and the header as JSON under `config`."""
    return {"format": NAME, "version": str(FORMAT), "config": json.dumps(header)}


def map_size(tensors: dict[str, Tensor], header: dict[str, Any]) -> int:
    """Bytes of the file that `write_map` writes."""
    return len(safetensors.torch.save(_plain(tensors), metadata_of(header)))


def write_map(path: Path, tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    """Write the file whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    with whole_file(path) as temporary:
        try:
            safetensors.torch.save_file(_plain(tensors), temporary, metadata_of(header))
        except SafetensorError as error:
            raise InputError(f"{path} was not written: {error}") from error


def _plain(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """As safetensors takes them: whole, and none in another's memory."""
    plain: dict[str, Tensor] = {}
    taken: set[int] = set()
    for name, tensor in tensors.items():
        tensor = tensor.detach().cpu().contiguous()
        memory = tensor.untyped_storage()
        if memory.data_ptr() in taken or memory.nbytes() != tensor.nbytes:
            tensor = tensor.clone()
        taken.add(tensor.untyped_storage().data_ptr())
        plain[name] = tensor
    return plain


def read_map(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and header of a map file.

    Raises:
        InputError: missing, truncated, foreign, or of another format.
    """
    if path.is_dir():
        raise InputError(f"{path} is a folder; expected {EXPECTED}")
    if not path.is_file():
        raise InputError(f"{path} is not there; expected {EXPECTED}")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != NAME:
                raise InputError(f"{path} is no map of dejavu_torch; expected {EXPECTED}")
            version = int(metadata["version"])
            if version != FORMAT:
                newer = "a newer dejavu_torch is needed" if version > FORMAT else "learn the route again"
                raise InputError(f"{path} has map format {version}; this version reads {FORMAT}: {newer}")
            header = json.loads(metadata["config"])
            if not isinstance(header, dict):
                raise ValueError("the header is no mapping")
            return {name: file.get_tensor(name) for name in file.keys()}, header  # noqa: SIM118
    except InputError:
        raise
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is truncated or no map file ({error}); expected a whole one") from error
