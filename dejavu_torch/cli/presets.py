"""Presets: the configs that come with the package, by name from any folder."""

from __future__ import annotations

import os
from pathlib import Path

import yaml

from dejavu_torch.data.files import check_regular, read_text, reading
from dejavu_torch.types import InputError

PACKAGE = Path(__file__).parents[1]
# installed, the folder lies inside the package; in a checkout beside it
FOLDER = PACKAGE / "configs" if (PACKAGE / "configs").is_dir() else PACKAGE.parent / "configs"

EXPECTED = "a YAML file of options"
LARGEST, DEEPEST, MOST = 2**18, 50, 10_000  # bytes, levels and values of a config, aliases written out
LONGEST = 4096  # characters of a word or value, as of a path


def preset_names() -> list[str]:
    """The names that `find_config` knows."""
    found = (path.relative_to(FOLDER).with_suffix("") for path in FOLDER.rglob("*.yaml"))
    return sorted((name.as_posix() for name in found), key=lambda name: ("/" in name, name))


def find_config(name: str) -> Path:
    """The config file of that path, or else the preset of that name.

    Raises:
        InputError: neither is there.

    Example:
        >>> find_config("paper").name
        'paper.yaml'
    """
    if os.path.exists(name) and not os.path.isdir(name):  # False also of what is no path at all
        return Path(name)
    if name in preset_names():
        return FOLDER / f"{name}.yaml"
    known = ", ".join(preset_names())
    raise InputError(f"--config {name} is not there; expected a YAML file, or one of {known}")


def check_config(path: Path) -> None:
    """Refuse what is no YAML file of options, ahead of what makes objects of it.

    Raises:
        InputError: no regular file, no text, no YAML, not a mapping or an empty one; see `check_yaml`.
    """
    if check_regular(path, EXPECTED) > LARGEST:
        raise InputError(f"{path} is larger than {LARGEST} bytes; expected {EXPECTED}")
    text = read_text(path, EXPECTED)
    with reading(path, "is no YAML", EXPECTED):
        check_yaml(text)
        if not isinstance(yaml.safe_load(text), dict):
            raise InputError(f"{path} holds no options; expected {EXPECTED}, as KEY: VALUE")


def check_yaml(text: str) -> None:
    """Refuse a text of more, deeper or longer values than any config has, or with a key twice in one mapping.

    It goes through the events of the parser, one by one: no value is made, and nothing calls itself. Loaders
    do: aliases that name each other keep them busy for hours, and many levels end the process.

    Raises:
        ValueError: naming the line. yaml.YAMLError: no YAML.
    """
    sizes: dict[str, int] = {}  # values below each anchor
    open_: list[_Collection] = [_Collection(None, False)]
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        here, line = open_[-1], f"line {event.start_mark.line + 1}"
        if isinstance(event, yaml.ScalarEvent):
            if len(event.value) > LONGEST:
                raise ValueError(f"{line}: a value of {len(event.value)} characters")
            here.add(1, event.value, line)
            sizes[event.anchor or ""] = 1
        elif isinstance(event, yaml.AliasEvent):
            here.add(sizes.get(event.anchor, MOST), None, line)  # its own anchor is not yet there
        elif isinstance(event, yaml.CollectionStartEvent):
            open_.append(_Collection(event.anchor, isinstance(event, yaml.MappingStartEvent)))
        elif isinstance(event, yaml.CollectionEndEvent):
            open_.pop()
            sizes[here.anchor or ""] = here.size
            open_[-1].add(here.size, None, line)
        if open_[-1].size >= MOST or len(open_) > DEEPEST:
            raise ValueError(f"{line}: over {MOST} values, or {DEEPEST} levels")


class _Collection:
    """A list or mapping that a YAML text has begun."""

    def __init__(self, anchor: str | None, mapping: bool) -> None:
        self.anchor, self.mapping = anchor, mapping
        self.size = 1
        self.keys: set[str] = set()
        self.parts = 0

    def add(self, size: int, text: str | None, line: str) -> None:
        self.size += size
        if self.mapping and self.parts % 2 == 0 and text is not None:
            if text in self.keys:
                raise ValueError(f"{line}: {text} appears twice")
            self.keys.add(text)
        self.parts += 1


def check_word(word: str) -> None:
    """Refuse a word that is YAML, as the value of any option may be, but more than an option can mean."""
    if not word or (word.startswith("--") and word.endswith("=")):
        raise InputError(f"{word or 'a word'} is empty; expected a name or a value")
    if len(word) > LONGEST:
        raise InputError(f"{word[:40]} ...: a word of {len(word)} characters; expected at most {LONGEST}")
    if "&" in word and "*" in word:  # aliases
        try:
            check_yaml(word.partition("=")[2] if word.startswith("--") else word)
        except yaml.YAMLError:  # an address, or a name
            pass
        except ValueError as error:
            raise InputError(f"{word}: {error}; expected a value as an option has") from error
