"""Writes a model to a map file and reads it: recipes of its parts, weights and map.

A recipe is the name of a class and its constructor arguments. Only classes in `REGISTRY` are built from a
file; the caller has to give any other module. Nothing is imported by name.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor, nn

from dejavu_torch.data.names import decode_names, encode_names
from dejavu_torch.features.cnn import SmallCNN
from dejavu_torch.features.descriptor import Descriptor
from dejavu_torch.features.distilled import Distilled
from dejavu_torch.features.embedding import Embedding
from dejavu_torch.features.hog import HOG
from dejavu_torch.features.joined import Joined
from dejavu_torch.features.pixels import PatchPixels
from dejavu_torch.features.preprocess import BLANK, Preprocess
from dejavu_torch.features.views import SAMPLE, AugmentedFrames, LabelledFrames
from dejavu_torch.features.whitening import Whitening
from dejavu_torch.features.xfeat import XFeat
from dejavu_torch.maps.file import HEADER as FILE_HEADER
from dejavu_torch.maps.file import checksums, digests, map_size, part_of, read_map, write_map
from dejavu_torch.maps.place_map import Mapper, PlaceMap
from dejavu_torch.maps.spectral import SpectralMapper
from dejavu_torch.maps.summary import MapSummary
from dejavu_torch.maps.template_map import TemplateMapper
from dejavu_torch.maps.weights import is_rounded, packed, unpacked
from dejavu_torch.memory import in_float32
from dejavu_torch.motion.odometry import GroundOdometry
from dejavu_torch.periods.imposed import ImposedPeriods
from dejavu_torch.periods.spectrogram import SpectrogramAnalysis
from dejavu_torch.recognition.calibration import MARGIN, Calibration, Platt
from dejavu_torch.recognition.provenance import Provenance
from dejavu_torch.recognition.views import Views
from dejavu_torch.text import one_line
from dejavu_torch.types import Facts, InputError, Training, Traverse, expect
from dejavu_torch.version import __version__

R = TypeVar("R", bound="Model")
NO_MAP = "a descriptor without a map; expected a map, as from `dejavu learn SOURCE --descriptor FILE`"

# the classes that a map file may name
CLASSES: tuple[type[nn.Module], ...] = (
    Preprocess,
    HOG,
    PatchPixels,
    Distilled,
    XFeat,
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
# arguments that older files name and no class takes; the one that changes a descriptor, with its only value
REMOVED_ARGUMENTS: Mapping[str, Facts] = {
    "Joined": {"shares": ...},
    "Whitening": {"most_views": ..., "power": 1.0, "group_numbers": ...},
}


class Recipe(NamedTuple):
    """The name of a module's class and its constructor arguments."""

    class_path: str
    init_args: Facts


@dataclass
class ModelState:
    """What a model knows of its map's route, apart from tensors.

    Attributes:
        frame_shape: of the reference, (C,H,W), or (D,) of ready features; None if unknown.
        step: pixels of ground from one place of the map to the next; None if frames are places.
        trained: how the features or the map were trained, if they were.
        frame_names: of the reference; empty if it has none.
        calibration: probabilities of right answers.
        provenance: where the map comes from, by which queries that are not independent of it are known.
        views: of images alone, which other visits have shown; `ALONE` where moved images show other places of
            the route. None if nothing is known.
    """

    frame_shape: tuple[int, ...] | None = None
    step: float | None = None
    trained: Training | None = None
    frame_names: list[str] = field(default_factory=list)
    calibration: Calibration | None = None
    views: Views | None = None
    provenance: Provenance = field(default_factory=Provenance)


class Model(Protocol):
    """What a file keeps of `DejaVu`."""

    descriptor: Descriptor
    mapper: Mapper
    velocity: GroundOdometry | None
    threshold: float | None
    precision: float | None
    map: PlaceMap
    state: ModelState


# the header of a map file: a model's parts as recipes, settings and state, and the state of its map
PARTS = ("preprocess", "features", "whitening", "mapper", "velocity")
SETTINGS = ("threshold", "precision", "batch_size")
# arguments that files lack at their defaults
ADDED_ARGUMENTS: Mapping[str, Facts] = {
    "Preprocess": {"range": None, "blank": BLANK},
    "Whitening": {"lengths": None},
}


def recipe_of(module: nn.Module) -> Recipe:
    """The recipe of a module, without arguments if its class is not in `REGISTRY`."""
    cls = type(module)
    if REGISTRY.get(cls.__name__) is not cls:
        return Recipe(f"{cls.__module__}.{cls.__qualname__}", {})
    arguments = {name: getattr(module, name) for name in inspect.signature(cls).parameters}
    for name, value in arguments.items():
        if isinstance(value, nn.ModuleList):
            arguments[name] = [recipe_of(member)._asdict() for member in value]
        elif isinstance(value, nn.Module):
            arguments[name] = recipe_of(value)._asdict()
    for name, default in ADDED_ARGUMENTS.get(cls.__name__, {}).items():
        if arguments[name] == default:
            del arguments[name]
    return Recipe(cls.__name__, json.loads(json.dumps(arguments)))  # compares equal to one from a file


def parts_of(model: Model) -> dict[str, nn.Module | None]:
    """The parts of a model that its file has recipes of."""
    own = model.descriptor
    described = {"preprocess": own.preprocess, "features": own.features, "whitening": own.whitening}
    return described | {"mapper": model.mapper, "velocity": model.velocity}


def recipes_of(model: Model) -> Facts:
    """The recipe of each part of a model, as JSON values."""
    parts = parts_of(model).items()
    return {name: None if part is None else recipe_of(part)._asdict() for name, part in parts}


def with_parts(recipe: Recipe) -> list[Recipe]:
    """A recipe and all recipes nested in it."""
    parts = (part for parts in _parts(recipe).values() for part in parts)
    return [recipe, *(inner for part in parts for inner in with_parts(part))]


def _parts(recipe: Recipe) -> dict[str, list[Recipe]]:
    """The arguments that are recipes, or lists of them, by name."""
    named = {name: value if isinstance(value, list) else [value] for name, value in recipe.init_args.items()}
    return {
        name: [Recipe(**value) for value in values]
        for name, values in named.items()
        if any(isinstance(value, dict) and "class_path" in value for value in values)
    }


def without_gone(recipe: Recipe) -> Recipe:
    """The recipe, and those nested in it, without the arguments in `REMOVED_ARGUMENTS`."""
    gone = REMOVED_ARGUMENTS.get(recipe.class_path, {})
    arguments = {
        key: value
        for key, value in recipe.init_args.items()
        if key not in gone or gone[key] not in (..., value)
    }
    for key, parts in _parts(recipe).items():
        built = [without_gone(part)._asdict() for part in parts]
        arguments[key] = built if isinstance(arguments[key], list) else built[0]
    return Recipe(recipe.class_path, arguments)


def difference(stored: Recipe, given: Recipe) -> str:
    """How two recipes differ, in words."""
    if stored.class_path != given.class_path:
        return f"{stored.class_path}; got {given.class_path}"
    names = [name for name, value in stored.init_args.items() if given.init_args.get(name) != value]
    values = [", ".join(f"{name}={part.init_args.get(name)}" for name in names) for part in (stored, given)]
    return f"{stored.class_path} with {'; got '.join(values)}"


def build(recipe: Recipe, given: nn.Module | None = None) -> Any:
    """A module from its recipe; `given` if it has the same recipe."""
    name = recipe.class_path
    if given is not None and recipe_of(given) == recipe:
        return given
    seen = f"the map's features are of class {name}, which only the caller can load"
    expect(name in REGISTRY, "it as `features`, with its original arguments", seen)
    arguments = dict(recipe.init_args)
    for key, parts in _parts(recipe).items():
        # only learning needs the period finder: a foreign one is omitted
        foreign = key == "periods" and parts[0].class_path not in REGISTRY
        built = [None if foreign else build(part, given) for part in parts]
        if given is not None and sum(member is given for member in built) > 1:
            seen = f"several members of the features are {recipe_of(given).class_path}"
            raise InputError(f"{seen}, and one was given; expected all members, as a list")
        arguments[key] = built if isinstance(arguments[key], list) else built[0]
    module = REGISTRY[name](**arguments)
    if "periods" in arguments:
        module.periods = arguments["periods"]
    return module


def weights_of(model: Model, part: str) -> dict[str, Tensor]:
    """The tensors of a part of a model, such as "features", as stored in a file."""
    module = parts_of(model)[part]
    if module is None:
        return {}
    rounded = part == "features" and model.descriptor.weight_bits == 8
    weights = packed(module) if rounded else module.state_dict()
    # features may be half precision by choice, a whitening only by `model.half()`
    wide = (torch.float64,) if part == "features" else (torch.float64, torch.float16, torch.bfloat16)
    return {
        f"{part}.{name}": tensor.float() if tensor.dtype in wide else tensor
        for name, tensor in weights.items()
        if isinstance(tensor, Tensor)
    }


def state_to_json(state: ModelState) -> Facts:
    """A model's state as JSON values."""
    names = encode_names(state.frame_names) if state.frame_names else None
    calibration = state.calibration and {
        name: platt and {key: value for key, value in platt._asdict().items() if value != ()}
        for name, platt in state.calibration._asdict().items()
    }
    trained = state.trained and state.trained._asdict()
    values = {"frame_shape": state.frame_shape, "step": state.step, "trained": trained, "names": names}
    views = {"views": [*zip(*state.views.known, strict=True)]} if state.views is not None else {}
    provenance = {"provenance": stored} if (stored := state.provenance.stored()) else {}
    return values | {"calibration": calibration, **views, **provenance}


def state_from_json(values: Facts, frames: int | None = None) -> ModelState:
    """The state from the result of `state_to_json`; `frames`: the number of names, None for any."""
    shape, trained, calibration = values["frame_shape"], values["trained"], values["calibration"]
    if calibration is not None:
        calibration = Calibration(**{name: platt and _platt(**platt) for name, platt in calibration.items()})
    return ModelState(
        None if shape is None else tuple(shape),
        values["step"],
        trained and Training(**trained),
        [] if values["names"] is None else decode_names(values["names"], frames),
        calibration,
        (pairs := values.get("views")) and Views(*map(tuple, zip(*pairs, strict=True))),  # type: ignore[arg-type]
        Provenance.restored(values.get("provenance", {})),
    )


def _platt(
    slope: float, offset: float, most: Sequence[Sequence[float]] = (), margin: float | None = MARGIN
) -> Platt:
    """A scaling from a file; those of older versions do not name the margin."""
    return Platt(slope, offset, tuple((upper, limit) for upper, limit in most), margin)


def contents(model: Model) -> tuple[dict[str, Tensor], Facts]:
    """The tensors and the header of a model's map file."""
    settings = {"threshold": model.threshold, "precision": model.precision}
    header = recipes_of(model) | settings | {"batch_size": model.descriptor.batch_size}
    header |= state_to_json(model.state) | {"map": model.map.get_extra_state()}
    place_map = model.map.packed() if model.map.places else {}
    tensors = {f"map.{name}": tensor for name, tensor in place_map.items()}
    return tensors | weights_of(model, "features") | weights_of(model, "whitening"), header


def summary_of(model: Model) -> MapSummary:
    """The resolution of a model's map, and the bytes of its file by part."""
    tensors, header = contents(model)
    fixed = {
        name: sum(tensor.nbytes for tensor in weights_of(model, part).values())
        for name, part in (("backbone", "features"), ("whitening", "whitening"))
    }
    fixed["names"] = len(header["names"] or "")
    summary = model.map.summary()
    fixed["header"] = map_size(tensors, header) - summary.map_bytes - sum(fixed.values())
    return summary.with_parts(fixed=fixed)


def write_model(path: Path, model: Model) -> None:
    """See `DejaVu.save`."""
    check_rounded(model.descriptor)
    write_map(path, *contents(model))


def read_model(make: Callable[..., R], path: Path, features: nn.Module | None) -> R:
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
                build(header["features"]).load_state_dict(part_of(weights, "features"), assign=True)
        with in_float32():
            parts = {name: header[name] and build(header[name], features) for name in PARTS}
        parts["whitening"] = parts["whitening"] or "none"
        model = make(**parts, **{name: header[name] for name in SETTINGS})
        _fill(model.map, tensors, header["map"])
        for name in ("features", "whitening"):
            if (part := parts_of(model)[name]) is not None:
                part.load_state_dict(part_of(weights, name))
        model.descriptor.weight_bits = 8 if len(weights) < len(tensors) else 32
        model.state = state_from_json(header, model.map.table.frames)
        return model


def read_place_map(path: Path) -> PlaceMap:
    """The map of a file without its feature modules; InputError as in `DejaVu.load`."""
    with opened(path) as (tensors, header):
        place_map: PlaceMap = build(header["mapper"]).empty()
        if header["map"].get("places") == 0:
            raise InputError(NO_MAP)
        _fill(place_map, tensors, header["map"])
    return place_map


@contextmanager
def opened(path: Path) -> Iterator[tuple[dict[str, Tensor], Facts]]:
    """Tensors and header of a map file; errors within the block are raised with the file's name."""
    tensors, values = read_map(path)
    try:
        recipes = {name: values[name] and without_gone(Recipe(**values[name])) for name in PARTS}
        header = values | recipes
        kinds = [cls.kind for cls in REGISTRY.values() if issubclass(cls, Mapper)]
        if header["map"].get("kind") not in kinds:
            seen = f"a map of kind {header['map'].get('kind')!r:.40}"
            raise InputError(f"{seen}; this version knows {', '.join(kinds)}")
        yield tensors, header
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except MemoryError:
        raise
    except Exception as error:  # of torch for other tensors, of a module for arguments of another version
        cause = one_line(error) or type(error).__name__
        raise InputError(f"{path} does not fit its modules: {cause}") from error


def _fill(place_map: PlaceMap, tensors: Mapping[str, Tensor], state: Facts) -> None:
    """Fill an empty map from a file; it stays empty if the file has only a descriptor."""
    stored = part_of(tensors, "map")
    if stored or state.get("places"):
        place_map.load_packed(stored, state)
    else:
        place_map.set_extra_state(state)


def check_types(tensors: Mapping[str, Tensor], features: nn.Module) -> None:
    """Refuse integers for float weights, such as 8-bit weights without their scales."""
    for name, weight in features.state_dict().items():
        stored = tensors.get(f"features.{name}")
        is_float = isinstance(weight, Tensor) and weight.dtype.is_floating_point
        if is_float and stored is not None and not stored.dtype.is_floating_point:
            kind = str(stored.dtype).removeprefix("torch.")
            raise InputError(f"it does not fit: features.{name} is {kind}; expected a float type")


def check_rounded(descriptor: Descriptor) -> None:
    """Refuse a descriptor of 8-bit weights that are not rounded."""
    seen = f"weights of {type(descriptor.features).__name__} are not rounded to 8 bits, or changed since then"
    fits = descriptor.weight_bits != 8 or is_rounded(descriptor.features)
    expect(fits, "a DejaVu constructed from them with weight_bits=8", seen)


def run_key(
    model: Model,
    traverse: Traverse,
    second: LabelledFrames | None = None,
    visits: LabelledFrames | None = None,
) -> dict[str, str]:
    """Digests of everything that affects the chunks of a traverse, see `learning.Checkpoint`."""
    descriptor, header = model.descriptor, recipes_of(model)
    parts = [*descriptor.modules(), *model.mapper.modules()]
    header["code"] = sorted(filter(None, map(_code_of, {type(part) for part in parts})))
    header |= {"batch_size": descriptor.batch_size, "sample": SAMPLE}
    header |= {"version": __version__, "torch": torch.__version__, "device": descriptor.device.type}
    fixed = descriptor.whitening is not None and descriptor.whitening.fixed
    weights = weights_of(model, "features") | (weights_of(model, "whitening") if fixed else {})
    sums = checksums(weights, header)
    sources = {
        name: views and [*_source(views.traverse), views.places.tolist(), *["placed"] * bool(views.placed)]
        for name, views in (("second", second), ("visits", visits))
    }
    return digests(source=_source(traverse), **sources) | {"settings": sums.pop(FILE_HEADER), **sums}


def _source(traverse: Traverse | AugmentedFrames) -> list[object]:
    """What identifies the source of a traverse, without its frames."""
    names = [*traverse.names] if isinstance(traverse, Traverse) else []
    return [traverse.name, len(traverse), [*traverse.frame_shape], names]


def _code_of(cls: type[nn.Module]) -> str:
    """The source of a user's class; "" if there is none, or for a class that a version identifies."""
    if cls.__module__.partition(".")[0] in ("dejavu_torch", "torch"):
        return ""
    try:
        return inspect.getsource(cls)
    except (OSError, TypeError):
        return ""
