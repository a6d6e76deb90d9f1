"""Free memory, tensors in temporary files, the type of new ones, and threads."""

from __future__ import annotations

import functools
import math
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ParamSpec, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch._C._functorch import is_functorch_wrapped_tensor
from torch.autograd import forward_ad

from dejavu_torch.types import InputError, expect

P = ParamSpec("P")
R = TypeVar("R")

IN_MEMORY = 2**29  # bytes of features that are kept in memory
SMALL = 2**20  # numbers of an operation that one thread computes as fast as several that are disturbed


@contextmanager
def in_float32() -> Iterator[None]:
    """In the block new tensors are float32, whatever the user's default."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def in_one_thread(numbers: float = 0) -> Iterator[None]:
    """In the block torch computes in one thread, unless its operations have 2^20 numbers or more.

    Of two threads each operation is as slow as the one that another program disturbs, which is many times
    slower. And the rounding of matrix products depends on the number of threads. A Python thread that begins
    to compute meanwhile has one from then on: torch gives it what was set last.
    """
    before = torch.get_num_threads()
    if numbers >= SMALL or before == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def without_autocast(function: Callable[P, R]) -> Callable[P, R]:
    """A function of tensors, computed in their own types under any autocast."""

    @functools.wraps(function)
    def exact(*args: P.args, **kwargs: P.kwargs) -> R:
        devices = [arg.device.type for arg in (*args, *kwargs.values()) if isinstance(arg, Tensor)]
        # is_compiling: older versions of torch do not compile the question
        if not devices or not (torch.compiler.is_compiling() or torch.amp.is_autocast_available(devices[0])):
            return function(*args, **kwargs)
        with torch.autocast(devices[0], enabled=False):
            return function(*args, **kwargs)

    return exact


def is_plain(tensor: Tensor) -> bool:
    """Whether a number can be read from a tensor: it is neither traced nor transformed by torch.func, and has
    no tangent."""
    if torch.compiler.is_compiling() or type(tensor) not in (Tensor, nn.Parameter):
        return False
    return not is_functorch_wrapped_tensor(tensor) and forward_ad.unpack_dual(tensor).tangent is None


def is_readable(*tensors: Tensor) -> bool:
    """Whether all are plain and on the CPU, so that nothing waits for a device."""
    return all(is_plain(tensor) and tensor.device.type == "cpu" for tensor in tensors)


def free_memory() -> float:
    """Bytes that the system has available, whatever limits a container sets; inf if unknown."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, StopIteration):  # another system
        known = hasattr(os, "sysconf")
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")) if known else math.inf


def check_room(needed: float, what: str) -> None:
    """Refuse what needs more bytes than are free; the message begins with `what`.

    Example:
        >>> check_room(10**6, "a strip of 1000 x 1000 pixels")
    """
    free = free_memory()
    expect(needed <= free, f"at most the {_size(free)} free", f"{what} takes {_size(needed)}")


def _size(number: float) -> str:
    return f"{number / 1e9:.3g} GB" if number >= 1e9 else f"{max(number, 0) / 1e6:.3g} MB"


def empty(
    rows: int,
    columns: int,
    device: torch.device,
    in_memory: int = IN_MEMORY,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Uninitialised (rows,columns); on the CPU, more than `in_memory` bytes are in an unnamed temporary file.
    InputError if there is no room for it."""
    size = dtype.itemsize * rows * columns
    if device.type != "cpu" or size <= in_memory:
        return torch.empty(rows, columns, dtype=dtype, device=device)
    try:
        with tempfile.TemporaryFile() as file:
            if hasattr(os, "posix_fallocate"):  # a full disk would end the process later
                os.posix_fallocate(file.fileno(), 0, size)
            kind = str(dtype).removeprefix("torch.")
            return torch.from_numpy(np.memmap(file, kind, "w+", shape=(rows, columns)))
    except OSError as error:
        seen = f"{rows} x {columns} numbers do not fit into a temporary file: {error.strerror}"
        raise InputError(f"{seen}; expected room there, or TMPDIR set to a folder with room") from error


def concatenate(
    batches: Iterable[Tensor], rows: int, in_memory: int = IN_MEMORY, half: bool = False
) -> Tensor:
    """Batches (B,D) of one dtype, which have so many rows in all, as one tensor, see `empty`.

    Args:
        in_memory: bytes; more are in a file, on the CPU, also of batches elsewhere.
        half: whether a file holds float16.

    Raises:
        InputError: batches of different D or dtype, none at all, another number of rows, or no room for a
            file.
    """
    whole, kind, first = None, (0, torch.float32), 0
    for batch in batches:
        columns, dtype = batch.shape[1], batch.dtype
        if whole is None:
            whole, kind = _room(rows, batch, in_memory, half), (columns, dtype)
        before = f"{kind[0]} of {kind[1]} as before"
        expect(kind == (columns, dtype), before, f"features {first}.. are {columns} of {dtype}")
        last = first + len(batch)
        expect(last <= rows, f"{rows}, as announced", f"there are {last} features")
        whole[first:last] = batch
        first = last
    if whole is None or first != rows:
        raise InputError(f"the features are {first}; expected {rows or 'at least one batch'}")
    return whole


def _room(rows: int, like: Tensor, in_memory: int, half: bool) -> Tensor:
    """Room for rows like those of a tensor."""
    columns = like.shape[1]
    if rows * columns * like.itemsize <= in_memory:
        return torch.empty(rows, columns, dtype=like.dtype, device=like.device)
    return empty(rows, columns, torch.device("cpu"), 0, torch.float16 if half else like.dtype)
