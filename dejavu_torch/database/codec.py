"""Integer levels as a stream of bytes: most of them are 0, and it holds little more than their entropy."""

from __future__ import annotations

import lzma
import math
import os
import zlib
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dejavu_torch.types import InputError

ESCAPE = -128  # stands for a level that int8 does not hold
FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME, "lc": 0, "lp": 0, "pb": 0}]
NUMBER = 6  # bytes that a level takes while a map is loaded: itself, and a float32 with its norm


class Stream(NamedTuple):
    """bytes: (n,) uint8, compressed. checksum: of the levels, CRC-32."""

    bytes: Tensor
    checksum: int


def encode(levels: Tensor) -> Stream:
    """Compress integer levels, row by row, with LZMA.

    Shape: (W,K) int8 -> (n,) uint8.
    """
    plain = levels.detach().cpu().contiguous().numpy().tobytes()
    filters = [{**FILTERS[0], "dict_size": max(4096, len(plain))}]  # the same bytes, sooner
    packed = lzma.compress(plain, format=lzma.FORMAT_RAW, filters=filters)
    return Stream(torch.from_numpy(np.frombuffer(packed, np.uint8).copy()), zlib.crc32(plain))


def decode(stream: Stream, rows: int, columns: int) -> Tensor:
    """The levels of a stream, (W,K) int8.

    Raises:
        InputError: a truncated or altered stream, one of another size, or more than the memory holds.
    """
    count, problem = rows * columns, ""
    if count * NUMBER > memory():
        raise InputError(f"the map claims {rows} x {columns} levels; expected what fits into the memory")
    try:
        decompressor = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=FILTERS)
        plain = decompressor.decompress(stream.bytes.numpy().tobytes(), count + 1)
    except (lzma.LZMAError, MemoryError) as error:
        plain, problem = b"", str(error)
    if len(plain) != count or zlib.crc32(plain) != stream.checksum:
        seen = problem or f"{len(plain)} levels of checksum {zlib.crc32(plain)}"
        raise InputError(
            f"the coded lines are truncated or altered: {seen}; expected {count} of {stream.checksum}"
        )
    return torch.from_numpy(np.frombuffer(plain, np.int8).reshape(rows, columns).copy())


def to_int8(levels: Tensor) -> tuple[Tensor, Tensor]:
    """Whole numbers as int8, and those that int8 does not hold, in their order.

    Shape: (W,K) -> (W,K) int8, (E,) int32.
    """
    large = levels.abs() > 127
    return torch.where(large, ESCAPE, levels).to(torch.int8), levels[large].to(torch.int32)


def from_int8(small: Tensor, escapes: Tensor) -> Tensor:
    """The inverse of `to_int8`, (W,K) int32."""
    return small.to(torch.int32).masked_scatter(small == ESCAPE, escapes)


def entropy_bytes(levels: Tensor) -> float:
    """What the levels cost if each is coded by how often its value occurs in its octave of rows.

    Args:
        levels: whole numbers. Rows r to 2r are one octave.

    Shape: (W,K) -> scalar, in bytes.

    Example:
        >>> entropy_bytes(torch.tensor([[0, 1], [0, 1]]))
        0.5
    """
    bits, start, rows = 0.0, 0, len(levels)
    while start < rows:
        stop = min(rows, max(16, 2 * start))
        octave = levels[start:stop].flatten().long()
        counts = (octave - octave.min()).bincount().double()
        bits -= float(counts.xlogy(counts / counts.sum()).sum()) / math.log(2)
        start = stop
    return bits / 8


def memory() -> float:
    """Bytes of the machine's memory; inf where it does not say."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        return math.inf
