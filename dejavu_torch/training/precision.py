"""Which precision pays on this machine."""

from __future__ import annotations

from pathlib import Path

CPU_FLAGS = Path("/proc/cpuinfo")
FAST = {"avx512_bf16", "amx_bf16", "bf16"}  # the last one of ARM


def has_bf16() -> bool:
    """Whether the processor multiplies numbers of 16 bits (bfloat16) itself; elsewhere they are slower.

    Known on Linux; False elsewhere.
    """
    try:
        text = CPU_FLAGS.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    lines = (line for line in text.splitlines() if line.lower().startswith(("flags", "features")))
    return bool(FAST & set(next(lines, "").split()))
