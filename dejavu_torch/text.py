"""Text as part of messages: from elsewhere, such as the names of files, and of settings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from inspect import signature
from typing import TYPE_CHECKING, TypeVar
from unicodedata import category

if TYPE_CHECKING:
    from torch import nn

Step = TypeVar("Step")


def printable(text: object) -> str:
    """A text of one line: what is neither printable nor a space, as a line break, is escaped."""
    return "".join(
        c if c.isprintable() or category(c) == "Zs" else c.encode("unicode_escape").decode()
        for c in str(text)
    )


def one_line(text: object) -> str:
    """A text without line breaks, each run of blanks one space."""
    return " ".join(str(text).split())


def settings_of(module: nn.Module, *hidden: str) -> str:
    """The constructor's arguments, as `extra_repr` shows them."""
    names = (name for name in signature(type(module)).parameters if name not in hidden)
    return ", ".join(f"{name}={getattr(module, name)!r}" for name in names)


def bar(steps: Sequence[Step], text: str | None) -> Iterable[Step]:
    """The steps of a long work, with a progress bar on stderr if that is a terminal; no text is no bar."""
    from tqdm import tqdm

    shown: Iterable[Step] = tqdm(steps, text, disable=None if text else True, leave=False)
    return shown
