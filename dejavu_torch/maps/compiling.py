"""Functions compiled by numba, where it is installed and works."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F, signature: str, **options: Any) -> F:
    """The function, compiled for arguments of one signature or loaded from numba's cache.

    Args:
        options: of `numba.njit`.

    Raises:
        Exception: of any kind, if numba is missing, disabled or broken; its message says why.
    """
    import numba

    njit: Any = partial(numba.njit, signature, nogil=True, error_model="numpy", **options)
    try:
        kernel: F = njit(cache=True)(function)
    except Exception:  # there may be no folder for the cache
        kernel = njit(cache=False)(function)
    if kernel is function:
        raise RuntimeError("NUMBA_DISABLE_JIT is set")
    return kernel
