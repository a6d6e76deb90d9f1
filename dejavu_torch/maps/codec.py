"""Integer levels as a stream of bytes: an arithmetic code that learns, as it goes, from what is near."""

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

ESCAPE = -128  # stands for a level that int8 does not hold
LEVELS_PER_BYTE, LEVELS_AT_LEAST = 2**13, 2**22  # of a stream, at most
LEVEL, COLUMN = 4, 2**10  # bytes that a level takes while it is decoded, and a column besides
MOST = 15  # a magnitude counts for no more in what is near
REACH = 128  # rows that are near

# symbols: levels + ZERO, and in front of a row, that it goes on, or that all rows left are 0
ZERO, GOES_ON, ENDS, SYMBOLS = 128, 256, 257, 258
NONE, TOO_SHORT, TOO_MANY = 258, 259, 260  # no symbol, too few bytes, and too many rows for them
# contexts: of a bit in every row, of signs, of the bits of a magnitude, and of how many bits it has
END, SIGN, BITS, LENGTH = 0, 1, 4, 4 + 8 * 8
NEAR = 34  # kinds of neighbourhood
CONTEXTS = LENGTH + 8 * NEAR
FIRST = (2, 1)  # 0s and 1s of a context before there are any; each one counts 2

BLOCK, PIECE = 2**14, 2**11  # levels whose neighbourhood is found, and that are coded, at a time
PATH, SYMBOL = 17, 80  # bits of a symbol, and bytes, that it takes less of
SPAN, BYTE = 56, 48  # bits of the coder's interval at first, and at least
LEAST = 1 << BYTE
WORTH_COMPILING = 2**21  # levels: without numba they take about as long as to compile
LIGHTER = 8  # so many levels are counted in the time of one that is coded


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
    whole = _numbers(levels)
    code = _code(whole.size)
    tables = [code.numbers(table) for table in (_padded().ravel(), *_first_counts())]
    packed, low, span, size = bytearray(), 0, 1 << SPAN, 0
    for block in _symbols(whole, code):
        begin, near, before = (part.ravel() for part in (block[0] * np.int16(PATH), *block[1:]))
        for at in range(0, len(begin), PIECE):
            if (needed := size + SYMBOL * PIECE) > len(packed):
                packed.extend(bytes(needed))
            parts = [code.numbers(part[at : at + PIECE]) for part in (begin, near, before)]
            low, span, size = code.write(*parts, code.bytes(packed), *tables, low, span, size)
    packed[size:] = bytes(1)
    _shift(packed, low + LEAST - 1, size)  # a number in the interval whose further bytes are 0
    check_work(len(_filled(whole)), whole.shape[1], len(packed))
    return Stream(torch.frombuffer(packed, dtype=torch.uint8), _checksum(whole))


def coded_bytes(levels: Tensor) -> int:
    """What `encode` needs, without coding: a byte more at most.

    Shape: (W,K) int8 -> scalar.

    Example:
        >>> coded_bytes(torch.zeros(500, 20, dtype=torch.int8))
        1
    """
    whole = _numbers(levels)
    seen = np.zeros(SYMBOLS * NEAR * 3, np.int64)  # how often a symbol came with what is near
    for symbols, near, before in _symbols(whole, _code(whole.size // LIGHTER)):
        seen += np.bincount(((symbols * np.int32(NEAR) + near) * 3 + before).ravel(), minlength=len(seen))
    counts = np.zeros((CONTEXTS, 2))
    steps, taken = _taken()
    each = (taken @ seen.reshape(SYMBOLS, -1)).reshape(-1, NEAR, 3)
    for step, times in zip(steps.tolist(), each, strict=True):
        context, bit = step >> 1, step & 1
        if context >= LENGTH:
            counts[context : context + NEAR, bit] += times.sum(1)
        elif context == SIGN:
            counts[SIGN : SIGN + 3, bit] += times.sum(0)
        else:
            counts[context, bit] += times.sum()
    start = torch.tensor(FIRST, dtype=torch.float64) / 2
    after = torch.from_numpy(counts) + start
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
    if min(rows, columns) < 1 or (rows * LEVEL + COLUMN) * columns > free_memory():
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


def _numbers(levels: Tensor) -> Ints:
    numbers: Ints = levels.detach().cpu().contiguous().numpy()
    return numbers


def _checksum(levels: Ints) -> int:
    return zlib.crc32(levels.data, zlib.crc32(repr(levels.shape).encode()))


def _filled(levels: Ints) -> Ints:
    """The rows up to the last that is not 0."""
    filled = np.flatnonzero(levels.any(1))
    return levels[: int(filled[-1]) + 1 if len(filled) else 0]


def _blocks(rows: int, columns: int) -> Iterator[tuple[int, int, tuple[Ints, Ints, int]]]:
    """Rows [start, stop) at a time, and room for what `_near` sums up, which keeps that of the rows before.

    The sums are those of each column and of all together, and the row that they begin with.
    """
    halo, step = min(REACH, rows), max(1, BLOCK // columns)
    sums = np.zeros((halo + min(step, rows), columns), np.int32)
    totals = np.zeros(len(sums), np.int64)
    for start in range(0, rows, step):
        yield start, min(start + step, rows), (sums, totals, start - halo)
        sums[:halo], totals[:halo] = sums[-halo:], totals[-halo:]


def _symbols(levels: Ints, code: _Code) -> Iterator[tuple[Ints, Ints, Ints]]:
    """What is coded, a block of rows at a time: symbols, `_near`, signs two rows before, 0 to 2; (R,1+K)."""
    filled = _filled(levels)
    for start, stop, sums in _blocks(*filled.shape):
        shape = (stop - start, 1 + filled.shape[1])
        symbols, near = np.full(shape, GOES_ON, np.int16), np.zeros(shape, np.int16)
        np.add(filled[start:stop], ZERO, out=symbols[:, 1:], dtype=np.int16)
        code.near(filled, start, near, *sums, _logarithms())
        before = np.ones(shape, np.int8)
        earlier = filled[max(start - 2, 0) : max(stop - 2, 0)]
        before[len(before) - len(earlier) :, 1:] += np.sign(earlier)
        yield symbols, near, before
    if len(filled) < len(levels):
        yield np.full((1, 1), ENDS, np.int16), np.zeros((1, 1), np.int16), np.zeros((1, 1), np.int8)


def _decode(packed: bytes, levels: Ints) -> None:
    """Fill in what `encode` packed; ValueError where there are more or fewer bytes."""
    if not packed:
        raise ValueError("no bytes")
    rows, columns = levels.shape
    code, near = _code(levels.size), np.zeros((1, 1 + columns), np.int16)
    tables = [code.numbers(table) for table in (*_tree(), *_first_counts())]
    most = (LEVELS_AT_LEAST + LEVELS_PER_BYTE * len(packed)) // columns
    ahead = SPAN // 8
    padded = bytearray(packed + bytes(ahead - 1))
    why, value, span, read = GOES_ON, int.from_bytes(padded[:ahead], "big"), 1 << SPAN, ahead
    for start, stop, sums in _blocks(rows, columns):
        place = (start, stop, most, near, *sums, _logarithms())
        why, value, span, read = code.read(code.bytes(padded), levels, *place, *tables, value, span, read)
        if why != GOES_ON:
            break
    if why == TOO_MANY:
        check_work(most + 1, columns, len(packed))
    if why == NONE:
        raise ValueError("a level that int8 does not hold")
    if why == TOO_SHORT:
        raise ValueError(f"{len(packed)} bytes are too few")
    if read != len(padded):
        raise ValueError(f"{len(packed)} bytes, of which {len(padded) - read} are left over")


# The functions down to `_near` run as they stand, on lists, and compiled by numba, on arrays.


def _write(
    begin: Any,
    near: Any,
    before: Any,
    packed: Any,
    steps: Any,
    zeros: Any,
    ones: Any,
    low: int,
    span: int,
    size: int,
) -> tuple[int, int, int]:
    """Pack symbols behind the bytes that are there.

    Args:
        begin: of the symbols, where their paths do in `steps`, which is `_padded`. near, before: see
            `_symbols`. packed: bytes, with room.
        zeros, ones: how often each context had them. low, span: the interval. size: bytes that are there.

    Returns:
        low, span, size.
    """
    for at, around, sign in zip(begin, near, before):  # noqa: B905, numba knows no `strict`
        step = steps[at]
        while step >= 0:
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
            at += 1
            step = steps[at]
    return low, span, size


def _shift(packed: Any, low: int, size: int) -> tuple[int, int]:
    """Pack the first byte of the interval's lower end, carrying into those before it; what is left of it."""
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
    packed: Any,
    levels: Ints,
    start: int,
    stop: int,
    most: int,
    near: Ints,
    sums: Ints,
    totals: Ints,
    first: int,
    logarithms: Ints,
    contexts: Any,
    after: Any,
    zeros: Any,
    ones: Any,
    value: int,
    span: int,
    read: int,
) -> tuple[int, int, int, int]:
    """Fill in the levels of rows [start, stop).

    Args:
        most: rows that the bytes are good for. near: (1,1+K), room. sums, totals, first: see `_blocks`.
        contexts, after: see `_tree`. zeros, ones: how often each context had them. value, span: the bytes'
            place in the interval. read: how many of them are.

    Returns:
        `GOES_ON`, or why there are no more rows. value, span, read.
    """
    for row in range(start, stop):
        _near(levels, row, near, sums, totals, first, logarithms)
        for f, around in enumerate(_listed(near[0])):
            node = 1 if f else 0
            while node >= 0:
                context = contexts[node]
                if context >= LENGTH:
                    context += around
                elif context == SIGN:
                    context += 1
                    if row > 1:
                        before = levels[row - 2, f - 1]
                        context += int(before > 0) - int(before < 0)
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
                        return TOO_SHORT, value, span, read
                    value = value << 8 | packed[read]
                    span <<= 8
                    read += 1
            symbol = -1 - node
            if symbol == ZERO:
                continue
            if symbol < GOES_ON:
                levels[row, f - 1] = symbol - ZERO
            elif symbol > GOES_ON:
                return symbol, value, span, read
            elif row >= most:
                return TOO_MANY, value, span, read
    return GOES_ON, value, span, read


def _listed(numbers: Any) -> Any:
    """What goes through them fastest."""
    return numbers.tolist()


def _reach(row: int) -> tuple[int, int]:
    """How many rows before a row count for each of its columns, and for all together.

    Convention: for a column half as many as there are, 16 to 128 of them, so that it reaches as far in
        octaves everywhere; for all together, the last 8 or fewer.
    """
    return min(max(row // 2, 16), REACH, row), min(max(row // 16, 2), 8, row)


def _column(now: Any, then: Any, last: Any, reach: Any) -> Any:
    """The mean magnitude over so many rows, in 256ths; the last two count for more. Numbers or arrays."""
    return ((now - then) << 8) // reach + ((now - last) << 4)


def _kind(wide: Any, row: Any, logarithms: Any) -> Any:
    """0 to `NEAR`, of the mean of three columns, the middle one twice, and that of the row in 1024ths."""
    return (2 * logarithms[(wide >> 2) + 3] + logarithms[row + 4]) // 9


def _near(
    levels: Ints, start: int, near: Ints, sums: Ints, totals: Ints, first: int, logarithms: Ints
) -> None:
    """How large the levels of rows may be by those of the rows before, 0 to `NEAR`, into (R,1+K).

    Also fills in the sums of these rows; those of the rows before are there. See `_blocks`.
    """
    rows = np.arange(start, start + len(near))
    at, end = start - first, start - first + len(near)
    new = len(near) - (not start)  # before row 0 there is nothing
    if new:
        sizes = np.minimum(np.abs(levels[rows[-1] - new : rows[-1]], dtype=np.int16), MOST)
        sums[end - new : end] = sizes.cumsum(0, dtype=np.int32) + sums[end - new - 1]
        totals[at:end] = sums[at:end].sum(1)
    far, close = _reaches()[:, np.minimum(rows, 2 * REACH)]
    here = rows - first
    row = (totals[at:end] - totals[here - close] << 10) // (close.clip(1) * levels.shape[1])
    now = sums[at:end]
    column = _column(
        now, sums.take(here - far, 0), sums.take(here - np.minimum(rows, 2), 0), far.clip(1)[:, None]
    )
    wide = 2 * column
    wide[:, 1:] += column[:, :-1]
    wide[:, :-1] += column[:, 1:]
    wide[:, 0] += column[:, 0]
    wide[:, -1] += column[:, -1]
    near[:, 1:] = _kind(wide, row[:, None], logarithms)


def _near_by_numbers(
    levels: Ints, start: int, near: Ints, sums: Ints, totals: Ints, first: int, logarithms: Ints
) -> None:
    """`_near` where it is compiled: loops over numbers are several times as fast there as arrays."""
    columns = levels.shape[1]
    for i in range(len(near)):
        row = start + i
        now, total = sums[row - first], 0
        if row:
            before = sums[row - 1 - first]
            for f in range(columns):
                now[f] = before[f] + min(abs(np.int64(levels[row - 1, f])), MOST)
                total += now[f]
        totals[row - first] = total
        far, close = _reach(row)
        then, last = sums[row - far - first], sums[row - min(row, 2) - first]
        mean = (total - totals[row - close - first] << 10) // (max(close, 1) * columns)
        far = max(far, 1)
        here = _column(now[0], then[0], last[0], far)
        left = here
        for f in range(columns):
            g = min(f + 1, columns - 1)
            right = _column(now[g], then[g], last[g], far)
            near[i, 1 + f] = _kind(left + 2 * here + right, mean, logarithms)
            left, here = here, right


@cache
def _logarithms() -> Ints:
    """8 log2 of 0 to 2^14, rounded down; by whole numbers, so that all machines find the same."""
    return np.array([0, *((n**8).bit_length() - 1 for n in range(1, 2**14 + 1))], np.int16)


@cache
def _reaches() -> Ints:
    """`_reach` of all rows but those that have that of the last one: (2,2*REACH+1)."""
    return np.array([_reach(row) for row in range(2 * REACH + 1)], np.int32).T


@cache
def _paths() -> list[list[int]]:
    """The bits of each symbol, as 2 * context + bit.

    Signs and lengths have the first of their contexts; what is near tells which of them it is.
    """
    paths = []
    for level in range(-ZERO, ZERO):
        size = abs(level)
        length = size.bit_length()
        path = [(LENGTH + n * NEAR, int(n < length)) for n in range(min(length + 1, 8))]
        if size:
            path.append((SIGN, int(level < 0)))
            path += [(BITS + (length - 1) * 8 + n, size >> n & 1) for n in reversed(range(length - 1))]
        paths.append(path)
    paths += [[(END, 0)], [(END, 1)]]
    return [[2 * context + bit for context, bit in path] for path in paths]


@cache
def _padded() -> Ints:
    """The paths, each with -1 behind it: (SYMBOLS,PATH)."""
    return np.array([path + [-1] * (PATH - len(path)) for path in _paths()])


@cache
def _taken() -> tuple[Ints, NDArray[np.float64]]:
    """The steps that there are, and whether each symbol takes them: (S,), (S,SYMBOLS)."""
    steps = np.unique(_padded())[1:]
    return steps, np.array([np.isin(steps, path) for path in _paths()]).T.astype(np.float64)


@cache
def _tree() -> tuple[Ints, Ints]:
    """The paths as a tree: that of the bit of a row from node 0 on, that of levels from node 1 on.

    Returns:
        The contexts of the nodes. At 2 * node + bit, the node that comes next, or -1 - symbol.
    """
    contexts, after = [END, LENGTH], [0] * 4
    nodes: dict[tuple[int, ...], int] = {}  # by the steps to them
    for symbol, path in enumerate(_paths()):
        node = int(symbol < GOES_ON)
        for n, step in enumerate(path):
            edge = 2 * node + (step & 1)
            if n + 1 == len(path):
                after[edge] = -1 - symbol
                break
            node = nodes.setdefault(tuple(path[: n + 1]), len(contexts))
            if node == len(contexts):
                contexts.append(path[n + 1] >> 1)
                after += [-1 - NONE] * 2
            after[edge] = node
    return np.array(contexts), np.array(after)


def _first_counts() -> tuple[Ints, Ints]:
    zeros, ones = (np.full(CONTEXTS, count) for count in FIRST)
    return zeros, ones


class _Code(NamedTuple):
    """The functions that take the time, and what they take arrays and bytes as."""

    near: Callable[..., None]
    write: Callable[..., tuple[int, int, int]]
    read: Callable[..., tuple[int, int, int, int]]
    numbers: Callable[[Ints], Any]
    bytes: Callable[[bytearray], Any]


PLAIN = _Code(_near, _write, _read, lambda numbers: numbers.tolist(), lambda packed: packed)
_coded = 0  # levels, by this process


def _code(levels: int) -> _Code:
    """How to code so many more levels."""
    global _coded
    _coded += levels
    return (_compiled() if _coded >= WORTH_COMPILING else None) or PLAIN


@cache
def _compiled() -> _Code | None:
    """The same functions compiled, or None where numba is not installed or does not work."""
    levels, table = "int8[:,::1]", "int64[::1]"
    place = f"int16[:,::1], int32[:,::1], {table}, int64, int16[::1]"
    read = f"uint8[::1], {levels}, int64, int64, int64, {place}"
    coder = f"{table}, {table}, int64, int64, int64"
    try:
        from numba.extending import overload, register_jitable

        for function in (_shift, _reach, _column, _kind):
            register_jitable(function)
        overload(_listed)(lambda numbers: lambda numbers: numbers)
        overload(_near, strict=False)(  # its form has the types of arguments in its signature
            lambda levels, start, near, sums, totals, first, logarithms: _near_by_numbers
        )
        return _Code(
            compiled(_near_by_numbers, f"void({levels}, int64, {place})"),
            compiled(
                _write,
                f"UniTuple(int64, 3)(int16[::1], int16[::1], int8[::1], uint8[::1], {table}, {coder})",
            ),
            compiled(_read, f"UniTuple(int64, 4)({read}, {table}, {table}, {coder})"),
            lambda numbers: numbers,
            lambda packed: np.frombuffer(packed, np.uint8),
        )
    except Exception as error:  # a broken compiler must not break what works without one
        log.info("levels are coded in Python, not by numba: %s", " ".join(str(error).split()))
        return None


def to_int8(levels: Tensor) -> tuple[Tensor, Tensor]:
    """Whole numbers as int8, and those that int8 does not hold, in their order.

    Shape: (W,K) -> (W,K) int8, (E,) int32.
    """
    large = levels.abs() > 127
    return torch.where(large, ESCAPE, levels).to(torch.int8), levels[large].to(torch.int32)


def from_int8(small: Tensor, escapes: Tensor) -> Tensor:
    """The inverse of `to_int8`, (W,K) int32."""
    return small.to(torch.int32).masked_scatter(small == ESCAPE, escapes)
