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
WINDOW = 2**26  # bytes that LZMA looks back, both when it packs and when it unpacks
FILTERS = [
    {
        "id": lzma.FILTER_LZMA2,
        "preset": 9 | lzma.PRESET_EXTREME,
        "lc": 0,
        "lp": 0,
        "pb": 0,
        "dict_size": WINDOW,
    }
]
LEVEL = 16  # bytes that a level takes while it is decoded


class Stream(NamedTuple):
    """bytes: (n,) uint8, compressed. checksum: of the levels, CRC-32."""

    bytes: Tensor
    checksum: int


def encode(levels: Tensor) -> Stream:
    """Compress integer levels: which of them are not 0, their signs, and their magnitudes, with LZMA.

    Shape: (W,K) int8 -> (n,) uint8.

    Convention: which are not 0 is a bit each, in bytes of eight columns; those of the first eight columns
        come first, row by row. Most bytes are then one of few, and neighbours are alike.
    """
    whole = levels.detach().cpu().contiguous().numpy()
    kept = whole != 0
    values = whole[kept]
    marks = np.packbits(kept, axis=1).T.tobytes()
    sizes = (np.abs(values.astype(np.int16)) - 1).astype(np.uint8)
    plain = marks + np.packbits(values > 0).tobytes() + sizes.tobytes()
    filters = [{**FILTERS[0], "dict_size": min(max(4096, len(plain)), WINDOW)}]  # the same bytes, sooner
    packed = lzma.compress(plain, format=lzma.FORMAT_RAW, filters=filters)
    return Stream(torch.from_numpy(np.frombuffer(packed, np.uint8).copy()), zlib.crc32(whole.tobytes()))


def decode(stream: Stream, rows: int, columns: int) -> Tensor:
    """The levels of a stream, (W,K) int8.

    Raises:
        InputError: a truncated or altered stream, one of another size, or more than the memory holds.
    """
    count, problem, whole = rows * columns, "", b""
    check_claim(rows, columns)
    try:
        decompressor = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=FILTERS)
        longest = -(-columns // 8) * rows + -(-count // 8) + count
        plain = decompressor.decompress(stream.bytes.numpy().tobytes(), longest + 1)
        whole = _levels(np.frombuffer(plain, np.uint8), rows, columns)
    except (lzma.LZMAError, MemoryError, OverflowError, ValueError) as error:
        problem = str(error)
    if problem or zlib.crc32(whole) != stream.checksum:
        seen = problem or f"levels of checksum {zlib.crc32(whole)}"
        raise InputError(
            f"the coded lines are truncated or altered: {seen}; expected {count} levels of {stream.checksum}"
        )
    return torch.from_numpy(np.frombuffer(whole, np.int8).reshape(rows, columns).copy())


def check_claim(rows: int, columns: int) -> None:
    """Refuse, before anything is made, more levels than the memory holds, or none.

    Raises:
        InputError: naming both.
    """
    if min(rows, columns) < 1 or rows * columns * LEVEL > memory():
        raise InputError(
            f"the map claims {rows} x {columns} levels; expected at least one, and what fits into the memory"
        )


def _levels(plain: np.ndarray, rows: int, columns: int) -> bytes:
    """What `encode` packed, as int8 row by row; ValueError where there are more or fewer bytes."""
    marked = -(-columns // 8) * rows
    marks, rest = np.split(plain, [marked])
    if len(marks) != marked:
        raise ValueError(f"{len(marks)} bytes of marks, expected {marked}")
    kept = np.unpackbits(marks.reshape(-1, rows).T, axis=1, count=columns).astype(bool)
    number = int(kept.sum())
    signs, sizes = np.split(rest, [-(-number // 8)])
    if len(sizes) != number:
        raise ValueError(f"{len(sizes)} magnitudes of {number} levels")
    positive = np.unpackbits(signs, count=number).astype(bool)
    magnitudes = sizes.astype(np.int16) + 1
    levels = np.zeros((rows, columns), np.int8)
    levels[kept] = np.where(positive, magnitudes, -magnitudes)
    return levels.tobytes()


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
