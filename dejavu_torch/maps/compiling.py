"""Functions compiled by numba, if it is installed and works."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from threading import Timer
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils._python_dispatch import is_in_torch_dispatch_mode

from dejavu_torch.memory import is_readable
from dejavu_torch.text import one_line

log = logging.getLogger("dejavu_torch")

Kernel: TypeAlias = Callable[..., Any]
Floats: TypeAlias = NDArray[np.float32]
SILENCE = 2.0  # seconds, longer than a load from the cache takes


def compiled(
    function: Kernel, signature: str, what: str, calls: Sequence[object] = (), **options: object
) -> Kernel | None:
    """The function, and its `calls`, compiled for one signature, or loaded from numba's cache; a long
    compilation is logged.

    None, and a log line that `what` happens instead, if numba is missing, disabled or broken.
    """
    options |= {"nogil": True, "error_model": "numpy"}
    notice = Timer(SILENCE, log.warning, ("compiling a loop with numba, once; this may take 20 s",))
    try:
        import numba
        from numba.extending import register_jitable

        for call in calls:
            register_jitable(call)
        notice.start()
        try:
            kernel: Kernel = numba.njit(signature, cache=True, **options)(function)
        except Exception:  # the cache may have no folder
            kernel = numba.njit(signature, cache=False, **options)(function)
        if kernel is function:
            raise RuntimeError("NUMBA_DISABLE_JIT is set")
        return kernel
    except Exception as error:  # a broken compiler must not break what works without it
        log.info("%s, not by numba: %s", what, one_line(error))
        return None
    finally:
        notice.cancel()


def floats_of(tensor: Tensor) -> Floats | None:
    """The data of a float32 tensor on the CPU, or None if autograd or a tracer records its operations."""
    if (
        not is_readable(tensor)
        or torch.jit.is_tracing()  # type: ignore[attr-defined, no-untyped-call]
        or is_in_torch_dispatch_mode()
        or tensor.dtype != torch.float32
        or (tensor.requires_grad and torch.is_grad_enabled())
    ):
        return None
    try:
        floats: Floats = tensor.detach().contiguous().numpy()
        return floats
    except (RuntimeError, TypeError):  # sparse tensors have no rows
        return None
