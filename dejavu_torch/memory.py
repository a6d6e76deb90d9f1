"""How much memory there is, so that what cannot fit is refused before it is made."""

from __future__ import annotations

import math
import os
import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.types import InputError

GROUPS = Path("/sys/fs/cgroup")  # the limits of containers, jobs and services
OWN = Path("/proc/self/cgroup")  # which of them the process is in
CACHES = ("inactive_file", "active_file", "slab_reclaimable")  # given back if memory is short


def free_memory() -> float:
    """Bytes the process can still get: what the system has and its limits allow; inf if nothing says."""
    return min(_of_system(), _of_container(), _of_process())


def check_room(needed: float, what: str) -> None:
    """Refuse what does not fit into memory.

    Args:
        needed: bytes. what: it is, as the message begins.

    Raises:
        InputError: with both numbers.

    Example:
        >>> check_room(10**6, "a strip of 1000 x 1000 pixels")
    """
    free = free_memory()
    if needed > free:
        raise InputError(f"{what} takes {_size(needed)}; expected at most the {_size(free)} free")


def empty(rows: int, columns: int, device: torch.device, in_memory: int = 2**29) -> Tensor:
    """Room for a tensor that may be larger than the memory: on the CPU it then lies in a temporary file.

    Args:
        in_memory: bytes, at most. The file has no name and goes with the tensor or the process.

    Shape: (rows,columns) float32.

    Raises:
        InputError: no room for the file.

    Example:
        >>> empty(3, 2, torch.device("cpu")).shape
        torch.Size([3, 2])
    """
    size = 4 * rows * columns
    if device.type != "cpu" or size <= in_memory:
        return torch.empty(rows, columns, device=device)
    try:
        with tempfile.TemporaryFile() as file:
            if hasattr(os, "posix_fallocate"):  # a full disk would end the process later
                os.posix_fallocate(file.fileno(), 0, size)
            return torch.from_numpy(np.memmap(file, np.float32, "w+", shape=(rows, columns)))
    except OSError as error:
        raise InputError(
            f"{rows} x {columns} numbers do not fit into a temporary file: {error.strerror}; "
            "expected room there, or TMPDIR set to a folder with room"
        ) from error


def _size(number: float) -> str:
    return f"{number / 1e9:.3g} GB" if number >= 1e9 else f"{max(number, 0) / 1e6:.3g} MB"


def _of_system() -> float:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, StopIteration):  # another system
        pass
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        return math.inf


def _of_container() -> float:
    """What is left to the control group of the process, and to each that contains it."""
    try:
        own = next(line[3:] for line in OWN.read_text().splitlines() if line.startswith("0::"))
    except (OSError, StopIteration):
        own = "/"
    inside = GROUPS / own.lstrip("/")
    return min(_of_group(group) for group in (inside, *inside.parents) if group.is_relative_to(GROUPS))


def _of_group(group: Path) -> float:
    try:
        limit, used = (float((group / f"memory.{name}").read_text()) for name in ("max", "current"))
        stat = dict(map(str.split, (group / "memory.stat").read_text().splitlines()))
        return limit - used + sum(float(stat.get(name, 0)) for name in CACHES)
    except (OSError, ValueError):  # none, or "max"
        return math.inf


def _of_process() -> float:
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except (ImportError, OSError, ValueError):  # another system
        return math.inf
    return math.inf if limit == resource.RLIM_INFINITY else float(limit - used)
