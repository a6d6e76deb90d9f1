"""The parsers of the commands, made from their functions, with errors of one line."""

from __future__ import annotations

import argparse
import inspect
import json
import os
import pydoc
import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, NoReturn, cast, get_args, get_origin

import docstring_parser
import jsonargparse
import yaml
from jsonargparse.typing import restricted_string_type
from torch import nn

from dejavu_torch.cli.options import named_features, refuse_with
from dejavu_torch.cli.presets import check_config, check_word, find_config
from dejavu_torch.data.files import LARGEST
from dejavu_torch.data.source import check_not_read
from dejavu_torch.features import hub
from dejavu_torch.features.joined import Joined
from dejavu_torch.model import DejaVu
from dejavu_torch.model_file import REGISTRY
from dejavu_torch.text import one_line
from dejavu_torch.types import InputError

MODEL = "model"  # the parameter of a command that is a DejaVu: each of its arguments is an option
COMMAND = "command"  # the parameter that is the command line itself
# the class whose options can be given without it, for a constructor argument of a base class
DEFAULT_PARTS = {"mapper": {"class_path": "dejavu_torch.SpectralMapper"}}
HINT = (
    "Parts have options of their own, such as --whitening.numbers 64, --mapper.route_bytes_per_place 2.5 "
    "or, for HOG alone, --features.cell 4: see --features.help HOG, --whitening.help, --mapper.help "
    "SpectralMapper, --preprocess.help and --velocity.help. --config local_maxima makes a map of templates, "
    "with options such as --mapper.periods.window 512. --features '[HOG, Distilled]' joins several features. "
    "--features hub:megaloc is a pretrained network: it downloads and runs code from GitHub. --whitening "
    "also accepts none, or a map file, whose features are then used as well; --descriptor uses only the "
    "features, of a map or of the file that `dejavu train` writes for several routes."
)
BARE = {"velocity": "GroundOdometry", "page": 8765}  # values of options given without one
MapFile = restricted_string_type("MapFile", r".*\.safetensors")
NETWORKS = ("features", "backbone", "network")  # options that name a class or a function that makes one
LONGEST = 300  # characters of a message; longer ones are cut


class UsageError(InputError):
    """A command line or config file that the commands do not understand."""


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """An exception and its causes; jsonargparse wraps each in one that says more."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def refusal(error: Exception) -> InputError:
    """The error of a part's constructor, as an InputError."""
    chain = list(causes(error))
    own = [one for one in chain if isinstance(one, InputError)]
    if own:  # Python's None is YAML's null
        return type(own[-1])(re.sub(r"\bNone\b", "null", str(own[-1])))
    return InputError(f"a part cannot be built: {one_line(chain[-1])[:LONGEST] or type(chain[-1]).__name__}")


def whole_numbers(value: object) -> Iterator[int]:
    """The whole numbers in a value and in lists and mappings in it."""
    if isinstance(value, int):
        yield value
    elif isinstance(value, dict | list | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            yield from whole_numbers(part)


def made(function: str, **arguments: Any) -> nn.Module:
    """The network that a function of any signature makes, such as torch.hub.load; see `with_made`.

    Args:
        function: its import path as the user typed it, never from a map or checkpoint.
    """
    try:
        maker: Any = pydoc.locate(function)
    except pydoc.ErrorDuringImport as error:
        raise InputError(f"{function} cannot be imported: {one_line(error.value)}") from error
    if not callable(maker):
        raise InputError(f"{function} is no function that can be imported; expected one, or a class")
    try:
        with redirect_stdout(sys.stderr):  # keeps stdout to lines of JSON
            network = maker(**arguments)
    except SystemExit as stop:  # it would end the command silently
        raise InputError(f"{function} ends the program ({stop}); expected one that makes a network") from stop
    if not isinstance(network, nn.Module):
        raise InputError(f"{function} made a {type(network).__name__}; expected an nn.Module")
    # DataParallel would use the first GPU, wherever the model is
    return network.module.cpu() if isinstance(network, nn.DataParallel) else network


def _function_at(path: str) -> Callable[..., Any] | None:
    """The function or method of that name, or None."""
    try:
        found = pydoc.locate(path) if "." in path else None
    except pydoc.ErrorDuringImport:  # the parser reports it
        return None
    return found if inspect.isroutine(found) else None


def with_made(words: Sequence[str]) -> list[str]:
    """The command line with a call of `made` for a function that is named instead of a class.

    `--features timm.create_model --features.model_name NAME` calls that function; jsonargparse itself only
    accepts functions with annotated arguments and return value.
    """
    words = list(_with_members(_joined(with_hub(words))))
    configured = any(word.startswith(("--config=", "-c")) or word == "--config" for word in words)
    named = (word.partition("=") for word in words if _names_network(word))
    makers = {option: path if _function_at(path) is not None else "" for option, _, path in named}
    spelt: list[str] = []
    for word in words:
        option = word.partition("=")[0]
        part = option.rpartition(".")[0]
        own = part if makers.get(part) and not makers.get(option) else option
        path = makers.get(own, "")
        made_by = [f"{own}={__name__}.made", f"{own}.function={path}"] if path else []
        if made_by and made_by[1] in spelt:
            made_by = []
        elif not configured and own in ("--features", "--model.backbone"):
            spelt.append(f"{own}=null")  # else arguments of the default class would be kept
        spelt += made_by  # before its arguments, wherever they are typed
        if not path:
            spelt.append(word)
        elif option != own:
            spelt.append(f"{own}.dict_kwargs.{word.removeprefix(own + '.')}")
    return spelt


def _names_network(word: str) -> bool:
    """Whether a word is an option that names a class, or a function that makes one."""
    return word.startswith("--") and word.partition("=")[0].lstrip("-").rpartition(".")[2] in NETWORKS


def _joined(given: Sequence[str]) -> list[str]:
    """The command line with `--features=NAME` for `--features NAME`, and so for all networks."""
    words = [*given]
    for at in range(len(words) - 2, -1, -1):
        if _names_network(words[at]) and "=" not in words[at] and not words[at + 1].startswith("-"):
            words[at : at + 2] = [f"{words[at]}={words[at + 1]}"]
    return words


def with_hub(given: Sequence[str]) -> Sequence[str]:
    """The command line with the settings that `hub:NAME` stands for, except those that are typed."""
    words = _joined(given)
    typed = [word.partition("=")[0] for word in words]
    values = {at: word.partition("=")[2] for at, word in enumerate(words) if _names_network(word)}
    short = [
        at
        for at, value in values.items()
        if value.startswith(hub.PREFIX) and not typed[at].endswith("network")
    ]
    if not short:
        return given
    if len(short) > 1:
        raise UsageError(f"{' and '.join(values[at] for at in short)}; expected one of them, or a list")
    at, option, whole = short[0], typed[short[0]], hub.known(values[short[0]])
    settings = whole["init_args"] | {"network": "torch.hub.load"}
    settings |= {f"network.{key}": one for key, one in whole["init_args"]["network"]["init_args"].items()}
    named = {f"{option}.{k}": v if type(v) is str else json.dumps(v) for k, v in settings.items()}
    spelt = [f"{option}=null", f"{option}={whole['class_path']}"]  # drops settings of a config
    spelt += [f"{k}={v}" for k, v in named.items() if k not in typed]
    first = next(i for i, one in enumerate(typed) if one.startswith(f"{option}.") or i == at)
    return [*words[:first], *spelt, *words[first:at], *words[at + 1 :]]


def _with_members(words: Sequence[str]) -> Iterator[str]:
    """The command line with `Joined` for a list of features."""
    for word in words:
        option, _, value = word.partition("=")
        if not _names_network(word) or not value.lstrip().startswith("["):
            yield f"{option}={_path_of(value)}" if _names_network(word) and value in REGISTRY else word
            continue
        try:
            members = yaml.safe_load(value)
            made_in = _made_in(members)
            value = value if made_in == members else json.dumps(made_in)
        except InputError:
            raise
        except (yaml.YAMLError, ValueError, TypeError) as error:
            expected = "expected a list of classes, such as [HOG, PatchPixels]"
            raise UsageError(f"{option} is {value!r}; {expected}") from error
        yield from (f"{option}={Joined.__module__}.{Joined.__name__}", f"{option}.members={value}")


def _made_in(value: Any) -> Any:
    """A YAML value with import paths of our classes, and calls of `made` for each function in it."""
    if isinstance(value, list):
        members = [{"class_path": one} if str(one).startswith(hub.PREFIX) else one for one in value]
        return [_path_of(one) if isinstance(one, str) else _made_in(one) for one in members]
    if not isinstance(value, dict):
        return value
    path, given = str(value.get("class_path")), value.get("init_args") or {}
    short = path.startswith(hub.PREFIX)
    if not short and (_function_at(path) is None or path == f"{__name__}.made"):
        return {key: _made_in(one) for key, one in value.items()}
    odd = [key for key in value if key not in ("class_path", "init_args")]
    odd += [key for key in given if "." in str(key)]
    if odd:
        raise UsageError(f"{path} with {odd[0]}; expected settings under init_args, without dots in names")
    if short:
        return _made_in(_merged(hub.known(path), {"init_args": given}))
    return {"class_path": f"{__name__}.made", "init_args": {"function": path}, "dict_kwargs": _made_in(given)}


def _merged(base: Any, over: Any) -> Any:
    """Two nested mappings, of which the second overrides the first; another class discards the settings."""
    if not isinstance(base, dict) or not isinstance(over, dict) or "class_path" in over:
        return over
    return base | {key: _merged(base.get(key), one) for key, one in over.items()}


def _path_of(name: str) -> str:
    """The import path of one of our classes; other names are left to jsonargparse."""
    return f"{REGISTRY[name].__module__}.{name}" if name in REGISTRY else name


class HelpFormatter(jsonargparse.DefaultHelpFormatter):
    """Help without lists of all installed classes, and without defaults of null."""

    def _expand_help(self, action: Any) -> str:
        text, cut, _ = super()._expand_help(action).partition(", known subclasses: ")
        text = text.replace("<class '", "").replace("'>", "").replace(" | null, default: null", "")
        return text + (")" if cut else "")


class Preset(jsonargparse.ActionConfigFile):  # type: ignore[name-defined, misc]
    """--config: the name of a preset, or a YAML file of options."""

    def __call__(self, parser: Any, cfg: Any, values: Any, option_string: str | None = None) -> None:
        path = find_config(values)
        check_config(path)
        super().__call__(parser, cfg, str(path), option_string)


class Parser(jsonargparse.ArgumentParser):
    """A parser whose errors are UsageErrors of one line, and whose options override its --config."""

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

    def _parsed(self, args: Any, *rest: Any, **settings: Any) -> Any:
        for word in args or ():
            check_word(word)
        # a nested null reaches the parser of its part as None
        words = with_made([f"{w[:-4]}null" if w.endswith("=None") else w for w in args or ()])
        start = 1 if self._subparsers is not None else 0  # after the subcommand
        configs, others = self._configs(words[start:])
        if features := self._option_string_actions.get("--features"):  # of this command line alone
            hog = {"class_path": _path_of("HOG")} if self._need_class(configs, others) else None
            features.default = hog
        words[start:] = [*(f"--config={name}" for name in configs), *others]
        parsed = super().parse_args(words, *rest, **settings)
        for key, value in vars(parsed.as_flat()).items():
            if any(abs(number) > LARGEST for number in whole_numbers(value)):
                self.error(f"--{key} is {value}; expected whole numbers of at most {LARGEST}")
        return parsed

    def _configs(self, words: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
        """The values of --config, and the other words."""
        names = [name for name in ("-c", "--config") if name in self._option_string_actions]
        if not names:
            return [], words
        reader = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        reader.error = self.error  # type: ignore[method-assign]
        reader.add_argument(*names, action="append", default=[])
        found, others = reader.parse_known_args(words)
        return found.config, others

    @staticmethod
    def _need_class(configs: Sequence[str], words: Sequence[str]) -> bool:
        """Whether arguments of the features are given, maybe without a class, which is then HOG."""
        if any(word.startswith("--features.") for word in words):
            return True
        for name in configs:
            with suppress(InputError):  # parsing the config reports it
                check_config(path := find_config(name))
                given = yaml.safe_load(path.read_text("utf-8")).get("features")
                if isinstance(given, dict) and "class_path" not in given:
                    return True
        return False

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        head, required, names = message.partition("required: ")
        positional = {action.dest for action in self._actions if not action.option_strings}
        if required:
            words = [
                name if name in positional else f"--{name.partition('.')[2] or name}"  # without `fit.`
                for name in names.split(", ")
            ]
            message = f"{head}{required}{', '.join(words)}"
        text = one_line(_by_options(message, ex, positional))
        raise UsageError(text if len(text) < LONGEST else f"{text[:LONGEST]} ...") from ex


def _by_options(message: str, error: Exception | None, positional: Collection[str]) -> str:
    """The message of jsonargparse, or for an option's value that of the innermost parser or type."""
    key = re.match(r'Parser key "([^"]+)"', message)
    if key is None:
        stages = re.match(r'expected "subcommand" to be one of {(.*)}', message)
        if stages:
            return f"no stage given; expected one of {stages[1].replace(',', ', ')}"
        return re.sub(r"^Option '([\w.]+)'", r"--\1", message)
    option = "--" * (key[1] not in positional) + key[1].replace(".init_args", "")
    short = re.search(rf"\b{hub.PREFIX}[\w+.-]*", message)
    if short:
        where = "--features or --model.backbone on the command line, alone or in a list"
        return f"{option}: {short[0]}; expected a short name only as value of {where}"
    chain = list(causes(error))
    part = next((one for one in chain if isinstance(one, UsageError)), None)
    if part is not None:
        inner = re.sub(r"(?<![\w-])--(?=\w)", f"{option}.", str(part))  # of the part's own parser
        return inner if inner.startswith(option) else f"{option}: {inner}"
    setting = re.search(r"NestedArg\(key='([\w.]+)'", message)
    if setting:
        return f"{option}.{setting[1]}: the value of {option} has no settings; expected one or the other"
    text = re.sub(r"<class '(?:\w+\.)*(\w+)'>", r"\1", str(chain[-1])).replace("typing.Literal", "one of ")
    others = ", none or a map file" * ("MapFile" in message)
    wanted = f"expected the import path of a class{others}, not"
    text = text.replace("Expected a dot import path string:", wanted)
    if text.startswith(wanted) and not others:
        word = text.removeprefix(wanted).strip().lower()
        meant = "null" if word == "none" else next((name for name in REGISTRY if name.lower() == word), None)
        text += f"; did you mean {meant}?" if meant else ""
    value = re.match(r"Expected an? (.*)\. Got value: (.*)", text, re.DOTALL)
    none = "null, or " if value and value[2].lower() == "none" else ""
    return f"{option} is {value[2]}; expected {none}{value[1]}" if value else f"{option}: {text}"


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
    for key, parameter in inspect.signature(function, eval_str=True).parameters.items():
        if key == COMMAND:
            continue
        if key == MODEL:
            add_model(parser)
        elif is_dataclass(options := parameter.annotation):
            for one in inspect.signature(cast(type, options), eval_str=True).parameters.values():
                add_option(parser, one.replace(kind=one.KEYWORD_ONLY), described(cast(type, options))[1])
        else:
            add_option(parser, parameter, helps)
    return parser


def described(thing: Callable[..., Any]) -> tuple[str | None, dict[str, str | None]]:
    """The description and the help of each argument, of a function or of a dataclass with its bases."""
    helps: dict[str, str | None] = {}
    for one in reversed(thing.__mro__ if isinstance(thing, type) else [thing]):
        text = docstring_parser.parse(inspect.getdoc(one) or "")
        helps |= {one.arg_name: one.description for one in text.params}
    return text.description, helps


def add_option(parser: Parser, parameter: inspect.Parameter, helps: Mapping[str, str | None]) -> None:
    """Add an option or a positional argument, see `command_parser`."""
    keyword, default = parameter.kind is parameter.KEYWORD_ONLY, parameter.default
    settings: dict[str, Any] = {"help": helps.get(parameter.name, argparse.SUPPRESS)}  # hidden
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


def grouped(function: Callable[..., None], arguments: dict[str, Any]) -> dict[str, Any]:
    """The arguments, with those of each dataclass of the function gathered in it."""
    for key, parameter in inspect.signature(function, eval_str=True).parameters.items():
        if is_dataclass(parameter.annotation):
            options = cast(type, parameter.annotation)
            names = inspect.signature(options).parameters
            arguments[key] = options(**{name: arguments.pop(name) for name in names})
    return arguments


def add_model(parser: Parser) -> None:
    """Add --config, and every argument of DejaVu as an option."""
    parser.description = f"{parser.description} {HINT}"
    parser.add_argument(
        "-c", "--config", action=Preset, help="preset (default, local_maxima, paper) or YAML file"
    )
    parser.add_class_arguments(DejaVu, None, skip={"whitening", "velocity"})
    helps = described(DejaVu)[1]
    parameters = inspect.signature(DejaVu, eval_str=True).parameters
    for name, also in (("whitening", MapFile), ("velocity", None)):
        one = parameters[name]
        add_option(parser, one.replace(kind=one.KEYWORD_ONLY, annotation=one.annotation | also), helps)
    parser.set_defaults(DEFAULT_PARTS)


def parse(name: str, function: Callable[..., None], words: Sequence[str]) -> dict[str, Any]:
    """The arguments of a command's function, from the words after its name.

    Raises:
        UsageError: words that the command does not understand.
        InputError: a part cannot be built with its arguments.
    """
    parser = command_parser(name, function)
    parsed = parser.parse_args(list(words))
    try:
        arguments: dict[str, Any] = parser.instantiate(parsed).as_dict()
    except Exception as error:
        raise refusal(error) from error
    if MODEL in function.__annotations__:
        arguments[MODEL] = _model_of(name, arguments, [word.partition("=")[0] for word in words])
    return grouped(function, arguments)


def _model_of(name: str, arguments: dict[str, Any], words: Sequence[str]) -> DejaVu:
    """The model that the arguments describe, which are removed from them.

    Args:
        words: of the command line, without the values after `=`.
    """
    _check_settings(name, arguments, words)
    del arguments["config"]
    settings = {one: arguments.pop(one) for one in inspect.signature(DejaVu).parameters}
    whitening, descriptor = settings["whitening"], arguments.get("descriptor")
    if isinstance(whitening, MapFile):
        refuse_with(f"--whitening {whitening}", descriptor=descriptor)
        _check_own(words, {"preprocess", "weight_bits"}, f"the whitening of {whitening}")
        check_not_read(
            arguments["map"] if name == "learn" else arguments["out"] / "map.safetensors", whitening
        )
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


def _check_settings(name: str, arguments: dict[str, Any], words: Sequence[str]) -> None:
    """Refuse settings that a given map has already, and `learn` without a file to write."""
    if name == "learn":
        arguments["map"] = arguments["map"] or arguments["append"]
        if arguments["map"] is None:
            raise UsageError("the following arguments are required: --map")
    given = {"compare": "map", "learn": "append"}.get(name)  # a map that keeps its settings
    if given and arguments[given]:
        own = {*inspect.signature(DejaVu).parameters} - {"features", "threshold", "precision"}
        own |= {"config", "second", "second_truth", "descriptor"}
        _check_own(words, own if given == "map" else {*own, "seed"}, f"the map of --{given}")


def _check_own(words: Sequence[str], own: set[str], whose: str) -> None:
    """Refuse options for what a file has."""
    for word in words:
        option = "config" if word.startswith("-c") else word[2:].partition(".")[0]
        if word.startswith("-") and option in own:
            raise UsageError(f"{word}: {whose} has its own settings; expected one or the other")
