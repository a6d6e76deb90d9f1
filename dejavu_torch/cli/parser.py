"""What the commands understand."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any, NoReturn

import jsonargparse
import torch

from dejavu_torch import __version__
from dejavu_torch.experiments.bench import BENCHES
from dejavu_torch.experiments.section_five import PUBLISHED
from dejavu_torch.model import DejaVu
from dejavu_torch.types import InputError

SOURCE = (
    "folder of images, video (clip.mp4?width=160), .npy of frames or features, sim:NAME?seed=0&traverse=0, "
    "or strip:IMAGE?width=96"
)
MODEL = tuple(inspect.signature(DejaVu).parameters)
TRUTH = (
    "offset (place = query + offset), csv of query,place[,place...] or query_frame,place_frame[,...], npz "
    "with GThard, or utm:25 for coordinates in image names"
)
HINT = (
    "Options of the parts go by their names, such as --periods.window 512, --features.cell 4, "
    "--preprocess.contrast patch or --velocity.step 5; --features.help HOG, --periods.help "
    "SpectrogramAnalysis, --preprocess.help and --velocity.help GroundOdometry list them."
)
PARTS = {
    "features": "dejavu_torch.HOG",
    "periods": "dejavu_torch.SpectrogramAnalysis",
    "preprocess": "dejavu_torch.Preprocess",
}


REQUIRED = {"learn.map": "--map", "out": "--out", "truth": "--truth"}
TYPES = {
    "int": "a whole number",
    "float": "a number",
    "tuple": "a list such as '[90,160]'",
    "bool": "true or false",
}
LONGEST = 300  # characters of an error


class HelpFormatter(jsonargparse.DefaultHelpFormatter):
    """Help without the list of every class that is installed."""

    def _expand_help(self, action: Any) -> str:
        text = super()._expand_help(action)
        return re.sub(r"<class '(\w+)'>", r"\1", re.sub(r", known subclasses: [^()]*", "", text))


class UsageError(InputError):
    """A command line or config file that does not say what the commands understand."""


def refusal(error: Exception) -> InputError:
    """What a part's constructor refused, in one line; jsonargparse wraps it."""
    cause = error.__cause__ or error.__context__ or error
    if isinstance(cause, InputError):
        return cause
    return InputError(f"a part cannot be built: {' '.join(str(cause).split())[:LONGEST]}")


class Parser(jsonargparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, formatter_class=HelpFormatter, **kwargs)

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        # of a union's complaints the first is the one about what the user wrote
        union = re.search(r"Errors:\n\s*- (.*?)(?=\n\s*- |\n  Given|\Z)", message, re.DOTALL)
        complaint = f"{message.partition(':')[0]}: {union[1]}" if union else message
        raise UsageError(_plainly(complaint)) from ex


def _plainly(message: str) -> str:
    """jsonargparse's complaint as a user would put it: options by their names, types in words."""
    head, _, names = message.partition("required: ")
    if names:
        needed = [name if name in REQUIRED else name.rpartition(".")[2] for name in names.split(", ")]
        return f"{head}required: {', '.join(REQUIRED.get(name, name) for name in needed)}"
    text, keys = " ".join(message.split()), []
    while key := re.match(r'(?:Parser )?[Kk]ey "([\w.]+)": ', text):
        keys.append(key[1])
        text = text[key.end() :]
    name = f"--{'.'.join(keys)}"
    if keys and text.startswith("--"):  # told of a part by the part's own parser
        return f"{name}.{text[2:]}"
    path = re.match(r"Expected a dot import path string: (.*)", text)
    if keys and path:
        return f"{name} is {path[1][:80]}; expected the name of a class, see {name}.help"
    wrong = re.match(r"Expected an? (.*?)(?:\. Got value: (.*))?$", text)
    if keys and wrong:
        choices = re.search(r"Literal\[(.*)\]", wrong[1])
        kind = choices[1] if choices else re.sub(r"<class '(?:\w+\.)*(\w+)'>", r"\1", wrong[1])
        seen = f" is {wrong[2][:80]}; expected " if wrong[2] else ": expected "
        return f"{name}{seen}{TYPES.get(kind, kind)}"
    told = f"{name}: {text}" if keys else message
    return told if len(told) < LONGEST else f"{told[:LONGEST]} ..."


def build_parser() -> Parser:
    """The parser of all commands."""
    parser = Parser(prog="dejavu", description="Place recognition from repeating features.")
    parser.add_argument("--version", action="version", version=f"dejavu_torch {__version__}")
    commands = parser.add_subcommands(dest="command", metavar="COMMAND")

    def command(name: str, text: str, model: bool = False) -> Parser:
        sub = Parser(description=f"{text}. {HINT}" if model else f"{text}.")
        if model:
            sub.add_argument("--config", action="config", help="YAML file; its keys are the options below")
            sub.add_class_arguments(DejaVu, None, as_group=True)
            sub.set_defaults({name: {"class_path": path} for name, path in PARTS.items()})
        commands.add_subcommand(name, sub, help=text)
        return sub

    text = "the main job on the built-in route: learn, localize a second traverse, report"
    demo = command("demo", text, model=True)
    demo.add_argument("--out", type=Path, default=Path("dejavu_demo"), help="folder for report and pictures")
    demo.add_argument("--seed", type=int, default=0, help="which route")

    learn = command(
        "learn", "learn a map; print its plan, its certificate and the bytes per place", model=True
    )
    learn.add_argument("source", help=SOURCE)
    learn.add_argument("--map", type=Path, required=True, help="map file to write (.safetensors)")

    localize = command("localize", "find the frames of a source on a map")
    localize.add_argument("map", type=Path, help="map file")
    localize.add_argument("source", help=SOURCE)
    localize.add_argument(
        "--out",
        type=Path,
        required=True,
        help="csv of query,place,score,accepted and more",
    )
    localize.add_argument("--threshold", type=float | None, help="accept a match whose score is below")

    localize.add_argument(
        "--corners",
        type=list[list[float]] | None,
        help="where this camera sees the ground that the map's saw in its --velocity.corners",
    )
    localize.add_argument(
        "--as_is",
        action="store_true",
        help="take the frames as they come, though the map's are evenly spaced",
    )

    compare_ = command("compare", "learn, localize and judge, beside baselines and null control", model=True)
    compare_.add_argument("reference", help=SOURCE)
    compare_.add_argument("query", help=SOURCE)
    compare_.add_argument(
        "--map",
        type=Path | None,
        help="judge this map of the reference, with its own settings, instead of learning one",
    )
    compare_.add_argument(
        "--leave_out", type=int | None, help="diagnostic: the reference on itself, W left out"
    )

    evaluate_ = command("evaluate", "judge a matches.csv by a truth: scores, curve, coverage")
    evaluate_.add_argument("matches", type=Path, help="csv of query,place,score[,accepted]")
    evaluate_.add_argument(
        "--reference",
        type=str | None,
        help=f"tells how many places there are, and coordinates for utm: {SOURCE}",
    )
    evaluate_.add_argument(
        "--map",
        type=Path | None,
        help="tells how many places there are, and the frame of each that is evenly spaced",
    )
    evaluate_.add_argument("--query", type=str | None, help="as --reference, of the queries")
    for sub in (compare_, evaluate_):
        sub.add_argument(
            "--truth", type=str if sub is evaluate_ else str | None, required=sub is evaluate_, help=TRUTH
        )
        sub.add_argument("--tolerance", type=int, default=5, help="right within this many places, inclusive")
        sub.add_argument(
            "--interpolate", action="store_true", help="fill in a csv that lists some queries only"
        )
        sub.add_argument("--out", type=Path, required=True, help="folder for report and pictures")

    reproduce = command("reproduce", "the paper's datasets, simulated, beside the paper's own numbers")
    choices = [*PUBLISHED, "all"]
    reproduce.add_argument("dataset", choices=choices, nargs="?", default="all", help="which of them")
    reproduce.add_argument("--out", type=Path, required=True, help="folder for the reports")
    reproduce.add_argument("--seed", type=int, default=0, help="which routes")
    reproduce.add_argument(
        "--tolerance", type=int, default=5, help="right within this many places, inclusive"
    )

    train = command(
        "train",
        "train features that repeat, end to end: fit, validate or test; see `dejavu train fit --help`",
    )
    train.add_argument("arguments", nargs="*", help="fit, validate or test, and their options")

    bench = command("bench", "time this package beside what a user would pick instead")
    bench.add_argument("what", choices=list(BENCHES), nargs="?", default="matcher", help="HOG, L1 distances")
    bench.add_argument("--out", type=Path, required=True, help="folder for bench.json and bench.png")

    info = command("info", "what is in a map, and its certificate")
    info.add_argument("map", type=Path, help="map file")
    for sub in (localize, info):
        sub.add_argument(
            "--features", type=torch.nn.Module | None, help="class of the map's features, if not ours"
        )
    return parser
