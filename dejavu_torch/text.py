"""Text from elsewhere, such as the names of files, as part of messages."""

from __future__ import annotations

from unicodedata import category


def printable(text: object) -> str:
    """A text of one line: what is neither printable nor a space, as a line break, is escaped."""
    return "".join(
        c if c.isprintable() or category(c) == "Zs" else c.encode("unicode_escape").decode()
        for c in str(text)
    )


def one_line(text: object) -> str:
    """A text without line breaks, each run of blanks one space."""
    return " ".join(str(text).split())
