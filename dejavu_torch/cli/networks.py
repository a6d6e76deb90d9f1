"""What an option for a network may be: a class, hub:NAME, a function that makes one, or a list of these."""

from __future__ import annotations

import inspect
import json
import pydoc
from collections.abc import Callable, Sequence
from typing import Any

import yaml
from jsonargparse import ArgumentParser, Namespace
from jsonargparse._typehints import ActionTypeHint  # whose values no public hook reaches

from dejavu_torch.features import hub
from dejavu_torch.features.joined import Joined
from dejavu_torch.model_file import REGISTRY
from dejavu_torch.types import Facts, InputError

OPTIONS = ("features", "backbone", "network")  # last parts of the names of such options
MADE = "dejavu_torch.cli.parser.made"  # as config files name it
HUB = f"{hub.__name__}.hub"
SPEC = {"class_path", "init_args", "dict_kwargs"}


def names_network(word: str) -> bool:
    """Whether a word is an option that names a class, or a function that makes one."""
    return word.startswith("--") and word.partition("=")[0].lstrip("-").rpartition(".")[2] in OPTIONS


def with_hub(words: Sequence[str]) -> list[str]:
    """The command line with the call that hub:NAME stands for, which makes the network of a trained map."""
    spelled: list[str] = []
    for at, word in enumerate(words):
        option, _, value = word.partition("=")
        value = value or (words[at + 1] if at + 1 < len(words) else "")
        if names_network(word) and value.startswith(hub.PREFIX):
            spelled.append(f"{option}.network=torch.hub.load")
            for name, one in hub.known(value).call.items():
                setting = f"{option}.network.{name}"
                if not any(typed.partition("=")[0] == setting for typed in words):
                    spelled.append(f"{setting}={one if isinstance(one, str) else json.dumps(one)}")
        spelled.append(word)
    return spelled


class NetworkAction(ActionTypeHint):
    """An option for a network: its value is put into jsonargparse's words, class_path and init_args."""

    def __call__(self, parser: Any, cfg: Any, value: Any, option: str | None = None) -> None:
        before = cfg.get(self.dest)
        base = next((one for one in self.option_strings if str(option).startswith(f"{one}.")), None)
        if base is not None and option is not None:  # a setting
            name = option.removeprefix(f"{base}.")
            path = None if before is None else before.get("class_path")
            if path is None and self.dest == "features":
                cfg[self.dest] = Namespace({"class_path": path_of("HOG")})  # type: ignore[no-untyped-call]
            elif path == MADE and name.partition(".")[0] not in {*SPEC, "function"}:
                option = f"{base}.dict_kwargs.{name}"
        else:
            try:
                value = spelt(value)
            except InputError as error:
                raise TypeError(f'Parser key "{self.dest}":\n{error}') from error
            if isinstance(value, dict) and before is not None and not _of_one_class(before, value):
                cfg[self.dest] = None  # settings of another class are not kept
        super().__call__(parser, cfg, value, option)  # type: ignore[no-untyped-call]

    def _check_type(self, value: Any, append: bool = False, cfg: Any = None, mode: object = None) -> Any:
        if isinstance(value, Namespace):
            value = value.as_dict()
        value = spelt(value)
        if isinstance(value, dict) and "class_path" not in value and self.dest == "features":
            if not value.keys() <= SPEC:
                value = {"init_args": value}
            before = cfg.get(self.dest) if cfg else None
            value = {"class_path": before["class_path"] if before else path_of("HOG")} | value
        return super()._check_type(value, append, cfg, mode)  # type: ignore[no-untyped-call]


def accept_networks(parser: ArgumentParser) -> None:
    """Let the options of a parser for networks, and those of its subcommands, be as above."""
    for action in parser._actions:
        if isinstance(getattr(action, "_name_parser_map", None), dict):
            for one in action._name_parser_map.values():  # type: ignore[attr-defined]
                accept_networks(one)
        if type(action) is not ActionTypeHint or action.dest.rpartition(".")[2] not in OPTIONS:
            continue
        if action.is_subclass_typehint(action, all_subtypes=False):  # type: ignore[no-untyped-call]
            action.__class__ = NetworkAction  # and no mapping, as of hub


def spelt(value: object) -> Any:
    """A value with import paths in place of short names, and with the call that makes each network."""
    if isinstance(value, str):
        if value.lstrip().startswith(("[", "{")):
            try:
                return spelt(yaml.safe_load(value))
            except InputError:
                raise
            except (yaml.YAMLError, ValueError, TypeError) as error:
                expected = "expected a list of classes, such as [HOG, PatchPixels]"
                if value.lstrip()[0] == "[":
                    raise InputError(f"is {value!r}; {expected}") from error
        return spelt({"class_path": value}) if is_made(value) else path_of(value)
    if isinstance(value, list):
        members = [spelt({"class_path": one} if isinstance(one, str) else one) for one in value]
        return {"class_path": f"{Joined.__module__}.{Joined.__name__}", "init_args": {"members": members}}
    if not isinstance(value, dict) or "class_path" not in value:
        return value
    path, given = str(value["class_path"]), value.get("init_args") or {}
    if not is_made(path):
        given = {key: _inside(key, one) for key, one in given.items()}
        return value | {"class_path": path_of(path)} | ({"init_args": given} if given else {})
    odd = [key for key in value if key not in ("class_path", "init_args")]
    odd += [key for key in given if "." in str(key)]
    if odd:
        raise InputError(f"{path} with {odd[0]}; expected settings under init_args, without dots in names")
    if not path.startswith(hub.PREFIX):
        return {"class_path": MADE, "init_args": {"function": path}, "dict_kwargs": given}
    hub.known(path)
    network = given.get("network") or {}
    given = given | ({"network": network.get("init_args", network)} if network else {})
    return {"class_path": HUB, "init_args": {"name": path.removeprefix(hub.PREFIX), **given}}


def _inside(key: str, value: object) -> object:
    """The value of a class's argument, in which there may be networks."""
    if isinstance(value, list):
        return [spelt(one) if isinstance(one, dict) or key == "members" else one for one in value]
    return spelt(value) if key in OPTIONS or isinstance(value, dict) else value


def is_made(path: str) -> bool:
    """Whether it is a short name, or a function without annotations that jsonargparse asks for."""
    return path.startswith(hub.PREFIX) or (path not in (MADE, HUB) and _function_at(path) is not None)


def path_of(name: str) -> str:
    """The import path of one of our classes; other names are left to jsonargparse."""
    return f"{REGISTRY[name].__module__}.{name}" if name in REGISTRY else name


def _function_at(path: str) -> Callable[..., object] | None:
    """The function or method of that name, or None."""
    try:
        found = pydoc.locate(path) if "." in path else None
    except pydoc.ErrorDuringImport:  # the parser reports it
        return None
    return found if inspect.isroutine(found) else None


def _of_one_class(before: Facts, value: Facts) -> bool:
    """Whether two values name the same class, by any path."""
    names = (str(one.get("class_path")).rpartition(".")[2] for one in (before, value))
    return len({*names}) == 1
