"""`dejavu`: every stage as a command, a thin skin over functions."""

from __future__ import annotations

import logging
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import jsonargparse
import torch

from dejavu_torch import __version__
from dejavu_torch.data.files import check_output_file, make_output_folder
from dejavu_torch.data.source import open_source
from dejavu_torch.database.certificate import describe
from dejavu_torch.evaluation.report import score_table, text_table, write_matches, write_report
from dejavu_torch.experiments.compare import Comparison, compare
from dejavu_torch.model import DejaVu
from dejavu_torch.types import InputError

SOURCE = "folder of images, .npy of frames or features, sim:NAME?seed=0&traverse=0, or strip:IMAGE?width=96"
MODEL = ("features", "periods", "metric", "reduction", "threshold", "batch_size")


class HelpFormatter(jsonargparse.DefaultHelpFormatter):
    """Help without the list of every class that is installed."""

    def _expand_help(self, action: Any) -> str:
        text = super()._expand_help(action)
        return re.sub(r"<class '(\w+)'>", r"\1", re.sub(r", known subclasses: [^()]*", "", text))


class UsageError(InputError):
    """A command line or config file that does not say what the commands understand."""


class Parser(jsonargparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, formatter_class=HelpFormatter, **kwargs)

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        # of a union's complaints the first is the one about what the user wrote
        union = re.search(r"Errors:\n\s*- (.*?)(?=\n\s*- |\n  Given|\Z)", message, re.DOTALL)
        key = message.partition(":")[0]
        raise UsageError(f"{key}: {union[1]}" if union else message) from ex


def fail(message: str) -> NoReturn:
    """One line on stderr, exit status 2."""
    print(f"dejavu: {' '.join(message.split())}", file=sys.stderr)
    raise SystemExit(2)


def run_demo(out: Path, seed: int, command: str) -> None:
    """The main job on the built-in route."""
    make_output_folder(out)
    reference = open_source(f"sim:aerial?seed={seed}")
    query = open_source(f"sim:aerial?seed={seed}&traverse=1")
    print(f"learning {reference.name}, then finding {query.name} on it")
    result = compare(reference, query, progress=True)
    _publish(result, out, "dejavu demo: the built-in route", command, save_map=True)


def run_learn(source: str, map: Path, model: DejaVu) -> None:
    """Learn a map and print its plan."""
    check_output_file(map)
    model.learn(open_source(source), progress=True)
    model.save(map)
    _print_plan(model)


def run_localize(map: Path, source: str, out: Path, threshold: float | None, features: Any) -> None:
    """Find the frames of a source on a map; one csv row each."""
    check_output_file(out)
    model = DejaVu.load(map, features)
    model.threshold = model.threshold if threshold is None else threshold
    if model.threshold is None:
        print("no threshold given or stored in the map: every query with a finite score is accepted")
    queries, accepted = write_matches(out, model.matches(open_source(source), progress=True))
    print(f"{queries} queries, {accepted} accepted; written to {out}")


def run_compare(
    reference: str,
    query: str,
    truth: str | None,
    tolerance: int,
    leave_out: int | None,
    out: Path,
    model: DejaVu,
    command: str,
) -> None:
    """Learn, localize and judge; report beside baselines and null control."""
    pair = open_source(reference), open_source(query)
    make_output_folder(out)
    result = compare(*pair, truth, model, tolerance, leave_out, progress=True)
    _publish(result, out, f"{query} found on {reference}", command)


def run_info(map: Path, features: Any) -> None:
    """Tell what is in a map."""
    model = DejaVu.load(map, features)
    _print_plan(model)
    matcher = model.matcher
    print(f"features {type(model.features).__name__}, {matcher.extra_repr()}, threshold={model.threshold}")


def _print_plan(model: DejaVu) -> None:
    if not model.map.plan:
        print("this route does not repeat")
    print(describe(model.certificate))


def _publish(result: Comparison, out: Path, title: str, command: str, save_map: bool = False) -> None:
    _print_plan(result.model)
    if result.report.ours.scores is None:
        print("the traverses differ in length and no --truth was given: matches and pictures, no scores")
    print(text_table(score_table(result.report)))
    write_matches(out / "matches.csv", [result.match])
    if save_map:
        result.model.save(out / "map.safetensors")
    write_report(out, result.report, result.pictures, title, command, describe(result.model.certificate))
    print(f"right within {result.report.facts['tolerance']} frames; report: {out / 'index.html'}")


def build_parser() -> Parser:
    """The parser of all commands."""
    parser = Parser(prog="dejavu", description="Place recognition from repeating features.")
    parser.add_argument("--version", action="version", version=f"dejavu_torch {__version__}")
    commands = parser.add_subcommands(dest="command", metavar="COMMAND")

    def command(name: str, text: str, model: bool = False) -> Parser:
        sub = Parser(description=text)
        if model:
            sub.add_argument("--config", action="config", help="YAML file; its keys are the options below")
            sub.add_class_arguments(DejaVu, None, as_group=True)
            defaults = {"features": "dejavu_torch.HOG", "periods": "dejavu_torch.SpectrogramAnalysis"}
            sub.set_defaults({name: {"class_path": path} for name, path in defaults.items()})
        commands.add_subcommand(name, sub, help=text)
        return sub

    demo = command("demo", "the main job on the built-in route: learn, localize a second traverse, report")
    demo.add_argument("--out", type=Path, default=Path("dejavu_demo"), help="folder for report and pictures")
    demo.add_argument("--seed", type=int, default=0, help="which route")

    learn = command("learn", "learn a map; prints the plan, its certificate and bytes per place", model=True)
    learn.add_argument("source", help=SOURCE)
    learn.add_argument("--map", type=Path, required=True, help="map file to write (.safetensors)")

    localize = command("localize", "find the frames of a source on a map")
    localize.add_argument("map", type=Path, help="map file")
    localize.add_argument("source", help=SOURCE)
    localize.add_argument(
        "--out", type=Path, required=True, help="csv of query,place,score,accepted to write"
    )
    localize.add_argument("--threshold", type=float | None, help="accept a match whose score is below")

    compare_ = command("compare", "learn, localize, judge; baselines and null control beside it", model=True)
    compare_.add_argument("reference", help=SOURCE)
    compare_.add_argument("query", help=SOURCE)
    compare_.add_argument("--truth", type=str | None, help="integer offset: place = query + offset")
    compare_.add_argument("--tolerance", type=int, default=5, help="right within this many frames, inclusive")
    compare_.add_argument(
        "--leave_out", type=int | None, help="diagnostic: the reference on itself, W left out"
    )
    compare_.add_argument("--out", type=Path, required=True, help="folder for report and pictures")

    info = command("info", "what is in a map, and its certificate")
    info.add_argument("map", type=Path, help="map file")
    for sub in (localize, info):
        sub.add_argument(
            "--features", type=torch.nn.Module | None, help="class of the map's features, if not ours"
        )
    return parser


COMMANDS: dict[str, Callable[..., None]] = {
    "demo": run_demo,
    "learn": run_learn,
    "localize": run_localize,
    "compare": run_compare,
    "info": run_info,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the `dejavu` command."""
    logging.basicConfig(format="dejavu: %(message)s", level=logging.WARNING)
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = build_parser()
    try:
        parsed = parser.parse_args(given)
        if parsed.command is None:
            parser.print_help()
            raise SystemExit(2)
        chosen = parser.instantiate(parsed)[parsed.command].as_dict()
        chosen.pop("config", None)
        if parsed.command in ("learn", "compare"):
            chosen["model"] = DejaVu(**{name: chosen.pop(name) for name in MODEL})
        if parsed.command in ("demo", "compare"):
            chosen["command"] = shlex.join(["dejavu", *given])
        COMMANDS[parsed.command](**chosen)
    except UsageError as error:
        config = [value for name, value in pairwise(given) if name == "--config"]
        fail(f"{error} (with --config {config[0]})" if config else f"{error} (see --help)")
    except (InputError, OSError) as error:
        fail(str(error))
    except ValueError as error:  # a constructor's own refusal arrives wrapped
        cause = error.__cause__ or error.__context__
        if not isinstance(cause, InputError):
            raise
        fail(str(cause))
    except KeyboardInterrupt:
        print("dejavu: interrupted", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
