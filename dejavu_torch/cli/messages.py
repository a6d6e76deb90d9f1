"""The errors of jsonargparse in the words of the command line: which option has which value."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator

from dejavu_torch.model_file import REGISTRY
from dejavu_torch.text import one_line
from dejavu_torch.types import InputError

UNITS = {"--tolerance": " of frames, or in an area of metres or pixels; by coordinates, --truth metres:5"}
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


def by_options(message: str, error: Exception | None, positional: Collection[str]) -> str:
    """The message of jsonargparse, or for an option's value that of the innermost parser or type.

    Args:
        positional: names of the arguments that are no options.
    """
    key = re.match(r'Parser key "([^"]+)"', message)
    if key is None:
        return _of_no_option(message)
    option = "--" * (key[1] not in positional) + key[1].replace(".init_args", "")
    chain = list(causes(error))
    part = next((one for one in chain if isinstance(one, UsageError)), None)
    if part is not None:
        return _of_a_part(option, str(part))
    setting = re.search(r"NestedArg\(key='([\w.]+)'", message)
    if setting:
        return f"{option}.{setting[1]}: the value of {option} has no settings; expected one or the other"
    own = [one for one in chain if isinstance(one, InputError)]
    text = str((own or chain)[-1]).replace("typing.Literal", "one of ")
    text = re.sub(r"<class '(?:\w+\.)*(\w+)'>", r"\1", text)
    return _of_a_value(option, _of_a_class(text, takes_files="MapFile" in message))


def _of_no_option(message: str) -> str:
    stages = re.match(r'expected "subcommand" to be one of {(.*)}', message)
    if stages:
        return f"no stage given; expected one of {stages[1].replace(',', ', ')}"
    return re.sub(r"^Option '([\w.]+)'", r"--\1", message)


def _of_a_part(option: str, text: str) -> str:
    """What the parser of a part says, such as of --features, whose options have its name before theirs."""
    inner = re.sub(r"(?<![\w-])--(?=\w)", f"{option}.", text)
    return inner if inner.startswith(option) else f"{option}: {inner}"


def _of_a_class(text: str, takes_files: bool) -> str:
    """What is said of a word that names no class, with the class that was meant."""
    others = ", none or a map file" * takes_files
    wanted = f"expected the import path of a class{others}, not"
    text = text.replace("Expected a dot import path string:", wanted)
    if text.startswith(wanted) and not others:
        word = text.removeprefix(wanted).strip().lower()
        meant = "null" if word == "none" else next((name for name in REGISTRY if name.lower() == word), None)
        text += f"; did you mean {meant}?" if meant else ""
    return text


def _of_a_value(option: str, text: str) -> str:
    value = re.match(r"Expected an? (.*)\. Got value: (.*)", text, re.DOTALL)
    if value:
        none = "null, or " if value[2].lower() == "none" else ""
        return f"{option} is {value[2]}; expected {none}{value[1]}{UNITS.get(option, '')}"
    return f"{option} {text}" if text.startswith("is ") else f"{option}: {text}"
