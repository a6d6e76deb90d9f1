"""The commands in the order of messages, with their lines in `dejavu --help`."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module

COMMANDS = {
    "demo": "see it work on two real flights over a road",
    "learn": "learn a map",
    "localize": "find frames on a map",
    "live": "localize the frames of a camera on a map, one at a time",
    "compare": "learn one visit, find the frames of another, and write a report",
    "evaluate": "score a csv of matches from any method",
    "reproduce": "repeat the paper's experiments on simulated routes",
    "train": "train features that repeat: fit, validate, test or export",
    "refine": "improve a map with another drive, without ground truth",
    "update": "refine a map with a drive, and append new ground",
    "merge": "merge the maps of several routes",
    "export": "write a map and its features as an ONNX file",
    "info": "show what a map holds",
    "completion": "print a completion script for bash or zsh",
}
FIRST_DAY = ("demo", "compare", "learn", "localize", "info")  # listed first by `dejavu --help`
# the options that README and the first how-tos use, which --help shows; --help_all shows all
FIRST_OPTIONS = {
    "compare": (
        *("out", "open", "truth", "tolerance", "bytes"),
        *("second", "device", "map", "config", "features"),
    ),
    "learn": ("map", "bytes", "append", "second", "device", "config", "features"),
    "localize": ("out", "top", "precision", "match", "ordered"),
    "live": ("page", "reference", "realtime", "match"),
}
# the modules of this folder that have their functions; commands has all others
MODULES = {"localize": ("localize", "live"), "reports": ("demo", "compare", "evaluate", "reproduce")}
MODULES["completion"] = ("completion",)


def function_of(name: str) -> Callable[..., None]:
    """The function of a command; its module imports torch, which takes seconds."""
    module = next((module for module, names in MODULES.items() if name in names), "commands")
    function: Callable[..., None] = getattr(import_module(f"dejavu_torch.cli.{module}"), f"run_{name}")
    return function
