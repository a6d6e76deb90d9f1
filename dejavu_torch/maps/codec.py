"""The entropy coder of a spectral map: int8 levels to bytes by adaptive arithmetic coding, and back.

Each row begins with a bit that is 1 if all further levels are 0. A level is the number of bits of its
magnitude in unary, its sign, and the bits below the leading one. The probability of a bit follows how often
it was 1 in its context: for the unary bits, the magnitudes in this column and its neighbours over the rows
before, and in all columns over the last few rows; for a sign, the sign two rows before, which is the line of
the same kind, cosine or sine. All arithmetic is in integers, so that every machine decodes the same levels.
"""

from __future__ import annotations

import logging
import math
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dejavu_torch.maps.compiling import compiled
from dejavu_torch.memory import free_memory
from dejavu_torch.types import InputError

log = logging.getLogger("dejavu_torch")

Ints = NDArray[np.integer[Any]]

ESCAPE = -128  # in place of a level that int8 does not hold
LEVELS_PER_BYTE, LEVELS_AT_LEAST = 2**13, 2**22  # most levels of a stream
LEVEL, COLUMN = 4, 2**13  # bytes to decode a level, and a column
MOST = 15  # larger magnitudes count as this one in the sums of a context
REACH, RING = 128, 256  # rows that a context looks back at most, and whose sums are kept

ZERO, GOES_ON, ENDS, SYMBOLS = 128, 256, 257, 258  # a symbol is a level + ZERO, or begins a row
NO_SYMBOL, TOO_SHORT, TOO_MANY = 258, 259, 260  # why decoding fails
END, SIGN, BITS, LENGTH = 0, 1, 4, 4 + 8 * 8  # the first context of each kind of bit
NEAR = 34  # contexts by the magnitudes near a level
CONTEXTS = LENGTH + 8 * NEAR
FIRST = (2, 1)  # initial counts of 0s and 1s in a context; each bit adds 2
BLOCK, PIECE = 2**16, 2**11  # levels whose contexts are found, and that are encoded, at a time
PATH, SYMBOL = 17, 80  # upper bounds of bits, and of bytes, per symbol
SPAN, BYTE = 56, 48  # bits of the interval at first, and at least
LEAST = 1 << BYTE
WORTH_COMPILING = 2**21  # levels that Python codes in the time that numba compiles
LIGHTER = 8  # `coded_bytes` is so many times faster than `encode`


class Stream(NamedTuple):
    """bytes: (n,) uint8, compressed. checksum: CRC-32 of the levels and their shape."""

    bytes: Tensor
    checksum: int


def encode(levels: Tensor) -> Stream:
    """Compress integer levels.

    Shape: (W,K) int8 -> (n,) uint8.
    """
    whole = _numbers(levels)
    code = _code(whole.size)
    tables = tuple(code.numbers(table) for table in (_paths(), *_first_counts()))
    packed = bytearray()
    low, span, size = 0, 1 << SPAN, 0
    for block in _symbols(whole, code):
        for at in range(0, len(block[0]), PIECE):
            packed.extend(bytes(max(0, size + SYMBOL * PIECE - len(packed))))
            piece = [code.numbers(part[at : at + PIECE]) for part in block]
            low, span, size = code.write(*piece, code.bytes(packed), tables, low, span, size)
    packed[size:] = bytes(1)
    _shift(packed, low + LEAST - 1, size)  # a number in the interval whose further bytes are 0
    check_work(len(_filled(whole)), whole.shape[1], len(packed))
    return Stream(torch.frombuffer(packed, dtype=torch.uint8), _checksum(whole))


def coded_bytes(levels: Tensor) -> int:
    """The size of `encode`'s stream, or a byte more, without coding.

    Shape: (W,K) int8 -> scalar.

    Example:
        >>> coded_bytes(torch.zeros(500, 20, dtype=torch.int8))
        1
    """
    whole = _numbers(levels)
    seen = np.zeros(SYMBOLS * NEAR * 3, np.int64)  # occurrences of each symbol in each neighbourhood
    for symbols, near, before in _symbols(whole, _code(whole.size // LIGHTER)):
        seen += np.bincount((symbols * np.int32(NEAR) + near) * 3 + before, minlength=len(seen))
    counts = np.zeros((CONTEXTS, 2))
    steps, taken = _taken()
    each = (taken @ seen.reshape(SYMBOLS, -1)).reshape(-1, NEAR, 3)
    for step, times in zip(steps.tolist(), each, strict=True):
        context, bit = step >> 1, step & 1
        bits = times.sum(1) if context >= LENGTH else times.sum(0 if context == SIGN else None)
        counts[context : context + bits.size, bit] += bits
    start = torch.tensor(FIRST, dtype=torch.float64) / 2
    after = torch.from_numpy(counts) + start
    # the probability of all bits of a context, in any order, is a quotient of gamma functions
    nats = after.sum(1).lgamma() - after.lgamma().sum(1) + start.lgamma().sum() - start.sum().lgamma()
    return int(float(nats.sum()) / math.log(256) + 1.01)


def decode(stream: Stream, rows: int, columns: int) -> Tensor:
    """The levels of a stream, (W,K) int8.

    Raises:
        InputError: a truncated or altered stream, one of another size, or more than the memory holds.
    """
    check_claim(rows, columns)
    levels = np.zeros((rows, columns), np.int8)
    packed = stream.bytes.numpy().tobytes()
    padded = bytearray(packed + bytes(SPAN // 8 - 1))
    most = (LEVELS_AT_LEAST + LEVELS_PER_BYTE * len(packed)) // columns
    code = _code(levels.size)
    near = np.zeros((1, 1 + columns), np.int16)
    room = [code.numbers(one) for one in (near, _sums(columns), _logarithms())]
    tables = tuple(code.numbers(table) for table in (*_tree(), *_first_counts()))
    failed = TOO_SHORT, len(padded)
    why, read = code.read(code.bytes(padded), levels, most, *room, tables) if packed else failed
    if why == TOO_MANY:
        check_work(most + 1, columns, len(packed))
    left, checksum = len(padded) - read, _checksum(levels)
    if why not in (GOES_ON, ENDS) or left or checksum != stream.checksum:
        raise InputError(
            f"the coded lines are truncated or altered: {len(packed)} bytes, {left} of them left over, give "
            f"levels of checksum {checksum}; expected {levels.size} levels of {stream.checksum}"
        )
    return torch.from_numpy(levels)


def check_claim(rows: int, columns: int) -> None:
    """Refuse, before anything is allocated, an empty shape and more levels than the memory holds.

    Raises:
        InputError: naming both sizes.
    """
    if min(rows, columns) < 1 or (rows * LEVEL + COLUMN) * columns > free_memory():
        raise InputError(
            f"the map claims {rows} x {columns} levels; expected at least one, and what fits into the memory"
        )


def check_work(rows: int, columns: int, size: int) -> None:
    """Refuse a short stream of very many zeros, which would take far too long to decode.

    Args:
        rows: up to the last that is not 0. size: bytes of the stream.

    Raises:
        InputError: naming the numbers.
    """
    if rows * columns > LEVELS_AT_LEAST + LEVELS_PER_BYTE * size:
        raise InputError(
            f"{rows} x {columns} levels in {size} bytes are next to nothing but zeros; "
            "expected more bytes per place"
        )


def to_int8(levels: Tensor) -> tuple[Tensor, Tensor]:
    """Levels as int8, and separately those that int8 does not hold, in their order.

    Shape: (W,K) -> (W,K) int8, (E,) int32.
    """
    large = levels.abs() > 127
    return torch.where(large, ESCAPE, levels).to(torch.int8), levels[large].to(torch.int32)


def from_int8(small: Tensor, escapes: Tensor) -> Tensor:
    """The inverse of `to_int8`, (W,K) int32."""
    return small.to(torch.int32).masked_scatter(small == ESCAPE, escapes)


def _numbers(levels: Tensor) -> Ints:
    numbers: Ints = levels.detach().cpu().contiguous().numpy()
    return numbers


def _checksum(levels: Ints) -> int:
    return zlib.crc32(levels.data, zlib.crc32(repr(levels.shape).encode()))


def _filled(levels: Ints) -> Ints:
    """The rows up to the last that is not 0."""
    filled = np.flatnonzero(levels.any(1))
    return levels[: int(filled[-1]) + 1 if len(filled) else 0]


def _symbols(levels: Ints, code: _Code) -> Iterator[tuple[Ints, Ints, Ints]]:
    """Blocks of symbols, each with the magnitudes near it and the sign two rows before (0 to 2)."""
    filled = _filled(levels)
    rows, columns = filled.shape
    sums, step = _sums(columns), max(1, BLOCK // columns)
    for start in range(0, rows, step):
        block = filled[start : start + step]
        symbols = np.full((len(block), 1 + columns), GOES_ON, np.int16)
        near, before = np.zeros_like(symbols), np.ones(symbols.shape, np.int8)
        np.add(block, ZERO, out=symbols[:, 1:], dtype=np.int16)
        code.near(filled, start, near, sums, _logarithms())
        earlier = filled[max(start - 2, 0) : max(start + len(block) - 2, 0)]
        before[len(block) - len(earlier) :, 1:] += np.sign(earlier)
        yield symbols.ravel(), near.ravel(), before.ravel()
    if rows < len(levels):
        yield np.array([ENDS], np.int16), np.zeros(1, np.int16), np.zeros(1, np.int8)


def _sums(columns: int) -> Ints:
    """Room for the sums of magnitudes over all rows before a row: of all columns, then of each one."""
    return np.zeros((RING, 1 + columns), np.int32)


# The functions from here to `_near` run as they are, on lists, and compiled by numba, on arrays.


def _write(
    symbols: Any, near: Any, before: Any, packed: Any, tables: Any, low: int, span: int, size: int
) -> tuple[int, int, int]:
    """Append symbols to the bytes; the interval's low and span, and the size, before and after.

    Args:
        symbols, near, before: see `_symbols`. tables: `_paths`, and the counts of each context.
    """
    paths, zeros, ones = tables
    for symbol, around, sign in zip(symbols, near, before):  # noqa: B905, numba knows no `strict`
        for step in paths[symbol]:
            if step < 0:
                break
            context = step >> 1
            if context >= LENGTH:
                context += around
            elif context == SIGN:
                context += sign
            zero, one = zeros[context], ones[context]
            part = span // (zero + one) * zero
            if step & 1:
                ones[context] = one + 2
                low += part
                span -= part
            else:
                zeros[context] = zero + 2
                span = part
            while span < LEAST:
                low, size = _shift(packed, low, size)
                span <<= 8
    return low, span, size


def _shift(packed: Any, low: int, size: int) -> tuple[int, int]:
    """Append the first byte of the interval's lower end, and carry into the bytes before it."""
    byte = low >> BYTE
    if byte > 255:
        last = size - 1
        while packed[last] == 255:
            packed[last] = 0
            last -= 1
        packed[last] += 1
    packed[size] = byte & 255
    return (low & LEAST - 1) << 8, size + 1


def _read(
    packed: Any, levels: Ints, most: int, near: Any, sums: Any, logarithms: Any, tables: Any
) -> tuple[int, int]:
    """Fill in the levels, of at most so many rows that are not all 0.

    Args:
        near: room for one row. tables: `_tree` and the counts of each context.

    Returns:
        `GOES_ON`, `ENDS`, or why there are no more rows; how many bytes were read.
    """
    contexts, after, zeros, ones = tables
    value, span, read = 0, 1 << SPAN, 0
    for _ in range(SPAN // 8):
        value = value << 8 | packed[read]
        read += 1
    for row in range(len(levels)):
        _near(levels, row, near, sums, logarithms)
        earlier = _listed(levels[row - 2 if row > 1 else row])
        for f, around in enumerate(near[0]):
            node = 1 if f else 0
            while node >= 0:
                context = contexts[node]
                if context >= LENGTH:
                    context += around
                elif context == SIGN:
                    before = earlier[f - 1]
                    context += 1 + int(before > 0) - int(before < 0)
                zero, one = zeros[context], ones[context]
                part = span // (zero + one) * zero
                if value < part:
                    zeros[context] = zero + 2
                    span = part
                    node = after[2 * node]
                else:
                    ones[context] = one + 2
                    value -= part
                    span -= part
                    node = after[2 * node + 1]
                while span < LEAST:
                    if read == len(packed):
                        return TOO_SHORT, read
                    value = value << 8 | packed[read]
                    span <<= 8
                    read += 1
            symbol = -1 - node
            if symbol == ZERO:
                continue
            if symbol < GOES_ON:
                levels[row, f - 1] = symbol - ZERO
            elif symbol > GOES_ON:
                return symbol, read
            elif row >= most:
                return TOO_MANY, read
    return GOES_ON, read


def _listed(numbers: Any) -> Any:
    """The form whose elements Python reads fastest."""
    return numbers.tolist()


def _near(levels: Ints, start: int, near: Any, sums: Any, logarithms: Any) -> None:
    """The contexts of rows by the magnitudes near each level, into near[:,1:]; also adds the rows' sums."""
    for i, found in enumerate(near):
        row = start + i
        now = sums[row % RING]
        if row:
            before, total = sums[(row - 1) % RING], 0
            for f, level in enumerate(_listed(levels[row - 1])):
                size = min(abs(0 + level), MOST)  # 0 + makes it int64 where compiled
                now[1 + f] = before[1 + f] + size
                total += size
            now[0] = before[0] + total
        far, close = min(max(row // 2, 16), REACH, row), min(max(row // 16, 2), 8, row)
        then, last = sums[(row - far) % RING], sums[(row - min(row, 2)) % RING]
        columns, far = len(now) - 1, max(far, 1)
        mean = (now[0] - sums[(row - close) % RING][0] << 10) // (max(close, 1) * columns)
        here = left = _column(now[1], then[1], last[1], far)
        for f in range(1, 1 + columns):
            g = min(f + 1, columns)
            right = _column(now[g], then[g], last[g], far)
            found[f] = _kind(left + 2 * here + right, mean, logarithms)
            left, here = here, right


def _column(now: Any, then: Any, last: Any, far: Any) -> Any:
    """The mean magnitude over the last rows, in 256ths, with more weight on the last two."""
    return ((now - then) << 8) // far + ((now - last) << 4)


def _kind(wide: Any, mean: Any, logarithms: Any) -> Any:
    """0 to `NEAR`, of the magnitudes near a level and the mean of the last rows."""
    return (2 * logarithms[(wide >> 2) + 3] + logarithms[mean + 4]) // 9


def _near_arrays(levels: Ints, start: int, near: Ints, _: Ints, logarithms: Ints) -> None:
    """`_near` by arrays, faster in Python."""
    first, stop = max(start - REACH, 0), start + len(near)
    sums = np.zeros((stop - first, levels.shape[1]), np.int32)  # over the rows from `first` on
    np.minimum(np.abs(levels[first : stop - 1], dtype=np.int16), MOST).cumsum(0, out=sums[1:])
    totals, rows = sums.sum(1), np.arange(start, stop)
    far = np.minimum((rows // 2).clip(16, REACH), rows)
    close = np.minimum((rows // 16).clip(2, 8), rows)
    here = rows - first
    mean = (totals[here] - totals[here - close] << 10) // (close.clip(1) * levels.shape[1])
    last = sums[here - np.minimum(rows, 2)]
    column = _column(sums[here[0] :], sums[here - far], last, far.clip(1)[:, None].astype(np.int32))
    wide = 2 * column
    wide[:, 1:] += column[:, :-1]
    wide[:, :-1] += column[:, 1:]
    wide[:, 0] += column[:, 0]
    wide[:, -1] += column[:, -1]
    near[:, 1:] = _kind(wide, mean[:, None], logarithms)


@cache
def _logarithms() -> Ints:
    """8 log2 of 0 to 2^14, rounded down, in integers."""
    return np.array([0, *((n**8).bit_length() - 1 for n in range(1, 2**14 + 1))], np.int16)


@cache
def _paths() -> Ints:
    """The bits of each symbol as 2 * context + bit, then -1: (SYMBOLS,PATH).

    Signs and lengths have the first of their contexts.
    """
    paths = np.full((SYMBOLS, PATH), -1)
    for level in range(-ZERO, ZERO):
        size = abs(level)
        length = size.bit_length()
        path = [(LENGTH + n * NEAR, int(n < length)) for n in range(min(length + 1, 8))]
        if size:
            path.append((SIGN, int(level < 0)))
            path += [(BITS + (length - 1) * 8 + n, size >> n & 1) for n in reversed(range(length - 1))]
        paths[level + ZERO, : len(path)] = [2 * context + bit for context, bit in path]
    paths[GOES_ON, 0], paths[ENDS, 0] = 2 * END, 2 * END + 1
    return paths


@cache
def _taken() -> tuple[Ints, NDArray[np.float64]]:
    """All steps of the paths, and whether each symbol takes them: (S,), (S,SYMBOLS)."""
    steps = np.unique(_paths())[1:]
    return steps, (_paths() == steps[:, None, None]).any(2).astype(np.float64)


@cache
def _tree() -> tuple[Ints, Ints]:
    """The paths as a tree: that of a row's first bit begins at node 0, that of levels at node 1.

    Returns:
        The context of each node. At 2 * node + bit, the next node, or -1 - symbol.
    """
    nodes: dict[tuple[int, ...], int] = {(1,): 0, (0,): 1}  # by whether they begin a row, and the steps
    contexts, after = np.zeros(2 * SYMBOLS, np.int64), np.full(4 * SYMBOLS, -1 - NO_SYMBOL)
    for symbol, path in enumerate(_paths().tolist()):
        key: tuple[int, ...] = (int(symbol >= GOES_ON),)
        path = path[: path.index(-1)]
        for step in path:
            node = nodes[key]
            key = (*key, step)
            contexts[node] = step >> 1
            more = len(key) <= len(path)
            after[2 * node + (step & 1)] = nodes.setdefault(key, len(nodes)) if more else -1 - symbol
    return contexts, after


def _first_counts() -> tuple[Ints, Ints]:
    zeros, ones = (np.full(CONTEXTS, count) for count in FIRST)
    return zeros, ones


class _Code(NamedTuple):
    """The inner loops, and the form of arrays and bytes that they accept."""

    near: Callable[..., None]
    write: Callable[..., tuple[int, int, int]]
    read: Callable[..., tuple[int, int]]
    numbers: Callable[[Ints], Any]
    bytes: Callable[[bytearray], Any]


PLAIN = _Code(_near_arrays, _write, _read, lambda numbers: numbers.tolist(), lambda packed: packed)
_coded = 0  # levels, by this process


def _code(levels: int) -> _Code:
    """How to code so many more levels."""
    global _coded
    _coded += levels
    return (_compiled() if _coded >= WORTH_COMPILING else None) or PLAIN


@cache
def _compiled() -> _Code | None:
    """The loops compiled, or None if numba is missing or broken."""
    table, levels = "int64[::1]", "int8[:,::1]"
    near = "int16[:,::1], int32[:,::1], int16[::1]"
    symbols = "int16[::1], int16[::1], int8[::1]"
    paths, tree = f"Tuple((int64[:,::1], {table}, {table}))", f"UniTuple({table}, 4)"
    try:
        from numba.extending import overload, register_jitable

        for function in (_shift, _near, _column, _kind):
            register_jitable(function)
        overload(_listed)(lambda numbers: lambda numbers: numbers)
        return _Code(
            compiled(_near, f"void({levels}, int64, {near})"),
            compiled(_write, f"UniTuple(int64, 3)({symbols}, uint8[::1], {paths}, int64, int64, int64)"),
            compiled(_read, f"UniTuple(int64, 2)(uint8[::1], {levels}, int64, {near}, {tree})"),
            lambda numbers: numbers,
            lambda packed: np.frombuffer(packed, np.uint8),
        )
    except Exception as error:  # a broken compiler must not break what works without one
        log.info("levels are coded in Python, not by numba: %s", " ".join(str(error).split()))
        return None
