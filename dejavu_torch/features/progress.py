"""Progress of long work: a bar on a terminal, elsewhere a line now and then."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

FIRST, EVERY = 30.0, 60.0  # seconds before the first line, and from one to the next


@contextmanager
def shown(text: str | None, total: int | None, unit: str = "frame") -> Iterator[Callable[[int], object]]:
    """A function to call with how much more of some work is done, which shows it on stderr.

    Args:
        text: what the work is; None shows nothing. total: how much of it there is, if known, in `unit`.
    """
    if text is not None and sys.stderr.isatty():
        with tqdm(total=total, desc=text, unit=unit, leave=False) as bar:
            yield bar.update
        return
    began, done = time.monotonic(), 0
    due = began + FIRST

    def update(more: int) -> None:
        nonlocal done, due
        done, now = done + more, time.monotonic()
        if text is None or now < due or not done:
            return
        due = now + EVERY
        of = f" of {total}" if total else ""
        left = f", {max(0, total - done) * (now - began) / done:.0f} s left" if total else ""
        tqdm.write(f"dejavu: {text}: {done}{of} {unit}s{left}", file=sys.stderr)

    yield update
