"""What made ready descriptors, as a file beside them says."""

from __future__ import annotations

import json
from pathlib import Path

from dejavu_torch.data.files import read_text
from dejavu_torch.types import InputError, Traverse, expect

EXPECTED = 'JSON such as {"maker": "network, version, weights"}'


def read_maker(path: Path) -> str:
    """The maker in `X.json` next to `X.npy`; "" if there is no such file, or none in it."""
    beside = path.with_suffix(".json")
    text = read_text(beside, EXPECTED) if beside.exists() else "{}"
    try:
        facts = json.loads(text)
    except ValueError as error:
        raise InputError(f"{beside} is no JSON ({error}); expected {EXPECTED}") from error
    return as_maker(facts.get("maker", "") if isinstance(facts, dict) else "", beside)


def as_maker(maker: object, file: object) -> str:
    """A maker that a file tells; refuses what is no text."""
    text = maker.decode(errors="replace") if isinstance(maker, bytes) else maker
    if not isinstance(text, str):
        raise InputError(f"{file}: maker is {maker!r:.60}; expected {EXPECTED}")
    return text


def check_maker(maker: str, owner: str, queries: Traverse) -> None:
    """Refuse queries that something else made than a map or a reference; "" is unknown."""
    seen = f"{queries.name} has descriptors of {queries.maker!r}, {owner} has those of {maker!r}"
    expect("" in (maker, queries.maker) or maker == queries.maker, "the same", seen)
