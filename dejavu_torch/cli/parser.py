"""The parsers of the commands, made from their functions, with errors of one line."""

from __future__ import annotations

import argparse
import inspect
import operator
import os
import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache, reduce
from pathlib import Path
from typing import Any, NoReturn, cast, get_args, get_origin, get_type_hints

import docstring_parser
import jsonargparse
from jsonargparse.typing import restricted_string_type

from dejavu_torch.cli.messages import LONGEST, UsageError, by_options, causes, refusal
from dejavu_torch.cli.names import FIRST_OPTIONS
from dejavu_torch.cli.networks import accept_networks, is_made, names_network
from dejavu_torch.cli.options import named_features
from dejavu_torch.cli.presets import find_config, read_config
from dejavu_torch.data.files import LARGEST
from dejavu_torch.data.source import check_not_read
from dejavu_torch.features.hub import made as made  # config files name it here
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.model import DejaVu
from dejavu_torch.text import one_line, refuse_with
from dejavu_torch.types import Facts, InputError, expect

MODEL = "model"  # the parameter of a command that is a DejaVu: each of its arguments is an option
COMMAND = "command"  # the parameter that is the command line itself
# the class whose options can be given without it, for a constructor argument of a base class
DEFAULT_PARTS = {"mapper": {"class_path": "dejavu_torch.SpectralMapper"}}
BYTES, ROUTE_BYTES = "--bytes", "--mapper.route_bytes_per_place"  # an option, and what it stands for
HINT = (
    "Parts have their own options, such as --whitening.numbers 64, --mapper.route_bytes_per_place 2.5 "
    "or, for HOG alone, --features.cell 4: see --features.help HOG, --whitening.help, --mapper.help "
    "SpectralMapper, --preprocess.help and --velocity.help. --config local_maxima makes a template map, "
    "with options such as --mapper.periods.window 512. --features '[HOG, Distilled]' joins several features. "
    "--features hub:megaloc is a pretrained network: it downloads and runs code from GitHub. --whitening "
    "also accepts none, or a map file, whose features are then used as well; --descriptor uses only the "
    "features, of a map or of the file that `dejavu train` writes for several routes."
)
BARE = {"velocity": "GroundOdometry", "page": 8765}  # values of options given without one
MapFile = restricted_string_type("MapFile", r".*\.safetensors")


def whole_numbers(value: object) -> Iterator[int]:
    """The whole numbers in a value and in lists and mappings in it."""
    if isinstance(value, int):
        yield value
    elif isinstance(value, dict | list | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            yield from whole_numbers(part)


class HelpFormatter(jsonargparse.DefaultHelpFormatter):
    """Help without lists of all installed classes, and without defaults of null."""

    def _expand_help(self, action: argparse.Action) -> str:
        text, cut, _ = super()._expand_help(action).partition(", known subclasses: ")
        text = text.replace("<class '", "").replace("'>", "").replace(" | null, default: null", "")
        return text + (")" if cut else "")


class HelpAll(argparse.Action):
    """--help_all: the help of all options."""

    def __init__(self, option_strings: Sequence[str], dest: str, **settings: Any) -> None:
        super().__init__(option_strings, argparse.SUPPRESS, 0, default=argparse.SUPPRESS, **settings)

    def __call__(self, parser: Any, *_: object) -> None:
        parser.whole = True
        parser.print_help()
        parser.exit()


class Preset(jsonargparse.ActionConfigFile):  # type: ignore[name-defined, misc]
    """--config: the name of a preset, or a YAML file of options."""

    def __call__(self, parser: Parser, cfg: object, values: str, option_string: str | None = None) -> None:
        path = find_config(values)
        read_config(path)
        super().__call__(parser, cfg, str(path), option_string)


class Parser(jsonargparse.ArgumentParser):
    """A parser whose errors are UsageErrors of one line, and whose options override its --config."""

    first: Collection[str] = ()  # options that --help shows; all if empty
    hint = ""  # that is shown with all of them
    whole = False  # whether all are shown
    short = False  # whether a size is spelt --bytes

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, formatter_class=HelpFormatter, allow_abbrev=False, **kwargs)

    def parse_args(self, args: Any = None, *rest: Any, **settings: Any) -> Any:
        try:
            return self._parsed(args, *rest, **settings)
        except UsageError as error:
            here = os.getcwd()
            if here in sys.path or not any(isinstance(one, ModuleNotFoundError) for one in causes(error)):
                raise
        sys.path.append(here)  # only for a user's own classes: modules there have any name
        try:
            return self._parsed(args, *rest, **settings)
        except UsageError:
            sys.path.remove(here)
            raise

    def format_help(self, *given: Any) -> str:
        """The help of the first options with a line on the others, or of the whole."""
        shown = {"-h", "--help", "--help_all", *(f"--{name}" for name in self.first)}
        hidden = [one for one in self._actions if one.option_strings and not shown & {*one.option_strings}]
        texts, description = [one.help for one in hidden], self.description
        try:
            if self.whole or not self.first:
                self.description = f"{description} {self.hint}".strip() if description else None
                return str(super().format_help(*given))
            part = ", `--features.help HOG` those of one part" * bool(self.hint)
            self.epilog = f"`{self.prog} --help_all` shows all options{part}."
            for one in hidden:
                one.help = argparse.SUPPRESS
            return str(super().format_help(*given))
        finally:
            self.description, self.epilog, self.whole = description, None, False
            for one, text in zip(hidden, texts, strict=True):
                one.help = text

    def parse_object(self, *args: object, **settings: object) -> Any:
        accept_networks(self)
        return super().parse_object(*args, **settings)

    def _parsed(self, args: Sequence[str] | None, *rest: Any, **settings: Any) -> Any:
        accept_networks(self)
        for word in args or ():
            if not word or (word.startswith("--") and word.endswith("=")):
                raise InputError(f"{word or 'a word'} is empty; expected a name or a value")
        # a nested null reaches the parser of its part as None
        words = [f"{word[:-4]}null" if word.endswith("=None") else word for word in args or ()]
        if BYTES in self._option_string_actions:
            self.short = any(word.partition("=")[0] == BYTES for word in words)
            words = [re.sub(f"^{BYTES}(?==|$)", ROUTE_BYTES, word) for word in words]
            if words[-1:] == [ROUTE_BYTES]:
                self.error(f"{BYTES} without a number; expected bytes per place, as 5")
        start = 1 if self._subparsers is not None else 0  # after the subcommand
        words[start:] = self._in_order(words[start:])
        parsed = super().parse_args(words, *rest, **settings)
        for key, value in vars(parsed.as_flat()).items():
            if any(abs(number) > LARGEST for number in whole_numbers(value)):
                self.error(f"--{key} is {value}; expected whole numbers of at most {LARGEST}")
        return parsed

    def _in_order(self, words: Sequence[str]) -> Sequence[str]:
        """The words, with configs and then classes ahead of their settings, wherever these are typed."""
        names = {name for name in ("-c", "--config") if name in self._option_string_actions}
        classes = {word.partition("=")[0] for word in words if names_network(word)}
        if not names | classes:
            return words
        reader = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        reader.error = self.error  # type: ignore[method-assign]
        for name in sorted(classes, key=lambda name: name.count(".")):
            reader.add_argument(name, action="append", default=[], dest=name)
        if names:
            reader.add_argument(*names, action="append", default=[], dest="--config")
        found, others = reader.parse_known_args(words)
        first = ["--config"] if names else []
        first += sorted(classes, key=lambda name: name.count("."))
        pairs = [(name, value) for name in first for value in vars(found)[name]]
        spelled = [f"{name}={value}" for name, value in pairs]
        # within a part, what is made would keep settings of the class before
        dropped = [f"{name}=null" for name, value in pairs if name == "--model.backbone" and is_made(value)]
        configs = len(vars(found)["--config"]) if names else 0
        return [*spelled[:configs], *dropped, *spelled[configs:], *others]

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        head, required, names = message.partition("required: ")
        positional = {action.dest for action in self._actions if not action.option_strings}
        if required:
            words = [
                name if name in positional else f"--{name.partition('.')[2] or name}"  # without `fit.`
                for name in names.split(", ")
            ]
            message = f"{head}{required}{', '.join(words)}"
        text = one_line(by_options(message, ex, positional))
        text = text.replace(ROUTE_BYTES, BYTES) if self.short else text
        raise UsageError(text if len(text) < LONGEST else f"{text[:LONGEST]} ...") from ex


@cache
def command_parser(name: str, function: Callable[..., None], program: str = "dejavu") -> Parser:
    """The parser of one command of a program, made from its function; once in a process.

    Args:
        function: positional parameters become positional arguments (optional with a default), keyword-only
            ones options, and the fields of a dataclass options too; `Args:` of the docstrings has their help.
            A `Sequence` accepts any number of words, without a default at least one.
    """
    text, helps = described(function)
    parser = Parser(prog=f"{program} {name}", description=text)
    if name in FIRST_OPTIONS and program == "dejavu":
        parser.first = FIRST_OPTIONS[name]
        parser.add_argument("--help_all", action=HelpAll, help="show all options and exit")
    for key, parameter in inspect.signature(function, eval_str=True).parameters.items():
        if key == COMMAND:
            continue
        if key == MODEL:
            add_model(parser)
        elif is_dataclass(options := parameter.annotation):
            title, own = described(cast(type, options))
            group = parser.add_argument_group(str(title).strip().rstrip("."))
            for one in fields_of(cast(type, options)):
                add_option(group, one.replace(kind=one.KEYWORD_ONLY), own)
        else:
            add_option(parser, parameter, helps)
    return parser


def described(thing: Callable[..., object]) -> tuple[str | None, dict[str, str | None]]:
    """The description and the help of each argument, of a function or of a dataclass with its bases."""
    helps: dict[str, str | None] = {}
    for one in reversed(thing.__mro__ if isinstance(thing, type) else [thing]):
        text = docstring_parser.parse(inspect.getdoc(one) or "")
        helps |= {one.arg_name: one.description for one in text.params}
    return text.description, helps


def fields_of(options: type) -> Iterator[inspect.Parameter]:
    """The fields of a dataclass that are options; what Python takes in place of text is left out of them."""
    types = get_type_hints(options)
    hidden = {one.name for one in fields(options) if not one.metadata.get("option", True)}
    for one in inspect.signature(options).parameters.values():
        kind, kinds = types[one.name], get_args(types[one.name])
        if str in kinds:
            known = [part for part in kinds if part in (str, type(None)) or get_origin(part) is list]
            kind = reduce(operator.or_, known)
        if one.name not in hidden:
            yield one.replace(annotation=kind)


def add_option(parser: Any, parameter: inspect.Parameter, helps: Mapping[str, str | None]) -> None:
    """Add an option or a positional argument to a parser or a group of it, see `command_parser`."""
    keyword, default = parameter.kind is parameter.KEYWORD_ONLY, parameter.default
    settings: Facts = {"help": helps.get(parameter.name, argparse.SUPPRESS)}  # hidden
    if parameter.annotation is bool:
        settings["action"] = "store_true"
    elif get_origin(parameter.annotation) is Sequence:
        settings |= {"type": get_args(parameter.annotation)[0], "nargs": "+"}
        settings |= {} if default is parameter.empty else {"nargs": "*", "default": list(default)}
    else:
        settings["type"] = parameter.annotation
        if default is not parameter.empty:
            settings["default"] = default
            settings |= {} if keyword and parameter.name not in BARE else {"nargs": "?"}
        elif keyword:
            settings["required"] = True
    action = parser.add_argument(f"--{parameter.name}" if keyword else parameter.name, **settings)
    if parameter.name in BARE:
        action.const = BARE[parameter.name]


def grouped(function: Callable[..., None], arguments: Facts) -> Facts:
    """The arguments, with those of each dataclass of the function gathered in it."""
    for key, parameter in inspect.signature(function, eval_str=True).parameters.items():
        if is_dataclass(parameter.annotation):
            options = cast(type, parameter.annotation)
            names = [one.name for one in fields_of(options)]
            arguments[key] = options(**{name: arguments.pop(name) for name in names})
    return arguments


def add_model(parser: Parser) -> None:
    """Add --config, and every argument of DejaVu as an option."""
    parser.hint = HINT
    parser.add_argument(
        "-c", "--config", action=Preset, help="preset (default, local_maxima, paper) or YAML file"
    )
    parser.add_class_arguments(DejaVu, None, skip={"whitening", "velocity"})
    group = parser._action_groups[-1]
    group.title = "The model"
    size = f"size of the map: bytes per place that grow with the route ({ROUTE_BYTES})"
    group.add_argument(BYTES, metavar="BYTES", help=size, default=argparse.SUPPRESS)
    helps = described(DejaVu)[1]
    parameters = inspect.signature(DejaVu, eval_str=True).parameters
    for name, also in (("whitening", MapFile), ("velocity", None)):
        one = parameters[name]
        add_option(group, one.replace(kind=one.KEYWORD_ONLY, annotation=one.annotation | also), helps)
    parser.set_defaults(DEFAULT_PARTS)


def parse(name: str, function: Callable[..., None], words: Sequence[str]) -> Facts:
    """The arguments of a command's function, from the words after its name.

    Raises:
        UsageError: words that the command does not understand.
        InputError: a part cannot be built with its arguments.
    """
    parser = command_parser(name, function)
    parsed = parser.parse_args(list(words))
    try:
        arguments: Facts = parser.instantiate(parsed).as_dict()
    except Exception as error:
        raise refusal(error) from error
    if MODEL in function.__annotations__:
        arguments[MODEL] = _model_of(name, arguments, [word.partition("=")[0] for word in words])
    return grouped(function, arguments)


def _model_of(name: str, arguments: Facts, words: Sequence[str]) -> DejaVu:
    """The model that the arguments describe, which are removed from them.

    Args:
        words: of the command line, without the values after `=`.
    """
    _check_settings(name, arguments, words)
    expect("bytes" not in arguments, "mapper: {route_bytes_per_place: ..}", "bytes in a config file")
    if BYTES in words and not isinstance(arguments["mapper"], SpectralMapper | None):
        raise UsageError(f"{BYTES} with {type(arguments['mapper']).__name__}; expected a SpectralMapper")
    del arguments["config"]
    settings = {one: arguments.pop(one) for one in inspect.signature(DejaVu).parameters}
    whitening, descriptor = settings["whitening"], arguments.get("descriptor")
    if isinstance(whitening, MapFile):
        refuse_with(f"--whitening {whitening}", descriptor=descriptor)
        _check_own(words, {"preprocess", "weight_bits"}, f"the whitening of {whitening}")
        out = arguments.get("out")  # none of compare is a folder that is not there
        written = arguments["map"] if name == "learn" else out and out / "map.safetensors"
        if written is not None:
            check_not_read(written, whitening)
        model = DejaVu(**settings | {"whitening": None})
        file = DejaVu.load(Path(whitening), named_features(model))
        try:
            model.descriptor.take(file.descriptor, whitening=True)
        except InputError as error:
            raise InputError(f"--whitening {whitening}: {error}") from error
        return model
    if descriptor:
        _check_own(words, {"preprocess", "weight_bits"}, f"the descriptor of {descriptor}")
    model = DejaVu(**settings)
    if descriptor:
        model.descriptor.take(DejaVu.load(descriptor, named_features(model)).descriptor)
    return model


def _check_settings(name: str, arguments: Facts, words: Sequence[str]) -> None:
    """Refuse settings that a given map has already, and `learn` without a file to write."""
    if name == "learn":
        arguments["map"] = arguments["map"] or arguments["append"]
        if arguments["map"] is None:
            raise UsageError("the following arguments are required: --map")
    given = {"compare": "map", "learn": "append"}.get(name)  # a map that keeps its settings
    if given and arguments[given]:
        own = {*inspect.signature(DejaVu).parameters} - {"features", "threshold", "precision"}
        own |= {"config", "bytes", "second", "second_truth", "descriptor"}
        _check_own(words, own if given == "map" else {*own, "seed"}, f"the map of --{given}")


def _check_own(words: Sequence[str], own: set[str], whose: str) -> None:
    """Refuse options for what a file has."""
    for word in words:
        option = "config" if word.startswith("-c") else word[2:].partition(".")[0]
        if word.startswith("-") and option in own:
            raise UsageError(f"{word}: {whose} has its own settings; expected one or the other")
