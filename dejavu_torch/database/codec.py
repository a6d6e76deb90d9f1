"""Integer levels as a stream of bytes: an arithmetic code that learns, as it goes, from what is near."""

from __future__ import annotations

import itertools
import math
import zlib
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dejavu_torch.memory import free_memory
from dejavu_torch.types import InputError

Ints = NDArray[np.integer[Any]]

ESCAPE = -128  # stands for a level that int8 does not hold
LEVELS_PER_BYTE, LEVELS_AT_LEAST = 2**13, 2**22  # of a stream, at most
LEVEL = 16  # bytes that a level takes while it is decoded
MOST = 15  # a magnitude counts for no more in what is near

# contexts: of a bit in every row, of signs, of the bits of a magnitude, and of how many bits it has
END, SIGN, BITS, LENGTH = 0, 1, 4, 4 + 8 * 8
NEAR = 34  # kinds of neighbourhood
CONTEXTS = LENGTH + 8 * NEAR
FIRST = (2, 1)  # 0s and 1s of a context before there are any; each one counts 2

BLOCK = 2**18  # levels whose bits are found at a time
SPAN, BYTE = 56, 48  # bits of the coder's interval at first, and at least


class Stream(NamedTuple):
    """bytes: (n,) uint8, compressed. checksum: of the levels and their shape, CRC-32."""

    bytes: Tensor
    checksum: int


def encode(levels: Tensor) -> Stream:
    """Compress integer levels by an adaptive arithmetic code; whole numbers alone decide its intervals.

    Shape: (W,K) int8 -> (n,) uint8.

    Convention: row by row, first a bit: whether all that is left is 0. Then of each level how many bits its
        magnitude has, in unary, its sign, and these bits below the first. The probability of a bit is that
        with which it was 1 in its context: for the unary ones, how large the magnitudes are in the column and
        its neighbours over the rows before, and in all columns over the last few; for a sign, that of the
        column two rows before, which is the line of the same kind, cosine or sine.
    """
    whole = levels.detach().cpu().contiguous().numpy()
    zeros, ones = [FIRST[0]] * CONTEXTS, [FIRST[1]] * CONTEXTS
    packed, low, span = bytearray(), 0, 1 << SPAN
    for context, bit in itertools.chain.from_iterable(map(_in_order, _decisions(whole))):
        zero, one = zeros[context], ones[context]
        part = span // (zero + one) * zero
        if bit:
            ones[context] = one + 2
            low, span = low + part, span - part
        else:
            zeros[context] = zero + 2
            span = part
        while span < 1 << BYTE:
            low, span = _shift(packed, low), span << 8
    _shift(packed, low + (1 << BYTE) - 1)  # a number in the interval whose further bytes are 0
    check_work(len(_filled(whole)), whole.shape[1], len(packed))
    return Stream(torch.from_numpy(np.frombuffer(bytes(packed), np.uint8).copy()), _checksum(whole))


def coded_bytes(levels: Tensor) -> int:
    """What `encode` needs, without coding: a byte more at most.

    Shape: (W,K) int8 -> scalar.

    Example:
        >>> coded_bytes(torch.zeros(500, 20, dtype=torch.int8))
        1
    """
    counts = np.zeros(2 * CONTEXTS, np.int64)
    blocks = _decisions(levels.detach().cpu().contiguous().numpy())
    for contexts, bits, _ in itertools.chain.from_iterable(blocks):
        counts += np.bincount(2 * contexts + bits, minlength=2 * CONTEXTS)
    start = torch.tensor(FIRST, dtype=torch.float64) / 2
    after = torch.from_numpy(counts).view(-1, 2) + start
    # in whatever order they come, the bits of a context have a probability of gamma functions' quotients
    nats = after.sum(1).lgamma() - after.lgamma().sum(1) + start.lgamma().sum() - start.sum().lgamma()
    return int(float(nats.sum()) / math.log(256) + 1.01)


def decode(stream: Stream, rows: int, columns: int) -> Tensor:
    """The levels of a stream, (W,K) int8.

    Raises:
        InputError: a truncated or altered stream, one of another size, or more than the memory holds.
    """
    problem = ""
    check_claim(rows, columns)
    levels = np.zeros((rows, columns), np.int8)
    try:
        _decode(stream.bytes.numpy().tobytes(), levels)
    except InputError:
        raise
    except (MemoryError, OverflowError, ValueError) as error:
        problem = str(error)
    if problem or _checksum(levels) != stream.checksum:
        seen = problem or f"levels of checksum {_checksum(levels)}"
        raise InputError(
            f"the coded lines are truncated or altered: {seen}; expected {levels.size} levels of "
            f"{stream.checksum}"
        )
    return torch.from_numpy(levels)


def check_claim(rows: int, columns: int) -> None:
    """Refuse, before anything is made, more levels than the memory holds, or none.

    Raises:
        InputError: naming both.
    """
    if min(rows, columns) < 1 or rows * columns * LEVEL > free_memory():
        raise InputError(
            f"the map claims {rows} x {columns} levels; expected at least one, and what fits into the memory"
        )


def check_work(rows: int, columns: int, size: int) -> None:
    """Refuse a stream that takes far longer to decode than its bytes are worth: zeros cost next to nothing.

    Args:
        rows: up to the last that is not 0. size: of the stream, bytes.

    Raises:
        InputError: naming the numbers.
    """
    if rows * columns > LEVELS_AT_LEAST + LEVELS_PER_BYTE * size:
        raise InputError(
            f"{rows} x {columns} levels in {size} bytes are next to nothing but zeros; "
            "expected more bytes per place"
        )


def _checksum(levels: Ints) -> int:
    return zlib.crc32(levels.tobytes(), zlib.crc32(repr(levels.shape).encode()))


def _filled(levels: Ints) -> Ints:
    """The rows up to the last that is not 0."""
    filled = np.flatnonzero(levels.any(1))
    return levels[: int(filled[-1]) + 1 if len(filled) else 0]


def _decisions(levels: Ints) -> Iterator[list[tuple[Ints, Ints, Ints]]]:
    """All bits that `encode` codes, a block of rows at a time: contexts, what they are, what sorts them."""
    filled = _filled(levels)
    rows, columns = len(filled), levels.shape[1]
    sums = _summed(filled)
    ends = min(rows + 1, len(levels))
    step = max(1, BLOCK // columns)
    for start in range(0, ends, step):
        places = np.arange(start, min(start + step, ends))
        last = (places == rows).astype(np.int8)
        parts: list[tuple[Ints, Ints, Ints]]
        parts = [(np.full(len(places), END, np.int16), last, (places - start) * columns * 32)]
        there = places[places < rows]
        if len(there):
            parts += _of_levels(levels, there, _near(sums, there))
        yield parts


def _of_levels(levels: Ints, rows: Ints, near: Ints) -> Iterator[tuple[Ints, Ints, Ints]]:
    """The bits of the levels of some rows, one behind the other."""
    here, near = levels[rows].ravel(), near.ravel()
    size, order = np.abs(here.astype(np.int16)), np.arange(len(here)) * 32 + 1
    before = np.where(rows[:, None] < 2, 0, np.sign(levels[np.maximum(rows - 2, 0)])).ravel()
    negative, length = here < 0, _lengths()[size]
    for n in range(8):
        yield LENGTH + n * NEAR + near, (length > n).astype(np.int8), order + n
        kept = length > n
        size, near, order = size[kept], near[kept], order[kept]
        length = length[kept]
        if not n:
            yield SIGN + 1 + before[kept], negative[kept].astype(np.int8), order + 8
        for bit in range(n):
            ends = length == n + 1
            context = np.full(int(ends.sum()), BITS + n * 8 + bit, np.int16)
            yield context, size[ends] >> bit & 1, order[ends] + 16 - bit


def _decode(packed: bytes, levels: Ints) -> None:
    """Fill in what `encode` packed; ValueError where there are more or fewer bytes."""
    if not packed:
        raise ValueError("no bytes")
    zeros, ones = [FIRST[0]] * CONTEXTS, [FIRST[1]] * CONTEXTS
    ahead = SPAN // 8
    padded = packed + bytes(ahead - 1)
    value, span, read = int.from_bytes(padded[:ahead], "big"), 1 << SPAN, ahead

    def bit(context: int) -> bool:
        nonlocal value, span, read
        zero, one = zeros[context], ones[context]
        part = span // (zero + one) * zero
        found = value >= part
        if found:
            ones[context] = one + 2
            value, span = value - part, span - part
        else:
            zeros[context] = zero + 2
            span = part
        while span < 1 << BYTE:
            if read == len(padded):
                raise ValueError(f"{len(packed)} bytes are too few")
            value, span, read = value << 8 | padded[read], span << 8, read + 1
        return found

    rows, columns = levels.shape
    signs = [[0] * columns, [0] * columns]  # of the last two rows
    sums = np.zeros((rows + 1, columns), np.int32)
    for r in range(rows):
        if bit(END):
            break
        check_work(r + 1, columns, len(packed))
        row, before = [0] * columns, signs[r % 2]
        for f, near in enumerate(_near(sums, np.array([r]))[0].tolist()):
            context, length = LENGTH + near, 0
            while length < 8 and bit(context):
                context, length = context + NEAR, length + 1
            if length:
                negative, size = bit(SIGN + 1 + before[f]), 1
                for n in reversed(range(length - 1)):
                    size = size << 1 | bit(BITS + (length - 1) * 8 + n)
                row[f] = -size if negative else size
        levels[r] = row
        signs[r % 2] = np.sign(levels[r]).tolist()
        sums[r + 1] = sums[r] + np.minimum(np.abs(levels[r].astype(np.int16)), MOST)
    if read != len(padded):
        raise ValueError(f"{len(packed)} bytes, of which {len(padded) - read} are left over")


def _shift(packed: bytearray, low: int) -> int:
    """Pack the first byte of the interval's lower end, carrying into those before it; what is left of it."""
    byte, rest = low >> BYTE, low & (1 << BYTE) - 1
    if byte > 255:
        last = len(packed) - 1
        while packed[last] == 255:
            packed[last] = 0
            last -= 1
        packed[last] += 1
    packed.append(byte & 255)
    return rest << 8


def _in_order(parts: list[tuple[Ints, Ints, Ints]]) -> Iterator[tuple[int, int]]:
    """Contexts and bits as they are coded."""
    contexts, bits, order = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = order.argsort()
    return zip(contexts[order].tolist(), bits[order].tolist(), strict=True)


def _summed(levels: Ints) -> Ints:
    """(W,K) levels, their magnitudes summed over the rows before: (W+1,K)."""
    sums = np.zeros((len(levels) + 1, levels.shape[1]), np.int32)
    np.minimum(np.abs(levels, dtype=np.int16), MOST).cumsum(0, out=sums[1:])
    return sums


def _near(sums: Ints, rows: Ints) -> Ints:
    """How large the levels of such rows may be, 0 to `NEAR`, by those of the rows before: (W+1,K) -> (R,K).

    Convention: the column counts twice as much as the row. Its mean is over half as many rows as there
        are, 16 to 128 of them, so that it reaches as far in octaves everywhere, and the last two count for
        more; that of the row is over the last 8 or fewer.
    """
    reach = np.minimum((rows // 2).clip(16, 128), rows)
    column = ((sums[rows] - sums[rows - reach]) << 8) // reach.clip(1)[:, None]
    column += (sums[rows] - sums[np.maximum(rows - 2, 0)]) << 4
    wide = 2 * column
    wide[:, 1:] += column[:, :-1]
    wide[:, :-1] += column[:, 1:]
    wide[:, 0] += column[:, 0]
    wide[:, -1] += column[:, -1]
    reach = np.minimum((rows // 16).clip(2, 8), rows)
    row = (sums[rows] - sums[rows - reach]).sum(1, dtype=np.int64) << 10
    row //= reach.clip(1) * sums.shape[1]
    logarithm = _logarithms()
    near: Ints = (2 * logarithm[(wide >> 2) + 3] + logarithm[row + 4][:, None]) // 9
    return near


@cache
def _logarithms() -> Ints:
    """8 log2 of 0 to 2^14, rounded down; by whole numbers, so that all machines find the same."""
    return np.array([0, *((n**8).bit_length() - 1 for n in range(1, 2**14 + 1))], np.int16)


@cache
def _lengths() -> Ints:
    """How many bits the numbers from 0 to 128 have."""
    return np.array([n.bit_length() for n in range(129)], np.int8)


def to_int8(levels: Tensor) -> tuple[Tensor, Tensor]:
    """Whole numbers as int8, and those that int8 does not hold, in their order.

    Shape: (W,K) -> (W,K) int8, (E,) int32.
    """
    large = levels.abs() > 127
    return torch.where(large, ESCAPE, levels).to(torch.int8), levels[large].to(torch.int32)


def from_int8(small: Tensor, escapes: Tensor) -> Tensor:
    """The inverse of `to_int8`, (W,K) int32."""
    return small.to(torch.int32).masked_scatter(small == ESCAPE, escapes)
