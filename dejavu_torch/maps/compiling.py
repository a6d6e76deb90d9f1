"""Functions compiled by numba, if it is installed and works."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F, signature: str, **options: Any) -> F:
    """The function compiled for one signature, or loaded from numba's cache; `options` are those of `njit`.

    Raises:
        Exception: of any kind, if numba is missing, disabled or broken; its message says why.
    """
    import numba

    options |= {"nogil": True, "error_model": "numpy"}
    kernel: Any
    try:
        kernel = numba.njit(signature, cache=True, **options)(function)
    except Exception:  # there may be no folder for the cache
        kernel = numba.njit(signature, cache=False, **options)(function)
    if kernel is function:
        raise RuntimeError("NUMBA_DISABLE_JIT is set")
    return kernel  # type: ignore[no-any-return]
