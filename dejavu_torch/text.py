"""Text in messages: of unknown origin, such as file names, and of settings; progress bars."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from inspect import signature
from typing import TYPE_CHECKING, TypeVar
from unicodedata import category

if TYPE_CHECKING:
    from torch import nn

Step = TypeVar("Step")


def printable(text: object) -> str:
    """The text as one line: characters neither printable nor a space, such as line breaks, are escaped."""
    return "".join(c if c.isprintable() or category(c) == "Zs" else ascii(c)[1:-1] for c in str(text))


def one_line(text: object) -> str:
    """The text without line breaks; every run of blanks becomes one space."""
    return " ".join(str(text).split())


def settings_of(module: nn.Module, *hidden: str) -> str:
    """The constructor's arguments, also of base classes, as `extra_repr` shows them."""
    names = dict.fromkeys(name for cls in type(module).__mro__ for name in signature(cls).parameters)
    shown = (name for name in names if name not in hidden and hasattr(module, name))  # some are not kept
    return ", ".join(f"{name}={getattr(module, name)!r}" for name in shown)


def bar(steps: Sequence[Step], text: str | None) -> Iterable[Step]:
    """The steps of a long task, with a progress bar on stderr if it is a terminal; None shows no bar."""
    from tqdm import tqdm

    shown: Iterable[Step] = tqdm(steps, text, disable=None if text else True, leave=False)
    return shown
