"""Presets: the configs of the package, by name."""

from __future__ import annotations

import os
from pathlib import Path

import yaml

from dejavu_torch.data.files import check_regular, read_text, reading
from dejavu_torch.types import Facts, InputError, expect

PACKAGE = Path(__file__).parents[1]
# inside the installed package; in a clone next to it
FOLDER = PACKAGE / "configs" if (PACKAGE / "configs").is_dir() else PACKAGE.parent / "configs"

EXPECTED = "a YAML file of options"
LARGEST = 2**18  # bytes of a config


class Loader(yaml.SafeLoader):  # type: ignore[misc]
    """A loader that refuses a key that appears twice, of which others take the last value."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> object:
        """The mapping of a node."""
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise ValueError(f"line {key.start_mark.line + 1}: {key.value} appears twice")
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)


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


def read_config(path: Path) -> Facts:
    """The options in a YAML file.

    Raises:
        InputError: not a regular file, text, YAML, or a mapping with keys; or too large.
    """
    expect(check_regular(path, EXPECTED) <= LARGEST, EXPECTED, f"{path} is larger than {LARGEST} bytes")
    text = read_text(path, EXPECTED)
    with reading(path, "is no YAML", EXPECTED):
        given: Facts = yaml.load(text, Loader)
    expect(isinstance(given, dict), f"{EXPECTED}, as KEY: VALUE", f"{path} holds no options")
    return given
