"""The names of a traverse's frames in a few bytes, for the header of a map."""

from __future__ import annotations

import base64
import json
import math
import re
import zlib
from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from dejavu_torch.types import InputError, Traverse

LONGEST = 4096  # characters of a name, as of a path
WIDEST = 255  # digits of a number in a name
TOO_LARGE = 10**WIDEST
CLOCK = re.compile(r"(-?)([0-9]+):([0-5][0-9]):([0-5][0-9])\.([0-9]{3})")


class FrameNames:
    """The names of all frames, exactly, in as little as they need.

    File names with a counter, and times at an even rate, take a few dozen bytes whatever their number; any
    other names are kept as compressed text.

    Args:
        frames: F, how many frames. name: the name of a frame from its number, 0..F-1.

    Example:
        >>> files = [f"left_{i:06}.png" for i in range(0, 10_000, 2)]
        >>> names = FrameNames(len(files), files.__getitem__)
        >>> names[7], len(names), names.encode()
        ('left_000014.png', 5000, {'runs': [[5000, 'left_', '.png', 6, 0, 2]]})
    """

    def __init__(self, frames: int, name: Callable[[int], str]) -> None:
        self._frames, self._name = frames, name

    @classmethod
    def of(cls, traverse: Traverse, frames: int | None = None) -> FrameNames | None:
        """The names of a traverse's frames; None where it has none.

        Args:
            frames: how many frames there are, needed where the traverse does not know its length.
        """
        count = traverse.length if frames is None else frames
        names = [traverse.frame_name(i) for i in range(count or 0)]
        return cls(len(names), names.__getitem__) if any(names) else None

    def __len__(self) -> int:
        return self._frames

    def __getitem__(self, i: int) -> str:
        if not 0 <= i < self._frames:
            raise IndexError(f"there is no name of frame {i}; expected 0 to {self._frames - 1}")
        return self._name(i)

    def encode(self) -> dict[str, Any]:
        """The names as values that JSON can hold: of the codes that give them back exactly, the shortest.

        Raises:
            InputError: a name of over 4096 characters.
        """
        names = [self[i] for i in range(self._frames)]
        longest = max(map(len, names), default=0)
        if longest > LONGEST:
            raise InputError(f"a frame's name has {longest} characters; expected at most {LONGEST}")
        text = base64.b64encode(zlib.compress(json.dumps(names).encode(), 9)).decode()
        times, runs = _fit_times(names), _find_runs(names)
        codes: list[dict[str, Any]] = [{"text": text}, {"runs": [list(run) for run in runs]}]
        codes += [{"times": times}] if times else []
        return min(codes, key=lambda code: len(json.dumps(code)))

    @classmethod
    def decode(cls, code: Any, frames: int) -> FrameNames:
        """The names that `encode` gave.

        Args:
            frames: how many names there must be.

        Raises:
            InputError: no such code, or one of another number of names.
        """
        try:
            ((kind, value),) = code.items()
            return cls(frames, DECODERS[kind](value, frames))
        except (AttributeError, KeyError, TypeError, ValueError, RecursionError, zlib.error) as error:
            why = " ".join(str(error).split())
            raise InputError(f"the names of {frames} frames cannot be read: {why}") from error


# file names with a counter ------------------------------------------------------------------------------


class Run(NamedTuple):
    """Names of consecutive frames: prefix, a number that changes by `stride` from `first` on, suffix.

    frames: how many. width: digits of the number, filled up with zeros; 0 where there is no number.
    """

    frames: int
    prefix: str
    suffix: str
    width: int
    first: int
    stride: int

    def number(self, i: int) -> int:
        return self.first + i * self.stride

    def name(self, i: int) -> str:
        number = str(self.number(i)).zfill(self.width) if self.width else ""
        return f"{self.prefix}{number}{self.suffix}"

    def check(self) -> None:
        whole = all(type(n) is int for n in (self.frames, self.width, self.first, self.stride))
        if not whole or self.frames < 1 or not 0 <= self.width <= WIDEST:
            raise ValueError("a run of names is not of whole numbers")
        ends = self.number(0), self.number(self.frames - 1)
        if not 0 <= min(ends) <= max(ends) < TOO_LARGE or len(self.prefix + self.suffix) > LONGEST:
            raise ValueError("a run of names is out of range")


def _find_runs(names: Sequence[str]) -> list[Run]:
    runs: list[Run] = []
    start = 0
    while start < len(names):
        run = _begin_run(names[start], names[min(start + 1, len(names) - 1)])
        frames = 1
        while start + frames < len(names) and names[start + frames] == run.name(frames):
            if not 0 <= run.number(frames) < TOO_LARGE:
                break
            frames += 1
        runs.append(run._replace(frames=frames) if frames > 1 else _single(names[start]))
        start += frames
    return runs


def _begin_run(name: str, following: str) -> Run:
    """The run that goes on from one name to the next, where these differ in one number."""
    one, other = (re.split("([0-9]+)", text) for text in (name, following))
    changed = [j for j, (a, b) in enumerate(zip(one, other, strict=False)) if a != b]
    if len(one) != len(other) or len(changed) != 1 or not changed[0] % 2:
        return _single(name)
    j = changed[0]
    digits = one[j]
    if max(len(digits), len(other[j])) > WIDEST:
        return _single(name)
    width = len(digits) if digits[0] == "0" else 1
    first = int(digits)
    return Run(1, "".join(one[:j]), "".join(one[j + 1 :]), width, first, int(other[j]) - first)


def _single(name: str) -> Run:
    return Run(1, name, "", 0, 0, 0)


def _decode_runs(value: Any, frames: int) -> Callable[[int], str]:
    runs = [Run(*row) for row in value]
    for run in runs:
        run.check()
    ends = list(accumulate(run.frames for run in runs))
    if sum(run.frames for run in runs) != frames:
        raise ValueError("the runs are of another number of names")

    def name(i: int) -> str:
        at = bisect_right(ends, i)
        return runs[at].name(i - ends[at] + runs[at].frames)

    return name


# times at an even rate ----------------------------------------------------------------------------------


def clock_time(milliseconds: int) -> str:
    """Hours, minutes, seconds and milliseconds.

    Example:
        >>> clock_time(3_723_480)
        '1:02:03.480'
    """
    seconds, thousandths = divmod(abs(milliseconds), 1000)
    clock = f"{seconds // 3600}:{seconds // 60 % 60:02}:{seconds % 60:02}.{thousandths:03}"
    return f"-{clock}" if milliseconds < 0 else clock


def _fit_times(names: Sequence[str]) -> list[float] | None:
    """Milliseconds of the first frame and from frame to frame, where rounding them gives all names."""
    matches = [CLOCK.fullmatch(name[:WIDEST]) for name in names]
    if len(names) < 2 or None in matches:
        return None
    times = np.array([_milliseconds(*match.groups()) for match in matches if match], dtype=np.float64)
    frames = np.arange(len(times))
    low, high = float(np.diff(times).min()), float(np.diff(times).max())

    def spread(step: float) -> float:
        return float(np.ptp(times - step * frames))

    while (third := (high - low) / 3) > 1e-15 * max(abs(low), abs(high), 1):  # it is convex
        if spread(low + third) < spread(high - third):
            high -= third
        else:
            low += third
    step = (low + high) / 2
    rest = times - step * frames
    fitted = [float(rest.min() + rest.max()) / 2, step]
    name = _decode_times(fitted, len(names)) if np.abs(times).max() < 2**52 else str
    return fitted if all(name(i) == names[i] for i in range(len(names))) else None


def _milliseconds(sign: str, hours: str, minutes: str, seconds: str, thousandths: str) -> float:
    value = ((float(hours) * 60 + int(minutes)) * 60 + int(seconds)) * 1000 + int(thousandths)
    return -value if sign else value


def _decode_times(value: Any, frames: int) -> Callable[[int], str]:
    first, step = map(float, value)
    if not abs(first) + abs(step) * frames < 2**53:
        raise ValueError(f"times {first} + {step} * frame")
    return lambda i: clock_time(math.floor(first + step * i + 0.5))


# any other names ----------------------------------------------------------------------------------------


def _decode_text(value: Any, frames: int) -> Callable[[int], str]:
    unpack = zlib.decompressobj()
    most = frames * (12 * LONGEST + 4) + 2  # each character may be escaped
    text = unpack.decompress(base64.b64decode(value, validate=True), most)
    names = json.loads(text)
    if not isinstance(names, list) or len(names) != frames or not all(type(name) is str for name in names):
        raise ValueError("they are no list of as many texts")
    return names.__getitem__


DECODERS: dict[str, Callable[[Any, int], Callable[[int], str]]] = {
    "runs": _decode_runs,
    "times": _decode_times,
    "text": _decode_text,
}
