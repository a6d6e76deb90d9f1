"""One safetensors file for a map: tensors, and JSON that says what they are. No pickle, no code."""

from __future__ import annotations

import importlib
import inspect
import json
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import safetensors.torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from dejavu_torch.data.files import whole_file
from dejavu_torch.types import InputError

FORMAT = 1
PACKAGE = "dejavu_torch"
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
    # as JSON gives it back, so that a recipe read from a file equals the module's own
    return Recipe(path, json.loads(json.dumps(arguments)))


def build(recipe: Recipe, kind: type[M]) -> M:
    """Build a module of this package from its recipe; never imports anything else.

    Raises:
        InputError: a class outside this package, one that is not there, or one that is no `kind`.
    """
    module_name, _, class_name = str(recipe.class_path).rpartition(".")
    if not str(recipe.class_path).startswith(PACKAGE + "."):
        raise InputError(
            f"the map's features come from {recipe.class_path}, which only the caller can load; "
            "expected --features CLASS, or features=... in Python"
        )
    try:
        cls = getattr(importlib.import_module(module_name), class_name)
        if not (isinstance(cls, type) and issubclass(cls, kind)):
            raise TypeError(f"{class_name} is no {kind.__name__}")
        module = cls(**recipe.init_args)
    except (ImportError, AttributeError, TypeError) as error:
        raise InputError(f"the map names {recipe.class_path}, which cannot be built: {error}") from error
    return module


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
            return {name: file.get_tensor(name) for name in file.keys()}, header  # noqa: SIM118
    except InputError:
        raise
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise InputError(f"{path} is truncated or no map file ({error}); expected a whole one") from error
