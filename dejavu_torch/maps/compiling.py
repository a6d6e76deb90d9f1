"""Functions compiled by numba, where it is installed and works."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F, signature: str, **options: Any) -> F:
    """The function for arguments of one signature, compiled now or at an earlier time.

    Args:
        options: of `numba.njit`.

    Raises:
        Exception: of any kind, where numba is missing, switched off or broken; it says why.
    """
    import numba

    reason: Exception
    for keep in (True, False):  # nowhere to keep what is compiled is no reason not to compile
        try:
            compiler: Any = numba.njit(signature, cache=keep, nogil=True, error_model="numpy", **options)
            kernel: F = compiler(function)
        except Exception as error:
            reason = error
        else:
            if kernel is function:
                raise RuntimeError("NUMBA_DISABLE_JIT is set")
            return kernel
    raise reason
