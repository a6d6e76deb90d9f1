"""Names, kinds, choices and defaults of the options of every command, from the parsers its --help shows."""

from __future__ import annotations

import argparse
import contextlib
import inspect
import io
import json
import pydoc
import re
import types
from pathlib import Path
from typing import Literal, Union, get_args, get_origin

import jsonargparse
from pytorch_lightning import Trainer

from dejavu_torch.cli import COMMANDS, main

FILE = Path(__file__).parent / "options.json"
# the classes whose arguments are options of a part, as YAML files name them
PARTS = (
    *("HOG", "Embedding", "features.pixels.PatchPixels", "features.cnn.SmallCNN", "features.joined.Joined"),
    *("features.distilled.Distilled", "features.augmentation.Augmentation", "training.losses.Objective"),
    *("Preprocess", "Whitening", "GroundOdometry", "SpectralMapper", "TemplateMapper"),
    *("SpectrogramAnalysis", "periods.imposed.ImposedPeriods"),
)
STAGES = ("fit", "validate", "test", "export")
LIGHTNING = ("--verbose", "--weights_only")  # options of Lightning, as are those of its Trainer that we leave


def shown(*words):
    """The parser whose help a command line prints."""
    seen = []
    printed = argparse.ArgumentParser.print_help
    try:
        argparse.ArgumentParser.print_help = lambda self, file=None: seen.append(self)  # type: ignore
        with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
            main(list(words))
    finally:
        argparse.ArgumentParser.print_help = printed  # type: ignore[method-assign]
    assert seen, f"dejavu {' '.join(words)} shows no help"
    return seen[-1]


def commands():
    """What `dejavu --help` lists."""
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()) as printed:
        main(["--help"])
    listed = dict(re.findall(r"^  (\w+)  +(.+)$", printed.getvalue(), re.MULTILINE))
    return {name: listed[name] for name in COMMANDS}


def kinds(annotation):
    """The kinds of value that an annotation allows, sorted: `int | None` and `Optional[int]` are alike."""
    if get_origin(annotation) in (Union, types.UnionType):
        return sorted({kind for one in get_args(annotation) for kind in kinds(one)})
    if get_origin(annotation) is Literal:
        return sorted(json.dumps(one) for one in get_args(annotation))
    origin, inside = get_origin(annotation), get_args(annotation)
    if origin is not None and inside:
        parts = ", ".join(" | ".join(kinds(one)) if one is not Ellipsis else "..." for one in inside)
        return [f"{origin.__name__}[{parts}]"]
    if annotation in (None, type(None)):
        return ["null"]
    return [getattr(annotation, "__name__", str(annotation)).removeprefix("typing.")]


def plain(value):
    """A default as JSON: class paths without their modules."""
    if isinstance(value, argparse.Namespace) or hasattr(value, "as_dict"):
        value = value.as_dict() if hasattr(value, "as_dict") else vars(value)
    if isinstance(value, dict):
        return {
            key: str(one).rpartition(".")[2] if key == "class_path" else plain(one)
            for key, one in value.items()
        }
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def options(parser):
    """The options of a parser and, without dashes, its positional arguments."""
    trainer = inspect.signature(Trainer).parameters
    for action in parser._actions:
        if action.default == argparse.SUPPRESS or isinstance(action, argparse._SubParsersAction):
            continue
        name = next((one for one in action.option_strings if one.startswith("--")), action.dest)
        lightning = trainer.get(name.removeprefix("--trainer."))
        own = lightning is None or lightning.default == action.default
        if name in LIGHTNING or (name.startswith("--trainer.") and own):
            continue
        kind = getattr(action, "_typehint", None) or action.type
        flag = action.nargs == 0
        about = {"kind": ["flag"] if flag else kinds(kind)}
        if action.choices:
            about["choices"] = sorted(map(str, action.choices))
        if action.nargs not in (None, 0):
            about["number"] = action.nargs
        if action.required:
            about["required"] = True
        else:
            about["default"] = plain(action.default)
        yield name, about


def read():
    """All of them, by the words that show them."""
    found = {"dejavu": commands()}
    for command in found["dejavu"]:
        if command != "train":
            found[command] = dict(options(shown(command, "--help")))
    for name in PARTS:
        parser = jsonargparse.ArgumentParser()
        parser.add_class_arguments(pydoc.locate(f"dejavu_torch.{name}"), None)
        found[name.rpartition(".")[2]] = dict(options(parser))
    for stage in STAGES:
        found[f"train {stage}"] = dict(options(shown("train", stage, "--help")))
    fit = found["train fit"]
    for stage in STAGES[1:]:  # what differs from fit
        one = found[f"train {stage}"]
        differing = {name: about for name, about in one.items() if fit.get(name) != about}
        found[f"train {stage}"] = {"without": sorted(set(fit) - set(one)), **differing}
    return found


def text(found):
    """JSON with a line for each option."""
    blocks = []
    for words, one in found.items():
        lines = [f"  {json.dumps(name)}: {json.dumps(about)}" for name, about in one.items()]
        blocks.append(f" {json.dumps(words)}: {{\n" + ",\n".join(lines) + "\n }")
    return "{\n" + ",\n".join(blocks) + "\n}\n"


def write():
    FILE.write_text(text(read()))
