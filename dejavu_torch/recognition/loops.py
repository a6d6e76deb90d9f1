"""A step along routes as loops, in single precision; compiled by numba, where it is installed.

Beliefs are (S,): the places in one or two directions, by chain, (M,D,N), then being off the map; see
`AlongRoute`.
"""

from __future__ import annotations

from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from dejavu_torch.maps.compiling import Floats, Kernel, compiled

Numbers = NDArray[np.int64]
Doubles = NDArray[np.float64]

# A route is `keep` (D,N), links as direction, from and to (L,3), with their shares (L,), the probability of a
# turn, and whether it is plain, without ends or links; a motion, moves (C,M,V+1) of M chains, the shares of a
# state's mass that go anywhere, and off the map, (C,S) each, the mass of each place of what goes anywhere, by
# chain, (M,), and the shares of a chain that go on as each chain, (M,M).
ROUTE = "Tuple((float32[:,::1], int64[:,::1], float32[::1], float32, boolean))"
MOTION = "Tuple((float32[:,:,::1], float32[:,::1], float32[:,::1], float32[::1], float32[:,::1]))"
SEEN = "float32[:,::1], float32[:,:,::1], boolean[:,::1]"
SWEPT = f"void({SEEN}, {MOTION}, {ROUTE}, float32[:,:,::1], float32[:,::1])"
Route = tuple[Floats, Numbers, Floats, float, bool]
Steps = tuple[Floats, Floats, Floats, Floats, Floats]


WORTH_COMPILING = 2**17  # numbers that torch takes longer for than numba does to load

# All loops count from 0 over slices, which the compiler makes vectors of.


def _turned(on: Floats, turn: float, out: Floats) -> None:
    """Mass (D N), some of it in the other direction."""
    back = on[::-1]
    for i in range(len(on)):
        out[i] = on[i] + turn * (back[i] - on[i])


def _added(factor: float, on: Floats, out: Floats) -> None:
    for i in range(len(on)):
        out[i] += factor * on[i]


def _scaled(factor: float, on: Floats, out: Floats) -> None:
    for i in range(len(on)):
        out[i] = factor * on[i]


def _product(one: Floats, other: Floats) -> np.float32:
    total = np.float32(0)
    for i in range(len(one)):
        total += one[i] * other[i]
    return total  # type: ignore[no-any-return]


def _times(one: Floats, other: Floats, out: Floats) -> None:
    for i in range(len(one)):
        out[i] = one[i] * other[i]


def _shifted(on: Floats, route: Route, back: bool, out: Floats) -> None:
    """Mass (D N) one place further, or its transpose."""
    keep, linked, shares, _, _ = route
    n = keep.shape[1]
    for d in range(keep.shape[0]):
        own, moved, kept = on[d * n : d * n + n], out[d * n : d * n + n], keep[d, 1:]
        if back:
            moved[n - 1] = 0
            _times(kept, own[1:], moved)
        else:
            moved[0] = 0
            _times(kept, own, moved[1:])
    for k in range(len(shares)):
        first = linked[k, 0] * n
        at, to = first + linked[k, 1], first + linked[k, 2]
        if back:
            out[at] += shares[k] * on[to]
        else:
            out[to] += shares[k] * on[at]


def _by_all_moves(on: Floats, moves: Floats, route: Route, back: bool, scratch: Floats, out: Floats) -> None:
    """The sum of mass (D N) moved by 0 to V places, each times its probability."""
    keep, _, _, _, plain = route
    n = keep.shape[1]
    _scaled(moves[0], on, out)
    if plain:
        for d in range(keep.shape[0]):
            own, moved = on[d * n : d * n + n], out[d * n : d * n + n]
            for v in range(1, min(len(moves), n)):
                if moves[v] == 0:  # most, of a steady speed
                    continue
                if back:
                    _added(moves[v], own[v:], moved)
                else:
                    _added(moves[v], own[: n - v], moved[v:])
        return
    one, other = scratch[0], scratch[1]
    one[:] = on
    for v in range(1, len(moves)):
        _shifted(one, route, back, other)
        one, other = other, one
        _added(moves[v], one, out)


def _changed(on: Floats, change: Floats, back: bool, out: Floats) -> None:
    """Mass (M D N), of which shares go on as other chains, or its transpose."""
    chains = len(change)
    size = len(on) // chains
    out[:] = 0
    for i in range(chains):
        for j in range(chains):
            if change[i, j] > 0:
                first, last = (j, i) if back else (i, j)
                _added(change[i, j], on[first * size :][:size], out[last * size :][:size])


def _ahead(
    belief: Floats,
    likelihood: Floats,
    still: NDArray[np.bool_],
    motion: Steps,
    route: Route,
    before: Floats,
    totals: Floats,
) -> None:
    """`Motion.ahead`, of drives (C,B,S); the belief (C,S) becomes the last one."""
    (moves, free, gone, each, change), (keep, _, _, turn, _) = motion, route
    drives, queries, states = likelihood.shape
    n, chains = states - 1, len(each)
    size = n // chains
    start, other, scratch = np.empty(n, np.float32), np.empty(n, np.float32), np.empty((2, size), np.float32)
    for c in range(drives):
        own = belief[c]
        for t in range(queries):
            out = before[c, t]
            if still[c, t]:
                out[:] = own
            else:
                anywhere, start[:] = _product(own, free[c]), own[:n]
                if chains > 1:
                    _changed(own[:n], change, False, start)
                for m in range(chains):
                    first, last = m * size, m * size + size
                    moved, jumped = out[first:last], anywhere * each[m]
                    if keep.shape[0] > 1:
                        _turned(start[first:last], turn, other[first:last])
                    else:
                        other[first:last] = start[first:last]
                    _by_all_moves(other[first:last], moves[c, m], route, False, scratch, moved)
                    for i in range(size):
                        moved[i] += jumped
                out[n] = _product(own, gone[c])
            _times(out, likelihood[c, t], own)
            total = np.float32(0)
            for i in range(states):
                total += own[i]
            totals[c, t] = total
            _scaled(1 / total, own, own)


def _behind(
    message: Floats,
    likelihood: Floats,
    still: NDArray[np.bool_],
    motion: Steps,
    route: Route,
    after: Floats,
    totals: Floats,
) -> None:
    """`Motion.behind`, of drives (C,B,S); the message (C,S) becomes that of the first query."""
    (moves, free, gone, each, change), (keep, _, _, turn, _) = motion, route
    drives, queries, states = likelihood.shape
    n, chains = states - 1, len(each)
    size = n // chains
    back, other, scratch = np.empty(n, np.float32), np.empty(n, np.float32), np.empty((2, size), np.float32)
    for c in range(drives):
        own = message[c]
        for t in range(queries - 1, -1, -1):
            after[c, t, :] = own
            _times(own, likelihood[c, t], own)
            total = np.float32(0)
            for i in range(states):
                total += own[i]
            _scaled(1 / total, own, own)
            if still[c, t]:
                continue
            off, anywhere = own[n], np.float32(0)
            for m in range(chains):
                first, last, total = m * size, m * size + size, np.float32(0)
                for i in range(first, last):
                    total += own[i]
                anywhere += each[m] * total
                _by_all_moves(own[first:last], moves[c, m], route, True, scratch, back[first:last])
                if keep.shape[0] > 1:
                    _turned(back[first:last], turn, other[first:last])
                else:
                    other[first:last] = back[first:last]
            own[:n] = other
            if chains > 1:
                _changed(other, change, True, own[:n])
            own[n] = 0
            _added(anywhere, free[c], own)
            _added(off, gone[c], own)


def _counted(
    before: Floats,
    after: Floats,
    lost: Floats,
    route: Route,
    out: Floats,
) -> None:
    """Of beliefs and messages (B,S), the weight of each move, (B,V+1), without its probability; a share of
    `lost` (V+1,S-1) leaves the map."""
    keep, _, _, turn, plain = route
    n, width = before.shape[1] - 1, keep.shape[1]
    start, scratch = np.empty(n, np.float32), np.empty((2, n), np.float32)
    for t in range(len(before)):
        if keep.shape[0] > 1:
            _turned(before[t, :n], turn, start)
        else:
            start[:] = before[t, :n]
        one, other, off = scratch[0], scratch[1], after[t, n]
        one[:] = after[t, :n]
        for v in range(out.shape[1]):
            if plain:  # only the last places are left
                last, total = max(0, width - v), np.float32(0)
                for d in range(keep.shape[0]):
                    own, later = start[d * width : d * width + width], one[d * width : d * width + width]
                    total += _product(own[:last], later[width - last :])
                    total += off * _product(own[last:], lost[v, d * width + last : d * width + width])
                out[t, v] = total
            else:
                out[t, v] = _product(start, one) + off * _product(start, lost[v])
                _shifted(one, route, True, other)
                one, other = other, one


def _told(
    seen: tuple[Floats, Floats, Floats],
    scores: tuple[Floats, Floats, Floats],
    table: tuple[float, float, int],
    counts: Doubles,
    sums: Doubles,
) -> None:
    """`Motion.told`, of before, likelihood and after (B,S), and z and normal scores (B,N) with shares (B,);
    a table has its lowest z, steps of one, and a radius."""
    (before, likelihood, after), (z, normal, shares), (lowest, steps, radius) = seen, scores, table
    n, states = z.shape[1], before.shape[1]
    every, plain = np.empty(states, np.float32), np.empty(states, np.float32)
    own, others, last = np.empty(n, np.float32), np.empty(n, np.float32), np.float32(len(counts) - 2)
    for t in range(len(before)):
        _times(before[t], after[t], plain)
        _times(plain, likelihood[t], every)
        for part, out in ((every, own), (plain, others)):
            total = np.float32(0)
            for i in range(states):
                total += part[i]
            _scaled(1 / total, part[:n], out)
            if states > n + 1:
                _added(1 / total, part[2 * n - 1 : n - 1 : -1], out)
        sums[0] += shares[t] * _product(others, normal[t])
        total = np.float32(0)
        for i in range(n):
            total += others[i]
        sums[1] += shares[t] * total
        near = 0.0
        for i in range(-radius, n):
            if i + radius < n:
                near += own[i + radius]
            if i > radius:
                near -= own[i - radius - 1]
            if i >= 0:
                at = min(max((z[t, i] - lowest) * steps, np.float32(0)), last)
                counts[int(at)] -= shares[t] * min(max(near, 0.0), 1.0)


def _looked_up(z: Floats, values: Floats, lowest: float, steps: float, out: Floats) -> None:
    """The values of a table, one at each of `steps` from `lowest` on, at z (n,), and in between."""
    last = np.float32(len(values) - 2)
    for i in range(len(z)):
        at = min(max((z[i] - lowest) * steps, np.float32(0)), last)  # NaN becomes 0
        low = int(at)
        out[i] = values[low] + (at - np.float32(low)) * (values[low + 1] - values[low])


FAST = {"reassoc", "nsz", "contract"}  # not "nnan" and "ninf", which lose NaN and infinity
CALLS = _turned, _added, _scaled, _product, _times, _shifted, _by_all_moves, _changed
compiled_by = partial(compiled, what="drives by torch", calls=CALLS, fastmath=FAST)


@cache
def ahead() -> Kernel | None:
    """`_ahead` compiled."""
    return compiled_by(_ahead, SWEPT)


@cache
def behind() -> Kernel | None:
    """`_behind` compiled."""
    return compiled_by(_behind, SWEPT)


@cache
def looked_up() -> Kernel | None:
    """`_looked_up` compiled."""
    return compiled_by(_looked_up, "void(float32[::1], float32[::1], float32, float32, float32[::1])")


@cache
def counted() -> Kernel | None:
    """`_counted` compiled."""
    given = ", ".join(["float32[:,::1]"] * 3)
    return compiled_by(_counted, f"void({given}, {ROUTE}, float32[:,::1])")


@cache
def told() -> Kernel | None:
    """`_told` compiled."""
    rows, row = "float32[:,::1]", "float32[::1]"
    given = (
        f"Tuple(({rows}, {rows}, {rows})), Tuple(({rows}, {rows}, {row})), Tuple((float32, float32, int64))"
    )
    return compiled_by(_told, f"void({given}, float64[::1], float64[::1])")
