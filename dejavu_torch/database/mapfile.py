"""One safetensors file for a map: tensors, and JSON that says what they are. No pickle, no code."""

from __future__ import annotations

import importlib
import inspect
import json
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from dejavu_torch.data.files import whole_file
from dejavu_torch.database.compressed import CompressedMap
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.periods.finder import PeriodFinder
from dejavu_torch.types import InputError

FORMAT = 3  # 1 knew no even steps, 2 neither weights nor temperature
PACKAGE = "dejavu_torch"
PARTS: dict[str, type[nn.Module]] = {  # what a header holds recipes of
    "preprocess": Preprocess,
    "features": nn.Module,
    "periods": PeriodFinder,
    "velocity": GroundOdometry,
}
LAYER_COLUMNS = ["period_numerator", "period_denominator", "phases", "start", "stop"]


M = TypeVar("M", bound=nn.Module)


class Recipe(NamedTuple):
    """How to build a module: its class path and its constructor arguments."""

    class_path: str
    init_args: dict[str, Any]


def recipe_of(module: nn.Module) -> Recipe:
    """Recipe of a module. Ours keep each constructor argument under its own name; of any other
    module only the class path is recorded, and the caller gives the object when loading."""
    cls = type(module)
    path = f"{cls.__module__}.{cls.__qualname__}"
    names = inspect.signature(cls).parameters if path.startswith(PACKAGE + ".") else ()
    arguments = {name: getattr(module, name) for name in names}
    for name, value in arguments.items():
        if isinstance(value, nn.Module):
            arguments[name] = recipe_of(value)._asdict()
    # as JSON gives it back, so that a recipe read from a file equals the module's own
    return Recipe(path, json.loads(json.dumps(arguments)))


def build(recipe: Recipe, kind: type[M], given: nn.Module | None = None) -> M:
    """Build a module of this package from its recipe; never imports anything else.

    Args:
        given: a module from elsewhere, to stand where the recipe, or a part of it, names its class.

    Raises:
        InputError: a class outside this package, one that is not there, or one that is no `kind`.
    """
    module_name, _, class_name = str(recipe.class_path).rpartition(".")
    if isinstance(given, kind) and recipe_of(given) == recipe:
        return given
    if not str(recipe.class_path).startswith(PACKAGE + "."):
        raise InputError(
            f"the map's features come from {recipe.class_path}, which only the caller can load; expected "
            f"--features {recipe.class_path} with the arguments it was made with, or features=... in Python"
        )
    try:
        cls = getattr(importlib.import_module(module_name), class_name)
        if not (isinstance(cls, type) and issubclass(cls, kind)):
            raise TypeError(f"{class_name} is no {kind.__name__}")
        parts = {
            n: Recipe(**v) for n, v in recipe.init_args.items() if isinstance(v, dict) and "class_path" in v
        }
        module = cls(**recipe.init_args | {n: build(part, nn.Module, given) for n, part in parts.items()})
    except (ImportError, AttributeError, TypeError) as error:
        raise InputError(f"the map names {recipe.class_path}, which cannot be built: {error}") from error
    return module


def part_recipes(model: nn.Module) -> dict[str, Any]:
    """The header's entries of a model's parts, by the names of `PARTS`."""
    parts = {name: getattr(model, name) for name in PARTS}
    return {name: None if part is None else recipe_of(part)._asdict() for name, part in parts.items()}


def build_parts(header: dict[str, Any], features: nn.Module | None = None) -> dict[str, Any]:
    """The modules that a map's header names, by the names of `PARTS`.

    Args:
        features: the module that made the map's features, needed where it is not one of this package.

    Raises:
        InputError: modules that cannot be built, or other features than the map's.
    """
    there = [name for name in PARTS if name != "velocity" or header[name] is not None]
    recipes = {name: Recipe(**header[name]) for name in there}
    if features is not None:
        own = recipe_of(features)
        for recipe in _within(recipes["features"]):
            if recipe.class_path == own.class_path:
                _complete(recipe, type(features))
        if own not in _within(recipes["features"]):
            raise InputError(f"it was learnt with {_difference(recipes['features'], own)}")
    parts: dict[str, Any] = dict.fromkeys(PARTS)
    for name, recipe in recipes.items():
        # only learning needs what found the periods: one from elsewhere need not be built
        elsewhere = name == "periods" and not recipe.class_path.startswith(PACKAGE + ".")
        if parts[name] is None and not elsewhere:
            parts[name] = build(recipe, PARTS[name], features)
    return parts


def _within(recipe: Recipe) -> list[Recipe]:
    """A recipe, and those of its parts."""
    parts = [Recipe(**v) for v in recipe.init_args.values() if isinstance(v, dict) and "class_path" in v]
    return [recipe, *(inner for part in parts for inner in _within(part))]


def _complete(recipe: Recipe, cls: type[nn.Module]) -> None:
    """Arguments that an older version did not know were what is the default now."""
    for name, parameter in inspect.signature(cls).parameters.items():
        if recipe.class_path.startswith(PACKAGE + ".") and parameter.default is not parameter.empty:
            recipe.init_args.setdefault(name, json.loads(json.dumps(parameter.default)))


def _difference(stored: Recipe, given: Recipe) -> str:
    """Where two recipes differ, in words."""
    if stored.class_path != given.class_path:
        return f"{stored.class_path}; got {given.class_path}"
    names = [name for name, value in stored.init_args.items() if given.init_args.get(name) != value]
    told = ", ".join(f"{name}={stored.init_args[name]}" for name in names)
    got = ", ".join(f"{name}={given.init_args.get(name)}" for name in names)
    return f"{stored.class_path} of {told}; got {got}"


def metadata_of(header: dict[str, Any]) -> dict[str, str]:
    """The file's metadata: a format version, and JSON under `plan` and `config`."""
    return {
        "format": f"{PACKAGE}-map",
        "version": str(FORMAT),
        "plan": json.dumps({"tensor": "map.layers", "columns": LAYER_COLUMNS}),
        "config": json.dumps(header),
    }


def map_size(tensors: dict[str, Tensor], header: dict[str, Any]) -> int:
    """Bytes of the file `write_map` writes."""
    return len(safetensors.torch.save(_plain(tensors), metadata_of(header)))


def write_map(path: Path, tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    """Write the file whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    with whole_file(path) as temporary:
        try:
            safetensors.torch.save_file(_plain(tensors), temporary, metadata_of(header))
        except SafetensorError as error:
            raise InputError(f"{path} was not written: {error}") from error


def _plain(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """As safetensors takes them: whole, and none in another's memory."""
    plain: dict[str, Tensor] = {}
    taken: set[int] = set()
    for name, tensor in tensors.items():
        tensor = tensor.detach().cpu().contiguous()
        memory = tensor.untyped_storage()
        if memory.data_ptr() in taken or memory.nbytes() != tensor.nbytes:
            tensor = tensor.clone()
        taken.add(tensor.untyped_storage().data_ptr())
        plain[name] = tensor
    return plain


def read_map(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and header of a map file.

    Raises:
        InputError: missing, truncated, foreign, or of a newer format.
    """
    if not path.is_file():
        raise InputError(f"{path} is not there; expected a map file written by `dejavu learn`")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != f"{PACKAGE}-map":
                raise InputError(f"{path} is no map of {PACKAGE}; expected a file written by `dejavu learn`")
            if int(metadata["version"]) > FORMAT:
                raise InputError(
                    f"{path} has map format {metadata['version']}; this version reads up to {FORMAT}, "
                    f"a newer {PACKAGE} is needed"
                )
            header = json.loads(metadata["config"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            if int(metadata["version"]) == 1:
                header |= {"velocity": None, "step": None}
                tensors["map.way"] = torch.zeros(0)
            if int(metadata["version"]) < 3:
                header |= {"temperature": None, "trained": None}
                tensors["map.weights"] = torch.zeros(0)
            return tensors, header
    except InputError:
        raise
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is truncated or no map file ({error}); expected a whole one") from error


def read_compressed(path: Path) -> CompressedMap:
    """The map alone, without what made its features.

    Raises:
        InputError: as `read_map`, or tensors that make no map.
    """
    tensors, _ = read_map(path)
    stored = CompressedMap()
    own = {name.removeprefix("map."): tensor for name, tensor in tensors.items() if name.startswith("map.")}
    try:
        stored.load_state_dict(own)
    except (InputError, RuntimeError) as error:
        raise InputError(f"{path}: {' '.join(str(error).split())}") from error
    return stored
