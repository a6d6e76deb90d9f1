"""`dejavu`: every stage as a command."""

from __future__ import annotations

import logging
import os
import shlex
import signal
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NoReturn

from dejavu_torch.cli import commands
from dejavu_torch.cli.parser import MODEL, UsageError, build_parser, refusal
from dejavu_torch.model import DejaVu
from dejavu_torch.types import InputError

COMMANDS: dict[str, Callable[..., None]] = {
    "demo": commands.run_demo,
    "learn": commands.run_learn,
    "localize": commands.run_localize,
    "compare": commands.run_compare,
    "evaluate": commands.run_evaluate,
    "reproduce": commands.run_reproduce,
    "bench": commands.run_bench,
    "info": commands.run_info,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the `dejavu` command."""
    logging.basicConfig(format="dejavu: %(message)s", level=logging.WARNING)
    given = _spelt_out(list(sys.argv[1:] if arguments is None else arguments))
    if arguments is None:  # so that temporary files are removed
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # a user's own classes, as `python -m` finds them
    parser = build_parser()
    try:
        if given[:1] == ["train"]:  # Lightning, which takes seconds to import, is loaded for it alone
            from dejavu_torch.cli.train import run_train

            run_train(given[1:])
            return
        parsed = parser.parse_args(_config_first(given))
        if parsed.command is None:
            parser.print_help()
            raise SystemExit(2)
        try:
            chosen = parser.instantiate(parsed)[parsed.command].as_dict()
        except Exception as error:
            raise refusal(error) from error
        if chosen.get("map") and parsed.command == "compare":
            _refuse_settings(given)
        chosen.pop("config", None)
        if parsed.command in ("demo", "learn", "compare"):
            chosen["model"] = DejaVu(**{name: chosen.pop(name) for name in MODEL})
        if parsed.command in ("demo", "compare", "evaluate", "reproduce"):
            chosen["command"] = shlex.join(["dejavu", *given])
        COMMANDS[parsed.command](**chosen)
    except UsageError as error:
        config = [value for name, value in pairwise(given) if name == "--config"]
        fail(f"{error} (with --config {' --config '.join(config)})" if config else f"{error} (see --help)")
    except (InputError, OSError) as error:
        fail(str(error))
    except KeyboardInterrupt:
        print("dejavu: interrupted", file=sys.stderr)
        raise SystemExit(130) from None


def _refuse_settings(given: list[str]) -> None:
    """A map has its own settings; only its threshold and what made its features can be given."""
    for word in given:
        name = word.removeprefix("--").partition("=")[0].partition(".")[0]
        if word.startswith("--") and name in (*MODEL, "config") and name not in ("features", "threshold"):
            raise UsageError(f"{word.partition('=')[0]}: a --map has its own settings")


def _spelt_out(given: list[str]) -> list[str]:
    """The command line with a bare --velocity given the one value it can have."""
    following = [*given[1:], "--"]
    return [
        "--velocity=GroundOdometry" if word == "--velocity" and after.startswith("--") else word
        for word, after in zip(given, following, strict=True)
    ]


def _config_first(given: list[str]) -> list[str]:
    """The command line with its config files ahead of the options, which then have the last word."""
    taken = {i for i, word in enumerate(given) if word.startswith("--config=")}
    for i, word in enumerate(given[:-1]):
        if word == "--config":
            taken |= {i, i + 1}
    config = [given[i] for i in sorted(taken)]
    return (
        given[:1] + config + [word for i, word in enumerate(given) if i and i not in taken]
        if given
        else given
    )


def fail(message: str) -> NoReturn:
    """One line on stderr, exit status 2."""
    print(f"dejavu: {' '.join(message.split())}", file=sys.stderr)
    raise SystemExit(2)
