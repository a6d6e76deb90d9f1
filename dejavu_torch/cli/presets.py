"""Presets: the configs that come with the package, by name from any folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dejavu_torch.types import InputError

PACKAGE = Path(__file__).parents[1]
# installed, the folder lies inside the package; in a checkout beside it
FOLDER = PACKAGE / "configs" if (PACKAGE / "configs").is_dir() else PACKAGE.parent / "configs"


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
    if Path(name).is_file():
        return Path(name)
    if name in preset_names():
        return FOLDER / f"{name}.yaml"
    known = ", ".join(preset_names())
    raise InputError(f"--config {name} is not there; expected a YAML file, or one of {known}")


def with_configs(words: Sequence[str]) -> list[str]:
    """A command line with the path of each config in place of a preset's name.

    Raises:
        InputError: see `find_config`.
    """
    found = list(words)
    for i, word in enumerate(words):
        if word.startswith("--config="):
            found[i] = f"--config={find_config(word.removeprefix('--config='))}"
        elif i and words[i - 1] in ("--config", "-c"):
            found[i] = str(find_config(word))
    return found
