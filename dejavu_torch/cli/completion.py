"""The script with which bash or zsh completes commands, options, presets and files."""

from __future__ import annotations

import argparse
import importlib
import os
from collections.abc import Iterator
from typing import Any, Literal, get_args

from jsonargparse import ArgumentParser
from torch import nn

from dejavu_torch.cli.names import COMMANDS, function_of
from dejavu_torch.cli.parser import Preset, command_parser
from dejavu_torch.cli.presets import preset_names
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.hog import HOG
from dejavu_torch.model_file import REGISTRY
from dejavu_torch.types import InputError

DEFAULTS = {"features": HOG, "model.backbone": SmallCNN}  # whose options can be given without a class
FILES = {"bash": "_shtab_compgen_files", "zsh": "_files"}
PREAMBLE = {  # completes --config
    "bash": '_dejavu_preset_files() {{ compgen -W "{0}" -- "$1"; compgen -f -- "$1"; }}',
    "zsh": '_dejavu_preset_files() {{ _alternative "presets:preset:({0})" "files:file:_files" }}',
}


def run_completion(shell: Literal["bash", "zsh"] = "bash") -> None:
    """Print a script with which a shell completes commands, options, presets and files.

    To use it in this shell only, in bash: eval "$(dejavu completion bash)". To keep it, write it to
    ~/.local/share/bash-completion/completions/dejavu, or for zsh to a file _dejavu in a folder of $fpath.

    Args:
        shell: bash or zsh
    """
    try:
        shtab = importlib.import_module("shtab")
    except ImportError as error:
        raise InputError(
            "shtab is not installed; expected it: pip install 'dejavu_torch[completion]'"
        ) from error
    from dejavu_torch.cli.train import TrainCLI

    # a plain tree: for jsonargparse's own, shtab would list the options of every class in torch
    root = argparse.ArgumentParser("dejavu")
    root.add_argument("--version", action="store_true", help="print the version")
    added = root.add_subparsers()
    for name, text in COMMANDS.items():
        parser = added.add_parser(name, help=text)
        if name != "train":
            _copy(command_parser(name, function_of(name)), parser)
            continue
        stages = parser.add_subparsers()
        for stage in TrainCLI.subcommands():
            _copy(TrainCLI.stage_parser(), stages.add_parser(stage, help=stage))
    print(shtab.complete(root, shell, preamble=PREAMBLE[shell].format(" ".join(preset_names()))))


def _copy(parser: ArgumentParser, plain: argparse.ArgumentParser) -> None:
    """Copy the arguments of a parser that are not there yet, and the options of their parts, for shtab."""
    for action in parser._actions:
        names = [name for name in action.option_strings if not name.endswith("+")]  # which append to lists
        if any(name in plain._option_string_actions for name in names):
            continue
        text = str(action.help or "").partition(";")[0].replace("%", "%%")
        copied: Any = plain.add_argument(*names or [action.dest], help=text)
        copied.nargs = action.nargs
        leaves = [] if action.dest.endswith(".help") else [*_leaves(getattr(action, "_typehint", None))]
        if isinstance(action, Preset):
            copied.complete = dict.fromkeys(FILES, "_dejavu_preset_files")
        elif any(isinstance(leaf, type) and issubclass(leaf, str | os.PathLike) for leaf in leaves):
            copied.complete = FILES
        else:
            copied.choices = [str(leaf) for leaf in leaves if isinstance(leaf, str | int)]
        for base in (leaf for leaf in leaves if isinstance(leaf, type) and issubclass(leaf, nn.Module)):
            ours = [cls for cls in REGISTRY.values() if base is not nn.Module and issubclass(cls, base)]
            for cls in ours or ([DEFAULTS[action.dest]] if action.dest in DEFAULTS else []):
                part = ArgumentParser()
                part.add_class_arguments(cls, action.dest)
                _copy(part, plain)


def _leaves(kind: object) -> Iterator[object]:
    """The types and the values of literals in an annotation."""
    parts = get_args(kind)
    for part in parts:
        yield from _leaves(part)
    if not parts:
        yield kind
