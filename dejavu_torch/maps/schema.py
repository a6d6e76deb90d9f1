"""JSON values from a file, checked by the type annotations of what they are for."""

from __future__ import annotations

import math
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from torch import nn

from dejavu_torch.data.files import LARGEST
from dejavu_torch.types import InputError

NAMES = {
    int: "a whole number below 2^53",
    float: "a finite number",
    str: "a text",
    bool: "true or false",
    type(None): "null",
}
SHOWN = 60  # characters of a value


def checked(value: Any, kind: Any, where: str) -> Any:
    """A JSON value as a type annotation says.

    Args:
        kind: int, float, str, bool, None, Any, a Literal, a union, a sequence or mapping of these, or a
            NamedTuple, which is a mapping with just its fields. Modules are told by a mapping, callables by
            a text.
        where: the value stands, for messages.

    Convention: numbers are finite, whole ones below 2^53.

    Raises:
        InputError: naming what is of another type.

    Example:
        >>> checked([4, 4], tuple[int, int], "block")
        (4, 4)
        >>> checked("4", int | None, "block")
        Traceback (most recent call last):
        dejavu_torch.types.InputError: block is '4'; expected a whole number below 2^53 or null
    """
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        for one in inner:
            try:
                return checked(value, one, where)
            except InputError:
                if isinstance(value, dict) and hasattr(one, "_fields"):  # what else could be meant
                    raise
        raise _refusal(value, kind, where)
    if kind is Any:
        return _plain(value, where)
    if fields := getattr(kind, "_fields", None):
        return kind(**checked_fields(value, {name: get_type_hints(kind)[name] for name in fields}, where))
    if origin is Literal:
        fits = any(type(value) is type(one) and value == one for one in inner)
    elif origin in (tuple, list, Sequence):
        alike = origin is not tuple or ... in inner
        if isinstance(value, list | tuple) and (alike or len(inner) == len(value)):
            kinds = (inner[0],) * len(value) if alike else inner
            pairs = zip(value, kinds, strict=True)
            items = [checked(one, of, f"{where}[{i}]") for i, (one, of) in enumerate(pairs)]
            return items if origin is list else tuple(items)
        fits = False
    elif origin in (dict, Mapping) or (isinstance(kind, type) and issubclass(kind, nn.Module)):
        fits = isinstance(value, dict)
        value = _plain(value, where) if fits else value
    elif origin is Callable:
        fits = isinstance(value, str)
    elif kind is float:
        fits = type(value) in (int, float) and math.isfinite(value)
    elif kind is int:
        fits = type(value) is int and abs(value) < LARGEST
    else:
        fits = type(value) is (type(None) if kind is None else kind)
    if not fits:
        raise _refusal(value, kind, where)
    return value


def checked_fields(value: Any, kinds: Mapping[str, Any], where: str) -> dict[str, Any]:
    """A mapping with just these keys, whose values are `checked` by these types."""
    if not isinstance(value, dict) or value.keys() != kinds.keys():
        seen = ", ".join(sorted(map(str, value))) if isinstance(value, dict) else repr(value)
        raise InputError(f"{where} is of {seen[:SHOWN] or 'nothing'}; expected {', '.join(kinds)}")
    return {name: checked(value[name], kind, f"{where}.{name}") for name, kind in kinds.items()}


def _plain(value: Any, where: str) -> Any:
    """Any JSON value, of numbers as `checked` takes them."""
    if isinstance(value, float | int) and not isinstance(value, bool):
        checked(value, type(value), where)
    if isinstance(value, dict | list | tuple):
        for name, part in value.items() if isinstance(value, dict) else enumerate(value):
            _plain(part, f"{where}.{name}")
    return value


def _refusal(value: object, kind: Any, where: str) -> InputError:
    return InputError(f"{where} is {repr(value)[:SHOWN]}; expected {_told(kind)}")


def _told(kind: Any) -> str:
    """A type in words."""
    inner = get_args(kind)
    if get_origin(kind) is Literal:
        return " or ".join(map(repr, inner))
    if get_origin(kind) in (Union, types.UnionType):
        return " or ".join(map(_told, inner))
    if get_origin(kind) in (tuple, list, Sequence):
        return (
            f"a list of {'' if ... in inner or len(inner) == 1 else f'{len(inner)} times '}{_told(inner[0])}"
        )
    return NAMES.get(kind, "a mapping")
