"""All features of a traverse at once, in memory or in a temporary file."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from typing import IO

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.types import InputError

IN_MEMORY = 2**29  # bytes
BLOCK = 2**26  # bytes: so large a tensor goes back to the system once it is freed, a batch may not


def concatenate(batches: Iterable[Tensor], in_memory: int = IN_MEMORY, half: bool = False) -> Tensor:
    """The batches as one tensor, which may be larger than the memory.

    Args:
        batches: each (B,D), one number type.
        in_memory: about how many bytes to keep in memory. More spill to a temporary file without a name,
            which the tensor then maps: rows are read when they are used.
        half: whether the file holds float16.

    Shape: (B,D), ... -> (N,D); on the CPU if it spilled.

    Raises:
        InputError: batches of different D or number type, none at all, or no room for the file.
    """
    parts: list[Tensor] = []
    file: IO[bytes] | None = None
    like, rows, held = None, 0, 0
    joined, loose = 0, 0  # parts that are blocks already, and bytes of the others
    for batch in batches:
        like = batch[:0] if like is None else like
        if batch.shape[1:] != like.shape[1:] or batch.dtype != like.dtype:
            raise InputError(
                f"features {rows}.. are {batch.shape[1]} of {batch.dtype}; "
                f"expected {like.shape[1]} of {like.dtype} as before"
            )
        parts.append(batch)
        rows, held, loose = rows + len(batch), held + batch.nbytes, loose + batch.nbytes
        if held > in_memory:
            file = _spilled(parts, file, half)
            parts, held, joined, loose = [], 0, 0, 0
        elif loose > BLOCK:
            parts[joined:] = [torch.cat(parts[joined:])]
            joined, loose = len(parts), 0
    if like is None:
        raise InputError("there are no features; expected at least one batch")
    if file is None:
        whole, start = like.new_empty(rows, like.shape[1]), 0  # torch.cat would hold all of them twice
        while parts:
            part = parts.pop(0)
            whole[start : start + len(part)] = part
            start += len(part)
        return whole
    _spilled(parts, file, half)
    kind = np.float16 if half else like.cpu().numpy().dtype
    # copy on write: the tensor may be written to, the file never is
    return torch.from_numpy(np.memmap(file, kind, "c", shape=(rows, like.shape[1])))


def _spilled(parts: list[Tensor], file: IO[bytes] | None, half: bool) -> IO[bytes]:
    """The file, a new one if there is none, with the parts at its end."""
    try:
        file = tempfile.TemporaryFile() if file is None else file  # noqa: SIM115, it goes with the tensor
        for part in parts:
            file.write((part.half() if half else part).cpu().contiguous().numpy().data)
        file.flush()
    except OSError as error:
        raise InputError(
            f"the features do not fit into a temporary file: {error.strerror}; "
            "expected room there, or TMPDIR set to a folder with room"
        ) from error
    return file
