"""The names of a traverse's frames, compressed for the header of a map."""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Sequence
from itertools import accumulate, pairwise

from dejavu_torch.types import Facts, InputError, expect

MAX_NAME_LENGTH = 4096  # characters, as of a path
MAX_DIGITS = 18  # of a number in a name
MAX_TEXT = 2**28  # bytes of the names of a map


def encode_names(names: Sequence[str]) -> str:
    """Names as compressed text; numbers in them are stored as differences if that is exact.

    Thousands of file names with a counter, or of times at a constant rate, take about 100 bytes.

    Example:
        >>> files = [f"left_{i:06}.png" for i in range(0, 10_000, 2)]
        >>> code = encode_names(files)
        >>> len(code) < 200, decode_names(code) == files
        (True, True)
    """
    longest = max(map(len, names), default=0)
    expect(longest <= MAX_NAME_LENGTH, f"at most {MAX_NAME_LENGTH}", f"a frame name has {longest} characters")
    numbered = _numbered(names)
    value = list(names) if numbered is None or _names(numbered) != list(names) else numbered
    return base64.b64encode(zlib.compress(json.dumps(value, separators=(",", ":")).encode(), 9)).decode()


def decode_names(code: str, count: int | None = None) -> list[str]:
    """The names that `encode_names` encoded; `count`: their expected number, None for any."""
    value = json.loads(zlib.decompressobj().decompress(base64.b64decode(code), MAX_TEXT))
    columns = value["columns"] if isinstance(value, dict) else None
    seen = len(value) if columns is None else len(columns[0]) - 1
    expect(count in (None, seen), count, f"there are names of {seen} frames")
    return value if columns is None else _names(value)


def _numbered(names: Sequence[str]) -> Facts | None:
    """Names that differ only in their numbers: the text between them, and the changes of each; else None."""
    parts = [re.split("([0-9]+)", name) for name in names]
    if any(part[::2] != parts[0][::2] or max(map(len, part[1::2]), default=0) > MAX_DIGITS for part in parts):
        return None
    columns: list[list[int]] = []
    for digits in zip(*(part[1::2] for part in parts), strict=True):
        values = [int(text) for text in digits]
        width = min(map(len, digits)) if any(text[0] == "0" and len(text) > 1 for text in digits) else 1
        columns.append([width, values[0], *(b - a for a, b in pairwise(values))])
    return {"texts": parts[0][::2], "columns": columns} if columns else None


def _names(numbered: Facts) -> list[str]:
    first, *rest = numbered["texts"]
    if max(width for width, *_ in numbered["columns"]) > MAX_DIGITS:
        raise InputError(f"the numbers in names are too wide; expected at most {MAX_DIGITS} digits")
    columns = [[str(n).zfill(width) for n in accumulate(changes)] for width, *changes in numbered["columns"]]
    rows = zip(*columns, strict=True)
    return [first + "".join(n + text for n, text in zip(row, rest, strict=True)) for row in rows]


def clock_time(seconds: float) -> str:
    """Hours, minutes, seconds and milliseconds, as in the names of video frames: 1:02:03.480."""
    whole, thousandths = divmod(abs(round(1000 * seconds)), 1000)
    clock = f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}.{thousandths:03}"
    return f"-{clock}" if seconds < 0 else clock
