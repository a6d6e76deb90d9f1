"""What made ready descriptors, as a file beside them says."""

from __future__ import annotations

import json
from pathlib import Path

from dejavu_torch.data.files import read_text
from dejavu_torch.text import one_line, printable
from dejavu_torch.types import InputError, Traverse, expect

EXPECTED = 'JSON such as {"maker": "network, version, weights"}'


def read_maker(path: Path) -> str:
    """The maker in `X.json` next to `X.npy`; "" if there is no such file, or none in it."""
    beside = path.with_suffix(".json")
    if not beside.exists():
        return ""
    try:
        facts = json.loads(read_text(beside, EXPECTED))
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{printable(beside)} is no JSON ({one_line(error)}); expected {EXPECTED}"
        ) from error
    return as_maker(facts.get("maker", "") if isinstance(facts, dict) else "", printable(beside))


def as_maker(maker: object, name: str) -> str:
    """A maker that a file of this name tells; refuses what is no text."""
    text = maker.decode(errors="replace") if isinstance(maker, bytes) else maker
    expect(isinstance(text, str), EXPECTED, f"{name}: maker is {maker!r:.60}")
    return str(text)


def check_maker(maker: str, owner: str, queries: Traverse) -> None:
    """Refuse queries that something else made than a map or a reference; "" is unknown."""
    seen = f"{queries.name} has descriptors of {queries.maker!r}, {owner} has those of {maker!r}"
    expect(not maker or not queries.maker or maker == queries.maker, "the same", seen)
