"""Functions compiled by numba, if it is installed and works."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

log = logging.getLogger("dejavu_torch")


def compiled(
    function: Callable[..., Any], signature: str, what: str, calls: Sequence[Any] = (), **options: Any
) -> Callable[..., Any] | None:
    """The function, and what it calls, compiled for one signature or loaded from numba's cache.

    None, with a line in the log that says `what` is done without, if numba is missing, disabled or broken;
    `options` are those of `njit`.
    """
    options |= {"nogil": True, "error_model": "numpy"}
    try:
        import numba
        from numba.extending import register_jitable

        for one in calls:
            register_jitable(one)
        try:
            kernel: Callable[..., Any] = numba.njit(signature, cache=True, **options)(function)
        except Exception:  # there may be no folder for the cache
            kernel = numba.njit(signature, cache=False, **options)(function)
        if kernel is function:
            raise RuntimeError("NUMBA_DISABLE_JIT is set")
        return kernel
    except Exception as error:  # a broken compiler must not break what works without one
        log.info("%s, not by numba: %s", what, " ".join(str(error).split()))
        return None
