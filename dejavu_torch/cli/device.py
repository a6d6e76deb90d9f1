"""The --device option."""

from __future__ import annotations

import torch

from dejavu_torch.types import InputError


def device_of(name: str, learns: bool = False) -> torch.device:
    """The device with that name.

    Args:
        name: cpu, cuda, cuda:N or mps.
        learns: whether a map is learned on it, which needs double precision.

    Raises:
        InputError: another name, or a device that this machine lacks.

    Example:
        >>> device_of("cpu")
        device(type='cpu')
    """
    try:
        device = torch.device(name)
    except RuntimeError:
        device = torch.device("meta")
    if device.type not in ("cpu", "cuda", "mps") or (device.type != "cuda" and device.index):
        raise InputError(f"--device {name} is unknown; expected cpu, cuda, cuda:N or mps")
    if device.type == "cuda" and not (device.index or 0) < torch.cuda.device_count():
        count = torch.cuda.device_count()
        there = f"cuda:0 to cuda:{count - 1}" if count > 1 else "cuda" if count else "cpu"
        raise InputError(f"--device {name} is not there; expected {there}, which this machine has")
    if device.type == "mps" and not torch.backends.mps.is_available():
        raise InputError("--device mps is not there; expected cpu, which this machine has")
    if device.type == "mps" and learns:
        raise InputError("--device mps has no double precision, which learning needs; expected cpu or cuda")
    return device
