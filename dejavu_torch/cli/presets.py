"""Presets: the configs of the package, by name."""

from __future__ import annotations

import os
from pathlib import Path

import yaml

from dejavu_torch.data.files import check_regular, read_text, reading
from dejavu_torch.types import InputError

PACKAGE = Path(__file__).parents[1]
# inside the installed package; in a clone next to it
FOLDER = PACKAGE / "configs" if (PACKAGE / "configs").is_dir() else PACKAGE.parent / "configs"

EXPECTED = "a YAML file of options"
LARGEST, DEEPEST, MOST = 2**18, 50, 10_000  # bytes, levels and values of a config, with aliases expanded
LONGEST = 4096  # characters of a word or value, as of a path


def preset_names() -> list[str]:
    """The names that `find_config` knows."""
    found = (path.relative_to(FOLDER).with_suffix("") for path in FOLDER.rglob("*.yaml"))
    return sorted((name.as_posix() for name in found), key=lambda name: ("/" in name, name))


def find_config(name: str) -> Path:
    """The config file with that path, else the preset with that name.

    Raises:
        InputError: there is neither.

    Example:
        >>> find_config("paper").name
        'paper.yaml'
    """
    if os.path.exists(name) and not os.path.isdir(name):  # False also for what is no path
        return Path(name)
    if name in preset_names():
        return FOLDER / f"{name}.yaml"
    known = ", ".join(preset_names())
    raise InputError(f"--config {name} is not there; expected a YAML file, or one of {known}")


def check_config(path: Path) -> None:
    """Refuse what is not a YAML file of options, before objects are made from it.

    Raises:
        InputError: not a regular file, text, YAML, or a mapping with keys; or too large, see `count_values`.
    """
    if check_regular(path, EXPECTED) > LARGEST:
        raise InputError(f"{path} is larger than {LARGEST} bytes; expected {EXPECTED}")
    text = read_text(path, EXPECTED)
    with reading(path, "is no YAML", EXPECTED):
        node = yaml.compose(text, yaml.SafeLoader)
        if not isinstance(node, yaml.MappingNode):
            raise InputError(f"{path} holds no options; expected {EXPECTED}, as KEY: VALUE")
        count_values(node)
        yaml.safe_load(text)


def count_values(node: yaml.Node, level: int = 1, count: int = 0) -> int:
    """The number of values in a YAML node, aliases expanded, plus `count`.

    Raises:
        ValueError: more, deeper or longer values than any config has, or a duplicate key. Loaders accept
            these: nested aliases keep them busy for hours, many levels crash the process.
    """
    line = f"line {node.start_mark.line + 1}"
    if level > DEEPEST:
        raise ValueError(f"{line}: over {DEEPEST} levels")
    scalar = isinstance(node, yaml.ScalarNode)
    if count >= MOST or (not scalar and count + len(node.value) > MOST):
        raise ValueError(f"{line}: over {MOST} values")
    if scalar:
        if len(node.value) > LONGEST:
            raise ValueError(f"{line}: a value of {len(node.value)} characters")
        return count + 1
    parts = node.value
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if key.value in seen:
                raise ValueError(f"line {key.start_mark.line + 1}: {key.value} appears twice")
            seen.add(key.value)
        parts = [part for pair in node.value for part in pair]
    for part in parts:
        count = count_values(part, level + 1, count)
    return count + 1


def check_word(word: str) -> None:
    """Refuse a word that no option can mean; the value of any option may be YAML."""
    if not word or (word.startswith("--") and word.endswith("=")):
        raise InputError(f"{word or 'a word'} is empty; expected a name or a value")
    if len(word) > LONGEST:
        raise InputError(f"{word[:40]} ...: a word of {len(word)} characters; expected at most {LONGEST}")
    if "&" in word and "*" in word:  # aliases
        try:
            node = yaml.compose(word.partition("=")[2] if word.startswith("--") else word, yaml.SafeLoader)
            if node is not None:  # not a comment
                count_values(node)
        except yaml.YAMLError:  # an address or a name
            pass
        except ValueError as error:
            raise InputError(f"{word}: {error}; expected a value as an option has") from error
