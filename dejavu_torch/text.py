"""Text in messages: of unknown origin, such as file names, and of settings; progress."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from inspect import signature
from typing import TYPE_CHECKING, TypeVar
from unicodedata import category

if TYPE_CHECKING:
    from torch import nn

Step = TypeVar("Step")
TOLD = 20  # times as much as is done, in all, for a line to tell the time that is left
FIRST_LINE, LINE_EVERY = 30.0, 60.0  # seconds until the first line of progress, and between lines
LONGEST_MESSAGE = 2000  # characters


def printable(text: object) -> str:
    """The text as one line: characters neither printable nor a space, such as line breaks, are escaped."""
    return "".join(c if c.isprintable() or category(c) == "Zs" else ascii(c)[1:-1] for c in str(text))


class InputError(ValueError):
    """Bad input. The message is one printable line of limited length: what was seen and what was expected."""

    def __init__(self, message: object) -> None:
        text = printable(message)
        if len(text) > LONGEST_MESSAGE:
            text = f"{text[: LONGEST_MESSAGE // 2]} ... {text[-LONGEST_MESSAGE // 2 :]}"
        super().__init__(text)


def expect(fits: object, to_be: object, seen: object = "", /, **given: object) -> None:
    """Refuse bad input unless it `fits`: "`seen`; expected `to_be`", where `given` reads "name is value".

    Example:
        >>> expect(2 > 1, "at least 1", k=2)
    """
    if not fits:
        pairs = ((name, f"a {x.__name__}" if isinstance(x, type) else repr(x)) for name, x in given.items())
        raise InputError(f"{seen or ' and '.join(map(' is '.join, pairs))}; expected {to_be}")


def refuse_with(option: str, **others: object) -> None:
    """Refuse an option if one of the others, which exclude it, is given."""
    for name, value in others.items():
        other = f"--{name}" if value is True else f"--{name} {value}"
        expect(not value, "one of them", f"{option} and {other}")


def plain_number(number: object) -> int | float:
    """A number as in JSON, whole if it is."""
    value = float(number)  # type: ignore[arg-type]
    return int(value) if value.is_integer() else value


def rounded(value: float) -> str:
    """A length in words: three digits, or whole.

    Example:
        >>> rounded(0.12345), rounded(123456.7)
        ('0.123', '123457')
    """
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def one_line(text: object) -> str:
    """The text without line breaks; every run of blanks becomes one space."""
    return " ".join(str(text).split())


def settings_of(module: nn.Module, *hidden: str) -> str:
    """The constructor's arguments, also of base classes, as `extra_repr` shows them."""
    names = dict.fromkeys(name for cls in type(module).__mro__ for name in signature(cls).parameters)
    shown = (name for name in names if name not in hidden and hasattr(module, name))  # some are not kept
    return ", ".join(f"{name}={getattr(module, name)!r}" for name in shown)


@contextmanager
def progress_of(
    verb: str, total: int, progress: bool, unit: str = "frame"
) -> Iterator[Callable[[int], object]]:
    """A function to call with the number of frames newly done: it shows a bar on stderr, or lines if that is
    no terminal; nothing without `progress`."""
    from tqdm import tqdm

    if progress and sys.stderr.isatty():
        with tqdm(total=total, desc=verb, unit=unit, leave=False) as bar:
            yield bar.update
        return
    units = unit[:-1] + "ies" if unit.endswith("y") else unit + "s"
    began, done = time.monotonic(), 0
    due = began + FIRST_LINE

    def update(more: int) -> None:
        nonlocal done, due
        done, now = done + more, time.monotonic()
        if not progress or now < due or not done:
            return
        due = now + LINE_EVERY
        # the first of many take longer: something is compiled, or the work before them is counted
        left = f", {max(0, total - done) * (now - began) / done:.0f} s left" if TOLD * done >= total else ""
        tqdm.write(f"dejavu: {verb}: {done} of {total} {units}{left}", file=sys.stderr)

    yield update


def with_progress(steps: Sequence[Step], verb: str, progress: bool) -> Iterator[Step]:
    """The steps of a long task; see `progress_of`."""
    with progress_of(verb, len(steps), progress, "step") as update:
        for step in steps:
            yield step
            update(1)
