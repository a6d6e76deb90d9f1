"""What a mutant is."""

from __future__ import annotations

from typing import NamedTuple


class Mutant(NamedTuple):
    """A sentence of behaviour, and how to break it.

    file: of the package. old: a text that occurs once in it; new: what is put in its place. tests: those that
    must notice, as pytest takes them, `tests/FILE::NAME` or `tests/FILE::-k EXPRESSION`.
    """

    sentence: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
