"""Writes a model to a map file and reads it: recipes of its parts, weights and map.

A recipe is the name of a class and its constructor arguments. Only classes in `REGISTRY` are built from a
file; the caller has to give any other module. Nothing is imported by name.
"""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, get_type_hints

import torch
from torch import Tensor, nn

from dejavu_torch.data.names import decode_names, encode_names
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.features.preprocess import Preprocess
from dejavu_torch.features.views import Views
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.learning import SAMPLE
from dejavu_torch.maps.file import HEADER as FILE_HEADER
from dejavu_torch.maps.file import (
    checked,
    checked_fields,
    checksums,
    digests,
    map_size,
    part_of,
    read_map,
    write_map,
)
from dejavu_torch.maps.place_map import Mapper, PlaceMap
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.maps.weights import is_rounded, packed, unpacked
from dejavu_torch.memory import in_float32
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.recognition.calibration import Calibration
from dejavu_torch.text import one_line
from dejavu_torch.types import FRAME_NUMBERS, InputError, Training, Traverse
from dejavu_torch.version import __version__

M = TypeVar("M", bound=nn.Module)
MAX_PARTS = 16  # of a recipe
NO_MAP = "a descriptor without a map; expected a map, as from `dejavu learn SOURCE --descriptor FILE`"

# the classes that a map file may name
CLASSES: tuple[type[nn.Module], ...] = (
    Preprocess,
    HOG,
    PatchPixels,
    Distilled,
    SmallCNN,
    Embedding,
    Joined,
    Whitening,
    SpectrogramAnalysis,
    ImposedPeriods,
    TemplateMapper,
    SpectralMapper,
    GroundOdometry,
)
REGISTRY = {cls.__name__: cls for cls in CLASSES}
# arguments that older files name and no class takes, with the only value that they may have
GONE: Mapping[str, Mapping[str, Any]] = {
    "Joined": {"shares": None},
    "Whitening": {"most_views": 20_000, "power": 1.0, "group_numbers": None},
}


class Recipe(NamedTuple):
    """The name of a module's class and its constructor arguments."""

    class_path: str
    init_args: dict[str, Any]


# the header of a map file: a model's parts, settings and state, and the state of its map
PARTS: dict[str, tuple[type[nn.Module], Any]] = {
    "preprocess": (Preprocess, Recipe),
    "features": (nn.Module, Recipe),
    "whitening": (Whitening, Recipe | None),
    "mapper": (Mapper, Recipe),
    "velocity": (GroundOdometry, Recipe | None),
}
SETTINGS = {"threshold": float | None, "precision": float | None, "batch_size": int}
STATE = {
    "frame_shape": tuple[int, ...] | None,
    "step": float | None,
    "trained": Training | None,
    "names": str | None,
    "calibration": Calibration | None,
}
HEADER = {name: kind for name, (_, kind) in PARTS.items()} | SETTINGS | STATE | {"map": dict[str, Any]}


def recipe_of(module: nn.Module) -> Recipe:
    """The recipe of a module, without arguments if its class is not in `REGISTRY`."""
    cls = type(module)
    if REGISTRY.get(cls.__name__) is not cls:
        return Recipe(f"{cls.__module__}.{cls.__qualname__}", {})
    arguments = {name: getattr(module, name) for name in inspect.signature(cls).parameters}
    for name, value in arguments.items():
        if isinstance(value, nn.ModuleList):
            arguments[name] = [recipe_of(one)._asdict() for one in value]
        elif isinstance(value, nn.Module):
            arguments[name] = recipe_of(value)._asdict()
    return Recipe(cls.__name__, json.loads(json.dumps(arguments)))  # compares equal to one from a file


def recipes_of(model: Any) -> dict[str, Any]:
    """The recipe of each part of a model, as JSON values."""
    parts = {name: getattr(model, name) for name in PARTS}
    return {name: None if part is None else recipe_of(part)._asdict() for name, part in parts.items()}


def with_parts(recipe: Recipe) -> list[Recipe]:
    """A recipe and all recipes nested in it."""
    parts = (part for parts in _parts(recipe).values() for part in parts)
    return [recipe, *(inner for part in parts for inner in with_parts(part))]


def _parts(recipe: Recipe) -> dict[str, list[Recipe]]:
    """The arguments that are recipes, or lists of them, by name."""
    named = {name: one if isinstance(one, list) else [one] for name, one in recipe.init_args.items()}
    return {
        name: checked(ones, list[Recipe], name)
        for name, ones in named.items()
        if any(isinstance(one, dict) and "class_path" in one for one in ones)
    }


def without_gone(recipe: Recipe) -> Recipe:
    """The recipe, and those nested in it, without the arguments in `GONE`; InputError for another value."""
    name, gone = recipe.class_path, GONE.get(recipe.class_path, {})
    arguments = {key: value for key, value in recipe.init_args.items() if key not in gone}
    for key in gone.keys() & recipe.init_args.keys():
        if (seen := recipe.init_args[key]) != gone[key]:
            raise InputError(f"the map's {name} has {key} {seen!r:.40}; expected {gone[key]}")
    for key, parts in _parts(recipe).items():
        built = [without_gone(part)._asdict() for part in parts]
        arguments[key] = built if isinstance(arguments[key], list) else built[0]
    return Recipe(name, arguments)


def difference(stored: Recipe, given: Recipe) -> str:
    """How two recipes differ, in words."""
    if stored.class_path != given.class_path:
        return f"{stored.class_path}; got {given.class_path}"
    names = [name for name, value in stored.init_args.items() if given.init_args.get(name) != value]
    values = [", ".join(f"{name}={one.init_args.get(name)}" for name in names) for one in (stored, given)]
    return f"{stored.class_path} with {'; got '.join(values)}"


def build(recipe: Recipe, kind: type[M], given: nn.Module | None = None) -> M:
    """A module of base class `kind` from its recipe; `given` if it has the same recipe."""
    name = recipe.class_path
    if isinstance(given, kind) and recipe_of(given) == recipe:
        return given
    if name not in REGISTRY:
        seen = f"the map's features are of class {name}, which only the caller can load"
        raise InputError(f"{seen}; expected it as `features`, with its original arguments")
    cls = REGISTRY[name]
    if not issubclass(cls, kind):
        raise InputError(f"the map names {name}; expected a {kind.__name__}")
    hints = get_type_hints(cls.__init__)
    kinds = {  # an argument that is newer than the file gets its default
        key: hints[key]
        for key, parameter in inspect.signature(cls).parameters.items()
        if key in recipe.init_args or parameter.default is parameter.empty
    }
    arguments = checked_fields(recipe.init_args, kinds, f"the map's {name}")
    count = len(with_parts(recipe))
    if count > MAX_PARTS:
        raise InputError(f"the map's {name} has {count} parts; expected at most {MAX_PARTS}")
    for key, parts in _parts(recipe).items():
        # only learning needs the period finder: a foreign one is omitted
        foreign = key == "periods" and parts[0].class_path not in REGISTRY
        built = [None if foreign else build(part, nn.Module, given) for part in parts]
        if given is not None and sum(one is given for one in built) > 1:
            seen = f"several members of the features are {recipe_of(given).class_path}"
            raise InputError(f"{seen}, and one was given; expected all members, as a list")
        arguments[key] = built if isinstance(arguments[key], list) else built[0]
    module: Any = cls(**arguments)
    if "periods" in arguments:
        module.periods = arguments["periods"]
    return module  # type: ignore[no-any-return]


def weights_of(model: Any, part: str) -> dict[str, Tensor]:
    """The tensors of a part of a model, such as "features", as stored in a file."""
    module = getattr(model, part)
    state = {} if module is None else module.state_dict()
    weights = packed(module) if part == "features" and model.weight_bits == 8 else state
    # features may be half precision by choice, a whitening only by `model.half()`
    wide = (torch.float64,) if part == "features" else (torch.float64, torch.float16, torch.bfloat16)
    return {
        f"{part}.{name}": tensor.float() if tensor.dtype in wide else tensor
        for name, tensor in weights.items()
        if isinstance(tensor, Tensor)
    }


def model_state(model: Any) -> dict[str, Any]:
    """A model's state apart from tensors and the map's own state, as JSON values."""
    names = encode_names(model.frame_names) if model.frame_names else None
    return {name: _json(names if name == "names" else getattr(model, name)) for name in STATE}


def _json(value: Any) -> Any:
    return {key: _json(one) for key, one in value._asdict().items()} if hasattr(value, "_asdict") else value


def set_state(model: Any, state: Mapping[str, Any], frames: int | None = None) -> None:
    """Restore the result of `model_state`, whose types are checked."""
    for name in STATE.keys() - {"names"}:
        setattr(model, name, state[name])
    names = state["names"]
    model.frame_names = [] if names is None else decode_names(names, frames)


def contents(model: Any) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors and the header of a model's map file."""
    header = recipes_of(model) | {name: getattr(model, name) for name in SETTINGS} | model_state(model)
    header["map"] = model.map.get_extra_state()
    route = model.map.packed() if model.map.places else {}
    tensors = {f"map.{name}": tensor for name, tensor in route.items()}
    return tensors | weights_of(model, "features") | weights_of(model, "whitening"), header


def summary_of(model: Any) -> MapSummary:
    """The resolution of a model's map, and the bytes of its file by part."""
    tensors, header = contents(model)
    fixed = {
        name: sum(tensor.nbytes for tensor in weights_of(model, part).values())
        for name, part in (("backbone", "features"), ("whitening", "whitening"))
    }
    fixed["names"] = len(header["names"] or "")
    summary: MapSummary = model.map.summary()
    fixed["header"] = map_size(tensors, header) - summary.route_bytes - sum(fixed.values())
    return summary.with_parts(fixed=fixed)


def write_model(path: Path, model: Any) -> None:
    """See `DejaVu.save`."""
    _check_rounded(model)
    tensors, header = contents(model)
    checked_fields(header, HEADER, "the model")  # as reading will
    checked(header["map"], model.map.state, "the map")
    write_map(path, tensors, header)


def read_model(make: Callable[..., M], path: Path, features: nn.Module | None) -> M:
    """See `DejaVu.load`; `make` is `DejaVu`."""
    with opened(path) as (tensors, header):
        if features is not None and (given := recipe_of(features)) != (whole := header["features"]):
            # a part is enough if only the caller can load it
            foreign = any(part.class_path not in REGISTRY for part in with_parts(given))
            if not (foreign and given in with_parts(whole)):
                raise InputError(f"it was learned with {difference(whole, given)}")
        weights = unpacked(tensors, "features.")
        if features is None:
            with torch.device("meta"):  # large layers in a bad header allocate nothing
                probe = nn.ModuleDict({"features": _part(header, "features", None)})
                own = {name: one for name, one in weights.items() if name.startswith("features.")}
                probe.load_state_dict(own, assign=True)
        with in_float32():
            parts = {name: _part(header, name, features) for name in PARTS}
        parts["whitening"] = parts["whitening"] or "none"
        model: Any = make(**parts, **{name: header[name] for name in SETTINGS})
        _fill(model.map, tensors, header["map"])
        check_types(weights, model.features)
        rest = {name: weight for name, weight in weights.items() if not name.startswith("map.")}
        loaded = model.load_state_dict(rest, strict=False)
        missing = [name for name in loaded.missing_keys if name.startswith(("features.", "whitening."))]
        if missing or loaded.unexpected_keys:
            raise InputError(f"it does not fit: missing {missing}, unexpected {loaded.unexpected_keys}")
        model.weight_bits = 8 if len(weights) < len(tensors) else 32
        _check_rounded(model)
        set_state(model, header, model.map.table.frames)
        _check(model)
        return model  # type: ignore[no-any-return]


def read_place_map(path: Path) -> PlaceMap:
    """The map of a file without its feature modules; InputError as in `DejaVu.load`."""
    with opened(path) as (tensors, header):
        route: PlaceMap = _part(header, "mapper", None).empty()
        if header["map"].get("places") == 0:
            raise InputError(NO_MAP)
        _fill(route, tensors, header["map"])
    return route


@contextmanager
def opened(path: Path) -> Iterator[tuple[dict[str, Tensor], dict[str, Any]]]:
    """Tensors and header of a map file; errors within the block are raised with the file's name."""
    tensors, values = read_map(path)
    try:
        header = checked_fields(values, HEADER, "its header")
        header |= {name: without_gone(header[name]) for name in PARTS if header[name] is not None}
        known = [cls.kind for cls in REGISTRY.values() if issubclass(cls, Mapper)]
        if header["map"].get("kind") not in known:
            seen = f"a map of kind {header['map'].get('kind')!r:.40}"
            raise InputError(f"{seen}; this version knows {', '.join(known)}")
        yield tensors, header
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (RuntimeError, RecursionError) as error:  # torch cannot load tensors, or the nesting is too deep
        raise InputError(f"{path} does not fit its modules: {one_line(error)}") from error


def _part(header: Mapping[str, Any], name: str, features: nn.Module | None) -> Any:
    kind, _ = PARTS[name]
    return None if header[name] is None else build(header[name], kind, features)


def _fill(route: PlaceMap, tensors: Mapping[str, Tensor], state: dict[str, Any]) -> None:
    """Fill an empty map from a file; it stays empty if the file has only a descriptor."""
    checked(state, route.state, "its map")
    own = part_of(tensors, "map")
    if own or state.get("places"):
        route.load_packed(own, state)
    else:
        route.set_extra_state(state)


def check_types(tensors: Mapping[str, Tensor], features: nn.Module) -> None:
    """Refuse integers for float weights, such as 8-bit weights without their scales."""
    for name, own in features.state_dict().items():
        stored = tensors.get(f"features.{name}")
        is_float = isinstance(own, Tensor) and own.dtype.is_floating_point
        if is_float and stored is not None and not stored.dtype.is_floating_point:
            kind = str(stored.dtype).removeprefix("torch.")
            raise InputError(f"it does not fit: features.{name} is {kind}; expected a float type")


def _check_rounded(model: Any) -> None:
    if model.weight_bits == 8 and not is_rounded(model.features):
        seen = f"weights of {type(model.features).__name__} are not rounded to 8 bits, or changed since then"
        raise InputError(f"{seen}; expected a DejaVu constructed from them with weight_bits=8")


def _check(model: Any) -> None:
    """Refuse inconsistent parts of a model."""
    positions, step, shape, whitening = model.map.positions, model.step, model.frame_shape, model.whitening
    resampled = model.velocity is not None and step is not None and step > 0
    if (len(positions) > 0) != resampled or (step is not None) != resampled:
        raise InputError(f"it has step {step} and {len(positions)} frame positions")
    if whitening is not None and whitening.learned:
        found, expected = whitening.dimension, model.map.dimension
        if found != (expected or found):
            raise InputError(f"its whitening makes {found} dimensions; expected the map's {expected}")
    if shape is not None and (len(shape) not in (1, 3) or min(shape) < 1 or math.prod(shape) > FRAME_NUMBERS):
        raise InputError(f"its frames are {shape}; expected (C,H,W) or (D,)")


def run_key(
    model: Any, traverse: Traverse, second: Views | None = None, visits: Views | None = None
) -> dict[str, str]:
    """Digests of everything that affects the chunks of a traverse, see `learning.Checkpoint`."""
    header = recipes_of(model)
    header["code"] = sorted(filter(None, map(_code_of, {type(one) for one in model.modules()})))
    header |= {"batch_size": model.describer.batch_size, "sample": SAMPLE}
    header |= {"version": __version__, "torch": torch.__version__, "device": model.describer.device.type}
    fixed = model.whitening is not None and model.whitening.fixed
    weights = weights_of(model, "features") | (weights_of(model, "whitening") if fixed else {})
    sums = checksums(weights, header)
    sources = {
        name: views
        and [views.traverse.identity(), views.traverse.state(0, len(views.places)), views.places.tolist()]
        for name, views in (("second", second), ("visits", visits))
    }
    source = [traverse.identity(), traverse.count()]
    return digests(source=source, **sources) | {"settings": sums.pop(FILE_HEADER), **sums}


def _code_of(cls: type[nn.Module]) -> str:
    """The source of a user's class; "" if there is none, or for a class that a version identifies."""
    if cls.__module__.partition(".")[0] in ("dejavu_torch", "torch"):
        return ""
    try:
        return inspect.getsource(cls)
    except (OSError, TypeError):
        return ""
