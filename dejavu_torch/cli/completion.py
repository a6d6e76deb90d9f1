"""The script by which bash or zsh completes commands, options, presets and files."""

from __future__ import annotations

import argparse
import importlib
import inspect
import os
from collections.abc import Iterator
from typing import Any, Literal, get_args

from jsonargparse import ArgumentParser
from torch import nn

from dejavu_torch.cli import commands
from dejavu_torch.cli.names import COMMANDS
from dejavu_torch.cli.parser import Preset, command_parser
from dejavu_torch.cli.presets import preset_names
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.hog import HOG
from dejavu_torch.model_file import REGISTRY
from dejavu_torch.types import InputError

DEFAULTS = {"--features": HOG, "--model.backbone": SmallCNN}  # whose options are typed without a class
FILES = {"bash": "_shtab_compgen_files", "zsh": "_files"}
PREAMBLE = {  # what completes --config
    "bash": '_dejavu_preset_files() {{ compgen -W "{0}" -- "$1"; compgen -f -- "$1"; }}',
    "zsh": '_dejavu_preset_files() {{ _alternative "presets:preset:({0})" "files:file:_files" }}',
}


def run_completion(shell: Literal["bash", "zsh"] = "bash") -> None:
    """Print a script by which a shell completes commands, options, presets and files.

    To use it in this shell only, in bash: eval "$(dejavu completion bash)". To keep it, write it to
    ~/.local/share/bash-completion/completions/dejavu, or for zsh to a file _dejavu in a folder of $fpath.

    Args:
        shell: bash or zsh
    """
    print(completion_script(shell))


def completion_script(shell: str) -> str:
    """The script for `bash` or `zsh`.

    Raises:
        InputError: shtab is not installed.
    """
    try:
        shtab = importlib.import_module("shtab")
    except ImportError as error:
        raise InputError("shtab is not there; expected it: pip install 'dejavu_torch[completion]'") from error
    from dejavu_torch.cli.train import TrainCLI

    # a plain tree: of jsonargparse's own, shtab would list the options of all classes that torch has
    root = argparse.ArgumentParser("dejavu")
    root.add_argument("--version", action="store_true", help="print the version")
    added = root.add_subparsers()
    for name, text in COMMANDS.items():
        parser = added.add_parser(name, help=text)
        if name != "train":
            function = run_completion if name == "completion" else getattr(commands, f"run_{name}")
            _copy(command_parser(name, function), parser)
            continue
        stages = parser.add_subparsers()
        for stage in TrainCLI.subcommands():
            _copy(TrainCLI.stage_parser(), stages.add_parser(stage, help=stage))
    return str(shtab.complete(root, shell, preamble=PREAMBLE[shell].format(" ".join(preset_names()))))


def _copy(parser: ArgumentParser, plain: argparse.ArgumentParser) -> None:
    """The arguments of a command, and the options of the parts that it is made of, as shtab reads them."""
    for action in parser._actions:
        names = [name for name in action.option_strings if not name.endswith("+")]  # which append to lists
        if names[:1] == ["-h"]:  # argparse's own
            continue
        text, kind = str(action.help or "").partition(";")[0], getattr(action, "_typehint", None)
        given = _add(plain, names or [action.dest], kind, text.replace("%", "%%"))
        given.nargs = action.nargs
        if isinstance(action, Preset):
            given.complete = dict.fromkeys(FILES, "_dejavu_preset_files")  # type: ignore[attr-defined]
        if names and not names[-1].endswith(".help"):
            for option, part in dict(_part_options(names[-1], kind)).items():
                if option not in parser._option_string_actions:
                    _add(plain, [option], part)


def _add(plain: argparse.ArgumentParser, names: list[str], kind: Any, text: str = "") -> argparse.Action:
    """An argument, completed by the words of its type, or by files if that is text or a path."""
    given, leaves = plain.add_argument(*names, help=text), [*_leaves(kind)]
    if any(isinstance(leaf, type) and issubclass(leaf, str | os.PathLike) for leaf in leaves):
        given.complete = FILES  # type: ignore[attr-defined]
    else:
        given.choices = [str(leaf) for leaf in leaves if isinstance(leaf, str | int)]
    return given


def _leaves(kind: Any) -> Iterator[Any]:
    """The types that an annotation is made of, and the values of its literals."""
    parts = get_args(kind)
    for part in parts:
        yield from _leaves(part)
    if not parts:
        yield kind


def _part_options(name: str, kind: Any) -> Iterator[tuple[str, Any]]:
    """The options of a part of ours, such as --mapper.hold, with their types, of every class that fits."""
    for base in (leaf for leaf in _leaves(kind) if isinstance(leaf, type) and issubclass(leaf, nn.Module)):
        fitting = [cls for cls in REGISTRY.values() if base is not nn.Module and issubclass(cls, base)]
        for cls in fitting or ([DEFAULTS[name]] if name in DEFAULTS else []):
            for one in inspect.signature(cls, eval_str=True).parameters.values():
                yield f"{name}.{one.name}", one.annotation
                yield from _part_options(f"{name}.{one.name}", one.annotation)
