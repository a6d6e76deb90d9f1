"""The entropy coder of a spectral map: integer levels to bytes by adaptive arithmetic coding, and back.

Each row begins with a bit that is 1 if all further levels are 0. A level is coded as the bit length of its
magnitude in unary, its sign, and the bits below the leading one. Each bit has an adaptive probability in its
context: for the unary bits, earlier magnitudes in this column and its neighbours, and recent ones in all
columns; for a sign, the sign two rows before, whose line has the same kind, cosine or sine. All arithmetic is
in integers, so that every machine decodes the same levels.
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

LEVELS_PER_BYTE, LEVELS_AT_LEAST = 2**13, 2**22  # maximum levels of a stream, per byte and of a short one
LEVEL_BYTES, COLUMN_BYTES = 4, 2**13  # memory to decode a level, and a column
MAX_MAGNITUDE = 15  # in the sums of a context; larger ones are clipped
REACH, RING = 128, 256  # rows that a context looks back at most, and rows whose sums are kept
LENGTH_MAX = 31  # bits of a magnitude
NEAR = 34  # contexts by the magnitudes near a level
END, SIGN, BITS, LENGTH = 0, 1, 4, 4 + 32 * 32  # the first context of each kind of bit
CONTEXTS = LENGTH + 32 * NEAR
PRIOR = (2, 1)  # initial counts of 0s and 1s in a context; each bit adds 2
CODED_LEVELS, COUNTED_LEVELS = 2**13, 2**16  # per block
BIT_BYTES = 5  # at most
SPAN, MIN_SPAN = 56, 48  # bits of the interval: initial and minimal
SMALLEST = 1 << MIN_SPAN
WORTH_COMPILING = 2**19  # levels that Python codes in the time that numba takes to load


class Stream(NamedTuple):
    """bytes: (n,) uint8, compressed. checksum: CRC-32 of the levels and their shape."""

    bytes: Tensor
    checksum: int


def encode(levels: Tensor) -> Stream:
    """Compress integer levels, of magnitudes below 2^31.

    Shape: (W,K) int8 or int32 -> (n,) uint8.
    """
    numbers = _integers(levels)
    packed = bytearray()
    _, row, (low, _, size) = _run(numbers, packed)
    packed[size:] = bytes(1)
    # the first byte of a number in the interval; the others are 0
    _put(int(low) + SMALLEST - 1, size, packed)
    _check_size(row, numbers.shape[1], len(packed))
    return Stream(torch.frombuffer(packed, dtype=torch.uint8), _checksum(numbers))


def coded_bytes(levels: Tensor) -> int:
    """The size of the stream of `encode`, or a byte more, without coding: (W,K) int8 or int32."""
    numbers = _integers(levels)
    filled, width = _filled(numbers), numbers.shape[1]
    counts, rows = np.zeros((CONTEXTS, 2)), max(2, COUNTED_LEVELS // width)
    counts[END] = filled, filled < len(numbers)
    sums, signs = np.zeros((rows + RING, width + 1), np.int32), np.zeros((2, width), np.int64)
    for start in range(0, filled, rows):
        block = numbers[start : min(start + rows, filled)].astype(np.int64)
        row = np.arange(start, start + len(block))
        after, totals = (row + 1) % len(sums), np.minimum(np.abs(block), MAX_MAGNITUDE).cumsum(0)
        sums[after, :-1] = sums[start % len(sums), :-1] + totals
        sums[after, -1] = sums[after, :-1].sum(1)
        near = _near(sums, row, _logarithms())
        signs = np.concatenate([signs[-2:], np.sign(block)])
        _count(counts, np.abs(block), signs[2:], signs[:-2], near)
    prior = torch.tensor(PRIOR, dtype=torch.float64) / 2
    total = torch.from_numpy(counts) + prior
    # the probability of all bits of a context, in any order, is a quotient of gamma functions
    nats = total.sum(1).lgamma() - total.lgamma().sum(1) + prior.lgamma().sum() - prior.sum().lgamma()
    return int(float(nats.sum()) / math.log(256) + 1.01)


def decode(stream: Stream, rows: int, columns: int) -> Tensor:
    """The levels of a stream, (W,K) int8, or int32 if necessary.

    Raises:
        InputError: a truncated or altered stream, another size, or more levels than fit into memory.
    """
    if min(rows, columns) < 1 or (rows * LEVEL_BYTES + COLUMN_BYTES) * columns > free_memory():
        raise InputError(f"the map claims {rows} x {columns} levels; expected 1 or more, within free memory")
    packed = stream.bytes.numpy().tobytes()
    padded = bytearray(packed + bytes(SPAN // 8 - 1))
    levels, _, state = _run(np.zeros((rows, columns), np.int8), padded, reads=True)
    left, checksum = max(0, len(padded) - int(state[2])), _checksum(levels)
    if left or checksum != stream.checksum:
        seen = f"{len(packed)} bytes, {left} of them unused, decode to levels of checksum {checksum}"
        expected = f"expected {levels.size} levels of {stream.checksum}"
        raise InputError(f"the coded lines are truncated or altered: {seen}; {expected}")
    return torch.from_numpy(levels)


def _check_size(rows: int, columns: int, size: int) -> None:
    """Refuse a stream of few bytes for many rows up to the last that is not 0: it is slow to decode."""
    if rows * columns > LEVELS_AT_LEAST + LEVELS_PER_BYTE * size:
        raise InputError(f"{rows} x {columns} levels in {size} bytes are nearly all 0; expected more bytes")


def _integers(levels: Tensor) -> Ints:
    numbers: Ints = levels.detach().cpu().contiguous().numpy()
    return numbers.astype(np.int8) if _fits(numbers) else numbers


def _fits(levels: Ints) -> bool:
    """Whether the levels fit into int8."""
    return levels.dtype == np.int8 or bool(levels.min() >= -128 and levels.max() <= 127)


def _checksum(levels: Ints) -> int:
    return zlib.crc32(levels.data, zlib.crc32(repr(levels.shape).encode()))


def _filled(levels: Ints) -> int:
    """The number of rows up to the last that is not 0."""
    return 1 + int(np.flatnonzero(levels.any(1)).max(initial=-1))


def _count(counts: np.ndarray, size: Ints, sign: Ints, before: Ints, near: Ints) -> None:
    """Add the bits of levels (R,K) to counts (CONTEXTS,2); before: the sign two rows before each."""
    length = np.frexp(size)[1].astype(np.int64)
    ends = np.bincount((length * NEAR + near).ravel(), minlength=32 * NEAR).reshape(32, NEAR)
    more = ends[::-1].cumsum(0)[::-1] - ends
    counts[LENGTH:] += np.stack([ends, more], 2).reshape(-1, 2)
    counts[LENGTH + LENGTH_MAX * NEAR :, 0] = 0  # the longest has no final bit
    for minus in (0, 1):
        counts[SIGN : SIGN + 3, minus] += np.bincount(1 + before[sign == 1 - 2 * minus], minlength=3)
    for bits in range(2, 1 + int(length.max())):
        large = size[length == bits]
        ones = (large[:, None] >> np.arange(bits - 1) & 1).sum(0)
        first = BITS + 32 * bits
        counts[first : first + bits - 1] += np.stack([len(large) - ones, ones], 1)


def _run(levels: Ints, packed: bytearray, reads: bool = False) -> tuple[Ints, int, Any]:
    """Write levels to bytes, or read them -> levels, the row at which coding ended, the state of `_code`."""
    rows, columns = levels.shape
    kernel, begin = _kernel(levels.size), SPAN // 8 if reads else 0
    state: Any = np.array([int.from_bytes(packed[:begin], "big"), 1 << SPAN, begin])
    counts: Any = np.tile(PRIOR, CONTEXTS)
    if kernel is _code:  # lists, whose elements Python reads faster
        state, counts = state.tolist(), counts.tolist()
    sums, before = np.zeros((RING, columns + 1), np.int32), np.zeros((2, columns), np.int32)
    end, row, step = _filled(levels), 0, max(1, CODED_LEVELS // columns)
    coder = reads, state, counts, sums, _logarithms()
    for start in range(0, rows, step):
        some = levels[start : start + step]
        if reads:
            _check_size(start, columns, len(packed))
        else:
            bits = 2 * max(int(some.max()), -int(some.min())).bit_length() + 2  # of a level, and a row
            packed.extend(bytes(max(0, int(state[2]) + BIT_BYTES * bits * some.size - len(packed))))
        block = np.concatenate([before, some], dtype=np.int32)
        row = kernel(block, start, end, packed if kernel is _code else np.frombuffer(packed, np.uint8), coder)
        before = block[-2:]
        if reads:
            levels = levels if _fits(block) else levels.astype(np.int32, copy=False)
            levels[start : start + step] = block[2:]
        if row < start + len(some) or state[2] > len(packed):
            break
    return levels, row, state


# The functions from here to `_near` run in Python, on lists, or compiled by numba, on arrays.


def _code(block: Any, start: int, filled: int, packed: Any, coding: Any) -> int:
    """Code the rows of a block, which follow the two rows before `start`; the row from which all are 0."""
    reads, state, counts, sums, logarithms = coding
    # the lower end of the interval, or its distance from the value read; its width; the position in `packed`
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
                    bit = size >> n & 1
                    bit, low, span, at = _bit(context + n, bit, reads, low, span, at, counts, packed)
                    value = 2 * value + bit
                block[r, f] = -value if minus else value
        now, after = sums[row % RING], sums[(row + 1) % RING]
        after[:-1] = now[:-1] + np.minimum(np.abs(block[r]), MAX_MAGNITUDE)
        after[-1] = after[:-1].sum()
    else:
        row = start + len(block) - 2
    state[0], state[1], state[2] = low, span, at
    return row


def _bit(
    context: int, bit: int, reads: bool, low: int, span: int, at: int, counts: Ints, packed: bytearray | Ints
) -> tuple[int, int, int, int]:
    """Code a bit in its context -> the bit, and the interval and position after it."""
    zero, one = counts[2 * context], counts[2 * context + 1]
    part = span // (zero + one) * zero
    if reads:
        bit = int(low >= part)
    if bit:
        low += -part if reads else part
        span -= part
    else:
        span = part
    while span < SMALLEST:
        span <<= 8
        low = (low << 8 | (packed[at] if at < len(packed) else 0)) if reads else _put(low, at, packed)
        at += 1
    counts[2 * context + bit] += 2
    return bit, low, span, at


def _put(low: int, at: int, packed: bytearray | Ints) -> int:
    """Write the first byte of the interval's lower end, with a carry into the bytes before it."""
    byte = low >> MIN_SPAN
    if byte > 255:
        last = at - 1
        while packed[last] == 255:
            packed[last] = 0
            last -= 1
        packed[last] += 1
    packed[at] = byte & 255
    return (low & SMALLEST - 1) << 8


def _near(sums: Ints, rows: Ints, logarithms: Ints) -> Any:
    """The contexts (R,K), 0 to `NEAR`, by the recent growth of `sums` (.., K+1) over all earlier rows."""
    now, columns = sums[rows % len(sums)], sums.shape[1] - 1
    far = np.minimum(np.minimum(np.maximum(rows // 2, 16), REACH), rows)
    close = np.minimum(np.minimum(np.maximum(rows // 16, 2), 8), rows)
    recent = (now[:, -1] - sums[(rows - close) % len(sums)][:, -1]).astype(np.int64)
    mean = (recent << 10) // (np.maximum(close, 1) * columns)
    # the mean magnitude over recent rows, in 256ths, with more weight on the last two
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


_coded = 0  # levels, in this process


def _kernel(levels: int) -> Callable[..., int]:
    """The function that codes this number of further levels."""
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
