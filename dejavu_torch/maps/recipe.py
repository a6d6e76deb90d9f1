"""How a module was made, as data: its class by name and its arguments."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TypeVar, get_type_hints

from torch import nn

from dejavu_torch.maps.schema import checked, checked_fields
from dejavu_torch.types import InputError

M = TypeVar("M", bound=nn.Module)
Registry = Mapping[str, type[nn.Module]]
MOST_PARTS = 16  # of a recipe: each is tried out with all that it holds


class Recipe(NamedTuple):
    """How to build a module: the name of its class and its constructor arguments."""

    class_path: str
    init_args: dict[str, Any]


def recipe_of(module: nn.Module, registry: Registry) -> Recipe:
    """Recipe of a module.

    Args:
        registry: the classes that a map may name, which keep each constructor argument under its own name.
            Of any other module only the class path is recorded, and the caller gives the object when loading.
    """
    cls = type(module)
    known = registry.get(cls.__name__) is cls
    arguments = {name: getattr(module, name) for name in inspect.signature(cls).parameters} if known else {}
    for name, value in arguments.items():
        if isinstance(value, nn.Module):
            arguments[name] = recipe_of(value, registry)._asdict()
        elif callable(value):  # a name alone, which no file can bring back
            arguments[name] = getattr(value, "__name__", "callable")
    # as JSON gives it back, so that a recipe read from a file equals the module's own
    return Recipe(
        cls.__name__ if known else f"{cls.__module__}.{cls.__qualname__}", json.loads(json.dumps(arguments))
    )


def inner_recipes(recipe: Recipe) -> Iterator[tuple[str, Recipe]]:
    """The parts that a recipe names, by argument."""
    for name, value in recipe.init_args.items():
        if isinstance(value, dict) and "class_path" in value:
            yield name, checked(value, Recipe, name)


def with_parts(recipe: Recipe) -> list[Recipe]:
    """A recipe, and those of all its parts."""
    return [recipe, *(inner for _, part in inner_recipes(recipe) for inner in with_parts(part))]


def build(recipe: Recipe, kind: type[M], registry: Registry, given: nn.Module | None = None) -> M:
    """Build a module from its recipe; nothing is ever imported by name.

    Args:
        kind: what it has to be. registry: the classes that may be built.
        given: a module from elsewhere, used where the recipe, or a part of it, is its own.

    Raises:
        InputError: a class outside the registry, one that is no `kind`, arguments that are not its own, or
            parts within parts beyond `MOST_PARTS`.
    """
    name = recipe.class_path
    if isinstance(given, kind) and recipe_of(given, registry) == recipe:
        return given
    if name not in registry:
        raise InputError(
            f"the map's features come from {name}, which only the caller can load; expected it as "
            "`features`, with the arguments it was made with"
        )
    cls = registry[name]
    if not issubclass(cls, kind):
        raise InputError(f"the map names {name}, which is no {kind.__name__}")
    hints = get_type_hints(cls.__init__)
    kinds = {  # an argument that is newer than the file has its default
        key: hints[key]
        for key, parameter in inspect.signature(cls).parameters.items()
        if key in recipe.init_args or parameter.default is parameter.empty
    }
    arguments = checked_fields(recipe.init_args, kinds, f"the map's {name}")
    count = len(with_parts(recipe))
    if count > MOST_PARTS:
        raise InputError(f"the map's {name} is made of {count} parts; expected at most {MOST_PARTS}")
    parts = {key: build(part, nn.Module, registry, given) for key, part in inner_recipes(recipe)}
    return cls(**arguments | parts)


def difference(stored: Recipe, given: Recipe) -> str:
    """Where two recipes differ, in words."""
    if stored.class_path != given.class_path:
        return f"{stored.class_path}; got {given.class_path}"
    names = [name for name, value in stored.init_args.items() if given.init_args.get(name) != value]
    expected = ", ".join(f"{name}={stored.init_args[name]}" for name in names)
    got = ", ".join(f"{name}={given.init_args.get(name)}" for name in names)
    return f"{stored.class_path} of {expected}; got {got}"
