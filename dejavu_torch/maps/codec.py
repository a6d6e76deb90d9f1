"""The entropy coder of a spectral map: integer levels to bytes by adaptive arithmetic coding, and back.

Each row begins with a bit that is 1 if all further levels are 0. A level is the number of bits of its
magnitude in unary, its sign, and the bits below the leading one. The probability of a bit follows how often
it was 1 in its context: for the unary bits, the magnitudes in this column and its neighbours over the rows
before, and in all columns over the last few rows; for a sign, the sign two rows before, which is the line of
the same kind, cosine or sine. All arithmetic is in integers, so that every machine decodes the same levels.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dejavu_torch.maps.compiling import compiled
from dejavu_torch.memory import free_memory
from dejavu_torch.types import InputError

Ints = NDArray[np.integer[Any]]

LEVELS_PER_BYTE, LEVELS_AT_LEAST = 2**13, 2**22  # most levels of a stream
LEVEL, COLUMN = 4, 2**13  # bytes to decode a level, and a column
MOST = 15  # larger magnitudes count as this one in the sums of a context
REACH, RING = 128, 256  # rows that a context looks back at most, and whose sums are kept
LENGTH_MAX = 31  # bits of a magnitude
NEAR = 34  # contexts by the magnitudes near a level
END, SIGN, BITS, LENGTH = 0, 1, 4, 4 + 32 * 32  # the first context of each kind of bit
CONTEXTS = LENGTH + 32 * NEAR
FIRST = (2, 1)  # initial counts of 0s and 1s in a context; each bit adds 2
BLOCK, COUNTED = 2**13, 2**16  # levels that are coded, and counted, at a time
BIT = 5  # bytes of a bit at most
SPAN, BYTE = 56, 48  # bits of the interval at first, and at least
LEAST = 1 << BYTE
WORTH_COMPILING = 2**19  # levels that Python codes in the time that numba loads


class Stream(NamedTuple):
    """bytes: (n,) uint8, compressed. checksum: CRC-32 of the levels and their shape."""

    bytes: Tensor
    checksum: int


def encode(levels: Tensor) -> Stream:
    """Compress integer levels, of magnitudes below 2^31.

    Shape: (W,K) int8 or int32 -> (n,) uint8.
    """
    whole = _numbers(levels)
    packed = bytearray()
    _, row, (low, _, size) = _run(whole, packed)
    packed[size:] = bytes(1)
    _put(int(low) + LEAST - 1, size, packed)  # in the interval, its further bytes 0
    _check_size(row, whole.shape[1], len(packed))
    return Stream(torch.frombuffer(packed, dtype=torch.uint8), _checksum(whole))


def coded_bytes(levels: Tensor) -> int:
    """The size of `encode`'s stream, or a byte more, without coding: (W,K) int8 or int32."""
    whole = _numbers(levels)
    filled, width = _filled(whole), whole.shape[1]
    counts, rows = np.zeros((CONTEXTS, 2)), max(2, COUNTED // width)
    counts[END] = filled, filled < len(whole)
    sums, signs = np.zeros((rows + RING, width + 1), np.int32), np.zeros((2, width), np.int64)
    for start in range(0, filled, rows):
        block = whole[start : min(start + rows, filled)].astype(np.int64)
        here = np.arange(start, start + len(block))
        ahead, totals = (here + 1) % len(sums), np.minimum(np.abs(block), MOST).cumsum(0)
        sums[ahead, :-1] = sums[start % len(sums), :-1] + totals
        sums[ahead, -1] = sums[ahead, :-1].sum(1)
        near = _near(sums, here, _logarithms())
        signs = np.concatenate([signs[-2:], np.sign(block)])
        _count(counts, np.abs(block), signs[2:], signs[:-2], near)
    prior = torch.tensor(FIRST, dtype=torch.float64) / 2
    after = torch.from_numpy(counts) + prior
    # the probability of all bits of a context, in any order, is a quotient of gamma functions
    nats = after.sum(1).lgamma() - after.lgamma().sum(1) + prior.lgamma().sum() - prior.sum().lgamma()
    return int(float(nats.sum()) / math.log(256) + 1.01)


def decode(stream: Stream, rows: int, columns: int) -> Tensor:
    """The levels of a stream, (W,K) int8, or int32 if some need it.

    Raises:
        InputError: a truncated or altered stream, one of another size, or more than the memory holds.
    """
    if min(rows, columns) < 1 or (rows * LEVEL + COLUMN) * columns > free_memory():
        raise InputError(
            f"the map claims {rows} x {columns} levels; expected at least one, and what fits into the memory"
        )
    packed = stream.bytes.numpy().tobytes()
    padded = bytearray(packed + bytes(SPAN // 8 - 1))
    levels, _, state = _run(np.zeros((rows, columns), np.int8), padded, reads=True)
    left, checksum = max(0, len(padded) - int(state[2])), _checksum(levels)
    if left or checksum != stream.checksum:
        raise InputError(
            f"the coded lines are truncated or altered: {len(packed)} bytes, {left} of them left over, give "
            f"levels of checksum {checksum}; expected {levels.size} levels of {stream.checksum}"
        )
    return torch.from_numpy(levels)


def _check_size(rows: int, columns: int, size: int) -> None:
    """Refuse a stream of `size` bytes for so many rows up to the last that is not 0: slow to decode."""
    if rows * columns > LEVELS_AT_LEAST + LEVELS_PER_BYTE * size:
        raise InputError(
            f"{rows} x {columns} levels in {size} bytes are next to nothing but zeros; "
            "expected more bytes per place"
        )


def _numbers(levels: Tensor) -> Ints:
    numbers: Ints = levels.detach().cpu().contiguous().numpy()
    return numbers.astype(np.int8) if _fits(numbers) else numbers


def _fits(levels: Ints) -> bool:
    """Whether int8 holds the levels."""
    return levels.dtype == np.int8 or bool(levels.min() >= -128 and levels.max() <= 127)


def _checksum(levels: Ints) -> int:
    return zlib.crc32(levels.data, zlib.crc32(repr(levels.shape).encode()))


def _filled(levels: Ints) -> int:
    """The number of rows up to the last that is not 0."""
    return 1 + int(np.flatnonzero(levels.any(1)).max(initial=-1))


def _count(counts: Any, size: Ints, sign: Ints, before: Ints, near: Ints) -> None:
    """Add the bits of levels (R,K) to counts (CONTEXTS,2); before: the sign two rows before each."""
    length = np.frexp(size)[1].astype(np.int64)
    ends = np.bincount((length * NEAR + near).ravel(), minlength=32 * NEAR).reshape(32, NEAR)
    more = ends[::-1].cumsum(0)[::-1] - ends
    counts[LENGTH:] += np.stack([ends, more], 2).reshape(-1, 2)
    counts[LENGTH + LENGTH_MAX * NEAR :, 0] = 0  # no bit follows the longest
    for minus in (0, 1):
        there = sign == 1 - 2 * minus
        counts[SIGN : SIGN + 3, minus] += np.bincount(1 + before[there], minlength=3)
    for bits in range(2, 1 + int(length.max())):
        large = size[length == bits]
        ones = (large[:, None] >> np.arange(bits - 1) & 1).sum(0)
        first = BITS + 32 * bits
        counts[first : first + bits - 1] += np.stack([len(large) - ones, ones], 1)


def _run(levels: Ints, packed: bytearray, reads: bool = False) -> tuple[Ints, int, Any]:
    """Write levels to bytes, or read as many; the levels, the row where coding ended, `_code`'s state."""
    rows, columns = levels.shape
    kernel, begin = _kernel(levels.size), SPAN // 8 if reads else 0
    state: Any = np.array([int.from_bytes(packed[:begin], "big"), 1 << SPAN, begin])
    counts: Any = np.tile(FIRST, CONTEXTS)
    if kernel is _code:  # lists, whose elements Python reads faster
        state, counts = state.tolist(), counts.tolist()
    sums, before = np.zeros((RING, columns + 1), np.int32), np.zeros((2, columns), np.int32)
    filled, row, step = _filled(levels), 0, max(1, BLOCK // columns)
    for start in range(0, rows, step):
        some = levels[start : start + step]
        if reads:
            _check_size(start, columns, len(packed))
        else:
            bits = 2 * max(int(some.max()), -int(some.min())).bit_length() + 2  # of a level, and a row
            packed.extend(bytes(max(0, int(state[2]) + BIT * bits * some.size - len(packed))))
        block = np.concatenate([before, some], dtype=np.int32)
        coding = reads, state, counts, sums, _logarithms()
        row = kernel(
            block, start, filled, packed if kernel is _code else np.frombuffer(packed, np.uint8), coding
        )
        before = block[-2:]
        if reads:
            levels = levels if _fits(block) else levels.astype(np.int32, copy=False)
            levels[start : start + step] = block[2:]
        if row < start + len(some) or state[2] > len(packed):
            break
    return levels, row, state


# The functions from here to `_near` run as they are, on lists, and compiled by numba, on arrays.


def _code(block: Any, start: int, filled: int, packed: Any, coding: Any) -> int:
    """Code the rows of a block, behind the two before row `start`; the row from which on all are 0."""
    reads, state, counts, sums, logarithms = coding
    # the lower end of the interval, or the value read less that, its width, the position in `packed`
    low, span, at = state[0], state[1], state[2]
    for r in range(2, len(block)):
        row = start + r - 2
        bit, low, span, at = _bit(END, int(row >= filled), reads, low, span, at, counts, packed)
        if bit:
            break
        near = _near(sums, np.full(1, row), logarithms)[0]
        for f in range(block.shape[1]):
            level, around, before = int(block[r, f]), int(near[f]), int(block[r - 2, f])
            size, length, context = abs(level), 0, LENGTH + around
            while length < LENGTH_MAX:
                more = int(size >> length > 0)
                bit, low, span, at = _bit(context, more, reads, low, span, at, counts, packed)
                if not bit:
                    break
                length, context = length + 1, context + NEAR
            if length:
                context = SIGN + 1 + int(before > 0) - int(before < 0)
                minus, low, span, at = _bit(context, int(level < 0), reads, low, span, at, counts, packed)
                value, context = 1, BITS + 32 * length
                for n in range(length - 2, -1, -1):
                    bit, low, span, at = _bit(
                        context + n, size >> n & 1, reads, low, span, at, counts, packed
                    )
                    value = 2 * value + bit
                block[r, f] = -value if minus else value
        now, after = sums[row % RING], sums[(row + 1) % RING]
        after[:-1] = now[:-1] + np.minimum(np.abs(block[r]), MOST)
        after[-1] = after[:-1].sum()
    else:
        row = start + len(block) - 2
    state[0], state[1], state[2] = low, span, at
    return row


def _bit(
    context: int, bit: int, reads: bool, low: int, span: int, at: int, counts: Any, packed: Any
) -> tuple[int, int, int, int]:
    """Code a bit in its context; the bit, and the interval and position after it."""
    zero, one = counts[2 * context], counts[2 * context + 1]
    part = span // (zero + one) * zero
    if reads:
        bit = int(low >= part)
    if bit:
        low += -part if reads else part
        span -= part
    else:
        span = part
    while span < LEAST:
        span <<= 8
        low = (low << 8 | (packed[at] if at < len(packed) else 0)) if reads else _put(low, at, packed)
        at += 1
    counts[2 * context + bit] += 2
    return bit, low, span, at


def _put(low: int, at: int, packed: Any) -> int:
    """Write the first byte of the interval's lower end, and carry into the bytes before it."""
    byte = low >> BYTE
    if byte > 255:
        last = at - 1
        while packed[last] == 255:
            packed[last] = 0
            last -= 1
        packed[last] += 1
    packed[at] = byte & 255
    return (low & LEAST - 1) << 8


def _near(sums: Any, rows: Any, logarithms: Any) -> Any:
    """The contexts (R,K), 0 to `NEAR`, by what sums (over R,K+1) of all rows before gained lately."""
    now, columns = sums[rows % len(sums)], sums.shape[1] - 1
    far = np.minimum(np.minimum(np.maximum(rows // 2, 16), REACH), rows)
    close = np.minimum(np.minimum(np.maximum(rows // 16, 2), 8), rows)
    recent = (now[:, -1] - sums[(rows - close) % len(sums)][:, -1]).astype(np.int64)
    mean = (recent << 10) // (np.maximum(close, 1) * columns)
    # the mean magnitude over the last rows, in 256ths, with more weight on the last two
    column = ((now - sums[(rows - far) % len(sums)]) << 8) // np.maximum(far, 1).reshape(-1, 1)
    column = column + ((now - sums[(rows - np.minimum(rows, 2)) % len(sums)]) << 4)
    wide = 2 * column[:, :-1]
    wide[:, 1:] += column[:, :-2]
    wide[:, :-1] += column[:, 1:-1]
    wide[:, 0] += column[:, 0]
    wide[:, -1] += column[:, -2]
    return (2 * np.take(logarithms, (wide >> 2) + 3) + logarithms[mean + 4].reshape(-1, 1)) // 9


@cache
def _logarithms() -> Ints:
    """8 log2 of 0 to 2^14, rounded down, in integers."""
    return np.array([0, *((n**8).bit_length() - 1 for n in range(1, 2**14 + 1))])


_coded = 0  # levels, by this process


def _kernel(levels: int) -> Callable[..., int]:
    """What codes so many more levels."""
    global _coded
    _coded += levels
    return (_compiled() if _coded >= WORTH_COMPILING else None) or _code


@cache
def _compiled() -> Callable[..., int] | None:
    """`_code` compiled, or None if numba is missing or broken."""
    block, numbers = "int32[:,::1]", "int64[::1]"
    coding = f"Tuple((boolean, {numbers}, {numbers}, {block}, {numbers}))"
    signature = f"int64({block}, int64, int64, uint8[::1], {coding})"
    return compiled(_code, signature, "levels are coded in Python", (_bit, _put, _near))
